"""Folders of numbered files, USD as a row of the table, and what an inspection says."""

import json
import zipfile
from dataclasses import asdict

import numpy as np
import pytest

from beam_warp import converters
from beam_warp.converters import WriteOptions, usd
from beam_warp.errors import AssetFormatError, InvalidArrayError, InvalidOptionError, MissingFileError, OutputError
from beam_warp.world.axes import change_axes
from beam_warp.world.gaussians import GaussianSequence


@pytest.fixture
def walk(make_cloud):
    clouds = [make_cloud(10 + frame, degree=0, seed=frame) for frame in range(12)]
    return GaussianSequence.from_clouds(clouds, frames_per_second=24.0)


def test_frames_are_numbered_and_come_back_in_order(walk, tmp_path):
    paths = converters.write(walk, tmp_path / "walk.ply")
    assert [path.name for path in paths] == [f"walk{frame:06d}.ply" for frame in range(12)]
    assert sorted(path.name for path in tmp_path.iterdir()) == [path.name for path in paths]
    back = converters.read(tmp_path)
    assert len(back) == 12
    assert back.frames_per_second == 24.0
    assert back.topology == "perFrame"
    for frame, cloud in enumerate(walk):
        assert np.array_equal(back[frame].positions, change_axes(cloud, "rdf").positions)


def test_frames_are_read_when_asked_for(walk, tmp_path):
    converters.write(walk, tmp_path / "walk.ply")
    sequence = converters.read(tmp_path)
    (tmp_path / "walk000005.ply").unlink()
    assert len(sequence[4]) == 14
    with pytest.raises(MissingFileError, match=r"input must be an existing file, got .*walk000005"):
        sequence[5]


def test_a_cut_frame_is_found_before_any_work(walk, tmp_path):
    converters.write(walk, tmp_path / "walk.ply")
    last = tmp_path / "walk000011.ply"
    last.write_bytes(last.read_bytes()[:-1])
    with pytest.raises(AssetFormatError, match=r"walk000011\.ply: element vertex must have the 21 rows"):
        converters.read(tmp_path)


def test_natural_order_any_start_and_the_packed_suffix(columns, ply_bytes, tmp_path):
    for number in (8, 9, 10, 11):
        columns["x"] = [float(number)] * 3
        suffix = ".compressed.ply" if number == 9 else ".PLY" if number == 10 else ".ply"
        (tmp_path / f"take2_{number}{suffix}").write_bytes(ply_bytes(columns))
    (tmp_path / "notes.txt").write_text("not a frame")
    assert [cloud.positions[0, 0] for cloud in converters.read(tmp_path)] == [8, 9, 10, 11]


@pytest.mark.parametrize(
    ("names", "message"),
    [
        ([], r"must hold asset\.usda, meta\.json or numbered files \(walk000000\.ply, walk000001\.ply, …\), got none"),
        (["a0.ply", "a1.ply", "b0.ply"], r"must hold one sequence, got 2 prefixes \('a', 'b'\)"),
        (["a0.ply", "a2.ply"], r"must hold every frame, got none between a0\.ply and a2\.ply. Add the missing frames"),
        (["a1.ply", "a01.ply"], r"must hold each frame once, got a01\.ply and a1\.ply. Remove one"),
    ],
)
def test_folders_that_are_no_sequence(columns, ply_bytes, tmp_path, names, message):
    for name in names:
        (tmp_path / name).write_bytes(ply_bytes(columns))
    with pytest.raises(AssetFormatError, match=message):
        converters.read(tmp_path)


def test_a_frame_that_fails_leaves_no_frames(walk, tmp_path):
    def broken(frame):
        if frame == 7:
            raise InvalidArrayError("positions must be finite, got NaN at row 0. Repair it.")
        return walk[frame]

    sequence = GaussianSequence(frame_count=12, read_frame=broken)
    with pytest.raises(InvalidArrayError, match="positions must be finite"):
        converters.write(sequence, tmp_path / "walk.ply")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("stem", ["take2", "take.v1 (3)"])
def test_frames_of_an_older_longer_take_are_in_the_way(walk, tmp_path, make_cloud, stem):
    converters.write(walk, tmp_path / f"{stem}.ply")
    shorter = GaussianSequence.from_clouds([make_cloud(3, seed=frame) for frame in range(5)])
    with pytest.raises(OutputError, match=r"no frames after the last of 5, got .*000005\.ply \(7 in all\). Delete"):
        converters.write(shorter, tmp_path / f"{stem}.ply")
    converters.write(walk, tmp_path / f"{stem}.ply")  # the same length replaces it
    assert len(converters.read(tmp_path)) == 12


