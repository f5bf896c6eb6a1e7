"""What lands on disk: files, precision, what is constant, stand-ins for plain viewers, and nothing after a failure."""

import tracemalloc

import numpy as np
import pytest
from pxr import Sdf, Usd

from beam_warp.errors import BeamError, InvalidArrayError, InvalidOptionError, OutputError
from beam_warp.schema import writer
from beam_warp.schema.writer import write_asset
from beam_warp.world.gaussians import GaussianSequence
from beam_warp.world.harmonics import SH_C0


@pytest.fixture
def open_splats():
    stages = []

    def open_one(path):
        stages.append(Usd.Stage.Open(str(path)))
        return stages[-1].GetPrimAtPath("/Asset/Splats")

    return open_one


def names(folder):
    return sorted(path.name for path in folder.iterdir())


@pytest.mark.parametrize(
    ("name", "frames", "files"),
    [
        ("a.usda", 1, ["a.static.usdc", "a.usda"]),
        ("a.usda", 3, ["a.frames.usdc", "a.usda"]),
        (
            "a.usda",
            70,
            ["a.000000.usdc", "a.000030.usdc", "a.000060.usdc", "a.manifest.usda", "a.static.usdc", "a.usda"],
        ),
        ("a.usdc", 70, ["a.usdc"]),
        ("a.usdz", 70, ["a.usdz"]),
    ],
)
def test_files(tmp_path, sequence, name, frames, files):
    written = write_asset(sequence(frames), tmp_path / name)
    assert names(tmp_path) == files
    assert sorted(path.name for path in written) == files
    assert written[-1].name == name


def test_text_layers_stay_small(tmp_path, sequence):
    write_asset(sequence(70, count=500), tmp_path / "a.usda")
    assert max(path.stat().st_size for path in tmp_path.glob("*.usda")) < 3000


def test_one_precision_and_constants_once(tmp_path, sequence, open_splats):
    write_asset(sequence(3), tmp_path / "a.usdc")
    prim = open_splats(tmp_path / "a.usdc")
    arrays = {a.GetName(): a.GetNumTimeSamples() for a in prim.GetAuthoredAttributes() if a.GetTypeName().isArray}
    assert arrays == {
        "beam:ambientOcclusionErrorh": 0,
        "beam:ambientOcclusionh": 3,
        "beam:baseColorErrorh": 0,
        "beam:baseColorh": 0,
        "beam:ids": 0,
        "beam:normalConfidenceh": 0,
        "beam:normalsh": 0,
        "beam:observability": 0,
        "beam:roughnessErrorh": 0,
        "beam:roughnessh": 0,
        "extent": 3,
        "opacitiesh": 0,
        "orientationsh": 3,
        "positions": 3,
        "primvars:displayColor": 0,
        "radiance:sphericalHarmonicsCoefficientsh": 0,
        "scalesh": 0,
    }


@pytest.mark.parametrize(
    ("channel", "value", "usd_name"),
    [
        ("scales", 2.0**-14, "scalesh"),
        ("scales", 2.0**-15, "scales"),  # below, half loses bits
        ("scales", 0.0, "scalesh"),  # a disc is exact
        ("scales", 70000.0, "scales"),
        ("ambient_occlusion_error", 65504.0, "beam:ambientOcclusionErrorh"),
        ("ambient_occlusion_error", 65505.0, "beam:ambientOcclusionError"),
        ("ambient_occlusion_error", 1e-9, "beam:ambientOcclusionErrorh"),  # absolutely small is small enough
    ],
)
def test_half_only_where_it_is_safe(tmp_path, cloud, open_splats, channel, value, usd_name):
    base = cloud()
    array = base.arrays()[channel].copy()
    array.flat[0] = value
    moved = base.with_arrays(**{channel: array}, positions=base.positions + 1.0)
    # The second frame decides for both: an attribute has one precision.
    write_asset(GaussianSequence.from_clouds([base, moved]), tmp_path / "a.usdc")
    prim = open_splats(tmp_path / "a.usdc")
    written = [name for name in (usd_name.removesuffix("h"), usd_name.removesuffix("h") + "h") if has(prim, name)]
    assert written == [usd_name]


def has(prim, name):
    return prim.GetAttribute(name).HasAuthoredValue()


