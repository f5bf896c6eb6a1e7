"""What the tracer is measured against: a plain ``wp.Bvh`` loop as its users write it, and Embree 4 user geometry.

Both take the same packed Gaussians and compute the same product of (1 - alpha) with the same early stop.
"""

from __future__ import annotations

import ctypes
import importlib.util
import shutil
import subprocess
import tempfile
from ctypes.util import find_library
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import warp as wp
from numpy.typing import NDArray

from beam_warp.kernels.common.constants import ALPHA_MAX, ALPHA_MIN, TRANSMITTANCE_STOP
from beam_warp.kernels.common.launching import launch
from beam_warp.world.gaussians import GaussianCloud
from beam_warp.world.quaternions import rotation_matrices

COMPILER_FLAGS = ("-O3", "-march=native", "-fno-math-errno", "-fno-trapping-math", "-fPIC", "-shared")
"""Not -ffast-math: loading a library built with it changes denormals for the whole process, and it gains nothing."""

BUILD_QUALITIES = {"medium": 1, "high": 2}
"""Numbers of Embree's RTCBuildQuality."""


class PackedGaussians(NamedTuple):
    """Gaussians as both baselines read them.

    Attributes:
        rows: Centre and opacity, the three rows of S^-1 R^T, the squared support radius in the first one's fourth
            place, ``(N, 4, 4)`` float32.
        boxes: Lower and upper corners of the tight bounds, ``(N, 6)`` float32.
    """

    rows: NDArray[np.float32]
    boxes: NDArray[np.float32]

    def sorted_by(self, order: NDArray[np.integer]) -> PackedGaussians:
        """Return them in another order in memory."""
        return PackedGaussians(self.rows[order], self.boxes[order])


def pack_gaussians(cloud: GaussianCloud) -> PackedGaussians:
    """Pack every Gaussian that a ray can see, without recentring or clamping: for scenes that need neither."""
    seen = cloud.opacities > ALPHA_MIN
    rotations = rotation_matrices(cloud.orientations[seen])
    centers, scales, opacities = (
        array[seen].astype(np.float64) for array in (cloud.positions, cloud.scales, cloud.opacities)
    )
    radius_squared = 2.0 * np.log(opacities / ALPHA_MIN)
    rows = np.zeros((len(centers), 4, 4), dtype=np.float32)
    rows[:, 0, :3], rows[:, 0, 3] = centers, opacities
    rows[:, 1:, :3] = rotations.transpose(0, 2, 1) / scales[:, :, None]
    rows[:, 1, 3] = radius_squared
    halves = np.sqrt(radius_squared)[:, None] * np.linalg.norm(rotations * scales[:, None, :], axis=2)
    halves = halves * 1.00001 + 2.4e-7 * np.abs(centers)  # as in kernels/trace/bounds.py
    return PackedGaussians(rows, np.concatenate([centers - halves, centers + halves], axis=1).astype(np.float32))


def make_plain_bvh_kernel(fast_math: bool) -> Any:
    """Return the loop as a kernel of its own, compiled with or without Warp's fast math."""

    @wp.kernel(
        name="trace_plain_bvh_fast" if fast_math else "trace_plain_bvh",
        enable_backward=False,
        module="unique",
        module_options={"fast_math": fast_math},
    )
    def trace_plain_bvh_kernel(
        first: int,
        bvh: wp.uint64,
        rows: wp.array2d[wp.vec4],
        origins: wp.array[wp.vec3],
        directions: wp.array[wp.vec3],
        stop: float,
        out_transmittance: wp.array[float],
    ):
        i = first + wp.tid()
        origin = origins[i]
        direction = directions[i]
        v = wp.float32(1.0)
        query = wp.bvh_query_ray(bvh, origin, direction)
        index = wp.int32(0)
        while wp.bvh_query_next(query, index):
            head = rows[index, 0]
            a = rows[index, 1]
            b = rows[index, 2]
            c = rows[index, 3]
            p = origin - wp.vec3(head[0], head[1], head[2])
            t_closest = -wp.dot(p, direction)
            p = p + direction * t_closest
            row_a = wp.vec3(a[0], a[1], a[2])
            row_b = wp.vec3(b[0], b[1], b[2])
            row_c = wp.vec3(c[0], c[1], c[2])
            q = wp.vec3(wp.dot(row_a, p), wp.dot(row_b, p), wp.dot(row_c, p))
            d = wp.vec3(wp.dot(row_a, direction), wp.dot(row_b, direction), wp.dot(row_c, direction))
            dd = wp.dot(d, d)
            x = wp.cross(q, d)
            xx = wp.dot(x, x)
            if xx < a[3] * dd and t_closest - wp.dot(q, d) / dd > 0.0:
                alpha = wp.min(ALPHA_MAX, head[3] * wp.exp(-0.5 * xx / dd))
                if alpha >= ALPHA_MIN:
                    v *= 1.0 - alpha
                    if v < stop:
                        break
        out_transmittance[i] = v

    return trace_plain_bvh_kernel


PLAIN_BVH_KERNELS = {fast_math: make_plain_bvh_kernel(fast_math) for fast_math in (False, True)}


