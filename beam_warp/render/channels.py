"""One channel of a cloud as a camera sees it: colours as they are, numbers by a colour map, flags by colours."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from PIL import Image as PillowImage
from PIL import ImageDraw, ImageFont

from beam_warp.checks import require_choice, require_count
from beam_warp.errors import InvalidArrayError
from beam_warp.image.color import DISPLAY_SRGB
from beam_warp.image.files import display_image
from beam_warp.image.metrics import block_means
from beam_warp.image.panels import BACKGROUND, over_background
from beam_warp.raster.channels import CHANNELS, RADIANCE, UNIT_CHANNELS, channel_layers
from beam_warp.raster.drawn_part import drawn_part
from beam_warp.raster.gbuffer import rasterize, rasterize_values
from beam_warp.raster.pixel_means import PixelMeans
from beam_warp.raster.records import RasterOptions
from beam_warp.world.camera import Camera
from beam_warp.world.gaussians import ATTRIBUTES, GaussianCloud, Observability

OBSERVABILITY = "observability"
"""The channel that is no number: flags, of which a pixel sees shares."""

DRAWABLE = (*CHANNELS, OBSERVABILITY)
"""Every channel that `see_channel` knows; a cloud may lack some."""

FLAG_COLORS = {
    Observability.UNSEEN: ("unseen", "#d55e00"),
    Observability.UNLIT: ("unlit", "#0072b2"),
    Observability.GRAZING: ("grazing", "#009e73"),
    Observability.SATURATED: ("saturated", "#f0e442"),
    Observability.UNCERTAIN_NORMAL: ("uncertain normal", "#cc79a7"),
    Observability.FILLED: ("filled", "#56b4e9"),
}
"""Names and colours of flags (Okabe and Ito 2008: told apart by the colour-blind too); the gravest first."""

OBSERVED_COLOR = "#d9d9d9"

VIRIDIS = (
    *("#440154", "#48186a", "#472d7b", "#424086", "#3b528b", "#33638d", "#2c728e", "#26828e", "#21918c"),
    *("#1fa088", "#28ae80", "#3fbc73", "#5ec962", "#84d44b", "#addc30", "#d8e219", "#fde725"),
)
"""Matplotlib's viridis at every sixteenth, sRGB: equal steps look equal, in grey and to the colour-blind too."""

MOST_GAUSSIANS = 0.95
"""A range without an upper end of its own ends where that of this part of the Gaussians does, rounded up."""

TEXT_COLOR = (225, 225, 225)
TEXT_SIZE = 13
LINE_HEIGHT = 20
MARGIN = 6


