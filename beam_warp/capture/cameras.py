"""Faults of a capture's cameras, as far as poses and intrinsics show them."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from beam_warp.capture.findings import Findings, are, count_of
from beam_warp.capture.rigs import frustum_volume, likely_mistakes, seen_by, up_direction
from beam_warp.errors import InvalidOptionError
from beam_warp.world.camera import Camera

MIN_CAMERAS = 2
"""Fewest cameras of a frame: depth needs two."""

FEW_CAMERAS = 8
"""Below this number, most of a surface is seen by one camera or none; the paper uses at least 8."""

ANGLES = (0.05, 175.0)
"""Smallest and largest field of view of sound intrinsics [degree]."""

Volume = tuple[NDArray[np.float64], NDArray[np.float64]]
"""Lower and upper corner of a box [m], ``(3,)`` each."""


def judge_cameras(rig: Mapping[str, Camera], split: str, findings: Findings) -> tuple[Volume | None, set[str]]:
    """Check poses and intrinsics.

    Args:
        rig: Training cameras by name.
        split: The split that they belong to, for messages.
        findings: List to which findings are added.

    Returns:
        The volume that most cameras see, None if there is none; and the names of cameras that see nothing of it.
    """
    _judge_count(len(rig), split, findings)
    _judge_intrinsics(rig, findings)
    if len(rig) < MIN_CAMERAS:
        return None, set()
    _judge_duplicates(rig, findings)
    mistakes = likely_mistakes(list(rig.values()))
    if mistakes:
        findings.add(
            "error",
            "swapped-axes",
            "the cameras do not look at a common place, and would with their axes changed",
            remedy=f"Probably {'; or '.join(mistakes)}.",
        )
    _judge_up(rig, findings)
    try:
        volume = frustum_volume(list(rig.values()))
    except InvalidOptionError:
        findings.add(
            "error",
            "no-overlap",
            "the cameras have no volume in common",
            remedy="Check the poses: their axes, their units, and that they are camera-to-world.",
        )
        return None, set()
    return volume, set() if mistakes else _judge_blind(rig, volume, findings)


def _judge_count(count: int, split: str, findings: Findings) -> None:
    """Find too few cameras."""
    if count < MIN_CAMERAS:
        findings.add(
            "error",
            "too-few-cameras",
            f"{count_of(count, 'camera')} to train from, where depth needs {MIN_CAMERAS}",
            remedy=f"Add cameras, or give records the split {split}.",
        )
    elif count < FEW_CAMERAS:
        findings.warn(
            "few-cameras",
            f"{count} cameras leave parts of the surface that no two of them see",
            remedy=f"Expect holes; {FEW_CAMERAS} or more all around are better.",
        )


def _judge_intrinsics(rig: Mapping[str, Camera], findings: Findings) -> None:
    """Find fields of view, principal points and pixel shapes that no usual camera has."""
    singular = {name: angles for name, camera in rig.items() if (angles := _odd_angles(camera))}
    if singular:
        findings.add(
            "error",
            "singular-intrinsics",
            f"fields of view of {next(iter(singular.values()))} are beyond {ANGLES[0]:g} to {ANGLES[1]:g} degrees",
            singular,
            "Correct the focal lengths: they are in pixels.",
        )
    outside = [name for name, c in rig.items() if not (0 <= c.center_x <= c.width and 0 <= c.center_y <= c.height)]
    if outside:
        findings.warn(
            "principal-point",
            f"the principal point lies outside of the images of {count_of(len(outside), 'camera')}",
            outside,
            "Right for crops only: check that cx and cy are in pixels of these images.",
        )
    uneven = [name for name, c in rig.items() if not (2 / 3 <= c.focal_x / c.focal_y <= 3 / 2)]
    if uneven:
        findings.warn(
            "uneven-pixels",
            f"focal lengths along x and y differ by more than half for {count_of(len(uneven), 'camera')}",
            uneven,
            "Check fl_x and fl_y.",
        )


def _odd_angles(camera: Camera) -> str:
    """Return a camera's field of view in words if it is out of range, else an empty string."""
    angles = [
        float(np.degrees(2.0 * np.arctan(0.5 * side / focal)))
        for side, focal in ((camera.width, camera.focal_x), (camera.height, camera.focal_y))
    ]
    return "" if all(ANGLES[0] <= angle <= ANGLES[1] for angle in angles) else f"{angles[0]:.3g} x {angles[1]:.3g}"


def _judge_duplicates(rig: Mapping[str, Camera], findings: Findings) -> None:
    """Find cameras at the same place that look the same way."""
    names = list(rig)
    poses = np.array([camera.camera_to_world for camera in rig.values()])
    positions = poses[:, :3, 3]
    middle = np.median(positions, axis=0)
    scale = float(np.median(np.linalg.norm(positions - middle, axis=1)))
    rows = np.concatenate([positions / (1e-5 * scale + 1e-12), poses[:, :3, :3].reshape(-1, 9) / 1e-4], axis=1)
    pairs = [f"{names[i]} = {names[j]}" for i, j in _neighbours(rows)]
    if pairs:
        findings.warn(
            "duplicate-pose",
            f"{count_of(len(pairs), 'pair')} of cameras have the same pose",
            pairs,
            "Check that each camera has its own calibration.",
        )


def _neighbours(rows: NDArray[np.float64]) -> list[tuple[int, int]]:
    """Return pairs of rows that differ by less than 1 everywhere: of each row one at most, so that few are many."""
    found: dict[bytes, int] = {}
    pairs = {(i, row) for row, values in enumerate(rows) if (i := found.setdefault(values.tobytes(), row)) != row}
    firsts = np.array([*found.values()])
    distances, nearest = cKDTree(rows[firsts]).query(rows[firsts], k=[2], p=np.inf, distance_upper_bound=1.0)
    close = np.isfinite(distances[:, 0])
    near = np.stack([firsts[close], firsts[nearest[close, 0]]], axis=1)
    return sorted(pairs | {(min(i, j), max(i, j)) for i, j in near.tolist()})


def _judge_up(rig: Mapping[str, Camera], findings: Findings) -> None:
    """Find a common up of the cameras that is not the world's z."""
    up = up_direction(list(rig.values()))
    length = float(np.linalg.norm(up))
    if length < 0.5:  # cameras of all rolls have no up
        return
    axis = int(np.argmax(np.abs(up)))
    if up[2] < np.cos(np.radians(45.0)) * length:
        name = f"{'+' if up[axis] > 0 else '-'}{'xyz'[axis]}"
        findings.warn(
            "up-direction",
            f"up is about {name} for these cameras ({np.round(up / length, 2).tolist()}), where z is expected",
            remedy="Reconstruction does not mind; lights and orbits will be turned. Turn the poses to z up.",
        )


def _judge_blind(rig: Mapping[str, Camera], volume: Volume, findings: Findings) -> set[str]:
    """Return the names of cameras that see nothing of the common volume."""
    grid = np.stack(np.meshgrid(*np.linspace(*volume, 9).T, indexing="ij"), axis=-1).reshape(-1, 3)
    blind = {name for name, camera in rig.items() if not seen_by(camera, grid).any()}
    if blind:
        findings.warn(
            "sees-nothing",
            f"{count_of(len(blind), 'camera')} of {len(rig)} {'sees' if len(blind) == 1 else 'see'} nothing of "
            f"what most see, and {are(blind)} left out",
            sorted(blind),
            "Correct their poses, or take them out.",
        )
    return blind
