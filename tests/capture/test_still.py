"""Plates by what stands still: a disc that wanders before a wall that is known."""

import numpy as np
import pytest
from PIL import Image as PillowImage
from support.commands import beam
from support.sound_capture import HEIGHT, WIDTH, rewrite, rig, save, write_sound

from beam_warp.capture.capture import Capture
from beam_warp.capture.inspect import inspect_capture
from beam_warp.capture.still import write_plates
from beam_warp.errors import AssetFormatError
from beam_warp.image.files import read_image, write_exr

FRAMES, STEP, RADIUS = 7, 5, 4
ROWS, COLUMNS = np.mgrid[:HEIGHT, :WIDTH]
WALL = np.stack([40 + COLUMNS, 50 + 2 * ROWS, 60 + (ROWS + COLUMNS) % 7], -1).astype(np.uint8)


def inside(frame):
    return np.hypot(COLUMNS - STEP * (frame + 0.5), ROWS - 15) < RADIUS


def write_wandering(folder, frames=FRAMES, cameras=3):
    """A white disc that moves on by more than its radius: no pixel is covered in three frames."""
    content = write_sound(folder, rig(cameras), frames)
    for entry in content["frames"]:
        image = np.where(inside(entry["frame"])[..., None], 250, WALL).astype(np.uint8)
        PillowImage.fromarray(image).save(folder / entry["file_path"])
    return content


def test_plates_are_the_wall_and_what_moves_is_the_subject(tmp_path, capsys):
    write_wandering(tmp_path)
    assert beam("plates", tmp_path) == 0
    said = capsys.readouterr().out
    assert "plates: 3 plates; " in said
    for path in sorted((tmp_path / "plates").iterdir()):
        np.testing.assert_array_equal(np.array(PillowImage.open(path)), WALL)
    capture = Capture.read(tmp_path)
    assert "no-coverage" not in {finding.code for finding in inspect_capture(capture).findings}
    for record in capture.records:
        true = inside(record.frame)
        assert np.abs(record.view().alpha - true).sum() < 0.5 * 2.0 * np.pi * RADIUS


def test_linear_images_have_linear_plates(tmp_path):
    content = write_wandering(tmp_path)
    for entry in content["frames"]:
        values = read_image(tmp_path / entry["file_path"]).linear_rgba()
        entry["file_path"] = entry["file_path"].replace(".png", ".exr")
        write_exr(tmp_path / entry["file_path"], {name: 5.0 * values[..., i] for i, name in enumerate("RGB")})
    save(tmp_path, content)
    found = write_plates(Capture.read(tmp_path))
    assert {plate.path.suffix for plate in found} == {".exr"}
    wall = read_image(found[0].path).rgb()
    empty = Capture.read(tmp_path).records[-1].image().rgb()
    np.testing.assert_array_equal(wall[~inside(FRAMES - 1)], empty[~inside(FRAMES - 1)])


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda entries: entries.__delitem__(slice(4, None)), "cameras must have 5 frames or more, got 4 of c00"),
        (lambda entries: entries[1]["transform_matrix"][0].__setitem__(3, 9.0), "cameras must stand still, got c00"),
        (lambda entries: entries[0].__setitem__("mask_path", "m.png"), "images must have neither masks"),
    ],
)
def test_captures_without_a_plate_are_refused(tmp_path, change, says):
    content = write_wandering(tmp_path)
    change(content["frames"])
    save(tmp_path, content)
    with pytest.raises(AssetFormatError, match=says):
        write_plates(Capture.read(tmp_path))
    assert not (tmp_path / "plates").exists()


def test_a_subject_that_stays_is_no_subject(tmp_path):
    content = write_wandering(tmp_path)
    for entry in content["frames"]:
        rewrite(tmp_path / entry["file_path"], lambda _: WALL)
    with pytest.raises(AssetFormatError, match="subject must move from its place between frames, got nothing"):
        write_plates(Capture.read(tmp_path))
    assert not list((tmp_path / "plates").iterdir())
