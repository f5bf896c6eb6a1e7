"""What Gaussians reflect of a known environment towards cameras: the specular term of a split sum, with few numbers.

A Gaussian faces along its thin axis, on the side that a camera sees, and adds to its colour

    s E_s(n.v, r) sum w_k L_(r_k)(d_k),

as `beam_warp.light.prefiltered` states it, r the roughness and s the part of the lobe that is open. Both are moved as
logits: r in [`LEAST_ROUGHNESS`, 1], s in [0, 1].
"""

import warp as wp

from beam_warp.kernels.common.launching import launch, launcher
from beam_warp.kernels.light.shading import EnvironmentLight, reflected_radiance, view_albedo
from beam_warp.kernels.raster.project import RasterView
from beam_warp.kernels.reconstruction.activation import sigmoid, smallest_axis

wp.set_module_options({"enable_backward": False})

LEAST_ROUGHNESS = wp.constant(0.05)
"""Below it, a lobe is narrower than normals of Gaussians can tell."""

LEAST_FACING = wp.constant(0.1)
"""Smallest cosine with the view: a disc that is seen from its edge shows next to nothing, but reflects without bounds
compared with what it scatters."""

LOGIT_STEP = wp.constant(0.05)
"""Half the difference of logits over which the slope by roughness is taken: levels of blur are joined by lines."""


@wp.struct
class Reflectors:
    """Gaussians that reflect."""

    positions: wp.array[wp.vec3]
    orientations: wp.array[wp.quat]
    scales: wp.array[wp.vec3]
    gloss: wp.array[wp.vec2]  # logits of roughness and of the open part


@wp.func
def roughness_of(logit: float) -> float:
    return LEAST_ROUGHNESS + (1.0 - LEAST_ROUGHNESS) * sigmoid(logit)


@wp.func
def thin_axis(reflectors: Reflectors, i: int, side: wp.vec3) -> wp.vec3:
    """Unit normal of a Gaussian, on a side."""
    axis = smallest_axis(reflectors.scales[i])
    own = wp.vec3(wp.where(axis == 0, 1.0, 0.0), wp.where(axis == 1, 1.0, 0.0), wp.where(axis == 2, 1.0, 0.0))
    normal = wp.quat_rotate(wp.normalize(reflectors.orientations[i]), own)
    return wp.where(wp.dot(normal, side) < 0.0, -normal, normal)


@wp.func
def reflected(light: EnvironmentLight, normal: wp.vec3, view: wp.vec3, roughness: float) -> wp.vec3:
    """What an open surface reflects."""
    facing = normal
    cosine = wp.dot(normal, view)
    if cosine < LEAST_FACING:
        facing = wp.normalize(normal + (LEAST_FACING - cosine) * view)
    return reflected_radiance(light, facing, view, roughness) * view_albedo(light, facing, view, roughness)


@wp.kernel
def add_reflections_kernel(
    first: int,
    light: EnvironmentLight,
    reflectors: Reflectors,
    views: wp.array[RasterView],
    out_colors: wp.array[wp.vec3],
):
    splat = first + wp.tid()
    count = reflectors.positions.shape[0]
    i = splat % count
    view = wp.normalize(views[splat / count].position - reflectors.positions[i])
    gloss = reflectors.gloss[i]
    shown = reflected(light, thin_axis(reflectors, i, view), view, roughness_of(gloss[0]))
    out_colors[splat] = out_colors[splat] + shown * sigmoid(gloss[1])


@wp.kernel
def gloss_gradients_kernel(
    first: int,
    light: EnvironmentLight,
    reflectors: Reflectors,
    views: wp.array[RasterView],
    color_gradients: wp.array[wp.vec3],
    out_gloss: wp.array[wp.vec2],
):
    i = first + wp.tid()
    count = reflectors.positions.shape[0]
    gloss = reflectors.gloss[i]
    part = sigmoid(gloss[1])
    rough = roughness_of(gloss[0])
    rougher = roughness_of(gloss[0] + LOGIT_STEP)
    smoother = roughness_of(gloss[0] - LOGIT_STEP)
    total = wp.vec2()
    for k in range(views.shape[0]):
        gradient = color_gradients[k * count + i]
        if wp.length_sq(gradient) > 0.0:
            view = wp.normalize(views[k].position - reflectors.positions[i])
            normal = thin_axis(reflectors, i, view)
            change = reflected(light, normal, view, rougher) - reflected(light, normal, view, smoother)
            by_roughness = part * wp.dot(gradient, change) / (2.0 * LOGIT_STEP)
            by_part = part * (1.0 - part) * wp.dot(gradient, reflected(light, normal, view, rough))
            total += wp.vec2(by_roughness, by_part)
    out_gloss[i] = total


@wp.kernel
def reflect_towards_kernel(
    first: int,
    light: EnvironmentLight,
    reflectors: Reflectors,
    start: int,
    sides: wp.array[wp.vec3],
    directions: wp.array[wp.vec3],
    out_cosines: wp.array2d[float],
    out_colors: wp.array2d[wp.vec3],
):
    item = first + wp.tid()
    row = item / directions.shape[0]
    k = item % directions.shape[0]
    i = start + row
    view = directions[k]
    normal = thin_axis(reflectors, i, sides[i])
    cosine = wp.dot(normal, view)
    color = wp.vec3()
    if cosine > 0.0:
        gloss = reflectors.gloss[i]
        color = reflected(light, normal, view, roughness_of(gloss[0])) * sigmoid(gloss[1])
    out_cosines[row, k] = wp.max(cosine, 0.0)
    out_colors[row, k] = color


def launch_add_reflections(light, reflectors, views, colors, device):
    """Add to the colour of every splat what its Gaussian reflects towards the view's camera."""
    launch(add_reflections_kernel, len(colors), inputs=[light, reflectors, views], outputs=[colors], device=device)


launch_gloss_gradients = launcher(gloss_gradients_kernel)
"""Write the gradients of the logits, from those of the splats' colours."""


def launch_reflect_towards(light, reflectors, start, sides, directions, cosines, colors, device):
    """Write what Gaussians from row ``start`` on reflect towards directions, and how much they face these."""
    inputs = [light, reflectors, start, sides, directions]
    launch(reflect_towards_kernel, cosines.size, inputs=inputs, outputs=[cosines, colors], device=device)
