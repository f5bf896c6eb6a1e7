"""A shot, which is everything that one image is rendered from, the rendered image, and the protocol of renderers."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from beam_warp.checks import require_array, require_number, require_same_length
from beam_warp.errors import InvalidArrayError, InvalidOptionError
from beam_warp.world.camera import Camera
from beam_warp.world.environment import EnvironmentMap
from beam_warp.world.gaussians import WORLD_AXES, GaussianCloud
from beam_warp.world.lights import LIGHT_TYPES, Light, unknown_light
from beam_warp.world.mesh import MaterialMesh


@dataclass(frozen=True, eq=False, kw_only=True)
class ShotMesh:
    """Triangles among the Gaussians: ground, walls, props; both sides are seen and lit.

    Attributes:
        surface: Triangles with materials, in the world; they need not be closed.
        catches_shadows: Faces that are not seen themselves, but the shadows on them, ``(F,)`` bool.

    Raises:
        InvalidArrayError: There is not one entry for each face.
    """

    surface: MaterialMesh
    catches_shadows: NDArray[np.bool_]

    def __post_init__(self) -> None:
        """Check the lengths."""
        flags = require_array("catches_shadows", self.catches_shadows, (None,), np.bool_)
        require_same_length("catches_shadows", flags, "faces", len(self.surface.faces))
        object.__setattr__(self, "catches_shadows", flags)


@dataclass(frozen=True, eq=False, kw_only=True)
class Shot:
    """One image to render.

    Attributes:
        cloud: Relightable Gaussians in the world's axes; none is fine.
        camera: Who looks.
        environment: Distant light; None for none. It is not seen behind things: see ``RenderedImage``.
        environment_rotation: Turns the environment about z, counter-clockwise from above [degree]. Renderers keep what
            they made ready of an environment for the next shot that has the same object, whatever its rotation.
        lights: Other lights; lamps themselves are not seen by the camera, but in reflections that are traced.
        mesh: Triangles; None for none.

    Raises:
        InvalidArrayError: The cloud lacks base colour, roughness, ambient occlusion or normals.
        InvalidOptionError: The cloud is in other axes, the rotation is not finite, or one of ``lights`` is no light.
    """

    cloud: GaussianCloud
    camera: Camera
    environment: EnvironmentMap | None = None
    environment_rotation: float = 0.0
    lights: tuple[Light, ...] = ()
    mesh: ShotMesh | None = None

    def __post_init__(self) -> None:
        """Check what every renderer needs."""
        require_number("environment_rotation", self.environment_rotation, -1e6, 1e6)
        for light in self.lights:
            if type(light) not in LIGHT_TYPES.values():
                raise unknown_light(type(light).__name__)
        if self.cloud.axes != WORLD_AXES:
            raise InvalidOptionError(
                f"cloud must be in the axes {WORLD_AXES!r}, got {self.cloud.axes!r}. Convert it with "
                f"beam_warp.change_axes(cloud, {WORLD_AXES!r})."
            )
        for name in ("base_color", "roughness", "ambient_occlusion", "normals"):
            if len(self.cloud) and getattr(self.cloud, name) is None:
                raise InvalidArrayError(f"{name} must be given to relight, got None. Decompose the Gaussians first.")


@dataclass(frozen=True, eq=False)
class RenderedImage:
    """What a camera sees, nothing behind it.

    Attributes:
        rgb: Scene-linear Rec.709 radiance multiplied by alpha, ``(H, W, 3)`` float32.
        alpha: Coverage in [0, 1], ``(H, W)`` float32. A caught shadow is black with the alpha of what it takes away.
        layers: Further images by name, means over what is covered, 0 where nothing is: ``base_color`` (H, W, 3),
            ``roughness``, ``normals`` (unit, world), ``depth`` (along the optical axis [m]), ``ambient_occlusion`` and
            what else the renderer knows.
    """

    rgb: NDArray[np.float32]
    alpha: NDArray[np.float32]
    layers: Mapping[str, NDArray[np.float32]] = field(default_factory=dict)


class Renderer(Protocol):
    """Renders shots, one after the other. What two shots share is prepared once.

    `beam_warp.render.deferred.DeferredRenderer` and `beam_warp.render.path.PathRenderer` are the renderers.
    """

    def draw(self, shot: Shot) -> RenderedImage:
        """Render one image."""
        ...
