"""Ways to decompose that the materials benchmark compares: the only place where it calls either path.

A row of the ablation is a name and a function of a subject. The ladder begins at the paper's recipe and adds one idea
at a time; then each idea is taken away from ours alone. What is not installed, or asks for frames that a subject lacks,
says so in its row.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np
from materials_truth import Materials
from numpy.typing import NDArray

from beam_warp.capture.views import CapturedView
from beam_warp.jobs.progress import StageTimer
from beam_warp.light.prepared import PreparedEnvironment
from beam_warp.materials.base_color import fill_from_neighbors, solve_base_color
from beam_warp.materials.direct import ColorEvidence, measure_materials
from beam_warp.materials.evidence import view_evidence
from beam_warp.materials.images import ImagePathOptions, decompose_by_images
from beam_warp.materials.light_rays import MaterialOptions
from beam_warp.materials.normals import SurfacePoints
from beam_warp.materials.roughness import solve_roughness
from beam_warp.materials.roughness_profile import measure_roughness_profile
from beam_warp.raster.records import RasterOptions
from beam_warp.study.materials import without_color
from beam_warp.trace.scene import Scene
from beam_warp.world.gaussians import GaussianCloud

ROUGHNESS = 0.5
"""Roughness of every Gaussian, alike in every row."""


@dataclass(frozen=True, eq=False)
class SubjectFrame:
    """A reconstructed frame and what was captured then."""

    number: int
    cloud: GaussianCloud
    views: Sequence[CapturedView]


@dataclass(frozen=True, eq=False)
class Subject:
    """Gaussians and captured views that are decomposed.

    Attributes:
        name: In tables.
        frames: The first is scored; row i of every frame is the same Gaussian.
        raster: How the Gaussians were fitted.
        light: The light of the capture.
        device: Where work runs.
        roughness: Of the Gaussians; a constant where None.
    """

    name: str
    frames: Sequence[SubjectFrame]
    raster: RasterOptions
    light: PreparedEnvironment
    device: Any
    roughness: Any = None

    def small(self) -> Subject:
        """Return a part that compiles what the whole needs, in no time: few Gaussians, two views of each frame."""
        frames = []
        for frame in self.frames[:2]:
            rows = np.linspace(0, len(frame.cloud) - 1, min(len(frame.cloud), 512)).astype(np.int64)
            views = [view.reduced(max(1, view.camera.height // 160)) for view in frame.views[:2]]
            frames.append(SubjectFrame(frame.number, frame.cloud.select(rows), views))
        return replace(self, frames=frames, roughness=None)

    def rough(self, cloud: GaussianCloud) -> Any:
        """Return the roughness of every Gaussian."""
        return np.full(len(cloud), ROUGHNESS, np.float32) if self.roughness is None else self.roughness


@dataclass(frozen=True, eq=False)
class Decomposed:
    """The first frame's materials, seconds by stage for all frames used, how many these are, notes."""

    materials: Materials
    seconds: dict[str, float]
    frames: int = 1
    notes: tuple[str, ...] = ()


Method = Callable[[Subject], Decomposed]


class Unavailable(Exception):
    """A row cannot be run here; the message says why."""


@dataclass(frozen=True)
class Choices:
    """Choices of the direct path.

    Attributes:
        materials: Rays and fit.
        offset: Lift of ray origins.
        observed: Fitted radiance plus the image's difference spread back, or images spread back as they are.
        joint: Whether all frames are fitted at once.
        roughness: Whether roughness is found, in the first frame; else it is the subject's.
    """

    materials: MaterialOptions = field(default_factory=MaterialOptions)
    offset: float | Literal["auto"] = "auto"
    observed: Literal["difference", "images"] = "difference"
    joint: bool = True
    roughness: bool = False

    def but(self, **changes: Any) -> Choices:
        """Return other choices; those of `MaterialOptions` by their names as well."""
        own = {name: changes.pop(name) for name in ("offset", "observed", "joint", "roughness") if name in changes}
        return replace(self, materials=replace(self.materials, **changes), **own)


OURS = Choices()

