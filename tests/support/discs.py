"""Discs whose coverage is known, before a backdrop that is known."""

import numpy as np

from beam_warp.capture.views import CapturedView
from beam_warp.world.camera import Camera

SIDE, RADIUS, SAMPLES = 96, 30.0, 8
SUBJECT = np.array([0.8, 0.5, 0.3], np.float32)
ROWS, COLUMNS = np.mgrid[:SIDE, :SIDE].astype(np.float32)
WALL = (0.2 + 0.001 * ROWS + 0.0005 * COLUMNS)[..., None] * np.array([1.0, 0.9, 0.8], np.float32)
"""A backdrop whose brightness is linear."""


def disc(radius=RADIUS, center=(47.3, 48.6)):
    """How much of each pixel is in a disc."""
    fine = (np.arange(SIDE * SAMPLES) + 0.5) / SAMPLES - 0.5
    inside = np.hypot(fine[:, None] - center[0], fine - center[1]) < radius
    return inside.reshape(SIDE, SAMPLES, SIDE, SAMPLES).mean(axis=(1, 3)).astype(np.float32)


def before(wall, alpha, subject=SUBJECT):
    """What a camera sees of a subject before a backdrop."""
    return (alpha[..., None] * subject + (1.0 - alpha[..., None]) * wall).astype(np.float32)


def cut_out(pixels=0.0, *, is_straight=True, alpha=None, coverage=None, color=SUBJECT, **where):
    """A disc over nothing, with a mask that is too large by so much; straight colour is whole where the disc is."""
    coverage = disc(**where) if coverage is None else coverage
    alpha = disc(**{**where, "radius": where.get("radius", RADIUS) + pixels}) if alpha is None else alpha
    shown = alpha * (coverage > 0.0) if is_straight else np.minimum(alpha, coverage)
    camera = Camera(SIDE, SIDE, 100.0, 100.0, 48.0, 48.0, np.eye(4))
    return CapturedView(name="a", camera=camera, color=(shown[..., None] * color).astype(np.float32), alpha=alpha)
