"""Tables, numbers and figures of materials."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import materials_plot
import numpy as np
from record import PICTURES
from tables import Row, Rows, cell, figure, table

EVALUATION = "materials_evaluation_h200.json"
ROUGHNESS = "materials_roughness_h200.json"
ABLATION = "materials_ablation_h200.json"
PERFECT = "materials_perfect_h200.json"
COST = "materials_cost_h200.json"


def ways(result: Row) -> Iterator[tuple[str, Row]]:
    """Yield every reconstruction, with the way it was decomposed in, and its scores."""
    for name, capture in result["evaluation"]["captures"].items():
        for way, row in capture["ways"].items():
            if "mean" in row:
                yield f"{name}, {way}", row


def both(score: Row) -> str:
    """Return PSNR and SSIM."""
    return f"{score['psnr']:.2f} / {score['ssim']:.3f}"


def triple(values: Sequence[float]) -> str:
    """Return three factors, without a zero in front of the point."""
    return " ".join(f"{value:.3f}" for value in values)


@table("materials_quality", EVALUATION)
def quality(result: Row) -> Rows:
    """Scores of decomposed reconstructions: PSNR [dB] and SSIM in the box."""
    rows: list[Sequence[Any]] = [
        ("", "ambient occlusion", "base colour", "its best scale, R G B", "roughness", "normals, median", "flicker")
    ]
    for name, row in ways(result):
        mean, steady = row["mean"], row["temporal"]["gaussians"]
        rows.append(
            (
                name,
                *(both(mean[channel]) for channel in ("ambient_occlusion", "base_color")),
                triple(row["base_color_scale"]),
                both(mean["roughness"]),
                f"{mean['normals_median_degrees']:.1f}°",
                None if steady is None else f"{steady['mean']:.4f}",
            )
        )
    return rows


@table("materials_relit", EVALUATION)
def relit(result: Row) -> Rows:
    """Scores of decomposed reconstructions under other lights, by both renderers."""
    rows: list[Sequence[Any]] = [("", "light", "deferred", "path traced")]
    for name, row in ways(result):
        found = row["mean"]["relit"]
        rows += [(name, light, both(found["deferred"][light]), both(found["path"][light])) for light in found["path"]]
    return rows


@table("results_materials", EVALUATION)
def results(result: Row) -> Rows:
    """PSNR alone, relit by the mean over lights."""
    rows: list[Sequence[Any]] = [
        ("PSNR [dB]", "ambient occlusion", "base colour", "roughness", "relit, deferred", "relit, path traced")
    ]
    for name, row in ways(result):
        mean = row["mean"]
        channels = [mean[channel] for channel in ("ambient_occlusion", "base_color", "roughness")]
        channels += [mean["relit_mean"][renderer] for renderer in ("deferred", "path")]
        rows.append((name, *(f"{score['psnr']:.1f}" for score in channels)))
    return rows


def compared(result: Row, groups: Sequence[str]) -> Rows:
    """Return occlusion, base colour and its scale of rows of the ablation, a column a capture."""
    captures = result["ablation"]["captures"]
    first = next(iter(captures.values()))["rows"]
    rows: list[Sequence[Any]] = [("AO [dB], base colour [dB], scale", *captures)]
    for place, named in enumerate(first):
        if named["group"] in groups:
            label = named["name"] if len(groups) == 1 else f"{named['group']}: {named['name']}"
            rows.append((label, *(_three(capture["rows"][place]) for capture in captures.values())))
    return rows


def _three(row: Row) -> str | None:
    if "base_color" not in row:
        return None
    color = row["base_color"]
    return f"{row['ambient_occlusion']['psnr']:.2f}, {color['psnr']:.2f}, {np.mean(color['scale']):.3f}"


@table("materials_ladder", ABLATION)
def ladder(result: Row) -> Rows:
    """The way from the paper's recipe to ours, one idea after the other."""
    return compared(result, ["ladder"])


