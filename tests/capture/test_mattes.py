"""Mattes: discs whose coverage is known before backdrops that are known, and photographs of the walker."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image as PillowImage
from scipy.ndimage import gaussian_filter
from support.discs import COLUMNS, RADIUS, ROWS, SIDE, SUBJECT, WALL, before, disc
from support.sound_capture import CAMERAS, save, write_sound

from beam_warp.capture.capture import Capture
from beam_warp.capture.inspect import inspect_capture
from beam_warp.capture.mattes import keyed, matte
from beam_warp.stability.flaws.mattes import offset_coverage, plate


@pytest.mark.parametrize("pixels", [-1.0, -0.5, 0.0, 0.5, 1.0])
@pytest.mark.parametrize("with_plate", [False, True])
def test_a_mask_is_moved_to_the_outline_of_a_disc(pixels, with_plate):
    true = disc()
    found = matte(before(WALL, true), disc(RADIUS + pixels), WALL if with_plate else None)
    assert found.offset.pixels == pytest.approx(pixels, abs=0.05)
    assert abs(found.offset.pixels - pixels) < 3.0 * found.offset.error
    if pixels != 0.0:
        assert np.abs(found.alpha - true).sum() < 0.35 * np.abs(disc(RADIUS + pixels) - true).sum()
    else:
        np.testing.assert_array_equal(found.alpha, true)
        np.testing.assert_allclose(found.color, true[..., None] * SUBJECT, atol=1e-5)
        assert found.uncut is None


@pytest.mark.parametrize("noise", [0.0, 0.01])
@pytest.mark.parametrize(
    ("made", "left"),
    [
        (lambda true: gaussian_filter(true, 1.2), 0.06),  # feathered
        (lambda true: offset_coverage(true, 0.5), 0.1),  # interpolated as it was grown
        (lambda true: offset_coverage(true, -0.5), 0.1),
        (lambda true: np.where(true > 0.5, 1.0, 0.0), 0.5),  # its stairs are a quarter of a pixel off in the mean
        (lambda true: np.where(offset_coverage(true, 1.0) > 0.5, 1.0, 0.0), 0.12),
    ],
)
def test_a_mask_is_made_as_soft_as_the_photograph(made, left, noise):
    true = disc()
    mask = made(true.astype(np.float64)).astype(np.float32)
    photograph = before(WALL, true) + np.random.default_rng(0).normal(0.0, noise, WALL.shape)
    found = matte(photograph.astype(np.float32), mask)
    assert np.abs(found.alpha - true).sum() < left * np.abs(mask - true).sum()
    assert found.uncut is not None


@pytest.mark.parametrize("blur", [0.7, 1.5])
def test_a_mask_of_a_blurred_photograph_is_not_made_steeper_than_that(blur):
    true = gaussian_filter(disc(), blur)
    mask = gaussian_filter(disc(RADIUS + 1.0), blur)
    found = matte(before(WALL, true), mask)
    assert np.abs(found.alpha - true).sum() < 0.15 * np.abs(mask - true).sum()


@pytest.mark.parametrize("pixels", [-1.0, 1.0])
def test_a_photograph_is_the_subject_before_its_backdrop(pixels):
    """However wrong the mask is, the wall is known along the whole outline; far from it nothing is said."""
    true = disc()
    photograph = before(WALL, true)
    found = matte(photograph, disc(RADIUS + pixels))
    behind, scene = found.uncut.behind, found.uncut.scene
    known = behind.any(axis=-1)
    assert known[(true > 0.0) & (true < 1.0)].all()
    np.testing.assert_allclose(behind[known], WALL[known], rtol=0.02)
    np.testing.assert_array_equal(scene[known], photograph[known])
    np.testing.assert_array_equal(scene[~known], found.color[~known])
    assert not known[0, 0]
    assert not known[SIDE // 2, SIDE // 2]


def test_a_subject_like_its_backdrop_is_left_as_it_is():
    mask = disc(RADIUS + 1.0)
    wall = np.full((SIDE, SIDE, 3), 0.01, np.float32)
    found = matte(before(wall, disc(), np.full(3, 0.01, np.float32)), mask)
    assert found.offset is None
    np.testing.assert_array_equal(found.alpha, mask)
    np.testing.assert_allclose(found.color, wall * mask[..., None], atol=1e-6)
    assert found.uncut is None


def test_a_cluttered_backdrop_is_trusted_little():
    rng = np.random.default_rng(0)
    wall = np.kron(rng.random((SIDE // 4, SIDE // 4, 3)), np.ones((4, 4, 1)))
    true = disc()
    photograph = before(wall, true)
    found = matte(photograph, true)
    np.testing.assert_array_equal(found.alpha, true)
    assert found.offset is None or abs(found.offset.pixels) < 3.0 * found.offset.error
    edge = (true > 0.0) & (true < 1.0)
    error, naive = (
        np.abs(color - true[..., None] * SUBJECT)[edge].mean() for color in (found.color, photograph * true[..., None])
    )
    assert error < 0.5 * naive  # F is known, though B is not


@settings(max_examples=15, deadline=None)
@given(
    st.floats(14.0, 34.0),
    st.tuples(st.floats(40.0, 55.0), st.floats(40.0, 55.0)),
    st.tuples(*[st.floats(0.0, 1.0)] * 3),
    st.floats(0.0, 1.5),
    st.integers(0, 99),
)
def test_a_sound_mask_stays_as_it_is(radius, center, subject, blur, seed):
    true = gaussian_filter(disc(radius, center), blur).astype(np.float32)
    photograph = before(WALL, true, np.array(subject, np.float32))
    noise = np.random.default_rng(seed).normal(0.0, 0.01, photograph.shape)
    found = matte((photograph + noise).astype(np.float32), true)
    assert np.abs(found.alpha - true).max() < 0.05


@pytest.mark.parametrize("pixels", [-1.0, 0.0])
def test_a_dark_limb_is_doubted_where_it_looks_like_the_wall(pixels):
    """A sixth of a disc darkens to the wall's colour over three pixels: what is bitten off there is told as a doubt."""
    true, wall = disc(), np.broadcast_to(np.array([0.1, 0.1, 0.1], np.float32), WALL.shape)
    row, column = ROWS - 47.3, COLUMNS - 48.6
    away = np.clip((RADIUS - np.hypot(row, column)) / 3.0, 0.0, 1.0)[..., None]
    is_dark = (np.abs(np.arctan2(row, column)) < np.pi / 6.0)[..., None]
    found = matte(before(wall, true, np.where(is_dark, wall + away * (SUBJECT - wall), SUBJECT)), disc(RADIUS + pixels))
    off = np.abs(found.alpha - true)
    assert (off * (1.0 - found.doubt)).sum() < 0.08 * 2.0 * np.pi * RADIUS
    assert not found.doubt[:, :48].any()


