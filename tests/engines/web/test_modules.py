"""What the web module computes without a GPU: the same numbers as Python, and words for what is wrong."""

import base64
import gzip
import json
import re
import shutil
import struct
import subprocess
import zipfile
import zlib
from pathlib import Path

import numpy as np
import pytest
from engines.web.pages import MODULE
from support.drawn_ball import relightable

from beam_warp._version import __version__
from beam_warp.converters import WriteOptions, write
from beam_warp.light.ggx import specular_albedo_table
from beam_warp.light.prefiltered import blurred_environment
from beam_warp.light.regions import EnvironmentRegions
from beam_warp.light.uploaded import ROWS
from beam_warp.render.shadow_maps import LARGEST_KERNEL, ShadowCasters, light_views
from beam_warp.world.environment import EnvironmentMap
from beam_warp.world.framing import bulk
from beam_warp.world.gaussians import GaussianSequence
from beam_warp.world.lights import lights_from_json

NODE = shutil.which("node")
needs_node = pytest.mark.skipif(NODE is None, reason="Node.js is not installed")
LIGHTS = [
    {"type": "directional", "direction": [0.3, 0.5, -2.0], "irradiance": [1, 2, 3], "angular_diameter": 4.0},
    {"type": "point", "position": [0.1, 0.2, 0.3], "intensity": [1, 2, 3], "radius": 0.1},
    {"type": "point", "position": [3, -4, 1], "intensity": [1, 2, 3]},
    {
        "type": "spot",
        "position": [2, 0.5, 1],
        "direction": [-1, -0.2, -0.4],
        "intensity": [1, 2, 3],
        "inner_angle": 5,
        "outer_angle": 12,
    },
    {"type": "spot", "position": [2, 0, 1], "direction": [-1, 0, -0.4], "intensity": [1, 2, 3], "casts_shadows": False},
]


def run(*jobs):
    """Return what node makes of jobs, in one process."""
    script = Path(__file__).with_name("modules.mjs")
    text = json.dumps(jobs)
    done = subprocess.run([NODE, str(script)], input=text, capture_output=True, text=True, check=True, timeout=120)
    return json.loads(done.stdout)


