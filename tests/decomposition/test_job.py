"""The main job, small: everything is written, a stopped job continues to the same bytes, errors leave nothing."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
from support.changed_code import changed_code
from support.figure_asset import figure_asset
from support.shapes import cloud_of, sphere_points, tiles

from beam_warp import GaussianSequence, RunOptions, read, run, validate
from beam_warp.decomposition.capture_images import CaptureImages
from beam_warp.decomposition.job import OverviewOptions
from beam_warp.errors import InvalidArrayError, InvalidOptionError, OutputError
from beam_warp.image.color import DISPLAY_SRGB
from beam_warp.image.files import read_image, write_exr
from beam_warp.image.panels import MARGIN, TITLE_HEIGHT
from beam_warp.materials.images import ImagePathOptions, decompose_by_images
from beam_warp.materials.light import LightCheck
from beam_warp.materials.light_rays import MaterialOptions
from beam_warp.materials.light_turn import LightTurn
from beam_warp.materials.roughness_source import RoughnessTexture
from beam_warp.raster.records import RasterOptions
from beam_warp.render.sheet import contact_sheet
from beam_warp.world.camera import Camera
from beam_warp.world.environment import EnvironmentMap
from beam_warp.world.gaussians import Observability

FAST = RunOptions(materials=MaterialOptions(sample_count=8), exposure=0.0, device="cpu")
AUTO = replace(FAST, exposure="auto")
"""Looks for the exposure that explains the colours, which takes longer than all the rest of a small job."""

SMALL = OverviewOptions(height=48)


def job(sequence, light, out, options=FAST, **more):
    return run(sequence, light, out, options, overview=SMALL, **more)


def frame(shift=0.0, ids=True, count=200):
    points, spacing = sphere_points(count)
    parts = tiles(points + np.array([shift, 0.0, 0.0]), points, spacing)
    return cloud_of(
        parts,
        radiance=np.full((count, 1, 3), 0.3),
        radiance_color_space=DISPLAY_SRGB,
        ids=np.arange(count) if ids else None,
    )


def frames(*shifts, ids=True, metadata=None):
    return GaussianSequence.from_clouds([frame(shift, ids) for shift in shifts], metadata=metadata)


@pytest.fixture(scope="module")
def light():
    return EnvironmentMap.constant((1.0, 0.9, 0.8), height=16)


@pytest.fixture(scope="module")
def whole(light, tmp_path_factory):
    """A job of three frames, done without a stop. Read only."""
    return job(frames(0.0, 0.1, 0.2), light, tmp_path_factory.mktemp("whole") / "out", AUTO)


def folder_bytes(folder):
    """Bytes of all files but those that hold times: the report, receipts, and what is known of a capture's files."""
    files = {path.relative_to(folder): path for path in folder.rglob("*") if path.is_file()}
    return {
        p: f.read_bytes()
        for p, f in files.items()
        if p.name != "report.json" and p.parts[0] not in ("digests", "plan", "steps")
    }


def test_everything_is_written_valid_and_readable(whole):
    assert validate(whole.asset).is_valid
    cloud = read(whole.asset)[0]
    assert cloud.is_relightable
    assert cloud.axes == "rub"
    assert cloud.base_color_error is not None
    assert cloud.observability is not None
    assert np.allclose(cloud.roughness, 0.5)
    report = json.loads((whole.asset.parent / "report.json").read_text())
    assert report["materials"]["gaussians"] == 200
    # Every point of a convex body is open: 8 rays for occlusion and, as nothing is noisy, 4 for light, in three frames
    rays = report["light_and_occlusion_rays_per_second"] * report["seconds"]["materials"]
    assert rays == pytest.approx(3 * 200 * (8 + 4))
    assert report["device"]["kind"] == "cpu"
    assert read_image(whole.overview).width > 48
    assert report["exposure_is_fitted"]
    assert report["light"] == f"the given light, exposure fitted by {report['exposure_stops']:+.1f} stops"


