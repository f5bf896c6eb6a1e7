"""What is written is read back: exactly in float, within the rounding of half otherwise."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from pxr import Sdf, Usd, Vt

from beam_warp.errors import InvalidOptionError
from beam_warp.schema.layout import HALF_EPSILON
from beam_warp.schema.reader import read_asset
from beam_warp.schema.writer import write_asset
from beam_warp.world.gaussians import GaussianSequence
from beam_warp.world.metadata import stated_raster


def assert_same(got, wanted, full_float):
    assert got.arrays().keys() == wanted.arrays().keys()
    assert (got.axes, got.radiance_color_space) == (wanted.axes, wanted.radiance_color_space)
    for name, array in wanted.arrays().items():
        found = got.arrays()[name]
        if name == "orientations":  # q and -q are one rotation; the writer keeps signs continuous over time
            found = np.where(np.sum(found * array, axis=1, keepdims=True) < 0.0, -found, found)
        if full_float or name in ("positions", "ids", "observability"):
            assert np.array_equal(found, array), name
        else:
            bound = np.maximum(HALF_EPSILON * np.abs(array), 2.0**-25)  # half's relative and absolute rounding
            assert (np.abs(found.astype(np.float64) - array) <= bound).all(), name


def trip(source, path, **options):
    """Write a sequence and read it."""
    write_asset(source, path, **options)
    return read_asset(path, trusted=True)


@pytest.mark.parametrize(
    ("name", "frames", "full_float"),  # one frame, one layer, clips with a short last segment
    [
        ("a.usda", 1, True),
        ("a.usdc", 3, False),
        ("a.usda", 65, False),
        ("a.usdc", 65, True),
        ("a.usdz", 3, True),
        ("a.usdz", 65, False),
    ],
)
def test_every_channel_survives(tmp_path, sequence, name, frames, full_float):
    source = sequence(frames, metadata={"producer": "test", "source_axes": "rdf"})
    found = trip(source, tmp_path / name, full_float=full_float, segment_length=30)
    assert len(found) == frames
    assert found.frames_per_second == 24.0
    assert found.topology == "constant"
    assert found.constant == source.constant
    assert found.metadata.items() >= source.metadata.items()
    for frame in (*range(min(frames, 3)), frames // 2, frames - 1):
        assert_same(found[frame], source[frame], full_float)


RASTER = {"raster_antialiased": "true", "raster_low_pass": "0.1"}


@pytest.mark.parametrize(("name", "frames"), [("a.usdc", 1), ("a.usda", 65), ("a.usdz", 3)])
def test_how_it_is_drawn_and_which_frames_it_shows_survive(tmp_path, sequence, name, frames):
    numbers = " ".join(str(7 + 2 * frame) for frame in range(frames))
    found = trip(sequence(frames, metadata={**RASTER, "capture_frames": numbers}), tmp_path / name).metadata
    stage = Usd.Stage.Open(str(tmp_path / name))
    splats, root = stage.GetPrimAtPath("/Asset/Splats"), stage.GetPrimAtPath("/Asset")
    assert splats.GetAttribute("beam:rasterAntialiased").Get() is True
    assert splats.GetAttribute("beam:rasterLowPass").Get() == np.float32(0.1)
    assert list(root.GetAttribute("beam:sequence:captureFrames").Get()) == [7 + 2 * frame for frame in range(frames)]
    assert found.items() >= RASTER.items()
    assert found["capture_frames"] == numbers


def test_attributes_go_before_what_was_noted(tmp_path, sequence):
    """Another program changes attributes, not the text of our customData."""
    write_asset(sequence(2, metadata={**RASTER, "capture_frames": "0 1"}), tmp_path / "a.usda")
    stage = Usd.Stage.Open(str(tmp_path / "a.usda"))
    stage.GetPrimAtPath("/Asset/Splats").GetAttribute("beam:rasterLowPass").Set(0.25)
    stage.GetPrimAtPath("/Asset").GetAttribute("beam:sequence:captureFrames").Set(Vt.IntArray([4, 6]))
    stage.GetRootLayer().Save()
    found = read_asset(tmp_path / "a.usda", trusted=True).metadata
    assert (found["raster_antialiased"], found["raster_low_pass"]) == ("true", "0.25")
    assert found["capture_frames"] == "4 6"


@pytest.mark.parametrize(
    ("name", "type_name", "value", "raster"),
    [
        ("beam:rasterAntialiased", Sdf.ValueTypeNames.Bool, True, (True, 0.3)),
        ("beam:rasterLowPass", Sdf.ValueTypeNames.Float, 0.1, (False, 0.1)),
    ],
)
def test_what_is_not_said_of_drawing_is_the_fallback(tmp_path, sequence, name, type_name, value, raster):
    write_asset(sequence(1), tmp_path / "a.usda")
    stage = Usd.Stage.Open(str(tmp_path / "a.usda"))
    splats = stage.GetPrimAtPath("/Asset/Splats")
    assert not splats.GetAttribute("beam:rasterLowPass").HasAuthoredValue()
    assert stated_raster(read_asset(tmp_path / "a.usda", trusted=True).metadata) is None
    splats.CreateAttribute(name, type_name).Set(value)
    stage.GetRootLayer().Save()
    assert stated_raster(read_asset(tmp_path / "a.usda", trusted=True).metadata) == raster


@pytest.mark.parametrize(
    ("stated", "message"),
    [
        ({"raster_antialiased": "True"}, r"raster_antialiased must be one of true, false, got 'True'"),
        ({"capture_frames": "0 1 2"}, r"capture_frames must be a number for each of 2 frames, got 3 in '0 1 2'"),
    ],
)
def test_metadata_that_say_nothing_clear_are_refused(tmp_path, sequence, stated, message):
    with pytest.raises(InvalidOptionError, match=message):
        write_asset(sequence(2, metadata=stated), tmp_path / "a.usda")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("options", [{"axes": "rfu"}, {"relightable": False, "degree": 3}])
def test_z_up_and_splats_without_material_survive(tmp_path, cloud, sequence, options):
    found = trip(sequence(1, **options), tmp_path / "a.usdc", full_float=True)[0]
    assert found.is_relightable == options.get("relightable", True)
    assert_same(found, cloud(**options), True)


def test_stand_in_radiance_is_not_read_as_captured(tmp_path, sequence):
    found = trip(sequence(2, degree=None), tmp_path / "a.usdc")
    assert found[0].radiance is None
    assert found.metadata["radiance_meaning"] == "baseColorOnly"
    assert "radiance" not in found.constant


def test_frames_blend_across_a_segment_boundary_as_in_one_layer(tmp_path, sequence):
    source = sequence(65)
    values = []
    for name in ("clips.usda", "single.usdc"):
        write_asset(source, tmp_path / name)
        stage = Usd.Stage.Open(str(tmp_path / name))
        prim = stage.GetPrimAtPath("/Asset/Splats")
        values.append([np.array(prim.GetAttribute("positions").Get(time)) for time in (29.25, 29.5, 30.0, 63.5)])
    assert np.array_equal(values[0], values[1])
    mean = 0.5 * (source[29].positions + source[30].positions)
    assert np.abs(values[0][1] - mean).max() <= 1e-6  # one float32 lerp of values below 4


def test_writing_what_was_read_changes_nothing(tmp_path, sequence):
    once = trip(sequence(3), tmp_path / "a.usdc")
    twice = trip(once, tmp_path / "b.usdc")
    for frame in range(3):
        assert_same(twice[frame], once[frame], True)


def test_an_asset_can_be_rewritten_from_itself(tmp_path, sequence):
    found = trip(sequence(65), tmp_path / "a.usda", full_float=True)
    again = trip(found, tmp_path / "a.usda", full_float=True, segment_length=10)
    assert_same(again[64], sequence(65)[64], True)


@pytest.mark.parametrize(("name", "frames"), [("a.usdc", 2), ("a.usda", 65), ("a.usdz", 65)])
def test_reading_sees_a_replaced_file(tmp_path, sequence, name, frames):
    held = trip(sequence(frames), tmp_path / name)
    assert len(held[1]) == 6  # OpenUSD shares the open layers with the next reader
    assert len(trip(sequence(frames, count=9), tmp_path / name)[1]) == 9


def test_frames_can_be_read_from_any_thread(tmp_path, sequence):
    source = sequence(65, count=200)
    found = trip(source, tmp_path / "a.usda", full_float=True)
    order = [(7 * frame) % 65 for frame in range(65)]
    with ThreadPoolExecutor(4) as threads:
        for frame, got in zip(order, threads.map(found.read_frame, order), strict=True):
            assert np.array_equal(got.positions, source[frame].positions)
            assert np.array_equal(got.base_color, source[frame].base_color)


def test_still_frames_keep_their_number(tmp_path, cloud):
    found = trip(GaussianSequence.from_clouds([cloud()] * 5), tmp_path / "a.usda")
    assert len(found) == 5
    assert len(found.constant) == len(cloud().arrays())


def test_counts_may_change(tmp_path, cloud):
    source = GaussianSequence.from_clouds([cloud(0, 4), cloud(1, 7), cloud(2, 0)])
    found = trip(source, tmp_path / "a.usdc", full_float=True)
    assert found.topology == "perFrame"
    assert [len(found[frame]) for frame in range(3)] == [4, 7, 0]
    assert_same(found[1], source[1], True)
