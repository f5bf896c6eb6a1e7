"""Scores of a frame: the formulas of the shared protocol written again, known shifts, and the truth's own surface."""

import numpy as np
import pytest
import trimesh
from skimage.metrics import structural_similarity
from support.shapes import colored

from beam_warp.errors import InvalidArrayError, MissingFileError
from beam_warp.image.color import DISPLAY_SRGB, linear_to_srgb, srgb_to_linear
from beam_warp.raster.gbuffer import GBuffer, rasterize
from beam_warp.reconstruction.scores import read_truth_mesh, score_frame, seen_radiance, truth_frames
from beam_warp.world.camera import Camera
from beam_warp.world.gaussians import GaussianCloud
from beam_warp.world.quaternions import turns_from_z

DISCS = 20_000


@pytest.fixture(scope="module")
def discs(tiny_capture):
    """Opaque discs on the true surface of frame 0, coloured by where they are."""
    mesh = read_truth_mesh(tiny_capture, 0)
    points, faces = trimesh.sample.sample_surface(mesh, DISCS, seed=5)
    spacing = np.sqrt(mesh.area / DISCS)
    cloud = GaussianCloud(
        positions=points,
        orientations=turns_from_z(mesh.face_normals[faces]),
        scales=np.tile([spacing, spacing, 0.05 * spacing], (DISCS, 1)),
        opacities=np.full(DISCS, 0.99),
    )
    return colored(cloud, 0.1 + 0.3 * (points - mesh.bounds[0]) / np.ptp(mesh.bounds, axis=0))


@pytest.fixture
def records(tiny_capture):
    """The test view of frame 0."""
    return tiny_capture.select(split="test", frames=[0])


def protocol(record, cloud, device):
    """The shared scorer's formulas, on what `rasterize` gives for one view."""

    def srgb(x):
        x = np.clip(x, 0, 1)
        return np.where(x <= 0.0031308, 12.92 * x, 1.055 * np.maximum(x, 1e-9) ** (1 / 2.4) - 0.055)

    def psnr(a, b):
        return 10 * np.log10(1 / max(np.mean((a - b) ** 2), 1e-12))

    buffer = rasterize(cloud, record.camera, channels=("radiance", "surface_normals"), device=device)
    ours = srgb(buffer.channels["radiance"].astype(np.float64) * buffer.alpha[..., None])
    theirs = srgb(record.image().rgb().astype(np.float64))
    truth = record.truth()
    alpha = truth.channels["A"]
    solid = alpha > 0.999
    y, x = np.nonzero(alpha > 0.5)
    a, b = (image[y.min() : y.max() + 1, x.min() : x.max() + 1] for image in (ours, theirs))
    n, g = buffer.channels["surface_normals"][solid], truth.stack("normal.X", "normal.Y", "normal.Z")[solid]
    n, g = (v / (np.linalg.norm(v, axis=1, keepdims=True) + 1e-9) for v in (n.astype(np.float64), g))
    angles = np.degrees(np.arccos(np.clip((n * g).sum(1), -1, 1)))
    return {
        "psnr": psnr(a, b),
        "ssim": structural_similarity(
            a, b, data_range=1, gaussian_weights=True, sigma=1.5, use_sample_covariance=False, channel_axis=-1
        ),
        "solid_psnr": psnr(ours[solid], theirs[solid]),
        "whole_psnr": psnr(ours, theirs),
        "normals_median_degrees": np.median(angles),
        "normals_mean_degrees": np.mean(angles),
        "depth_median_mm": 1e3 * np.median(np.abs(buffer.depth[solid] - truth.channels["depth"][solid])),
    }


