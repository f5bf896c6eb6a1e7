"""`beam view` as people meet it: its page in headless Chromium, with its picture, its time, and the server's stills."""

import json

import numpy as np
import pytest
from PIL import Image
from support.drawn_ball import drawn_ball
from support.player_pages import (
    BACKGROUND,
    HEIGHT,
    PATIENCE,
    WIDTH,
    as_rendered,
    camera_of,
    picture,
    ready,
    said,
    settled,
    until,
)
from web.viewers import CHROMIUM, FLAGS

from beam_warp import converters
from beam_warp.cli.view import ViewCommand, shown
from beam_warp.demo.lights import studio
from beam_warp.errors import AssetFormatError
from beam_warp.image.files import read_image
from beam_warp.image.metrics import psnr
from beam_warp.image.tone import display_over
from beam_warp.render.path import PathOptions, PathRenderer
from beam_warp.view.takes import SEGMENT_FRAMES
from beam_warp.view.viewer import Viewer, ViewOptions
from beam_warp.world.gaussians import GaussianSequence
from beam_warp.world.shot import Shot

sync_api = pytest.importorskip("playwright.sync_api")

if CHROMIUM is None:
    pytest.skip("no chromium is installed (set BEAM_CHROMIUM)", allow_module_level=True)

pytestmark = pytest.mark.slow

FRAMES = SEGMENT_FRAMES + 2
LIGHTS = {"studio": studio}
LOST = set()
"""Frames that cannot be read."""


def ball(frame, count=1200):
    return drawn_ball(center=(0.02 * frame, 0.0, 0.0), count=count).with_arrays(
        ids=np.arange(count), scales=np.tile([0.035, 0.035, 1e-3], (count, 1)), roughness_error=np.full(count, 0.1)
    )


def read(frame):
    if frame in LOST:
        raise AssetFormatError(f"frame {frame} must be a file, got none. Put it back.")
    return ball(frame)


@pytest.fixture(scope="module")
def browser():
    with sync_api.sync_playwright() as playwright:
        opened = playwright.chromium.launch(executable_path=CHROMIUM, args=list(FLAGS))
        yield opened
        opened.close()


@pytest.fixture
def opened(browser):
    """Serves a sequence and opens its page; in the end, nothing must have gone wrong in it."""
    served, pages, wrong = [], [], []

    def open_page(sequence, environments=LIGHTS, **parts):
        served.append(Viewer(sequence, environments, options=ViewOptions(port=0, device="cpu"), **parts))
        page = browser.new_page(viewport={"width": WIDTH, "height": HEIGHT}, reduced_motion="reduce")
        page.on("pageerror", lambda error: wrong.append(str(error)))
        page.goto(served[-1].url)
        pages.append(page)
        return ready(page)

    yield open_page
    for closed in (*pages, *served):
        closed.close()
    assert wrong == []


MOVING = GaussianSequence(FRAMES, read, frames_per_second=10.0, topology="constant")


@pytest.fixture
def page(opened):
    return opened(MOVING)


def agree(page, cloud):
    expected, alpha = as_rendered(page, cloud, studio())
    assert alpha.mean() > 0.1
    return psnr(picture(page) / 255.0, expected / 255.0, alpha > 0.99) > 38.0


def test_it_shows_what_the_renderer_shows_at_any_time(page):
    assert agree(page, ball(0))
    page.evaluate(f"player.change({{time: {(FRAMES - 1) / 10.0}}})")
    until(page, f"player.frame === {FRAMES - 1}")
    assert agree(page, ball(FRAMES - 1))


def test_frames_with_nothing_in_common_are_shown_one_by_one(opened):
    page = opened(GaussianSequence.from_clouds([ball(0), ball(4, count=900), ball(8, count=1500)]))
    page.evaluate("player.change({time: 2 / player.frameRate})")
    until(page, "player.part === 2 && player.take.manifest.count === 1500")
    assert agree(page, ball(8, count=1500))
    page.evaluate("player.change({playing: true})")
    until(page, "player.part === 1")


