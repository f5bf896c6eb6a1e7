"""Reduced assets: what the quadratic forms predict, targets, certificates that a validator repeats, refusals."""

from dataclasses import replace

import numpy as np
import pytest
from pxr import Usd
from scipy.spatial.transform import Rotation
from support.shapes import sphere_points

from beam_warp import converters
from beam_warp.cli.main import main as beam
from beam_warp.cli.reduce import bytes_of
from beam_warp.cli.validate import main as beam_validate
from beam_warp.demo.lights import demo_environments
from beam_warp.device.arrays import resolve_device
from beam_warp.errors import InvalidArrayError, InvalidOptionError
from beam_warp.evaluate.certificate import KEY, Certificate, asset_digest, measured_again
from beam_warp.evaluate.relit import RelitComparison, compared_options
from beam_warp.image.color import linear_to_srgb
from beam_warp.image.files import write_exr
from beam_warp.raster.rasterizer import Rasterizer
from beam_warp.raster.records import RasterOptions
from beam_warp.raster.sources import upload_gaussians
from beam_warp.reduction import job, sensitivity
from beam_warp.reduction.job import ReduceOptions, Reducer, reduce_asset
from beam_warp.reduction.refit import refit
from beam_warp.reduction.sensitivity import LIGHTS as EACH
from beam_warp.reduction.sensitivity import MATERIALS, material_rows
from beam_warp.render.deferred import DeferredRenderer
from beam_warp.world.gaussians import GaussianCloud, GaussianSequence
from beam_warp.world.quaternions import turns_from_z

RASTER = RasterOptions(antialiased=True)
LIGHTS = [demo_environments()["studio"].resized(16, 32), demo_environments()["stage"].resized(16, 32)]
QUICK = ReduceOptions(gaussians=60, height=32, views=4, steps=6, pairs=6, device="cpu")


def ball(count: int = 300, frames: int = 1, angle: float = 0.3) -> GaussianSequence:
    """A ball of Gaussians in two colours, which turns by an angle each frame."""
    still, spacing = sphere_points(count)
    facing = Rotation.from_quat(turns_from_z(still))
    clouds = []
    for frame in range(frames):
        turn = Rotation.from_rotvec([0.0, 0.0, angle * frame])
        normals = turn.apply(still)
        clouds.append(
            GaussianCloud(
                positions=normals + np.array([0.0, 0.0, 0.1 * frame]),
                orientations=(turn * facing).as_quat(),
                scales=np.tile([0.6 * spacing, 0.6 * spacing, 0.05 * spacing], (count, 1)),
                opacities=np.full(count, 0.95),
                base_color=np.where(still[:, 2:] > 0.2, [0.7, 0.2, 0.1], [0.1, 0.3, 0.6]),
                roughness=np.full(count, 0.6),
                ambient_occlusion=np.ones(count),
                normals=normals,
                ids=np.arange(count),
            )
        )
    return GaussianSequence.from_clouds(clouds, metadata=RASTER.as_metadata())


@pytest.fixture
def few_draws(monkeypatch):
    """A search that judges candidates by few draws."""
    monkeypatch.setattr(job, "TRIED", 4)


@pytest.fixture(scope="module")
def reducer() -> Reducer:
    return Reducer(ball(), LIGHTS, QUICK)


