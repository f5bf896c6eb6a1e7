"""Stress materials: small subjects and lights on which the measurement of materials fails, with known base colours.

A case is a closed mesh under a light. The path tracer for meshes computes the radiance that its vertices send towards
every camera. Gaussians on the vertices, drawn with those colours, are its photographs. So the light transport of the
photographs is independent of the one under test, and no reconstruction adds errors of its own.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import trimesh
from numpy.typing import ArrayLike, NDArray

from beam_warp.capture.views import CapturedView
from beam_warp.demo.lights import studio
from beam_warp.image.color import DISPLAY_SRGB, LINEAR_REC709
from beam_warp.raster.gbuffer import rasterize_values
from beam_warp.stability.suite import stability_case, together
from beam_warp.trace.mesh_paths import TracedMesh, outgoing_radiance
from beam_warp.world.camera import Camera
from beam_warp.world.environment import EnvironmentMap, texel_directions
from beam_warp.world.gaussians import GaussianCloud, Observability
from beam_warp.world.harmonics import SH_C0
from beam_warp.world.mesh import MaterialMesh, vertex_normals
from beam_warp.world.shapes import TiledSurface, tile

RADIUS = 0.5
"""Radius of the ball of most cases [m]."""

ROUGHNESS = 0.6
MIRROR_ROUGHNESS = 0.05
PATCH_COSINE = 0.5
"""Least cosine between `PATCH` and the normals of the patch that a case is about: 60 degrees."""

PATCH = np.array([1.0, 0.0, 0.3]) / np.linalg.norm([1.0, 0.0, 0.3])

SUN_OVER_MEAN = 2e4
SHELL = 0.002
"""Thickness of the thin shell [m]."""

CREASE_DEPTH = 0.35
CREASES = 6
"""Depth of creases in radii, and their number: from pole to pole, about as deep as they are wide."""

SATURATED_QUANTILE = 0.7
SATURATED_BY = 1.1
"""The quantile of all image values at which the saturated images end; the factor by which the mean over views of the
Gaussians that the case is about exceeds that ceiling."""

HOLE = 1e-3
"""Coverage below which a pixel of a photograph counts as empty."""


@dataclass(frozen=True, eq=False, kw_only=True)
class MaterialStress:
    """The input of a decomposition, and what must come of it.

    Attributes:
        cloud: Gaussians with captured radiance.
        views: Photographs.
        environment: The light as stated, which may be wrong.
        base_color: True base colour, ``(N, 3)``.
        hit: Gaussians that the case is about, ``(N,)``.
        roughness: Roughness that the decomposition is given, ``(N,)``.
        color_space: Colour space of the image files.
        flags: Flags of which `hit` must have one; 0 for none.
        finding: Code that must be found; empty for none.
        refused: Whether the case must be refused.
    """

    cloud: GaussianCloud
    views: tuple[CapturedView, ...]
    environment: EnvironmentMap
    base_color: NDArray[np.float32]
    hit: NDArray[np.bool_]
    roughness: NDArray[np.float32]
    color_space: str = LINEAR_REC709
    flags: Observability = Observability.OBSERVED
    finding: str = ""
    refused: bool = False


@dataclass(frozen=True, eq=False)
class MaterialStudio:
    """Takes photographs of meshes.

    Attributes:
        device: Warp device; None takes the first CUDA device, or the CPU.
        camera_count: Cameras around the subject.
        size: Side of the images [pixel].
        samples: Paths for each vertex and camera.
        subdivisions: Subdivisions of the ball's icosahedron: 3 gives 642 vertices, 4 gives 2,562.
    """

    device: str | None = None
    camera_count: int = 8
    size: int = 64
    samples: int = 32
    subdivisions: int = 4

    @cached_property
    def light(self) -> EnvironmentMap:
        """The demo's studio."""
        return studio()

    @cached_property
    def plain(self) -> MaterialStress:
        """A ball in the studio with nothing wrong."""
        return self.photograph(self.ball(), self.light)

    @cached_property
    def varnished(self) -> MaterialStress:
        """The ball with a patch as smooth as varnish."""
        ball = self.ball()
        hit = _patch(ball)
        return self.photograph(replace(ball, roughness=np.where(hit, MIRROR_ROUGHNESS, ROUGHNESS)), self.light, hit)

    def ball(self) -> MaterialMesh:
        """Return the ball, in soft colours."""
        shape = trimesh.creation.icosphere(self.subdivisions, RADIUS)
        return _material(np.asarray(shape.vertices), np.asarray(shape.faces))

    def cameras(self) -> list[Camera]:
        """Return cameras on a ring, high and low in turn."""
        size = {"width": self.size, "height": self.size, "vertical_fov": 30.0}
        return [
            Camera.orbit((0.0, 0.0, 0.0), 2.6, 360.0 * index / self.camera_count, 30.0 if index % 2 else -15.0, **size)
            for index in range(self.camera_count)
        ]

    def photograph(
        self, mesh: MaterialMesh, light: EnvironmentMap, hit: NDArray[np.bool_] | None = None, *, flatness: float = 0.1
    ) -> MaterialStress:
        """Put a Gaussian on every vertex and photograph it.

        Args:
            mesh: The subject.
            light: The environment that lights the mesh.
            hit: Vertices that the case is about; None for none.
            flatness: Thickness of the Gaussians over their width.
        """
        traced = TracedMesh.from_mesh(mesh, device=self.device)
        cameras = self.cameras()
        face, weights = _corner_of_vertex(mesh)
        toward = np.stack([camera.position - mesh.vertices for camera in cameras], axis=1)
        toward /= np.linalg.norm(toward, axis=2, keepdims=True)
        seen = outgoing_radiance(traced, face, weights, toward, light, sample_count=self.samples)
        facing = np.maximum(np.einsum("nvk,nk->nv", toward, mesh.normals), 1e-3)
        mean = np.einsum("nv,nvc->nc", facing, seen) / facing.sum(axis=1, keepdims=True)
        cloud = replace(
            _gaussians(mesh, flatness),
            radiance=((mean - 0.5) / SH_C0)[:, None].astype(np.float32),
            radiance_color_space=LINEAR_REC709,
        )
        return MaterialStress(
            cloud=cloud,
            views=tuple(self._view(cloud, camera, seen[:, index]) for index, camera in enumerate(cameras)),
            environment=light,
            base_color=mesh.base_color,
            hit=np.zeros(len(cloud), bool) if hit is None else hit,
            roughness=mesh.roughness,
        )

    def _view(self, cloud: GaussianCloud, camera: Camera, radiance: NDArray[np.float32]) -> CapturedView:
        """Draw one photograph. Splats let a little light through, the surface that they stand for does not."""
        drawn = rasterize_values(cloud, camera, radiance, device=self.device)
        alpha = np.where(drawn.alpha > 1.0 - 0.05, 1.0, drawn.alpha).astype(np.float32)
        scale = np.divide(alpha, drawn.alpha, out=np.zeros_like(alpha), where=drawn.alpha > HOLE)
        name = f"azimuth_{np.degrees(np.arctan2(camera.position[1], camera.position[0])) % 360.0:03.0f}"
        return CapturedView(name=name, camera=camera, color=drawn.values * scale[..., None], alpha=alpha)


