"""Visibility in float64 with its decisions frozen, and its gradients by central differences.

Which Gaussians count on which ray is decided once and held still; what is differenced is smooth.
"""

import numpy as np

from beam_warp.world.quaternions import rotation_matrices

ALPHA_MIN, ALPHA_MAX = 1.0 / 255.0, 0.99
STEP = 1e-5  # relative truncation is about STEP^2, rounding about 1e-16 / STEP


class FrozenVisibility:
    """Rays through a cloud.

    Attributes:
        rays, rows: The ray and the Gaussian of every pair that counts, ``(P,)``.
        near_tie: Rays on which float32 may decide otherwise, ``(R,)``.
    """

    def __init__(self, cloud, origins, directions, *, t_max=np.inf, front="peak", cull=False, degree=2):
        self.degree = degree
        self.parameters = {
            "positions": cloud.positions.astype(np.float64),
            "orientations": cloud.orientations.astype(np.float64),
            "scales": cloud.scales.astype(np.float64),
            "opacities": cloud.opacities.astype(np.float64),
            "origins": np.asarray(origins, np.float64),
            "directions": np.asarray(directions, np.float64),
        }
        reach = np.broadcast_to(np.asarray(t_max, np.float64), len(origins))[:, None]
        alpha, t, chord = self._terms(self.parameters, *np.ogrid[: len(origins), : len(cloud)])
        start = t - chord if front == "entry" else t
        counts = (alpha >= ALPHA_MIN) & (start > 0.0) & (t < reach)
        ties = (np.abs(start) < 1e-3) | (np.abs(t - reach) < 1e-3) | (np.abs(alpha - ALPHA_MAX) < 1e-4)
        if cull:
            facing = self.parameters["directions"] @ cloud.normals.T.astype(np.float64)
            counts &= facing <= 0.0
            ties |= np.abs(facing) < 1e-5
        ties &= alpha > 0.9 * ALPHA_MIN
        self.rays, self.rows = np.nonzero(counts)
        self.near_tie = (ties | (np.abs(alpha / ALPHA_MIN - 1.0) < 1e-2)).any(axis=1)

    def _terms(self, parameters, rays, rows):
        """Alpha before its cap, its place t, and half the chord of the support of every pair."""
        turned = np.swapaxes(rotation_matrices(parameters["orientations"]), 1, 2)
        whitening = (turned / parameters["scales"][:, :, None])[rows]
        p = np.einsum("...ij,...j->...i", whitening, parameters["origins"][rays] - parameters["positions"][rows])
        v = np.einsum("...ij,...j->...i", whitening, parameters["directions"][rays])
        vv = (v * v).sum(-1)
        t = -(p * v).sum(-1) / vv
        closest = p + t[..., None] * v
        distance = (closest * closest).sum(-1)
        exponent = -0.5 * distance if self.degree == 2 else -(distance**2) / 18.0
        opacities = parameters["opacities"][rows]
        support = np.log(np.maximum(255.0 * opacities, 1.0))
        support = 2.0 * support if self.degree == 2 else np.sqrt(18.0 * support)
        chord = np.sqrt(np.maximum(support - distance, 0.0) / vv)
        return opacities * np.exp(exponent), t, chord

    def passed(self, **changed):
        """1 - alpha of every pair that counts, ``(P,)``."""
        alpha, _, _ = self._terms({**self.parameters, **changed}, self.rays, self.rows)
        return 1.0 - np.minimum(ALPHA_MAX, alpha)

    def visibility(self, **changed):
        return np.exp(np.bincount(self.rays, np.log(self.passed(**changed)), len(self.near_tie)))

    def gradients(self, adjoints):
        """Central differences of sum of adjoint V with respect to every array.

        A Gaussian's parameters change its own factor only, so one parameter of all Gaussians is moved at once, and of
        all rays likewise.
        """
        without = (adjoints * self.visibility())[self.rays] / self.passed()  # adjoint V without each Gaussian
        result = {}
        for name, value in self.parameters.items():
            gradient = np.zeros_like(value)
            of_rays = name in ("origins", "directions")
            for k in range(value.shape[1] if value.ndim == 2 else 1):
                column = (slice(None), k) if value.ndim == 2 else slice(None)
                step = self._steps(name, value[column])
                moved = []
                for sign in (1.0, -1.0):
                    other = value.copy()
                    other[column] += sign * step
                    if of_rays:
                        moved.append(adjoints * self.visibility(**{name: other}))
                    else:
                        moved.append(np.bincount(self.rows, without * self.passed(**{name: other}), len(value)))
                gradient[column] = (moved[0] - moved[1]) / (2.0 * step)
            result[name] = gradient
        return result

    def _steps(self, name, value):
        """Steps that move the point closest to a centre by about STEP standard deviations."""
        smallest = self.parameters["scales"].min(axis=1)
        if name == "positions":
            return STEP * smallest
        if name == "orientations":
            return STEP * smallest / self.parameters["scales"].max(axis=1)
        if name in ("origins", "directions"):
            return STEP * smallest.min()
        return STEP * value
