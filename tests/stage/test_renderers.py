"""Frames as renderers draw them: the part that shows something, a seed of its own, a place for what is done."""

from pathlib import Path

import numpy as np
import pytest
from support.shapes import cloud_of, sphere_points, tiles

from beam_warp.raster.drawn_part import drawn_part
from beam_warp.raster.records import RasterOptions
from beam_warp.render.deferred import DeferredOptions, DeferredRenderer
from beam_warp.render.path import PathOptions
from beam_warp.stage import renderers
from beam_warp.stage.jobs import FrameContext
from beam_warp.stage.renderers import DeferredFrames, PathFrames
from beam_warp.world.camera import Camera
from beam_warp.world.environment import EnvironmentMap
from beam_warp.world.shot import Shot


class MadeUpRenderer:
    def __init__(self, options, *, device=None):
        self.options, self.device, self.drawn = options, device, []

    def draw(self, shot, *, checkpoint, report):
        self.drawn.append((shot, self.options, checkpoint))
        report(1, self.options.samples)
        return "image"


@pytest.fixture
def path_frames(monkeypatch):
    made = []

    def make(options, *, device=None):
        made.append(MadeUpRenderer(options, device=device))
        return made[-1]

    monkeypatch.setattr(renderers, "PathRenderer", make)
    return PathFrames(PathOptions(samples=8, seed=2**32 - 1), device="cpu"), made[0]


def test_every_frame_has_its_noise_and_always_the_same(path_frames):
    frames, renderer = path_frames
    heard = []
    for number in (0, 1, 2, 1000, 1, 0):
        context = FrameContext(number, Path(f"{number}.checkpoint"), lambda *said: heard.append(said))
        assert frames.draw("shot", context) == "image"
    seeds = [options.seed for _, options, _ in renderer.drawn]
    assert seeds[0] == 2**32 - 1
    assert len(set(seeds[:4])) == 4
    assert seeds[4:] == [seeds[1], seeds[0]]
    assert {options.samples for _, options, _ in renderer.drawn} == {8}
    assert [checkpoint.name for _, _, checkpoint in renderer.drawn[:2]] == ["0.checkpoint", "1.checkpoint"]
    assert heard == [(1, 8)] * 6


def test_what_decides_is_what_was_asked_for(path_frames):
    frames, _ = path_frames
    assert frames.decisive == ("path", PathOptions(samples=8, seed=2**32 - 1))


def test_a_small_subject_is_drawn_by_itself(device):
    """The image, its layers and errors are those of the whole image, but for rounding."""
    points, spacing = sphere_points(200)
    rng = np.random.default_rng(5)
    known = {"base_color": rng.random((200, 3)), "roughness": rng.random(200), "ambient_occlusion": rng.random(200)}
    cloud = cloud_of(tiles(points, points, spacing), **known, normals=points, roughness_error=rng.random(200))
    camera = Camera.orbit((0.0, 2.0, 1.0), 12.0, 20.0, 10.0, width=96, height=64, vertical_fov=40.0)
    shot = Shot(cloud=cloud, camera=camera, environment=EnvironmentMap.constant((1.0, 0.5, 2.0)))
    options = DeferredOptions(environment_shadows=0, bounces=0, samples=2, light_map_size=64)
    raster = RasterOptions()
    assert np.prod(drawn_part(cloud, camera, raster)[2:]) < 96 * 64 / 2
    context = FrameContext(0, Path("unused"), lambda *said: None)
    own = DeferredFrames(options, raster=raster, errors=True, device=device).draw(shot, context)
    whole = DeferredRenderer(options, raster=raster, device=device).draw(shot)
    assert own.layers.keys() == whole.layers.keys() | {"roughness_error"}
    np.testing.assert_allclose(own.rgb, whole.rgb, atol=1e-4)
    np.testing.assert_allclose(own.alpha, whole.alpha, atol=1e-5)
    for name, layer in whole.layers.items():
        assert own.layers[name].shape == layer.shape
        is_seen = whole.alpha > 0.01  # means of almost nothing are rounded by more
        np.testing.assert_allclose(own.layers[name][is_seen], layer[is_seen], atol=1e-3)
    assert (own.layers["roughness_error"] > 0.0).sum() > 100
