"""glTF splats: documents written here from the specification, a file of another program, and our own."""

import base64
import copy
import json
import os
import struct
import time
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from reference.covariances import covariances
from reference.harmonics import sh_color
from scipy.spatial.transform import Rotation

from beam_warp import converters
from beam_warp.converters import WriteOptions
from beam_warp.converters.gltf import reader as gltf
from beam_warp.errors import AssetFormatError, InvalidOptionError, MissingFileError
from beam_warp.image.color import DISPLAY_SRGB, LINEAR_REC709, srgb_to_linear
from beam_warp.world.axes import change_axes
from beam_warp.world.gaussians import GaussianSequence
from beam_warp.world.metadata import raster_metadata, stated_raster

FOREIGN = Path(__file__).parent / "foreign"
EPSILON = float(np.finfo(np.float32).eps)
SPLAT = "KHR_gaussian_splatting"
CODES = {"f4": 5126, "i1": 5120, "u1": 5121, "i2": 5122, "u2": 5123}
TYPES = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}


def document_of(arrays, *, nodes=None, extension=None):
    """A document of one mesh: attribute → ``(N, width)`` array, integers normalised."""
    content, views, accessors = b"", [], []
    for array in arrays.values():
        views.append({"buffer": 0, "byteOffset": len(content), "byteLength": array.nbytes})
        accessor = {"bufferView": len(accessors), "componentType": CODES[array.dtype.str[1:]]}
        accessor |= {"count": len(array), "type": TYPES[array.shape[1]]}
        accessors.append(accessor | ({"normalized": True} if array.dtype.kind in "iu" else {}))
        content += array.tobytes() + b"\0" * (-array.nbytes % 4)
    uri = "data:application/octet-stream;base64," + base64.b64encode(content).decode()
    primitive = {
        "attributes": {name: number for number, name in enumerate(arrays)},
        "mode": 0,
        "extensions": {SPLAT: {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"} | (extension or {})},
    }
    return {
        "asset": {"version": "2.0"},
        "scenes": [{"nodes": [0]}],
        "nodes": nodes or [{"mesh": 0}],
        "meshes": [{"primitives": [primitive]}],
        "buffers": [{"byteLength": len(content), "uri": uri}],
        "bufferViews": views,
        "accessors": accessors,
    }


def primitive_of(document):
    return document["meshes"][0]["primitives"][0]


def arrays_of(cloud):
    """The attributes of a cloud in single precision."""
    count, bands = len(cloud), cloud.radiance.shape[1]
    names = [f"{SPLAT}:SH_DEGREE_{degree}_COEF_{m}" for degree in range(4) for m in range(2 * degree + 1)][:bands]
    return {
        "POSITION": cloud.positions,
        f"{SPLAT}:ROTATION": cloud.orientations,
        f"{SPLAT}:SCALE": cloud.scales,
        f"{SPLAT}:OPACITY": cloud.opacities.reshape(count, 1),
    } | {name: np.ascontiguousarray(cloud.radiance[:, number]) for number, name in enumerate(names)}


def glb_bytes(document, chunk=None, *, version=2, length=None):
    """A GLB; the first buffer's data URI becomes the chunk unless one is given."""
    document = copy.deepcopy(document)
    if chunk is None:
        chunk = base64.b64decode(document["buffers"][0].pop("uri").partition(",")[2])
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    total = 28 + len(text) + len(chunk)
    parts = struct.pack("<4sII", b"glTF", version, total if length is None else length)
    return parts + struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(chunk), b"BIN\0") + chunk


def file_of(folder, document, name="a.gltf"):
    (folder / name).write_text(json.dumps(document))
    return folder / name


def read(folder, document, **options):
    return converters.read(file_of(folder, document), **options)


def notes_of(sequence):
    return sequence.metadata.get("notes", "").splitlines()


def test_every_attribute_means_what_the_extension_says(make_cloud, tmp_path):
    cloud = make_cloud(count=7, degree=3, axes="rub")
    document = document_of(arrays_of(cloud))
    (tmp_path / "a.glb").write_bytes(glb_bytes(document))
    for sequence in (read(tmp_path, document), converters.read(tmp_path / "a.glb")):
        for name, array in cloud.arrays().items():
            assert np.array_equal(getattr(sequence[0], name), array), name
        assert (sequence[0].axes, sequence[0].radiance_color_space) == ("rub", DISPLAY_SRGB)
        assert notes_of(sequence) == []


def test_integers_are_fractions_where_they_are_normalised(tmp_path):
    arrays = {
        "POSITION": np.array([[-32768, 32767, 0], [1, 2, 3]], "<i2"),
        f"{SPLAT}:ROTATION": np.array([[0, 0, 90, 90], [127, 0, 0, 0]], "i1"),
        f"{SPLAT}:SCALE": np.array([[65535, 0, 13107], [1, 2, 3]], "<u2"),
        f"{SPLAT}:OPACITY": np.array([[255], [51]], "u1"),
        f"{SPLAT}:SH_DEGREE_0_COEF_0": np.array([[1, 2, 3], [4, 5, 6]], "<f4"),
    }
    document = document_of(arrays)
    document["accessors"][0].pop("normalized")
    cloud = read(tmp_path, document)[0]
    assert np.array_equal(cloud.positions, [[-32768, 32767, 0], [1, 2, 3]])
    assert np.allclose(cloud.orientations, [[0, 0, 0.5**0.5, 0.5**0.5], [1, 0, 0, 0]], atol=EPSILON)
    assert np.allclose(cloud.scales[0], [1.0, 0.0, 0.2], atol=EPSILON)
    assert np.allclose(cloud.opacities, [1.0, 0.2], atol=EPSILON)
    document["accessors"][0]["normalized"] = True
    assert np.array_equal(read(tmp_path, document)[0].positions[0], [-1.0, 1.0, 0.0])


def test_interleaved_attributes(make_cloud, tmp_path):
    cloud = make_cloud(count=5, degree=0)
    rows = np.column_stack(list(arrays_of(cloud).values())).astype("<f4")
    document = document_of(arrays_of(cloud))
    document["buffers"][0] = {"byteLength": rows.nbytes, "uri": "rows%20of%20a.bin"}
    (tmp_path / "rows of a.bin").write_bytes(rows.tobytes())
    document["bufferViews"] = [{"buffer": 0, "byteLength": rows.nbytes, "byteStride": 4 * rows.shape[1]}]
    for accessor, place in zip(document["accessors"], (0, 3, 7, 10, 11), strict=True):
        accessor |= {"bufferView": 0, "byteOffset": 4 * place}
    back = read(tmp_path, document)[0]
    assert all(np.array_equal(getattr(back, name), array) for name, array in cloud.arrays().items())


TURN, MOVE = Rotation.from_rotvec([0.3, -1.1, 0.7]), np.array([1.0, -2.0, 0.5])


@given(
    st.tuples(*[st.floats(-3.0, 3.0)] * 3),
    st.tuples(*[st.floats(-10.0, 10.0)] * 3),
    st.floats(0.01, 100.0),
    st.booleans(),
)
@settings(max_examples=15, deadline=None)
def test_nodes_move_gaussians_as_the_extension_says(tmp_path_factory, rotation, move, scale, as_matrix):
    from support.radiant_cloud import radiant_cloud

    cloud = radiant_cloud(6, 3, axes="rub")
    turn = Rotation.from_rotvec(rotation)
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = scale * turn.as_matrix(), move
    own = {"matrix": matrix.T.ravel().tolist()}  # glTF lists columns
    if not as_matrix:
        own = {"rotation": turn.as_quat().tolist(), "scale": [scale] * 3, "translation": list(move)}
    outer = np.eye(4)
    outer[:3, :3], outer[:3, 3] = 2.0 * TURN.as_matrix(), MOVE
    nodes = [{"matrix": outer.T.ravel().tolist(), "children": [1]}, {"mesh": 0} | own]
    back = read(tmp_path_factory.mktemp("gltf"), document_of(arrays_of(cloud), nodes=nodes))[0]

    whole = outer @ matrix
    linear = whole[:3, :3]
    expected = cloud.positions @ linear.T + whole[:3, 3]
    assert np.allclose(back.positions, expected, rtol=0.0, atol=4 * EPSILON * np.abs(expected).max())
    moved = linear @ covariances(cloud.orientations, cloud.scales) @ linear.T
    size = np.abs(moved).max(axis=(1, 2))[:, None, None]
    assert np.abs((covariances(back.orientations, back.scales) - moved) / size).max() <= 64 * EPSILON
    direction = np.array([0.6, -0.48, 0.64])
    before = sh_color(cloud.radiance, direction @ (TURN * turn).as_matrix())  # the same direction in the mesh
    assert np.allclose(sh_color(back.radiance, direction), before, atol=64 * EPSILON * 16)


def test_scenes_join_primitives_in_the_order_of_their_nodes(make_cloud, tmp_path):
    first, second = make_cloud(count=3, degree=1, seed=1), make_cloud(count=2, degree=0, seed=2)
    document = document_of(arrays_of(first))
    other = document_of(arrays_of(second))
    for view in other["bufferViews"]:
        view["buffer"] = 1
    for accessor in other["accessors"]:
        accessor["bufferView"] += len(document["bufferViews"])
    attributes = primitive_of(other)["attributes"]
    shifted = {name: number + len(document["accessors"]) for name, number in attributes.items()}
    other["meshes"][0]["primitives"][0]["attributes"] = shifted
    plain = {"attributes": {"POSITION": 0}, "mode": 0}
    document["meshes"] += [{"primitives": [plain, primitive_of(other)]}]
    for key in ("buffers", "bufferViews", "accessors"):
        document[key] += other[key]
    document["nodes"] = [{"children": [2, 1]}, {"mesh": 0}, {"mesh": 1}, {"mesh": 0}]
    back = read(tmp_path, document)[0]
    assert np.array_equal(back.positions, np.concatenate([second.positions, first.positions]))
    assert np.array_equal(back.radiance[:2, 0], second.radiance[:, 0])
    assert not back.radiance[:2, 1:].any()
    assert np.array_equal(back.radiance[2:], first.radiance)
    del document["scenes"]  # then every node is shown, and mesh 0 twice
    assert len(read(tmp_path, document)[0]) == 8
    document["scenes"] = [{}, {"nodes": [3]}]
    document["scene"] = 1
    assert len(read(tmp_path, document)[0]) == 3
    primitive_of(other)["extensions"][SPLAT]["colorSpace"] = "lin_rec709_display"
    document["scene"], document["scenes"] = 0, [{"nodes": [0]}]
    refused(tmp_path, document, "colorSpace must be one of srgb_rec709_display, lin_rec709_display, the same everywh")


def test_colour_that_is_linear(make_cloud, tmp_path):
    sequence = read(tmp_path, document_of(arrays_of(make_cloud()), extension={"colorSpace": "lin_rec709_display"}))
    assert sequence[0].radiance_color_space == LINEAR_REC709
    assert notes_of(sequence) == ["linear display-referred colour is taken as scene-linear"]


def test_a_file_of_splat_transform():
    cloud = converters.read(FOREIGN / "cloud.ply")[0]
    (note,) = notes_of(converters.read(FOREIGN / "splat_transform.glb"))
    assert note == "splat-transform turns its input by 180° about z: pass --source-axes luf to undo it"
    sequence = converters.read(FOREIGN / "splat_transform.glb", source_axes="luf")
    back = change_axes(sequence[0], "rdf")
    assert sequence.metadata["producer"] == "splat-transform 3.7.0 (asset.generator)"
    assert np.allclose(back.positions, cloud.positions, atol=8 * EPSILON)
    assert np.allclose(back.scales, cloud.scales, rtol=8 * EPSILON)
    assert np.allclose(back.opacities, cloud.opacities, atol=8 * EPSILON)
    difference = covariances(back.orientations, back.scales) - covariances(cloud.orientations, cloud.scales)
    assert np.abs(difference).max(axis=(1, 2)) == pytest.approx(0.0, abs=32 * EPSILON * float(cloud.scales.max()) ** 2)
    for direction in (*np.eye(3), np.array([0.6, -0.48, 0.64])):
        assert np.allclose(sh_color(back.radiance, direction), sh_color(cloud.radiance, direction), atol=64 * EPSILON)


@pytest.mark.parametrize("name", [f"{SPLAT}_compression_spz_2", f"{SPLAT}_compression_spz", "older"])
def test_splats_in_spz(make_cloud, tmp_path, name):
    content = (FOREIGN / "library_v3.spz").read_bytes()
    packed = converters.read(FOREIGN / "library_v3.spz")[0]
    document = document_of({"POSITION": packed.positions})
    document["accessors"] = [{"componentType": 5126, "count": 32, "type": "VEC3"}]
    document["bufferViews"] = [{"buffer": 0, "byteOffset": 4, "byteLength": len(content)}]
    document["buffers"] = [{"byteLength": len(content) + 4}]
    form = {"bufferView": 0}
    if name == "older":
        primitive_of(document)["extensions"] = {"KHR_spz_gaussian_splats_compression": form}
    else:
        primitive_of(document)["extensions"][SPLAT]["extensions"] = {name: form}
        document["extensionsRequired"] = [SPLAT, name]
    (tmp_path / "a.glb").write_bytes(glb_bytes(document, b"pad " + content))
    sequence = converters.read(tmp_path / "a.glb")
    for key, array in packed.arrays().items():
        assert np.array_equal(getattr(sequence[0], key), array), key
    assert any("--source-axes luf" in note for note in notes_of(sequence))
    document["accessors"][0]["count"] = 31
    (tmp_path / "a.glb").write_bytes(glb_bytes(document, b"pad " + content))
    with pytest.raises(AssetFormatError, match=r"a\.glb: all attributes must have 31 elements, got 32 for positions"):
        converters.read(tmp_path / "a.glb")


def write(cloud, path, *, metadata=None, **options):
    return converters.write(GaussianSequence.from_clouds([cloud], metadata=metadata), path, WriteOptions(**options))


@pytest.mark.parametrize("suffix", [".glb", ".gltf"])
@pytest.mark.parametrize(("degree", "profile"), [(0, "standard"), (3, "standard"), (2, "beam")])
def test_written_and_read_again(make_cloud, tmp_path, suffix, degree, profile):
    cloud = make_cloud(degree=degree, materials=True, axes="rub")
    paths = write(cloud, tmp_path / f"a{suffix}", profile=profile, metadata=raster_metadata(True, 0.1))
    assert [path.name for path in paths] == ([f"a{suffix}"] if suffix == ".glb" else ["a.gltf", "a.bin"])
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(path.name for path in paths)
    sequence = converters.read(paths[0])
    kept = {"positions", "orientations", "scales", "opacities", "radiance"}
    kept |= {"base_color", "roughness", "ambient_occlusion", "normals"} if profile == "beam" else set()
    assert set(sequence[0].arrays()) == kept
    assert all(np.array_equal(getattr(sequence[0], name), getattr(cloud, name)) for name in kept)  # bit for bit
    assert stated_raster(sequence.metadata) == (True, pytest.approx(0.1))
    assert sequence.metadata["radiance_meaning"] == "captured"
    assert notes_of(sequence) == []


def test_other_readers_see_coloured_points(make_cloud, tmp_path):
    cloud = make_cloud(degree=1, axes="rfu")
    write(cloud, tmp_path / "a.glb")
    (points,) = trimesh.load(tmp_path / "a.glb").geometry.values()
    assert np.array_equal(points.vertices, change_axes(cloud, "rub").positions)
    shown = srgb_to_linear(np.clip(0.5 + 0.28209479177387814 * cloud.radiance[:, 0].astype(float), 0.0, 1.0))
    colors = 255.0 * np.column_stack([shown, cloud.opacities])
    assert np.abs(points.colors - colors).max() <= 0.5 + 255 * EPSILON * 4


def test_colour_that_only_repeats_the_material(make_cloud, tmp_path):
    cloud = make_cloud(materials=True, radiance=None, radiance_color_space=None)
    write(cloud, tmp_path / "a.glb", profile="beam")
    assert converters.read(tmp_path / "a.glb")[0].radiance is None
    write(cloud, tmp_path / "a.glb")
    sequence = converters.read(tmp_path / "a.glb")
    assert sequence.metadata["radiance_meaning"] == "baseColorOnly"
    assert sequence[0].radiance.shape == (50, 1, 3)


def test_linear_radiance_is_kept_with_the_materials(make_cloud, tmp_path):
    cloud = make_cloud(degree=1, materials=True, axes="rub", radiance_color_space=LINEAR_REC709)
    write(cloud, tmp_path / "a.glb", profile="beam")
    back = converters.read(tmp_path / "a.glb")[0]
    assert back.radiance_color_space == LINEAR_REC709
    assert np.array_equal(back.radiance, cloud.radiance)
    write(cloud, tmp_path / "a.glb")
    assert converters.read(tmp_path / "a.glb")[0].radiance_color_space == DISPLAY_SRGB


def test_frames_are_numbered_and_appear_whole_or_not_at_all(make_cloud, tmp_path):
    clouds = [make_cloud(count=4, seed=seed, axes="rub") for seed in range(3)]
    paths = converters.write(GaussianSequence.from_clouds(clouds, frames_per_second=25.0), tmp_path / "a.gltf")
    assert sorted(path.name for path in paths) == sorted(path.name for path in tmp_path.iterdir())
    assert "a000002.bin" in {path.name for path in paths}
    back = converters.read(tmp_path)
    assert (len(back), back.frames_per_second) == (3, 25.0)
    assert all(np.array_equal(back[n].positions, clouds[n].positions) for n in range(3))
    (tmp_path / "b").mkdir()
    broken = [clouds[0], make_cloud(degree=4, axes="rub")]
    with pytest.raises(InvalidOptionError, match="must have a Gaussian, of at most degree 3, got 50 of degree 4"):
        converters.write(GaussianSequence.from_clouds(broken), tmp_path / "b" / "a.gltf")
    assert not list((tmp_path / "b").iterdir())


def test_what_is_not_written(make_cloud, tmp_path):
    with pytest.raises(InvalidOptionError, match=r"profile beam must have one of base_color, roughness, .*, got none"):
        write(make_cloud(axes="rub"), tmp_path / "a.glb", profile="beam")
    with pytest.raises(InvalidOptionError, match="must have a Gaussian, of at most degree 3, got 0 of degree 3"):
        write(make_cloud(count=0, axes="rub"), tmp_path / "a.glb")
    assert not list(tmp_path.iterdir())


def refused(folder, content, message="", error=AssetFormatError, name="a.gltf"):
    """Reading refuses a document or bytes, in one line after the file's name, soon and with little memory."""
    content = json.dumps(content).encode() if isinstance(content, dict) else content
    (folder / name).write_bytes(content)
    started = time.process_time()
    tracemalloc.start()
    with pytest.raises(error) as caught:
        converters.read(folder / name)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert time.process_time() - started < 2.0
    assert peak < 100 * 2**20 + 2 * len(content)
    said = str(caught.value)
    assert said.startswith(f"{name}: ")
    assert "\n" not in said
    assert message in said


def sound():
    """A document of three Gaussians of degree 1: accessors of position, rotation, scale, opacity and harmonics."""
    from support.radiant_cloud import radiant_cloud

    return document_of(arrays_of(radiant_cloud(3, 1)))


SH_1 = f"{SPLAT}:SH_DEGREE_1_COEF_1"

PATHS = [
    # Place in the document, value (None takes it away), and what is said.
    (("asset", "version"), "1.0", "glTF must state asset.version 2.x, got"),
    (("asset",), None, "glTF must state asset.version 2.x, got None"),
    (("extensionsRequired",), ["EXT_x", "KHR_materials_unlit"], "extensionsRequired must be known, got EXT_x"),
    (("extensionsRequired",), {}, "extensionsRequired must be an array, got {}"),
    (("scene",), 1, "an index must name one of 1 scenes, got 1"),
    (("scene",), -1, "scene must be an integer of at least 0, got -1"),
    (("scenes", 0, "nodes"), [True], "an index must name one of 1 nodes, got True"),
    (("scenes", 0, "nodes"), 0, "nodes must be an array, got 0"),
    (("scenes", 0, "nodes"), [0, 0], "a node must have one parent, got several for node 0"),
    (("nodes", 0, "children"), [0], "a node must have one parent, got several for node 0"),
    (("nodes", 0, "mesh"), 1, "an index must name one of 1 meshes, got 1"),
    (("nodes", 0, "mesh"), "0", "mesh must be an integer of at least 0, got '0'"),
    (("nodes", 0, "matrix"), [1.0] * 16, "must be placed by rotation, uniform scale and translation"),
    (("nodes", 0, "matrix"), [1.0] * 15, "matrix must be 16 finite numbers, got [1.0"),
    (("nodes", 0, "scale"), [1.0, 1.0, 1.1], "scales unevenly"),
    (("nodes", 0, "scale"), [0, 0, 0], "scales unevenly"),
    (("nodes", 0, "rotation"), [0, 0, 0, 0], "rotation must be a quaternion, got [0, 0, 0, 0]"),
    (("nodes", 0, "translation"), ["a", 0, 0], "translation must be 3 finite numbers, got ['a', 0, 0]"),
    (("meshes", 0, "primitives", 0), 7, "a primitive must be an object, got 7"),
    (("meshes", 0, "primitives", 0, "mode"), 4, "splats must be points, mode 0, got 4"),
    (("meshes", 0, "primitives", 0, "mode"), None, "splats must be points, mode 0, got 4"),
    (("meshes", 0, "primitives", 0, "extensions"), None, f"the scene must have points with {SPLAT}, got 1 meshes"),
    (("meshes", 0, "primitives", 0, "extensions", SPLAT), [], f"{SPLAT} must be an object, got []"),
    (("meshes", 0, "primitives", 0, "extensions", SPLAT, "colorSpace"), None, "the same everywhere, got None"),
    (("meshes", 0, "primitives", 0, "extensions", SPLAT, "colorSpace"), "acescg", "the same everywhere, got 'acescg'"),
    (("meshes", 0, "primitives", 0, "attributes", "POSITION"), None, "an index must name one of 8 accessors, got None"),
    (("meshes", 0, "primitives", 0, "attributes", f"{SPLAT}:SCALE"), None, f"splats must have {SPLAT}:SCALE, got POS"),
    (("meshes", 0, "primitives", 0, "attributes", SH_1), None, f"must be whole, got none of {SH_1} beside {SPLAT}:SH_"),
    (("meshes", 0, "primitives", 0, "attributes", SH_1), 3, "accessor 3 must have known components, 3 in an element"),
    (("meshes", 0, "primitives", 0, "extras"), {"beam": {"raster": 3}}, "extras.beam: "),
    (("meshes", 0, "primitives", 0, "extras"), {"beam": {"raster": [1, "x"]}}, "extras.beam: raster must be a number"),
    (
        ("meshes", 0, "primitives", 0, "extras"),
        {"beam": {"radiance_meaning": []}},
        "extras.beam: radiance_meaning must",
    ),
    (("meshes", 0, "primitives", 0, "extras"), {"beam": {"frames_per_second": 0}}, "extras.beam: frames_per_second mu"),
    (("accessors", 0, "sparse"), {"count": 1}, "accessor 0 must be plain, got a sparse one. Export it with plain"),
    (("accessors", 0, "bufferView"), None, "accessor 0 must be plain, got one without a buffer view"),
    (("accessors", 0, "componentType"), 5130, "accessor 0 must have known components, 3 in an element, got 5130"),
    (("accessors", 0, "type"), "MAT4", "accessor 0 must have known components, 3 in an element, got 5126 and 'MAT4'"),
    (("accessors", 0, "type"), [], "accessor 0 must have known components, 3 in an element, got 5126 and []"),
    (("accessors", 0, "count"), 4, "accessor 0 must lie within 36 bytes, got 4 every 12 bytes from 0"),
    (("accessors", 0, "count"), 2**32, "the scene must have at most 262144 Gaussians, got 4294967296"),
    (("accessors", 0, "count"), 2**60, "count must be an integer of at least 0, got 1152921504606846976"),
    (("accessors", 0, "count"), 3.0, "count must be an integer of at least 0, got 3.0"),
    (("accessors", 0, "count"), 2, "all attributes must have 2 elements, got 3 for orientations"),
    (("accessors", 0, "byteOffset"), 1, "accessor 0 must lie within 36 bytes, got 3 every 12 bytes from 1"),
    (("accessors", 5, "count"), 2, f"{SPLAT}:SH_DEGREE_1_COEF_0 must have 3 elements, got 2"),
    (("bufferViews", 0, "byteStride"), 4, "accessor 0 must lie within 36 bytes, got 3 every 4 bytes"),
    (("bufferViews", 0, "byteLength"), 2**40, "buffer view 0 must end within"),
    (("bufferViews", 0, "buffer"), 1, "an index must name one of 1 buffers, got 1"),
    (("bufferViews", 0, "extensions"), {"EXT_meshopt_compression": {}}, "must not be compressed, got EXT_meshopt_com"),
    (("buffers", 0, "byteLength"), 2**40, "buffers must have at most twice the"),
    (("buffers", 0, "uri"), None, "buffer 0 must be in the file or name a URI, got None"),
    (("buffers", 0, "uri"), "data:;base64,@@", "the data of buffer 0 must be base64, got data:;base64"),
    (("buffers", 0, "uri"), "data:,abc", "the data of buffer 0 must be base64, got data:"),
]


@pytest.mark.parametrize(("place", "value", "message"), PATHS)
def test_malformed_documents(tmp_path, place, value, message):
    document = sound()
    holder = document
    for key in place[:-1]:
        holder = holder[key]
    if value is None:
        del holder[place[-1]]
    else:
        holder[place[-1]] = value
    refused(tmp_path, document, message)


OUTSIDE = [
    *("../a.bin", "x/../../a.bin", "/etc/hostname", "%2Fetc%2Fhostname", "%2e%2e/a.bin", "http://example.org/a.bin"),
    *("file:///etc/hostname", "C:\\a.bin", "c:a.bin", "..\\a.bin", "//host/a.bin", "a\u0000.bin", "a\ud800.bin"),
]


@pytest.mark.parametrize("uri", OUTSIDE)
def test_files_outside_the_folder_are_not_opened(tmp_path, uri):
    (tmp_path / "a.bin").write_bytes(bytes(1000))
    (tmp_path / "in").mkdir()
    document = sound()
    document["buffers"][0]["uri"] = uri
    refused(tmp_path / "in", document, "a URI must be data or a path below the file's folder, got ")


def test_links_and_files_that_are_not_there(tmp_path):
    (tmp_path / "a.bin").write_bytes(bytes(1000))
    (tmp_path / "in").mkdir()
    document = sound()
    for name, target in (("link.bin", tmp_path / "a.bin"), ("loop.bin", "loop.bin")):
        (tmp_path / "in" / name).symlink_to(target)
    document["buffers"][0]["uri"] = "link.bin"
    refused(tmp_path / "in", document, "a URI must stay in the file's folder, got the link 'link.bin'")
    os.mkfifo(tmp_path / "in" / "pipe.bin")
    for uri in ("loop.bin", "gone.bin", "pipe.bin", ".", "n" * 400):
        document["buffers"][0]["uri"] = uri
        refused(tmp_path / "in", document, "file of buffer 0 must exist, got ", MissingFileError)
    (tmp_path / "in" / "short.bin").write_bytes(bytes(4))
    document["buffers"][0]["uri"] = "short.bin"
    refused(tmp_path / "in", document, "buffer 0 must have 276 bytes, got 4")


def test_documents_that_are_large_or_deep(tmp_path):
    refused(tmp_path, b"[" * 100_000, "glTF must be JSON, alone or in a GLB")
    refused(tmp_path, b'{"a":[' + b"[]," * 10**6 + b"[]]}", "the document must have at most 300000 values, got more")
    refused(tmp_path, b'{"a": NaN}', "got NaN, which JSON does not have")
    refused(tmp_path, b'{"a": ' + b"9" * 5000 + b"}", "glTF must be JSON, alone or in a GLB")
    refused(tmp_path, b"\xff\xfe", "glTF must be JSON, alone or in a GLB")
    refused(tmp_path, b"", "glTF must be JSON, alone or in a GLB")
    refused(tmp_path, b"[]", "glTF must state asset.version 2.x")
    chain = sound()
    chain["nodes"] = [{"children": [n + 1], "scale": [2, 2, 2]} for n in range(10_000)] + [{"mesh": 0}]
    refused(tmp_path, chain, "a scene must have at most 10000 nodes, got more. Export the splats alone.")
    chain["nodes"] = [{"children": [n + 1], "scale": [2, 2, 2]} for n in range(2_000)] + [{"mesh": 0}]
    refused(tmp_path, chain, "transforms must stay below 1e30, got more at node 2000")
    again = sound()
    again["nodes"] = [{"children": list(range(1, 1_002))}] + [{"mesh": 0}] * 1_001
    refused(tmp_path, again, "a scene must place at most 1000 primitives, got more. Join them.")


def test_a_mesh_shown_again_and_again(make_cloud, tmp_path):
    document = document_of(arrays_of(make_cloud(count=5000, degree=0)))
    document["nodes"] = [{"children": list(range(1, 901))}] + [{"mesh": 0}] * 900
    refused(tmp_path, document, "the scene must have at most 262144 Gaussians, got 4500000")


def test_a_rotation_of_nothing_that_a_node_turns(make_cloud, tmp_path):
    arrays = arrays_of(make_cloud(count=3, degree=0))
    arrays[f"{SPLAT}:ROTATION"] = np.zeros((3, 4), np.float32)
    document = document_of(arrays, nodes=[{"mesh": 0, "rotation": [1.0, 0.0, 0.0, 0.0]}])
    refused(tmp_path, document, "orientations must have unit length, got |v| = 0 at row 0")


@pytest.mark.parametrize("more", [[{"byteLength": 2**50}], [{"byteLength": 2**20, "uri": "a.bin"}] * 9])
def test_buffers_that_their_files_do_not_hold_raise_no_limit(make_cloud, tmp_path, more):
    (tmp_path / "a.bin").write_bytes(bytes(2**20))
    document = document_of(arrays_of(make_cloud(count=5000, degree=0)))
    document["nodes"] = [{"children": list(range(1, 901))}] + [{"mesh": 0}] * 900
    document["buffers"] += more
    refused(tmp_path, document, "buffers must have at most twice the ")


def test_glb_cut_anywhere(tmp_path):
    content = glb_bytes(sound())
    for size in [*range(0, 24), *range(24, len(content), 97), len(content) - 1]:
        refused(tmp_path, content[:size], name="a.glb")
    assert gltf.probe(file_of(tmp_path, sound())) == 3


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (glb_bytes(sound(), version=1), "a GLB must be of version 2 and as long as it says, got version 1"),
        (glb_bytes(sound(), length=2**32 - 1), "as long as it says, got version 2 and 4294967295 of"),
        (glb_bytes(sound(), length=12), "a GLB must begin with a chunk JSON, got ''"),
        (glb_bytes(sound()).replace(b"JSON", b"BIN\0", 1), "a GLB must begin with a chunk JSON, got 'BIN'"),
        (glb_bytes(sound()).replace(b"BIN\0", b"BIX\0", 1), "buffer 0 must be in the file or name a URI, got None"),
        (b"glTF" + struct.pack("<IIII", 2, 20, 2**32 - 1, 0), "a chunk must end within 20 bytes, got 4294967295"),
        (glb_bytes(sound()).replace(b"glTF", b"GLTF", 1), "glTF must be JSON, alone or in a GLB"),
    ],
)
def test_malformed_glb(tmp_path, content, message):
    refused(tmp_path, content, message, name="a.glb")


