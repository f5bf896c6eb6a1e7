"""Gradients of the float64 rasteriser with every decision frozen, by complex steps: no step size, no cancellation.

For f analytic, Im f(x + i h) / h is f'(x) up to h^2, and nothing is subtracted. A parameter of one splat changes its
own alpha, depth and features only, and what lies behind it by a common factor; so the same parameter of all splats is
moved at once, and each splat's pixels are composited again with every other splat where it was.
"""

from dataclasses import replace

import numpy as np
from reference.raster_splats import dot, see
from reference.rasterizing import RasterImage, decide, pair_terms, replay

STEP = 1e-20


def gradients(scene, upstream, decisions=None):
    """Return dL/d(array) for every array of a scene, L = sum of upstream times image; names as `RasterScene.arrays`.

    Args:
        scene: Where.
        upstream: A `RasterImage` of dL/d(output).
        decisions: What is held still; `decide` of the scene without.
    """
    frozen = FrozenPairs(scene, upstream, decisions or decide(scene))
    result = {}
    for name, array in scene.arrays().items():
        gradient = np.zeros(array.shape)
        for k in np.ndindex(array.shape[1:]):
            moved = array.astype(complex)
            moved[:, *k] += 1j * STEP
            gradient[:, *k] = frozen.derivatives(**{name: moved})
        result[name] = gradient
    return result


def camera_gradients(scene, upstream, decisions=None):
    """Return dL/d(move) of a scene's camera, (N, 12): a row for what it does to each splat; they add up."""
    frozen = FrozenPairs(scene, upstream, decisions or decide(scene))
    steps = 1j * STEP * np.eye(12)
    return np.stack([frozen.derivatives(move=scene.move + step) for step in steps], axis=-1)


def random_upstream(rng, scene, decisions):
    """Normal numbers that single precision holds, and 0 on pixels where it may decide otherwise.

    That of the mean depth is weighted by alpha, as a loss would: else a pixel of alpha 1/255 asks, 255 times as loudly
    as others, for the difference of a splat's depth and the mean, which is all rounding where there is one splat.
    """
    unclear = decisions.near_jump | decisions.near_bend
    image = replay(scene, decisions)
    arrays = {}
    for name in ("alpha", "depth", "median_depth", "channels", "normals"):
        array = rng.normal(size=getattr(image, name).shape)
        if name == "depth":
            array *= image.alpha
        array[unclear] = 0.0
        arrays[name] = array.astype(np.float32).astype(np.float64)
    return RasterImage(**arrays)


class FrozenPairs:
    """A scene, taken apart into pairs of a splat and a pixel."""

    def __init__(self, scene, upstream, decisions):
        self.scene, self.decisions = scene, decisions
        size, at = scene.camera.height * scene.camera.width, decisions.pixel
        self.to_alpha, self.to_depth, to_median = (
            np.asarray(array, np.float64).reshape(size)[at]
            for array in (upstream.alpha, upstream.depth, upstream.median_depth)
        )
        self.to_channels = np.asarray(upstream.channels, np.float64).reshape(size, -1)[at]
        self.to_normals = np.asarray(upstream.normals, np.float64).reshape(size, 3)[at]
        self.to_median = np.where(decisions.median[at] == np.arange(len(at)), to_median, 0.0)
        splats = see(scene, decisions.splats)
        self.terms = pair_terms(scene, splats, decisions)
        alpha, depth = self.terms
        self.transmittance = self._before(alpha)
        terms = np.stack([np.ones(len(at)), depth, self._linear(splats)])
        parts = self.transmittance * alpha * terms
        totals = np.stack([np.bincount(at, part, size) for part in parts])
        front = self._front(parts)
        self.front, self.behind = front, (totals[:, at] - front - parts) / (1.0 - alpha)

    def derivatives(self, **changed):
        """dL of each splat per STEP, were its parameters alone changed as in the complex arrays, (N,)."""
        scene = replace(self.scene, **changed)
        splats = see(scene, self.decisions.splats)
        unmoved = set(changed) <= {"values", "radiance"}
        alpha, depth = self.terms if unmoved else pair_terms(scene, splats, self.decisions)
        own = self.transmittance * alpha * np.stack([np.ones(len(depth)), depth, self._linear(splats)])
        total, depth_sum, linear = self.front + own + self.behind * (1.0 - alpha)
        loss = linear + self.to_depth * depth_sum / total + self.to_median * depth
        return np.bincount(self.decisions.splat, loss.imag / STEP, len(scene.positions))

    def _linear(self, splats):
        """What one unit of weight of each pair adds to L through the outputs that are plain sums."""
        i = self.decisions.splat
        return self.to_alpha + dot(self.to_channels, splats.channels[i]) + dot(self.to_normals, splats.normal[i])

    def _before(self, alpha):
        """Transmittance before each pair."""
        return np.exp(self._front(np.log1p(-alpha)[None])[0])

    def _front(self, parts):
        """Sums over the pairs of the same pixel in front of each pair, row by row."""
        by_pixel = np.argsort(self.decisions.pixel, kind="stable")
        pixel = self.decisions.pixel[by_pixel]
        ordered = parts[:, by_pixel]
        running = np.cumsum(ordered, axis=1) - ordered
        first = np.searchsorted(pixel, pixel)
        result = np.zeros_like(parts)
        result[:, by_pixel] = running - running[:, first]
        return result