DIRECT_AS_PAPER = Choices(
    MaterialOptions(
        light_error=0.0,
        sampler="iid",
        density="cosine",
        ratio=False,
        bounce=False,
        robust=False,
        blended=False,
        diffuse_weight="fresnel_hv",
    ),
    offset=0.02,
    observed="images",
    joint=False,
)
"""The paper's choices as far as the direct path has them; 64 rays in every row, so that only the idea changes."""


def direct(subject: Subject, choices: Choices = OURS) -> Decomposed:
    """Decompose by the direct path."""
    stages, device = StageTimer(subject.device), str(subject.device)
    frames = subject.frames if choices.joint else subject.frames[:1]
    if choices.joint and len(frames) < 2:
        raise Unavailable("a joint fit needs two frames of the same Gaussians")
    joint: ColorEvidence | None = None
    first: Any = None
    rough = subject.rough(frames[0].cloud)
    for frame in frames:
        cloud = frame.cloud
        with stages("upload and build"):
            scene = Scene.from_gaussians(cloud, device)
        with stages("views"):
            shown = without_color(cloud) if choices.observed == "images" else cloud
            cameras = [view.camera for view in frame.views]
            seen = view_evidence(shown, cameras, frame.views, options=subject.raster, device=device)
        with stages("surface"):
            points = SurfacePoints.seen_by(cloud, seen, scene, choices.offset)
        if choices.roughness and first is None:
            with stages("roughness"):
                profile = measure_roughness_profile(
                    cloud, scene, points, subject.light, seen, options=choices.materials, frame=frame.number
                )
                rough = solve_roughness(cloud.positions, profile).roughness
        with stages("materials"):
            measured = measure_materials(
                cloud, scene, points, rough, subject.light, options=choices.materials, views=seen, frame=frame.number
            )
        joint = measured.evidence if joint is None else joint + measured.evidence
        if first is None:
            first = cloud, measured, points
    assert joint is not None
    cloud, measured, points = first
    with stages("solve"):
        up = normals_of(cloud, points)
        known = cloud.with_arrays(normals=up, normal_confidence=points.confidence)
        solved = solve_base_color(known, joint, subject.light.mean_irradiance)
        openness, _ = fill_from_neighbors(
            cloud.positions,
            measured.ambient_occlusion[:, None],
            measured.ambient_occlusion_error[:, None],
            ~points.seen,
        )
    materials = Materials(solved.base_color, openness[:, 0].astype(np.float32), rough, up)
    return Decomposed(materials, stages.seconds, len(frames))


def normals_of(cloud: GaussianCloud, points: SurfacePoints) -> NDArray[np.float32]:
    """Return the normals that views show, and those of neighbours where they show none."""
    known = points.normals.numpy()
    filled, _ = fill_from_neighbors(cloud.positions, known, np.zeros_like(known), ~points.seen)
    lengths = np.linalg.norm(filled, axis=1, keepdims=True)
    return np.where(lengths > 1e-6, filled / np.maximum(lengths, 1e-6), (0.0, 0.0, 1.0)).astype(np.float32)


def seen_normals(subject: Subject) -> NDArray[np.float32]:
    """Return the normals of the first frame, to relight what comes without."""
    frame = subject.frames[0]
    cameras = [view.camera for view in frame.views]
    seen = view_evidence(frame.cloud, cameras, options=subject.raster, device=str(subject.device))
    scene = Scene.from_gaussians(frame.cloud, str(subject.device))
    return normals_of(frame.cloud, SurfacePoints.seen_by(frame.cloud, seen, scene, 0.0))


def by_images(subject: Subject, **changes: Any) -> Decomposed:
    """Decompose by the image path; without changes, the paper's preset with the bilateral filter."""
    options = {"denoiser": "bilateral", **changes}
    frame = subject.frames[0]
    stages = StageTimer(subject.device)
    with stages("upload and build"):
        scene = Scene.from_gaussians(frame.cloud, str(subject.device))
    found = decompose_by_images(
        frame.cloud,
        scene,
        frame.views,
        subject.rough(frame.cloud),
        subject.light,
        ImagePathOptions(**options),
        raster_options=subject.raster,
        frame=frame.number,
    )
    materials = Materials(found.base_color, found.ambient_occlusion, subject.rough(frame.cloud))
    return Decomposed(materials, {**stages.seconds, **found.seconds}, notes=found.notes)


