"""Checks of a PLY of Gaussians on its raw values, so that errors name the file's own properties and rows."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from beam_warp.checks import rows_at
from beam_warp.converters.common.activations import LOG_SCALE_LIMITS
from beam_warp.converters.common.errors import malformed
from beam_warp.converters.ply.container import Element

_WORDS = {"u1": "uchar", "u4": "uint", "f4": "float", "f8": "double"}


def require_types(path: Path, element: Element, names: tuple[str, ...], codes: tuple[str, ...]) -> None:
    """Refuse an element that lacks properties or has them in another type."""
    missing = [name for name in names if name not in element.names]
    if missing:
        raise malformed(
            path,
            f"element {element.name} must have {', '.join(missing)}",
            ", ".join(element.names[:24]) or "no properties",
            "Export it again.",
        )
    for column in element.properties:
        if column.name in names and column.code not in codes:
            wanted = " or ".join(_WORDS[code] for code in codes)
            raise malformed(path, f"{column.name} must be {wanted}", column.word, "Export it again.")


def settle_log_scales(path: Path, log_scales: NDArray[np.floating], drop_invalid: bool) -> None:
    """Refuse scales that cannot be natural logs of standard deviations, or make them NaN, so that a cloud drops them.

    -inf is the log of 0, which a flat Gaussian has.
    """
    low, high = LOG_SCALE_LIMITS
    bad = ~((log_scales >= low) & (log_scales <= high) | (log_scales == -np.inf))
    if drop_invalid:
        log_scales[bad] = np.nan
    elif bad.any():
        raise malformed(
            path,
            f"scales must be natural logs in [{low:g}, {high:g}], or -inf",
            f"{log_scales[bad][0]:g} at {rows_at(bad)}",
            "Drop those rows (--drop-invalid), or pass --activation linear if the file's scales are linear.",
        )


def require_rotations(path: Path, quaternions: NDArray[np.floating]) -> None:
    """Refuse quaternions that did not become unit when they were divided by their lengths."""
    squares = np.einsum("ij,ij->i", quaternions, quaternions)
    bad = ~(squares > 0.5)
    if bad.any():
        got = "a zero quaternion" if squares[bad][0] == 0.0 else "NaN or infinity"
        raise malformed(
            path,
            "rot_0 … rot_3 must be a quaternion",
            f"{got} at {rows_at(bad)}",
            "Repair those rows, or drop them with --drop-invalid.",
        )


def require_not_linear(path: Path, log_scales: NDArray[np.floating], logits: NDArray[np.floating]) -> None:
    """Refuse a file in which all scales are above 0 and all opacities in [0, 1], since they seem to be linear.

    As logs and logits, these numbers would mean that every Gaussian is wider than a unit and none is more than 73 %
    opaque, which no training produces. NaN is left out of account.
    """
    if not len(logits):
        return
    least, largest = (function.reduce(log_scales, axis=None) for function in (np.fmin, np.fmax))
    lowest, highest = (function.reduce(logits, axis=None) for function in (np.fmin, np.fmax))
    if least > 0.0 and lowest >= 0.0 and highest <= 1.0:
        raise malformed(
            path,
            "scales must be natural logs and opacities logits",
            f"scales in [{least:g}, {largest:g}] and opacities in [{lowest:g}, {highest:g}], which look linear",
            "Pass --activation linear, or --activation log if they are what they should be.",
        )
