"""Arrays by name: ``.npz`` that NumPy writes, HDF5 in each layout, and files that lie about their size."""

import io
import os
import zipfile

import h5py
import numpy as np
import pytest
from support.radiant_cloud import radiant_cloud

from beam_warp import converters
from beam_warp.errors import AssetFormatError
from beam_warp.world.gaussians import GaussianSequence

MINIMAL = {
    "positions": [[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]],
    "orientations": [[0.0, 0.0, 0.0, 1.0]] * 2,
    "scales": [[0.1, 0.2, 0.3]] * 2,
    "opacities": [0.5, 1.0],
}


def test_plain_arrays_of_any_type_are_read(tmp_path):
    positions = np.asfortranarray(np.array(MINIMAL["positions"], np.float64))
    np.savez_compressed(tmp_path / "a.npz", **MINIMAL | {"positions": positions}, other=np.zeros(3))
    sequence = converters.read(tmp_path / "a.npz", meters_per_unit=0.5)
    assert sequence[0].positions.tolist() == [[0.5, 1.0, 1.5], [2.0, 2.5, 3.0]]
    assert sequence[0].axes == "rdf"
    assert sequence.metadata["notes"].splitlines()[0] == "arrays left out: other"


def test_npz_keeps_every_array_axes_and_rate(tmp_path):
    cloud = radiant_cloud(7, materials=True, ids=np.arange(7), axes="fru")
    converters.write(GaussianSequence.from_clouds([cloud], frames_per_second=24.0), tmp_path / "a.npz")
    with np.load(tmp_path / "a.npz") as stored:
        assert str(stored["axes"]) == "fru"
    back = converters.read(tmp_path / "a.npz")
    assert (back[0].axes, back.frames_per_second) == ("fru", 24.0)
    for name, array in cloud.arrays().items():
        assert np.array_equal(getattr(back[0], name), array), name
    assert "notes" not in back.metadata


def npz(path, **members):
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in members.items():
            archive.writestr(f"{name}.npy", content)


def npy(array, **changes):
    """Bytes of an array, with another shape in the header on request."""
    stream = io.BytesIO()
    np.lib.format.write_array_header_1_0(
        stream, {"descr": "<f4", "fortran_order": False, "shape": array.shape, **changes}
    )
    return stream.getvalue() + array.astype("<f4").tobytes()


def test_npz_that_lie_or_hold_no_numbers_are_refused(tmp_path):
    sound = {name: npy(np.array(value)) for name, value in MINIMAL.items()}
    path = tmp_path / "a.npz"
    for member, message in (
        (npy(np.zeros((2, 3)), shape=(2**40, 3)), r"got 152 bytes for float32 of shape \(1099511627776, 3\)"),
        (npy(np.zeros((2, 3)), shape=(-2, 3)), r"must be an \.npz file with arrays of numbers"),
        (sound["positions"][:-1], "must be an .npz file"),
        (b"\x93NUMPY\x01\x00", "must be an .npz file"),
        (sound["positions"].replace(b"}", b" "), r"got .*EOF|never closed"),
        (npy(np.zeros((2, 4))), r"positions must have shape \(N, 3\), got \(2, 4\)"),
    ):
        npz(path, **sound | {"positions": member})
        with pytest.raises(AssetFormatError, match=message):
            converters.read(path)
    np.savez(path, **MINIMAL | {"positions": np.array([{}, []], object)})
    with pytest.raises(AssetFormatError, match=r"must be an \.npz file with arrays of numbers"):
        converters.read(path)
    np.savez(path, **MINIMAL, axes="xyz")
    with pytest.raises(AssetFormatError, match=r"a\.npz: axes must be three letters"):
        converters.read(path)
    np.savez(path, positions=MINIMAL["positions"])
    with pytest.raises(AssetFormatError, match="got none named orientations, scales, opacities"):
        converters.read(path)
    path.write_bytes(b"PK\x03\x04")
    with pytest.raises(AssetFormatError, match=r"must be an \.npz file"):
        converters.read(path)


def test_compressed_zeros_are_refused_before_they_are_unpacked(tmp_path, monkeypatch):
    monkeypatch.setattr("beam_warp.converters.arrays.MAX_FREE_BYTES", 2**20)
    np.savez_compressed(tmp_path / "a.npz", **MINIMAL | {"radiance": np.zeros((2, 10**6, 3), np.float32)})
    with h5py.File(tmp_path / "a.h5", "w") as file:
        for name, value in MINIMAL.items():
            file[name] = value
        file.create_dataset("radiance", (2, 10**9, 3), "f4", chunks=(1, 1000, 3), compression="gzip")
    for name in ("a.npz", "a.h5"):
        with pytest.raises(AssetFormatError, match=r"must hold at most 1 MiB a frame for its size"):
            converters.read(tmp_path / name)


