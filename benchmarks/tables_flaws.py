"""Table of the flaws of captures and what they cost, from the results of `flaws.py`."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from tables import Row, Rows, table

from beam_warp.stability.flaws.write import FLAWS

WORDS = {"clean": "nothing", "flawed": "exposure, noise, masks, poses and light at once"}
TIMES = {0.5: "half of it", 1.0: "", 2.0: "twice that"}
IMAGES = ("ambient_occlusion", "base_color_scaled", "relit_scaled", "novel_view")


Key = tuple[str, str, float]
"""Capture, name of the flaw, size."""


@table("flaws_studio", "flaws_studio_h200.json")
def studio(result: Row) -> Rows:
    """Return the scores of clean captures, and of those with all of a studio's flaws."""
    return scores([row for row in result["rows"] if row["case"]["flaw"] in ("clean", "flawed")])


def scores(found: Sequence[Row]) -> Rows:
    """Return a row for every flaw and size of every capture, means over seeds: the clean ones first, then the worst."""
    head = ["what is wrong", "ambient occlusion", "base colour, scaled", "its scale", "relit, scaled", "novel views"]
    head += ["normals", "depth [mm]", "roughness", "named"]
    return [head, *(_cells(label, rows) for label, rows in _groups(found))]


@table("flaws_alone", "flaws_studio_h200.json", "flaws_vignetting_h200.json", "flaws_alone_h200.json")
def alone(together: Row, lenses: Row, result: Row) -> Rows:
    """Return the scores of clean captures, and of those with one flaw of a studio's or of its lenses."""
    clean = [row for row in together["rows"] if row["case"]["flaw"] == "clean"]
    return scores([*clean, *lenses["rows"], *result["rows"]])


@table("flaws_others", "flaws_h200.json", "flaws_alone_h200.json")
def others(result: Row, newer: Row) -> Rows:
    """Return the scores of clean captures and of those with flaws that were not measured since."""
    known = {"flawed", *(row["case"]["flaw"] for row in newer["rows"])}
    return scores([row for row in result["rows"] if row["case"]["flaw"] not in known])


@table("flaws_mended", "flaws_studio_h200.json")
def mended(result: Row) -> Rows:
    """Return what is left of the flaws of rigs after their correction, beside what was there, means over seeds."""
    keys = ("pose_pixels", "pose_mm")
    head = ["what is wrong", "poses before [pixel]", "after", "places before [mm]", "after"]
    head += ["exposure left [%]", "white balance left [%]"]
    rows: list[list[Any]] = [head]
    for label, found in _groups(result["rows"]):
        cells = [f"{_mean(found, 'recovered', key + end):.2g}" for key in keys for end in ("_injected", "")]
        left = [f"{100 * _mean(found, 'recovered', key):.2g}" for key in ("exposure_error", "white_balance_error")]
        if found[0]["case"]["flaw"] == "flawed":
            rows.append([label, *cells, *left])
    return rows


@table("flaws_recovered", "flaws_studio_h200.json", "flaws_vignetting_h200.json")
def recovered(result: Row, lenses: Row) -> Rows:
    """Return what the job makes of the light and of exposures, how honest stated errors are, and seconds."""
    head = ["what is wrong", "light made brighter [stop]", "should be", "largest exposure found [stop]", "injected"]
    head += ["vignetting undone [power]", "injected"]
    head += ["base colour within 1, 2 stated errors", "but for its scale", "roughness", "seconds"]
    return [head, *(_recovered(label, rows) for label, rows in _groups([*result["rows"], *lenses["rows"]]))]


@table("flaws_named", "flaws_named_cpu.json")
def named(result: Row) -> Rows:
    """Return what is said of each flaw, and in how many runs, of each capture."""
    captures = list(dict.fromkeys(row["case"]["capture"] for row in result["rows"]))
    by_flaw: dict[tuple[str, float], dict[str, list[Row]]] = {}
    for row in result["rows"]:
        case = row["case"]
        by_flaw.setdefault((case["flaw"], case["size"]), {}).setdefault(case["capture"], []).append(row)
    body = [
        [_words(*key), *(_named(rows[name]) or "nothing" if name in rows else "" for name in captures)]
        for key, rows in by_flaw.items()
    ]
    return [["what is wrong", *captures], *body]


def _words(flaw: str, size: float) -> str:
    """Return what is wrong, in words."""
    *others, last = flaw.split("+")
    words = WORDS.get(flaw) or (f"{', '.join(others)} and {last} at once" if others else FLAWS[last])
    return ", ".join(filter(None, (words, TIMES.get(size, f"times {size:g}"))))


def _groups(found: Sequence[Row]) -> Iterator[tuple[str, list[Row]]]:
    """Yield the runs of each flaw under its words, in the order of the tables."""
    groups: dict[Key, list[Row]] = {}
    for row in found:
        case = row["case"]
        groups.setdefault((case["capture"], case["flaw"], case["size"]), []).append(row)
    captures = list(dict.fromkeys(capture for capture, *_ in groups))
    for key in sorted(groups, key=lambda key: (captures.index(key[0]), key[1] != "clean", _quality(groups[key]))):
        capture, name, size = key
        yield ", ".join(filter(None, (capture if len(captures) > 1 else "", _words(name, size)))), groups[key]


def _recovered(label: str, rows: Sequence[Row]) -> list[str]:
    """Return the cells of a flaw in the second table."""
    found = [row for row in rows if "scores" in row]
    if not found:
        return [label, *[""] * 10]
    keys = ("light_stops", "exposure_spread", "falloff")
    stops, spread, falloff = (_mean(found, "recovered", key) for key in keys)
    should, injected, true_falloff = (_mean(found, "recovered", f"{key}_injected") for key in keys)

    def within(name: str) -> str:
        if any(name not in row["errors"] for row in found):
            return ""
        return ", ".join(f"{100 * _mean(found, 'errors', name, f'within_{count}'):.0f} %" for count in (1, 2))

    cells = [label, f"{stops:+.2f}", f"{0.0 - should:+.2f}", f"{spread:.2f}", f"{injected:.2f}"]
    cells += [f"{abs(falloff):.1f}", f"{true_falloff:.1f}"]
    return [
        *cells,
        *map(within, ("base_color", "base_color_scaled", "roughness")),
        f"{_mean(found, 'seconds', 'run'):.0f}",
    ]


def _cells(label: str, rows: Sequence[Row]) -> list[str]:
    """Return the cells of a flaw."""
    found = [row["scores"] for row in rows if "scores" in row]
    if not found:
        return [label, "refused: " + re.sub(r"/\S*/capture/", "capture/", rows[0]["refused"]), *[""] * 8]

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
