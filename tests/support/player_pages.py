"""Player pages in headless Chromium: waiting for them, what they show, and what the deferred renderer makes of it."""

import time

import numpy as np
from PIL import Image

from beam_warp.image.tone import display_over
from beam_warp.render.deferred import DeferredRenderer
from beam_warp.render.options import UNSHADOWED
from beam_warp.world.camera import Camera
from beam_warp.world.shot import Shot

WIDTH, HEIGHT = 800, 420
PATIENCE = 240.0
BACKGROUND = np.full(3, 33 / 255.0)


def ready(page):
    """Wait for the first picture."""
    until(page, "window.player?.isReady && player.drawn === 0 && !player.isDrawing")
    return page


def until(page, condition):
    """Wait for an expression; playwright's own way would need a page without a policy."""
    last = time.monotonic() + PATIENCE
    while not page.evaluate(f"Boolean({condition})"):
        assert time.monotonic() < last, f"{condition}: {page.locator('.message').inner_text()}"
        page.wait_for_timeout(50)


def settled(page):
    """Wait until nothing moves and the picture is sharp."""
    page.wait_for_timeout(100)
    until(page, "!player.isChanged && player.pending == null && !player.isDrawing")


def picture(page):
    """The picture as it is saved, (height, width, 3)."""
    settled(page)
    with page.expect_download(timeout=1000 * PATIENCE) as waiting:
        page.evaluate("player.savePng()")
    return np.asarray(Image.open(waiting.value.path()).convert("RGB"))


def said(page):
    page.locator(".message").wait_for(state="visible", timeout=1000 * PATIENCE)
    return page.locator(".message p").inner_text()


def camera_of(page, scale=1.0):
    """The camera that a page looks through."""
    given = page.evaluate(
        f"player.camera(...[player.root.clientWidth, player.root.clientHeight].map((n) => {scale} * n))"
    )
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = np.reshape(given["worldToCamera"], (3, 3)).T, given["position"]
    return Camera(int(given["width"]), int(given["height"]), *given["focal"], *given["center"], pose)


def as_rendered(page, cloud, environment, options=UNSHADOWED):
    """What the deferred renderer shows of a cloud to the page's camera, and where it is covered."""
    shot = Shot(cloud=cloud, camera=camera_of(page), environment=environment)
    image = DeferredRenderer(options, device="cpu").draw(shot)
    return display_over(image.rgb, image.alpha, background=BACKGROUND), image.alpha
