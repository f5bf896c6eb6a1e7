"""The package's HLSL: every entry compiles and validates, and what runs on a Vulkan device is what Python computes."""

import re

import numpy as np
import pytest
from engines.probes import ENVIRONMENTS, PROBES, REGIONS, goldens
from engines.unity.csharp import needs_mono, run
from engines.unity.device import SHADERS, Device, compiled, needs_glslang
from engines.unity.pictures import draw_buffer, picture, set_view, sort, upload_gaussians
from engines.unity.takes import walk

from beam_warp import converters
from beam_warp.converters import WriteOptions
from beam_warp.converters.delivery import decoder
from beam_warp.converters.delivery.decoder import Container
from beam_warp.image.color import linear_to_srgb
from beam_warp.world.axes import change_axes
from beam_warp.world.camera import Camera

pytestmark = needs_glslang

ENTRIES = {
    "Evaluate.hlsl": ("Evaluate",),
    "Sort.hlsl": ("Keys", "Count", "Scan", "Scatter", "Order"),
    "Environment.hlsl": ("FromCube", "Irradiance"),
    "Arriving.hlsl": ("Arrive",),
    "Splats.hlsl": ("SplatVertex", "SplatFragment"),
    "Meshes.hlsl": ("MeshVertex", "MeshFragment"),
    "Caster.hlsl": ("CasterVertex", "CasterFragment"),
    "Deferred.hlsl": ("DeferredVertex", "DeferredFragment", "DepthFragment"),
}


VARIANTS = [
    *[(file, entry, ()) for file, entries in ENTRIES.items() for entry in entries],
    *[("Splats.hlsl", entry, ("BEAM_SHADOW_MAP",)) for entry in ENTRIES["Splats.hlsl"]],
    *[("Splats.hlsl", entry, ("STEREO_INSTANCING_ON", "BEAM_DEPTH_ARRAY")) for entry in ENTRIES["Splats.hlsl"]],
    *[("Caster.hlsl", entry, ("BEAM_HDRP",)) for entry in ENTRIES["Caster.hlsl"]],
    *[
        ("Splats.hlsl", entry, (*others, "BEAM_REGIONS"))
        for entry in ENTRIES["Splats.hlsl"]
        for others in ((), ("STEREO_INSTANCING_ON", "BEAM_DEPTH_ARRAY"))
    ],
    ("Deferred.hlsl", "DeferredFragment", ("BEAM_EXPOSED",)),
    ("Deferred.hlsl", "DeferredFragment", ("BEAM_EXPOSED", "BEAM_REGIONS")),
    *[("Deferred.hlsl", entry, ("STEREO_INSTANCING_ON",)) for entry in ENTRIES["Deferred.hlsl"]],
]


@pytest.mark.slow
def test_every_entry_compiles_and_validates():
    for file, entry, defines in VARIANTS:
        found = compiled(file, entry, *defines)
        assert found.code[:4] == b"\x03\x02\x23\x07"  # SPIR-V
        names = {name for name, _ in found.bindings.items()} | found.constants.keys()
        assert all(
            re.match(r"_Beam|sampler_Beam|\$Global$|unity_|_(CameraDepth|Exposure)Texture$|_World", name)
            for name in names
        ), names


def test_every_hlsl_file_is_compiled():
    included = {"Gaussians.hlsl", "Views.hlsl", "Stereo.hlsl", "Relight.hlsl", "Light.hlsl"}
    assert {path.name for path in SHADERS.glob("*.hlsl")} == included | ENTRIES.keys()


@pytest.mark.slow
@pytest.mark.parametrize("count", [1, 1023, 1025, 5000])
def test_splats_are_sorted_and_ties_keep_their_order(count):
    rng = np.random.default_rng(count)
    positions = np.round(rng.normal(size=(count, 3)), 2).astype(np.float32)
    device = Device()
    rows = np.zeros((count, 5, 4), np.float32)
    rows[:, 0, :3] = positions
    device.buffer("_BeamGaussians", rows)
    device.set(_BeamObject=np.eye(4))
    sort(device, count, [0.0, 0.0, 0.0], [0.0, 1.0, 0.0])
    assert (device.array("_BeamOrder", np.uint32) == np.argsort(-positions[:, 1], kind="stable")).all()


@needs_mono
@pytest.mark.slow
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
            rows = found.setdefault(name, np.zeros((len(track), manifest["count"]), np.float32))
            for component, row in zip(track, rows, strict=True):
                component.add(at, row)
    return found


def psnr(found, wanted):
    return -10.0 * np.log10(np.square(np.clip(found, 0.0, 1.0) - np.clip(wanted, 0.0, 1.0)).mean())


def close_to(golden, found):
    """Whether a picture is that of the deferred renderer: 40 dB as light, and as it is displayed."""
    wanted = golden.image.rgb
    displayed = psnr(linear_to_srgb(np.clip(found[..., :3], 0, 1)), linear_to_srgb(np.clip(wanted, 0, 1)))
    return min(psnr(found[..., :3], wanted), displayed, psnr(found[..., 3], golden.image.alpha)) >= 40.0


@pytest.mark.slow
@pytest.mark.parametrize("name", PROBES)
def test_pictures_are_those_of_the_deferred_renderer(name):
    device = Device()
    for golden in goldens([name]):
        assert close_to(golden, picture(device, golden)), golden.lighting


