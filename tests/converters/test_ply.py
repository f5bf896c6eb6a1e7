"""Sound PLY files: what other tools write is read as they mean it, and what we write comes back."""

import numpy as np
import plyfile
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from reference.harmonics import sh_color

from beam_warp import converters
from beam_warp.blocks import BLOCK_ROWS
from beam_warp.converters import WriteOptions
from beam_warp.converters.common.activations import LOGIT_LIMIT
from beam_warp.errors import AssetFormatError, InvalidOptionError, OutputError, SchemaVersionError
from beam_warp.image.color import LINEAR_REC709
from beam_warp.world.gaussians import GaussianSequence
from beam_warp.world.harmonics import SH_C0
from beam_warp.world.metadata import raster_metadata, stated_raster

EPSILON = np.finfo(np.float32).eps

STANDARD_62 = [
    *("x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"),
    *(f"f_rest_{i}" for i in range(45)),
    *("opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"),
]


def notes_of(sequence):
    return sequence.metadata.get("notes", "").splitlines()


def write(cloud, path, **options):
    if "target" not in options:
        options = {"axes": cloud.axes} | options
    return converters.write(GaussianSequence.from_clouds([cloud]), path, WriteOptions(**options))


def through_plyfile(path):
    """The independent reading: one column at a time, activations from their definitions, in float64."""
    vertex = plyfile.PlyData.read(str(path))["vertex"].data
    stack = lambda *names: np.stack([vertex[name].astype(np.float64) for name in names], 1)  # noqa: E731
    quaternions = stack("rot_1", "rot_2", "rot_3", "rot_0")
    rest = [name for name in vertex.dtype.names if name.startswith("f_rest_")]
    per_channel = len(rest) // 3
    radiance = [stack("f_dc_0", "f_dc_1", "f_dc_2")]
    for k in range(per_channel):
        radiance.append(stack(f"f_rest_{k}", f"f_rest_{per_channel + k}", f"f_rest_{2 * per_channel + k}"))
    return {
        "positions": stack("x", "y", "z"),
        "orientations": quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True),
        "scales": np.exp(stack("scale_0", "scale_1", "scale_2")),
        "opacities": 1.0 / (1.0 + np.exp(-vertex["opacity"].astype(np.float64))),
        "radiance": np.stack(radiance, 1),
    }


def test_a_file_of_another_tool_is_read_as_plyfile_reads_it(data_dir):
    path = data_dir / "fixtures" / "jsplat" / "unitCube-ascii.ply"
    sequence = converters.read(path)
    cloud = sequence[0]
    assert len(sequence) == 1
    assert len(cloud) == 20
    assert cloud.axes == "rdf"
    for name, expected in through_plyfile(path).items():
        assert np.allclose(getattr(cloud, name), expected, rtol=2 * EPSILON, atol=0.0), name
    (note,) = notes_of(sequence)
    assert note == "axes are not stated: taken as rdf (3DGS training); pass --source-axes if they are others"


@pytest.mark.parametrize("degree", [0, 3, 4])
def test_standard_files_are_read_alike_by_plyfile(make_cloud, tmp_path, degree):
    cloud = make_cloud(degree=degree)
    write(cloud, tmp_path / "a.ply")
    back = converters.read(tmp_path / "a.ply")[0]
    for name, expected in through_plyfile(tmp_path / "a.ply").items():
        assert np.allclose(getattr(back, name), expected, rtol=2 * EPSILON, atol=EPSILON), name
    for name in ("positions", "orientations", "radiance"):  # stored as they are: bit for bit
        assert np.array_equal(getattr(back, name), getattr(cloud, name)), name
    assert (back.axes, back.radiance_color_space) == (cloud.axes, cloud.radiance_color_space)


