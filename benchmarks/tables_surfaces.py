"""What pages say of surfaces: meshes fused from depth images, and skins that joints carry."""

from __future__ import annotations

from typing import Any

from tables import Row, Rows, cell, number, table

WAYS = "sparse", "dense"
SKINNED = "skinning_walker_cpu.json", "skinning_runner_cpu.json"


@table("meshing", "meshing_h200.json")
def meshing(result: Row) -> Rows:
    """Sparse and dense fusion of the sphere and of the figure."""
    sphere, human = result["sphere"], result["figure"]
    scenes = f"sphere of 0.5 m, voxel {sphere['voxel_mm']:.1f} mm", f"demo figure, voxel {human['voxel_mm']:.1f} mm"
    found = [(scene, way, entry[way]) for scene, entry in zip(scenes, (sphere, human), strict=True) for way in WAYS]

    def row(title: str, key: str, form: str = ",.0f") -> list[str]:
        return [title, *(cell(entry[key], form) for *_, entry in found)]

    def distance(title: str, name: str, of_sphere: str, of_figure: str, form: str = ".2g") -> list[str]:
        keys = (("radius_mm", of_sphere) if scene is scenes[0] else (name, of_figure) for scene, *_ in found)
        pairs = zip(found, keys, strict=True)
        return [title, *("" if not key else cell(entry[group][key], form) for (*_, entry), (group, key) in pairs)]

    return [
        ["", *(f"{scene}: {way}" for scene, way, _ in found)],
        row("triangles", "faces"),
        row("parts", "parts"),
        row("boundary edges", "boundary_edges"),
        row("edges of more than two triangles", "nonmanifold_edges"),
        distance("distance from the truth, mean [mm]", "to_truth_mm", "mean_size", "mean_size"),
        distance("largest, or 95 % [mm]", "to_truth_mm", "largest", "p95"),
        distance("the truth's distance from it, mean [mm]", "from_truth_mm", "", "mean_size"),
    ]


@number("meshing_sphere_voxels", "meshing_h200.json")
def meshing_sphere_voxels(result: Row) -> float:
    """The sphere's largest error in voxels."""
    return result["sphere"]["sparse"]["radius_mm"]["largest"] / result["sphere"]["voxel_mm"]


@table("skinning", *SKINNED)
def skinning(*captures: Row) -> Rows:
    """Errors of skins that true joints carry, by what counts as a neighbour and by reach."""
    settings = {
        "without normals": "none 1.5",
        "cosine -0.2, the default of the functions": "-0.2 1.5",
        "cosine 0.2, of the tracker": "0.2 1.5",
        "cosine 0.5": "0.5 1.5",
        "cosine 0.2, l = 1 spacing": "0.2 1",
        "cosine 0.2, l = 2 spacings": "0.2 2",
    }
    columns = [(result, joints) for result in captures for joints in (1500, 3000)]
    heads = [f"{result['capture']}, {joints:,} joints" for result, joints in columns]
    rows: list[list[Any]] = [["RMS / 99 % error [mm], linear", *heads]]
    for title, setting in settings.items():
        found = (_skin(result, f"{joints} {setting} linear") for result, joints in columns)
        rows.append([title, *(f"{row['rms_mm']:.2f} / {row['p99_mm']:.1f}" for row in found)])
    return rows


def _skin(result: Row, name: str) -> Row:
    """Return the row of a name."""
    (row,) = (row for row in result["rows"] if row["name"].lower() == name)
    return row


@number("skinning_blends", *SKINNED)
def skinning_blends(*captures: Row) -> float:
    """The largest difference that the blend makes to an RMS error, as a part of it."""
    pairs = [
        (row["rms_mm"], _skin(result, row["name"].lower().replace("linear", "dual"))["rms_mm"])
        for result in captures
        for row in result["rows"]
        if row["blend"] == "linear"
    ]
    return max(abs(dual / linear - 1.0) for linear, dual in pairs)
