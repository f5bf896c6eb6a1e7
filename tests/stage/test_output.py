"""Names of outputs, and which frames are rendered again: everything that may have happened to a sequence before."""

import json
import os
from pathlib import Path

import pytest

from beam_warp.errors import InvalidOptionError, OutputError
from beam_warp.stage.output import Film, FrameLog, FramePattern, Still, numbered, parse_target, require_folder


class TestNames:
    def test_what_a_name_asks_for(self):
        assert parse_target(Path("a/x.png")) == Still(Path("a/x.png"))
        assert parse_target(Path("x.EXR")) == Still(Path("x.EXR"))
        assert parse_target(Path("x.mp4")) == Film(Path("x.mp4"))
        pattern = parse_target(Path("frames/a%04d_b.exr"))
        assert pattern == FramePattern(Path("frames"), "a", 4, "_b.exr")
        assert pattern.path(12) == Path("frames/a0012_b.exr")
        assert pattern.path(123456) == Path("frames/a123456_b.exr")
        assert (str(pattern), pattern.kind) == (str(Path("frames/a%04d_b.exr")), ".exr")

    def test_fields_without_digits_and_percent_signs(self):
        pattern = parse_target(Path("%d.PNG"))
        assert (pattern.path(7).name, pattern.kind, str(pattern)) == ("7.PNG", ".png", "%d.PNG")
        pattern = parse_target(Path("100%%_%03d_50%%.png"))
        assert pattern.path(7).name == "100%_007_50%.png"
        assert parse_target(Path(str(pattern))) == pattern

    @pytest.mark.parametrize(
        "name",
        ["%04d_%04d.png", "%s.png", "100%.png", "%04d.mp4", "%04d/x.png", "%f.exr", "%4d.png", "%099d.png", "%%.png"],
    )
    def test_one_integer_field(self, name):
        message = "out must have one integer field in the name of an image, such as"
        with pytest.raises(InvalidOptionError, match=message):
            parse_target(Path(name))

    @pytest.mark.parametrize("name", ["x.gif", "x", "x.jpg", "x.png.bak"])
    def test_other_kinds(self, name):
        with pytest.raises(InvalidOptionError, match=r"out must end in \.png, \.exr or \.mp4, got x"):
            parse_target(Path(name))

    def test_several_images_of_one_name(self):
        assert numbered(Still(Path("a/x.png"))).path(12) == Path("a/x000012.png")

    def test_frames_of_a_film(self):
        film = Film(Path("a/x.mp4"))
        assert film.work.path(3) == Path("a/.x.mp4.frames/000003.png")
        assert film.instead.path(3) == Path("a/x/000003.png")

    def test_frames_of_a_film_go_when_it_is_whole(self, tmp_path):
        film = Film(tmp_path / "x.mp4")
        require_folder(film.work)
        film.work.path(0).touch()
        film.discard_work()
        film.discard_work()
        assert not list(tmp_path.iterdir())


class TestFolders:
    def test_folders_are_made(self, tmp_path):
        for target in (FramePattern(tmp_path / "a" / "b", "", 4, ".png"), Still(tmp_path / "c" / "d" / "x.png")):
            require_folder(target)
        assert (tmp_path / "a" / "b").is_dir()
        assert (tmp_path / "c" / "d").is_dir()

    def test_refusals(self, tmp_path):
        (tmp_path / "file").touch()
        (tmp_path / "x.png").mkdir()
        for target, message in (
            (Film(tmp_path / "file" / "x.mp4"), r"exists or can be made, got .* \(File exists"),
            (FramePattern(tmp_path / "file" / "no", "", 4, ".png"), r"exists or can be made, got .* \(Not a dir"),
            (FramePattern(tmp_path / "file", "", 4, ".png"), r"exists or can be made, got .* \(File exists"),
            (Still(tmp_path / "x.png"), "out must be a file, got the folder"),
        ):
            with pytest.raises(OutputError, match=message):
                require_folder(target)

    def test_a_folder_that_is_closed(self, tmp_path, monkeypatch):
        monkeypatch.setattr(os, "access", lambda *_: False)  # whoever runs the tests may write anywhere
        with pytest.raises(OutputError, match="out must be in a folder that can be written"):
            require_folder(Still(tmp_path / "x.png"))


