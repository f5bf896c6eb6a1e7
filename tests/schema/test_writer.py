"""What lands on disk: files, precision, what is constant, stand-ins for plain viewers, and nothing after a failure."""

import tracemalloc

import numpy as np
import pytest
from pxr import Sdf, Usd
from support.radiant_cloud import radiant_cloud

from beam_warp import converters
from beam_warp.blocks import BLOCK_ROWS
from beam_warp.errors import BeamError, InvalidArrayError, InvalidOptionError, OutputError
from beam_warp.schema import writer
from beam_warp.schema.writer import write_asset
from beam_warp.world.gaussians import GaussianSequence
from beam_warp.world.harmonics import SH_C0
from beam_warp.world.quaternions import matrix_of


@pytest.fixture
def written(tmp_path):
    """A function that writes a sequence, or clouds as one, and returns the prim of the splats."""
    stages = []

    def write(source, name="a.usdc", **options):
        sequence = GaussianSequence.from_clouds(source) if isinstance(source, list) else source
        write_asset(sequence, tmp_path / name, **options)
        stages.append(Usd.Stage.Open(str(tmp_path / name)))
        return stages[-1].GetPrimAtPath("/Asset/Splats")

    return write


def names(folder):
    return sorted(path.name for path in folder.iterdir())


@pytest.mark.parametrize(
    ("name", "frames", "files"),
    [
        ("a.usda", 1, ["a.static.usdc", "a.usda"]),
        ("a.usda", 3, ["a.frames.usdc", "a.usda"]),
        ("a.usda", 70, [*(f"a.0000{n}0.usdc" for n in (0, 3, 6)), "a.manifest.usda", "a.static.usdc", "a.usda"]),
        ("a.usdc", 70, ["a.usdc"]),
        ("a.usdz", 70, ["a.usdz"]),
    ],
)
def test_files(tmp_path, sequence, name, frames, files):
    paths = write_asset(sequence(frames), tmp_path / name)
    assert names(tmp_path) == files
    assert sorted(path.name for path in paths) == files
    assert paths[-1].name == name


def test_text_layers_stay_small(tmp_path, sequence):
    write_asset(sequence(70, count=500), tmp_path / "a.usda")
    assert max(path.stat().st_size for path in tmp_path.glob("*.usda")) < 3000


def test_one_precision_and_constants_once(sequence, written):
    prim = written(sequence(3))
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
        "primvars:ambientOcclusion": 3,
        "primvars:baseColor": 0,
        "primvars:displayColor": 0,
        "primvars:normals": 0,
        "primvars:roughness": 0,
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
def test_half_only_where_it_is_safe(cloud, written, channel, value, usd_name):
    base = cloud()
    array = base.arrays()[channel].copy()
    array.flat[0] = value
    moved = base.with_arrays(**{channel: array}, positions=base.positions + 1.0)
    # The second frame decides for both: an attribute has one precision.
    prim = written([base, moved])
    variants = (usd_name.removesuffix("h"), usd_name.removesuffix("h") + "h")
    assert [name for name in variants if prim.GetAttribute(name).HasAuthoredValue()] == [usd_name]


def test_loose_quaternions_are_normalised_before_half(cloud, written):
    base = cloud()
    prim = written([base.with_arrays(orientations=base.orientations * 1.0009)])
    stored = np.asarray(prim.GetAttribute("orientationsh").Get()).astype(np.float64)
    assert np.abs(np.linalg.norm(stored, axis=1) - 1.0).max() <= 2.0**-11  # four components, each off by 2^-12


def test_stand_in_radiance_is_encoded_base_colour_times_occlusion(cloud, written):
    grey = cloud(count=2, degree=None, base_color=[[0.5, 0.25, 0.002]] * 2, ambient_occlusion=[1.0, 0.5])
    prim = written([grey], full_float=True)
    shown = 0.5 + SH_C0 * np.asarray(prim.GetAttribute("radiance:sphericalHarmonicsCoefficients").Get())
    # sRGB of .5, .25, .125 (IEC 61966-2-1), and the linear toe 12.92 x below .0031308
    wanted = [[0.735357, 0.537099, 0.02584], [0.537099, 0.388573, 0.01292]]
    assert np.abs(shown - wanted).max() < 1e-6
    assert prim.GetAttribute("radiance:sphericalHarmonicsDegree").Get() == 0
    assert prim.GetAttribute("beam:radianceMeaning").Get() == "baseColorOnly"
    assert prim.GetAttribute("colorSpace:name").Get() == "srgb_rec709_display"


