"""The sample assets: valid, as their page says, and drawn as their golden images by the path tracer."""

import numpy as np
import pytest
from pxr import Sdf
from scipy.ndimage import minimum_filter
from support.sample_scenes import GOLDEN_SAMPLES, NAMES, SAMPLES, opened, shot_of

from beam_warp.image.color import linear_to_srgb, srgb_to_linear
from beam_warp.image.files import read_image
from beam_warp.image.metrics import psnr
from beam_warp.render.deferred import DeferredRenderer
from beam_warp.render.path import PathOptions, PathRenderer
from beam_warp.schema.reader import read_asset
from beam_warp.schema.validation.validator import validate_stage
from beam_warp.world.axes import change_axes
from beam_warp.world.harmonics import sh_basis
from beam_warp.world.shot import Shot

RENDERS, SAMPLES_EACH = 4, 2
"""Independent renders, whose spread tells their noise, and the paths of a pixel in each."""

CONFIDENCE = 5.0
"""Standard errors of the mean squared error that chance is allowed."""

REAL_TIME_DB = 25.0
"""What the page of the samples asks of a real-time renderer [dB]."""


def golden(name):
    """The golden image's display values."""
    return read_image(SAMPLES / name / "golden.png").rgb().astype(np.float64)


def renders(shot):
    """Linear images of independent paths, ``(RENDERS, H, W, 3)``."""
    options = [PathOptions(samples=SAMPLES_EACH, seed=seed) for seed in range(1, RENDERS + 1)]
    return np.stack([PathRenderer(option).draw(shot).rgb for option in options]).astype(np.float64)


def excess(images, truth):
    """Mean squared error of the mean image beyond what noise explains, over its standard error.

    The noise of the mean is the spread of the renders over their number. The golden image has less, in proportion to
    its paths, and rounds its display values evenly within a step.
    """
    noise = images.var(axis=0, ddof=1) / RENDERS
    noise *= 1.0 + RENDERS * SAMPLES_EACH / GOLDEN_SAMPLES
    step = srgb_to_linear(truth + 0.5 / 255.0) - srgb_to_linear(np.maximum(truth - 0.5 / 255.0, 0.0))
    unexplained = ((images.mean(axis=0) - srgb_to_linear(truth)) ** 2 - noise - step**2 / 12.0).mean(axis=2)
    return unexplained.mean() / (unexplained.std() / np.sqrt(unexplained.size))


@pytest.mark.parametrize("name", NAMES)
def test_a_sample_is_valid_and_small(name):
    for file in ("asset.usdc", "scene.usda"):
        assert [str(found) for found in validate_stage(opened(name, file)).findings] == []
    assert sum(path.stat().st_size for path in (SAMPLES / name).iterdir()) < 150_000
    assert read_asset(SAMPLES / name / "asset.usdc", trusted=True).metadata["license"] == "CC0-1.0"


@pytest.mark.parametrize("name", NAMES)
def test_a_sample_is_drawn_as_its_golden_image(name):
    truth = golden(name)
    assert truth.max() < 1.0  # nothing is clipped
    assert excess(renders(shot_of(name)), truth) < CONFIDENCE


def test_a_base_colour_that_is_off_by_a_twentieth_is_noticed():
    shot = shot_of("still_life")
    darker = shot.cloud.with_arrays(base_color=0.95 * shot.cloud.base_color)
    images = renders(Shot(cloud=darker, camera=shot.camera, environment=shot.environment, lights=shot.lights))
    assert excess(images, golden("still_life")) > CONFIDENCE