@pytest.fixture
def pattern(tmp_path):
    return FramePattern(tmp_path, "f", 3, ".png")


def render(pattern, digests, *, overwrite=False):
    """Fill a sequence; returns the frames that were rendered."""
    log, done = FrameLog(pattern), []

    for number in log.missing(digests, digests.__getitem__, overwrite=overwrite):
        log.write(number, digests[number], lambda path: path.write_text(f"image {len(done)}"))
        done.append(number)
    return done


class TestResume:
    JOB = {number: f"digest {number}" for number in range(5)}  # noqa: RUF012

    def test_a_frame_of_another_size_is_not_ours(self, pattern):
        render(pattern, self.JOB)
        pattern.path(3).write_text("painted over")
        message = r"f003.png of another input, option or version \(1 in all\). Pass --over"
        with pytest.raises(OutputError, match=message):
            render(pattern, self.JOB)
        assert render(pattern, self.JOB, overwrite=True) == [3]

    def test_another_render_is_refused_or_replaced(self, pattern):
        render(pattern, self.JOB)
        other = {number: "other" if number > 2 else digest for number, digest in self.JOB.items()}
        with pytest.raises(OutputError, match=r"f003.png of another input, option or version \(2 in all\)"):
            render(pattern, other)
        assert render(pattern, self.JOB) == []  # nothing was touched
        assert render(pattern, other, overwrite=True) == [3, 4]
        assert render(pattern, other) == []

    def test_images_that_were_there_before_are_refused(self, pattern):
        pattern.path(2).write_text("mine")
        with pytest.raises(OutputError, match=r"f002.png of another"):
            render(pattern, self.JOB)
        assert pattern.path(2).read_text() == "mine"
        assert render(pattern, {5: "x"}) == [5]  # but others beside them are no matter

    def test_killed_between_image_and_log(self, pattern):
        log = FrameLog(pattern)
        log.write(0, "digest 0", lambda path: path.write_text("image"))
        pattern.log.write_text(pattern.log.read_text().splitlines()[0] + "\n")  # the second line was never written
        assert render(pattern, self.JOB) == [0, 1, 2, 3, 4]

    @pytest.mark.parametrize(
        "end", ['{"frame": 1, "dig', "[]", "null", '{"frame": "1", "digest": "x", "size": 3}', "\x00"]
    )
    def test_a_line_that_is_broken_counts_as_none(self, pattern, end):
        render(pattern, {0: "a", 1: "b"})
        lines = pattern.log.read_text().splitlines()
        pattern.log.write_text("\n".join([*lines[:-1], end]))
        assert render(pattern, {0: "a", 1: "b"}) == [1]
        assert render(pattern, {0: "a", 1: "b"}) == []  # and takes no later line along

    def test_digests_are_asked_of_whole_frames_only(self, pattern):
        render(pattern, {0: "a"})
        asked = []
        FrameLog(pattern).missing(range(5), lambda number: asked.append(number) or "a")
        assert asked == [0]

    def test_two_runs_at_once(self, pattern):
        first, second = FrameLog(pattern), FrameLog(pattern)
        for number in range(4):
            (first, second)[number % 2].write(number, self.JOB[number], lambda path: path.write_text("image"))
        assert render(pattern, self.JOB) == [4]
        assert len([json.loads(line) for line in pattern.log.read_text().splitlines()]) == 10

    def test_a_log_that_cannot_be_used(self, pattern):
        pattern.log.mkdir()
        with pytest.raises(OutputError, match=r"output must be readable and writable, got .*Is a directory"):
            FrameLog(pattern)

    def test_sequences_in_one_folder_have_their_own_logs(self, tmp_path):
        names = ("%04d.png", "%04d.exr", "a%04d.png", "a%04d_b.png")
        logs = {parse_target(tmp_path / name).log for name in names}
        assert len(logs) == len(names)
