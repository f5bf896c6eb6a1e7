"""Scores of an asset: against itself and known errors in closed form, and the shared tool's numbers on its images."""

import json
import re
import shutil
import subprocess
import sys
from dataclasses import replace
from functools import cache
from types import MappingProxyType

import numpy as np
import pytest
from support.figure_asset import OPENNESS, changed, figure_asset

from beam_warp.capture.capture import Capture
from beam_warp.errors import InvalidOptionError, MissingFileError
from beam_warp.evaluate.asset import evaluate_asset
from beam_warp.evaluate.materials import EvaluateOptions, score_materials
from beam_warp.evaluate.perceptual import PerceptualMetrics
from beam_warp.evaluate.relighters import RELIGHTERS
from beam_warp.image.files import read_image, write_exr
from beam_warp.raster import resolution
from beam_warp.raster.records import RasterOptions
from beam_warp.world.environment import EnvironmentMap
from beam_warp.world.gaussians import GaussianSequence
from beam_warp.world.shot import RenderedImage

NO_METRICS = PerceptualMetrics()
CAP = 120.0
"""What equal images score [dB]."""


@pytest.fixture(scope="module")
def asset():
    return figure_asset()


@pytest.fixture(scope="module", autouse=True)
def small_lights():
    """Lights have few texels, which are quick to blur, and are read once, so that renderers know them again."""
    read = EnvironmentMap.read
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(EnvironmentMap, "read", cache(lambda path: read(path).resized(16, 32)))
        yield


@pytest.fixture(scope="module")
def relighters():
    """One deferred renderer for all tests, which prepares a light once."""
    return {"deferred": cache(RELIGHTERS["deferred"])}


@pytest.fixture(scope="module")
def evaluated(asset, relit_capture, tmp_path_factory):
    """The asset's scores against the traced truth, and the folder of its images."""
    renders = tmp_path_factory.mktemp("evaluated") / "renders"
    found = evaluate_asset(asset, relit_capture, EvaluateOptions(device="cpu"), renders=renders)
    return found, renders


@pytest.fixture(scope="module")
def mirror(evaluated, relit_capture, tmp_path_factory):
    """A capture whose truth is what the asset itself shows."""
    renders = evaluated[1]
    folder = shutil.copytree(relit_capture.folder, tmp_path_factory.mktemp("mirror") / "capture")
    content = json.loads((folder / "transforms.json").read_text())
    for record in content["frames"]:
        if "truth" in record:
            name = f"{record['camera']}_{record['frame']:04d}.exr"
            shutil.copy(renders / name, folder / record["truth"])
            shutil.copy(renders / name, folder / record["file_path"])
            for light, path in record["relit"].items():
                shutil.copy(renders / f"deferred_{light}" / name, folder / path)
    return Capture.read(folder)


@pytest.fixture
def folder(mirror, tmp_path):
    """A copy of the mirror's folder, to be changed."""
    return shutil.copytree(mirror.folder, tmp_path / "capture")


def score(sequence, capture, device, *, metrics=NO_METRICS, relighters=MappingProxyType({}), **options):
    options = EvaluateOptions(device=device, **options)
    return score_materials(sequence, capture, options, metrics=metrics, relighters=relighters)


def truth_of(capture, view):
    (record,) = (record for record in capture.records if record.name == view.name)
    return record.truth()


def box_of(alpha):
    rows, columns = np.nonzero(alpha > 0.5)
    return slice(rows.min(), rows.max() + 1), slice(columns.min(), columns.max() + 1)


