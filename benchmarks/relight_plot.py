"""The relighting benchmark as a picture: deferred beside path traced beside the truth."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from beam_warp.image.color import linear_to_srgb

Row = Mapping[str, Any]

SHOWN_LIGHT = "sunrise"
"""Light of the compared pictures, if it is there; else the last light is shown."""

GAIN = 4.0
"""Factor by which differences are brightened."""


def draw_comparison(subjects: Mapping[str, Row], pictures: Path, path: Path) -> None:
    """Draw deferred, path traced, truth and what the first two differ by, a row a subject."""
    from matplotlib import pyplot as plt

    loaded = []
    for name, subject in subjects.items():
        light = SHOWN_LIGHT if SHOWN_LIGHT in subject["lights"] else list(subject["lights"])[-1]
        with np.load(pictures) as kept:
            images = [shown_color(kept[f"{name} {light} {kind}"]) for kind in ("deferred", "path", "truth")]
        loaded.append((name, light, subject["lights"][light], images))
    heights = [2.2 * images[0].shape[0] / images[0].shape[1] + 0.45 for *_, images in loaded]
    figure, axes = plt.subplots(
        len(loaded), 4, figsize=(8.8, sum(heights)), height_ratios=heights, layout="constrained", squeeze=False
    )
    for line, (name, light, found, images) in zip(axes, loaded, strict=True):
        rows = {(row["method"], row["setting"]): row for row in found["rows"]}
        deferred = rows["deferred", found["shown"]["deferred"]]
        path_row = rows["path traced", found["shown"]["path"]]
        difference = np.clip(0.5 + 0.5 * GAIN * (images[0] - images[1]), 0.0, 1.0)
        captions = (
            f"deferred, {deferred['setting']}\n{deferred['view_psnr'][0]:.1f} dB",
            f"path traced, {path_row['setting']}\n{path_row['view_psnr'][0]:.1f} dB",
            f"truth: {name}, {light}",
            f"deferred - path traced, x {GAIN:g}\n{deferred['against_path']['view_psnr'][0]:.1f} dB",
        )
        for axis, image, caption in zip(line, [*images, difference], captions, strict=True):
            axis.set_axis_off()
            axis.imshow(image, interpolation="none")
            axis.set_title(caption, fontsize=7)
    figure.savefig(path, dpi=70)
    plt.close(figure)


def shown_color(image: NDArray[np.floating[Any]]) -> NDArray[np.float64]:
    """Return scene-linear radiance, multiplied by alpha, on black as it is compared: sRGB in [0, 1]."""
    return linear_to_srgb(np.clip(image.astype(np.float64), 0.0, 1.0))
