"""Shadow maps of Gaussians and meshes: from where they are drawn, and what draws them again and again.

Where views stand: a directional light's is a pinhole `FAR` radii of the subject away, so that directions are off by at
most 1/`FAR` rad (0.12 degrees at the subject's rim, less than half the sun's diameter); a spot's is at the light and
sees the smaller of its cone and the subject; a point light's likewise, or, from inside or near, six views see all
around. What lies outside of a map is not shadowed by it.

Bias: a comparison is with the receiver's tangent plane at each texel, begins half a texel (plus half of what the plane
rises within a texel) and the Gaussians' thickness before it, and is full at twice that. Shadows of what is nearer than
that to its receiver are missing: half a texel is 0.8 mm for a subject of 1.7 m in a map of 1024, the thickness the
median over the Gaussians of the middle one of their three scales, at most 2 % of the subject's radius.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import ArrayLike, NDArray

from beam_warp.device.arrays import upload
from beam_warp.kernels.raster.project import RasterView
from beam_warp.kernels.render.shadow_maps import ShadowMaps, launch_cast_mesh, launch_gather_texels
from beam_warp.raster.layout import ViewLayout
from beam_warp.raster.rasterizer import Rasterizer
from beam_warp.raster.records import GaussianArrays, RasterOptions
from beam_warp.world.camera import Camera
from beam_warp.world.framing import bulk
from beam_warp.world.gaussians import GaussianCloud
from beam_warp.world.lights import DirectionalLight, Light, PointLight, SpotLight, light_entry

FAR = 500.0
"""How many radii away a distant light's view stands: directions are parallel to 1/500, depths fine to 6e-5 m."""

ROOM = 1.06
"""A map shows this much more than the subject's sphere: splats and kernels reach beyond centres."""

THICKEST = 0.02
"""Largest thickness of a layer, in radii of the subject: few large Gaussians are flat, not thick."""

NEARBY = 2.0
"""Props whose corners are within this many radii of the Gaussians are in the maps; a ground's are not, and it casts
shadows only where the maps see it."""

NEAR = 0.02
"""Depth before which a lamp's map shows nothing [m]."""

WIDEST = 60.0
"""Largest half angle of a single view [degree]: beyond it six views cost less than one with as many texels in its
middle."""

GROUP_SPLATS = 2**23
"""Most splats, Gaussians times views, drawn at a time unless one view has more: their pairs with tiles, about twice as
many, are then few enough to be drawn in one go, as CUDA graphs want it."""

LARGEST_KERNEL = 0.25
"""Largest radius of a filter, as a share of a map's side: half of the subject."""

FACE_ANGLE = 48.0
"""Half the angle that each of six views sees [degree]: 3 more than 45, so that kernels do not end at the edges."""


@dataclass(frozen=True)
class ShadowCasters:
    """The sphere around everything that casts shadows.

    Attributes:
        center: World position [m], ``(3,)``.
        radius: Radius of the sphere [m].
        thickness: Thickness of the layer of Gaussians that a surface is [m].
    """

    center: NDArray[np.float64]
    radius: float
    thickness: float = 0.0

    @classmethod
    def of(cls, cloud: GaussianCloud, vertices: NDArray[np.float32] | None = None) -> ShadowCasters:
        """Return the sphere around a cloud's bulk and what corners of triangles are near it; or around all corners."""
        corners = np.zeros((0, 3)) if vertices is None else np.asarray(vertices, np.float64)
        if not len(cloud):
            return cls(*_sphere(corners if len(corners) else np.zeros((1, 3))))
        points = bulk(cloud.positions, cloud.opacities)
        center, radius = _sphere(points)
        near = corners[np.linalg.norm(corners - center, axis=1) < NEARBY * radius]
        center, radius = _sphere(np.concatenate([points, near]))
        thickness = float(np.median(np.sort(cloud.scales, axis=1)[:, 1]))  # of a surface's discs, their radius
        return cls(center, radius, min(thickness, THICKEST * radius))


def _sphere(points: NDArray[np.float64]) -> tuple[NDArray[np.float64], float]:
    """Return the middle of the box around points, and how far they are from it; at least a millimetre."""
    center = 0.5 * (points.min(axis=0) + points.max(axis=0))
    return center, max(float(np.linalg.norm(points - center, axis=1).max()), 1e-3)


@dataclass(frozen=True, eq=False)
class ShadowView:
    """One map's view.

    Attributes:
        camera: The view, of a square image.
        radius: Radius of the light's disc at the camera's position [m].
        front: Depth before which nothing casts shadows [m].
    """

    camera: Camera
    radius: float
    front: float


