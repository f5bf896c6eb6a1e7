"""Pictures of probes, drawn by the package's HLSL: sort, G-buffer, shadow maps and deferred light."""

import numpy as np
from engines.probes import MAP_SIZE, prefiltered, shadow_maps

from beam_warp.light.ggx import specular_albedo_table
from beam_warp.light.uploaded import upload_lights

G_BUFFER = {
    "_BeamLook": "rgba16float",
    "_BeamNormal": "rgba16float",
    "_BeamRest": "rgba32float",
    "_BeamFirst": "rgba32float",
}
"""Targets of the G-buffer, and what the package keeps them in; its last one has one channel there."""


def row(*values):
    return np.concatenate([np.ravel(value) for value in values]).astype(np.float32)


def upload_gaussians(device, cloud, to_world=None):
    rows = np.zeros((len(cloud), 5, 4), np.float32)
    rows[:, 0] = np.column_stack([cloud.positions, cloud.opacities])
    rows[:, 1] = cloud.orientations
    rows[:, 2] = np.column_stack([cloud.scales, cloud.roughness])
    rows[:, 3] = np.column_stack([cloud.base_color, cloud.ambient_occlusion])
    rows[:, 4, :3] = cloud.normals
    device.buffer("_BeamGaussians", rows)
    device.set(_BeamObject=np.eye(4) if to_world is None else to_world)


