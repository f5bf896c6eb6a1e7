"""The player page as people meet it: opened from a file in headless Chromium, with a mouse, keys and a headset."""

import base64
import json
import re
import zipfile
from io import BytesIO

import npm_packages
import numpy as np
import pytest
from engines.probes import PROBES, REGIONS
from engines.web import pages as web_pages
from PIL import Image
from support.drawn_ball import drawn_ball
from support.player_pages import HEIGHT, WIDTH, as_rendered, picture, ready, said, settled, until
from web.viewers import CHROMIUM, FLAGS

from beam_warp import converters
from beam_warp.cli.convert import main
from beam_warp.image.files import write_exr
from beam_warp.image.metrics import psnr
from beam_warp.world.environment import EnvironmentMap
from beam_warp.world.gaussians import GaussianSequence
from beam_warp.world.lights import PointLight, read_lights

sync_api = pytest.importorskip("playwright.sync_api")

if CHROMIUM is None:
    pytest.skip("no chromium is installed (set BEAM_CHROMIUM)", allow_module_level=True)

pytestmark = pytest.mark.slow

FRAMES = 14
"""One more segment than one."""


def ball(frame):
    return drawn_ball(center=(0.02 * frame, 0.0, 0.0), count=1200).with_arrays(
        scales=np.tile([0.035, 0.035, 1e-3], (1200, 1)), radiance=None, radiance_color_space=None
    )


@pytest.fixture(scope="module")
def take(tmp_path_factory):
    path = tmp_path_factory.mktemp("take") / "ball.b4d"
    clouds = [ball(frame) for frame in range(FRAMES)]
    converters.write(GaussianSequence.from_clouds(clouds, frames_per_second=10.0), path)
    return path


@pytest.fixture(scope="module")
def light(tmp_path_factory):
    path = tmp_path_factory.mktemp("light") / "window.exr"
    radiance = np.full((16, 32, 3), 0.3, np.float32)
    radiance[3:7, 20:26] = (6.0, 5.0, 4.0)
    write_exr(path, {name: radiance[..., k] for k, name in enumerate("RGB")})
    return path


@pytest.fixture(scope="module")
def written(take, light, tmp_path_factory):
    page = tmp_path_factory.mktemp("page") / "ball.html"
    assert main([str(take), str(page), "--player", "--quiet", "--environment", str(light)]) == 0
    return page


@pytest.fixture(scope="module")
def browsers():
    """Starts browsers: one without WebGPU, or one with it."""
    with sync_api.sync_playwright() as playwright:
        yield lambda flags: playwright.chromium.launch(executable_path=CHROMIUM, args=list(flags))


@pytest.fixture(scope="module")
def browser(browsers):
    opened = browsers(FLAGS)
    yield opened
    opened.close()


@pytest.fixture
def opened(browser):
    """Opens a page that stands still; in the end, nothing must have gone wrong in it."""
    pages, wrong = [], []

    def open_page(path, script=None, browser=browser):
        page = browser.new_page(viewport={"width": WIDTH, "height": HEIGHT}, reduced_motion="reduce")
        pages.append(page)
        page.on("pageerror", lambda error: wrong.append(str(error)))
        if script:
            page.add_init_script(script)
        page.goto(path.as_uri())
        return page

    yield open_page
    for page in pages:
        page.close()
    assert wrong == []


@pytest.fixture
def page(opened, written):
    return ready(opened(written))


@pytest.mark.parametrize("backend", ["webgl2", "webgpu"])
def test_it_shows_what_the_renderer_shows(opened, written, light, browsers, browser, backend):
    other = browser
    if backend == "webgpu":
        other = browsers((*web_pages.FLAGS, *web_pages.BOTH_FLAGS))
        web_pages.need_shown_webgpu(other)
    page = ready(opened(written, browser=other))
    assert page.evaluate("player.relight.backend") == backend
    expected, alpha = as_rendered(page, ball(0), EnvironmentMap.read(light))
    assert alpha.mean() > 0.1
    assert psnr(picture(page) / 255.0, expected / 255.0, alpha > 0.99) > 38.0
    if other is not browser:
        page.close()
        other.close()


def test_keys_play_step_and_orbit(page):
    page.locator("body").press(".")
    page.locator("body").press(".")
    assert page.evaluate("player.frame") == 2
    page.locator("body").press(",")
    assert page.locator("nav output").inner_text() == f"2 / {FRAMES}"
    page.locator("body").press(" ")
    until(page, "player.frame > 4")
    page.get_by_role("button", name="Pause").click()
    assert not page.evaluate("player.state.playing")
    page.locator("canvas").first.focus()
    page.keyboard.press("ArrowLeft")
    assert page.evaluate("player.orbit.azimuth") == pytest.approx(0.1)
    page.locator("body").press("f")
    assert page.evaluate("player.orbit.azimuth") == 0.0


