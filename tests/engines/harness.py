"""The generated shaders, run as they are: WGSL and HLSL on Vulkan (`wgpu`), GLSL ES 3.00 in a browser (WebGL2).

``harness.slang`` stands for an engine. All that it reads lies in one array of float4, `packed`; row 0 holds width,
height, number of lamps, and side of shadow maps. A program computes one float4 an item.
"""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from base64 import b64decode
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from engines.probes import SIDE, Golden, Maps, prefiltered, shadow_maps
from numpy.typing import NDArray
from web.viewers import CHROMIUM, HERE, chromium

from beam_warp.light.ggx import specular_albedo_table
from beam_warp.light.uploaded import ROWS

ENGINES = Path(__file__).resolve().parents[2] / "engines"
sys.path.insert(0, str(ENGINES / "shading"))

import generate  # noqa: E402

FloatArray = NDArray[np.float32]
Program: TypeAlias = Callable[[FloatArray, int], FloatArray]
"""A function of the harness, ready for a target: rows of float4, and a number of items, to a float4 an item."""

AT = {"at": "float4 at(int index)"}
TEXTURE_WIDTH = 2048

WGSL_MAIN = """
@group(0) @binding(0) var<storage, read> given : array<vec4<f32>>;
@group(0) @binding(1) var<storage, read_write> made : array<vec4<f32>>;
fn at(index : i32) -> vec4<f32> { return given[index]; }
@compute @workgroup_size(64) fn main(@builtin(global_invocation_id) id : vec3<u32>)
{ if (id.x < arrayLength(&made)) { made[id.x] = PROGRAM(i32(id.x)); } }
"""
HLSL_MAIN = """
[[vk::binding(0, 0)]] StructuredBuffer<float4> given;
[[vk::binding(1, 0)]] RWStructuredBuffer<float4> made;
float4 at(int index) { return given[index]; }
[numthreads(64, 1, 1)] void main(uint3 id : SV_DispatchThreadID)
{ uint count, stride; made.GetDimensions(count, stride); if (id.x < count) made[id.x] = PROGRAM(int(id.x)); }
"""
GLSL_HEAD = "#version 300 es\nprecision highp float;\nprecision highp int;\nprecision highp sampler2D;\n"
GLSL_MAIN = """
uniform sampler2D given;
uniform int count;
out vec4 made;
vec4 at(int index) { return texelFetch(given, ivec2(index % WIDTH, index / WIDTH), 0); }
void main()
{
    int item = int(gl_FragCoord.y) * WIDTH + int(gl_FragCoord.x);
    made = item < count ? PROGRAM(item) : vec4(0.0);
}
"""
PAGE = """([source, width]) => {
  const gl = document.createElement("canvas").getContext("webgl2");
  if (!gl || !gl.getExtension("EXT_color_buffer_float")) throw new Error("no WebGL2 with float targets");
  const program = gl.createProgram();
  const corner = "vec2(gl_VertexID % 2, gl_VertexID / 2) * 4.0 - 1.0";
  const vertex = `#version 300 es\\nvoid main() { gl_Position = vec4(${corner}, 0.0, 1.0); }`;
  for (const [kind, text] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, source]]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, text);
    gl.compileShader(shader);
    if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
    gl.attachShader(program, shader);
  }
  gl.linkProgram(program);
  if (!gl.getProgramParameter(program, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(program));
  gl.useProgram(program);
  gl.bindFramebuffer(gl.FRAMEBUFFER, gl.createFramebuffer());
  const texture = (rows) => {
    const made = gl.createTexture();
    gl.bindTexture(gl.TEXTURE_2D, made);
    gl.texStorage2D(gl.TEXTURE_2D, 1, gl.RGBA32F, width, rows);
    for (const filter of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER])
      gl.texParameteri(gl.TEXTURE_2D, filter, gl.NEAREST);
    return made;
  };
  window.run = async (count) => {
    const floats = new Float32Array(await (await fetch("/given")).arrayBuffer());
    const rows = Math.ceil(count / width);
    const target = texture(rows);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, target, 0);
    const given = texture(floats.length / 4 / width);
    gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, width, floats.length / 4 / width, gl.RGBA, gl.FLOAT, floats);
    gl.uniform1i(gl.getUniformLocation(program, "count"), count);
    gl.viewport(0, 0, width, rows);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
    const out = new Float32Array(4 * width * rows);
    gl.readPixels(0, 0, width, rows, gl.RGBA, gl.FLOAT, out);
    for (const each of [target, given]) gl.deleteTexture(each);
    const bytes = new Uint8Array(out.buffer);
    let text = "";
    for (let i = 0; i < bytes.length; i += 8192) text += String.fromCharCode(...bytes.subarray(i, i + 8192));
    return btoa(text);
  };
}"""


