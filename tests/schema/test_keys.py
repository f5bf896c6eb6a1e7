"""Keyed assets: keys of known motions, bounds that hold in every frame as it is read, rows that are never blended."""

import tracemalloc

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from pxr import Usd, Vt
from scipy.spatial.transform import Rotation
from support.radiant_cloud import radiant_cloud

from beam_warp.errors import InvalidOptionError
from beam_warp.schema import reader, register
from beam_warp.schema.keys import departure, key_times
from beam_warp.schema.layout import to_vt
from beam_warp.schema.reader import read_asset
from beam_warp.schema.stage_queries import clip_sets, frame_times, sample_times
from beam_warp.schema.validation.mending import mend_stage
from beam_warp.schema.validation.validator import validate_stage
from beam_warp.schema.writer import write_asset
from beam_warp.world.gaussians import GaussianSequence

BOUNDS = {"positions": 0.02, "orientations": 0.1, "scales": 0.1, "ambient_occlusion": 0.1, "normals": 0.2}


def keys(values, bound, name="positions", type_name="point3f[]"):
    """Keys of an array, one value a frame."""
    register()
    return key_times(name, type_name, {float(t): to_vt(type_name, value) for t, value in enumerate(values)}, bound)


def along(places):
    """Positions of a Gaussian that is at some places of the x axis, one a frame."""
    return [np.array([[place, 0.0, 0.0]], np.float32) for place in places]


class TestKnownMotions:
    def test_a_straight_way_has_two_keys(self):
        assert keys(along(0.25 * np.arange(30)), 0.0) == [0.0, 29.0]

    def test_a_corner_is_a_key(self):
        assert keys(along(0.25 * np.abs(np.arange(30) - 12.0)), 1e-6) == [0.0, 12.0, 29.0]

    @pytest.mark.parametrize(("bound", "run"), [(0.49, 1), (0.5, 2), (0.99, 2), (1.0, 3), (2.0, 4), (12.5, 10)])
    def test_a_fall_has_keys_as_far_apart_as_its_curvature_lets_them_be(self, bound, run):
        # Of t²/2, a chord over n frames is off by k (n - k) / 2 at frame k: n²/8 in the middle, for odd n (n² - 1)/8.
        expected = [*np.arange(0.0, 28.0, run), 28.0]
        assert keys(along(0.5 * np.arange(29.0) ** 2), bound / np.sqrt(3.0)) == expected  # of one component of three

    def test_what_spins_evenly_has_two_keys(self):
        spun = [Rotation.from_euler("y", [0.1 * frame]).as_quat().astype(np.float32) for frame in range(20)]
        assert keys(spun, 1e-5, "orientations", "quatf[]") == [0.0, 19.0]

    def test_turns_by_more_than_half_a_circle_are_not_made_the_short_way(self):
        spun = [Rotation.from_euler("y", [0.4 * frame]).as_quat().astype(np.float32) for frame in range(20)]
        found = keys(spun, 0.01, "orientations", "quatf[]")
        assert max(np.diff(found)) * 0.4 < np.pi
        assert len(found) < 5

    def test_integers_are_held(self):
        flags = [np.array([4 if frame < 7 else 9], np.uint8) for frame in range(12)]
        assert keys(flags, 0.0, "observability", "uchar[]") == [0.0, 7.0, 11.0]

    def test_counts_that_change_are_not_blended(self):
        grown = [np.zeros((3 if frame < 5 else 4, 3), np.float32) for frame in range(10)]
        assert keys(grown, 1e9) == [0.0, 5.0, 9.0]  # OpenUSD holds what it cannot blend

    def test_normals_that_turn_round_are_not_blended_to_nothing(self):
        turned = [np.array([[0.0, 0.0, 1.0 if frame < 2 else -1.0]], np.float32) for frame in range(3)]
        assert keys(turned, 1e9, "normals", "normal3f[]") == [0.0, 1.0, 2.0]

    @pytest.mark.parametrize("frames", [1, 2])
    def test_ends_are_keys(self, frames):
        assert keys(along(np.arange(frames)), 1e9) == [*map(float, range(frames))]


