"""Pages of headless Chromium that hold the module `beam-relight`, and what they send back.

WebGL2 and WebGPU have no GPU here, but SwiftShader.
"""

from __future__ import annotations

import base64
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from engines.probes import LAMPS, MAP_SIZE, ROTATION, SIDE, Golden
from numpy.typing import NDArray
from PIL import Image
from web.viewers import CHROMIUM, HERE

from beam_warp.converters import WriteOptions, write
from beam_warp.world.camera import Camera
from beam_warp.world.gaussians import GaussianSequence
from beam_warp.world.lights import lights_to_json

MODULE = Path(__file__).parents[3] / "engines" / "web"
FLAGS = (
    *(
        "--no-sandbox",
        "--no-first-run",
        "--disable-background-networking",
        "--disable-component-update",
        "--disable-sync",
    ),
    *(
        "--ignore-gpu-blocklist",
        "--enable-unsafe-swiftshader",
        "--enable-unsafe-webgpu",
        "--use-webgpu-adapter=swiftshader",
    ),
    "--js-flags=--expose-gc",
)
BOTH_FLAGS = ("--use-gl=angle", "--use-angle=swiftshader", "--use-vulkan=swiftshader", "--enable-features=Vulkan")
BACKENDS = ("webgl2", "webgpu")

START = """<!doctype html><canvas id="canvas"></canvas><script type="module">
import * as relight from "/module/index.js";
Object.assign(window, relight);
window.heard = [];
window.make = async (options, canvas = null) => {
  const made = await Relight.create(canvas, options);
  for (const type of ["stalled", "resumed", "lost", "restored", "error"])
    made.addEventListener(type, (event) => heard.push([type, event.detail.message ?? ""]));
  return made;
};
window.packed = (numbers) => {
  const bytes = new Uint8Array(numbers.buffer, numbers.byteOffset, numbers.byteLength);
  let text = "";
  for (let i = 0; i < bytes.length; i += 8192) text += String.fromCharCode(...bytes.subarray(i, i + 8192));
  return btoa(text);
};
window.isThere = true;
</script>"""


CLEARED = """<!doctype html><canvas width="16" height="16"></canvas><script type="module">
window.isCleared = await (async () => {
  const device = await (await navigator.gpu.requestAdapter()).requestDevice();
  const context = document.querySelector("canvas").getContext("webgpu");
  context.configure({device, format: navigator.gpu.getPreferredCanvasFormat(), alphaMode: "opaque"});
  const commands = device.createCommandEncoder(), view = context.getCurrentTexture().createView();
  commands.beginRenderPass({colorAttachments: [{view, loadOp: "clear", storeOp: "store",
    clearValue: [1, 0, 0, 1]}]}).end();
  device.queue.submit([commands.finish()]);
  await device.queue.onSubmittedWorkDone();
  return true;
})().catch(() => false);
</script>"""

SHOW = """async ([probe, lighting, rows, camera, lights, rotation, environmentShadows]) => {
  window.environments ??= new Map();
  if (!environments.has(lighting)) {
    const radiance = new Float32Array(await (await fetch(`/${lighting}.f32`)).arrayBuffer());
    environments.set(lighting, await Environment.of({height: rows, radiance}));
  }
  const made = window.made;
  if (window.shown !== probe) await made.open(await Take.open(`/${probe}.b4d`));
  window.shown = probe;
  Object.assign(made, {environment: environments.get(lighting), lights, rotation, environmentShadows,
    background: [0.5, 0.5, 0.5]});
  if (!(await made.render(camera))) throw new Error("nothing was drawn");
  return [packed(await made.read("lit")), packed(await made.read("picture"))];
}"""

GREY = (0.5, 0.5, 0.5)
"""What `SHOW` draws pictures over."""


