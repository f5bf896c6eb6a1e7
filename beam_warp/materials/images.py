"""Image path, the paper's: base colour and ambient occlusion of every pixel of the views, baked into the Gaussians.

Per view, the pixels' surface points are lifted by a fixed distance, ambient occlusion and both residues are estimated
by independent rays and denoised, and what was captured is solved for the base colour, pixel by pixel. Then both are
baked into the Gaussians, geometry held fixed (BEAM §3.2). `beam_warp.materials.direct` is the direct path, which needs
no images of materials; this one is what it is compared with.

The paper leaves the following open. Here, densities of rays as in `beam_warp.materials.residues`; the base colour is
max(L_o - L_S, 0) / L_D, cut to [0, 1], and does not count where L_D is below `UNLIT_PART` of the light that falls on an
open surface on average, nor where a pixel is not covered by the subject wholly, as drawn and as captured.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from beam_warp.capture.views import CapturedView
from beam_warp.checks import (
    require_array,
    require_choice,
    require_count,
    require_finite,
    require_number,
    require_range,
    require_same_length,
)
from beam_warp.device.arrays import upload
from beam_warp.errors import InvalidOptionError
from beam_warp.image.color import DISPLAY_SRGB, srgb_to_linear
from beam_warp.jobs.listeners import CountProgress
from beam_warp.jobs.progress import StageTimer
from beam_warp.kernels.materials.base_color_pixels import PixelGuards, ShownPixels, launch_write_bake_targets
from beam_warp.light.prepared import PreparedEnvironment
from beam_warp.materials.bake import BakedValues, BakeOptions, BakeTarget, Solver, bake
from beam_warp.materials.bake_resolution import reduced_target
from beam_warp.materials.base_color import Neighbors
from beam_warp.materials.light_rays import DIFFUSE_WEIGHTS, DiffuseWeight
from beam_warp.materials.residues import (
    FEWEST_LIGHT_SAMPLES,
    SURFACE_DEPTHS,
    SurfaceDepth,
    ViewSurfaces,
    surface_residues,
    view_surfaces,
)
from beam_warp.raster.records import GaussianArrays, RasterOptions
from beam_warp.raster.resolution import reduced_options, reduction_factor
from beam_warp.raster.sources import upload_gaussians
from beam_warp.trace.denoise import DENOISERS, Denoiser, NoisyImage, SurfaceGuides, chosen_denoiser, denoise
from beam_warp.trace.occlusion import ambient_occlusion
from beam_warp.trace.scene import Scene
from beam_warp.world.gaussians import WORLD_AXES, GaussianCloud
from beam_warp.world.harmonics import SH_C0

UNLIT_PART = 0.01
"""A pixel is unlit below this part of what the environment sheds on an open surface on average."""

WHOLE_ALPHA = 0.99
"""Coverage from which a pixel shows the subject alone: others mix it with the background, and near with far."""

CROP_MARGIN = 16
"""Pixels around the subject that stay in the picture: so far does the last round of denoising reach."""

UNSEEN_EVIDENCE = 1e-2
"""Gaussians that are worth fewer pixels than this over all views take the values of their neighbours."""


@dataclass(frozen=True, kw_only=True)
class ImagePathOptions:
    """Options of the image path; defaults are the paper's, but for the solver.

    Attributes:
        occlusion_samples: Rays a pixel for ambient occlusion.
        light_samples: Rays a pixel for both residues.
        offset: Lift of ray origins along the normal [m].
        denoiser: See `beam_warp.trace.denoise.DENOISERS`.
        solver: ``"cg"``, or ``"adam"`` as in the paper; see `beam_warp.materials.bake`.
        passes: Most passes over the views of ``"cg"``.
        steps: Steps of ``"adam"``.
        ridge: See `beam_warp.materials.bake.BakeOptions`.
        temporal: Pull of the base colour towards the previous frame's, in pixels.
        diffuse_weight: See `beam_warp.materials.light_rays.DIFFUSE_WEIGHTS`.
        surface_depth: See `beam_warp.materials.residues.SURFACE_DEPTHS`.
        seed: Same seed, same device, same bits.

    Raises:
        InvalidOptionError: An option is out of range.
    """

    occlusion_samples: int = 50
    light_samples: int = 100
    offset: float = 0.02
    denoiser: Denoiser = "auto"
    solver: Solver = "cg"
    passes: int = 30
    steps: int = 5000
    ridge: float = 0.1
    temporal: float = 1.0
    diffuse_weight: DiffuseWeight = "fresnel_hv"
    surface_depth: SurfaceDepth = "mean"
    seed: int = 0

    def __post_init__(self) -> None:
        """Check every option once; baking checks its own."""
        require_count("occlusion_samples", self.occlusion_samples, 1, 1 << 20)
        require_count("light_samples", self.light_samples, FEWEST_LIGHT_SAMPLES, 1 << 20)
        require_number("offset", self.offset)
        require_choice("denoiser", self.denoiser, DENOISERS)
        require_choice("diffuse_weight", self.diffuse_weight, tuple(DIFFUSE_WEIGHTS))
        require_choice("surface_depth", self.surface_depth, SURFACE_DEPTHS)
        self.baking(temporal=self.temporal)

    def baking(self, *, temporal: float) -> BakeOptions:
        """Return the options of baking, with or without a previous frame."""
        return BakeOptions(
            solver=self.solver,
            passes=self.passes,
            steps=self.steps,
            ridge=self.ridge,
            temporal=temporal,
            seed=self.seed,
        )


@dataclass(frozen=True, eq=False)
class ImageMaterials:
    """Materials that the image path finds.

    Attributes:
        base_color: In [0, 1], scene-linear Rec.709, ``(N, 3)`` float32.
        ambient_occlusion: Hemispherical visibility in [0, 1], ``(N,)`` float32.
        color_evidence: How many pixels say something about the base colour, ``(N,)`` float32: the least of the
            channels.
        occlusion_evidence: The same of ambient occlusion, ``(N,)`` float32.
        filled: Where base colour, or ambient occlusion, comes from neighbours because no view says anything,
            ``(N, 2)`` bool.
        ray_count: How many rays were traced for both.
        seconds: By stage.
        passes: Of baking, over the views.
        notes: What a reader of the result should know.
    """

    base_color: NDArray[np.float32]
    ambient_occlusion: NDArray[np.float32]
    color_evidence: NDArray[np.float32]
    occlusion_evidence: NDArray[np.float32]
    filled: NDArray[np.bool_]
    ray_count: int
    seconds: dict[str, float]
    passes: float
    notes: tuple[str, ...]


def decompose_by_images(
    cloud: GaussianCloud,
    scene: Scene,
    views: Sequence[CapturedView],
    roughness: NDArray[np.float32],
    light: PreparedEnvironment,
    options: ImagePathOptions | None = None,
    *,
    raster_options: RasterOptions | None = None,
    previous: NDArray[np.float32] | None = None,
    frame: int = 0,
    progress: CountProgress | None = None,
) -> ImageMaterials:
    """Decompose one frame.

    Args:
        cloud: Gaussians, axes "rfu".
        scene: The same Gaussians, uploaded.
        views: What was captured at that moment, scene-linear; at least one.
        roughness: Perceptual roughness of every Gaussian, ``(N,)`` in [0, 1].
        light: The light of the capture, prepared on the scene's device.
        options: See `ImagePathOptions`.
        raster_options: How the cloud was fitted, so must be drawn.
        previous: Base colour of the frame before, ``(N, 3)``, for the temporal term; without there is none.
        frame: Number of the frame: frames have independent noise.
        progress: Called with (views done, views in all).

    Raises:
        InvalidArrayError: An array breaks its contract.
        InvalidOptionError: There is no view, the cloud is in other axes, or the light is on another device.
        MissingPackageError: The denoiser asked for is not installed.

    Source: BEAM §3.2, Eqs. 3 to 7.
    """
    chosen = options or ImagePathOptions()
    kind = chosen_denoiser(chosen.denoiser)
    if not views:
        raise InvalidOptionError("views must hold at least one view, got none. Pass what the cameras saw.")
    if cloud.axes != WORLD_AXES:
        raise InvalidOptionError(
            f"cloud must be in the axes {WORLD_AXES!r}, got {cloud.axes!r}. Convert it with beam_warp.change_axes."
        )
    if light.device != scene.device:
        raise InvalidOptionError(
            f"light must be on {scene.device}, got one on {light.device}. Prepare it for that device."
        )
    rough = require_array("roughness", roughness, (None,))
    require_same_length("roughness", rough, "positions", len(cloud))
    require_range("roughness", rough, 0.0, 1.0)
    before = None
    if previous is not None:
        before = require_array("previous", previous, (len(cloud), 3))
        require_finite("previous", before)
    require_count("frame", frame, 0, 2**32 - 1)

    stages = StageTimer(scene.device)
    with stages("upload"):
        gaussians = upload_gaussians(cloud, scene.device, values=rough[:, None])
    drawn_as = raster_options or RasterOptions()
    factor = reduction_factor(cloud, [view.camera for view in views], near=drawn_as.near)
    targets = []
    shown = 0
    for i, view in enumerate(views):
        cropped = crop_to_subject(view)
        # Views of one frame, and frames, have independent noise.
        number = (frame * len(views) + i) % 2**32
        target, count = _measure_view(scene, gaussians, cropped, light, chosen, drawn_as, number, kind, stages)
        with stages("bake"):
            targets.append(reduced_target(target, factor, scene.device))
        shown += count
        if progress is not None:
            progress(i + 1, len(views))
    reduced = reduced_options(drawn_as, factor)
    baked, filled = _bake(cloud, gaussians, targets, chosen, reduced, before, stages, scene.device)
    notes = [_DENOISER_NOTES[kind]] if chosen.denoiser == "auto" or kind == "none" else []
    if factor > 1:
        notes.append(f"baked from means of {factor} x {factor} pixels, narrower than the Gaussians seen there")
    if not shown:
        notes.append("no view shows a surface: every value is a prior")
    return ImageMaterials(
        np.ascontiguousarray(baked.values[:, :3]),
        np.ascontiguousarray(baked.values[:, 3]),
        baked.evidence[:, :3].min(axis=1),
        np.ascontiguousarray(baked.evidence[:, 3]),
        filled,
        shown * (chosen.occlusion_samples + chosen.light_samples),
        stages.seconds,
        baked.passes,
        tuple(notes),
    )


_DENOISER_NOTES = {
    "oidn": "denoised by Open Image Denoise",
    "bilateral": "denoised by a joint bilateral filter: Open Image Denoise is not installed (extra denoise)",
    "none": "not denoised",
}


def crop_to_subject(view: CapturedView) -> CapturedView:
    """Return the part of a view that shows the subject, with a margin; all of it where coverage is not known.

    Everything that follows costs by the pixel.
    """
    if view.alpha is None:
        return view
    rows, columns = (np.flatnonzero((view.alpha > 0.0).any(axis=axis)) for axis in (1, 0))
    if not len(rows):
        return view.cropped(0, 0, 1, 1)
    top, left = max(int(rows[0]) - CROP_MARGIN, 0), max(int(columns[0]) - CROP_MARGIN, 0)
    bottom = min(int(rows[-1]) + 1 + CROP_MARGIN, view.camera.height)
    right = min(int(columns[-1]) + 1 + CROP_MARGIN, view.camera.width)
    return view.cropped(left, top, right - left, bottom - top)


def _measure_view(
    scene: Scene,
    gaussians: GaussianArrays,
    view: CapturedView,
    light: PreparedEnvironment,
    options: ImagePathOptions,
    raster_options: RasterOptions,
    number: int,
    denoiser: Denoiser,
    stages: StageTimer,
) -> tuple[BakeTarget, int]:
    """Return base colour and ambient occlusion of a view's pixels, to be baked, and how many show a surface."""
    device = scene.device
    with stages("draw"):
        surfaces = view_surfaces(
            gaussians, view.camera, surface_depth=options.surface_depth, options=raster_options, device=device
        )
    stream: dict[str, Any] = {"offset": options.offset, "seed": options.seed, "frame": number}
    with stages("occlusion rays"):
        occlusion = ambient_occlusion(
            scene,
            surfaces.rows.positions,
            surfaces.rows.normals,
            sample_count=options.occlusion_samples,
            sampler="iid",  # BEAM Eq. 3
            **stream,
        )
    with stages("light rays"):
        residues = surface_residues(
            scene, surfaces, light, sample_count=options.light_samples, diffuse_weight=options.diffuse_weight, **stream
        )
    with stages("denoise"):
        noisy = [
            NoisyImage(surfaces.image(occlusion.visibility), surfaces.image(occlusion.standard_error), hdr=False),
            NoisyImage(surfaces.image(residues.diffuse), surfaces.image(residues.diffuse_error), hdr=True),
            NoisyImage(surfaces.image(residues.specular), surfaces.image(residues.specular_error), hdr=True),
        ]
        guides = SurfaceGuides(view.camera, surfaces.image(surfaces.rows.normals), surfaces.depth)
        clean = denoise(noisy, guides, denoiser=denoiser)
    with stages("base colour"):
        return _bake_target(surfaces, view, clean, light), len(surfaces)