@stability_case("as it is", "nothing fails here", "nothing found, nothing flagged: what is elsewhere is no habit")
def plain(studio: MaterialStudio) -> MaterialStress:
    """The ball in the studio."""
    return studio.plain


@stability_case("black base colour", "ratios of small numbers; gloss becomes colour", "black within the error stated")
def black(studio: MaterialStudio) -> MaterialStress:
    """A patch that reflects nothing but gloss."""
    ball = studio.ball()
    hit = _patch(ball)
    colors = np.where(hit[:, None], 0.0, ball.base_color)
    return studio.photograph(replace(ball, base_color=colors), studio.light, hit)


@stability_case(
    "mirror-like, known", "reflections of windows become patches of paint", "removed, or the error stated tells"
)
def mirror_known(studio: MaterialStudio) -> MaterialStress:
    """A patch as smooth as varnish, and the decomposition knows."""
    return studio.varnished


@stability_case("mirror-like, unknown", "the same, and gloss is looked for elsewhere", "the error stated tells")
def mirror_unknown(studio: MaterialStudio) -> MaterialStress:
    """The same patch, taken for as rough as the rest."""
    return replace(studio.varnished, roughness=np.full_like(studio.varnished.roughness, ROUGHNESS))


@stability_case("one hot sun", "few of 64 rays find it: fireflies and shadows of noise", "as good as under soft light")
def hot_sun(studio: MaterialStudio) -> MaterialStress:
    """A square of 1.4 degrees, 2e4 times as bright as the mean, gives most of the light."""
    return studio.photograph(studio.ball(), sun())


