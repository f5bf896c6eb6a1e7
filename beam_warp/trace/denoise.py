"""Noise off images of what light does on a surface: Open Image Denoise where it is installed, else a bilateral filter.

Occlusion and residues are demodulated already, there is no texture in them: the auxiliary images are a white albedo and
the normals. Giving a textured albedo instead costs 1 to 5 dB.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from typing import Any, Literal

import numpy as np
import warp as wp

from beam_warp.checks import require_choice
from beam_warp.device.array_checks import float_rows
from beam_warp.device.arrays import upload
from beam_warp.errors import InvalidArrayError, MissingPackageError
from beam_warp.kernels.trace.joint_bilateral import (
    ROUNDS,
    Guides,
    launch_clamp_fireflies,
    launch_filter_round,
    launch_smooth_variances,
    launch_square_errors,
)
from beam_warp.world.camera import Camera

Denoiser = Literal["auto", "oidn", "bilateral", "none"]

DENOISERS = ("auto", "oidn", "bilateral", "none")
"""``"oidn"``: Intel Open Image Denoise, of the extra ``denoise``. ``"bilateral"``: an edge-avoiding filter that needs
nothing. ``"auto"``: the first if it is installed, else the second. ``"none"``: images as they are."""


@dataclass(frozen=True, eq=False)
class NoisyImage:
    """An estimate and how uncertain it is; flat, on the device, 0 where there is no surface.

    Attributes:
        values: ``(H * W,)`` floats or vectors.
        standard_error: Of the mean over channels, ``(H * W,)`` float.
        hdr: Whether values may be above 1; if not they are in [0, 1].
    """

    values: wp.array
    standard_error: wp.array
    hdr: bool


@dataclass(frozen=True, eq=False)
class SurfaceGuides:
    """What is known of a view without noise; flat, on the device.

    Attributes:
        camera: The view.
        normals: Unit normals in the world, ``(H * W,)`` vec3; 0 where there is no surface.
        depth: Along the optical axis [m], ``(H * W,)`` float.
    """

    camera: Camera
    normals: wp.array
    depth: wp.array


def chosen_denoiser(denoiser: Denoiser) -> Literal["oidn", "bilateral", "none"]:
    """Return what a choice comes down to on this machine.

    Raises:
        InvalidOptionError: There is no such denoiser.
        MissingPackageError: Open Image Denoise is asked for by name and not installed.
    """
    require_choice("denoiser", denoiser, DENOISERS)
    if denoiser == "auto":
        return "bilateral" if _open_image_denoise() is None else "oidn"
    if denoiser == "oidn" and _open_image_denoise() is None:
        raise MissingPackageError(
            'denoiser must be installed to be used, got "oidn" without its package. '
            'Install it with pip install "beam-warp[denoise]", or choose "bilateral".'
        )
    return denoiser


@cache
def _open_image_denoise() -> Any:
    """Return the package, or None."""
    try:
        return import_module("mitsuba_oidn")
    except ImportError:
        return None


def denoise(images: Sequence[NoisyImage], guides: SurfaceGuides, *, denoiser: Denoiser = "auto") -> list[wp.array]:
    """Take noise off images of one view.

    Pixels far brighter than all around them are cut first where values have no bound: one of them brightens a whole
    neighbourhood. Ratios of images are not to be denoised, their noise has heavy tails: denoise what they are made of.

    Args:
        images: Of one view, all on one device.
        guides: The surface that they show.
        denoiser: One of `DENOISERS`.

    Returns:
        Images of the same types, on the device.

    Raises:
        InvalidArrayError: An array is not as long as the view has pixels.
        InvalidOptionError: There is no such denoiser.
        MissingPackageError: It is not installed.

    Source: Afra 2019-2026 (Open Image Denoise); Dammertz et al. 2010; Schied et al. 2017.
    """
    kind = chosen_denoiser(denoiser)
    count = guides.camera.width * guides.camera.height
    arrays = [guides.normals, guides.depth, *(a for image in images for a in (image.values, image.standard_error))]
    if any(len(array) != count for array in arrays):
        raise InvalidArrayError(
            f"images and guides must have {count} pixels, got {', '.join(str(len(array)) for array in arrays)}. "
            "Pass one row for each pixel of the camera."
        )
    if kind == "none" or count == 0:
        return [image.values for image in images]
    device = guides.normals.device
    kernel_guides = _kernel_guides(guides)
    clean = []
    for image in images:
        colors = _as_colors(image.values)
        if image.hdr:
            cut = wp.empty_like(colors)
            launch_clamp_fireflies(len(colors), kernel_guides, colors, cut, device)
            colors = cut
        if kind == "oidn":
            result = _filter_by_oidn(colors, guides, image.hdr)
        else:
            result = _filter_by_rounds(colors, image.standard_error, kernel_guides)
        clean.append(result if image.values.dtype is wp.vec3 else wp.clone(float_rows(result)[:, 0]))
    return clean


def _as_colors(values: wp.array) -> wp.array:
    """Return vectors: floats become grey."""
    if values.dtype is wp.vec3:
        return values
    colors = wp.empty(len(values), dtype=wp.vec3, device=values.device)
    rows = float_rows(colors)
    for c in range(3):
        wp.copy(rows[:, c], values)
    return colors


def _kernel_guides(guides: SurfaceGuides) -> Any:
    """Describe the view to kernels."""
    camera = guides.camera
    result = Guides()
    result.normals, result.depth = guides.normals, guides.depth
    result.width, result.height = camera.width, camera.height
    result.focal = wp.vec2(camera.focal_x, camera.focal_y)
    result.center = wp.vec2(camera.center_x, camera.center_y)
    result.world_to_camera = wp.mat33(camera.world_to_camera[:3, :3].astype(np.float32))
    return result


def _filter_by_rounds(colors: wp.array, error: wp.array, guides: Any) -> wp.array:
    """Run all rounds of the bilateral filter."""
    device = colors.device
    variances = wp.empty(len(colors), dtype=float, device=device)
    launch_square_errors(len(error), error, variances, device)
    current, spread = colors, wp.empty_like(variances)
    for round in range(ROUNDS):
        launch_smooth_variances(len(variances), guides, variances, spread, device)
        following = wp.empty_like(colors)
        launch_filter_round(len(current), guides, 1 << round, current, spread, following, variances, device)
        current = following
    return current


def _filter_by_oidn(colors: wp.array, guides: SurfaceGuides, hdr: bool) -> wp.array:
    """Hand an image to Open Image Denoise: on the CPU, whatever the device, so that results do not depend on it.

    The background gets the mean of the surface: a black one bleeds into the rim, where it costs 0.08 RMS of 0.85
    against 0.02, as measured on a ball at 0.05 noise; and so does an albedo that ends there.
    """
    package = _open_image_denoise()
    shape = (guides.camera.height, guides.camera.width, 3)
    normals = np.ascontiguousarray(guides.normals.numpy().reshape(shape))
    surface = np.abs(normals).max(axis=2) > 0.0
    if not surface.any():
        return colors
    image = colors.numpy().reshape(shape).copy()
    image[~surface] = image[surface].mean(axis=0, dtype=np.float64)
    clean = package.denoise(
        image, albedo=np.ones(shape, np.float32), normal=normals, hdr=hdr, clean_aux=True, device=_oidn_device(package)
    )
    return upload((np.asarray(clean) * surface[..., None]).reshape(-1, 3), wp.vec3, colors.device)


@cache
def _oidn_device(package: Any) -> Any:
    """Return Open Image Denoise's CPU device, made once: it holds the network's weights."""
    return package.Device(package.DeviceType.CPU)