def missing(target: str) -> str | None:
    """Return what a target lacks on this machine, or None."""
    if generate.slangc() is None:
        return "slangc is not installed (PyPI: slangtorch)"
    if target == "glsl":
        there = CHROMIUM and find_spec("playwright")
        return None if there else "no chromium is installed (set BEAM_CHROMIUM), or no playwright"
    if target == "hlsl" and not shutil.which("glslangValidator"):
        return "glslangValidator is not installed (Debian: glslang-tools)"
    return None if device() is not None else "wgpu finds no adapter (PyPI: wgpu; Debian: mesa-vulkan-drivers)"


@cache
def device() -> Any:
    """Return a device of Vulkan, drawn by the CPU where there is no GPU; None without wgpu or an adapter."""
    try:
        import wgpu

        return wgpu.gpu.request_adapter_sync().request_device_sync()
    except (ImportError, OSError, RuntimeError):
        return None


@cache
def source(target: str, program: str) -> str:
    """Return the committed text of a target, and after it the harness with one function of it as the program."""
    compiler = generate.slangc()
    assert compiler is not None
    harness = Path(__file__).with_name("harness.slang").read_text(encoding="utf-8")
    relight = generate.SOURCE.read_text(encoding="utf-8")
    made = generate.texts(compiler, target, relight + harness, AT)
    engine = "\n\n".join(made[name] for _, _, name, _ in generate.FUNCTION.findall(harness))
    parts = dict(re.findall(r"export const (\w+) = `\n(.*?)`;", generate.JAVASCRIPT.read_text(encoding="utf-8"), re.S))
    if target == "wgsl":
        text = [parts["WGSL"], parts["WGSL_FETCHING"], engine, WGSL_MAIN]
    elif target == "glsl":
        main = GLSL_MAIN.replace("WIDTH", str(TEXTURE_WIDTH))
        text = [GLSL_HEAD, parts["GLSL"], parts["GLSL_FETCHING"], generate.declarations(target, AT), engine, main]
    else:
        hlsl = "#define RELIGHT_FETCHING\n" + generate.HLSL.read_text(encoding="utf-8")
        text = [hlsl, generate.declarations(target, AT), engine, HLSL_MAIN]
    return "\n".join(text).replace("PROGRAM", program)


