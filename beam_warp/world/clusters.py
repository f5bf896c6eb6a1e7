"""What clusters of Gaussians become: one Gaussian each, by the moments of its members, moving as they move."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.spatial.transform import Rotation

from beam_warp.world.gaussians import GaussianCloud
from beam_warp.world.quaternions import rotation_matrices

MOST_OPACITY = 0.99
"""Opacity of merged Gaussians ends where the rasteriser's alpha does; what is beyond makes them wider."""

GEOMETRY = ("positions", "orientations", "scales", "opacities")
"""What merges by mass; the rest merges by the pixels that members are worth."""

FloatArray = NDArray[np.float64]


class Clusters:
    """Clusters of the Gaussians of a constant topology, and the Gaussian that each of them is in any frame.

    Geometry is weighted by optical mass, -log(1 - opacity) times the area that a Gaussian shows, which is conserved:
    two Gaussians in one place absorb as one of the sum of their depths (Beer and Lambert). Materials are weighted by
    the pixels in which members are seen. Clusters move by the mean of their members' motions.

    Attributes:
        heaviest: Row of the member of each cluster that is worth most, ``(K,)``.
    """

    def __init__(self, reference: GaussianCloud, labels: NDArray[np.integer], visible: NDArray[np.floating]) -> None:
        """Merge the reference frame.

        Args:
            reference: The frame that shapes are taken from, in the world's axes.
            labels: The cluster of every Gaussian, 0 … K - 1, each at least once; ``(N,)``.
            visible: Pixels that each Gaussian is worth, ``(N,)``.
        """
        self._reference, self._labels = reference, np.asarray(labels)
        mass = optical_mass(reference)
        self._mass = self._shares(mass + 1e-9 * mass.max(initial=1e-30))
        seen = np.asarray(visible, np.float64)
        self._seen = self._shares(
            seen + 1e-6 * (mass / max(mass.max(initial=0.0), 1e-30) + 1e-3) * (seen.mean() + 1e-9)
        )
        order = np.lexsort((np.arange(len(mass)), -(seen + 1e-9 * mass), self._labels))
        self.heaviest = order[np.flatnonzero(np.diff(self._labels[order], prepend=-1))]
        self._orientations, self._scales, self._depth = self._shapes(mass)

    def __len__(self) -> int:
        """Return the number of clusters."""
        return len(self.heaviest)

    def _shares(self, weight: FloatArray) -> csr_array:
        """Return the matrix that takes the weighted mean of every cluster, ``(K, N)``."""
        total = np.bincount(self._labels, weight)
        entries = weight / total[self._labels]
        return csr_array((entries, (self._labels, np.arange(len(weight)))), shape=(len(total), len(weight)))

    def _shapes(self, mass: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return orientations, scales and optical depths of the clusters in the reference frame."""
        cloud = self._reference
        axes = rotation_matrices(cloud.orientations) * cloud.scales[:, None, :].astype(np.float64)
        places = cloud.positions.astype(np.float64)
        away = places - (self._mass @ places)[self._labels]
        spread = axes @ axes.transpose(0, 2, 1) + away[:, :, None] * away[:, None, :]
        squares, turned = np.linalg.eigh((self._mass @ spread.reshape(-1, 9)).reshape(-1, 3, 3))
        turned[:, :, 2] *= np.sign(np.linalg.det(turned))[:, None]
        orientations, scales = Rotation.from_matrix(turned).as_quat(), np.sqrt(np.maximum(squares, 0.0))
        alone = np.bincount(self._labels)[self._labels[self.heaviest]] == 1
        orientations[alone] = cloud.orientations[self.heaviest[alone]]
        scales[alone] = cloud.scales[self.heaviest[alone]]
        depth = np.bincount(self._labels, mass) / np.maximum(shown_area(scales), 1e-30)
        deepest = -np.log1p(-MOST_OPACITY)
        wider = np.where(alone, 1.0, np.sqrt(np.maximum(depth / deepest, 1.0)))
        larger = np.argsort(np.argsort(scales, axis=1), axis=1) > 0  # the two that lie in the surface
        return orientations, np.where(larger, scales * wider[:, None], scales), np.minimum(depth, deepest)

    def cloud(self, frame: GaussianCloud) -> GaussianCloud:
        """Return the merged Gaussians of a frame, whose axes are those of the reference."""
        turn, places = self.motion(frame)
        stretch = self._mass @ np.log(np.maximum(frame.scales, 1e-12) / np.maximum(self._reference.scales, 1e-12))
        opaque = [self._mass @ cloud.opacities.astype(np.float64) for cloud in (frame, self._reference)]
        return GaussianCloud(
            positions=places.astype(np.float32),
            orientations=(turn * Rotation.from_quat(self._orientations)).as_quat(),
            scales=self._scales * np.exp(np.asarray(stretch).mean(axis=1, keepdims=True)),
            opacities=np.clip(-np.expm1(-self._depth) * opaque[0] / np.maximum(opaque[1], 1e-9), 0.0, 1.0),
            axes=frame.axes,
            radiance_color_space=frame.radiance_color_space,
            **{name: self._merged(frame, name) for name in frame.arrays() if name not in GEOMETRY},
        )

    def motion(self, frame: GaussianCloud) -> tuple[Rotation, FloatArray]:
        """Return how clusters are turned since the reference frame, and where they are [m], ``(K, 3)``."""
        if frame.orientations is self._reference.orientations:
            turns = np.tile([0.0, 0.0, 0.0, 1.0], (len(self), 1))
        else:
            since = Rotation.from_quat(frame.orientations) * Rotation.from_quat(self._reference.orientations).inv()
            rows = since.as_quat()
            rows *= np.where((rows * rows[self.heaviest][self._labels]).sum(axis=1, keepdims=True) < 0.0, -1.0, 1.0)
            turns = self._mass @ rows
        return Rotation.from_quat(turns), self._mass @ frame.positions.astype(np.float64)

    def _merged(self, frame: GaussianCloud, name: str) -> NDArray[Any]:
        """Return an array of the merged Gaussians, by name."""
        array = getattr(frame, name)
        if name in ("ids", "observability"):
            return array[self.heaviest]
        rows = array.reshape(len(array), -1).astype(np.float64)
        if name.endswith("_error"):  # what is known of one member, and how far members are apart
            value = getattr(frame, name.removesuffix("_error")).reshape(len(array), -1).astype(np.float64)
            apart = value - (self._seen @ value)[self._labels]
            found = np.sqrt(self._seen @ (np.square(rows) + np.square(apart)))
        else:
            found = self._seen @ rows
        if name == "normals":
            found = unit(found, frame.normals[self.heaviest])  # type: ignore[index]
        return found.reshape(len(self), *array.shape[1:]).astype(np.float32)


def shown_area(scales: NDArray[np.floating]) -> FloatArray:
    """Return the mean area that Gaussians show from all sides, but for a factor [m^2], ``(N,)``."""
    a, b, c = np.square(np.asarray(scales, np.float64)).T
    return np.sqrt(a * b + b * c + c * a)


def optical_mass(cloud: GaussianCloud) -> FloatArray:
    """Return what merging conserves: optical depth times area [m^2], ``(N,)``."""
    return -np.log1p(-np.minimum(cloud.opacities.astype(np.float64), MOST_OPACITY)) * shown_area(cloud.scales)


def unit(rows: NDArray[np.floating], instead: NDArray[np.floating]) -> FloatArray:
    """Return rows ``(N, 3)`` of length 1, those of ``instead`` where there is none."""
    rows = np.asarray(rows, np.float64)
    length = np.linalg.norm(rows, axis=1, keepdims=True)
    return np.where(length > 1e-6, rows / np.maximum(length, 1e-6), instead)
