"""Images: the sRGB curve, round trips, foreign encodings, and refusals."""

import re
import struct
import zlib

import numpy as np
import OpenEXR
import pytest
from PIL import Image as PillowImage

from beam_warp.errors import AssetFormatError, InvalidArrayError, InvalidOptionError, MissingFileError, OutputError
from beam_warp.image import files
from beam_warp.image.color import DISPLAY_SRGB, LINEAR_REC709, linear_to_srgb, srgb_to_linear
from beam_warp.image.files import display_image, read_image, write_exr, write_png

# Powers in float64 are good to a few ulp; the curve's slope is at most 12.92.
SRGB_TOLERANCE = 64 * np.finfo(np.float64).eps


class TestSrgb:
    def test_values_of_the_standard(self):
        assert linear_to_srgb(np.array([0.0, 1.0])) == pytest.approx([0.0, 1.0], abs=SRGB_TOLERANCE)
        assert linear_to_srgb(np.float64(0.002)) == pytest.approx(12.92 * 0.002, abs=SRGB_TOLERANCE)
        assert linear_to_srgb(np.float64(0.5)) == pytest.approx(1.055 * 0.5 ** (1 / 2.4) - 0.055, abs=SRGB_TOLERANCE)
        assert srgb_to_linear(np.float64(0.04)) == pytest.approx(0.04 / 12.92, abs=SRGB_TOLERANCE)

    def test_inverse_both_ways(self):
        x = np.concatenate([np.linspace(-2.0, 4.0, 10001), [0.0031308, 12.92 * 0.0031308]])
        np.testing.assert_allclose(srgb_to_linear(linear_to_srgb(x)), x, atol=SRGB_TOLERANCE * 4)
        np.testing.assert_allclose(linear_to_srgb(srgb_to_linear(x)), x, atol=SRGB_TOLERANCE * 4)

    def test_monotone_over_the_knee(self):
        x = np.linspace(0.0, 0.01, 100001)
        assert (np.diff(linear_to_srgb(x)) > 0).all()
        assert (np.diff(srgb_to_linear(x)) > 0).all()

    def test_float32_stays_float32(self):
        assert linear_to_srgb(np.ones(3, np.float32)).dtype == np.float32
        assert srgb_to_linear(np.ones(3, np.float32)).dtype == np.float32

    def test_every_byte_survives(self):
        levels = np.arange(256)
        rgb = srgb_to_linear(levels / 255)[None, :, None].repeat(3, 2)
        np.testing.assert_array_equal(display_image(rgb)[0, :, 0], levels)

    def test_exposure_and_clip(self):
        np.testing.assert_array_equal(display_image(np.full((1, 1, 3), 0.25), 2.0), 255)
        np.testing.assert_array_equal(display_image(np.array([[[-1.0, 0.0, 9.0]]])), [[[0, 0, 255]]])

    def test_refuses_nan(self):
        with pytest.raises(InvalidArrayError, match="linear_rgb must be finite, got NaN or infinity at row 1"):
            display_image(np.array([[[0.0] * 3], [[np.nan] * 3]]))


