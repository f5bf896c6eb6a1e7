"""Playing on the web: frames and their blends, damaged and lost segments, a GPU that goes, pages without a server."""

import base64
import json
from io import BytesIO

import numpy as np
import pytest
from engines.web.pages import BACKENDS, MODULE, camera_record, chromium, need_shown_webgpu, numbers, open_page
from PIL import Image
from support.drawn_ball import drawn_ball, relightable
from web.viewers import CHROMIUM

from beam_warp import rasterize
from beam_warp.converters import WriteOptions, write
from beam_warp.world.camera import Camera
from beam_warp.world.gaussians import GaussianSequence

pytest.importorskip("playwright.sync_api")
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(CHROMIUM is None, reason="no chromium is installed (set BEAM_CHROMIUM)"),
]

COUNT, FRAMES, RATE = 300, 16, 10.0
CAMERA = camera_record(Camera.look_at((0.0, -4.0, 0.5), (0, 0, 0), width=64, height=48, vertical_fov=40))
PRELUDE = f"const camera = {CAMERA};".replace("'", '"')


@pytest.fixture(scope="module")
def take(tmp_path_factory):
    """A take of two segments, in which everything moves."""
    rng = np.random.default_rng(1)
    base = relightable(
        rng.uniform(-0.7, 0.7, (COUNT, 3)), scales=np.full((COUNT, 3), 0.05), base_color=rng.random((COUNT, 3))
    )
    clouds = [
        base.with_arrays(
            positions=base.positions + 0.1 * np.sin(0.4 * frame + base.positions[:, ::-1]),
            ambient_occlusion=rng.uniform(0.2, 0.8, COUNT),  # a blend is clamped after it is made
            ids=np.arange(COUNT),
        )
        for frame in range(FRAMES)
    ]
    path = tmp_path_factory.mktemp("take") / "take.b4d"
    write(GaussianSequence.from_clouds(clouds, frames_per_second=RATE), path, WriteOptions())
    return path


@pytest.fixture(scope="module")
def browser():
    with chromium() as opened:
        yield opened


def test_the_gpu_evaluates_frames_and_blends_as_the_decoder_does(browser, take):
    page = open_page(browser, {"take.b4d": take})
    got = page.evaluate(
        f"""async () => {{ {PRELUDE}
        const made = await make({{backend: "webgl2"}}), take = await Take.open("/take.b4d"), out = [];
        await made.open(take);
        const mixed = (a, b, t) => a.map((value, i) => (1 - t) * value + t * b[i]);
        for (const at of [0, 3.25, 11, 12, 14.5, 99]) {{
          made.time = at / {RATE};
          await made.render(camera);
          const last = {FRAMES - 1}, low = Math.min(Math.floor(at), last), high = Math.min(low + 1, last);
          const t = Math.min(at, last) - low;
          const [a, b] = [await take.frame(low), await take.frame(high)];
          out.push([packed(await made.read("positions")), packed(await made.read("colors")),
            packed(mixed(a.positions, b.positions, t)), packed(mixed(a.ambient_occlusion, b.ambient_occlusion, t))]);
        }}
        return out; }}"""
    )
    for places, colors, positions, occlusion in got:
        x, y, z = numbers(positions, 3, COUNT)
        found = numbers(places, -1, 4)[:COUNT, :3]
        assert np.abs(found - np.stack([x, -z, y], axis=1)).max() < 2e-6
        assert np.abs(numbers(colors, -1, 4)[:COUNT, 3] - numbers(occlusion, COUNT)).max() < 2e-6
    page.close()