def _bake_target(
    surfaces: ViewSurfaces, view: CapturedView, clean: list[wp.array], light: PreparedEnvironment
) -> BakeTarget:
    """Solve L_o = rho L_D + L_S for every pixel, and say which ones count."""
    device = surfaces.alpha.device
    count = len(surfaces.alpha)
    pixels = ShownPixels()
    pixels.alpha = surfaces.alpha
    pixels.surface = surfaces.image(wp.full(len(surfaces), 1.0, dtype=float, device=device))
    pixels.captured = upload(view.color.reshape(-1, 3), wp.vec3, device)
    pixels.captured_alpha = upload(np.zeros(0) if view.alpha is None else view.alpha.reshape(-1), float, device)
    pixels.ambient_occlusion, pixels.diffuse, pixels.specular = clean
    guards = PixelGuards()
    guards.least_alpha = WHOLE_ALPHA
    guards.least_diffuse = max(UNLIT_PART * light.mean_irradiance / np.pi, float(np.finfo(np.float32).tiny))
    targets, weights = (wp.empty((count, 4), dtype=float, device=device) for _ in range(2))
    launch_write_bake_targets(len(pixels.alpha), pixels, guards, targets, weights, device)
    shape = (view.camera.height, view.camera.width, 4)
    return BakeTarget(view.camera, targets.reshape(shape), weights.reshape(shape))


