"""Offline rendering: path tracing of Gaussians and meshes, progressive, adaptive, and resumable.

Radiance of a pixel is the mean over paths from points spread evenly over its square. A camera's ray meets Gaussians in
order, layer by layer; surfaces scatter by `beam_warp.kernels.light.scattering`, the BSDF of the deferred renderer;
light comes from the environment and from lights, directly and by up to ``bounces`` other surfaces, through whatever is
in the way. Nothing is clamped: the estimate is unbiased for this model of the scene, but for the stop of transmittance
at 1e-4, and, with a target error, for the little that stopping where the noise looks small does.
"""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from beam_warp.checks import require_choice, require_count, require_number
from beam_warp.device.arrays import members, resolve_device, upload, zero_struct
from beam_warp.errors import AssetFormatError
from beam_warp.image.files import replacing
from beam_warp.kernels.render.path_tracing import PathImages, PathLight, PathPass, launch_trace_paths
from beam_warp.kernels.render.path_vertices import PathMaterials
from beam_warp.light.ggx import specular_albedo_table
from beam_warp.light.prepared import PreparedEnvironments
from beam_warp.light.uploaded import upload_lights
from beam_warp.trace.camera_rays import pixel_rays
from beam_warp.trace.denoise import DENOISERS, Denoiser, NoisyImage, SurfaceGuides, chosen_denoiser, denoise
from beam_warp.trace.mesh_paths import mesh_surface
from beam_warp.trace.scene import NOTHING, Scene
from beam_warp.trace.transmittance import EXACT
from beam_warp.world.gaussians import GaussianCloud
from beam_warp.world.mesh import MaterialMesh
from beam_warp.world.quaternions import rotation_matrices
from beam_warp.world.shot import RenderedImage, Shot, ShotMesh

PASS_SAMPLES = 16
"""Samples of a pixel between two looks at its noise; fewer where there are too few in all for `FEWEST_PASSES`."""

FEWEST_PASSES = 4
"""Passes before a pixel's noise is believed: fewer miss what is rare."""

NOISE_BLOCK = 8
"""Pixels are stopped in squares of this side, when the noisiest of a square is good enough: one alone may look good by
chance."""

WARP_TILE = (8, 4)
"""Columns and rows of pixels that the threads of a warp trace."""

DARKEST = 1e-3
"""Luminance that darker pixels are taken to have where their noise is judged:
the slope of the square root has no bound at black."""

CHECKPOINT_SECONDS = 10.0
"""Time between two checkpoints."""

NO_TRIANGLES = MaterialMesh(
    vertices=np.zeros((3, 3), np.float32),
    faces=np.array([[0, 1, 2]], np.int32),
    normals=np.eye(3, dtype=np.float32),
    base_color=np.zeros((3, 3), np.float32),
    roughness=np.ones(3, np.float32),
)
"""A mesh that no ray meets: with it kernels need no case for a shot without one."""

SamplesReport = Callable[[int, int], None]
"""Called with (samples per pixel done, samples per pixel at most)."""


@dataclass(frozen=True, kw_only=True)
class PathOptions:
    """How paths are traced.

    Attributes:
        samples: Paths per pixel, at most if there is a target error; a power of two is best.
        bounces: How often light may go from surface to surface before it reaches the one that is seen; 0 is direct
            light.
        target_error: Standard error of the square root of a pixel's luminance, about its display value, at which it is
            done; 0.004 is a step of eight bits. None for ``samples`` everywhere.
        denoiser: What takes the noise off the finished image: ``"none"``, ``"auto"``, ``"oidn"`` or ``"bilateral"``.
        seed: Same seed, same device, same bits.

    Raises:
        InvalidOptionError: An option is out of range.
        MissingPackageError: The denoiser is not installed.
    """

    samples: int = 64
    bounces: int = 4
    target_error: float | None = None
    denoiser: Denoiser = "none"
    seed: int = 0

    def __post_init__(self) -> None:
        """Check every option once."""
        require_count("samples", self.samples, 1, 2**20)
        require_count("bounces", self.bounces, 0, 64)
        if self.target_error is not None:
            require_number("target_error", self.target_error, 1e-6, 1.0)
        require_choice("denoiser", self.denoiser, DENOISERS)
        if self.denoiser != "none":
            chosen_denoiser(self.denoiser)
        require_count("seed", self.seed, 0, 2**32 - 1)


