"""The same splats drawn by gsplat, forwards and backwards: images to compare with, and seconds.

Needs torch for CUDA, gsplat 1.5.3 (``pip install gsplat==1.5.3``) or 1.6.0 (its sources on the path), and nvcc: gsplat
compiles its kernels when they are first used. ``BUILD_3DGS=1 NUM_CHANNELS=4,12`` leaves out what 1.6.0 is not asked for
here. It is run on 3 and 11 channels and depth (``RGB+ED``), with our low-pass and near plane. What differs:

- It leaves out the splat that would bring the transmittance to 1e-4 or below, and stops; we draw that one, and stop
  after it. A splat of alpha 0.98 is left out at a transmittance of up to 1e-4 / 0.02: so values differ by up to 0.005
  of that splat's where the image is opaque, and its alpha stays below 0.9999.
- Its alpha is capped at 0.999 and ours at 0.99. The scenes have no opacity above 0.98.
- Its depth is that of splats' centres, ours that of their tangent planes: thin surfaces differ, by splats' sizes.
- Tiles are 16 pixels wide, filled by boxes; exp is CUDA's fast one; backward adds floats in any order.
- It draws neither median depth nor the identity of what is seen; ours include them.
- The renderer for inference of 1.6.0 draws RGB alone, from half-precision arrays that it packed before.

It cannot run as a CUDA graph: its forward reads the number of (tile, splat) pairs back, to size what follows, which
waits for the device and which stream capture refuses. Its seconds by the host's clock or by events are therefore what a
training loop pays, with launches and that wait. `kernel_seconds` is what its kernels alone take.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from beam_warp.world.camera import Camera
from beam_warp.world.gaussians import GaussianCloud

VERSIONS = ("1.5.3", "1.6.0")
LOW_PASS = 0.3
NEAR = 0.01
LEAVES = ("means", "quats", "scales", "opacities", "colors")
"""Arguments of gsplat that gradients are asked for."""


class GsplatUnavailableError(RuntimeError):
    """There is no gsplat of this version, or no torch with a CUDA device."""


class Images(NamedTuple):
    """Sums of values ``(H, W, K)``, mean depth ``(H, W)`` [m], 0 where nothing is seen, and alpha ``(H, W)``."""

    values: NDArray[np.float32]
    depth: NDArray[np.float32]
    alpha: NDArray[np.float32]


def arguments(cloud: GaussianCloud, camera: Camera, values: NDArray[np.float32]) -> dict[str, NDArray[np.float32]]:
    """Return gsplat's arrays by its names: quaternions wxyz, world to camera and K with OpenCV's axes, as ours are."""
    intrinsics = [[camera.focal_x, 0.0, camera.center_x], [0.0, camera.focal_y, camera.center_y], [0.0, 0.0, 1.0]]
    arrays = {
        "means": cloud.positions,
        "quats": cloud.orientations[:, [3, 0, 1, 2]],
        "scales": cloud.scales,
        "opacities": cloud.opacities,
        "colors": values,
        "viewmats": camera.world_to_camera[None],
        "Ks": np.array([intrinsics]),
    }
    return {name: np.ascontiguousarray(array, dtype=np.float32) for name, array in arrays.items()}


def kernel_seconds(work: Callable[[], Any], device: str, repeats: int = 20) -> float:
    """Return the seconds that the kernels and copies of some work take on the device, whoever launches them.

    The gaps between them, in which the device waits for the host, are left out (CUPTI, through torch's profiler).
    """
    torch: Any = importlib.import_module("torch")
    work()
    torch.cuda.synchronize(device)
    with torch.profiler.profile(activities=[torch.profiler.ProfilerActivity.CUDA]) as profile:
        for _ in range(repeats):
            work()
        torch.cuda.synchronize(device)
    return 1e-6 * sum(row.self_device_time_total for row in profile.key_averages()) / repeats


class GsplatPeer:
    """A cloud and a camera on a CUDA device, drawn by gsplat.

    Args:
        cloud: What is drawn.
        camera: From where.
        values: What is composited, ``(N, K)``.
        device: Torch's name of the device.
        packed: gsplat's layout: False keeps every splat and is faster where most are seen.

    Raises:
        GsplatUnavailableError: See there.
    """

    def __init__(
        self,
        cloud: GaussianCloud,
        camera: Camera,
        values: NDArray[np.float32],
        *,
        device: str = "cuda:0",
        packed: bool = False,
    ) -> None:
        try:
            self.torch: Any = importlib.import_module("torch")
            gsplat: Any = importlib.import_module("gsplat")
        except ImportError as error:
            raise GsplatUnavailableError(f"torch and gsplat must be importable, got {error}.") from error
        self.version: str = gsplat.__version__
        if self.version not in VERSIONS:
            raise GsplatUnavailableError(f"gsplat must be one of {', '.join(VERSIONS)}, got {self.version}.")
        if not self.torch.cuda.is_available():
            raise GsplatUnavailableError("torch must see a CUDA device, got none.")
        self.device = self.torch.device(device)
        self.tensors = {
            name: self.torch.tensor(array, device=self.device)
            for name, array in arguments(cloud, camera, values).items()
        }
        self._rasterization = gsplat.rasterization
        self._options = {
            "width": camera.width,
            "height": camera.height,
            "near_plane": NEAR,
            "eps2d": LOW_PASS,
            "packed": packed,
            "render_mode": "RGB+ED",
            "rasterize_mode": "classic",
        }

    def draw(self) -> Images:
        """Draw once."""
        with self.torch.no_grad():
            rendered, alpha, _ = self._draw(self.tensors)
        rendered, alpha = rendered[0].cpu().numpy(), alpha[0, ..., 0].cpu().numpy()
        return Images(rendered[..., :-1], rendered[..., -1], alpha)

    def pair_count(self) -> int:
        """Return how many (tile, splat) pairs are composited."""
        with self.torch.no_grad():
            return len(self._draw(self.tensors)[2]["flatten_ids"])

    def forward(self) -> None:
        """Draw without gradients, and leave the images on the device."""
        with self.torch.no_grad():
            self._draw(self.tensors)

    def training(self, upstream: Images) -> Callable[[], None]:
        """Return what draws and finds the gradients of `LEAVES` under a loss's derivatives to the images."""
        leaves, step = self._training(upstream)

        def forward_and_backward() -> None:
            for leaf in leaves.values():
                leaf.grad = None
            step()

        return forward_and_backward

    def gradients(self, upstream: Images) -> dict[str, NDArray[np.float32]]:
        """Return the gradients of `LEAVES`, in gsplat's conventions, under a loss's derivatives to the images."""
        leaves, step = self._training(upstream)
        step()
        return {name: leaf.grad.cpu().numpy() for name, leaf in leaves.items()}

    def random_upstream(self, seed: int = 0) -> Images:
        """Return normally distributed derivatives to every image."""
        rng = np.random.default_rng(seed)
        shape = (self._options["height"], self._options["width"])
        sizes = ((*shape, self.tensors["colors"].shape[1]), shape, shape)
        return Images(*(rng.standard_normal(size, dtype=np.float32) for size in sizes))

    def event(self) -> Any:
        """Record an event on the stream that gsplat launches on."""
        with self.torch.cuda.device(self.device):
            event = self.torch.cuda.Event(enable_timing=True)
            event.record()
        return event

    @staticmethod
    def seconds_between(begin: Any, end: Any) -> float:
        """Return the seconds from one event to another, which the device has passed."""
        return 1e-3 * begin.elapsed_time(end)

    def inference(self) -> Callable[[], Any] | None:
        """Return what draws RGB by the renderer for inference, from arrays packed here; None before 1.6.0."""
        if self.version == "1.5.3":
            return None
        scene: Any = importlib.import_module("gsplat.scene")
        render: Any = importlib.import_module("gsplat.experimental.render.functional")
        arrays = self.tensors
        quaternions = self.torch.nn.functional.normalize(arrays["quats"], dim=-1)
        colors = arrays["colors"][:, :3].contiguous()
        shape = (arrays["means"], quaternions, arrays["scales"], arrays["opacities"], colors)
        packed = scene.GaussianInferenceScene.from_gaussian_tensors(*shape, None, "none", id="scene")
        request = {"viewmats": arrays["viewmats"], "Ks": arrays["Ks"], "near_plane": NEAR, "eps2d": LOW_PASS}
        request |= {name: self._options[name] for name in ("width", "height")}

        def draw() -> Any:
            with self.torch.no_grad():
                return render.rasterize_gaussian_inference_scene(packed, **request).frame

        return draw

    def _training(self, upstream: Images) -> tuple[dict[str, Any], Callable[[], None]]:
        """Return tensors that ask for gradients, and what draws and adds to them."""
        leaves = {name: self.tensors[name].clone().requires_grad_() for name in LEAVES}
        tensors = {**self.tensors, **leaves}
        rendered = np.concatenate([upstream.values, upstream.depth[..., None]], axis=-1)
        given = [self.torch.tensor(array[None], device=self.device) for array in (rendered, upstream.alpha[..., None])]

        def step() -> None:
            rendered, alpha, _ = self._draw(tensors)
            self.torch.autograd.backward([rendered, alpha], given)

        return leaves, step

    def _draw(self, tensors: dict[str, Any]) -> tuple[Any, Any, dict[str, Any]]:
        """Return channels and depth ``(1, H, W, K + 1)``, alpha ``(1, H, W, 1)``, and what gsplat says of itself."""
        with self.torch.cuda.device(self.device):
            return self._rasterization(**tensors, **self._options)