class TestAgainstItself:
    def test_equal_images_score_the_cap(self, asset, mirror, relighters):
        seen = []

        def flip(image, truth):
            seen.append((image, truth))
            return float(np.abs(image - truth).mean())

        found = score(asset, mirror, "cpu", relighters=relighters, metrics=PerceptualMetrics({"flip": flip}))
        assert all(image.shape == truth.shape and image.shape[2] == 3 for image, truth in seen)
        everything = {**found.mean_channels(), **found.mean_relit()["deferred"]}
        assert set(everything) == {
            "ambient_occlusion", "base_color", "base_color_scaled", "roughness", "novel_view", "sunset", "stage",
        }  # fmt: skip
        for name, channel in everything.items():
            # Files hold what was scored; the scale is 1 but for the rounding of its sums, and so below the cap's 1e-6.
            assert (channel.psnr, channel.solid_psnr) == (CAP, CAP), name
            assert channel.ssim == pytest.approx(1.0, abs=1e-9), name
            # Scaled colours differ by rounding: 1e-6 of colour, at most 12.92 times as much when encoded.
            assert channel.perceptual["flip"] < 2e-5, name
        assert found.base_color_scale == pytest.approx((1.0, 1.0, 1.0), abs=1e-12)
        assert found.mean("normals_mean_degrees") < 0.05  # arccos of 1 - 1e-7 is 0.03 degrees
        assert found.mean("depth_median_mm") == 0.0
        assert found.mean("overlap") == pytest.approx(1.0)
        assert found.scale_deviation == pytest.approx((0.0, 0.0, 0.0), abs=1e-12)

    @pytest.mark.parametrize(("spacing", "side"), [(2.0, 2), (0.8, 3), (0.1, 4)])
    def test_samples_are_those_of_the_fit(self, asset, relit_capture, monkeypatch, spacing, side):
        """Two on the distance of neighbours [pixel], 2 x 2 at least and 4 x 4 at most; what is stated counts, and
        splats that are not antialiased keep the least."""
        cameras = [record.camera for record in relit_capture.select(split="test", frames=[0])]
        middle = np.median(next(iter(asset)).positions, axis=0)
        pixel = np.median([(middle - camera.position) @ camera.forward / camera.focal_x for camera in cameras])
        monkeypatch.setattr(resolution, "disc_spacing", lambda cloud: spacing * pixel)
        fitted = {"raster": RasterOptions(antialiased=True, low_pass=0.1)}
        for options, expected in ((fitted, side), ({**fitted, "samples": 1}, 1), ({"raster": RasterOptions()}, 2)):
            found = score(asset, relit_capture, "cpu", **options)
            assert found.conditions["samples_per_pixel"] == expected**2

    def test_a_factor_is_found_and_undone(self, asset, mirror, device):
        """Base colour times k needs 1/k: exactly, but for float32 of colours (6e-8) in the sums."""
        factors = np.array([0.5, 0.8, 0.9], np.float32)
        dim = changed(asset, lambda _, cloud: cloud.with_arrays(base_color=cloud.base_color * factors))
        found = score(dim, mirror, device)
        assert found.base_color_scale == pytest.approx(tuple(1.0 / factors), rel=1e-6)
        for view in found.views:
            assert view.base_color_scale == pytest.approx(tuple(1.0 / factors), rel=1e-6)
            # The sRGB curve is at most 12.92 steep: 1e-6 of colour is at most 1.3e-5, or 97 dB.
            scaled = view.channels["base_color_scaled"]
            assert scaled.solid_psnr > 97.0
            if device == "cpu":  # it drew the mirror; CUDA's silhouettes differ by single pixels, which the box counts
                assert scaled.psnr > 97.0
            assert view.channels["base_color"].psnr < 30.0

    def test_a_flickering_factor_is_flicker_of_the_scale(self, asset, mirror):
        factors = (1.0, 0.8)
        uneven = changed(asset, lambda frame, cloud: cloud.with_arrays(base_color=cloud.base_color * factors[frame]))
        found = score(uneven, mirror, "cpu")
        assert found.scale_deviation == pytest.approx(3 * (0.5 * (1.0 / 0.8 - 1.0),), rel=1e-5)
        assert found.frame_scales[1] == pytest.approx(3 * (1.25,), rel=1e-6)

    def test_a_known_error_of_ambient_occlusion(self, asset, mirror, device):
        """0.1 everywhere, composited on black: 0.1 of the coverage, 20 dB where that is 1."""
        darker = changed(
            asset, lambda _, cloud: cloud.with_arrays(ambient_occlusion=np.full(len(cloud), OPENNESS - 0.1, np.float32))
        )
        found = score(darker, mirror, device)
        for view in found.views:
            alpha = truth_of(mirror, view).channels["A"].astype(np.float64)
            found_here = view.channels["ambient_occlusion"]
            # A mean of equal values in float32 is off by less than 1e-6: 1e-5 of the error, or 1e-4 dB.
            for value, part in ((found_here.psnr, box_of(alpha)), (found_here.solid_psnr, alpha > 0.999)):
                assert value == pytest.approx(-10.0 * np.log10(np.mean((0.1 * alpha[part]) ** 2)), abs=1e-3)
            assert found_here.solid_psnr == pytest.approx(20.0, abs=0.01)  # alpha above .999: 0.009 dB

    def test_turned_normals_are_turned_by_as_much(self, asset, mirror, device):
        """A turn by 10 degrees about z is seen whole where a normal is level, not at all where it points up."""
        angle = np.radians(10.0)
        turn = np.array([[np.cos(angle), -np.sin(angle), 0.0], [np.sin(angle), np.cos(angle), 0.0], [0.0, 0.0, 1.0]])
        turned = changed(asset, lambda _, cloud: cloud.with_arrays(normals=cloud.normals @ turn.T))
        found = score(turned, mirror, device)
        for view in found.views:
            truth = truth_of(mirror, view)
            normals = truth.stack("normal.X", "normal.Y", "normal.Z")[truth.channels["A"] > 0.999].astype(np.float64)
            cosine = np.einsum("ni,ij,nj->n", normals, turn, normals)  # turning commutes with blending
            angles = np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))
            assert view.normals_median_degrees == pytest.approx(np.median(angles), abs=0.05)
            assert view.normals_mean_degrees == pytest.approx(angles.mean(), abs=0.05)

    def test_scaled_relighting_is_that_of_scaled_colour(self, asset, mirror, relighters):
        """One view says it: every light is drawn for it, with and without the scale."""
        view = replace(mirror, records=mirror.select(split="test", frames={0})[:1])
        dim = GaussianSequence.from_clouds([asset[0].with_arrays(base_color=0.5 * asset[0].base_color)])
        found = score(dim, view, "cpu", relighters=relighters, scaled_relighting=True)
        assert found.mean_relit()["deferred"]["sunset"].psnr < 30.0
        assert found.mean_relit(scaled=True)["deferred"]["sunset"].psnr > 97.0
        assert found.as_dict()["mean"]["relit_scaled"]["deferred"]["stage"]["psnr"] > 97.0


