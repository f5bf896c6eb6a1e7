"""Compressed PLY as written: half a step of every code is the error, and what the codes can say comes back."""

import math

import numpy as np
import plyfile
import pytest

from beam_warp import converters
from beam_warp.blocks import BLOCK_ROWS
from beam_warp.converters import WriteOptions
from beam_warp.converters.ply.compressed import CHUNK_ROWS
from beam_warp.converters.ply.compressed_writer import _between_bounds, _cells
from beam_warp.errors import InvalidOptionError
from beam_warp.world.curve import morton_order
from beam_warp.world.gaussians import GaussianSequence
from beam_warp.world.harmonics import SH_C0

EPSILON = float(np.finfo(np.float32).eps)
STEPS = np.array([2047, 1023, 2047])


def write(cloud, path, metadata=None, **options):
    sequence = GaussianSequence.from_clouds([cloud], metadata=metadata)
    return converters.write(sequence, path, WriteOptions(**{"axes": cloud.axes, **options}))


def chunk_range(values):
    """The largest less the smallest value of each row's chunk, by plain loops."""
    starts = range(0, len(values), CHUNK_ROWS)
    ranges = [np.ptp(values[start : start + CHUNK_ROWS].astype(np.float64), axis=0) for start in starts]
    return np.repeat(ranges, CHUNK_ROWS, axis=0)[: len(values)]


@pytest.mark.parametrize("cores", [1, 3])
@pytest.mark.parametrize(("count", "degree"), [(1, 0), (256, 3), (257, 1), (BLOCK_ROWS + 1, 2)])
def test_errors_are_half_a_step(make_cloud, tmp_path, rng, monkeypatch, cores, count, degree):
    monkeypatch.setattr("beam_warp.blocks._core_count", lambda: cores)
    cloud = make_cloud(count, degree=degree, opacities=rng.uniform(size=count))
    write(cloud, tmp_path / "a.compressed.ply")
    back, put = converters.read(tmp_path / "a.compressed.ply")[0], cloud.select(morton_order(_cells(cloud.positions)))

    # Beside half a step, values are rounded to float32 as bounds and once more when read.
    bound = chunk_range(put.positions) / (2 * STEPS) + 2 * EPSILON * np.abs(put.positions).max()
    assert (np.abs(back.positions - put.positions.astype(np.float64)) <= bound).all()
    logs = np.log(put.scales.astype(np.float64))
    bound = chunk_range(logs) / (2 * STEPS) + 3 * EPSILON * np.abs(logs).max()
    assert (np.abs(np.log(back.scales.astype(np.float64)) - logs) <= bound).all()
    assert np.abs(back.opacities - put.opacities.astype(np.float64)).max() <= 1 / 510 + EPSILON
    shown, colors = (0.5 + SH_C0 * c.radiance[:, 0].astype(np.float64) for c in (back, put))
    assert (np.abs(shown - colors) <= chunk_range(colors) / 510 + 4 * EPSILON * (1 + np.abs(colors))).all()
    off = np.abs(back.radiance[:, 1:] - np.clip(put.radiance[:, 1:].astype(np.float64), -4, 4))
    assert off.max(initial=0.0) <= 3 / 128 + 2 * EPSILON  # v + 4 is rounded by half a unit of 8
    assert (off <= 1 / 64 + 2 * EPSILON)[np.abs(put.radiance[:, 1:]) < 4 - 1 / 32].all()
    # As in test_compressed_ply: three components half a step off, and the largest by no more than their three errors.
    aligned = back.orientations * np.sign(np.sum(back.orientations * put.orientations, axis=1, keepdims=True))
    assert np.abs(aligned - put.orientations).max() <= 4 * 0.5 * math.sqrt(2.0) / 1023


def test_a_word_is_made_of_the_nearest_codes():
    values = np.float32([[0, 10, -1], [1, 20, 1], [0.3, 13.3, 0.17], [0.7, 16.6, -0.5]])
    words, bounds = _between_bounds(values, ((21, 11), (11, 10), (0, 11)))
    assert np.array_equal(bounds, [[0, 10, -1, 1, 20, 1]])
    for word, value in zip(words.tolist(), values.astype(np.float64), strict=True):
        x, y, z = (value - [0, 10, -1]) / [1, 10, 2] * STEPS
        assert word == round(x) << 21 | round(y) << 11 | round(z)


def test_values_between_equal_bounds(make_cloud, tmp_path):
    cloud = make_cloud(5, positions=np.tile(np.float32([0.1, -2.0, 1e6]), (5, 1)))
    write(cloud, tmp_path / "a.compressed.ply")
    assert np.array_equal(converters.read(tmp_path / "a.compressed.ply")[0].positions, cloud.positions)


