"""Activations: conversion between the values that training stores (logits, logs, raw materials) and linear values.

Everything else in the package is linear. Plain NumPy, float64 inside, float32 out.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from beam_warp.world.harmonics import SH_C0

LOG_SCALE_LIMITS = (-30.0, 20.0)
"""Range of the natural log of a plausible standard deviation; above it, the activation is wrong.

A writer says the lower limit for a scale of 0: readers that divide by its square in float32 still get a finite 1e26.
"""

LOGIT_LIMIT = 20.0
"""Largest logit written: sigmoid(20) rounds to 1 in float32, and sigmoid(-20) = 2.1e-9 shows nothing.

Of the opacities below 1, the largest float32 has the logit 16.6, so that 1 alone is written as the limit.
"""


def sigmoid(logits: ArrayLike) -> NDArray[np.float32]:
    """Return 1 / (1 + exp(-x)): exactly 1 for +inf and 0 for -inf; NaN stays NaN."""
    bounded = np.clip(np.asarray(logits, dtype=np.float64), -700.0, 700.0)  # exp(700) is still finite
    return (1.0 / (1.0 + np.exp(-bounded))).astype(np.float32)


def logit(opacities: ArrayLike) -> NDArray[np.float32]:
    """Return ln(o / (1 - o)) held within ± `LOGIT_LIMIT`, so that 0 and 1 stay finite in a file."""
    value = np.asarray(opacities, dtype=np.float64)
    with np.errstate(divide="ignore"):
        raw = np.log(value) - np.log1p(-value)
    return np.clip(raw, -LOGIT_LIMIT, LOGIT_LIMIT).astype(np.float32)


def exp_scale(log_scales: ArrayLike) -> NDArray[np.float32]:
    """Return the standard deviations of natural logs that lie in `LOG_SCALE_LIMITS`; -inf is the log of 0."""
    return np.exp(np.asarray(log_scales, dtype=np.float64)).astype(np.float32)


def log_scale(scales: ArrayLike) -> NDArray[np.float32]:
    """Return natural logs, never below the lower limit: a flat Gaussian (0) is written as exp(-30) = 9e-14."""
    with np.errstate(divide="ignore"):
        raw = np.log(np.asarray(scales, dtype=np.float64))
    return np.clip(raw, *LOG_SCALE_LIMITS).astype(np.float32)


def dc_from_color(color: ArrayLike) -> NDArray[np.float32]:
    """Return the zeroth spherical-harmonics coefficient that shows a colour from everywhere."""
    return ((np.asarray(color, dtype=np.float64) - 0.5) / SH_C0).astype(np.float32)


def color_from_dc(coefficients: ArrayLike) -> NDArray[np.float32]:
    """Return the colour that a zeroth coefficient shows."""
    return (0.5 + SH_C0 * np.asarray(coefficients, dtype=np.float64)).astype(np.float32)


def linear(raw: ArrayLike) -> NDArray[np.float32]:
    """Return a material that is stored linearly."""
    return np.asarray(raw, dtype=np.float32)


def sigmoid_base_color(raw: ArrayLike) -> NDArray[np.float32]:
    """Return 0.03 + 0.77 sigmoid(x), the base colour of Relightable 3D Gaussian and IRGS."""
    return (0.03 + 0.77 * sigmoid(raw).astype(np.float64)).astype(np.float32)


def sigmoid_roughness(raw: ArrayLike) -> NDArray[np.float32]:
    """Return 0.09 + 0.9 sigmoid(x), the roughness of Relightable 3D Gaussian."""
    return (0.09 + 0.9 * sigmoid(raw).astype(np.float64)).astype(np.float32)
