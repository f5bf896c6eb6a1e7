"""Lights that are placed by hand, on a server that nobody looks at."""

import math

import numpy as np
import pytest

from beam_warp.view.lamps import KINDS, MOST_LAMPS, Lamps
from beam_warp.view.server import start_server, stop_server
from beam_warp.view.state import SubjectBox
from beam_warp.world.lights import DirectionalLight, PointLight, SpotLight

pytest.importorskip("viser")

TYPES = {"point": PointLight, "spot": SpotLight, "directional": DirectionalLight}


@pytest.fixture
def placed():
    """Lamps, and the lights that they told last."""
    server = start_server("127.0.0.1", 0, "lamps")
    told = []
    yield Lamps(server, SubjectBox(np.zeros(3), np.ones(3)), told.append), told, server
    stop_server(server)


def test_lights_come_and_go(placed):
    lamps, told, server = placed
    numbers = [lamps.add(kind) for kind in KINDS]
    assert [type(light) for light in told[-1]] == [TYPES[kind] for kind in KINDS]
    assert server.scene.get_handle_by_name(f"/lamps/{numbers[1]}") is not None
    lamps.remove(numbers[1])
    lamps.remove(numbers[1])  # two pages may be as fast as each other
    assert [type(light) for light in told[-1]] == [TYPES["point"], TYPES["directional"]]
    assert server.scene.get_handle_by_name(f"/lamps/{numbers[1]}") is None
    assert lamps.add("point") not in numbers


def test_changes_are_told(placed):
    lamps, told, _ = placed
    lamp = lamps._lamps[lamps.add("point")]
    lamp.change(position=(1.0, 2.0, 3.0), power=5.0, size=0.2, casts_shadows=False)
    (light,) = told[-1]
    assert (light.position, light.intensity, light.radius) == ((1.0, 2.0, 3.0), (5.0, 5.0, 5.0), 0.2)
    assert not light.casts_shadows
    lamp.change(position=(math.nan, 0.0, 0.0), power=math.nan)
    assert told[-1] == (light,)


def test_a_kind_that_is_none_adds_nothing(placed):
    """A page may send any word; a light that cannot be made would keep all later ones from being told."""
    lamps, told, _ = placed
    assert lamps.add("laser") is None
    lamps.add("point")
    assert [type(light) for light in told[-1]] == [PointLight]


def test_there_is_a_most(placed):
    lamps, told, _ = placed
    for _ in range(MOST_LAMPS):
        assert lamps.add("point") is not None
    assert lamps.add("point") is None
    assert len(told[-1]) == MOST_LAMPS
