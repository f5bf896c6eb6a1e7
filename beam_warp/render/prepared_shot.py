"""One shot on a device, made ready to be lit and drawn again and again by deferred shading."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from beam_warp.device.arrays import upload
from beam_warp.device.graphs import StepGraphs
from beam_warp.errors import InvalidOptionError
from beam_warp.image.metrics import block_means
from beam_warp.kernels.raster.project import RasterView
from beam_warp.kernels.render.deferred_mesh import launch_blend_mesh, launch_shade_mesh
from beam_warp.kernels.render.deferred_pixels import launch_average_samples, launch_shade_gaussians
from beam_warp.light.prepared import PreparedEnvironments
from beam_warp.raster.layout import ViewLayout
from beam_warp.raster.rasterizer import Rasterizer
from beam_warp.raster.records import GaussianArrays, RasterOptions
from beam_warp.render.arriving import ArrivingLight
from beam_warp.render.options import DeferredOptions
from beam_warp.render.shadow_maps import ShadowCasters
from beam_warp.trace.mesh_paths import TracedMesh
from beam_warp.world.camera import Camera
from beam_warp.world.gaussians import GaussianCloud
from beam_warp.world.shot import RenderedImage, Shot, ShotMesh

MATERIAL_COLUMNS = {
    "base_color": slice(0, 3),
    "roughness": slice(3, 4),
    "ambient_occlusion": slice(4, 5),
    "normals": slice(5, 8),
}
"""Where materials are among a Gaussian's values."""

SURFACE_COLUMNS = {"base_color": slice(0, 3), "roughness": slice(3, 4), "normals": slice(4, 7), "depth": slice(7, 8)}
"""Where they are in what is known of a pixel's triangle."""


