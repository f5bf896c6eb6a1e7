"""Pictures of the web renderer: those of the deferred renderer, and the same on WebGPU and WebGL2."""

import numpy as np
import pytest
from engines.probes import ENVIRONMENTS, LAMPS, MAP_SIZE, PROBES, REGIONS, ROTATION, SIDE, goldens
from engines.web.pages import BACKENDS, camera_record, chromium, numbers, open_page
from web.viewers import CHROMIUM

from beam_warp.converters import WriteOptions, write
from beam_warp.image.metrics import psnr
from beam_warp.image.tone import display_over
from beam_warp.world.gaussians import GaussianSequence
from beam_warp.world.lights import lights_to_json

pytest.importorskip("playwright.sync_api")
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(CHROMIUM is None, reason="no chromium is installed (set BEAM_CHROMIUM)"),
]

LEAST = {"figure": 38.0}
"""Least agreement of a probe with the deferred renderer [dB], over grey."""

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


@pytest.fixture(scope="module")
def stands():
    """What pages may fetch, and a page with a renderer for each backend, which keeps its environments."""
    files = {}
    with chromium() as browser:
        pages = {backend: open_page(browser, files) for backend in BACKENDS}
        for backend, page in pages.items():
            options = {"backend": backend, "shadowMapSize": MAP_SIZE}
            page.evaluate("async (options) => { window.made = await make(options); }", options)
        yield files, pages


@pytest.mark.parametrize("name", list(PROBES))
def test_a_probe_looks_as_the_deferred_renderer_draws_it_on_both_backends(name, stands, tmp_path):
    for golden in goldens([name]):
        check(golden, stands, tmp_path)


@pytest.mark.parametrize("name", list(PROBES))
def test_regions_of_an_environment_cast_the_deferred_renderer_s_shadows(name, stands, tmp_path):
    for golden in goldens([name], ENVIRONMENTS, REGIONS):
        check(golden, stands, tmp_path, environment_shadows=len(golden.regions))


def check(golden, stands, folder, environment_shadows=0):
    """Fail unless both backends draw a case as the deferred renderer does, and alike."""
    (files, pages), shot, name = stands, golden.shot, golden.probe
    key = f"{name}.b4d"
    if key not in files:
        write(GaussianSequence.from_clouds([shot.cloud]), folder / key, WriteOptions(error_scale=0.02))
        files[key] = folder / key
    lighting = "dim" if golden.lighting in LAMPS else golden.lighting
    files[f"{lighting}.f32"] = shot.environment.radiance.tobytes()
    lamps, camera = lights_to_json(shot.lights), camera_record(shot.camera)
    asked = [name, lighting, shot.environment.height, camera, lamps, ROTATION, environment_shadows]
    truth = display_over(golden.image.rgb, np.minimum(golden.image.alpha, 1.0), background=(0.5, 0.5, 0.5))
    pictures = {}
    for backend, page in pages.items():
        lit, picture = page.evaluate(SHOW, asked)
        lit, picture = numbers(lit, SIDE, SIDE, 4), numbers(picture, SIDE, SIDE, 4, dtype=np.uint8)
        shown = display_over(np.maximum(lit[..., :3], 0.0), np.clip(lit[..., 3], 0.0, 1.0), background=(0.5,) * 3)
        off_by_one = np.abs(shown.astype(int) - picture[..., :3]).max()
        assert off_by_one <= 1, "the display pass is the view transform of beam_warp"
        pictures[backend] = picture[..., :3].astype(int)
        found = psnr(truth / 255.0, picture[..., :3] / 255.0)
        print(f"{name:8} {golden.lighting:8} {environment_shadows} {backend} {found:.1f} dB")
        assert found >= LEAST.get(name, 40.0), (golden.lighting, backend, found)
    apart = np.abs(pictures["webgl2"] - pictures["webgpu"]).max(axis=-1)
    assert (apart <= 1).mean() >= 0.999, golden.lighting
