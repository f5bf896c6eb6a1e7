"""The delivery container: bounds hold, bytes are those of the page, and two other decoders read the same numbers."""

import ast
import hashlib
import itertools
import json
import re
import shutil
import struct
import subprocess
import sys
import zipfile
import zlib
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from support.drawn_ball import relightable

from beam_warp import converters
from beam_warp.cli.convert import main
from beam_warp.converters import WriteOptions
from beam_warp.converters.delivery import decoder, writer
from beam_warp.converters.delivery.decoder import Container
from beam_warp.converters.delivery.motion import Planes, moving, still
from beam_warp.errors import AssetFormatError, InvalidArrayError
from beam_warp.world.axes import change_axes
from beam_warp.world.gaussians import GaussianSequence

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "delivery.md").read_text(encoding="utf-8")
NODE = shutil.which("node")
needs_node = pytest.mark.skipif(NODE is None, reason="there is no Node.js")


def moved(cloud, frames, *, noise=0.0, turn=0.1, seed=0):
    """A cloud that turns about z by steps and shakes, its materials with it."""
    rng = np.random.default_rng(seed)
    for frame in range(frames):
        way = Rotation.from_euler("z", turn * frame)
        shaken = way * Rotation.from_rotvec(noise * rng.normal(size=(len(cloud), 3)))
        yield cloud.with_arrays(
            positions=way.apply(cloud.positions) + noise * rng.normal(size=(len(cloud), 3)),
            orientations=(shaken * Rotation.from_quat(cloud.orientations)).as_quat(),
            normals=shaken.apply(cloud.normals),
            ambient_occlusion=np.clip(cloud.ambient_occlusion + noise * rng.normal(size=len(cloud)), 0.0, 1.0),
        )


def walk(make_cloud, count=40, frames=5, **motion):
    cloud = make_cloud(count, 0, materials=True, radiance=None, radiance_color_space=None)
    clouds = list(moved(cloud, frames, **motion))
    return GaussianSequence.from_clouds(clouds, frames_per_second=24.0, metadata={"producer": "nobody"})


def written(sequence, path, **options):
    converters.write(sequence, path, WriteOptions(**options))
    return path


def pairs(sequence, path):
    """Clouds as they were and as they are read, row by row; rows are matched by their places in the first frame."""
    back = converters.read(path)
    first = change_axes(sequence[0], "rub")
    rows = cKDTree(first.positions).query(back[0].positions)[1] if len(first) else np.arange(0)
    assert sorted(rows) == list(range(len(first)))
    for frame in range(len(sequence)):
        yield change_axes(sequence[frame], "rub").select(rows), back[frame]


def angles(first, second):
    """Angles between rotations [rad], by the chord, which keeps its digits where cosines are flat."""
    near = np.minimum(np.linalg.norm(first - second, axis=1), np.linalg.norm(first + second, axis=1))
    return 4.0 * np.arcsin(np.minimum(near / 2.0, 1.0))


@settings(max_examples=15, deadline=None)
@given(
    st.integers(1, 60),
    st.integers(1, 14),
    st.sampled_from([0.0, 1e-3, 0.3]),
    st.floats(-2.0, 2.0),
    st.sampled_from([0.3, 1.0, 5.0]),
    st.integers(0, 99),
)
def test_no_number_is_further_off_than_its_bound(tmp_path_factory, make_cloud, count, frames, noise, turn, scale, seed):
    sequence = walk(make_cloud, count, frames, noise=noise, turn=turn, seed=seed)
    path = written(sequence, tmp_path_factory.mktemp("b4d") / "a.b4d", error_scale=scale)
    bounds = Container(path).manifest["bounds"]
    assert bounds["positions"] == pytest.approx(0.05 * scale * np.median(np.median(sequence[0].scales, axis=1)))
    rounding = 1e-6 * max(1.0, np.abs(sequence[0].positions).max())
    for cloud, back in pairs(sequence, path) if bounds["positions"] < 0.01 else ():
        assert np.abs(cloud.positions - back.positions).max() <= bounds["positions"] + rounding
        assert np.abs(np.log(cloud.scales / back.scales)).max() <= bounds["scales"] + 1e-5
        for name in ("opacities", "base_color", "roughness", "ambient_occlusion"):
            assert np.abs(getattr(cloud, name) - getattr(back, name)).max() <= bounds[name] + 1e-6
        lean = np.linalg.norm(cloud.normals - back.normals, axis=1)
        assert 2.0 * np.arcsin(lean / 2.0).max() <= bounds["normals"] + 1e-5
        assert angles(cloud.orientations, back.orientations).max() <= bounds["orientations"] + 1e-5