@pytest.mark.parametrize(
    ("stops", "title"), [(0.0, "relit by the given light"), (1.5, "relit by the given light, exposed by +1.5 stops")]
)
def test_a_relighting_says_which_light_it_shows(tmp_path, light, monkeypatch, stops, title):
    """Nobody knows the light of Gaussians without images: the overview does not claim it."""
    titles = []

    def sheet(cloud, camera, lights, **options):
        titles.extend(shown.title for shown in lights)
        return np.zeros((8, 8, 3), np.uint8)

    monkeypatch.setattr("beam_warp.render.sheet.contact_sheet", sheet)
    job(frames(0.0), light, tmp_path / "out", replace(FAST, exposure=stops))
    assert titles == [title, "relit by that light turned by 180°"]


def test_it_is_drawn_as_its_metadata_say(tmp_path, light, whole):
    stated = {"raster_antialiased": "true", "raster_low_pass": "4.0", "capture_frames": "7"}
    said = job(frames(0.0, metadata=stated), light, tmp_path / "out")
    assert read(said.asset).metadata.items() >= stated.items()
    assert not [key for key in read(whole.asset).metadata if key.startswith("raster")]
    for result, options in ((said, RasterOptions(antialiased=True, low_pass=4.0)), (whole, RasterOptions())):
        cloud = result.sequence[len(result.sequence) // 2]
        extent = np.ptp(cloud.positions, axis=0)
        width = round(SMALL.height * float(np.hypot(extent[0], extent[1]) / extent[2]))  # panels are that wide
        camera = Camera.frame_cloud(
            cloud.positions, cloud.opacities, elevation=SMALL.elevation, width=width, height=SMALL.height
        )
        expected = contact_sheet(cloud, camera, [], options=options, device="cpu")
        # Captured colour is the first panel, whatever follows.
        top = MARGIN + TITLE_HEIGHT
        panel = np.s_[top : top + SMALL.height, MARGIN : MARGIN + width]
        drawn = np.rint(read_image(result.overview).rgb() * 255.0)
        np.testing.assert_array_equal(drawn[panel], expected[panel])


def test_progress_moves_within_a_frame_and_ends_full(tmp_path, light, monkeypatch):
    monkeypatch.setattr("beam_warp.trace.rays.RAYS_AT_ONCE", 8 * 50)
    said = []
    job(frames(0.0, 0.1), light, tmp_path / "out", progress=lambda *step: said.append(step))
    for stage, total in (("normals", 400), ("materials", 400), ("decompose", 2), ("overview", 1)):
        steps = [done for name, done, count in said if name == stage and count == total]
        assert steps == sorted(steps)
        assert steps[-1] == total
    assert len([1 for name, *_ in said if name == "materials"]) > 6


def stop_after(frame_count):
    """Progress that is interrupted once so many frames are decomposed."""

    def stop(stage, done, total):
        if (stage, done) == ("decompose", frame_count):
            raise KeyboardInterrupt

    return stop


def test_stopped_job_continues_to_identical_bytes(tmp_path, light, whole):
    sequence, out = frames(0.0, 0.1, 0.2), tmp_path / "out"
    with pytest.raises(KeyboardInterrupt):
        job(sequence, light, out, AUTO, progress=stop_after(2))
    assert not (out / "asset.usda").exists()
    assert job(sequence, light, out, AUTO).report["resumed_frames"] == 2
    assert folder_bytes(whole.asset.parent) == folder_bytes(out)


def test_other_input_options_or_code_start_over(tmp_path, light):
    out, given = tmp_path / "out", {"sequence": frames(0.0), "light": light, "options": FAST}
    job(out=out, **given)
    with pytest.raises(InvalidOptionError, match="environment must shed light"):  # what is kept is of another light
        job(out=out, **given | {"light": light.scaled(0.0)})
    for changed in (
        {"sequence": frames(0.5)},
        {"light": light.scaled(2.0)},
        {"options": replace(FAST, materials=MaterialOptions(sample_count=16))},
    ):
        given |= changed
        assert job(out=out, **given).report["resumed_frames"] == 0
    with changed_code():
        for resumed in (0, 1):
            found = job(out=out, **given).report
            assert found["resumed_frames"] == resumed
            assert found["versions"]["code"] == "another algorithm"


def test_persistent_frames_share_one_base_colour(tmp_path, light, whole):
    joint = whole.sequence
    assert joint.topology == "constant"
    assert "base_color" in joint.constant
    assert np.array_equal(joint[0].base_color, joint[1].base_color)
    assert not np.array_equal(joint[0].positions, joint[1].positions)
    separate = job(frames(0.0, 0.1, ids=False), light, tmp_path / "out").sequence
    assert separate.topology == "perFrame"
    assert "base_color" not in separate.constant


def test_colours_that_change_have_solutions_of_their_own(tmp_path, light, monkeypatch):
    """A tenth of the Gaussians blink; solutions are the same however many frames a step solves."""
    blinks, found = np.arange(200) < 20, {}
    clouds = [
        frame().with_arrays(radiance=np.where(blinks, 0.9 * (-1) ** number - 0.3, 0.3)[:, None, None] * np.ones((1, 3)))
        for number in range(5)
    ]
    for part in (2, 30):
        monkeypatch.setattr("beam_warp.decomposition.work.PART", part)
        found[part] = job(GaussianSequence.from_clouds(clouds), light, tmp_path / str(part))
    sequence, report = found[2].sequence, found[2].report
    assert report["materials"]["changing_part"] == pytest.approx(0.1)
    assert "base_color" not in sequence.constant
    change = np.abs(sequence[1].base_color - sequence[0].base_color).max(axis=1)
    assert (change[blinks] > 0.1).all()
    assert (change[~blinks] == 0.0).all()
    assert folder_bytes(tmp_path / "2") == folder_bytes(tmp_path / "30")


def test_the_image_path_needs_images(tmp_path, light):
    with pytest.raises(InvalidOptionError, match="capture must be given for the image path, got none"):
        job(frames(0.0), light, tmp_path / "out", RunOptions(images=ImagePathOptions()))
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("materials", "says"),
    [
        (MaterialOptions(sample_count=8, bounce=False), "got sample_count 8, bounce False. Drop them"),
        (MaterialOptions(), "got defaults"),
    ],
)
def test_one_path_alone_has_options(materials, says):
    with pytest.raises(InvalidOptionError, match=f"materials .* must be left out on the image path.*{says}"):
        RunOptions(materials=materials, images=ImagePathOptions())


