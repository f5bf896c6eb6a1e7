"""Faults of a capture's images, as far as small copies of them show: black images, coverage, exposure."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from beam_warp.capture.findings import Finding, Findings, are, count_of, names_of
from beam_warp.capture.mattes import MaskOffset
from beam_warp.capture.quality import ImageQuality, quality_of
from beam_warp.capture.records import CaptureRecord
from beam_warp.image.color import LUMINANCE
from beam_warp.image.files import display_image

GLIMPSE_SIDE = 160
"""Images are reduced by whole factors until their longer side is this long or a little longer [pixel]."""

EXPOSURE_STOPS = 0.7
"""Exposures that differ from those expected by more than this are reported [stops]. Light from one side makes views of
a subject differ by 1.2 stops between front and back; the rest, once that is fitted, is 0.32 at most in our captures."""

FIT_CAMERAS = 10
"""Fewest cameras for which exposure is expected to vary linearly with the direction of view; with fewer, it is expected
to be the same."""

PLAIN_STOPS = 1.5
"""Replaces `EXPOSURE_STOPS` with fewer cameras, where light from one side and exposure cannot be told apart [stops]."""

SPREADS = 4.0
"""Cameras differ from what is expected if they do so by this many standard deviations of all, by the median: where
light is hard, or faces are few, nothing that is linear expects well."""

BLACK = 1e-4
"""An image is black if its brightest pixel is at most this share of the median image's brightest pixel."""

MASK_PIXELS, MASK_ERRORS = 0.5, 3.0
"""Masks that are off by more than so many pixels and so many standard errors are reported."""

STEEPER = 1.5
"""Outlines that are made so many times steeper, or filtered, are reported."""

SOFT_PIXELS, SURELY_SOFT = 0.4, 0.7
"""Blur that is reported [pixel]: the first where coverage shows it, or the median of all photographs does; the second
of a single photograph, whose shading widens edges by up to 0.5. A circle of confusion of two pixels is 0.5, and costs
novel views 3 dB; sharp renderings are below 0.1."""

STREAKED = 0.5
"""Blur whose least deviation is below this part of its largest is one of motion."""

NOISY = 0.05
"""Noise of a pixel over its value, in the middle of the subject's levels, from which on images are reported."""

LOSSY = 3.5
"""Errors of a JPEG's luminance from which on it is reported [level of 255]: those of quality 90 of libjpeg's 100, which
costs base colour 3 dB, and of less."""

SOLID = 0.5
"""A pixel belongs to the subject if its alpha is above this."""


@dataclass(frozen=True, eq=False)
class Glimpse:
    """One image at a fraction of its resolution.

    Attributes:
        record: The record of the image.
        pixels: Display sRGB, not premultiplied, ``(H, W, 3)`` uint8.
        alpha: Coverage, ``(H, W)`` float32; None if it is unknown.
        brightest: Largest value of a colour channel.
        exposure: Median luminance of the subject, or of all where coverage is not known, as a power of two; None for
            an image without a subject, or a black one.
        coverage: Mean alpha; None if it is unknown.
        quality: How sharp and how noisy it is.
        mask_offset: How far the mask reached beyond the subject, and how it was redrawn; None if nothing tells.
    """

    record: CaptureRecord
    pixels: NDArray[np.uint8]
    alpha: NDArray[np.float32] | None
    brightest: float
    exposure: float | None
    coverage: float | None
    quality: ImageQuality
    mask_offset: MaskOffset | None = None


