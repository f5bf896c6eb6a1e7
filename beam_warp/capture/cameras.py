"""What is wrong with a capture's cameras, as far as poses and intrinsics tell."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from beam_warp.capture.findings import Finding, are, count_of, names_of
from beam_warp.capture.rigs import frustum_volume, likely_mistakes, seen_by, up_direction
from beam_warp.errors import InvalidOptionError
from beam_warp.world.camera import Camera

MIN_CAMERAS = 2
"""Fewer cameras of a frame have no depth."""

FEW_CAMERAS = 8
"""Fewer cameras leave most of a surface seen by one camera or none; the paper's least is 8."""

ANGLES = (0.05, 175.0)
"""Fields of view beyond which the intrinsics of a camera are as good as singular [degree]."""


def judge_cameras(
    rig: dict[str, Camera], split: str, findings: list[Finding]
) -> tuple[tuple[NDArray[np.float64], NDArray[np.float64]] | None, set[str]]:
    """Find what poses and intrinsics tell; return the common volume and the cameras that see nothing of it."""
    if len(rig) < MIN_CAMERAS:
        findings.append(
            Finding(
                "error",
                "too-few-cameras",
                f"{count_of(len(rig), 'camera')} to train from, where depth needs {MIN_CAMERAS}",
                remedy=f"Add cameras, or give records the split {split}.",
            )
        )
    elif len(rig) < FEW_CAMERAS:
        findings.append(
            Finding(
                "warning",
                "few-cameras",
                f"{len(rig)} cameras leave parts of the surface that no two of them see",
                remedy=f"Expect holes; {FEW_CAMERAS} or more all around are better.",
            )
        )
    singular = {name: angles for name, camera in rig.items() if (angles := _odd_angles(camera))}
    if singular:
        findings.append(
            Finding(
                "error",
                "singular-intrinsics",
                f"fields of view of {next(iter(singular.values()))} are beyond {ANGLES[0]:g} to {ANGLES[1]:g} degrees",
                names_of(singular),
                "Correct the focal lengths: they are in pixels.",
            )
        )
    outside = [
        name for name, c in rig.items() if not (0 <= c.center_x <= c.width and 0 <= c.center_y <= c.height)
    ]  # allowed: crops have it
    if outside:
        findings.append(
            Finding(
                "warning",
                "principal-point",
                f"the principal point lies outside of the images of {count_of(len(outside), 'camera')}",
                names_of(outside),
                "Right for crops only: check that cx and cy are in pixels of these images.",
            )
        )
    uneven = [name for name, c in rig.items() if not (2 / 3 <= c.focal_x / c.focal_y <= 3 / 2)]
    if uneven:
        findings.append(
            Finding(
                "warning",
                "uneven-pixels",
                f"focal lengths along x and y differ by more than half for {count_of(len(uneven), 'camera')}",
                names_of(uneven),
                "Check fl_x and fl_y.",
            )
        )
    if len(rig) < MIN_CAMERAS:
        return None, set()
    cameras = list(rig.values())
    _judge_duplicates(rig, findings)
    mistakes = likely_mistakes(cameras)
    if mistakes:
        findings.append(
            Finding(
                "error",
                "swapped-axes",
                "the cameras do not look at a common place, and would with their axes changed",
                remedy=f"Probably {'; or '.join(mistakes)}.",
            )
        )
    _judge_up(cameras, findings)
    try:
        volume = frustum_volume(cameras)
    except InvalidOptionError:
        findings.append(
            Finding(
                "error",
                "no-overlap",
                "the cameras have no volume in common",
                remedy="Check the poses: their axes, their units, and that they are camera-to-world.",
            )
        )
        return None, set()
    if mistakes:
        return volume, set()
    grid = np.stack(np.meshgrid(*np.linspace(*volume, 9).T, indexing="ij"), axis=-1).reshape(-1, 3)
    blind = {name for name, camera in rig.items() if not seen_by(camera, grid).any()}
    if blind:
        findings.append(
            Finding(
                "warning",
                "sees-nothing",
                f"{count_of(len(blind), 'camera')} of {len(rig)} {'sees' if len(blind) == 1 else 'see'} nothing of "
                f"what most see, and {are(blind)} left out",
                names_of(sorted(blind)),
                "Correct their poses, or take them out.",
            )
        )
    return volume, blind


def _odd_angles(camera: Camera) -> str:
    """Return the field of view of a camera, in words, if it is hardly one."""
    angles = [
        float(np.degrees(2.0 * np.arctan(0.5 * side / focal)))
        for side, focal in ((camera.width, camera.focal_x), (camera.height, camera.focal_y))
    ]
    return "" if all(ANGLES[0] <= angle <= ANGLES[1] for angle in angles) else f"{angles[0]:.3g} x {angles[1]:.3g}"


def _judge_duplicates(rig: dict[str, Camera], findings: list[Finding]) -> None:
    """Find cameras at the same place that look the same way."""
    names = list(rig)
    poses = np.array([camera.camera_to_world for camera in rig.values()])
    positions = poses[:, :3, 3]
    middle = np.median(positions, axis=0)
    scale = float(np.median(np.linalg.norm(positions - middle, axis=1)))
    pairs = [
        (names[i], names[j])
        for i, j in sorted(cKDTree(positions).query_pairs(1e-5 * scale + 1e-12))
        if np.abs(poses[i, :3, :3] - poses[j, :3, :3]).max() < 1e-4
    ]
    if pairs:
        findings.append(
            Finding(
                "warning",
                "duplicate-pose",
                f"{count_of(len(pairs), 'pair')} of cameras have the same pose",
                names_of(" = ".join(pair) for pair in pairs),
                "Check that each camera has its own calibration.",
            )
        )


def _judge_up(cameras: Sequence[Camera], findings: list[Finding]) -> None:
    """Find where the cameras' common up is not the world's z."""
    up = up_direction(cameras)
    length = float(np.linalg.norm(up))
    if length < 0.5:  # cameras of all rolls: nothing to say
        return
    axis = int(np.argmax(np.abs(up)))
    if up[2] < np.cos(np.radians(45.0)) * length:
        name = f"{'+' if up[axis] > 0 else '-'}{'xyz'[axis]}"
        findings.append(
            Finding(
                "warning",
                "up-direction",
                f"up is about {name} for these cameras ({np.round(up / length, 2).tolist()}), where z is expected",
                remedy="Reconstruction does not mind; lights and orbits will be turned. Turn the poses to z up.",
            )
        )