@dataclass(frozen=True, eq=False)
class SeenChannel:
    """What a camera sees of one channel.

    Attributes:
        name: One of `DRAWABLE`.
        alpha: Coverage, ``(H, W)`` float32.
        values: The mean of what each pixel sees, ``(H, W)`` or ``(H, W, C)`` float32, as in
            `beam_warp.raster.gbuffer.GBuffer`; of ``observability`` the share of what it sees that has each flag, ``(H,
            W, 6)`` in the order of `FLAG_COLORS`.
        is_display: True for colours that are display-referred.
    """

    name: str
    alpha: NDArray[np.float32]
    values: NDArray[np.float32]
    is_display: bool = False

    @property
    def is_mapped(self) -> bool:
        """True if a colour map shows it: a number, or the errors of three."""
        return self.name not in (OBSERVABILITY, RADIANCE, *UNIT_CHANNELS) and (
            self.values.ndim == 2 or self.name.endswith("_error")
        )

    def layers(self) -> dict[str, NDArray[np.float32]]:
        """Return alpha and the values as layers of an image file: ``A``, ``roughness``, ``observability.unlit`` …"""
        if self.name != OBSERVABILITY:
            return {"A": self.alpha, **channel_layers(self.name, self.values)}
        names = (word.replace(" ", "_") for word, _ in FLAG_COLORS.values())
        return {"A": self.alpha} | {f"{self.name}.{word}": self.values[..., i] for i, word in enumerate(names)}

    def flag_shares(self) -> dict[str, float]:
        """Return by name the share of all that is seen that has each flag, in [0, 1]; of ``observability`` alone."""
        weights = self.alpha.astype(np.float64)
        seen = np.einsum("hw,hwc->c", weights, self.values) / max(float(weights.sum()), 1e-12)
        return {word: float(share) for (word, _), share in zip(FLAG_COLORS.values(), seen, strict=True)}

    def picture(self, value_range: tuple[float, float] = (0.0, 1.0)) -> NDArray[np.uint8]:
        """Return a picture for a display, with a legend below where colours need one.

        Colours are shown as they are, directions as r, g, b for x, y, z. What has a number is shown by viridis, of
        three errors their root mean square. Of flags the gravest that at least half of what a pixel sees has.

        Args:
            value_range: What the ends of the colour map stand for; see `channel_range`.

        Returns:
            8-bit sRGB, ``(H + legend, W, 3)``.
        """
        shown = over_background(self.colors(value_range), self.alpha[..., None])
        legend = self.legend(shown.shape[1], value_range)
        return shown if legend is None else np.concatenate([shown, legend])

    def colors(self, value_range: tuple[float, float] = (0.0, 1.0)) -> NDArray[np.float64]:
        """Return the display colours of a picture in [0, 1], nothing behind them and not multiplied by alpha."""
        if self.name == OBSERVABILITY:
            return _flag_colors(self.values)
        if self.is_mapped:
            low, high = value_range
            numbers = self.values if self.values.ndim == 2 else np.sqrt((self.values**2).mean(axis=-1))
            return _viridis((numbers - low) / (high - low))
        if self.name in UNIT_CHANNELS:
            return 0.5 * self.values.astype(np.float64) + 0.5
        straight = self.values if self.is_display else display_image(self.values) / 255.0
        return np.clip(straight, 0.0, 1.0).astype(np.float64)

    def legend(self, width: int, value_range: tuple[float, float] = (0.0, 1.0)) -> NDArray[np.uint8] | None:
        """Return what the colours of a picture mean, ``(h, width, 3)``; None where they mean themselves."""
        if self.name == OBSERVABILITY:
            shares = self.flag_shares()
            entries = [(f"{word} {shares[word]:.1%}", color) for word, color in FLAG_COLORS.values()]
            return _flag_legend(width, [*entries, ("none of these", OBSERVED_COLOR)])
        return _bar_legend(width, self.name, *value_range) if self.is_mapped else None


def see_channel(
    cloud: GaussianCloud,
    camera: Camera,
    name: str,
    *,
    samples: int = 1,
    options: RasterOptions | None = None,
    device: str | None = None,
) -> SeenChannel:
    """Draw one channel of a cloud.

    Args:
        cloud: Gaussians, axes "rfu".
        camera: The view.
        name: One of `DRAWABLE`.
        samples: Side of the square of samples of a pixel, of which it is the mean.
        options: How splats are drawn: as they were when the Gaussians were fitted.
        device: Warp device.

    Raises:
        InvalidOptionError: There is no such channel, the samples are out of range, or the cloud is in other axes.
        InvalidArrayError: The cloud lacks the channel.
    """
    require_choice("channel", name, DRAWABLE)
    part = drawn_part(cloud, camera, options or RasterOptions())
    fine = camera.cropped(*part).supersampled(require_count("samples", samples, 1, 16))
    if name != OBSERVABILITY:
        buffer = rasterize(cloud, fine, channels=(name,), options=options, device=device)
        is_display = name == RADIANCE and cloud.radiance_color_space == DISPLAY_SRGB
        means = PixelMeans.of(buffer, samples)
        return SeenChannel(
            name, part.placed(means.alpha, camera), part.placed(means.channels[name], camera), is_display
        )
    if cloud.observability is None:
        raise InvalidArrayError(
            f"channel must be one that the cloud holds, got {name!r}, which it lacks "
            f"(it has {', '.join(cloud.arrays())}). Choose another."
        )
    flags = np.stack([(cloud.observability & np.uint8(flag)) != 0 for flag in FLAG_COLORS], axis=1)
    seen = rasterize_values(cloud, fine, flags.astype(np.float32), options=options, device=device)
    alpha = block_means(seen.alpha, samples).astype(np.float32)
    values, weights = block_means(seen.values, samples).astype(np.float32), alpha[..., None]
    shares = np.divide(values, weights, out=np.zeros_like(values), where=weights > 0.0)
    alpha = np.minimum(alpha, np.float32(1.0))
    return SeenChannel(name, part.placed(alpha, camera), part.placed(shares, camera))