def srgb(x):
    x = np.clip(x, 0, 1)
    return np.where(x <= 0.0031308, 12.92 * x, 1.055 * np.maximum(x, 1e-9) ** (1 / 2.4) - 0.055)


def protocol(capture, renders):
    """The shared protocol's PSNR written again: (box, solid) by channel, means over views."""
    found = {}

    def add(name, a, b, alpha):
        errors = [np.mean((a[part] - b[part]) ** 2) for part in (box_of(alpha), alpha > 0.999)]
        found.setdefault(name, []).append([-10 * np.log10(max(error, 1e-12)) for error in errors])

    for record in capture.select(split="test"):
        truth, ours = record.truth(), read_image(renders / f"{record.name}.exr")
        known, alpha = truth.channels["A"].astype(np.float64), ours.channels["A"].astype(np.float64)
        for name in ("ambient_occlusion", "roughness"):
            add(name, ours.channels[name] * alpha, truth.channels[name] * known, known)
        names = ("base_color.R", "base_color.G", "base_color.B")
        a, b = (srgb(image.stack(*names).astype(np.float64)) for image in (ours, truth))
        add("base_color", a * alpha[..., None], b * known[..., None], known)
        image = srgb(record.image().rgb().astype(np.float64))
        add("novel_view", srgb(ours.rgb().astype(np.float64)), image, known)
        for light in record.relit_paths:
            lit = read_image(renders / f"deferred_{light}" / f"{record.name}.exr")
            a, b = (srgb(shown.rgb().astype(np.float64)) for shown in (lit, record.relit(light)))
            add(light, a, b, known)
    return {name: np.mean(values, axis=0) for name, values in found.items()}


