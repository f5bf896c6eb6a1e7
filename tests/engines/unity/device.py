"""The package's HLSL on a Vulkan device: entries compiled by glslang to SPIR-V, and run by wgpu."""

import re
import shutil
import subprocess
import tempfile
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from engines.unity.csharp import HERE, PACKAGE

SHADERS = PACKAGE / "Runtime" / "Shaders"
GLSLANG = shutil.which("glslangValidator")
SPIRV_DIS = shutil.which("spirv-dis")
SPIRV_VAL = shutil.which("spirv-val")
TARGET = "vulkan1.1"
MATRICES = ("_BeamCamera", "_BeamObject", "unity_MatrixVP", "unity_ObjectToWorld")
STAGES = {"Vertex": "vert", "Fragment": "frag"}

needs_glslang = pytest.mark.skipif(
    not (GLSLANG and SPIRV_DIS and SPIRV_VAL), reason="there are no glslang-tools and spirv-tools"
)


def stage_of(entry):
    return next((stage for end, stage in STAGES.items() if entry.endswith(end)), "comp")


@dataclass(frozen=True)
class Entry:
    """An entry point: its SPIR-V, and by name the set and binding of its resources and the place of its constants."""

    name: str
    code: bytes
    bindings: dict
    constants: dict
    size: int