def test_quadratic_forms_predict_the_error_of_a_small_change(monkeypatch):
    # The twin draws both assets by the renderer, under the lights of one view that have no lamp. Forms of these lights
    # alone predict it; refits take the mean form of all pixels as a further light.
    monkeypatch.setattr(sensitivity, "MEAN_LIGHTS", 0.0)
    reducer = Reducer(ball(), LIGHTS, QUICK)
    view = reducer.sensitivity.views[0]
    cloud = reducer.original[0]
    changes = 0.01 * np.random.default_rng(0).normal(size=(len(cloud), 3))
    other = cloud.with_arrays(base_color=np.clip(cloud.base_color + changes, 0.0, 1.0))

    device = resolve_device("cpu")
    drawer = Rasterizer(len(cloud), [view.camera], value_count=MATERIALS, options=RASTER, device=device)
    images, slopes = drawer.draw(upload_gaussians(other, device, values=material_rows(other))), drawer.adjoints()
    view.slopes(images, slopes)
    away = images.channels[0].numpy() - view.target.numpy(), images.alpha.numpy() - view.alpha.numpy()
    predicted = 0.5 * (np.vdot(away[0], slopes.channels[0].numpy()) + np.vdot(away[1], slopes.alpha.numpy()))
    renderer, total = DeferredRenderer(compared_options(32), raster=RASTER, device="cpu"), 0.0
    trials = reducer.trials.draw("search", range(QUICK.views, QUICK.views + EACH), [0])
    for trial in trials:
        shots = (reducer.trials.shot(trial, each, cloud) for each in (cloud, other))
        lit = [
            replace(shot, camera=view.camera, lights=tuple(replace(lamp, casts_shadows=False) for lamp in shot.lights))
            for shot in shots
        ]
        images = [linear_to_srgb(np.clip(renderer.draw(shot).rgb, 0.0, 1.0)) for shot in lit]
        total += float(np.square(images[0] - images[1]).sum()) / EACH
    assert predicted == pytest.approx(total, rel=0.1)  # steps of 0.02 in colours of 0.1 and more: second order is small


def test_a_refit_brings_images_closer_and_merging_beats_leaving_out(reducer):
    comparison = RelitComparison(reducer.original, reducer.trials, device="cpu")
    draws = reducer.trials.draw("certificate", range(8), [0])
    fitted, merged = reducer.reduced(60), reducer.reduced(60, steps=0)
    some = reducer.original[0].select(np.random.default_rng(0).permutation(300)[:60])
    errors = [
        comparison.errors(each, draws, keep=True).psnr.mean()
        for each in (fitted, merged, GaussianSequence.from_clouds([some]))
    ]
    assert errors[0] > errors[1] > errors[2] + 3.0


@pytest.mark.slow
def test_the_same_call_gives_the_same_bits(reducer):
    again = Reducer(ball(), LIGHTS, QUICK)
    assert asset_digest(again.reduced(50)) == asset_digest(reducer.reduced(50))


@pytest.mark.parametrize("name", ["small.usda", pytest.param("small.b4d", marks=pytest.mark.slow)])
def test_a_moving_asset_is_certified_as_it_is_stored(name, tmp_path, few_draws):
    original = ball(200, frames=3)
    found = reduce_asset(original, LIGHTS, replace(QUICK, gaussians=40), tmp_path / name)
    back = converters.read(tmp_path / name)
    assert [len(cloud) for cloud in back] == [40, 40, 40]
    certificate = Certificate.of(back)
    assert certificate == found.certificate
    assert certificate.asset == asset_digest(back)
    if name.endswith("usda"):
        assert back.topology == "constant"
        held = measured_again(back, original, LIGHTS, device="cpu")
        assert held.passed, held
        spoiled = back[0].with_arrays(base_color=0.5 * back[0].base_color)
        changed = replace(back, read_frame=lambda frame: spoiled)
        assert measured_again(changed, original, LIGHTS, device="cpu").passed is False
        assert measured_again(back, None, LIGHTS, device="cpu").passed is None
        with pytest.raises(InvalidOptionError, match="original must be the certificate's"):
            measured_again(back, back, LIGHTS, device="cpu")


@pytest.mark.parametrize(("angle", "scale", "least"), [(0.01, 1.0, 2), (2.0, None, 8)])
def test_time_samples_are_keys_where_that_saves_space(tmp_path, few_draws, angle, scale, least):
    found = reduce_asset(ball(80, frames=8, angle=angle), LIGHTS, replace(QUICK, gaussians=40), tmp_path / "small.usda")
    assert found.error_scale == scale
    back = converters.read(tmp_path / "small.usda")
    assert (len(back), back.topology) == (8, "constant")
    assert found.certificate.asset == asset_digest(back)
    stage = Usd.Stage.Open(str(tmp_path / "small.usda"))
    samples = stage.GetPrimAtPath("/Asset/Splats").GetAttribute("positions").GetNumTimeSamples()
    assert least <= samples <= (8 if scale is None else 4)


