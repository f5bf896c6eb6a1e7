"""Files that are not what they say: each is refused at once, with one message, and nothing is left behind."""

import subprocess
import sys
import time

import numpy as np
import pytest
from hostile import corpus

from beam_warp import converters
from beam_warp.cli.convert import main
from beam_warp.converters.ply.container import read_columns, read_header
from beam_warp.errors import AssetFormatError, InvalidOptionError, MissingFileError


def refused(folder, content, message, **options):
    """Read ``content``: that message on one line, after the file's name, within two seconds."""
    (folder / "bad.ply").write_bytes(content)
    started = time.perf_counter()
    with pytest.raises(AssetFormatError) as caught:
        converters.read(folder / "bad.ply", **options)
    assert time.perf_counter() - started < 2.0
    said = str(caught.value)
    assert said.startswith("bad.ply: ")
    assert "\n" not in said
    assert message in said


def test_the_command_says_so_on_one_line_and_leaves_nothing(columns, ply_bytes, tmp_path, capsys):
    (tmp_path / "bad.ply").write_bytes(ply_bytes(columns)[:-1])
    assert main([str(tmp_path / "bad.ply"), str(tmp_path / "out.ply")]) == 2
    captured = capsys.readouterr()
    assert captured.err.startswith("error: bad.ply: element vertex must have the 3 rows")
    assert (captured.err.count("\n"), captured.out) == (1, "")
    assert [path.name for path in tmp_path.iterdir()] == ["bad.ply"]


def test_truncated_at_every_header_line(columns, ply_bytes, tmp_path):
    content = ply_bytes(columns)
    header = content[: content.index(b"end_header\n")]
    lines = header.splitlines(keepends=True)
    for count in range(len(lines) + 1):
        cut = b"".join(lines[:count])
        message = "got an empty file" if not cut else "the header must end with the line end_header, got a cut file"
        refused(tmp_path, cut, message)


def test_truncated_within_the_data(columns, ply_bytes, tmp_path):
    content = ply_bytes(columns)
    start = content.index(b"end_header\n") + len(b"end_header\n")
    for size in (start, start + 1, start + 56, len(content) - 1):
        held = (size - start) // 56
        message = f"element vertex must have the 3 rows that the header counts, got bytes for {held}"
        refused(tmp_path, content[:size], message)
    bytes_first = content[:start].replace(b"element vertex", b"element mask 2\nproperty uchar m\nelement vertex")
    refused(tmp_path, bytes_first, "element mask must have the 2 rows that the header counts, got bytes for 0")


@pytest.mark.parametrize(
    ("count", "message"),
    [
        (4, "the 4 rows that the header counts, got bytes for 3. The file is cut short"),
        (10**9, "the 1000000000 rows that the header counts, got bytes for 3"),
        (2**31, "element vertex must count 0 to 2147483647 rows, got '2147483648'"),
        (10**100, "element vertex must count 0 to 2147483647 rows, got '1000"),
        (-1, "element vertex must count 0 to 2147483647 rows, got '-1'"),
        ("3.0", "element vertex must count 0 to 2147483647 rows, got '3.0'"),
    ],
)
def test_lying_counts(columns, ply_bytes, tmp_path, count, message):
    refused(tmp_path, ply_bytes(columns, count=count), message)


HEADER_LINES = [
    (b"format binary_little_endian 1.0", b"format binary_middle_endian 1.0", "a header line must be format"),
    (b"format binary_little_endian 1.0\n", b"", "a header line must be format"),
    (b"format binary_little_endian 1.0\n", b"format ascii 1.0\nformat ascii 1.0\n", "a header line must be format"),
    (b"element vertex 3\n", b"", "in that order, got 'property float x'"),
    (b"element vertex 3\n", b"element vertex\n", "in that order, got 'element vertex'"),
    (b"property float x\n", b"property float32x x\n", "a property must be a type word and a name, got"),
    (b"property float x\n", b"property list uchar vec3 x\n", "a property must be a type word and a name, got"),
    (b"property float x\n", b"garbage\n", "in that order, got 'garbage'"),
    (b"property float x\n", b"property float y\n", "each property of vertex must be named once, got y"),
    (b"property float x\n", b"property list uchar float x\n", "x must be float or double, got list"),
    (b"property float x\n", b"property uint x\n", "x must be float or double, got uint"),
    (b"property float rot_3\n", b"property float rot_4\n", "Gaussians must have the properties rot_3, got"),
    (b"property float f_dc_1\n", b"property float f_rest_0\n", "got 2 and 1. Export it again with full bands"),
    (b"element vertex 3\n", b"element point 3\n", "got vertices with nothing"),
    (b"end_header", b"element vertex 0\nend_header", "each element must be named once, got vertex"),
    (b"ply\n", b"PLY\n", "a PLY file must start with the line ply, got b'PLY"),
]


@pytest.mark.parametrize(("old", "new", "message"), HEADER_LINES)
def test_wrong_header_lines(columns, ply_bytes, tmp_path, old, new, message):
    content = ply_bytes(columns)
    assert old in content
    refused(tmp_path, content.replace(old, new, 1), message)