def distant_view(direction: Any, half_angle: float, casters: ShadowCasters, size: int) -> ShadowView:
    """Return the view of a distant light.

    Args:
        direction: Unit vector to the light.
        half_angle: Half the angle that its disc takes up [rad].
        casters: What casts shadows.
        size: Texels of a side.
    """
    distance = FAR * casters.radius
    away = np.asarray(direction, np.float64)
    camera = _camera(casters.center + distance * away, -away, np.arcsin(min(ROOM / FAR, 1.0)), size)
    return ShadowView(camera, distance * float(np.tan(half_angle)), distance - ROOM * casters.radius)


def light_views(light: Light, casters: ShadowCasters, size: int) -> list[ShadowView]:
    """Return the views of a light's maps: one, or the six of a cube.

    Six are in the order of `beam_warp.kernels.render.shadow_maps.face_towards`.

    Raises:
        InvalidOptionError: ``light`` is of no type that lights have.
    """
    return light_entry(VIEWS, light)(light, casters, size)


def _directional_views(light: DirectionalLight, casters: ShadowCasters, size: int) -> list[ShadowView]:
    half = 0.5 * np.radians(light.angular_diameter)
    return [distant_view(-np.asarray(light.direction), half, casters, size)]


def _point_views(light: PointLight, casters: ShadowCasters, size: int) -> list[ShadowView]:
    return _lamp_views(light.position, light.radius, np.zeros(3), np.pi, casters, size=size)


def _spot_views(light: SpotLight, casters: ShadowCasters, size: int) -> list[ShadowView]:
    cone = float(np.radians(light.outer_angle))
    return _lamp_views(light.position, light.radius, np.asarray(light.direction), cone, casters, size=size)


VIEWS: Mapping[type[Light], Callable[[Any, ShadowCasters, int], list[ShadowView]]] = {
    DirectionalLight: _directional_views,
    PointLight: _point_views,
    SpotLight: _spot_views,
}
"""Where the shadow maps of each type of light look from."""


def _lamp_views(
    at: ArrayLike, radius: float, direction: NDArray[np.float64], cone: float, casters: ShadowCasters, *, size: int
) -> list[ShadowView]:
    """Return the views of a lamp that shines into a cone; they see the smaller of the cone and what casts shadows."""
    position = np.asarray(at, np.float64)
    axis = casters.center - position
    distance, extent = float(np.linalg.norm(axis)), ROOM * casters.radius
    half_angle = np.arcsin(extent / distance) if distance > extent else np.pi
    if cone < half_angle:
        axis, half_angle = direction, cone
    front = max(distance - extent, NEAR)
    if half_angle <= np.radians(WIDEST):
        return [ShadowView(_camera(position, axis, half_angle, size), radius, front)]
    faces = np.repeat(np.eye(3), 2, axis=0) * np.tile([1.0, -1.0], 3)[:, None]
    return [ShadowView(_camera(position, face, np.radians(FACE_ANGLE), size), radius, NEAR) for face in faces]


def _camera(eye: NDArray[np.float64], axis: NDArray[np.float64], half_angle: float, size: int) -> Camera:
    """Return a square camera; up is whichever axis of the world is least along the view."""
    up = np.eye(3)[int(np.argmin(np.abs(axis)))]
    return Camera.look_at(
        eye, eye + axis, up=up, width=size, height=size, vertical_fov=2.0 * float(np.degrees(half_angle))
    )


