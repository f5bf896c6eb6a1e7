"""The lat-long mapping in float64: the twin of ``latlong_nearest``."""

import numpy as np


def lookup(environment, directions):
    """Radiance of the texel that holds each unit direction, ``(..., 3)`` to ``(..., 3)``.

    It differs from the kernel only for directions within rounding of a texel's edge.
    """
    d = np.asarray(directions, np.float64)
    u = 0.5 - np.arctan2(d[..., 1], d[..., 0]) / (2.0 * np.pi)
    v = np.arccos(np.clip(d[..., 2], -1.0, 1.0)) / np.pi
    row = np.minimum((v * environment.height).astype(np.int64), environment.height - 1)
    return environment.radiance[row, (u * environment.width).astype(np.int64) % environment.width]
