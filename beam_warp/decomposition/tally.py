"""Counts over the frames of a relightable sequence, and what a user should know about them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from beam_warp.decomposition.archive import MeasuredFrame
from beam_warp.materials.changes import ColorChange
from beam_warp.world.gaussians import GaussianCloud, Observability

CLIPPED_WARNING = 0.05
"""Part of the opacity with base colour cut at 1 above which the stated light is called too dim."""

UNCERTAIN_WARNING = 0.5
"""Part of the Gaussians with uncertain normals above which they are said not to form a surface."""


def warnings_about(statistics: Mapping[str, Any]) -> list[str]:
    """Return what a user should know about what `summary` returns."""
    warnings = []
    if statistics["clipped_part"] > CLIPPED_WARNING:
        warnings.append(
            f"{statistics['clipped_part']:.0%} of what is opaque has base colour cut at 1: the environment is too dim, "
            "or comes from other sides than the light of the capture; see --exposure and --rotate"
        )
    if statistics["gaussians"] and statistics["flags"]["FILLED"] == statistics["gaussians"]:
        warnings.append(
            "no base colour could be measured: no Gaussian is both lit and seen; check that the environment is not "
            "black and that the capture is the one that the Gaussians were reconstructed from"
        )
    if statistics["flags"]["UNCERTAIN_NORMAL"] > UNCERTAIN_WARNING * statistics["gaussians"]:
        warnings.append("most normals are uncertain: the Gaussians do not form a surface; relighting is a guess")
    return warnings


def changes_of(change: ColorChange) -> dict[str, float]:
    """Return what a test of frames against each other found, JSON-able."""
    return {"changing_part": float(change.changing.mean()), "error_dispersion": change.dispersion}


def summary(counts: Sequence[Mapping[str, Any]], changes: Mapping[str, float]) -> dict[str, Any]:
    """Return parts, means and counts over frames, JSON-able.

    Args:
        counts: What `counts_of` says of each.
        changes: What `changes_of` says of all.
    """
    total = sum(frame["rows"] for frame in counts)
    rows = max(total, 1)
    sums = {name: sum(frame["sums"][name] for frame in counts) for name in counts[0]["sums"]}
    return {
        "gaussians": total,
        "clipped_part": sums["clipped"] / rows,
        "normals_from_shape": sums["from_shape"] / rows,
        "mean_ambient_occlusion": sums["openness"] / rows,
        "mean_normal_confidence": sums["confidence"] / rows,
        "mean_base_color_error_where_measured": sums["error"] / max(sums["measured"], 1.0),
        "dropped_transparent": int(sums["dropped"]),
        "raised_scales": int(sums["raised"]),
        "flags": {name: sum(frame["flags"][name] for frame in counts) for name in counts[0]["flags"]},
        **changes,
    }


def counts_of(frame: MeasuredFrame, cloud: GaussianCloud, clipped_part: float = 0.0) -> dict[str, Any]:
    """Return sums over one frame, JSON-able.

    Args:
        frame: Its measurements.
        cloud: Its relightable cloud.
        clipped_part: Part of the opacity whose base colour was cut at 1.
    """
    assert cloud.observability is not None
    assert cloud.ambient_occlusion is not None
    assert cloud.normal_confidence is not None
    measured = (cloud.observability & np.uint8(Observability.FILLED)) == 0
    error = 0.0
    if cloud.base_color_error is not None:
        error = cloud.base_color_error[measured].mean(axis=1).sum(dtype=np.float64)
    sums = {
        "clipped": clipped_part * len(cloud),
        "from_shape": frame.from_shape.sum(),
        "openness": cloud.ambient_occlusion.sum(dtype=np.float64),
        "confidence": cloud.normal_confidence.sum(dtype=np.float64),
        "error": error,
        "measured": measured.sum(),
        "dropped": frame.report[1],
        "raised": frame.report[2],
    }
    flags = (flag for flag in Observability if flag and flag.name)
    return {
        "rows": len(cloud),
        "sums": {name: float(value) for name, value in sums.items()},
        "flags": {flag.name: int(((cloud.observability & np.uint8(flag)) != 0).sum()) for flag in flags},
    }
