"""Display of scene-linear light: exposure, a view transform, and 8-bit sRGB.

Every view transform maps scene-linear Rec.709 to display-linear Rec.709 in [0, 1]; `files.display_image` encodes the
result, so that there is one sRGB curve and one rounding:

- ``standard``: no curve; values are clipped at white and otherwise shown as they are.
- ``aces``: Narkowicz 2015 (ACES Filmic Tone Mapping Curve), a rational fit of ACES' RRT and sRGB ODT, per channel; as
  published, without the factor 0.6 on the light that he gives to match ACES' exposure.
- ``agx``: AgX-like, after Sobotka's published description: every primary is mixed with a little of the others (the
  inset), 2^-10 to 2^6.5 of middle grey are encoded by their logarithm and bent by a sigmoid, the mix is undone, and the
  display's power of 2.2. The inset's numbers are those of Wrensch 2023 (Minimal AgX Implementation), its rows made to
  sum to 1 so that grey stays grey; the sigmoid is the closed form behind the polynomial there. No look is applied.
- ``neutral``: Khronos PBR Neutral (specification of 2024): surfaces under white light keep their colour up to 0.76;
  brighter light is compressed and fades to white.

Alpha: a view transform is not linear. So light is divided by alpha, transformed, and then composited over the
background: the edge of a highlight has the highlight's colour, and a picture over a colour equals the picture with
alpha over that colour. Only an environment behind the subject is light of the same scene, and is added before
(`beam_warp.render.backdrops`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Literal, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from beam_warp.checks import require_array, require_choice, require_finite, require_number, require_range
from beam_warp.image.color import srgb_to_linear, straight
from beam_warp.image.files import display_image

ViewTransform: TypeAlias = Literal["standard", "aces", "agx", "neutral"]

EXPOSURE_RANGE = (-64.0, 64.0)
"""Range of the exposure [stops]."""

WHITEST = np.float32(2.0**24)
"""Light is clipped to this, at which every curve has reached white and whose square is finite in float32."""

MIDDLE_GREY = 0.18
AGX_STOPS = (-10.0, 6.5)
"""Range of light that AgX shows [stops from middle grey]."""

AGX_SLOPE, AGX_TOE, AGX_SHOULDER = 2.0, 3.0, 3.25
"""Slope of the sigmoid at middle grey, and the powers of its ends towards black and white."""

AGX_DISPLAY_POWER = 2.2

AGX_INSET = (
    (0.842479062253094, 0.0784335999999992, 0.0792237451477643),
    (0.0423282422610123, 0.878468636469772, 0.0791661274605434),
    (0.0423756549057051, 0.0784336, 0.879142973793104),
)
"""Mix of red, green and blue in each channel, one row a channel, before the rows are scaled to sum to 1."""

NEUTRAL_START, NEUTRAL_DESATURATION, FRESNEL = 0.8 - 0.04, 0.15, 0.04
"""Start of compression, rate at which colours fade to white, and reflectance of white highlights that is removed."""


def display(
    linear_rgb: ArrayLike, transform: ViewTransform = "standard", exposure_stops: float = 0.0
) -> NDArray[np.uint8]:
    """Show scene-linear light: exposure, view transform, sRGB curve, round to nearest.

    Args:
        linear_rgb: Scene-linear Rec.709, not multiplied by alpha, ``(H, W, 3)``, finite.
        transform: One of `TRANSFORMS`.
        exposure_stops: Gain in powers of two, before the transform.

    Returns:
        sRGB, ``(H, W, 3)``.

    Raises:
        InvalidArrayError: The shape is another, or a value is not finite.
        InvalidOptionError: The transform is none, or the exposure is out of range.
    """
    return display_image(display_linear(linear_rgb, transform, exposure_stops))


def display_linear(
    linear_rgb: ArrayLike, transform: ViewTransform = "standard", exposure_stops: float = 0.0
) -> NDArray[np.float32]:
    """Return the light that the display is to emit, ``(H, W, 3)`` float32 in [0, 1]; see `display`."""
    linear = require_array("linear_rgb", linear_rgb, (None, None, 3))
    require_finite("linear_rgb", linear)
    require_choice("transform", transform, TRANSFORMS)
    gain = 2.0 ** require_number("exposure_stops", exposure_stops, *EXPOSURE_RANGE)
    with np.errstate(over="ignore"):  # what is brighter than float32 is white
        exposed = linear * np.float32(gain)
    return np.clip(_CURVES[transform](np.clip(exposed, 0.0, WHITEST)), 0.0, 1.0).astype(np.float32)


def display_over(
    premultiplied_rgb: ArrayLike,
    alpha: ArrayLike,
    transform: ViewTransform = "standard",
    exposure_stops: float = 0.0,
    background: ArrayLike | None = None,
) -> NDArray[np.uint8]:
    """Show an image with coverage, for an 8-bit file.

    Args:
        premultiplied_rgb: Scene-linear Rec.709 multiplied by alpha, ``(H, W, 3)``, finite.
        alpha: Coverage in [0, 1], ``(H, W)``.
        transform: One of `TRANSFORMS`; it is applied to the colour, not to its product with alpha.
        exposure_stops: Gain in powers of two, before the transform.
        background: Display colour in [0, 1], ``(3,)``, to which transform and exposure do not apply; the image is
            composited over it in the display's linear light. None keeps alpha.

    Returns:
        sRGB: ``(H, W, 3)`` over a background or where alpha is 1 everywhere, else ``(H, W, 4)``, alpha straight.

    Raises:
        InvalidArrayError: A shape is another, a value is not finite, or alpha or the background is out of range.
        InvalidOptionError: The transform is none, or the exposure is out of range.
    """
    rgb = require_array("premultiplied_rgb", premultiplied_rgb, (None, None, 3))
    coverage = require_array("alpha", alpha, rgb.shape[:2])
    require_range("alpha", coverage, 0.0, 1.0)
    opacity = coverage[..., None]
    color = straight(rgb, opacity)
    if background is not None:
        behind = require_array("background", background, (3,))
        require_range("background", behind, 0.0, 1.0, "Use display values from 0 to 1.")
        shown = display_linear(color, transform, exposure_stops)
        return display_image(opacity * shown + (1.0 - opacity) * srgb_to_linear(behind))
    color = display(color, transform, exposure_stops)
    if (coverage == 1.0).all():
        return color
    return np.concatenate([color, np.rint(opacity * 255.0).astype(np.uint8)], axis=-1)


def agx_sigmoid(encoded: ArrayLike) -> NDArray[Any]:
    """Return the display value in [0, 1] of light whose logarithm was mapped to [0, 1].

    Each half is s u (1 + u^p)^(-1/p) about middle grey, u = slope (x - pivot) / s: the slope is that asked for at the
    pivot, and the scale s is such that the curve ends at exactly 0 and 1.
    """
    x = np.clip(np.asarray(encoded), 0.0, 1.0)
    pivot = AGX_STOPS[0] / (AGX_STOPS[0] - AGX_STOPS[1])
    toe = _agx_half(np.maximum(pivot - x, 0.0), pivot, AGX_TOE)
    shoulder = _agx_half(np.maximum(x - pivot, 0.0), 1.0 - pivot, AGX_SHOULDER)
    return 0.5 - toe + shoulder


def _agx_half(distance: NDArray[Any], reach: float, power: float) -> NDArray[Any]:
    """Return the sigmoid's difference from 0.5 at a distance from its pivot; it is 0.5 at the reach."""
    end = AGX_SLOPE * reach
    scale = (0.5**-power - end**-power) ** (-1.0 / power)  # solves scale u (1 + u^p)^(-1/p) = 0.5 at the end
    u = AGX_SLOPE * distance / scale
    return scale * u * (1.0 + u**power) ** (-1.0 / power)