def test_the_file_obeys_the_rules_of_importers(make_cloud, tmp_path):
    cloud = make_cloud(materials=True)
    write(cloud, tmp_path / "standard.ply")
    write(cloud, tmp_path / "beam.ply", profile="beam")
    extras = ["base_color_0", "base_color_1", "base_color_2", "roughness", "ambient_occlusion"]
    for name, properties in (("standard", STANDARD_62), ("beam", STANDARD_62 + extras)):
        content = (tmp_path / f"{name}.ply").read_bytes()
        header, _, body = content.partition(b"end_header\n")
        lines = header.decode("ascii").split("\n")[:-1]
        assert b"\r" not in header
        assert lines[:2] == ["ply", "format binary_little_endian 1.0"]
        rest = [line for line in lines[2:] if not line.startswith("comment ")]
        assert rest == ["element vertex 50", *(f"property float {p}" for p in properties)]
        assert len(body) == 50 * 4 * len(properties)
        assert np.isfinite(np.frombuffer(body, "<f4")).all()
        assert "comment beam_axes rfu" in lines
        assert "comment beam_schema 1.3" in lines
        assert "comment beam_frame 0 30" in lines
        assert ("comment beam_material linear" in lines) == (name == "beam")
        assert ("comment beam_base_color_space lin_rec709_scene" in lines) == (name == "beam")


def test_full_and_no_opacity_stay_finite_in_a_file(make_cloud, tmp_path):
    write(make_cloud(3, opacities=[0.0, 0.5, 1.0]), tmp_path / "a.ply")
    stored = plyfile.PlyData.read(str(tmp_path / "a.ply"))["vertex"]["opacity"]
    assert np.array_equal(stored, [-20.0, 0.0, 20.0])
    assert np.allclose(converters.read(tmp_path / "a.ply")[0].opacities, [2.0611536e-9, 0.5, 1.0], rtol=EPSILON, atol=0)


def test_the_beam_profile_keeps_every_channel(make_cloud, tmp_path):
    cloud = make_cloud(materials=True, radiance_color_space=LINEAR_REC709)
    write(cloud, tmp_path / "a.ply", profile="beam")
    sequence = converters.read(tmp_path / "a.ply")
    back = sequence[0]
    assert (sequence.topology, sequence.constant) == ("constant", back.arrays().keys())
    assert not notes_of(sequence)
    exact = ("positions", "orientations", "radiance", "normals", "base_color", "roughness", "ambient_occlusion")
    for name in exact:
        assert np.array_equal(getattr(back, name), getattr(cloud, name)), name
    assert back.is_relightable
    assert back.radiance_color_space == LINEAR_REC709
    assert sequence.metadata["producer"] == "beam-warp (beam_schema 1.3)"


finite = st.floats(-(2.0**100), 2.0**100, width=32)


@settings(max_examples=40, deadline=None)
@given(
    positions=arrays(np.float32, (4, 3), elements=finite),
    radiance=arrays(np.float32, (4, 4, 3), elements=finite),
    scales=arrays(np.float32, (4, 3), elements=st.floats(2.0**-40, 2.0**20, width=32)),
    opacities=arrays(np.float32, (4,), elements=st.floats(0.0, 1.0, width=32)),
    base_color=arrays(np.float32, (4, 3), elements=st.floats(0.0, 1.0, width=32)),
)
def test_round_trip(tmp_path_factory, make_cloud, positions, radiance, scales, opacities, base_color):
    path = tmp_path_factory.mktemp("trip") / "a.ply"
    given = {"positions": positions, "radiance": radiance, "scales": scales, "opacities": opacities}
    cloud = make_cloud(4, **given, base_color=base_color)
    write(cloud, path, profile="beam")
    back = converters.read(path, activation="log")[0]
    for name in ("positions", "radiance", "orientations", "base_color"):
        assert np.array_equal(getattr(back, name), getattr(cloud, name)), name
    # ln s is rounded to float32: |d ln s| <= |ln s| eps / 2, and s itself once more.
    log = np.abs(np.log(scales.astype(np.float64)))
    assert (np.abs(back.scales - scales.astype(np.float64)) <= scales * (log + 1.0) * EPSILON).all()
    # d sigmoid(x) = o (1 - o) dx with |dx| <= |x| eps / 2, |x| <= 20; sigmoid(±20) is within 2.1e-9 of 0 and 1.
    o = opacities.astype(np.float64)
    bound = o * (1.0 - o) * LOGIT_LIMIT * EPSILON + o * EPSILON + 2.1e-9
    assert (np.abs(back.opacities - o) <= bound).all()


