"""Loader of captures whose cameras are 3 x 4 projection matrices, one text file each.

``<image>_P.txt`` holds the twelve numbers of P, row after row; images are in the same folder or in ``images``. P maps a
world point (x, y, z, 1) to a multiple of its pixel (u, v, 1). P and every multiple of it, -P too, are the same camera:
up to scale P = K [R | t] with K upper triangular with a positive diagonal and R a rotation, and K, R and t are unique
if the left 3 x 3 of P is not singular.

Images are often smaller than the grid that the matrices belong to. ``capture.json`` may state ``scale``, the matrices'
pixels per pixel of the images; ``pixel_centers``: ``half`` (the default, as in `Camera`), or ``integer`` if the centre
of the first pixel is (0, 0) in the matrices; and ``color_space``. If the scale is not stated, one scale is inferred for
all images: the whole number from 1 to `MAX_SCALE` that brings the principal points nearest to the images' middle.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from beam_warp.capture.records import (
    COLOR_SPACES,
    IMAGE_FOLDER,
    CaptureContents,
    CaptureRecord,
    camera_name_of,
    mask_beside,
    plate_beside,
    read_json,
    read_text,
)
from beam_warp.errors import AssetFormatError, BeamError, MissingFileError
from beam_warp.image.files import SUFFIXES, image_size
from beam_warp.world.camera import Camera

SUFFIX = "_P.txt"
"""Ending of a matrix file's name, after the name of its image."""

OPTIONS_NAME = "capture.json"

MAX_FILE_BYTES = 65536
"""Largest file of a matrix or of options [byte]."""

MAX_SCALE = 8
"""Largest scale that is inferred; a larger one must be stated."""

MAX_OFF_CENTER = 0.1
"""Largest distance of the principal point from the middle at which a scale is inferred, as a share of the side."""

MAX_SKEW_SHIFT = 0.05
"""Largest displacement of a pixel by skew that is ignored [pixel]."""

SINGULAR = 1e-12
"""Ratio of singular values below which a matrix with rows of equal length counts as singular."""


@dataclass(frozen=True)
class _Options:
    """Contents of ``capture.json``."""

    scale: float | None = None
    pixel_centers: str = "half"
    color_space: str | None = None


@dataclass(frozen=True, eq=False)
class Decomposition:
    """Factors of a projection matrix P = s K [R | t] with t = -R C.

    Attributes:
        intrinsics: K, upper triangular, K[2, 2] = 1 [pixel], ``(3, 3)``.
        rotation: R, world to camera in `Camera`'s axes, ``(3, 3)``.
        position: C, the centre of projection, ``(3,)``.
        negated: True if s is negative.
    """

    intrinsics: NDArray[np.float64]
    rotation: NDArray[np.float64]
    position: NDArray[np.float64]
    negated: bool


def find(folder: Path) -> tuple[Path, ...]:
    """Return the files of a capture's matrices, sorted by name."""
    return tuple(sorted(folder.glob(f"*{SUFFIX}"))) if folder.is_dir() else ()


def decompose(matrix: NDArray[np.float64]) -> Decomposition:
    """Decompose a projection matrix ``(3, 4)``.

    Raises:
        AssetFormatError: The left 3 x 3 is singular, so that there is no finite centre of projection.
    """
    left = matrix[:, :3]
    sizes = np.linalg.norm(left, axis=1, keepdims=True)
    if not (np.isfinite(matrix).all() and (sizes > 0.0).all()):
        raise AssetFormatError("matrix must be finite with three rows that are not 0, got another. Export it again.")
    spread = np.linalg.svd(left / sizes, compute_uv=False)
    if not spread[2] > SINGULAR * spread[0]:
        raise AssetFormatError(
            f"matrix must not be singular, got singular values {spread[0]:.3g} to {spread[2]:.3g}. Export it again: "
            "a pinhole at a finite place has none such."
        )
    position = -np.asarray(np.linalg.solve(left, matrix[:, 3]), np.float64)
    negated = bool(np.linalg.det(left / sizes) < 0.0)
    # RQ by QR of the matrix turned upside down and transposed.
    q, r = np.linalg.qr((-left if negated else left)[::-1].T)
    upper, rotation = r.T[::-1, ::-1], q.T[::-1]
    signs = np.sign(np.diag(upper))
    upper, rotation = upper * signs, rotation * signs[:, None]
    return Decomposition(upper / upper[2, 2], rotation, position, negated)


