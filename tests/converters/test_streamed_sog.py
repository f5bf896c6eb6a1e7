"""Streamed SOG: what comes back, what the index promises to viewers, and what coarser levels keep."""

import json
import math
import zipfile

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from beam_warp import converters
from beam_warp.converters import WriteOptions
from beam_warp.converters.common import levels
from beam_warp.converters.sog import streamed_writer
from beam_warp.converters.sog.streamed_writer import coarser_levels, level_count
from beam_warp.errors import BeamError, InvalidOptionError
from beam_warp.world.gaussians import GaussianSequence
from beam_warp.world.metadata import raster_metadata, stated_raster
from beam_warp.world.quaternions import matrix_of


def write(cloud, path, options=WriteOptions(), **metadata):  # noqa: B008
    return converters.write(GaussianSequence.from_clouds([cloud], metadata=metadata), path, options)


@pytest.fixture(scope="module")
def scene(tmp_path_factory, make_cloud):
    """A scene of three levels, eight regions and several files, its folder, and its index."""
    cloud = make_cloud(230, 1, opacities=(np.random.default_rng(1).permutation(230) + 20) / 255, axes="rdf")
    folder = tmp_path_factory.mktemp("scene") / "out"
    with pytest.MonkeyPatch.context() as patch:
        for name, number in (("REGION", 30), ("FILE", 70), ("COARSEST", 14)):
            patch.setattr(streamed_writer, name, number)
        write(cloud, folder / "lod-meta.json", **raster_metadata(True, 0.3))
    return cloud, folder, json.loads((folder / "lod-meta.json").read_text())


def nodes(node):
    yield node
    for child in node.get("children", ()):
        yield from nodes(child)


def leaves(index):
    return [node for node in nodes(index["tree"]) if "lods" in node]


def test_level_0_is_the_cloud(scene):
    cloud, folder, _ = scene
    sequence = converters.read(folder)
    found, order = sequence[0], np.argsort(cloud.opacities)
    row = order[np.searchsorted(cloud.opacities[order], sequence[0].opacities - 0.5 / 255)]
    assert np.array_equal(np.sort(row), np.arange(len(cloud)))
    logs = [np.copysign(np.log1p(np.abs(p.astype(float))), p) for p in (found.positions, cloud.positions[row])]
    assert np.abs(logs[0] - logs[1]).max() <= np.ptp(logs[1], axis=0).max() / 65535
    assert found.axes == "rdf"
    assert stated_raster(sequence.metadata) == (True, pytest.approx(0.3))
    assert sequence.metadata["notes"] == "level 0, the finest of 3, is read"


def test_the_index_says_what_lies_where(scene):
    cloud, folder, index = scene
    assert index["version"] == 1
    assert index["lodLevels"] == len(index["counts"]) == 3
    assert index["count"] == sum(index["counts"])
    assert index["counts"][0] == len(cloud)
    assert len(index["filenames"]) > 3
    for node in nodes(index["tree"]):
        assert ("children" in node) != ("lods" in node)
        assert len(node.get("children", (1, 2))) == 2
    for number, name in enumerate(index["filenames"]):
        count = json.loads((folder / name).read_text())["count"]
        runs = [
            (int(level), lod) for leaf in leaves(index) for level, lod in leaf["lods"].items() if lod["file"] == number
        ]
        assert len({level for level, _ in runs}) == 1
        ends = np.cumsum([0, *(lod["count"] for _, lod in sorted(runs, key=lambda run: run[1]["offset"]))])
        assert sorted(lod["offset"] for _, lod in runs) == ends[:-1].tolist()
        assert ends[-1] == count


def test_runs_are_in_morton_order(scene):
    _, folder, index = scene
    for leaf in leaves(index):
        for lod in leaf["lods"].values():
            place = (folder / index["filenames"][lod["file"]]).parent
            low, high = (
                np.asarray(Image.open(place / f"means_{name}.webp")).reshape(-1, 3).astype(int) for name in "lu"
            )
            codes = (low + 256 * high)[lod["offset"] : lod["offset"] + lod["count"]]
            keys = [sum((int(c[a]) >> b & 1) << (3 * b + a) for b in range(16) for a in range(3)) for c in codes]
            assert keys == sorted(keys)


def test_bounds_hold_three_standard_deviations_at_every_level(scene):
    _, folder, index = scene
    clouds = [converters.read(folder / name)[0] for name in index["filenames"]]
    for leaf in leaves(index):
        low, high = (np.array(leaf["bound"][key]) for key in ("min", "max"))
        slack = 0.02 * (high - low)  # scales and rotations are rounded in the files
        for lod in leaf["lods"].values():
            part = clouds[lod["file"]].select(np.arange(lod["offset"], lod["offset"] + lod["count"]))
            for position, rotation, scales in zip(part.positions, part.orientations, part.scales, strict=True):
                reach = 3 * np.sqrt(((matrix_of(rotation) * scales) ** 2).sum(axis=1))
                assert (position - reach >= low - slack).all()
                assert (position + reach <= high + slack).all()
    for node in nodes(index["tree"]):
        for child in node.get("children", ()):
            assert (np.array(node["bound"]["min"]) <= child["bound"]["min"]).all()
            assert (np.array(node["bound"]["max"]) >= child["bound"]["max"]).all()