@stability_case("one lit side", "division by no light: noise, or white", "the dark side flagged unlit, and filled")
def one_side(studio: MaterialStudio) -> MaterialStress:
    """All light comes from a cone about the patch."""
    ball = studio.ball()
    directions = texel_directions(32, 64)
    light = EnvironmentMap(np.repeat((directions @ PATCH > np.cos(np.radians(20.0)))[..., None] * 8.0, 3, axis=-1))
    hit = ball.normals @ PATCH < -np.sin(np.radians(20.0))
    return replace(studio.photograph(ball, light, hit), flags=Observability.UNLIT)


@stability_case("saturated pixels", "colours above the ceiling are taken for the ceiling", "flagged, and images named")
def saturated(studio: MaterialStudio) -> MaterialStress:
    """Photographs that end at a value that much of the subject exceeds."""
    stress = studio.plain
    values = np.concatenate(
        [view.color[view.alpha > 0.99].max(axis=-1) for view in stress.views if view.alpha is not None]
    )
    gain = np.float32(1.0 / np.quantile(values, SATURATED_QUANTILE))
    views = tuple(replace(view, color=np.minimum(view.color * gain, 1.0)) for view in stress.views)
    assert stress.cloud.radiance is not None
    bright = (0.5 + SH_C0 * stress.cloud.radiance[:, 0]) * gain
    return replace(
        stress,
        cloud=replace(stress.cloud, radiance=((np.minimum(bright, 1.0) - 0.5) / SH_C0)[:, None].astype(np.float32)),
        views=views,
        environment=stress.environment.scaled(float(gain)),
        hit=bright.max(axis=1) > SATURATED_BY,
        color_space=DISPLAY_SRGB,
        flags=Observability.SATURATED,
        finding="clipped-images",
    )


@stability_case("wrong environment rotation", "light and shade are painted on", "found, with the turn that is missing")
def turned_light(studio: MaterialStudio) -> MaterialStress:
    """The light as stated is a quarter turn from where it was."""
    return replace(studio.plain, environment=studio.plain.environment.rotated(90.0), finding="environment-turned")


@stability_case("mirrored environment", "the same, with highlights", "found")
def mirrored_light(studio: MaterialStudio) -> MaterialStress:
    """The light as stated has its columns in reverse order."""
    mirrored = EnvironmentMap(studio.plain.environment.radiance[:, ::-1])
    return replace(studio.plain, environment=mirrored, finding="environment-turned")


@stability_case("normals flipped", "surfaces are lit from within: black, or white", "as good as if they were not")
def flipped_normals(studio: MaterialStudio) -> MaterialStress:
    """Every other Gaussian is turned over, its normal with it."""
    cloud = studio.plain.cloud
    turned = np.arange(len(cloud)) % 2 == 1
    assert cloud.normals is not None
    x, y, z, w = cloud.orientations.T
    over = np.stack([w, z, -y, -x], axis=1)  # the rotation times half a turn about its own x
    return replace(
        studio.plain,
        cloud=replace(
            cloud,
            orientations=np.where(turned[:, None], over, cloud.orientations),
            normals=np.where(turned[:, None], -cloud.normals, cloud.normals),
        ),
        hit=turned,
    )


