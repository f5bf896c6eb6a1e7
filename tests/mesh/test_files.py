"""Meshes on disk: round trips, axes, colours, texture coordinates, and files that are none."""

import json
import struct

import numpy as np
import pytest
import trimesh

from beam_warp.errors import AssetFormatError, InvalidArrayError, InvalidOptionError, MissingFileError, OutputError
from beam_warp.mesh.files import read_mesh, write_mesh
from beam_warp.mesh.topology import mesh_report

SUFFIXES = ("ply", "obj", "glb")

PRECISION = 5e-8
"""Vertices are about 1 m: floats of 32 bits, and eight digits after the point of text, are both within."""


@pytest.fixture
def mesh():
    """A box without symmetry, vertices told apart by colour."""
    shape = trimesh.creation.box((0.2, 0.4, 0.8))
    shape.apply_translation((0.1, 0.3, 0.5))
    colors = np.arange(8)[:, None] * [10, 20, 30]
    return trimesh.Trimesh(shape.vertices, shape.faces, vertex_colors=colors.astype(np.uint8), process=False)


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_round_trip(mesh, suffix, tmp_path):
    path, other = tmp_path / f"box.{suffix}", tmp_path / f"other.{suffix}"
    for file in (path, other):
        write_mesh(mesh, file)
    again = read_mesh(path)
    assert np.abs(again.vertices - mesh.vertices).max() < PRECISION
    assert np.array_equal(again.faces, mesh.faces)
    assert np.array_equal(again.visual.vertex_colors[:, :3], mesh.visual.vertex_colors[:, :3])
    assert np.abs(again.vertex_normals - mesh.vertex_normals).max() < 1e-6
    assert {file.name for file in tmp_path.iterdir()} == {path.name, other.name}
    assert path.read_bytes() == other.read_bytes()
    assert b"mtl" not in path.read_bytes()  # an OBJ names no material


def test_glb_is_y_up(mesh, tmp_path):
    """Read without our reader: the box is 0.8 m tall, along y, and what was at +y, forward, is at -z."""
    write_mesh(mesh, tmp_path / "box.glb")
    content = (tmp_path / "box.glb").read_bytes()
    header = json.loads(content[20 : 20 + struct.unpack("<I", content[12:16])[0]])
    positions = next(a for a in header["accessors"] if a["type"] == "VEC3" and "min" in a)
    assert positions["min"] == pytest.approx([0.0, 0.1, -0.5], abs=1e-6)
    assert positions["max"] == pytest.approx([0.2, 0.9, -0.1], abs=1e-6)


@pytest.mark.parametrize("suffix", ["obj", "glb"])
def test_texture_coordinates(suffix, tmp_path):
    uv = np.array([[0.0, 0.0], [1.0, 0.0], [0.25, 0.75]])
    visual = trimesh.visual.TextureVisuals(uv=uv)
    flat = trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]], visual=visual, process=False)
    write_mesh(flat, tmp_path / f"flat.{suffix}")
    assert np.abs(read_mesh(tmp_path / f"flat.{suffix}").visual.uv - uv).max() < PRECISION


def test_what_cannot_be_written(mesh, tmp_path):
    with pytest.raises(InvalidOptionError, match=r"mesh must end in one of \.ply, \.obj, \.glb, got box\.stl"):
        write_mesh(mesh, tmp_path / "box.stl")
    with pytest.raises(OutputError, match="output must be a writable file"):
        write_mesh(mesh, tmp_path / "none" / "box.ply")
    with pytest.raises(InvalidArrayError, match="mesh must hold at least one triangle"):
        write_mesh(trimesh.Trimesh(), tmp_path / "none.ply")


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_what_cannot_be_read(suffix, tmp_path):
    path = tmp_path / f"broken.{suffix}"
    with pytest.raises(MissingFileError, match="mesh must be an existing file"):
        read_mesh(path)
    path.write_bytes(b"\x00\x01 no mesh")
    with pytest.raises(AssetFormatError, match="mesh must"):
        read_mesh(path)


def test_report_of_a_closed_box(mesh):
    report = mesh_report(mesh)
    assert (report.vertices, report.faces, report.parts, report.holes) == (8, 12, 1, 0)
    assert report.closed
    assert report.area == pytest.approx(2 * (0.2 * 0.4 + 0.2 * 0.8 + 0.4 * 0.8))


def test_report_of_a_box_with_holes(mesh):
    """Without its first triangle one hole of three edges; without another that shares no vertex, two."""
    open_box = trimesh.Trimesh(mesh.vertices, mesh.faces[1:], process=False)
    report = mesh_report(open_box)
    assert (report.boundary_edges, report.holes, report.nonmanifold_edges) == (3, 1, 0)
    assert not report.closed
    apart = next(i for i, face in enumerate(mesh.faces) if not set(face) & set(mesh.faces[0]))
    report = mesh_report(trimesh.Trimesh(mesh.vertices, np.delete(mesh.faces, [0, apart], axis=0), process=False))
    assert (report.boundary_edges, report.holes) == (6, 2)


def test_reports_of_a_fin_and_of_nothing():
    """Three triangles on one edge, and none at all."""
    corners = [[0, 0, 0], [0, 0, 1], [1, 0, 0], [0, 1, 0], [-1, 0, 0]]
    report = mesh_report(trimesh.Trimesh(corners, [[0, 1, 2], [0, 1, 3], [0, 1, 4]], process=False))
    assert (report.nonmanifold_edges, report.boundary_edges, report.parts) == (1, 6, 1)
    report = mesh_report(trimesh.Trimesh())
    assert (report.vertices, report.faces, report.parts, report.holes) == (0, 0, 0, 0)