def test_only_options_of_the_path_are_stated():
    direct = RunOptions().as_dict()
    assert direct["materials"] == vars(MaterialOptions())
    assert "images" not in direct
    paper = RunOptions(images=ImagePathOptions(seed=3)).as_dict()
    assert paper["images"] == vars(ImagePathOptions(seed=3))
    assert "materials" not in paper
    assert RunOptions(images=ImagePathOptions(seed=3)).gathering == MaterialOptions(seed=3)


@pytest.mark.parametrize("stops", [np.nan, 100.0])
def test_exposures_that_no_light_has(stops):
    with pytest.raises(InvalidOptionError, match="exposure must be"):
        RunOptions(exposure=stops)


def test_frames_without_radiance_or_gaussians_are_refused(tmp_path, light):
    bare = frame().with_arrays(radiance=None, radiance_color_space=None)
    for cloud, complaint in (
        (bare, "radiance must be given to decompose materials"),
        (frame().select(np.arange(0)), "a frame must hold at least one Gaussian"),
    ):
        with pytest.raises(InvalidArrayError, match=f"{complaint}, got none at frame 0"):
            job(GaussianSequence.from_clouds([cloud]), light, str(tmp_path / "out"))
        assert not (tmp_path / "out" / "asset.usda").exists()


def test_a_folder_that_cannot_be_made(tmp_path, light):
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(OutputError, match="output folder must be a folder, got"):
        job(frames(0.0), light, tmp_path / "file")


def test_roughness_from_a_texture(tmp_path, light):
    """A square of two triangles whose texture is rough on the left, smooth on the right."""
    import trimesh
    from PIL import Image

    values = np.full((8, 8), 51, np.uint8)
    values[:, :4] = 204
    Image.fromarray(values).save(tmp_path / "rough.png")
    square = trimesh.Trimesh(
        vertices=[[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]],
        faces=[[0, 1, 2], [0, 2, 3]],
        visual=trimesh.visual.TextureVisuals(uv=[[0, 0], [1, 0], [1, 1], [0, 1]]),
        process=False,
    )
    square.export(tmp_path / "square.obj")
    options = replace(FAST, roughness=RoughnessTexture(tmp_path / "rough.png", tmp_path / "square.obj"))
    cloud = job(frames(0.0), light, tmp_path / "out", options).sequence[0]
    clear = np.abs(cloud.positions[:, 0]) > 0.2
    expected = np.where(cloud.positions[:, 0] < 0.0, 0.8, 0.2)
    assert np.allclose(cloud.roughness[clear], expected[clear], atol=1e-6)


