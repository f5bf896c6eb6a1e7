"""What pages say of rays: speed and error of tracing, builds, growth, the main job, CPU against CUDA, and the demo."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from tables import Row, Rows, cell, figure, number, table
from tracing_plot import draw_growth

FIRST_LIGHT = "normals", "exposure", "materials", "solve"
"""Stages of the main job that find materials; the others read, write and draw."""

SCORES = {
    "ambient_occlusion": "ambient occlusion",
    "base_color": "base colour",
    "relit_studio": "relit by the light of the capture",
    "relit_sunset": "relit by a sunset",
    "relit_stage": "relit by two stage lights",
}


def device_of(result: Row) -> str:
    """Return the device that a result is of; times on the CPU are of one thread."""
    machine = result["measured"]["machine"]
    return machine["device"] if machine["device"] != "cpu" else f"one CPU core ({machine['processor']})"


def contender_name(name: str) -> str:
    """Return a contender as a table names it."""
    scene, _, acceptance = name.rpartition(" ")
    words = {"product": "exact", "bernoulli": "Bernoulli"}
    fast = ", fast build" if scene == "wide fast" else ""
    return f"ours, {words[acceptance]}{fast}" if acceptance in words else name.replace("wp.Bvh", "`wp.Bvh`")


def ratio(entry: Row, name: str) -> str:
    """Return how many times faster, nothing where it was not measured."""
    return cell(entry.get(name), ".2f")


@table("tracing_speed", "tracing_h200.json", "tracing_cpu.json")
def tracing_speed(gpu: Row, cpu: Row) -> Rows:
    """Every contender of the torus on both devices."""
    ratios = ["× the fastest `wp.Bvh`", "largest error"]
    rows: list[list[Any]] = [["", f"{device_of(gpu)} [Mray/s]", *ratios, f"{device_of(cpu)}: × Embree 4", *ratios]]
    tables = gpu["torus"]["contenders"], cpu["torus"]["contenders"]
    for name in dict.fromkeys([*tables[0], *tables[1]]):
        on_gpu, on_cpu = (found.get(name, {}) for found in tables)
        rows.append(
            [
                contender_name(name),
                cell(on_gpu.get("mray_per_second")),
                *(ratio(on_gpu, "over_wp_bvh"), cell(on_gpu.get("largest_error"), ".1e")),
                *(ratio(on_cpu, "over_embree"), ratio(on_cpu, "over_wp_bvh")),
                cell(on_cpu.get("largest_error"), ".1e"),
            ]
        )
    return rows


@table("tracing_builds", "tracing_h200.json")
def tracing_builds(result: Row) -> Rows:
    """Builds and updates, and the closest surface."""
    builds, surface = result["builds"], result["closest_surface"]
    rows: list[list[Any]] = [[f"{builds['gaussians']:,} Gaussians", device_of(result)]]
    rows += [[f"{_code(name)} [ms]", value] for name, value in builds["milliseconds"].items()]
    covered = f"closest surface, camera rays, {100.0 * surface['covered']:.0f} % covered [Mray/s]"
    rows.append([covered, surface["mray_per_second"]])
    rows.append(["memory, everything that a scene holds [bytes a Gaussian]", builds["bytes_per_gaussian"]["wide"]])
    return rows


def _code(name: str) -> str:
    """Return the first word, a name of Python, as code."""
    first, _, rest = name.partition(" ")
    return f"`{first}`, {rest.removeprefix('wide').strip() or 'quality'}"


@table("tracing_embree", "tracing_cpu.json")
def tracing_embree(result: Row) -> Rows:
    """How many times faster than Embree, by the number of Gaussians."""
    rows: list[list[Any]] = [[f"Gaussians, {device_of(result)}", "× Embree 4", "× the faster `wp.Bvh`"]]
    for row in result["growth"]:
        ours = row["contenders"]["wide product"]
        rows.append([f"{row['gaussians']:,}", ratio(ours, "over_embree"), ratio(ours, "over_wp_bvh")])
    return rows


@number("tracing_overlap_cost", "tracing_h200.json")
def tracing_overlap_cost(result: Row) -> float:
    """How many times as long a ray takes at twice the overlap."""
    return _nanoseconds(result, 2.0) / _nanoseconds(result, 1.0)


def _nanoseconds(result: Row, overlap: float) -> float:
    """Return the median time of a ray of the sweep over overlaps."""
    count = result["builds"]["gaussians"]
    (row,) = (
        row for row in result["growth"] if (row["gaussians"], row["overlap"], row["opacity"]) == (count, overlap, 0.9)
    )
    return row["contenders"]["wide product"]["nanoseconds_per_ray"]["median"]


@figure("tracing_growth_h200.webp", "tracing_h200.json")
def tracing_growth(result: Row, path: Path) -> None:
    """Draw the growth rows."""
    draw_growth(dict(result), path)


@table("tracing_parity", "parity_h200.json")
def tracing_parity(result: Row) -> Rows:
    """CPU against CUDA, stage by stage."""
    names = ("visibility", "ambient_occlusion", "alpha", "depth", "base_color", "relit")
    rows: list[list[Any]] = [[f"CPU against {device_of(result)}", "largest difference", "99.9 % are within"]]
    for name in names:
        found = result[name]
        rows.append([name.replace("_", " ").replace("color", "colour"), found["largest"], found["p99.9"]])
    return rows


@table("results_tracing", "tracing_h200.json", "tracing_cpu.json")
def results_tracing(gpu: Row, cpu: Row) -> Rows:
    """Speed of rays and of builds in a few rows."""
    strongest = gpu["torus"]["strongest_wp_bvh"]
    rows: list[list[Any]] = [
        ["", device_of(gpu), f"× the fastest loop over `wp.Bvh` ({strongest[7:]})", f"{device_of(cpu)}: × Embree 4"]
    ]
    for name in ("wide product", "wide bernoulli"):
        here, there = (result["torus"]["contenders"][name] for result in (gpu, cpu))
        rate = f"{cell(here['mray_per_second'])} Mray/s"
        rows.append([contender_name(name), rate, ratio(here, "over_wp_bvh"), ratio(there, "over_embree")])
    times = gpu["builds"]["milliseconds"]
    surface = f"{cell(gpu['closest_surface']['mray_per_second'])} Mray/s"
    rows.append(["closest surface, camera rays", surface, "", ""])
    rows.append(["rebuild for moved Gaussians", f"{cell(times['Scene.move wide fast'])} ms", "", ""])
    rows.append(["refit for moved Gaussians", f"{cell(times['Scene.move wide refit'])} ms", "", ""])
    return rows


@table("results_first_light", "first_light_h200.json", "first_light_cpu.json")
def results_first_light(gpu: Row, cpu: Row) -> Rows:
    """The main job on both devices; times only of the one that is not shared."""
    runs, rays = (gpu["run"], cpu["run"]), (gpu["rays"], cpu["rays"])
    on_device = f"{runs[0]['peak_memory_mib']:,} MiB (+ {runs[0]['device_memory_mib']:,} MiB on the device)"
    return [
        [f"{runs[0]['gaussians']:,} Gaussians", gpu["measured"]["machine"]["device"], _cores(cpu)],
        ["whole job, from files to files", f"{cell(runs[0]['seconds_with_reading'])} s", ""],
        ["of which normals, exposure, occlusion and base colour", *(f"{100.0 * _share(run):.0f} %" for run in runs)],
        ["occlusion rays", f"{cell(rays[0]['mray_per_second'])} million a second", ""],
        ["peak memory of the process", on_device, f"{runs[1]['peak_memory_mib']:,} MiB"],
        [
            f"occlusion error of {gpu['samples']} rays against 4,096, RMS",
            *(each["ambient_occlusion_rmse"] for each in rays),
        ],
        ["visibility error against float64, largest", *(each["visibility_largest_error"] for each in rays)],
    ]


def _cores(result: Row) -> str:
    """Return a CPU in words, without times: they are of a machine that others use too."""
    return f"{result['measured']['machine']['processor']}, shared"


def _share(run: Row) -> float:
    """Return the part of the main job in which materials are found."""
    seconds = run["seconds"]
    return sum(seconds[name]["median"] for name in FIRST_LIGHT) / seconds["total"]["median"]


@number("first_light_overstated", "first_light_h200.json")
def first_light_overstated(result: Row) -> float:
    """How many times the error that ambient occlusion states is its error."""
    return result["rays"]["stated_standard_error_rms"] / result["rays"]["ambient_occlusion_rmse"]


@table("results_demo", "demo_h200.json")
def results_demo(result: Row) -> Rows:
    """Scores of both halves of the demo: PSNR of solid pixels and of the box, SSIM there."""
    halves: tuple[Mapping[str, Any], ...] = (result["scores"], result["from_images"]["relightable"])
    rows: list[list[Any]] = [["PSNR of solid pixels / of the box, SSIM there", "from Gaussians", "from images"]]
    for name, title in SCORES.items():
        found = (half[name] for half in halves)
        rows.append([title, *(f"{s['solid_psnr']:.1f} / {s['psnr']:.1f} dB, {s['ssim']:.3f}" for s in found)])
    images = result["from_images"]
    last, drift = images["frames"][-1], images["drift"][-1]["vertices"]["mean_mm"]
    chamfer = last["surface"]["chamfer_mm"]
    angles = halves[0]["normals_median_error_degrees"], last["normals_median_degrees"]
    rows.append(["median error of normals", *(f"{angle:.1f} degrees" for angle in angles)])
    factors = [half["base_color_scale"] for half in halves]
    rows.append(["factors that fit base colour best", *(" ".join(f"{x:.3f}" for x in each) for each in factors)])
    rows.append(["novel views of the last frame, PSNR in the box", "", f"{last['psnr']:.1f} dB"])
    rows.append(["its mesh and its tracked points off the truth, mean", "", f"{chamfer:.1f} / {drift:.1f} mm"])
    return rows