def _standard(linear: NDArray[np.float32]) -> NDArray[np.float32]:
    return linear


def _aces(linear: NDArray[np.float32]) -> NDArray[np.float32]:
    return (linear * (2.51 * linear + 0.03) / (linear * (2.43 * linear + 0.59) + 0.14)).astype(np.float32)


def _agx(linear: NDArray[np.float32]) -> NDArray[np.float32]:
    inset = np.array(AGX_INSET)
    inset /= inset.sum(axis=1, keepdims=True)
    low, high = AGX_STOPS
    stops = np.log2(np.maximum(linear @ (inset.T / MIDDLE_GREY).astype(np.float32), 2.0**low))
    shown = agx_sigmoid((stops - low) / (high - low)) @ np.linalg.inv(inset).T.astype(np.float32)
    return np.maximum(shown, 0.0) ** AGX_DISPLAY_POWER


def _neutral(linear: NDArray[np.float32]) -> NDArray[np.float32]:
    low = linear.min(axis=-1, keepdims=True)
    color = linear - np.where(low < 2.0 * FRESNEL, low - low**2 / (4.0 * FRESNEL), FRESNEL)
    peak = color.max(axis=-1, keepdims=True)
    room = 1.0 - NEUTRAL_START
    new_peak = 1.0 - room**2 / np.maximum(peak + room - NEUTRAL_START, room)
    compressed = color * (new_peak / np.maximum(peak, NEUTRAL_START))
    white = 1.0 - 1.0 / (NEUTRAL_DESATURATION * np.maximum(peak - new_peak, 0.0) + 1.0)
    return np.where(peak < NEUTRAL_START, color, compressed * (1.0 - white) + new_peak * white)


_CURVES: Mapping[str, Callable[[NDArray[np.float32]], NDArray[np.float32]]] = {
    "standard": _standard,
    "aces": _aces,
    "agx": _agx,
    "neutral": _neutral,
}

TRANSFORMS = tuple(_CURVES)
"""Names of the view transforms."""
