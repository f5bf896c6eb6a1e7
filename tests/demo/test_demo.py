"""The demo: its figure persists and is closed, and a small run decomposes it close to its truth."""

import json
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import trimesh
from PIL import Image

from beam_warp.cli.demo import Demo
from beam_warp.decomposition.job import OverviewOptions
from beam_warp.demo.capture import FIGURE_SPACINGS, demo_figure_for
from beam_warp.demo.figure import build_figure
from beam_warp.demo.from_images import PANEL_HEIGHT, FromImages, FromImagesOptions, demo_capture, demo_from_images
from beam_warp.demo.job import DemoOptions, run_demo
from beam_warp.demo.lights import demo_environments
from beam_warp.errors import OutputError
from beam_warp.jobs.listeners import no_progress


@pytest.fixture(scope="module")
def figure():
    return build_figure(FIGURE_SPACINGS[1])


@pytest.fixture(scope="module")
def lights():
    """The lights of the demo, smaller: what is made of them costs less."""
    return {name: light.resized(16, 32) for name, light in demo_environments().items()}


def test_figure_is_closed_and_its_points_persist(figure):
    first, later = figure.at(0.0), figure.at(0.3)
    assert trimesh.Trimesh(first.vertices, first.faces, process=False).is_watertight
    assert np.array_equal(first.faces, later.faces)
    assert np.array_equal(first.base_color, later.base_color)
    assert np.array_equal(later.vertices, demo_figure_for(size=64).at(0.3).vertices)  # the same figure every time
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


def test_figure_is_closed_where_its_surface_meets_the_grid():
    """A point of the grid lies on the surface at this size: triangles about it have no area, and no normals."""
    mesh = demo_figure_for(size=120).rest
    assert trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).is_watertight


def test_figure_is_concave(figure):
    mesh = trimesh.Trimesh(figure.rest.vertices, figure.rest.faces, process=False)
    assert mesh.volume < 0.4 * mesh.convex_hull.volume


def test_lights_are_maps_of_the_same_exposure(lights):
    assert set(lights) == {"studio", "sunset", "stage"}
    brightest = [light.irradiance_map(16, 32).max() for light in lights.values()]
    assert max(brightest) < 1.5 * min(brightest)


@pytest.fixture(scope="module")
def small_demo(tmp_path_factory):
    """The whole demo at a twentieth of its size: its folder, its options and its result."""
    out = tmp_path_factory.mktemp("small") / "demo"
    sizes = {"size": 64, "frame_count": 2, "camera_count": 8, "test_camera_count": 1, "samples": 4}
    steps = {"color_iterations": 30, "normal_iterations": 30, "joint_iterations": 20, "track_iterations": 10}
    images = FromImagesOptions(gaussian_count=1500, **sizes, **steps)
    options = DemoOptions(frame_count=2, gaussian_count=4000, image_height=96, device="cpu", images=images)
    return out, options, run_demo(out, options)


def test_command_and_function_have_the_same_sizes():
    command, options = Demo(), DemoOptions()
    names = {"frames": "frame_count", "gaussians": "gaussian_count", "height": "image_height", "seed": "seed"}
    assert [getattr(command, one) for one in names] == [getattr(options, other) for other in names.values()]


@pytest.mark.slow
def test_small_demo_recovers_its_truth(small_demo):
    """Bounds are what 4,000 coarse Gaussians must reach if the chain is sound; wrong axes, light or scale fail them."""
    _, _, result = small_demo
    scores = result.report["scores"]
    assert scores["ambient_occlusion"]["solid_psnr"] > 16.0
    assert scores["base_color"]["solid_psnr"] > 16.0
    assert scores["relit_studio"]["solid_psnr"] > 17.0
    assert scores["relit_sunset"]["solid_psnr"] > 17.0
    assert all(0.85 < scale < 1.15 for scale in scores["base_color_scale"])
    assert scores["normals_median_error_degrees"] < 15.0
    assert result.sequence.topology == "constant"
    assert {"roughness", "ids"} <= result.sequence.constant
    # Nothing changes colour; so coarse a reconstruction may say so of a few that it misplaces.
    assert result.report["materials"]["changing_part"] < 0.02