@pytest.mark.slow
@pytest.mark.parametrize("angle", [0.05, 0.5])  # the second turns so fast that keys save little but where they are few
def test_a_bound_on_error_chooses_how_far_keys_are_apart(tmp_path, few_draws, monkeypatch, angle):
    monkeypatch.setattr(job, "ROUNDS", 2)
    original, scales = ball(120, frames=8, angle=angle), []
    for bound in (0.05, 0.4):
        options = replace(QUICK, gaussians=None, target_error=bound, confidence=0.5, pairs=70, steps=1)
        found = reduce_asset(original, LIGHTS, options, tmp_path / f"{bound}.usda")
        assert found.certificate.share >= job.SHARE
        scales.append(found.error_scale)
    assert scales[1] == job.SCALES[0]
    assert scales[0] is None or scales[0] <= scales[1]


@pytest.mark.slow
def test_a_size_is_kept(tmp_path, few_draws):
    original = ball()
    converters.write(original, tmp_path / "all.b4d")
    size = (tmp_path / "all.b4d").stat().st_size // 2
    options = replace(QUICK, gaussians=None, size=size, steps=2, views=3, pairs=4)
    found = reduce_asset(original, LIGHTS, options, tmp_path / "small.b4d")
    assert 0.8 * size < (tmp_path / "small.b4d").stat().st_size <= size + 2000  # the certificate is 1 KB of text
    assert found.count < 300


@pytest.mark.slow
@pytest.mark.parametrize("target", [{"max_loss": 6.0}, {"max_flip": 0.1}, {"target_error": 0.06}])
def test_a_certified_bound_holds_on_fresh_draws(target, tmp_path):
    original = ball(600)
    options = ReduceOptions(**target, height=48, views=16, steps=60, pairs=120, device="cpu")
    found = reduce_asset(original, LIGHTS, options, tmp_path / "small.usda")
    assert found.count < 500
    assert found.certificate.bound == options.bound
    reducer = Reducer(original, LIGHTS, replace(options, views=1))
    comparison = RelitComparison(original, reducer.trials, measure=options.measure, device="cpu")
    fresh = reducer.trials.draw("certificate", range(5000, 5300), [0])
    errors = comparison.errors(converters.read(tmp_path / "small.usda"), fresh).values(options.measure)
    kept = np.mean(errors <= found.certificate.bound)
    assert kept >= found.certificate.share - 3.0 * np.sqrt(0.05 * 0.95 / 300)


@pytest.mark.slow
def test_what_cannot_be_attained_is_refused_with_the_nearest_that_can(tmp_path, few_draws, monkeypatch):
    monkeypatch.setattr(job, "TRIES", 2)
    original, out = ball(60), tmp_path / "small.b4d"
    options = replace(QUICK, gaussians=None, max_flip=1e-6, confidence=0.5, pairs=45, steps=1)
    with pytest.raises(InvalidOptionError, match=r"max_flip must be at least [\d.e-]+ for this asset") as refused:
        reduce_asset(original, LIGHTS, options, out)
    assert not out.exists()
    nearest = float(str(refused.value).split()[5])
    found = reduce_asset(original, LIGHTS, replace(options, max_flip=nearest), out)
    assert found.certificate.share >= job.SHARE
    assert out.is_file()


