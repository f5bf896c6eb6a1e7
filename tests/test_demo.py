"""The demo: its figure persists and is closed, and a small run decomposes it close to its truth."""

import numpy as np
import pytest
import trimesh

from beam_warp.demo import DemoOptions, run_demo
from beam_warp.demo_environments import demo_environments
from beam_warp.demo_figure import build_figure


@pytest.fixture(scope="module")
def figure():
    return build_figure(0.014)


def test_figure_is_closed_and_its_points_persist(figure):
    first, later = figure.at(0.0), figure.at(0.3)
    assert trimesh.Trimesh(first.vertices, first.faces, process=False).is_watertight
    assert np.array_equal(first.faces, later.faces)
    assert np.array_equal(first.base_color, later.base_color)
    moved = np.linalg.norm(first.vertices - later.vertices, axis=1)
    assert 0.05 < moved.max() < 1.0
    assert 1.5 < np.ptp(first.vertices[:, 2]) < 1.9
    assert first.vertices[:, 2].min() == pytest.approx(0.0, abs=1e-6)


def test_figure_is_textured_within_what_materials_are(figure):
    mesh = figure.at(0.0)
    assert mesh.base_color.min() >= 0.02
    assert mesh.base_color.max() <= 0.85
    assert mesh.base_color.std(axis=0).min() > 0.1
    assert mesh.roughness.std() > 0.02


def test_figure_is_concave(figure):
    mesh = trimesh.Trimesh(figure.rest.vertices, figure.rest.faces, process=False)
    assert mesh.volume < 0.4 * mesh.convex_hull.volume


def test_lights_are_maps_of_the_same_exposure():
    lights = demo_environments()
    assert set(lights) == {"studio", "sunset", "stage"}
    brightest = [light.irradiance_map(16, 32).max() for light in lights.values()]
    assert max(brightest) < 1.5 * min(brightest)


def test_small_demo_recovers_its_truth(tmp_path):
    """Bounds are what 4,000 coarse Gaussians must reach if the chain is sound; wrong axes, light or scale fail them."""
    options = DemoOptions(frame_count=2, gaussian_count=4000, image_height=96, device="cpu")
    result = run_demo(tmp_path / "demo", options)
    scores = result.report["scores"]
    assert scores["ambient_occlusion"]["solid_psnr"] > 16.0
    assert scores["base_color"]["solid_psnr"] > 16.0
    assert scores["relit_studio"]["solid_psnr"] > 17.0
    assert scores["relit_sunset"]["solid_psnr"] > 17.0
    assert all(0.85 < scale < 1.15 for scale in scores["base_color_scale"])
    assert scores["normals_median_error_degrees"] < 15.0
    assert result.sequence.topology == "constant"
    assert {"base_color", "roughness", "ids"} <= result.sequence.constant
    for name in ("asset.usda", "report.json", "overview.png", "relit.png", "lights/studio.exr", "lights/sunset.exr"):
        assert (tmp_path / "demo" / name).stat().st_size > 0
