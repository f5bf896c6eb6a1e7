"""Radiance pictures: the three encodings of one picture agree; damage is refused with its place."""

import numpy as np
import pytest

from beam_warp.errors import AssetFormatError
from beam_warp.image.files import read_image

HEADER = b"#?RADIANCE\n# a comment\nFORMAT=32-bit_rle_rgbe\n\n"


def resolution(rgbe, signs=b"-+"):
    return signs[:1] + b"Y %d " % rgbe.shape[0] + signs[1:] + b"X %d\n" % rgbe.shape[1]


def flat(rgbe):
    return rgbe.tobytes()


def old_runs(rgbe):
    """Each pixel once, then repeats of it as one or two (1, 1, 1, n) entries."""
    out = b""
    for row in rgbe:
        column = 0
        while column < len(row):
            end = column + 1
            while end < len(row) and (row[end] == row[column]).all():
                end += 1
            repeats = end - column - 1
            out += row[column].tobytes()
            if repeats:
                out += bytes((1, 1, 1, repeats & 255))
            if repeats > 255:
                out += bytes((1, 1, 1, repeats >> 8))
            column = end
    return out


def new_runs(rgbe):
    """Per component: runs of at least three, and literals."""
    out = b""
    for row in rgbe:
        out += bytes((2, 2, len(row) >> 8, len(row) & 255))
        for component in row.T:
            column = 0
            while column < len(row):
                end = column + 1
                while end < len(row) and component[end] == component[column] and end - column < 127:
                    end += 1
                if end - column > 2:
                    out += bytes((128 + end - column, component[column]))
                else:
                    end = min(column + 5, len(row))
                    out += bytes((end - column,)) + component[column:end].tobytes()
                column = end
    return out


@pytest.fixture
def picture(rng):
    """RGBE with long and short repeats; no pixel looks like a marker of either encoding."""
    rgbe = rng.integers(3, 256, (6, 700, 4), dtype=np.uint8)
    rgbe[..., 3] = rng.integers(120, 140, (6, 700))
    rgbe[1, 100:] = rgbe[1, 100]
    rgbe[2, :40] = rgbe[2, 0]
    rgbe[3] = rgbe[3, 0]
    rgbe[4, ::9, 3] = 0
    return rgbe


@pytest.mark.parametrize("encode", [flat, old_runs, new_runs])
def test_encodings_agree_with_the_definition(tmp_path, picture, encode):
    (tmp_path / "a.hdr").write_bytes(HEADER + resolution(picture) + encode(picture))
    expected = picture[..., :3] * np.exp2(picture[..., 3:].astype(np.float64) - 136)
    expected[picture[..., 3] == 0] = 0
    np.testing.assert_array_equal(read_image(tmp_path / "a.hdr").rgb(), expected.astype(np.float32))


def test_new_runs_of_narrow_pictures_are_flat(tmp_path):
    rgbe = np.array([[[2, 2, 0, 130], [9, 9, 9, 128]]], np.uint8)
    (tmp_path / "a.hdr").write_bytes(HEADER + resolution(rgbe) + flat(rgbe))
    np.testing.assert_array_equal(read_image(tmp_path / "a.hdr").rgb()[0, 1], 9 / 256)


@pytest.mark.parametrize(("signs", "step"), [(b"-+", (1, 1)), (b"++", (-1, 1)), (b"--", (1, -1))])
def test_scan_order(tmp_path, picture, signs, step):
    (tmp_path / "a.hdr").write_bytes(HEADER + resolution(picture) + flat(picture))
    (tmp_path / "b.hdr").write_bytes(HEADER + resolution(picture, signs) + flat(picture[:: step[0], :: step[1]]))
    np.testing.assert_array_equal(read_image(tmp_path / "a.hdr").rgb(), read_image(tmp_path / "b.hdr").rgb())


