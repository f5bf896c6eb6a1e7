"""Films: what a decoder finds in them, and what is left and said when ffmpeg fails."""

import os
import stat
import subprocess
import sys

import numpy as np
import pytest

from beam_warp.errors import InvalidArrayError, InvalidOptionError, OutputError
from beam_warp.image import video
from beam_warp.image.video import VideoOptions, find_ffmpeg, require_encoder, write_mp4

FFMPEG = find_ffmpeg()
needs_ffmpeg = pytest.mark.skipif(FFMPEG is None, reason="there is no ffmpeg here")
needs_scripts = pytest.mark.skipif(os.name == "nt", reason="a script is no program on Windows")


def decode(path, height, width):
    """Every frame as RGB, through the matrix and range that the file states."""
    words = [FFMPEG, "-loglevel", "error", "-i", path, "-f", "rawvideo", "-pix_fmt", "rgb24"]
    words += ["-sws_flags", "accurate_rnd+full_chroma_int", "pipe:1"]
    out = subprocess.run(words, capture_output=True, check=True).stdout
    return np.frombuffer(out, np.uint8).reshape(-1, height, width, 3)


def about(path):
    """What ffmpeg says of a file."""
    return subprocess.run([FFMPEG, "-hide_banner", "-i", path], capture_output=True, check=False).stderr.decode()


def fake_ffmpeg(folder, body):
    """A program that stands in for ffmpeg; OUT is its last argument."""
    path = folder / "fake-ffmpeg"
    path.write_text(f"#!{sys.executable}\nimport sys\nfrom pathlib import Path\nOUT = Path(sys.argv[-1])\n{body}\n")
    path.chmod(path.stat().st_mode | stat.S_IXUSR)
    return str(path)


@needs_ffmpeg
class TestFilm:
    def test_grey_ramp_comes_back(self, tmp_path):
        levels = np.linspace(0, 255, 16).round().astype(np.uint8)
        image = np.repeat(np.repeat(levels, 8)[None, :, None], 3, axis=2).repeat(32, axis=0)
        frames = [np.roll(image, 8 * n, axis=1) for n in range(5)]
        assert write_mp4(tmp_path / "x.mp4", frames, VideoOptions(crf=1), ffmpeg=FFMPEG) == 5
        found = decode(tmp_path / "x.mp4", 32, 128)
        assert len(found) == 5
        # 219 levels of luma stand for 255 (0.6), chroma rounds by half a level of 224 (1.0), and the codec at crf 1
        # quantises with steps of about 1.
        assert np.abs(found.astype(int) - np.array(frames).astype(int)).max() <= 3

    def test_colours_are_bt709(self, tmp_path):
        """Green would come back 30 levels off with the matrix of BT.601."""
        colors = np.array([[200, 30, 30], [30, 200, 30], [30, 30, 200], [200, 200, 30]], np.uint8)
        image = colors[None].repeat(16, axis=1).repeat(32, axis=0)
        write_mp4(tmp_path / "x.mp4", [image] * 2, VideoOptions(crf=1), ffmpeg=FFMPEG)
        found = decode(tmp_path / "x.mp4", 32, 64)[1].astype(int)
        for n, color in enumerate(colors):  # away from the edges, which half the resolution of chroma blurs
            assert np.abs(found[4:-4, 16 * n + 4 : 16 * n + 12] - color).max() <= 4
        said = about(tmp_path / "x.mp4")
        assert "h264" in said
        assert "yuv420p(tv, bt709" in said

    def test_odd_sides_repeat_their_last_row_and_column(self, tmp_path, rng):
        image = rng.integers(60, 200, (1, 1, 3)).astype(np.uint8).repeat(7, 0).repeat(5, 1)
        assert write_mp4(tmp_path / "x.mp4", [image], VideoOptions(crf=1), ffmpeg=FFMPEG) == 1
        found = decode(tmp_path / "x.mp4", 8, 6)
        assert found.shape == (1, 8, 6, 3)
        assert np.abs(found[0].astype(int) - image[0, 0].astype(int)).max() <= 4

    def test_an_old_film_is_replaced_and_nothing_else_is_left(self, tmp_path):
        require_encoder(FFMPEG)
        (tmp_path / "x.mp4").write_bytes(b"old")
        options = VideoOptions(frames_per_second=30000 / 1001)
        write_mp4(tmp_path / "x.mp4", [np.zeros((4, 4, 3), np.uint8)] * 3, options, ffmpeg=FFMPEG)
        assert [path.name for path in tmp_path.iterdir()] == ["x.mp4"]
        assert len(decode(tmp_path / "x.mp4", 4, 4)) == 3
        assert "29.97 fps" in about(tmp_path / "x.mp4")
        content = (tmp_path / "x.mp4").read_bytes()
        assert content.index(b"moov") < content.index(b"mdat")  # it plays while it loads

    def test_a_renderer_that_fails_leaves_nothing(self, tmp_path):
        def frames():
            yield np.zeros((4, 4, 3), np.uint8)
            raise KeyboardInterrupt

        with pytest.raises(KeyboardInterrupt):
            write_mp4(tmp_path / "x.mp4", frames(), VideoOptions(), ffmpeg=FFMPEG)
        assert not list(tmp_path.iterdir())

    def test_frames_of_another_size_are_refused(self, tmp_path):
        frames = [np.zeros((4, 4, 3), np.uint8), np.zeros((4, 6, 3), np.uint8)]
        with pytest.raises(InvalidArrayError, match=r"one shape \(H, W, 3\), got uint8 \(4, 6, 3\) in a film of"):
            write_mp4(tmp_path / "x.mp4", frames, VideoOptions(), ffmpeg=FFMPEG)
        assert not list(tmp_path.iterdir())

    def test_a_folder_that_is_not_there(self, tmp_path):
        with pytest.raises(OutputError, match=r"ffmpeg must end well.*No such file or directory"):
            write_mp4(tmp_path / "no" / "x.mp4", [np.zeros((4, 4, 3), np.uint8)], VideoOptions(), ffmpeg=FFMPEG)