class PathRenderer:
    """Path traces shots, a `beam_warp.world.shot.Renderer`. What two shots share is prepared once."""

    def __init__(self, options: PathOptions | None = None, *, device: str | None = None) -> None:
        """Choose the device.

        Args:
            options: How paths are traced; None for the defaults.
            device: ``"cpu"``, ``"cuda:0"``, …; None takes the first CUDA device, or the CPU where there is none.

        Raises:
            DeviceError: There is no such device.
        """
        self.options = options or PathOptions()
        self.device = resolve_device(device)
        self._geometry: _Geometry | None = None
        self._environments = PreparedEnvironments(self.device)
        self._albedo_table = upload(specular_albedo_table(), wp.vec2, self.device)

    def start(self, shot: Shot) -> PathProgress:
        """Prepare a shot; nothing is traced yet."""
        held = self._geometry
        if held is None or held.cloud is not shot.cloud or held.mesh is not shot.mesh:
            self._geometry = held = _Geometry.of(shot.cloud, shot.mesh, self.device)
        return PathProgress(shot, self.options, held, self._light(shot, held))

    def draw(self, shot: Shot, *, checkpoint: Path | None = None, report: SamplesReport | None = None) -> RenderedImage:
        """Render a shot.

        Args:
            shot: What to render.
            checkpoint: Where to keep what is done, so that a render that was interrupted goes on from there and ends
                with the same bits; removed at the end. What was kept of something else is written over.
            report: Told how far it is.

        Raises:
            OutputError: The checkpoint cannot be written.
        """
        progress = self.start(shot)
        if checkpoint is not None:
            progress.resume(checkpoint)
        saved = time.monotonic()
        try:
            while not progress.done:
                progress.advance()
                if report is not None:
                    report(progress.sample_count, self.options.samples)
                if checkpoint is not None and time.monotonic() - saved > CHECKPOINT_SECONDS:
                    progress.save(checkpoint)
                    saved = time.monotonic()
        except KeyboardInterrupt:
            if checkpoint is not None:
                progress.save(checkpoint)
            raise
        image = progress.image(denoiser=self.options.denoiser)
        if checkpoint is not None:
            checkpoint.unlink(missing_ok=True)
        return image

    def _light(self, shot: Shot, geometry: _Geometry) -> PathLight:
        """Bring environment and lights to the device."""
        light = PathLight()
        shown = self._environments.of(shot.environment)
        light.environment = shown.product_tree
        light.has_environment = int(bool(shown.environment.radiance.any()))
        turn = np.radians(shot.environment_rotation)
        light.turn = wp.vec2(float(np.cos(turn)), float(np.sin(turn)))
        light.lights = upload_lights(shot.lights, self.device, geometry.scene.origin)
        light.albedo_table = self._albedo_table
        return light


@dataclass(frozen=True, eq=False)
class _Geometry:
    """Everything that paths can meet, on a device."""

    cloud: GaussianCloud
    mesh: ShotMesh | None
    scene: Scene
    materials: PathMaterials

    @classmethod
    def of(cls, cloud: GaussianCloud, mesh: ShotMesh | None, device: Any) -> _Geometry:
        """Build the hierarchies and pack materials."""
        triangles = None
        if mesh is not None:
            triangles = SimpleNamespace(vertices=mesh.surface.vertices, faces=mesh.surface.faces)
        scene = Scene.from_gaussians(cloud, str(device), mesh=triangles)
        materials = PathMaterials()
        materials.color_roughness, materials.normal_thickness = _material_rows(cloud, device)
        sizes = np.median(cloud.scales, axis=1) if len(cloud) else np.ones(len(NOTHING))
        materials.sizes = upload(sizes.astype(np.float32), float, device)
        surface = mesh_surface(NO_TRIANGLES if mesh is None else mesh.surface, device, scene.origin)
        if scene.mesh is not None:
            surface.mesh = scene.mesh.id
        materials.surface = surface
        catches = np.zeros(1, np.int32) if mesh is None else mesh.catches_shadows.astype(np.int32)
        materials.catches = upload(catches, int, device)
        return cls(cloud, mesh, scene, materials)


def _material_rows(cloud: GaussianCloud, device: Any) -> tuple[wp.array, wp.array]:
    """Return base colour and roughness, and normals and the standard deviation along them."""
    if not len(cloud):
        nothing = wp.zeros(len(NOTHING), dtype=wp.vec4, device=device)
        return nothing, nothing
    assert cloud.base_color is not None
    assert cloud.roughness is not None
    assert cloud.normals is not None
    looks = np.concatenate([cloud.base_color, cloud.roughness[:, None]], axis=1)
    along = np.einsum("nij,ni->nj", rotation_matrices(cloud.orientations), cloud.normals) * cloud.scales
    shapes = np.concatenate([cloud.normals, np.linalg.norm(along, axis=1, keepdims=True)], axis=1)
    return upload(looks.astype(np.float32), wp.vec4, device), upload(shapes.astype(np.float32), wp.vec4, device)


