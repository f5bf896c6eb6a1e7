"""Captures whose cameras are videos: the views of images that were decoded from them, by time."""

import json
import subprocess
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from beam_warp.capture import digests
from beam_warp.capture.capture import Capture
from beam_warp.capture.digests import CaptureDigests
from beam_warp.errors import AssetFormatError, MissingFileError, MissingPackageError
from beam_warp.image import film
from beam_warp.image.files import write_exr
from beam_warp.image.film import film_of, film_times, read_film_frame
from beam_warp.image.video import VideoOptions, find_ffmpeg, write_mp4

FFMPEG = find_ffmpeg()
needs_ffmpeg = pytest.mark.skipif(FFMPEG is None, reason="there is no ffmpeg here")
HEIGHT, WIDTH, RATE, COUNT = 32, 48, 25.0, 8


def pictures(seed):
    """Smooth colours that change from frame to frame: a codec keeps them apart."""
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    for frame in range(COUNT):
        yield (
            np.stack([4 * x + 8 * frame, 6 * y + seed, 255 - 20 * frame + 0 * x], axis=-1).clip(0, 255).astype(np.uint8)
        )


def decoded(path):
    """All frames in order, decoded by one process, 0 to 1."""
    words = "scale=out_range=pc:flags=accurate_rnd+full_chroma_int+bicubic,format=rgb48le"
    command = [
        FFMPEG,
        "-loglevel",
        "error",
        "-i",
        path,
        "-vf",
        words,
        "-fps_mode",
        "passthrough",
        "-f",
        "rawvideo",
        "-",
    ]
    raw = subprocess.run(command, capture_output=True, check=True).stdout
    return np.frombuffer(raw, "<u2").reshape(-1, HEIGHT, WIDTH, 3).astype(np.float32) / np.float32(65535)


def described(folder, records, **more):
    pose = np.eye(4).tolist()
    content = {"w": WIDTH, "h": HEIGHT, "fl_x": 40.0, "fl_y": 40.0, "cx": 24.0, "cy": 16.0}
    content |= more | {"frames": [{"transform_matrix": pose, **record} for record in records]}
    (folder / "transforms.json").write_text(json.dumps(content))
    return Capture.read(folder)


@pytest.fixture(scope="module")
def filmed(tmp_path_factory):
    """A folder with two videos and a mask's."""
    folder = tmp_path_factory.mktemp("filmed")
    for name, seed in (("a", 0), ("b", 40), ("mask", 90)):
        write_mp4(folder / f"{name}.mp4", pictures(seed), VideoOptions(frames_per_second=RATE), ffmpeg=FFMPEG)
    return folder


@needs_ffmpeg
def test_videos_give_the_views_of_images_decoded_from_them(filmed, tmp_path):
    films = described(filmed, [{"file_path": f"{name}.mp4", "mask_path": "mask.mp4"} for name in "ab"])
    records = []
    for name in ("a", "b", "mask"):
        for frame, image in enumerate(decoded(filmed / f"{name}.mp4")):
            write_exr(tmp_path / f"{name}_{frame}.exr", dict(zip("RGB", np.moveaxis(image, -1, 0), strict=True)))
            if name != "mask":
                of_frame = {"camera": name, "frame": frame, "color_space": "srgb", "mask_path": f"mask_{frame}.exr"}
                records.append({"file_path": f"{name}_{frame}.exr", **of_frame})
    images = described(tmp_path, records)
    assert films.frames_per_second == pytest.approx(RATE)
    assert [record.name for record in films.records] == [record.name for record in images.records]
    for ours, theirs in zip(films.records, images.records, strict=True):
        assert np.array_equal(ours.photograph().rgb(), theirs.photograph().rgb())
    for arrays in zip(
        *(vars(record.view()).items() for record in (films.records[-1], images.records[-1])), strict=True
    ):
        assert arrays[0][0] in ("name", "camera") or np.array_equal(arrays[0][1], arrays[1][1]), arrays[0][0]


@needs_ffmpeg
def test_frames_go_by_time(filmed, tmp_path):
    """A camera that began three frames late and dropped every other frame shows what the first one shows then."""
    words = ["-vf", "select=not(mod(n\\,2))", "-fps_mode", "passthrough", "-c:v", "ffv1", tmp_path / "half.mkv"]
    subprocess.run([FFMPEG, "-loglevel", "error", "-i", filmed / "a.mp4", *words], check=True)
    assert np.allclose(film_times(tmp_path / "half.mkv") * RATE, [0, 2, 4, 6], atol=0.03)
    late = {"file_path": "half.mkv", "video_start": 3.0 / RATE}
    capture = described(tmp_path, [{**late, "camera": "all"}, {**late, "camera": "one", "frame": 3}], fps=RATE)
    assert [record.name for record in capture.records] == ["all_0001", "all_0003", "one_0003"]
    assert [round(record.moment * RATE) for record in capture.records] == [4, 6, 6]
    at = decoded(tmp_path / "half.mkv")
    assert np.array_equal(capture.records[2].photograph().rgb(), at[3])


@needs_ffmpeg
def test_a_video_is_digested_once(filmed, tmp_path, monkeypatch):
    read = []

    def counted(path, known):
        read.append(path) if str(path) not in known else None
        return (1, 2, 3, 4), "digest"

    monkeypatch.setattr(digests, "content_digest", counted)
    capture = described(filmed, [{"file_path": "a.mp4"}])
    memory = CaptureDigests(tmp_path)
    with ThreadPoolExecutor(1) as pool:
        found = {memory.of(record.frame, [record], pool) for record in capture.records}
    assert len(found) == COUNT
    assert len(read) == 1


@needs_ffmpeg
def test_what_is_no_video_is_refused(filmed, tmp_path):
    path = tmp_path / "x.mp4"
    for content in (b"", b"no video" * 500, (filmed / "a.mp4").read_bytes()[:200]):
        path.write_bytes(content)
        with pytest.raises(AssetFormatError, match=r"^video must hold pictures that ffmpeg knows, got none in .*\.mp4"):
            film_of(path)
    with pytest.raises(AssetFormatError, match=r"video must have a frame at 9\.000 s, got none"):
        read_film_frame(filmed / "a.mp4", 9.0)
    with pytest.raises(MissingFileError, match="video must be a readable file"):
        described(tmp_path, [{"file_path": "gone.mp4"}])


@needs_ffmpeg
def test_high_dynamic_range_is_refused(filmed, tmp_path):
    tags = ["-vf", "setparams=color_trc=smpte2084:color_primaries=bt2020:colorspace=bt2020nc"]
    subprocess.run([FFMPEG, "-loglevel", "error", "-i", filmed / "a.mp4", *tags, tmp_path / "x.mp4"], check=True)
    with pytest.raises(AssetFormatError, match="video must be of standard dynamic range"):
        film_of(tmp_path / "x.mp4")


def test_ffmpeg_that_is_not_there(tmp_path, monkeypatch):
    monkeypatch.setattr(film, "find_ffmpeg", lambda: None)
    (tmp_path / "x.mp4").write_bytes(b"")
    with pytest.raises(MissingPackageError, match=r"ffmpeg must be there to read videos.*beam-warp\[video\]"):
        film_of(tmp_path / "x.mp4")