def test_captured_colour_is_that_of_the_rasteriser(browser, tmp_path):
    rng = np.random.default_rng(4)
    ball = drawn_ball(count=600)
    ball = ball.with_arrays(
        scales=np.tile([0.06, 0.06, 1e-3], (600, 1)), radiance=0.2 * rng.normal(size=(1, 16, 3)).repeat(600, axis=0)
    )
    path = tmp_path / "ball.b4d"
    write(GaussianSequence.from_clouds([ball]), path, WriteOptions(error_scale=0.02, sh_degree=3))
    camera = Camera.look_at((0.8, -2.0, 0.9), (0, 0, 0), width=64, height=48, vertical_fov=40)
    page = open_page(browser, {"ball.b4d": path})
    sums, channels = page.evaluate(
        """async (camera) => {
        const made = await make({backend: "webgl2"});
        await made.open(await Take.open("/ball.b4d"));
        made.channel = "radiance";
        await made.render(camera);
        return [packed(await made.read("sums0")), made.channels]; }""",
        camera_record(camera),
    )
    sums, buffer = numbers(sums, 48, 64, 4), rasterize(ball, camera, channels=["radiance"], device="cpu")
    assert "radiance" in channels
    solid = buffer.alpha > 0.5
    found = sums[..., :3] / np.maximum(sums[..., 3:], 1e-6)
    assert np.abs(found - buffer.channels["radiance"])[solid].max() < 5e-3
    assert np.ptp(buffer.channels["radiance"][solid]) > 0.3
    page.close()


def test_a_lost_segment_holds_the_last_frame_and_says_so_until_it_is_back(browser, take):
    whole = take.read_bytes()
    at = int(0.85 * len(whole))  # in the last segment
    files = {"take.b4d": whole[:at] + bytes(40) + whole[at + 40 :]}
    page = open_page(browser, files)
    held = page.evaluate(
        f"""async () => {{ {PRELUDE}
        window.made = await make({{backend: "webgl2"}});
        await made.open(await Take.open("/take.b4d"));
        made.time = 1.1; // the last frame of the first segment
        await made.render(camera);
        const before = packed(await made.read());
        made.time = 0.2;
        await made.render(camera);
        made.time = 1.5;
        const drawn = await made.render(camera); // the nearest frame at hand, while one may hope, and then held
        return [drawn, made.shownTime, before === packed(await made.read()), heard]; }}"""
    )
    assert held[:3] == [True, 1.1, True]
    assert held[3][0][0] == "stalled"
    assert "must have the digest" in held[3][0][1]
    files["take.b4d"] = whole
    said, moved = page.evaluate(
        f"""async () => {{ {PRELUDE}
        const before = packed(await made.read());
        await new Promise((resolve) => setTimeout(resolve, 2200));
        await made.render(camera);
        return [heard.at(-1)[0], before !== packed(await made.read())]; }}"""
    )
    assert (said, moved) == ("resumed", True)
    page.close()


@pytest.mark.parametrize("backend", ["webgl2", "webgpu"])
def test_a_lost_gpu_is_said_and_drawn_with_again(backend, browser, take):
    page = open_page(browser, {"take.b4d": take})
    said, same = page.evaluate(
        f"""async () => {{ {PRELUDE}
        const made = await make({{backend: "{backend}"}});
        await made.open(await Take.open("/take.b4d"));
        made.lights = [{{type: "point", position: [0, -2, 1], intensity: [4, 4, 4]}}];
        made.environment = await Environment.constant([0.2, 0.3, 0.4]);
        await made.render(camera);
        const before = packed(await made.read());
        const back = new Promise((resolve) => made.addEventListener("restored", resolve, {{once: true}}));
        if (made.backend === "webgpu") made.gpu.device.destroy();
        else {{
          const loss = made.gpu.gl.getExtension("WEBGL_lose_context");
          loss.loseContext();
          await new Promise((resolve) => setTimeout(resolve, 200));
          if (made.draw(camera)) throw new Error("a lost context draws nothing");
          loss.restoreContext();
        }}
        await back;
        await made.render(camera);
        return [heard.map(([type]) => type), before === packed(await made.read())]; }}"""
    )
    assert said == ["lost", "restored"]
    assert same
    page.close()


def test_without_webgpu_it_is_webgl2_or_words(browser, take):
    page = open_page(browser, {"take.b4d": take})
    backend, refused = page.evaluate(
        """async () => {
        Object.defineProperty(navigator, "gpu", {value: undefined});
        const made = await make({});
        let words = null;
        await make({backend: "webgpu"}).catch((error) => { words = `${error.constructor.name}: ${error.message}`; });
        return [made.backend, words]; }"""
    )
    assert backend == "webgl2"
    assert refused.startswith("GpuError: this browser must offer WebGPU")
    page.close()


