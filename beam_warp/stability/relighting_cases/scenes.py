"""Subjects, cameras and lights of the cases."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from beam_warp.world.camera import Camera
from beam_warp.world.environment import EnvironmentMap
from beam_warp.world.gaussians import GaussianCloud
from beam_warp.world.lights import SUN_DIAMETER, DirectionalLight
from beam_warp.world.mesh import MaterialMesh
from beam_warp.world.shapes import TiledSurface, rectangle, sphere_zone, tile
from beam_warp.world.shot import ShotMesh

RADIUS = 0.5
"""Radius of the ball [m]."""

FIREFLY = 5e4
"""Radiance of the one hot texel; others have `FIREFLY_SKY`."""

FIREFLY_SKY = 0.1

GRAZING = 10.0
ACNE = 3.0
"""Elevation of the sun over a floor with a wall, and over a bare one [degree]."""

WALL = (-0.5, 0.15, 0.4)
"""Where the wall stands along x, its height, and half its width [m]."""

FIELD = 1.8
"""Width of the floor that is seen from above [m]."""

THICKNESS = 0.02
"""Thickness of the wall [m]."""


@dataclass(frozen=True, eq=False)
class RelightStudio:
    """Makes the subjects.

    Attributes:
        size: Side of images [pixel]; of those of planes, which look everywhere alike, a quarter.
        spacing: Distance between the Gaussians on the floor and the ball [m].
        samples: Samples of a pixel that the path tracer takes: bounds of its noise depend on it.
    """

    size: int = 32
    spacing: float = 0.08
    samples: int = 64

    def plane(self, *, base_color: float = 1.0, roughness: float = 1.0, opacity: float = 0.99) -> GaussianCloud:
        """Return z = 0: one Gaussian, so wide that nothing of its rim is seen."""
        return relightable(sheet((0.0, 0.0, 0.0), 3.0, opacity), base_color, roughness)

    def ball(self, *, base_color: float = 1.0, roughness: float = 1.0, spacing: float | None = None) -> GaussianCloud:
        """Return a ball at the origin, tiled with flat Gaussians."""
        surface = sphere_zone(np.zeros(3), RADIUS, -1.0, 1.0, spacing or self.spacing)
        return relightable(tile((surface,)), base_color, roughness)

    def floor(self, wall: tuple[TiledSurface, ...] = ()) -> GaussianCloud:
        """Return a floor of 2 m, tiled with flat Gaussians, and a wall on it if one is given."""
        x, y, _ = np.eye(3)
        return relightable(tile((rectangle(np.zeros(3), x, y, self.spacing), *wall)), 0.8)

    def wall(self) -> tuple[TiledSurface, TiledSurface]:
        """Return both sides of the wall, the first towards the sun."""
        _, y, z = np.eye(3)
        place, height, half = WALL
        front = np.array([place - THICKNESS, 0.0, 0.5 * height])
        back = np.array([place, 0.0, 0.5 * height])
        spacing = 0.5 * self.spacing
        return (
            rectangle(front, half * -y, 0.5 * height * z, spacing),
            rectangle(back, half * y, 0.5 * height * z, spacing),
        )

    def at_plane(self, degrees: float = 45.0, *, fov: float = 2.0) -> Camera:
        """Return a camera that sees a spot of the plane, so many degrees from its normal."""
        side = max(self.size // 4, 4)
        angle = np.radians(degrees)
        eye = 2.0 * np.array([0.0, -np.sin(angle), np.cos(angle)])
        return Camera.look_at(eye, (0.0, 0.0, 0.0), width=side, height=side, vertical_fov=fov)

    def at_ball(self) -> Camera:
        """Return a camera that sees the ball from a little above."""
        return Camera.look_at((0.0, -2.6, 0.6), (0.0, 0.0, 0.0), width=self.size, height=self.size, vertical_fov=24.0)

    def from_above(self) -> Camera:
        """Return a camera that sees `FIELD` of the floor from 3 m above."""
        field = 2.0 * np.degrees(np.arctan(0.5 * FIELD / 3.0))
        side = self.size
        return Camera.look_at(
            (0.0, 0.0, 3.0), (0.0, 0.0, 0.0), up=(0.0, 1.0, 0.0), width=side, height=side, vertical_fov=field
        )


def sheet(middle: ArrayLike, size: float, opacity: float, *, up: bool = True) -> GaussianCloud:
    """Return one flat Gaussian that faces up or down."""
    return GaussianCloud(
        positions=np.asarray(middle, np.float32)[None],
        orientations=np.array([[0.0, 0.0, 0.0, 1.0]]),
        scales=np.array([[size, size, 1e-3 * size]]),
        opacities=np.array([opacity]),
        normals=np.array([[0.0, 0.0, 1.0 if up else -1.0]]),
    )


def relightable(cloud: GaussianCloud, base_color: float = 1.0, roughness: float = 1.0) -> GaussianCloud:
    """Return the cloud with one material."""
    count = len(cloud)
    return cloud.with_arrays(
        base_color=np.full((count, 3), base_color, np.float32),
        roughness=np.full(count, roughness, np.float32),
        ambient_occlusion=np.ones(count, np.float32),
    )


def nothing(studio: RelightStudio) -> GaussianCloud:
    """Return no Gaussians."""
    return studio.plane().select(np.zeros(0, np.int64))


def square(half: float, middle: ArrayLike = (0.0, 0.0, 0.0), *, catches: bool = False) -> ShotMesh:
    """Return a level square of two triangles, white."""
    corners = np.array([[-half, -half, 0.0], [half, -half, 0.0], [half, half, 0.0], [-half, half, 0.0]])
    surface = MaterialMesh(
        vertices=(corners + np.asarray(middle, np.float64)).astype(np.float32),
        faces=np.array([[0, 1, 2], [0, 2, 3]], np.int32),
        normals=np.tile(np.array([0.0, 0.0, 1.0], np.float32), (4, 1)),
        base_color=np.ones((4, 3), np.float32),
        roughness=np.ones(4, np.float32),
    )
    return ShotMesh(surface=surface, catches_shadows=np.full(2, catches))


def white(radiance: float = 1.0) -> EnvironmentMap:
    """Return even light."""
    return EnvironmentMap.constant((radiance, radiance, radiance))


def firefly() -> EnvironmentMap:
    """Return a dim sky with one texel of `FIREFLY`, 51 degrees from the zenith."""
    radiance = np.full((16, 32, 3), FIREFLY_SKY, np.float32)
    radiance[4, 9] = FIREFLY
    return EnvironmentMap(radiance)


def sun_at(degrees: float, irradiance: float = 3.0, *, diameter: float = SUN_DIAMETER) -> DirectionalLight:
    """Return a sun at -x, so many degrees above the floor."""
    angle = np.radians(degrees)
    return DirectionalLight(
        direction=(float(np.cos(angle)), 0.0, -float(np.sin(angle))),
        irradiance=(irradiance, irradiance, irradiance),
        angular_diameter=diameter,
    )
