"""Words and numbers about a reconstruction: the report of a job, its warnings, and lines of progress."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

DRIFT_WARNING = 3.0
"""Loss of PSNR from a key frame to a tracked frame above which a warning is given [dB]."""


def sequence_facts(frames: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return what the reports of all frames come to, JSON-able: segments, mean and lowest PSNR, and the reports."""
    measured = [entry for entry in frames if entry.get("psnr") is not None]
    lowest = min(measured, key=lambda entry: entry["psnr"], default=None)
    return {
        "segments": sorted({entry["segment"] for entry in frames}),
        "mean_psnr": float(np.mean([entry["psnr"] for entry in measured])) if measured else None,
        "lowest_psnr": None if lowest is None else {"frame": lowest["frame"], "psnr": lowest["psnr"]},
        "frames": list(frames),
    }


def frame_line(report: Mapping[str, Any]) -> str:
    """Return the line of progress about a finished frame, given its report."""
    kind = f"lost ({report['lost']}), fitted anew" if report["lost"] else f"{report['kind']} frame"
    return f"frame {report['frame']}: " + ", ".join([kind, *known_numbers(report)])


def known_numbers(facts: Mapping[str, Any]) -> list[str]:
    """Return PSNR and the number of Gaussians in words, as far as they are known."""
    psnr, count = facts.get("psnr"), facts.get("gaussians")
    return ([] if psnr is None else [f"{psnr:.2f} dB"]) + ([] if count is None else [f"{int(count):,} Gaussians"])


def warnings_of(frames: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return what a user should know about the frames, given their reports."""
    found = [
        f"tracking was lost at frame {entry['frame']} ({entry['lost']}): it is a key frame of a new segment, and "
        "identities do not persist across it"
        for entry in frames
        if entry["lost"]
    ]
    found += _finding_warnings(frames)
    key_psnr = {entry["segment"]: entry.get("psnr") for entry in frames if entry["kind"] == "key"}
    falls = [
        (key_psnr[entry["segment"]] - entry["psnr"], entry["frame"])
        for entry in frames
        if entry.get("psnr") is not None and key_psnr.get(entry["segment"]) is not None
    ]
    fall, frame = max(falls, default=(0.0, 0))
    if fall > DRIFT_WARNING:
        found.append(
            f"frame {frame} is {fall:.1f} dB below its key frame, the most of {len(frames)} frames: shorter segments "
            "bound the drift; see --segment-length"
        )
    return found


def _finding_warnings(frames: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return one warning for each kind of finding; lost tracking has a warning of its own."""
    by_code: dict[str, list[tuple[int, Mapping[str, Any]]]] = {}
    for entry in frames:
        for finding in entry["findings"]:
            if not entry["lost"] or finding["what"] != f"tracking is lost: {entry['lost']}":
                by_code.setdefault(finding["code"], []).append((entry["frame"], finding))
    return [
        f"frame {rows[0][0]}: {rows[0][1]['what']}"
        + (f" ({rows[0][1]['where']})" if rows[0][1]["where"] else "")
        + (f"; so in {len({frame for frame, _ in rows})} of {len(frames)} frames" if len(rows) > 1 else "")
        for rows in by_code.values()
    ]
