"""`.ksplat` files: bytes that are packed here from the layout, at every level and degree, and malformed ones."""

import struct

import numpy as np
import pytest

from beam_warp import converters
from beam_warp.errors import AssetFormatError
from beam_warp.world.harmonics import SH_C0

HALF_STEP = 2.0**-11
"""Largest relative error of a half-precision number."""

BLOCK, STEPS, SH_RANGE = 5.0, 32767, (-0.75, 1.25)


def sample(count, degree, seed):
    """Random rows: positions, scales, wxyz, RGBA bytes, harmonics channel after channel by degree."""
    rng = np.random.default_rng(seed)
    quaternions = rng.normal(size=(count, 4))
    return {
        "positions": rng.uniform(-1, 1, (count, 3)).astype(np.float32),
        "scales": rng.uniform(0.01, 1, (count, 3)).astype(np.float32),
        "wxyz": (quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True)).astype(np.float32),
        "rgba": rng.integers(0, 256, (count, 4), dtype=np.uint8),
        "harmonics": rng.uniform(*SH_RANGE, (count, (0, 9, 24)[degree])).astype(np.float32),
    }


def section(rows, level, degree, *, bucket_rows=2):
    """Header and content of a section, its rows in buckets of ``bucket_rows`` and a last one that is partly filled."""
    count = len(rows["positions"])
    full, left = divmod(count, bucket_rows) if level else (0, 0)
    lengths = [bucket_rows] * full + ([left] if left else [])
    centers = np.array([[0.5 * k, -0.25, 1.0] for k in range(len(lengths))], np.float32).reshape(-1, 3)
    of_row = np.repeat(np.arange(len(lengths)), lengths)
    header = bytearray(1024)
    struct.pack_into("<4If", header, 0, count, count, bucket_rows, len(lengths), BLOCK if level else 0.0)
    struct.pack_into("<H", header, 20, 12 if level else 0)
    struct.pack_into("<I", header, 24, STEPS if level else 0)
    struct.pack_into("<2IH", header, 32, full, 1 if left else 0, degree)
    body = struct.pack(f"<{1 if left else 0}I", *([left] if left else [])) + centers.tobytes()
    for k in range(count):
        if level:
            words = np.rint((rows["positions"][k] - centers[of_row[k]]) * STEPS / (BLOCK / 2)) + STEPS
            body += struct.pack("<3H3e4e", *words.astype(int), *rows["scales"][k], *rows["wxyz"][k])
        else:
            body += struct.pack("<10f", *rows["positions"][k], *rows["scales"][k], *rows["wxyz"][k])
        body += rows["rgba"][k].tobytes()
        if level == 2:
            low, high = SH_RANGE
            body += bytes(int((value - low) / (high - low) * 255) for value in rows["harmonics"][k])
        else:
            body += struct.pack(f"<{len(rows['harmonics'][k])}{'fe'[level]}", *rows["harmonics"][k])
    return bytes(header), body


def ksplat(sections, level, *, count, version=(0, 1)):
    header = bytearray(4096)
    struct.pack_into("<2B", header, 0, *version)
    struct.pack_into("<4IH", header, 4, len(sections), len(sections), count, count, level)
    struct.pack_into("<5f", header, 24, 0, 0, 0, *SH_RANGE)
    return bytes(header) + b"".join(head for head, _ in sections) + b"".join(body for _, body in sections)


