"""The text for Unreal's Custom node is that of the shading source, compiles, and gives what the specification says."""

import re
import runpy
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

from beam_warp.light.ggx import specular_albedo_table

UNREAL = Path(__file__).parents[2] / "engines" / "unreal"
PASTED = (UNREAL / "RelightLamp.hlsl").read_text(encoding="utf-8")
INPUTS = "float3 BaseColor, float Roughness, float3 Normal, float3 View, float3 LightDirection, float3 LightIrradiance"

# A Custom node is a function's body. Glslang takes calls of a struct of its own for recursion: it stands outside.
NODE = """
[[vk::binding(0, 0)]] StructuredBuffer<float4> given;
[[vk::binding(1, 0)]] RWStructuredBuffer<float4> made;
struct Table
{
    float2 texel(float2 place) { int2 p = clamp(int2(place), 0, 63); return given[COUNT * 4 + p.y * 64 + p.x].xy; }
    float4 SampleLevel(int sampler_, float2 uv, float level)
    {
        float2 p = uv * 64.0f - 0.5f, low = floor(p), f = p - low;
        float2 top = lerp(texel(low), texel(low + float2(1, 0)), f.x);
        float2 bottom = lerp(texel(low + float2(0, 1)), texel(low + 1.0f), f.x);
        return float4(lerp(top, bottom, f.y), 0.0f, 0.0f);
    }
};
STRUCTS
float3 CustomExpression0(INPUTS, float LightSize, Table Terms, int TermsSampler)
{
BODY
}
[numthreads(64, 1, 1)] void main(uint3 id : SV_DispatchThreadID)
{
    float4 a = given[4 * id.x], n = given[4 * id.x + 1], v = given[4 * id.x + 2], l = given[4 * id.x + 3];
    Table table;
    made[id.x] = float4(CustomExpression0(a.xyz, a.w, n.xyz, v.xyz, l.xyz, float3(1, 2, 3), 0.0f, table, 0), 1.0f);
}
"""
COUNT = 64


def test_it_is_what_the_program_writes():
    generated = runpy.run_path(str(UNREAL / "generate.py"))
    assert generated["text"](generated["SOURCE"].read_text(encoding="utf-8")) == PASTED
    assert re.findall(r"^    \w+ (\w+)\(", PASTED, re.M) == list(generated["FUNCTIONS"])


def unit(rng):
    vectors = rng.normal(size=(COUNT, 3))
    vectors[:, 2] = 0.2 + np.abs(vectors[:, 2])
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def specified(color, rough, normal, view, light, albedo):
    """Section 3 of the specification, in float64: the BRDF times the cosine."""
    dot = lambda a, b: np.einsum("ni,ni->n", a, b)  # noqa: E731
    middle = (view + light) / np.linalg.norm(view + light, axis=1, keepdims=True)
    nl, nv, nh, vh = dot(normal, light), dot(normal, view), dot(normal, middle), dot(view, middle)
    a2 = np.maximum(rough**2, 1e-3) ** 2
    spread = a2 / (np.pi * (nh**2 * (a2 - 1.0) + 1.0) ** 2)
    seen = 0.5 / (nl * np.sqrt(nv**2 * (1.0 - a2) + a2) + nv * np.sqrt(nl**2 * (1.0 - a2) + a2))
    lobe = spread * seen * (0.04 + 0.96 * (1.0 - vh) ** 5)
    return np.where(nl > 0.0, nl, 0.0)[:, None] * ((1.0 - albedo)[:, None] * color / np.pi + lobe[:, None])


def run(code, given):
    """What a compute shader makes of rows of float4, a row an item."""
    wgpu = pytest.importorskip("wgpu", reason="compiled; wgpu is not installed to run it")
    try:
        device, usage = wgpu.gpu.request_adapter_sync().request_device_sync(), wgpu.BufferUsage
    except RuntimeError:
        pytest.skip("compiled; wgpu finds no adapter to run it (Debian: mesa-vulkan-drivers)")
    module = device.create_shader_module(code=code)
    pipeline = device.create_compute_pipeline(layout="auto", compute={"module": module, "entry_point": "main"})
    rows = device.create_buffer_with_data(data=given, usage=usage.STORAGE)
    made = device.create_buffer(size=16 * COUNT, usage=usage.STORAGE | usage.COPY_SRC)
    entries = [{"binding": k, "resource": {"buffer": each}} for k, each in enumerate((rows, made))]
    encoder = device.create_command_encoder()
    compute = encoder.begin_compute_pass()
    compute.set_pipeline(pipeline)
    compute.set_bind_group(0, device.create_bind_group(layout=pipeline.get_bind_group_layout(0), entries=entries))
    compute.dispatch_workgroups(1)
    compute.end()
    device.queue.submit([encoder.finish()])
    return np.frombuffer(device.queue.read_buffer(made), np.float32).reshape(COUNT, 4)


@pytest.mark.skipif(not shutil.which("glslangValidator"), reason="no glslangValidator (Debian: glslang-tools)")
def test_it_compiles_and_lights_as_specified(tmp_path, rng):
    at = PASTED.index("BeamRelight beam;")
    code = NODE.replace("COUNT", str(COUNT)).replace("INPUTS", INPUTS)
    code = code.replace("STRUCTS", PASTED[:at]).replace("BODY", PASTED[at:])
    (tmp_path / "node.hlsl").write_text(code, encoding="utf-8")
    command = ["glslangValidator", "-D", "-V", "-S", "comp", "-e", "main", "-o", "node.spv", "node.hlsl"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout
    color, rough = rng.uniform(0.0, 1.0, (COUNT, 3)), rng.uniform(0.2, 1.0, COUNT)
    normal, view, light = (unit(rng) for _ in range(3))
    view[np.einsum("ni,ni->n", normal, view) < 0.05] = [0.0, 0.0, 1.0]
    zero = np.zeros((COUNT, 1))
    rows = [np.hstack(pair) for pair in ((color, rough[:, None]), (normal, zero), (view, zero), (light, zero))]
    table = np.pad(specular_albedo_table().reshape(-1, 2), ((0, 0), (0, 2)))
    given = np.concatenate([np.stack(rows, axis=1).reshape(-1, 4), table]).astype(np.float32)
    found = run((tmp_path / "node.spv").read_bytes(), given)[:, :3]
    terms = specular_albedo_table().astype(float)
    place = np.stack([rough, np.sqrt(np.einsum("ni,ni->n", normal, view))]) * 63.0
    low = np.minimum(place.astype(int), 62)
    f, g = place - low
    corners = [terms[low[0] + i, low[1] + j] @ [0.04, 1.0] for i in (0, 1) for j in (0, 1)]
    albedo = (corners[0] * (1 - g) + corners[1] * g) * (1 - f) + (corners[2] * (1 - g) + corners[3] * g) * f
    truth = specified(color, rough, normal, view, light, albedo) * [1.0, 2.0, 3.0]
    assert np.abs(truth).max() > 0.3
    assert np.allclose(found, truth, rtol=2e-4, atol=1e-6)
