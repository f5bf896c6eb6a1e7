"""beam-warp: relightable 4D Gaussian assets on NVIDIA Warp.

Public names are resolved on first use: ``import beam_warp`` costs no Warp and no USD, so that a converter or a
validator starts at once.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from beam_warp._version import __version__ as __version__

if TYPE_CHECKING:
    from beam_warp.adam import Adam as Adam
    from beam_warp.adam import Parameters as Parameters
    from beam_warp.assets import GaussianCloud as GaussianCloud
    from beam_warp.assets import GaussianSequence as GaussianSequence
    from beam_warp.assets import Observability as Observability
    from beam_warp.axes import change_axes as change_axes
    from beam_warp.cameras import Camera as Camera
    from beam_warp.captured_views import CapturedView as CapturedView
    from beam_warp.captures import Capture as Capture
    from beam_warp.converters import read as read
    from beam_warp.converters import write as write
    from beam_warp.deferred_options import DeferredOptions as DeferredOptions
    from beam_warp.deferred_rendering import DeferredRenderer as DeferredRenderer
    from beam_warp.depth_normals import DepthNormals as DepthNormals
    from beam_warp.environments import EnvironmentMap as EnvironmentMap
    from beam_warp.errors import BeamError as BeamError
    from beam_warp.gaussian_fitting import FitOptions as FitOptions
    from beam_warp.gaussian_fitting import fit_gaussians as fit_gaussians
    from beam_warp.gradients import visibility_gradients as visibility_gradients
    from beam_warp.image_losses import L1Loss as L1Loss
    from beam_warp.image_losses import NormalLoss as NormalLoss
    from beam_warp.image_losses import SsimLoss as SsimLoss
    from beam_warp.image_path import ImagePathOptions as ImagePathOptions
    from beam_warp.incident_light import Irradiance as Irradiance
    from beam_warp.incident_light import irradiance as irradiance
    from beam_warp.initialization import initial_gaussians as initial_gaussians
    from beam_warp.lighting import AmbientOcclusion as AmbientOcclusion
    from beam_warp.lighting import ambient_occlusion as ambient_occlusion
    from beam_warp.lights import DirectionalLight as DirectionalLight
    from beam_warp.lights import PointLight as PointLight
    from beam_warp.lights import SpotLight as SpotLight
    from beam_warp.material_scores import score_materials as score_materials
    from beam_warp.materials import MaterialOptions as MaterialOptions
    from beam_warp.meshing import mesh_of_gaussians as mesh_of_gaussians
    from beam_warp.path_rendering import PathOptions as PathOptions
    from beam_warp.path_rendering import PathRenderer as PathRenderer
    from beam_warp.pipeline import RunOptions as RunOptions
    from beam_warp.pipeline import RunResult as RunResult
    from beam_warp.pipeline import run as run
    from beam_warp.raster_records import GaussianArrays as GaussianArrays
    from beam_warp.raster_records import RasterOptions as RasterOptions
    from beam_warp.rasterizer import Rasterizer as Rasterizer
    from beam_warp.rasterizing import GBuffer as GBuffer
    from beam_warp.rasterizing import rasterize as rasterize
    from beam_warp.rasterizing import rasterize_backward as rasterize_backward
    from beam_warp.reconstruction import Reconstruction as Reconstruction
    from beam_warp.reconstruction import ReconstructOptions as ReconstructOptions
    from beam_warp.reconstruction import reconstruct as reconstruct
    from beam_warp.reconstruction_steps import FitAndTrack as FitAndTrack
    from beam_warp.scene import Scene as Scene
    from beam_warp.schema.validator import validate as validate
    from beam_warp.shots import RenderedImage as RenderedImage
    from beam_warp.shots import Shot as Shot
    from beam_warp.shots import ShotMesh as ShotMesh
    from beam_warp.stages import Stage as Stage
    from beam_warp.surfaces import SurfaceNormals as SurfaceNormals
    from beam_warp.surfaces import estimate_normals as estimate_normals
    from beam_warp.tracing import visibility as visibility
    from beam_warp.tracking import TrackOptions as TrackOptions

_HOMES = {
    "SpotLight": "lights",
    "PointLight": "lights",
    "DirectionalLight": "lights",
    "RenderedImage": "shots",
    "ShotMesh": "shots",
    "Shot": "shots",
    "PathRenderer": "path_rendering",
    "PathOptions": "path_rendering",
    "DeferredRenderer": "deferred_rendering",
    "DeferredOptions": "deferred_options",
    "Adam": "adam",
    "AmbientOcclusion": "lighting",
    "BeamError": "errors",
    "Camera": "cameras",
    "Capture": "captures",
    "CapturedView": "captured_views",
    "DepthNormals": "depth_normals",
    "EnvironmentMap": "environments",
    "FitAndTrack": "reconstruction_steps",
    "FitOptions": "gaussian_fitting",
    "GBuffer": "rasterizing",
    "GaussianArrays": "raster_records",
    "GaussianCloud": "assets",
    "GaussianSequence": "assets",
    "Irradiance": "incident_light",
    "L1Loss": "image_losses",
    "ImagePathOptions": "image_path",
    "MaterialOptions": "materials",
    "score_materials": "material_scores",
    "NormalLoss": "image_losses",
    "Observability": "assets",
    "Parameters": "adam",
    "RasterOptions": "raster_records",
    "Rasterizer": "rasterizer",
    "ReconstructOptions": "reconstruction",
    "Reconstruction": "reconstruction",
    "RunOptions": "pipeline",
    "RunResult": "pipeline",
    "Scene": "scene",
    "SsimLoss": "image_losses",
    "Stage": "stages",
    "SurfaceHits": "surface_tracing",
    "SurfaceNormals": "surfaces",
    "TraceOptions": "tracing",
    "TrackOptions": "tracking",
    "ambient_occlusion": "lighting",
    "change_axes": "axes",
    "closest_surface": "surface_tracing",
    "estimate_normals": "surfaces",
    "fit_gaussians": "gaussian_fitting",
    "initial_gaussians": "initialization",
    "irradiance": "incident_light",
    "mesh_of_gaussians": "meshing",
    "rasterize": "rasterizing",
    "rasterize_backward": "rasterizing",
    "read": "converters",
    "reconstruct": "reconstruction",
    "run": "pipeline",
    "validate": "schema.validator",
    "visibility": "tracing",
    "visibility_gradients": "gradients",
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
