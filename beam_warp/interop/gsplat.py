"""Drawing with gsplat's arguments: a function with the arguments and results of ``gsplat.rasterization``.

Facts of the interface are from gsplat 1.5's documentation; the drawing and its gradients are this package's own.
"""

from __future__ import annotations

from collections import OrderedDict
from functools import lru_cache
from typing import Any, Literal

import numpy as np

from beam_warp.checks import require_choice, require_count
from beam_warp.errors import BeamError, InvalidArrayError, InvalidOptionError
from beam_warp.interop.torch import TorchRasterizer, describe, require_tensor  # says what is missing, where torch is
from beam_warp.raster.records import DepthMode, RasterOptions
from beam_warp.world.camera import Camera

# isort: split
import torch  # noqa: TID251  # pyright: ignore[reportMissingImports]

KEPT_RASTERIZERS = 4
"""Number of rasterisers that `rasterization` keeps for the next call: of training and evaluation, upright and wide."""

MAX_DEGREE = 4
"""Highest degree of spherical harmonics."""

RENDER_MODES = ("RGB", "D", "ED", "RGB+D", "RGB+ED")

RASTERIZE_MODES = ("classic", "antialiased")

HINTS = ("packed", "tile_size", "channel_chunk", "segmented")
"""gsplat's arguments that change how it works and not the image: accepted, and without effect here."""

_UNDISTORT = "Undistort the images first, see beam_warp.capture.undistort"

REFUSED: dict[str, tuple[Any, str]] = {
    "far_plane": (1e10, "Leave out the Gaussians beyond it"),
    "radius_clip": (0.0, "Leave out the small Gaussians"),
    "sparse_grad": (False, "Use dense gradients"),
    "absgrad": (False, "Densify by other criteria"),
    "distributed": (False, "Draw on one device"),
    "camera_model": ("pinhole", _UNDISTORT),
    "covars": (None, "Pass quats and scales"),
    "with_ut": (False, _UNDISTORT),
    "with_eval3d": (False, "Draw projected Gaussians"),
    "radial_coeffs": (None, _UNDISTORT),
    "tangential_coeffs": (None, _UNDISTORT),
    "thin_prism_coeffs": (None, _UNDISTORT),
    "ftheta_coeffs": (None, _UNDISTORT),
    "rolling_shutter": ("GLOBAL", "Take each camera at one moment"),
    "viewmats_rs": (None, "Take each camera at one moment"),
}
"""gsplat's arguments that change the image and have no counterpart here: the value that asks for nothing, and what to
do instead."""

_kept: OrderedDict[tuple[Any, ...], TorchRasterizer] = OrderedDict()


