"""Baking of images into Gaussians: the bounded values whose drawing comes nearest to given images, geometry held fixed.

A pixel's value is linear in the Gaussians' values x, W x with the blending weights W. So baking is the bounded linear
least-squares problem

    min over x in [low, high]  sum over pixels of m_p |(W x)_p - t_p|^2 + ridge |x - prior|^2
                               + temporal |x - previous|^2,

by column. Conjugate gradients on the free variables, with the rasteriser and its transpose as operator, take tens of
passes over the views; Adam, a random view a step, is the paper's way (BEAM §3.2) and kept to compare.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Literal

import numpy as np
import warp as wp
from numpy.typing import ArrayLike, NDArray

from beam_warp.checks import require_array, require_choice, require_count, require_finite, require_number
from beam_warp.device.array_checks import device_array
from beam_warp.device.arrays import upload
from beam_warp.errors import InvalidArrayError, InvalidOptionError
from beam_warp.kernels.common.row_sums import launch_add_rows
from beam_warp.kernels.materials.baking import launch_add_pull, launch_clamp_rows, launch_weigh_pixels
from beam_warp.kernels.raster.composite import CHANNEL_COUNTS
from beam_warp.materials.bounded_solve import solve_bounded
from beam_warp.raster.adam import Adam, Parameters
from beam_warp.raster.rasterizer import Rasterizer
from beam_warp.raster.records import GaussianArrays, RasterOptions
from beam_warp.world.camera import Camera

Solver = Literal["cg", "adam"]

SOLVERS = ("cg", "adam")

LEARNING_RATE = 0.05
"""Learning rate of ``"adam"`` at first; it falls to a hundredth exponentially."""

MOST_COLUMNS = CHANNEL_COUNTS[-1]
"""Most columns of one problem: those that the rasteriser composites in one pass."""

GROUP_SPLATS = 2**22
"""Most splats, Gaussians times views, drawn at a time unless one view has more."""

GROUP_PIXELS = 2**23
"""Most pixels drawn at a time unless one view has more."""


LEAST_EVIDENCE = 1e-6
"""Pixels below which the mean of the targets that a Gaussian is seen in is rounding error."""


@dataclass(frozen=True, eq=False)
class BakeTarget:
    """Values that one view should show, and their weights.

    Attributes:
        camera: The view.
        targets: Sums that its pixels should show, means times coverage, ``(H, W, K)`` float32; read where a weight is
            above 0. NumPy, or a warp array on the device.
        weights: m, at least 0: what each of them counts, ``(H, W, K)`` float32.
    """

    camera: Camera
    targets: Any
    weights: Any


@dataclass(frozen=True, kw_only=True)
class BakeOptions:
    """Options of baking.

    Attributes:
        solver: ``"cg"`` or ``"adam"``.
        passes: Most passes over all views of ``"cg"``, each a drawing and its transpose.
        tolerance: ``"cg"`` ends where the projected gradient of every column is below this part of what it is at 0.
        steps: Steps of ``"adam"``, a view each.
        ridge: Pull towards the prior, in pixels: that of a pixel which sees the Gaussian alone.
        temporal: Pull towards the previous frame, likewise.
        low: Least value.
        high: Largest value.
        seed: Of the order of the views.

    Raises:
        InvalidOptionError: An option is out of range.
    """

    solver: Solver = "cg"
    passes: int = 30
    tolerance: float = 1e-2
    steps: int = 5000
    ridge: float = 0.1
    temporal: float = 0.0
    low: float = 0.0
    high: float = 1.0
    seed: int = 0

    def __post_init__(self) -> None:
        """Check every option once."""
        require_choice("solver", self.solver, SOLVERS)
        require_count("passes", self.passes)
        require_number("tolerance", self.tolerance, 0.0, 1.0)
        require_count("steps", self.steps)
        require_number("ridge", self.ridge, 0.0)
        require_number("temporal", self.temporal, 0.0)
        require_number("high", self.high, require_number("low", self.low))
        require_count("seed", self.seed, 0, 2**32 - 1)


@dataclass(frozen=True, eq=False)
class BakedValues:
    """Result of baking.

    Attributes:
        values: ``(N, K)`` float32 in the bounds.
        evidence: How many pixels say something about each value, by their weights, ``(N, K)`` float32; 0 for what no
            view sees, which holds the prior.
        passes: Passes over the views: drawings and transposes of all of them, in pairs.
        residuals: Of ``"cg"``, by pass the length of the projected gradient over that at 0, ``(passes, K)``; what
            ``"adam"`` leaves out.
    """

    values: NDArray[np.float32]
    evidence: NDArray[np.float32]
    passes: float
    residuals: NDArray[np.float32]


def bake(
    gaussians: GaussianArrays,
    views: Sequence[BakeTarget],
    *,
    prior: ArrayLike | None = None,
    start: ArrayLike | None = None,
    previous: ArrayLike | None = None,
    options: BakeOptions | None = None,
    raster_options: RasterOptions | None = None,
    device: Any,
) -> BakedValues:
    """Find the values whose drawing comes nearest to the targets.

    Device memory, targets and weights included, is

        8 K P + (28 + 4 W) G + (88 + 4 W) S + 4 W H + 1.25 (24 + 4 W) Q + 12 T + 56 W N bytes

    for P pixels of all views, G of the largest group that is drawn at a time (at most `GROUP_PIXELS`, unless one view
    has more), S = V N splats, H those of the largest group, Q pairs of tile and splat, T tiles, and W >= K the number
    of columns that are drawn, 4, 8, 12 or 16; on the CPU 16 G more. For 140,000 Gaussians in 81 views of 3840 x 2160,
    cut to a figure of 155 million pixels in all, with 34 million pairs, and K = 4, that is 7.7 GiB, of which 4.6 are
    targets and weights: `beam_warp.materials.bake_resolution` takes off pixels that say nothing more.

    Args:
        gaussians: Geometry on the device; its values are not read.
        views: At least one, of any sizes, all with K columns, at most `MOST_COLUMNS`. Compact arrays on the device are
            read where they are.
        prior: What values are pulled to, ``(N, K)``; without, the mean of the targets that each Gaussian is seen in,
            weighted by how much it is seen there, and the middle of the bounds where it is not.
        start: Where solving begins, ``(N, K)``; the prior without.
        previous: Values of the frame before, ``(N, J)``, for ``temporal``: it pulls at the first J columns.
        options: See `BakeOptions`.
        raster_options: How splats are drawn: as they were fitted.
        device: Where the arrays are.

    Raises:
        InvalidArrayError: Arrays do not fit together.
        InvalidOptionError: There is no view, or an option is out of range.

    Source: BEAM §3.2 for the problem; Dostal and Schoeberl 2005 for the solver; the scaling by sums of rows makes its
    step safe without an estimate of the spectrum (Perron and Frobenius).
    """
    if not views:
        raise InvalidOptionError("views must hold at least one view, got none. Pass what the cameras saw.")
    chosen = options or BakeOptions()
    shape = np.shape(views[0].targets)
    count, columns = len(gaussians.positions), shape[2] if len(shape) == 3 else 0
    require_count("columns of targets", columns, 1, MOST_COLUMNS)
    given = {}
    for name, array, width in (("prior", prior, columns), ("start", start, columns), ("previous", previous, None)):
        if array is not None:
            given[name] = require_array(name, array, (count, width))
            require_finite(name, given[name])
    if chosen.temporal > 0.0 and previous is None:
        raise InvalidArrayError("previous must be given for a temporal term, got None. Pass the last frame's values.")
    if "previous" in given and given["previous"].shape[1] > columns:
        raise InvalidArrayError(
            f"previous must have at most the {columns} columns of the targets, got {given['previous'].shape[1]}. "
            "Drop the others."
        )
    with wp.ScopedDevice(device):
        problem = _BlendedImages(gaussians, views, columns, chosen, raster_options, device)
        evidence = problem.evidence.numpy()
        center = given.get("prior", problem.mean_targets(evidence))
        problem.anchor(center, given.get("previous"))
        values = problem.start(given.get("start", center))
        if chosen.solver == "cg":
            passes, residuals = _solve_by_gradients(problem, values)
        else:
            passes, residuals = _solve_by_adam(problem, values)
        return BakedValues(values.numpy()[:, :columns], evidence[:, :columns], passes, residuals[:, :columns])


@dataclass(eq=False)
class _Group:
    """Views that are drawn together; of each, what it should show and what that counts, ``(pixels of the view, K)``."""

    rasterizer: Rasterizer
    targets: list[wp.array]
    weights: list[wp.array]
    rows: wp.array  # (V * N, K), room for what each view says


class _BlendedImages:
    """The problem as an operator: drawing, its transpose, and what pulls at the values besides pixels."""

    def __init__(
        self,
        gaussians: GaussianArrays,
        views: Sequence[BakeTarget],
        columns: int,
        options: BakeOptions,
        raster_options: RasterOptions | None,
        device: Any,
    ) -> None:
        """Draw every view once, so that later passes wait for nothing."""
        self.options = options
        self.device = device
        self.count = len(gaussians.positions)
        self.columns = columns
        self.width = next(n for n in CHANNEL_COUNTS if n >= columns)
        self._drawn_values, self._summed = (wp.zeros((self.count, self.width), dtype=float) for _ in range(2))
        alone = options.solver == "adam"  # a step is a view
        parts = _groups([view.camera for view in views], self.count, alone)
        rows = wp.empty((max(len(part) for part in parts) * self.count, self.width), dtype=float)
        # All groups draw into the same images: what one drew is used up before the next one draws.
        first = max(parts, key=lambda part: sum(views[i].camera.width * views[i].camera.height for i in part))
        how: dict[str, Any] = {"value_count": self.width, "options": raster_options, "device": device}
        room = Rasterizer(self.count, [views[i].camera for i in first], **how)
        self.groups = []
        for part in parts:
            rasterizer = room
            if part is not first:
                rasterizer = Rasterizer(self.count, [views[i].camera for i in part], images_of=room, **how)
            rasterizer.draw(gaussians._replace(values=self._drawn_values, radiance=None))
            group = _Group(rasterizer, [], [], rows[: len(part) * self.count])
            for i in part:
                shape = (views[i].camera.height, views[i].camera.width, columns)
                for name, held in (("targets", group.targets), ("weights", group.weights)):
                    given = device_array(f"views[{i}].{name}", getattr(views[i], name), shape, device)
                    held.append(given.contiguous().reshape((-1, columns)))
            self.groups.append(group)
        self._nothing = wp.empty((0, 0), dtype=float)
        # W' M W 1: how many pixels each value is seen by
        self.evidence = wp.zeros((self.count, self.width), dtype=float)
        self.apply_pixels(wp.full((self.count, self.width), 1.0, dtype=float), self.evidence)
        self.strength = wp.zeros((self.count, self.width), dtype=float)
        self._anchors = wp.zeros((self.count, self.width), dtype=float)

    def mean_targets(self, evidence: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the mean of what each Gaussian is seen in, ``(N, K)``: W' M t / W' M W 1."""
        sums = wp.zeros((self.count, self.width), dtype=float)
        nothing = wp.zeros((self.count, self.width), dtype=float)
        for group in self.groups:
            self.add_pixels_said(group, nothing, sums)
        middle = np.full(evidence.shape, 0.5 * (self.options.low + self.options.high), np.float32)
        means = np.divide(-sums.numpy(), evidence, out=middle, where=evidence > LEAST_EVIDENCE)
        return np.clip(means[:, : self.columns], self.options.low, self.options.high)

    def anchor(self, prior: NDArray[np.float32], previous: NDArray[np.float32] | None) -> None:
        """Join both pulls, which are quadratic: one towards their weighted mean."""
        ridge, temporal = self.options.ridge, self.options.temporal
        strength = np.full((self.count, self.width), ridge)
        pull = ridge * self._padded(prior).astype(np.float64)
        if previous is not None:
            strength[:, : previous.shape[1]] += temporal
            pull[:, : previous.shape[1]] += temporal * previous.astype(np.float64)
        means = np.divide(pull, strength, out=np.zeros_like(pull), where=strength > 0.0)
        self._anchors.assign(means.astype(np.float32))
        self.strength.assign(strength.astype(np.float32))

    def start(self, values: NDArray[np.float32]) -> wp.array:
        """Return values on the device, within the bounds."""
        return upload(np.clip(self._padded(values), self.options.low, self.options.high), float, self.device)

    def _padded(self, values: NDArray[Any]) -> NDArray[np.float32]:
        """Return values with as many columns as are drawn."""
        result = np.zeros((self.count, self.width), np.float32)
        result[:, : self.columns] = values
        return result

    def apply_pixels(self, values: wp.array, out: wp.array) -> None:
        """Add W' M W values to ``out``."""
        for group in self.groups:
            self._add_pixels(group, values, [self._nothing] * len(group.weights), out)

    def _add_pixels(self, group: _Group, values: wp.array, targets: list[wp.array], out: wp.array) -> None:
        """Add W' M (W values - targets) of a group to ``out``; empty targets are targets of 0."""
        wp.copy(self._drawn_values, values)
        pixels = group.rasterizer.redraw_values().channels[0]
        ends = pairwise(group.rasterizer.first_pixels)
        for (start, end), target, weights in zip(ends, targets, group.weights, strict=True):
            part = pixels[start:end]
            launch_weigh_pixels(part.size, part, target, weights, part, self.device)
        group.rasterizer.back_project(pixels, group.rows)
        group.rasterizer.sum_views(group.rows, self._summed)
        launch_add_rows(out.size, self._summed, out, self.device)

    def apply(self, values: wp.array, out: wp.array) -> None:
        """Write A values to ``out``, A = W' M W + ridge + temporal."""
        out.zero_()
        self.apply_pixels(values, out)
        launch_add_pull(values.size, values, self._nothing, self.strength, 1.0, out, self.device)

    def scaling(self) -> wp.array:
        """Return the sums of the rows of A: no eigenvalue is larger, as no entry is negative."""
        sums = wp.clone(self.evidence)
        launch_add_rows(self.strength.size, self.strength, sums, self.device)
        return sums

    def add_gradient(self, values: wp.array, out: wp.array) -> None:
        """Add half of the objective's gradient."""
        for group in self.groups:
            self.add_pixels_said(group, values, out)
        self.add_pulls(values, 1.0, out)

    def add_pixels_said(self, group: _Group, values: wp.array, out: wp.array) -> None:
        """Add what the pixels of a group say to half of the objective's gradient."""
        self._add_pixels(group, values, group.targets, out)

    def add_pulls(self, values: wp.array, scale: float, out: wp.array) -> None:
        """Add ``scale`` times what the pulls are to half of the objective's gradient."""
        launch_add_pull(values.size, values, self._anchors, self.strength, scale, out, self.device)