@pytest.mark.parametrize(
    ("words", "tokens"),
    [
        (("shortestAxis", "texture", "shaded"), ("shortestAxis", "texture", "shaded")),
        (("guess", "guess", "guess"), ("authored", "unknown", "captured")),  # of no meaning to other programs
    ],
)
def test_a_word_that_is_no_token_of_ours_is_written_as_the_fallback(sequence, written, words, tokens):
    stated = dict(zip(("normal_source", "roughness_source", "radiance_meaning"), words, strict=True))
    prim = written(sequence(1, metadata=stated))
    attributes = ("beam:normalSource", "beam:roughnessSource", "beam:radianceMeaning")
    assert tuple(prim.GetAttribute(name).Get() for name in attributes) == tokens


def test_harmonics_are_contiguous_triplets_padded_to_one_degree(cloud, written):
    low, high = cloud(0, 2, degree=0), cloud(1, 2, degree=1)
    attribute = written([low, high], full_float=True).GetAttribute("radiance:sphericalHarmonicsCoefficients")
    assert np.array_equal(np.asarray(attribute.Get(1)), high.radiance.reshape(-1, 3))
    assert np.array_equal(np.asarray(attribute.Get(0))[[0, 4]], low.radiance[:, 0])
    assert not np.asarray(attribute.Get(0))[[1, 2, 3, 5, 6, 7]].any()


def test_extent_is_three_sigma_of_each_frame(cloud, written):
    half = np.sqrt(0.5)
    turned = cloud(
        count=1,
        positions=[[1.0, 2.0, 3.0]],
        scales=[[0.1, 0.2, 0.3]],
        orientations=[[0.0, 0.0, half, half]],  # a quarter turn about z swaps x and y
    )
    extent = np.asarray(written([turned]).GetAttribute("extent").Get())
    assert np.abs(extent - [[0.4, 1.7, 2.1], [1.6, 2.3, 3.9]]).max() < 1e-6


@pytest.mark.parametrize("frames", [4, 65])
def test_quaternions_keep_their_sign_over_time(cloud, written, frames):
    base = cloud()
    changes = [(base.positions + frame, base.orientations * (-1) ** frame) for frame in range(frames)]
    clouds = [base.with_arrays(positions=positions, orientations=turns) for positions, turns in changes]
    attribute = written(clouds, "a.usda", segment_length=30).GetAttribute("orientationsh")
    first = np.asarray(attribute.Get(0))
    assert all(np.array_equal(np.asarray(attribute.Get(frame)), first) for frame in range(frames))


def test_display_colour_is_the_mean_weighted_by_opacity(cloud, written):
    two = cloud(count=2, base_color=[[1.0, 0.0, 0.0], [0.0, 0.0, 1.0]], opacities=[0.75, 0.25])
    color = np.asarray(written([two]).GetAttribute("primvars:displayColor").Get())
    assert np.allclose(color, [[0.75, 0.0, 0.25]])


def test_same_input_gives_the_same_bytes(tmp_path, sequence):
    contents = []
    for _ in range(2):
        write_asset(sequence(65), tmp_path / "a.usda")
        contents.append({path.name: path.read_bytes() for path in tmp_path.iterdir()})
    assert contents[0] == contents[1]


def test_memory_does_not_grow_with_length(tmp_path, cloud):
    def lazy(frames):
        read = lambda frame: cloud(frame, 300, relightable=False, degree=2)  # noqa: E731
        return GaussianSequence(frame_count=frames, read_frame=read, topology="perFrame")

    peaks = []
    write_asset(lazy(2), tmp_path / "warm.usda")
    for frames in (65, 130):
        tracemalloc.start()
        write_asset(lazy(frames), tmp_path / "a.usda", segment_length=10)
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[1] < 1.2 * peaks[0]