class TestDeparture:
    def test_the_mean_square_of_components_counts(self):
        off = np.zeros((4, 3), np.float32)
        off[2, 1] = 0.5
        assert departure("positions", off, np.zeros((4, 3), np.float32)) == pytest.approx(0.5 / np.sqrt(12.0))

    def test_scales_are_relative_and_a_disc_stays_one(self):
        one = np.ones((2, 3), np.float32)
        assert departure("scales", 1.1 * one, one) == pytest.approx(0.1, rel=1e-5)
        assert departure("scales", 0.0 * one, 0.0 * one) == 0.0
        assert departure("scales", one, 0.0 * one) == np.inf

    @pytest.mark.parametrize("angle", [1e-4, 0.1, 3.0])
    def test_angles(self, angle):
        quaternion = Rotation.from_rotvec([[0.0, angle, 0.0]]).as_quat().astype(np.float32)
        still = np.array([[0.0, 0.0, 0.0, -1.0]], np.float32)  # the same rotation as its negative
        assert departure("orientations", 1.001 * quaternion, still) == pytest.approx(angle, rel=1e-3)
        normal = np.array([[np.sin(angle), 0.0, np.cos(angle)]], np.float32)
        assert departure("normals", 0.9 * normal, np.float32([[0.0, 0.0, 1.0]])) == pytest.approx(angle, rel=1e-3)


def take(frames, *, noise=0.0, turn=0.05, seed=0):
    """A cloud that turns about y and swings, with occlusion and normals that shake."""
    rng = np.random.default_rng(seed)
    base = radiant_cloud(6, 1, materials=True, seed=seed, ids=np.arange(6), axes="rub")
    clouds = []
    for frame in range(frames):
        way = Rotation.from_rotvec([0.0, turn * frame, 0.0])
        normals = way.apply(base.normals) + noise * rng.normal(size=(6, 3))
        clouds.append(
            base.with_arrays(
                positions=way.apply(base.positions) + np.array([0.0, 0.3 * np.sin(0.4 * frame), 0.0]),
                orientations=(way * Rotation.from_quat(base.orientations)).as_quat(),
                normals=normals / np.linalg.norm(normals, axis=1, keepdims=True),
                ambient_occlusion=np.clip(base.ambient_occlusion + noise * rng.normal(size=6), 0.0, 1.0),
                scales=base.scales * (1.0 + 0.002 * frame),
            )
        )
    return GaussianSequence.from_clouds(clouds, frames_per_second=24.0)


def splats(path):
    stage = Usd.Stage.Open(str(path))
    return stage, stage.GetPrimAtPath("/Asset/Splats")


def assert_within(found, wanted, bounds):
    """Every array of every frame is within its bound; what has no bound is the same."""
    assert len(found) == len(wanted)
    for frame in range(len(found)):
        got, true = found[frame].arrays(), wanted[frame].arrays()
        assert got.keys() == true.keys()
        for name, array in true.items():
            # The reader normalises in single precision what was compared before.
            assert departure(name, got[name], array) <= bounds.get(name, 0.0) * (1.0 + 1e-4), (frame, name)


@settings(max_examples=25, deadline=None)
@given(
    frames=st.integers(2, 20),
    noise=st.sampled_from([0.0, 0.05, 1.0]),
    turn=st.floats(-1.5, 1.5),
    seed=st.integers(0, 99),
    scale=st.sampled_from([0.0, 0.1, 1.0, 8.0]),
    length=st.integers(1, 25),
    full_float=st.booleans(),
)
@example(frames=12, noise=0.0, turn=0.0, seed=1, scale=8.0, length=5, full_float=False)
@example(frames=6, noise=0.0, turn=0.0, seed=99, scale=0.1, length=1, full_float=False)  # as halves, scales leave
def test_every_frame_is_within_its_bounds(tmp_path_factory, frames, noise, turn, seed, scale, length, full_float):
    folder, bounds = tmp_path_factory.mktemp("keys"), {name: scale * bound for name, bound in BOUNDS.items()}
    how = {"full_float": full_float, "segment_length": length}
    source = take(frames, noise=noise, turn=turn, seed=seed)
    write_asset(source, folder / "all.usdc", **how)
    write_asset(source, folder / "keys.usdc", bounds=bounds, **how)
    found = read_asset(folder / "keys.usdc", trusted=True)
    assert_within(found, read_asset(folder / "all.usdc", trusted=True), bounds)
    stage, prim = splats(folder / "keys.usdc")
    report = validate_stage(stage)
    assert report.findings == ()
    assert report.frames == (frames if sample_times(prim) else 1)


