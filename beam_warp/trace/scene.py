"""Gaussians on a device, ready to be traced: packed rows, exact bounds and a bounding volume hierarchy."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any, Literal, NoReturn

import numpy as np
import warp as wp
from numpy.typing import NDArray

from beam_warp.checks import require_array, require_choice, require_finite, require_range, require_same_length
from beam_warp.device.arrays import require_rows, resolve_device, upload
from beam_warp.errors import InvalidArrayError, InvalidOptionError
from beam_warp.kernels.trace.bounds import INVISIBLE, NOT_FINITE, RAISED, TRACED
from beam_warp.kernels.trace.occluders import GaussianAndMeshOccluders, GaussianOccluders
from beam_warp.trace.packing import PackedGaussians
from beam_warp.trace.wide_tree import BuiltTree, RepeatedBuild, build_wide_tree, refit
from beam_warp.world.gaussians import GaussianCloud

NOTHING = GaussianCloud(
    positions=np.zeros((1, 3), np.float32),
    orientations=np.array([[0.0, 0.0, 0.0, 1.0]], np.float32),
    scales=np.ones((1, 3), np.float32),
    opacities=np.zeros(1, np.float32),
)
"""One Gaussian that no ray sees: with it kernels need no case for an empty scene."""

BUILDS = ("quality", "fast")

Build = Literal["quality", "fast"]


@dataclass(frozen=True)
class SceneReport:
    """What was done to the Gaussians so that they can be traced.

    Attributes:
        traced: Gaussians that take part.
        dropped: Gaussians left out because their opacity is at most 1/255: no ray can see them.
        raised_scales: Gaussians traced with a scale raised to the smallest that float32 can resolve.
        not_finite: Gaussians left out because of NaN, infinity, a negative scale or a zero quaternion.
        depth: Levels of the tree.
        build: How the tree was built; ``"places"`` where the method asked for made it too deep to traverse.
    """

    traced: int
    dropped: int
    raised_scales: int
    not_finite: int = 0
    depth: int = 0
    build: str = ""


@dataclass(eq=False)
class Scene:
    """One device's copy of a cloud; `from_gaussians` makes it, `move` moves it.

    Attributes:
        occluders: What kernels trace, relative to ``origin``.
        mesh: Triangles among the Gaussians; None for none.
        packed: The Gaussians on the device.
    """

    occluders: Any
    mesh: wp.Mesh | None
    packed: PackedGaussians = field(repr=False)
    _count: int = field(repr=False)
    _tree: BuiltTree = field(repr=False, init=False)
    _report: SceneReport = field(repr=False, default=SceneReport(0, 0, 0))
    _refitted: bool = field(repr=False, default=False)
    _repeated: RepeatedBuild | None = field(repr=False, default=None)

    @classmethod
    def from_gaussians(
        cls,
        cloud: GaussianCloud,
        device: str | None = None,
        *,
        build: Build = "quality",
        response_degree: Literal[2, 4] = 2,
        mesh: Any = None,
    ) -> Scene:
        """Upload a cloud and build its hierarchy.

        Args:
            cloud: Any number of Gaussians, none included.
            device: Warp device; None takes the first CUDA device, or the CPU where there is none.
            build: ``"quality"`` for many rays, ``"fast"`` for geometry that changes with every few.
            response_degree: 2 for Gaussians, 4 for the faster falloff exp(-x^4 / 18) of 3DGRT, if trained with it.
            mesh: Opaque triangles in the same world, ground or props: anything with ``vertices`` ``(V, 3)`` [m] and
                ``faces`` ``(F, 3)``, a ``trimesh.Trimesh`` for one.

        Raises:
            DeviceError: There is no such device.
            InvalidArrayError: The mesh's arrays break the contract above.
            InvalidOptionError: An option is none of its choices.
        """
        target = resolve_device(device)
        require_choice("build", build, BUILDS)
        if response_degree not in (2, 4):
            raise InvalidOptionError(f"response_degree must be 2 or 4, got {response_degree!r}. Choose one of them.")
        packed = PackedGaussians.from_cloud(cloud if len(cloud) else NOTHING, response_degree, target)
        occluders, triangles = GaussianOccluders(), None
        if mesh is not None:
            occluders, triangles = GaussianAndMeshOccluders(), _upload_mesh(mesh, packed.origin, target)
            occluders.mesh.mesh = triangles.id
        occluders.gaussians = packed.gaussians
        occluders.origin = wp.vec3(*packed.origin.tolist())
        scene = cls(occluders, triangles, packed, len(cloud))
        scene._build(build)
        return scene

    @property
    def report(self) -> SceneReport:
        """What was left out or changed; after a refit it is counted when asked for, as a refit reads nothing back."""
        if self._refitted:
            fates = self.packed.fates.numpy().copy()
            absent = np.ones(len(fates), np.bool_)  # what was left out when the tree was built stays out
            absent[self._tree.layout.items.numpy()[: self._tree.count]] = False
            fates[absent & ((fates == TRACED) | (fates == RAISED))] = NOT_FINITE
            number = np.bincount(fates, minlength=4).tolist()
            self._report = replace(
                self._report,
                traced=number[TRACED] + number[RAISED],
                raised_scales=number[RAISED],
                not_finite=number[NOT_FINITE],
            )
            self._refitted = False
        return self._report

    @property
    def device(self) -> Any:
        """Warp device that holds the scene."""
        return self.packed.device

    @property
    def origin(self) -> NDArray[np.float32]:
        """World position that the device's coordinates are relative to [m].

        The middle of the cloud, so that precision does not suffer far from the world's origin.
        """
        return self.packed.origin

    @property
    def extent(self) -> float:
        """Largest side of the centres' bounding box when the scene was made [m]."""
        return self.packed.extent

    @property
    def response_degree(self) -> int:
        """Degree of the Gaussians' response, 2 or 4."""
        return self.occluders.gaussians.degree

    @property
    def has_normals(self) -> bool:
        """Whether the cloud came with normals."""
        normals = self.occluders.gaussians.normals
        return normals is not None and len(normals) > 0

    def face(self, normals: Any) -> None:
        """Give the scene's Gaussians normals, in place, or others than they came with.

        Args:
            normals: Unit normals, ``(N, 3)`` float32, NumPy or a warp array of vec3 on the scene's device.

        Raises:
            InvalidArrayError: The shape or type breaks the contract above.
        """
        self.packed.gaussians.normals = _device_rows("normals", normals, 3, wp.vec3, len(self), self.device)
        self.occluders.gaussians = self.packed.gaussians

    def __reduce__(self) -> NoReturn:
        """Refuse copies and pickles: what is on a device belongs to one process.

        Raises:
            InvalidOptionError: Always.
        """
        raise InvalidOptionError(
            "scene must stay in the process that made it, got a copy or a pickle of it. Pass its cloud, and make it "
            "there."
        )

    def __len__(self) -> int:
        """Return the number of Gaussians, those that are not traced included."""
        return self._count

    def move(
        self, positions: Any, orientations: Any, scales: Any, *, tree: Literal["refit", "fast", "quality"] = "refit"
    ) -> None:
        """Move the scene's Gaussians, in place; opacities stay.

        Args:
            positions: World positions [m], ``(N, 3)`` float32, NumPy or a warp array of vec3 on the scene's device.
            orientations: Quaternions xyzw, ``(N, 4)``, NumPy or a warp array of quat.
            scales: Standard deviations [m], ``(N, 3)``, NumPy or a warp array of vec3.
            tree: ``"refit"`` keeps the hierarchy and gives it new boxes: fastest, and exact, but slower to trace the
                farther neighbours drift apart. The others build it anew.

        Rows that are not finite are left out, counted in ``report``; a row can come back with the next move, but a
        refit does not bring back what was left out when the tree was built.

        Raises:
            InvalidArrayError: A shape or type breaks the contract above.
        """
        require_choice("tree", tree, ("refit", *BUILDS))
        arrays = [
            _device_rows(name, value, size, dtype, len(self), self.device)
            for name, value, size, dtype in (
                ("positions", positions, 3, wp.vec3),
                ("orientations", orientations, 4, wp.quat),
                ("scales", scales, 3, wp.vec3),
            )
        ]
        if not len(self):
            return
        self.packed.place(*arrays)
        self._refitted = tree == "refit"
        if tree == "fast" == self._tree.method and self._repeated is None and self._tree.count > 1:
            self._repeated = RepeatedBuild(self.packed, self._tree)
        if tree != "refit":
            self._build(tree)
        else:
            refit(self._tree, self.packed)

    def _build(self, build: Build) -> None:
        """Build the hierarchy over the packed bounds, and report."""
        packed = self.packed
        repeated = self._repeated if build == "fast" else None
        if repeated is not None:
            repeated.launch()
        number = packed.fate_counts()
        traced = number[TRACED] + number[RAISED]
        built = None if repeated is None else repeated.built(traced)
        if built is None:
            built, self._repeated = build_wide_tree(packed, traced, build), None
        self._tree = built
        self.occluders.tree = built.tree
        # The one Gaussian of an empty scene is not the cloud's.
        invisible = number[INVISIBLE] if len(self) else 0
        self._report = SceneReport(
            traced, invisible, number[RAISED], number[NOT_FINITE], len(self._tree.levels), self._tree.method
        )


