"""Coarse motion: joints are moved until the Gaussians that they carry look like the next photographs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from beam_warp.capture.views import CapturedView
from beam_warp.checks import require_choice, require_count, require_number
from beam_warp.device.arrays import upload
from beam_warp.device.graphs import StepGraphs
from beam_warp.device.morton import morton_order
from beam_warp.errors import InvalidOptionError
from beam_warp.raster.adam import Adam, Parameters
from beam_warp.raster.records import GaussianArrays, RasterOptions
from beam_warp.reconstruction.fit import mean_psnr
from beam_warp.reconstruction.joints.graph import JointGraph, stable_order
from beam_warp.reconstruction.joints.rigidity import RigidityLoss
from beam_warp.reconstruction.joints.skinning import BLENDS, Anchors, Skin
from beam_warp.reconstruction.targets import LossWeights, TargetSet, ViewTargets, shuffled_views
from beam_warp.world.clusters import Clusters
from beam_warp.world.gaussians import GaussianCloud

GAUSSIANS_PER_PIXEL = 4
"""Gaussians for a pixel that the subject covers in a reduced image, on each of its two sides: what is finer tells
nothing there, and costs as much as at full resolution."""

RATES_EVERY = 10
"""Steps between two changes of the learning rates: a change is a launch of its own."""


@dataclass(frozen=True)
class JointPose:
    """Poses of all joints.

    Attributes:
        rotations: Rotations against the frame before, quaternions xyzw, ``(M, 4)`` float32.
        positions: Positions, ``(M, 3)`` float32 [m].
    """

    rotations: NDArray[np.float32]
    positions: NDArray[np.float32]


@dataclass(frozen=True, kw_only=True)
class JointOptions:
    """Options of moving joints.

    Attributes:
        levels: Reductions of the images, coarse to fine: the coarser, the further a motion is found.
        iterations: Steps at each of them.
        weights: Weights of the images' terms.
        rigidity: Weight of motion that is not rigid around each joint (E_smooth) at full resolution; on reduced images
            divided by the square of the reduction, because stiff joints turn too slowly where motion is large.
        rotation_rate: Size of steps of quaternions at full resolution; on reduced images times the reduction.
        position_rate: Size of steps of positions, likewise, in distances between joints.
        final_rate: Part of both that is left at the end of each level.
        blend: How several joints move a Gaussian: ``"linear"`` or ``"dual"``.

    Raises:
        InvalidOptionError: An option is out of range, or levels and iterations are not as many.
    """

    levels: tuple[int, ...] = (8, 4, 2, 1)
    iterations: tuple[int, ...] = (200, 200, 150, 200)
    weights: LossWeights = field(default_factory=lambda: LossWeights(estimated=1.0))
    rigidity: float = 1.0
    rotation_rate: float = 5e-3
    position_rate: float = 3e-2
    final_rate: float = 0.1
    blend: str = "linear"

    def __post_init__(self) -> None:
        """Check every option once."""
        if not len(self.levels) or len(self.levels) != len(self.iterations):
            raise InvalidOptionError(
                f"levels and iterations must be as many, at least one, got {len(self.levels)} and "
                f"{len(self.iterations)}. Give each level its steps."
            )
        for level, iterations in zip(self.levels, self.iterations, strict=True):
            require_count("levels", level)
            require_count("iterations", iterations, 0)
        for name in ("rigidity", "rotation_rate", "position_rate"):
            require_number(name, getattr(self, name), 0.0)
        require_number("final_rate", self.final_rate, 0.0, 1.0)
        require_choice("blend", self.blend, BLENDS)


class JointTracker:
    """Joints, the Gaussians that they carry from the frame before, and the photographs of this one."""

    def __init__(
        self,
        cloud: GaussianCloud,
        anchors: Anchors,
        graph: JointGraph,
        joints: NDArray[np.float32],
        options: JointOptions,
        raster: RasterOptions,
        device: Any,
    ) -> None:
        """Bring the frame before to a device.

        Args:
            cloud: Gaussians of the frame before.
            anchors: Anchors of the Gaussians to the joints.
            graph: Graph of the joints.
            joints: Positions of the joints in the frame before, ``(M, 3)``.
            options: See `JointOptions`.
            raster: How splats are drawn.
            device: Warp device.
        """
        self.device = device
        self._options = options
        self._raster = raster
        count = len(joints)
        self._cloud, self._anchors, self._joints = cloud, anchors, joints
        self._spacing = graph.spacing
        self._all = self._on_joints(cloud, anchors)
        self._rigidity = RigidityLoss(graph, device=device)
        at_rest = np.tile(np.array([0.0, 0.0, 0.0, 1.0], np.float32), (count, 1))
        self._rest_rotations = upload(at_rest, wp.quat, device)
        self._rotations = wp.clone(self._rest_rotations)
        self._positions = wp.clone(self._all.skin.joint_rest_positions)
        self._rotation_gradients = wp.zeros(count, dtype=wp.quat, device=device)
        self._position_gradients = wp.zeros(count, dtype=wp.vec3, device=device)

    def find(
        self,
        views: Sequence[CapturedView],
        starts: Mapping[str, JointPose],
        samples: int,
        seed: int,
        whole: TargetSet | None = None,
    ) -> tuple[JointPose, str]:
        """Move the joints until what they carry looks like the views.

        Args:
            views: The photographs.
            starts: Poses to choose from, by name, at least one: the first that looks most like the views, reduced as
                far as any, is begun with.
            samples: Side of the square of samples of a pixel at full resolution.
            seed: Seed of the order of views.
            whole: The views at full resolution, for all Gaussians, where they are on the device already.

        Returns:
            The poses, and the name of those that they began with.
        """
        chosen, begun = self._options, next(iter(starts))
        self._pose(starts[begun])
        rng = np.random.default_rng(seed)
        factors = [[min(level, view.camera.width, view.camera.height) for view in views] for level in chosen.levels]
        with ThreadPoolExecutor(1) as ahead:  # while joints are moved at one level, what the next one draws is merged
            labels = [self._labels(views, reductions) for reductions in factors]
            merged = [None if label is None else ahead.submit(self._merged, label) for label in labels]
            for index, (level, iterations) in enumerate(zip(chosen.levels, chosen.iterations, strict=True)):
                clusters = merged[index]
                carried = self._all if clusters is None else self._on_joints(*clusters.result())
                targets = whole if level == 1 else None
                if targets is None:
                    side = samples if level == 1 else 1
                    targets = TargetSet(views, carried.count, self._raster, side, self.device, factors[index])
                if index == 0 and len(starts) > 1:
                    likeness = {name: self._likeness(carried, targets, start) for name, start in starts.items()}
                    begun = max(likeness, key=likeness.__getitem__)
                    self._pose(starts[begun])
                order = shuffled_views(rng, len(targets), iterations)[:iterations]
                self._move(carried, targets, order, level)
        rotations = self._rotations.numpy().astype(np.float64)
        rotations /= np.linalg.norm(rotations, axis=1, keepdims=True)
        positions = self._positions.numpy().copy()  # on the CPU it is the array
        return JointPose(rotations.astype(np.float32), positions), begun

    def _move(self, carried: _Carried, targets: TargetSet, order: NDArray[np.int64], level: int) -> None:
        """Move the joints at one level, by a step for each number of a view in ``order``."""
        chosen = self._options
        rates = {"rotations": level * chosen.rotation_rate, "positions": level * (chosen.position_rate * self._spacing)}
        adam = Adam(
            {
                "rotations": Parameters(self._rotations, self._rotation_gradients, rates["rotations"]),
                "positions": Parameters(self._positions, self._position_gradients, rates["positions"]),
            }
        )
        graphs = StepGraphs(self.device)
        carried.carry(self._rotations, self._positions)
        targets.make_room(carried.drawn)
        for iteration, view in enumerate(order):
            if iteration % RATES_EVERY == 0:
                for name, rate in rates.items():
                    adam.set_learning_rate(name, rate * chosen.final_rate ** (iteration / len(order)))
            group, place = targets[int(view)]
            group.select(place)
            step = partial(self._step, carried, group, place, adam, chosen.rigidity / level**2)
            graphs.run(group.kind(place), step)

    def _pose(self, pose: JointPose) -> None:
        """Put the joints somewhere."""
        wp.copy(self._rotations, upload(pose.rotations, wp.quat, self.device))
        wp.copy(self._positions, upload(pose.positions, wp.vec3, self.device))

    def _likeness(self, carried: _Carried, targets: TargetSet, pose: JointPose) -> float:
        """Return the PSNR of a pose [dB]."""
        self._pose(pose)
        carried.carry(self._rotations, self._positions)
        return mean_psnr(targets.make_room(carried.drawn)[0])

    def carried(self, cloud: GaussianCloud) -> GaussianCloud:
        """Return a cloud where the joints carry it now."""
        self._all.carry(self._rotations, self._positions)
        orientations = self._all.drawn.orientations.numpy().astype(np.float64)
        orientations /= np.linalg.norm(orientations, axis=1, keepdims=True)
        positions = self._all.drawn.positions.numpy().copy()  # on the CPU it is the array
        return cloud.with_arrays(positions=positions, orientations=orientations.astype(np.float32))

    def _labels(self, views: Sequence[CapturedView], reductions: Sequence[int]) -> NDArray[np.int64] | None:
        """Return what merges for reduced views, so that no more than `GAUSSIANS_PER_PIXEL` are drawn; None for nothing.

        Nothing merges at full resolution, and where coverage is not known.
        """
        if max(reductions) == 1 or any(view.alpha is None for view in views):
            return None
        pixels = float(np.mean([view.covered / factor**2 for view, factor in zip(views, reductions, strict=True)]))
        size = int(len(self._cloud) / max(2 * GAUSSIANS_PER_PIXEL * pixels, 1.0))
        return None if size < 2 else hanging_together(self._cloud, self._anchors, size, self.device)

    def _merged(self, labels: NDArray[np.int64]) -> tuple[GaussianCloud, Anchors]:
        """Return the Gaussians that clusters are, and what carries each."""
        merged = Clusters(self._cloud, labels, np.ones(len(self._cloud)))
        anchors = Anchors(self._anchors.joints[merged.heaviest], self._anchors.weights[merged.heaviest])
        return merged.cloud(self._cloud), anchors

    def _on_joints(self, cloud: GaussianCloud, anchors: Anchors) -> _Carried:
        return _Carried(cloud, anchors, self._joints, self._options.blend, self.device)

    def _step(self, carried: _Carried, group: ViewTargets, index: int, adam: Adam, rigidity: float) -> None:
        """Draw the view that was selected, compare, and move the joints."""
        carried.carry(self._rotations, self._positions)
        group.rasterizer.redraw()
        group.add_losses(index, self._options.weights, values=False)
        drawn = group.rasterizer.backward()
        self._rotation_gradients.zero_()
        self._position_gradients.zero_()
        carried.skin.add_gradients(
            self._rotations,
            self._positions,
            drawn.positions,
            drawn.orientations,
            self._rotation_gradients,
            self._position_gradients,
        )
        self._rigidity(
            self._rotations,
            self._positions,
            self._rest_rotations,
            self._all.skin.joint_rest_positions,
            weight=rigidity,
            rotation_gradients=self._rotation_gradients,
            position_gradients=self._position_gradients,
            value=False,
        )
        adam.step()


class _Carried:
    """Gaussians at rest, and where joints carry them."""

    def __init__(
        self, cloud: GaussianCloud, anchors: Anchors, joints: NDArray[np.float32], blend: str, device: Any
    ) -> None:
        self.count = len(cloud)
        self.skin = Skin(cloud.positions, cloud.orientations, anchors, joints, blend=blend, device=device)
        self.drawn = GaussianArrays(
            wp.clone(self.skin.rest_positions),
            wp.clone(self.skin.rest_orientations),
            upload(cloud.scales, wp.vec3, device),
            upload(cloud.opacities, float, device),
            None,
            upload(cloud.radiance, wp.vec3, device),  # type: ignore[arg-type]
        )

    def carry(self, rotations: wp.array, positions: wp.array) -> None:
        """Move the Gaussians to where the joints are."""
        self.skin.warp(rotations, positions, self.drawn.positions, self.drawn.orientations)


def hanging_together(cloud: GaussianCloud, anchors: Anchors, size: int, device: Any) -> NDArray[np.int64]:
    """Return clusters of Gaussians that are near each other and hang on the same joint, ``(N,)``.

    Args:
        cloud: Gaussians.
        anchors: Their anchors; the first of each counts.
        size: Most members of a cluster. The last one of a joint has fewer.
        device: Warp device.
    """
    count, joint = len(cloud), anchors.joints[:, 0]
    places = upload(cloud.positions, wp.vec3, device)
    order = morton_order(places, places, wp.ones(count, dtype=int, device=device))[0].numpy()[:count]
    order = order[stable_order(joint[order], int(joint.max(initial=0)) + 1)]
    within = np.arange(count) - np.searchsorted(joint[order], joint[order])
    labels = np.empty(count, np.int64)
    labels[order] = np.cumsum(within % size == 0) - 1
    return labels
