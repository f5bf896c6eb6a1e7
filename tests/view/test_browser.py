"""The viewer as people meet it: a page in headless Chromium, a mouse, and what the screen shows then."""

import os
import shutil
import time
from io import BytesIO
from queue import SimpleQueue

import numpy as np
import pytest
from PIL import Image as PillowImage
from support.figure_asset import figure_asset

from beam_warp.demo.lights import stage, studio
from beam_warp.image.files import read_image

pytest.importorskip("viser")
sync_api = pytest.importorskip("playwright.sync_api")

CHROMIUM = os.environ.get("BEAM_CHROMIUM") or shutil.which("chromium") or shutil.which("chromium-browser")
if CHROMIUM is None:
    pytest.skip("no chromium is installed (set BEAM_CHROMIUM)", allow_module_level=True)

pytestmark = pytest.mark.slow

WIDTH, HEIGHT = 900, 480
SEEN = slice(320, 560)
"""Columns between the note on the left, which says that this browser draws in software, and the controls."""

PATIENCE = 90.0
FLAGS = (
    *("--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-background-networking"),
    *("--disable-component-update", "--disable-sync"),
)
SHARP = "&fixedDpr=1"
"""Part of the address: the page takes away no pixels where it is slow."""

FIRST = {"frame": 0, "channel": "lit", "environment": "studio", "rotation": 0.0, "exposure": 0.0}

BACKGROUND = (33, 33, 33)


@pytest.fixture(scope="module")
def viewer():
    from beam_warp.view.viewer import Viewer, ViewOptions

    served = Viewer(
        figure_asset(frame_count=3),
        {"studio": studio, "stage": stage},
        title="figure",
        options=ViewOptions(port=0, device="cpu"),
    )
    yield served
    served.close()
    assert not [thread for thread in (served._ticker, served._loop._thread) if thread.is_alive()]


@pytest.fixture(scope="module")
def browser():
    with sync_api.sync_playwright() as playwright:
        opened = playwright.chromium.launch(executable_path=CHROMIUM, args=list(FLAGS))
        yield opened
        opened.close()


@pytest.fixture(scope="module")
def opened(viewer, browser):
    """A page in which nothing goes wrong."""
    page = browser.new_page(viewport={"width": WIDTH, "height": HEIGHT})
    wrong = []
    page.on("console", lambda message: wrong.append(message.text) if message.type == "error" else None)
    page.on("pageerror", lambda error: wrong.append(str(error)))
    page.goto(viewer.url + SHARP)
    note = page.get_by_text("Software WebGL rendering detected")
    if note.is_visible():
        page.locator(".mantine-Notification-closeButton").first.click()
    yield page
    page.close()
    assert wrong == []


@pytest.fixture
def page(viewer, opened):
    """The page on the first state, with its sharp picture."""
    viewer.change(**FIRST)
    opened.get_by_role("button", name="Frame subject").click()  # keys that move sliders orbit too
    settled(opened, viewer)
    return opened


def screen(page):
    """What is seen between the note and the controls."""
    picture = PillowImage.open(BytesIO(page.screenshot())).convert("RGB")
    return np.asarray(picture)[:, SEEN].astype(int)


def ours(viewer, client):
    """What the page of a client is to show, drawn now, in the one thread that may draw."""
    drawn = SimpleQueue()
    viewer._loop.export(client, drawn.put)
    return drawn.get(timeout=PATIENCE).pixels[:, SEEN].astype(int)


def newest(viewer):
    return max(viewer._pages)


def differs(one, other):
    """The share of pixels that differ by more than what JPEG, scaling and rounding make of them."""
    return float((np.abs(one - other).max(axis=-1) > 24).mean())


def settled(page, viewer, before=None):
    """Wait for the screen to show what we draw, and to be another one than before."""
    deadline = time.monotonic() + PATIENCE
    shown = None
    while time.monotonic() < deadline:
        page.wait_for_timeout(300)
        if not viewer._pages:
            continue
        shown, wanted = screen(page), ours(viewer, newest(viewer))
        is_new = before is None or differs(shown, before) > 0.005
        if is_new and wanted.shape == shown.shape and differs(shown, wanted) < 0.04:
            return shown
    pytest.fail(f"the screen did not settle within {PATIENCE} s")