def bare(cloud, step=4):
    """Some of the discs, larger, as a reconstruction would know them: without materials."""
    cloud = cloud.select(np.arange(0, len(cloud), step))
    unknown = dict.fromkeys(("base_color", "roughness", "ambient_occlusion", "normals"))
    return cloud.with_arrays(**unknown, scales=np.tile(np.float32([0.02, 0.02, 0.002]), (len(cloud), 1)))


@pytest.fixture(scope="module")
def figure():
    return figure_asset(64, 2, metadata={"capture_frames": "0 1"})


@pytest.fixture(scope="module")
def discs(figure):
    """A twelfth of them: enough for all that does not look at colours."""
    return GaussianSequence.from_clouds([bare(cloud, 12) for cloud in figure], metadata=figure.metadata)


@pytest.fixture(scope="module")
def studio(tiny_capture):
    return EnvironmentMap.read(tiny_capture.environment_path).resized(16, 32)


@pytest.fixture(scope="module")
def capture(tiny_capture):
    """Two cameras of the capture."""
    records = tuple(r for r in tiny_capture.records if r.camera_name in ("train_00", "train_03"))
    return replace(tiny_capture, records=records)


@pytest.fixture(scope="module")
def done(discs, studio, capture, tmp_path_factory):
    """The folder of a job of two frames. Read only."""
    out = tmp_path_factory.mktemp("done") / "out"
    job(discs, studio, out, capture=capture)
    return out