def test_limits_of_the_header(columns, ply_bytes, tmp_path):
    content = ply_bytes(columns)
    elements = b"".join(b"element e%d 0\n" % i for i in range(16))
    properties = b"element e 0\n" + b"".join(b"property float p%d\n" % i for i in range(1020))
    for place, more, message in (
        (b"element vertex", b"comment " + b"x" * 70_000 + b"\n", "got none in the first 64 KiB"),
        (b"element vertex", elements, "at most 16 elements, got 17"),
        (b"end_header", properties, "at most 1024 properties, got 1034"),
    ):
        refused(tmp_path, content.replace(place, more + place, 1), message)


def test_lists_before_or_within_the_vertices(columns, ply_bytes, tmp_path):
    content = ply_bytes(columns)
    faces = b"element face 1\nproperty list uchar int vertex_indices\nelement vertex"
    message = "element face must have no list properties before vertex, got vertex_indices. Export Gaussians, not a"
    refused(tmp_path, content.replace(b"element vertex", faces, 1), message)
    extra = b"property list uchar int neighbours\nend_header"
    message = "element vertex must have no list properties, got neighbours"
    refused(tmp_path, content.replace(b"end_header", extra, 1), message)


QUATERNION = "rot_0 … rot_3 must be a quaternion"


def test_a_point_cloud_is_named(ply_bytes, tmp_path):
    points = {"x": [0.0], "y": [0.0], "z": [0.0], "red": [255], "green": [0], "blue": [0]}
    content = ply_bytes(points, types=dict.fromkeys(("red", "green", "blue"), "uchar"))
    message = "got vertices with x, y, z, red, green, blue. This is a point cloud or a mesh: train Gaussians from it"
    refused(tmp_path, content, message)


@pytest.mark.parametrize(
    ("name", "values", "message"),
    [
        ("x", [0.0, np.nan, np.inf], "positions must be finite, got NaN or infinity at row 1 (2 rows in all)"),
        ("f_dc_0", [0.0, 0.0, np.nan], "radiance must be finite, got NaN or infinity at row 2."),
        ("opacity", [0.0, np.nan, np.inf], "opacities must be finite, got NaN or infinity at row 1. Drop or repair"),
        ("scale_0", [-4.0, np.nan, np.nan], "natural logs in [-30, 20], or -inf, got nan at row 1 (2 rows in all)"),
        ("scale_1", [-4.0, 1000.0, np.inf], "[-30, 20], or -inf, got 1000 at row 1 (2 rows in all). Drop those rows"),
        ("rot_0", [0.0, 0.0, 0.0], f"{QUATERNION}, got a zero quaternion at row 0 (2 rows in all)"),
        ("rot_2", [0.0, np.nan, 0.0], f"{QUATERNION}, got NaN or infinity at row 1."),
    ],
)
def test_bad_values(columns, ply_bytes, tmp_path, name, values, message):
    refused(tmp_path, ply_bytes(columns | {name: values}), message)


def test_doubles_beyond_float_and_materials_out_of_range(columns, ply_bytes, tmp_path):
    content = ply_bytes(columns | {"x": [1e300, 0.0, 0.0]}, types={"x": "double"})
    refused(tmp_path, content, "positions must be finite, got NaN or infinity at row 0.")
    content = ply_bytes(columns | {"roughness": [0.0, 1.5, 0.0]}, comments=["beam_material linear"])
    refused(tmp_path, content, "roughness must lie in [0, 1], got 1.5 at row 1.")


def test_files_that_look_linear(columns, ply_bytes, tmp_path):
    linear = columns | {"opacity": [0.1, 0.5, 1.0]} | {f"scale_{i}": [0.01, 0.02, 0.03] for i in range(3)}
    message = (
        "scales must be natural logs and opacities logits, got scales in [0.01, 0.03] and opacities in [0.1, 1], "
        "which look linear. Pass --activation linear"
    )
    refused(tmp_path, ply_bytes(linear), message)
    # And the other way round: trained values are not linear ones.
    message = "scales must lie in [0, inf], got -4"
    refused(tmp_path, ply_bytes(columns), message, activation="linear")