@table("materials_alone", ABLATION)
def alone(result: Row) -> Rows:
    """Ours without each idea, and the image path with other settings."""
    return compared(result, ["one idea taken away", "image path"])


@table("materials_perfect", PERFECT)
def perfect(result: Row) -> Rows:
    """Materials on the true surface with the truth's coverage: PSNR [dB] of occlusion and base colour."""
    captures = result["perfect"]["captures"]
    rows: list[Sequence[Any]] = [("AO [dB], base colour [dB]", *captures)]
    for place, named in enumerate(next(iter(captures.values()))["rows"]):
        found = [capture["rows"][place] for capture in captures.values()]
        scores = [[row[k]["true_coverage_psnr"] for k in ("ambient_occlusion", "base_color")] for row in found]
        rows.append((named["name"], *(f"{first:.1f}, {second:.1f}" for first, second in scores)))
    return rows


@table("materials_light", PERFECT)
def light(result: Row) -> Rows:
    """Errors of irradiance of the default and of independent cosine rays, in per cent."""
    captures = result["perfect"]["captures"]
    rows: list[Sequence[Any]] = [("light", *(f"{name}: {what}" for name in captures for what in _LIGHT_ERRORS))]
    for name in next(iter(captures.values()))["irradiance"]:
        found = [capture["irradiance"][name]["ways"] for capture in captures.values()]
        errors = [ways[way][key] for ways in found for way, key in _LIGHT_ERRORS.values()]
        rows.append((name, *(f"{100.0 * error:.{0 if error > 0.1 else 1}f} %" for error in errors)))
    return rows


_LIGHT_ERRORS: Mapping[str, tuple[str, str]] = {
    "at each point": ("product, ratio, Owen", "relative_rmse"),
    "of the mean": ("product, ratio, Owen", "rmse_over_mean"),
    "independent cosine rays, at each point": ("cosine, iid", "relative_rmse"),
}


@table("materials_cost", COST)
def cost(result: Row) -> Rows:
    """Seconds and memory of one frame at the paper's scale."""
    part = result["cost"]
    width, height = part["scene"]["size"]
    rows: list[Sequence[Any]] = [
        (f"one frame, {part['scene']['gaussians']:,} Gaussians", f"views of {width} × {height}", "s", "device GiB")
    ]
    for name, row in part.items():
        if isinstance(row, Mapping) and "stages" in row:
            peak = row.get("peak_device_bytes")
            memory = None if peak is None else f"{peak / 2**30:.1f}"
            rows.append((name, str(row["views"]), cell(row["seconds"], ".2f"), memory))
    return rows


@table("materials_roughness", ROUGHNESS)
def roughness(result: Row) -> Rows:
    """Roughness of one frame and of all, the best constant, and whether stated errors hold."""
    rows: list[Sequence[Any]] = [
        ("", "PSNR / SSIM", "best constant", "median \\|z\\|", "within 1 σ", "2 σ", "informed", "stated", "mean error")
    ]
    for name, capture in result["roughness"]["captures"].items():
        constant = capture["best_constant"]
        for place, row in enumerate(capture["rows"]):
            rows.append(
                (
                    f"{name}, {row['frames']} frame{'s' if row['frames'] > 1 else ''}",
                    both(row),
                    None if place else f"{both(constant)} ({constant['roughness']:.2g})",
                    f"{row['median_z']:.2f}",
                    *(f"{100.0 * row[key]:.0f} %" for key in ("within_1", "within_2", "informed")),
                    f"{row['median_stated_error']:.2f}",
                    f"{row['mean_error']:+.2f}",
                )
            )
    return rows


@table("light_check", "light_check_cpu.json")
def light_check(result: Row) -> Rows:
    """How many of the subjects' wrong lights were told; the others were met by silence."""
    rows = [["stated light", "told"]]
    for name, found in result["summary"]["found"].items():
        kind, _, amount = name.rpartition(" ")
        unit = " stops" if kind == "exposed" else "°"
        rows.append([f"{kind} by {amount.replace('-', '−')}{unit}", f"{found['found']} of {found['lights']}"])
    return rows


