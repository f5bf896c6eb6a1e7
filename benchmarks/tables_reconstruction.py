"""Tables and figure of the pages on reconstruction and tracking, from `reconstruction.py` and `steady_take.py`."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import materials_plot
from record import PICTURES
from tables import Row, Rows, cell, figure, number, table

MAIN = "reconstruction_h200.json"
LARGE = "reconstruction_large_h200.json"
CHOICES = "reconstruction_choices_h200.json"
CAMERAS = "reconstruction_cameras_h200.json"
STRIDES = "reconstruction_strides_h200.json"
WALK, WITH_CASE = "steady_walk_h200.json", "steady_case_h200.json"
EXPOSURES = "exposures_cpu.json"
STATUE = "statue_h200.json"

MEASURES: tuple[tuple[str, Callable[[Row], float]], ...] = (
    ("PSNR of novel views, in the box [dB]", lambda row: row["psnr"]),
    ("normals, median error [°]", lambda row: row["normals_median_degrees"]),
    ("Chamfer distance [mm]", lambda row: row["surface"]["chamfer_mm"]),
)
"""Curves drawn over either sweep: a title and the value."""


@table("reconstruction_captures", MAIN)
def captures(main: Row) -> Rows:
    """Return scores of every frame with truth, and seconds."""
    head = ["", "PSNR, box [dB]", "whole", "SSIM, box", "normals", "Chamfer [mm]", "drift [mm]", "seconds"]
    return [head, *(_scores(label, row, seconds) for label, row, seconds in _scored_frames(main))]


@table("results_reconstruction", MAIN)
def results(main: Row) -> Rows:
    """Return the same in fewer columns."""
    head = ["", "novel views, PSNR in the box / of whole images", "normals, median error", "mesh to truth", "seconds"]
    return [
        head,
        *(
            [
                label,
                f"{row['psnr']:.1f} / {row['whole_psnr']:.1f} dB",
                f"{row['normals_median_degrees']:.1f}°",
                f"{row['surface']['chamfer_mm']:.1f} mm",
                cell(seconds, ".1f"),
            ]
            for label, row, seconds in _scored_frames(main)
        ),
    ]


def _scored_frames(main: Row) -> Iterator[tuple[str, Row, Row]]:
    """Yield a label, the row and the seconds of every frame with truth of every capture."""
    for part in main["captures"]["rows"]:
        name = part["name"]
        first, *others = [row for row in part["frames"] if "psnr" in row]
        yield f"{name}, frame {first['frame']}", first, part["first_seconds"]
        for row in others:
            yield f"{name}, tracked to frame {row['frame']}", row, part["tracked_seconds"]


def _scores(label: str, row: Row, seconds: Row) -> list[str]:
    drift = row["drift"]["vertices"]["mean_mm"]
    return [
        label,
        f"{row['psnr']:.2f}",
        f"{row['whole_psnr']:.2f}",
        f"{row['ssim']:.3f}",
        f"{row['normals_median_degrees']:.2f}°",
        f"{row['surface']['chamfer_mm']:.2f}",
        f"{drift:.2f}" if drift else "",
        cell(seconds, ".1f"),
    ]


@table("reconstruction_drawn", MAIN)
def drawn(main: Row) -> Rows:
    """Return what first frames score when they are drawn as they were fitted, and as splat viewers draw."""
    rows = []
    for part in main["captures"]["rows"]:
        side = part["frames"][0]["samples"]
        found = (part["drawn"][f"{way}_{samples}"] for samples in SAMPLES for way in ("fitted", "classic"))
        rows.append([f"{part['name']}, {side} × {side} samples in the fit", *(f"{value:.1f} dB" for value in found)])
    heads = (f"{way}, {samples}" for samples in SAMPLES.values() for way in ("as fitted", "classically"))
    return [["", *heads], *rows]


SAMPLES = {"samples_of_fit": "samples of the fit", "one_sample": "one sample a pixel"}


@table("reconstruction_rade", CHOICES)
def rade(choices: Row) -> Rows:
    """Return RaDe-GS's choices, made ours one by one."""
    rows = [*choices["rade"]["rows"][:-1], *choices.get("rade_long", {}).get("rows", ()), choices["rade"]["rows"][-1]]
    return _trial_rows("our code with", rows)


