"""Deferred shading of a G-buffer by an environment alone."""

from __future__ import annotations

import numpy as np
import warp as wp
from numpy.typing import ArrayLike, NDArray

from beam_warp.checks import require_array, require_finite, require_range, require_unit
from beam_warp.kernels.light.shading import ShadedSurfaces, launch_shade_environment
from beam_warp.light.prefiltered import EnvironmentLighting
from beam_warp.raster.gbuffer import GBuffer


def shade(
    *,
    base_color: ArrayLike,
    roughness: ArrayLike,
    ambient_occlusion: ArrayLike,
    normals: ArrayLike,
    alpha: ArrayLike,
    view_directions: ArrayLike,
    lighting: EnvironmentLighting,
) -> NDArray[np.float32]:
    """Light a G-buffer; the formula stands at the top of this module.

    All inputs are un-premultiplied. Where alpha is 0 the other channels may hold anything.

    Args:
        base_color: Scene-linear Rec.709 in [0, 1], ``(H, W, 3)``.
        roughness: Perceptual roughness in [0, 1], ``(H, W)``.
        ambient_occlusion: Hemispherical visibility in [0, 1], ``(H, W)``.
        normals: World-space normals of any length, ``(H, W, 3)``. One that faces away from the camera is turned until
            it grazes the view for the specular lobe; one of length 0 is taken to face the camera.
        alpha: Opacity in [0, 1], ``(H, W)``.
        view_directions: Unit directions from the camera to the pixel, ``(H, W, 3)``.
        lighting: The light, on the device that does the work.

    Returns:
        Scene-linear radiance multiplied by alpha, ``(H, W, 3)`` float32; 0 where alpha is 0.

    Raises:
        InvalidArrayError: A shape is another, or a value of a visible pixel is outside its range.
    """
    opacity = require_array("alpha", alpha, (None, None))
    require_range("alpha", opacity, 0.0, 1.0)
    size = opacity.shape
    visible = opacity > 0.0
    colors = require_array("base_color", base_color, (*size, 3))
    rough = require_array("roughness", roughness, size)
    openness = require_array("ambient_occlusion", ambient_occlusion, size)
    normal = require_array("normals", normals, (*size, 3))
    views = require_array("view_directions", view_directions, (*size, 3))
    for name, array in (("base_color", colors), ("roughness", rough), ("ambient_occlusion", openness)):
        require_range(f"visible {name}", array[visible], 0.0, 1.0)
    require_finite("visible normals", normal[visible])
    require_unit("visible view_directions", views[visible])
    surfaces = ShadedSurfaces()
    for name, array in (
        ("base_color", colors),
        ("roughness", rough),
        ("ambient_occlusion", openness),
        ("normals", normal),
        ("alpha", opacity),
        ("view_directions", views),
    ):
        flat = array.reshape(-1, 3) if array.ndim == 3 else array.reshape(-1)
        setattr(surfaces, name, wp.array(flat, dtype=wp.vec3 if array.ndim == 3 else float, device=lighting.device))
    out = wp.empty(opacity.size, dtype=wp.vec3, device=lighting.device)
    launch_shade_environment(lighting.light, surfaces, out_radiance=out, device=lighting.device)
    return out.numpy().reshape(*size, 3)


def relight(buffer: GBuffer, lighting: EnvironmentLighting) -> NDArray[np.float32]:
    """Light a G-buffer with the channels of `rasterizing.MATERIAL_CHANNELS`; see `shade`.

    Returns:
        Scene-linear radiance multiplied by alpha, ``(H, W, 3)`` float32.
    """
    return shade(
        base_color=buffer.channels["base_color"],
        roughness=buffer.channels["roughness"],
        ambient_occlusion=buffer.channels["ambient_occlusion"],
        normals=buffer.channels["normals"],
        alpha=buffer.alpha,
        view_directions=buffer.camera.directions(),
        lighting=lighting,
    )
