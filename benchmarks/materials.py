"""How good decomposed materials are, what each idea brings, and what it costs at the paper's scale.

    python benchmarks/materials.py [--device cuda:0] [--data DIR] [--out results.json] [--parts PART ...] [--quick]

Parts: ``perfect`` decomposes Gaussians sampled from the true surface: occlusion, light at 64 rays on every HDRI, base
colour with and without the bounce; ``ablation`` decomposes reconstructions, from the paper's recipe to ours one idea at
a time, then without each idea alone, then the image path's own settings; ``cost`` times both paths on 140,000 Gaussians
and 81 views of 3840 x 2160 that lie in memory decoded, and how that grows. ``--quick`` is the demo's capture, small:
does all of it run?

Reconstructions are given with ``--assets NAME=PATH``, or made here (``--gaussians``). Writes the JSON after every row,
so that a kill loses little. ``--pictures DIR`` gets a strip of every row, occlusion and base colour of the first
test view; ``materials_plot.py`` draws all of it. A part that fails says so in its place; the program returns 1 then.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from device_memory import peak_memory
from materials_contenders import AblationRow, Subject, SubjectFrame, Unavailable, ablation_rows, seen_normals
from materials_cost import PAPER, Scale, measure_cost
from materials_truth import (
    SHARP,
    Materials,
    PerfectFrame,
    Row,
    TruthViews,
    light_errors,
    light_reference,
    row_of,
)
from reconstruction_contenders import follow, ours
from timing import commit, machine

from beam_warp import converters
from beam_warp.capture.capture import Capture
from beam_warp.demo.capture import write_demo_capture
from beam_warp.device.arrays import resolve_device
from beam_warp.evaluate.relighters import RELIGHTERS
from beam_warp.jobs.report import versions
from beam_warp.light.prepared import PreparedEnvironment
from beam_warp.materials.base_color import fill_from_neighbors, solve_base_color
from beam_warp.materials.direct import MaterialOptions, measure_materials
from beam_warp.raster.records import RasterOptions
from beam_warp.reconstruction.scores import truth_frames
from beam_warp.world.axes import change_axes
from beam_warp.world.environment import EnvironmentMap

PUBLISHED = {
    "BEAM, its own synthetic humans": {
        "ambient_occlusion": [25.32, 0.924],
        "base_color": [21.47, 0.906],
        "relit": [26.57, 0.895],
    }
}
"""PSNR [dB] and SSIM that the paper states; other data."""

TARGETS = {
    "perfect": {
        "ambient_occlusion_psnr": 40.0,
        "irradiance_relative_rmse": 0.035,
        "base_color_psnr_with_bounce": 35.0,
        "base_color_psnr_direct_only": [31.0, 33.0],
    },
    "reconstructed": {
        "ambient_occlusion": [30.0, 0.95],
        "base_color": [26.0, 0.93],
        "scale": [0.97, 1.03],
        "relit": [30.0, 0.94],
    },
}

LIGHTS = ("studio", "sunrise", "apartment", "night", "workshop")


@dataclass(frozen=True)
class Effort:
    """How much is measured.

    Attributes:
        perfect_gaussians: On the true surface.
        light_points: Points at which light is compared.
        light_rays: Rays that are judged.
        reference_rays: Rays that they are compared with.
        perfect_rays: Rays a Gaussian of the perfect geometry's materials.
        perfect_samples: Side of the square of samples of its drawn pixels.
        samples: The same of reconstructions.
        frames: Most frames of an ablation.
        high: Rays a pixel of the image path where there are many.
        adam_steps: Of the image path's other solver.
        scale: Of the cost.
        fitting: Changes of the reconstruction's defaults.
    """

    perfect_gaussians: int = 140_000
    light_points: int = 4096
    light_rays: int = 64
    reference_rays: int = 16_384
    perfect_rays: tuple[int, ...] = (64, 256)
    perfect_samples: int = 4
    samples: int = 2
    frames: int = 6
    high: int = 512
    adam_steps: int = 5000
    scale: Scale = field(default_factory=Scale)
    fitting: Any = None


FULL = Effort()

QUICK = Effort(
    perfect_gaussians=1500,
    light_points=32,
    light_rays=16,
    reference_rays=256,
    perfect_rays=(8,),
    perfect_samples=2,
    samples=1,
    frames=2,
    high=16,
    adam_steps=8,
    scale=Scale(
        gaussians=400,
        views=3,
        size=(48, 32),
        repeats=1,
        counts=(200, 400),
        view_counts=(1, 2),
        ray_counts=(8, 16),
        series_views=2,
    ),
    fitting={"color_iterations": 30, "normal_iterations": 30},
)


@dataclass(frozen=True)
class Bench:
    """What parts share.

    Attributes:
        captures: With truth, by name.
        lights: Environments by name.
        assets: Reconstructions by the name of their capture; what is missing is made.
        gaussians: Of those that are made.
        effort: How much is measured.
        device: Where.
        pictures: Folder of pictures; None for none.
        say: Hears what is being done.
    """

    captures: Mapping[str, Capture]
    lights: Mapping[str, EnvironmentMap]
    assets: Mapping[str, Path]
    gaussians: int
    effort: Effort
    device: Any
    pictures: Path | None
    say: Callable[[str], None]

    def light_of(self, capture: Capture) -> PreparedEnvironment:
        """Return the light of a capture, prepared."""
        assert capture.environment_path is not None
        return PreparedEnvironment(EnvironmentMap.read(capture.environment_path), self.device)

    def picture(self, truth: TruthViews, cloud: Any, found: Materials | None, *words: str) -> str | None:
        """Write a row's picture; returns its file's name."""
        if self.pictures is None:
            return None
        self.pictures.mkdir(parents=True, exist_ok=True)
        name = re.sub(r"[^a-z0-9]+", "_", " ".join(words).lower()).strip("_") + ".png"
        truth.picture(cloud, found, self.pictures / name)
        return name


def measure_perfect(bench: Bench) -> Iterator[Row]:
    """Yield what is known so far of materials on the true surface."""
    result: Row = {"targets": TARGETS["perfect"], "captures": {}}
    for name, capture in bench.captures.items():
        frame = truth_frames(capture)[0]
        started = time.perf_counter()
        perfect = PerfectFrame.of(capture, frame, bench.effort.perfect_gaussians, bench.device)
        bench.say(
            f"{name}: {len(perfect.cloud):,} Gaussians on the true surface, {time.perf_counter() - started:.1f} s"
        )
        row: Row = {"gaussians": len(perfect.cloud), "seen": float(perfect.evidence.seen.mean()), "rows": []}
        result["captures"][name] = row
        row["irradiance"] = perfect_light(bench, perfect)
        yield result
        truth = TruthViews(capture, frame, SHARP, bench.effort.perfect_samples, str(bench.device))
        row["truth_picture"] = bench.picture(truth, perfect.cloud, None, "perfect", name, "truth")
        for entry in perfect_materials(bench, perfect, truth, name):
            row["rows"].append(entry)
            bench.say(f"{name}, {entry['name']}: {row_of(entry)}")
            yield result
        row["reached"] = perfect_reached(row)
        yield result


def perfect_light(bench: Bench, perfect: PerfectFrame) -> Row:
    """Return errors of irradiance on every light: the default, and what each of its three ideas brings."""
    effort = bench.effort
    points = perfect.points()
    seen = np.flatnonzero(points.seen)
    rows = np.random.default_rng(0).permutation(seen)[: effort.light_points]
    found: Row = {}
    for name, environment in bench.lights.items():
        light = PreparedEnvironment(environment, bench.device)
        reference = light_reference(perfect.scene, points, rows, light, effort.reference_rays)
        mean = float(environment.radiance.mean())
        found[name] = {
            "points": len(rows),
            "rays": effort.light_rays,
            "reference_rays": effort.reference_rays,
            "peak_over_mean": float(environment.radiance.max()) / max(mean, 1e-12),
            "ways": {
                label: light_errors(perfect.scene, reference, light, sample_count=effort.light_rays, **how)
                for label, how in (
                    ("product, ratio, Owen", {}),
                    ("product, Owen", {"ratio": False}),
                    ("product, ratio, iid", {"sampler": "iid"}),
                    ("mis, ratio, Owen", {"density": "mis"}),
                    ("cosine, ratio, Owen", {"density": "cosine"}),
                    ("cosine, iid", {"density": "cosine", "ratio": False, "sampler": "iid"}),
                )
            },
        }
        default = found[name]["ways"]["product, ratio, Owen"]
        bench.say(
            f"light {name}: {default['relative_rmse']:.4f} at each point, {default['rmse_over_mean']:.4f} of the mean"
        )
    return found


def perfect_materials(bench: Bench, perfect: PerfectFrame, truth: TruthViews, name: str) -> Iterator[Row]:
    """Yield scores with and without the bounce, at the true points and at those that views show."""
    light = bench.light_of(perfect.capture)
    rough = {"0.5": np.full(len(perfect.cloud), 0.5, np.float32), "true": perfect.true_roughness(bench.device)}
    spread = perfect.images_spread_back()
    for row in perfect_rows(bench.effort.perfect_rays):
        points = perfect.points(row.offset, exact=row.exact)
        started = time.perf_counter()
        measured = measure_materials(
            perfect.cloud,
            perfect.scene,
            points,
            rough[row.roughness],
            light,
            options=MaterialOptions(bounce=row.bounce, sample_count=row.rays),
            views=perfect.evidence if row.observed == "difference" else spread,
        )
        solved = solve_base_color(
            perfect.cloud.with_arrays(normal_confidence=points.confidence), measured.evidence, light.mean_irradiance
        )
        seconds = time.perf_counter() - started
        openness, _ = fill_from_neighbors(
            perfect.cloud.positions,
            measured.ambient_occlusion[:, None],
            measured.ambient_occlusion_error[:, None],
            ~points.seen,
        )
        found = Materials(solved.base_color, openness[:, 0].astype(np.float32), rough[row.roughness])
        yield {
            "name": row.name,
            "points": "true" if row.exact else "seen",
            **{key: value for key, value in vars(row).items() if key != "exact"},
            "seconds": seconds,
            **truth.score(perfect.cloud, found),
            "picture": bench.picture(truth, perfect.cloud, found, "perfect", name, row.name),
        }


@dataclass(frozen=True)
class PerfectRow:
    """How materials on the true surface are measured: at its points or those that views show, and so on."""

    exact: bool = True
    roughness: str = "true"
    rays: int = 64
    bounce: bool = True
    offset: Any = "auto"
    observed: str = "difference"

    @property
    def name(self) -> str:
        """In tables."""
        words = [f"{'true' if self.exact else 'seen'} points", f"roughness {self.roughness}", f"{self.rays} rays"]
        words.append("with the bounce" if self.bounce else "direct only")
        if self.offset != "auto":
            words.append(f"offset {1000.0 * self.offset:g} mm")
        if self.observed != "difference":
            words.append("images spread back")
        return ", ".join(words)


def perfect_rows(rays: Sequence[int]) -> list[PerfectRow]:
    """Return what is measured on the true surface: the default with and without the bounce first."""
    default = PerfectRow(rays=rays[0])
    return [
        *(replace(row, bounce=bounce) for row in (default, replace(default, exact=False)) for bounce in (True, False)),
        replace(default, roughness="0.5"),
        replace(default, observed="images"),
        *(replace(default, offset=offset) for offset in (0.001, 0.002, 0.02)),
        *(replace(default, rays=count) for count in rays[1:]),
    ]


def perfect_reached(row: Row) -> Row:
    """Return which targets are met: with the truth's coverage, since silhouettes are the Gaussians'."""

    def first(bounce: bool) -> Row:
        return next(r for r in row["rows"] if r["bounce"] is bounce and r["points"] == "true")

    wanted = TARGETS["perfect"]
    direct_only = first(False)["base_color"]["true_coverage_psnr"]
    low, high = wanted["base_color_psnr_direct_only"]
    # Phrased so that NaN fails.
    return {
        "ambient_occlusion": bool(
            first(True)["ambient_occlusion"]["true_coverage_psnr"] >= wanted["ambient_occlusion_psnr"]
        ),
        **{
            f"irradiance, {measure}": {
                name: bool(light["ways"]["product, ratio, Owen"][measure] <= wanted["irradiance_relative_rmse"])
                for name, light in row["irradiance"].items()
            }
            for measure in ("relative_rmse", "rmse_over_mean")
        },
        "base_color_with_bounce": bool(
            first(True)["base_color"]["true_coverage_psnr"] >= wanted["base_color_psnr_with_bounce"]
        ),
        "direct_only_lands_where_expected": bool(low <= direct_only <= high),
    }


def measure_ablation(bench: Bench) -> Iterator[Row]:
    """Yield the ablation so far of every reconstruction."""
    result: Row = {"targets": TARGETS["reconstructed"], "published": PUBLISHED, "captures": {}}
    rows = ablation_rows(high=bench.effort.high, steps=bench.effort.adam_steps)
    for name, capture in bench.captures.items():
        subject, made = reconstruction(bench, name, capture)
        truth = TruthViews(capture, subject.frames[0].number, subject.raster, bench.effort.samples, str(bench.device))
        part: Row = {
            **made,
            "gaussians": len(subject.frames[0].cloud),
            "frames": [frame.number for frame in subject.frames],
            "truth_picture": bench.picture(truth, subject.frames[0].cloud, None, "ablation", name, "truth"),
            "rows": [],
        }
        result["captures"][name] = part
        warm, normals = subject.small(), seen_normals(subject)
        for row in rows:
            entry = {"group": row.group, "name": row.name, **measure_row(row, subject, warm, truth, normals)}
            if "found" in entry:
                found = entry.pop("found")
                entry["picture"] = bench.picture(
                    truth, subject.frames[0].cloud, found, "ablation", name, row.group, row.name
                )
                bench.say(f"{name}, {row.group}, {row.name}: {row_of(entry)}, {entry['seconds']:.2f} s")
            else:
                bench.say(f"{name}, {row.group}, {row.name}: {entry.get('unavailable') or entry.get('failed')}")
            part["rows"].append(entry)
            yield result


def measure_row(row: AblationRow, subject: Subject, warm: Subject, truth: TruthViews, normals: Any) -> Row:
    """Return scores, seconds by stage and memory of a row; why not, where it cannot be run.

    Rows of the ladder are relit too; ``normals`` are for those that bring none.
    """
    try:
        row.warm(warm)  # compiles what this row is the first to need
        with peak_memory(subject.device) as memory:
            done = row.method(subject)
    except Unavailable as error:
        return {"unavailable": str(error)}
    except Exception:
        return {"failed": traceback.format_exc()}
    cloud = subject.frames[0].cloud
    scores = truth.score(cloud, done.materials)
    if row.group == "ladder":
        found = done.materials if done.materials.normals is not None else replace(done.materials, normals=normals)
        scores["relit"] = {name: truth.score_relit(cloud, found, make) for name, make in RELIGHTERS.items()}
    return {
        "seconds": sum(done.seconds.values()),
        "seconds_per_frame": sum(done.seconds.values()) / done.frames,
        "stages": done.seconds,
        "frames": done.frames,
        "notes": list(done.notes),
        **memory,
        **scores,
        "found": done.materials,
    }


def reconstruction(bench: Bench, name: str, capture: Capture) -> tuple[Subject, Row]:
    """Return a reconstruction that was given, or make one."""
    light = bench.light_of(capture)
    limit = bench.effort.frames
    if name in bench.assets:
        sequence = converters.read(bench.assets[name])
        stated = sequence.metadata.get("capture_frames", "").split()
        numbers = [int(word) for word in stated] or list(capture.frames[: len(sequence)])
        chosen = list(range(min(len(sequence), limit)))
        clouds = [change_axes(sequence[index], "rfu") for index in chosen]
        raster = RasterOptions.from_metadata(sequence.metadata)
        made: Row = {"asset": str(bench.assets[name])}
        numbers = [numbers[index] for index in chosen]
    else:
        contender = ours(bench.gaussians, str(bench.device), **(bench.effort.fitting or {}))
        numbers = list(capture.frames[:limit])
        modelled = list(follow(contender, capture, numbers, bench.device, bench.say))
        clouds = [change_axes(frame.cloud, "rfu") for frame in modelled]
        raster = contender.options or RasterOptions()
        made = {"reconstruction_seconds": [frame.seconds for frame in modelled]}
    frames = [
        SubjectFrame(number, cloud, [r.view() for r in capture.select(split="train", frames=[number])])
        for number, cloud in zip(numbers, clouds, strict=True)
    ]
    kept = [frame for frame in frames if len(frame.cloud) == len(frames[0].cloud)]
    return Subject(name, kept, raster, light, bench.device), made


def measure_scale(bench: Bench) -> Iterator[Row]:
    """Yield what it costs so far."""
    capture = next(iter(bench.captures.values()))
    result: Row = {"paper": PAPER, "parts": {}}
    for name, part in measure_cost(capture, bench.light_of(capture), bench.effort.scale, bench.device, bench.say):
        result["parts"][name] = part
        yield result


PARTS: dict[str, Callable[[Bench], Iterator[Row]]] = {
    "perfect": measure_perfect,
    "cost": measure_scale,
    "ablation": measure_ablation,
}


def measure(bench: Bench, *, only: Sequence[str] = (), keep: Callable[[Row], None] = lambda result: None) -> Row:
    """Run the parts; a part that fails says so in its place, beside what it had found.

    Args:
        bench: What they share.
        only: These parts only; all where empty.
        keep: Told everything so far, whenever there is more.
    """
    result: Row = {
        "versions": versions(),
        "machine": machine(bench.device),
        "gaussians": {"perfect": bench.effort.perfect_gaussians, "cost": bench.effort.scale.gaussians},
        "failed": [],
    }
    for name, part in PARTS.items():
        if only and name not in only:
            continue
        started = time.perf_counter()
        try:
            for state in part(bench):
                result[name] = state
                keep(result)
            result[name]["part_seconds"] = time.perf_counter() - started
        except Exception:
            result.setdefault(name, {})["failed"] = traceback.format_exc()
            result["failed"].append(name)
            bench.say(traceback.format_exc())
        keep(result)
        bench.say(f"{name}: {time.perf_counter() - started:.1f} s")
    return result


def markdown(result: Row) -> str:
    """Return the tables."""
    lines: list[str] = []
    for name, row in result.get("perfect", {}).get("captures", {}).items():
        lines += [f"\n### {name}, {row['gaussians']:,} Gaussians on the true surface\n"]
        rays = next(iter(row["irradiance"].values()))["rays"]
        lines += [f"| light | error at {rays} rays: at each point | of the mean | cosine, iid |", "|---|---|---|---|"]
        for light, found in row["irradiance"].items():
            ways = found["ways"]
            cells = [f"{ways['product, ratio, Owen'][key]:.4f}" for key in ("relative_rmse", "rmse_over_mean")]
            cells.append(f"{ways['cosine, iid']['relative_rmse']:.4f}")
            lines.append(f"| {light} | " + " | ".join(cells) + " |")
        lines += ["", *_table(row["rows"], true_coverage=True)]
    for name, part in result.get("ablation", {}).get("captures", {}).items():
        lines += [f"\n### {name}, {part['gaussians']:,} reconstructed Gaussians\n", *_table(part["rows"])]
    parts = result.get("cost", {}).get("parts", {})
    for name in ("direct", "image path"):
        if "seconds" in parts.get(name, {}):
            row = parts[name]
            stages = ", ".join(f"{stage} {seconds:.2f}" for stage, seconds in row["stages"].items())
            peak = f"{row['peak_device_bytes'] / 2**30:.1f} GiB" if "peak_device_bytes" in row else "not on CUDA"
            lines.append(f"- {name}: {row['seconds']:.2f} s ({stages}), peak {peak}")
    failed = [f"- {name}: {result[name]['failed'].splitlines()[-1]}" for name in result.get("failed", [])]
    return "\n".join([*lines, *failed]) + "\n"


def _table(rows: Sequence[Row], *, true_coverage: bool = False) -> list[str]:
    """Return rows as a table of scores, time and memory."""
    extra = " AO, base colour with true coverage [dB] |" if true_coverage else ""
    lines = [
        f"| | AO [dB] / SSIM | base colour [dB] / SSIM | scale |{extra} s | GiB |",
        "|" + "---|" * (7 if true_coverage else 6),
    ]
    for row in rows:
        if "base_color" not in row:
            why = row.get("unavailable") or row.get("failed", "").strip().splitlines()[-1]
            lines.append(f"| {row['name']} | {why} |" + " |" * (5 if true_coverage else 4))
            continue
        color, openness = row["base_color"], row["ambient_occlusion"]
        cells = [
            row["name"],
            f"{openness['psnr']:.2f} / {openness['ssim']:.3f}",
            f"{color['psnr']:.2f} / {color['ssim']:.3f}",
            f"{np.mean(color['scale']):.3f}",
        ]
        if true_coverage:
            cells.append(f"{openness['true_coverage_psnr']:.2f}, {color['true_coverage_psnr']:.2f}")
        cells.append(f"{row['seconds']:.2f}")
        cells.append(f"{row['peak_device_bytes'] / 2**30:.2f}" if "peak_device_bytes" in row else "")
        lines.append("| " + " | ".join(cells) + " |")
    return lines


def read_lights(data: Path) -> dict[str, EnvironmentMap]:
    """Return the HDRIs of the data folder."""
    return {name: EnvironmentMap.read(data / "hdri" / f"{name}.hdr") for name in LIGHTS}


def quick_bench(folder: Path, device: Any, say: Callable[[str], None]) -> Bench:
    """Return a bench that runs in no time, on the demo's capture and its own light."""
    capture = write_demo_capture(
        folder / "demo", camera_count=6, test_camera_count=1, size=64, samples=4, frame_count=2, device=str(device)
    )
    return bench_of_capture(capture, device, say)