def test_loose_quaternions_are_normalised_before_half(tmp_path, cloud, open_splats):
    base = cloud()
    write_asset(
        GaussianSequence.from_clouds([base.with_arrays(orientations=base.orientations * 1.0009)]), tmp_path / "a.usdc"
    )
    stored = np.asarray(open_splats(tmp_path / "a.usdc").GetAttribute("orientationsh").Get()).astype(np.float64)
    assert np.abs(np.linalg.norm(stored, axis=1) - 1.0).max() <= 2.0**-11  # four components, each off by 2^-12


def test_stand_in_radiance_is_encoded_base_colour_times_occlusion(tmp_path, cloud, open_splats):
    grey = cloud(count=2, degree=None, base_color=[[0.5, 0.25, 0.002]] * 2, ambient_occlusion=[1.0, 0.5])
    write_asset(GaussianSequence.from_clouds([grey]), tmp_path / "a.usdc", full_float=True)
    prim = open_splats(tmp_path / "a.usdc")
    shown = 0.5 + SH_C0 * np.asarray(prim.GetAttribute("radiance:sphericalHarmonicsCoefficients").Get())
    # sRGB of .5, .25, .125 (IEC 61966-2-1), and the linear toe 12.92 x below .0031308
    wanted = [[0.735357, 0.537099, 0.02584], [0.537099, 0.388573, 0.01292]]
    assert np.abs(shown - wanted).max() < 1e-6
    assert prim.GetAttribute("radiance:sphericalHarmonicsDegree").Get() == 0
    assert prim.GetAttribute("beam:radianceMeaning").Get() == "baseColorOnly"
    assert prim.GetAttribute("colorSpace:name").Get() == "srgb_rec709_display"


def test_harmonics_are_contiguous_triplets_padded_to_one_degree(tmp_path, cloud, open_splats):
    low, high = cloud(0, 2, degree=0), cloud(1, 2, degree=1)
    write_asset(GaussianSequence.from_clouds([low, high]), tmp_path / "a.usdc", full_float=True)
    attribute = open_splats(tmp_path / "a.usdc").GetAttribute("radiance:sphericalHarmonicsCoefficients")
    assert np.array_equal(np.asarray(attribute.Get(1)), high.radiance.reshape(-1, 3))
    assert np.array_equal(np.asarray(attribute.Get(0))[[0, 4]], low.radiance[:, 0])
    assert not np.asarray(attribute.Get(0))[[1, 2, 3, 5, 6, 7]].any()


def test_extent_is_three_sigma_of_each_frame(tmp_path, cloud, open_splats):
    half = np.sqrt(0.5)
    turned = cloud(
        count=1,
        positions=[[1.0, 2.0, 3.0]],
        scales=[[0.1, 0.2, 0.3]],
        orientations=[[0.0, 0.0, half, half]],  # a quarter turn about z swaps x and y
    )
    write_asset(GaussianSequence.from_clouds([turned]), tmp_path / "a.usdc")
    extent = np.asarray(open_splats(tmp_path / "a.usdc").GetAttribute("extent").Get())
    assert np.abs(extent - [[0.4, 1.7, 2.1], [1.6, 2.3, 3.9]]).max() < 1e-6


@pytest.mark.parametrize("frames", [4, 65])
def test_quaternions_keep_their_sign_over_time(tmp_path, cloud, open_splats, frames):
    base = cloud()
    clouds = [
        base.with_arrays(orientations=base.orientations * (-1) ** frame, positions=base.positions + frame)
        for frame in range(frames)
    ]
    write_asset(GaussianSequence.from_clouds(clouds), tmp_path / "a.usda", segment_length=30)
    attribute = open_splats(tmp_path / "a.usda").GetAttribute("orientationsh")
    first = np.asarray(attribute.Get(0))
    assert all(np.array_equal(np.asarray(attribute.Get(frame)), first) for frame in range(frames))


def test_display_colour_is_the_mean_weighted_by_opacity(tmp_path, cloud, open_splats):
    two = cloud(count=2, base_color=[[1.0, 0.0, 0.0], [0.0, 0.0, 1.0]], opacities=[0.75, 0.25])
    write_asset(GaussianSequence.from_clouds([two]), tmp_path / "a.usdc")
    color = np.asarray(open_splats(tmp_path / "a.usdc").GetAttribute("primvars:displayColor").Get())
    assert np.allclose(color, [[0.75, 0.0, 0.25]])


def test_same_input_gives_the_same_bytes(tmp_path, sequence):
    contents = []
    for _ in range(2):
        write_asset(sequence(65), tmp_path / "a.usda")
        contents.append({path.name: path.read_bytes() for path in tmp_path.iterdir()})
    assert contents[0] == contents[1]


