"""SOG out: what comes back is within the steps of the format, in Morton order, and the same bytes every time."""

import io
import json
import math
import zipfile

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from beam_warp import converters
from beam_warp._version import __version__
from beam_warp.converters import WriteOptions
from beam_warp.errors import InvalidOptionError
from beam_warp.image.color import LINEAR_REC709
from beam_warp.world.gaussians import GaussianCloud, GaussianSequence
from beam_warp.world.metadata import raster_metadata, stated_raster

EPSILON = float(np.finfo(np.float32).eps)


def written(cloud, path, options=WriteOptions(), **metadata):  # noqa: B008
    converters.write(GaussianSequence.from_clouds([cloud], metadata=metadata), path, options)
    return path


def opened(path):
    """meta.json, and the textures as arrays."""
    with zipfile.ZipFile(path) as archive:
        files = {name: archive.read(name) for name in archive.namelist()}
    meta = json.loads(files.pop("meta.json"))
    return meta, {name: np.asarray(Image.open(io.BytesIO(content))) for name, content in files.items()}


def logs(positions):
    return np.copysign(np.log1p(np.abs(positions.astype(np.float64))), positions)


def morton(codes):
    """The key of one Gaussian, bit by bit: x has the lowest."""
    return sum((int(codes[axis]) >> bit & 1) << (3 * bit + axis) for bit in range(16) for axis in range(3))


def rows_of(got, wanted):
    """Rows of ``wanted`` whose opacities are those of ``got``; opacities are distinct bytes."""
    return np.argsort(wanted)[np.searchsorted(np.sort(wanted), got - 0.5 / 255)]


@settings(max_examples=15, deadline=None)
@given(st.integers(1, 60), st.integers(0, 3), st.integers(0, 2**32 - 1), st.floats(-6, 6))
def test_what_comes_back_is_within_the_steps_of_the_format(tmp_path_factory, make_cloud, count, degree, seed, size):
    rng = np.random.default_rng(seed)
    opacities = rng.permutation(256)[:count] / 255
    cloud = make_cloud(count, degree, seed=seed, opacities=opacities, axes="rdf")
    cloud = cloud.with_arrays(positions=cloud.positions * 10.0**size)
    path = written(cloud, tmp_path_factory.mktemp("sog") / "a.sog")
    back, (meta, _) = converters.read(path)[0], opened(path)
    row = rows_of(back.opacities, cloud.opacities)
    assert np.array_equal(np.sort(row), np.arange(count))
    assert np.abs(back.opacities - cloud.opacities[row]).max() <= EPSILON
    half = np.ptp(logs(cloud.positions), axis=0) / 65535 / 2
    # Beside half a step, float32 rounds a position once: relative to it, and so at most that much in its logarithm.
    assert (np.abs(logs(back.positions) - logs(cloud.positions)[row]) <= half * (1 + 1e-9) + EPSILON).all()
    # Half a step of a component is d = sqrt(1/2) / 255. The largest one, a, follows from unit length: it moves by at
    # most |q d| / (a - d), so that the whole moves by |d| (1 + (1 - a^2) / (a - d)^2)^(1/2), the most at a = 1/2.
    step = math.sqrt(3.0) * math.sqrt(0.5) / 255
    most = step * math.sqrt(1 + 0.75 / (0.5 - step) ** 2) + 4 * EPSILON
    cosine = np.abs(np.einsum("ij,ij->i", back.orientations.astype(float), cloud.orientations[row]))
    assert (np.sqrt(2 - 2 * np.minimum(cosine, 1)) <= most).all()
    for group, got, wanted in (
        ("scales", np.log(back.scales.astype(float)), np.log(cloud.scales[row].astype(float))),
        ("sh0", back.radiance[:, 0], cloud.radiance[row, 0]),
        ("shN", back.radiance[:, 1:], cloud.radiance[row, 1:]),  # up to 64 Gaussians have an entry each
    ):
        if got.size:
            nearest = np.abs(wanted[..., None].astype(float) - np.array(meta[group]["codebook"])).min(axis=-1)
            assert np.allclose(np.abs(got - wanted), nearest, rtol=0, atol=8 * EPSILON)
            if wanted.size <= 256:
                assert np.allclose(got, wanted, rtol=0, atol=8 * EPSILON)


def test_codebooks_hold_many_gaussians_closely(make_cloud, tmp_path):
    cloud = make_cloud(3000, 1, axes="rdf")
    back = converters.read(written(cloud, tmp_path / "a.sog"))[0]
    order = np.lexsort(np.round(logs(cloud.positions) / 1e-3).T), np.lexsort(np.round(logs(back.positions) / 1e-3).T)
    a, b = (c.scales[o] for c, o in zip((cloud, back), order, strict=True))
    same = np.abs(cloud.positions[order[0]] - back.positions[order[1]]).max(axis=1) < 1e-3
    assert same.mean() > 0.8
    # Log scales lie evenly over 8, so that the root mean square of codes is 8 / 256 / sqrt(12).
    assert np.sqrt(np.mean((np.log(a) - np.log(b))[same] ** 2)) <= 1.05 * 8 / 256 / math.sqrt(12)


def test_pixels_are_in_morton_order(make_cloud, tmp_path):
    _, textures = opened(written(make_cloud(300, 0), tmp_path / "a.sog"))
    codes = textures["means_u.webp"].astype(int) * 256 + textures["means_l.webp"]
    keys = [morton(code) for code in codes.reshape(-1, 3)[:300]]
    assert keys == sorted(keys)
    assert codes.reshape(-1, 3)[:300].min() == 0
    assert codes.max() == 65535


