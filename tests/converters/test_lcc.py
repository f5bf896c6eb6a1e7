"""LCC and LCC2 in: one Gaussian at a time as the white papers word it, runs of files, and what is left out."""

import json
import math
import struct

import numpy as np
import pytest
import write_lcc

from beam_warp import converters
from beam_warp.converters import WriteOptions
from beam_warp.errors import BeamError
from beam_warp.world.gaussians import GaussianSequence

EPSILON = float(np.finfo(np.float32).eps)
BOUNDS = {"scale": ([0.01, 0.02, 0.03], [0.5, 0.25, 2.0]), "shcoef": ([-1.0, -2.0, -0.5], [1.5, 2.5, 0.75])}
RECORD, LEVEL = struct.Struct("<3f4B3HI3H"), struct.Struct("<IQI")


def random_records(count, seed=0):
    """Fields of Gaussians as in data.bin, with the 16 words of each in shcoef.bin."""
    rng = np.random.default_rng(seed)

    def whole(bits, number):
        return [int(code) for code in rng.integers(0, 2**bits, number)]

    return [
        ([*map(float, rng.normal(size=3)), *whole(8, 4), *whole(16, 3), *whole(32, 1), *whole(16, 3)], whole(32, 16))
        for _ in range(count)
    ]


def write_scene(folder, regions, **changes):
    """Write regions, each a list of levels, each a list of records."""
    index, data, bands = b"", b"", b""
    for number, levels in enumerate(regions):
        index += struct.pack("<I", number)
        for records in levels:
            index += LEVEL.pack(len(records), len(data), RECORD.size * len(records))
            data += b"".join(RECORD.pack(*fields) for fields, _ in records)
            bands += b"".join(struct.pack("<16I", *words) for _, words in records)
    files = {"Index.bin": index, "data.bin": data, "SHCOEF.BIN": bands}
    for name, content in files.items():
        (folder / name).write_bytes(content)
    attributes = [{"name": name, "min": low, "max": high} for name, (low, high) in BOUNDS.items()]
    meta = {"totalLevel": len(regions[0]), "fileType": "Quality", "attributes": attributes, **changes}
    path = folder / "scene.lcc"
    path.write_text(json.dumps({key: value for key, value in meta.items() if value is not None}))
    return path


def between(name, axis, code, greatest):
    low, high = BOUNDS[name]
    return low[axis] + (high[axis] - low[axis]) * code / greatest


def rotation_by_hand(code):
    """The pseudo code of the white paper."""
    q = [(code >> shift & 1023) / 1023 * math.sqrt(2) - math.sqrt(0.5) for shift in (0, 10, 20)]
    q.append(math.sqrt(1 - min(1.0, sum(part**2 for part in q))))
    table = [3, 0, 1, 2, 0, 3, 1, 2, 0, 1, 3, 2, 0, 1, 2, 3]
    return np.array([q[table[4 * (code >> 30) + axis]] for axis in range(4)])


def test_every_gaussian_is_what_the_white_paper_says(tmp_path):
    records = random_records(60)
    scene = [[records[:25], records[25:30]], [[], records[30:32]], [records[32:], []]]
    sequence = converters.read(write_scene(tmp_path, scene))
    cloud, finest = sequence[0], records[:25] + records[32:]
    assert (cloud.axes, len(cloud), sequence.metadata["source_axes"]) == ("rfu", len(finest), "rfu")
    for row, (fields, words) in enumerate(finest):
        assert np.array_equal(cloud.positions[row], np.float32(fields[:3]))
        color = [(code / 255 - 0.5) * 2 * math.sqrt(math.pi) for code in fields[3:6]]
        assert np.allclose(cloud.radiance[row, 0], color, rtol=0, atol=4 * EPSILON)
        assert cloud.opacities[row] == pytest.approx(fields[6] / 255, rel=EPSILON)
        scales = [between("scale", axis, fields[7 + axis], 65535) for axis in range(3)]
        assert np.allclose(cloud.scales[row], scales, rtol=EPSILON, atol=0)
        rotation = rotation_by_hand(fields[10])
        rotation /= np.linalg.norm(rotation)  # three large parts have no room for a fourth
        assert np.allclose(cloud.orientations[row], rotation, rtol=0, atol=2 * EPSILON)
        for index, word in enumerate(words[:15]):
            codes = ((word & 2047, 2047), (word >> 11 & 1023, 1023), (word >> 21, 2047))
            bands = [between("shcoef", axis, *code) for axis, code in enumerate(codes)]
            assert np.allclose(cloud.radiance[row, 1 + index], bands, rtol=0, atol=4 * EPSILON)


