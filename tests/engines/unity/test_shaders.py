"""The package's HLSL: every entry compiles and validates, and what runs on a Vulkan device is what Python computes."""

import numpy as np
import pytest
from engines.unity.csharp import needs_mono, run
from engines.unity.device import Device, needs_glslang
from engines.unity.takes import walk

from beam_warp import converters
from beam_warp.converters import WriteOptions
from beam_warp.converters.delivery import decoder
from beam_warp.converters.delivery.decoder import Container

pytestmark = needs_glslang

ENTRIES = {
    "Evaluate.hlsl": ("Evaluate",),
    "Sort.hlsl": ("Keys", "Count", "Scan", "Scatter", "Order"),
    "Environment.hlsl": ("FromCube", "Irradiance"),
    "Splats.hlsl": ("SplatVertex", "SplatFragment"),
    "Deferred.hlsl": ("DeferredVertex", "DeferredFragment", "DepthFragment"),
}


def sorted_order(device, positions, way):
    """Sort as the package does: keys, then eight passes of count, scan and scatter."""
    count = len(positions)
    groups = -(-count // 1024)
    rows = np.zeros((count, 5, 4), np.float32)
    rows[:, 0, :3] = positions
    device.buffer("_BeamGaussians", rows)
    device.buffer("_BeamDigits", np.zeros(16 * groups, np.uint32))
    device.buffer("_BeamOrdered", np.zeros(count, np.uint32))
    here, there = (device.buffer("", np.zeros((count, 2), np.uint32)) for _ in range(2))
    device.set(_BeamObject=np.eye(4), _BeamSortPlane=np.zeros(4), _BeamSortWay=[*way, 0.0])
    device.set(_BeamSort=[count, groups, 0, 0])
    device.held["_BeamSorted"] = here
    device.compute("Sort.hlsl", "Keys", -(-count // 64))
    for shift in range(0, 32, 4):
        device.set(_BeamSort=[count, groups, shift, 0])
        device.held |= {"_BeamUnsorted": here, "_BeamSorted": there}
        device.compute("Sort.hlsl", "Count", groups)
        device.compute("Sort.hlsl", "Scan", 1)
        device.compute("Sort.hlsl", "Scatter", groups)
        here, there = there, here
    device.held["_BeamUnsorted"] = here
    device.compute("Sort.hlsl", "Order", -(-count // 64))
    return device.array("_BeamOrdered", np.uint32)


@pytest.mark.parametrize("count", [1, 1023, 1025, 5000])
def test_splats_are_sorted_and_ties_keep_their_order(count):
    rng = np.random.default_rng(count)
    positions = np.round(rng.normal(size=(count, 3)), 2).astype(np.float32)
    order = sorted_order(Device(), positions, [0.0, 1.0, 0.0])
    assert (order == np.argsort(-positions[:, 1], kind="stable")).all()


@needs_mono
@pytest.mark.parametrize("time", [0.0, 5.0, 13.0, 4.25, 11.5])
def test_a_moment_is_evaluated_as_python_evaluates_it(dump, tmp_path, time):
    """Between two frames it is evaluated from the blend of their numbers, across segments, too."""
    take = tmp_path / "a.b4d"
    converters.write(walk(70, 14, noise=0.02), take, WriteOptions())
    done = run(dump, take, tmp_path, time)
    assert done.returncode == 0, done.stdout + done.stderr
    device = Device()
    for name, file in {"Still": "still", "Segment": "segment", "Next": "next", "Terms": "terms"}.items():
        device.buffer(f"_Beam{name}", np.fromfile(tmp_path / file, np.uint8))
    device.buffer("_BeamComponents", np.fromfile(tmp_path / "components", np.float32))
    device.buffer("_BeamEvaluated", np.zeros((70, 5, 4), np.float32))
    device.set(_BeamCounts=[70, 0, 0, 0])
    device.compute("Evaluate.hlsl", "Evaluate", 2)
    found = device.array("_BeamEvaluated", np.float32).reshape(70, 5, 4)
    wanted = moment(Container(take), time)
    columns = {"positions": found[:, 0, :3], "opacities": found[:, 0, 3:], "orientations": found[:, 1]}
    columns |= {"scales": found[:, 2, :3], "roughness": found[:, 2, 3:], "base_color": found[:, 3, :3]}
    columns |= {"ambient_occlusion": found[:, 3, 3:], "normals": found[:, 4, :3]}
    assert columns.keys() == wanted.keys()
    for name, values in columns.items():
        np.testing.assert_allclose(values.T, wanted[name], rtol=1e-5, atol=5e-6, err_msg=name)


def moment(container, time):
    """Arrays of a moment: what blended numbers stand for."""
    frame, share = int(time), time - int(time)
    if share == 0.0:
        return container.frame(frame)
    raw = [numbers(container, frame), numbers(container, frame + 1)]
    blend = {name: (1.0 - share) * raw[0][name] + share * raw[1][name] for name in raw[0]}
    turn = decoder.quaternions(blend.pop("turns").astype(np.float32))
    arrays = {name: decoder.activated(name, values.astype(np.float32)) for name, values in blend.items()}
    arrays["orientations"] = decoder.product(turn, arrays["orientations"])
    arrays["normals"] = decoder.rotated(turn, arrays["normals"])
    return arrays


def numbers(container, frame):
    """Numbers of a frame before they are taken for anything."""
    manifest, found = container.manifest, {}
    entry = next(each for each in manifest["segments"] if frame < each["first"] + each["frames"])
    for block, at in ((manifest["static"], 0), (entry, frame - entry["first"])):
        for name, track in container.tracks(block, block.get("frames", 1)).items():
            found[name] = found.get(name, 0.0) + np.stack([component.at(at) for component in track])
    return found
