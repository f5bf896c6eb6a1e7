"""What a job finds once and keeps is found again when anything changes that decides it: the light and roughness."""

from itertools import count
from types import SimpleNamespace

import numpy as np
import pytest
from support.shapes import cloud_of, colored, sphere_points, tiles

from beam_warp.decomposition.frames import GivenFrames
from beam_warp.decomposition.options import RunOptions
from beam_warp.decomposition.work import MaterialWork
from beam_warp.image.color import DISPLAY_SRGB
from beam_warp.materials.light_rays import MaterialOptions
from beam_warp.plan.steps import Task, perform
from beam_warp.raster.records import RasterOptions
from beam_warp.world.environment import EnvironmentMap
from beam_warp.world.gaussians import GaussianSequence

LIGHT = EnvironmentMap.constant((1.0, 0.9, 0.8), height=8)


def balls(*greys):
    """A frame of each grey."""
    points, spacing = sphere_points(20)
    cloud = cloud_of(tiles(points, points, spacing))
    return GaussianSequence.from_clouds([colored(cloud, np.full((20, 3), grey), DISPLAY_SRGB) for grey in greys])


IMAGES = SimpleNamespace(
    raster=RasterOptions(), is_display_referred=lambda _: True, has_light=False, digest=lambda *_: "digest"
)
"""Images as far as a job looks before it reads them."""


@pytest.fixture
def found(tmp_path, monkeypatch):
    """A function that makes a job's light and roughness, and says how often each has been searched for so far."""
    lights, estimates = count(), count()

    def find_light(environment, source):
        turn = [np.nan, np.inf, 0.0, np.nan, np.nan]
        return {"numbers": np.array([*turn, next(lights), 0.0]), "findings": np.frombuffer(b"[]", np.uint8)}

    def find_roughness(positions, profiles, frame_count):
        return SimpleNamespace(roughness=np.float32([next(estimates)]), standard_error=np.zeros(1), report={})

    monkeypatch.setattr("beam_warp.decomposition.work.find_light", find_light)
    monkeypatch.setattr("beam_warp.decomposition.work.find_roughness", find_roughness)
    monkeypatch.setattr("beam_warp.decomposition.work.are_silent", lambda *asked: True)

    def find(greys=(0.3, 0.3), light=LIGHT, samples=8, shown=None):
        options = RunOptions(
            roughness="estimate", persistent=True, materials=MaterialOptions(sample_count=samples), device="cpu"
        )
        work = MaterialWork(tmp_path, GivenFrames(lambda: balls(*greys), None), light, options)
        work.images = shown
        work.prepare()
        plan, keys = work.plan(), dict[str, str]()
        for step in plan.steps:
            if step.stage in ("light", "profile", "roughness"):
                task = Task(step, tuple(map(keys.__getitem__, step.inputs)))
                keys[step.name] = perform(plan.works, task, lambda *step: None).key
        return work.job.light.stops, float(work._roughness(work.source.first, {})["roughness"][0])

    return find


@pytest.mark.parametrize(
    ("change", "light"),
    [
        ({"light": LIGHT.scaled(2.0)}, 1.0),
        ({"samples": 16}, 1.0),
        ({"greys": (0.4, 0.3)}, 1.0),
        ({"greys": (0.3, 0.4)}, 0.0),
        ({"shown": IMAGES}, 1.0),
    ],
    ids=["light", "options", "first frame", "second frame", "images"],
)
def test_what_decides_it_is_in_its_key(found, change, light):
    """The first frame decides the light; every frame of persistent Gaussians their roughness."""
    assert [found(), found(), found(**change), found(**change)] == [(0.0, 0.0)] * 2 + [(light, 1.0)] * 2
