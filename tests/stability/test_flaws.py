"""Flawed captures: every flaw has its stated size in closed form, and changes nothing else."""

import json
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image as PillowImage

from beam_warp.errors import InvalidArrayError, InvalidOptionError
from beam_warp.image.color import srgb_to_linear
from beam_warp.image.files import read_image
from beam_warp.stability.flaws.mattes import blotted_coverage, offset_coverage
from beam_warp.stability.flaws.optics import defocused, distorted, motion_blurred, radial_coefficient
from beam_warp.stability.flaws.rig import CameraFlaws, draw_camera_flaws
from beam_warp.stability.flaws.sensor import FULL_WELL, READ_NOISE, noisy
from beam_warp.stability.flaws.write import FLAWS, STUDIO, write_flawed
from beam_warp.world.camera import Camera
from beam_warp.world.environment import EnvironmentMap

CENTER = np.array([0.1, -0.2, 0.9])


def blob(x=32.0, y=30.0, deviation=3.0, side=64):
    """A Gaussian, whose moments every filter changes by those of its kernel; two channels."""
    rows, columns = np.mgrid[:side, :side] + 0.5
    value = np.exp(-0.5 * ((columns - x) ** 2 + (rows - y) ** 2) / deviation**2)
    return np.stack([value, 0.5 * value], axis=-1)


def moments(channel):
    """Sum, centre (x, y) and covariance."""
    rows, columns = np.mgrid[: channel.shape[0], : channel.shape[1]] + 0.5
    total = channel.sum()
    places = np.stack([columns, rows]).reshape(2, -1)
    center = places @ channel.ravel() / total
    off = places - center[:, None]
    return total, center, (off * channel.ravel()) @ off.T / total


def ring(count, **options):
    size = {"width": 320, "height": 320, "vertical_fov": 40.0, **options}
    return {f"c{k}": Camera.orbit(CENTER, 2.7, 360.0 * k / count, 10.0 * (k % 3), **size) for k in range(count)}


class TestOptics:
    @pytest.mark.parametrize(
        ("filtered", "grown"),
        [
            (lambda layers: motion_blurred(layers, (0.6, 0.8)), np.array([[0.36, 0.48], [0.48, 0.64]]) / 12),
            (lambda layers: motion_blurred(layers, (2.0, 0.0)), np.diag([4.0, 0.0]) / 12),
            (lambda layers: defocused(layers, 2.0), np.eye(2) * 4.0 / 16),
            (lambda layers: defocused(layers, 0.5), np.eye(2) * 0.25 / 16),
        ],
    )
    def test_blur_keeps_energy_and_center_and_adds_its_variance(self, filtered, grown):
        sharp = blob()
        blurred = filtered(sharp)
        for before, after in zip(np.moveaxis(sharp, -1, 0), np.moveaxis(blurred, -1, 0), strict=True):
            (total, center, spread), (kept, there, wider) = moments(before), moments(after)
            assert kept == pytest.approx(total, rel=1e-12)
            np.testing.assert_allclose(there, center, atol=1e-9)
            np.testing.assert_allclose(wider - spread, grown, atol=1e-9)

    def test_distortion_moves_the_edge_by_its_size_and_the_middle_not_at_all(self):
        camera = Camera.look_at([0, -3, 0], [0, 0, 0], width=64, height=64, vertical_fov=40.0)
        k1 = radial_coefficient(camera, 0.5)
        rows, columns = np.mgrid[:64, :64] + 0.5
        shown = distorted(np.stack([columns, rows], axis=-1), camera, k1)  # of coordinates, whose values are places
        inner = (slice(16, -16), slice(16, -16))  # a spline forgets its end by a factor of 0.27 a pixel
        x, y = shown[..., 0] - 32.0, shown[..., 1] - 32.0
        grown = 1.0 + 0.5 / 32.0 * (x**2 + y**2) / 32.0**2  # half a pixel of 32, growing by the third power
        np.testing.assert_allclose((32.0 + x * grown)[inner], columns[inner], atol=1e-6)
        np.testing.assert_allclose((32.0 + y * grown)[inner], rows[inner], atol=1e-6)


