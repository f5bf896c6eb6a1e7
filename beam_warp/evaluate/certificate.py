"""The certificate of a reduced asset: how far its relit images are from the original's, with which confidence.

Of independent draws of a stated distribution (`beam_warp.evaluate.trials`), none of which the search saw, some number
stays within a bound. The share of all draws that do so is at least its lower limit by Clopper and Pearson, whatever the
errors are distributed like. It says nothing about other lights, cameras, image sizes, frames or renderers.

Source: Clopper and Pearson 1934.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import special

from beam_warp.digests import array_digest
from beam_warp.errors import AssetFormatError, InvalidOptionError
from beam_warp.evaluate.physical_rules import CERTIFIED, Measured
from beam_warp.evaluate.relit import MEASURES, RelitComparison
from beam_warp.evaluate.trials import RelitTrials
from beam_warp.world.environment import EnvironmentMap
from beam_warp.world.gaussians import GaussianSequence

KEY = "relit_certificate"
"""Key of the asset's metadata."""

MOST_PAIRS = 100_000
"""Most draws that a certificate may ask a validator to repeat."""

DIGESTED = ("positions", "orientations", "scales", "opacities", "base_color", "roughness", "normals")
"""Arrays by which an asset is told from another one."""

ROUNDING = 1.01
"""Factor of the bound that another device is allowed."""


@dataclass(frozen=True, kw_only=True)
class Certificate:
    """What is known about the errors of an asset.

    Attributes:
        measure: One of `beam_warp.evaluate.relit.MEASURES`.
        bound: Bound on the error of a draw.
        share: Least share of all draws whose error is within the bound.
        confidence: Confidence of that share, over everything that was tried.
        pairs: Draws that it was measured on: light, camera, frame.
        within: Draws within the bound.
        first: Number of the first draw.
        mean: Mean error, with the ends of its interval of the same confidence by Student's t.
        psnr: Mean PSNR against the original [dB].
        asset_psnr: The original's PSNR against the truth, from which ``loss`` counts [dB]; it is not measured again.
        distribution: Lights by digest, image height, seed.
        original: Digest of the original.
        asset: Digest of the asset.
    """

    measure: str
    bound: float
    share: float
    confidence: float
    pairs: int
    within: int
    first: int
    mean: tuple[float, float, float]
    psnr: float
    asset_psnr: float
    distribution: dict[str, Any]
    original: str
    asset: str

    def __str__(self) -> str:
        """Return what is certified, in a sentence."""
        is_loss = self.measure == "loss"
        unit, of = (" dB", f" of an asset of {self.asset_psnr:.1f} dB") if is_loss else ("", "")
        low, high = (f"{end:.3g}" for end in self.mean[1:])
        return (
            f"{self.measure} at most {self.bound:.3g}{unit}{of} for at least {self.share:.1%} of lights, cameras and "
            f"frames, with {self.confidence:.1%} confidence "
            f"({self.within} of {self.pairs} draws; mean {self.mean[0]:.3g}, "
            f"{low} to {high}; {self.psnr:.1f} dB against the original)"
        )

    def as_metadata(self) -> dict[str, str]:
        """Return what an asset's metadata hold."""
        return {KEY: json.dumps(asdict(self), sort_keys=True)}

    @classmethod
    def of(cls, sequence: GaussianSequence) -> Certificate | None:
        """Return the certificate of an asset; None without one.

        Raises:
            AssetFormatError: It is damaged.
        """
        text = sequence.metadata.get(KEY)
        if text is None:
            return None
        try:
            record = json.loads(text)
            record["mean"] = tuple(float(value) for value in record["mean"])
            for field in fields(cls):
                kind = {"float": float, "int": int, "str": str}.get(str(field.type))
                if kind is not None:
                    record[field.name] = kind(record[field.name])
            made = cls(**record)
            sound = made.measure in MEASURES and 0 < made.pairs <= MOST_PAIRS and len(made.mean) == 3
            sound = sound and 0.0 < made.confidence < 1.0 and 0.0 <= made.first <= 2**31 and made.bound >= 0.0
            sound = sound and {"environments", "height", "seed"} <= set(made.distribution)
        except (ValueError, KeyError, TypeError, AttributeError, RecursionError, OverflowError) as error:
            raise AssetFormatError(f"{KEY} must be a certificate, got {text[:40]!r}. Reduce it again.") from error
        if not sound:
            raise AssetFormatError(f"{KEY} must be a certificate, got numbers out of range. Reduce it again.")
        return made