@table("reconstruction_variants", CHOICES)
def variants(choices: Row) -> Rows:
    """Return 3DGS's way of drawing, made ours one by one."""
    return _trial_rows("choices, added one by one", choices["variants"]["rows"])


@table("reconstruction_cameras", CAMERAS)
def few_cameras(sweep: Row) -> Rows:
    """Return fits to some of the cameras, opacities kept and reset."""
    rows = sweep["cameras"]["rows"]
    head = ["cameras"]
    head += [
        f"{title}: opacities {name}" for title in ("PSNR, box [dB]", "normals, mean", "Chamfer [mm]") for name in WAYS
    ]
    body: list[list[Any]] = []
    for count in sorted({row["cameras"] for row in rows}):
        found = {row["name"]: row for row in rows if row["cameras"] == count}
        body.append(
            [
                f"{count}",
                *(f"{found[name]['psnr']:.2f}" for name in WAYS),
                *(f"{found[name]['normals_mean_degrees']:.1f}°" for name in WAYS),
                *(f"{found[name]['surface']['chamfer_mm']:.2f}" for name in WAYS),
            ]
        )
    return [head, *body]


WAYS = ("kept", "reset")


def _trial_rows(title: str, rows: Sequence[Row]) -> Rows:
    found: list[list[Any]] = [
        [title, "Gaussians", "steps", "samples", "PSNR, box [dB]", "with 4 × 4 samples", "normals", "Chamfer [mm]"]
    ]
    for row in rows:
        side = row["samples"]
        scores = (f"{row['psnr']:.2f}", f"{row['fine_psnr']:.2f}", f"{row['normals_median_degrees']:.2f}°")
        chamfer = f"{row['surface']['chamfer_mm']:.2f}"
        found.append([row["name"], f"{row['gaussians']:,}", f"{row['steps']:,}", f"{side} × {side}", *scores, chamfer])
    return found


@table("reconstruction_large", LARGE)
def large(main: Row) -> Rows:
    """Return time, scores and memory of frames at full resolution."""
    heads = (
        "steps",
        "seconds",
        "PSNR, box [dB]",
        "device, peak [MiB]",
        "host [MiB]",
        "host, free memory returned [MiB]",
    )
    found: list[list[Any]] = [["", *heads]]
    for row in main["large"]["frames"]:
        memory = [row.get("peak_device_bytes"), row["host_bytes"], row["host_bytes_after_trim"]]
        found.append(
            [
                "first frame" if row["name"] == "0" else f"tracked frame {row['name']}",
                row["steps"],
                f"{row['seconds']:.1f}",
                cell(row.get("psnr"), ".1f"),
                *(cell(value, ",.0f", factor=2.0**-20) for value in memory),
            ]
        )
    return found


@table("tracking_strides", STRIDES)
def strides(result: Row) -> Rows:
    """Return how frames follow that are farther and farther apart, with and without silhouettes."""
    heads = ("p95", "largest", "begun with", "lost", "training views [dB]", "novel views [dB]", "drift", "p95")
    found: list[list[Any]] = [["one frame of", "silhouettes", *heads]]
    for row in sorted(result["strides"]["rows"], key=lambda row: row["stride"]):
        tracked, last = row["frames"][1:], row["frames"][-1]
        drift = last["drift"]["vertices"]
        found.append(
            [
                f"{row['stride']}",
                row["silhouettes"],
                *(f"{row['pixels'][key]:.0f} px" for key in ("p95", "largest")),
                ", ".join(dict.fromkeys(frame["start"] for frame in tracked)),
                f"{sum(bool(frame['lost']) for frame in tracked)} of {len(tracked)}",
                f"{last['training_psnr']:.1f}",
                cell(last["psnr"], ".1f"),
                *(f"{drift[key]:.1f} mm" for key in ("mean_mm", "p95_mm")),
            ]
        )
    return found