def read(folder: Path, matrices: Sequence[Path]) -> CaptureContents:
    """Read a capture; see the head of this file. Matrices without an image are left out, with a note.

    Raises:
        MissingFileError: No matrix has an image.
        AssetFormatError: A file is damaged, a matrix is singular, skewed or left-handed, or the scale is not stated
            and cannot be inferred.
    """
    options = _read_options(folder / OPTIONS_NAME)
    found = {path.name.removesuffix(SUFFIX): path for path in matrices}
    images = {stem: path for stem in found if (path := _image_of(folder, stem)) is not None}
    if not images:
        raise MissingFileError(
            f"images must lie in {folder} or its folder {IMAGE_FOLDER}, named as the matrices are, got none for "
            f"{len(found)} matrices. Copy them there."
        )
    notes = []
    if absent := len(found) - len(images):
        notes.append(f"{absent} of {len(found)} matrices have no image and are left out")
    parts = {stem: _decompose_file(found[stem]) for stem in images}
    sizes = {stem: image_size(path) for stem, path in images.items()}
    scale = options.scale
    if scale is None:
        scale = _infer_scale(parts, sizes, folder)
        if scale != 1:
            notes.append(
                f"the matrices are taken to be for {scale:g} times as many pixels as the images have along each side, "
                "which is what brings their principal points to the middle"
            )
    _require_facing(parts, folder)
    shift = 0.5 if options.pixel_centers == "integer" else 0.0
    records = []
    for stem, image in images.items():
        name = image.relative_to(folder).as_posix()
        records.append(
            CaptureRecord(
                camera_name=camera_name_of(name.removeprefix(f"{IMAGE_FOLDER}/")),
                camera=_camera(parts[stem], sizes[stem], scale, shift, found[stem]),
                image_path=image,
                mask_path=mask_beside(folder, name),
                plate_path=plate_beside(folder, camera_name_of(name.removeprefix(f"{IMAGE_FOLDER}/"))),
                color_space=options.color_space,
            )
        )
    return CaptureContents(folder=folder, records=tuple(records), notes=tuple(notes))


def _image_of(folder: Path, stem: str) -> Path | None:
    for inner in (folder / IMAGE_FOLDER, folder):
        for suffix in SUFFIXES:
            for path in (inner / f"{stem}{suffix}", inner / f"{stem}{suffix.upper()}"):
                if path.is_file():
                    return path
    return None


def _read_options(path: Path) -> _Options:
    if not path.is_file():
        return _Options()
    content = read_json(path, "options", MAX_FILE_BYTES)
    known = ("scale", "pixel_centers", "color_space")
    if not isinstance(content, dict) or set(content) - set(known):
        raise AssetFormatError(
            f"options must be a JSON object of {', '.join(known)}, got {str(content)[:60]} at {path}. Correct the file."
        )
    scale, centers, space = (content.get(name) for name in known)
    if scale is not None and (
        isinstance(scale, bool) or not isinstance(scale, (int, float)) or not (1e-3 <= scale <= 1e3)
    ):
        raise AssetFormatError(f"scale must be a number in [0.001, 1000], got {scale!r} at {path}. Correct the file.")
    if centers not in (None, "half", "integer"):
        raise AssetFormatError(f"pixel_centers must be half or integer, got {centers!r} at {path}. Correct the file.")
    if space is not None and not (isinstance(space, str) and space in COLOR_SPACES):
        raise AssetFormatError(
            f"color_space must be one of {', '.join(COLOR_SPACES)}, got {space!r} at {path}. Correct the file."
        )
    return _Options(
        None if scale is None else float(scale), centers or "half", None if space is None else COLOR_SPACES[space]
    )