class ShadowDrawer:
    """Draws the maps of some views, all of one size, again and again.

    Attributes:
        maps: The maps as kernels take them: the same arrays for as long as the drawer lives.
        cameras: The views of the maps now.
    """

    def __init__(
        self,
        gaussian_count: int,
        views: Sequence[ShadowView],
        *,
        casters: ShadowCasters,
        taps: tuple[int, int],
        device: Any,
    ) -> None:
        """Allocate.

        Args:
            gaussian_count: Number of Gaussians that are drawn.
            views: Views of the maps, at least one.
            casters: What casts shadows.
            taps: How many look for what is in the way of a light of a size, and how many are then compared, each with
                four texels.
            device: Warp device.
        """
        self._device = device
        self.cameras = [view.camera for view in views]
        self._texels_of_view = self.cameras[0].width * self.cameras[0].height
        group = max(1, GROUP_SPLATS // max(gaussian_count, 1))
        self._groups = [range(k, min(k + group, len(views))) for k in range(0, len(views), group)]
        self._rasterizers: list[Rasterizer] = []
        for views_of_group in self._groups:
            self._rasterizers.append(
                Rasterizer(
                    gaussian_count,
                    [self.cameras[k] for k in views_of_group],
                    # Widened splats lose in height what they gain in area: small ones cast no wider shadows.
                    options=RasterOptions(antialiased=True, low_pass=0.1),
                    device=device,
                    images_of=self._rasterizers[0] if self._rasterizers else None,
                )
            )
        texel_count = self._texels_of_view * len(views)
        self._mesh_depth = wp.zeros(0, dtype=float, device=device)
        self._mesh: Any = None
        self.maps = ShadowMaps()
        self.maps.views = wp.array(ViewLayout.of(self.cameras).views, dtype=RasterView, device=device)
        self.maps.texels = wp.zeros(texel_count, dtype=wp.vec4, device=device)
        self.maps.radii = wp.zeros(len(views), dtype=float, device=device)
        self.maps.fronts = wp.zeros(len(views), dtype=float, device=device)
        self.maps.search_taps = upload(disc_taps(taps[0]), wp.vec2, device)
        self.maps.filter_taps = upload(disc_taps(taps[1]), wp.vec2, device)
        self.maps.largest_kernel = LARGEST_KERNEL * self.cameras[0].width
        self._set(views, casters)

    def move(self, views: Sequence[ShadowView], casters: ShadowCasters) -> None:
        """Draw from other views from now on; their number and size stay."""
        self.cameras = [view.camera for view in views]
        for rasterizer, group in zip(self._rasterizers, self._groups, strict=True):
            rasterizer.set_cameras([self.cameras[k] for k in group])
        self.maps.views.assign(wp.array(ViewLayout.of(self.cameras).views, dtype=RasterView, device=self._device))
        self._set(views, casters)

    def _set(self, views: Sequence[ShadowView], casters: ShadowCasters) -> None:
        """Bring what kernels know of lights to the device."""
        self.maps.radii.assign(np.array([view.radius for view in views], np.float32))
        self.maps.fronts.assign(np.array([view.front for view in views], np.float32))
        self.maps.thickness = casters.thickness

    @property
    def pair_capacities(self) -> tuple[int, ...]:
        """Room for pairs of splats and tiles; see `Rasterizer.pair_capacity`."""
        return tuple(rasterizer.pair_capacity for rasterizer in self._rasterizers)

    def draw(self, gaussians: GaussianArrays, mesh: Any = None) -> None:
        """Draw all maps, however much room they take.

        Args:
            gaussians: The Gaussians, on the device.
            mesh: A `beam_warp.kernels.mesh.surface.MeshSurface`, or None.
        """
        self._mesh = mesh
        depths = 0 if mesh is None else len(self.maps.texels)
        if len(self._mesh_depth) != depths:
            self._mesh_depth = wp.zeros(depths, dtype=float, device=self._device)
        self._cast()
        for rasterizer, group in zip(self._rasterizers, self._groups, strict=True):
            rasterizer.draw(gaussians)
            self._gather(rasterizer, group)

    def redraw(self) -> None:
        """Draw again what arrays and views have become, without waiting; see `Rasterizer.redraw`."""
        self._cast()
        for rasterizer, group in zip(self._rasterizers, self._groups, strict=True):
            rasterizer.redraw()
            self._gather(rasterizer, group)

    def _cast(self) -> None:
        """Find the triangles that maps see."""
        if self._mesh is not None:
            launch_cast_mesh(
                len(self._mesh_depth), self._mesh, self.maps.views, self._texels_of_view, self._mesh_depth, self._device
            )

    def _gather(self, rasterizer: Rasterizer, group: range) -> None:
        """Make texels of what was drawn."""
        texels = slice(group.start * self._texels_of_view, group.stop * self._texels_of_view)
        launch_gather_texels(
            rasterizer.images,
            self._mesh_depth[texels] if len(self._mesh_depth) else self._mesh_depth,
            self.maps.texels[texels],
            self._device,
        )


@cache
def disc_taps(count: int) -> NDArray[np.float32]:
    """Return points spread evenly over the unit disc, ``(count, 2)``: Vogel's spiral, the golden angle apart."""
    steps = np.arange(count)
    radius, angle = np.sqrt((steps + 0.5) / count), steps * np.pi * (3.0 - 5.0**0.5)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=-1).astype(np.float32)
