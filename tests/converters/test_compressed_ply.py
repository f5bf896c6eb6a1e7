"""Packed PLY: the decoder against an encoder written here from the layout, and against plain loops on real files."""

import math
import struct

import numpy as np
import plyfile
import pytest

from beam_warp import converters
from beam_warp.errors import AssetFormatError
from beam_warp.image.color import DISPLAY_SRGB
from beam_warp.world.harmonics import SH_C0

EPSILON = float(np.finfo(np.float32).eps)

AXES = ("x", "y", "z")
GEOMETRY_BOUNDS = [
    *(f"{end}_{a}" for end in ("min", "max") for a in AXES),
    *(f"{end}_scale_{a}" for end in ("min", "max") for a in AXES),
]
COLOR_BOUNDS = [f"{end}_{c}" for end in ("min", "max") for c in "rgb"]
WORDS = ("packed_position", "packed_rotation", "packed_scale", "packed_color")


def bits(value, count):
    """The nearest of 2^count levels of [0, 1]."""
    return round(value * (2**count - 1))


def pack_11_10_11(x, y, z):
    return bits(x, 11) << 21 | bits(y, 10) << 11 | bits(z, 11)


def pack_rotation(w, x, y, z):
    parts = [w, x, y, z]
    largest = max(range(4), key=lambda i: abs(parts[i]))
    sign = math.copysign(1.0, parts[largest])
    word = largest
    for index in range(4):
        if index != largest:
            word = word << 10 | bits(sign * parts[index] * math.sqrt(0.5) + 0.5, 10)
    return word


def packed_ply(chunks, rows, sh=None, *, colors=True, chunk_count=None):
    """Chunk bounds and packed words as a file; ``sh`` as rows of bytes."""
    names = GEOMETRY_BOUNDS + (COLOR_BOUNDS if colors else [])
    lines = ["ply", "format binary_little_endian 1.0", f"element chunk {chunk_count or len(chunks)}"]
    lines += [f"property float {name}" for name in names]
    lines += [f"element vertex {len(rows)}", *(f"property uint {name}" for name in WORDS)]
    body = b"".join(struct.pack(f"<{len(names)}f", *chunk) for chunk in chunks)
    body += b"".join(struct.pack("<4I", *row) for row in rows)
    if sh is not None:
        lines += [f"element sh {len(sh)}", *(f"property uchar f_rest_{i}" for i in range(len(sh[0])))]
        body += b"".join(bytes(row) for row in sh)
    return "\n".join([*lines, "end_header", ""]).encode() + body


CHUNK = [-1.0, 0.0, 10.0, 1.0, 4.0, 14.0, -6.0, -5.0, -4.0, -2.0, -1.0, 0.0, -0.5, 0.0, 0.5, 0.5, 1.0, 1.5]
"""Bounds of position, log scale and colour, all exact in float32."""

IDENTITY = pack_rotation(1.0, 0.0, 0.0, 0.0)


def read(tmp_path, content):
    (tmp_path / "a.compressed.ply").write_bytes(content)
    return converters.read(tmp_path / "a.compressed.ply")[0]


def test_the_ends_of_every_field(tmp_path):
    low, high = (0, IDENTITY, 0, 0), (0xFFFFFFFF, IDENTITY, 0xFFFFFFFF, 0xFFFFFFFF)
    cloud = read(tmp_path, packed_ply([CHUNK], [low, high]))
    assert np.array_equal(cloud.positions, [[-1, 0, 10], [1, 4, 14]])
    assert np.allclose(np.log(cloud.scales), [[-6, -5, -4], [-2, -1, 0]], atol=6 * EPSILON)
    assert np.array_equal(cloud.opacities, [0, 1])
    assert np.allclose(0.5 + SH_C0 * cloud.radiance[:, 0], [[-0.5, 0, 0.5], [0.5, 1, 1.5]], atol=4 * EPSILON)
    assert cloud.radiance_color_space == DISPLAY_SRGB


def test_fields_do_not_leak_into_each_other(tmp_path):
    # One field of each word at its top, the others at 0.
    words = [0b11111111111 << 21, 0b1111111111 << 11, 0b11111111111]
    colors = [0xFF000000, 0x00FF0000, 0x0000FF00, 0x000000FF]
    cloud = read(tmp_path, packed_ply([CHUNK], [(w, IDENTITY, w, c) for w, c in zip(words, colors, strict=False)]))
    assert np.array_equal(cloud.positions, [[1, 0, 10], [-1, 4, 10], [-1, 0, 14]])
    assert np.allclose(np.log(cloud.scales), [[-2, -5, -4], [-6, -1, -4], [-6, -5, 0]], atol=6 * EPSILON)
    shown = 0.5 + SH_C0 * cloud.radiance[:, 0]
    assert np.allclose(shown, [[0.5, 0, 0.5], [-0.5, 1, 0.5], [-0.5, 0, 1.5]], atol=4 * EPSILON)
    assert read(tmp_path, packed_ply([CHUNK], [(0, IDENTITY, 0, colors[3])])).opacities[0] == 1.0