@table("geometry_budget", "geometry_budget_h200.json")
def geometry_budget(result: Row) -> Rows:
    """Return the drawn occlusion of every combination of true and found places, normals and occluders, by capture."""
    captures = _in_order(result["captures"])
    return [
        ["ambient occlusion [dB]", *captures],
        *(
            [row, *(f"{found['rows'][row]['psnr']:.1f}" for found in captures.values())]
            for row in captures["robot"]["rows"]
        ),
    ]


@table("geometry_places", "geometry_budget_h200.json")
def geometry_places(result: Row) -> Rows:
    """Return shares, signed distances and angles of the pixels beside each kind of edge, by capture."""
    kinds = ("flat", "beside a crease", "beside a ridge", "beside a ledge")
    rows: Rows = [
        ["", "of all pixels", "distance to the true surface [mm]: tenth, median, ninetieth", "normals: median, mean"]
    ]
    for name, found in _in_order(result["captures"]).items():
        for kind in kinds:
            place = found["places"][kind]
            signed = ", ".join(f"{value:+.1f}" for value in place["signed_mm"])
            middle, _, mean = place["normal_degrees"]
            rows.append([f"{name}, {kind}", f"{100 * place['share']:.0f} %", signed, f"{middle:.1f}°, {mean:.1f}°"])
    return rows


def _in_order(captures: Row) -> Row:
    """Return captures in the order of the other tables, however they were asked for."""
    return {name: captures[name] for name in ("walker", "runner", "robot") if name in captures}


@table("light_turn", "light_turn_cpu.json")
def light_turn(result: Row) -> Rows:
    """Errors of turns in both halves of the points, and scales by highlights of each roughness."""
    rows: Rows = []
    for name, found in result["captures"].items():
        turns, highlights = found["turns"], found["highlights"]
        rows = rows or [
            ["", "light as measured", "worst of all stated turns", "turned, as measured"]
            + ["turned by 8°", "other places told"]
            + [f"scale at roughness {roughness}" for roughness in highlights]
        ]

        def applied(least: float, most: float, turns: Any = turns) -> str:
            some = [turn["applied"] for turn in turns if least <= abs(turn["stated"]) <= most]
            return f"{sum(some)} of {len(some)}"

        right = [turn for turn in turns if turn["stated"] == 0.0]
        elsewhere = [place for place in found["places"].values() if not place["is_right"]]
        told = sum(place["said"] == ["environment-unexplained"] for place in elsewhere)
        rows.append(
            [
                name,
                ", ".join(f"{turn['error']:+.1f}° ± {turn['standard_error']:.1f}°" for turn in right),
                f"{max((turn['error'] for turn in turns), key=abs):+.1f}°",
                applied(0.0, 0.0),
                applied(8.0, 8.0),
                f"{told} of {len(elsewhere)}",
                *(f"{scale['scale']:.2f} ± {scale['standard_error']:.2f}" for scale in highlights.values()),
            ]
        )
    return rows


@figure("materials_perfect.webp", PERFECT)
def draw_perfect(result: Row, path: Path) -> None:
    """Draw `perfect` and `light`, with every way to sample."""
    materials_plot.draw_perfect(result["perfect"], path)


@figure("materials_ablation.webp", ABLATION)
def draw_ablation(result: Row, path: Path) -> None:
    """Draw `ladder` and `alone`."""
    materials_plot.draw_ablation(result["ablation"], path)


@figure("materials_cost.webp", COST)
def draw_cost(result: Row, path: Path) -> None:
    """Draw `cost`, stage by stage."""
    materials_plot.draw_cost(result["cost"], path)


@figure("materials_runner.webp", EVALUATION)
def draw_runner(result: Row, path: Path) -> None:
    """Show the runner's materials beside the truth."""
    materials_plot.draw_sheet(PICTURES / "materials_runner.png", path)
