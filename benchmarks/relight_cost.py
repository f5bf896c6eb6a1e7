"""What a relit frame costs: deferred, path traced, and of geometry that moves; 140,000 Gaussians of a ball's skin."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import warp as wp
from device_memory import peak_memory
from parts import Row, say
from relight_scenes import LAMPS, SUN_AND_LAMP, Bench, MovingFigure, frame_times, ground, posed, seconds_of
from timing import spread

from beam_warp.device.graphs import StepGraphs
from beam_warp.raster.rasterizer import Rasterizer
from beam_warp.render.deferred import DeferredOptions, DeferredRenderer
from beam_warp.render.path import PathOptions, PathRenderer
from beam_warp.trace.scene import Scene
from beam_warp.world.lights import Light
from beam_warp.world.shot import Shot

MOST_PASSES = 3
"""Timed passes of paths: one takes a second or more."""

ENVIRONMENT = "environment"
TWO_LIGHTS = "environment, 2 shadowed lights"


def deferred_cases(bench: Bench) -> dict[str, tuple[DeferredOptions, tuple[Light, ...]]]:
    """Return by name how the figure is shaded, and by which lights."""
    plain = bench.deferred_options(0)
    cases: dict[str, tuple[DeferredOptions, tuple[Light, ...]]] = {
        ENVIRONMENT: (plain, ()),
        TWO_LIGHTS: (plain, SUN_AND_LAMP),
    }
    for count in bench.effort.shadows:
        options = bench.deferred_options(count)
        cases[f"environment with {count} shadow maps, {options.bounces} bounces"] = (options, ())
    return cases


def measure_deferred(bench: Bench) -> Iterator[Row]:
    """Yield the cost so far of the steady frame, of one with all maps drawn again, and of one whose Gaussians moved."""
    effort, device = bench.effort, bench.device
    shot = bench.figure()
    moving = MovingFigure(shot.cloud, effort.poses, device)
    result: Row = {"gaussians": len(shot.cloud), "size": list(effort.size), "cases": {}}
    result["frames_in_a_row"] = effort.frames
    for name, (options, lights) in deferred_cases(bench).items():
        renderer = DeferredRenderer(options, device=str(device))
        renderer.draw(replace(bench.small_figure(), lights=lights, mesh=None))
        lit = replace(shot, lights=lights)
        with peak_memory(device) as memory:
            first = seconds_of(lambda r=renderer, s=lit: r.frame(s), device)
            frame = renderer.frame(lit)
            drawn = frame.pixels.numpy().copy()  # on the CPU it is a view
            row: Row = {
                "options": {"environment_shadows": options.environment_shadows, "bounces": options.bounces},
                "lights": len(lights),
                "first_ms": 1e3 * first,
                "still_maps": frame_times(frame.launch_view, effort, device),
                "whole": frame_times(frame.launch, effort, device),
            }
            row["launched_is_drawn"] = bool(np.array_equal(frame.pixels.numpy(), drawn))
            row["covered"] = float((drawn[:, 3] > 0.0).mean())
            row["g_buffer"] = g_buffer_times(bench, lit, frame.gaussians)

            def moved(frame: Any = frame) -> None:
                moving.move(frame.gaussians)
                frame.launch()

            row["moving"] = frame_times(moved, effort, device)
        row |= memory
        whole, still, drawn_alone = (row[key]["ms"]["median"] for key in ("whole", "still_maps", "g_buffer"))
        row["shares_ms"] = {
            "shadow maps and what arrives": whole - still,
            "G-buffer": drawn_alone,
            "shading": still - drawn_alone,
        }
        result["cases"][name] = row
        shares = ", ".join(f"{part} {ms:.3f}" for part, ms in row["shares_ms"].items())
        say(f"{name}: {whole:.3f} ms ({shares}), moving {row['moving']['ms']['median']:.3f} ms")
        yield result


def g_buffer_times(bench: Bench, shot: Shot, gaussians: Any) -> Row:
    """Time what a frame draws before it is lit, by itself."""
    count = gaussians.values.shape[1]
    rasterizer = Rasterizer(len(shot.cloud), [shot.camera], value_count=count, device=bench.device)
    rasterizer.draw(gaussians)
    graphs = StepGraphs(bench.device)
    return frame_times(lambda: graphs.run("draw", rasterizer.redraw), bench.effort, bench.device)


def measure_path(bench: Bench) -> Iterator[Row]:
    """Yield how many samples a second are traced, by what is there to meet and to shine."""
    effort, device = bench.effort, bench.device
    options = PathOptions(samples=2**20, bounces=effort.bounces)
    PathRenderer(options, device=str(device)).start(bench.small_figure()).advance(1)
    result: Row = {
        "gaussians": effort.gaussians,
        "size": list(effort.size),
        "bounces": effort.bounces,
        "samples": effort.path_samples,
        "cases": {},
    }
    pixels = effort.size[0] * effort.size[1]
    for name, shot in (
        ("sky", bench.figure()),
        ("sky, 2 spheres that shine", bench.figure(lights=LAMPS)),
        ("sky, ground", bench.figure(mesh=ground())),
        ("sky, ground, 2 spheres that shine", bench.figure(lights=LAMPS, mesh=ground())),
    ):
        renderer = PathRenderer(options, device=str(device))
        started: list[Any] = []
        with peak_memory(device) as memory:
            row: Row = {"prepare_seconds": seconds_of(lambda s=shot: started.append(renderer.start(s)), device)}  # noqa: B023
            (progress,) = started
            row["first_pass_seconds"] = row["prepare_seconds"] + seconds_of(lambda p=progress: p.advance(1), device)
            seconds = [
                seconds_of(lambda p=progress: p.advance(effort.path_samples), device)
                for _ in range(min(effort.repeats, MOST_PASSES))
            ]
        # the depth of a pixel is above 0 where any sample met something
        covered = float((progress.image().layers["depth"] > 0.0).mean())
        rate = pixels * effort.path_samples / np.array(seconds)
        row |= {
            "covered": covered,
            "samples_per_second": spread(rate),
            "covered_samples_per_second": spread(rate * covered),
            **memory,
        }
        result["cases"][name] = row
        say(f"{name}: {np.median(rate) / 1e6:.2f} Msample/s, covered {covered:.0%}")
        yield result


def measure_moving(bench: Bench) -> Iterator[Row]:
    """Yield the cost of frames with new geometry each: hierarchy, sort, maps and shading, together and by part."""
    effort, device = bench.effort, bench.device
    shot = bench.figure()
    moving = MovingFigure(shot.cloud, effort.poses, device)
    result: Row = {"gaussians": len(shot.cloud), "size": list(effort.size), "trees": {}, "cases": {}}
    scenes = {"refit": Scene.from_gaussians(shot.cloud, str(device))}
    scenes["fast"] = Scene.from_gaussians(shot.cloud, str(device), build="fast")
    for tree, scene in scenes.items():
        result["trees"][tree] = frame_times(lambda s=scene, t=tree: s.move(*moving.arrays(), tree=t), effort, device)
        say(f"hierarchy, {tree}: {result['trees'][tree]['ms']['median']:.3f} ms")
        yield result
    for name, (options, lights) in deferred_cases(bench).items():
        frame = DeferredRenderer(options, device=str(device)).frame(replace(shot, lights=lights))
        row: Row = {
            "arrays": frame_times(lambda f=frame: moving.move(f.gaussians), effort, device),
            "deferred": frame_times(frame.launch, effort, device),
        }
        for tree, scene in scenes.items():

            def whole(frame: Any = frame, scene: Scene = scene, tree: Any = tree) -> None:
                moving.move(frame.gaussians)
                arrays = frame.gaussians
                scene.move(arrays.positions, arrays.orientations, arrays.scales, tree=tree)
                frame.launch()

            row[tree] = frame_times(whole, effort, device)
        result["cases"][name] = row
        say(
            f"moving, {name}: refit {row['refit']['ms']['median']:.3f} ms, rebuilt {row['fast']['ms']['median']:.3f} ms"
        )
        yield result
    result["path_start_ms"] = path_start_times(bench, shot)
    say(f"path tracer, a new frame made ready: {result['path_start_ms']['median']:.1f} ms")
    yield result


def path_start_times(bench: Bench, shot: Shot) -> Row:
    """Return milliseconds of what the path tracer does before the first sample of a frame with other Gaussians."""
    renderer = PathRenderer(device=str(bench.device))
    renderer.start(shot)
    times = []
    for repeat in range(bench.effort.repeats):
        positions, orientations, scales = posed(shot.cloud, 0.3 + repeat)
        cloud = shot.cloud.with_arrays(positions=positions, orientations=orientations, scales=scales)
        following = replace(shot, cloud=cloud)
        times.append(1e3 * seconds_of(lambda s=following: renderer.start(s), bench.device))
    wp.synchronize_device(bench.device)
    return spread(np.array(times))