def test_text_is_read_to_the_last_bit(tmp_path):
    """Words of 32 bits, of which float32 would keep 24; a number that its type cannot hold is refused."""
    chunk, words = [*CHUNK[:5], np.nextafter(np.float32(14.0), np.float32(15.0)), *CHUNK[6:]], 0x12345679
    binary = packed_ply([chunk], [(words, IDENTITY + 5, words, words)], [[0, 1, 2, 253, 254, 255, 127, 128, 129]])
    header, _, _ = binary.partition(b"end_header\n")
    rows = [" ".join(f"{value:.9g}" for value in chunk), f"{words} {IDENTITY + 5} {words} {words}"]
    text = header.replace(b"binary_little_endian", b"ascii") + b"end_header\n" + "\n".join(rows).encode()
    told, wanted = read(tmp_path, text + b"\n0 1 2 253 254 255 127 128 129\n"), read(tmp_path, binary)
    for name, array in wanted.arrays().items():
        assert np.array_equal(getattr(told, name), array), name
    with pytest.raises(AssetFormatError, match=r"element sh must hold rows of 9 numbers of its types, got .*'256' to"):
        read(tmp_path, text + b"\n0 1 2 253 254 256 127 128 129\n")


def test_without_colour_bounds_a_byte_is_the_colour(tmp_path):
    cloud = read(tmp_path, packed_ply([CHUNK[:12]], [(0, IDENTITY, 0, 0xFF003300)], colors=False))
    assert np.allclose(0.5 + SH_C0 * cloud.radiance[0, 0], [1.0, 0.0, 0.2], atol=4 * EPSILON)


@pytest.mark.parametrize(("largest", "sign"), [(0, 1.0), (1, -1.0), (2, 1.0), (3, -1.0)])
def test_rotations_by_every_largest_component(tmp_path, largest, sign, rng):
    quaternions = rng.normal(size=(40, 4))
    quaternions /= np.linalg.norm(quaternions, axis=1, keepdims=True)
    current = np.argmax(np.abs(quaternions), axis=1)
    for row, place in zip(quaternions, current, strict=True):
        row[[place, largest]] = row[[largest, place]]
        row *= sign * np.sign(row[largest])
    rows = [(0, pack_rotation(*quaternion), 0, 0) for quaternion in quaternions]
    decoded = read(tmp_path, packed_ply([CHUNK], rows)).orientations[:, [3, 0, 1, 2]]
    # Each of three components is off by half of sqrt(2)/1023; the largest, at least 1/2, by at most 3/2 of that
    # divided by 1/2 (its derivative is -(a, b, c)/m): in all less than 4 steps' halves.
    error = np.abs(decoded * sign - quaternions).max()
    assert error <= 4 * 0.5 * math.sqrt(2.0) / 1023
    assert np.allclose(np.linalg.norm(decoded, axis=1), 1.0, atol=2 * EPSILON)


def test_three_components_too_long_are_normalised(tmp_path):
    cloud = read(tmp_path, packed_ply([CHUNK], [(0, 0x3FFFFFFF, 0, 0)]))  # three times sqrt(1/2), nothing left for w
    assert np.allclose(cloud.orientations, [[3**-0.5, 3**-0.5, 3**-0.5, 0]], atol=EPSILON)