@pytest.mark.parametrize(
    "name", [name if name == "tripod" else pytest.param(name, marks=pytest.mark.slow) for name in NAMES]
)
def test_the_real_time_renderer_is_within_the_tolerance_and_mistakes_are_not(name):
    shot = shot_of(name)
    truth = golden(name)
    solid = minimum_filter(truth.max(axis=2), size=3) > 0.0

    renderer = DeferredRenderer()

    def score(cloud):
        changed = Shot(cloud=cloud, camera=shot.camera, environment=shot.environment, lights=shot.lights)
        return psnr(linear_to_srgb(np.clip(renderer.draw(changed).rgb, 0.0, 1.0)), truth, solid)

    assert score(shot.cloud) > REAL_TIME_DB
    if name == "furnace":
        return  # white is white in any encoding, and a ball looks the same from all sides
    assert score(shot.cloud.with_arrays(base_color=linear_to_srgb(shot.cloud.base_color))) < REAL_TIME_DB
    if name != "roughness":
        mirrored = shot.cloud.with_arrays(positions=shot.cloud.positions * np.float32([-1, 1, 1]))
        assert score(mirrored) < REAL_TIME_DB


def test_the_furnace_reflects_what_arrives():
    truth = golden("furnace")
    inside = minimum_filter(truth.max(axis=2), size=9) > 0.5
    assert inside.mean() > 0.25
    expected = 255.0 * linear_to_srgb(0.5)
    assert abs(255.0 * truth[inside].mean() - expected) < 0.5  # half a step of the display is 0.6 % of the energy
    assert 255.0 * truth[inside].std() < 1.0


@pytest.mark.parametrize(("looking", "color"), [("x", (0.9, 0.5, 0.5)), ("y", (0.5, 0.9, 0.5)), ("z", (0.5, 0.5, 0.9))])
def test_the_hub_of_the_tripod_shows_directions(looking, color):
    cloud = read_asset(SAMPLES / "tripod" / "asset.usdc", trusted=True)[0]
    assert cloud.axes == "rub"
    direction = {"x": (1.0, 0.0, 0.0), "y": (0.0, 0.0, -1.0), "z": (0.0, 1.0, 0.0)}[looking]  # right, forward, up
    hub = np.abs(cloud.radiance[:, 1:]).max(axis=(1, 2)) > 0.0
    assert 100 < hub.sum() < len(cloud)
    shown = 0.5 + np.einsum("k,nkc->nc", sh_basis(np.array([direction]), 1)[0], cloud.radiance[hub])
    assert np.abs(shown - color).max() < 4.0 * 2.0**-11  # four half-precision terms below 1


def test_the_rods_of_the_tripod_point_right_forward_and_up():
    cloud = change_axes(read_asset(SAMPLES / "tripod" / "asset.usdc", trusted=True)[0], "rfu")
    for axis, length in enumerate((0.55, 0.4, 0.3)):
        color = cloud.base_color
        rod = (color[:, axis] > 0.6) & (np.delete(color, axis, 1).max(axis=1) < 0.1)
        reach = cloud.positions[rod].max(axis=0)
        assert length - 0.02 < reach[axis] < length
        assert np.delete(reach, axis).max() < 0.04


def test_the_ball_rolls_without_sliding():
    sequence = read_asset(SAMPLES / "rolling" / "asset.usdc", trusted=True)
    assert (len(sequence), sequence.topology) == (4, "constant")
    first, last = (change_axes(sequence[frame], "rfu") for frame in (0, 3))
    ball = first.base_color[:, 0] > 0.6
    middles = [cloud.positions[ball].mean(axis=0) for cloud in (first, last)]
    turn = 3 * np.pi / 8.0
    assert middles[1][0] - middles[0][0] == pytest.approx(0.16 * turn, abs=1e-3)
    rotation = np.array([[np.cos(turn), 0, np.sin(turn)], [0, 1, 0], [-np.sin(turn), 0, np.cos(turn)]])
    assert np.abs((first.positions[ball] - middles[0]) @ rotation.T - (last.positions[ball] - middles[1])).max() < 1e-5
    assert np.array_equal(first.positions[~ball], last.positions[~ball])


def test_the_proposal_is_usd_that_can_be_read():
    blocks = (SAMPLES.parent / "PROPOSAL.md").read_text(encoding="utf-8").split("```usda\n")[1:]
    assert len(blocks) == 2
    for block in blocks:
        assert Sdf.Layer.CreateAnonymous(".usda").ImportFromString("#usda 1.0\n" + block.partition("```")[0])
