"""What a photograph says about the numbers of its camera: normal equations, solutions and honest errors.

A render of the subject moves with the camera: the image's derivative to a number of the camera is minus its gradient
times the flow that the number causes at the drawn depth. Differences between photograph and render, weighted against
outliers (Huber), are a linear function of the numbers. Each field of pixels gives a score of its own, and their scatter
gives the covariance of a solution, whatever the errors of neighbouring pixels have in common (White 1980, by clusters).

The gains of the photograph's colours are solved for with the numbers and left out of the result: a camera that is too
bright seems to have turned to where the subject is brighter.

Errors that a whole view has in common, of a model whose surface shines or is not there yet, do not show in that
scatter. `MODEL_ERROR` stands for them: it is measured in rigs that are exact.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

from beam_warp.world.camera import Camera

KINDS: Mapping[str, slice] = MappingProxyType(
    {"turn": slice(0, 3), "shift": slice(3, 6), "focal": slice(6, 7), "center": slice(7, 9), "radial": slice(9, 11)}
)
"""Numbers of a camera, by kind: turn [rad] and shift [m] in its axes (right, down, forward), the logarithm of the
focal lengths' factor, principal point [focal length], and the two radial terms of a lens that is drawn as a pinhole."""

NUMBERS = 11
"""Numbers of all kinds."""

FIELD = 24
"""Side of the fields of pixels whose scores are told apart [pixel]: about twice the window of structural similarity. In
small images it is a third of the shorter side."""

OUTLIER = 1.5
"""Differences beyond so many robust standard deviations count by their sign only."""

SEEN = 0.3
"""A pixel has a depth of its own where so much of it is covered; others take the nearest one."""

MODEL_ERROR = 1.6
"""Standard errors are so many times what the scatter of fields says: of exact rigs, solutions scatter by so much."""


ENCODED_KNEE = 0.04045
"""Where the sRGB curve begins to be a power."""


