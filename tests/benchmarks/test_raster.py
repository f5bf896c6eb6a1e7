"""The raster benchmark: its truth is the reference, its stages are all of a frame, and all of it runs."""

import json

import numpy as np
import pytest
import raster as benchmark
from gsplat_peer import Images, arguments
from parts import measure
from raster_contenders import Drawing, Seen, random_adjoints
from raster_images import draw, grazing_scene, image_panels, write_sheet
from raster_plot import draw_growth, draw_stages
from raster_scenes import RasterScene, cube, figure
from raster_stages import BACKWARD, FORWARD, REST, STAGES, measure_stages, stage_launchers
from raster_truth import brute_force
from reference import rasterizing as reference

from beam_warp.device.arrays import resolve_device
from beam_warp.raster import records
from beam_warp.world.camera import Camera
from beam_warp.world.gaussians import GaussianCloud
from beam_warp.world.quaternions import rotation_matrices

pytestmark = pytest.mark.slow  # a benchmark's own tests

TINY = benchmark.Effort(
    gaussians=300,
    size=(24, 18),
    repeats=2,
    slow_repeats=1,
    stage_repeats=1,
    truth_pixels=20,
    counts=(100, 300),
    sizes=((16, 16), (24, 18)),
    growth_repeats=1,
)


class TestTruth:
    @pytest.mark.parametrize("make", [figure, cube])
    @pytest.mark.parametrize("antialiased", [False, True])
    def test_is_the_reference(self, make, antialiased):
        scene = make(200, 24, 18)
        found = brute_force(scene.cloud, scene.camera, scene.values(), np.arange(24 * 18), antialiased)
        alpha, depth, values = reference.rasterize(scene.cloud, scene.camera, scene.values(), antialiased=antialiased)
        # The same sums of up to 200 terms in float64, in another order.
        np.testing.assert_allclose(found.alpha, alpha.reshape(-1), atol=1e-12)
        np.testing.assert_allclose(found.values, values.reshape(-1, values.shape[-1]), atol=1e-12)
        np.testing.assert_allclose(found.depth["plane"] * found.alpha, depth.reshape(-1), atol=1e-11)
        assert (found.alpha > 0.5).any()

    def test_exact_depth_is_that_of_the_largest_response_on_the_ray(self):
        camera = Camera.orbit((0, 0, 0), 3.0, 20.0, 10.0, width=24, height=18, vertical_fov=40.0)
        cloud = GaussianCloud(
            positions=[[0.1, -0.2, 0.05]],
            orientations=[[0.3, -0.5, 0.2, np.sqrt(0.62)]],
            scales=[[0.5, 0.3, 0.2]],
            opacities=[0.9],
        )
        pixels = np.array([9 * 24 + 12, 7 * 24 + 15, 11 * 24 + 9])
        found = brute_force(cloud, camera, np.zeros((1, 1), np.float32), pixels, antialiased=False)
        steps = np.linspace(2.0, 4.0, 200_001)  # of depth: 1e-5 apart
        directions = camera.directions().reshape(-1, 3)[pixels]
        for row, direction in enumerate(directions):
            along = steps / (direction @ camera.forward)
            offsets = camera.position + along[:, None] * direction - cloud.positions[0]
            canonical = offsets @ rotation_matrices(cloud.orientations)[0] / cloud.scales[0]
            largest = steps[(canonical**2).sum(axis=1).argmin()]
            assert found.depth["exact"][row] == pytest.approx(largest, abs=1.1e-5)
            assert found.median_depth["exact"][row] == pytest.approx(largest, abs=1.1e-5)
            assert abs(found.depth["plane"][row] - largest) > 1e-4


class TestStages:
    def test_every_launcher_of_the_rasteriser_has_one(self):
        assert set(STAGES) == set(stage_launchers())

    def test_they_are_all_of_a_frame(self, device):
        scene = figure(200, 24, 18)
        found = measure_stages(lambda: Drawing(scene, resolve_device(device)), 1, resolve_device(device))
        for way, order in (("forward", FORWARD), ("backward", BACKWARD)):
            assert list(found[way]["ms"]) == [*order, REST]
            assert sum(found[way]["ms"].values()) == pytest.approx(found[way]["total_ms"], rel=2e-3)  # four digits

    def test_watching_leaves_nothing_behind(self):
        before = {name: getattr(owner, name) for name, owner in stage_launchers().items()}
        device = resolve_device("cpu")
        measure_stages(lambda: Drawing(figure(50, 16, 9), device), 1, device)
        assert before == {name: getattr(owner, name) for name, owner in stage_launchers().items()}