def _decompose_file(path: Path) -> Decomposition:
    words = read_text(path, MAX_FILE_BYTES).split()
    try:
        values = np.array([float(word) for word in words])
    except ValueError:
        values = np.zeros(0)
    if len(values) != 12 or not np.isfinite(values).all():
        raise AssetFormatError(
            f"matrix must be 3 rows of 4 finite numbers, got {len(words)} words at {path}. Copy the file again."
        )
    try:
        return decompose(values.reshape(3, 4))
    except BeamError as error:
        raise AssetFormatError(f"{error} (at {path})") from error


def _off_center(part: Decomposition, size: tuple[int, int], scale: float) -> float:
    """Return the principal point's distance from the image's middle, as a share of the side."""
    middle = part.intrinsics[:2, 2] / scale / size
    return float(np.abs(middle - 0.5).max())


def _infer_scale(parts: dict[str, Decomposition], sizes: dict[str, tuple[int, int]], folder: Path) -> float:
    """Return the whole scale at which the median principal point is nearest to the middle."""
    off = {
        scale: float(np.median([_off_center(part, sizes[stem], scale) for stem, part in parts.items()]))
        for scale in range(1, MAX_SCALE + 1)
    }
    best = min(off, key=lambda scale: off[scale])
    if not off[best] <= MAX_OFF_CENTER:
        raise AssetFormatError(
            f"scale must be stated where principal points are not near the middle of the images, got "
            f"{off[best]:.0%} of a side away at the best whole scale, {best}, at {folder}. Write "
            f'{{"scale": ...}} into {OPTIONS_NAME} there: pixels of the matrices per pixel of the images.'
        )
    return float(best)


def _require_facing(parts: dict[str, Decomposition], folder: Path) -> None:
    """Refuse mirrored matrices.

    If the sign of a mirrored matrix is changed, the camera has the scene behind it. A single matrix does not tell:
    a mirrored camera and the negative of a camera that looks the other way are the same. Where signs were changed, the
    point nearest to all optical axes is examined: it must lie in front of the cameras, since photographs show it.
    """
    if len(parts) < 2 or not any(part.negated for part in parts.values()):
        return
    positions = np.array([part.position for part in parts.values()])
    axes = np.array([part.rotation[2] for part in parts.values()])
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    normal = across.sum(axis=0)
    if not np.linalg.cond(normal) < 1e6:  # parallel axes meet nowhere
        return
    meeting = np.linalg.solve(normal, np.einsum("nij,nj->i", across, positions))
    negated = np.array([part.negated for part in parts.values()])
    behind = ((meeting - positions) * axes).sum(axis=1) < 0.0
    if (behind & negated).sum() > 0.5 * len(parts):
        raise AssetFormatError(
            f"matrices must be right-handed, got {int(negated.sum())} of {len(parts)} with a determinant that makes "
            f"cameras look away from where their axes meet, at {folder}. Mirror them: pixels must count rows downwards "
            "and the world be right-handed."
        )


def _camera(part: Decomposition, size: tuple[int, int], scale: float, shift: float, path: Path) -> Camera:
    """Return the camera of an image, whose grid is ``scale`` times coarser than the matrix'."""
    width, height = size
    k = part.intrinsics
    moved = abs(k[0, 1]) / k[1, 1] * max(k[1, 2], height * scale - k[1, 2]) / scale
    if not moved <= MAX_SKEW_SHIFT:
        raise AssetFormatError(
            f"matrix must have no skew, got {k[0, 1]:.4g}, which moves pixels by up to {moved:.3g}, at {path}. "
            "Rectify the images, or export the matrix again."
        )
    pose = np.eye(4)
    pose[:3, :3] = part.rotation.T
    pose[:3, 3] = part.position
    try:
        return Camera(
            width,
            height,
            float(k[0, 0] / scale),
            float(k[1, 1] / scale),
            float((k[0, 2] + shift) / scale),
            float((k[1, 2] + shift) / scale),
            pose,
        )
    except BeamError as error:
        raise AssetFormatError(f"matrix is no camera at {path}: {error}") from error