class TestMotion:
    @pytest.mark.parametrize("rank", [0, 1, 3])
    def test_what_has_few_directions_takes_few_planes(self, rank):
        """A matrix of this rank is as many planes, and little is left to be said of single frames."""
        rng = np.random.default_rng(rank)
        values = rng.normal(size=(12, rank)) @ rng.normal(size=(rank, 3000)) + rng.normal(size=(12, 1))
        planes = moving(values.astype(np.float32), 1e-2)
        assert len(planes.summed) == rank
        assert np.abs(planes.plain).max(initial=0) <= rank  # of steps: each direction errs by one at most
        assert np.abs(planes.values() - values).max() <= 1e-2

    def test_noise_is_bounded_too(self):
        values = np.random.default_rng(0).normal(size=(30, 500)).astype(np.float32)
        assert np.abs(moving(values, 0.01).values() - values).max() <= 0.01

    def test_one_moment_is_rounded_to_twice_the_bound(self):
        values = np.linspace(-3.0, 9.0, 1000, dtype=np.float32)
        planes = still(values, 0.05)
        assert np.abs(planes.values()[0] - values).max() <= 0.05
        assert len(np.unique(planes.summed)) <= 12.0 / 0.099 + 2

    def test_a_propeller(self, tmp_path, make_cloud):
        """Where a turn passes a full one from the middle of a segment, its parameters have no limit."""
        sequence = walk(make_cloud, 30, 12, turn=1.3)
        path = written(sequence, tmp_path / "a.b4d")
        for cloud, back in pairs(sequence, path):
            assert angles(cloud.orientations, back.orientations).max() <= 0.02 + 1e-5


def spelled_out(path, frame):
    """A frame, number by number, as the page tells it; `beam_warp` is not used."""
    archive = path.read_bytes()
    name_size, extra = struct.unpack_from("<HH", archive, 26)
    size = struct.unpack_from("<I", archive, 18)[0]
    start = 30 + name_size + extra + size
    manifest = json.loads(archive[start - size : start])
    count = manifest["count"]

    def block(entry, at_frame, frames):
        packed = archive[start + entry["offset"] :][: entry["bytes"]]
        assert hashlib.sha256(packed).hexdigest() == entry["sha256"]
        content = zlib.decompress(packed)
        at = 4 + struct.unpack_from("<I", content)[0]
        arrays = json.loads(content[4:at])["arrays"]
        components = [(a["name"], s, p) for a in arrays for s, p in a["planes"]]
        weights = []
        for _, summed, plain in components:
            columns = 1 + len(summed) + len(plain)
            weights.append(struct.unpack_from(f"<{columns}f", content, at + 4 * columns * at_frame))
            at += 4 * columns * frames
        found = {}
        for (name, summed, plain), row in zip(components, weights, strict=True):
            values = [row[0]] * count
            for k, octets in enumerate([*summed, *plain]):
                total = 0
                for i in range(count):
                    code = sum(content[at + order * count + i] << 8 * order for order in range(octets))
                    number = code // 2 if code % 2 == 0 else -(code + 1) // 2
                    total = total + number if k < len(summed) else number
                    values[i] += row[1 + k] * total
                at += octets * count
            found.setdefault(name, []).append(values)
        assert at == len(content)
        return found

    raw = block(manifest["static"], 0, 1)
    entry = next(e for e in manifest["segments"] if frame < e["first"] + e["frames"])
    for name, values in block(entry, frame - entry["first"], entry["frames"]).items():
        raw[name] = np.add(raw.get(name, 0.0), values)
    raw = {name: np.array(values) for name, values in raw.items()}

    def rotation(rodrigues):
        length = np.linalg.norm(rodrigues, axis=0)
        return Rotation.from_rotvec((4.0 * np.arctan(length) * rodrigues / np.maximum(length, 1e-12)).T)

    turn = rotation(raw.get("turns", np.zeros((3, count))))
    normals = raw["normals"] / np.linalg.norm(raw["normals"], axis=0)
    return {
        "positions": raw["positions"],
        "orientations": (turn * rotation(raw["orientations"])).as_quat().T,
        "scales": np.exp(raw["scales"]),
        "normals": turn.apply(normals.T).T,
        **{n: np.clip(raw[n], 0.0, 1.0) for n in ("opacities", "base_color", "roughness", "ambient_occlusion")},
    }