def rasterization(
    means: torch.Tensor,
    quats: torch.Tensor,
    scales: torch.Tensor,
    opacities: torch.Tensor,
    colors: torch.Tensor,
    viewmats: torch.Tensor,
    Ks: torch.Tensor,
    width: int,
    height: int,
    *,
    near_plane: float = 0.01,
    eps2d: float = 0.3,
    sh_degree: int | None = None,
    backgrounds: torch.Tensor | None = None,
    render_mode: Literal["RGB", "D", "ED", "RGB+D", "RGB+ED"] = "RGB",
    rasterize_mode: Literal["classic", "antialiased"] = "classic",
    return_normals: bool = False,
    depth: DepthMode = "plane",
    **others: Any,
) -> tuple[torch.Tensor, torch.Tensor, dict[str, Any]]:
    """Draw Gaussians for cameras of one size, differentiably, with gsplat's arguments and shapes.

    Gradients go to ``means``, ``quats``, ``scales``, ``opacities``, ``colors`` and ``backgrounds``, not to cameras.
    They have the same bits in every run on a device. Rasterisers are kept between calls, see `forget_rasterizers`; a
    loop of one's own may hold a `TorchRasterizer` instead.

    What differs from gsplat: depth is that of each splat's surface on the pixel's ray, not its centre's; a splat is
    added before the transmittance of 1e-4 stops a pixel, not left out; ``meta`` holds images, not what happened on the
    way, so that strategies which densify by ``means2d`` find nothing there. As there, a splat's alpha is at most 0.99,
    and nothing below 1/255.

    Args:
        means: ``(N, 3)`` float32 [m], without further dimensions in front.
        quats: ``(N, 4)`` quaternions wxyz, of any length; they are turned to xyzw, the one copy of an input.
        scales: ``(N, 3)`` [m].
        opacities: ``(N,)`` in [0, 1].
        colors: ``(N, D)`` of any D; with ``sh_degree``, spherical harmonics ``(N, K, 3)`` in the signs of 3DGS. A first
            dimension of cameras is accepted if it is 1.
        viewmats: World to camera, rigid, ``(C, 4, 4)``; on the host, no GPU is waited for to read them.
        Ks: Intrinsics ``(C, 3, 3)`` without skew [pixel].
        width: Image width [pixel].
        height: Image height [pixel].
        near_plane: Depth before which a Gaussian's centre is not drawn [m].
        eps2d: Variance of the pixel filter [pixel^2].
        sh_degree: Degree to evaluate, 0 to 4, at most that of ``colors``; colours are then at least 0.
        backgrounds: ``(C, D)``, seen through what is left of colours; depth has none.
        render_mode: ``"D"`` sums depths weighted by visibility, ``"ED"`` is their mean; along the optical axis.
        rasterize_mode: ``"antialiased"`` keeps a splat's total opacity when the pixel filter widens it.
        return_normals: Whether ``meta`` holds normals.
        depth: ``"plane"`` or ``"exact"``, see `beam_warp.raster.records.RasterOptions`.
        others: gsplat's other arguments. `HINTS` have no effect; `REFUSED` must have the value that asks for nothing.

    Returns:
        Images ``(C, H, W, X)``: D colours, or 3 of spherical harmonics, then depth where the mode has it; alpha
        ``(C, H, W, 1)``; and a dictionary: ``depth`` (mean) and ``median_depth`` ``(C, H, W, 1)`` [m], both with
        gradients, ``last_gaussian_ids`` ``(C, H, W)`` int32, ``width``, ``height``, ``n_cameras`` and, if asked,
        ``normals`` ``(C, H, W, 3)``: sums weighted by visibility, in the world, towards the camera; with gradients.

    Raises:
        InvalidArrayError: A tensor breaks its contract, or a camera asks for a gradient.
        InvalidOptionError: An option is out of range, refused or unknown.
    """
    _refuse(others)
    require_choice("render_mode", render_mode, RENDER_MODES)
    require_choice("rasterize_mode", rasterize_mode, RASTERIZE_MODES)
    count = _require_gaussians(means, quats)
    cameras = _cameras(viewmats, Ks, width, height)
    options = RasterOptions(rasterize_mode == "antialiased", eps2d, near_plane, depth)
    drawn = _require_colors(colors, count, len(cameras), sh_degree, means.device)
    if render_mode in ("D", "ED"):
        drawn = None
    values, radiance = (drawn, None) if sh_degree is None else (None, drawn)
    rasterizer = _rasterizer(count, cameras, values, radiance, return_normals, options, means.device)
    images = rasterizer.draw(means, quats.roll(-1, 1), scales, opacities, values, radiance, cameras=cameras)
    shape = (len(cameras), height, width)
    alphas = images.alpha.view(*shape, 1)
    layers = []
    if drawn is not None:
        rgb: Any = images.values if images.colors is None else images.colors
        rgb = rgb.view(*shape, -1)
        if backgrounds is not None:
            require_tensor("backgrounds", backgrounds, (len(cameras), rgb.shape[3]), rgb.device)
            rgb = rgb + (1.0 - alphas) * backgrounds[:, None, None, :]
        layers.append(rgb)
    mean_depth = images.depth.view(*shape, 1)
    if render_mode.endswith("D"):
        layers.append(mean_depth if render_mode.endswith("ED") else mean_depth * alphas)
    meta = {
        "depth": mean_depth,
        "median_depth": images.median_depth.view(*shape, 1),
        "last_gaussian_ids": images.gaussian_ids.view(shape),
        "width": width,
        "height": height,
        "n_cameras": len(cameras),
    }
    if images.normals is not None:
        meta["normals"] = images.normals.view(*shape, 3)
    return layers[0] if len(layers) == 1 else torch.cat(layers, dim=-1), alphas, meta


def forget_rasterizers() -> None:
    """Give back the memory that `rasterization` keeps for the next call; draws not yet differentiated keep theirs."""
    _kept.clear()


def _rasterizer(
    count: int,
    cameras: tuple[Camera, ...],
    values: torch.Tensor | None,
    radiance: torch.Tensor | None,
    normals: bool,
    options: RasterOptions,
    device: Any,
) -> TorchRasterizer:
    """Return a rasteriser of such Gaussians and cameras, kept from an earlier call if there is one."""
    value_count = 0 if values is None else values.shape[1]
    coefficient_count = 0 if radiance is None else radiance.shape[1]
    sizes = tuple((camera.width, camera.height) for camera in cameras)
    key = (count, sizes, value_count, coefficient_count, normals, options, str(device))
    rasterizer = _kept.pop(key, None)
    if rasterizer is None:
        rasterizer = TorchRasterizer(
            count,
            cameras,
            value_count=value_count,
            coefficient_count=coefficient_count,
            normals=normals,
            options=options,
            device=device,
        )
    _kept[key] = rasterizer
    while len(_kept) > KEPT_RASTERIZERS:
        _kept.popitem(last=False)
    return rasterizer