def vulkan_program(target: str, program: str, folder: Path) -> Program:
    """Return a program on Vulkan: of WGSL, or of HLSL by way of glslang and SPIR-V."""
    import wgpu

    code: Any = source(target, program)
    if target == "hlsl":
        written, compiled = folder / f"{program}.hlsl", folder / f"{program}.spv"
        written.write_text(code, encoding="utf-8")
        command = ["glslangValidator", "-D", "-V", "-S", "comp", "-e", "main", str(written), "-o", str(compiled)]
        run = subprocess.run(command, capture_output=True, text=True, check=False)
        assert run.returncode == 0, run.stdout
        code = compiled.read_bytes()
    module = device().create_shader_module(code=code)
    pipeline = device().create_compute_pipeline(layout="auto", compute={"module": module, "entry_point": "main"})

    def run_on(given: FloatArray, count: int) -> FloatArray:
        usage = wgpu.BufferUsage
        rows = device().create_buffer_with_data(data=np.ascontiguousarray(given), usage=usage.STORAGE)
        made = device().create_buffer(size=16 * count, usage=usage.STORAGE | usage.COPY_SRC)
        entries = [{"binding": k, "resource": {"buffer": each}} for k, each in enumerate((rows, made))]
        encoder = device().create_command_encoder()
        compute = encoder.begin_compute_pass()
        compute.set_pipeline(pipeline)
        compute.set_bind_group(0, device().create_bind_group(layout=pipeline.get_bind_group_layout(0), entries=entries))
        compute.dispatch_workgroups(-(-count // 64))
        compute.end()
        device().queue.submit([encoder.finish()])
        return np.frombuffer(device().queue.read_buffer(made), np.float32).reshape(count, 4)

    return run_on


@contextmanager
def program(target: str, function: str, folder: Path) -> Iterator[Program]:
    """Make a function of the harness ready for a target; a browser is open meanwhile if it needs one."""
    if target != "glsl":
        yield vulkan_program(target, function, folder)
        return
    with chromium() as browser:
        page, rows = browser.new_page(), [b""]
        page.route("**/given", lambda route: route.fulfill(body=rows[0]))
        page.route("**/page", lambda route: route.fulfill(body="", content_type="text/html"))
        page.goto(f"{HERE}page")
        page.evaluate(PAGE, [source(target, function), TEXTURE_WIDTH])

        def run_on(given: FloatArray, count: int) -> FloatArray:
            rows[0] = np.pad(given, ((0, -len(given) % TEXTURE_WIDTH), (0, 0))).tobytes()
            text = page.evaluate("run", count)
            return np.frombuffer(b64decode(text), np.float32).reshape(-1, 4)[:count]

        yield run_on


def shaded(target: str, cases: Sequence[Golden], folder: Path) -> list[FloatArray]:
    """Return the pixels of cases; with regions, what arrives at Gaussians is found and blended first."""
    cases, shadowed = list(cases), [k for k, golden in enumerate(cases) if golden.regions]
    if shadowed:
        with program(target, "arrivedAt", folder) as lit:
            for k in shadowed:
                values = cases[k].frame.gaussians.values
                rows = values.numpy().copy()
                rows[:, 8:] = lit(packed(cases[k]), len(rows))
                values.assign(rows)
                cases[k] = replace(cases[k])  # without the buffer of what the renderer found to arrive
    with program(target, "shadedPixel", folder) as made:
        return [made(packed(golden), SIDE * SIDE) for golden in cases]


def packed(golden: Golden) -> FloatArray:
    """Return all that ``harness.slang`` reads of a case."""
    camera, maps, buffer = golden.shot.camera, shadow_maps(golden), golden.buffer
    pixels = np.zeros((len(buffer.alpha), 4, 4), np.float32)
    pixels[:, :2] = buffer.sums[:, :8].reshape(-1, 2, 4)
    pixels[:, 2, 0], pixels[:, 2, 1] = buffer.alpha, buffer.depth
    if golden.regions:
        pixels[:, 3] = buffer.sums[:, 8:]
    cloud = golden.shot.cloud
    gaussians = np.zeros((len(cloud), 2, 4), np.float32)
    gaussians[:, 0, :3], gaussians[:, 0, 3] = cloud.positions, cloud.ambient_occlusion
    gaussians[:, 1, :3] = cloud.normals
    moments = golden.regions.moments.transpose(1, 0, 2).reshape(-1, 4) if golden.regions else np.zeros((0, 4))
    levels = prefiltered(golden.shot.environment)
    parts = {
        "pixels": pixels.reshape(-1, 4),
        "lamps": _lamp_rows(golden, maps.counts),
        "gaussians": gaussians.reshape(-1, 4),
        "regions": moments.astype(np.float32),
        "views": _view_rows(maps),
        "shadows": maps.texels.reshape(-1, 4),
        "levels": np.zeros((len(levels), 4), np.float32),
        "albedo": _padded(specular_albedo_table().reshape(-1, 2)),
        "texels": np.concatenate([_padded(level.reshape(-1, 3)) for level in levels]),
    }
    starts = dict(zip(parts, np.cumsum([10, *(len(part) for part in parts.values())]), strict=False))
    rows = [len(level) for level in levels]
    parts["levels"][:, 0] = starts["texels"] + np.cumsum([0, *(2 * each * each for each in rows)])[:-1]
    parts["levels"][:, 1] = rows
    angle = np.radians(golden.shot.environment_rotation)
    head = np.zeros((10, 4), np.float32)
    head[0] = camera.width, camera.height, len(golden.shot.lights), maps.texels.shape[1]
    head[1, :2] = np.cos(angle), np.sin(angle)
    head[2] = starts["pixels"], starts["lamps"], starts["gaussians"], starts["regions"]
    head[9, 1:3] = len(golden.regions or ()), sum(maps.counts)
    head[3] = starts["views"], starts["shadows"], starts["levels"], starts["albedo"]
    head[4, :3] = camera.position
    head[5:8, :3] = camera.world_to_camera[:3, :3]
    head[8] = camera.focal_x, camera.focal_y, camera.center_x, camera.center_y
    return np.concatenate([head, *parts.values()])


def _padded(rows: FloatArray) -> FloatArray:
    return np.pad(rows, ((0, 0), (0, 4 - rows.shape[1])))


def _lamp_rows(golden: Golden, counts: Sequence[int]) -> FloatArray:
    rows, first = [], 0
    for light, count in zip(golden.shot.lights, counts, strict=True):
        row = ROWS[type(light)](light)
        rows += [(*row.position, row.kind), (*row.direction, row.size), (*row.power, first), (*row.cone, count, 0)]
        first += count
    return np.array(rows, np.float32).reshape(-1, 4)


def _view_rows(maps: Maps) -> FloatArray:
    rows = []
    for view in maps.views:
        camera = view.camera
        right, down, forward = camera.world_to_camera[:3, :3]
        rows += [(*camera.position, view.radius), (*right, view.front), (*down, maps.thickness)]
        rows += [(*forward, maps.largest_kernel), (camera.focal_x, camera.focal_y, camera.center_x, camera.center_y)]
        rows += [(camera.width, camera.height, 0, 0)]
    return np.array(rows, np.float32).reshape(-1, 4)


def psnr(made: FloatArray, golden: Golden) -> float:
    """Return the PSNR of radiance multiplied by alpha over pixels that the subject covers, 1 being the peak [dB]."""
    covered = golden.image.alpha.ravel() > 0.0
    error = (made[:, :3] - golden.image.rgb.reshape(-1, 3))[covered].astype(np.float64)
    return float(-10.0 * np.log10(max(float((error**2).mean()), 1e-16)))
