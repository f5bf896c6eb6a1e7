"""A take in a scene of three.js, by both of its renderers: depth, lamps, environment, and shadows both ways."""

import npm_packages
import numpy as np
import pytest
from engines.web.pages import MODULE, chromium, numbers, open_page
from support.drawn_ball import drawn_ball
from web.viewers import CHROMIUM

from beam_warp.converters import WriteOptions, write
from beam_warp.world.gaussians import GaussianSequence

pytest.importorskip("playwright.sync_api")
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(CHROMIUM is None, reason="no chromium is installed (set BEAM_CHROMIUM)"),
]

SIDE = 128
BUILDS = ("three.module.js", "three.core.js", "three.webgpu.js", "three.tsl.js")
START = """<!doctype html><script type="importmap">
{"imports": {"three": "/three.module.js", "three/webgpu": "/three.webgpu.js", "three/tsl": "/three.tsl.js"}}</script>
<script type="module">
import * as THREE from "three";
import {WebGPURenderer} from "three/webgpu";
import {RelightObject} from "/module/three.js";
import {Take} from "/module/index.js";
window.packed = (numbers) => btoa(String.fromCharCode(...numbers));
window.stage = async (kind) => {
  const renderer = kind === "webgl" ? new THREE.WebGLRenderer({antialias: false, preserveDrawingBuffer: true})
    : new WebGPURenderer({antialias: false, requiredLimits: {maxColorAttachmentBytesPerSample: 64}});
  const target = kind === "webgl" ? null : new THREE.RenderTarget(SIDE, SIDE);
  await renderer.init?.();
  renderer.setRenderTarget(target);
  renderer.setSize(SIDE, SIDE, false);
  renderer.shadowMap.enabled = true;
  document.body.append(renderer.domElement);
  const scene = new THREE.Scene(), camera = new THREE.PerspectiveCamera(40, 1, 0.1, 50);
  camera.position.set(0, 1.2, 4);
  camera.lookAt(0, 0.3, 0);
  camera.updateMatrixWorld();
  const sun = new THREE.DirectionalLight(0xffffff, 3);
  sun.position.set(2, 3, 2);
  sun.castShadow = true;
  sun.shadow.mapSize.set(512, 512);
  Object.assign(sun.shadow.camera, {left: -3, right: 3, top: 3, bottom: -3, far: 20});
  scene.add(sun, sun.target);
  const standard = (color) => new THREE.MeshStandardMaterial({color, roughness: 0.5, metalness: 0});
  const add = (geometry, color, ...place) => {
    const mesh = Object.assign(new THREE.Mesh(geometry, standard(color)), {castShadow: true, receiveShadow: true});
    mesh.position.set(...place);
    scene.add(mesh);
    return mesh;
  };
  const ground = add(new THREE.PlaneGeometry(12, 12), 0x999999, 0, -0.5, 0);
  ground.rotation.x = -Math.PI / 2;
  ground.castShadow = false;
  const ball = await RelightObject.create(renderer, await Take.open("/ball.b4d"), {shadowMapSize: 256});
  ball.relight.addEventListener("error", (event) => { throw event.detail.error; });
  scene.add(ball);
  const draw = async () => {
    for (let k = 0; k < 3; k++) {
      renderer.render(scene, camera);
      await ball.ready();
      await new Promise(requestAnimationFrame); // WebGPURenderer draws shadow maps once an animation frame
    }
    renderer.render(scene, camera);
    if (target) { // in linear light, top row first
      const light = await renderer.readRenderTargetPixelsAsync(target, 0, 0, SIDE, SIDE);
      const pixels = new Uint8Array(light.length);
      for (let i = 0; i < light.length; i++) {
        const row = Math.floor(i / (4 * SIDE));
        pixels[(SIDE - 1 - 2 * row) * 4 * SIDE + i] = Math.round(255 * (light[i] / 255) ** (1 / 2.2));
      }
      return packed(pixels);
    }
    const gl = renderer.getContext(), pixels = new Uint8Array(4 * SIDE * SIDE);
    gl.readPixels(0, 0, SIDE, SIDE, gl.RGBA, gl.UNSIGNED_BYTE, pixels);
    if (gl.getError()) throw new Error("WebGL complains");
    return packed(pixels);
  };
  return {THREE, renderer, scene, camera, sun, ground, ball, add, draw};
};
window.isThere = true;
</script>""".replace("SIDE", str(SIDE))