@contextmanager
def chromium(more: tuple[str, ...] = BOTH_FLAGS) -> Iterator[Any]:
    """Start a browser without a screen or a GPU, in which WebGL2 and WebGPU draw."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=[*FLAGS, *more])
        yield browser
        browser.close()


def need_shown_webgpu(browser: Any) -> None:
    """Skip a test if not even a page without our code shows a canvas that WebGPU cleared.

    SwiftShader loses its device there in some versions of Chromium, by what else they do with it.
    """
    page = browser.new_page()
    page.route(f"{HERE}**", lambda route: route.fulfill(body=CLEARED, content_type="text/html"))
    page.goto(HERE)
    page.wait_for_function("window.isCleared !== undefined")
    with Image.open(BytesIO(page.locator("canvas").screenshot())) as image:
        is_shown = image.convert("RGB").getpixel((8, 8)) == (255, 0, 0)
    page.close()
    if not is_shown:
        pytest.skip(f"chromium {browser.version} shows no canvas of WebGPU on SwiftShader")


def open_page(browser: Any, files: Mapping[str, bytes | Path], start: str = START) -> Any:
    """Open a page that imports the module; ``files`` are at hand by their names, and may change while it is open."""
    page = browser.new_page()

    def answer(route: Any) -> None:
        name = route.request.url.split("?")[0].removeprefix(HERE)
        content = MODULE / name.removeprefix("module/") if name.startswith("module/") else files.get(name)
        if not name:
            route.fulfill(body=start, content_type="text/html")
        elif content is None or (isinstance(content, Path) and not content.is_file()):
            route.fulfill(status=404)
        elif isinstance(content, Path):
            kind = "text/javascript" if content.suffix == ".js" else "application/octet-stream"
            route.fulfill(path=content, content_type=kind)
        else:
            route.fulfill(body=content, content_type="application/octet-stream")

    page.route("**/*", answer)
    page.goto(HERE)
    page.wait_for_function("window.isThere", timeout=60_000)
    return page


def numbers(packed: str, *shape: int, dtype: Any = np.float32) -> NDArray[Any]:
    """Return an array that a page sent by ``packed``."""
    return np.frombuffer(base64.b64decode(packed), dtype).reshape(*shape)


def camera_record(camera: Camera) -> dict[str, Any]:
    """Return a camera as `Relight.draw` takes it."""
    return {
        "position": camera.position.tolist(),
        "worldToCamera": camera.world_to_camera[:3, :3].ravel().tolist(),
        "focal": [camera.focal_x, camera.focal_y],
        "center": [camera.center_x, camera.center_y],
        "width": camera.width,
        "height": camera.height,
    }


@contextmanager
def drawing_pages() -> Iterator[tuple[dict[str, Any], dict[str, Any]]]:
    """Open a page with a renderer for each backend, which keeps environments; what pages may fetch comes with them."""
    files: dict[str, bytes | Path] = {}
    with chromium() as browser:
        pages = {backend: open_page(browser, files) for backend in BACKENDS}
        for backend, page in pages.items():
            options = {"backend": backend, "shadowMapSize": MAP_SIZE}
            page.evaluate("async (options) => { window.made = await make(options); }", options)
        yield files, pages


def drawn(
    golden: Golden, stands: tuple[dict[str, Any], dict[str, Any]], folder: Path
) -> Iterator[tuple[str, NDArray[np.float32], NDArray[np.uint8]]]:
    """Yield of each backend radiance times alpha, and alpha, and the picture over grey, ``(SIDE, SIDE, 4)`` each."""
    (files, pages), shot, key = stands, golden.shot, f"{golden.probe}.b4d"
    if key not in files:
        write(GaussianSequence.from_clouds([shot.cloud]), folder / key, WriteOptions(error_scale=0.02))
        files[key] = folder / key
    lighting = "dim" if golden.lighting in LAMPS else golden.lighting
    files[f"{lighting}.f32"] = shot.environment.radiance.tobytes()
    lamps, camera = lights_to_json(shot.lights), camera_record(shot.camera)
    asked = [golden.probe, lighting, shot.environment.height, camera, lamps, ROTATION, len(golden.regions or ())]
    for backend, page in pages.items():
        lit, picture = page.evaluate(SHOW, asked)
        yield backend, numbers(lit, SIDE, SIDE, 4), numbers(picture, SIDE, SIDE, 4, dtype=np.uint8)