@pytest.mark.slow
@pytest.mark.parametrize("name", PROBES)
def test_regions_of_environments_cast_the_deferred_renderer_s_shadows(name):
    device = Device()
    for golden in goldens([name], ENVIRONMENTS, REGIONS):
        assert close_to(golden, picture(device, golden)), golden.lighting


@pytest.mark.slow
def test_a_take_is_turned_with_its_object():
    """Gaussians in a container's axes, x right, y up, z back, and a matrix give the same picture."""
    (golden,) = goldens(["tripod"], ["studio"])
    to_world = np.array([[1, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
    assert close_to(golden, picture(Device(), golden, change_axes(golden.shot.cloud, "rub"), to_world))


@pytest.mark.slow
def test_opaque_surfaces_hide_splats_behind_them():
    (golden,) = goldens(["tripod"], ["studio"])
    cloud, camera = golden.shot.cloud, golden.shot.camera
    device = Device()
    upload_gaussians(device, cloud)
    wall = 2.7  # between the balls
    draw_buffer(device, cloud, camera, scene_depth=0.01 / wall)
    rest = device.image("_BeamRest")
    covered = rest[..., 3] > 0.0
    depth = rest[covered, 2] / rest[covered, 3]
    assert (depth < wall + 1e-4).all()
    behind = (golden.frame.image().layers["depth"] > wall + 0.2) & (golden.image.alpha > 0.9)
    assert behind.any()
    assert not covered[behind].any()


@pytest.mark.slow
def test_an_even_cube_sheds_pi_times_its_radiance():
    """Level texels point where the cube's do: its top face, y in Unity, is up."""
    device = Device()
    faces = np.full((6, 8, 8, 4), 0.5, np.float32)
    faces[2, ..., 0] = 2.0
    device.texture("_BeamCube", faces)
    device.buffer("_BeamTexels", np.zeros((512 + 128, 4), np.float32))
    device.set(_BeamLevel=[16, 0, 0, 1], _BeamSource=[16, 0, 0, 0])
    device.compute("Environment.hlsl", "FromCube", 8)
    device.set(_BeamLevel=[8, 512, 0, 1])
    device.compute("Environment.hlsl", "Irradiance", 2)
    texels = device.array("_BeamTexels", np.float32).reshape(-1, 4)
    level, irradiance = texels[:512].reshape(16, 32, 4), texels[512:].reshape(8, 16, 4)
    assert (level[0, :, 0] == 2.0).all()
    assert (level[8:, :, 0] == 0.5).all()
    np.testing.assert_allclose(level[..., 1:3], 0.5)
    np.testing.assert_allclose(irradiance[..., 1:3], 0.5 * np.pi, rtol=0.01)  # cosines at 512 middles
    assert irradiance[0, :, 0].min() > irradiance[-1, :, 0].max()


@pytest.mark.slow
def test_meshes_are_in_shadow_maps_by_their_depth():
    """A wall across the view of a lamp, and its place in Unity's axes: y up, z forward."""
    device = Device()
    camera = Camera.look_at((0.0, -2.0, 0.5), (0.0, 0.0, 0.5), width=32, height=32, vertical_fov=60.0)
    set_view(device, camera)
    device.set(unity_ObjectToWorld=[[1, 0, 0, 0], [0, 1, 0, 0.5], [0, 0, 1, 1.0], [0, 0, 0, 1]])
    device.target("map", 1, 32, 32)
    corners = [(-9, -9, 0), (9, -9, 0), (-9, 0, 0), (9, -9, 0), (9, 0, 0), (-9, 0, 0)]  # lower half of the view
    meshes = ("MeshVertex", "MeshFragment")
    device.draw("Meshes.hlsl", meshes, ["map"], 6, blend="least", clear=3e38, corners=corners)
    found = device.image("map")[..., 0]
    np.testing.assert_allclose(found[16:], 3.0, rtol=1e-5)
    assert (found[:16] > 1e38).all()


@pytest.mark.slow
def test_a_take_casts_shadows_where_it_hides_half():
    """Under a parallel light the shadow of a Gaussian is the ellipse in which its alpha is at least a half."""
    device = Device()
    place, sigmas, opacity = (0.1, 0.0, -0.2), (0.2, 0.05, 0.1), 0.9
    ball = [*place, opacity, 0, 0, 0, 1, *sigmas, 0.5, 0.5, 0.5, 0.5, 1, 0, 0, 1, 0]
    device.buffer("_BeamGaussians", np.array(ball, np.float32))
    device.set(_BeamObject=np.eye(4), unity_MatrixVP=[[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0.1, 0.5], [0, 0, 0, 1]])
    device.target("map", 1, 256, 256)
    device.draw("Caster.hlsl", ("CasterVertex", "CasterFragment"), ["map"], 6, blend="none")
    found = device.image("map")[..., 0]
    y, x = np.mgrid[1 : -1 : -1 / 128, -1 : 1 : 1 / 128] + np.array([-1, 1])[:, None, None] / 256
    e = ((x - place[0]) / sigmas[0]) ** 2 + ((y - place[2]) / sigmas[2]) ** 2  # Unity's y is the world's z
    wanted = opacity * np.exp(-0.5 * e) >= 0.5
    assert wanted.any()
    assert (found == wanted).mean() > 0.999
