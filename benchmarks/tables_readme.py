"""The one table of the README: a row for each thing that the package does, from the results of their benchmarks."""

from __future__ import annotations

from tables import Row, Rows, cell, table

SHADOWS = "environment with 16 shadow maps, 2 bounces"
"""The case of the deferred renderer that has its default options."""


@table(
    "readme",
    "tracing_h200.json",
    "raster_h200.json",
    "reconstruction_h200.json",
    "materials_evaluation_h200.json",
    "relight_speed_h200.json",
)
def readme(tracing: Row, raster: Row, reconstruction: Row, materials: Row, relight: Row) -> Rows:
    """Return what is measured, how well it does, and what it is compared with or seen in."""
    results = (tracing, raster, reconstruction, materials, relight)
    devices = dict.fromkeys(result["measured"]["machine"]["device"] for result in results)
    return [
        ["", ", ".join(devices), "beside it"],
        _rays(tracing),
        _images(raster),
        *_reconstructions(reconstruction),
        *_materials(materials),
        _relighting(relight),
        _paths(relight),
    ]


def _rays(result: Row) -> list[str]:
    torus = result["torus"]
    ours = torus["contenders"]["wide product"]
    return [
        f"rays through {torus['gaussians']:,} Gaussians, exact visibility",
        f"{cell(ours['mray_per_second'])} million/s, error at most {cell(ours['largest_error'])}",
        f"{cell(ours['over_wp_bvh'])} × the fastest loop over `wp.Bvh`",
    ]


def _images(result: Row) -> list[str]:
    scene, case = result["peer"]["scene"], result["peer"]["cases"]["RGB and depth"]
    size = f"{scene['width']} × {scene['height']}"
    wall = {name: cell(times["wall_ms"]) for name, times in case["ms"].items()}
    return [
        f"image and gradients of {scene['splats']:,} Gaussians at {size}, {_covered(case)}",
        f"{wall['ours redraw, training']} ms launched, {wall['ours graph, training']} ms as a CUDA graph",
        f"gsplat {case['gsplat']}: {wall['gsplat, training']} ms",
    ]


def _covered(case: Row) -> str:
    return f"{100.0 * case['covered']:.0f} % covered"


def _reconstructions(result: Row) -> Rows:
    rows = []
    for part in result["captures"]["rows"]:
        first = part["frames"][0]
        rows.append(
            [
                f"reconstruction of {part['name']}, {first['gaussians']:,} Gaussians, first frame",
                f"novel views {first['psnr']:.1f} dB, normals {first['normals_median_degrees']:.1f}°, "
                f"mesh {first['surface']['chamfer_mm']:.1f} mm",
                f"{cell(part['first_seconds'], '.1f')} s",
            ]
        )
    return rows


def _materials(result: Row) -> Rows:
    rows = []
    for name, part in result["evaluation"]["captures"].items():
        ours, paper = (_scores(part["ways"][way]["mean"]) for way in ("direct", "paper, bilateral"))
        rows.append([f"materials of {name}", ours, f"the paper's recipe: {paper}"])
    return rows


def _scores(row: Row) -> str:
    return f"occlusion {row['ambient_occlusion']['psnr']:.1f} dB, base colour {row['base_color']['psnr']:.1f} dB"


def _relighting(result: Row) -> list[str]:
    part = result["deferred"]
    case, (width, height) = part["cases"][SHADOWS], part["size"]
    return [
        f"relighting a ball of {part['gaussians']:,} Gaussians at {width} × {height}, one sample a pixel, "
        f"{_covered(case)}, default shadows",
        f"{cell(case['whole']['fps'], ',.0f')} frames/s with everything redrawn",
        f"{cell(case['still_maps']['fps'], ',.0f')} frames/s with the camera moved only",
    ]


def _paths(result: Row) -> list[str]:
    part = result["path"]
    case = part["cases"]["sky"]
    rate = cell(case["covered_samples_per_second"], factor=1e-6)
    return [f"path tracing of the same, {part['bounces']} bounces", f"{rate} million covered samples/s", ""]