def test_output_folders_are_made_and_removed_again_when_the_work_fails(walk, tmp_path):
    converters.write(walk, tmp_path / "some" / "where" / "a.ply")
    assert len(converters.read(tmp_path / "some" / "where")) == 12
    with pytest.raises(InvalidOptionError, match="profile beam must have a material channel"):
        converters.write(walk, tmp_path / "other" / "place" / "a.ply", WriteOptions(profile="beam"))
    assert [path.name for path in tmp_path.iterdir()] == ["some"]
    (tmp_path / "folder.ply").mkdir()
    with pytest.raises(OutputError, match="output must be a file, got the folder"):
        converters.write(walk, tmp_path / "folder.ply")
    (tmp_path / "file").write_bytes(b"")
    with pytest.raises(OutputError, match=r"output folder must be a folder, got .*file for a\.ply"):
        converters.write(walk, tmp_path / "file" / "a.ply")


def test_what_is_only_read_is_not_written(walk, tmp_path):
    with pytest.raises(InvalidOptionError, match=r"must end in one of .*, got a\.ksplat: ksplat is only read"):
        converters.write(walk, tmp_path / "a.ksplat")


def test_a_folder_with_an_asset_is_that_asset(make_cloud, walk, tmp_path, trusted_files):
    converters.write(walk, tmp_path / "walk.ply")
    converters.write(GaussianSequence.from_clouds([make_cloud(3)]), tmp_path / "asset.usda")
    assert len(converters.read(tmp_path)) == 1
    assert converters.inspect(tmp_path).format == "USD (.usda)"


def test_usd_gets_y_up_metres_and_the_asked_bands(make_cloud, tmp_path):
    cloud = make_cloud(axes="rdf", degree=1)
    sequence = GaussianSequence.from_clouds([cloud], metadata={"producer": "somebody", "notes": "of another file"})
    paths = converters.write(sequence, tmp_path / "a.usda", WriteOptions(sh_degree=2, full_float=True))
    assert paths[-1] == tmp_path / "a.usda"
    back = converters.read(tmp_path / "a.usda")
    assert (back[0].axes, back[0].sh_degree) == ("rub", 2)
    assert np.array_equal(back[0].positions, cloud.positions * [1, -1, -1])
    assert np.array_equal(back[0].scales, cloud.scales)  # in full float
    assert back.metadata["producer"] == "somebody"
    assert "notes" not in back.metadata


@pytest.mark.parametrize(("most_kept", "times"), [(2**29, 1), (0, 2)])
def test_usd_reads_a_short_sequence_once_to_the_same_bytes(make_cloud, tmp_path, monkeypatch, most_kept, times):
    clouds, read = [make_cloud(8, seed=frame) for frame in range(3)], list[int]()
    sequence = GaussianSequence(3, lambda frame: read.append(frame) or clouds[frame])
    converters.write(sequence, tmp_path / "whole.usdc")
    read.clear()
    monkeypatch.setattr(usd, "MOST_KEPT", most_kept)
    converters.write(sequence, tmp_path / "again.usdc")
    assert read.count(1) == times
    assert (tmp_path / "again.usdc").read_bytes() == (tmp_path / "whole.usdc").read_bytes()


def test_what_the_caller_states_outranks_a_stage_with_a_note(make_cloud, tmp_path, trusted_files):
    cloud = make_cloud(axes="rub", degree=1)
    converters.write(GaussianSequence.from_clouds([cloud]), tmp_path / "a.usda", WriteOptions(full_float=True))
    sequence = converters.read(tmp_path / "a.usda", source_axes="rdf", meters_per_unit=0.5)
    assert sequence[0].axes == "rdf"
    assert np.array_equal(sequence[0].positions, 0.5 * cloud.positions)
    assert np.array_equal(sequence[0].scales, 0.5 * cloud.scales)
    assert np.array_equal(sequence[0].radiance, cloud.radiance)
    assert sequence.metadata["notes"].splitlines() == [
        "axes are taken as rdf, by --source-axes; the file says rub",
        "one unit is taken as 0.5 m, by --meters-per-unit; the file says 1 m",
    ]
    with pytest.raises(
        InvalidOptionError, match=r"activation must be left out for USD, where it means nothing, got a\.usda"
    ):
        converters.read(tmp_path / "a.usda", activation="log")


def test_a_package_that_is_not_aligned_is_read_with_a_note(make_cloud, tmp_path, trusted_files):
    cloud = make_cloud(axes="rub")
    converters.write(GaussianSequence.from_clouds([cloud]), tmp_path / "a.usdc", WriteOptions(full_float=True))
    with zipfile.ZipFile(tmp_path / "a.usdz", "w") as archive:  # data begin after a header of 36 bytes
        archive.write(tmp_path / "a.usdc", "a.usdc")
    sequence = converters.read(tmp_path / "a.usdz")
    assert np.array_equal(sequence[0].positions, cloud.positions)
    assert "1 files of the package are not 64-byte aligned" in sequence.metadata["notes"]
    converters.write(GaussianSequence.from_clouds([cloud]), tmp_path / "b.usdz")
    assert "notes" not in converters.read(tmp_path / "b.usdz").metadata


