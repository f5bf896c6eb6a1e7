"""The specular lobe as four round ones (`beam_warp.kernels.light.stretched_lobe`): what is left of it, and the fit.

    python benchmarks/specular_lobe.py --out benchmarks/results/specular_lobe_cpu.json
    python benchmarks/specular_lobe.py --out fitted.json --iterations 60

What is left is the root of the integral of the squared difference over that of the squared lobe, and the length of the
difference of mean directions; beside both are those of one round lobe about the mirror direction. With iterations, the
polynomials are fitted first, and printed, in two minutes.
"""

from __future__ import annotations

import numpy as np
import record
import warp as wp

from beam_warp.kernels.light.brdf import DIELECTRIC_F0
from beam_warp.kernels.light.stretched_lobe import COEFFICIENTS, LOBES
from beam_warp.light.ggx import ggx_distribution, schlick_weight, smith_lambda
from beam_warp.world.directions import even_directions

COSINES = np.square(np.linspace(0.1, 1.0, 16))
ROUGHNESSES = np.linspace(0.1, 1.0, 10)
POINTS = 1024
"""Directions drawn by the lobe, and as many over the sphere."""

MEAN_COUNTS = 4.0
"""What an error of the lobe's mean direction counts: it is what light that changes slowly shows."""

STEP = 1e-5
START = np.array((-1.0, -0.3, 0.3, 1.0, 0.8, 0.8, 0.9, 1.0, 0.0, 0.0, 0.0))
"""Offsets, widths and weights of the lobes, whatever the view."""