def choose(page, shown, wanted):
    page.locator(f"input[value='{shown}']").first.click()
    page.get_by_role("option", name=wanted, exact=True).click()


def slide(page, label, key, times=1):
    """Move a slider by keys; its thumb is in the row of its label."""
    row = page.locator("label", has_text=label).locator("xpath=ancestor::div[.//*[@role='slider']][1]")
    thumb = row.get_by_role("slider").first
    thumb.focus()
    for _ in range(times):
        thumb.press(key)


def test_the_page_shows_our_picture(page, viewer):
    shown, wanted = screen(page), ours(viewer, newest(viewer))
    covered = (np.abs(wanted - BACKGROUND).max(axis=-1) > 8).mean()
    assert 0.1 < covered < 0.8
    assert differs(shown, np.broadcast_to(BACKGROUND, shown.shape)) > 0.5 * covered
    # where the picture is smooth, scaling changes nothing: colours agree to a level or two
    step = np.abs(np.diff(wanted, axis=1)).max(axis=-1)
    assert np.median(np.abs(shown - wanted).max(axis=-1)[:, 1:-1][step[:, 1:] + step[:, :-1] < 4]) <= 2
    assert "6,000 Gaussians" in page.content()


def test_a_drag_orbits(page, viewer):
    before = screen(page)
    start, _ = viewer._loop._schedule.seen(newest(viewer))
    page.mouse.move(330, 300)
    page.mouse.down()
    page.mouse.move(430, 300, steps=8)
    page.mouse.up()
    turned = settled(page, viewer, before)
    end, _ = viewer._loop._schedule.seen(newest(viewer))
    center = viewer._painter.subject.center
    away = [np.asarray(view.position) - center for view in (start, end)]
    assert np.linalg.norm(away[1]) == pytest.approx(np.linalg.norm(away[0]), rel=1e-3)  # it goes round, not away
    angle = np.degrees(np.arctan2(away[1][1], away[1][0]) - np.arctan2(away[0][1], away[0][0]))
    assert 10.0 < abs((angle + 180.0) % 360.0 - 180.0) < 170.0
    page.get_by_role("button", name="Frame subject").click()
    settled(page, viewer, turned)
    back, _ = viewer._loop._schedule.seen(newest(viewer))
    np.testing.assert_allclose(back.position, start.position, atol=1e-2)


def test_sliders_change_time_and_light(page, viewer):
    before = screen(page)
    slide(page, "Frame", "ArrowRight", 2)
    moved = settled(page, viewer, before)
    assert viewer.state.frame == 2
    slide(page, "Rotation", "End")
    turned = settled(page, viewer, moved)
    assert viewer.state.rotation == 180.0
    slide(page, "Exposure", "ArrowLeft", 15)
    settled(page, viewer, turned)
    assert viewer.state.exposure == pytest.approx(-1.5)


def test_choices_change_the_picture(page, viewer):
    before = screen(page)
    choose(page, "lit", "normals")
    normals = settled(page, viewer, before)
    assert viewer.state.channel == "normals"
    choose(page, "normals", "depth")
    settled(page, viewer, normals)
    choose(page, "depth", "lit")
    lit = settled(page, viewer, normals)
    choose(page, "studio", "stage")
    settled(page, viewer, lit)


def test_time_runs(page, viewer):
    row = page.locator("label", has_text="Play").locator("xpath=ancestor::div[.//input[@type='checkbox']][1]")
    row.locator("input[type=checkbox]").click()
    seen, deadline = set(), time.monotonic() + PATIENCE
    while len(seen) < 3 and time.monotonic() < deadline:
        seen.add(viewer.state.frame)
        time.sleep(0.01)
    viewer._controls._playing.value = False
    assert seen == {0, 1, 2}


def test_pictures_can_be_kept(page, viewer, tmp_path):
    page.get_by_text("Save", exact=True).click()
    for name, suffix in (("Save PNG", "png"), ("Save EXR", "exr")):
        with page.expect_download(timeout=1000 * PATIENCE) as waiting:
            page.get_by_role("button", name=name).click()
        path = tmp_path / f"kept.{suffix}"
        waiting.value.save_as(path)
        image = read_image(path)
        assert (image.width, image.height) == (WIDTH, HEIGHT)
        if suffix == "exr":
            assert 0.05 < image.alpha.mean() < 0.8