@pytest.mark.parametrize("name", ["a.usda", "a.usdz"])
def test_a_failing_source_leaves_nothing(tmp_path, cloud, name):
    def read(frame):
        if frame == 40:
            raise RuntimeError("the disk that holds the source went away")
        return cloud(frame)

    with pytest.raises(RuntimeError, match="went away"):
        write_asset(GaussianSequence(frame_count=65, read_frame=read), tmp_path / name)
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


@pytest.mark.parametrize(
    ("name", "options", "message"),
    [
        ("a.ply", {}, r"path must end in .usda, .usdc, .usdz, got 'a.ply'"),
        ("a[1].usda", {}, r"path must name a file without .* got 'a\[1\].usda'\. Rename it"),
        ("none/a.usda", {}, r"none must be a folder that can be written, got No such file or directory"),
        ("a.usda", {"segment_length": 0}, r"segment_length must be an integer in \[1"),
    ],
)
def test_bad_targets(tmp_path, sequence, name, options, message):
    with pytest.raises(BeamError, match=message):
        write_asset(sequence(1), tmp_path / name, **options)


def test_bad_sequences(tmp_path, cloud, sequence):
    target = tmp_path / "a.usda"
    with pytest.raises(InvalidOptionError, match=r"axes must be rub \(y up\) or rfu \(z up\).* got 'rdf'\. Convert"):
        write_asset(sequence(1, axes="rdf"), target)
    for change, error, message in (
        ({"axes": "rfu"}, InvalidOptionError, "axes must be the same in every frame, got 'rfu' after 'rub' at frame 1"),
        ({"degree": None}, InvalidArrayError, "same arrays, got a difference in radiance at frame 1"),
        ({"count": 3}, InvalidOptionError, "topology must be perFrame where counts change, got 3 .* after 6"),
    ):
        frames = [cloud(), cloud(**change)]
        with pytest.raises(error, match=message):
            write_asset(GaussianSequence(2, frames.__getitem__, topology="constant"), target)
    assert names(tmp_path) == []


def test_layers_agree_on_time_codes(tmp_path, sequence):
    # USD retimes across layers whose rates differ; a layer that states none counts as 24.
    write_asset(sequence(65), tmp_path / "a.usda")
    for path in tmp_path.iterdir():
        assert Sdf.Layer.FindOrOpen(str(path)).timeCodesPerSecond == 24.0


@pytest.mark.parametrize("cores", [1, 3])
def test_blocks_write_what_whole_arrays_say(tmp_path, monkeypatch, cores):
    monkeypatch.setattr("beam_warp.blocks._core_count", lambda: cores)
    cloud = radiant_cloud(BLOCK_ROWS + 1, degree=1, materials=True, axes="rub")
    write_asset(GaussianSequence.from_clouds([cloud]), tmp_path / "a.usdc")
    stage = Usd.Stage.Open(str(tmp_path / "a.usdc"))
    read = stage.GetPrimAtPath("/Asset/Splats").GetAttribute
    stored = {name: np.asarray(read(name).Get()) for name in ("opacitiesh", "orientationsh", "extent")}
    assert np.array_equal(stored["opacitiesh"].reshape(-1), cloud.opacities.astype(np.float16))
    wide = cloud.orientations.astype(np.float64)  # unit to float32 rounding, so that nothing is normalised
    assert np.array_equal(stored["orientationsh"], wide.astype(np.float16))
    reach = 3.0 * np.linalg.norm(matrix_of(wide) * cloud.scales[:, None], axis=2)
    low, high = (cloud.positions - reach).min(axis=0), (cloud.positions + reach).max(axis=0)
    outwards = [np.nextafter(low.astype(np.float32), -np.inf), np.nextafter(high.astype(np.float32), np.inf)]
    assert np.array_equal(stored["extent"], np.float32(outwards))


def test_a_source_is_asked_once_for_its_only_frame(tmp_path, cloud):
    asked = []
    sequence = GaussianSequence(frame_count=1, read_frame=lambda frame: asked.append(frame) or cloud())
    converters.write(sequence, tmp_path / "a.usdc")
    assert asked == [0]
