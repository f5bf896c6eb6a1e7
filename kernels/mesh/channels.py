"""Channels of a mesh at each pixel besides light: material, normal, depth and cosine-weighted visibility."""

import warp as wp

from beam_warp.kernels.common.launching import launch
from beam_warp.kernels.common.pixel_sampling import PIXEL_CHUNK, PixelRays, pixel_direction, sample_pair
from beam_warp.kernels.common.sampling import square_to_cosine_hemisphere, stream_of, tangent_frame
from beam_warp.kernels.mesh.surface import MeshSurface, closest_hit, is_open, surface_point

wp.set_module_options({"enable_backward": False})

FORWARD = wp.constant(2)


@wp.struct
class MeshChannels:
    """Means over the part of a pixel that is covered; 0 where nothing is."""

    base_color: wp.array[wp.vec3]
    roughness: wp.array[float]
    normal: wp.array[wp.vec3]  # unit
    depth: wp.array[float]  # along the optical axis
    ambient_occlusion: wp.array[float]  # 1 is open


@wp.kernel
def trace_channels_kernel(
    first: int,
    surface: MeshSurface,
    rays: PixelRays,
    seed: wp.uint32,
    sample_count: int,
    visibility_count: int,
    out_channels: MeshChannels,
):
    """``visibility_count`` rays towards the sky at each of ``sample_count`` points of a pixel."""
    pixel = first + wp.tid()
    stream = stream_of(seed, wp.uint32(0), wp.uint32(pixel))
    base_color = wp.vec3(0.0)
    normal = wp.vec3(0.0)
    roughness = float(0.0)
    depth = float(0.0)
    open_count = int(0)
    covered = int(0)
    for sample in range(sample_count):
        direction = pixel_direction(rays, pixel, sample_pair(sample, stream, 0))
        hit = closest_hit(surface, rays.origin, direction)
        if hit.found:
            point = surface_point(surface, hit.face, hit.weights)
            covered += 1
            base_color += point.base_color
            roughness += point.roughness
            normal += point.normal
            depth += (wp.transpose(rays.camera_to_world) * (point.position - rays.origin))[FORWARD]
            frame = tangent_frame(point.normal)
            for ray in range(visibility_count):
                at = sample_pair(sample * visibility_count + ray, stream, 1)
                if is_open(surface, point.origin, frame * square_to_cosine_hemisphere(at[0], at[1])):
                    open_count += 1
    if covered > 0:
        share = 1.0 / float(covered)
        out_channels.base_color[pixel] = base_color * share
        out_channels.roughness[pixel] = roughness * share
        out_channels.normal[pixel] = wp.normalize(normal)
        out_channels.depth[pixel] = depth * share
        out_channels.ambient_occlusion[pixel] = float(open_count) * share / float(visibility_count)


def launch_trace_channels(surface, rays, seed, sample_count, visibility_count, out_channels):
    """Fill the channels of every pixel; the arrays come in filled with 0."""
    launch(
        trace_channels_kernel,
        len(out_channels.depth),
        inputs=[surface, rays, wp.uint32(seed), sample_count, visibility_count],
        outputs=[out_channels],
        device=out_channels.depth.device,
        block_dim=64,
        min_chunk=PIXEL_CHUNK,
    )
