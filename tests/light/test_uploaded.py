"""Lights on a device: every type has its entries, and what is no light is refused everywhere."""

from types import SimpleNamespace

import numpy as np
import pytest
from support.figure_asset import figure_asset

from beam_warp.errors import InvalidOptionError
from beam_warp.light.uploaded import ROWS, upload_lights
from beam_warp.render.shadow_maps import VIEWS, ShadowCasters, light_views
from beam_warp.world.camera import Camera
from beam_warp.world.lights import LIGHT_TYPES, PointLight, lights_to_json
from beam_warp.world.shot import Shot

LAMP = SimpleNamespace(position=(0, 0, 1), intensity=(1, 1, 1), radius=0.0, casts_shadows=True)
"""An object with all that a point light has, but that is none."""


def shot_of(light):
    cloud = figure_asset(frame_count=1)[0]
    return Shot(cloud=cloud, camera=Camera.frame_cloud(cloud.positions, width=8, height=8), lights=(light,))


def test_every_type_of_light_has_its_entries():
    assert set(ROWS) == set(VIEWS) == set(LIGHT_TYPES.values())


@pytest.mark.parametrize(
    "take",
    [
        lambda: upload_lights([PointLight(position=(0, 0, 1), intensity=(1, 1, 1)), LAMP], "cpu"),
        lambda: light_views(LAMP, ShadowCasters(np.zeros(3), 1.0), 16),
        lambda: lights_to_json([LAMP]),
        lambda: shot_of(LAMP),
    ],
    ids=["upload", "shadow views", "JSON", "shot"],
)
def test_what_is_no_light_is_refused(take):
    known = "DirectionalLight, PointLight, SpotLight"
    with pytest.raises(
        InvalidOptionError, match=rf"lights must be of {known}, got SimpleNamespace\. Choose one of these types\."
    ):
        take()


def test_without_lights_there_is_one_row_of_nothing():
    arrays = upload_lights([], "cpu")
    assert arrays.count == 0
    assert len(arrays.kinds) == 1
    assert not arrays.powers.numpy().any()
