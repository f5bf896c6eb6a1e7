"""Deferred shading of a G-buffer of Gaussians: environment and lights, pixel by pixel; and means over samples."""

import warp as wp

from beam_warp.kernels.common.constants import PI
from beam_warp.kernels.common.launching import launch, launcher
from beam_warp.kernels.light.scattering import shading_of
from beam_warp.kernels.light.shading import (
    MIN_N_DOT_V,
    reflected_radiance,
    seen_normal,
    specular_occlusion,
    split_sum_radiance,
    view_albedo,
)
from beam_warp.kernels.raster.project import RasterView
from beam_warp.kernels.render.gaussian_light import (
    ARRIVING,
    NORMAL,
    OCCLUSION,
    OPENNESS,
    ROUGHNESS,
    SceneLight,
    random_turn,
    row_vector,
)
from beam_warp.kernels.render.surface_lighting import DistantLight, lit_radiance, unturned

wp.set_module_options({"enable_backward": False})


SHADE_CHUNK = 256
"""Fewest pixels of one launch on the CPU."""


@wp.func
def pixel_ray(view: RasterView, pixel: int) -> wp.vec3:
    """World vector from the camera through a pixel's middle, of depth 1."""
    x = (float(pixel % view.width) + 0.5 - view.center[0]) / view.focal[0]
    y = (float(pixel / view.width) + 0.5 - view.center[1]) / view.focal[1]
    return wp.transpose(view.world_to_camera) * wp.vec3(x, y, 1.0)


@wp.func
def arriving_radiance(
    environment: DistantLight,
    base_color: wp.vec3,
    roughness: float,
    openness: float,
    arriving: wp.vec3,
    raw_normal: wp.vec3,
    raw_view: wp.vec3,
) -> wp.vec3:
    """Radiance by an irradiance that is known, and by the environment's reflection."""
    view = unturned(environment, raw_view)
    normal = seen_normal(unturned(environment, raw_normal), view)
    reflected = view_albedo(environment.light, normal, view, roughness)
    n_dot_v = wp.clamp(wp.dot(normal, view), MIN_N_DOT_V, 1.0)
    open_share = specular_occlusion(openness, n_dot_v, roughness)
    diffuse = wp.cw_mul(base_color, arriving) * ((1.0 - reflected) / PI)
    return diffuse + reflected_radiance(environment.light, normal, view, roughness) * (reflected * open_share)


@wp.kernel(cuda_max_registers=96)  # by itself it takes 211, and few threads fit: a sixth slower with two lights
def shade_gaussians_kernel(
    first: int,
    views: wp.array[RasterView],
    channels: wp.array2d[float],
    alpha: wp.array[float],
    depth: wp.array[float],
    median_depth: wp.array[float],
    has_arriving: int,
    light: SceneLight,
    out_image: wp.array[wp.vec4],
):
    """Radiance multiplied by alpha, and alpha."""
    i = first + wp.tid()
    coverage = wp.min(alpha[i], 1.0)
    if not (coverage > 0.0):
        out_image[i] = wp.vec4()
        return
    view = views[0]
    ray = pixel_ray(view, i)
    toward = -wp.normalize(ray)
    # means over what the pixel sees; rounding may leave the range
    share = 1.0 / alpha[i]
    base_color = row_vector(channels, i, 0) * share
    roughness = wp.clamp(channels[i, ROUGHNESS] * share, 0.0, 1.0)
    ambient_occlusion = wp.clamp(channels[i, OCCLUSION] * share, 0.0, 1.0)
    raw_normal = row_vector(channels, i, NORMAL)
    radiance = wp.vec3()
    if has_arriving != 0:
        radiance = arriving_radiance(
            light.environment,
            base_color,
            roughness,
            wp.clamp(channels[i, OPENNESS] * share, 0.0, 1.0),
            row_vector(channels, i, ARRIVING) * share,
            raw_normal,
            toward,
        )
    else:
        radiance = split_sum_radiance(
            light.environment.light,
            base_color,
            roughness,
            ambient_occlusion,
            unturned(light.environment, raw_normal),
            unturned(light.environment, toward),
        )
    if light.lights.count > 0:
        shading = shading_of(
            seen_normal(raw_normal, toward), toward, base_color, roughness, light.environment.light.albedo_terms
        )
        # where the front leaks the mean lies inside the body, where no light arrives
        place = view.position + wp.min(depth[i], median_depth[i]) * ray
        radiance += lit_radiance(light.lights, light.shadows, shading, place, random_turn(i))
    out_image[i] = wp.vec4(radiance[0] * coverage, radiance[1] * coverage, radiance[2] * coverage, coverage)


@wp.kernel
def average_samples_kernel(first: int, width: int, side: int, samples: wp.array[wp.vec4], out_image: wp.array[wp.vec4]):
    """The mean over the square of samples of each pixel."""
    i = first + wp.tid()
    x = i % width
    y = i / width
    total = wp.vec4()
    for row in range(side):
        start = (y * side + row) * width * side + x * side
        for column in range(side):
            total += samples[start + column]
    out_image[i] = total / float(side * side)


def launch_shade_gaussians(views, images, has_arriving, light, out_image, device):
    """Shade what a rasteriser drew for one camera."""
    launch(
        shade_gaussians_kernel,
        len(out_image),
        inputs=[views, images.channels[0], images.alpha, images.depth, images.median_depth, int(has_arriving), light],
        outputs=[out_image],
        device=device,
        block_dim=128,
        min_chunk=SHADE_CHUNK,
    )


launch_average_samples = launcher(average_samples_kernel)
"""Reduce an image of ``side`` x ``side`` samples a pixel."""
