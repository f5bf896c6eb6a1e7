"""What a file shows of a rendered image: layers of light in an EXR, a view of it in a PNG."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from beam_warp.checks import require_array, require_choice, require_number, require_range
from beam_warp.image.color import srgb_to_linear
from beam_warp.image.files import write_exr, write_png
from beam_warp.image.tone import EXPOSURE_RANGE, TRANSFORMS, ViewTransform, display_over
from beam_warp.raster.channels import channel_layers
from beam_warp.render.backdrops import Backdrop
from beam_warp.world.environment import EnvironmentMap
from beam_warp.world.shot import RenderedImage, Shot

Background: TypeAlias = tuple[float, float, float] | Literal["transparent", "environment"]
"""A display colour in [0, 1], nothing, or the environment as the camera sees it."""

BLACK = (0.0, 0.0, 0.0)


@dataclass(frozen=True, kw_only=True)
class PictureOptions:
    """How rendered images become files.

    Attributes:
        view: View transform of PNGs and films; an EXR holds scene-linear light.
        exposure: Gain of the light [stops], in every kind of file.
        background: Colour or light behind. A PNG shows a colour whatever exposure and view; an EXR holds it decoded.
        layers: Whether an EXR also holds the renderer's layers.

    Raises:
        InvalidArrayError: The colour is out of range.
        InvalidOptionError: The view or the background is no such word, or the exposure is out of range.
    """

    view: ViewTransform = "standard"
    exposure: float = 0.0
    background: Background = "transparent"
    layers: bool = False

    def __post_init__(self) -> None:
        """Check every option once."""
        require_choice("view", self.view, TRANSFORMS)
        require_number("exposure", self.exposure, *EXPOSURE_RANGE)
        if isinstance(self.background, str):
            require_choice("background", self.background, ("transparent", "environment"))
        else:
            color = require_array("background", self.background, (3,), np.float64)
            require_range("background", color, 0.0, 1.0, "Use display values from 0 to 1.")


class PictureWriter:
    """Writes one rendered image after the other in one way."""

    def __init__(self, options: PictureOptions) -> None:
        """Take the options."""
        self.options = options
        self._backdrop: tuple[EnvironmentMap, Backdrop] | None = None

    def write(self, path: Path, shot: Shot, image: RenderedImage) -> None:
        """Write a .png or an .exr, in one step.

        Raises:
            InvalidArrayError: The image holds NaN or infinity.
            OutputError: The file cannot be written.
        """
        if path.suffix.lower() == ".exr":
            write_exr(path, self.exr_layers(shot, image))
        else:
            write_png(path, self.pixels(shot, image))

    def pixels(self, shot: Shot, image: RenderedImage) -> NDArray[np.uint8]:
        """Return what a display shows, ``(H, W, 3)``, or ``(H, W, 4)`` where something is transparent."""
        options = self.options
        color = None if isinstance(options.background, str) else options.background
        rgb, alpha = self._composed(shot, image)
        return display_over(rgb, alpha, options.view, options.exposure, color)

    def exr_layers(self, shot: Shot, image: RenderedImage) -> dict[str, NDArray[np.float32]]:
        """Return the channels of an EXR: R, G, B, A, and those of the layers if they are asked for."""
        rgb, alpha = self._composed(shot, image)
        rgb = rgb * np.float32(2.0**self.options.exposure)
        if not isinstance(self.options.background, str):
            behind = srgb_to_linear(np.asarray(self.options.background, np.float32))
            rgb, alpha = (rgb + (1.0 - alpha[..., None]) * behind).astype(np.float32), np.ones_like(alpha)
        channels: dict[str, Any] = {}
        if self.options.layers:
            for name, layer in image.layers.items():
                channels |= channel_layers(name, layer)
        return channels | {"R": rgb[..., 0], "G": rgb[..., 1], "B": rgb[..., 2], "A": alpha}

    def _composed(self, shot: Shot, image: RenderedImage) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Return light and coverage, with the light of the environment behind if that is asked for."""
        if self.options.background != "environment" or shot.environment is None:
            return image.rgb, image.alpha
        if self._backdrop is None or self._backdrop[0] is not shot.environment:
            self._backdrop = (shot.environment, Backdrop(shot.environment))
        behind = self._backdrop[1].seen(shot.camera, shot.environment_rotation)
        rgb = image.rgb + (1.0 - image.alpha[..., None]) * behind
        return rgb.astype(np.float32), np.ones_like(image.alpha)
