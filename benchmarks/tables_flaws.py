"""Table of the flaws of captures and what they cost, from the results of `flaws.py`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from tables import Row, Rows, table

from beam_warp.stability.flaws.write import FLAWS

WORDS = {"clean": "nothing", "flawed": "exposure, noise, masks, poses and light at once"}
TIMES = {0.5: "half of it", 1.0: "", 2.0: "twice that"}
IMAGES = ("ambient_occlusion", "base_color_scaled", "relit_scaled", "novel_view")


@table("flaws", "flaws_cpu.json")
def flaws(result: Row) -> Rows:
    """Return a row for every flaw and size of every capture, means over seeds: the clean ones first, then the worst."""
    groups: dict[tuple[str, str, float], list[Row]] = {}
    for row in result["rows"]:
        case = row["case"]
        groups.setdefault((case["capture"], case["flaw"], case["size"]), []).append(row)
    captures = list(dict.fromkeys(capture for capture, *_ in groups))
    ordered = sorted(groups, key=lambda key: (captures.index(key[0]), key[1] != "clean", _quality(groups[key])))
    head = ["what is wrong", "ambient occlusion", "base colour, scaled", "its scale", "relit, scaled", "novel views"]
    head += ["normals", "depth [mm]", "roughness", "named"]
    return [head, *(_cells(key, groups[key], len(captures) > 1) for key in ordered)]


def _cells(key: tuple[str, str, float], rows: Sequence[Row], several: bool) -> list[str]:
    """Return the cells of a flaw."""
    capture, name, size = key
    words = WORDS.get(name) or "; ".join(FLAWS[part] for part in name.split("+"))
    label = ", ".join(filter(None, [capture if several else "", words, TIMES.get(size, f"times {size:g}")]))
    found = [row["scores"] for row in rows if "scores" in row]
    if not found:
        return [label, f"refused: {rows[0]['refused']}", *[""] * 8]

    def image(channel: str) -> str:
        return f"{_mean(found, channel, 'psnr'):.1f} dB / {_mean(found, channel, 'ssim'):.3f}"

    occlusion, color, relit, novel = map(image, IMAGES)
    scale = np.mean([score["base_color_scale"] for score in found])
    normals, depth = (_mean(found, key) for key in ("normals_median_degrees", "depth_median_mm"))
    geometry = [f"{normals:.1f}°", f"{depth:.1f}", f"{_mean(found, 'roughness', 'psnr'):.1f} dB"]
    return [label, occlusion, color, f"{scale:.2f}", relit, novel, *geometry, _named(rows)]


def _mean(scores: Sequence[Row], *path: str) -> float:
    """Return the mean over runs of a score."""

    def value(score: Any) -> Any:
        for key in path:
            score = score[key]
        return score

    return float(np.mean([value(score) for score in scores]))


def _quality(rows: Sequence[Row]) -> float:
    """Return the mean PSNR by which rows are ordered; what was refused comes first."""
    found = [row["scores"] for row in rows if "scores" in row]
    return float(np.mean([_mean(found, channel, "psnr") for channel in IMAGES])) if found else -np.inf


def _named(rows: Sequence[Row]) -> str:
    """Return which flaws were named, and in how many runs, and the codes of other findings."""
    counts = {flaw: sum(row["named"][flaw] for row in rows) for flaw in rows[0]["named"]}
    runs = f" in {{}} of {len(rows)} runs" if len(rows) > 1 else ""
    named = [flaw + runs.format(count) for flaw, count in counts.items() if count]
    beside = dict.fromkeys(words.partition(" ")[0] for row in rows for words in row["beside"])
    return ", ".join([*named, *(f"also `{code}`" for code in beside)]) or ("" if not counts else "nothing")
