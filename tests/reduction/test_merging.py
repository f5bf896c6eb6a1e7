"""Clusters are found in the order of their cost in relit images."""

from dataclasses import replace

import numpy as np
import pytest

from beam_warp.reduction.merging import FLOOR, SPREAD, MergeOrder
from beam_warp.reduction.sensitivity import Sensitivity, material_rows
from beam_warp.world.gaussians import GaussianCloud

SIDE = 12


def floor(colors: np.ndarray | None = None) -> GaussianCloud:
    """Gaussians on a grid, facing up."""
    x, y = np.meshgrid(np.arange(SIDE), np.arange(SIDE), indexing="ij")
    count = SIDE * SIDE
    return GaussianCloud(
        positions=np.stack([x.ravel(), y.ravel(), np.zeros(count)], axis=1),
        orientations=np.tile([0.0, 0.0, 0.0, 1.0], (count, 1)),
        scales=np.tile([0.7, 0.7, 0.05], (count, 1)),
        opacities=np.full(count, 0.9),
        base_color=np.full((count, 3), 0.5) if colors is None else colors,
        roughness=np.full(count, 0.5),
        ambient_occlusion=np.ones(count),
        normals=np.tile([0.0, 0.0, 1.0], (count, 1)),
    )


def even(count: int) -> Sensitivity:
    """Images that depend on everything everywhere alike."""
    forms = np.tile(np.eye(8, dtype=np.float32), (count, 1, 1))
    return Sensitivity((), np.ones(count, np.float32), np.full(count, 1e-3, np.float32), forms, 1.0)


@pytest.mark.parametrize("count", [1, 2, 17, 143, 144])
def test_any_number_of_clusters_is_to_be_had(count):
    labels = MergeOrder([floor()], even(SIDE * SIDE)).labels(count)
    assert sorted(set(labels)) == list(range(count))


def test_fewer_clusters_are_unions_of_more_and_the_order_does_not_depend_on_who_asked_first():
    order, again = MergeOrder([floor()], even(SIDE * SIDE)), MergeOrder([floor()], even(SIDE * SIDE))
    many, few = order.labels(40), order.labels(9)
    assert len(set(zip(many, few, strict=True))) == 40
    np.testing.assert_array_equal(few, again.labels(9))
    np.testing.assert_array_equal(many, again.labels(40))


def test_a_pair_costs_what_ward_says_of_relit_images():
    rng, cloud, found = np.random.default_rng(0), floor(), even(SIDE * SIDE)
    halves = rng.normal(size=(len(cloud), 8, 8)).astype(np.float32)
    found = replace(found, materials=halves @ halves.transpose(0, 2, 1), visible=rng.uniform(1.0, 9.0, len(cloud)))
    cloud = cloud.with_arrays(base_color=rng.uniform(size=(len(cloud), 3)), roughness=rng.uniform(size=len(cloud)))
    pairs, costs = MergeOrder([cloud], found)._costs()
    rows, (one, two) = material_rows(cloud), pairs[7]
    away, places = rows[one] - rows[two], cloud.positions[one] - cloud.positions[two]  # on a floor: all along it
    weights, total = found.visible, found.visible[one] + found.visible[two]
    form = away @ (found.materials[one] + found.materials[two]) @ away
    edges = 2e-3 + FLOOR * total
    expected = weights[one] * weights[two] / total**2 * (form + edges * SPREAD * np.square(places).sum())
    assert costs[7] == pytest.approx(expected, rel=1e-4)


def test_what_looks_different_is_merged_last():
    colors = np.where(np.arange(SIDE * SIDE)[:, None] // SIDE < 4, 0.1, 0.9) * np.ones(3)
    labels = MergeOrder([floor(colors)], even(SIDE * SIDE)).labels(2)
    assert len(set(zip(labels, colors[:, 0], strict=True))) == 2


def test_what_moves_apart_is_merged_last():
    still = floor()
    away = still.positions + np.where(still.positions[:, :1] < 6.0, 0.0, 30.0) * [0.0, 0.0, 1.0]
    labels = MergeOrder([still, still.with_arrays(positions=away)], even(SIDE * SIDE)).labels(2)
    assert len(set(zip(labels, still.positions[:, 0] < 6.0, strict=True))) == 2
