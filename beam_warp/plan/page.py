"""HTML page of how far a plan is: stages, failures, and every frame with its times, its worker and its preview."""

from __future__ import annotations

import os
from collections.abc import Iterable
from html import escape
from pathlib import Path

from beam_warp.outputs import replacing
from beam_warp.plan.standing import Standing
from beam_warp.plan.steps import Step

STYLE = """
body { font: 15px/1.45 system-ui, sans-serif; margin: 1.2em auto; max-width: 1200px; padding: 0 1em; color: #222; }
table { border-collapse: collapse; margin: 1em 0; } th, td { padding: 0.2em 0.8em; text-align: right; }
th { border-bottom: 1px solid #999; } td:first-child, th:first-child { text-align: left; }
.bar { width: 12em; background: #e4e7eb; } .bar div { background: #3b7dbf; height: 0.8em; }
.failed { color: #b3261e; } .running { color: #1a6e35; }
.frames { display: grid; grid-template-columns: repeat(auto-fill, minmax(210px, 1fr)); gap: 0.8em; }
figure { margin: 0; border: 1px solid #ddd; border-radius: 4px; padding: 0.4em; font-size: 0.85em; }
figure img { width: 100%; }
"""


def write_page(standing: Standing, path: Path) -> None:
    """Write one HTML file, which names previews by their place beside it.

    Raises:
        OutputError: The file cannot be written.
    """
    frames: dict[int, list[Step]] = {}
    for step in standing.steps:
        if step.frame is not None:
            frames.setdefault(step.frame, []).append(step)
    body = [
        f"<h1>{escape(left_in_words(standing))}</h1>",
        _stages(standing),
        _list("failed", (f"{name}: {words[-1]}" for name, words in standing.errors.items())),
        _list("running", (f"{name}: {who}, {in_words(age)}" for name, (who, age) in standing.running.items())),
        '<div class="frames">',
        *(_frame(standing, frame, steps, path.parent) for frame, steps in sorted(frames.items())),
        "</div>",
    ]
    head = f'<!doctype html><html lang="en"><meta charset="utf-8"><title>Plan</title><style>{STYLE}</style>'
    with replacing(path) as temporary:
        temporary.write_text("\n".join([head, *body]) + "\n", encoding="utf-8")


def _stages(standing: Standing) -> str:
    rows = [
        f"<tr><td>{escape(stage)}<td>{found.done:,} / {found.total:,}"
        f'<td class="bar"><div style="width: {100.0 * found.done / max(found.total, 1):.1f}%"></div>'
        f"<td>{found.running}<td>{found.given_up}<td>{in_words(found.seconds)}</tr>"
        for stage, found in standing.stages.items()
    ]
    return "<table><tr><th>stage<th>done<th><th>running<th>failed<th>each</tr>" + "\n".join(rows) + "</table>"


def _list(kind: str, lines: Iterable[str]) -> str:
    items = "\n".join(f"<li>{escape(line)}</li>" for line in lines)
    return f'<ul class="{kind}">{items}</ul>' if items else ""


def _frame(standing: Standing, frame: int, steps: list[Step], beside: Path) -> str:
    """Return the figure of a frame."""
    picture, lines = "", []
    for step in steps:
        receipt = standing.receipts.get(step.name)
        if receipt is None:
            word = (
                "failed" if step.name in standing.given_up else "running" if step.name in standing.running else "open"
            )
            lines.append(f'<span class="{word}">{escape(step.stage)}: {word}</span>')
            continue
        lines.append(f"{escape(step.stage)}: {in_words(receipt.seconds)}, {escape(receipt.worker)}")
        lines += [escape(str(receipt.facts["line"]))] if "line" in receipt.facts else []
        for name in receipt.outputs:
            if name.endswith(".png"):
                place = Path(os.path.relpath(standing.folders[step.stage] / name, beside)).as_posix()
                picture = f'<img loading="lazy" src="{escape(place)}" alt="frame {frame}">'
    return f"<figure>{picture}<figcaption><b>frame {frame}</b><br>{'<br>'.join(lines)}</figcaption></figure>"


def left_in_words(standing: Standing, workers: int | None = None) -> str:
    """Return in a line what is left of a plan and how long it will take."""
    count, left = workers or standing.workers, len(standing.steps) - len(standing.receipts)
    if left == 0:
        return f"all {len(standing.steps):,} steps are done"
    seconds = standing.seconds_left(workers)
    time = "not known before a step of each stage is done" if seconds is None else f"about {in_words(seconds)}"
    who = f"{count} worker{'s'[: count > 1]}" + ("" if standing.is_live or workers else ", who do not work now")
    return f"{left:,} of {len(standing.steps):,} steps are left: {time} with {who}"


def in_words(seconds: float | None) -> str:
    """Return a time in words."""
    if seconds is None:
        return ""
    if seconds < 90.0:
        return f"{seconds:.1f} s"
    return f"{seconds / 60.0:.0f} min" if seconds < 5400.0 else f"{seconds / 3600.0:.1f} h"
