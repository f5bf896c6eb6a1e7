"""Lens distortion and its inverse.

Points are in *tangent coordinates*, x / z and y / z in the camera's axes: a pixel minus the principal point, over the
focal length. A lens maps the tangent coordinates of a ray to those at which the photograph shows it; both refer to the
same optical axis and centre of projection.

Source: D. C. Brown 1966, "Decentering distortion of lenses"; J. Kannala and S. Brandt 2006 (fisheye); coefficients in
the order and with the meaning of nerfstudio's ``transforms.json``.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from beam_warp.checks import require_array, require_choice, require_number
from beam_warp.errors import InvalidOptionError

MODELS = ("OPENCV", "OPENCV_FISHEYE")
"""Lens models: Brown's polynomial in the tangent of the angle to the axis, and the equidistant one in the angle."""

COEFFICIENT_NAMES = ("k1", "k2", "k3", "k4", "p1", "p2")
"""Coefficients in the order of `Lens.coefficients`."""

MAX_COEFFICIENT = 1e6
"""Largest coefficient; those of long lenses, whose tangents are small, reach thousands."""

NEGLIGIBLE = 1e-12
"""Coefficients up to this move no pixel of any photograph, and are too small to find the roots of a polynomial with."""

MAX_TANGENT = 1e3
"""Largest tangent for which a lens is inverted, 3.4 arc minutes short of a right angle to the axis."""