@pytest.mark.parametrize("level", [0, 1, 2])
@pytest.mark.parametrize("degree", [0, 1, 2])
def test_every_level_and_degree_of_two_sections(tmp_path, level, degree):
    parts = [sample(5, degree, 1), sample(4, 0, 2)]  # the second one without harmonics, in full buckets only
    sections = [section(parts[0], level, degree), section(parts[1], level, 0)]
    (tmp_path / "a.ksplat").write_bytes(ksplat(sections, level, count=9))
    cloud = converters.read(tmp_path / "a.ksplat")[0]
    joined = {name: np.concatenate([part[name] for part in parts]) for name in ("positions", "scales", "wxyz", "rgba")}
    step = BLOCK / 2 / STEPS if level else 0.0
    assert np.abs(cloud.positions - joined["positions"]).max() <= 0.5 * step + 1e-6
    relative = HALF_STEP if level else 0.0
    assert np.allclose(cloud.scales, joined["scales"], rtol=relative, atol=0)
    # Components are off by at most HALF_STEP, the vector by twice that, and again by the division by its length.
    assert np.abs(cloud.orientations[:, [3, 0, 1, 2]] - joined["wxyz"]).max() <= 4 * relative + 1e-6
    assert np.allclose(cloud.opacities, joined["rgba"][:, 3] / 255.0, atol=1e-7)
    assert np.allclose(0.5 + SH_C0 * cloud.radiance[:, 0], joined["rgba"][:, :3] / 255.0, atol=1e-6)
    assert cloud.sh_degree == degree
    assert cloud.axes == "rdf"
    assert not cloud.radiance[5:, 1:].any()
    error = (0.0, HALF_STEP * max(map(abs, SH_RANGE)), (SH_RANGE[1] - SH_RANGE[0]) / 255)[level]
    for channel in range(3):
        for k in range(1, (degree + 1) ** 2):
            column = 3 * channel + k - 1 if k < 4 else 9 + 5 * channel + k - 4
            stored = parts[0]["harmonics"][:, column]
            assert np.abs(cloud.radiance[:5, k, channel] - stored).max() <= error + 1e-6


def test_an_empty_file_is_read(tmp_path):
    (tmp_path / "a.ksplat").write_bytes(ksplat([], 1, count=0))
    assert len(converters.read(tmp_path / "a.ksplat")[0]) == 0


def broken(place, form, value):
    """Return a sound file of level 1 with another value at a byte."""
    content = bytearray(ksplat([section(sample(5, 1, 1), 1, 1)], 1, count=5))
    struct.pack_into(form, content, place, value)
    return bytes(content)


SECTION = 4096

CASES = {
    "no header": (b"\x00\x01" * 100, "must have a header of 4096 bytes, got 200 bytes"),
    # 4096 + 1024, the length and three centres of buckets, 5 rows of 6 + 6 + 8 + 4 + 18 bytes
    "cut": (broken(0, "B", 0)[:-1], "must have 5370 bytes for 1 sections, got 5369"),
    "version": (broken(1, "B", 2), r"must have version 0\.1 .* got version 0\.2, level 1"),
    "level": (broken(20, "<H", 3), r"got version 0\.1, level 3"),
    "sections": (broken(4, "<I", 2**32 - 1), "must have the headers of 4294967295 sections"),
    "rows": (broken(SECTION + 4, "<I", 2**32 - 1), "must have .* bytes for 1 sections"),
    "count": (broken(16, "<I", 6), "must have 6 Gaussians in its sections"),
    "degree": (broken(SECTION + 40, "<H", 3), "spherical harmonics of degree 0 to 2, got 3"),
    "buckets": (broken(SECTION + 12, "<I", 2**31), "must have buckets for all rows"),
    "block": (broken(SECTION + 16, "<f", float("nan")), "must have buckets for all rows"),
    "lengths": (broken(SECTION + 1024, "<I", 7), "partly filled buckets that sum up to its rows, got 7"),
    "range": (broken(36, "<f", float("inf")), "must state a range of spherical harmonics"),
}


@pytest.mark.parametrize("case", CASES)
def test_malformed_files_are_refused(tmp_path, case):
    content, message = CASES[case]
    (tmp_path / "a.ksplat").write_bytes(content)
    with pytest.raises(AssetFormatError, match=message):
        converters.read(tmp_path / "a.ksplat")


def test_a_zero_quaternion_is_refused_or_dropped(tmp_path):
    rows = sample(3, 0, 1)
    rows["wxyz"][1] = 0.0
    (tmp_path / "a.ksplat").write_bytes(ksplat([section(rows, 0, 0)], 0, count=3))
    with pytest.raises(AssetFormatError, match="got zero, NaN or infinity at row 1"):
        converters.read(tmp_path / "a.ksplat")
    assert len(converters.read(tmp_path / "a.ksplat", drop_invalid=True)[0]) == 2
