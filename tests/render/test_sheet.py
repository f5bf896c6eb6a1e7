"""The picture of an asset: each panel is what its title says."""

import numpy as np
from support.shapes import cloud_of, sphere_points, tiles

from beam_warp.image.color import LINEAR_REC709
from beam_warp.image.files import display_image
from beam_warp.image.panels import MARGIN, TITLE_HEIGHT, over_background
from beam_warp.raster.resolution import LEAST_SAMPLES
from beam_warp.render.channels import see_channel
from beam_warp.render.sheet import Relighting, contact_sheet
from beam_warp.world.camera import Camera
from beam_warp.world.environment import EnvironmentMap


def panels(sheet, width, height):
    """Panels in reading order."""
    down = range(MARGIN + TITLE_HEIGHT, len(sheet) - height, height + TITLE_HEIGHT + MARGIN)
    across = range(MARGIN, sheet.shape[1] - width, width + MARGIN)
    return [sheet[top : top + height, left : left + width] for top in down for left in across]


def test_panels_show_channels_and_relightings(rng):
    points, spacing = sphere_points(400)
    cloud = cloud_of(
        tiles(points, points, spacing),
        radiance=rng.normal(0.0, 0.3, (400, 4, 3)),
        radiance_color_space=LINEAR_REC709,
        base_color=np.ones((400, 3)),
        roughness=rng.random(400),
        ambient_occlusion=rng.random(400),
        normals=points,
    )
    camera = Camera.orbit((0.0, 0.0, 0.0), 4.0, 20.0, 10.0, width=40, height=30, vertical_fov=40.0)
    white = Relighting("white", EnvironmentMap.constant((3.0, 3.0, 3.0), height=16))
    found = panels(contact_sheet(cloud, camera, [white], device="cpu"), 40, 30)
    names = ("radiance", "ambient_occlusion", "base_color", "roughness", "normals")
    seen = {name: see_channel(cloud, camera, name, samples=LEAST_SAMPLES, device="cpu") for name in names}
    alpha = seen["radiance"].alpha[..., None]
    for name, panel in zip(names, found, strict=False):
        values = seen[name].values
        gray = name in ("ambient_occlusion", "roughness")
        expected = over_background(values[..., None].repeat(3, -1), alpha) if gray else seen[name].picture()
        np.testing.assert_array_equal(panel, expected)
    # a white open surface sends back all light, which is exposed to 0.85
    opened = cloud.with_arrays(ambient_occlusion=np.ones(400))
    relit = panels(contact_sheet(opened, camera, [white], device="cpu"), 40, 30)[5].astype(int)
    expected = over_background(display_image(np.full((30, 40, 3), 0.85, np.float32)) / 255.0, alpha)
    assert np.abs(relit - expected).max() <= 1