def with_parts(path, place, change, first=0):
    """The same container, whose manifest says ``change(parts)`` of each block's parts; None: nothing."""
    with zipfile.ZipFile(path) as files:
        content = {name: files.read(name) for name in files.namelist()}
    manifest = json.loads(content["manifest.json"])
    for entry in (manifest["static"], *manifest["segments"])[first:]:
        entry["parts"] = change(entry["parts"])
        if entry["parts"] is None:
            del entry["parts"]
    content["manifest.json"] = json.dumps(manifest).encode()
    with zipfile.ZipFile(place, "w") as files:
        for name, each in content.items():
            files.writestr(name, each)
    return place


def node(folder, script, *arguments):
    """Return what a script for Node.js prints; it opens containers by `open(path)`."""
    reads = f"""
        import {{Take, DeliveryError}} from "{(ROOT / "engines/web/b4d.js").as_uri()}";
        import {{readFileSync}} from "node:fs";
        const open = (path, file = readFileSync(path)) =>
          Take.open("a.b4d", async (name, start, size) => file.subarray(start, start + size));
        """
    (folder / "read.mjs").write_text(reads + script)
    done = subprocess.run([NODE, folder / "read.mjs", *arguments], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout


class TestDecoders:
    @pytest.fixture
    def take(self, tmp_path, make_cloud):
        return written(walk(make_cloud, 9, 14, noise=0.01), tmp_path / "a.b4d")

    @pytest.mark.parametrize("frame", [0, 5, 13])
    def test_numpy_reads_what_the_page_says(self, take, frame):
        found, wanted = Container(take).frame(frame), spelled_out(take, frame)
        assert found.keys() == wanted.keys()
        for name, values in found.items():
            same = np.abs(values - wanted[name])
            if name == "orientations":
                same = np.minimum(same, np.abs(values + wanted[name]))
            assert same.max() < 1e-5 * max(1.0, np.abs(values).max()), name

    def test_a_block_is_one_stream_and_its_parts_unpack_alone(self, take, tmp_path):
        """Parts give the bytes of the whole, and readers the same numbers with and without them."""
        said = Container(take).manifest
        with zipfile.ZipFile(take) as files:
            for entry in (said["static"], *said["segments"]):
                packed = files.read(entry["file"])
                ends = np.cumsum([2, entry["parts"][0] - 2, *entry["parts"][1:]])
                raw = [packed[start:end] for start, end in itertools.pairwise(ends)]
                alone = [zlib.decompress(part + b"\3\0", -15) for part in raw]
                assert b"".join(alone) == zlib.decompress(packed)
                assert all(len(plane) % said["count"] == 0 for plane in alone[1:])
        whole = Container(with_parts(take, tmp_path / "old.b4d", lambda _: None))
        for frame in range(said["frames"]):
            here, there = Container(take).frame(frame), whole.frame(frame)
            assert here.keys() == there.keys()
            assert all(np.array_equal(here[name], there[name]) for name in here)

    @needs_node
    @pytest.mark.parametrize(("far", "octets"), [(1.0, 2), (1e2, 3), (1e4, 4)])
    def test_javascript_reads_what_numpy_reads(self, make_cloud, tmp_path, far, octets):
        """Blocks with and without parts; arrays of old frames are written over, and calls that overlap do not meet."""
        away = np.where(np.arange(43) == 0, far, 1.0)[:, None]
        clouds = [cloud.with_arrays(positions=away * cloud.positions) for cloud in walk(make_cloud, 43, 14, noise=0.01)]
        take = written(GaussianSequence.from_clouds(clouds), tmp_path / "a.b4d", error_scale=0.1)
        with zipfile.ZipFile(take) as files:
            block = zlib.decompress(files.read("static.bin"))
        arrays = json.loads(block[4 : 4 + struct.unpack_from("<I", block)[0]])["arrays"]
        assert max(width for array in arrays for summed, _ in array["planes"] for width in summed) == octets
        old = with_parts(take, tmp_path / "old.b4d", lambda _: None)
        script = """
            const found = [];
            const keep = (frame) => found.push(Object.fromEntries(Object.entries(frame).map(([k, v]) => [k, [...v]])));
            for (const path of process.argv.slice(2)) {
              const take = await open(path);
              let frame = {};
              for (const number of [5, 0, 13, 5]) keep(frame = await take.frame(number, frame));
              for (const each of await Promise.all([5, 0, 13, 5].map((number) => take.frame(number)))) keep(each);
            }
            console.log(JSON.stringify(found));
            """
        found = json.loads(node(tmp_path, script, take, old))
        assert found[:4] == found[4:8] == found[8:12] == found[12:]
        container = Container(take)
        for number, theirs in zip((5, 0, 13, 5), found[:4], strict=True):
            ours = container.frame(number)
            assert ours.keys() == theirs.keys()
            for name, values in ours.items():
                rounding = 4.0 * np.finfo(np.float32).eps * np.abs(values).max()  # of sums whose terms are as large
                np.testing.assert_allclose(np.ravel(theirs[name]), values.ravel(), 1e-5, 1e-5 + rounding, err_msg=name)

    @needs_node
    def test_javascript_names_the_segment_that_is_wrong(self, take, tmp_path):
        """One whose bytes were altered, and one whose parts are not what is said; others are read."""
        lies = [lambda p: p[:-1], lambda p: [p[0], p[1] - 1, *p[2:]], lambda p: [p[0], -9, *p[2:]], lambda _: "ab"]
        places = [with_parts(take, tmp_path / f"{k}.b4d", lie, first=1) for k, lie in enumerate(lies)]
        places.append(with_parts(take, tmp_path / "static.b4d", lies[0]))
        content = bytearray(take.read_bytes())
        content[content.rindex(b"PK\3\4") + 60] ^= 1
        take.write_bytes(content)
        script = """
            const said = (error) => console.log(error instanceof DeliveryError, error.message);
            for (const path of process.argv.slice(2)) {
              const take = await open(path).catch(said);
              if (take) for (const number of [0, 13]) await take.frame(number).catch(said);
            }
            """
        altered, *others, still = node(tmp_path, script, take, *places).splitlines()
        assert altered.startswith("true 000012.bin must have the digest")
        assert still.startswith("true static.bin must be a sound block, got: ")
        assert len(others) == 2 * len(lies)
        for line in others:
            assert re.match(r"true 0000(00|12)\.bin must be a sound block, got: ", line)

    def test_the_reader_in_javascript_is_short(self):
        for name, most, needed in (("b4d", 200, ["./inflate.js"]), ("inflate", 120, [])):
            lines = (ROOT / f"engines/web/{name}.js").read_text(encoding="utf-8").splitlines()
            assert sum(not re.match(r"\s*($|//|/\*|\*)", line) for line in lines) <= most
            assert re.findall(r'^import.*"(.*)"', "\n".join(lines), re.MULTILINE) == needed

    def test_the_decoder_stands_alone(self):
        """The decoder imports NumPy and the standard library, and has at most 200 lines that are not blank."""
        text = Path(decoder.__file__).read_text(encoding="utf-8")
        imports = [n for n in ast.walk(ast.parse(text)) if isinstance(n, (ast.Import, ast.ImportFrom))]
        names = {a.name for n in imports if isinstance(n, ast.Import) for a in n.names}
        names |= {n.module for n in imports if isinstance(n, ast.ImportFrom)}
        assert {name.partition(".")[0] for name in names} - set(sys.stdlib_module_names) == {"numpy"}
        assert sum(bool(line.strip()) for line in text.splitlines()) <= 200


class TestContainer:
    def test_the_block_of_the_page(self):
        """What the page shows byte by byte is what is written."""
        none = np.empty((0, 3), np.int32)
        planes = [
            Planes(np.array([[1.0, 0.5], [2.0, 1.0]], np.float32), np.array([[0, 20, 40]], np.int32), none),
            Planes(np.array([[5.0], [5.0]], np.float32), none, none),
            Planes(np.array([[0.0, 0.0], [0.0, 1.0]], np.float32), none, np.array([[0, 0, -3]], np.int32)),
        ]
        content = b"".join(writer.block_parts(2, {"positions": planes}))
        shown = re.search(r"<!-- block -->\n(.*?)<!-- /block -->", PAGE, re.DOTALL)[1]
        digits = "".join(re.findall(r"^    [0-9a-f]{4}  ((?:[0-9a-f]{2} )*[0-9a-f]{2})", shown, re.MULTILINE))
        assert bytes.fromhex(digits) == content

    def test_a_block_is_one_range_of_the_file(self, tmp_path, make_cloud):
        path = written(walk(make_cloud, 20, 30), tmp_path / "a.b4d")
        container = Container(path)
        segments = container.manifest["segments"]
        assert [(entry["first"], entry["frames"]) for entry in segments] == [(0, 12), (12, 12), (24, 6)]
        content, start = path.read_bytes(), path.read_bytes().index(b'{"format"')
        start += len(zipfile.ZipFile(path).read("manifest.json"))
        for entry in (container.manifest["static"], *segments):
            packed = content[start + entry["offset"] :][: entry["bytes"]]
            assert packed == zipfile.ZipFile(path).read(entry["file"])
            assert hashlib.sha256(packed).hexdigest() == entry["sha256"]

    def test_a_folder_holds_what_the_archive_does(self, tmp_path, make_cloud):
        sequence = walk(make_cloud)
        archive = written(sequence, tmp_path / "a.b4d")
        again = written(sequence, tmp_path / "b.b4d")
        written(sequence, tmp_path / "take" / "manifest.json")
        assert archive.read_bytes() == again.read_bytes()
        with zipfile.ZipFile(archive) as files:
            assert {name: files.read(name) for name in files.namelist()} == {
                file.name: file.read_bytes() for file in (tmp_path / "take").iterdir()
            }
        for cloud, other in zip(converters.read(archive), converters.read(tmp_path / "take"), strict=True):
            assert np.array_equal(cloud.positions, other.positions)

    def test_what_stands_still_is_said_once(self, tmp_path, make_cloud):
        cloud = walk(make_cloud, 30, 1)[0]
        path = written(GaussianSequence.from_clouds([cloud] * 25, frames_per_second=24.0), tmp_path / "a.b4d")
        container = Container(path)
        assert all(container.tracks(entry, entry["frames"]) == {} for entry in container.manifest["segments"])

    def test_the_sequence_keeps_its_facts(self, tmp_path, make_cloud):
        back = converters.read(written(walk(make_cloud), tmp_path / "a.b4d"))
        assert (len(back), back.frames_per_second, back.topology) == (5, 24.0, "perFrame")
        assert back.metadata["producer"] == "nobody"
        assert back[0].axes == "rub"

    def test_flat_gaussians_stay_flat(self, tmp_path, make_cloud):
        cloud = walk(make_cloud, 10, 1)[0]
        flat = cloud.with_arrays(scales=cloud.scales * [1.0, 1.0, 0.0])
        back = converters.read(written(GaussianSequence.from_clouds([flat]), tmp_path / "a.b4d"))[0]
        assert not back.scales[:, 2].any()
        assert back.scales[:, :2].all()

    def test_radiance_stays_where_nothing_else_is_shown(self, tmp_path, make_cloud):
        plain = GaussianSequence.from_clouds([make_cloud(20, 2)])
        both = GaussianSequence.from_clouds([make_cloud(20, 2, materials=True)])
        (cloud, back), *_ = pairs(plain, written(plain, tmp_path / "a.b4d"))
        assert np.abs(cloud.radiance - back.radiance).max() <= 0.01 + 1e-6
        assert back.radiance_color_space == cloud.radiance_color_space
        assert converters.read(written(both, tmp_path / "b.b4d"))[0].radiance is None
        assert converters.read(written(both, tmp_path / "c.b4d", sh_degree=0))[0].sh_degree == 0

    def test_no_gaussians(self, tmp_path, make_cloud):
        empty = walk(make_cloud, 3, 2)
        empty = GaussianSequence.from_clouds([cloud.select(np.arange(0)) for cloud in empty])
        assert [len(cloud) for cloud in converters.read(written(empty, tmp_path / "a.b4d"))] == [0, 0]

    def test_commands_convert_both_ways(self, tmp_path, make_cloud, capsys):
        clouds = [cloud.with_arrays(ids=np.arange(40)) for cloud in walk(make_cloud)]
        converters.write(GaussianSequence.from_clouds(clouds), tmp_path / "a.usdc")
        assert main([str(tmp_path / "a.usdc"), str(tmp_path / "a.b4d")]) == 0
        assert "not drawn and left out: ids" in capsys.readouterr().err
        assert main([str(tmp_path / "a.b4d"), str(tmp_path / "b.usdc")]) == 0
        assert main([str(tmp_path / "a.b4d"), str(tmp_path / "ply" / "b.ply"), "--profile", "beam"]) == 0
        there = converters.read(tmp_path / "b.usdc")
        assert len(there) == len(list((tmp_path / "ply").iterdir())) == 5
        assert there.topology == "constant"
        assert np.array_equal(there[3].positions, converters.read(tmp_path / "a.b4d")[3].positions)


class TestRefusals:
    def test_frames_whose_counts_differ(self, tmp_path, make_cloud):
        clouds = [*walk(make_cloud, 5, 2), *walk(make_cloud, 4, 1)]
        with pytest.raises(InvalidArrayError, match=r"as many Gaussians as the first one \(5\), got 4 in frame 2"):
            written(GaussianSequence.from_clouds(clouds), tmp_path / "take" / "a.b4d")
        assert list(tmp_path.iterdir()) == []

    def test_frames_whose_arrays_differ(self, tmp_path, make_cloud):
        clouds = list(walk(make_cloud, 5, 2))
        clouds[1] = clouds[1].with_arrays(roughness=None)
        with pytest.raises(InvalidArrayError, match="got roughness in only one of frames 0 and 1"):
            written(GaussianSequence.from_clouds(clouds), tmp_path / "a.b4d")

    def test_an_altered_segment_is_named_and_others_are_read(self, tmp_path, make_cloud):
        path = written(walk(make_cloud, 20, 30), tmp_path / "a.b4d")
        container = Container(path)
        second = container.manifest["segments"][1]
        content = bytearray(path.read_bytes())
        content[content.index(b"PK\3\4", 4) + second["offset"] + 40] ^= 1
        path.write_bytes(content)
        back = converters.read(path)
        with pytest.raises(AssetFormatError, match=rf"a.b4d: {second['file']} must have the digest"):
            back[15]
        assert len(back[29]) == len(back[0]) == 20

    def test_a_lost_segment_is_named(self, tmp_path, make_cloud):
        written(walk(make_cloud, 20, 30), tmp_path / "manifest.json")
        (tmp_path / "000012.bin").unlink()
        with pytest.raises(AssetFormatError, match=r"must hold all its files, got 'no 000012\.bin'"):
            converters.read(tmp_path)[15]


def test_the_positions_of_a_ball_that_shrinks(tmp_path):
    """Scales change over time as positions do."""
    places = np.random.default_rng(0).normal(size=(50, 3))
    clouds = [relightable(s * places, scales=np.full((50, 3), 0.1 * s)) for s in np.linspace(1.0, 0.5, 20)]
    sequence = GaussianSequence.from_clouds(clouds)
    for cloud, back in pairs(sequence, written(sequence, tmp_path / "a.b4d")):
        assert np.abs(np.log(cloud.scales / back.scales)).max() <= 0.02 + 1e-5
        assert np.abs(cloud.positions - back.positions).max() <= 0.01 + 1e-6