class TestFiles:
    @pytest.mark.parametrize("name", ["a.usda", "a.usdc", "a.usdz"])
    @pytest.mark.parametrize("frames", [24, 65])
    def test_keys_are_few_and_frames_are_as_many(self, tmp_path, name, frames):
        source = take(frames)
        (tmp_path / "all").mkdir()
        write_asset(source, tmp_path / "all" / name)
        write_asset(source, tmp_path / name, bounds=BOUNDS)
        found, every = (read_asset(folder / name, trusted=True) for folder in (tmp_path, tmp_path / "all"))
        assert (found.topology, found.frames_per_second) == ("constant", 24.0)
        assert_within(found, every, BOUNDS)
        stage, prim = splats(tmp_path / name)
        assert prim.GetAttribute("orientationsh").GetNumTimeSamples() <= 2 * np.ceil(frames / 30)  # it spins evenly
        assert 2 < prim.GetAttribute("positions").GetNumTimeSamples() < frames / 1.5
        assert prim.GetAttribute("extent").GetNumTimeSamples() == frames
        assert validate_stage(stage).findings == ()

    def test_a_clip_is_read_without_the_others(self, tmp_path):
        write_asset(take(65), tmp_path / "a.usda", bounds=BOUNDS)
        stage, prim = splats(tmp_path / "a.usda")
        (clips,) = clip_sets(prim)
        assert [start for start, _ in clips.active] == [0.0, 30.0, 60.0]
        for frame in range(65):
            clip = Usd.Stage.Open(clips.paths[frame // 30])
            alone = clip.GetPrimAtPath("/Asset/Splats")
            for name in ("positions", "orientationsh", "beam:normalsh", "extent"):
                assert np.array_equal(alone.GetAttribute(name).Get(frame), prim.GetAttribute(name).Get(frame)), name
        del stage

    def test_clips_are_blended_into_each_other(self, tmp_path):
        write_asset(take(65), tmp_path / "a.usda", bounds=BOUNDS)
        stage, prim = splats(tmp_path / "a.usda")
        before, between, after = (np.asarray(prim.GetAttribute("positions").Get(time)) for time in (29.0, 29.5, 30.0))
        np.testing.assert_allclose(between, 0.5 * (before + after), atol=1e-6)  # roundings of coordinates of about 3
        assert not np.array_equal(before, after)
        del stage

    def test_what_never_leaves_its_bound_is_written_once(self, tmp_path):
        write_asset(take(12, noise=1e-3), tmp_path / "a.usdc", bounds=BOUNDS | {"normals": 2.0})
        stage, prim = splats(tmp_path / "a.usdc")
        still = [prim.GetAttribute(name) for name in ("beam:ambientOcclusionh", "primvars:normals", "scalesh")]
        assert [attribute.GetNumTimeSamples() for attribute in still] == [0, 0, 0]
        assert all(attribute.HasAuthoredValue() for attribute in still)
        assert "normals" in read_asset(tmp_path / "a.usdc", trusted=True).constant
        del stage

    def test_the_asset_says_that_it_has_keys_and_their_bounds(self, tmp_path):
        write_asset(take(12), tmp_path / "a.usdc", bounds=BOUNDS)
        write_asset(take(12), tmp_path / "b.usdc")
        stage, prim = splats(tmp_path / "a.usdc")
        said = {name: prim.GetAttribute(name).GetCustomDataByKey("beam") for name in ("positions", "opacitiesh")}
        assert said == {"positions": {"keyedWithin": 0.02}, "opacitiesh": {"keyedWithin": 0.0}}
        assert stage.GetPrimAtPath("/Asset").GetAttribute("beam:sequence:sampling").Get() == "keyed"
        other, plain = splats(tmp_path / "b.usdc")
        assert plain.GetAttribute("positions").GetCustomDataByKey("beam") is None
        assert other.GetPrimAtPath("/Asset").GetAttribute("beam:sequence:sampling").Get() == "everyFrame"

    def test_rows_that_are_not_the_same_gaussian_are_never_blended(self, tmp_path):
        clouds = [cloud.with_arrays(ids=None) for cloud in take(12)]
        with pytest.raises(InvalidOptionError, match="bounds of keys must go with a constant topology, got perFrame"):
            write_asset(GaussianSequence.from_clouds(clouds), tmp_path / "a.usdc", bounds=BOUNDS)
        assert [*tmp_path.iterdir()] == []

    def test_the_box_of_every_frame_holds_its_kernels(self, tmp_path):
        write_asset(take(20), tmp_path / "a.usdc", bounds={name: 4.0 * bound for name, bound in BOUNDS.items()})
        stage, prim = splats(tmp_path / "a.usdc")
        found = read_asset(tmp_path / "a.usdc", trusted=True)
        for frame, cloud in enumerate(found):
            low, high = np.asarray(prim.GetAttribute("extent").Get(frame))
            turned = Rotation.from_quat(cloud.orientations).as_matrix()
            reach = 3.0 * np.linalg.norm(turned * cloud.scales[:, None], axis=2)
            assert (cloud.positions >= low).all()
            assert (cloud.positions <= high).all()
            assert (cloud.positions - reach >= low - 0.1 * reach).all()  # axes are blended, too, by these bounds
            assert (cloud.positions + reach <= high + 0.1 * reach).all()
        del stage

    def test_a_colour_that_changes_is_keyed_in_the_variant_of_albedo(self, tmp_path):
        clouds = [cloud.with_arrays(base_color=np.full((6, 3), 0.1 + 0.02 * k)) for k, cloud in enumerate(take(20))]
        write_asset(
            GaussianSequence.from_clouds(clouds),
            tmp_path / "a.usda",
            bounds=BOUNDS | {"base_color": 0.002},
            lighting_variants=True,
        )
        stage, prim = splats(tmp_path / "a.usda")
        stage.GetPrimAtPath("/Asset").GetVariantSet("lighting").SetVariantSelection("albedo")
        assert prim.GetAttribute("radiance:sphericalHarmonicsCoefficientsh").GetTimeSamples() == [0.0, 19.0]
        shown = 0.5 + 0.28209479 * np.asarray(prim.GetAttribute("radiance:sphericalHarmonicsCoefficientsh").Get(7))
        assert np.abs(shown - 0.24).max() < 0.002


def test_a_key_is_mended_and_others_stay(tmp_path):
    write_asset(take(30), tmp_path / "a.usdc", bounds=BOUNDS)
    stage, prim = splats(tmp_path / "a.usdc")
    attribute = prim.GetAttribute("orientationsh")
    times, last = attribute.GetTimeSamples(), np.asarray(attribute.Get(29))
    attribute.Set(Vt.QuathArray.FromNumpy((0.75 * last).astype(np.float16)), 29)
    report = mend_stage(stage)
    assert [found.rule for found in report.mended] == ["BEAM-GEO-012"]
    assert report.findings == ()
    assert attribute.GetTimeSamples() == times
    assert departure("orientations", np.asarray(attribute.Get(29)), last) < 2e-3  # rounding to half


@pytest.mark.parametrize(
    ("times", "topology"), [([0.0, 1.0], "constant"), ([0.0, 1.5, 2.0], "constant"), ([0.0, 2.0], "perSegment")]
)
def test_keys_that_say_too_little_are_told(asset, times, topology):
    asset.prepare("BEAM-SEQ-010")
    asset.root.GetAttribute("beam:sequence:topology").Set(topology)
    attribute = asset.splats.GetAttribute("beam:ambientOcclusionh")
    values = {time: attribute.Get(time) for time in times}
    attribute.Clear()
    for time, value in values.items():
        attribute.Set(value, time)
    assert asset.rules() == ["BEAM-SEQ-010"]


def test_samples_that_are_far_apart_make_no_frames(asset):
    """A few bytes could claim so many frames that nobody ends reading them."""
    asset.prepare("BEAM-SEQ-010")
    for name in ("positions", "beam:ambientOcclusionh"):
        asset.splats.GetAttribute(name).Set(asset.splats.GetAttribute(name).Get(0), 1e9)
    assert frame_times(asset.splats) == [0.0, 1.0, 2.0, 1e9]
    assert "BEAM-SEQ-010" in asset.rules()


def test_one_segment_is_in_memory_at_once(tmp_path):
    """Three times the frames; so many Gaussians that times of samples, which grow with frames, are little beside."""

    def lazy(frames):
        rows, ids = np.arange(300) % 6, np.arange(300)
        some = [cloud.select(rows).with_arrays(ids=ids) for cloud in take(10)]
        return GaussianSequence(frame_count=frames, read_frame=lambda k: some[k % 10], topology="constant")

    peaks = []
    write_asset(lazy(20), tmp_path / "warm.usdc", bounds=BOUNDS)
    for frames in (65, 195):
        tracemalloc.start()
        write_asset(lazy(frames), tmp_path / "a.usda", segment_length=10, bounds=BOUNDS)
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[1] < 1.2 * peaks[0]


def test_a_reader_of_1_2_reads_the_same_frames(tmp_path, monkeypatch):
    write_asset(take(30), tmp_path / "a.usdc", bounds=BOUNDS)
    found = list(read_asset(tmp_path / "a.usdc", trusted=True))
    monkeypatch.setattr(reader, "frame_times", sample_times)  # it took samples for frames, unless frameCount differed
    before = read_asset(tmp_path / "a.usdc", trusted=True)
    assert len(before) == 30
    for cloud, same in zip(found, before, strict=True):
        assert np.array_equal(cloud.positions, same.positions)
        assert np.array_equal(cloud.orientations, same.orientations)