class TestExr:
    @pytest.mark.parametrize("half", [False, True])
    def test_round_trip_is_exact(self, tmp_path, rng, half):
        kind = np.float16 if half else np.float32
        names = ("R", "G", "B", "A", "base_color.R", "normal.X", "depth")
        channels = {name: rng.normal(size=(5, 9)).astype(kind).astype(np.float32) for name in names}
        write_exr(tmp_path / "a.exr", channels, half=half)
        image = read_image(tmp_path / "a.exr")
        assert (image.height, image.width) == (5, 9)
        assert image.color_space == LINEAR_REC709
        assert set(image.channels) == set(names)
        for name in names:
            np.testing.assert_array_equal(image.channels[name], channels[name])
        np.testing.assert_array_equal(image.stack("depth", "A")[..., 0], channels["depth"])
        np.testing.assert_array_equal(image.linear_rgba()[..., 3], channels["A"])

    def test_failed_write_keeps_the_old_file(self, tmp_path, monkeypatch):
        write_exr(tmp_path / "a.exr", {"Y": np.ones((2, 2))})
        assert [p.name for p in tmp_path.iterdir()] == ["a.exr"]
        monkeypatch.setattr(files.os, "replace", lambda *_: (_ for _ in ()).throw(OSError(28, "No space left")))
        with pytest.raises(
            OutputError, match=r"output must be a writable file, got .*a\.exr \(No space left on device\)"
        ):
            write_exr(tmp_path / "a.exr", {"Y": np.zeros((2, 2))})
        assert [p.name for p in tmp_path.iterdir()] == ["a.exr"]
        assert (read_image(tmp_path / "a.exr").channels["Y"] == 1).all()

    def test_missing_folder(self, tmp_path):
        with pytest.raises(OutputError, match="Choose a folder that exists"):
            write_exr(tmp_path / "none" / "a.exr", {"Y": np.zeros((2, 2))})

    @pytest.mark.parametrize(
        ("channels", "half", "message"),
        [
            ({}, False, "channels must hold at least one channel, got none"),
            ({"R": np.zeros((2, 2)), "G": np.zeros((2, 3))}, False, r"G must have the shape .* got \(2, 3\)"),
            ({"R": np.zeros((0, 2))}, False, "not empty"),
            ({"R": np.full((2, 2), 7e4)}, True, "R must be at most 65504 in size as half floats, got 70000"),
        ],
    )
    def test_refuses_to_write(self, tmp_path, channels, half, message):
        with pytest.raises(InvalidArrayError, match=message):
            write_exr(tmp_path / "a.exr", channels, half=half)
        assert not list(tmp_path.iterdir())

    def test_data_window_is_laid_into_the_display_window(self, tmp_path):
        header = {
            "compression": OpenEXR.ZIP_COMPRESSION,
            "type": OpenEXR.scanlineimage,
            "dataWindow": (np.array([-1, 2], np.int32), np.array([2, 3], np.int32)),
            "displayWindow": (np.array([0, 0], np.int32), np.array([4, 5], np.int32)),
        }
        values = np.arange(8, dtype=np.float32).reshape(2, 4)
        OpenEXR.File(header, {"Y": values}).write(str(tmp_path / "a.exr"))
        expected = np.zeros((6, 5), np.float32)
        expected[2:4, 0:3] = values[:, 1:]
        np.testing.assert_array_equal(read_image(tmp_path / "a.exr").channels["Y"], expected)

    def test_missing_channel_is_named(self, tmp_path):
        write_exr(tmp_path / "a.exr", {"depth": np.zeros((2, 2))})
        with pytest.raises(AssetFormatError, match=r"must have the channels R, G, B, got depth in .*a\.exr"):
            read_image(tmp_path / "a.exr").rgb()

    def test_truncated_anywhere(self, tmp_path, rng):
        write_exr(tmp_path / "a.exr", {"R": rng.random((40, 8))})
        data = (tmp_path / "a.exr").read_bytes()
        for size in (0, 3, 100, 200, len(data) // 2, len(data) - 1):
            (tmp_path / "b.exr").write_bytes(data[:size])
            with pytest.raises(AssetFormatError, match=r"image must be an intact EXR file, got a damaged one at .*b\."):
                read_image(tmp_path / "b.exr")

    def test_size_is_checked_in_the_header(self, tmp_path):
        write_exr(tmp_path / "a.exr", {"R": np.zeros((2, 2))})
        data = bytearray((tmp_path / "a.exr").read_bytes())
        for name in (b"dataWindow", b"displayWindow"):
            at = data.find(name) + len(name) + len(b"\0box2i\0") + 4
            data[at : at + 16] = struct.pack("<4i", 0, 0, 39_999, 9)
        (tmp_path / "b.exr").write_bytes(data)
        with pytest.raises(AssetFormatError, match=r"sides in \[1, 32768\] px .* got 40000 x 10"):
            read_image(tmp_path / "b.exr")

    def test_several_parts_are_refused(self, tmp_path):
        header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
        parts = [OpenEXR.Part({**header, "name": n}, {"Y": np.zeros((2, 2), np.float32)}) for n in ("a", "b")]
        OpenEXR.File(parts).write(str(tmp_path / "a.exr"))
        with pytest.raises(AssetFormatError, match="flat EXR of one part, got 2 parts"):
            read_image(tmp_path / "a.exr")


def png(path, values, color_type, bits=16):
    """Write an unfiltered PNG without Pillow, which has no 16-bit colour."""

    def chunk(tag, body):
        return struct.pack(">I", len(body)) + tag + body + struct.pack(">I", zlib.crc32(tag + body))

    head = struct.pack(">IIBBBBB", values.shape[1], values.shape[0], bits, color_type, 0, 0, 0)
    rows = b"".join(b"\0" + row.tobytes() for row in values.astype(">u2"))
    path.write_bytes(
        b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", zlib.compress(rows)) + chunk(b"IEND", b"")
    )


class TestPngAndJpeg:
    @pytest.mark.parametrize("channels", [1, 3, 4])
    def test_round_trip(self, tmp_path, rng, channels):
        pixels = rng.integers(0, 256, (4, 6, channels), dtype=np.uint8)
        write_png(tmp_path / "a.png", pixels[..., 0] if channels == 1 else pixels)
        image = read_image(tmp_path / "a.png")
        assert image.color_space == DISPLAY_SRGB
        np.testing.assert_allclose(image.rgb() * 255, pixels[..., :3].repeat(3 if channels == 1 else 1, 2), atol=1e-4)
        assert (image.alpha is None) == (channels != 4)
        assert [p.name for p in tmp_path.iterdir()] == ["a.png"]

    @pytest.mark.parametrize(("color_type", "channels"), [(0, "Y"), (2, "RGB"), (6, "RGBA")])
    def test_sixteen_bits_lose_nothing(self, tmp_path, rng, color_type, channels):
        values = rng.integers(0, 65536, (5, 7, len(channels)))
        png(tmp_path / "a.png", values, color_type)
        image = read_image(tmp_path / "a.png")
        np.testing.assert_array_equal(np.rint(image.stack(*channels) * 65535), values)

    def test_sixteen_bit_grey_with_alpha_is_refused(self, tmp_path):
        png(tmp_path / "a.png", np.zeros((2, 2, 2)), 4)
        with pytest.raises(AssetFormatError, match="grey, RGB or RGBA, of 8 or 16 bits"):
            read_image(tmp_path / "a.png")

    def test_linear_rgba_decodes_and_multiplies(self, tmp_path):
        write_png(tmp_path / "a.png", np.array([[[188, 188, 188, 51]]], np.uint8))
        expected = srgb_to_linear(188 / 255) * 0.2
        found = read_image(tmp_path / "a.png").linear_rgba()
        np.testing.assert_allclose(found[0, 0], [*[expected] * 3, 0.2], rtol=1e-6)
        # The same bytes declared linear are not decoded.
        linear = read_image(tmp_path / "a.png", color_space=LINEAR_REC709).linear_rgba()
        np.testing.assert_allclose(linear[0, 0, 0], 188 / 255 * 0.2, rtol=1e-6)

    def test_premultiplied_display_values_are_decoded_before_the_product(self, tmp_path):
        write_exr(tmp_path / "a.exr", {"R": [[0.2]], "G": [[0.0]], "B": [[0.0]], "A": [[0.5]]})
        rgba = read_image(tmp_path / "a.exr", color_space=DISPLAY_SRGB).linear_rgba()
        np.testing.assert_allclose(rgba[0, 0, 0], srgb_to_linear(0.4) * 0.5, rtol=1e-6)

    def test_palette_and_jpeg(self, tmp_path):
        PillowImage.new("P", (3, 2)).save(tmp_path / "a.png")
        assert read_image(tmp_path / "a.png").rgb().shape == (2, 3, 3)
        PillowImage.new("RGB", (8, 8), (255, 0, 0)).save(tmp_path / "a.jpg", quality=95)
        red = [[[1, 0, 0]]] * np.ones((8, 8, 1))
        np.testing.assert_allclose(read_image(tmp_path / "a.jpg").rgb(), red, atol=2 / 255)

    @pytest.mark.parametrize("size", [0, 40])
    def test_truncated(self, tmp_path, rng, size):
        write_png(tmp_path / "a.png", rng.integers(0, 256, (9, 9, 3), dtype=np.uint8))
        (tmp_path / "b.png").write_bytes((tmp_path / "a.png").read_bytes()[:size])
        with pytest.raises(AssetFormatError, match="image must be an intact PNG file, got a damaged one"):
            read_image(tmp_path / "b.png")

    def test_cmyk_is_refused(self, tmp_path):
        PillowImage.new("CMYK", (8, 8)).save(tmp_path / "a.jpg")
        with pytest.raises(AssetFormatError, match="got mode CMYK"):
            read_image(tmp_path / "a.jpg")

    def test_write_refuses_floats(self, tmp_path):
        with pytest.raises(InvalidArrayError, match=r"pixels must be uint8 .* Encode linear values with display_image"):
            write_png(tmp_path / "a.png", np.zeros((2, 2, 3)))


def test_unknown_suffix_missing_file_and_unknown_space(tmp_path):
    with pytest.raises(AssetFormatError, match=r"got .*a\.tga\. Convert it"):
        read_image(tmp_path / "a.tga")
    with pytest.raises(MissingFileError, match="no such file"):
        read_image(tmp_path / "a.png")
    with pytest.raises(InvalidOptionError, match="color_space must be one of"):
        read_image(tmp_path / "a.png", color_space="aces")


def test_messages_are_one_line(tmp_path):
    (tmp_path / "a.exr").write_bytes(b"garbage")
    with pytest.raises(AssetFormatError) as caught:
        read_image(tmp_path / "a.exr")
    assert re.fullmatch(r"[^\n]+\.", str(caught.value))