@pytest.mark.usefixtures("coarse_irradiance", "trusted_files")
class TestWithACapture:
    """Discs on the demo figure, decomposed by the images of its capture."""

    def test_it_finds_the_materials(self, figure, studio, tiny_capture, tmp_path):
        many = GaussianSequence.from_clouds([bare(cloud) for cloud in figure], metadata=figure.metadata)
        result = job(many, studio, tmp_path / "out", AUTO, capture=tiny_capture)
        assert validate(result.asset).is_valid
        back = read(result.asset)
        assert back.metadata["capture_frames"] == "0 1"
        assert back.metadata["roughness_source"] == "constant"
        assert back.metadata["radiance_meaning"] == "captured"
        assert result.report["exposure_stops"] == 0.0
        assert not result.report["exposure_is_fitted"]
        assert result.report["light"] == "the light of the capture"
        # discs of the true surface, some left out, cover less than the figure does
        assert all("silhouettes" in warning for warning in result.report["warnings"])
        cloud = result.sequence[0]
        measured = cloud.observability == 0
        assert 0.5 < measured.mean() < 1.0  # some discs lie where no camera looks
        filled = (cloud.observability & np.uint8(Observability.FILLED)) != 0
        unseen = (cloud.observability & np.uint8(Observability.UNSEEN)) != 0
        assert filled[unseen].all()
        without_evidence = Observability.UNSEEN | Observability.UNLIT | Observability.GRAZING
        assert ((cloud.observability[filled] & np.uint8(without_evidence)) != 0).all()
        error = np.abs(cloud.base_color - figure[0].base_color[::4])[measured]
        stated = cloud.base_color_error[measured]
        assert np.median(error) < 0.1
        # images of 64 pixels and 8 rays: what is stated must hold, whatever it is
        assert (error < 2.0 * stated + 0.04).mean() > 0.9
        cosine = (cloud.normals * figure[0].normals[::4]).sum(axis=1)[measured]
        assert np.median(cosine) > np.cos(np.radians(20.0))

    @pytest.mark.slow
    def test_threads_do_not_change_a_byte(self, discs, studio, tiny_capture, tmp_path, monkeypatch):
        found = []
        for threads in ("1", "3"):
            monkeypatch.setenv("BEAM_WARP_THREADS", threads)
            job(discs, studio, tmp_path / threads, AUTO, capture=tiny_capture)
            found.append(folder_bytes(tmp_path / threads))
        assert found[0] == found[1]

    def test_stopped_job_continues_to_identical_bytes(self, discs, studio, capture, done, tmp_path):
        with pytest.raises(KeyboardInterrupt):
            job(discs, studio, tmp_path / "out", FAST, capture=capture, progress=stop_after(1))
        assert job(discs, studio, tmp_path / "out", FAST, capture=capture).report["resumed_frames"] == 1
        assert folder_bytes(done) == folder_bytes(tmp_path / "out")

    def test_what_results_depend_on_starts_over(self, discs, studio, capture, done, tmp_path):
        """A frame's images, how splats are drawn, whether there are images at all."""
        out, file = tmp_path / "out", tmp_path / "darker.exr"
        shutil.copytree(done, out)
        changed = next(r for r in capture.records if r.frame == 1)
        write_exr(file, {name: values * np.float32(0.5) for name, values in changed.image().channels.items()})
        records = tuple(replace(r, image_path=file) if r is changed else r for r in capture.records)
        darker = replace(capture, records=records)
        assert job(discs, studio, out, capture=darker).report["resumed_frames"] == 1
        drawn = replace(discs, metadata=discs.metadata | {"raster_antialiased": "true", "raster_low_pass": "0.1"})
        assert job(drawn, studio, out, capture=darker).report["resumed_frames"] == 0
        assert job(drawn, studio, out).report["resumed_frames"] == 0

    def test_gaussians_of_every_frame_their_own(self, discs, studio, capture, tmp_path):
        apart = [cloud.with_arrays(ids=None) for cloud in discs]
        sequence = GaussianSequence.from_clouds([apart[0], apart[1].select(np.arange(300))], metadata=discs.metadata)
        found = job(sequence, studio, tmp_path / "out", capture=capture).sequence
        assert found.topology == "perFrame"
        assert [len(cloud) for cloud in found] == [500, 300]

    def test_some_frames_of_a_capture(self, discs, tiny_capture):
        """The frames that the sequence names are read, not those in the same place."""
        second = GaussianSequence.from_clouds([discs[1]], metadata={"capture_frames": "1"})
        views = CaptureImages(tiny_capture, second).views(0)
        expected = [record.view() for record in tiny_capture.select(split="train", frames={1})]
        assert len(views) == len(expected) == 6
        assert all(np.array_equal(a.color, b.color) for a, b in zip(views, expected, strict=True))

    def test_missing_images_are_left_out(self, discs, tiny_capture):
        """Reconstruction leaves them out, so the materials of the same capture must be found without them, too."""
        gone = replace(tiny_capture.records[0], image_path=tiny_capture.folder / "gone.exr")
        images = CaptureImages(replace(tiny_capture, records=(gone, *tiny_capture.records[1:])), discs)
        assert [len(images.views(index)) for index in range(2)] == [5, 6]
        assert images.notes == [f"1 image missing, left out: {gone.name}"]
        assert images.scale_errors() == (0.0, 0.0, 0.0)

    def test_differences_between_cameras_are_an_error_of_the_scale(self, discs, tiny_capture):
        gains = [(1.0 + 0.1 * (k % 2), 1.0, 1.0) for k in range(len(tiny_capture.records))]
        matched = [replace(record, gains=gain) for record, gain in zip(tiny_capture.records, gains, strict=True)]
        red, green, blue = CaptureImages(replace(tiny_capture, records=tuple(matched)), discs).scale_errors()
        assert green == blue == 0.0
        assert 0.05 < red < 0.06  # of six cameras: half of log 1.1, times the root of 6 / 5 and of 7 / 6

    def test_images_without_a_scale_ask_for_an_exposure(self, discs, studio, capture, tmp_path):
        """8-bit images carry no scale: the same light four times as bright gives the same base colour.

        In one folder: the exposure that was found for the one light is not that of the other.
        """
        assert not CaptureImages(capture, discs).is_display_referred(0)
        records = tuple(replace(record, color_space=DISPLAY_SRGB) for record in capture.records)
        display = replace(capture, records=records, environment_path=None)
        images = CaptureImages(display, discs)
        assert images.ceiling(0, images.views(0)) == 1.0
        one = GaussianSequence.from_clouds([discs[0]], metadata={"capture_frames": "0"})
        plain, brighter = (
            job(one, studio.scaled(scale), tmp_path / "out", AUTO, capture=display) for scale in (1.0, 4.0)
        )
        # candidates are a sixteenth of a stop apart
        difference = plain.report["exposure_stops"] - brighter.report["exposure_stops"]
        assert difference == pytest.approx(2.0, abs=1.5 / 16.0)

    @pytest.mark.parametrize("turns", [True, False])
    def test_a_light_that_is_askew(self, discs, studio, capture, tmp_path, monkeypatch, turns):
        """Turned, as all that shows the light says; or kept, as a finding says with the remedy."""
        monkeypatch.setattr("beam_warp.decomposition.capture_light.find_turn", lambda *_: LightTurn(6.0, 1.25))
        monkeypatch.setattr("beam_warp.decomposition.capture_light.judge_light", lambda *_: LightCheck(point_count=64))
        one = GaussianSequence.from_clouds([discs[0]], metadata={"capture_frames": "0"})
        found = job(one, studio, tmp_path / "out", replace(AUTO, turn_light=turns), capture=capture)
        expected = studio.rotated(6.0) if turns else studio
        np.testing.assert_array_equal(found.environment.radiance, expected.radiance)
        turned_by = 6.0 if turns else 0.0
        assert found.report["light_turn"] == {"degrees": 6.0, "standard_error": 1.25, "turned_by": turned_by}
        metadata = read(found.asset).metadata
        assert metadata["light_turn_degrees"] == f"{turned_by:.4f}"
        assert metadata["base_color_scale_errors"] == "0.0000 0.0000 0.0000"
        assert found.report["base_color_scale_errors"] == [0.0, 0.0, 0.0]
        assert ("turned by +6.0 degrees" in found.report["light"]) == turns
        said = next(text for text in found.report["warnings"] if "up axis" in text)
        assert "+6.0 ± 1.2 degrees" in said
        assert ("--no-turn-light" if turns else "--rotate +6.0") in said

    @pytest.mark.parametrize("what", ["black", "elsewhere", "transparent", "single"])
    def test_what_cannot_be_decomposed_is_refused_at_once(self, discs, studio, capture, tmp_path, what):
        """Without light, or where the images show something else, nothing is measured and no asset is left."""
        cloud, light, complaint = discs[0], studio, "sequence must show what the capture shows"
        if what == "black":
            light, complaint = EnvironmentMap.constant((0.0, 0.0, 0.0), height=32), "environment must shed light"
        elif what == "elsewhere":
            cloud = cloud.with_arrays(positions=cloud.positions + np.float32([0.0, 0.0, 50.0]))
        elif what == "transparent":
            cloud = cloud.with_arrays(opacities=np.full(len(cloud), 0.002, np.float32))
        else:
            cloud = cloud.select(np.arange(1))
        sequence = GaussianSequence.from_clouds([cloud], metadata={"capture_frames": "0"})
        with pytest.raises(InvalidOptionError, match=complaint):
            job(sequence, light, tmp_path / "out", AUTO, capture=capture)
        assert not (tmp_path / "out" / "asset.usda").exists()

    @pytest.mark.slow
    def test_the_image_path_follows_its_first_frame(self, discs, studio, capture, tmp_path, monkeypatch):
        """Colours are drawn towards those of the frame before: when that frame changes, the next is done again."""
        images = ImagePathOptions(occlusion_samples=4, light_samples=8)
        options = replace(FAST, materials=None, images=images)
        traced = []

        def counted(*arguments, **more):
            found = decompose_by_images(*arguments, **more)
            traced.append(found.ray_count)
            return found

        monkeypatch.setattr("beam_warp.materials.images.decompose_by_images", counted)
        darker = discs[0].with_arrays(opacities=discs[0].opacities * np.float32(0.5))
        changed = GaussianSequence.from_clouds([darker, discs[1]], metadata=discs.metadata)
        for sequence, resumed in ((discs, 0), (discs, 2), (changed, 0)):
            report = job(sequence, studio, tmp_path / "out", options, capture=capture).report
            assert report["resumed_frames"] == resumed
            rate, seconds = report["light_and_occlusion_rays_per_second"], report["seconds"].get("materials")
            assert rate == (None if resumed == 2 else pytest.approx(sum(traced[-2:]) / seconds))
        # both frames show the subject to two cameras, and each of its pixels sends 4 + 8 rays
        assert all(count > 0 and count % 12 == 0 for count in traced)
        assert report["options"]["images"]["light_samples"] == 8
        assert "materials" not in report["options"]