def flow(camera: Camera, depth: NDArray[np.float64], pixels: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return how points move in an image with each number of its camera, ``(11, 2, ...)`` [pixel].

    Args:
        camera: The camera.
        depth: Of the points along the optical axis [m], above 0, ``(...)``.
        pixels: Where the image shows them, ``(2, ...)``.
    """
    u, v = (pixels[0] - camera.center_x) / camera.focal_x, (pixels[1] - camera.center_y) / camera.focal_y
    none, one, square = np.zeros_like(u), np.ones_like(u), u * u + v * v
    away = 1.0 / depth
    tangents = np.array(
        [
            *([-u * v, -one - v * v], [one + u * u, u * v], [-v, u]),
            *([away, none], [none, away], [-u * away, -v * away]),
            [u, v],
            *([one, none], [none, one]),
            *([u * square, v * square], [u * square**2, v * square**2]),
        ]
    )
    focal = np.array([camera.focal_x, camera.focal_y]).reshape(1, 2, *[1] * u.ndim)
    return tangents * focal


def flow_of(camera: Camera, points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return `flow` of points of the world ``(N, 3)`` that the camera has in front of it, ``(11, 2, M)``."""
    x, y, z = camera.project(points).T
    ahead = np.isfinite(x) & np.isfinite(y) & (z > 0.0)
    return flow(camera, z[ahead], np.stack([x, y])[:, ahead])


@dataclass(frozen=True, eq=False)
class Evidence:
    """What a photograph says about its camera.

    Attributes:
        informations: Normal matrices of the fields, of the numbers and, after them, of gains that are not asked for,
            ``(fields, n, n)``.
        scores: Their right-hand sides, ``(fields, n)``.
    """

    informations: NDArray[np.float64]
    scores: NDArray[np.float64]

    def solved(self, kinds: Collection[str]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the numbers of some kinds that explain the photograph best, ``(11,)``, and their covariance.

        Numbers of other kinds are 0, and are taken for known. So is all of a photograph that shows nothing.
        """
        wanted = rows_of(kinds)
        numbers, covariance = np.zeros(NUMBERS), np.zeros((NUMBERS, NUMBERS))
        others = np.arange(NUMBERS, self.scores.shape[1])
        chosen = np.concatenate([wanted, others[self.informations[:, others, others].any(axis=0)]])
        fields = self.informations[:, chosen][:, :, chosen]
        information = fields.sum(axis=0)
        size = np.sqrt(np.diag(information))
        surplus = len(self.scores) - len(chosen)
        if not (len(wanted) and surplus > 0 and size.all()):
            return numbers, covariance
        inverse = np.linalg.pinv(information / np.outer(size, size), rcond=1e-9, hermitian=True) / np.outer(size, size)
        solution = inverse @ self.scores[:, chosen].sum(axis=0)
        left = (self.scores[:, chosen] - fields @ solution) @ inverse
        numbers[wanted] = solution[: len(wanted)]
        spread = left.T @ left * (MODEL_ERROR**2 * len(self.scores) / surplus)
        covariance[np.ix_(wanted, wanted)] = spread[: len(wanted), : len(wanted)]
        return numbers, covariance


def rows_of(kinds: Collection[str]) -> NDArray[np.int64]:
    """Return the places of the numbers of some kinds, in their order."""
    chosen = [np.arange(NUMBERS)[part] for kind, part in KINDS.items() if kind in kinds]
    return np.concatenate([np.zeros(0, int), *chosen])


def evidence(
    drawn: NDArray[np.floating], photograph: NDArray[np.floating], depth: NDArray[np.floating], camera: Camera
) -> Evidence:
    """Return what a photograph says about the camera that a render was drawn for.

    Args:
        drawn: The render's channels, encoded for display, the last one coverage, ``(H, W, C)``.
        photograph: The same channels of the photograph.
        depth: Of what was drawn, along the optical axis [m], ``(H, W)``.
        camera: The camera, of that size.
    """
    rows, columns = (np.gradient(np.asarray(drawn, np.float64), axis=axis) for axis in range(2))
    away = np.asarray(photograph, np.float64) - drawn
    depth = _spread(np.asarray(depth, np.float64), drawn[..., -1] > SEEN)
    lengths = np.sqrt(np.mean(away * away, axis=2))
    brighter = _brighter(np.asarray(drawn, np.float64))
    limit = OUTLIER * 1.4826 * np.median(lengths[(rows * rows + columns * columns).any(axis=2)] if rows.any() else 0.0)
    weights = np.minimum(1.0, limit / np.maximum(lengths, 1e-12)) if limit > 0.0 else np.ones_like(lengths)
    informations, scores = [], []
    places = np.mgrid[: depth.shape[0], : depth.shape[1]][::-1] + 0.5
    side = int(np.clip(min(depth.shape) // 3, 4, FIELD))
    for top in range(0, depth.shape[0], side):
        for left in range(0, depth.shape[1], side):
            part = np.s_[top : top + side, left : left + side]
            if not (rows[part].any() or columns[part].any()):
                continue
            moves = flow(camera, depth[part], places[:, *part])[:, :, ..., None]
            slopes = -(columns[part] * moves[:, 0] + rows[part] * moves[:, 1])
            slopes = np.concatenate([slopes, brighter[:, *part]])
            flat, weighted = (array.reshape(len(slopes), -1) for array in (slopes, slopes * weights[part][..., None]))
            informations.append(weighted @ flat.T)
            scores.append(weighted @ away[part].reshape(-1))
    count = NUMBERS + len(brighter)
    return Evidence(np.array(informations).reshape(-1, count, count), np.array(scores).reshape(-1, count))


def _brighter(drawn: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the derivatives of an encoded image ``(H, W, C)`` to the logarithms of its colours' gains.

    The last channel is coverage, and has no gain: ``(C - 1, H, W, C)``.
    """
    count = drawn.shape[-1]
    slopes = np.where(drawn > ENCODED_KNEE, (drawn + 0.055) / 2.4, drawn)
    return slopes * np.eye(count)[: count - 1, None, None]


def _spread(depth: NDArray[np.float64], is_seen: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Return the depth of every pixel, that of the nearest covered one where it has none; 1 m where there is none."""
    is_seen = is_seen & (depth > 0.0)
    if not is_seen.any():
        return np.ones_like(depth)
    nearest = distance_transform_edt(~is_seen, return_distances=False, return_indices=True)
    assert isinstance(nearest, np.ndarray)
    return depth[tuple(nearest)]


def strength(found: Sequence[Evidence], kinds: Collection[str], kind: str) -> NDArray[np.float64]:
    """Return how many standard errors each camera's numbers of a kind are from 0, solved with those of others.

    Args:
        found: What each photograph says.
        kinds: Kinds that are solved for.
        kind: One of them.

    Returns:
        Root mean square over the kind's numbers, ``(V,)``; 0 where a photograph says nothing.
    """
    rows = rows_of([kind])
    result = np.zeros(len(found))
    for view, says in enumerate(found):
        numbers, covariance = says.solved(kinds)
        if (part := covariance[np.ix_(rows, rows)]).any():
            result[view] = np.sqrt(
                max(0.0, numbers[rows] @ np.linalg.pinv(part, hermitian=True) @ numbers[rows]) / len(rows)
            )
    return result