@pytest.mark.parametrize("count", [1, 256, 257, 513])
def test_each_chunk_has_its_own_bounds(tmp_path, count):
    chunks = [[float(index), *CHUNK[1:3], float(index) + 0.5, *CHUNK[4:]] for index in range(-(-count // 256))]
    cloud = read(tmp_path, packed_ply(chunks, [(pack_11_10_11(1, 0, 0), IDENTITY, 0, 0)] * count))
    assert np.array_equal(cloud.positions[:, 0], np.arange(count) // 256 + 0.5)


@pytest.mark.parametrize("width", [9, 45])
def test_higher_bands(tmp_path, width):
    levels = [0, 255, 128, 1, 127, 200]
    rows = [[levels[(row + column) % 6] for column in range(width)] for row in range(3)]
    cloud = read(tmp_path, packed_ply([CHUNK], [(0, IDENTITY, 0, 0)] * 3, rows))
    value = {0: -4.0, 255: 4.0} | {v: ((v + 0.5) / 256 - 0.5) * 8 for v in (128, 1, 127, 200)}
    for row in range(3):
        for k in range(width // 3):
            for channel in range(3):  # channel after channel
                expected = value[rows[row][channel * (width // 3) + k]]
                assert cloud.radiance[row, 1 + k, channel] == np.float32(expected)


@pytest.mark.parametrize(
    "place", ["splats/biker.compressed.ply", "fixtures/splat_transform/playcanvas_test.ply"], ids=["biker", "engine"]
)
def test_files_of_supersplat_by_plain_loops(data_dir, place):
    path = data_dir / place
    ply = plyfile.PlyData.read(str(path))
    chunk, vertex = ply["chunk"].data, ply["vertex"].data
    cloud = converters.read(path)[0]
    assert len(cloud) == len(vertex)
    for row in {0, 1, 63, len(vertex) // 2, len(vertex) - 1}:
        bounds = {name: float(chunk[name][row // 256]) for name in chunk.dtype.names}
        position, rotation, scale, color = (int(vertex[name][row]) for name in WORDS)
        for axis, shift, top in ((0, 21, 2047), (1, 11, 1023), (2, 0, 2047)):
            name = AXES[axis]
            t = (position >> shift & top) / top
            expected = bounds[f"min_{name}"] * (1 - t) + bounds[f"max_{name}"] * t
            assert cloud.positions[row, axis] == pytest.approx(expected, rel=2 * EPSILON, abs=EPSILON)
            t = (scale >> shift & top) / top
            expected = math.exp(bounds[f"min_scale_{name}"] * (1 - t) + bounds[f"max_scale_{name}"] * t)
            assert cloud.scales[row, axis] == pytest.approx(expected, rel=2 * EPSILON)
            t = (color >> (24 - 8 * axis) & 255) / 255
            expected = bounds[f"min_{'rgb'[axis]}"] * (1 - t) + bounds[f"max_{'rgb'[axis]}"] * t
            shown = 0.5 + SH_C0 * cloud.radiance[row, 0, axis]
            assert shown == pytest.approx(expected, abs=4 * EPSILON)
        assert cloud.opacities[row] == pytest.approx((color & 255) / 255, rel=EPSILON)
        a, b, c = (((rotation >> shift & 1023) / 1023 - 0.5) * math.sqrt(2) for shift in (20, 10, 0))
        wxyz = [a, b, c]
        wxyz.insert(rotation >> 30, math.sqrt(1 - a * a - b * b - c * c))
        assert cloud.orientations[row] == pytest.approx([*wxyz[1:], wxyz[0]], abs=2 * EPSILON)


def test_a_packed_file_becomes_a_plain_one(data_dir, tmp_path):
    sequence = converters.read(data_dir / "fixtures" / "splat_transform" / "playcanvas_test.ply")
    converters.write(sequence, tmp_path / "plain.ply")
    back = converters.read(tmp_path / "plain.ply")[0]
    assert np.array_equal(back.radiance, sequence[0].radiance)
    assert np.array_equal(back.positions, sequence[0].positions)


ROW = (0, IDENTITY, 0, 0)
BANDS = "element sh must have 1 rows of 9, 24 or 45 properties, "


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (packed_ply([CHUNK] * 2, [ROW]), "1 packed vertices must have 1 chunks, got 2"),
        (packed_ply([CHUNK], [ROW] * 257), "257 packed vertices must have 2 chunks, got 1"),
        (packed_ply([CHUNK], [ROW], chunk_count=10**9), "element chunk must have the 1000000000 rows that the header"),
        (packed_ply([CHUNK], [ROW], [[0] * 10]), BANDS + "got 1 rows of 10"),
        (packed_ply([CHUNK], [ROW], [[0] * 9] * 2), BANDS + "got 2 rows"),
        (packed_ply([CHUNK], [ROW]).replace(b"element chunk", b"element lumps"), "must come with an element chunk"),
        (packed_ply([CHUNK], [ROW]).replace(b"float max_x", b"int max_x"), "max_x must be float, got int"),
        (packed_ply([CHUNK], [ROW]).replace(b"uint packed_color", b"int packed_color"), "packed_color must be uint"),
        (packed_ply([CHUNK], [ROW]).replace(b"packed_scale", b"packed_size"), "must have packed_scale, got packed_pos"),
        (packed_ply([[math.nan, *CHUNK[1:]]], [ROW]), "positions must be finite, got NaN or infinity at row 0"),
        (packed_ply([[*CHUNK[:12], *[3e38] * 6]], [ROW]), "radiance must be finite, got NaN or infinity at row 0"),
        (
            packed_ply([[*CHUNK[:6], -400.0, *CHUNK[7:]]], [ROW]),
            "natural logs in [-30, 20], or -inf, got -400 at row 0",
        ),
    ],
)
def test_malformed(tmp_path, content, message):
    with pytest.raises(AssetFormatError) as caught:
        read(tmp_path, content)
    assert str(caught.value).startswith("a.compressed.ply: ")
    assert message in str(caught.value)