def _groups(cameras: Sequence[Camera], gaussian_count: int, alone: bool) -> list[range]:
    """Cut views into runs that are drawn together."""
    groups = []
    first = 0
    while first < len(cameras):
        end = first + 1
        pixels = cameras[first].width * cameras[first].height
        while end < len(cameras) and not alone:
            pixels += cameras[end].width * cameras[end].height
            if pixels > GROUP_PIXELS or (end + 1 - first) * gaussian_count > GROUP_SPLATS:
                break
            end += 1
        groups.append(range(first, end))
        first = end
    return groups


def _solve_by_gradients(images: _BlendedImages, values: wp.array) -> tuple[float, NDArray[np.float32]]:
    """Move values to the minimum, in place."""
    options = images.options
    bounds = options.low, options.high
    found = solve_bounded(images, values, bounds=bounds, passes=options.passes, tolerance=options.tolerance)
    relative = np.divide(found, found[0], out=np.zeros_like(found), where=found[0] > 0.0)
    return len(found) + 1.0, relative


def _solve_by_adam(images: _BlendedImages, values: wp.array) -> tuple[float, NDArray[np.float32]]:
    """Move values by the gradients of one random view a step, in place."""
    options, device = images.options, images.device
    gradients = wp.zeros((images.count, images.width), dtype=float)
    adam = Adam({"values": Parameters(values, gradients, LEARNING_RATE)})
    order = np.random.default_rng(options.seed).integers(0, len(images.groups), options.steps)
    share = 1.0 / len(images.groups)
    for step, place in enumerate(order):
        adam.set_learning_rate("values", LEARNING_RATE * 0.01 ** (step / options.steps))
        gradients.zero_()
        images.add_pixels_said(images.groups[place], values, gradients)
        images.add_pulls(values, share, gradients)
        adam.step()
        launch_clamp_rows(values.size, options.low, options.high, values, device)
    return options.steps * share, np.zeros((0, images.width), np.float32)
