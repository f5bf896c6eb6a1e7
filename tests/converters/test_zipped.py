"""Zipped frames: any format inside, in order, unpacked one at a time; archives with tricks are refused."""

import struct
import zipfile

import numpy as np
import pytest

from beam_warp import converters
from beam_warp.errors import AssetFormatError, MissingFileError
from beam_warp.world.gaussians import GaussianSequence


@pytest.fixture
def frames(make_cloud, tmp_path):
    """Eleven frames in alternating formats, in a folder of their own."""
    (tmp_path / "walk").mkdir()
    for number in range(11):
        ending = ("ply", "splat", "npz")[number % 3]
        cloud = make_cloud(3, seed=number, axes="rdf")
        converters.write(GaussianSequence.from_clouds([cloud]), tmp_path / "walk" / f"walk{number}.{ending}")
    return tmp_path / "walk"


def zipped(path, **members):
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    return path


def test_frames_of_any_format_are_read_in_order(frames, tmp_path, monkeypatch):
    temporary = tmp_path / "temporary"
    temporary.mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(temporary))
    members = {f"take/{path.name}": path.read_bytes() for path in frames.iterdir()}
    zipped(
        tmp_path / "walk.zip", **members, **{"take/": b"", "__MACOSX/take/._walk0.ply": b"x", "take/.DS_Store": b"x"}
    )
    sequence, plain = converters.read(tmp_path / "walk.zip"), converters.read(frames)
    assert len(sequence) == len(plain) == 11
    for frame in (10, 3, 0):
        assert np.array_equal(sequence[frame].positions, plain[frame].positions)
        assert not list(temporary.iterdir())
    assert sequence.metadata["source"] == "walk.zip"


def test_one_file_needs_no_number(columns, ply_bytes, tmp_path):
    path = zipped(tmp_path / "person.zip", **{"person.ply": ply_bytes(columns)})
    assert len(converters.read(path, source_axes="rub")[0]) == 3


def test_an_entry_without_a_name_is_no_frame(columns, ply_bytes, tmp_path):
    path = zipped(tmp_path / "person.zip", **{"person.ply": ply_bytes(columns)})
    with zipfile.ZipFile(path, "a") as archive:
        archive.writestr(zipfile.ZipInfo(""), b"")
    assert len(converters.read(path, source_axes="rub")) == 1


@pytest.mark.parametrize("count", [1, 2])
def test_gltf_brings_the_file_of_its_arrays(make_cloud, tmp_path, count):
    clouds = [make_cloud(3, seed=number, axes="rub") for number in range(count)]
    files = converters.write(GaussianSequence.from_clouds(clouds), tmp_path / "walk.gltf")
    path = zipped(tmp_path / "walk.zip", **{f"take/{file.name}": file.read_bytes() for file in files})
    sequence = converters.read(path)
    assert len(sequence) == count
    assert all(np.array_equal(sequence[n].positions, cloud.positions) for n, cloud in enumerate(clouds))
    with pytest.raises(MissingFileError, match=r"file of buffer 0 must exist, got 'walk.*\.bin'"):
        converters.read(zipped(path, **{files[0].name: files[0].read_bytes()}))


def test_archives_that_are_no_frames_or_reach_outside(columns, ply_bytes, tmp_path):
    sound = ply_bytes(columns)
    path = tmp_path / "a.zip"
    for members, message in (
        ({"../a0.ply": sound, "../a1.ply": sound}, r"must hold files inside itself, got '\.\./a0\.ply'"),
        ({"/a0.ply": sound}, "must hold files inside itself"),
        ({"a0.ply": sound, "a2.ply": sound}, r"a\.zip must hold every frame, got none between a0\.ply and a2\.ply"),
        ({"x/a0.ply": sound, "y/a0.ply": sound}, "must hold each frame once"),
        ({"a.txt": b""}, r"a\.zip must hold .* or numbered files"),
        ({"a0.ply": sound[:-1], "a1.ply": sound}, r"a0\.ply: .*must have the 3 rows"),
        ({"a0.ply": bytes(2**27), "a1.ply": sound}, "must unpack to at most 32 × its size"),
    ):
        with pytest.raises(AssetFormatError, match=message):
            converters.read(zipped(path, **members))
    path.write_bytes(zipped(path, a=sound).read_bytes()[:-30])
    with pytest.raises(AssetFormatError, match="must be a whole zip archive"):
        converters.read(path)


def test_encrypted_and_damaged_members_are_refused(columns, ply_bytes, tmp_path):
    content = bytearray(zipped(tmp_path / "a.zip", **{"a.ply": ply_bytes(columns)}).read_bytes())
    directory = content.index(b"PK\x01\x02")
    struct.pack_into("<H", content, directory + 8, 1)
    (tmp_path / "b.zip").write_bytes(content)
    with pytest.raises(AssetFormatError, match=r"must not be encrypted, got 'a\.ply'"):
        converters.read(tmp_path / "b.zip")
    struct.pack_into("<H", content, directory + 8, 0)
    struct.pack_into("<I", content, directory + 16, 0)  # another checksum
    (tmp_path / "b.zip").write_bytes(content)
    with pytest.raises(AssetFormatError, match=r"must hold whole files, got 'a\.ply' \(Bad CRC-32"):
        converters.read(tmp_path / "b.zip")