@pytest.mark.parametrize(
    "targets",
    [
        {},
        {"max_loss": 1.0, "gaussians": 3},
        {"max_loss": 0.0},
        {"max_flip": 0.0},
        {"max_loss": float("nan")},
        {"size": 0},
        {"max_loss": 1.0, "pairs": 20},
        {"target_error": 0.0},
        {"target_error": 0.1, "target_fps": 30.0},
        {"target_fps": 0.0},
        {"gaussians": 3, "target_seconds": 0.0},
    ],
)
def test_targets_that_mean_nothing_are_refused(targets):
    with pytest.raises(InvalidOptionError, match="must be"):
        ReduceOptions(**targets)


def test_a_time_goes_with_a_number_of_gaussians():
    with pytest.raises(InvalidOptionError, match="target-seconds must go with gaussians, got max-loss"):
        ReduceOptions(max_loss=1.0, target_seconds=60.0)


def test_times_choose_gaussians_and_steps(few_draws, tmp_path, monkeypatch):
    """What is drawn so often is said as it was reached; steps of the refit are those that fit."""
    fast = reduce_asset(ball(), LIGHTS, replace(QUICK, gaussians=None, target_fps=1e-3), tmp_path / "fast.usda")
    assert fast.count == 300
    assert fast.fps is not None
    assert fast.fps > 1e-3
    monkeypatch.setattr(job, "steps_within", lambda seconds, spent, *_: 3 if spent > 7.0 else 0)
    steps = []
    monkeypatch.setattr(job, "refit", lambda *given, **how: steps.append(how["steps"]) or refit(*given, **how))
    found = reduce_asset(ball(), LIGHTS, replace(QUICK, target_seconds=1e3, spent=7.0), tmp_path / "timed.usda")
    assert set(steps) == {found.steps} == {3}


@pytest.mark.parametrize(("text", "count"), [("20MB", 20_000_000), ("1.5 kb", 1500), ("7", 7)])
def test_sizes_are_read(text, count):
    assert bytes_of(text) == count


@pytest.mark.parametrize("text", ["", "MB", "-3", "1e9", "nan", "20 apples"])
def test_what_is_no_size_is_refused(text):
    with pytest.raises(InvalidOptionError, match="size must be"):
        bytes_of(text)


def test_assets_that_cannot_be_reduced_are_refused(tmp_path):
    moving = ball(20, frames=2)
    uneven = GaussianSequence.from_clouds([moving[0], moving[1].select(range(19))])
    bare = GaussianSequence.from_clouds([moving[0].with_arrays(normals=None)])
    unknown = replace(moving, topology="perFrame")
    for asset, word in ((uneven, "20 in frame 0 and 19 in frame 1"), (bare, "materials"), (unknown, "topology")):
        with pytest.raises(InvalidArrayError, match=word):
            Reducer(asset, LIGHTS, QUICK)
    with pytest.raises(InvalidOptionError, match="out must be a file of USD or b4d"):
        reduce_asset(moving, LIGHTS, QUICK, tmp_path / "small.ply")


@pytest.mark.slow
def test_the_command_writes_what_the_validator_accepts(tmp_path, capsys, few_draws):
    converters.write(ball(), tmp_path / "all.usda")
    bright = LIGHTS[0].radiance
    write_exr(tmp_path / "light.exr", {name: bright[..., index] for index, name in enumerate("RGB")})
    words = f"--environment {tmp_path / 'light.exr'} --gaussians 60 --height 32 --views 4 --steps 4 --pairs 6".split()
    assert beam(["reduce", str(tmp_path / "all.usda"), "--out", str(tmp_path / "small.usda"), *words]) == 0
    assert "60 of 300 Gaussians" in capsys.readouterr().out
    assert KEY in converters.read(tmp_path / "small.usda").metadata
    words = [str(tmp_path / "small.usda"), "--physical", "--original", str(tmp_path / "all.usda")]
    beam_validate([*words, "--environment", str(tmp_path / "light.exr")])
    assert "holds   BEAM-PHYS-007" in capsys.readouterr().out
    assert beam(["reduce", str(tmp_path / "all.usda"), "--out", str(tmp_path / "small.usda")]) == 2
    assert capsys.readouterr().err.startswith("error: target must be one of")