def certify(
    comparison: RelitComparison,
    asset: GaussianSequence,
    *,
    measure: str,
    bound: float,
    pairs: int,
    first: int = 0,
    confidence: float = 0.95,
    stated: float | None = None,
) -> Certificate:
    """Measure an asset on draws that no search saw.

    Args:
        comparison: With the original and the distribution.
        asset: What is certified, as it is stored.
        measure: One of `beam_warp.evaluate.relit.MEASURES`.
        bound: See `Certificate`.
        pairs: Number of draws.
        first: Number of the first one.
        confidence: Of this measurement.
        stated: Confidence that is stated, lower if something was tried before; the same without.
    """
    frames = range(len(asset))
    found = comparison.errors(asset, comparison.trials.draw("certificate", range(first, first + pairs), frames))
    errors = found.values(measure)
    within = int(np.count_nonzero(errors <= bound))
    wide = special.stdtrit(max(pairs - 1, 1), 0.5 + 0.5 * confidence) * max(errors.std(ddof=1), 1e-12) / pairs**0.5
    return Certificate(
        measure=measure,
        bound=float(bound),
        share=least_share(within, pairs, confidence),
        confidence=confidence if stated is None else stated,
        pairs=pairs,
        within=within,
        first=first,
        mean=(float(errors.mean()), float(errors.mean() - wide), float(errors.mean() + wide)),
        psnr=float(found.psnr.mean()),
        asset_psnr=comparison.asset_psnr,
        distribution=comparison.trials.describe(),
        original=asset_digest(comparison.original),
        asset=asset_digest(asset),
    )


def least_share(within: int, pairs: int, confidence: float) -> float:
    """Return the lower limit of a share by Clopper and Pearson, one-sided."""
    return float(special.betaincinv(within, pairs - within + 1, 1.0 - confidence)) if within else 0.0


def least_bound(errors: NDArray[np.floating], share: float, confidence: float) -> float:
    """Return the least bound that some draws certify for a share of all; infinite if there are too few draws."""
    counts = np.arange(1, len(errors) + 1)
    enough = counts[special.bdtrc(counts - 1, len(errors), share) <= 1.0 - confidence]
    return float(np.sort(errors)[enough[0] - 1]) if len(enough) else float("inf")


def asset_digest(sequence: GaussianSequence) -> str:
    """Return the digest of the first, the middle and the last frame of an asset."""
    frames = sorted({0, len(sequence) // 2, len(sequence) - 1})
    arrays = [getattr(cloud, name) for cloud in (sequence[frame] for frame in frames) for name in DIGESTED]
    return array_digest(*(array for array in arrays if array is not None), text=str(len(sequence)))


def measured_again(
    asset: GaussianSequence,
    original: GaussianSequence | None,
    environments: Sequence[EnvironmentMap],
    *,
    device: str | None = None,
) -> Measured:
    """Measure what a certificate states, on its own seed, and compare.

    Args:
        asset: With a certificate, or without.
        original: What it was made from; without it, only the certificate itself is judged.
        environments: The lights of the distribution.
        device: Warp device.

    Raises:
        InvalidOptionError: The original or the environments are others than the certificate's.
    """
    try:
        stated = Certificate.of(asset)
    except AssetFormatError as error:
        return Measured(CERTIFIED.id, False, 0.0, 1.0, str(error))
    if stated is None:
        return Measured.absent(CERTIFIED, "the asset has no certificate of a reduction")
    if asset_digest(asset) != stated.asset:
        return Measured(CERTIFIED.id, False, 0.0, 1.0, "an asset that was changed since")
    if original is None:
        return Measured.absent(CERTIFIED, "--original must name what the asset was reduced from")
    told = {name: stated.distribution[name] for name in ("height", "seed")}
    trials = RelitTrials(environments, **told, device=device)
    for name, there, here in (
        ("original", stated.original, asset_digest(original)),
        ("environment", stated.distribution["environments"], trials.describe()["environments"]),
    ):
        if there != here:
            raise InvalidOptionError(f"{name} must be the certificate's, {there}, got {here}. Name the same files.")
    how = {"measure": stated.measure, "asset_psnr": stated.asset_psnr, "device": device}
    comparison = RelitComparison(original, trials, **how)
    again = certify(
        comparison, asset, measure=stated.measure, bound=stated.bound * ROUNDING, pairs=stated.pairs, first=stated.first
    )
    words = f"{again.within} of {again.pairs} draws within {stated.bound:.3g} (stated: {stated.within})"
    return Measured(CERTIFIED.id, again.within >= stated.within, again.within, stated.within, words)