@pytest.mark.parametrize(("order", "newline"), [("<", "\r\n"), (">", "\n")])
def test_byte_orders_and_line_ends(columns, ply_file, order, newline):
    cloud = converters.read(ply_file(columns, order=order, newline=newline, comments=["made by hand"]))[0]
    assert np.array_equal(cloud.positions, [[0, 0, 3], [1, -1, 2], [2, 0.5, 1]])
    assert np.array_equal(cloud.orientations, [[0, 0, 0, 1], [1, 0, 0, 0], [0, 0, 0, 1]])  # w last, normalised
    assert np.allclose(cloud.opacities, [0.119202922, 0.5, 0.952574127], rtol=EPSILON)
    assert np.allclose(cloud.scales[:, 2], 0.000911882, rtol=1e-6)


def test_any_property_order_and_unknown_properties(columns, ply_bytes, tmp_path):
    shuffled = dict(reversed(columns.items())) | {"confidence": [1, 2, 3], "label": [1, 2, 3], "weight": [1, 2, 3]}
    types = {"label": "uchar", "weight": "double", "x": "double"}
    (tmp_path / "a.ply").write_bytes(ply_bytes(columns))
    (tmp_path / "b.ply").write_bytes(ply_bytes(shuffled, types=types))
    plain, mixed = (converters.read(tmp_path / f"{name}.ply") for name in "ab")
    for name, array in plain[0].arrays().items():
        assert np.array_equal(getattr(mixed[0], name), array), name
    assert "properties left out: confidence, label, weight" in notes_of(mixed)


def test_elements_before_and_lists_after_are_stepped_over(columns, ply_bytes, tmp_path):
    content = ply_bytes(columns)
    header, _, body = content.partition(b"end_header\n")
    first = b"element camera 2\nproperty float f\nproperty uchar c\nelement vertex"
    last = b"element face 1\nproperty list uchar int vertex_indices\nend_header\n"
    header = header.replace(b"element vertex", first)
    (tmp_path / "a.ply").write_bytes(header + last + bytes(10) + body + b"\x03" + bytes(12))
    assert np.array_equal(converters.read(tmp_path / "a.ply")[0].positions[:, 0], [0, 1, 2])


def test_ascii_after_other_elements(columns, tmp_path):
    names = list(columns)
    rows = "\n".join(" ".join(str(columns[name][row]) for name in names) for row in range(3))
    text = "ply\nformat ascii 1.0\nelement camera 1\nproperty float f\nelement vertex 3\n"
    text += "".join(f"property float {name}\n" for name in names) + f"end_header\n0.5\n{rows}"
    (tmp_path / "a.ply").write_text(text)
    assert np.array_equal(converters.read(tmp_path / "a.ply")[0].positions[:, 0], [0, 1, 2])


def test_flat_gaussians_and_missing_colour(columns, ply_file, tmp_path):
    for name in ("scale_2", "f_dc_0", "f_dc_1", "f_dc_2"):
        del columns[name]
    sequence = converters.read(ply_file(columns))
    assert np.array_equal(sequence[0].scales[:, 2], [0, 0, 0])
    assert sequence[0].radiance is None
    flat, colorless = notes_of(sequence)[:2]
    assert flat == "no scale_2: read as 2D Gaussians of thickness 0"
    assert colorless == "no f_dc_0 … f_dc_2: read without colour"
    # Written again, a flat Gaussian has the least scale that a log can say, and comes back flat by the file's tag.
    converters.write(sequence, tmp_path / "b.ply")
    back = converters.read(tmp_path / "b.ply")[0]
    assert back.radiance is None
    assert plyfile.PlyData.read(str(tmp_path / "b.ply"))["vertex"]["scale_2"].tolist() == [-30.0] * 3
    assert not back.scales[:, 2].any()


def test_no_gaussians(columns, ply_file, tmp_path):
    sequence = converters.read(ply_file({name: [] for name in columns}))
    assert len(sequence[0]) == 0
    assert notes_of(sequence)[-1] == "holds no Gaussians"
    converters.write(sequence, tmp_path / "b.ply")
    assert len(converters.read(tmp_path / "b.ply")[0]) == 0
    assert converters.inspect(tmp_path / "b.ply").bounds is None