@pytest.mark.parametrize("pixels", [-1.0, 1.0])
def test_limbs_that_darken_along_nearly_half_of_an_outline_do_not_move_it(pixels):
    """Over two pixels to the wall's colour, along 45 % of a disc: a median is drawn 0.1 pixel towards them."""
    wall = np.broadcast_to(np.array([0.1, 0.1, 0.1], np.float32), WALL.shape)
    row, column = ROWS - 47.3, COLUMNS - 48.6
    away = np.clip((RADIUS - np.hypot(row, column)) / 2.0, 0.0, 1.0)[..., None]
    is_dark = (np.abs(np.arctan2(row, column)) < 0.45 * np.pi)[..., None]
    limb = wall + (0.1 + 0.9 * away) * (SUBJECT - wall)
    found = matte(before(wall, disc(), np.where(is_dark, limb, SUBJECT)), disc(RADIUS + pixels))
    assert found.offset.pixels == pytest.approx(pixels, abs=0.05)


@pytest.mark.parametrize("seed", range(3))
def test_a_mask_that_is_off_beyond_doubt_is_moved_as_far_as_it_is_off(seed):
    """Texture of a fifth of the colour makes the offset uncertain by a quarter of it: no reason to leave three."""
    texture = gaussian_filter(np.random.default_rng(seed).normal(size=WALL.shape), (1.5, 1.5, 0.0))
    subject = np.maximum(SUBJECT * (1.0 + 0.2 * texture / texture.std()), 0.05)
    true = disc()
    found = matte(before(WALL, true, subject), disc(RADIUS + 1.0))
    assert 3.0 < found.offset.pixels / found.offset.error < 4.5
    assert (found.alpha - true).sum() < 0.3 * 2.0 * np.pi * RADIUS


