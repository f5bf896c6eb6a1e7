"""Gaussians as an optimiser moves them: raw arrays on a device, the splats drawn from them, and their gradients."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from beam_warp.capture.views import CapturedView
from beam_warp.checks import require_choice, require_count
from beam_warp.device.array_checks import float_rows
from beam_warp.device.arrays import upload
from beam_warp.errors import InvalidArrayError
from beam_warp.image.color import LINEAR_REC709
from beam_warp.kernels.common.row_sums import launch_add_rows
from beam_warp.kernels.reconstruction.activation import (
    Shapes,
    launch_activate,
    launch_add_shape_gradients,
    launch_drop_out,
)
from beam_warp.raster.adam import Adam, Parameters
from beam_warp.raster.records import GaussianArrays, GaussianGradients
from beam_warp.reconstruction.reflections import Reflections
from beam_warp.world.environment import EnvironmentMap
from beam_warp.world.gaussians import MAX_SH_DEGREE, GaussianCloud

SMALLEST_SCALE = 1e-7
"""Scale from which a scale of 0 is moved [m]."""

LOGIT_LIMIT = 9.0
"""Largest logit of an opacity: those of 0 and 1 are moved from sigmoid(-9) and sigmoid(9)."""

DEAD_LOGIT = -30.0
"""Logit of a row that is no Gaussian: it is not drawn, and has no gradient."""


class GaussianParameters:
    """Rows of Gaussians that steps of an optimiser move; rows without a Gaussian wait for one.

    Attributes:
        device: Warp device that holds them.
        positions: ``(N,)`` vec3 [m].
        orientations: ``(N,)`` quat xyzw, of any length.
        radiance: ``(N, B)`` vec3 spherical harmonics, scene-linear.
        gloss: Logits of roughness and of the open part of lobes, ``(N,)`` vec2; only with a known light.
        reflections: What they reflect of a known light; None without, and once `settle_reflections` was called.
        drawn: Gaussians as the rasteriser takes them; `activate` brings scales and opacities up to date.
    """

    def __init__(
        self,
        cloud: GaussianCloud,
        device: Any,
        *,
        row_count: int | None = None,
        sh_degree: int = 2,
        environment: EnvironmentMap | None = None,
    ) -> None:
        """Bring a cloud to a device.

        Args:
            cloud: Where steps begin, with scene-linear radiance.
            device: Warp device.
            row_count: Room for Gaussians, at least the cloud's; its number without.
            sh_degree: Of the radiance; the cloud's is cut or filled up with zeros.
            environment: The light that Gaussians reflect, beside what their radiance says; None for none.

        Raises:
            InvalidArrayError: The cloud has no radiance, or not in scene-linear Rec.709.
            InvalidOptionError: ``row_count`` or ``sh_degree`` is out of range.
        """
        captured = require_scene_linear("start", cloud)
        count = len(cloud)
        rows = count if row_count is None else require_count("row_count", row_count, count)
        require_count("sh_degree", sh_degree, 0, MAX_SH_DEGREE)
        self.device = device

        def padded(array: Any, fill: float = 0.0) -> Any:
            result = np.full((rows, *array.shape[1:]), fill, np.float32)
            result[:count] = array
            return result

        bands = (sh_degree + 1) ** 2
        radiance = np.zeros((count, bands, 3), np.float32)
        kept = min(bands, captured.shape[1])
        radiance[:, :kept] = captured[:, :kept]
        opacities = np.clip(cloud.opacities.astype(np.float64), 1e-12, 1.0 - 1e-12)
        logits = np.clip(np.log(opacities / (1.0 - opacities)), -LOGIT_LIMIT, LOGIT_LIMIT)
        self.positions = upload(padded(cloud.positions), wp.vec3, device)
        self.orientations = upload(padded(cloud.orientations), wp.quat, device)
        self.radiance = upload(padded(radiance), wp.vec3, device)
        self.log_scales = upload(padded(np.log(np.maximum(cloud.scales, SMALLEST_SCALE)), -10.0), wp.vec3, device)
        self.logits = upload(padded(logits, DEAD_LOGIT), float, device)
        self.filters = wp.zeros(rows, dtype=float, device=device)
        self._gradients = {
            name: wp.zeros_like(getattr(self, name))
            for name in ("positions", "orientations", "radiance", "log_scales", "logits")
        }
        self.reflections = None if environment is None else Reflections(environment, rows, device)
        self.drawn = GaussianArrays(
            self.positions,
            self.orientations,
            wp.zeros(rows, dtype=wp.vec3, device=device),
            wp.zeros(rows, dtype=float, device=device),
            None,
            self.radiance,
            self.reflections,
        )
        if self.reflections is not None:
            self.gloss = self.reflections.gloss
            self._gradients["gloss"] = self.reflections.gradients
        self._turns = wp.zeros(rows, dtype=int, device=device)
        self._shapes = Shapes()
        self._shapes.log_scales, self._shapes.logits, self._shapes.filters = self.log_scales, self.logits, self.filters
        self.activate()

    def __len__(self) -> int:
        """Return the number of rows, with a Gaussian or without."""
        return self.positions.shape[0]

    def activate(self) -> None:
        """Bring the drawn scales and opacities up to date."""
        launch_activate(self.drawn.scales.size, self._shapes, self.drawn.scales, self.drawn.opacities, self.device)

    def drop_out(self, part: float, seed: int) -> None:
        """Draw a random part of the Gaussians no more, until `activate` is called; others each time.

        Opacities of the others rise, so that the light that passes them all is the same in the mean, as far as
        `ALPHA_MAX` allows. Gradients are not told: Adam, which divides them by their size, need not know.

        Args:
            part: How large a part, in [0, 1).
            seed: Same seed, same Gaussians.
        """
        launch_drop_out(len(self), part, seed, self._turns, self.drawn.opacities, self.device)

    def settle_reflections(self, sides: NDArray[np.floating]) -> None:
        """Let harmonics stand for what Gaussians reflect from now on: draw `drawn` anew.

        Args:
            sides: On which side of each it is seen, ``(N, 3)`` of any length.
        """
        if self.reflections is None:
            return
        degree = math.isqrt(self.radiance.shape[1]) - 1
        radiance = self.radiance.numpy() + self.reflections.harmonics(self.drawn, sides, degree)
        wp.copy(self.radiance, upload(radiance, wp.vec3, self.device))
        self.drawn = self.drawn._replace(extra=None)
        self.reflections.gradients.zero_()
        self.reflections = None

    def zero_gradients(self) -> None:
        """Begin a new sum of gradients; those of gloss are not a sum, but of the last frame."""
        for name, array in self._gradients.items():
            if name != "gloss":
                array.zero_()

    def add_gradients(self, drawn: GaussianGradients) -> None:
        """Add the gradients of what was drawn, brought back to what is moved."""
        for name in ("positions", "orientations", "radiance"):
            rows = float_rows(getattr(drawn, name))
            launch_add_rows(rows.size, rows, float_rows(self._gradients[name]), self.device)
        launch_add_shape_gradients(
            self._shapes,
            drawn.scales,
            drawn.opacities,
            self._gradients["log_scales"],
            self._gradients["logits"],
            self.device,
        )

    def gradient(self, name: str) -> wp.array:
        """Return where the gradient of ``positions``, ``orientations``, ``radiance``, ``log_scales``, ``logits`` is."""
        return self._gradients[name]

    def optimizer(self, rates: dict[str, float]) -> Adam:
        """Return an optimiser of the rows.

        Args:
            rates: Learning rates of ``positions``, ``orientations``, ``log_scales``, ``logits``, ``color`` (band 0),
                ``bands`` (all others, if there are any) and ``gloss`` (if they reflect); those left out stay.

        Raises:
            InvalidOptionError: There is no such group.
        """
        color, slope = float_rows(self.radiance), float_rows(self._gradients["radiance"])
        groups = {name: (getattr(self, name), self._gradients[name]) for name in self._gradients if name != "radiance"}
        groups["color"] = (color[:, :3], slope[:, :3])
        if color.shape[1] > 3:
            groups["bands"] = (color[:, 3:], slope[:, 3:])
        for name in rates:
            require_choice("rates", name, (*groups, "bands", "gloss"))
        return Adam({name: Parameters(*groups[name], rate) for name, rate in rates.items() if name in groups})

    def rows(self) -> dict[str, Any]:
        """Return the arrays that are moved, by name, as NumPy."""
        return {name: getattr(self, name).numpy() for name in self._gradients}

    def set_rows(self, rows: dict[str, Any]) -> None:
        """Overwrite the arrays that are moved; they stay at their addresses, so that captured steps go on."""
        for name, array in rows.items():
            target = getattr(self, name)
            wp.copy(target, upload(array, target.dtype, self.device))

    def alive(self) -> Any:
        """Return which rows hold a Gaussian, ``(N,)`` bool NumPy."""
        return self.logits.numpy() > 0.5 * (DEAD_LOGIT - LOGIT_LIMIT)

    def cloud(self) -> GaussianCloud:
        """Return the Gaussians as they are drawn, rows without one left out."""
        self.activate()
        alive = self.alive()
        orientations = self.orientations.numpy()[alive].astype(np.float64)
        orientations /= np.linalg.norm(orientations, axis=1, keepdims=True)
        return GaussianCloud(
            positions=self.positions.numpy()[alive],
            orientations=orientations.astype(np.float32),
            scales=self.drawn.scales.numpy()[alive],
            opacities=np.clip(self.drawn.opacities.numpy()[alive], 0.0, 1.0),
            radiance=self.radiance.numpy()[alive],
            radiance_color_space=LINEAR_REC709,
            ids=np.flatnonzero(alive),
        )


def require_something(name: str, cloud: GaussianCloud, views: Sequence[CapturedView]) -> None:
    """Refuse no views and no Gaussians.

    Raises:
        InvalidArrayError: There is no view or no Gaussian.
    """
    if not len(views) or not len(cloud):
        raise InvalidArrayError(
            f"views and {name} must hold something, got {len(views)} views and {len(cloud)} Gaussians. Pass some."
        )


def require_scene_linear(name: str, cloud: GaussianCloud) -> NDArray[np.float32]:
    """Return a cloud's radiance after checking that it is scene-linear: display colours would be taken for light.

    Raises:
        InvalidArrayError: There is none, or not in scene-linear Rec.709.
    """
    if cloud.radiance is None or cloud.radiance_color_space != LINEAR_REC709:
        raise InvalidArrayError(
            f"{name} must have radiance in {LINEAR_REC709}, got {cloud.radiance_color_space or 'none'}. "
            "Begin from initial_gaussians, or with a cloud that was fitted in linear light."
        )
    return cloud.radiance