def test_axes_and_units_of_the_file_and_of_the_caller(make_cloud, columns, ply_file):
    path = ply_file(columns, comments=["beam_axes fru", "beam_meters_per_unit 0.01"])
    sequence = converters.read(path)
    raw = np.column_stack([columns[axis] for axis in "xyz"])
    assert (sequence[0].axes, sequence.metadata["source_units"]) == ("fru", "0.01 m")
    assert np.allclose(sequence[0].positions, 0.01 * raw, rtol=3 * EPSILON, atol=0)
    sequence = converters.read(path, source_axes="rdf", meters_per_unit=1.0)
    assert (sequence[0].axes, sequence.metadata["source_units"]) == ("rdf", "m")
    assert np.array_equal(sequence[0].positions, raw.astype(np.float32))
    assert notes_of(sequence) == [
        "axes are taken as rdf, by --source-axes; the file says fru",
        "one unit is taken as 1 m, by --meters-per-unit; the file says 0.01 m",
    ]


def test_bands_are_padded_and_cut(make_cloud, tmp_path):
    cloud = make_cloud(16, degree=2)  # as many as a third degree has coefficients
    write(cloud, tmp_path / "three.ply", sh_degree=3)
    write(cloud, tmp_path / "none.ply", sh_degree=0)
    three, none = (converters.read(tmp_path / f"{name}.ply")[0].radiance for name in ("three", "none"))
    assert three.shape == (16, 16, 3)
    assert np.array_equal(three[:, :9], cloud.radiance)
    assert not three[:, 9:].any()
    assert np.array_equal(none, cloud.radiance[:, :1])


@pytest.mark.parametrize("without", [{}, {"ambient_occlusion": None}])
def test_without_radiance_a_standard_file_shows_the_base_colour(make_cloud, tmp_path, without):
    cloud = make_cloud(materials=True, radiance=None, radiance_color_space=None, **without)
    write(cloud, tmp_path / "a.ply")
    sequence = converters.read(tmp_path / "a.ply")
    shown = sh_color(sequence[0].radiance, [0.0, 0.0, 1.0])
    light = (cloud.base_color * (1.0 if without else cloud.ambient_occlusion[:, None])).astype(np.float64)
    # IEC 61966-2-1; the standard's own two branches meet only to 1e-7, and colour is rounded twice.
    encoded = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
    assert np.abs(shown - encoded).max() <= 4 * EPSILON + 1e-7
    assert "colour is base colour times ambient occlusion, not captured radiance" in notes_of(sequence)
    assert sequence.metadata["radiance_meaning"] == "baseColorOnly"
    # The beam profile knows that this colour repeats the material.
    write(cloud, tmp_path / "b.ply", profile="beam")
    assert converters.read(tmp_path / "b.ply")[0].radiance is None


def test_linear_radiance_is_encoded_in_a_standard_file(make_cloud, tmp_path):
    rng = np.random.default_rng(2)
    radiance = np.concatenate([rng.uniform(-1.0, 3.0, (50, 1, 3)), 1e-3 * rng.normal(size=(50, 3, 3))], 1)
    cloud = make_cloud(radiance=radiance, radiance_color_space=LINEAR_REC709)
    write(cloud, tmp_path / "a.ply")
    back = converters.read(tmp_path / "a.ply")[0]
    direction = np.array([0.6, 0.0, 0.8])
    light = sh_color(cloud.radiance, direction)
    encoded = np.where(light <= 0.0031308, 12.92 * light, 1.055 * np.maximum(light, 0.0031308) ** (1 / 2.4) - 0.055)
    # First order: the error is at most half the second derivative (< 0.4 / light^1.6 above 0.2) times (3e-3)^2.
    bright = light > 0.2
    assert bright.any()
    assert np.abs(sh_color(back.radiance, direction) - encoded)[bright].max() <= 0.5 * 0.4 / 0.2**1.6 * 3e-3**2


def test_bands_of_linear_radiance_follow_the_slope_of_the_encoding(make_cloud, tmp_path):
    radiance = np.ones((5, 4, 3), np.float32)
    radiance[:, 0] = (np.float64([-0.1, 0.002, 0.0031, 0.0032, 0.2])[:, None] - 0.5) / SH_C0
    write(make_cloud(5, radiance=radiance, radiance_color_space=LINEAR_REC709), tmp_path / "a.ply")
    mean = 0.5 + SH_C0 * radiance[:, :1].astype(np.float64)
    slope = np.where(mean <= 0.0031308, 12.92, 1.055 / 2.4 * np.maximum(mean, 0.0031308) ** (1 / 2.4 - 1.0))
    bands = converters.read(tmp_path / "a.ply")[0].radiance[:, 1:]
    assert np.allclose(bands, np.broadcast_to(slope, bands.shape), rtol=2 * EPSILON, atol=0.0)