def test_exposures_are_divided_out(tmp_path, picture):
    (tmp_path / "a.hdr").write_bytes(HEADER + resolution(picture) + flat(picture))
    (tmp_path / "b.hdr").write_bytes(b"#?RGBE\nEXPOSURE=2\nEXPOSURE= 4\n\n" + resolution(picture) + flat(picture))
    np.testing.assert_array_equal(read_image(tmp_path / "b.hdr").rgb() * 8, read_image(tmp_path / "a.hdr").rgb())


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"", "must be a Radiance picture"),
        (HEADER + b"+X 4 -Y 4\n" + bytes(64), "must be a Radiance picture with a '-Y height .X width' line"),
        (b"#?RADIANCE\nFORMAT=32-bit_rle_xyze\n\n-Y 1 +X 1\n0000", "got '32-bit_rle_xyze'"),
        (b"#?RADIANCE\nEXPOSURE=0\n\n-Y 1 +X 1\n0000", r"EXPOSURE in \(1e-30, 1e30\), got 0.0"),
        (b"#?RADIANCE\nEXPOSURE=x\n\n-Y 1 +X 1\n0000", r"EXPOSURE in \(1e-30, 1e30\), got nan"),
        (HEADER + b"-Y 40000 +X 2\n" + bytes(64), r"sides in \[1, 32768\] px"),
        (HEADER + b"-Y 30000 +X 30000\n" + bytes(64), "at most 268435456 px, got 30000 x 30000"),
        (HEADER + b"-Y 30000 +X 8000\n" + bytes(64), "truncated one at row 0"),
        (HEADER + b"-Y 2 +X 2\n" + bytes(12), "truncated one at row 1"),
        (HEADER + b"-Y 1 +X 2\n" + bytes((1, 1, 1, 1)), "truncated one at row 0"),
        (HEADER + b"-Y 1 +X 9\n" + bytes((7, 7, 7, 128, 1, 1, 1, 9)), "truncated one at row 0"),
        (HEADER + b"-Y 1 +X 9\n" + bytes((2, 2, 0, 9, 138, 5)) + bytes(60), "truncated one at row 0"),
        (HEADER + b"-Y 1 +X 9\n" + bytes((2, 2, 0, 9, 0, 5)) + bytes(60), "truncated one at row 0"),
        (HEADER + b"-Y 1 +X 9\n" + bytes((2, 2, 0, 9, 137, 5, 137)), "truncated one at row 0"),
        (HEADER + b"-Y 2 +X 9\n" + bytes((2, 2, 0, 9, *(137, 5) * 3, 12, *range(9))), "truncated one at row 0"),
    ],
)
def test_refusals(tmp_path, data, message):
    (tmp_path / "a.hdr").write_bytes(data)
    with pytest.raises(AssetFormatError, match=message):
        read_image(tmp_path / "a.hdr")


def test_huge_repeat_counts_do_not_allocate(tmp_path):
    rgbe = bytes((7, 7, 7, 128)) + bytes((1, 1, 1, 255)) * 4
    (tmp_path / "a.hdr").write_bytes(HEADER + b"-Y 1 +X 9000\n" + rgbe * 20)
    with pytest.raises(AssetFormatError, match="truncated one at row 0"):
        read_image(tmp_path / "a.hdr")


def test_every_truncation_is_refused(tmp_path, picture):
    data = HEADER + resolution(picture[:2]) + new_runs(picture[:2])
    for size in range(0, len(data), 37):
        (tmp_path / "a.hdr").write_bytes(data[:size])
        with pytest.raises(AssetFormatError):
            read_image(tmp_path / "a.hdr")


@pytest.mark.parametrize("name", ["studio", "sunrise", "night"])
def test_pictures_of_other_tools(data_dir, name):
    rgb = read_image(data_dir / f"hdri/{name}.hdr").rgb()
    assert rgb.shape == (512, 1024, 3)
    assert np.isfinite(rgb).all()
    assert 0.0 < rgb.mean() < 10.0