class OwnPeer:
    """Stands for gsplat: reads its arguments, answers in its conventions, and draws with ours."""

    def __init__(self, scene, values):
        given = arguments(scene.cloud, scene.camera, values)
        cloud = GaussianCloud(
            positions=given["means"],
            orientations=given["quats"][:, [1, 2, 3, 0]],
            scales=given["scales"],
            opacities=given["opacities"],
        )
        self.shape = (scene.camera.height, scene.camera.width)
        self.drawing = Drawing(RasterScene("own", cloud, scene.camera), resolve_device("cpu"), values=given["colors"])

    def draw(self):
        seen = self.drawing.seen()
        return Images(
            seen.channels.reshape(*self.shape, -1), seen.depth.reshape(self.shape), seen.alpha.reshape(self.shape)
        )

    def gradients(self, upstream):
        rows = [array.reshape(self.shape[0] * self.shape[1], -1) for array in upstream]
        self.drawing.set_adjoints(Seen(rows[0], rows[2][:, 0], rows[1][:, 0], np.zeros_like(rows[1][:, 0])))
        found = self.drawing.gradients()
        return {
            "means": found["positions"],
            "quats": found["orientations"][:, [3, 0, 1, 2]],
            "scales": found["scales"],
            "opacities": found["opacities"],
            "colors": found["values"],
        }


class TestPeer:
    def test_a_peer_that_draws_the_same_agrees_in_everything(self, monkeypatch):
        monkeypatch.setattr(benchmark, "peer_for", lambda scene, values, device: (OwnPeer(scene, values), None))
        scene = figure(300, 24, 18)
        found = benchmark.compare_with_peer(scene, resolve_device("cpu"))
        assert found["rgb"]["largest"] == found["alpha"]["largest"] == found["depth_where_opaque_m"]["largest"] == 0.0
        for name in ("all_pixels", "agreeing_pixels_before_the_stop"):
            row = found[f"gradients_relative_l2_{name}"]
            assert row.pop("pixels") > 100
            assert set(row.values()) == {0.0}

    def test_a_peer_that_draws_something_else_does_not(self, monkeypatch):
        shifted = lambda scene: scene._replace(cloud=figure(300, 24, 18, seed=1).cloud)  # noqa: E731
        other = lambda scene, values, device: (OwnPeer(shifted(scene), values), None)  # noqa: E731
        monkeypatch.setattr(benchmark, "peer_for", other)
        found = benchmark.compare_with_peer(figure(300, 24, 18), resolve_device("cpu"))
        assert found["rgb"]["beyond_1e-4"] > 50
        assert found["gradients_relative_l2_all_pixels"]["positions"] > 0.1


def test_adjoints_reach_every_channel(device):
    scene = figure(100, 16, 9)
    drawing = Drawing(scene, resolve_device(device), **benchmark.all_channels(scene))
    adjoints = random_adjoints(16 * 9, drawing.channel_count)
    drawing.set_adjoints(adjoints)
    assert drawing.channel_count == 14
    written = np.concatenate([rows.numpy() for rows in drawing.rasterizer.adjoints().channels], axis=1)
    np.testing.assert_array_equal(written[:, :14], adjoints.channels)
    assert not written[:, 14:].any()
    assert {*drawing.gradients(), "extra"} == {*records.GaussianGradients._fields}


def test_everything_is_measured(device, tmp_path):
    pytest.importorskip("matplotlib")
    target = resolve_device(device)
    states = []
    sections = benchmark.sections(TINY, target)
    result = measure(sections, target, keep=lambda state: states.append(json.dumps(state)))
    assert result["failed"] == []
    result = json.loads(states[-1])
    assert len(states) == len(sections)
    for rows in (result["variants"]["figure"]["variants"], result["variants"]["cube"]["variants"]):
        for name, row in rows.items():
            # Single precision: 6e-8 of up to 4 m, through up to 300 splats.
            assert row["errors"]["depth_to_own_model_m"]["median"] < 1e-5, name
    for scene in ("figure", "cube"):
        assert result["accuracy"][scene]["two_runs_bit_equal"] == {"images": True, "gradients": True}
    assert [row["splats"] for row in result["growth"]["gaussians"]] == [100, 300]
    assert [row["width"] for row in result["growth"]["pixels"]] == [16, 24]
    for draw_one in (draw_growth, draw_stages):
        draw_one([result | {"measured": {"machine": {"device": device}}}], tmp_path / "plot.png")
        assert (tmp_path / "plot.png").stat().st_size > 10_000


def test_pictures_are_written_small(device, tmp_path):
    scene = grazing_scene(figure(500, 40, 30))
    view = draw(scene, resolve_device(device))
    assert (view.alpha > 0.5).mean() > 0.1
    lengths = np.linalg.norm(view.surface_normals, axis=-1)[view.alpha > 0.0]
    np.testing.assert_allclose(lengths, 1.0, atol=1e-6)
    write_sheet(image_panels(view), tmp_path / "sheet.png")
    assert 1_000 < (tmp_path / "sheet.png").stat().st_size < 300_000
