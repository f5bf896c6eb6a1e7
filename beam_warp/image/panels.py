"""Layout of panels with titles as one picture."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from PIL import Image as PillowImage
from PIL import ImageDraw, ImageFont

from beam_warp.image.color import straight
from beam_warp.image.files import display_image

BACKGROUND = 0.13
"""Display grey behind subjects, on which dark and white ones are both visible."""

MARGIN = 8
TITLE_HEIGHT = 30
TITLE_SIZE = 16
Panel = tuple[str, NDArray[np.uint8]]
"""A title and 8-bit sRGB pixels ``(H, W, 3)``."""


def gray(values: NDArray[np.floating]) -> NDArray[np.floating]:
    """Return values ``(H, W)`` as display colour, 0 black and 1 white."""
    return np.repeat(np.clip(values, 0.0, 1.0)[..., None], 3, axis=-1)


def display_color(image: NDArray[np.floating], alpha: NDArray[np.floating], stops: float = 0.0) -> NDArray[np.floating]:
    """Return premultiplied radiance as straight display colour in [0, 1]."""
    return display_image(straight(image, alpha[..., None]), stops) / 255.0


def over_background(display: NDArray[np.floating], alpha: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Composite straight display colour ``(H, W, 3)`` in [0, 1] with coverage ``(H, W, 1)`` onto the background."""
    return np.rint(255.0 * (display * alpha + BACKGROUND * (1.0 - alpha))).astype(np.uint8)


def lay_out(panels: Sequence[Panel], columns: int) -> NDArray[np.uint8]:
    """Return one image of panels of equal size with their titles, row by row."""
    height, width = panels[0][1].shape[:2]
    cell = (height + TITLE_HEIGHT + MARGIN, width + MARGIN)
    rows = -(-len(panels) // columns)
    shade_of_frame = round(255 * BACKGROUND * 0.7)
    sheet = PillowImage.new("RGB", (columns * cell[1] + MARGIN, rows * cell[0] + MARGIN), (shade_of_frame,) * 3)
    draw = ImageDraw.Draw(sheet)
    for number, (title, pixels) in enumerate(panels):
        left = MARGIN + number % columns * cell[1]
        top = MARGIN + number // columns * cell[0]
        size = TITLE_SIZE
        while draw.textlength(title, font=ImageFont.load_default(size=size)) > width and size > 8:
            size -= 1
        draw.text((left + 2, top + 5), title, fill=(225, 225, 225), font=ImageFont.load_default(size=size))
        sheet.paste(PillowImage.fromarray(pixels), (left, top + TITLE_HEIGHT))
    return np.asarray(sheet)