class PathProgress:
    """A shot that is being path traced.

    Attributes:
        shot: What is rendered.
        options: How.
        sample_count: Samples of the pixels that are still traced.
        done: Whether every pixel has its samples, or its target error.
    """

    def __init__(self, shot: Shot, options: PathOptions, geometry: _Geometry, light: PathLight) -> None:
        """Start with no samples; `PathRenderer.start` calls this."""
        self.shot, self.options = shot, options
        self.sample_count = 0
        self._geometry, self._light = geometry, light
        self._device = geometry.scene.device
        self._rays = pixel_rays(shot.camera, geometry.scene.origin)
        pixel_count = shot.camera.width * shot.camera.height
        self._images = zero_struct(PathImages, pixel_count, self._device)
        self._pixels = upload(_tiled(shot.camera.width, shot.camera.height), int, self._device)

    def only(self, pixels: NDArray[np.integer[Any]]) -> None:
        """Trace some pixels alone, by their numbers row by row; the others stay black."""
        self._pixels = upload(np.asarray(pixels, np.int32), int, self._device)

    @property
    def done(self) -> bool:
        """Whether every pixel has its samples, or its target error."""
        return not len(self._pixels) or self.sample_count >= self.options.samples

    def advance(self, samples: int | None = None) -> None:
        """Add samples to every pixel that is not done; beyond ``options.samples`` there are none to add."""
        usual = max(1, min(PASS_SAMPLES, self.options.samples // FEWEST_PASSES))
        wanted = usual if samples is None else require_count("samples", samples)
        samples = min(wanted, self.options.samples - self.sample_count)
        if self.done:
            return
        tracing = PathPass()
        tracing.seed, tracing.samples, tracing.bounces = self.options.seed, samples, self.options.bounces
        launch_trace_paths(
            len(self._pixels),
            self._geometry.scene.occluders,
            self._geometry.materials,
            EXACT.settings(self._geometry.scene),
            self._light,
            self._rays,
            self._pixels,
            tracing,
            self._images,
            self._device,
        )
        self.sample_count += samples
        if self.options.target_error is not None:
            self._keep_noisy(self.options.target_error)

    def image(self, *, denoiser: Denoiser = "none") -> RenderedImage:
        """Return the image of the samples so far.

        Args:
            denoiser: What takes noise off the radiance, one of `beam_warp.trace.denoise.DENOISERS`.

        Returns:
            The image; besides the layers of every renderer it has ``indirect`` (the part of ``rgb`` that came by way of
            another surface, with its noise), ``standard_error`` (of luminance) and ``samples``.
        """
        camera = self.shot.camera
        shape = (camera.height, camera.width)
        sums = {name: rows.numpy() for name, rows in members(self._images).items()}
        count = np.maximum(sums["counts"], 1).astype(np.float32)
        coverage = np.maximum(sums["coverage"], 1.0)
        caught, open_light, shadowed = sums["caught"].T
        missing = 1.0 - np.divide(shadowed, open_light, out=np.ones_like(shadowed), where=open_light > 0.0)
        layers = {
            "base_color": sums["base_color"] / coverage[:, None],
            "roughness": sums["roughness"] / coverage,
            "normals": _unit(sums["normals"]),
            "depth": sums["distance"] / coverage,
            "indirect": sums["indirect"] / count[:, None],
            "standard_error": _standard_error(sums["moments"], sums["passes"]),
            "samples": sums["counts"].astype(np.float32),
        }
        rgb = sums["radiance"] / count[:, None]
        if denoiser != "none":
            rgb = self._denoised(rgb, layers, denoiser)
        alpha = np.clip((sums["coverage"] + caught * np.clip(missing, 0.0, 1.0)) / count, 0.0, 1.0)
        return RenderedImage(
            rgb.reshape(*shape, 3),
            alpha.reshape(shape),
            {name: layer.reshape(*shape, *layer.shape[1:]) for name, layer in layers.items()},
        )

    def save(self, path: Path) -> None:
        """Write what is done to a file, in one step.

        Raises:
            OutputError: The file cannot be written.
        """
        arrays = {name: rows.numpy() for name, rows in members(self._images).items()}
        with replacing(path) as temporary, temporary.open("wb") as file:
            np.savez(file, digest=self.digest(), sample_count=self.sample_count, pixels=self._pixels.numpy(), **arrays)

    def resume(self, path: Path) -> bool:
        """Go on from what `save` wrote, if it is of this very shot and these options; tell whether it was."""
        try:
            with np.load(path, allow_pickle=False) as kept:
                if str(kept["digest"]) != self.digest():
                    return False
                for name, rows in members(self._images).items():
                    rows.assign(kept[name])
                self._pixels = upload(kept["pixels"], int, self._device)
                self.sample_count = int(kept["sample_count"])
        except FileNotFoundError:
            return False
        except (OSError, ValueError, KeyError) as error:
            raise AssetFormatError(
                f"checkpoint must be one that a render left, got {path} ({error}). Delete it to start again."
            ) from error
        return True

    def digest(self) -> str:
        """Return a hash of everything that decides the image."""
        shot, hasher = self.shot, hashlib.blake2b(digest_size=16)
        options = asdict(self.options) | {"denoiser": None}
        facts = [options, shot.lights, shot.environment_rotation, str(self._device), vars(shot.camera)]
        hasher.update(repr(facts).encode())
        arrays = dict(shot.cloud.arrays())
        if shot.environment is not None:
            arrays["environment"] = shot.environment.radiance
        if shot.mesh is not None:
            arrays |= vars(shot.mesh.surface) | {"catches_shadows": shot.mesh.catches_shadows}
        for name, array in sorted(arrays.items()):
            hasher.update(f"{name} {array.shape} {array.dtype}".encode())
            hasher.update(np.ascontiguousarray(array).data)
        return hasher.hexdigest()

    def _keep_noisy(self, target: float) -> None:
        """Leave out the pixels of squares in which all are good enough."""
        passes = self._images.passes.numpy()
        if passes.max(initial=0) < FEWEST_PASSES:
            return
        moments = self._images.moments.numpy()
        luminance = moments[:, 0] / np.maximum(passes, 1)
        error = _standard_error(moments, passes) / (2.0 * np.sqrt(np.maximum(luminance, DARKEST)))
        camera = self.shot.camera
        rows, columns = -(-camera.height // NOISE_BLOCK), -(-camera.width // NOISE_BLOCK)
        padded = np.zeros((rows * NOISE_BLOCK, columns * NOISE_BLOCK), np.float32)
        padded[: camera.height, : camera.width] = error.reshape(camera.height, camera.width)
        worst = padded.reshape(rows, NOISE_BLOCK, columns, NOISE_BLOCK).max(axis=(1, 3))
        noisy = ~(worst <= target)
        everywhere = noisy.repeat(NOISE_BLOCK, 0).repeat(NOISE_BLOCK, 1)[: camera.height, : camera.width].reshape(-1)
        pixels = self._pixels.numpy()
        self._pixels = upload(pixels[everywhere[pixels]], int, self._device)

    def _denoised(
        self, rgb: NDArray[np.float32], layers: dict[str, NDArray[np.float32]], denoiser: Denoiser
    ) -> NDArray[np.float32]:
        """Take noise off what arrives, radiance over base colour: texture is known without noise and stays sharp."""
        color = np.maximum(layers["base_color"], 0.05)
        error = layers["standard_error"] / color.mean(axis=1)
        noisy = NoisyImage(
            upload((rgb / color).astype(np.float32), wp.vec3, self._device),
            upload(error.astype(np.float32), float, self._device),
            True,
        )
        guides = SurfaceGuides(
            self.shot.camera,
            upload(layers["normals"], wp.vec3, self._device),
            upload(layers["depth"], float, self._device),
        )
        return denoise([noisy], guides, denoiser=denoiser)[0].numpy() * color


def _tiled(width: int, height: int) -> NDArray[np.int32]:
    """Return the numbers of all pixels, tile by tile: neighbours in the list meet the same Gaussians."""
    row, column = np.divmod(np.arange(width * height, dtype=np.int64), width)
    across, down = WARP_TILE
    order = ((row // down) * (-(-width // across)) + column // across) * (across * down)
    order += (row % down) * across + column % across
    return np.argsort(order, kind="stable").astype(np.int32)


def _standard_error(moments: NDArray[np.float32], passes: NDArray[np.int32]) -> NDArray[np.float32]:
    """Return the standard error of luminance from the spread of passes; 0 for fewer than two.

    The passes of a pixel are parts of one low-discrepancy set, which are better together than independent ones: it errs
    on the large side.
    """
    count = np.maximum(passes, 1).astype(np.float64)
    mean, squares = (moments / count[:, None]).T.astype(np.float64)
    variance = np.maximum(squares - mean * mean, 0.0) / np.maximum(count - 1.0, 1.0)
    return np.where(passes > 1, np.sqrt(variance), 0.0).astype(np.float32)


def _unit(vectors: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return vectors of length 1, or 0 where there is none."""
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.divide(vectors, length, out=np.zeros_like(vectors), where=length > 0.0)