def test_a_canvas_shows_what_webgpu_and_webgl2_draw(browser, take):
    shown = {}
    script = f"""async (backend) => {{ {PRELUDE}
        const canvas = document.getElementById("canvas"), made = await make({{backend}}, canvas);
        await made.open(await Take.open("/take.b4d"));
        made.background = [1, 0, 0];
        made.channel = "base_color";
        await made.render(camera);
        await new Promise(requestAnimationFrame); }}"""
    need_shown_webgpu(browser)
    for backend in BACKENDS:
        page = open_page(browser, {"take.b4d": take})
        page.evaluate(script, backend)
        shown[backend] = picture_of(page)
        page.close()
    assert (shown["webgl2"][0, 0] == [255, 0, 0]).all()
    assert (np.abs(shown["webgl2"].astype(int) - shown["webgpu"]).max(axis=-1) <= 1).mean() > 0.999
    assert np.ptp(shown["webgl2"][..., 2]) > 64


def picture_of(page):
    return np.asarray(Image.open(BytesIO(page.locator("#canvas").screenshot())).convert("RGB"))


BOUND = "inflate b4d gpu environment lights sorting segments shaders shading relight index"
"""Modules, each after those that it names."""
FILE_PAGE = """<!doctype html><script>
const sources = SOURCES, places = {};
for (const [name, text] of Object.entries(sources)) {
  const bound = text.replace(/from "\\.\\/(\\w+)\\.js"/g, (_, other) => `from "${places[other]}"`);
  places[name] = URL.createObjectURL(new Blob([bound], {type: "text/javascript"}));
}
const bytes = Uint8Array.from(atob("BYTES"), (c) => c.charCodeAt(0));
window.played = (async () => {
  PRELUDE
  const {Relight, Take} = await import(places.index);
  const made = await Relight.create(null, {backend: "webgl2"});
  await made.open(await Take.from(bytes));
  made.time = 1.3;
  const drawn = await made.render(camera);
  return [drawn, Math.max(...await made.read("sums0"))];
})();
</script>"""
"""Modules cannot be imported from files: as in a page of one file, each is a blob that names the others."""


def test_a_page_from_a_file_plays_a_take_from_its_bytes(browser, take, tmp_path):
    sources = json.dumps({name: (MODULE / f"{name}.js").read_text(encoding="utf-8") for name in BOUND.split()})
    text = FILE_PAGE.replace("BYTES", base64.b64encode(take.read_bytes()).decode()).replace("PRELUDE", PRELUDE)
    file = tmp_path / "page.html"
    file.write_text(text.replace("SOURCES", sources.replace("</", "<\\/")), encoding="utf-8")
    page = browser.new_page()
    page.goto(file.as_uri())
    drawn, most = page.evaluate("window.played")
    assert drawn
    assert most > 0.3
    page.close()


def test_nothing_is_kept_of_what_was_shown(browser, take):
    page = open_page(browser, {"take.b4d": take})
    first, last = page.evaluate(
        f"""async () => {{ {PRELUDE}
        const made = await make({{backend: "webgl2", shadowMapSize: 32}}), counts = [];
        const take = await Take.open("/take.b4d");
        for (let k = 0; k < 12; k++) {{
          if (k % 4 === 0) await made.open(take);
          made.lights = k % 2 ? [{{type: "directional", direction: [1, 1, -1], irradiance: [1, 1, 1]}}] : [];
          made.time = (7 * k % {FRAMES}) / {RATE};
          await made.render({{...camera, width: 64 - 8 * (k % 3)}});
          counts.push(made.gpu.made.size);
        }}
        const most = Math.max(...counts.slice(0, 6));
        made.dispose();
        return [most, Math.max(...counts.slice(6), made.gpu.made.size)]; }}"""
    )
    assert last <= first
    page.close()