def test_a_lost_frame_holds_the_last_one_and_comes_back(opened):
    LOST.add(FRAMES - 1)
    try:
        page = opened(MOVING)
        page.evaluate("player.change({time: 0.65})")
        words = said(page)
        assert words.startswith(f"Frames {SEGMENT_FRAMES + 1} to {FRAMES} cannot be read; the last frame is held")
        assert "must be a file, got none. Put it back" in words
        assert agree(page, ball(SEGMENT_FRAMES - 1))
    finally:
        LOST.clear()
    page.wait_for_timeout(2200)
    page.evaluate("player.change({time: 0.7})")
    until(page, "player.message.hidden")
    assert agree(page, ball(FRAMES - 1))


def test_a_still_is_drawn_by_paths_and_kept_until_something_changes(page, tmp_path):
    page.get_by_text("Stills", exact=True).click()
    page.get_by_label("Samples").fill("4")
    page.get_by_label("Size").select_option("quarter")
    page.get_by_role("button", name="Draw still").click()
    until(page, "player.stills.isShown && !player.stills.isDrawing")
    assert page.get_by_text("4 of 4 samples").is_visible()
    camera = camera_of(page, 0.25)
    image = PathRenderer(PathOptions(samples=4), device="cpu").draw(
        Shot(cloud=ball(0), camera=camera, environment=studio())
    )
    page.get_by_text("Files", exact=True).click()
    kept = {}
    for name in ("Save PNG", "Save EXR"):
        with page.expect_download(timeout=1000 * PATIENCE) as waiting:
            page.get_by_role("button", name=name).click()
        kept[name] = tmp_path / waiting.value.suggested_filename
        waiting.value.save_as(kept[name])
    shown_image = np.asarray(Image.open(kept["Save PNG"])).astype(int)
    np.testing.assert_allclose(shown_image, display_over(image.rgb, image.alpha, background=BACKGROUND), atol=1)
    np.testing.assert_allclose(read_image(kept["Save EXR"]).alpha, image.alpha, atol=1e-4)
    page.mouse.move(200, 200)
    page.mouse.down()
    page.mouse.move(220, 200)
    page.mouse.up()
    assert not page.evaluate("player.stills.isShown")
    settled(page)


def test_what_a_still_cannot_be_is_one_line(page):
    page.evaluate("player.stills.samples.value = 0.5; player.state.environment = 'dropped.hdr'; player.stills.draw()")
    assert said(page).startswith("The still cannot be drawn: samples must be")
    page.evaluate("player.stills.samples.value = 1; player.stills.draw()")
    until(page, "/environment must be one of studio, none, got .dropped.hdr/.test(player.message.textContent)")
    assert not page.evaluate("player.stills.isDrawing || player.stills.isShown")


def test_errors_of_an_asset_are_stills_with_a_legend(page):
    page.get_by_text("Stills", exact=True).click()
    page.get_by_label("Shows").select_option("standard error of roughness")
    assert not page.get_by_label("Samples").is_visible()
    page.evaluate("player.stills.draw()")
    until(page, "player.stills.isShown && !player.stills.isDrawing")
    assert page.get_by_alt_text("What its colours mean").is_visible()


def test_a_stage_stands_on_its_ground(opened, tmp_path):
    converters.write(GaussianSequence.from_clouds([ball(0)]), tmp_path / "a.usda")
    content = {"beam-stage": 1, "assets": ["a.usda"], "meshes": [{"ground": True, "size": 8}]}
    content |= {"camera": {"type": "fixed", "position": [0, -4, 1], "target": [0, 0, 0], "fov": 40}}
    (tmp_path / "set.json").write_text(json.dumps(content | {"environment": {"radiance": [1, 1, 1]}}))
    sequence, parts = shown(ViewCommand(asset=tmp_path / "set.json"), {})
    page = opened(sequence, **parts)
    assert page.evaluate("player.state.environment") == "set (stage)"
    drawn = picture(page)
    assert drawn[-20, WIDTH // 2].min() > 60  # the ground
    page.evaluate(
        "Object.assign(player.stills.size, {value: 0.25}); player.stills.samples.value = 2; player.stills.draw()"
    )
    until(page, "player.stills.isShown && !player.stills.isDrawing")
    traced = picture_of_still(page)
    assert traced[-5, WIDTH // 8].min() > 60


def picture_of_still(page):
    with page.expect_download(timeout=1000 * PATIENCE) as waiting:
        page.evaluate("player.savePng()")
    return np.asarray(Image.open(waiting.value.path()).convert("RGB"))