def _device_rows(name: str, value: Any, size: int, dtype: Any, count: int, device: Any) -> wp.array:
    """Return rows on the device; arrays that are there already pass through unread."""
    if isinstance(value, wp.array):
        rows = require_rows(name, value, dtype, device)
    else:
        rows = upload(require_array(name, value, (None, size)), dtype, device)
    require_same_length(name, rows, "the scene", count)
    return rows


def _upload_mesh(mesh: Any, origin: NDArray[np.float32], device: Any) -> wp.Mesh:
    """Return triangles on the device, relative to the scene's origin."""
    for name in ("vertices", "faces"):
        if getattr(mesh, name, None) is None:
            raise InvalidArrayError(
                f"mesh must have vertices and faces, got {type(mesh).__name__} without {name}. Pass a trimesh.Trimesh."
            )
    vertices = require_array("mesh.vertices", mesh.vertices, (None, 3), np.float64)
    faces = require_array("mesh.faces", mesh.faces, (None, 3), np.int64)
    require_finite("mesh.vertices", vertices)
    if not len(faces):
        raise InvalidArrayError("mesh.faces must hold at least one triangle, got none. Pass None for no mesh.")
    require_range("mesh.faces", faces, 0, len(vertices) - 1, "Index existing vertices.")
    return wp.Mesh(
        upload((vertices - origin).astype(np.float32), wp.vec3, device),
        upload(faces.reshape(-1).astype(np.int32), int, device),
    )
