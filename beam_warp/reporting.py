"""What a run says about itself: counts over frames, versions, warnings, and the file they are written to."""

from __future__ import annotations

import json
import os
import platform
from collections.abc import Mapping
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from beam_warp._version import __version__
from beam_warp.assets import GaussianCloud, Observability
from beam_warp.errors import OutputError
from beam_warp.kernels.launching import thread_count
from beam_warp.temporal_color import ColorChange

CLIPPED_WARNING = 0.05
"""Part of the opacity with base colour cut at 1 above which the stated light is called too dim."""

UNCERTAIN_WARNING = 0.5
"""Part of the Gaussians with uncertain normals above which they are said not to form a surface."""


def versions() -> dict[str, str]:
    """Return the versions that a result depends on."""
    return {
        "beam-warp": __version__,
        "warp": wp.__version__,
        "numpy": np.__version__,
        "usd-core": version("usd-core"),
        "python": platform.python_version(),
    }


def device_facts(device: Any) -> dict[str, Any]:
    """Return what a Warp device is, JSON-able."""
    return {
        "name": device.name,
        "kind": "cuda" if device.is_cuda else "cpu",
        "threads": None if device.is_cuda else thread_count(),
    }


def warnings_about(statistics: Mapping[str, Any]) -> list[str]:
    """Return what a user should know about a tally's `Tally.summary`."""
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


class Tally:
    """Counts over frames, so that a report needs no frame twice."""

    def __init__(self) -> None:
        """Start with nothing counted."""
        self._rows = 0
        self._sums: dict[str, float] = {}
        self._changes: dict[str, float] = {}
        self._flags = {flag.name: 0 for flag in Observability if flag and flag.name}

    def add(self, cloud: GaussianCloud, stored: Mapping[str, NDArray[Any]], clipped_part: float = 0.0) -> None:
        """Count one frame: its relightable cloud, ``from_shape`` and ``report`` of the store, and what was cut at 1."""
        count = len(cloud)
        assert cloud.observability is not None
        assert cloud.ambient_occlusion is not None
        assert cloud.normal_confidence is not None
        measured = (cloud.observability & np.uint8(Observability.FILLED)) == 0
        error = 0.0
        if cloud.base_color_error is not None:
            error = cloud.base_color_error[measured].mean(axis=1).sum(dtype=np.float64)
        self._rows += count
        for name, value in (
            ("clipped", clipped_part * count),
            ("from_shape", stored["from_shape"].sum()),
            ("openness", cloud.ambient_occlusion.sum(dtype=np.float64)),
            ("confidence", cloud.normal_confidence.sum(dtype=np.float64)),
            ("error", error),
            ("measured", measured.sum()),
            ("dropped", stored["report"][1]),
            ("raised", stored["report"][2]),
        ):
            self._sums[name] = self._sums.get(name, 0.0) + float(value)
        for flag in Observability:
            if flag and flag.name:
                self._flags[flag.name] += int(((cloud.observability & np.uint8(flag)) != 0).sum())

    def count_changes(self, change: ColorChange) -> None:
        """Keep what a test of frames against each other found."""
        self._changes = {"changing_part": change.changing_part, "error_dispersion": change.dispersion}

    def summary(self) -> dict[str, Any]:
        """Return parts, means and counts over all frames, JSON-able."""
        rows = max(self._rows, 1)
        return {
            "gaussians": self._rows,
            "clipped_part": self._sums["clipped"] / rows,
            "normals_from_shape": self._sums["from_shape"] / rows,
            "mean_ambient_occlusion": self._sums["openness"] / rows,
            "mean_normal_confidence": self._sums["confidence"] / rows,
            "mean_base_color_error_where_measured": self._sums["error"] / max(self._sums["measured"], 1.0),
            "dropped_transparent": int(self._sums["dropped"]),
            "raised_scales": int(self._sums["raised"]),
            "flags": self._flags,
            **self._changes,
        }


def write_report(out: Path, report: Mapping[str, Any]) -> None:
    """Write ``out/report.json`` whole or not at all."""
    write_json(out / "report.json", report)


def write_json(path: Path, content: Mapping[str, Any]) -> None:
    """Write a JSON file whole or not at all.

    Raises:
        OutputError: The file cannot be written; nothing is left behind.
    """
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        temporary.write_text(json.dumps(content, indent=2, allow_nan=False) + "\n", encoding="utf-8")
        temporary.replace(path)
    except OSError as error:
        temporary.unlink(missing_ok=True)
        raise OutputError(f"{path} must be writable, got {error.strerror}. Free space or choose another.") from error