def sort(device, count, position, way):
    """Sort as the package does: keys, then eight passes of count, scan and scatter."""
    groups = -(-count // 1024)
    device.buffer("_BeamDigits", np.zeros(16 * groups, np.uint32))
    device.buffer("_BeamOrdered", np.zeros(count, np.uint32))
    here, there = (device.buffer("", np.zeros((count, 2), np.uint32)) for _ in range(2))
    device.set(_BeamSortPlane=row(position, 0.0), _BeamSortWay=row(way, 0.0), _BeamSort=[count, groups, 0, 0])
    device.held["_BeamSorted"] = here
    device.compute("Sort.hlsl", "Keys", -(-count // 64))
    for shift in range(0, 32, 4):
        device.set(_BeamSort=[count, groups, shift, 0])
        device.held |= {"_BeamUnsorted": here, "_BeamSorted": there}
        device.compute("Sort.hlsl", "Count", groups)
        device.compute("Sort.hlsl", "Scan", 1)
        device.compute("Sort.hlsl", "Scatter", groups)
        here, there = there, here
    device.held["_BeamUnsorted"] = here
    device.compute("Sort.hlsl", "Order", -(-count // 64))
    device.held["_BeamOrder"] = device.held["_BeamOrdered"]


def set_view(device, camera, near=0.01, low_pass=0.3, antialiased=False):
    """Set one eye; the depth buffer holds near / depth."""
    pose = camera.camera_to_world
    rows = np.zeros((2, 4, 4))
    rows[:, :, :3] = np.stack([pose[:3, 3], pose[:3, 0], pose[:3, 1], pose[:3, 2]])
    device.set(
        _BeamCamera=rows,
        _BeamLens=np.tile([camera.focal_x, camera.focal_y, camera.center_x, camera.center_y], (2, 1)),
        _BeamDepths=np.tile([0.0, near, -1.0, 0.0], (2, 1)),
        _BeamTarget=[camera.width, camera.height, 1.0, near],
        _BeamFilter=[low_pass, float(antialiased), 0.0, 0.0],
    )


def draw_buffer(device, cloud, camera, scene_depth=0.0, regions=False):
    """Draw the G-buffer behind opaque surfaces whose depth is stored as that."""
    sort(device, len(cloud), camera.position, camera.forward)
    set_view(device, camera)
    targets = G_BUFFER | ({"_BeamArrived": "rgba16float"} if regions else {})
    for name, kind in targets.items():
        device.target(name, 1, camera.height, camera.width, kind)
    device.texture("_CameraDepthTexture", np.full((1, camera.height, camera.width, 4), scene_depth))
    defines = ("BEAM_REGIONS",) if regions else ()
    device.draw("Splats.hlsl", ("SplatVertex", "SplatFragment"), list(targets), 6 * len(cloud), defines=defines)


def draw_shadow_maps(device, cloud, maps):
    """Draw the shadow maps of all lamps, or of all regions of the environment."""
    for name in ("_BeamShadowSums", "_BeamShadowFirst"):
        device.target(name, max(len(maps.views), 1), MAP_SIZE, MAP_SIZE)
    device.texture("_BeamShadowMeshes", np.full((max(len(maps.views), 1), MAP_SIZE, MAP_SIZE, 4), 3e38))
    rows = [np.zeros(24)]
    for layer, view in enumerate(maps.views):
        camera, pose = view.camera, view.camera.camera_to_world
        sort(device, len(cloud), camera.position, camera.forward)
        set_view(device, camera, 0.01, 0.1, True)  # as the deferred renderer draws its maps
        device.draw(
            "Splats.hlsl",
            ("SplatVertex", "SplatFragment"),
            ["_BeamShadowSums", "_BeamShadowFirst"],
            6 * len(cloud),
            layer=layer,
            defines=("BEAM_SHADOW_MAP",),
        )
        lens = [camera.focal_x, camera.focal_y, camera.center_x, camera.center_y]
        axes = [pose[:3, 0], view.front, pose[:3, 1], maps.thickness, pose[:3, 2], maps.largest_kernel]
        rows.append(row(camera.position, view.radius, *axes, lens, camera.width, camera.height, 0, 0))
    device.buffer("_BeamShadowViews", np.array(rows[1:] or rows, np.float32))


def set_light(device, shot, maps):
    """Upload environment, table and lamps."""
    irradiance, *levels = prefiltered(shot.environment)
    starts = np.cumsum([0, *(level.shape[0] * level.shape[1] for level in levels)])
    texels = np.concatenate([each.reshape(-1, 3) for each in (*levels, irradiance)])
    device.buffer("_BeamEnvironment", np.column_stack([texels, np.ones(len(texels))]).astype(np.float32))
    table = specular_albedo_table().reshape(-1, 2)
    device.buffer("_BeamAlbedo", np.column_stack([table, np.zeros_like(table)]))
    angle = np.radians(shot.environment_rotation)
    device.set(
        _BeamLevels=[(len(each), start, 0, 0) for each, start in zip((*levels, irradiance), starts, strict=True)],
        _BeamTurn=[np.cos(angle), np.sin(angle), len(shot.lights), 1.0],
    )
    lights = upload_lights(shot.lights, "cpu")
    first, rows = 0, [np.zeros(16)]
    for k, count in enumerate(maps.counts):
        fields = [lights.positions, lights.kinds, lights.directions, lights.sizes, lights.powers]
        place, kind, way, size, power = (field.numpy()[k] for field in fields)
        rows.append(row(place, kind, way, size, power, first, lights.cones.numpy()[k], count, 0))
        first += count
    device.buffer("_BeamLamps", np.array(rows[1:] or rows, np.float32))


def arrive(device, golden):
    """Find what arrives of the environment at each Gaussian, by the maps of its regions."""
    moments = golden.regions.moments.transpose(1, 0, 2)
    device.buffer("_BeamRegions", moments.astype(np.float32))
    count = len(golden.shot.cloud)
    device.buffer("_BeamArrivals", np.zeros((count, 4), np.float32))
    device.set(_BeamCounts=[count, len(moments), 0, 0])
    device.compute("Arriving.hlsl", "Arrive", -(-count // 64))
    device.held["_BeamArriving"] = device.held["_BeamArrivals"]


def picture(device, golden, cloud=None, to_world=None):
    """Return radiance multiplied by alpha, and alpha, ``(H, W, 4)``; of another cloud, in axes that a matrix turns."""
    shot, maps = golden.shot, shadow_maps(golden)
    upload_gaussians(device, shot.cloud if cloud is None else cloud, to_world)
    draw_shadow_maps(device, shot.cloud, maps)
    set_light(device, shot, maps)
    regions = golden.regions is not None
    if regions:
        arrive(device, golden)
    draw_buffer(device, shot.cloud, shot.camera, regions=regions)
    device.target("picture", 1, shot.camera.height, shot.camera.width)
    entries, defines = ("DeferredVertex", "DeferredFragment"), ("BEAM_REGIONS",) if regions else ()
    device.draw("Deferred.hlsl", entries, ["picture"], 3, blend="none", defines=defines)
    return device.image("picture")