@pytest.mark.parametrize(
    ("comment", "message"),
    [
        ("beam_axes xyz", "comment beam_axes must be an axis code such as rdf, got xyz"),
        ("beam_material logit", "comment beam_material must be linear, got logit"),
        ("beam_base_color_space acescg", "comment beam_base_color_space must be lin_rec709_scene, got acescg"),
        ("beam_radiance_meaning shaded?", "comment beam_radiance_meaning must be captured, baseColorOnly, none"),
        ("beam_meters_per_unit nan", "beam_meters_per_unit must be a number in [1e-06, 1e+06], got 'nan'"),
        ("beam_frame", "beam_frame's rate must be a number in [0.001, 1e+06], got ''"),
        ("beam_frame fast", "beam_frame's rate must be a number in [0.001, 1e+06], got 'fast'"),
        ("beam_frame 0 fast", "beam_frame's rate must be a number in [0.001, 1e+06], got 'fast'"),
        ("beam_schema 9.1", "beam_schema must be 1.x, got 9.1"),
    ],
)
def test_wrong_statements(columns, ply_bytes, tmp_path, comment, message):
    refused(tmp_path, ply_bytes(columns, comments=[comment]), message)


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        ("0 1\n2 x\n4 5\n", "element vertex must hold rows of 2 numbers of its types, got could not convert string"),
        ("0.0 1\n2\n4 5\n", "element vertex must hold rows of 2 numbers of its types, got 1 at row 2. Export"),
        ("0 1\n2 3\n\n\n\n", "element vertex must hold 3 rows, got 2"),
        ("0 1 2\n3 4 5\n6 7 8\n", "element vertex must hold rows of 2 numbers of its types, got 3 at row 1. Export"),
        ("\xff\xfe 1\n2 3\n4 5\n", "element vertex must hold rows of 2 numbers"),
        ("0 1\n", "the 3 rows that the header counts, got bytes for at most 1"),
    ],
)
def test_malformed_text(tmp_path, rows, message):
    text = f"ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nend_header\n{rows}"
    (tmp_path / "a.ply").write_bytes(text.encode("latin-1"))
    with pytest.raises(AssetFormatError) as caught:
        read_columns(read_header(tmp_path / "a.ply"), "vertex", ["xy"])
    assert message in str(caught.value)


def test_an_element_that_is_not_there(columns, ply_file):
    with pytest.raises(AssetFormatError, match=r"a\.ply: the file must have an element face, got vertex\. Check"):
        read_columns(read_header(ply_file(columns)), "face", ["x"])


def test_rows_without_columns_cost_no_time(tmp_path):
    for kind in ("ascii", "binary_little_endian"):
        text = f"ply\nformat {kind} 1.0\nelement junk 2147483647\nelement vertex 1\nproperty float x\nend_header\n0000"
        message = "the 2147483647 rows that" if kind == "ascii" else "Gaussians must have the properties y, z"
        refused(tmp_path, text.encode(), message)


def test_control_characters_do_not_reach_the_terminal(columns, ply_bytes, tmp_path):
    (tmp_path / "a.ply").write_bytes(ply_bytes(columns, comments=["red \x1b[31m and \x7f\x9b"]))
    assert converters.inspect(tmp_path / "a.ply").comments == ("red ?[31m and ??",)


def test_what_is_not_a_file(tmp_path):
    with pytest.raises(MissingFileError, match=r"input must be an existing file or folder, got .*gone\.ply. Check the"):
        converters.read(tmp_path / "gone.ply")
    with pytest.raises(InvalidOptionError, match=r"file name must end in one of \.ply, .*, got a\.obj"):
        converters.read(tmp_path / "a.obj")


def test_a_thousand_million_vertices_ask_for_no_memory(columns, ply_bytes, tmp_path):
    (tmp_path / "a.ply").write_bytes(ply_bytes(columns, count=10**9))
    script = (
        "import resource, sys\n"
        "from beam_warp.cli.convert import main\n"
        "before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss\n"
        "code = main(sys.argv[1:])\n"
        "print(code, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before)\n"
    )
    arguments = [sys.executable, "-c", script, str(tmp_path / "a.ply"), str(tmp_path / "b.ply")]
    finished = subprocess.run(arguments, capture_output=True, text=True, timeout=20)
    code, grown_kib = map(int, finished.stdout.split())
    assert code == 2
    assert "the 1000000000 rows that the header counts" in finished.stderr
    assert grown_kib < 16 * 1024  # the reader's modules; the rows would be 56 GB


def mutations(content, count, seed):
    """Damaged copies: bytes changed, cut out, doubled, and numbers of the header replaced."""
    rng = np.random.default_rng(seed)
    for _ in range(count):
        damaged = bytearray(content)
        for _ in range(rng.integers(1, 3)):
            at, length = int(rng.integers(len(damaged))), int(rng.integers(1, 9))
            match int(rng.integers(-4, 4)):
                case -4 | -3 | -2 | -1 | 0:
                    damaged[at] = int(rng.integers(256))
                case 1:
                    del damaged[at : at + length]
                case 2:
                    damaged[at:at] = damaged[at : at + length]
                case 3:
                    damaged[at : at + length] = rng.choice([b"-1", b"99999999", b"\n", b" list ", b"nan", b"\0"])
        yield bytes(damaged)


@pytest.mark.parametrize("make", [corpus.ply, corpus.text_ply, corpus.compressed_ply])
def test_damaged_files_are_read_or_refused(make, tmp_path):
    path = make(tmp_path)
    content = path.read_bytes()
    refusals = []
    for damaged in mutations(content, 200, seed=len(content)):
        path.write_bytes(damaged)
        started = time.perf_counter()
        try:
            converters.read(path)
        except AssetFormatError as error:
            refusals.append(str(error))
        assert time.perf_counter() - started < 2.0
    assert all(message.startswith(f"{path.name}: ") for message in refusals)
    assert 20 < len(refusals) < 200  # the damage is neither harmless nor always fatal