def radiance_picture(radiance, width):
    """A Radiance picture of numbers that RGBE holds exactly; rows in the new run-length encoding, the last row flat."""
    mantissas, lines = radiance.astype(np.uint8), []
    for row in mantissas[:-1]:
        line = bytes((2, 2, width >> 8, width & 255))
        for channel in (*row.T, np.full(width, 136, np.uint8)):
            half = channel[: width // 2].tobytes()
            run_of = channel[width // 2 :]
            even = (run_of == run_of[0]).all()
            line += bytes([len(half)]) + half
            line += bytes([128 + len(run_of), run_of[0]]) if even else bytes([len(run_of)]) + run_of.tobytes()
        lines.append(line)
    lines.append(np.concatenate([mantissas[-1], np.full((width, 1), 136, np.uint8)], axis=1).tobytes())
    return b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\nEXPOSURE=2\n\n-Y 8 +X 16\n" + b"".join(lines)


def test_the_module_is_small_and_says_the_package_s_version():
    own = sorted(MODULE.glob("*.js")) + sorted(MODULE.glob("*.css"))
    assert len(gzip.compress(b"".join(path.read_bytes() for path in own), mtime=0)) <= 80 * 1024
    package = json.loads((MODULE / "package.json").read_text())
    assert package["version"] == __version__
    assert all((MODULE / place).is_file() for place in package["exports"].values())


@pytest.mark.slow
@needs_node
def test_light_is_read_and_blurred_as_python_does(tmp_path):
    rng = np.random.default_rng(2)
    radiance = rng.integers(129, 256, (8, 16, 3))
    radiance[:4, 8:] = 200
    path = tmp_path / "a.hdr"
    path.write_bytes(radiance_picture(radiance, 16))
    sky = EnvironmentMap((rng.random((20, 40, 3)) ** 8).astype(np.float32))
    damaged = tmp_path / "b.hdr"
    damaged.write_bytes(path.read_bytes()[:-40])
    (tmp_path / "c.hdr").write_bytes(b"\x89PNG and so on")
    read, cut, other, blurred = run(
        {"job": "hdr", "path": str(path)},
        {"job": "hdr", "path": str(damaged)},
        {"job": "hdr", "path": str(tmp_path / "c.hdr")},
        {"job": "prefilter", "height": 20, "radiance": sky.radiance.ravel().tolist()},
    )
    assert np.array_equal(np.reshape(read["radiance"], (8, 16, 3)), EnvironmentMap.read(path).radiance)
    assert cut["error"].startswith("EnvironmentError: environment must hold every scanline")
    assert other["error"].startswith("EnvironmentError: environment must be a Radiance picture")
    truth = blurred_environment(sky, "cpu")
    irradiance, *levels = [np.reshape(each["radiance"], (each["height"], -1, 3)) for each in blurred["maps"]]
    # cells of pi / 64 rad that straddle a normal's horizon lose (pi / 64)^2 / 12 of even light, 2e-4
    assert np.abs(irradiance / truth.irradiance.numpy() - 1.0).max() < 1e-3
    assert [len(level) for level in levels] == truth.heights.numpy().tolist()
    found = np.concatenate([level.reshape(-1, 3) for level in levels])
    texels = truth.texels.numpy()
    assert np.abs(found - texels).max() < 1e-4 * texels.max()
    assert np.abs(np.reshape(blurred["albedo"], (64, 64, 2)) - specular_albedo_table()).max() < 1e-6


@needs_node
@pytest.mark.parametrize("count", [5, 16])
def test_regions_of_environments_are_those_of_the_renderer(count):
    """The map is black below."""
    radiance = np.random.default_rng(3).gamma(0.2, size=(16, 32, 3)).astype(np.float32)
    radiance[10:] = 0.0
    wanted = EnvironmentRegions.of(EnvironmentMap(radiance), count)
    (found,) = run({"job": "regions", "height": 16, "radiance": radiance.ravel().tolist(), "count": count})
    directions, halves, moments = zip(*(each.values() for each in found["regions"]), strict=True)
    np.testing.assert_allclose(directions, wanted.directions, atol=1e-6)
    np.testing.assert_allclose(halves, wanted.half_angles, atol=1e-5)
    np.testing.assert_allclose(np.transpose(moments, (1, 0, 2)), wanted.moments, rtol=1e-5, atol=1e-5)


@needs_node
def test_what_a_worker_failed_to_make_is_made_when_it_is_asked_for_again():
    (ended,) = run({"job": "retry"})
    assert ended == 2 * ["no worker", "made", "made", 2]


@needs_node
def test_lamps_and_their_maps_stand_where_python_puts_them():
    casters = ShadowCasters(np.array([0.1, -0.2, 0.4]), 0.8)
    given = {"center": casters.center.tolist(), "radius": casters.radius}
    found, *wrong = run(
        {"job": "lights", "lights": LIGHTS, "casters": given, "size": 64},
        {"job": "lights", "lights": [{"type": "moon"}], "casters": given, "size": 64},
        {
            "job": "lights",
            "lights": [{"type": "point", "position": [0, 0], "intensity": [1, 1, 1]}],
            "casters": given,
            "size": 64,
        },
        {"job": "lights", "lights": [{**LIGHTS[1], "radius": None}], "casters": given, "size": 64},
    )
    for light, got in zip(lights_from_json(LIGHTS), found, strict=True):
        views = light_views(light, casters, 64) if light.casts_shadows else []
        row = ROWS[type(light)](light)
        expected = [*row.position, row.kind, *row.direction, row.size, *row.power, 0, *row.cone, 0, len(views)]
        assert got["lamp"] == pytest.approx(expected, abs=1e-6)
        assert len(got["maps"]) == len(views)
        for numbers, view in zip(got["maps"], views, strict=True):
            axes = view.camera.world_to_camera[:3, :3]
            ends = [view.radius, view.front, 0.01, LARGEST_KERNEL * 64]
            rows = [*axes, view.camera.position]
            expected = [value for row, end in zip(rows, ends, strict=True) for value in (*row, end)]
            assert numbers[:16] == pytest.approx(expected, rel=1e-6, abs=1e-6)
            assert numbers[16:] == pytest.approx([view.camera.focal_x] * 2 + [32, 32], rel=1e-6)
    assert [each["error"].split(" must")[0] for each in wrong] == [
        "LightError: lights[0].type", "LightError: lights[0].position", "LightError: lights[0].radius",
    ]  # fmt: skip


@needs_node
def test_depth_order_is_that_of_the_rasteriser_and_the_subject_s_bulk_that_of_python():
    rng = np.random.default_rng(5)
    positions = rng.normal(size=(400, 3)).astype(np.float32)
    positions[7] = 90.0
    positions[100:120] = positions[100]
    opacities = rng.random(400).astype(np.float32)
    plane = rng.integers(-9, 9, 400)
    row = [0.6, 0.0, 0.8, 2.0]
    found, = run({
        "job": "sort", "positions": positions.T.ravel().tolist(), "opacities": opacities.tolist(), "rows": [row],
        "plane": plane.tolist(), "weight": 0.125,
    })  # fmt: skip
    positions[:, 0] += np.float32(0.125) * plane.astype(np.float32)
    depth = positions @ np.float32(row[:3]) + np.float32(2.0)
    drawn = [i for i in found["orders"][0] if depth[int(i)] > 0]
    assert found["orders"][0][: len(drawn)] == drawn
    assert sorted(found["orders"][0]) == list(range(400))
    assert np.all(np.diff(depth[np.array(drawn, int)]) >= -1e-5)
    same = [int(i) for i in drawn if 100 <= i < 120 and plane[int(i)] == plane[100]]
    assert same == sorted(same), "ties keep the order of the cloud"
    points = bulk(positions, opacities)
    center = 0.5 * (points.min(axis=0) + points.max(axis=0))
    assert found["bulk"]["center"] == pytest.approx(center, abs=1e-5)
    assert found["bulk"]["radius"] == pytest.approx(np.linalg.norm(points - center, axis=1).max(), rel=1e-5)


def packed(content, level=9, strategy=zlib.Z_DEFAULT_STRATEGY):
    """Raw deflate."""
    stream = zlib.compressobj(level, zlib.DEFLATED, -15, 9, strategy)
    return stream.compress(content) + stream.flush()


def unpacked(stream, most):
    """What zlib makes of raw deflate; None if that is damaged, or longer than ``most``."""
    unpacking = zlib.decompressobj(-15)
    try:
        content = unpacking.decompress(stream, most + 1)
    except zlib.error:
        return None
    return content if unpacking.eof and len(content) <= most else None


@needs_node
def test_deflate_is_unpacked_as_zlib_does():
    """Every kind of block, codes of every length, distances that are near and far; and streams that are damaged."""
    rng = np.random.default_rng(3)
    rare = np.repeat(np.arange(24), 2 ** np.arange(24)[::-1] // 8 + 1)[: 2**18]  # codes of up to 15 bits
    near = b"".join(bytes([k]) * 9 + bytes([k, k + 1] * 9) + bytes([k, k + 1, k + 2] * 9) for k in range(200))
    noise = rng.integers(0, 256, 40_000, np.uint8).tobytes()
    repeated = bytearray(noise)
    for start, length in zip(rng.geometric(0.001, 4000), rng.integers(3, 300, 4000), strict=True):
        repeated += repeated[-start:][:length] + bytes([length % 256])
    sparse = rng.poisson(0.05, 60_000).astype(np.uint8).tobytes()
    contents = [
        b"",
        b"a",
        bytes(10**5),
        rng.permutation(rare).astype(np.uint8).tobytes(),
        near,
        noise,
        bytes(repeated),
        sparse,
    ]
    strategies = [zlib.Z_DEFAULT_STRATEGY, zlib.Z_FIXED, zlib.Z_HUFFMAN_ONLY, zlib.Z_RLE]
    sound = [(packed(content, 9, how), len(content)) for content in contents for how in strategies]
    sound += [(packed(content, level), len(content)) for content in contents for level in (0, 1)]
    small = [(packed(content[:3000], 9, how), len(content[:3000])) for content in contents for how in strategies]
    damaged = []
    for stream, most in small:
        for at in rng.integers(1, len(stream), 40):
            spoiled = bytearray(stream)
            spoiled[at] ^= 1 << rng.integers(8)
            damaged += [(bytes(spoiled), most), (stream[:at], most)]
        damaged.append((stream, most - 1))
    streams = sound + damaged
    jobs = [[base64.b64encode(stream + bytes(4)).decode(), len(stream), max(most, 0)] for stream, most in streams]
    (found,) = run({"job": "inflate", "streams": jobs})
    for (stream, most), theirs in zip(streams, found, strict=True):
        ours = unpacked(stream, max(most, 0))
        assert ours == (None if theirs is None else base64.b64decode(theirs)), (stream[:40], most)
    assert None not in found[: len(sound)]
    assert None in found


@needs_node
def test_bytes_that_are_no_container_are_refused_in_words(tmp_path):
    (tmp_path / "a.b4d").write_bytes(b"not a zip at all, but long enough to have a head")
    (tmp_path / "b.b4d").write_bytes(
        struct.pack("<IHHHHHIIIHH", 0x04034B50, 20, 0, 0, 0, 0, 0, 9, 9, 13, 0) + b"manifest.json{}"
    )
    found = run(*({"job": "take", "path": str(tmp_path / name)} for name in ("a.b4d", "b.b4d")))
    assert all(re.match(r"DeliveryError: .* must be .*, got", each["error"]) for each in found), found


@needs_node
def test_a_container_that_was_cut_or_altered_is_refused_and_never_crashes_the_reader(tmp_path):
    rng = np.random.default_rng(7)
    clouds = [relightable(rng.normal(size=(50, 3))).with_arrays(ids=np.arange(50)) for _ in range(14)]
    path = tmp_path / "a.b4d"
    write(GaussianSequence.from_clouds(clouds, frames_per_second=10.0), path, WriteOptions())
    size = path.stat().st_size
    with zipfile.ZipFile(path) as archive:  # after the blocks comes zip's directory, which players do not read
        end = archive.start_dir
    cuts = [*range(0, 60, 7), *np.linspace(60, end - 1, 40).astype(int).tolist()]
    flips = [*range(0, 60, 3), *np.linspace(60, size - 1, 60).astype(int).tolist()]
    (found,) = run({"job": "damage", "path": str(path), "cuts": cuts, "flips": flips})
    assert found[0] == "whole"
    assert set(found) == {"whole", "DeliveryError"}
    assert "whole" not in found[1 : 1 + len(cuts)]


@needs_node
def test_segments_are_kept_within_a_bound_and_what_is_not_wanted_any_more_is_not_unpacked():
    steps = [
        {"want": 0, "nearest": 57},  # two segments are read ahead
        {"want": 4, "breaks": 5},
        {"want": 5},
        {"want": 5, "mends": 5},
        {"want": 5, "passes": 2001},
        {"want": 0, "slow": True},
        {"want": 3},
        {"want": 0},
        {"want": 3},
        {"flows": True, "slow": False, "nearest": 29},
    ]
    found, tight = run(
        {"job": "segments", "most": 450, "steps": steps},
        {"job": "segments", "most": 0, "steps": [{"want": 0}, {"want": 3}]},
    )
    assert found[0] == {"here": [0, 1, 2], "told": [], "unpacked": [0, 1, 2], "nearest": [2, 9, 28]}
    assert 4 in found[1]["here"]
    assert found[1]["told"] == [], "what cannot be read ahead is nobody's loss yet"
    assert found[2]["told"] == ["stalled 5"]
    assert found[3]["told"] == [], "it is asked for again after a while"
    assert found[4]["told"] == ["resumed 5"]
    assert len(found[4]["here"]) == 4, "450 bytes hold four"
    assert [step["told"] for step in found[5:]] == [[]] * 5, "what was given up is no loss"
    assert found[9]["unpacked"] == [3]
    assert 3 in found[9]["here"]
    assert max(len(step["here"]) for step in found) <= 4
    assert found[9]["nearest"][0] == 3
    assert [step["here"] for step in tight] == [[0, 1], [3, 4]], "one that is read ahead has to be kept"


@needs_node
def test_the_dialect_of_shaders_becomes_wgsl():
    source = (
        "vec3 f(vec3 a, int b) {\n  vec4 c = fetch(t, ivec2(b, 0), 0);\n"
        "  for (int i = 0; i < b; i++) {\n    c.x += float(i);\n  }\n  return a * inversesqrt(c.xyz);\n}\n"
    )
    (found,) = run({"job": "wgsl", "source": source})
    assert found == (
        "fn f(a: vec3f, b: i32) -> vec3f {\n  var c: vec4f = textureLoad(t, vec2i(b, 0), 0);\n"
        "  for (var i: i32 = 0; i < b; i++) {\n    c.x += f32(i);\n  }\n  return a * inverseSqrt(c.xyz);\n}\n"
    )