def _refuse(others: dict[str, Any]) -> None:
    """Refuse arguments that would change the image and have no counterpart here."""
    for name, value in others.items():
        if name in HINTS:
            continue
        if name not in REFUSED:
            raise InvalidOptionError(f"{name} must be an argument of rasterization, got {value!r}. Leave it out.")
        nothing, remedy = REFUSED[name]
        plain = getattr(value, "name", value) if name == "rolling_shutter" else value
        if plain is not nothing and not (isinstance(plain, (bool, int, float, str)) and plain == nothing):
            raise InvalidOptionError(
                f"{name} must be {nothing!r}, the only one that is drawn here, got {describe(value)}. {remedy}."
            )


def _require_gaussians(means: Any, quats: Any) -> int:
    """Return N."""
    if not isinstance(means, torch.Tensor) or means.ndim != 2:
        raise InvalidArrayError(
            f"means must be a tensor of shape (N, 3), got {describe(means)}. Draw sets of Gaussians one by one."
        )
    require_tensor("means", means, (len(means), 3), means.device)
    require_tensor("quats", quats, (len(means), 4), means.device)
    return len(means)


def _require_colors(colors: Any, count: int, camera_count: int, sh_degree: int | None, device: Any) -> torch.Tensor:
    """Return colours without a dimension of cameras, and only the spherical harmonics that are evaluated."""
    dimensions = 2 if sh_degree is None else 3
    shape = list(colors.shape) if isinstance(colors, torch.Tensor) else []
    tensor = colors
    if len(shape) == dimensions + 1 and shape[0] == camera_count == 1:
        tensor, shape = colors[0], shape[1:]
    if not (len(shape) == dimensions and shape[1] > 0):
        raise InvalidArrayError(
            f"colors must be a tensor of shape {'(N, D)' if sh_degree is None else '(N, K, 3)'}, the same for every "
            f"camera, got {describe(colors)}. Draw cameras with colours of their own one by one."
        )
    if sh_degree is None:
        require_tensor("colors", tensor, (count, shape[1]), device)
        return tensor
    require_tensor("colors", tensor, (count, shape[1], 3), device)
    bases = (require_count("sh_degree", sh_degree, 0, MAX_DEGREE) + 1) ** 2
    if bases > shape[1]:
        raise InvalidArrayError(
            f"colors must hold the {bases} coefficients of degree {sh_degree}, got {shape[1]}. Lower sh_degree."
        )
    return tensor[:, :bases]


def _cameras(viewmats: Any, intrinsics: Any, width: int, height: int) -> tuple[Camera, ...]:
    """Read cameras; a GPU is waited for once if either is there."""
    for name, tensor, side in (("viewmats", viewmats, 4), ("Ks", intrinsics, 3)):
        fits = isinstance(tensor, torch.Tensor) and tensor.ndim == 3 and tuple(tensor.shape[1:]) == (side, side)
        if not fits:
            raise InvalidArrayError(
                f"{name} must be a tensor of shape (C, {side}, {side}), got {describe(tensor)}. Reshape it."
            )
        if tensor.requires_grad and torch.is_grad_enabled():
            raise InvalidArrayError(
                f"{name} must not ask for a gradient, which cameras have none of here, got requires_grad=True. "
                "Detach it."
            )
    if len(viewmats) != len(intrinsics):
        raise InvalidArrayError(
            f"Ks must hold a matrix for each of {len(viewmats)} viewmats, got {len(intrinsics)}. Expand it."
        )
    numbers = [tensor.detach().to(viewmats.device, torch.float64).flatten(1) for tensor in (viewmats, intrinsics)]
    rows = torch.cat(numbers, dim=1).cpu().numpy()
    cameras = []
    for i, row in enumerate(rows):
        try:
            cameras.append(_camera(width, height, row.tobytes()))
        except (BeamError, np.linalg.LinAlgError) as error:
            raise InvalidArrayError(
                f"viewmats and Ks must be rigid motions and pinhole intrinsics, got a camera that is not at index {i}: "
                f"{error}"
            ) from error
    return tuple(cameras)


@lru_cache(maxsize=4096)
def _camera(width: int, height: int, matrices: bytes) -> Camera:
    """Return the camera of 16 numbers of pose and 9 of intrinsics; the same object for the same numbers."""
    numbers = np.frombuffer(matrices)
    view, lens = numbers[:16].reshape(4, 4), numbers[16:].reshape(3, 3)
    if not np.array_equal(view[3], (0.0, 0.0, 0.0, 1.0)):
        raise InvalidArrayError(f"a viewmat must end in the row 0 0 0 1, got {view[3].tolist()}. Pass a rigid motion.")
    if not (lens[0, 1] == lens[1, 0] == 0.0 and np.array_equal(lens[2], (0.0, 0.0, 1.0))):
        raise InvalidArrayError(f"K must be fx 0 cx, 0 fy cy, 0 0 1, got {lens.tolist()}. Take out skew and scale.")
    pose = np.eye(4)
    pose[:3, :3] = np.linalg.inv(view[:3, :3])
    pose[:3, 3] = -pose[:3, :3] @ view[:3, 3]
    return Camera(width, height, float(lens[0, 0]), float(lens[1, 1]), float(lens[0, 2]), float(lens[1, 2]), pose)