@dataclass(frozen=True)
class AblationRow:
    """A row: its group, its name, what decomposes, and what compiles all that it needs in less time."""

    group: str
    name: str
    method: Method
    warm: Method


def ablation_rows(high: int = 512, low: int = 8) -> list[AblationRow]:
    """Return all rows.

    Args:
        high: Rays a pixel for occlusion, half of those for light, where the image path has many.
        low: The same where it has few.
    """
    paper = _image("ladder", "paper: image path, 2 cm, 50 + 100 iid rays", {})
    choices = DIRECT_AS_PAPER
    rows = [paper, _direct("ladder", "baked directly, iid rays by the cosine, images spread back", choices)]
    for name, changes in (
        ("+ offset auto", {"offset": "auto"}),
        ("+ Owen", {"sampler": "owen"}),
        ("+ product and ratio", {"density": "product", "ratio": True}),
        ("+ albedo scaling", {"diffuse_weight": "albedo_scaling"}),
        ("+ bounce", {"bounce": True}),
        ("+ fit and difference", {"observed": "difference"}),
        ("+ robust", {"robust": True}),
        ("+ all Gaussians together", {"blended": True}),
        ("+ rays where light is noisy", {"light_error": MaterialOptions().light_error}),
        ("+ all frames", {"joint": True}),
    ):
        choices = choices.but(**changes)
        rows.append(_direct("ladder", name, choices))
    alone = OURS.but(joint=False)
    for name, changes in (
        ("ours, one frame", {}),
        ("offset 0", {"offset": 0.0}),
        ("offset 2 cm", {"offset": 0.02}),
        ("offset 10 cm", {"offset": 0.1}),
        ("iid for Owen", {"sampler": "iid"}),
        ("cosine for product and ratio", {"density": "cosine", "ratio": False}),
        ("product without ratio", {"ratio": False}),
        ("fresnel_hv for albedo scaling", {"diffuse_weight": "fresnel_hv"}),
        ("without bounce", {"bounce": False}),
        ("images for fit and difference", {"observed": "images"}),
        ("plain for robust least squares", {"robust": False}),
        ("each Gaussian by itself for all together", {"blended": False}),
        ("as many rays for each", {"light_error": 0.0}),
        ("16 rays for each", {"sample_count": 16, "light_error": 0.0}),
        ("256 rays for each", {"sample_count": 256, "light_error": 0.0}),
    ):
        rows.append(_direct("one idea taken away", name, alone.but(**changes)))
    for name, options in (
        ("offset 0", {"offset": 0.0}),
        ("offset 2 cm", {}),
        ("offset 10 cm", {"offset": 0.1}),
        ("points at the median depth", {"surface_depth": "median"}),
        ("albedo scaling", {"diffuse_weight": "albedo_scaling"}),
        (f"{low} + {2 * low} rays", {"occlusion_samples": low, "light_samples": 2 * low, "denoiser": "none"}),
        (f"{low} + {2 * low} rays, denoised", {"occlusion_samples": low, "light_samples": 2 * low}),
        (f"{high} + {2 * high} rays", {"occlusion_samples": high, "light_samples": 2 * high, "denoiser": "none"}),
    ):
        rows.append(_image("image path", name, options))
    return rows


def _direct(group: str, name: str, choices: Choices) -> AblationRow:
    return AblationRow(
        group,
        name,
        lambda subject: direct(subject, choices),
        lambda subject: direct(subject, choices.but(sample_count=8)),
    )


def _image(group: str, name: str, options: dict[str, Any]) -> AblationRow:
    less = {"occlusion_samples": 4, "light_samples": 8}
    return AblationRow(
        group,
        name,
        lambda subject: by_images(subject, **options),
        lambda subject: by_images(subject, **{**options, **less}),
    )