@pytest.mark.parametrize(
    ("axis", "low", "high", "note"),
    [
        (
            "y",
            0.0,
            1.8,
            "it is tallest along y, from 0.02 to 1.78, so y points up if it stands at 0; pass --source-axes rub",
        ),
        ("z", 0.0, 1.8, "so z points up if it stands at 0; pass --source-axes rfu if it does"),
        ("z", -1.8, 0.0, "so z points down if it stands at 0; pass --source-axes"),
        ("x", 0.0, 1.8, "so x points up if it stands at 0; pass --source-axes u"),
        ("y", -1.8, 0.0, None),  # as assumed
        ("y", -0.9, 0.9, None),  # it does not stand at 0
        ("y", 0.0, 0.3, None),  # it is not tall
    ],
)
def test_a_shape_that_contradicts_the_assumed_axes_is_told(columns, ply_file, axis, low, high, note):
    rng = np.random.default_rng(5)
    many = {name: np.resize(values, 1000) for name, values in columns.items()}
    many |= {other: rng.uniform(-0.2, 0.2, 1000) for other in "xyz"} | {axis: np.linspace(low, high, 1000)}
    path = ply_file(many)
    told = [line for line in converters.read(path).metadata["notes"].splitlines() if "contradicts" in line]
    assert bool(told) == (note is not None)
    if note is not None:
        assert note in told[0]
        axes = told[0].partition("--source-axes ")[2][:3]
        assert "contradicts" not in converters.read(path, source_axes=axes).metadata.get("notes", "")
        assert converters.inspect(path).axes_evidence[-1] == f"which contradicts rdf: pass --source-axes {axes}"


def test_inspection_of_a_person(data_dir):
    found = converters.inspect(data_dir / "splats" / "biker.compressed.ply")
    assert (found.gaussian_count, found.frame_count, found.sh_degree) == (152746, 1, 0)
    assert found.format == "PLY, binary, packed in chunks of 256"
    assert found.producer == "SuperSplat 2.7.1, by its comment"
    assert found.axes == "rdf"
    assert found.axes_evidence[-2:] == (
        "it spans -3.11 … -0.04: y points down if it stands at 0",
        "which agrees with rdf",
    )
    text = found.as_text()
    assert "Gaussians   152,746" in text
    assert "size [m]    1.036 × 3.180 × 1.146" in text
    assert json.loads(json.dumps(asdict(found), allow_nan=False))["opacities"]["greatest"] == 1.0


def test_inspection_of_our_own_sequence(make_cloud, tmp_path):
    clouds = [make_cloud(materials=True, seed=frame) for frame in range(2)]
    converters.write(GaussianSequence.from_clouds(clouds), tmp_path / "a.ply", WriteOptions(profile="beam"))
    found = converters.inspect(tmp_path)
    assert found.axes_evidence == ("stated by the file",)
    assert found.materials == ("base_color", "roughness", "ambient_occlusion", "normals")
    assert found.color_state == "captured radiance, srgb_rec709_display"
    assert found.format == "PLY, binary, one property per value, one file per frame"
    assert "\nframes      2 at 30 per second\nGaussians   50 in the first frame\n" in found.as_text()
    assert found.notes == ()
    assert found.scales is not None
    seen = converters.read(tmp_path)[0].scales
    assert (found.scales.least, found.scales.median, found.scales.greatest) == (seen.min(), np.median(seen), seen.max())


def test_inspection_names_what_is_odd(columns, ply_bytes, tmp_path):
    count = 500
    rng = np.random.default_rng(5)
    many = {name: np.resize(values, count) for name, values in columns.items()}
    many |= {axis: rng.uniform(-1, 1, count) for axis in "xyz"} | {"opacity": np.full(count, -9.0)}
    many["x"][3] = 1e4
    (tmp_path / "a.ply").write_bytes(ply_bytes(many, comments=["Generated by Somebody 1.0"]))
    found = converters.inspect(tmp_path / "a.ply")
    assert found.producer == "Somebody 1.0, by its comment"
    assert "\nframes      1\nGaussians   500\n" in found.as_text()
    assert "500 Gaussians (100.0%) are less than 1/255 opaque" in found.notes
    assert "1 Gaussians lie more than 5 × the size of the middle 98 % away from it" in found.notes
    assert found.axes_evidence[1].startswith("the shape has no tall axis")
