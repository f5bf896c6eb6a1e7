"""The split sum at given surfaces: `split_sum_radiance`, which the deferred renderer's kernels call, on its own."""

import numpy as np
import warp as wp

from beam_warp.kernels.common.launching import launch
from beam_warp.kernels.light.shading import EnvironmentLight, split_sum_radiance
from beam_warp.world.environment import EnvironmentMap, texel_directions

wp.set_module_options({"enable_backward": False})


LINEAR = np.array([0.5, -0.3, 0.4])
"""Gradient of the smooth environment L = 1 + LINEAR · ω."""


@wp.kernel
def shade_kernel(
    first: int,
    light: EnvironmentLight,
    base_color: wp.array[wp.vec3],
    numbers: wp.array[wp.vec3],
    normals: wp.array[wp.vec3],
    views: wp.array[wp.vec3],
    out: wp.array[wp.vec3],
):
    i = first + wp.tid()
    radiance = split_sum_radiance(light, base_color[i], numbers[i][0], numbers[i][1], normals[i], -views[i])
    out[i] = radiance * numbers[i][2]


def shade(prepared, *, base_color, roughness, ambient_occlusion, normals, alpha, view_directions):
    """Radiance times alpha of surfaces ``(..., 3)`` and ``(...)`` under a `PreparedEnvironment`."""
    numbers = np.stack([roughness, ambient_occlusion, alpha], axis=-1)
    flat = [np.float32(a).reshape(-1, 3) for a in (base_color, numbers, normals, view_directions)]
    inputs = [wp.array(a, dtype=wp.vec3, device=prepared.device) for a in flat]
    out = wp.empty(len(flat[0]), dtype=wp.vec3, device=prepared.device)
    launch(shade_kernel, len(out), inputs=[prepared.blurred, *inputs], outputs=[out], device=prepared.device)
    return out.numpy().reshape(np.shape(base_color))


def blurred_level(prepared, level):
    """One level of blurred radiance as a lat-long image, ``(H, 2 H, 3)``."""
    light = prepared.blurred
    height, offset = int(light.heights.numpy()[level]), int(light.offsets.numpy()[level])
    return light.texels.numpy()[offset : offset + 2 * height * height].reshape(height, 2 * height, 3)


def smooth_environment(height=64):
    radiance = 1.0 + texel_directions(height, 2 * height) @ LINEAR
    return EnvironmentMap(radiance[..., None] * np.array([1.0, 0.5, 2.0]))


def sunny_sky(height=64):
    """A dim sky, a hot sun of one texel, and a black ground."""
    radiance = np.full((height, 2 * height, 3), 0.5, np.float32)
    radiance[height // 2 :] = 0.0
    radiance[height // 6, height // 3] = (4000.0, 3000.0, 2000.0)
    return EnvironmentMap(radiance)


def texels_of(directions, height):
    """Rows and columns of the texels that hold directions, in a map of ``height`` rows."""
    u = (0.5 - np.arctan2(directions[:, 1], directions[:, 0]) / (2.0 * np.pi)) % 1.0
    v = np.arccos(np.clip(directions[:, 2], -1.0, 1.0)) / np.pi
    return np.minimum((v * height).astype(int), height - 1), np.minimum((u * 2 * height).astype(int), 2 * height - 1)


def sunny_environment(rng, height=64):
    radiance = rng.random((height, 2 * height, 3)).astype(np.float32)
    radiance[height // 4, height // 3] = 5e4
    return EnvironmentMap(radiance)