def test_time_ends_or_begins_again(page):
    page.evaluate("player.change({rate: 2, loop: false, playing: true, time: 1.2})")
    until(page, "!player.state.playing")
    assert page.evaluate("player.frame") == FRAMES - 1
    page.evaluate("player.change({loop: true, playing: true})")
    until(page, "player.frame < 5")


def test_controls_change_the_picture(page):
    lit = picture(page).astype(int)
    page.get_by_label("Channel").select_option("normals")
    assert np.abs(picture(page) - lit).max() > 60
    page.get_by_label("Channel").select_option("lit")
    page.get_by_label("Exposure").fill("2")
    assert picture(page).mean() > lit.mean() + 5
    page.get_by_label("Exposure").fill("0")
    page.get_by_label("Rotation").fill("90")
    turned = picture(page).astype(int)
    assert np.abs(turned - lit).max() > 20
    page.get_by_label("Environment").select_option("none")
    until(page, "player.state.environment === 'none'")
    dark = picture(page)
    assert dark[dark.shape[0] // 2 - 30, int(0.5 * page.evaluate("player.free().width"))].max() < 8
    page.get_by_label("Background").fill("#00ff00")
    assert picture(page)[5, 5].tolist() == [0, 255, 0]


def test_an_environment_s_shadows_are_drawn_if_they_are_asked_for(opened, light, tmp_path):
    cloud = PROBES["corner"]()
    converters.write(GaussianSequence.from_clouds([cloud]), tmp_path / "corner.b4d")
    path = tmp_path / "page.html"
    assert main([str(tmp_path / "corner.b4d"), str(path), "--player", "--quiet", "--environment", str(light)]) == 0
    page = ready(opened(path))
    bare = picture(page)
    page.get_by_label("Its shadows").select_option("by 16 maps")
    shadowed = picture(page)
    expected, alpha = as_rendered(page, cloud, EnvironmentMap.read(light), REGIONS)
    assert psnr(shadowed / 255.0, expected / 255.0, alpha > 0.99) > 38.0
    assert psnr(bare / 255.0, expected / 255.0, alpha > 0.99) < 30.0
    page.get_by_label("Its shadows").select_option("by occlusion")
    np.testing.assert_array_equal(picture(page), bare)


def test_a_mouse_orbits_and_a_wheel_comes_nearer(page):
    page.mouse.move(200, 200)
    page.mouse.down()
    page.mouse.move(300, 200, steps=3)
    page.mouse.up()
    assert page.evaluate("player.orbit.azimuth") == pytest.approx(-0.8)
    before = page.evaluate("player.orbit.distance")
    page.mouse.wheel(0, -200)
    until(page, f"player.orbit.distance < {0.9 * before}")


def test_a_lamp_is_added_dragged_and_saved(page, tmp_path):
    page.evaluate("player.shadows = player.shadows.map(() => 128); player.choose('none')")
    dark = picture(page)
    page.get_by_role("button", name="Add light").click()
    assert picture(page).mean() > dark.mean() + 2
    handle = page.get_by_role("slider", name="Point 1", exact=True)
    before = page.evaluate("player.lamps.lights()[0].position")
    box = handle.bounding_box()
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    page.mouse.move(x, y)
    page.mouse.down()
    page.mouse.move(x + 40, y, steps=4)
    page.mouse.up()
    settled(page)
    moved = handle.bounding_box()
    assert moved["x"] - box["x"] == pytest.approx(40.0, abs=1.0)  # a mouse is on whole pixels
    after = page.evaluate("player.lamps.lights()[0].position")
    assert after[0] > before[0] + 0.1
    np.testing.assert_allclose(after[1:], before[1:], atol=1e-6)
    handle.press("PageUp")
    assert page.evaluate("player.lamps.lights()[0].position")[1] < before[1]
    page.get_by_label("Intensity [W/sr]").fill("7.5")
    page.get_by_text("Files", exact=True).click()
    with page.expect_download() as waiting:
        page.get_by_role("button", name="Save lights").click()
    waiting.value.save_as(tmp_path / "lights.json")
    (lamp,) = read_lights(tmp_path / "lights.json")
    assert isinstance(lamp, PointLight)
    assert lamp.intensity == (7.5, 7.5, 7.5)
    page.get_by_role("button", name="Remove").click()
    assert page.evaluate("player.relight.lights.length") == 0


def test_every_control_has_a_name_and_fits_a_phone(page):
    unnamed = page.evaluate(
        """[...document.querySelectorAll("button, select, input:not([hidden]), [role=slider]")]
           .filter((e) => !(e.ariaLabel || e.textContent.trim() || e.getAttribute("aria-label") || e.closest("label")))
           .map((e) => e.outerHTML)"""
    )
    assert unnamed == []
    page.set_viewport_size({"width": 360, "height": 640})
    settled(page)
    assert page.evaluate("document.querySelector('nav').scrollWidth") <= 360
    assert page.evaluate("player.free().height") > 200


def altered(written, tmp_path, change):
    """A page whose take has been changed."""
    text = written.read_text()
    content = re.search(r'id="take">([^<]*)<', text)[1]
    changed = base64.b64encode(change(base64.b64decode(content))).decode()
    (tmp_path / "altered.html").write_text(text.replace(content, changed))
    return tmp_path / "altered.html"


def test_a_page_that_was_cut_says_so(opened, written, tmp_path):
    assert "The take cannot be shown" in said(opened(altered(written, tmp_path, lambda content: content[:900])))


def test_a_lost_segment_holds_the_last_frame_and_says_so(opened, written, tmp_path):
    def spoil(content):
        with zipfile.ZipFile(BytesIO(content)) as archive:
            second = json.loads(archive.read("manifest.json"))["segments"][1]
            at = content.index(archive.read(second["file"]))
        return content[: at + 20] + bytes([content[at + 20] ^ 255]) + content[at + 21 :]

    page = opened(altered(written, tmp_path, spoil))
    ready(page)
    page.evaluate("player.change({time: 1.1})")
    held = picture(page)
    page.evaluate("player.change({time: 1.3})")
    assert re.match(r"Frames 13 to 14 cannot be read; the last frame is held \(.*digest", said(page))
    np.testing.assert_array_equal(picture(page), held)
    page.get_by_role("button", name="Close").click()
    assert not page.locator(".message").is_visible()


def test_a_take_beside_a_page_from_a_file_can_be_chosen(opened, take, tmp_path):
    assert main([str(take), str(tmp_path / "page.html"), "--player", "--beside", "--quiet"]) == 0
    page = opened(tmp_path / "page.html")
    assert "opened from a file" in said(page)
    with page.expect_file_chooser() as waiting:
        page.get_by_role("button", name="Open a file").click()
    waiting.value.set_files(tmp_path / "page.b4d")
    until(page, "player.isReady")
    assert not page.locator(".message").is_visible()


def test_a_host_serves_a_page_and_its_take(browser, take, tmp_path):
    assert main([str(take), str(tmp_path / "page.html"), "--player", "--beside", "--quiet"]) == 0
    page = browser.new_page(viewport={"width": WIDTH, "height": HEIGHT}, reduced_motion="reduce")
    page.route("**/*", lambda route: route.fulfill(path=tmp_path / route.request.url.rpartition("/")[2]))
    page.goto("http://localhost/page.html")
    assert picture(ready(page)).max() > 60
    page.close()


def test_without_graphics_it_says_what_is_missing(opened, written):
    page = opened(written, "HTMLCanvasElement.prototype.getContext = () => null; delete Navigator.prototype.gpu;")
    assert said(page).startswith("This page needs WebGPU or WebGL 2, and this browser offers neither")


def test_a_lost_device_is_said_and_may_come_back(page):
    page.evaluate("window.loss = player.canvas.getContext('webgl2').getExtension('WEBGL_lose_context')")
    page.evaluate("loss.loseContext()")
    assert said(page).startswith("The graphics device was lost")
    page.evaluate("loss.restoreContext()")
    until(page, "player.message.hidden")
    assert picture(page)[HEIGHT // 2 - 30, int(0.5 * page.evaluate("player.free().width"))].max() > 40


def test_it_plays_in_a_headset(opened, written):
    """Both eyes of an emulated headset see the ball, as far apart as its distance says, and time runs on."""
    try:
        emulator = npm_packages.packages() / "iwer" / "build" / "iwer.min.js"
    except npm_packages.MissingPackagesError as error:
        pytest.skip(f"the emulator cannot be had: {error}")
    headset = ";new IWER.XRDevice(IWER.metaQuest3, {stereoEnabled: true}).installRuntime({forceInstall: true});"
    page = opened(written, emulator.read_text() + headset)
    ready(page)
    page.get_by_role("button", name="Enter VR").click()
    until(page, "player.vr?.session.renderState.baseLayer")
    page.evaluate("player.change({playing: true})")
    start = page.evaluate("player.state.time")
    until(page, f"Math.abs(player.state.time - {start}) > 0.2")
    page.evaluate("player.change({playing: false, time: 0})")
    page.evaluate("document.getElementById('player').style.visibility = 'hidden'")
    page.wait_for_timeout(3000)
    shown = np.asarray(Image.open(BytesIO(page.screenshot())).convert("RGB")).astype(int)
    left, right = (np.argwhere(half.max(axis=2) > 40).mean(axis=0) for half in np.split(shown, 2, axis=1))
    # eyes are 63 mm apart; fields of view are 90 degrees high, so that the focal length is half the height
    shift = 0.5 * HEIGHT * 0.063 / page.evaluate("player.vr.away")
    assert left[1] - right[1] == pytest.approx(shift, abs=1.0)
    assert left[0] == pytest.approx(right[0], abs=1.0)
    page.evaluate("player.vr.session.end()")
    until(page, "!player.vr")
    assert picture(page).max() > 60