@stability_case("thin shell", "each side gets the other's light and colour", "sides kept apart")
def thin_shell(studio: MaterialStudio) -> MaterialStress:
    """An upright sheet of 2 mm, red on one side and blue on the other."""
    mesh = _sheet(28)
    hit = mesh.vertices[:, 0] < 0.0
    return studio.photograph(mesh, studio.light, hit, flatness=0.01)


@stability_case(
    "deep creases",
    "rays start on the other side of the crease; light that bounces is missed",
    "base colour holds, within the error stated",
)
def creases(studio: MaterialStudio) -> MaterialStress:
    """A ball with creases from pole to pole, about as deep as they are wide."""
    shape = trimesh.creation.icosphere(studio.subdivisions, 1.0)
    unit = np.asarray(shape.vertices)
    around = np.arctan2(unit[:, 1], unit[:, 0])
    depth = CREASE_DEPTH * np.hypot(unit[:, 0], unit[:, 1]) * (0.5 - 0.5 * np.cos(CREASES * around)) ** 2
    mesh = _material(unit * RADIUS * (1.0 - depth)[:, None], np.asarray(shape.faces))
    return studio.photograph(mesh, studio.light, depth > 0.5 * CREASE_DEPTH)


@stability_case("2 views only", "half of the subject is made up", "what no view shows flagged and filled")
def two_views(studio: MaterialStudio) -> MaterialStress:
    """Two of the photographs, neighbours."""
    stress = studio.plain
    views = stress.views[:2]
    assert stress.cloud.normals is not None
    facing = np.stack(
        [np.einsum("nk,nk->n", stress.cloud.normals, view.camera.position - stress.cloud.positions) for view in views]
    )
    return replace(stress, views=views, hit=(facing < 0.0).all(axis=0), flags=Observability.UNSEEN)


@stability_case("black environment", "0 / 0", "refused")
def black_light(studio: MaterialStudio) -> MaterialStress:
    """A light that sheds none."""
    return replace(studio.plain, environment=EnvironmentMap(np.zeros((16, 32, 3), np.float32)), refused=True)


@stability_case("Gaussians nobody sees", "colours that no view constrained are measured", "flagged unseen, and filled")
def unseen(studio: MaterialStudio) -> MaterialStress:
    """A grey ball within the ball."""
    stress = studio.plain
    cloud = stress.cloud
    inner = np.flatnonzero(np.arange(len(cloud)) % 4 == 0)
    hidden = cloud.select(inner)
    assert hidden.radiance is not None
    joined = together(
        cloud, hidden.with_arrays(positions=0.6 * hidden.positions, radiance=np.zeros_like(hidden.radiance))
    )
    return replace(
        stress,
        cloud=joined,
        # The inner ball has no true colour of its own: its neighbours' on the surface is as good a guess as any.
        base_color=np.concatenate([stress.base_color, stress.base_color[inner]]),
        roughness=np.concatenate([stress.roughness, np.full(len(inner), ROUGHNESS, np.float32)]),
        hit=np.arange(len(joined)) >= len(cloud),
        flags=Observability.UNSEEN,
    )


MATERIAL_CASES = [
    plain,
    black,
    mirror_known,
    mirror_unknown,
    hot_sun,
    one_side,
    saturated,
    turned_light,
    mirrored_light,
    flipped_normals,
    thin_shell,
    creases,
    two_views,
    black_light,
    unseen,
]
"""Every case, in the order of the table; the first has nothing wrong."""