@pytest.mark.parametrize(
    ("name", "row", "message"),
    [
        ("POSITION", [np.nan, 0, 0], "positions must be finite, got NaN or infinity at row 1"),
        (f"{SPLAT}:ROTATION", [0, 0, 0, 0], "orientations must have unit length, got |v| = 0 at row 1"),
        (f"{SPLAT}:ROTATION", [1e20, 0, 0, 0], "orientations must have unit length, got |v| = 0 at row 1"),
        (f"{SPLAT}:SCALE", [0, -1, 0], "scales must lie in [0, inf], got -1 at row 1"),
        (f"{SPLAT}:OPACITY", [1.5], "opacities must lie in [0, 1], got 1.5 at row 1"),
        (f"{SPLAT}:SH_DEGREE_0_COEF_0", [np.inf, 0, 0], "radiance must be finite, got NaN or infinity at row 1"),
    ],
)
def test_bad_values(make_cloud, tmp_path, name, row, message):
    arrays = {key: array.copy() for key, array in arrays_of(make_cloud(count=3, degree=0)).items()}
    arrays[name][1] = row
    refused(tmp_path, document_of(arrays), message)
    if "OPACITY" not in name:
        assert len(read(tmp_path, document_of(arrays), drop_invalid=True)[0]) == 2


def test_damaged_files_are_read_or_refused(tmp_path, rng):
    content = glb_bytes(sound())
    refusals = []
    for _ in range(150):
        damaged = bytearray(content)
        for at in rng.integers(0, len(content), 4):
            damaged[at] = rng.choice(bytearray(b'0129,:[]{}"-e'))
        (tmp_path / "a.glb").write_bytes(bytes(damaged))
        try:
            converters.read(tmp_path / "a.glb")
        except AssetFormatError as error:
            refusals.append(str(error))
    assert all(said.startswith("a.glb: ") for said in refusals)
    assert len(refusals) > 100
