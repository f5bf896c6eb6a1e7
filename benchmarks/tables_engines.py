"""What the pages on engines say of pictures against the deferred renderer."""

from __future__ import annotations

from typing import Any

from tables import Row, Rows, cell, table

ENGINES = "engine_shading_cpu.json"
WEB = "web_player_cpu.json"
STARTS = "view_start_cpu.json"
BACKENDS = {"webgl2": "WebGL 2", "webgpu": "WebGPU"}


@table("engine_shading", ENGINES)
def shading(result: Row) -> Rows:
    """Return PSNR by probe, lighting, and language or engine."""
    targets = {"wgsl": "WGSL", "hlsl": "HLSL", "glsl": "GLSL ES", "unity": "Unity's entries", **BACKENDS}
    rows: list[list[Any]] = [["probe", "light", *(f"{name} [dB]" for name in targets.values())]]
    for row in result["rows"]:
        values = [cell(row["psnr"].get(target), ".0f") for target in targets]
        rows.append([row["probe"], row["lighting"], *values])
    return rows


@table("web_seeks", WEB)
def seeks(result: Row) -> Rows:
    """Return what a seek takes on each backend, by stage."""
    stages = ("fetch", "unpack", "upload", "sort", "ready", "drawn")
    rows: list[list[Any]] = [["backend", "seek to what is", *stages]]
    for row in result["players"]["rows"]:
        for where, times in (("not at hand", row["cold"]), ("at hand", row["warm"])):
            cells = ["{:.0f}, {:.0f}".format(*times[stage]) if stage in times else "" for stage in stages]
            rows.append([BACKENDS[row["name"]], where, *cells])
    return rows


@table("web_memory", WEB)
def memory(result: Row) -> Rows:
    """Return how a take plays on each backend, and what it holds."""
    kinds = {"heap_mb": "heap", "page_mb": "page's process", "gpu_mb": "drawing process", "texture_mb": "textures"}
    rows: list[list[Any]] = [["backend", "pictures a second", "late", "of", "held [MB]", "grows [MB a minute]"]]
    for row in result["players"]["rows"]:
        head = [BACKENDS[row["name"]], cell(row["pictures_a_second"]), f"{100 * row['late_share']:.1f} %"]
        for name, said in kinds.items():
            rows.append([*head, said, cell(row["held"][name]), "{:.3f} ± {:.3f}".format(*row["growth"][name])])
            head = [""] * len(head)
    return rows


@table("view_start", STARTS)
def starts(result: Row) -> Rows:
    """Return how soon beam view answers and its page shows a picture, by kind of asset."""
    kinds = {"b4d": "a `.b4d` file", "usd": "USD", "ply": "one frame of PLY"}
    stages = ("served", "answered", "opened", "shown", "drawing")
    rows: list[list[Any]] = [["asset", "address", "page answered", "take open", "first picture", "of which drawing"]]
    for row in result["starts"]["rows"]:
        rows.append([kinds[row["name"]], *("{:.1f} ({:.1f} to {:.1f})".format(*row[stage]) for stage in stages)])
    return rows
