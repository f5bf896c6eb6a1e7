"""Triangles among Gaussians: seen by a ray through every pixel, shaded as Gaussians are, and blended by depth."""

import warp as wp

from beam_warp.kernels.common.constants import LARGEST_FLOAT
from beam_warp.kernels.common.launching import launcher
from beam_warp.kernels.common.luminance import luminance
from beam_warp.kernels.light.latlong import latlong_bilinear
from beam_warp.kernels.light.scattering import shading_of
from beam_warp.kernels.mesh.surface import MeshSurface, closest_hit, surface_point
from beam_warp.kernels.raster.project import RasterView
from beam_warp.kernels.render.deferred_pixels import SHADE_CHUNK, arriving_radiance, pixel_ray
from beam_warp.kernels.render.gaussian_light import SceneLight, environment_openness, random_turn
from beam_warp.kernels.render.surface_lighting import lit_irradiance, lit_radiance, unshadowed_irradiance, unturned

wp.set_module_options({"enable_backward": False})


@wp.kernel
def shade_mesh_kernel(
    first: int,
    views: wp.array[RasterView],
    surface: MeshSurface,
    catches_shadows: wp.array[wp.bool],
    light: SceneLight,
    out_image: wp.array[wp.vec4],
    out_surfaces: wp.array2d[float],
):
    """Radiance and alpha; base colour, roughness, normal and depth of what is seen, depth 0 for nothing.

    What only catches shadows is black, and covers by the share of irradiance that shadows take; its depth is negative.
    """
    i = first + wp.tid()
    view = views[0]
    ray = pixel_ray(view, i)
    length = wp.length(ray)
    direction = ray / length
    out_image[i] = wp.vec4()
    out_surfaces[i, 7] = 0.0
    hit = closest_hit(surface, view.position, direction)
    if not hit.found:
        return
    seen = surface_point(surface, hit.face, hit.weights)
    point = seen.position
    normal = seen.normal
    if wp.dot(seen.face_normal, direction) > 0.0:  # both sides are seen and lit
        normal = -normal
    depth = wp.dot(point - view.position, direction) / length
    turn = random_turn(i)
    free = latlong_bilinear(light.environment.light.irradiance, unturned(light.environment, normal))
    open_share = wp.vec3(1.0, 1.0, 1.0)
    if light.regions.moments.red.shape[0] > 0:
        open_share = environment_openness(light.regions, point, normal, turn)
    arriving = wp.cw_mul(free, open_share)
    if catches_shadows[hit.face]:
        all_light = luminance(free + unshadowed_irradiance(light.lights, point, normal))
        cover = float(0.0)
        if all_light > 0.0:
            cover = (
                1.0 - luminance(arriving + lit_irradiance(light.lights, light.shadows, point, normal, turn)) / all_light
            )
        out_image[i] = wp.vec4(0.0, 0.0, 0.0, wp.clamp(cover, 0.0, 1.0))
        out_surfaces[i, 7] = -depth
        return
    toward = -direction
    radiance = arriving_radiance(
        light.environment, seen.base_color, seen.roughness, luminance(open_share), arriving, normal, toward
    )
    if light.lights.count > 0:
        shading = shading_of(normal, toward, seen.base_color, seen.roughness, light.environment.light.albedo_terms)
        radiance += lit_radiance(light.lights, light.shadows, shading, point, turn)
    out_image[i] = wp.vec4(radiance[0], radiance[1], radiance[2], 1.0)
    for c in range(3):
        out_surfaces[i, c] = seen.base_color[c]
        out_surfaces[i, 4 + c] = normal[c]
    out_surfaces[i, 3] = seen.roughness
    out_surfaces[i, 7] = depth


@wp.kernel
def blend_mesh_kernel(
    first: int,
    depth: wp.array[float],
    mesh_image: wp.array[wp.vec4],
    mesh_surfaces: wp.array2d[float],
    out_image: wp.array[wp.vec4],
):
    """Put the nearer one over the other; Gaussians have their mean depth."""
    i = first + wp.tid()
    gaussians = out_image[i]
    mesh = mesh_image[i]
    mesh_depth = wp.abs(mesh_surfaces[i, 7])
    if mesh_depth == 0.0:
        mesh_depth = LARGEST_FLOAT
    if gaussians[3] > 0.0 and depth[i] <= mesh_depth:
        out_image[i] = gaussians + (1.0 - gaussians[3]) * mesh
    else:
        out_image[i] = mesh + (1.0 - mesh[3]) * gaussians


launch_shade_mesh = launcher(shade_mesh_kernel, block_dim=128, min_chunk=SHADE_CHUNK)
"""Shade what of the triangles every pixel of one camera sees."""


launch_blend_mesh = launcher(blend_mesh_kernel)
"""Blend triangles into the image of Gaussians."""