class TestAgainstTruth:
    def test_numbers_are_those_of_the_protocol(self, evaluated, relit_capture):
        found, renders = evaluated
        scores = {**found.scores.mean_channels(), **found.scores.mean_relit()["deferred"]}
        for name, (box, solid) in protocol(relit_capture, renders).items():
            assert scores[name].psnr == pytest.approx(box, abs=1e-6), name
            assert scores[name].solid_psnr == pytest.approx(solid, abs=1e-6), name

    def test_the_shared_tool_agrees(self, evaluated, relit_capture, data_dir):
        """The shared tool, independent of this package, agrees: PSNR to its last digit, the others to theirs."""
        tool = data_dir.parent / "tools" / "score_capture.py"
        if not tool.is_file():
            pytest.skip(f"the shared scoring tool {tool} is absent")
        found, renders = evaluated
        words = [f"{light}={renders / f'deferred_{light}'}" for light in ("sunset", "stage")]
        said = subprocess.run(
            [sys.executable, tool, relit_capture.folder, renders, "--relit", *words],
            check=True,
            capture_output=True,
            text=True,
        ).stdout
        assert "MISSING" not in said
        assert "NON-FINITE" not in said
        lines = re.findall(r"(.+?) +box PSNR +([\d.]+)  SSIM ([\d.]+)  solid PSNR +([\d.]+)  over 4 views", said)
        theirs = {name: tuple(map(float, values)) for name, *values in lines}
        scores = found.scores
        ours = {**scores.mean_channels(), **{f"relit {k}": v for k, v in scores.mean_relit()["deferred"].items()}}
        for name, title in (
            ("ambient_occlusion", "AO"), ("base_color", "base color"), ("roughness", "roughness"),
            ("novel_view", "novel view"), ("relit sunset", "relit sunset"), ("relit stage", "relit stage"),
        ):  # fmt: skip
            box, similarity, solid = theirs[title]
            assert ours[name].psnr == pytest.approx(box, abs=0.01), name
            assert ours[name].ssim == pytest.approx(similarity, abs=0.001), name
            assert ours[name].solid_psnr == pytest.approx(solid, abs=0.01), name
        assert scores.mean("normals_median_degrees") == pytest.approx(theirs["normal deg"][0], abs=0.01)
        assert scores.mean("depth_median_mm") == pytest.approx(theirs["depth mm"][0], abs=0.01)
        printed = re.search(r"base color scale \[(.+)\]", said).group(1)
        assert scores.mean_view_scale == pytest.approx([float(word) for word in printed.split()], abs=0.001)


class TestRefusals:
    @pytest.mark.parametrize(
        ("arrays", "options", "says"),
        [
            (lambda _: {}, {"frames": (7, 8)}, r"asset must show a frame whose truth is known \(0, 1\), got one of"),
            (lambda _: {}, {"split": "train"}, "truth must be a capture whose train views have exact channels"),
            (lambda cloud: {"positions": cloud.positions + np.float32(0.6)}, {}, "asset must stand where the capture"),
            (lambda _: {"axes": "rub"}, {}, "Check the axes"),
            (lambda _: {"roughness": None, "normals": None}, {}, r"without roughness, normals in frame 0\. Estimate"),
        ],
        ids=["frames", "truth", "place", "axes", "materials"],
    )
    def test_what_does_not_match(self, asset, relit_capture, arrays, options, says):
        wrong = changed(asset, lambda _, cloud: cloud.with_arrays(**arrays(cloud)))
        with pytest.raises(InvalidOptionError, match=says):
            score(wrong, relit_capture, "cpu", **options)

    def test_a_light_that_is_not_there(self, asset, folder, relighters):
        (folder / "truth" / "stage.exr").unlink()
        with pytest.raises(MissingFileError, match=r"light must be a file, got none at .*stage\.exr"):
            score(asset, Capture.read(folder), "cpu", relighters=relighters)


