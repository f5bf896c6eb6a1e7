"""Scales and opacities that are drawn, in float64 and as the papers write them; arrays may be complex."""

import numpy as np


def thin_axes(log_scales):
    """The axis that the filter leaves alone: the smallest; of several, the one that the kernel takes, (N,)."""
    s0, s1, s2 = np.exp(log_scales.real.astype(np.float64)).T
    return np.where((s0 < s1) & (s0 < s2), 0, np.where(s1 < s2, 1, 2))


def activate(log_scales, logits, filters, thin):
    """Scales sqrt(s^2 + f^2) but for the thin axis, and opacities that keep what such a Gaussian holds."""
    scales = np.exp(log_scales)
    wide = np.sqrt(scales**2 + np.asarray(filters, np.float64)[:, None] ** 2)
    wide = np.where(np.arange(3) == thin[:, None], scales, wide)
    return wide, (scales / wide).prod(axis=1) / (1.0 + np.exp(-logits))
