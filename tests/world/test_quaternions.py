"""Turns from +z: they end where they must, and go no detour."""

import numpy as np
from scipy.spatial.transform import Rotation

from beam_warp.world.directions import even_directions
from beam_warp.world.quaternions import turns_from_z


def test_turns_from_z_carry_it_to_every_direction_by_the_shortest_way():
    directions = np.concatenate([even_directions(50), np.eye(3), -np.eye(3)])
    turns = Rotation.from_quat(turns_from_z(directions))
    np.testing.assert_allclose(turns.apply([0.0, 0.0, 1.0]), directions, atol=1e-14)
    np.testing.assert_allclose(np.cos(turns.magnitude()), directions[:, 2], atol=1e-14)