def test_the_same_gaussians_are_the_same_bytes(make_cloud, tmp_path):
    cloud = make_cloud(2000, 2)
    first, second = (written(cloud, tmp_path / name).read_bytes() for name in ("a.sog", "b.sog"))
    assert first == second


def test_what_meta_says(make_cloud, tmp_path):
    cloud = make_cloud(70, 3)
    meta, textures = opened(written(cloud, tmp_path / "a.sog", **raster_metadata(True, 0.3)))
    assert meta["version"] == 2
    assert meta["asset"] == {"generator": f"beam-warp {__version__}"}
    assert meta["beam"] == {"axes": "rdf", "framesPerSecond": 30.0, "radianceMeaning": "captured"}
    assert (meta["count"], meta["model"], meta["shN"]["bands"]) == (70, "antialiased", 3)
    assert meta["shN"]["count"] == 64
    assert {name: pixels.shape for name, pixels in textures.items()} == {
        **dict.fromkeys(("means_l.webp", "means_u.webp", "scales.webp", "shN_labels.webp"), (8, 12, 3)),
        **dict.fromkeys(("quats.webp", "sh0.webp"), (8, 12, 4)),
        "shN_centroids.webp": (1, 960, 3),
    }
    assert stated_raster(converters.read(tmp_path / "a.sog").metadata) == (True, 0.3)


def test_colours_of_invisible_gaussians_are_kept(make_cloud, tmp_path):
    cloud = make_cloud(9, 0, opacities=np.zeros(9), axes="rdf")
    back = converters.read(written(cloud, tmp_path / "a.sog"))[0]
    assert np.array_equal(np.sort(back.radiance, axis=0), np.sort(cloud.radiance, axis=0))


@pytest.mark.parametrize("count", [0, 1, 16, 17])
def test_sizes_around_a_texture(count, make_cloud, tmp_path):
    cloud = make_cloud(count, 1)
    back = converters.read(written(cloud, tmp_path / "a.sog"))[0]
    assert (len(back), back.sh_degree) == (count, 1)


def test_a_flat_far_cloud_and_opaque_discs(make_cloud, tmp_path):
    cloud = make_cloud(200, 0, axes="rdf")
    cloud = cloud.with_arrays(
        positions=cloud.positions * np.array([1e30, 0.0, 1.0]) + np.array([0.0, 7.0, 0.0]),
        scales=cloud.scales * np.array([1, 1, 0]),
        opacities=np.ones(200),
    )
    back = converters.read(written(cloud, tmp_path / "a.sog"))[0]
    assert np.allclose(back.positions[:, 1], 7.0, rtol=EPSILON)
    assert (back.opacities == 1.0).all()
    assert (back.scales[:, 2] <= math.exp(-29.9)).all()
    assert np.abs(back.positions[:, 0]).max() == pytest.approx(np.abs(cloud.positions[:, 0]).max(), rel=1e-6)


def test_axes_and_colours_are_those_of_the_usual_ply(make_cloud, tmp_path):
    cloud = make_cloud(40, 3, materials=True, axes="rub")
    sequence = GaussianSequence.from_clouds([cloud])
    converters.write(sequence, tmp_path / "a.sog")
    sequence = converters.read(tmp_path / "a.sog")
    back = sequence[0]
    assert back.axes == "rdf"
    assert "notes" not in sequence.metadata
    assert np.allclose(np.sort(back.positions[:, 1]), np.sort(-cloud.positions[:, 1]), atol=1e-3)
    linear = make_cloud(40, 0, radiance_color_space=LINEAR_REC709)
    shown = written(linear, tmp_path / "b.sog"), written(linear, tmp_path / "b.ply")
    colors = [np.sort(converters.read(path)[0].radiance[:, 0], axis=0) for path in shown]
    assert np.array_equal(*colors)


def test_what_colour_means_and_the_rate_come_back(make_cloud, tmp_path):
    cloud = make_cloud(20, 0, materials=True)
    fields = {name: array for name, array in cloud.arrays().items() if name != "radiance"}
    for without, meaning in (((), "baseColorOnly"), (("base_color",), None)):
        kept = {name: array for name, array in fields.items() if name not in without}
        sequence = GaussianSequence.from_clouds([GaussianCloud(**kept, axes="rdf")] * 2, frames_per_second=24.0)
        converters.write(sequence, tmp_path / "walk.sog")
        back = converters.read(tmp_path)
        assert back.frames_per_second == 24.0
        assert back.metadata.get("radiance_meaning") == meaning
        assert (back[1].radiance is None) == (meaning is None)


def test_sequences_bands_and_what_does_not_fit(make_cloud, tmp_path):
    clouds = [make_cloud(10 + frame, 2, seed=frame) for frame in range(3)]
    converters.write(GaussianSequence.from_clouds(clouds), tmp_path / "walk.sog", WriteOptions(sh_degree=1))
    back = converters.read(tmp_path)
    assert [(len(cloud), cloud.sh_degree) for cloud in back] == [(10, 1), (11, 1), (12, 1)]
    with pytest.raises(InvalidOptionError, match=r"sh_degree must be at most 3 for SOG, got 4\. Pass --sh-degree 3"):
        written(make_cloud(5, 4), tmp_path / "b.sog")
    with pytest.raises(InvalidOptionError, match="profile must be standard for SOG"):
        written(make_cloud(5, 0, materials=True), tmp_path / "b.sog", WriteOptions(profile="beam"))
    assert len(list(tmp_path.iterdir())) == 3