class PlainBvh:
    """The loop over ``wp.Bvh`` that its manual suggests: no options, no recentring, no repair of axis-parallel rays.

    Args:
        packed: Gaussians.
        device: Warp device.
        constructor: Of ``wp.Bvh``.
        fast_math: Whether the kernel is compiled with Warp's fast math, as ours is.
    """

    def __init__(self, packed: PackedGaussians, device: Any, constructor: str, *, fast_math: bool = False) -> None:
        """Upload and build."""
        self._device, self._kernel = device, PLAIN_BVH_KERNELS[fast_math]
        self._rows = wp.array(packed.rows, dtype=wp.vec4, device=device)
        lowers, uppers = (
            wp.array(np.ascontiguousarray(part), dtype=wp.vec3, device=device)
            for part in (packed.boxes[:, :3], packed.boxes[:, 3:])
        )
        self._bvh = wp.Bvh(lowers, uppers, constructor=constructor, leaf_size=1)

    def visibility(self, origins: wp.array, directions: wp.array, *, stop: float = TRANSMITTANCE_STOP) -> wp.array:
        """Return transmittances ``(N,)`` on the device, of one ray a thread."""
        result = wp.empty(len(origins), dtype=float, device=self._device)
        launch(
            self._kernel,
            len(origins),
            inputs=[self._bvh.id, self._rows, origins, directions, stop],
            outputs=[result],
            device=self._device,
            block_dim=64,
        )
        return result


class EmbreeUnavailableError(RuntimeError):
    """There is no Embree 4, no compiler, or the two do not fit."""


def embree_library() -> Path | str:
    """Return Embree 4's shared library: that of the wheel ``embreex``, else the system's.

    Raises:
        EmbreeUnavailableError: There is neither.
    """
    spec = importlib.util.find_spec("embreex")
    if spec is not None and spec.origin is not None:
        bundled = sorted(Path(spec.origin).parent.parent.glob("embreex.libs/libembree4*"))
        if bundled:
            return bundled[0]
    found = find_library("embree4")
    if found is None:
        raise EmbreeUnavailableError("no Embree 4: pip install embreex")
    return found


class EmbreeScene:
    """The Gaussians as Embree user geometry, traced by ``embree_visibility.c`` on one thread.

    Args:
        packed: Gaussians; kept alive here, since Embree reads them in place.
        quality: Of Embree's build, one of `BUILD_QUALITIES`.

    Raises:
        EmbreeUnavailableError: There is no Embree 4 or no gcc, or compiling or building fails.
    """

    def __init__(self, packed: PackedGaussians, quality: str = "high") -> None:
        """Compile, load and build."""
        self._packed = packed
        self._library = _compiled_comparator()
        self._scene = self._library.comparator_new(
            packed.rows.ctypes.data, packed.boxes.ctypes.data, len(packed.rows), BUILD_QUALITIES[quality]
        )
        if not self._scene:
            raise EmbreeUnavailableError("Embree could not build the scene")
        number = self._library.comparator_version(self._scene)
        self.version = f"{number // 10000}.{number // 100 % 100}.{number % 100}"

    def visibility(
        self, origins: NDArray[np.float32], directions: NDArray[np.float32], *, stop: float = TRANSMITTANCE_STOP
    ) -> NDArray[np.float32]:
        """Return transmittances ``(N,)`` of contiguous float32 rays."""
        origins, directions = (np.ascontiguousarray(array, dtype=np.float32) for array in (origins, directions))
        result = np.empty(len(origins), dtype=np.float32)
        self._library.comparator_trace(
            self._scene, origins.ctypes.data, directions.ctypes.data, len(origins), stop, result.ctypes.data
        )
        return result

    def close(self) -> None:
        """Give the memory back to Embree; the object is of no use afterwards."""
        if self._scene:
            self._library.comparator_free(self._scene)
            self._scene = None

    def __enter__(self) -> EmbreeScene:
        """Return itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close."""
        self.close()


_loaded: dict[str, ctypes.CDLL] = {}  # a library stays loaded: the same code must not be compiled for every scene


def _compiled_comparator() -> ctypes.CDLL:
    """Return the comparator, compiled into a temporary folder that is gone once it is loaded."""
    library = str(embree_library())
    if library in _loaded:
        return _loaded[library]
    compiler = shutil.which("gcc")
    if compiler is None:
        raise EmbreeUnavailableError("no gcc")
    try:
        ctypes.CDLL(library, mode=ctypes.RTLD_GLOBAL)  # the comparator finds Embree's symbols here
    except OSError as error:
        raise EmbreeUnavailableError(f"Embree does not load: {error}") from error
    source = Path(__file__).with_name("embree_visibility.c")
    with tempfile.TemporaryDirectory() as folder:
        built = Path(folder) / "embree_visibility.so"
        done = subprocess.run(
            [compiler, *COMPILER_FLAGS, str(source), "-o", str(built), "-lm"], capture_output=True, text=True
        )
        if done.returncode != 0:
            raise EmbreeUnavailableError(f"gcc: {done.stderr.strip()[-500:]}")
        try:
            loaded = ctypes.CDLL(str(built))
        except OSError as error:
            raise EmbreeUnavailableError(f"the comparator does not load: {error}") from error
    pointer, size, number = ctypes.c_void_p, ctypes.c_size_t, ctypes.c_int
    for name, result, arguments in (
        ("comparator_new", pointer, (pointer, pointer, ctypes.c_uint, number)),
        ("comparator_free", None, (pointer,)),
        ("comparator_version", ctypes.c_long, (pointer,)),
        ("comparator_trace", None, (pointer, pointer, pointer, size, ctypes.c_float, pointer)),
    ):
        function = getattr(loaded, name)
        function.restype, function.argtypes = result, arguments
    _loaded[library] = loaded
    return loaded
