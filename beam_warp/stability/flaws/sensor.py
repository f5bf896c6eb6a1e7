"""What a camera's sensor and its file make of light: photon noise, white, eight bits."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from beam_warp.image.files import display_image, replacing, write_exr, write_png

FULL_WELL = 2500.0
READ_NOISE = 0.002
"""Electrons of a white pixel, whose photon noise is so 2 %, and read noise over white (5 electrons)."""

HALF = 2.0**-11
"""Coverage below which a straight colour means nothing: an 8-bit file holds none."""


def noisy(light: NDArray[np.float64], size: float, generator: np.random.Generator) -> NDArray[np.float64]:
    """Return what a sensor counts of light, over what it counts of white.

    The variance of a value v is (v / `FULL_WELL` + `READ_NOISE`^2) size^2, its mean v.

    Args:
        light: Light over white, not negative, of any shape.
        size: Standard deviation over that of the nominal sensor.
        generator: Draws the noise.
    """
    wells = FULL_WELL / size**2
    return generator.poisson(light * wells) / wells + generator.normal(0.0, READ_NOISE * size, light.shape)


def straight(layers: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return colour that is not multiplied by coverage, ``(H, W, 3)``; 0 where there is none."""
    alpha = layers[..., 3:]
    return np.where(alpha > HALF, layers[..., :3] / np.maximum(alpha, HALF), 0.0)


def write_linear(path: Path, layers: NDArray[np.float64]) -> None:
    """Write scene-linear half floats: ``(H, W, 4)`` premultiplied by coverage, or ``(H, W, 3)`` of a photograph."""
    write_exr(path, {name: layers[..., index] for index, name in enumerate("RGBA"[: layers.shape[-1]])}, half=True)


def write_eight_bits(path: Path, color: NDArray[np.float64], alpha: NDArray[np.float64] | None = None) -> None:
    """Write 8-bit sRGB, clipped at white: ``(H, W, 3)`` linear, not multiplied by ``alpha``, ``(H, W)``, if given."""
    pixels = display_image(color.astype(np.float32))
    write_png(path, pixels if alpha is None else np.dstack([pixels, eight_bits(alpha)]))


def write_jpeg(path: Path, color: NDArray[np.float64], quality: int) -> None:
    """Write a JPEG of ``(H, W, 3)`` linear colour, clipped at white, its chroma at half the resolution."""
    from PIL import Image as PillowImage

    with replacing(path) as temporary:
        PillowImage.fromarray(display_image(color.astype(np.float32))).save(
            temporary, format="JPEG", quality=quality, subsampling="4:2:0"
        )


def eight_bits(coverage: NDArray[np.float64]) -> NDArray[np.uint8]:
    """Return coverage in [0, 1] as bytes."""
    return np.rint(coverage * 255.0).astype(np.uint8)
