"""What stills can show; this waits for no renderer."""

from __future__ import annotations

from beam_warp.converters.common.options import WriteOptions
from beam_warp.converters.delivery.writer import delivered
from beam_warp.world.gaussians import GaussianCloud

TRACED, DEFERRED = "path traced", "deferred"
"""Light by paths, or at once, with shadows of the environment and light from surface to surface."""

NONE = "none"
"""No environment, no ground."""

LABELS = {
    TRACED: "path traced",
    DEFERRED: "deferred, shadows of the environment",
    "radiance": "captured colour",
    "base_color_error": "standard error of base colour",
    "roughness_error": "standard error of roughness",
    "ambient_occlusion_error": "standard error of ambient occlusion",
    "normal_confidence": "confidence of normals",
    "observability": "observability",
    "surface_normals": "normals of the geometry",
}
"""What kinds of stills are called on the page."""


def kinds_of(cloud: GaussianCloud) -> dict[str, str]:
    """Return the stills that a cloud allows and a container does not hold: their words, and what they are called."""
    held = delivered(cloud, WriteOptions())

    def is_offered(kind: str) -> bool:
        if kind in (TRACED, DEFERRED):
            return cloud.is_relightable
        return kind == "surface_normals" or (getattr(cloud, kind) is not None and kind not in held)

    return {kind: label for kind, label in LABELS.items() if is_offered(kind)}