def test_what_codes_say_is_written_as_it_was(make_cloud, tmp_path):
    """A chunk that was read is written with the same bounds, and so with the same codes."""
    write(make_cloud(CHUNK_ROWS, degree=3), tmp_path / "a.compressed.ply")
    once = converters.read(tmp_path / "a.compressed.ply")[0]
    write(once, tmp_path / "b.compressed.ply")
    twice = converters.read(tmp_path / "b.compressed.ply")[0].arrays()
    # The values of codes are in other cells of the curve than those that were coded: rows are compared in one order.
    orders = [np.lexsort(positions.T) for positions in (once.positions, twice["positions"])]
    for name, array in once.arrays().items():
        first, again = array[orders[0]], twice[name][orders[1]]
        if name in ("positions", "opacities"):
            assert np.array_equal(first, again), name
        elif name == "radiance":
            assert np.array_equal(first[:, 1:], again[:, 1:])
            assert np.abs(first[:, 0] - again[:, 0]).max() <= 4 * EPSILON / SH_C0  # a bound, rounded as a colour
        else:  # bounds are logs of scales that were rounded; a quaternion is normalised again
            assert np.allclose(first, again, rtol=8 * EPSILON, atol=2 * EPSILON), name


def test_every_byte_of_the_bands_comes_back(make_cloud, tmp_path):
    levels = (np.arange(256) + 0.5) / 32 - 4
    levels[[0, 255]] = -4, 4
    radiance = np.zeros((256, 4, 3), np.float32)
    radiance[:, 1:] = levels[:, None, None]
    cloud = make_cloud(256, radiance=radiance)
    write(cloud, tmp_path / "a.compressed.ply")
    back = converters.read(tmp_path / "a.compressed.ply")[0]
    assert np.array_equal(back.radiance[:, 1:], radiance[morton_order(_cells(cloud.positions)), 1:])
    beyond = make_cloud(2, radiance=np.full((2, 4, 3), [[[9.0]], [[-9.0]]]))
    write(beyond, tmp_path / "a.compressed.ply")
    back = converters.read(tmp_path / "a.compressed.ply")[0].radiance[morton_order(_cells(beyond.positions)), 1:]
    assert np.array_equal(back, np.clip(beyond.radiance[:, 1:], -4, 4))


def test_the_order_is_the_morton_curve(rng):
    positions = rng.uniform(-3, 5, (300, 3)).astype(np.float32)
    low, extent = positions.min(axis=0).astype(float), np.ptp(positions.astype(float), axis=0)

    def key(position):
        cells = [int(c) for c in (position - low) / extent * (2**21 - 1)]
        return sum((cell >> bit & 1) << (3 * bit + axis) for axis, cell in enumerate(cells) for bit in range(21))

    assert morton_order(_cells(positions)).tolist() == sorted(range(300), key=lambda row: key(positions[row]))
    assert morton_order(_cells(np.empty((0, 3), np.float32))).tolist() == []


def test_limits_are_finite_in_a_file(make_cloud, tmp_path):
    scales = np.float32([[0.0, 0.1, 0.2], [0.1, 0.0, 1e-12]])
    write(make_cloud(2, opacities=[0.0, 1.0], scales=scales), tmp_path / "a.compressed.ply")
    chunk = plyfile.PlyData.read(str(tmp_path / "a.compressed.ply"))["chunk"].data
    assert np.isfinite([float(value) for value in chunk[0]]).all()
    assert min(chunk[f"min_scale_{axis}"][0] for axis in "xyz") == -20
    back = converters.read(tmp_path / "a.compressed.ply")[0]
    assert sorted(back.opacities.tolist()) == [0.0, 1.0]


def test_what_is_stated_survives(make_cloud, tmp_path):
    stated = {"raster_antialiased": "true", "raster_low_pass": "0.1"}
    write(make_cloud(axes="rub"), tmp_path / "a.compressed.ply", stated, axes="fru")
    sequence = converters.read(tmp_path / "a.compressed.ply")
    assert (sequence[0].axes, sequence.metadata["source_units"]) == ("fru", "m")
    assert sequence.metadata.items() >= stated.items()
    colourless = make_cloud(radiance=None, radiance_color_space=None)
    write(colourless, tmp_path / "b.compressed.ply")
    assert converters.read(tmp_path / "b.compressed.ply")[0].radiance is None
    write(make_cloud(degree=2), tmp_path / "c.compressed.ply", sh_degree=1)
    assert converters.read(tmp_path / "c.compressed.ply")[0].radiance.shape[1] == 4


def test_no_gaussians(make_cloud, tmp_path):
    write(make_cloud(4).select(np.zeros(4, bool)), tmp_path / "a.compressed.ply")
    assert len(converters.read(tmp_path / "a.compressed.ply")[0]) == 0


@pytest.mark.parametrize(
    ("changes", "options", "message"),
    [
        (
            {"materials": True},
            {"profile": "beam"},
            "profile must be standard for compressed PLY, which has no materials",
        ),
        ({"radiance": np.zeros((16, 25, 3))}, {}, "sh_degree must be at most 3 for compressed PLY, got 4"),
    ],
)
def test_what_has_no_place_is_refused(make_cloud, tmp_path, changes, options, message):
    with pytest.raises(InvalidOptionError, match=message):
        write(make_cloud(16, **changes), tmp_path / "a.compressed.ply", **options)
    assert not list(tmp_path.iterdir())