class TestWhatIsThere:
    def test_frames_that_the_asset_lacks_are_said(self, asset, mirror):
        """The second frame alone, stated as such, scores as it does among both."""
        second = GaussianSequence.from_clouds([asset[1]], metadata={"capture_frames": "1"})
        found = score(second, mirror, "cpu")
        assert [view.frame for view in found.views] == [1, 1]
        assert found.mean_channels()["base_color"].psnr == CAP
        assert found.notes == ("the asset does not show frames whose truth is known: 0",)
        assert found.scale_deviation is None
        assert found.temporal.absent == {
            "gaussians": "the asset has one frame",
            "surface": "fewer than two frames of the asset have a true surface",
            "occlusion_gaussians": "the asset has one frame",
            "occlusion_surface": "fewer than two frames of the asset have a true surface",
        }

    def test_a_frame_without_true_base_colour_has_no_scale(self, asset, mirror, folder):
        """The other channels of that frame are scored; base colour and its scale are those of the other frame."""
        for record in mirror.select(split="test", frames={1}):
            channels = record.truth().channels
            path = folder / record.truth_path.relative_to(mirror.folder)
            write_exr(path, {name: array for name, array in channels.items() if "base_color" not in name})
        found = score(asset, Capture.read(folder), "cpu")
        assert set(found.frame_scales) == {0}
        assert found.base_color_scale == found.frame_scales[0] == pytest.approx((1.0, 1.0, 1.0), abs=1e-12)
        assert found.scale_deviation is None
        for view in found.views:
            assert "roughness" in view.channels
            assert ("base_color_scaled" in view.channels) == (view.frame == 0)

    def test_what_is_absent_is_said(self, asset, mirror):
        dull = changed(asset, lambda _, cloud: cloud.with_arrays(radiance=None, radiance_color_space=None))
        found = score(dull, mirror, "cpu")
        assert "novel_view" not in found.mean_channels()
        assert found.absent == {
            "novel_view": "the asset has no captured radiance", "relit": "no relighter was chosen",
        }  # fmt: skip

    def test_relighters_are_told_how_to_draw(self, asset, mirror):
        """Renderers draw as the asset states, with the samples asked for: each view once under each of its lights."""
        told, drawn = [], []

        class Black:
            def draw(self, shot):
                drawn.append((len(shot.cloud), shot.camera.width))
                black = np.zeros((shot.camera.height, shot.camera.width), np.float32)
                return RenderedImage(np.repeat(black[..., None], 3, axis=-1), black)

        def make(*how):
            told.append(how)
            return Black()

        stated = GaussianSequence.from_clouds(
            list(asset), metadata={"raster_antialiased": "true", "raster_low_pass": "0.1"}
        )
        found = score(stated, mirror, "cpu", samples=3, relighters={"black": make})
        assert told == [(RasterOptions(antialiased=True, low_pass=0.1), 3, "cpu")]
        assert drawn == [(len(asset[0]), 48)] * 8
        assert set(found.mean_relit()["black"]) == {"sunset", "stage"}
        assert found.conditions["samples_per_pixel"] == 9

    def test_the_record_is_json(self, evaluated):
        text = json.dumps(evaluated[0].report, allow_nan=False)
        found = json.loads(text)
        assert found["conditions"]["samples_per_pixel"] == 4
        assert len(found["views"]) == 4
        assert set(found["mean"]["relit"]["deferred"]) == {"sunset", "stage"}


def test_a_capture_without_relit_images_is_scored_all_the_same(asset, mirror):
    """There is no light to take a mean over: nothing is stated, and the record is valid JSON."""
    plain = replace(mirror, records=tuple(replace(record, relit_paths={}) for record in mirror.records))
    record = score(asset, plain, "cpu", relighters={"deferred": RELIGHTERS["deferred"]}).as_dict()
    assert record["mean"]["relit_mean"] == {}
    json.dumps(record, allow_nan=False)