@needs_scripts
class TestFailures:
    LARGE = np.zeros((512, 512, 3), np.uint8)  # more than a pipe holds

    @pytest.mark.parametrize(
        "body",
        [
            "sys.stdin.buffer.read()",
            "sys.stdin.buffer.read(10)",  # dies while it is fed
            "pass",
        ],
    )
    def test_its_last_line_is_said_and_nothing_is_left(self, tmp_path, body):
        words = "\nOUT.write_bytes(b'half')\nprint('first', file=sys.stderr)"
        words += "\nprint('av_interleaved_write_frame(): No space left on device', file=sys.stderr)\nsys.exit(1)"
        program = fake_ffmpeg(tmp_path, body + words)
        with pytest.raises(OutputError) as caught:
            write_mp4(tmp_path / "x.mp4", [self.LARGE] * 4, VideoOptions(), ffmpeg=program)
        assert str(caught.value).startswith(f"ffmpeg must end well, got a failure of {program} (av_interleaved_write")
        assert "first" not in str(caught.value)
        assert [path.name for path in tmp_path.iterdir()] == ["fake-ffmpeg"]

    def test_ending_well_without_a_film_is_a_failure_too(self, tmp_path):
        program = fake_ffmpeg(tmp_path, "sys.stdin.buffer.read()")
        with pytest.raises(OutputError, match="exit code 0, and not a word"):
            write_mp4(tmp_path / "x.mp4", [self.LARGE], VideoOptions(), ffmpeg=program)

    def test_no_h264(self, tmp_path):
        program = fake_ffmpeg(tmp_path, "print(' V..... mpeg4  MPEG-4 part 2')")
        message = r"built with libx264, got .*fake-ffmpeg without it. .*beam-warp\[video\]"
        with pytest.raises(OutputError, match=message):
            require_encoder(program)
        require_encoder(fake_ffmpeg(tmp_path, "print(' V....D libx264  H.264')"))
        with pytest.raises(OutputError, match=r"ffmpeg must end well.*\(broken library\)"):
            require_encoder(fake_ffmpeg(tmp_path, "print('broken library', file=sys.stderr); sys.exit(127)"))

    def test_a_program_that_does_not_run(self, tmp_path):
        missing = str(tmp_path / "none")
        for call in (
            lambda: require_encoder(missing),
            lambda: write_mp4(tmp_path / "x.mp4", [self.LARGE], VideoOptions(), ffmpeg=missing),
        ):
            with pytest.raises(OutputError, match="ffmpeg must run, got No such file or directory"):
                call()


def test_where_ffmpeg_comes_from(monkeypatch):
    class Package:
        @staticmethod
        def get_ffmpeg_exe():
            return "/packaged/ffmpeg"

    monkeypatch.setattr(video.shutil, "which", lambda name: f"/path/{name}")
    assert find_ffmpeg() == "/path/ffmpeg"
    monkeypatch.setattr(video.shutil, "which", lambda name: None)
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", Package)
    assert find_ffmpeg() == "/packaged/ffmpeg"
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)  # not installed
    assert find_ffmpeg() is None


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"frames_per_second": 0.0}, "frames_per_second must be a number in"),
        ({"frames_per_second": np.nan}, "frames_per_second must be a number in"),
        ({"crf": 52}, r"crf must be an integer in \[0, 51\], got 52"),
    ],
)
def test_options_are_checked(options, message):
    with pytest.raises(InvalidOptionError, match=message):
        VideoOptions(**options)


def test_a_film_has_a_frame(tmp_path):
    with pytest.raises(InvalidArrayError, match="at least one image, got none"):
        write_mp4(tmp_path / "x.mp4", [], VideoOptions(), ffmpeg="ffmpeg")
