"""Materials of Gaussians on the true surface: irradiance, occlusion, base colour with and without the bounce."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from materials_bench import Bench
from materials_truth import Materials, PerfectFrame, TruthViews, light_errors, light_reference, row_of
from parts import Row, say

from beam_warp.light.prepared import PreparedEnvironment
from beam_warp.materials.base_color import fill_from_neighbors, solve_base_color
from beam_warp.materials.direct import measure_materials
from beam_warp.materials.light_rays import MaterialOptions
from beam_warp.reconstruction.scores import truth_frames
from beam_warp.study.true_surface import SHARP


def measure_perfect(bench: Bench) -> Iterator[Row]:
    """Yield what is known so far of materials on the true surface."""
    result: Row = {"captures": {}}
    for name, capture in bench.captures.items():
        frame = truth_frames(capture)[0]
        started = time.perf_counter()
        perfect = PerfectFrame.of(capture, frame, bench.effort.perfect_gaussians, bench.device)
        say(f"{name}: {len(perfect.cloud):,} Gaussians on the true surface, {time.perf_counter() - started:.1f} s")
        row: Row = {"gaussians": len(perfect.cloud), "seen": float(perfect.evidence.seen.mean()), "rows": []}
        result["captures"][name] = row
        row["irradiance"] = perfect_light(bench, perfect)
        yield result
        truth = TruthViews(capture, frame, SHARP, bench.effort.perfect_samples, str(bench.device))
        for entry in perfect_materials(bench, perfect, truth):
            row["rows"].append(entry)
            say(f"{name}, {entry['name']}: {row_of(entry)}")
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
        say(f"light {name}: {default['relative_rmse']:.4f} at each point, {default['rmse_over_mean']:.4f} of the mean")
    return found


def perfect_materials(bench: Bench, perfect: PerfectFrame, truth: TruthViews) -> Iterator[Row]:
    """Yield scores with and without the bounce, at the true points and at those that views show."""
    light = bench.light_of(perfect.capture)
    rough = {"0.5": np.full(len(perfect.cloud), 0.5, np.float32), "true": perfect.true_roughness(bench.device)}
    spread = perfect.images_spread_back()
    for row in perfect_rows(bench.effort.perfect_rays):
        points = perfect.points(exact=row.exact)
        measured = measure_materials(
            perfect.cloud,
            perfect.scene,
            points,
            rough[row.roughness],
            light,
            options=MaterialOptions(bounce=row.bounce, sample_count=row.rays, light_error=0.0),
            views=perfect.evidence if row.observed == "difference" else spread,
        )
        solved = solve_base_color(
            perfect.cloud.with_arrays(normal_confidence=points.confidence), measured.evidence, light.mean_irradiance
        )
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
            **truth.score(perfect.cloud, found),
        }


@dataclass(frozen=True)
class PerfectRow:
    """Way to measure materials on the true surface: at its points or at those that views show, and so on."""

    exact: bool = True
    roughness: str = "true"
    rays: int = 64
    bounce: bool = True
    observed: str = "difference"

    @property
    def name(self) -> str:
        """Name in tables."""
        words = [f"{'true' if self.exact else 'seen'} points", f"roughness {self.roughness}", f"{self.rays} rays"]
        words.append("with the bounce" if self.bounce else "direct only")
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
        *(replace(default, rays=count) for count in rays[1:]),
    ]
