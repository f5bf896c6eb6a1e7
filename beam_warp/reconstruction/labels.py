"""How far photographs agree with each other where they are stated, and which of them another camera took.

Silhouettes of a round subject look alike from all sides, and a fit takes wrong photographs up as gloss. But what a
photograph shows of the surface agrees with the others' colours where it was taken, and nowhere else: one that hardly
does is tried at every camera.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from beam_warp.capture.views import CapturedView
from beam_warp.reconstruction.initial import view_samples
from beam_warp.world.gaussians import GaussianCloud

MOST_POINTS = 1_024
"""Most points of the surface whose colours are compared, evenly chosen."""

FEWEST_POINTS = 32
"""Fewest points that a camera sees for its photograph to be judged."""

ALIKE = 0.5
"""Explained part from which on a photograph may have been taken by a camera."""

FAR_BETTER = 0.5
"""What another camera leaves unexplained of a photograph, over what its own one does, below which labels were swapped;
and what the middle photograph's own one does, over that, below which others are tried."""

LEAST_CONTRAST = 0.1
"""Standard deviation of colours over their mean below which they tell nothing."""

SOLID = 0.5
"""Coverage from which on a pixel shows the subject."""


@dataclass(frozen=True, eq=False)
class Agreement:
    """How far photographs agree where they are stated.

    Attributes:
        explained: Part of the variance of each one's colours that the others' explain, ``(V,)``; 1 where nothing tells.
        swapped: Which ones agree far better where another camera is, ``(V,)``.
    """

    explained: NDArray[np.float64]
    swapped: NDArray[np.bool_]


def agreement_of(views: Sequence[CapturedView], surface: GaussianCloud, *, device: str | None = None) -> Agreement:
    """Compare what photographs show of a surface; nothing tells where images differ in size.

    Args:
        views: Photographs with coverage.
        surface: Discs on the subject, local z outward.
        device: Warp device; None takes the first CUDA device, or the CPU.
    """
    swapped = np.zeros(len(views), bool)
    if len({(view.camera.width, view.camera.height) for view in views}) > 1:
        return Agreement(np.ones(len(views)), swapped)
    points = surface.select(np.unique(np.linspace(0, len(surface) - 1, MOST_POINTS).astype(int)))
    outward = Rotation.from_quat(points.orientations).apply([0.0, 0.0, 1.0])
    samples = view_samples(views, points, outward, device=device).numpy().astype(np.float64)
    seen = samples[..., 3] > 0.0
    colors = np.where(seen[..., None], samples[..., :3], 0.0)
    total, count = colors.sum(axis=0), seen.sum(axis=0)
    pixels = [view.camera.project(points.positions)[:, :2] for view in views]

    def explained(photograph: int, camera: int) -> float:
        """Return what all but these two explain of a photograph at a camera's place."""
        left_out = list({photograph, camera})
        others = count - seen[left_out].sum(axis=0)
        rows = np.flatnonzero(seen[camera] & (others > 0))
        column, row = pixels[camera][rows].astype(int).T
        alpha = views[photograph].alpha
        assert alpha is not None
        held = alpha[row, column] > SOLID
        rows, column, row = rows[held], column[held], row[held]
        shown = views[photograph].color[row, column] / alpha[row, column, None]
        known = (total - colors[left_out].sum(axis=0))[rows] / others[rows, None]
        return _explained(shown.astype(np.float64), known)

    own = np.array([explained(view, view) for view in range(len(views))])
    for view in np.flatnonzero(1.0 - own > np.median(1.0 - own) / FAR_BETTER).tolist():
        best = max(explained(view, camera) for camera in range(len(views)) if camera != view)
        swapped[view] = ALIKE < best < 1.0 and 1.0 - best < FAR_BETTER * (1.0 - own[view])
    return Agreement(own, swapped)


def _explained(colors: NDArray[np.float64], others: NDArray[np.float64]) -> float:
    """Return the part of the variance of colours ``(N, 3)`` that others explain; 1 where nothing tells."""
    if len(colors) < FEWEST_POINTS:
        return 1.0
    one, other = colors - colors.mean(axis=0), others - others.mean(axis=0)
    if not min(one.std() / max(colors.mean(), 1e-12), other.std() / max(others.mean(), 1e-12)) > LEAST_CONTRAST:
        return 1.0
    met = float((one * other).sum()) / float(np.sqrt(np.square(one).sum() * np.square(other).sum()))
    return max(met, 0.0) ** 2