@cache
def compiled(file, entry, *defines):
    """Compile an entry point and validate it."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "out.spv"
        stage = stage_of(entry)
        command = [GLSLANG, "-D", "-V", "--quiet", "--target-env", TARGET, "-S", stage, "-e", entry]
        command += ["--auto-map-bindings", "--auto-map-locations", "--hlsl-iomap"]
        command += ["--resource-set-binding", "1" if stage == "frag" else "0"]  # stages have groups of their own
        command += [f"-I{SHADERS}", f"-I{HERE / 'stubs'}", *(f"-D{name}" for name in defines)]
        command += ["-o", str(out), str(SHADERS / file)]
        run = subprocess.run(command, capture_output=True, text=True, check=False)
        assert run.returncode == 0, run.stdout + run.stderr
        run = subprocess.run([SPIRV_VAL, "--target-env", TARGET, out], capture_output=True, text=True, check=False)
        assert run.returncode == 0, run.stderr
        said = subprocess.run([SPIRV_DIS, out], capture_output=True, text=True, check=True).stdout
        return reflected(entry, out.read_bytes(), said)


def reflected(entry, code, said):
    """Read names, bindings and offsets from a disassembly."""
    names = dict(re.findall(r'OpName (%\S+) "([^"]*)"', said))
    groups = dict(re.findall(r"OpDecorate (%\S+) DescriptorSet (\d+)", said))
    bindings = {}
    for variable, binding in re.findall(r"OpDecorate (%\S+) Binding (\d+)", said):
        name = names.get(variable) or "$Global"
        bindings[name] = int(groups[variable]), int(binding)
    block = next((key for key, name in names.items() if name == "$Global"), None)
    members = dict(re.findall(rf'OpMemberName {re.escape(block)} (\d+) "([^"]*)"', said)) if block else {}
    offsets = re.findall(rf"OpMemberDecorate {re.escape(block)} (\d+) Offset (\d+)", said) if block else []
    constants = {members[member]: int(offset) for member, offset in offsets}
    size = max(constants.values(), default=0) + 256  # the last one is an array of some rows at most
    return Entry(entry, code, bindings, constants, size)


@cache
def adapter():
    """The Vulkan device, lavapipe where there is no other."""
    wgpu = pytest.importorskip("wgpu", reason="there is no wgpu")
    try:
        return wgpu.gpu.request_adapter_sync()
    except RuntimeError as error:
        pytest.skip(f"there is no Vulkan device: {error}")


BLENDS = {
    "over": {"src_factor": "one", "dst_factor": "one-minus-src-alpha", "operation": "add"},
    "least": {"src_factor": "one", "dst_factor": "one", "operation": "min"},
    "none": None,
}
"""Blending of the passes of Relight.shader."""


class Device:
    """Buffers, textures and constants by the names that shaders give them."""

    def __init__(self):
        self.wgpu = pytest.importorskip("wgpu", reason="there is no wgpu")
        self.device = adapter().request_device_sync(required_features=["float32-blendable", "float32-filterable"])
        self.held = {}
        self.constants = {}
        self.pipelines = {}

    def buffer(self, name, array):
        """Put an array under a name; returns the buffer."""
        usage = self.wgpu.BufferUsage.STORAGE | self.wgpu.BufferUsage.COPY_SRC | self.wgpu.BufferUsage.COPY_DST
        content = np.ascontiguousarray(array)
        self.held[name] = self.device.create_buffer_with_data(data=content.tobytes() or bytes(16), usage=usage)
        return self.held[name]

    def texture(self, name, images):
        """Put images ``(layers, height, width, 4)`` float32 under a name."""
        layers, height, width, _ = images.shape
        texture = self.target(name, layers, height, width)
        self.device.queue.write_texture(
            {"texture": texture},
            np.ascontiguousarray(images, np.float32).tobytes(),
            {"bytes_per_row": 16 * width, "rows_per_image": height},
            (width, height, layers),
        )

    def target(self, name, layers, height, width, kind="rgba32float"):
        """Make a texture that can be drawn to and read, under a name."""
        use = self.wgpu.TextureUsage
        texture = self.device.create_texture(
            size=(width, height, layers),
            format=kind,
            usage=use.TEXTURE_BINDING | use.COPY_DST | use.COPY_SRC | use.RENDER_ATTACHMENT,
        )
        self.held[name] = texture
        return texture

    def image(self, name, layer=0):
        """Return a texture's layer, ``(height, width, 4)``."""
        texture = self.held[name]
        width, height, _ = texture.size
        assert texture.format == "rgba32float"
        data = self.device.queue.read_texture(
            {"texture": texture, "origin": (0, 0, layer)}, {"bytes_per_row": 16 * width}, (width, height, 1)
        )
        return np.frombuffer(data, np.float32).reshape(height, width, 4)

    def array(self, name, dtype):
        return np.frombuffer(self.device.queue.read_buffer(self.held[name]), dtype)

    def set(self, **constants):
        """Set constants: rows of float4; matrices as ``(…, 4, 4)`` arrays, as HLSL indexes them."""
        for name, value in constants.items():
            array = np.asarray(value, np.float32)
            if name in MATRICES:
                array = np.swapaxes(array, -1, -2)
            self.constants[name] = np.ascontiguousarray(array).tobytes()

    def _groups(self, pipeline, entries):
        groups = {}
        for entry in entries:
            for name, (group, binding) in entry.bindings.items():
                groups.setdefault(group, []).append({"binding": binding, "resource": self._resource(name, entry)})
        return {
            group: self.device.create_bind_group(layout=pipeline.get_bind_group_layout(group), entries=bound)
            for group, bound in groups.items()
        }

    def _resource(self, name, entry):
        if name == "$Global":
            content = bytearray(entry.size)
            for constant, offset in entry.constants.items():
                value = self.constants.get(constant, b"")
                content[offset : offset + len(value)] = value
            size = -len(content) % 16
            buffer = self.device.create_buffer_with_data(
                data=bytes(content) + bytes(size), usage=self.wgpu.BufferUsage.UNIFORM
            )
            return {"buffer": buffer, "offset": 0, "size": len(content) + size}
        if name.startswith("sampler"):
            return self.device.create_sampler(mag_filter="linear", min_filter="linear", mipmap_filter="linear")
        held = self.held[name]
        if hasattr(held, "create_view"):
            dimensions = {"_CameraDepthTexture": "2d", "_BeamCube": "cube"}
            return held.create_view(dimension=dimensions.get(name, "2d-array"))
        return {"buffer": held, "offset": 0, "size": held.size}

    def compute(self, file, entry, groups):
        """Dispatch a compute entry."""
        found = compiled(file, entry)
        if entry not in self.pipelines:
            module = self.device.create_shader_module(code=found.code)
            self.pipelines[entry] = self.device.create_compute_pipeline(
                layout="auto", compute={"module": module, "entry_point": entry}
            )
        pipeline = self.pipelines[entry]
        encoder = self.device.create_command_encoder()
        work = encoder.begin_compute_pass()
        work.set_pipeline(pipeline)
        for group, bound in self._groups(pipeline, [found]).items():
            work.set_bind_group(group, bound)
        work.dispatch_workgroups(groups)
        work.end()
        self.device.queue.submit([encoder.finish()])

    def draw(self, file, entries, targets, vertices, *, layer=0, defines=(), blend="over", clear=0.0, corners=None):
        """Draw triangles, of corners ``(vertices, 3)`` if there are any, into textures of those names."""
        found = [compiled(file, entry, *defines) for entry in entries]
        vertex, fragment = (self.device.create_shader_module(code=each.code) for each in found)
        part = BLENDS[blend]
        state = {"blend": {"color": part, "alpha": part}} if part else {}
        place = {"format": "float32x3", "offset": 0, "shader_location": 0}
        layout = {"array_stride": 12, "step_mode": "vertex", "attributes": [place]}
        states = [state | {"format": self.held[name].format} for name in targets]
        pipeline = self.device.create_render_pipeline(
            layout="auto",
            vertex={"module": vertex, "entry_point": entries[0], "buffers": [] if corners is None else [layout]},
            primitive={"topology": "triangle-list", "cull_mode": "none"},
            fragment={"module": fragment, "entry_point": entries[1], "targets": states},
        )
        encoder = self.device.create_command_encoder()
        attachments = [
            {
                "view": self.held[name].create_view(dimension="2d", base_array_layer=layer, array_layer_count=1),
                "load_op": "clear",
                "store_op": "store",
                "clear_value": (clear, 0, 0, 0),
            }
            for name in targets
        ]
        work = encoder.begin_render_pass(color_attachments=attachments)
        work.set_pipeline(pipeline)
        for group, bound in self._groups(pipeline, found).items():
            work.set_bind_group(group, bound)
        if corners is not None:
            content = np.ascontiguousarray(corners, np.float32).tobytes()
            buffer = self.device.create_buffer_with_data(data=content, usage=self.wgpu.BufferUsage.VERTEX)
            work.set_vertex_buffer(0, buffer)
        work.draw(vertices)
        work.end()
        self.device.queue.submit([encoder.finish()])