def bench_of_capture(capture: Capture, device: Any, say: Callable[[str], None]) -> Bench:
    """Return a quick bench of one capture."""
    assert capture.environment_path is not None
    lights = {"its own": EnvironmentMap.read(capture.environment_path)}
    return Bench({"demo": capture}, lights, {}, 600, QUICK, device, None, say)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cpu", help="cpu or cuda:0")
    parser.add_argument("--data", type=Path, default=Path(os.environ.get("BEAM_DATA", "../shared/data")))
    parser.add_argument("--captures", nargs="+", default=["walker", "runner"], help="names there, or folders")
    parser.add_argument("--assets", nargs="*", default=[], metavar="NAME=PATH", help="reconstructions of captures")
    parser.add_argument("--gaussians", type=int, default=140_000, help="of reconstructions that are made here")
    parser.add_argument("--perfect-gaussians", type=int, help="other than by default")
    parser.add_argument("--scale", type=float, default=1.0, help="of the cost's images and views, to try it")
    parser.add_argument("--commit", default=commit(), help="recorded; by default that of this checkout")
    parser.add_argument("--out", type=Path, help="JSON to write")
    parser.add_argument("--pictures", type=Path, metavar="DIR", help="pictures of every row")
    parser.add_argument("--parts", nargs="+", default=(), choices=PARTS, metavar="PART", help="these parts only")
    parser.add_argument("--quick", action="store_true", help="the demo's capture, small: does all of it run?")
    parser.add_argument("--plot", type=Path, metavar="DIR", help="also draw materials_plot.py's pictures there")
    arguments = parser.parse_args()
    device = resolve_device(arguments.device)
    started = time.perf_counter()

    def say(text: str) -> None:
        print(f"{time.perf_counter() - started:7.1f} s  {text}", file=sys.stderr, flush=True)

    head = {"benchmark": "materials", "commit": arguments.commit, "quick": arguments.quick}

    def keep(result: Row) -> None:
        if arguments.out is not None:
            arguments.out.parent.mkdir(parents=True, exist_ok=True)
            partial = arguments.out.with_suffix(".partial")
            partial.write_text(json.dumps({**head, **result}, indent=1) + "\n", encoding="utf-8")
            partial.replace(arguments.out)

    with tempfile.TemporaryDirectory() as folder:
        if arguments.quick:
            bench = replace(quick_bench(Path(folder), device, say), pictures=arguments.pictures)
        else:
            captures = {}
            for word in arguments.captures:
                path = Path(word) if Path(word).is_dir() else arguments.data / "captures" / word
                captures[path.name] = Capture.read(path)
            effort = FULL
            if arguments.perfect_gaussians:
                effort = replace(effort, perfect_gaussians=arguments.perfect_gaussians)
            if arguments.scale != 1.0:
                effort = replace(effort, scale=shrunk(effort.scale, arguments.scale))
            assets = {name: Path(path) for name, path in (word.split("=", 1) for word in arguments.assets)}
            bench = Bench(
                captures,
                read_lights(arguments.data),
                assets,
                arguments.gaussians,
                effort,
                device,
                arguments.pictures,
                say,
            )
        result = {**head, **measure(bench, only=arguments.parts, keep=keep)}
    print(markdown(result), end="")
    if arguments.plot is not None:
        from materials_plot import draw_all

        draw_all([result], arguments.plot, arguments.pictures)
    return 1 if result["failed"] else 0


def shrunk(scale: Scale, factor: float) -> Scale:
    """Return a smaller scale: of images, views and Gaussians."""

    def less(count: int, least: int = 1) -> int:
        return max(least, round(count * factor))

    return replace(
        scale,
        gaussians=less(scale.gaussians, 100),
        views=less(scale.views, 2),
        size=(less(scale.size[0], 16), less(scale.size[1], 16)),
        counts=tuple(less(count, 100) for count in scale.counts),
        view_counts=tuple(sorted({less(count) for count in scale.view_counts})),
        series_views=less(scale.series_views, 2),
    )


if __name__ == "__main__":
    sys.exit(main())