@pytest.mark.slow
def test_small_demo_from_images_recovers_its_truth(small_demo):
    """Bounds are what 1,500 Gaussians must reach on images of 64 x 64 if the chain is sound, from images to relighting.

    A pixel is 37 mm wide, so that a surface off by more than one is not found; the subject fills a sixth of its box, so
    that images which miss it score below 15 dB.
    """
    out, _, result = small_demo
    found = result.report["from_images"]
    assert json.loads((out / "report.json").read_text())["from_images"] == json.loads(json.dumps(found))
    assert [entry["kind"] for entry in found["frames"]] == ["key", "tracked"]
    assert not any("lost" in warning for warning in found["warnings"])
    assert found["gaussians"] == [1500, 1500]
    for entry in found["frames"]:
        assert entry["psnr"] > 20.0
        assert entry["surface"]["chamfer_mm"] < 37.0
        assert entry["normals_median_degrees"] < 25.0
    assert found["drift"][1]["followed"] == 1.0
    # The surface moves by 8.6 mm from one frame to the next: what is tracked must drift by less than what is not.
    assert found["drift"][1]["vertices"]["mean_mm"] < 8.6
    for name in ("base_color", "relit_studio", "relit_sunset", "relit_stage"):
        assert found["relightable"][name]["solid_psnr"] > 16.0
    for name in ("capture/transforms.json", "reconstruction/gaussians.usda", "from_images/asset.usda"):
        assert (out / name).stat().st_size > 0
    picture = np.asarray(Image.open(out / "reconstruction.png"))
    # A row for each frame; photograph, Gaussians, normals, mesh and two lights
    assert 2 * PANEL_HEIGHT < picture.shape[0] < 3 * PANEL_HEIGHT + 200
    assert picture.std() > 20.0


@pytest.mark.slow
def test_demo_from_images_takes_up_what_it_finished(small_demo):
    out, options, _ = small_demo
    lights = {"studio": demo_environments()["studio"]}
    again = demo_from_images(out, options.images, lights, device="cpu", seed=0, progress=no_progress)
    assert again.result.report["resumed_frames"] == 2


def test_demo_takes_up_its_capture_and_refuses_another(tmp_path):
    options = FromImagesOptions(size=16, frame_count=1, camera_count=2, test_camera_count=1, samples=1)
    written = demo_capture(tmp_path, options, "cpu", 0, no_progress)
    before = (tmp_path / "capture/transforms.json").stat().st_mtime_ns
    assert demo_capture(tmp_path, options, "cpu", 0, no_progress).frames == written.frames
    assert (tmp_path / "capture/transforms.json").stat().st_mtime_ns == before
    for other, seed in ((replace(options, samples=2), 0), (options, 1)):
        with pytest.raises(OutputError, match=r"folder must be new or empty, got .*capture with content"):
            demo_capture(tmp_path, other, "cpu", seed, no_progress)


def test_demo_writes_what_it_says(figure, lights, tmp_path, monkeypatch):
    """The first half at its smallest, the second made up: files and report. Slow tests say whether scores are good."""
    monkeypatch.setattr("beam_warp.demo.job.build_figure", lambda: figure)
    one_light = dict.fromkeys(lights, lights["studio"])
    monkeypatch.setattr("beam_warp.demo.job.demo_environments", lambda: one_light)
    monkeypatch.setattr("beam_warp.demo.job.OverviewOptions", partial(OverviewOptions, height=64))
    made_up = FromImages(tmp_path / "reconstruction.png", None, {"frames": []})
    monkeypatch.setattr("beam_warp.demo.job.demo_from_images", lambda *args, **options: made_up)
    stages = []
    options = DemoOptions(gaussian_count=500, image_height=32, device="cpu")
    result = run_demo(tmp_path / "demo", options, lambda stage, done, total: stages.append(stage))
    report = json.loads((tmp_path / "demo/report.json").read_text())
    assert report["from_images"] == made_up.report
    assert {"ambient_occlusion", "base_color", "relit_studio", "relit_sunset", "relit_stage"} <= set(report["scores"])
    assert stages[:3] == ["capture", "path trace truth", "path trace truth"]
    assert result.sequence[0].is_relightable
    for name in ("asset.usda", "overview.png", "relit.png", *(f"lights/{name}.exr" for name in lights)):
        assert (tmp_path / "demo" / name).stat().st_size > 0