class TestMattes:
    @pytest.mark.parametrize("pixels", [-2.0, -1.0, -0.5, 0.5, 1.0, 2.0])
    def test_the_sides_of_a_square_move_by_exactly_that(self, pixels):
        alpha = np.zeros((40, 50))
        alpha[10:30, 15:35] = 1.0
        profile = offset_coverage(alpha, pixels)[20]
        assert profile.sum() == pytest.approx(20.0 + 2.0 * pixels, abs=1e-12)
        np.testing.assert_array_equal(profile[15:35], profile[15:35][::-1])

    @pytest.mark.parametrize("pixels", [-1.0, 0.5, 1.0, 2.0])
    def test_a_disc_grows_by_its_circumference(self, pixels):
        rows, columns = np.mgrid[:480, :480] / 8.0 + 1 / 16 - 30.3
        radius = 17.0
        alpha = (np.hypot(rows, columns) < radius).reshape(60, 8, 60, 8).mean(axis=(1, 3))
        area = offset_coverage(alpha, pixels).sum()
        expected = np.pi * (radius + pixels) ** 2
        assert abs(area - expected) < 0.05 * 2.0 * np.pi * radius  # the outline is where it should be to 0.05 pixels

    def test_masks_are_ordered_and_nothing_stays_nothing(self, rng):
        alpha = np.clip(blob()[..., 0] * 3.0 - 0.3 + 0.1 * rng.random((64, 64)), 0.0, 1.0)
        smaller, larger = (offset_coverage(alpha, way) for way in (-1.0, 1.0))
        assert (smaller <= alpha).all()
        assert (alpha <= larger).all()
        np.testing.assert_array_equal(offset_coverage(alpha, 0.0), alpha)
        np.testing.assert_array_equal(offset_coverage(np.zeros((8, 8)), 2.0), 0.0)

    def test_blots_are_a_hole_and_a_blob(self):
        alpha = np.zeros((64, 64))
        alpha[20:44, 20:44] = 1.0
        blotted = blotted_coverage(alpha, 8.0, np.random.default_rng(0))
        hole, blob = ((blotted - alpha) == value for value in (-1.0, 1.0))
        assert 0.3 * 16.0 * np.pi < hole.sum() <= 57  # of whole pixels; cut by the outline, perhaps
        assert 0.3 * 16.0 * np.pi < blob.sum() <= 57


class TestSensor:
    @pytest.mark.parametrize("value", [0.0, 0.01, 0.3, 1.0])
    @pytest.mark.parametrize("size", [0.5, 2.0])
    def test_noise_has_its_mean_and_variance(self, value, size, rng):
        count = 200_000
        counted = noisy(np.full(count, value), size, rng)
        variance = (value / FULL_WELL + READ_NOISE**2) * size**2
        assert abs(counted.mean() - value) < 4.0 * np.sqrt(variance / count)
        # Of Poisson and normal numbers together: chi-square but for the excess of few electrons.
        wells = FULL_WELL / size**2
        excess = value / wells**3 / variance**2  # fourth cumulant over variance^2
        spread = np.sqrt(2.0 / count + excess / count)
        assert abs(counted.var() / variance - 1.0) < 4.0 * spread


class TestRig:
    def test_gains_have_their_size_and_a_mean_of_none(self):
        drawn = draw_camera_flaws(ring(24), ["exposure"], 0.5, 3)
        stops = np.array([flaw.exposure_stops for flaw in drawn.values()])
        hues = np.array([flaw.white_balance for flaw in drawn.values()])
        assert np.abs(stops).max() == pytest.approx(0.1)
        assert stops.mean() == pytest.approx(0.0, abs=1e-15)
        np.testing.assert_allclose(np.abs(hues).max(axis=0), 0.025)
        np.testing.assert_allclose(hues.mean(axis=0), 0.0, atol=1e-15)
        assert abs(np.corrcoef(stops, hues[:, 0])[0, 1]) < 0.6

    @pytest.mark.parametrize("size", [0.5, 1.0, 2.0])
    def test_a_pose_errs_by_its_pixels_where_it_looks_and_by_its_millimetres(self, size):
        cameras = ring(7)
        for name, flaw in draw_camera_flaws(cameras, ["poses"], size, 1).items():
            camera = cameras[name]
            assert np.linalg.norm(flaw.shift) == pytest.approx(1e-3 * size)
            turned = Camera(
                **{**vars(camera), "camera_to_world": CameraFlaws(rotation=flaw.rotation).stated(camera, CENTER)}
            )
            ahead = camera.position + 1e6 * camera.forward
            away = turned.project(ahead[None])[0, :2] - camera.project(ahead[None])[0, :2]
            assert np.hypot(*away) == pytest.approx(0.3 * size, rel=1e-6)
            np.testing.assert_allclose(flaw.stated(camera, CENTER)[:3, 3], camera.position + flaw.shift, atol=1e-12)

    def test_half_of_the_masks_are_too_large(self):
        drawn = draw_camera_flaws(ring(8), ["masks"], 2.0, 5)
        assert sorted(flaw.mask_pixels for flaw in drawn.values()) == [-2.0] * 4 + [2.0] * 4

    def test_one_camera_is_wrong_and_still_looks_at_the_subject(self):
        cameras = ring(9)
        drawn = draw_camera_flaws(cameras, ["wrong-camera"], 1.0, 2)
        (name,) = (name for name, flaw in drawn.items() if flaw.as_dict())
        pose = drawn[name].stated(cameras[name], CENTER)
        turned = replace(cameras[name], camera_to_world=pose)
        np.testing.assert_allclose(turned.project(CENTER[None]), cameras[name].project(CENTER[None]), atol=1e-9)
        assert np.dot(pose[:3, 0], cameras[name].camera_to_world[:3, 0]) == pytest.approx(np.cos(np.radians(20.0)))

    def test_draws_are_the_same_alone_and_together(self):
        cameras = ring(6)
        alone = draw_camera_flaws(cameras, ["poses"], 1.0, 4)
        together = draw_camera_flaws(cameras, STUDIO, 1.0, 4)
        assert all(alone[name].rotation == together[name].rotation for name in cameras)
        assert alone["c0"].rotation != draw_camera_flaws(cameras, ["poses"], 1.0, 5)["c0"].rotation


