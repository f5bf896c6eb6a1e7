"""The plan of the materials study: levels of each factor of decomposing, and which of them are crossed."""

from __future__ import annotations

from dataclasses import dataclass

from beam_warp.checks import require_count
from beam_warp.errors import InvalidOptionError
from beam_warp.materials.light_rays import DIFFUSE_WEIGHTS
from beam_warp.study.table import Settings
from beam_warp.study.tracing_plan import RATIOS, check_levels, parse_offset
from beam_warp.trace.denoise import DENOISERS
from beam_warp.trace.incident import DENSITIES
from beam_warp.trace.sampling import SAMPLERS

PATHS = ("direct", "images")
BOUNCES = ("one", "none")
FITS = ("together", "robust", "plain")
OBSERVED = ("difference", "images")

DIRECT_AXES = ("sampler", "offset", "density", "ratio", "bounce", "weight", "fit", "observed")
"""Factors of the direct path; the images' are their offset and denoiser."""


@dataclass(frozen=True)
class MaterialsPlan:
    """The settings to measure, and how well.

    Attributes:
        paths: ``direct``: rays from every Gaussian. ``images``: rays from every pixel, baked; the paper's.
        samplers: Sample sets; the first of each of these lists is its default.
        offsets: Lifts of ray origins: ``auto`` or metres such as ``0.02``; the path by images takes those in metres.
        densities: What light rays are drawn by.
        ratios: Light as a ratio of estimates (``ratio``) or as one estimate (``plain``).
        bounces: Light from other surfaces: ``one`` bounce or ``none``.
        weights: What the specular lobe leaves for diffusion.
        fits: All Gaussians ``together``, as pixels blend them; or each by itself, where views that disagree with the
            others count little (``robust``) or as they are (``plain``).
        observed: What views show of a Gaussian: its fitted radiance plus the ``difference`` to the image, spread back,
            or the ``images`` themselves spread back.
        denoisers: Denoisers of the path by images.
        rays: Rays a Gaussian, or a pixel's occlusion, rising.
        reference_rays: Rays a Gaussian of the reference, where there is no truth.
        repeats: Timed calls a setting, each with samples of its own.

    Raises:
        InvalidOptionError: A value is none of its choices, out of range or given twice.
    """

    paths: tuple[str, ...] = PATHS
    samplers: tuple[str, ...] = SAMPLERS
    offsets: tuple[str, ...] = ("auto", "0.02", "0", "0.1")
    densities: tuple[str, ...] = ("product", "mis", "environment", "cosine")
    ratios: tuple[str, ...] = RATIOS
    bounces: tuple[str, ...] = BOUNCES
    weights: tuple[str, ...] = tuple(DIFFUSE_WEIGHTS)
    fits: tuple[str, ...] = FITS
    observed: tuple[str, ...] = OBSERVED
    denoisers: tuple[str, ...] = ("auto", "none")
    rays: tuple[int, ...] = (8, 16, 32, 64, 128, 256)
    reference_rays: int = 4096
    repeats: int = 1

    def __post_init__(self) -> None:
        """Check every option once."""
        choices = {
            "paths": PATHS,
            "samplers": SAMPLERS,
            "densities": DENSITIES,
            "ratios": RATIOS,
            "bounces": BOUNCES,
            "weights": tuple(DIFFUSE_WEIGHTS),
            "fits": FITS,
            "observed": OBSERVED,
            "denoisers": DENOISERS,
        }
        check_levels(self, choices, most_rays=4096)
        for label in self.offsets:
            if parse_offset(label)[0] == "thicknesses":
                raise InvalidOptionError(f"offsets must be auto or metres such as 0.02, got {label!r}. Choose those.")
        require_count("reference_rays", self.reference_rays, 4, 4096)

    def axes(self) -> dict[str, tuple[str, ...]]:
        """Return the levels of every factor but rays, by its name."""
        return {
            "path": self.paths,
            "sampler": self.samplers,
            "offset": self.offsets,
            "density": self.densities,
            "ratio": self.ratios,
            "bounce": self.bounces,
            "weight": self.weights,
            "fit": self.fits,
            "observed": self.observed,
            "denoiser": self.denoisers,
        }

    def settings(self) -> list[Settings]:
        """Return settings without rays: the defaults, then one factor at a time, density and ratio crossed."""
        found: list[Settings] = []
        if "direct" in self.paths:
            levels = {name: self.axes()[name] for name in DIRECT_AXES}
            default = {"path": "direct", **{name: values[0] for name, values in levels.items()}}
            found.append(default)
            for name, values in levels.items():
                found += [{**default, name: value} for value in values[1:]]
            found += [
                {**default, "density": density, "ratio": ratio}
                for density in self.densities[1:]
                for ratio in self.ratios[1:]
            ]
        metres = [label for label in self.offsets if label != "auto"]
        if "images" in self.paths and metres:
            default = {"path": "images", "offset": metres[0], "denoiser": self.denoisers[0]}
            found.insert(1, default)  # beside the direct defaults: a budget cuts off the end
            found += [{**default, "denoiser": denoiser} for denoiser in self.denoisers[1:]]
            found += [{**default, "offset": offset} for offset in metres[1:]]
        return found
