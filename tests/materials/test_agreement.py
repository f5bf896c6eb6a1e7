"""What a decomposition must refuse or warn about before it starts."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from beam_warp.capture.records import CaptureContents, CaptureRecord
from beam_warp.capture.views import CapturedView
from beam_warp.demo.lights import studio
from beam_warp.errors import InvalidOptionError
from beam_warp.image.color import DISPLAY_SRGB, LINEAR_REC709
from beam_warp.materials.agreement import (
    GOOD_OVERLAP,
    LEAST_OVERLAP,
    judge_clipping,
    judge_environment,
    largest_value,
    match_silhouettes,
    matched_frames,
    require_match,
)
from beam_warp.raster.gbuffer import rasterize
from beam_warp.world.axes import change_axes
from beam_warp.world.camera import Camera
from beam_warp.world.environment import EnvironmentMap
from beam_warp.world.gaussians import GaussianSequence
from beam_warp.world.shapes import sphere_zone, tile

SIZE = 40


def cameras(count=5):
    size = {"width": SIZE, "height": SIZE, "vertical_fov": 40.0}
    return [Camera.orbit((0, 0, 0.4), 3.0, 72.0 * k, 15.0 * (-1) ** k, **size) for k in range(count)]


@pytest.fixture(scope="module")
def cloud():
    """A figure that no turn maps to itself: balls of three sizes on three axes, off the origin."""
    places = ((0.0, 0.1, 0.3, 0.3), (0.5, 0.1, 0.2, 0.15), (0.0, -0.4, 0.3, 0.2), (0.1, 0.1, 0.9, 0.12))
    return tile(tuple(sphere_zone(np.array(place[:3]), place[3], -1.0, 1.0, 0.04) for place in places))


@pytest.fixture(scope="module")
def views(cloud):
    drawn = rasterize(cloud, cameras(), channels=(), device="cpu")
    return [
        CapturedView(
            name=f"view_{k}",
            camera=camera,
            color=0.3 * np.repeat(image.alpha[..., None], 3, axis=-1),
            alpha=np.clip(image.alpha, 0.0, 1.0),
        )
        for k, (camera, image) in enumerate(zip(cameras(), drawn, strict=True))
    ]


def capture(*frames, split="train"):
    records = [
        CaptureRecord(
            camera_name="a", frame=f, time=0.0, split=split, camera=cameras(1)[0], image_path=Path(f"a/{f}.exr")
        )
        for f in frames
    ]
    return CaptureContents(folder=Path("cap"), records=tuple(records))


def sequence(cloud, count, metadata=None):
    return GaussianSequence.from_clouds([cloud] * count, metadata=metadata)


def test_a_picture_by_content_is_warned_of():
    light = studio()
    assert judge_environment(light) == []
    picture = EnvironmentMap(np.clip(light.radiance * 2.0, 0.0, 1.0))
    assert [finding.code for finding in judge_environment(picture)] == ["ldr-environment"]


def test_frames_are_those_stated_or_counted(cloud):
    assert matched_frames(sequence(cloud, 2), capture(0, 1, 2)) == (0, 1)
    assert matched_frames(sequence(cloud, 2, {"capture_frames": "4 7"}), capture(7, 4)) == (4, 7)


def test_absent_frames_are_refused(cloud):
    with pytest.raises(InvalidOptionError, match=r"got none of frame 5 at cap \(frames 4, 6\).*reconstructed from"):
        matched_frames(sequence(cloud, 2, {"capture_frames": "4 5"}), capture(4, 6))
    with pytest.raises(InvalidOptionError, match=r"got none of frames 0, 1 at cap \(frames 4, 6\).*capture_frames"):
        matched_frames(sequence(cloud, 2), capture(4, 6))
    with pytest.raises(InvalidOptionError, match=r"frames none"):
        matched_frames(sequence(cloud, 1), capture(0, split="test"))


def test_silhouettes_of_the_same_are_the_same(cloud, views, device):
    match = match_silhouettes(cloud, views, device=device)
    assert match.overlap > 0.99  # drawn by the same rasteriser; on other devices edges may round elsewhere
    assert match.finding is None
    assert match.view_count == len(views)
    require_match(match)


@pytest.mark.parametrize("code", ["rub", "luf"])
def test_wrong_axes_are_refused_and_the_right_ones_named(cloud, views, code):
    """The sequence was written in other axes than it is read in; read as they are, it matches again."""
    wrong = replace(change_axes(cloud, code), axes=cloud.axes)
    match = match_silhouettes(wrong, views[:3], device="cpu")
    assert match.overlap < LEAST_OVERLAP
    assert match.finding is not None
    assert f"were {code}" in match.finding.remedy
    with pytest.raises(InvalidOptionError, match="sequence must show what the capture shows"):
        require_match(match)


def test_wrong_units_are_named(cloud, views):
    wrong = cloud.with_arrays(positions=cloud.positions * 100, scales=cloud.scales * 100)
    match = match_silhouettes(wrong, views, device="cpu")
    assert match.finding is not None
    assert match.finding.severity == "error"
    assert "centimetres" in match.finding.remedy


def test_another_moment_is_warned_of(cloud, views):
    """A subject that has moved overlaps in part."""
    moved = cloud.with_arrays(positions=cloud.positions + np.float32([0.06, 0.0, 0.0]))
    match = match_silhouettes(moved, views, device="cpu")
    assert LEAST_OVERLAP < match.overlap < GOOD_OVERLAP
    assert match.finding is not None
    assert match.finding.severity == "warning"
    assert "Check axes" in match.finding.remedy
    require_match(match)


def test_views_without_coverage_tell_nothing(cloud, views):
    match = match_silhouettes(cloud, [replace(view, alpha=None) for view in views], device="cpu")
    assert np.isnan(match.overlap)
    assert match.finding is None


def test_nothing_overlaps_nothing(cloud, views):
    """A cloud of nothing covers nothing."""
    match = match_silhouettes(cloud.select(np.arange(0)), views, device="cpu")
    assert match.overlap == 0.0
    assert match.finding is not None


def test_a_ceiling_of_linear_images_is_seen(views):
    """A ramp has one brightest column; cut at half, half of it is at the ceiling."""
    ramp = np.broadcast_to(np.linspace(0.0, 2.0, SIZE)[None, :, None], (SIZE, SIZE, 3))
    first, second = (replace(view, color=np.minimum(ramp, 1.0), alpha=None) for view in views[:2])
    black = replace(views[2], color=np.zeros((SIZE, SIZE, 3)), alpha=None)
    assert largest_value([first, black, second], LINEAR_REC709) == 1.0
    assert largest_value(views, DISPLAY_SRGB) == 1.0  # display-referred images end at white
    assert largest_value([first], None) == 1.0
    [finding] = judge_clipping([first, black], 1.0)
    assert finding.code == "clipped-images"
    assert "1 image of 2 is cut at 1" in finding.what
    assert finding.where == "view_0 50%"
    assert judge_clipping([first], float("inf")) == []


def test_what_is_bright_in_one_view_is_no_ceiling(views):
    """A plain wall has one value all over, and another view shows another."""
    walls = [
        replace(view, color=np.full((SIZE, SIZE, 3), level), alpha=None)
        for view, level in zip(views[:3], (1, 2, 3), strict=True)
    ]
    assert largest_value(walls, None) == float("inf")
    noise = np.random.default_rng(0).uniform(0.0, 0.9, (SIZE, SIZE, 3)).astype(np.float32)
    smooth = [replace(view, color=noise + 0.01 * index, alpha=None) for index, view in enumerate(views)]
    assert largest_value(smooth, None) == float("inf")
    assert judge_clipping(smooth, 1.0) == []


def test_nothing_shown_has_no_ceiling(views):
    black = [replace(view, color=np.zeros((SIZE, SIZE, 3))) for view in views]
    assert largest_value(black, None) == float("inf")
    none = [replace(view, alpha=np.zeros((SIZE, SIZE))) for view in views]
    assert largest_value(none, None) == float("inf")
    assert judge_clipping(none, 1.0) == []


def test_white_background_is_not_the_subject(views):
    """What is cut beside the subject does not matter."""
    alpha = views[0].alpha
    beside = replace(views[0], color=np.where(alpha > 0.5, 0.3, 1.0)[..., None].repeat(3, axis=-1))
    assert judge_clipping([beside], 1.0) == []