def glimpse_of(record: CaptureRecord) -> Glimpse:
    """Read an image at a fraction of its resolution.

    Raises:
        MissingFileError, AssetFormatError: See `CaptureRecord.view`.
    """
    view = record.view()
    quality = quality_of(record, view)
    factor = max(1, max(view.camera.width, view.camera.height) // GLIMPSE_SIDE)
    view = view.reduced(min(factor, view.camera.width, view.camera.height))
    color, alpha = view.color, view.alpha
    if alpha is not None:
        color = np.divide(color, alpha[..., None], out=np.zeros_like(color), where=alpha[..., None] > 1e-6)
    subject = np.ones(color.shape[:2], bool) if alpha is None else alpha > SOLID
    luminance = (color @ LUMINANCE.astype(np.float32))[subject]
    level = float(np.median(luminance)) if len(luminance) else 0.0
    return Glimpse(
        record=record,
        pixels=display_image(np.clip(color, 0.0, 1.0)),
        alpha=alpha,
        brightest=float(view.color.max()),
        exposure=float(np.log2(level)) if level > 0.0 else None,
        coverage=None if alpha is None else float(alpha.mean()),
        quality=quality,
        mask_offset=view.mask_offset,
    )


def judge_images(training: Sequence[CaptureRecord], glimpses: Sequence[Glimpse], findings: Findings) -> set[str]:
    """Check the contents of images.

    Args:
        training: The records that are reconstructed from.
        glimpses: Images that were looked at, of training records and others.
        findings: List to which findings are added.

    Returns:
        Names of records whose images show nothing.
    """
    if not glimpses:
        return set()
    level = float(np.median([glimpse.brightest for glimpse in glimpses]))
    empty = [glimpse for glimpse in glimpses if _is_empty(glimpse)]
    black = [glimpse for glimpse in glimpses if not glimpse.brightest > BLACK * level and glimpse not in empty]
    left_out: set[str] = set()
    for void, code, what, remedy in (
        (black, "black-image", "black", "Check the cameras."),
        (
            empty,
            "empty-mask",
            "of nothing, by mask or alpha,",
            "Right if the subject is out of the image; else make the masks again.",
        ),
    ):
        if not void:
            continue
        dead = _dead_cameras(glimpses, void)
        findings.add(
            "error" if len(void) == len(glimpses) else "warning",
            code,
            f"{count_of(len(void), 'image')} {are(void)} {what} and left out"
            + (f", with all others of {names_of(sorted(dead))}" if dead else ""),
            _names(void),
            remedy,
        )
        left_out |= {*_names(void), *(record.name for record in training if record.camera_name in dead)}
    shown = [glimpse for glimpse in glimpses if glimpse not in black and glimpse not in empty]
    _judge_coverage(shown, findings)
    _judge_outlines(shown, findings)
    _judge_quality(shown, findings)
    names = {record.name for record in training}
    _judge_exposure([glimpse for glimpse in shown if glimpse.record.name in names], findings)
    return left_out


def _names(glimpses: Iterable[Glimpse]) -> list[str]:
    return [glimpse.record.name for glimpse in glimpses]


def _is_dim(alpha: NDArray[np.float32]) -> bool:
    """Tell a mask of 0 and 1 from one of 0 and 255."""
    return bool(0.0 < alpha.max() <= 2.5 / 255.0)


def _is_empty(glimpse: Glimpse) -> bool:
    return glimpse.alpha is not None and not glimpse.alpha.max() > SOLID and not _is_dim(glimpse.alpha)


def _dead_cameras(glimpses: Sequence[Glimpse], void: Sequence[Glimpse]) -> set[str]:
    """Return the cameras all of whose glimpses are void; they are left out as a whole.

    This holds for empty masks too: a single one would carve away all of the subject.
    """
    alive = {glimpse.record.camera_name for glimpse in glimpses if glimpse not in void}
    return {glimpse.record.camera_name for glimpse in void} - alive


def _judge_coverage(glimpses: Sequence[Glimpse], findings: Findings) -> None:
    """Find masks that do not tell the subject from the background."""
    if not glimpses:
        return
    known = [(glimpse, glimpse.alpha) for glimpse in glimpses if glimpse.alpha is not None]
    if not known:
        findings.warn(
            "no-coverage",
            "images have no alpha and no masks: background counts as the subject does, and there is no visual hull",
            remedy="For a subject by itself, write masks (masks/<image>.png, white on the subject) or plates "
            "(plates/<camera>.png, without the subject; beam plates makes them where the subject moves).",
        )
        return
    unknown = [glimpse for glimpse in glimpses if glimpse.alpha is None]
    if unknown:
        findings.warn(
            "some-coverage",
            f"{count_of(len(unknown), 'image')} of {len(glimpses)} {are(unknown)} without alpha and mask: "
            "all that they show counts",
            _names(unknown),
            "Write their masks.",
        )
    low = [glimpse for glimpse, alpha in known if _is_dim(alpha)]
    if low:
        findings.add(
            "error",
            "mask-range",
            f"{count_of(len(low), 'mask')} {are(low)} never brighter than 2 of 255: written as 0 and 1, it seems",
            _names(low),
            "Write masks with white as 255.",
        )
    full = [glimpse for glimpse, alpha in known if float(alpha.min()) > 0.99]
    if full:
        findings.add(
            "error" if len(full) == len(glimpses) else "warning",
            "full-mask",
            f"mask or alpha of {count_of(len(full), 'image')} of {len(known)} is white everywhere: background "
            "counts as the subject does",
            _names(full),
            "Make masks that are white on the subject alone, or save the images without alpha.",
        )
    inverted = [glimpse for glimpse, alpha in known if glimpse not in full and _is_inverted(alpha)]
    if inverted:
        findings.warn(
            "inverted-mask",
            f"{count_of(len(inverted), 'mask')} {are(inverted)} white all along the border and not within: "
            "perhaps inverted",
            _names(inverted),
            "White is the subject.",
        )


def _judge_outlines(glimpses: Sequence[Glimpse], findings: Findings) -> None:
    """Find cameras whose masks end elsewhere than the subject does, or are not as soft."""
    by_camera: dict[str, list[MaskOffset]] = defaultdict(list)
    for glimpse in glimpses:
        if glimpse.mask_offset is not None:
            by_camera[glimpse.record.camera_name].append(glimpse.mask_offset)
    off = {name: _middle_of(offsets) for name, offsets in by_camera.items()}
    wrong = {
        name: found for name, found in off.items() if abs(found.pixels) > max(MASK_PIXELS, MASK_ERRORS * found.error)
    }
    if wrong:
        findings.append(offset_finding(wrong))
    redrawn = [name for name, offsets in by_camera.items() if name not in wrong and _are_redrawn(offsets)]
    if redrawn:
        findings.warn(
            "mask-softness",
            f"masks of {count_of(len(redrawn), 'camera')} are all or nothing, or softer than the subject is in its "
            "photographs: their outlines are redrawn",
            redrawn,
            "Export the coverage of every pixel, neither thresholded nor feathered nor resized.",
        )


def _middle_of(offsets: Sequence[MaskOffset]) -> MaskOffset:
    """Return the median offset, and the median of the errors."""
    pixels, errors = zip(*((found.pixels, found.error) for found in offsets), strict=True)
    return MaskOffset(float(np.median(pixels)), float(np.median(errors)))


def _are_redrawn(offsets: Sequence[MaskOffset]) -> bool:
    """Tell whether the outlines of most masks are filtered, or made much steeper."""
    return 2 * sum(found.edge.blur > 0.0 or found.edge.gain >= STEEPER for found in offsets) > len(offsets)


def offset_finding(offsets: Mapping[str, MaskOffset]) -> Finding:
    """Return the finding that masks of some cameras end elsewhere than the subject does."""
    return Finding(
        "warning",
        "mask-offset",
        f"masks of {count_of(len(offsets), 'camera')} end outside (+) or inside (-) of where the subject does, and are "
        "moved there",
        names_of(f"{name} {found.pixels:+.1f} ± {found.error:.1f}" for name, found in offsets.items()),
        "Make them again for outlines that are exact.",
    )


def _judge_quality(glimpses: Sequence[Glimpse], findings: Findings) -> None:
    """Find images that are blurred, noisy, or lost much to compression."""
    photographs = [glimpse.quality.blur[0] for glimpse in glimpses if not glimpse.quality.by_coverage]
    told = [blur for blur in photographs if np.isfinite(blur)]
    limit = SOFT_PIXELS if told and np.median(told) > SOFT_PIXELS else SURELY_SOFT
    soft, streaked = {}, {}
    for glimpse in glimpses:
        least, largest = glimpse.quality.blur
        if least > (SOFT_PIXELS if glimpse.quality.by_coverage else limit):
            soft[glimpse.record.name] = least
        elif glimpse.quality.by_coverage and largest > SOFT_PIXELS and least < STREAKED * largest:
            streaked[glimpse.record.name] = largest
    noises = [glimpse.quality.noise for glimpse in glimpses if np.isfinite(glimpse.quality.noise)]
    noisy = {glimpse.record.name: glimpse.quality.noise for glimpse in glimpses if glimpse.quality.noise > NOISY}
    if not 2 * len(noisy) > len(noises):
        noisy = {}  # texture of some views
    lossy = {glimpse.record.name: glimpse.quality.loss for glimpse in glimpses if glimpse.quality.loss > LOSSY}
    blotted = {glimpse.record.name: glimpse.quality.blots for glimpse in glimpses if glimpse.quality.blots}
    for found, code, what, form, remedy in (
        (
            soft,
            "soft-images",
            "blurred in all directions: out of focus, enlarged, or with feathered masks; what is given are standard "
            "deviations",
            "{:.1f} px",
            "The asset will be as soft. Focus again, or take smaller copies of the images: nothing is lost.",
        ),
        (
            streaked,
            "motion-blur",
            "blurred in one direction; what is given are standard deviations",
            "{:.1f} px",
            "The asset will be as soft. Expose for a shorter time.",
        ),
        (
            noisy,
            "noisy-images",
            f"noisy: a pixel is off by more than {NOISY:.0%} of its value in the middle of the subject's levels",
            "{:.0%}",
            "Views average it out; base colour and roughness are less certain. Light more, or expose longer.",
        ),
        (
            lossy,
            "jpeg-loss",
            f"compressed so that luminance may be off by more than {LOSSY:g} of 255 levels",
            "{:.1f}",
            "Base colour loses more than sharpness. Give images without loss, or JPEG of a quality of 95 or more.",
        ),
        (
            blotted,
            "mask-blots",
            "masked with holes that show the subject, or islands that show the backdrop",
            "{} px",
            "A hole is cut into the subject, an island is taken for it. Make these masks again.",
        ),
    ):
        if found:
            worst = sorted(found, key=lambda name: -found[name])
            counted = f"{count_of(len(found), 'image')} of {len(glimpses)} {are(found)} {what}"
            findings.warn(code, counted, (f"{name} {form.format(found[name])}" for name in worst), remedy)


def _is_inverted(alpha: NDArray[np.float32]) -> bool:
    border = np.concatenate([alpha[0], alpha[-1], alpha[:, 0], alpha[:, -1]])
    return bool(border.mean() > 0.95 and alpha.mean() < 0.95 * border.mean())


def _judge_exposure(glimpses: Sequence[Glimpse], findings: Findings) -> None:
    """Find cameras and frames that are brighter or darker than the others."""
    by_camera: dict[str, dict[int, float]] = defaultdict(dict)
    forward = {}
    for glimpse in glimpses:
        if glimpse.exposure is not None:
            by_camera[glimpse.record.camera_name][glimpse.record.frame] = glimpse.exposure
            forward[glimpse.record.camera_name] = glimpse.record.camera.forward
    if len(by_camera) < 3:
        return
    names = sorted(by_camera)
    levels = np.array([np.median(list(by_camera[name].values())) for name in names])
    fits = len(names) >= FIT_CAMERAS
    off = levels - _expected(levels, np.array([forward[name] for name in names]) if fits else None)
    left = np.sort(np.abs(off))[4 if fits else 0 :]  # four lie on a plane of least absolute errors
    spread = 1.4826 * float(np.median(left))
    limit = max(EXPOSURE_STOPS if fits else PLAIN_STOPS, SPREADS * spread)
    wrong = {name: value for name, value in zip(names, off, strict=True) if abs(value) > limit}
    if wrong:
        findings.warn(
            "camera-exposure",
            f"{count_of(len(wrong), 'camera')} {are(wrong)} more than {limit:.1f} stops from what the others "
            "lead to expect",
            (f"{name} {value:+.1f}" for name, value in wrong.items()),
            "Match their exposure and white balance; a wrong camera pulls colours of all views.",
        )
    frames = sorted({frame for row in by_camera.values() for frame in row})
    remedy = "Fix exposure while recording, or match the frames."
    for before, after in pairwise(frames):
        steps = {name: row[after] - row[before] for name, row in by_camera.items() if before in row and after in row}
        if not steps:
            continue
        common = float(np.median(list(steps.values())))
        if abs(common) > EXPOSURE_STOPS:
            what = f"all cameras change by {common:+.1f} stops between frames {before} and {after}"
            findings.warn("frame-exposure", what, remedy=remedy)
        jumps = {name: step for name, step in steps.items() if abs(step - common) > EXPOSURE_STOPS}
        if jumps:
            findings.warn(
                "frame-exposure",
                f"exposure of {count_of(len(jumps), 'camera')} changes by {EXPOSURE_STOPS:g} stops more than "
                f"that of the others between frames {before} and {after}",
                (f"{name} {step:+.1f}" for name, step in jumps.items()),
                remedy,
            )


def _expected(levels: NDArray[np.float64], directions: NDArray[np.float64] | None) -> NDArray[np.float64]:
    """Return each camera's expected exposure: the median, or a plane over directions fitted by least absolute error."""
    if directions is None:
        return np.full_like(levels, np.median(levels))
    columns = np.concatenate([np.ones((len(levels), 1)), directions], axis=1)
    weights = np.ones(len(levels))
    fitted = levels
    for _ in range(50):
        root = np.sqrt(weights)
        fitted = columns @ np.linalg.lstsq(columns * root[:, None], levels * root, rcond=None)[0]
        weights = 1.0 / np.maximum(np.abs(levels - fitted), 1e-3)
    return fitted
