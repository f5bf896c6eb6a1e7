"""Clouds and PLY bytes that the converter tests share."""

import numpy as np
import pytest
from support.radiant_cloud import radiant_cloud


@pytest.fixture(scope="session")
def make_cloud():
    return radiant_cloud


@pytest.fixture(scope="session")
def ply_bytes():
    """A function that makes a PLY of float columns: ``ply_bytes({"x": [...], …}, comments=…, newline=…)``."""

    def make(columns, *, comments=(), newline="\n", count=None, order="<", types=None):
        types = types or {}
        codes = {"float": "f4", "double": "f8", "uchar": "u1", "int": "i4"}
        names = list(columns)
        rows = len(next(iter(columns.values())))
        kind = "binary_little_endian" if order == "<" else "binary_big_endian"
        lines = [
            "ply",
            f"format {kind} 1.0",
            *(f"comment {comment}" for comment in comments),
            f"element vertex {rows if count is None else count}",
            *(f"property {types.get(name, 'float')} {name}" for name in names),
            "end_header",
            "",
        ]
        table = np.empty(rows, [(name, order + codes[types.get(name, "float")]) for name in names])
        for name in names:
            table[name] = columns[name]
        return newline.join(lines).encode() + table.tobytes()

    return make


@pytest.fixture
def ply_file(ply_bytes, tmp_path):
    """A function that writes columns as ``a.ply``, with the options of `ply_bytes`, and returns its path."""

    def make(columns, **options):
        (tmp_path / "a.ply").write_bytes(ply_bytes(columns, **options))
        return tmp_path / "a.ply"

    return make


@pytest.fixture
def columns():
    """Columns of three sound Gaussians in the training layout, without spherical harmonics above the mean."""
    return {
        "x": [0.0, 1.0, 2.0],
        "y": [0.0, -1.0, 0.5],
        "z": [3.0, 2.0, 1.0],
        "f_dc_0": [0.1, 0.2, 0.3],
        "f_dc_1": [0.0, 0.0, 0.0],
        "f_dc_2": [-0.1, 0.5, 1.0],
        "opacity": [-2.0, 0.0, 3.0],
        "scale_0": [-4.0, -5.0, -6.0],
        "scale_1": [-4.5, -5.5, -6.5],
        "scale_2": [-7.0, -7.0, -7.0],
        "rot_0": [1.0, 0.0, 2.0],
        "rot_1": [0.0, 1.0, 0.0],
        "rot_2": [0.0, 0.0, 0.0],
        "rot_3": [0.0, 0.0, 0.0],
    }