@pytest.fixture(scope="module", params=["webgl", "webgpu"])
def page(request, tmp_path_factory):
    try:
        three = npm_packages.packages() / "three" / "build"
    except npm_packages.MissingPackagesError as error:
        pytest.skip(f"three.js cannot be had: {error}")
    path = tmp_path_factory.mktemp("three") / "ball.b4d"
    write(
        GaussianSequence.from_clouds(
            [
                drawn_ball(color=(0.8, 0.4, 0.2), count=4000).with_arrays(
                    radiance=None, radiance_color_space=None, scales=np.tile([0.025, 0.025, 1e-4], (4000, 1))
                )
            ]
        ),
        path,
        WriteOptions(),
    )
    files = {name: three / name for name in BUILDS} | {"ball.b4d": path}
    assert (MODULE / "three.js").is_file()
    with chromium() as browser:
        opened = open_page(browser, files, START)
        opened.evaluate("(kind) => stage(kind).then((made) => { Object.assign(window, made); })", request.param)
        assert opened.evaluate("ball.relight.backend") == {"webgl": "webgl2", "webgpu": "webgpu"}[request.param]
        yield opened


def shown(page, change):
    """What the scene looks like after a change, in linear light, top row first."""
    picture = numbers(page.evaluate(f"async () => {{ {change}; return await draw(); }}"), SIDE, SIDE, 4, dtype=np.uint8)
    return (picture[::-1, :, :3] / 255.0) ** 2.2


def test_gaussians_and_meshes_hide_each_other_by_depth(page):
    alone = shown(page, "")
    front = shown(page, "window.box = add(new THREE.BoxGeometry(0.3, 0.3, 0.3), 0x0000ff, 0, 0.35, 1.2)")
    behind = shown(page, "box.position.set(0, 0.15, -1.5)")
    page.evaluate("scene.remove(box)")
    row, column = 75, 64  # of the box
    assert alone[row, column, 0] > 2 * alone[row, column, 2], "the ball is orange"
    assert front[row, column, 2] > 3 * front[row, column, 0], "a blue box stands before it"
    assert np.allclose(behind[row, column], alone[row, column], atol=0.02), "and behind it, it is hidden"


def test_a_ball_of_gaussians_is_lit_as_a_ball_of_triangles(page):
    gaussians = shown(page, "sun.castShadow = false")
    triangles = shown(
        page,
        "ball.visible = false; const color = new THREE.Color().setRGB(0.8, 0.4, 0.2);"
        "window.twin = add(new THREE.SphereGeometry(0.5, 64, 48), color, 0, 0, 0)",
    )
    page.evaluate("scene.remove(twin); ball.visible = true; sun.castShadow = true")
    within = (slice(SIDE // 2 - 8, SIDE // 2 + 16), slice(SIDE // 2 - 12, SIDE // 2 + 12))
    assert np.abs(gaussians[within] - triangles[within]).mean() < 0.06 * triangles[within].mean()


def test_gaussians_cast_shadows_on_meshes(page):
    shadowed = shown(page, "")
    without = shown(page, "ball.castShadow = false")
    page.evaluate("ball.castShadow = true")
    darker = (shadowed < 0.7 * without - 0.01).all(axis=-1)
    assert 0.01 < darker.mean() < 0.2, "a spot of the ground is dark"
    assert darker[: SIDE // 3].mean() < 0.01


def test_what_draws_the_gaussians_casts_no_shadow_itself(page):
    """The triangle over the whole view would, to a lamp behind it."""
    shadowed = shown(page, "sun.position.z = -2")
    without = shown(page, "ball.castShadow = false")
    page.evaluate("ball.castShadow = true; sun.position.z = 2")
    darker = (shadowed < 0.7 * without - 0.01).all(axis=-1)
    assert 0.01 < darker.mean() < 0.2


def test_meshes_cast_shadows_on_gaussians(page):
    alone = shown(page, "")
    shadowed = shown(page, "window.lid = add(new THREE.BoxGeometry(0.5, 0.05, 0.5), 0xffffff, 0.85, 1.275, 0.85)")
    page.evaluate("scene.remove(lid)")
    again = shown(page, "")
    middle = (slice(60, 70), slice(68, 78))  # of the shadow
    assert shadowed[middle].mean() < 0.5 * alone[middle].mean()
    assert np.abs(again - alone).max() < 0.02