class DeferredFrame:
    """A shot on a device: `set` changes what is shown, `draw` or `launch` draws it, `image` brings it back.

    All arrays stay where they are for as long as shots fit. `draw` draws the shadow maps that are out of date and the
    view, and waits for the device to learn how much room they take. `launch` and `launch_view` are one CUDA graph each,
    recorded at their first call: they allocate nothing and wait for nothing. They must follow a `draw`; splats beyond
    1.25 times the room that it took are left out.

    Whoever moves Gaussians on the device writes into `gaussians` and calls `launch`; shadow maps then look at where the
    subject was when it was last `set`, and its sphere there has 6 % of room.

    Attributes:
        gaussians: What is drawn: arrays on the device. Values are base colour, roughness, ambient occlusion and normal,
            and, unless neither environment shadows nor bounces are wanted, what arrives [W/m^2] and the share of the
            environment that does, found by `draw` and `launch`.
        samples: Radiance multiplied by alpha, and alpha, of every sample of the image, row by row, vec4 on the device.
        pixels: The same for pixels, their means; ``samples`` itself for one sample a pixel.
    """

    def __init__(
        self,
        shot: Shot,
        options: DeferredOptions,
        raster: RasterOptions,
        environments: PreparedEnvironments,
        device: Any,
    ) -> None:
        """Allocate for shots of as many Gaussians and pixels, and `set` this one."""
        self._options, self._device = options, device
        self._graphs = StepGraphs(device)
        self._beside = wp.Stream(device) if device.is_cuda else None
        self._recorded: Any = None
        self._count = len(shot.cloud)
        self._size = (shot.camera.width, shot.camera.height)
        self._cloud: GaussianCloud | None = None
        self._casters = ShadowCasters(np.zeros(3), 1.0)
        self._mesh: ShotMesh | None = None
        self._traced: TracedMesh | None = None
        self._light = ArrivingLight(self._count, options, environments, device)
        camera = shot.camera.supersampled(options.samples)
        value_count = 12 if options.lights_gaussians else 8
        self._rasterizer = Rasterizer(self._count, [camera], value_count=value_count, options=raster, device=device)
        with wp.ScopedDevice(device):
            self.gaussians = GaussianArrays(
                wp.zeros(self._count, dtype=wp.vec3),
                wp.zeros(self._count, dtype=wp.quat),
                wp.zeros(self._count, dtype=wp.vec3),
                wp.zeros(self._count, dtype=float),
                wp.zeros((self._count, value_count), dtype=float),
            )
            self._views = wp.array(ViewLayout.of([camera]).views, dtype=RasterView)
            self.samples = wp.zeros(camera.width * camera.height, dtype=wp.vec4)
            self.pixels = self.samples
            if options.samples > 1:
                self.pixels = wp.zeros(self._size[0] * self._size[1], dtype=wp.vec4)
            self._mesh_image = wp.zeros(0, dtype=wp.vec4)
            self._mesh_surfaces = wp.zeros((0, 8), dtype=float)
            self._catches = wp.zeros(0, dtype=wp.bool)
        self.set(shot)

    def fits(self, shot: Shot) -> bool:
        """Tell whether `set` takes a shot: one of as many Gaussians and pixels."""
        return len(shot.cloud) == self._count and (shot.camera.width, shot.camera.height) == self._size

    def set(self, shot: Shot) -> None:
        """Upload what differs from the shot before; records and maps that are the same objects are not looked at again.

        Raises:
            InvalidOptionError: The shot does not fit.
        """
        if not self.fits(shot):
            raise InvalidOptionError(
                f"shot must have {self._count} Gaussians and {self._size[0]} x {self._size[1]} pixels, got "
                f"{len(shot.cloud)} and {shot.camera.width} x {shot.camera.height}. Make another frame."
            )
        self._set_camera(shot.camera)
        moved = shot.cloud is not self._cloud or shot.mesh is not self._mesh
        self._set_mesh(shot.mesh)
        if moved:
            self._casters = ShadowCasters.of(shot.cloud, None if shot.mesh is None else shot.mesh.surface.vertices)
        self._set_cloud(shot.cloud)
        self._light.set(shot.environment, shot.environment_rotation, shot.lights, self._casters, moved=moved)

    def _set_camera(self, camera: Camera) -> None:
        """Move the camera."""
        prepared = self._rasterizer.prepare_cameras([camera.supersampled(self._options.samples)])
        self._rasterizer.set_cameras(prepared)
        wp.copy(self._views, prepared.views)

    def _set_mesh(self, mesh: ShotMesh | None) -> None:
        """Upload triangles."""
        if mesh is self._mesh:
            return
        self._mesh, self._traced = mesh, None
        self._graphs.clear()
        if mesh is not None:
            self._traced = TracedMesh.from_mesh(mesh.surface, device=str(self._device))
            self._catches = upload(mesh.catches_shadows, wp.bool, self._device)
            if not len(self._mesh_image):
                self._mesh_image = wp.zeros(len(self.samples), dtype=wp.vec4, device=self._device)
                self._mesh_surfaces = wp.zeros((len(self.samples), 8), dtype=float, device=self._device)

    def _set_cloud(self, cloud: GaussianCloud) -> None:
        """Upload Gaussians."""
        if cloud is self._cloud:
            return
        self._cloud = cloud
        if not self._count:
            return
        arrays = self.gaussians
        for name in ("positions", "orientations", "scales", "opacities"):
            getattr(arrays, name).assign(getattr(cloud, name))
        values = np.zeros(arrays.values.shape, np.float32)  # type: ignore[union-attr]
        for name, columns in MATERIAL_COLUMNS.items():
            values[:, columns] = getattr(cloud, name).reshape(self._count, -1)
        arrays.values.assign(values)  # type: ignore[union-attr]
        self._light.order(arrays.positions)

    def draw(self) -> None:
        """Draw the shadow maps that are out of date, and the view, however much room they take."""
        self._light.draw(self.gaussians, None if self._traced is None else self._traced.surface)
        self._rasterizer.draw(self.gaussians)
        self._shade()

    def launch(self) -> None:
        """Draw all shadow maps and the view again, without waiting."""
        self._forget_old_graphs()
        self._graphs.run("all", self._redraw)

    def launch_view(self) -> None:
        """Draw the view again, without waiting; shadow maps and what arrives stay as they are."""
        self._forget_old_graphs()
        self._graphs.run("view", self._redraw_view)

    def _forget_old_graphs(self) -> None:
        """Record again if launches would be given something else than was recorded."""
        given = (self._light.generation, self._light.capacities, self._rasterizer.pair_capacity)
        if given != self._recorded:
            self._graphs.clear()
            self._recorded = given

    def _redraw(self) -> None:
        """Take every step of a frame; the view's splats are listed beside the shadow maps: neither fills a GPU."""
        with wp.ScopedStream(self._beside):
            self._rasterizer.relist()
        self._light.redraw(self.gaussians)
        if self._beside is not None:
            wp.wait_stream(self._beside)
        self._rasterizer.redraw_values()
        self._shade()

    def _redraw_view(self) -> None:
        """Take the steps that depend on the camera."""
        self._rasterizer.redraw()
        self._shade()

    def _shade(self) -> None:
        """Light what was drawn."""
        light, images = self._light.scene_light(), self._rasterizer.images
        launch_shade_gaussians(self._views, images, self._options.lights_gaussians, light, self.samples, self._device)
        if self._traced is not None:
            seen, count = (self._mesh_image, self._mesh_surfaces), len(self.samples)
            launch_shade_mesh(count, self._views, self._traced.surface, self._catches, light, *seen, self._device)
            launch_blend_mesh(count, images.depth, *seen, self.samples, self._device)
        if self.pixels is not self.samples:
            side, count = self._options.samples, len(self.pixels)
            launch_average_samples(count, self._size[0], side, self.samples, self.pixels, self._device)

    def image(self) -> RenderedImage:
        """Return what was drawn last; waits for the device."""
        width, height = self._size
        pixels = self.pixels.numpy().reshape(height, width, 4)
        rgb, alpha = np.ascontiguousarray(pixels[..., :3]), np.clip(pixels[..., 3], 0.0, 1.0)
        return RenderedImage(rgb, alpha, self._layers() if self._options.layers else {})

    def _layers(self) -> dict[str, NDArray[np.float32]]:
        """Return the layers that are wanted: means over what surfaces cover."""
        side = self._options.samples
        shape = (self._size[1] * side, self._size[0] * side)
        images = self._rasterizer.images
        coverage = np.minimum(images.alpha.numpy(), 1.0).reshape(*shape, 1)
        depth = images.depth.numpy().reshape(*shape, 1)
        sums = images.channels[0].numpy().reshape(*shape, -1)[..., :8]
        sums = {name: sums[..., columns] for name, columns in MATERIAL_COLUMNS.items()} | {"depth": depth * coverage}
        if self._traced is not None:
            surfaces = self._mesh_surfaces.numpy().reshape(*shape, 8)
            behind = surfaces[..., 7:]
            seen = np.where((behind > 0.0) & (coverage > 0.0) & (depth <= behind), 1.0 - coverage, behind > 0.0)
            in_front = (behind > 0.0) & ~((coverage > 0.0) & (depth <= behind))
            coverage = np.where(in_front, 0.0, coverage)
            for name, values in sums.items():
                here = surfaces[..., SURFACE_COLUMNS[name]] if name in SURFACE_COLUMNS else np.ones_like(seen)
                sums[name] = np.where(in_front, 0.0, values) + seen * here
            coverage = coverage + seen
        weight = block_means(coverage, side)
        layers = {}
        for name in self._options.layers:
            total = block_means(sums[name], side)
            length = np.linalg.norm(total, axis=-1, keepdims=True) if name == "normals" else weight
            mean = np.divide(total, length, out=np.zeros_like(total), where=length > 0.0).astype(np.float32)
            layers[name] = mean[..., 0] if mean.shape[-1] == 1 else mean
        return layers
