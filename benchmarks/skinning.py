"""How well joints carry a surface whose motion is known, and what their number, reach, blend and normals change.

    python benchmarks/skinning.py [--capture walker] [--skins 40000] [--device cpu] --out FILE.json

Skins are points of the truth mesh of a capture's first frame. Joints are some of them, with their true places in the
last frame, and the rotations that fit the surface around them best: what is left is the error of skinning itself, which
no tracking can undo. How much of independent errors of the joints' places reaches the skin follows from the weights.
"""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path
from typing import Any

import numpy as np
import record
import warp as wp
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from beam_warp.device.arrays import resolve_device
from beam_warp.reconstruction.joints.graph import (
    JointGraph,
    joint_spacing,
    nearest_joints,
    proximity_weights,
    torn_fraction,
)
from beam_warp.reconstruction.joints.selection import select_joints
from beam_warp.reconstruction.joints.skinning import Anchors, Skin

AROUND = 40
"""Points that a joint's true rotation is fitted to."""


def surface(folder: Path, count: int) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], float]:
    """Return points in the first and the last frame, normals in the first, and the area then [m^2]."""
    first, *_, last = (np.load(path) for path in sorted(folder.glob("truth/mesh_*.npz")))
    rng, faces = np.random.default_rng(0), first["faces"]
    corners = first["vertices"].astype(float)[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    areas = 0.5 * np.linalg.norm(normals, axis=1)
    chosen = rng.choice(len(faces), count, p=areas / areas.sum())
    weights = rng.dirichlet(np.ones(3), count)
    places = [np.einsum("nk,nkc->nc", weights, m["vertices"].astype(float)[faces[chosen]]) for m in (first, last)]
    return places[0], places[1], normals[chosen] / (2.0 * areas[chosen, None]), float(areas.sum())


def true_rotations(
    rows: NDArray[np.int64], before: NDArray[np.float64], after: NDArray[np.float64], normals: NDArray[np.float64]
) -> NDArray[np.float32]:
    """Return the rotation of each joint that fits the nearest points that face its way best."""
    near = cKDTree(before).query(before[rows], k=3 * AROUND)[1]
    found = np.tile(np.array([0.0, 0.0, 0.0, 1.0], np.float32), (len(rows), 1))
    for i, row in enumerate(rows):
        points = near[i][normals[near[i]] @ normals[row] > 0.0][:AROUND]
        if len(points) > 3:
            fit, _ = Rotation.align_vectors(after[points] - after[row], before[points] - before[row])
            found[i] = fit.as_quat()
    return found


def measure(folder: Path, skin_count: int, device: Any) -> dict[str, Any]:
    """Return what is left of the truth, for every setting."""
    before, after, normals, area = surface(folder, skin_count)
    rows = []
    for joint_count in (1500, 3000):
        joints = select_joints(before, joint_count)
        rest, rotations = before[joints], true_rotations(joints, before, after, normals)
        for cosine in (None, -0.2, 0.2, 0.5):
            facing = (None, None) if cosine is None else (normals, normals[joints])
            graph = JointGraph.build(rest, normals=facing[1], smallest_cosine=cosine or 0.0)
            torn = torn_fraction(graph, rest, after[joints])
            for reach in (1.0, 1.5, 2.0):
                nearest, squared = nearest_joints(before, rest, 8, *facing, cosine or 0.0)
                spacing = joint_spacing(rest, facing[1], cosine or 0.0)
                anchors = Anchors(nearest.astype(np.int32), proximity_weights(squared, reach * spacing))
                for blend in ("linear", "dual"):
                    found = carried(before, anchors, rest, rotations, after[joints], blend, device)
                    error = 1000.0 * np.linalg.norm(found - after, axis=1)
                    row = {
                        "name": f"{joint_count} {cosine} {reach:g} {blend}",
                        "joints": joint_count,
                        "smallest_cosine": cosine,
                        "reach": reach,
                        "blend": blend,
                        "rms_mm": float(np.sqrt((error**2).mean())),
                        "median_mm": float(np.median(error)),
                        "p99_mm": float(np.quantile(error, 0.99)),
                        "torn": torn,
                        "spacings_squared_per_area": joint_count * spacing**2 / area,
                        "error_of_joints_kept": float(np.sqrt((anchors.weights**2).sum(axis=1).mean())),
                    }
                    rows.append(row)
                    print(json.dumps(row), file=sys.stderr)
    return {"capture": folder.name, "skins": skin_count, "area_m2": area, "rows": rows}


def carried(
    skins: NDArray[np.float64],
    anchors: Anchors,
    rest: NDArray[np.float64],
    rotations: NDArray[np.float32],
    positions: NDArray[np.float64],
    blend: str,
    device: Any,
) -> NDArray[np.float32]:
    """Return where the joints carry the skins."""
    upright = np.tile([0.0, 0.0, 0.0, 1.0], (len(skins), 1))
    skin = Skin(skins, upright, anchors, rest, blend=blend, device=device)
    poses = (
        wp.array(rotations, dtype=wp.quat, device=device),
        wp.array(positions.astype(np.float32), dtype=wp.vec3, device=device),
    )
    out = [wp.zeros(len(skins), dtype=kind, device=device) for kind in (wp.vec3, wp.quat)]
    skin.warp(*poses, *out)
    return out[0].numpy()


def main() -> None:
    parser = record.parser(__doc__, device=True)
    parser.add_argument("--capture", default="walker")
    parser.add_argument("--skins", type=int, default=40_000)
    options = parser.parse_args()
    folder = Path(os.environ.get("BEAM_DATA", "../shared/data")) / "captures" / options.capture
    device = resolve_device(options.device)
    record.write_result(options, device, measure(folder, options.skins, device))


if __name__ == "__main__":
    main()