def sun() -> EnvironmentMap:
    """Return an even sky with a hot square of 1.4 degrees, whose radiance is `SUN_OVER_MEAN` times the mean."""
    height = 256
    row, column = int(0.29 * height), int(1.22 * height)
    sky = np.full((height, 2 * height, 3), 1.0, np.float32)
    place = (slice(row, row + 2), slice(column, column + 2))
    part = float(EnvironmentMap(sky).solid_angles()[place].sum() / (4.0 * np.pi))
    # s = ratio * mean, where mean = part * s + (1 - part) * 1
    sky[place] = SUN_OVER_MEAN * (1.0 - part) / (1.0 - SUN_OVER_MEAN * part)
    light = EnvironmentMap(sky)
    return light.scaled(np.pi / float(light.irradiance_map(32, 64).max()))


def _material(vertices: ArrayLike, faces: ArrayLike) -> MaterialMesh:
    """Return a mesh in soft colours, each channel a wave of its own."""
    points = np.asarray(vertices, np.float64)
    waves = np.sin(points @ np.array([[5.0, 2.0, -3.0], [-2.0, 4.0, 5.0], [4.0, -5.0, 2.0]]).T + [0.3, 1.7, 4.0])
    return MaterialMesh(
        vertices=points.astype(np.float32),
        faces=np.asarray(faces, np.int32),
        normals=vertex_normals(points, faces).astype(np.float32),
        base_color=(0.45 + 0.3 * waves).astype(np.float32),
        roughness=np.full(len(points), ROUGHNESS, np.float32),
    )


def _patch(mesh: MaterialMesh) -> NDArray[np.bool_]:
    return mesh.normals @ PATCH > PATCH_COSINE


def _corner_of_vertex(mesh: MaterialMesh) -> tuple[NDArray[np.int32], NDArray[np.float32]]:
    """Return a triangle of every vertex, and the weights that make it that vertex."""
    face, weights = np.zeros(len(mesh.vertices), np.int32), np.zeros((len(mesh.vertices), 3), np.float32)
    for corner in range(3):
        at = mesh.faces[:, corner]
        face[at] = np.arange(len(mesh.faces))
        weights[at] = np.eye(3, dtype=np.float32)[corner]
    return face, weights


def _gaussians(mesh: MaterialMesh, flatness: float) -> GaussianCloud:
    """Return a flat Gaussian on every vertex, as large as its share of the surface."""
    corners = mesh.vertices[mesh.faces].astype(np.float64)
    area = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    share = np.zeros(len(mesh.vertices))
    for corner in range(3):
        share += np.bincount(mesh.faces[:, corner], area / 3.0, len(share))
    spacing = float(np.sqrt(share.mean()))
    cloud = tile((TiledSurface(mesh.vertices.astype(np.float64), mesh.normals.astype(np.float64), spacing),))
    relative = (np.sqrt(share) / spacing)[:, None]
    scales = cloud.scales * relative
    scales[:, 2] = flatness * scales[:, 0]
    return replace(cloud, scales=scales.astype(np.float32))


def _sheet(count: int) -> MaterialMesh:
    """Return an upright sheet of `SHELL`, 0.9 m wide, with ``count`` x ``count`` squares a side."""
    steps = np.linspace(-0.45, 0.45, count + 1)
    y, z = np.meshgrid(steps, steps, indexing="ij")
    index = np.arange((count + 1) ** 2).reshape(count + 1, count + 1)
    a, b, c, d = index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]
    front = np.concatenate([np.stack([a, b, c], axis=-1).reshape(-1, 3), np.stack([a, c, d], axis=-1).reshape(-1, 3)])
    half = np.full(index.size, SHELL / 2.0)
    vertices = np.concatenate(
        [np.stack([half, y.ravel(), z.ravel()], axis=1), np.stack([-half, y.ravel(), z.ravel()], axis=1)]
    )
    sides = np.repeat([[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0]], index.size, axis=0)
    colors = np.repeat([[0.7, 0.1, 0.08], [0.08, 0.2, 0.7]], index.size, axis=0)
    return MaterialMesh(
        vertices=vertices.astype(np.float32),
        faces=np.concatenate([front, front[:, ::-1] + index.size]).astype(np.int32),
        normals=sides.astype(np.float32),
        base_color=colors.astype(np.float32),
        roughness=np.full(len(vertices), ROUGHNESS, np.float32),
    )
