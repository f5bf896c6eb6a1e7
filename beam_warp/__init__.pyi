# The table of public names: `__init__.py` resolves them lazily from here, and type checkers read the same lines.
from ._version import __version__ as __version__
from .capture.capture import Capture as Capture
from .converters import read as read  # pyright: ignore[reportMissingImports]  (mapped folder)
from .converters import write as write  # pyright: ignore[reportMissingImports]  (mapped folder)
from .decomposition.job import run as run
from .decomposition.options import RunOptions as RunOptions
from .errors import BeamError as BeamError
from .raster.gbuffer import rasterize as rasterize
from .reconstruction.job import ReconstructOptions as ReconstructOptions
from .reconstruction.job import reconstruct as reconstruct
from .render.deferred import DeferredRenderer as DeferredRenderer
from .render.options import DeferredOptions as DeferredOptions
from .render.path import PathOptions as PathOptions
from .render.path import PathRenderer as PathRenderer
from .schema.validation.validator import validate as validate  # pyright: ignore[reportMissingImports]  (mapped folder)
from .stage.stage import Stage as Stage
from .trace.incident import irradiance as irradiance
from .trace.occlusion import ambient_occlusion as ambient_occlusion
from .trace.scene import Scene as Scene
from .trace.transmittance import visibility as visibility
from .world.camera import Camera as Camera
from .world.environment import EnvironmentMap as EnvironmentMap
from .world.gaussians import GaussianCloud as GaussianCloud
from .world.gaussians import GaussianSequence as GaussianSequence
from .world.lights import DirectionalLight as DirectionalLight
from .world.lights import PointLight as PointLight
from .world.lights import SpotLight as SpotLight
from .world.shot import Shot as Shot
