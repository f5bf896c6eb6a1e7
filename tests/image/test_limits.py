"""Headers that promise more than a picture should cost are refused before memory or time is spent."""

import struct
import tracemalloc

import numpy as np
import OpenEXR
import pytest

from beam_warp.errors import AssetFormatError
from beam_warp.image.files import MAX_FILLED_VALUES, image_size, read_image
from beam_warp.world.environment import EnvironmentMap

HEADER = b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n"


def exr(path, shape, **windows):
    """Write a constant EXR, then replace windows in its header by ``(x0, y0, x1, y1)``."""
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    OpenEXR.File(header, {name: np.ones(shape, np.float16) for name in "RGB"}).write(str(path))
    content = bytearray(path.read_bytes())
    for name, corners in windows.items():
        mark = f"{name}\0box2i\0".encode()
        start = content.index(mark) + len(mark) + 4
        content[start : start + 16] = struct.pack("<4i", *corners)
    path.write_bytes(content)
    return path


def hdr(path, width, height, scanline):
    path.write_bytes(HEADER + b"-Y %d +X %d\n" % (height, width) + scanline * height)
    return path


def old_run(width):
    """One pixel, and the count of its repeats in bytes of growing weight."""
    left = width - 1
    return b"\1\2\3\4" + bytes((1, 1, 1, left & 255, 1, 1, 1, left >> 8))


def new_run(width):
    """Each component as runs of at most 127."""
    runs = [127] * (width // 127) + ([width % 127] if width % 127 else [])
    return bytes((2, 2, width >> 8, width & 255)) + 4 * b"".join(bytes((128 + n, 128)) for n in runs)


def refused(read, path, match):
    """Return the memory that a refusal took [byte]."""
    tracemalloc.start()
    try:
        with pytest.raises(AssetFormatError, match=match):
            read(path)
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


def test_an_environment_has_a_limit_of_its_own(tmp_path):
    limit = r"at most 33554432 px, got (32768|16384) x (16384|8192)"
    for path in (
        exr(tmp_path / "a.exr", (16, 32), displayWindow=(0, 0, 32767, 16383)),
        exr(tmp_path / "b.exr", (16, 32), dataWindow=(0, 0, 16383, 8191), displayWindow=(0, 0, 16383, 8191)),
        hdr(tmp_path / "a.hdr", 32768, 16384, old_run(32768)),
        hdr(tmp_path / "b.hdr", 16384, 8192, new_run(16384)),
    ):
        assert refused(EnvironmentMap.read, path, limit) < 2**22 + 2 * path.stat().st_size


@pytest.mark.parametrize("read", [read_image, EnvironmentMap.read])
def test_a_display_window_of_zeros_is_bounded_by_what_the_file_holds(tmp_path, read):
    path = exr(tmp_path / "a.exr", (16, 32), displayWindow=(0, 0, 8191, 4095))
    assert refused(read, path, "sixteenth of a display window .* got 1536 values for 100663296") < 2**22


def test_a_crop_of_a_film_frame_is_read(tmp_path):
    """A small element in a 4K frame, as compositors write it, is within the bound."""
    assert MAX_FILLED_VALUES > 4 * 4096 * 2160
    image = read_image(exr(tmp_path / "a.exr", (16, 32), displayWindow=(0, 0, 1023, 539)))
    assert (image.width, image.height) == (1024, 540)
    assert image.channels["R"].sum() == 16 * 32


def test_the_size_of_a_radiance_picture_comes_from_its_header(tmp_path):
    path = hdr(tmp_path / "a.hdr", 64, 32, new_run(64))
    path.write_bytes(path.read_bytes()[: len(HEADER) + 40])
    assert image_size(path) == (64, 32)
    with pytest.raises(AssetFormatError, match="truncated one at row"):
        read_image(path)


def test_a_large_radiance_picture_without_its_end_costs_no_more_than_its_file(tmp_path, monkeypatch):
    monkeypatch.setattr("beam_warp.image.hdr.UNCHECKED_PIXELS", 2**18)
    path = hdr(tmp_path / "a.hdr", 1024, 512, new_run(1024))
    path.write_bytes(path.read_bytes()[:-12])
    for read in (read_image, EnvironmentMap.read):
        assert refused(read, path, "truncated one at row 511 of") < 2**20 + 2 * path.stat().st_size


def test_an_exposure_that_overflows_is_refused(tmp_path):
    path = hdr(tmp_path / "a.hdr", 8, 4, new_run(8))
    path.write_bytes(path.read_bytes().replace(b"FORMAT", b"EXPOSURE=1e-320\nFORMAT"))
    with pytest.raises(AssetFormatError, match="EXPOSURE in"):
        read_image(path)
