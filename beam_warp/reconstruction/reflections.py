"""What Gaussians reflect of the capture's light while they are fitted, and afterwards the harmonics that stand for it.

Harmonics of low degree cannot show a highlight. Where nothing else may depend on the direction, fits imitate highlights
by geometry: discs at wrong depths that only some cameras see. If the light is known, two numbers for a Gaussian say
more: how rough it is, and which part of the lobe is open. Its normal is that of its disc, which is left as it is:
turned by the slopes of highlights, discs of flat faces bent.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from beam_warp.device.arrays import upload
from beam_warp.kernels.reconstruction.reflections import (
    Reflectors,
    launch_add_reflections,
    launch_gloss_gradients,
    launch_reflect_towards,
)
from beam_warp.light.prefiltered import blurred_environment
from beam_warp.raster.records import GaussianArrays
from beam_warp.world.directions import even_directions
from beam_warp.world.environment import EnvironmentMap
from beam_warp.world.harmonics import sh_basis

FIRST_GLOSS = (0.0, 0.85)
"""Logits with which fits begin: halfway between smooth and rough, and seven tenths of the lobe open."""

DIRECTIONS = 96
"""Directions of a sphere towards which reflections are evaluated for their harmonics: a Gaussian faces half of them,
five for each coefficient."""

RIDGE = 0.01
"""Weight of small coefficients, over that of what a Gaussian shows: the side that it turns away says nothing."""

ROWS_AT_ONCE = 16_384
"""Gaussians whose harmonics are solved for at a time: some 100 MB."""


class Reflections:
    """What the Gaussians of a fit reflect; an `ExtraColors` of the rasteriser.

    Attributes:
        gloss: Logits of each Gaussian's roughness and of the part of its lobe that is open, ``(N,)`` vec2.
        gradients: Derivatives of a loss to these, of the last frame, ``(N,)`` vec2.
    """

    def __init__(self, environment: EnvironmentMap, count: int, device: Any) -> None:
        """Blur the light, and let all Gaussians begin alike."""
        self._light = blurred_environment(environment, device)
        self._device = device
        self.gloss = wp.full(count, wp.vec2(*FIRST_GLOSS), dtype=wp.vec2, device=device)
        self.gradients = wp.zeros_like(self.gloss)

    def add(self, gaussians: GaussianArrays, views: wp.array, colors: wp.array) -> None:
        """Add what each splat's Gaussian reflects towards the camera to the colours of splats."""
        launch_add_reflections(self._light, self._reflectors(gaussians), views, colors, self._device)

    def differentiate(self, gaussians: GaussianArrays, views: wp.array, color_gradients: wp.array) -> None:
        """Write `gradients`, from those of the splats' colours; normals and places are taken as they are."""
        reflectors = self._reflectors(gaussians)
        launch_gloss_gradients(
            len(self.gloss), self._light, reflectors, views, color_gradients, self.gradients, self._device
        )

    def harmonics(self, gaussians: GaussianArrays, sides: NDArray[np.floating], degree: int) -> NDArray[np.float32]:
        """Return the spherical harmonics nearest to what Gaussians reflect, ``(N, (degree + 1)^2, 3)``.

        Least squares over the half of all directions that each faces, by how large it looks from there.

        Args:
            gaussians: As they were drawn.
            sides: On which side of each it is seen, ``(N, 3)`` of any length; 0 for what is not, which has none.
            degree: Degree of the harmonics.
        """
        device, reflectors = self._device, self._reflectors(gaussians)
        towards = even_directions(DIRECTIONS)
        basis = sh_basis(-towards, degree)  # colours are those seen along a direction, from the camera
        products = (basis[:, :, None] * basis[:, None, :]).reshape(DIRECTIONS, -1)
        ridge = np.diag([0.0] + [RIDGE / (4.0 * np.pi)] * (basis.shape[1] - 1))
        directions, outside = upload(towards.astype(np.float32), wp.vec3, device), upload(sides, wp.vec3, device)
        is_seen: NDArray[np.bool_] = np.any(sides != 0.0, axis=1)
        result = np.zeros((len(self.gloss), basis.shape[1], 3), np.float32)
        for start in range(0, len(result), ROWS_AT_ONCE):
            part = result[start : start + ROWS_AT_ONCE]
            count = len(part)
            cosines = wp.empty((count, DIRECTIONS), dtype=float, device=device)
            colors = wp.empty((count, DIRECTIONS), dtype=wp.vec3, device=device)
            launch_reflect_towards(self._light, reflectors, start, outside, directions, cosines, colors, device)
            weights = cosines.numpy().astype(np.float64)
            total = weights.sum(axis=1)
            shown = np.flatnonzero((total > 0.0) & is_seen[start : start + count])
            weights /= np.maximum(total, 1e-12)[:, None]
            weighted = weights[..., None] * colors.numpy()
            matrices = (weights @ products).reshape(count, basis.shape[1], -1) + ridge
            values = np.einsum("ki,nkc->nic", basis, weighted, optimize=True)
            part[shown] = np.linalg.solve(matrices[shown], values[shown])
        return result

    def _reflectors(self, gaussians: GaussianArrays) -> Reflectors:
        reflectors = Reflectors()
        reflectors.positions, reflectors.orientations = gaussians.positions, gaussians.orientations
        reflectors.scales, reflectors.gloss = gaussians.scales, self.gloss
        return reflectors