class Surface:
    """The lobe of one roughness under one cosine at points of the sphere, and what four round ones make of it."""

    def __init__(self, cosine: float, roughness: float) -> None:
        """Evaluate the lobe; its weights are one over the density of the points."""
        self.roughness, self.alpha, self.sine = roughness, roughness**2, np.sqrt(1.0 - cosine**2)
        view = np.array((self.sine, 0.0, cosine))
        self.mirrored = np.array((-self.sine, 0.0, cosine))
        self.aside = np.array((cosine, 0.0, self.sine))
        self.points = np.concatenate([self._drawn(view), even_directions(POINTS)])
        half = self.points + view
        half /= np.maximum(np.linalg.norm(half, axis=1, keepdims=True), 1e-12)
        light, normal = np.maximum(self.points[:, 2], 1e-9), half[:, 2]
        seen = 1.0 + smith_lambda(cosine, self.alpha)
        distribution = np.where(normal > 0.0, ggx_distribution(normal, self.alpha), 0.0)
        density = distribution / seen / (4.0 * cosine)
        fresnel = DIELECTRIC_F0 + (1.0 - DIELECTRIC_F0) * schlick_weight(np.clip(half @ view, 0.0, 1.0))
        masked = seen / (seen + smith_lambda(light, self.alpha))
        lobe = np.where(self.points[:, 2] > 0.0, density * masked * fresnel, 0.0)
        weights = 1.0 / (POINTS * density + POINTS / (4.0 * np.pi))
        self.lobe = lobe / (weights @ lobe)
        self.mean = (weights * self.lobe) @ self.points
        self.weights = np.sqrt(weights / (weights @ np.square(self.lobe)))

    def _drawn(self, view: np.ndarray) -> np.ndarray:
        """Draw directions by visible normals (Dupuy and Benyoub 2023)."""
        place = np.arange(POINTS) + 0.5
        azimuth, share = np.pi * (1.0 + np.sqrt(5.0)) * place, place / POINTS
        stretched = view * (self.alpha, self.alpha, 1.0)
        stretched /= np.linalg.norm(stretched)
        height = (1.0 - share) * (1.0 + stretched[2]) - stretched[2]
        ring = np.sqrt(np.maximum(1.0 - height**2, 0.0))
        normals = np.stack([ring * np.cos(azimuth), ring * np.sin(azimuth), height], axis=1) + stretched
        normals *= (self.alpha, self.alpha, 1.0)
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        return 2.0 * (normals @ view)[:, None] * normals - view

    def left(self, offsets: np.ndarray, widths: np.ndarray, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return what round lobes leave of it, times the root of what a point stands for, ``(P,)``, and of its mean."""
        axes = self.mirrored + (self.alpha * self.sine * offsets)[:, None] * self.aside
        axes /= np.linalg.norm(axes, axis=1, keepdims=True)
        rough = np.clip(self.roughness * widths, 0.02, 1.0)
        norm, length = _round_lobe(rough)
        cosine = np.clip(self.points @ axes.T, -1.0, 1.0)
        round_ones = np.where(cosine > 0.0, ggx_distribution(np.sqrt(0.5 * (1.0 + cosine)), rough**2) * cosine, 0.0)
        return ((round_ones / norm) @ weights - self.lobe) * self.weights, (weights * length) @ axes - self.mean

    def left_by(self, row: np.ndarray) -> np.ndarray:
        """Return what is left by offsets, widths, and logarithms of weights over that of the last, ``(P + 3,)``."""
        weights = np.exp(np.append(row[2 * LOBES :], 0.0))
        lobe, mean = self.left(row[:LOBES], row[LOBES : 2 * LOBES], weights / weights.sum())
        return np.concatenate([lobe, MEAN_COUNTS * mean])

    def slopes(self, row: np.ndarray, left: np.ndarray) -> np.ndarray:
        """Return the derivatives of `left_by`, ``(P + 3, 11)``."""
        return np.stack([(self.left_by(row + step) - left) / STEP for step in STEP * np.eye(len(row))], axis=1)


def _round_lobe(rough: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the integral of D (n.l) of round lobes, n = v, and the length of their mean direction."""
    angle = (np.arange(4000) + 0.5) * (0.5 * np.pi / 4000)
    lobe = ggx_distribution(np.cos(0.5 * angle), rough[:, None] ** 2) * np.cos(angle) * np.sin(angle)
    return lobe.sum(axis=1) * (np.pi**2 / 4000), lobe @ np.cos(angle) / lobe.sum(axis=1)


def powers(cosine: float, roughness: float) -> np.ndarray:
    """Return what coefficients are multiplied by, ``(9,)``."""
    x = np.sqrt(cosine)
    return np.outer((1.0, x, x * x), (1.0, roughness, roughness**2)).ravel()


def fitted(iterations: int) -> np.ndarray:
    """Minimise what is left, squared, of all surfaces at once by Levenberg's and Marquardt's method: ``(11, 9)``.

    A surface counts by its cosine, and by how many there are of it.
    """
    surfaces = [Surface(cosine, roughness) for roughness in ROUGHNESSES for cosine in COSINES]
    basis = np.array([powers(cosine, roughness) for roughness in ROUGHNESSES for cosine in COSINES])
    worth = np.tile(COSINES, len(ROUGHNESSES))
    coefficients = np.zeros((9, len(START)))
    coefficients[0] = START
    damping = 1e-2

    def loss(trial: np.ndarray) -> float:
        rows = basis @ trial
        return sum(w * np.square(s.left_by(row)).sum() for w, s, row in zip(worth, surfaces, rows, strict=True))

    least = loss(coefficients)
    for turn in range(iterations):
        size = coefficients.size
        matrix, slope = np.zeros((size, size)), np.zeros(size)
        for w, surface, power, row in zip(worth, surfaces, basis, basis @ coefficients, strict=True):
            left = surface.left_by(row)
            slopes = surface.slopes(row, left)
            matrix += np.kron(np.outer(power, power), w * (slopes.T @ slopes))
            slope += np.kron(power, w * (slopes.T @ left))
        for _ in range(8):
            step = np.linalg.solve(matrix + damping * np.diag(np.diag(matrix) + 1e-9), -slope)
            trial = coefficients + step.reshape(coefficients.shape)
            found = loss(trial)
            if found < least:
                break
            damping *= 6.0
        if not found < least * (1.0 - 1e-5):
            break
        coefficients, least, damping = trial, found, max(damping / 5.0, 1e-8)
        print(turn, round(least, 4), flush=True)
    return coefficients.T


def left_over(coefficients: np.ndarray) -> list[dict[str, float]]:
    """Return what is left of lobes and of their mean directions, by four round ones and by one."""
    rows = []
    for roughness in ROUGHNESSES[1::2]:
        for cosine in COSINES[1::3]:
            surface = Surface(cosine, roughness)
            left = surface.left_by(coefficients @ powers(cosine, roughness))
            lobe, mean = surface.left(np.zeros(1), np.ones(1), np.ones(1))
            rows.append(
                {
                    "roughness": float(roughness),
                    "cosine": float(cosine),
                    "four": float(np.linalg.norm(left[:-3])),
                    "one": float(np.linalg.norm(lobe)),
                    "four_mean": float(np.linalg.norm(left[-3:])) / MEAN_COUNTS,
                    "one_mean": float(np.linalg.norm(mean)),
                }
            )
    return rows


def main() -> None:
    """Fit if that is asked for, and measure."""
    parser = record.parser(__doc__)
    parser.add_argument("--iterations", type=int, default=0, help="fit the polynomials first")
    arguments = parser.parse_args()
    coefficients = np.array(COEFFICIENTS)
    if arguments.iterations:
        coefficients = fitted(arguments.iterations)
        print(np.array2string(coefficients, precision=4, separator=", ", max_line_width=118, suppress_small=True))
    record.write_result(arguments, wp.get_device("cpu"), {"left": left_over(coefficients)})


if __name__ == "__main__":
    main()