def test_memory_does_not_grow_with_length(tmp_path, cloud):
    def lazy(frames):
        def read(frame):
            return cloud(frame, 1000, relightable=False, degree=2)

        return GaussianSequence(frame_count=frames, read_frame=read, topology="perFrame")

    peaks = []
    write_asset(lazy(2), tmp_path / "warm.usda")
    for frames in (65, 130):
        tracemalloc.start()
        write_asset(lazy(frames), tmp_path / "a.usda", segment_length=10)
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[1] < 1.2 * peaks[0]


def broken_after(sequence, frame):
    def read(index):
        if index == frame:
            raise RuntimeError("the disk that holds the source went away")
        return sequence[index]

    return GaussianSequence(frame_count=len(sequence), read_frame=read)


@pytest.mark.parametrize("name", ["a.usda", "a.usdz"])
def test_a_failing_source_leaves_nothing(tmp_path, sequence, name):
    with pytest.raises(RuntimeError, match="went away"):
        write_asset(broken_after(sequence(65), 40), tmp_path / name)
    assert names(tmp_path) == []


def test_a_failing_disk_leaves_nothing_and_spares_the_old_asset(tmp_path, sequence, monkeypatch):
    write_asset(sequence(65), tmp_path / "a.usda")
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    calls = []

    def full_disk(layer):
        calls.append(layer)
        if len(calls) == 4:
            raise OSError(28, "No space left on device")
        assert layer.Save()

    monkeypatch.setattr(writer, "_save", full_disk)
    with pytest.raises(OutputError, match=r"a.usda must be writable, got .*No space left.*nothing was left behind"):
        write_asset(sequence(65, count=9), tmp_path / "a.usda")
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before


def test_a_package_that_would_reach_the_limit_is_refused_in_advance(tmp_path, sequence, monkeypatch):
    monkeypatch.setattr(writer, "USDZ_LIMIT", 5000)
    with pytest.raises(OutputError, match=r"a.usdz must stay below 4 GiB, got .* Write a.usda, or fewer frames"):
        write_asset(sequence(3, count=200), tmp_path / "a.usdz")
    assert names(tmp_path) == []


def refused(match):
    return pytest.raises(BeamError, match=match)


def test_bad_targets(tmp_path, sequence):
    with refused(r"path must end in .usda, .usdc, .usdz, got 'a.ply'"):
        write_asset(sequence(1), tmp_path / "a.ply")
    with refused(r"path must name a file without .* got 'a\[1\].usda'\. Rename it"):
        write_asset(sequence(1), tmp_path / "a[1].usda")
    with refused(r"none must be a folder that can be written, got No such file or directory"):
        write_asset(sequence(1), tmp_path / "none" / "a.usda")
    with refused(r"segment_length must be an integer in \[1"):
        write_asset(sequence(1), tmp_path / "a.usda", segment_length=0)


def test_bad_sequences(tmp_path, cloud, sequence):
    target = tmp_path / "a.usda"
    with pytest.raises(InvalidOptionError, match=r"axes must be rub \(y up\) or rfu \(z up\).* got 'rdf'\. Convert"):
        write_asset(sequence(1, axes="rdf"), target)
    mixed = GaussianSequence(2, [cloud(), cloud(axes="rfu")].__getitem__)
    with pytest.raises(
        InvalidOptionError, match=r"axes must be the same in every frame, got 'rfu' after 'rub' at frame 1"
    ):
        write_asset(mixed, target)
    with pytest.raises(InvalidArrayError, match=r"same arrays, got a difference in radiance at frame 1"):
        write_asset(GaussianSequence(2, [cloud(), cloud(degree=None)].__getitem__), target)
    shrinking = GaussianSequence(2, [cloud(), cloud(count=3)].__getitem__, topology="constant")
    with pytest.raises(InvalidOptionError, match=r"topology must be perFrame where counts change, got 3 .* after 6"):
        write_asset(shrinking, target)
    assert names(tmp_path) == []


def test_layers_agree_on_time_codes(tmp_path, sequence):
    # USD retimes across layers whose rates differ; a layer that states none counts as 24.
    write_asset(sequence(65), tmp_path / "a.usda")
    for path in tmp_path.iterdir():
        assert Sdf.Layer.FindOrOpen(str(path)).timeCodesPerSecond == 24.0