@pytest.mark.parametrize(("antialiased", "frames"), [("true", 1), ("false", 2)])
def test_how_it_is_drawn_survives(make_cloud, tmp_path, antialiased, frames):
    stated = {"raster_antialiased": antialiased, "raster_low_pass": "0.1"}
    sequence = GaussianSequence.from_clouds([make_cloud(seed=seed) for seed in range(frames)], metadata=stated)
    files = converters.write(sequence, tmp_path / "a.ply", WriteOptions(target="unreal"))
    word = "antialiased" if antialiased == "true" else "classic"
    for file in files:
        assert f"comment beam_raster {word} 0.1\n".encode() in file.read_bytes()
    found = converters.read(files[0] if frames == 1 else tmp_path)
    assert found.metadata.items() >= stated.items()


def test_nothing_is_said_of_drawing_without_a_word(make_cloud, columns, ply_bytes, tmp_path):
    write(make_cloud(), tmp_path / "ours.ply")
    assert b"beam_raster" not in (tmp_path / "ours.ply").read_bytes()
    (tmp_path / "other.ply").write_bytes(ply_bytes(columns))
    for name in ("ours", "other"):
        assert not [key for key in converters.read(tmp_path / f"{name}.ply").metadata if key.startswith("raster")]


@pytest.mark.parametrize(
    ("comments", "raster", "thickness"),
    [
        (["SplatRenderMode: mip"], (True, pytest.approx(0.3)), 7.0),
        (["splatrendermode mip"], (True, pytest.approx(0.3)), 7.0),
        (["antialiased 1"], (True, pytest.approx(0.3)), 7.0),
        (["antialiased 1", "SplatRenderMode: default"], None, 7.0),
        (["SplatRenderMode: mip", "beam_raster classic 0.1"], (False, pytest.approx(0.1)), 7.0),
        (["antialiased 0"], None, 7.0),
        (["SplatRenderMode: 2dgs"], None, np.inf),
        (["SplatRenderMode: other"], None, 7.0),
    ],
)
def test_the_tags_of_other_programs_are_read(comments, raster, thickness, columns, ply_file):
    sequence = converters.read(ply_file(columns, comments=comments))
    assert stated_raster(sequence.metadata) == raster
    assert np.allclose(sequence[0].scales[:, 2], np.exp(-thickness))


@pytest.mark.parametrize("suffix", [".ply", ".compressed.ply", ".sog"])
@pytest.mark.parametrize("is_flat", [False, True])
def test_flat_and_antialiased_splats_are_tagged(suffix, is_flat, make_cloud, tmp_path):
    cloud = make_cloud(8, 0)
    cloud = cloud.with_arrays(scales=cloud.scales * np.array([1, 1, not is_flat], np.float32))
    path = tmp_path / f"a{suffix}"
    converters.write(GaussianSequence.from_clouds([cloud], metadata=raster_metadata(not is_flat, 0.3)), path)
    words = {".sog": ('"model":"antialiased"', '"model":"2dgs"')}.get(suffix, ("RenderMode: mip", "RenderMode: 2dgs"))
    assert [word.encode() in path.read_bytes() for word in words] == [not is_flat, is_flat]
    assert (not converters.read(path)[0].scales[:, 2].any()) == is_flat


@pytest.mark.parametrize("text", ["sharp 0.1", "antialiased", "classic nan"])
def test_a_filter_that_is_none_is_refused(columns, ply_file, text):
    path = ply_file(columns, comments=[f"beam_raster {text}"])
    with pytest.raises(AssetFormatError, match=r"a\.ply: beam_raster('s low-pass)? must be"):
        converters.read(path)


def test_linear_files_are_read_when_told(columns, ply_file, tmp_path):
    columns |= {"opacity": [0.25, 0.5, 1.0]}
    columns |= {f"scale_{i}": [0.01, 0.02, 0.03] for i in range(3)}
    cloud = converters.read(ply_file(columns), activation="linear")[0]
    assert np.array_equal(cloud.opacities, np.float32([0.25, 0.5, 1.0]))
    assert np.array_equal(cloud.scales[:, 0], np.float32([0.01, 0.02, 0.03]))
    assert np.allclose(converters.read(tmp_path / "a.ply", activation="log")[0].scales[0], np.exp(0.01))