@pytest.mark.parametrize(
    ("changes", "degree"),
    [({}, 3), ({"fileType": None}, 3), ({"fileType": "Portable"}, 0), ({"fileType": None, "attributes": None}, 0)],
)
def test_bands_are_there_if_the_index_says_so(changes, degree, tmp_path):
    if "attributes" in changes:
        low, high = BOUNDS["scale"]
        changes = {**changes, "attributes": [{"name": "scale", "min": low, "max": high}]}
    assert converters.read(write_scene(tmp_path, [[random_records(4)]], **changes))[0].sh_degree == degree


def test_what_is_left_out_is_noted_and_a_folder_is_its_scene(tmp_path):
    write_scene(tmp_path, [[random_records(3), random_records(1)]], epsg=4547)
    (tmp_path / "environment.bin").write_bytes(b"")
    notes = converters.read(tmp_path).metadata["notes"].splitlines()
    assert [note.split()[0] for note in notes] == ["the", "environment.bin,", "its"]
    assert "originated from XGRIDS" in str(converters.inspect(tmp_path).format)


@pytest.mark.parametrize(
    ("changes", "complaint"),
    [
        ({"encoding": "RAW"}, "encoding must be COMPRESS"),
        ({"fileType": "Best"}, "fileType must be Portable or Quality"),
        ({"totalLevel": 0}, "totalLevel must be a whole number"),
        ({"totalLevel": 3}, "index.bin must have 52 bytes for every region"),
        ({"totalLevel": True}, "totalLevel must be a whole number"),
        ({"attributes": []}, "attribute scale must be an object"),
        ({"attributes": [{"name": "scale", "min": [0, 0, 0], "max": [1, 2, "3"]}]}, "scale.max must be 3 finite"),
    ],
)
def test_an_index_must_be_sound(changes, complaint, tmp_path):
    with pytest.raises(BeamError, match=complaint):
        converters.read(write_scene(tmp_path, [[random_records(2), []]], **changes))


@pytest.mark.parametrize(
    ("level", "complaint"),
    [
        ((3, 0, 96), "Gaussians must lie within the 64 bytes of data.bin, got '3 after 0 of region 0'"),
        ((1, 2**63, 32), "Gaussians must lie within"),
        ((2**32 - 1, 0, 32), "Gaussians must lie within"),
        ((1, 33, 32), "Gaussians must lie within"),
        ((2, 0, 32), "a Gaussian must have 32 bytes"),
    ],
)
def test_gaussians_must_lie_in_the_files(level, complaint, tmp_path):
    path = write_scene(tmp_path, [[random_records(2)]])
    (tmp_path / "Index.bin").write_bytes(struct.pack("<I", 0) + LEVEL.pack(*level))
    with pytest.raises(BeamError, match=complaint):
        converters.read(path)


def test_a_gaussian_is_in_one_region(tmp_path):
    path = write_scene(tmp_path, [[random_records(2)]])
    (tmp_path / "Index.bin").write_bytes(2 * (struct.pack("<I", 0) + LEVEL.pack(2, 0, 64)))
    with pytest.raises(BeamError, match="must hold Gaussians of the finest level once"):
        converters.read(path)


@pytest.mark.parametrize("name", ["SHCOEF.BIN", "data.bin", "Index.bin"])
def test_every_file_must_be_there(name, tmp_path):
    path = write_scene(tmp_path, [[random_records(2)]])
    (tmp_path / name).unlink()
    with pytest.raises(BeamError, match=rf"its file {name.lower()} must lie beside it"):
        converters.read(path)


def spoiled(path, change):
    meta = json.loads(path.read_text())
    change(meta)
    path.write_text(json.dumps(meta))
    return path


