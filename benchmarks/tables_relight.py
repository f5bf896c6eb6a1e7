"""Tables, numbers and figures of relighting."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import relight_plot
from record import PICTURES
from tables import Row, Rows, cell, figure, table

SPEED = "relight_speed_h200.json"
ACCURACY = "relight_accuracy_h200.json"
ENERGY = "relight_energy_h200.json"
LOBE = "specular_lobe_cpu.json"
EVALUATION = "materials_evaluation_h200.json"

USUAL = "N = 16"


def rate(times: Row) -> str:
    """Return milliseconds and frames per second."""
    return f"{cell(times['ms'], '.2f')} ms, {cell(times['fps']['median'], ',.0f')} FPS"


def percent(share: float) -> str:
    """Return a share in per cent."""
    return f"{100.0 * share:.0f} %"


def described(part: Row) -> str:
    """Return what was drawn, in words."""
    covered = next(iter(part["cases"].values()))["covered"]
    width, height = part["size"]
    return f"{part['gaussians']:,} Gaussians, {width} × {height}, {percent(covered)} covered"


@table("relight_deferred", SPEED)
def deferred(result: Row) -> Rows:
    """Deferred frames: all redrawn, the camera moved only, and new geometry in every frame."""
    part, moving = result["deferred"], result["moving"]
    rows: list[Sequence[Any]] = [
        (described(part), "everything redrawn", "camera moved only", "Gaussians moved", "hierarchy refitted", "rebuilt")
    ]
    for name, row in part["cases"].items():
        moved = moving["cases"][name]
        times = (row["whole"], row["still_maps"], row["moving"], moved["refit"], moved["fast"])
        rows.append((name, *(rate(each) for each in times)))
    return rows


@table("specular_lobe", LOBE)
def specular_lobe(result: Row) -> Rows:
    """What four round lobes leave of the specular one, and what one leaves."""
    cosines = sorted({row["cosine"] for row in result["left"]})
    rows: list[Sequence[Any]] = [("roughness", *(f"cosine {cosine:.2f}" for cosine in cosines))]
    for roughness in sorted({row["roughness"] for row in result["left"]}):
        found = {row["cosine"]: row for row in result["left"] if row["roughness"] == roughness}
        cells = (
            f"{100.0 * row['four']:.0f} / {percent(row['one'])}; {row['four_mean']:.3f} / {row['one_mean']:.3f}"
            for row in (found[cosine] for cosine in cosines)
        )
        rows.append((f"{roughness:.1f}", *cells))
    return rows


@table("relight_path", SPEED)
def path(result: Row) -> Rows:
    """Samples a second of the path tracer: those that meet the subject, and all."""
    part = result["path"]
    rows: list[Sequence[Any]] = [
        (
            f"{part['gaussians']:,} Gaussians, {part['bounces']} bounces",
            "million covered samples a second",
            "million samples a second, empty pixels included",
            "covered",
        )
    ]
    for name, row in part["cases"].items():
        rates = [cell(row[key], factor=1e-6) for key in ("covered_samples_per_second", "samples_per_second")]
        rows.append((name, *rates, percent(row["covered"])))
    return rows


@table("relight_accuracy", ACCURACY)
def accuracy(result: Row) -> Rows:
    """Scores and times of every way, where geometry and materials are true."""
    rows: list[Sequence[Any]] = [("", "light", "way", "PSNR / SSIM", "true coverage [dB]", "against path traced [dB]")]
    for name, subject in result["accuracy"]["subjects"].items():
        for light, found in subject["lights"].items():
            for row in shown(found["rows"]):
                other = row["against_path"]
                rows.append(
                    (
                        name,
                        light,
                        f"{row['method']}, {row['setting']}",
                        f"{row['psnr']:.2f} / {row['ssim']:.3f}",
                        f"{row['true_coverage_psnr']:.2f}",
                        None if other is None else f"{other['psnr']:.2f}",
                    )
                )
    return rows


def shown(rows: Sequence[Row]) -> list[Row]:
    """Return the ways that tables show: deferred without shadow maps and with the usual ones, most paths."""
    most = max((row for row in rows if row["method"] == "path traced"), key=lambda r: int(r["setting"].split()[0]))
    plain = [row for row in rows if row["setting"] in ("N = 0", USUAL)]
    return [*plain, most]


@table("relight_samples", ACCURACY)
def samples(result: Row) -> Rows:
    """PSNR of the path tracer by samples of a pixel."""
    subjects = result["accuracy"]["subjects"]
    traced = {
        f"{name}, {light}": {row["setting"]: row["psnr"] for row in found["rows"] if row["method"] == "path traced"}
        for name, subject in subjects.items()
        for light, found in subject["lights"].items()
    }
    levels = list(dict.fromkeys(setting for found in traced.values() for setting in found))
    rows = [
        [name, *(f"{found[level]:.2f}" if level in found else None for level in levels)]
        for name, found in traced.items()
    ]
    return [["PSNR [dB]", *levels], *rows]


@table("relight_furnace", ENERGY)
def furnace(result: Row) -> Rows:
    """Mean error of white surfaces under radiance 1."""
    found: dict[str, list[Row]] = {}
    for row in result["furnace"]["rows"]:
        found.setdefault(f"{row['shape']}, {row['renderer']}", []).append(row)
    head = ("roughness", *(f"{row['roughness']:g}" for row in next(iter(found.values()))))
    errors = [(name, *(f"{100.0 * row['mean_error']:+.2f} %" for row in rows)) for name, rows in found.items()]
    return [head, *errors]


@table("relight_consistent", ENERGY)
def consistent(result: Row) -> Rows:
    """Images of few samples against images of many, by the same tracer."""
    part = result["consistent"]
    few, more = part["samples"]
    return [
        (f"{part['seeds'][0]} images of {few} samples against {part['seeds'][1]} of {more}", "found", "by chance"),
        ("mean z of the pixels, in its standard errors", f"{part['mean_in_standard_errors']:+.2f}", "0 ± 1"),
        ("root mean square of z", f"{part['root_mean_square']:.3f}", "1"),
        ("largest \\|z\\|", f"{part['largest']:.2f}", f"{part['largest_by_chance']:.2f}"),
        (
            "sum over the image",
            f"{100.0 * part['relative_bias']:+.3f} %",
            f"0 ± {100.0 * part['relative_bias_standard_error']:.3f} %",
        ),
    ]


@table("results_relight_speed", SPEED)
def results_speed(result: Row) -> Rows:
    """What a frame costs: a synthetic ball, one sample a pixel."""
    part, traced = result["deferred"], result["path"]
    rows: list[Sequence[Any]] = [(f"a ball of {described(part)}", "everything redrawn", "camera moved only")]
    rows += [(f"deferred, {name}", rate(row["whole"]), rate(row["still_maps"])) for name, row in part["cases"].items()]
    sky = next(iter(traced["cases"].values()))
    covered = cell(sky["covered_samples_per_second"], factor=1e-6)
    rows.append((f"path traced, {traced['bounces']} bounces", f"{covered} million covered samples a second", None))
    return rows


@table("results_relight_accuracy", ACCURACY, EVALUATION)
def results_accuracy(true: Row, evaluated: Row) -> Rows:
    """How near relit images come: PSNR [dB] with true materials, and of decomposed captures."""
    paths = evaluated["evaluation"]["paths"]
    rows: list[Sequence[Any]] = []
    for name, subject in true["accuracy"]["subjects"].items():
        capture = evaluated["evaluation"]["captures"].get(name)
        for light, found in subject["lights"].items():
            usual, most = shown(found["rows"])[-2:]
            scores = [usual["psnr"], most["psnr"]]
            if capture is not None:
                relit = capture["ways"]["direct"]["mean"]["relit"]
                scores += [relit[way][light]["psnr"] for way in ("deferred", "path")]
            rows.append([name, light, *(f"{score:.1f}" for score in scores), *("",) * (4 - len(scores))])
    true_ways = (f"true materials: {way['method']}, {way['setting']}" for way in (usual, most))
    return [
        ("PSNR [dB]", "light", *true_ways, f"decomposed: deferred, {USUAL}", f"path traced, {paths} samples"),
        *rows,
    ]


@figure("relight_comparison.webp", ACCURACY)
def draw_comparison(result: Row, path: Path) -> None:
    """Show deferred, path traced and truth of every capture."""
    subjects = result["accuracy"]["subjects"]
    chosen = {name: row for name, row in subjects.items() if name != "demo figure"}
    relight_plot.draw_comparison(chosen, PICTURES / "relight.npz", path)