class TestViews:
    def test_numbers_are_those_of_the_shared_protocol(self, records, discs, device):
        found = score_frame(discs, records, device=device).as_dict()
        for name, value in protocol(records[0], discs, device).items():
            # The same formulas in float64; in float32 the mean of a normal is off by 1e-7, an angle by 1e-4 degrees.
            assert found[name] == pytest.approx(value, rel=1e-6, abs=1e-4), name
        assert found["views"] == 1

    def test_discs_on_the_surface_have_its_normals_and_depth(self, records, discs, device):
        found = score_frame(discs, records, device=device)
        # On a limb of 50 mm radius a pixel of 35 mm spans 0.7 rad: its normal means something to half of that.
        assert found.normals_median_degrees < 20.0
        assert found.views[0].depth_median_mm < 10.0
        assert found.views[0].median_depth_median_mm < 20.0

    def test_a_shift_along_the_axis_is_a_depth_error(self, records, discs, device):
        away = discs.with_arrays(positions=discs.positions + 0.1 * records[0].camera.forward)
        found = score_frame(away, records, device=device).views[0]
        still = score_frame(discs, records, device=device).views[0]
        # 100 mm of a distance of 3.3 m makes what is seen 3 % smaller: other pixels, by less than what they span.
        assert found.depth_median_mm == pytest.approx(100.0, abs=still.depth_median_mm + 5.0)

    def test_each_color_space_is_composited_in_itself(self, discs):
        camera = Camera.orbit((0, 0, 0), 3.0, 0.0, 0.0, width=2, height=1, vertical_fov=40.0)
        alpha = np.array([[0.5, 1.0]], np.float32)
        nothing = np.zeros((1, 2), np.float32)
        radiance = np.array([[[0.5, 0.2, -0.1], [0.8, 0.3, 2.0]]], np.float32)
        buffer = GBuffer(camera, alpha, nothing, nothing, nothing.astype(np.int32), {"radiance": radiance})
        over_black = np.array([[[0.25, 0.1, 0.0], [0.8, 0.3, 2.0]]])
        np.testing.assert_allclose(seen_radiance(buffer, discs), over_black, rtol=1e-6)
        display = discs.with_arrays(radiance_color_space=DISPLAY_SRGB)
        np.testing.assert_allclose(seen_radiance(buffer, display), srgb_to_linear(over_black), rtol=1e-6)

    def test_training_views_are_scored_by_their_image_alone(self, tiny_capture, discs, device):
        found = score_frame(discs, tiny_capture.select(split="train", frames=[0])[:2], device=device)
        assert found.normals_median_degrees is None
        names = "psnr ssim solid_psnr whole_psnr whole_ssim alpha_error views"
        assert set(found.as_dict()) == set(names.split())

    def test_a_pixel_is_the_mean_of_its_samples(self, records, discs, device):
        """The mean is taken in linear light, before it is encoded; geometry is measured as without samples."""
        once, fine = (score_frame(discs, records, samples=samples, device=device).as_dict() for samples in (1, 3))
        buffer = rasterize(discs, records[0].camera.supersampled(3), channels=("radiance",), device=device)
        linear = np.maximum(buffer.channels["radiance"].astype(np.float64) * buffer.alpha[..., None], 0.0)
        linear, alpha = (
            np.stack([image[j::3, i::3] for j in range(3) for i in range(3)]).mean(axis=0)
            for image in (linear, buffer.alpha.astype(np.float64))
        )
        image = records[0].image().linear_rgba()
        ours, theirs = (linear_to_srgb(np.clip(rgb, 0.0, 1.0)) for rgb in (linear, image[..., :3].astype(np.float64)))
        assert fine["whole_psnr"] == pytest.approx(-10.0 * np.log10(np.mean((ours - theirs) ** 2)), abs=1e-4)
        truth_alpha = records[0].truth().alpha
        assert fine["alpha_error"] == pytest.approx(np.abs(alpha - truth_alpha).mean(), rel=1e-5)
        assert fine["whole_psnr"] != once["whole_psnr"]
        for name in ("normals_mean_degrees", "normals_median_degrees", "depth_median_mm", "median_depth_median_mm"):
            assert fine[name] == once[name]

    def test_no_views_are_refused(self, discs):
        with pytest.raises(InvalidArrayError, match="records must hold at least one view"):
            score_frame(discs, [], device="cpu")


class TestSurface:
    def test_the_true_mesh_has_no_distance_from_itself(self, tiny_capture, records, discs, device):
        truth = read_truth_mesh(tiny_capture, 0)
        seeing = [record.camera for record in tiny_capture.select(split="train", frames=[0])]
        found = score_frame(discs, records, truth, truth_mesh=truth, seeing=seeing, sample_count=4000, device=device)
        assert found.surface.chamfer_mm < 1e-3
        assert 0.5 < found.surface.seen_share < 1.0

    def test_a_frame_later_is_a_frame_of_motion_away(self, tiny_capture, records, discs, device):
        truth, later = (read_truth_mesh(tiny_capture, frame) for frame in (0, 1))
        found = score_frame(discs, records, later, truth_mesh=truth, sample_count=4000, device=device)
        moved = 1e3 * np.linalg.norm(truth.vertices - later.vertices, axis=1)
        assert 0.3 < found.surface.chamfer_mm < moved.mean()

    def test_frames_have_exact_channels_and_a_mesh(self, tiny_capture):
        assert truth_frames(tiny_capture) == (0, 1)
        with pytest.raises(MissingFileError, match="truth must have a mesh for every frame scored"):
            read_truth_mesh(tiny_capture, 7)