def test_masks_without_an_outline_are_left_as_they_are():
    for mask in (np.zeros((8, 8)), np.ones((8, 8)), np.random.default_rng(0).random((900, 900))):
        photograph = np.ones((*mask.shape, 3), np.float32)
        found = matte(photograph, mask.astype(np.float32))
        np.testing.assert_array_equal(found.alpha, mask.astype(np.float32))
        assert found.offset is None


def test_values_without_measure_stay_finite():
    photograph = before(WALL, disc())
    photograph[48, 17:19] = 3e38
    photograph[10, 10] = -3e38
    found = matte(photograph, disc(RADIUS + 1.0))
    assert np.isfinite(found.color).all()
    assert found.offset.pixels == pytest.approx(1.0, abs=0.05)


@pytest.mark.parametrize("pixels", [-1.0, 1.0])
def test_a_photograph_of_the_walker_shows_its_outline(data_dir, pixels):
    view = Capture.read(data_dir / "captures" / "walker").records[7].view()
    alpha = view.alpha.astype(np.float64)
    wall = plate(alpha.shape, np.array([0.18, 0.156, 0.142]), np.random.default_rng(0))
    photograph = (view.color + (1.0 - alpha[..., None]) * wall).astype(np.float32)
    mask = offset_coverage(alpha, pixels).astype(np.float32)
    found = matte(photograph, mask)
    assert found.offset.pixels == pytest.approx(pixels, abs=0.3)
    assert np.abs(found.alpha - alpha).sum() < 0.35 * np.abs(mask - alpha).sum()
    assert np.square(found.color - view.color).sum() < 0.2 * np.square(photograph * mask[..., None] - view.color).sum()
    sound = matte(photograph, view.alpha)
    assert np.abs(sound.alpha - alpha).sum() < 0.05 * np.abs(mask - alpha).sum()


def test_what_differs_from_a_plate_is_the_subject():
    rng = np.random.default_rng(0)
    wall = WALL * (1.0 + 0.5 * (COLUMNS % 16 < 8))[..., None]  # cluttered
    true = disc()
    photograph = 1.2 * before(wall, true) + rng.normal(0.0, 0.005, wall.shape)  # another exposure
    start = keyed(photograph.astype(np.float32), wall.astype(np.float32))
    found = matte(photograph.astype(np.float32), start, wall.astype(np.float32))
    assert np.abs(found.alpha - true).sum() <= 0.3 * 2.0 * np.pi * RADIUS
    assert keyed(wall.astype(np.float32), wall.astype(np.float32)).max() == 0.0


def photographed(folder, grow):
    """Turn a sound capture into photographs before a wall, with masks that are too large for some cameras."""
    content = write_sound(folder, frames=2)
    rows, columns = np.mgrid[:30, :40]
    for entry in content["frames"]:
        path = folder / entry["file_path"]
        mask = folder / "masks" / entry["file_path"].removeprefix("images/")
        mask.parent.mkdir(parents=True, exist_ok=True)
        pixels = np.array(PillowImage.open(path))
        alpha = pixels[..., 3] / 255.0
        wall = (60 + rows)[..., None]
        seen = np.where(alpha[..., None] > 0.5, pixels[..., :3], wall).astype(np.uint8)
        PillowImage.fromarray(seen).save(path)
        way = grow.get(entry["camera"], 0.0)
        PillowImage.fromarray(np.round(255 * offset_coverage(alpha, way)).astype(np.uint8)).save(mask)
    return content, (rows, columns)