def test_hdf5_with_one_frame_and_attributes(tmp_path):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        for name, value in MINIMAL.items():
            file[name] = value
        file["mask"] = [1, 2]
        file.attrs.update(axes="rub", meters_per_unit=0.01, frames_per_second=25)
    sequence = converters.read(tmp_path / "a.h5")
    assert (len(sequence), sequence[0].axes, sequence.frames_per_second) == (1, "rub", 25.0)
    assert np.allclose(sequence[0].positions, 0.01 * np.array(MINIMAL["positions"]))
    assert sequence.metadata["notes"] == "arrays left out: mask"


@pytest.mark.parametrize("layout", ["axis", "groups"])
def test_hdf5_with_several_frames_shares_what_stands_once(tmp_path, layout):
    moved = [np.array(MINIMAL["positions"]) + frame for frame in range(12)]
    with h5py.File(tmp_path / "a.hdf5", "w") as file:
        for name in ("orientations", "scales", "opacities"):
            file[name] = MINIMAL[name]
        if layout == "axis":
            file["positions"] = np.stack(moved)
        else:
            for frame, positions in enumerate(moved):
                file[f"frame_{frame}/positions"] = positions  # 10 comes after 9, not after 1
        file.attrs["axes"] = "rdf"
    sequence = converters.read(tmp_path / "a.hdf5")
    assert len(sequence) == 12
    for frame, positions in enumerate(moved):
        assert np.array_equal(sequence[frame].positions, positions.astype(np.float32))
    assert converters.inspect(tmp_path / "a.hdf5").frame_count == 12


def test_hdf5_that_reaches_outside_or_disagrees_is_refused(tmp_path):
    path = tmp_path / "a.h5"

    def write(**changes):
        with h5py.File(path, "w") as file:
            for name, value in (MINIMAL | changes).items():
                if value is None:  # nothing is stored of what is never written
                    file.create_dataset(name, (10**9, 3), "f4")
                else:
                    file[name] = value

    for changes, message in (
        ({"positions": h5py.ExternalLink("other.h5", "positions")}, "must hold its arrays itself, got positions as"),
        ({"positions": h5py.SoftLink("/scales")}, "must hold its arrays itself"),
        ({"positions": [b"a", b"b"]}, "must have numbers with 2 axes in positions"),
        ({"positions": np.zeros((3, 2, 3)), "scales": np.zeros((4, 2, 3))}, "must have one number of frames"),
        ({"positions": np.zeros((0, 2, 3))}, "must have 1 to 100000 frames, got 0"),
        ({"positions": None}, "must hold its arrays whole, got positions without its data"),
        ({"positions": np.zeros((3, 3))}, "must have as many rows in opacities as in positions"),
    ):
        write(**changes)
        with pytest.raises(AssetFormatError, match=message):
            converters.read(path)
    path.write_bytes(b"\x89HDF\r\n\x1a\n" + bytes(64))
    with pytest.raises(AssetFormatError, match="must be an HDF5 file"):
        converters.read(path)


def test_hdf5_follows_no_links_to_frames_and_unpacks_no_large_chunk(tmp_path):
    path, elsewhere = tmp_path / "a.h5", tmp_path / "b.h5"
    for name in (path, elsewhere):
        with h5py.File(name, "w") as file:
            for field, value in MINIMAL.items():
                file[field] = value
    os.mkfifo(tmp_path / "pipe.h5")  # who opens it waits
    with h5py.File(path, "a") as file:
        file["frame1"], file["frame2"] = h5py.ExternalLink("b.h5", "/"), h5py.ExternalLink("pipe.h5", "/")
    assert len(converters.read(path)) == 1
    with h5py.File(path, "a") as file:
        del file["positions"]
        large = {"chunks": (2**23, 3), "maxshape": (None, 3), "compression": "gzip"}
        file.create_dataset("positions", data=MINIMAL["positions"], dtype="f4", **large)
    with pytest.raises(AssetFormatError, match=r"must have chunks of at most 64 MiB, got \(8388608, 3\) of positions"):
        converters.read(path)


def test_archives_and_groups_without_end_are_refused(tmp_path, monkeypatch):
    path = tmp_path / "a.npz"
    with zipfile.ZipFile(path, "w") as archive:
        for number in range(4000):
            archive.writestr(f"{number}.npy", b"")
    with pytest.raises(AssetFormatError, match=r"got a directory of \d+ bytes"):
        converters.read(path)
    monkeypatch.setattr("beam_warp.converters.arrays.MAX_NAMES", 8)
    with h5py.File(tmp_path / "a.h5", "w") as file:
        for number in range(9):
            file.create_group(f"frame{number}")
    with pytest.raises(AssetFormatError, match="must have at most 8 arrays and groups, got 9"):
        converters.read(tmp_path / "a.h5")