@pytest.fixture
def tree(tmp_path, make_cloud):
    """An LCC2 of PLY files, and the cloud in it."""
    cloud = make_cloud(40, 1, axes="rfu")

    def write(part, path):
        converters.write(GaussianSequence.from_clouds([part]), path, WriteOptions(axes="rfu"))

    path = tmp_path / "scene.lcc2"
    write_lcc.write_lcc2(cloud, path, ".ply", write)
    return path, cloud


def rows(cloud):
    """Positions in an order of their own."""
    return cloud.positions[np.lexsort(cloud.positions.T)]


def test_leaves_are_read(tree):
    path, cloud = tree
    sequence = converters.read(path.parent)
    assert sequence[0].axes == "rfu"
    assert np.array_equal(rows(sequence[0]), rows(cloud))
    assert sequence.metadata["notes"] == "the leaves are read, the finest of its levels"


@pytest.mark.parametrize(
    ("change", "left"),
    [
        (lambda region: region.pop("child"), lambda rows: rows[:: write_lcc.COARSER]),
        (lambda region: region["child"].pop("0"), lambda rows: rows[len(rows) // 2 :]),
    ],
    ids=["a region that ends in a coarser leaf", "part of a file"],
)
def test_what_the_tree_names_is_read(tree, change, left):
    path, cloud = tree
    first, *others = write_lcc.regions(cloud)
    wanted = cloud.select(np.concatenate([left(first), *others]))
    found = converters.read(spoiled(path, lambda meta: change(meta["root"]["child"]["0"])))[0]
    assert np.array_equal(rows(found), rows(wanted))


def test_older_names_and_commas_too_many_are_read(tree, tmp_path, make_cloud):
    cloud = make_cloud(5, 0)
    converters.write(GaussianSequence.from_clouds([cloud]), tmp_path / "old" / "data" / "a,]b.sog")
    path = tmp_path / "old" / "meta.lcc2"
    node = '{"child_num": 0, "data": {"3dgs": {"name": 0},},}'
    path.write_text('{"root": {"files": ["/data/a,]b"], "child": [' + node + ",], }, }")
    assert len(converters.read(path)[0]) == 5


def root(change):
    return lambda meta: change(meta["root"])


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        (lambda meta: meta.pop("root"), "root must be an object"),
        (lambda meta: meta.update(splatType=".zip"), "splatType must be one of .sog, .spz, .ply"),
        (lambda meta: meta.update(splatType=".sog"), r"splatFiles must end in \.sog"),
        (root(lambda node: node.update(splatFiles=3)), "splatFiles must be a list of file names"),
        (root(lambda node: node.update(child=[])), "a leaf must have Gaussians"),
        (root(lambda node: node.update(child=[3])), "a node must be an object"),
        (root(lambda node: node.update(child=3)), "child must be an object"),
        (root(lambda node: node["child"]["0"]["child"]["0"].update(data=3)), "data must be an object"),
        (root(lambda node: node["splatFiles"].__setitem__(0, "../a.ply")), "a file must be named by a path below"),
        (root(lambda node: node["splatFiles"].__setitem__(0, "/a.ply")), "a file must be named by a path below"),
        (root(lambda node: node["splatFiles"].__setitem__(0, "a.ply")), "its file 'a.ply' must exist"),
        (root(lambda node: node["child"]["0"]["child"]["0"]["data"]["3dgs"].update(name=99)), "3dgs.name must be"),
        (root(lambda node: node["child"]["0"]["child"]["0"]["data"]["3dgs"].update(count=99)), "runs in 0_0.ply must"),
        (root(lambda node: node["child"]["0"]["child"]["1"]["data"]["3dgs"].update(start=0)), "runs in 0_0.ply must"),
    ],
)
def test_a_tree_must_be_sound(change, complaint, tree):
    with pytest.raises(BeamError, match=complaint):
        converters.read(spoiled(tree[0], change))


@pytest.mark.parametrize("content", [b"", b"[]", b"{", b"\xff{}", b"[" * 10**5, b'"' + b'\\"' * 10**5])
def test_an_index_is_a_json_object(content, tmp_path):
    for name in ("a.lcc", "a.lcc2", "lod-meta.json"):
        (tmp_path / name).write_bytes(content)
        with pytest.raises(BeamError, match=r"an index must (be JSON|hold an object|have at most)"):
            converters.read(tmp_path / name)
