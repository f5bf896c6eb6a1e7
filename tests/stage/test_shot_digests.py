"""Digests of shots: the same for the same image, another for whatever could change it."""

from dataclasses import replace

import numpy as np
import pytest
from support.drawn_ball import relightable

from beam_warp.stage.shot_digests import ShotDigests
from beam_warp.world.camera import Camera
from beam_warp.world.environment import EnvironmentMap
from beam_warp.world.lights import PointLight
from beam_warp.world.mesh import MaterialMesh
from beam_warp.world.shot import Shot, ShotMesh


def cloud(**changes):
    return relightable(np.zeros((2, 3)), **changes)


def mesh(catches=False):
    shape = {"vertices": np.eye(3), "faces": [[0, 1, 2]], "normals": np.tile([0, 0, 1.0], (3, 1))}
    surface = MaterialMesh(**shape, base_color=np.ones((3, 3)), roughness=np.ones(3))
    return ShotMesh(surface=surface, catches_shadows=np.array([catches]))


def shot(**changes):
    fields = {
        "cloud": cloud(),
        "camera": Camera.look_at((0, -3, 0), (0, 0, 0), width=4, height=4, vertical_fov=30.0),
        "environment": EnvironmentMap.constant((1, 1, 1)),
        "lights": (PointLight(position=(1, 1, 1), intensity=(1, 1, 1)),),
        "mesh": mesh(),
    }
    return Shot(**(fields | changes))


def test_the_same_content_has_the_same_digest():
    assert ShotDigests("path", 64).of(shot()) == ShotDigests("path", 64).of(shot())
    digests = ShotDigests()
    assert digests.of(shot()) == digests.of(shot())


def test_whatever_changes_the_image_changes_the_digest():
    digests = ShotDigests()
    base = shot()
    variants = [
        base,
        replace(base, cloud=cloud(opacities=[1.0, np.nextafter(np.float32(1), np.float32(0))])),
        replace(base, cloud=cloud(roughness=[0.5, 0.6])),
        replace(base, cloud=cloud().select([0])),
        replace(base, camera=Camera.look_at((0, -3, 1e-9), (0, 0, 0), width=4, height=4, vertical_fov=30.0)),
        replace(base, camera=base.camera.cropped(0, 0, 4, 3)),
        replace(base, environment=None),
        replace(base, environment=EnvironmentMap.constant((1, 1, 1), height=8)),
        replace(base, environment=EnvironmentMap.constant((1, 1, 2))),
        replace(base, environment_rotation=1.0),
        replace(base, lights=()),
        replace(base, lights=(PointLight(position=(1, 1, 1), intensity=(1, 1, 1), radius=0.1),)),
        replace(base, lights=base.lights * 2),
        replace(base, mesh=None),
        replace(base, mesh=mesh(catches=True)),
    ]
    assert len({digests.of(variant) for variant in variants}) == len(variants)


def test_what_decides_besides():
    decisive = [(), ("a",), ("a", "b"), ("ab",), (1,), (1.0,), (True,), (None,), ({"a": 1},), ((1, 2), 3), (1, (2, 3))]
    assert len({ShotDigests(*values).of(shot()) for values in decisive}) == len(decisive)
    assert ShotDigests({"a": 1, "b": 2}).of(shot()) == ShotDigests({"b": 2, "a": 1}).of(shot())


def test_what_is_no_plain_data_is_refused():
    with pytest.raises(TypeError, match="what is digested must be plain data, got object"):
        ShotDigests(object())