@pytest.fixture(scope="module")
def flawed(tiny_capture, tmp_path_factory):
    """Write a flawed copy of the first frame of the tiny capture."""
    folder = tmp_path_factory.mktemp("flawed")

    def write(*flaws, **options):
        place = folder / f"{'_'.join(flaws)}{len(list(folder.iterdir()))}"
        return write_flawed(tiny_capture, place, flaws, **{"frames": tiny_capture.frames[:1], **options})

    return write


def views(capture, clean):
    """Pairs of views, the copy's and the clean one's."""
    records = {record.name: record for record in clean.records}
    return [(record.view(), records[record.name].view()) for record in capture.records]


class TestWrite:
    def test_without_flaws_it_is_the_capture(self, flawed, tiny_capture):
        copy = flawed()
        assert {record.split for record in copy.capture.records} == {"train"}
        assert copy.capture.frames == (0,)
        for mine, clean in views(copy.capture, tiny_capture):
            np.testing.assert_allclose(mine.color, clean.color, rtol=2.0**-11, atol=2.0**-25)
            np.testing.assert_allclose(mine.alpha, clean.alpha, rtol=2.0**-11, atol=2.0**-25)
            np.testing.assert_allclose(mine.camera.camera_to_world, clean.camera.camera_to_world, atol=1e-12)
        lights = [EnvironmentMap.read(c.environment_path).radiance for c in (copy.capture, tiny_capture)]
        np.testing.assert_array_equal(*lights)

    def test_exposures_are_what_was_injected(self, flawed, tiny_capture):
        copy = flawed("exposure")
        for (mine, clean), record in zip(views(copy.capture, tiny_capture), copy.capture.records, strict=True):
            said = copy.injected["cameras"][record.camera_name]
            red, blue = said["white_balance"]
            gains = 2.0 ** said["exposure_stops"] * np.array([1.0 + red, 1.0, 1.0 + blue])
            np.testing.assert_allclose(mine.color.sum((0, 1)) / clean.color.sum((0, 1)), gains, rtol=1e-3)

    def test_vignetting_is_the_power_of_the_cosine(self, flawed, tiny_capture):
        for mine, clean in views(flawed("vignetting", size=0.5).capture, tiny_capture):
            cosine = clean.camera.directions() @ clean.camera.forward
            np.testing.assert_allclose(mine.color, clean.color * cosine[..., None] ** 2, rtol=2e-3, atol=1e-5)

    def test_photographs_hide_where_the_subject_ends(self, flawed, tiny_capture):
        copy = flawed("masks")
        for record, (mine, clean) in zip(copy.capture.records, views(copy.capture, tiny_capture), strict=True):
            image = record.image()
            assert image.alpha is None
            way = copy.injected["cameras"][record.camera_name]["mask_pixels"]
            assert np.sign(mine.alpha.sum() - clean.alpha.sum()) == way
            wall = image.rgb()[clean.alpha == 0.0]
            assert wall.min() > 0.0
            inside = clean.alpha > 0.999  # and below it, also where the mask does not reach
            np.testing.assert_allclose(image.rgb()[inside], clean.color[inside], rtol=2.0**-10, atol=1e-6)

    def test_eight_bits_and_the_light_are_in_units_of_white(self, flawed, tiny_capture):
        copy = flawed("noise", size=0.01)
        assert copy.white > 1e-3
        light, true = (EnvironmentMap.read(c.environment_path).radiance for c in (copy.capture, tiny_capture))
        np.testing.assert_allclose(light * copy.white, true, rtol=1e-6)
        step = 0.5 / 255 * np.gradient(srgb_to_linear(np.linspace(0, 1, 256))).max() * 255  # of the brightest code
        for mine, clean in views(copy.capture, tiny_capture):
            solid = (clean.alpha > 0.999) & (clean.color.max(axis=-1) < copy.white)
            assert np.abs(mine.color[solid] - clean.color[solid] / copy.white).max() < step + 5 * 0.01 * 0.021
            assert np.abs(mine.alpha - clean.alpha).max() <= 0.5 / 255 + 1e-6
        assert PillowImage.open(copy.capture.records[0].image_path).mode == "RGBA"

    @pytest.mark.parametrize("size", [1.0, 2.0])
    def test_cut_outs_keep_straight_colour_within_wrong_masks(self, flawed, tiny_capture, size):
        copy = flawed("cutouts", size=size)
        for record, (mine, clean) in zip(copy.capture.records, views(copy.capture, tiny_capture), strict=True):
            way = copy.injected["cameras"][record.camera_name]["mask_pixels"]
            assert abs(way) == size
            assert np.sign(mine.alpha.sum() - clean.alpha.sum()) == np.sign(way)
            assert mine.color[clean.alpha == 0.0].max() == 0.0
            solid = (mine.alpha > 0.999) & (clean.alpha > 0.999)
            np.testing.assert_allclose(mine.color[solid], clean.color[solid], rtol=2.0**-10, atol=1e-6)

    def test_blots_are_in_a_quarter_of_the_masks(self, flawed, tiny_capture):
        copy = flawed("blots", "plate", size=0.5)
        found = [np.abs(mine.alpha - clean.alpha).max() > 0.9 for mine, clean in views(copy.capture, tiny_capture)]
        assert 0 < sum(found) < 0.6 * len(found)

    def test_hard_masks_are_all_or_nothing(self, flawed):
        masks = [read_image(record.mask_path).rgb() for record in flawed("hard-masks").capture.records]
        assert len(masks) > 1
        assert all(set(np.unique(mask)) == {0.0, 1.0} for mask in masks)

    def test_light_is_turned_and_brighter(self, flawed, tiny_capture):
        copy = flawed("light", size=2.0)
        light, true = (EnvironmentMap.read(c.environment_path) for c in (copy.capture, tiny_capture))
        np.testing.assert_allclose(light.mean_radiance() / true.mean_radiance(), 1.2, rtol=1e-5)
        assert abs(copy.injected["light"]["turn_degrees"]) == 4.0
        undone = light.rotated(-copy.injected["light"]["turn_degrees"]).radiance / 1.2
        assert np.abs(undone - true.radiance).mean() < np.abs(light.radiance / 1.2 - true.radiance).mean()

    def test_clipped_pixels_are_as_many_as_stated(self, flawed, tiny_capture):
        copy = flawed("clipping", size=2.0)
        solid = [mine.color[clean.alpha > 0.999].max(axis=-1) for mine, clean in views(copy.capture, tiny_capture)]
        bright = np.concatenate(solid)
        assert (bright >= np.float16(copy.injected["white"])).mean() == pytest.approx(
            0.04, abs=2.0 / len(bright) + 0.002
        )

    def test_missing_images_are_listed_and_not_there(self, flawed):
        copy = flawed("missing-image")
        absent = [record.name for record in copy.capture.records if not record.image_path.is_file()]
        assert len(absent) == 2
        assert absent == copy.injected["missing"]

    def test_the_copy_does_not_tell_what_was_done(self, flawed):
        copy = flawed(*STUDIO)
        stated = json.loads((copy.capture.folder / "transforms.json").read_text())
        assert set(stated) == {"camera_model", "fps", "environment", "frames"}
        assert not {"truth", "split_truth", "relit"} & set(stated["frames"][0])
        files = {path.suffix for path in copy.capture.folder.rglob("*") if path.is_file()}
        assert files == {".json", ".exr", ".png"}

    def test_the_same_seed_writes_the_same(self, flawed):
        first, second, other = (flawed("noise", "masks", seed=seed) for seed in (1, 1, 2))
        for a, b, c in zip(first.capture.records, second.capture.records, other.capture.records, strict=True):
            assert a.image_path.read_bytes() == b.image_path.read_bytes()
            assert a.image_path.read_bytes() != c.image_path.read_bytes()

    @pytest.mark.parametrize("flaw", FLAWS)
    def test_every_flaw_can_be_read(self, flawed, flaw):
        copy = flawed(flaw)
        readable = [record.view() for record in copy.capture.records if record.name not in copy.injected["missing"]]
        assert all(view.alpha is not None for view in readable)

    def test_what_cannot_be_flawed_is_refused(self, flawed):
        with pytest.raises(InvalidOptionError, match="flaw must be one of"):
            flawed("dust")
        with pytest.raises(InvalidOptionError, match="size must"):
            flawed("noise", size=0.0)
        with pytest.raises(InvalidArrayError, match="capture must have 2 training cameras"):
            flawed("noise", frames=())