@pytest.mark.parametrize(
    ("activation", "producer", "names", "base", "rough"),
    [
        ("r3dg", "Relightable3DGaussian", ("base_color", "incidents_dc"), 0.03 + 0.77 * 0.5, 0.09 + 0.9 * 0.5),
        ("gsir", "GS-IR", ("albedo", "normal"), 0.5, 0.5),
        ("irgs", "IRGS", ("base_color", "metallic"), 0.03 + 0.77 * 0.5, 0.5),
    ],
)
def test_materials_of_other_producers(columns, ply_file, tmp_path, activation, producer, names, base, rough):
    zeros, ones = [0.0] * 3, [1.0] * 3
    columns |= {f"{names[0]}_{i}": zeros for i in range(3)} | {"roughness": zeros}
    columns |= {f"{names[1]}_{i}": ones for i in range(3)} | ({"metallic": zeros} if activation == "irgs" else {})
    sequence = converters.read(ply_file(columns))
    assert sequence[0].base_color is None
    assert sequence.metadata["producer"] == f"{producer}, by its property names"
    (note,) = (note for note in notes_of(sequence) if note.startswith(f"materials of {producer} left out"))
    assert note.endswith(f"pass --material-activation {activation} to read them")
    cloud = converters.read(tmp_path / "a.ply", material_activation=activation)[0]
    assert np.allclose(cloud.base_color, base, rtol=EPSILON)
    assert np.allclose(cloud.roughness, rough, rtol=EPSILON)
    assert (cloud.normals is not None) == (activation == "gsir")


def test_mesh2splat_is_named(columns, ply_file):
    columns |= {"metallicFactor": [0.0] * 3, "roughnessFactor": [0.5] * 3}
    assert converters.inspect(ply_file(columns)).producer == "mesh2splat, by its property names"


def test_materials_that_are_not_there(columns, ply_file):
    path = ply_file(columns)
    message = r"a\.ply: materials of gsir must have albedo_0, .* no material channels"
    with pytest.raises(AssetFormatError, match=message):
        converters.read(path, material_activation="gsir")


def test_normals_zero_in_part_are_left_out(columns, ply_file):
    columns |= {"nx": [0.0, 2.0, 0.0], "ny": [0.0, 0.0, 1.0], "nz": [0.0, 0.0, 0.0]}
    sequence = converters.read(ply_file(columns))
    assert sequence[0].normals is None
    assert "normals left out: 1 of 3 are zero or not finite" in notes_of(sequence)


def test_limits_are_values(columns, ply_file, tmp_path):
    # splat-transform writes +inf for an alpha of 1, and -inf for a scale of 0.
    columns |= {"opacity": [np.inf, -np.inf, 0.0], "scale_2": [-np.inf, -7.0, -7.0]}
    cloud = converters.read(ply_file(columns))[0]
    assert np.array_equal(cloud.opacities, [1.0, 0.0, 0.5])
    assert np.array_equal(cloud.scales[:, 2], np.float32([0.0, np.exp(-7.0), np.exp(-7.0)]))
    kept = converters.read(tmp_path / "a.ply", drop_invalid=True)
    assert np.array_equal(kept[0].positions, cloud.positions)
    write(cloud, tmp_path / "b.ply")
    vertex = plyfile.PlyData.read(str(tmp_path / "b.ply"))["vertex"].data
    assert np.array_equal(vertex["opacity"], [20.0, -20.0, 0.0])
    assert np.array_equal(vertex["scale_2"], [-30.0, -7.0, -7.0])
    back = converters.read(tmp_path / "b.ply")[0]
    assert np.array_equal(back.opacities, np.float32([1.0, 1.0 / (1.0 + np.exp(20.0)), 0.5]))


def test_invalid_rows_are_dropped_on_request(columns, ply_file):
    columns = {name: values * 2 for name, values in columns.items()}
    columns["x"][0] = columns["opacity"][1] = columns["scale_0"][2] = np.nan
    columns["scale_1"][3], columns["rot_0"][5] = 1000.0, 0.0
    sequence = converters.read(ply_file(columns), drop_invalid=True)
    assert np.array_equal(sequence[0].positions, [[1, -1, 2]])
    assert "5 of 6 Gaussians dropped: 4 not finite, 1 with a zero quaternion" in notes_of(sequence)


