"""What views say of the roughness of Gaussians: how badly each of some candidates explains their colours.

The residues of every view are known for any roughness (`beam_warp.kernels.materials.roughness_profile`), and what views
show beyond them must be diffuse, of one base colour. What such profiles are worth, and which roughness follows, is
another question: `beam_warp.materials.roughness`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from beam_warp.device.arrays import upload
from beam_warp.errors import InvalidArrayError
from beam_warp.jobs.listeners import CountProgress
from beam_warp.kernels.materials.roughness_profile import (
    PARTS,
    ProfileFit,
    launch_lobe_shares,
    launch_profile,
    launch_reflections,
)
from beam_warp.light.prepared import PreparedEnvironment
from beam_warp.materials.evidence import ViewEvidence
from beam_warp.materials.light_rays import MaterialOptions, light_batches, lit_points, mean_radiance, reflected_light
from beam_warp.materials.normals import SurfacePoints
from beam_warp.trace.scene import Scene
from beam_warp.world.gaussians import GaussianCloud

CANDIDATES = (0.1, 0.15, 0.2, 0.25, 0.3, 0.36, 0.42, 0.5, 0.6, 0.7, 0.85, 1.0)
"""Perceptual roughness that is tried: a lobe's peak goes with its inverse fourth power, so smooth ones lie closer."""

REFLECTIONS_AT_ONCE = 1 << 22
"""Reflections that are held at once, of points times views times candidates: 64 MB."""


@dataclass(frozen=True, eq=False)
class RoughnessProfile:
    """Misfit of candidates to the views of Gaussians; profiles of several frames of the same Gaussians add up.

    Attributes:
        misfit: For all views, the even and the odd ones, and each of `CANDIDATES`: the sum over views of
            w log(1 + e^2 / s^2) at the base colour in [0, 1] that suits those views best, ``(3, N, 12)``. e is the
            residual, s 0.06 of what a white surface would show with nothing in the way.
        views: Sum of w over all views: how many that see a whole pixel from the front, ``(N,)``; 0 where there is none.
        frames: Number of frames.
        scatter: Sum over frames of the squared angle by which normals scatter where a Gaussian is seen, times its
            ``views``, ``(N,)`` [rad^2].
    """

    misfit: NDArray[np.floating[Any]]
    views: NDArray[np.floating[Any]]
    frames: int = 1
    scatter: NDArray[np.floating[Any]] | float = 0.0

    def __post_init__(self) -> None:
        """Check shapes once."""
        expected = (int(PARTS), len(self.views), len(CANDIDATES))
        if self.misfit.shape != expected:
            raise InvalidArrayError(
                f"misfit must have shape {expected}, got {self.misfit.shape}. Take it from measure_roughness_profile."
            )

    def __add__(self, other: RoughnessProfile) -> RoughnessProfile:
        """Join evidence on the same Gaussians, in float64."""
        if len(self.views) != len(other.views):
            raise InvalidArrayError(
                f"profiles must be of the same Gaussians, got {len(self.views)} and {len(other.views)}. "
                "Add up the frames of one segment."
            )
        return RoughnessProfile(
            np.add(self.misfit, other.misfit, dtype=np.float64),
            np.add(self.views, other.views, dtype=np.float64),
            self.frames + other.frames,
            np.add(self.scatter, other.scatter, dtype=np.float64),
        )

    @classmethod
    def of_nothing(cls, count: int) -> RoughnessProfile:
        """Return the profile of Gaussians of which no frame was asked."""
        return cls(np.zeros((int(PARTS), count, len(CANDIDATES)), np.float32), np.zeros(count, np.float32), frames=0)

    def of(self, rows: NDArray[np.integer[Any]]) -> RoughnessProfile:
        """Return the profile of some of the Gaussians."""
        scatter = np.broadcast_to(self.scatter, len(self.views))
        return RoughnessProfile(self.misfit[:, rows], self.views[rows], self.frames, scatter[rows])


def measure_roughness_profile(
    cloud: GaussianCloud,
    scene: Scene,
    points: SurfacePoints,
    light: PreparedEnvironment,
    views: ViewEvidence | None,
    *,
    options: MaterialOptions,
    frame: int = 0,
    rows: NDArray[np.integer[Any]] | None = None,
    progress: CountProgress | None = None,
) -> RoughnessProfile:
    """Trace the light of one frame and try every candidate on what its views show.

    Args:
        cloud: Gaussians with captured radiance, axes "rfu".
        scene: The same Gaussians, uploaded.
        points: Where their light is gathered.
        light: The light of the capture, prepared on the scene's device.
        views: What views with images show; None takes the captured radiance around each normal.
        options: Rays, offset, bounce, seed; as for `beam_warp.materials.direct.measure_materials`.
        frame: Number of the frame, for the rays' random streams.
        rows: Gaussians to measure; all of them if None.
        progress: Called now and then with (Gaussians done, Gaussians in all).

    Raises:
        InvalidArrayError: The cloud has no captured radiance.
    """
    device = scene.device
    chosen = np.arange(len(cloud)) if rows is None else np.asarray(rows)
    count = len(chosen)
    points = points.on_faces()
    told = np.flatnonzero(points.seen[chosen])
    shown = chosen[told]
    # Any roughness will do here: the candidates take its place.
    measured = lit_points(cloud, points, np.ones(len(cloud), np.float32), light, shown, views)
    candidates = upload(np.array(CANDIDATES, np.float32), float, device)
    fit = ProfileFit()
    fit.misfit = wp.zeros((int(PARTS), len(shown), len(CANDIDATES)), dtype=float, device=device)
    fit.views = wp.zeros(len(shown), dtype=float, device=device)

    def report(done: int, total: int) -> None:
        if progress is not None:
            progress(count - (total - done), count)

    normals, observed, reflected = measured.surface.normals, measured.views, reflected_light(light)
    bounced = mean_radiance(cloud, views) if options.bounce else None
    view_count = observed.colors.shape[0]
    at_once = min(max(REFLECTIONS_AT_ONCE // (view_count * len(CANDIDATES)), 1), len(shown))
    reflections = wp.empty((at_once, view_count, len(CANDIDATES)), dtype=wp.vec4, device=device)
    for batch, rays in light_batches(scene, points, light, measured, options, bounced, frame, report):
        shares = wp.empty((len(batch.rows), view_count), dtype=wp.vec4, device=device)
        launch_lobe_shares(
            shares.size, batch, rays, measured.light, normals, observed, reflected.sources, shares, device
        )
        for start in range(0, len(batch.rows), at_once):
            some = slice(start, min(start + at_once, len(batch.rows)))
            held = batch.rows[some]
            seen = reflections[: len(held)]
            inputs = (held, measured.light, reflected, normals, observed, shares[some], candidates, seen)
            launch_reflections(seen.size, *inputs, device)
            items = len(held) * int(PARTS) * len(CANDIDATES)
            launch_profile(items, held, measured.light, normals, observed, seen, fit, device)
    misfit = np.zeros((int(PARTS), count, len(CANDIDATES)), np.float32)
    counted = np.zeros(count, np.float32)
    misfit[:, told], counted[told] = fit.misfit.numpy(), fit.views.numpy()
    return RoughnessProfile(misfit, counted, scatter=counted * np.square(points.normal_error[chosen]))