def channel_range(cloud: GaussianCloud, name: str) -> tuple[float, float]:
    """Return what the ends of a colour map stand for: a channel's own limits, or those of most Gaussians.

    It depends on the Gaussians and not on what is in view, so that pictures from all sides have one scale.
    """
    attribute = ATTRIBUTES.get(name)
    array = None if attribute is None else getattr(cloud, name)
    if attribute is None or array is None or np.isfinite(attribute.high) or not len(array):
        return (0.0, 1.0)
    numbers = np.sqrt((array.reshape(len(array), -1).astype(np.float64) ** 2).mean(axis=1))
    return (0.0, _rounded_up(float(np.quantile(numbers, MOST_GAUSSIANS))))


def _rounded_up(value: float) -> float:
    """Return the next of 1, 2 and 5 times a power of ten, which rounding to half precision does not pass; 1 for 0."""
    if not value > 0.0:
        return 1.0
    power = 10.0 ** np.floor(np.log10(value))
    return float(next(step * power for step in (1.0, 2.0, 5.0, 10.0) if value <= step * power * (1.0 + 2.0**-11)))


def _rgb(color: str) -> NDArray[np.float64]:
    """Return a colour written as six hexadecimal digits."""
    return np.frombuffer(bytes.fromhex(color.lstrip("#")), np.uint8) / 255.0


def _viridis(numbers: NDArray[np.floating]) -> NDArray[np.float64]:
    """Return display colours ``(..., 3)`` of numbers, cut to [0, 1]."""
    anchors = np.stack([_rgb(color) for color in VIRIDIS])
    places = np.linspace(0.0, 1.0, len(anchors))
    return np.stack([np.interp(numbers, places, column) for column in anchors.T], axis=-1)


def _flag_colors(shares: NDArray[np.floating]) -> NDArray[np.float64]:
    """Return the colour of the gravest flag that at least half of what a pixel sees has, ``(H, W, 3)``."""
    has = shares >= 0.5
    gravest = np.where(has.any(axis=-1), has.argmax(axis=-1), len(FLAG_COLORS))
    palette = np.stack([_rgb(color) for color in (*(color for _, color in FLAG_COLORS.values()), OBSERVED_COLOR)])
    return palette[gravest]


def _strip(width: int, lines: int) -> tuple[PillowImage.Image, ImageDraw.ImageDraw]:
    """Return an empty place for a legend."""
    shade = round(255 * BACKGROUND * 0.7)
    image = PillowImage.new("RGB", (width, lines * LINE_HEIGHT + 2 * MARGIN), (shade,) * 3)
    return image, ImageDraw.Draw(image)


def _bar_legend(width: int, name: str, low: float, high: float) -> NDArray[np.uint8]:
    """Return the colour map between its ends, and whose it is below."""
    image, draw = _strip(width, 2)
    font = ImageFont.load_default(size=TEXT_SIZE)
    ends = f"{low:g}", f"{high:g}"
    left = MARGIN + round(draw.textlength(ends[0], font=font)) + MARGIN
    right = width - 2 * MARGIN - round(draw.textlength(ends[1], font=font))
    draw.text((MARGIN, MARGIN), ends[0], fill=TEXT_COLOR, font=font)
    draw.text((right + MARGIN, MARGIN), ends[1], fill=TEXT_COLOR, font=font)
    if right > left:
        bar = np.broadcast_to(_viridis(np.linspace(0.0, 1.0, right - left)), (LINE_HEIGHT - 6, right - left, 3))
        image.paste(PillowImage.fromarray(np.rint(255.0 * bar).astype(np.uint8)), (left, MARGIN + 3))
    draw.text((MARGIN, MARGIN + LINE_HEIGHT), name, fill=TEXT_COLOR, font=font)
    return np.asarray(image)


def _flag_legend(width: int, entries: Sequence[tuple[str, str]]) -> NDArray[np.uint8]:
    """Return squares of colours and their names, in as many lines as they need."""
    font = ImageFont.load_default(size=TEXT_SIZE)
    _, ruler = _strip(1, 1)
    side = LINE_HEIGHT - 8
    places, line, x = [], 0, MARGIN
    for text, _ in entries:
        length = side + 4 + round(ruler.textlength(text, font=font)) + 2 * MARGIN
        if x > MARGIN and x + length > width:
            line, x = line + 1, MARGIN
        places.append((x, MARGIN + line * LINE_HEIGHT))
        x += length
    image, draw = _strip(width, line + 1)
    for (left, top), (text, color) in zip(places, entries, strict=True):
        draw.rectangle((left, top + 3, left + side, top + 3 + side), fill=color)
        draw.text((left + side + 4, top), text, fill=TEXT_COLOR, font=font)
    return np.asarray(image)