def test_linear_values_are_seen_among_invalid_rows(columns, ply_file):
    columns |= {"opacity": [0.1, np.nan, 1.0]} | {f"scale_{i}": [0.01, 0.02, np.nan] for i in range(3)}
    with pytest.raises(AssetFormatError, match="which look linear"):
        converters.read(ply_file(columns), drop_invalid=True)


def test_writing_again_keeps_bits(make_cloud, tmp_path, rng):
    """Positions, rotations and colour are copied. exp and ln of a log x, |x| >= 1/2, give x again to one rounding."""
    cloud = make_cloud(3000, opacities=rng.uniform(size=3000), scales=np.exp(rng.uniform(-12, -0.5, (3000, 3))))
    write(cloud, tmp_path / "a.ply")
    once = converters.read(tmp_path / "a.ply")[0]
    write(once, tmp_path / "b.ply")
    first, again = (plyfile.PlyData.read(str(tmp_path / f"{name}.ply"))["vertex"].data for name in "ab")
    lossy = ("opacity", "scale_0", "scale_1", "scale_2")
    assert all(np.array_equal(first[name], again[name]) for name in first.dtype.names if name not in lossy)
    for name in lossy[1:]:  # s is rounded by eps / 2, which moves ln s by as much: at most half a unit of |ln s| >= 1/2
        assert (np.abs(again[name] - first[name]) <= np.spacing(np.abs(first[name]))).all()
    twice = converters.read(tmp_path / "b.ply")[0]
    # A logit has at most 16 EPSILON of rounding, of which o (1 - o) <= 1/4 arrives; o itself is rounded once more.
    assert np.abs(twice.opacities - once.opacities).max() <= 5 * EPSILON


@pytest.mark.parametrize("cores", [1, 3])
def test_blocks_on_threads_join_without_a_seam(make_cloud, tmp_path, monkeypatch, cores):
    monkeypatch.setattr("beam_warp.blocks._core_count", lambda: cores)
    for count in (BLOCK_ROWS - 1, BLOCK_ROWS, 2 * BLOCK_ROWS + 1):
        cloud = make_cloud(count, degree=1)
        write(cloud, tmp_path / "a.ply")
        back, plain = converters.read(tmp_path / "a.ply")[0], through_plyfile(tmp_path / "a.ply")
        assert np.array_equal(back.radiance, cloud.radiance)
        assert np.array_equal(back.positions, plain["positions"].astype(np.float32))
        assert np.array_equal(back.scales, plain["scales"].astype(np.float32))
        assert np.array_equal(back.opacities, plain["opacities"].astype(np.float32))


def test_a_beam_profile_needs_materials(make_cloud, tmp_path):
    with pytest.raises(InvalidOptionError, match="profile beam must have a material channel to write"):
        write(make_cloud(), tmp_path / "a.ply", profile="beam")
    assert not list(tmp_path.iterdir())


def test_a_later_schema_is_refused(columns, ply_file):
    path = ply_file(columns, comments=["beam_schema 2.0"])
    with pytest.raises(SchemaVersionError, match=r"beam_schema must be 1\.x, got 2\.0\. Update beam-warp"):
        converters.read(path)


def test_files_too_large_for_importers_are_refused(make_cloud, tmp_path, monkeypatch):
    monkeypatch.setattr("beam_warp.converters.ply.writer.MAX_FILE_BYTES", 5000)
    with pytest.raises(OutputError, match=r"a PLY file must be under 2 GB for importers to read it, got 0\.00 GB"):
        write(make_cloud(), tmp_path / "a.ply")
    assert not list(tmp_path.iterdir())


def test_a_full_disk_leaves_nothing(make_cloud, tmp_path, monkeypatch):
    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("beam_warp.converters.ply.writer._row_source", lambda *_: full)
    message = r"output must be a writable file, got .*a\.ply \(.*No space left on device\)"
    with pytest.raises(OutputError, match=message):
        write(make_cloud(), tmp_path / "a.ply")
    assert not list(tmp_path.iterdir())


def test_options_are_checked():
    with pytest.raises(InvalidOptionError, match="sh_degree must be an integer in"):
        WriteOptions(sh_degree=4)
    with pytest.raises(InvalidOptionError, match=r"target must be one of supersplat, .*, got 'maya'"):
        WriteOptions(target="maya")
    with pytest.raises(InvalidOptionError, match="meters_per_unit must be a number in"):
        converters.read("a.ply", meters_per_unit=0.0)