@table("tracking_take", WALK, WITH_CASE)
def take(walk: Row, with_case: Row) -> Rows:
    """Return how frames of a second hold: drift since the key frame, scores, and what was lost."""
    heads = ("lost", "drift", "in pixels", "95 % below", "novel views [dB]", "occlusion [dB]", "base colour [dB]")
    found: list[list[Any]] = [["", "frame", *heads]]
    for words, part in (("walk", walk["walk"]), ("with a case", with_case["case"])):
        frames, pixel = part["frames"], part["pixel_mm"]["median"]
        last = len(frames) - 1
        for index in (0, 1, last // 3, 2 * last // 3, last):
            row = frames[index]
            drift = row["drift"]["vertices"]
            lengths = (f"{drift['mean_mm']:.1f} mm", f"{drift['mean_mm'] / pixel:.2f}", f"{drift['p95_mm']:.1f} mm")
            found.append(
                [
                    words,
                    f"{row['frame']}",
                    f"{sum(bool(entry['lost']) for entry in frames[: index + 1])}",
                    *(("", "", "") if row["kind"] == "key" else lengths),
                    *(f"{row[channel]:.1f}" for channel in ("novel_view", "ambient_occlusion", "base_color")),
                ]
            )
    return found


@table("tracking_flicker", WALK, WITH_CASE)
def flicker(walk: Row, with_case: Row) -> Rows:
    """Return the flicker of both channels over a second, per Gaussian and at points of the surface."""
    heads = ("per Gaussian", "95 % below", "at points of the surface", "95 % below", "the truth there", "error there")
    found: list[list[Any]] = [["", "", *heads]]
    for words, scores in (("walk", walk["walk"]["temporal"]), ("with a case", with_case["case"]["temporal"])):
        for channel, prefix in (("base colour", ""), ("ambient occlusion", "occlusion_")):
            gaussians, surface = scores[f"{prefix}gaussians"], scores[f"{prefix}surface"]
            cells = [None if gaussians is None else gaussians[key] for key in ("mean", "p95")]
            cells += [surface["ours"]["mean"], surface["ours"]["p95"], surface["truth"]["mean"], surface["error"]]
            found.append([words, channel, *(cell(value, ".4f") for value in cells)])
    return found


@number("frames_tracked", MAIN)
def frames_tracked(main: Row) -> int:
    """Return the number of tracked frames of all captures."""
    return sum(len(part["frames"]) - 1 for part in main["captures"]["rows"])


@number("frames_lost", MAIN)
def frames_lost(main: Row) -> int:
    """Return the number of those that were lost."""
    return sum(bool(row["lost"]) for part in main["captures"]["rows"] for row in part["frames"])


@number("host_growth", LARGE)
def host_growth(main: Row) -> float:
    """Return what a tracked frame adds to the host's memory, after the first two [byte]."""
    held = [row["host_bytes_after_trim"] for row in main["large"]["frames"][2:]]
    return (held[-1] - held[0]) / (len(held) - 1)


@table("exposures", EXPOSURES)
def exposures(result: Row) -> Rows:
    """Return the exposures found over all captures, by the number of cameras."""
    rows = result["rows"]
    errors = list(rows[0]["errors"])
    found: list[list[Any]] = [
        ["cameras", "sound", *(f"one at {float(stops):+g}" for stops in errors), "others", "blamed"]
    ]
    for count in sorted({row["cameras"] for row in rows}, reverse=True):
        same = [row for row in rows if row["cameras"] == count]
        cells = []
        for stops in errors:
            parts = [row["errors"][stops] for row in same]
            low, high = min(part["lowest"] for part in parts), max(part["highest"] for part in parts)
            reported, cases = (sum(part[key] for part in parts) for key in ("found", "cases"))
            cells.append(f"{low:.2f} to {high:.2f}, {reported} of {cases} reported")
        ends = [max(row[key] for row in same) for key in ("sound", "others")]
        right = len(same) * (count + len(errors) * count * (count - 1))  # views that were compared as they are
        blamed = f"{sum(row['blamed'] for row in same)} of {right:,}"
        found.append([f"{count}", f"{ends[0]:.2f}", *cells, f"{ends[1]:.2f}", blamed])
    return found


@table("statue", STATUE)
def statue(result: Row) -> Rows:
    """Return how far each photograph is met that was left out."""
    head = ["left out", "PSNR [dB]", "matched [dB]", "red, green, blue", "covered", "exposures matched"]
    return [
        head,
        *(
            [
                row["photograph"],
                f"{row['psnr']:.1f}",
                f"{row['matched']:.1f}",
                ", ".join(f"{gain:.2f}" for gain in row["gains"]),
                f"{100.0 * row['covered']:.0f} %",
                "yes" if row["matched_cameras"] else "no",
            ]
            for row in result["rows"]
        ),
    ]


@figure("statue.webp", STATUE)
def draw_statue(_: Row, path: Path) -> None:
    """Show each photograph that was left out beside what the others show."""
    materials_plot.draw_sheet(PICTURES / "statue.png", path)


@figure("reconstruction.webp", MAIN, CHOICES, CAMERAS)
def draw(main: Row, choices: Row, sweep: Row, path: Path) -> None:
    """Draw quality over Gaussians and over cameras, and drift over frames."""
    from matplotlib import pyplot as plt

    ours = choices["rade"]["rows"][-1]
    picture, panels = plt.subplots(2, 4, figsize=(18, 8), layout="constrained")
    curves = {"gaussians": {"in the box": [*choices["gaussians"]["rows"], ours]}, "cameras": {}}
    for name in WAYS:
        curves["cameras"][f"opacities {name}"] = [row for row in sweep["cameras"]["rows"] if row["name"] == name]
    for panel, (across, drawn_rows) in zip(panels, curves.items(), strict=True):
        for label, found in drawn_rows.items():
            rows = sorted(found, key=lambda entry: entry[across])
            for axes, (title, value) in zip(panel, MEASURES, strict=False):
                axes.plot([row[across] for row in rows], [value(row) for row in rows], "o-", label=label)
                axes.set(title=title, xlabel=across)
        panel[0].legend()
    for axes in panels[:, 1:3].flat:
        axes.set_ylim(0.0, None)
    for axes in panels[0, :3]:
        axes.set_xscale("log")
        counts = sorted({entry["gaussians"] for entry in [*choices["gaussians"]["rows"], ours]})
        axes.set_xticks(counts, [f"{count / 1000:g}k" for count in counts])
        axes.set_xticks([], minor=True)
    for part in main["captures"]["rows"]:
        name = part["name"]
        frames = [row["frame"] for row in part["frames"]]
        panels[0, 3].plot(frames, [row["drift"]["vertices"]["mean_mm"] for row in part["frames"]], "o-", label=name)
        panels[1, 3].plot(frames, [row["training_psnr"] for row in part["frames"]], "o-", label=name)
    panels[0, 3].set(title="drift per vertex of the true surface, mean [mm]", xlabel="frame", ylim=(0.0, None))
    panels[1, 3].set(title="PSNR of the training views' crops [dB]", xlabel="frame")
    for axes in panels[:, 3]:
        axes.xaxis.get_major_locator().set_params(integer=True)
        axes.legend()
    for axes in panels.flat:
        axes.grid(True, which="both", alpha=0.25)
    picture.savefig(path, dpi=90)
    plt.close(picture)
