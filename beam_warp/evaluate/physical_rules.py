"""Rules of physics about an asset's materials: what each one states, and what its bound follows from.

Bounds are derived, none is fitted. Where estimates with a stated standard error are compared, nothing is assumed about
their distribution: by Chebyshev's inequality at most 1/16 of independent estimates are off by more than four standard
errors, by Cantelli's at most 1/17 to one side, and by Markov's a variance is 16 times its expectation in at most 1/16
of cases. The share that is found in a sample may exceed that of all by three standard deviations of its binomial law.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from beam_warp.schema.layout import HALF_EPSILON
from beam_warp.schema.validation.report import BrokenRule, Severity

FAR = 4.0
"""Standard errors beyond which an estimate counts as off."""

CHEBYSHEV, CANTELLI = 1.0 / FAR**2, 1.0 / (1.0 + FAR**2)
"""Largest share of estimates that are off to either side, and to one side."""

BRIGHTEST = 10.0**-0.05
"""Reflectance of the white patch of a ColorChecker, whose optical density is 0.05; what is whiter is rare."""

LEAST_OPACITY = 0.5
"""Opacity below which a Gaussian is no surface."""

CLOSED = (1.0 - LEAST_OPACITY) ** 2
"""Visibility below which a side is the inside of a body: the Gaussians of a surface overlap, so that light from outside
passes two of them at least. A sheet, such as a floor, has two open sides, and either may be the right one."""

LEAST_COUNT = 32
"""Gaussians below which a share means nothing: two of them are 1/16."""

FloatArray = NDArray[np.floating]


@dataclass(frozen=True)
class PhysicalRule:
    """A rule of physics.

    Attributes:
        id: Stable id, ``BEAM-PHYS-<nnn>``.
        severity: ``error`` if light would be wrong, ``warning`` if it is only unlikely to be right.
        text: What holds, in one sentence.
        remedy: What to do where it does not.
        attribute: The array that is judged.
    """

    id: str
    severity: Severity
    text: str
    remedy: str
    attribute: str


FURNACE, OCCLUSION, FACING, SHAPE, COLOR, STEADY, CERTIFIED = PHYSICAL_RULES = (
    PhysicalRule(
        "BEAM-PHYS-001",
        "error",
        "In a white furnace, light of 1 from everywhere, no material reflects more than 1 (energy is conserved).",
        "Scale the base colour down.",
        "beam:baseColor",
    ),
    PhysicalRule(
        "BEAM-PHYS-002",
        "error",
        "Ambient occlusion is that of a fresh trace in the kernel, within four standard errors, for all but 1/16.",
        "Trace it again, or state its error.",
        "beam:ambientOcclusion",
    ),
    PhysicalRule(
        "BEAM-PHYS-003",
        "error",
        "No normal points into a body, to a closed side that is less open by four standard errors, but for 1/17.",
        "Turn the normals to the open side.",
        "beam:normals",
    ),
    PhysicalRule(
        "BEAM-PHYS-004",
        "warning",
        "Normals of flat Gaussians are nearer to their shortest axes than random ones would be.",
        "Estimate the normals again, or state the axes of the source.",
        "beam:normals",
    ),
    PhysicalRule(
        "BEAM-PHYS-005",
        "warning",
        "Base colour does not exceed that of a white chart, 0.89, by four standard errors, but for 1/17.",
        "State the exposure or the light of the capture.",
        "beam:baseColor",
    ),
    PhysicalRule(
        "BEAM-PHYS-006",
        "warning",
        "Materials of a Gaussian vary over time by no more than four times their standard error, for all but 1/16.",
        "Smooth the materials over time, or state their errors.",
        "beam:baseColorError",
    ),
    PhysicalRule(
        "BEAM-PHYS-007",
        "error",
        "A certificate of relit images holds when it is measured again on its seed.",
        "Reduce the original again.",
        "beam:baseColor",
    ),
)


@dataclass(frozen=True)
class Measured:
    """What was measured about a rule.

    Attributes:
        rule: The rule's id.
        passed: Whether it holds; None if it could not be measured.
        value: What was measured.
        bound: What it may be.
        words: Value and bound in words, or why nothing could be measured.
        frame: The frame that is nearest to the bound, or beyond.
    """

    rule: str
    passed: bool | None
    value: float
    bound: float
    words: str
    frame: int = 0

    @classmethod
    def absent(cls, rule: PhysicalRule, reason: str) -> Measured:
        """Say why a rule could not be measured."""
        return cls(rule.id, None, 0.0, 0.0, f"not measured: {reason}")

    def __str__(self) -> str:
        """Return one readable line."""
        verdict = {True: "holds", False: "broken", None: "-"}[self.passed]
        return f"{verdict:7} {self.rule}  {self.words}"


def broken(measured: list[Measured], prim: str = "/") -> list[BrokenRule]:
    """Return what a report says of the rules that do not hold."""
    rules = {rule.id: rule for rule in PHYSICAL_RULES}
    return [
        BrokenRule(
            found.rule,
            rules[found.rule].severity,
            f"{rules[found.rule].text.rstrip('.')}, got {found.words}. {rules[found.rule].remedy}",
            prim,
            rules[found.rule].attribute,
        )
        for found in measured
        if found.passed is False
    ]


def furnace(albedo: FloatArray) -> Measured:
    """Judge the shares of uniform light that materials reflect, diffuse and specular together, ``(M,)``."""
    if not len(albedo):
        return Measured.absent(FURNACE, "no Gaussian is opaque")
    value, bound = float(albedo.max()), 1.0 + HALF_EPSILON
    words = f"at most {value:.4f} of the light reflected by {len(albedo):,} Gaussians"
    return Measured(FURNACE.id, value <= bound, value, bound, words)


def occlusion(stored: FloatArray, stored_error: FloatArray, fresh: FloatArray, fresh_error: FloatArray) -> Measured:
    """Judge visibilities by fresh ones.

    A Gaussian has no surface of its own: the point that its visibility belongs to lies somewhere in its kernel. So it
    is judged by the interval between two points.

    Args:
        stored: Visibilities of the asset, ``(M,)``.
        stored_error: Their standard errors, ``(M,)``.
        fresh: Visibilities at both points, ``(2, M)``.
        fresh_error: Their standard errors, ``(2, M)``.
    """
    away = np.maximum(fresh.min(axis=0) - stored, stored - fresh.max(axis=0))
    errors = np.sqrt(np.square(stored_error) + np.square(fresh_error).max(axis=0) + HALF_EPSILON**2)
    return _share(OCCLUSION, away > FAR * errors, CHEBYSHEV, "off")


def facing(open_side: FloatArray, open_error: FloatArray, back: FloatArray, back_error: FloatArray) -> Measured:
    """Judge visibilities about normals, and about their opposites, all ``(M,)``, with their standard errors."""
    errors = np.hypot(open_error, back_error)
    return _share(FACING, (open_side < CLOSED) & (back - open_side > FAR * errors), CANTELLI, "turned inward")


def shape(cosines: FloatArray) -> Measured:
    """Judge cosines of normals with shortest axes, either sign, ``(M,)``.

    Those of random directions are uniform in [0, 1] (Archimedes): their mean is 1/2, their variance 1/12.
    """
    if len(cosines) < LEAST_COUNT:
        return Measured.absent(SHAPE, f"{len(cosines)} flat Gaussians have a certain normal")
    value, bound = float(np.abs(cosines).mean()), 0.5 + FAR * math.sqrt(1.0 / 12.0 / len(cosines))
    words = f"a mean cosine of {value:.3f} over {len(cosines):,} flat Gaussians (random: up to {bound:.3f})"
    return Measured(SHAPE.id, value >= bound, value, bound, words)


def color(base_color: FloatArray, error: FloatArray) -> Measured:
    """Judge base colours ``(M, 3)`` by their standard errors, 0 where none is stated."""
    errors = np.sqrt(np.square(error) + HALF_EPSILON**2)
    return _share(COLOR, np.any(base_color - BRIGHTEST > FAR * errors, axis=1), CANTELLI, "whiter than a chart")


def steady(variance: FloatArray, error: FloatArray) -> Measured:
    """Judge variances over time and standard errors, both ``(M, C)``: of base colour and roughness."""
    expected = np.square(error) + HALF_EPSILON**2
    return _share(STEADY, np.any(variance > FAR**2 * expected, axis=1), CHEBYSHEV, "restless")


def _share(rule: PhysicalRule, off: NDArray[np.bool_], probability: float, what: str) -> Measured:
    """Judge the share of Gaussians that are off."""
    count = len(off)
    if count < LEAST_COUNT:
        return Measured.absent(rule, f"{count} Gaussians can be judged, {LEAST_COUNT} are needed")
    value, bound = float(off.mean()), probability + 3.0 * math.sqrt(probability * (1.0 - probability) / count)
    return Measured(rule.id, value <= bound, value, bound, f"{value:.1%} of {count:,} {what} (up to {bound:.1%})")