def test_two_pages_look_from_two_sides_and_one_leaves(page, viewer, browser):
    first = newest(viewer)
    other = browser.new_page(viewport={"width": 700, "height": HEIGHT})
    other.goto(viewer.url + SHARP)
    deadline = time.monotonic() + PATIENCE
    while newest(viewer) == first and time.monotonic() < deadline:
        other.wait_for_timeout(100)
    sizes = {viewer._loop._schedule.seen(client)[0].width for client in (first, newest(viewer))}
    assert sizes == {WIDTH, 700}
    viewer.change(rotation=50.0)
    other.close()  # in the middle of its frame
    viewer.change(rotation=120.0)
    deadline = time.monotonic() + PATIENCE
    while len(viewer._pages) > 1 and time.monotonic() < deadline:
        page.wait_for_timeout(100)
    assert len(viewer._pages) == 1
    settled(page, viewer)


def test_a_window_that_is_resized(page, viewer):
    page.set_viewport_size({"width": WIDTH, "height": 400})
    shown = settled(page, viewer)
    page.set_viewport_size({"width": WIDTH, "height": HEIGHT})
    assert shown.shape[0] == 400


def test_what_fails_is_said_on_the_page(page, viewer, monkeypatch):
    def fail(*_, **__):
        raise MemoryError("too small a device")

    before = screen(page)
    with monkeypatch.context() as broken:
        broken.setattr(viewer._painter, "draw", fail)
        viewer.change(environment="none")
        page.get_by_text("This could not be drawn").first.wait_for(timeout=1000 * PATIENCE)
    viewer.change(environment="stage")
    settled(page, viewer, before)


def test_a_light_is_added_dragged_and_taken_away(page, viewer):
    while page.get_by_text("This could not be drawn").count():  # left by another test: it may lie over the handles
        page.locator("[class*=Notification] button").first.click()
        page.wait_for_timeout(500)
    add = page.get_by_role("button", name="Add light")
    if not add.is_visible():
        page.get_by_text("Lamps", exact=True).click()
    viewer.change(environment="none")
    dark = settled(page, viewer)
    add.click()
    deadline = time.monotonic() + PATIENCE
    while not viewer.state.lights and time.monotonic() < deadline:
        page.wait_for_timeout(100)
    page.wait_for_timeout(1000)
    (light,) = viewer.state.lights
    view, _ = viewer._loop._schedule.seen(newest(viewer))
    size = 0.15 * viewer._painter.subject.extent
    place = np.asarray(light.position)
    arrow = place + np.array([0.0, 0.0, 0.7 * size])  # the handle's arrow upwards
    higher = arrow + np.array([0.0, 0.0, 0.2])
    (x, y, _), (up_x, up_y, _) = view.camera(1.0, 4096).project(np.stack([arrow, higher]))
    for wait in (300, 1000, 3000):  # a busy page takes a while to see that the mouse is over the arrow
        page.mouse.move(x - 40, y - 40)
        page.mouse.move(x, y)
        page.wait_for_timeout(wait)
        page.mouse.down()
        page.mouse.move(up_x, up_y, steps=6)
        page.mouse.up()
        page.wait_for_timeout(1000)
        if viewer.state.lights != (light,):
            break
    (moved,) = viewer.state.lights
    step = np.asarray(moved.position) - place
    assert step[2] == pytest.approx(0.2, abs=0.05)
    np.testing.assert_allclose(step[:2], 0.0, atol=1e-3)
    assert differs(screen(page), dark) > 0.02
    page.get_by_role("button", name="Remove").first.click()
    while viewer.state.lights and time.monotonic() < deadline:
        page.wait_for_timeout(100)
    assert viewer.state.lights == ()
    settled(page, viewer)


def test_paths_are_traced_once_nothing_moves(page, viewer):
    if not viewer._painter.can_trace:
        pytest.skip("there is no path tracer")
    viewer.change(samples=4)
    choose(page, "deferred", "path traced")
    page.get_by_text("· 4 samples ·").wait_for(timeout=1000 * PATIENCE)
    covered = np.abs(screen(page) - BACKGROUND).max(axis=-1) > 24
    viewer.change(mode="deferred")
    deferred = np.abs(settled(page, viewer) - BACKGROUND).max(axis=-1) > 24
    both = (covered & deferred).sum() / (covered | deferred).sum()
    assert both > 0.85  # the same subject, but for the edges of a coarser picture
