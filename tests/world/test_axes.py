"""Axis codes and changes of axes: covariances, colours and normals must mean the same afterwards."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from reference.harmonics import sh_color
from scipy.spatial.transform import Rotation
from support.radiant_cloud import radiant_cloud

from beam_warp.errors import InvalidOptionError
from beam_warp.world.axes import AXIS_CODES, axes_matrix, change_axes, handedness

EPSILON = np.finfo(np.float32).eps


def make_cloud(axes="rdf", degree=3):
    return radiant_cloud(20, degree, materials=True, axes=axes)


def covariances(cloud):
    """R S^2 R^T in float64."""
    rotation = Rotation.from_quat(cloud.orientations.astype(np.float64)).as_matrix()
    return np.einsum("nij,nj,nkj->nik", rotation, cloud.scales.astype(np.float64) ** 2, rotation)


def test_known_maps():
    # COLMAP to USD: half a turn about x. USD to Unity: z negated. USD to Unreal: (x, y, z) -> (-z, x, y).
    assert np.array_equal(axes_matrix("rdf", "rub"), np.diag([1, -1, -1]))
    assert np.array_equal(axes_matrix("rub", "ruf"), np.diag([1, 1, -1]))
    assert np.array_equal(axes_matrix("rub", "fru") @ [1.0, 2.0, 3.0], [-3.0, 1.0, 2.0])
    assert np.array_equal(axes_matrix("rub", "rfu") @ [1.0, 2.0, 3.0], [1.0, -3.0, 2.0])


def test_there_are_48_codes_half_of_each_hand():
    assert len(set(AXIS_CODES)) == 48
    assert [handedness(code) for code in ("rdf", "rub", "rfu", "ruf", "fru")] == ["right"] * 3 + ["left"] * 2
    assert sum(handedness(code) == "left" for code in AXIS_CODES) == 24


@pytest.mark.parametrize("code", ["rd", "rdd", "RDF"])
def test_a_wrong_code_or_scale_is_refused(code):
    with pytest.raises(InvalidOptionError, match=r"target must be three letters, one each of r/l, u/d and f/b, got"):
        change_axes(make_cloud(), code)
    with pytest.raises(InvalidOptionError, match=r"scale must be a number in \[1e-06, 1e\+06\], got nan"):
        change_axes(make_cloud(), "rub", scale=float("nan"))


@settings(max_examples=40, deadline=None)
@given(source=st.sampled_from(AXIS_CODES), target=st.sampled_from(AXIS_CODES))
def test_every_pair_keeps_what_is_meant(source, target):
    cloud = make_cloud(source)
    moved = change_axes(cloud, target)
    matrix = axes_matrix(source, target)
    assert moved.axes == target
    assert np.array_equal(moved.positions, cloud.positions @ matrix.T.astype(np.float32))
    assert np.array_equal(moved.scales, cloud.scales)
    assert np.array_equal(moved.normals, cloud.normals @ matrix.T.astype(np.float32))
    # A quaternion rounded to float32 turns by at most 4 eps; a covariance is at most 1 and twice linear in it.
    expected = matrix @ covariances(cloud) @ matrix.T
    assert np.abs(covariances(moved) - expected).max() <= 16 * EPSILON
    # Colours: from the corresponding direction. 16 coefficients of at most 5, each rounded once.
    directions = Rotation.random(len(cloud), rng=7).apply([0.0, 0.0, 1.0])
    seen, seen_moved = sh_color(cloud.radiance, directions), sh_color(moved.radiance, directions @ matrix.T)
    assert np.abs(seen - seen_moved).max() <= 16 * 5 * EPSILON


@pytest.mark.parametrize("target", ["luf", "ruf", "rdb"])
def test_a_pure_flip_and_back_is_bit_exact(target):
    cloud = make_cloud("rub", degree=4)
    back = change_axes(change_axes(cloud, target), "rub")
    for name, array in cloud.arrays().items():
        same = np.array_equal(getattr(back, name), array)
        assert same or name == "orientations", name
    # A quaternion and its negative are the same rotation.
    signs = np.sign(np.sum(back.orientations * cloud.orientations, axis=1, keepdims=True))
    assert np.array_equal(back.orientations * signs, cloud.orientations)


def test_another_unit_scales_positions_and_scales():
    cloud = make_cloud("rub")
    moved = change_axes(cloud, "fru", scale=100.0)
    assert np.allclose(moved.positions, 100.0 * cloud.positions[:, [2, 0, 1]] * [-1, 1, 1], rtol=2 * EPSILON)
    assert np.allclose(moved.scales, 100.0 * cloud.scales, rtol=EPSILON)


def test_zeroth_degree_and_no_optional_arrays():
    cloud = make_cloud(degree=0).with_arrays(normals=None)
    assert change_axes(cloud, "rdf") is cloud  # nothing to do
    moved = change_axes(cloud, "fru")
    assert np.array_equal(moved.radiance, cloud.radiance)
    assert moved.normals is None