@dataclass(frozen=True)
class Lens:
    """A lens model with its coefficients.

    ``OPENCV``, with r^2 = x^2 + y^2: the radius grows by 1 + k1 r^2 + k2 r^4 + k3 r^6 + k4 r^8, and (x, y) moves by
    (2 p1 x y + p2 (r^2 + 2 x^2), p1 (r^2 + 2 y^2) + 2 p2 x y). So k4 is the fourth coefficient of the polynomial, as
    nerfstudio has it, and not OpenCV's fourth radial one, which is in a denominator that nerfstudio does not have.
    ``OPENCV_FISHEYE``: a ray at the angle t to the axis is seen at the radius t (1 + k1 t^2 + k2 t^4 + k3 t^6 +
    k4 t^8), also where all coefficients are 0.

    Attributes:
        coefficients: Coefficients in the order of `COEFFICIENT_NAMES`.
        model: One of `MODELS`.

    Raises:
        InvalidOptionError: The model is unknown, or a coefficient is out of range or not one of the model.
    """

    coefficients: tuple[float, ...] = (0.0,) * len(COEFFICIENT_NAMES)
    model: str = "OPENCV"

    def __post_init__(self) -> None:
        """Check every field once."""
        require_choice("model", self.model, MODELS)
        if len(self.coefficients) != len(COEFFICIENT_NAMES):
            raise InvalidOptionError(
                f"coefficients must be {', '.join(COEFFICIENT_NAMES)}, got {len(self.coefficients)}. Pass 0 for none."
            )
        checked = tuple(
            require_number(name, value, -MAX_COEFFICIENT, MAX_COEFFICIENT)
            for name, value in zip(COEFFICIENT_NAMES, self.coefficients, strict=True)
        )
        object.__setattr__(self, "coefficients", checked)
        if self.model == "OPENCV_FISHEYE" and any(checked[4:]):
            raise InvalidOptionError(f"p1 and p2 must be 0 for OPENCV_FISHEYE, got {checked[4:]}. Leave them out.")

    @property
    def is_straight(self) -> bool:
        """True for a pinhole, whose images need no undistorting."""
        return self.model == "OPENCV" and not any(self.coefficients)

    @cached_property
    def fold(self) -> float:
        """Radius (of a fisheye: angle) beyond which the polynomial has no inverse; infinity if it always grows.

        The derivative is 1 in the middle; this is the first place where it is 0.
        """
        derivative = [*(n * k for n, k in zip((9, 7, 5, 3), self.coefficients[3::-1], strict=True)), 1.0]
        if not any(abs(k) > NEGLIGIBLE for k in derivative[:-1]):
            return np.inf
        roots = np.roots([k if abs(k) > NEGLIGIBLE else 0.0 for k in derivative])
        squares = roots.real[(roots.imag == 0.0) & (roots.real > 0.0)]
        return float(np.sqrt(squares.min())) if len(squares) else np.inf

    @cached_property
    def limit(self) -> float:
        """Radius (of a fisheye: angle) up to which the lens is inverted: `fold`, or that of `MAX_TANGENT`."""
        return min(self.fold, float(np.arctan(MAX_TANGENT)) if self.model == "OPENCV_FISHEYE" else MAX_TANGENT)

    @property
    def fold_angle(self) -> float:
        """Angle to the axis of `fold` [rad], or infinity."""
        return self.fold if self.model == "OPENCV_FISHEYE" or self.fold == np.inf else float(np.arctan(self.fold))

    def distort(self, points: ArrayLike) -> NDArray[np.float64]:
        """Map rays to their places in the photograph.

        Args:
            points: Tangent coordinates of the rays, ``(N, 2)``.

        Returns:
            Tangent coordinates in the photograph, ``(N, 2)`` float64; NaN for rays beyond `limit`, or where the
            tangential terms have folded the image over.

        Raises:
            InvalidArrayError: ``points`` has another shape.
        """
        rays = require_array("points", points, (None, 2), np.float64)
        radius = np.hypot(rays[:, 0], rays[:, 1])
        if self.model == "OPENCV":
            bent, j = self._brown(rays)
            inside = (radius <= self.limit) & (j[:, 0, 0] * j[:, 1, 1] > j[:, 0, 1] * j[:, 1, 0])
        else:
            angle = np.arctan(radius)
            grown = np.divide(self._radial(angle)[0], radius, out=np.ones_like(radius), where=radius > 0.0)
            bent, inside = rays * grown[:, None], angle <= self.limit
        return np.where(inside[:, None], bent, np.nan)

    def undistort(self, points: ArrayLike) -> NDArray[np.float64]:
        """Return the rays of places in a photograph, the inverse of `distort` to rounding.

        The radius is found by Newton's method kept between bounds, on which the polynomial grows and so has one
        solution; where there are tangential terms, Newton's method in two dimensions goes on from there.

        Args:
            points: Tangent coordinates in the photograph, ``(N, 2)``.

        Returns:
            Tangent coordinates of the rays, ``(N, 2)`` float64; NaN where no ray within `limit` is seen.

        Raises:
            InvalidArrayError: ``points`` has another shape.
        """
        seen = require_array("points", points, (None, 2), np.float64)
        target = np.hypot(seen[:, 0], seen[:, 1])
        solved = self._solve_radius(target)
        reached = target <= self.largest_radius
        radius = solved if self.model == "OPENCV" else np.tan(solved)
        rays = seen * np.divide(radius, target, out=np.ones_like(target), where=target > 0.0)[:, None]
        if any(self.coefficients[4:]):
            return self._refine(rays, seen)
        return np.where(reached[:, None], rays, np.nan)

    @cached_property
    def largest_radius(self) -> float:
        """Distorted radius at `limit`."""
        return float(self._radial(np.array(self.limit))[0])

    def fault(self, radius: float) -> str:
        """Name the coefficient that contributes most to the failure of the inverse at a distorted radius."""
        if radius > self.largest_radius:
            terms = [(2 * i + 1) * k * self.fold ** (2 * i) for i, k in enumerate(self.coefficients[:4], start=1)]
            index, turn = int(np.argmin(terms)), f"radii stop growing at {self.fold:.4g}"
        else:  # the radius has an inverse, the image has none
            index, turn = 4 + int(np.argmax(np.abs(self.coefficients[4:]))), "the image folds over"
        return (
            f"{COEFFICIENT_NAMES[index]} must let the lens be inverted over the whole photograph, "
            f"got {self.coefficients[index]:g}, with which {turn}"
        )

    def _radial(self, argument: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the polynomial a (1 + k1 a^2 + ...) and its derivative."""
        square = argument * argument
        k1, k2, k3, k4 = self.coefficients[:4]
        value = argument * (1.0 + square * (k1 + square * (k2 + square * (k3 + square * k4))))
        slope = 1.0 + square * (3.0 * k1 + square * (5.0 * k2 + square * (7.0 * k3 + square * (9.0 * k4))))
        return value, slope

    def _solve_radius(self, target: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the argument, up to `limit`, at which the polynomial has a value."""
        low, high = np.zeros_like(target), np.full_like(target, self.limit)
        found = np.minimum(target, self.limit)
        for _ in range(64):  # halving alone reaches rounding in 53 turns
            value, slope = self._radial(found)
            over = value > target
            low, high = np.where(over, low, found), np.where(over, found, high)
            with np.errstate(divide="ignore", invalid="ignore"):
                step = found - (value - target) / slope
            following = np.where((step >= low) & (step <= high), step, 0.5 * (low + high))
            moved = np.abs(following - found).max(initial=0.0, where=following > 0.0)
            found = following
            if not moved > np.finfo(float).eps * self.limit:
                break
        return found

    def _brown(self, rays: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the model ``OPENCV`` and its Jacobian, ``(N, 2)`` and ``(N, 2, 2)``."""
        k1, k2, k3, k4, p1, p2 = self.coefficients
        x, y = rays[:, 0], rays[:, 1]
        square = x * x + y * y
        grown = 1.0 + square * (k1 + square * (k2 + square * (k3 + square * k4)))
        twice = 2.0 * (k1 + square * (2.0 * k2 + square * (3.0 * k3 + square * (4.0 * k4))))
        bent = np.stack(
            [
                x * grown + 2.0 * p1 * x * y + p2 * (square + 2.0 * x * x),
                y * grown + p1 * (square + 2.0 * y * y) + 2.0 * p2 * x * y,
            ],
            axis=-1,
        )
        jacobian = np.empty((len(x), 2, 2))
        jacobian[:, 0, 0] = grown + twice * x * x + 2.0 * p1 * y + 6.0 * p2 * x
        jacobian[:, 1, 1] = grown + twice * y * y + 6.0 * p1 * y + 2.0 * p2 * x
        jacobian[:, 0, 1] = jacobian[:, 1, 0] = twice * x * y + 2.0 * p1 * x + 2.0 * p2 * y
        return bent, jacobian

    def _refine(self, rays: NDArray[np.float64], seen: NDArray[np.float64]) -> NDArray[np.float64]:
        """Solve with the tangential terms, from the solution without them; NaN where that does not lead to one."""
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            for _ in range(32):
                bent, j = self._brown(rays)
                missing = bent - seen
                determinant = j[:, 0, 0] * j[:, 1, 1] - j[:, 0, 1] * j[:, 1, 0]
                step_x = (j[:, 1, 1] * missing[:, 0] - j[:, 0, 1] * missing[:, 1]) / determinant
                step_y = (j[:, 0, 0] * missing[:, 1] - j[:, 1, 0] * missing[:, 0]) / determinant
                rays = rays - np.stack([step_x, step_y], axis=-1)
                if not max(np.nanmax(np.abs(step_x), initial=0.0), np.nanmax(np.abs(step_y), initial=0.0)) > 1e-15:
                    break
            again = self.distort(rays)  # NaN beyond the limit and the fold
            solved = np.abs(again - seen).max(axis=1, initial=0.0) <= 1e-12 * (1.0 + np.abs(seen).max(axis=1))
        return np.where(solved[:, None], rays, np.nan)
