"""Stress captures of subjects that are hard to follow: fast, plain, in contact with themselves, or not alone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import trimesh
from numpy.typing import NDArray

from beam_warp.demo.figure import Figure
from beam_warp.stability.capture_cases.alterations import with_every
from beam_warp.stability.capture_cases.case import NEW_SURFACE, CaptureStress, Detection
from beam_warp.stability.capture_cases.studio import StressStudio
from beam_warp.stability.suite import stability_case
from beam_warp.world.mesh import MaterialMesh

GREY = 0.35
GREY_ROUGHNESS = 0.6
"""Base colour and roughness of the figure without texture."""

CONTACT_TURN = 22.5
"""Turn of upper arms and forearms at which the hands touch the dress [degree]."""

APART = 0.7
"""Part of that turn from which the hands set out, some 9 cm away."""

SPHERE_RADIUS = 0.14
SPHERE_CENTER = (0.42, -0.30, 0.14)
"""Radius and centre of the ball that appears beside the feet, within what every camera sees [m]."""

SPHERE_COLOR = (0.65, 0.12, 0.08)


@stability_case("as it is", "nothing fails here", "nothing detected: what is found elsewhere is no habit")
def as_it_is(at: StressStudio) -> CaptureStress:
    """The capture, unchanged."""
    return CaptureStress(capture=at.base(), is_sound=True)


@stability_case(
    "every second frame",
    "motion of several pixels a frame drives Gaussians into the nearest colour that fits",
    "followed, or the loss detected and a key frame started",
)
def every_second_frame(at: StressStudio) -> CaptureStress:
    """Motion twice as fast."""
    return CaptureStress(capture=with_every(at.base(), 2))


@stability_case("every third frame", "the same, faster", "followed, or the loss detected and a key frame started")
def every_third_frame(at: StressStudio) -> CaptureStress:
    """Motion three times as fast."""
    return CaptureStress(capture=with_every(at.base(), 3))


@stability_case(
    "no texture",
    "colour says nothing about where a point went: Gaussians slide over the surface",
    "outlines and shading hold the surface; drift is reported",
)
def no_texture(at: StressStudio) -> CaptureStress:
    """The figure in one grey."""

    return CaptureStress(capture=at.traced("no texture", lambda: [plain(mesh) for mesh in at.dancing()]))


@stability_case(
    "self-contact",
    "what is near in space but not on the surface is smoothed together: hands tear off a piece of the dress",
    "hands and dress keep apart in the motion; drift is reported",
)
def self_contact(at: StressStudio) -> CaptureStress:
    """The figure lowers its hands until they touch its dress."""
    return CaptureStress(capture=at.traced("self-contact", lambda: touching(at.figure, at.frame_count)))


@stability_case(
    "an object appears",
    "nothing is there to move: Gaussians of the feet are stretched over the ball",
    "new surface detected in the frame where it appears, and a key frame started",
)
def object_appears(at: StressStudio) -> CaptureStress:
    """A ball lies beside the feet from the middle frame on."""
    first = max(1, at.frame_count // 2)

    def appearing() -> list[MaterialMesh]:
        return [mesh if frame < first else mesh.beside(ball()) for frame, mesh in enumerate(at.dancing())]

    return CaptureStress(
        capture=at.traced("an object appears", appearing), required=(Detection(NEW_SURFACE, frame=first),)
    )


def plain(mesh: MaterialMesh) -> MaterialMesh:
    """Return a mesh in one grey."""
    return replace(
        mesh, base_color=np.full_like(mesh.base_color, GREY), roughness=np.full_like(mesh.roughness, GREY_ROUGHNESS)
    )


def touching(figure: Figure, frame_count: int) -> list[MaterialMesh]:
    """Return the figure lowering its hands until they touch its dress in the last frame."""
    meshes = []
    for frame in range(frame_count):
        share = APART + (1.0 - APART) * (frame / max(frame_count - 1, 1))
        turn = CONTACT_TURN * share
        turns = {
            f"{side} {bone}": (0.0, sign * turn, 0.0)
            for side, sign in (("left", 1.0), ("right", -1.0))
            for bone in ("arm", "forearm")
        }
        meshes.append(figure.posed(turns))
    return meshes


def ball() -> MaterialMesh:
    """Return the object that appears."""
    sphere = trimesh.creation.icosphere(subdivisions=4, radius=SPHERE_RADIUS)
    normals: NDArray[np.float32] = (sphere.vertices / SPHERE_RADIUS).astype(np.float32)
    return MaterialMesh(
        vertices=(sphere.vertices + np.asarray(SPHERE_CENTER)).astype(np.float32),
        faces=sphere.faces,
        normals=normals,
        base_color=np.tile(SPHERE_COLOR, (len(normals), 1)),
        roughness=np.full(len(normals), 0.4),
    )
