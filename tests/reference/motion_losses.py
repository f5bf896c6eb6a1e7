"""Energies of joints' motion in float64 NumPy, edge by edge as the papers write them."""

import numpy as np
from reference.skinning import matrix


def rigidity(neighbors, weights, spacing, rotations, positions, previous_rotations, previous_positions):
    turn = matrix(rotations) @ np.swapaxes(matrix(previous_rotations), -1, -2)
    before = previous_positions[:, None] - previous_positions[neighbors]
    now = positions[:, None] - positions[neighbors]
    residual = np.einsum("mij,mkj->mki", turn, before) - now
    return (weights * (residual**2).sum(-1)).sum() / (len(positions) * spacing**2)
