"""Tables of `docs/constants.md`: what every constant is, and what less and more of it do to the scores."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np
from constants_places import numbers_of, value_of
from constants_registry import GROUPS, SIDES, UNTUNED, Constant
from tables import Row, Rows, number, table

GPU, CPU = "constants_h200.json", "constants_cpu.json"

FILES = {group: CPU if group in ("meshing", "materials", "relighting") else GPU for group in GROUPS}
"""The result of every group."""

SCORES = {
    "psnr": ("new views [dB]", ".2f"),
    "photographs": ("photographs [dB]", ".2f"),
    "normals": ("normals [°]", ".2f"),
    "chamfer": ("surface [mm]", ".2f"),
    "drift": ("drift [mm]", ".2f"),
    "ambient_occlusion": ("AO [dB]", ".2f"),
    "base_color": ("base colour [dB]", ".2f"),
    "roughness": ("roughness [dB]", ".2f"),
    "relit": ("relit [dB]", ".2f"),
}
"""What scores are called, and how they are written."""

FLOORS = {"meshing": "reconstruction", "relighting": "materials"}
"""Groups without a seed of their own, and whose noise theirs is told by."""

CLEAR = 3.0
"""How many times its noise a change must be to be printed bold."""


@number("constants_measured", GPU, CPU)
def measured(gpu: Row, cpu: Row) -> str:
    """Return how many of the constants that are varied were measured."""
    varied = {c.place: FILES[group] for group, chosen in GROUPS.items() for c in chosen if not c.not_varied}
    found = {GPU: gpu["constants"], CPU: cpu["constants"]}
    return f"{sum(bool(found[file].get(place)) for place, file in varied.items())} of {len(varied)}"


def noise(results: Sequence[Row], group: str, capture: int, score: str) -> float:
    """Return the standard deviation of the difference of two runs that differ by seeds alone; NaN if unknown.

    Args:
        results: The group's result, then that of the group which tells its noise, if that is another.
        group: Name of a group of constants.
        capture: Number of a capture.
        score: Name of a score.
    """
    seeds = results[-1]["seeds"].get(FLOORS.get(group, group), {}).values()
    values = [row[score][capture] for row in seeds if score in row]
    return math.sqrt(2.0) * float(np.std(values, ddof=1)) if len(values) > 1 else math.nan


def change(results: Sequence[Row], group: str, capture: int, row: Row | None) -> str:
    """Return how scores differ from the unchanged ones: bold where it is `CLEAR` of the noise."""
    if row is None or "failed" in row:
        return "" if row is None else f"fails: {row['failed'].partition(':')[0]}"
    parts = []
    for score in (key for key in row if key != "tried"):
        values = row[score]
        difference = values[capture] - results[0]["seeds"][group]["0"][score][capture]
        text = f"{difference:+{SCORES[score][1]}}".replace("-", "−")
        parts.append(f"**{text}**" if abs(difference) > CLEAR * noise(results, group, capture, score) else text)
    return " / ".join(parts)


def written(*values: Any) -> str:
    """Return values as pages have them."""
    return ", ".join(f"{number:.4g}" for number in numbers_of(values))


def constant_rows(*results: Row, group: str) -> Rows:
    """Return two rows for every constant of a group that was varied: with less of it, and with more.

    A row that says what was tried keeps it when the constant's value changes.
    """
    result = results[0]
    rows: list[list[str]] = [["constant", "value", "chosen on", "tried", *result["captures"]]]
    for constant in GROUPS[group]:
        if constant.not_varied:
            continue
        found = result["constants"].get(constant.place, {})
        for side, named in zip(SIDES, (_named(constant), [""] * 3), strict=True):
            now = [constant.tried(side, value_of(place)) for place in constant.places]
            tried = written(*found.get(side, {}).get("tried", now))
            changes = [change(results, group, i, found.get(side)) for i in range(len(result["captures"]))]
            rows.append([*named, tried, *changes])
    return rows


def _named(constant: Constant) -> list[str]:
    """Return what a constant is and does, its value, and what it was chosen on."""
    value = written(*map(value_of, constant.places))
    return [f"{where(constant)}<br>{constant.does}", value, constant.chosen_on]


def where(constant: Constant) -> str:
    """Return a constant's name and module, linked to its file."""
    module = constant.place.partition(":")[0]
    path = module.replace(".", "/").replace("beam_warp/kernels/", "kernels/", 1)
    return f"`{constant.name}` [{path.removeprefix('beam_warp/')}](../{path}.py)"


def fixed_rows(result: Row) -> Rows:
    """Return a row for every constant that was chosen and is not varied here."""
    chosen = [constant for group in GROUPS.values() for constant in group if constant.not_varied]
    head = ["constant", "value", "chosen on", "why it is not varied"]
    return [head, *([*_named(constant), constant.not_varied] for constant in chosen)]


def floor_rows(gpu: Row, cpu: Row) -> Rows:
    """Return the unchanged scores of every group, and their noise."""
    rows: list[list[Any]] = [["part", "score", *gpu["captures"]]]
    found = {GPU: gpu, CPU: cpu}
    for group in GROUPS:
        results = [found[file] for file in files_of(group)]
        for score, values in results[0]["seeds"].get(group, {}).get("0", {}).items():
            label, form = SCORES[score]
            cells = [f"{value:{form}} ± {noise(results, group, i, score):.3f}" for i, value in enumerate(values)]
            rows.append([group, label, *cells])
    return rows


def files_of(group: str) -> list[str]:
    """Return the result of a group, and that which tells its noise if it is another."""
    return list(dict.fromkeys((FILES[group], FILES[FLOORS.get(group, group)])))


def untuned_rows(result: Row) -> Rows:
    """Return the numbers that nobody tuned, by why they are what they are."""
    rows = [["why", "numbers"]]
    for reason, text in UNTUNED.items():
        lines = [line.strip().partition(": ") for line in text.split("\n") if line.strip()]
        rows.append([reason, "; ".join(f"{holder.removeprefix('beam_warp.')}: {names}" for holder, _, names in lines)])
    return rows


for _group in GROUPS:
    table(f"constants_{_group.replace(' ', '_')}", *files_of(_group))(partial(constant_rows, group=_group))
table("constants_fixed", GPU)(fixed_rows)
table("constants_noise", GPU, CPU)(floor_rows)
table("constants_untuned", GPU)(untuned_rows)