def test_equal_gaussians_double_for_every_level(make_cloud):
    scales = np.full((64, 3), 0.5, np.float32)
    cloud = make_cloud(64, 0, scales=scales, opacities=np.full(64, 0.25, np.float32))
    _, counts, factors = coarser_levels(cloud, 4)
    assert counts == [64, 16, 4, 1]
    assert factors == pytest.approx([1, 2, 4, 8])


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 90), st.integers(1, 4), st.integers(0, 2**32 - 1))
def test_coarser_levels_cover_as_much(make_cloud, count, levels, seed):
    cloud = make_cloud(count, 0, seed=seed)
    order, counts, factors = coarser_levels(cloud, levels)
    assert sorted(order) == list(range(count))
    a, b, c = cloud.scales.astype(float).T
    weights = cloud.opacities * (a * b + b * c + c * a) / 3
    for number, factor in zip(counts, factors, strict=True):
        assert factor**2 * weights[order[:number]].sum() == pytest.approx(weights.sum(), rel=1e-6)
        assert weights[order[:number]].min(initial=math.inf) >= weights[order[number:]].max(initial=0.0) * (1 - 1e-6)


@pytest.mark.parametrize(("count", "levels"), [(0, 1), (2**14 - 1, 1), (2**14, 2), (2**16, 3), (10**9, 4)])
def test_levels_end_where_little_is_left(count, levels):
    assert level_count(count) == levels


def test_nothing_may_be_streamed(make_cloud, tmp_path):
    write(make_cloud(1, 0).select(np.arange(0)), tmp_path / "lod-meta.json")
    assert len(converters.read(tmp_path)[0]) == 0


def test_a_folder_holds_what_a_bundle_does(make_cloud, tmp_path):
    cloud = make_cloud(20, 1)
    paths = write(cloud, tmp_path / "folder" / "meta.json")
    write(cloud, tmp_path / "a.sog")
    with zipfile.ZipFile(tmp_path / "a.sog") as bundle:
        assert {path.name: path.read_bytes() for path in paths} == {n: bundle.read(n) for n in bundle.namelist()}


@pytest.mark.parametrize("name", ["meta.json", "lod-meta.json"])
def test_an_index_describes_one_frame(name, make_cloud, tmp_path):
    sequence = GaussianSequence.from_clouds([make_cloud(3, 0)] * 2)
    with pytest.raises(InvalidOptionError, match=rf"a file for each of 2 frames, got {name}"):
        converters.write(sequence, tmp_path / "out" / name)
    assert list(tmp_path.iterdir()) == []


def test_what_fails_leaves_nothing_behind(make_cloud, tmp_path):
    (tmp_path / "out" / "0_0" / "sh0.webp").mkdir(parents=True)  # in the way
    with pytest.raises(BeamError):
        write(make_cloud(3, 0), tmp_path / "out" / "lod-meta.json")
    assert [path.name for path in tmp_path.rglob("*")] == ["out", "0_0", "sh0.webp"]


def spoiled(scene, tmp_path, change):
    """The scene with a changed index; its files are linked."""
    _, folder, index = scene
    index = json.loads(json.dumps(index))
    change(index)
    for name in {name.split("/")[0] for name in index["filenames"] if (folder / name).is_file()}:
        (tmp_path / name).mkdir()
        for file in (folder / name).iterdir():
            (tmp_path / name / file.name).write_bytes(file.read_bytes())
    (tmp_path / "lod-meta.json").write_text(json.dumps(index))
    return tmp_path / "lod-meta.json"


def leaf(index):
    return leaves(index)[0]["lods"]["0"]


def test_small_files_may_not_hold_much(scene, monkeypatch):
    monkeypatch.setattr(levels, "FREE_COUNT", 100)
    monkeypatch.setattr(levels, "COUNT_PER_BYTE", 0)
    with pytest.raises(BeamError, match=r"files must hold at most 0 Gaussians a byte, got .* in meta\.json"):
        converters.read(scene[1])


def test_what_other_programs_may_say(scene, tmp_path):
    def change(index):
        for name in ("version", "asset", "count", "counts"):
            del index[name]
        index["environment"] = "env/meta.json"
        del leaves(index)[0]["lods"]["0"]

    path = spoiled(scene, tmp_path, change)
    sequence = converters.read(path)
    assert len(sequence[0]) == len(scene[0]) - leaf(scene[2])["count"]
    assert "environment, its background, is left out" in sequence.metadata["notes"]


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        (lambda index: index.update(version=2), "version must be 1"),
        (lambda index: index.update(version=True), "version must be 1"),
        (lambda index: index.update(lodLevels=0), "lodLevels must be a whole number"),
        (lambda index: index.update(filenames="a"), "filenames must be a list"),
        (lambda index: index.update(tree=[]), "tree must be an object"),
        (lambda index: index.update(tree={}), "a leaf must have level 0"),
        (lambda index: index.update(counts=[229, 1, 1]), "counts must say that level 0 has 230"),
        (lambda index: index["tree"].update(children=3), "children must be a list"),
        (lambda index: index["tree"].update(children=[3]), "a node must be an object"),
        (lambda index: leaf(index).update(file=99), "file must be a whole number"),
        (lambda index: leaf(index).update(offset=-1), "offset must be a whole number"),
        (lambda index: leaf(index).update(count=10**6), "runs in meta.json must lie beside each other"),
        (lambda index: leaf(index).update(count=leaf(index)["count"] + 1), "runs in meta.json must lie beside"),
        (lambda index: index["filenames"].__setitem__(0, "../meta.json"), "a file must be named by a path below"),
        (lambda index: index["filenames"].__setitem__(0, "none/meta.json"), "its file 'none/meta.json' must exist"),
    ],
)
def test_an_index_must_be_sound(change, complaint, scene, tmp_path):
    with pytest.raises(BeamError, match=complaint):
        converters.read(spoiled(scene, tmp_path, change))