def test_masks_that_are_off_are_named_with_their_cameras(tmp_path):
    photographed(tmp_path, {"c02": 1.0, "c05": -1.0})
    (finding,) = inspect_capture(Capture.read(tmp_path)).findings
    assert (finding.severity, finding.code) == ("warning", "mask-offset")
    assert "c02 +" in finding.where
    assert "c05 -" in finding.where
    assert finding.what.startswith("masks of 2 cameras end outside")


def test_feathered_masks_are_named_with_their_cameras(tmp_path):
    photographed(tmp_path, {"c02": 1.0})
    for camera in ("c02", "c05"):
        for path in (tmp_path / "masks").rglob(f"{camera}*/*.png"):
            PillowImage.fromarray(gaussian_filter(np.array(PillowImage.open(path)), 1.2)).save(path)
    offset, softness = inspect_capture(Capture.read(tmp_path)).findings
    assert (offset.code, softness.severity, softness.code) == ("mask-offset", "warning", "mask-softness")
    assert softness.where == "c05"


def test_colour_under_a_clear_alpha_is_the_backdrop(tmp_path):
    photographed(tmp_path, {})
    record = Capture.read(tmp_path).records[0]
    masked = record.view()
    rgba = np.dstack([np.array(PillowImage.open(path)) for path in (record.image_path, record.mask_path)])
    PillowImage.fromarray(rgba).save(record.image_path)
    record.mask_path.unlink()
    cut = Capture.read(tmp_path).records[0].view()
    np.testing.assert_array_equal(cut.alpha, masked.alpha)
    np.testing.assert_array_equal(cut.color, masked.color)


def test_noise_under_a_clear_alpha_is_no_backdrop(tmp_path):
    """A sensor's darkness around a subject that was cut out varies from pixel to pixel, and shows no wall."""
    photographed(tmp_path, {})
    record = Capture.read(tmp_path).records[0]
    color, mask = (np.array(PillowImage.open(path)) for path in (record.image_path, record.mask_path))
    darkness = np.abs(np.random.default_rng(0).normal(0.0, 6.0, color.shape)).astype(np.uint8)
    PillowImage.fromarray(np.dstack([np.where(mask[..., None] > 0, color, darkness), mask])).save(record.image_path)
    record.mask_path.unlink()
    view = Capture.read(tmp_path).records[0].view()
    assert view.mask_offset is None
    np.testing.assert_allclose(view.alpha, mask / 255.0, atol=1e-6)


def test_plates_stand_in_for_masks(tmp_path):
    content, (rows, _) = photographed(tmp_path, {})
    records = Capture.read(tmp_path).records
    (tmp_path / "masks").rename(tmp_path / "kept")
    (tmp_path / "plates").mkdir()
    for camera in {record.camera_name for record in records}:
        wall = np.repeat((60 + rows)[..., None], 3, axis=-1).astype(np.uint8)
        PillowImage.fromarray(wall).save(tmp_path / f"plates/{camera}.png")
    report = inspect_capture(Capture.read(tmp_path))
    assert report.findings == ()
    assert len(report.glimpses) == CAMERAS * 2
    true = np.array(PillowImage.open(tmp_path / "kept/c00/0000.png")) / 255.0
    assert np.abs(Capture.read(tmp_path).records[0].view().alpha - true).sum() < 0.4 * 2.0 * np.pi * 8.0
    content["frames"][4]["plate_path"] = "plates/none.png"
    save(tmp_path, content)
    (finding,) = inspect_capture(Capture.read(tmp_path)).findings
    assert finding.code == "missing-plate"
    (tmp_path / "plates/c00.png").unlink()
    content["frames"][4].pop("plate_path")
    save(tmp_path, content)
    assert "some-coverage" in {finding.code for finding in inspect_capture(Capture.read(tmp_path)).findings}