def _bake(
    cloud: GaussianCloud,
    gaussians: GaussianArrays,
    targets: list[BakeTarget],
    options: ImagePathOptions,
    raster_options: RasterOptions,
    previous: NDArray[np.float32] | None,
    stages: StageTimer,
    device: Any,
) -> tuple[BakedValues, NDArray[np.bool_]]:
    """Bake the images, and fill what no view sees from its neighbours."""
    start = None
    if options.solver == "adam":
        start = np.zeros((len(cloud), 4), np.float32)  # the paper begins with black occlusion and the captured colour
        start[:, :3] = captured_color(cloud)
    temporal = options.temporal if previous is not None else 0.0
    with stages("bake"):
        baked = bake(
            gaussians,
            targets,
            start=start,
            previous=previous,  # of the base colour, the first columns
            options=options.baking(temporal=temporal),
            raster_options=raster_options,
            device=device,
        )
    with stages("fill"):
        color, occlusion = baked.evidence[:, :3].min(axis=1), baked.evidence[:, 3]
        filled = np.stack([color, occlusion], axis=1) <= UNSEEN_EVIDENCE
        values = baked.values.copy()
        for columns, missing in ((slice(0, 3), filled[:, 0]), (slice(3, 4), filled[:, 1])):
            values[:, columns] = Neighbors.of(cloud.positions, missing).fill(values[:, columns])
    return replace(baked, values=values), filled


def captured_color(cloud: GaussianCloud) -> NDArray[np.float32]:
    """Return the mean captured colour over views, scene-linear in [0, 1], ``(N, 3)``; grey where there is none."""
    if cloud.radiance is None:
        return np.full((len(cloud), 3), 0.5, np.float32)
    mean = np.clip(0.5 + SH_C0 * cloud.radiance[:, 0], 0.0, 1.0)
    return (srgb_to_linear(mean) if cloud.radiance_color_space == DISPLAY_SRGB else mean).astype(np.float32)
