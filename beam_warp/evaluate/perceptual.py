"""Perceptual differences of images, by programs that may or may not be there: FLIP and LPIPS; nothing is downloaded."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

Measure = Callable[[NDArray[np.float32], NDArray[np.float32]], float]
"""A difference of two display-referred images ``(H, W, 3)`` in [0, 1]; 0 for equal ones."""

LPIPS_SIDE = 64
"""Shorter images are not compared by LPIPS: its network halves them five times."""


@dataclass(frozen=True)
class PerceptualMetrics:
    """The perceptual differences that can be measured here.

    Attributes:
        measures: By name, ``flip`` and ``lpips``: lower is better.
        absent: By name, why one cannot be measured, and what to do about it.
    """

    measures: Mapping[str, Measure] = field(default_factory=dict)
    absent: Mapping[str, str] = field(default_factory=dict)

    @classmethod
    def installed(cls) -> PerceptualMetrics:
        """Find out which ones are there.

        FLIP is LDR-FLIP at 67 pixels per degree, its default (Andersson et al. 2020), mean over the image. LPIPS is
        version 0.1 with AlexNet (Zhang et al. 2018); it is measured only where the network's weights lie in torch's
        folder of checkpoints already.
        """
        measures: dict[str, Measure] = {}
        absent: dict[str, str] = {}
        for name, find in (("flip", _find_flip), ("lpips", _find_lpips)):
            found = find()
            if isinstance(found, str):
                absent[name] = found
            else:
                measures[name] = found
        return cls(measures, absent)

    def differences(self, image: ArrayLike, truth: ArrayLike) -> dict[str, float]:
        """Measure two display-referred images, ``(H, W)`` or ``(H, W, 3)``; values are cut to [0, 1], grey is tripled.

        An image that is too small for a measure has none of it.
        """
        a, b = (_display(array) for array in (image, truth))
        found = {name: measure(a, b) for name, measure in self.measures.items()}
        return {name: value for name, value in found.items() if np.isfinite(value)}


def _display(image: ArrayLike) -> NDArray[np.float32]:
    array = np.clip(np.asarray(image, np.float32), 0.0, 1.0)
    return np.ascontiguousarray(np.repeat(array[..., None], 3, axis=-1) if array.ndim == 2 else array)


def _find_flip() -> Measure | str:
    try:
        evaluator = import_module("flip_evaluator")
    except ImportError:
        return "flip-evaluator is not installed: pip install 'beam-warp[evaluate]'"

    def flip(image: NDArray[np.float32], truth: NDArray[np.float32]) -> float:
        return float(evaluator.evaluate(truth, image, "LDR", applyMagma=False)[1])

    return flip


def _find_lpips() -> Measure | str:
    try:
        lpips = import_module("lpips")
        models = import_module("torchvision.models")
    except ImportError:
        return "lpips is not installed: pip install 'beam-warp[lpips]'"
    try:
        # What torchvision would download is what it looks for first.
        weights = checkpoint_folder() / str(models.AlexNet_Weights.IMAGENET1K_V1.url).rpartition("/")[2]
    except AttributeError:
        return "torchvision does not say which weights it takes: install torchvision 0.13 or newer"
    if not weights.is_file():
        return f"the weights of its network are not there, and nothing is downloaded: put them at {weights}"
    model = lpips.LPIPS(net="alex", verbose=False)

    def measure(image: NDArray[np.float32], truth: NDArray[np.float32]) -> float:
        if min(image.shape[:2]) < LPIPS_SIDE:
            return float("nan")
        a, b = (lpips.im2tensor(255.0 * array) for array in (image, truth))
        return float(model(a, b).item())

    return measure


def checkpoint_folder() -> Path:
    """Return where torch keeps checkpoints, by the rule of ``torch.hub.get_dir``."""
    cache = os.environ.get("XDG_CACHE_HOME") or "~/.cache"
    home = os.environ.get("TORCH_HOME") or f"{cache}/torch"
    return Path(home).expanduser() / "hub" / "checkpoints"
