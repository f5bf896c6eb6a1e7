"""beam-warp: relightable 4D Gaussian assets on NVIDIA Warp.

Public names are resolved on first use: ``import beam_warp`` costs no Warp and no USD, so that a converter or a
validator starts at once.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from beam_warp._version import __version__ as __version__

if TYPE_CHECKING:
    from beam_warp.capture.capture import Capture as Capture
    from beam_warp.capture.views import CapturedView as CapturedView
    from beam_warp.converters import read as read
    from beam_warp.converters import write as write
    from beam_warp.errors import BeamError as BeamError
    from beam_warp.evaluate.materials import score_materials as score_materials
    from beam_warp.materials.direct import MaterialOptions as MaterialOptions
    from beam_warp.materials.images import ImagePathOptions as ImagePathOptions
    from beam_warp.materials.job import RunOptions as RunOptions
    from beam_warp.materials.job import RunResult as RunResult
    from beam_warp.materials.job import run as run
    from beam_warp.materials.normals import SurfaceNormals as SurfaceNormals
    from beam_warp.materials.normals import estimate_normals as estimate_normals
    from beam_warp.mesh.extract import mesh_of_gaussians as mesh_of_gaussians
    from beam_warp.raster.adam import Adam as Adam
    from beam_warp.raster.adam import Parameters as Parameters
    from beam_warp.raster.depth_normals import DepthNormals as DepthNormals
    from beam_warp.raster.gbuffer import GBuffer as GBuffer
    from beam_warp.raster.gbuffer import rasterize as rasterize
    from beam_warp.raster.gbuffer import rasterize_backward as rasterize_backward
    from beam_warp.raster.losses import L1Loss as L1Loss
    from beam_warp.raster.losses import NormalLoss as NormalLoss
    from beam_warp.raster.losses import SsimLoss as SsimLoss
    from beam_warp.raster.rasterizer import Rasterizer as Rasterizer
    from beam_warp.raster.records import GaussianArrays as GaussianArrays
    from beam_warp.raster.records import RasterOptions as RasterOptions
    from beam_warp.reconstruction.fit import FitOptions as FitOptions
    from beam_warp.reconstruction.fit import fit_gaussians as fit_gaussians
    from beam_warp.reconstruction.initial import initial_gaussians as initial_gaussians
    from beam_warp.reconstruction.job import Reconstruction as Reconstruction
    from beam_warp.reconstruction.job import ReconstructOptions as ReconstructOptions
    from beam_warp.reconstruction.job import reconstruct as reconstruct
    from beam_warp.reconstruction.steps import FitAndTrack as FitAndTrack
    from beam_warp.reconstruction.track import TrackOptions as TrackOptions
    from beam_warp.render.deferred import DeferredRenderer as DeferredRenderer
    from beam_warp.render.options import DeferredOptions as DeferredOptions
    from beam_warp.render.path import PathOptions as PathOptions
    from beam_warp.render.path import PathRenderer as PathRenderer
    from beam_warp.schema.validator import validate as validate
    from beam_warp.stage.stage import Stage as Stage
    from beam_warp.trace.gradients import visibility_gradients as visibility_gradients
    from beam_warp.trace.incident import Irradiance as Irradiance
    from beam_warp.trace.incident import irradiance as irradiance
    from beam_warp.trace.occlusion import AmbientOcclusion as AmbientOcclusion
    from beam_warp.trace.occlusion import ambient_occlusion as ambient_occlusion
    from beam_warp.trace.scene import Scene as Scene
    from beam_warp.trace.transmittance import visibility as visibility
    from beam_warp.world.axes import change_axes as change_axes
    from beam_warp.world.camera import Camera as Camera
    from beam_warp.world.environment import EnvironmentMap as EnvironmentMap
    from beam_warp.world.gaussians import GaussianCloud as GaussianCloud
    from beam_warp.world.gaussians import GaussianSequence as GaussianSequence
    from beam_warp.world.gaussians import Observability as Observability
    from beam_warp.world.lights import DirectionalLight as DirectionalLight
    from beam_warp.world.lights import PointLight as PointLight
    from beam_warp.world.lights import SpotLight as SpotLight
    from beam_warp.world.shot import RenderedImage as RenderedImage
    from beam_warp.world.shot import Shot as Shot
    from beam_warp.world.shot import ShotMesh as ShotMesh

_HOMES = {
    "SpotLight": "world.lights",
    "PointLight": "world.lights",
    "DirectionalLight": "world.lights",
    "RenderedImage": "world.shot",
    "ShotMesh": "world.shot",
    "Shot": "world.shot",
    "PathRenderer": "render.path",
    "PathOptions": "render.path",
    "DeferredRenderer": "render.deferred",
    "DeferredOptions": "render.options",
    "Adam": "raster.adam",
    "AmbientOcclusion": "trace.occlusion",
    "BeamError": "errors",
    "Camera": "world.camera",
    "Capture": "capture.capture",
    "CapturedView": "capture.views",
    "DepthNormals": "raster.depth_normals",
    "EnvironmentMap": "world.environment",
    "FitAndTrack": "reconstruction.steps",
    "FitOptions": "reconstruction.fit",
    "GBuffer": "raster.gbuffer",
    "GaussianArrays": "raster.records",
    "GaussianCloud": "world.gaussians",
    "GaussianSequence": "world.gaussians",
    "Irradiance": "trace.incident",
    "L1Loss": "raster.losses",
    "ImagePathOptions": "materials.images",
    "MaterialOptions": "materials.direct",
    "score_materials": "evaluate.materials",
    "NormalLoss": "raster.losses",
    "Observability": "world.gaussians",
    "Parameters": "raster.adam",
    "RasterOptions": "raster.records",
    "Rasterizer": "raster.rasterizer",
    "ReconstructOptions": "reconstruction.job",
    "Reconstruction": "reconstruction.job",
    "RunOptions": "materials.job",
    "RunResult": "materials.job",
    "Scene": "trace.scene",
    "SsimLoss": "raster.losses",
    "Stage": "stage.stage",
    "SurfaceHits": "trace.first_surface",
    "SurfaceNormals": "materials.normals",
    "TraceOptions": "trace.transmittance",
    "TrackOptions": "reconstruction.track",
    "ambient_occlusion": "trace.occlusion",
    "change_axes": "world.axes",
    "closest_surface": "trace.first_surface",
    "estimate_normals": "materials.normals",
    "fit_gaussians": "reconstruction.fit",
    "initial_gaussians": "reconstruction.initial",
    "irradiance": "trace.incident",
    "mesh_of_gaussians": "mesh.extract",
    "rasterize": "raster.gbuffer",
    "rasterize_backward": "raster.gbuffer",
    "read": "converters",
    "reconstruct": "reconstruction.job",
    "run": "materials.job",
    "validate": "schema.validator",
    "visibility": "trace.transmittance",
    "visibility_gradients": "trace.gradients",
    "write": "converters",
}
"""Public name → the module that defines it."""

__all__ = ["__version__", *sorted(_HOMES)]  # pyright: ignore[reportUnsupportedDunderAll]


def __getattr__(name: str) -> Any:
    """Import a public name's home when the name is first used."""
    if name in _HOMES:
        value = getattr(import_module(f"beam_warp.{_HOMES[name]}"), name)
        globals()[name] = value
        return value
    raise AttributeError(f"module 'beam_warp' has no attribute {name!r}")


def __dir__() -> list[str]:
    """List the public names before they are imported, for completion."""
    return sorted({*globals(), *_HOMES})
