"""What a job finds once and keeps is found again when anything changes that decides it: exposure and roughness."""

from itertools import count
from types import SimpleNamespace

import numpy as np
import pytest
import warp as wp
from support.shapes import cloud_of, colored, sphere_points, tiles

from beam_warp.capture.digests import CaptureDigests
from beam_warp.decomposition.archive import FrameArchive
from beam_warp.decomposition.capture_light import prepare_light
from beam_warp.decomposition.options import RunOptions
from beam_warp.decomposition.plan import JobPlan
from beam_warp.decomposition.roughness_finder import RoughnessFinder
from beam_warp.decomposition.source import Source
from beam_warp.image.color import DISPLAY_SRGB
from beam_warp.jobs.listeners import no_progress
from beam_warp.jobs.progress import JobLog
from beam_warp.world.environment import EnvironmentMap
from beam_warp.world.gaussians import GaussianSequence

LIGHT = EnvironmentMap.constant((1.0, 0.9, 0.8), height=8)


def balls(*greys):
    """A frame of each grey."""
    points, spacing = sphere_points(20)
    cloud = cloud_of(tiles(points, points, spacing))
    return GaussianSequence.from_clouds([colored(cloud, np.full((20, 3), grey), DISPLAY_SRGB) for grey in greys])


def images(digest):
    """Images that carry no scale, as far as a job looks before it reads them."""
    return SimpleNamespace(is_display_referred=lambda _: True, has_light=False, digest=lambda *_: digest)


def source_of(folder, sequence, shown=None):
    log = JobLog(no_progress, len(sequence), wp.get_device("cpu"))
    options = RunOptions(roughness="estimate", device="cpu")
    digests = CaptureDigests(folder)
    return Source(sequence=sequence, images=shown, options=options, digests=digests, device="cpu", log=log)


@pytest.mark.parametrize(
    "change",
    [{"light": LIGHT.scaled(2.0)}, {"described": "other options"}, {"greys": (0.4,)}, {"shown": images("digest")}],
    ids=lambda change: next(iter(change)),
)
def test_exposure(tmp_path, monkeypatch, change):
    searches = count()
    monkeypatch.setattr("beam_warp.decomposition.capture_light._exposure_stops", lambda *_: float(next(searches)))

    def stops(greys=(0.3,), light=LIGHT, described="options", shown=None):
        return prepare_light(light, source_of(tmp_path, balls(*greys), shown), described, tmp_path).stops

    assert [stops(), stops(), stops(**change), stops(**change)] == [0.0, 0.0, 1.0, 1.0]


@pytest.mark.parametrize("persistent", [True, False])
@pytest.mark.parametrize(
    "change",
    [{"key": "another light"}, {"greys": (0.4, 0.3)}, {"greys": (0.3, 0.4)}, {"shown": images("digest")}],
    ids=["light", "first frame", "second frame", "images"],
)
def test_roughness(tmp_path, monkeypatch, persistent, change):
    """Every frame of persistent Gaussians decides it; of others, the frame that is asked for."""
    searches = count()
    monkeypatch.setattr(RoughnessFinder, "_profile", lambda *_: next(searches))
    monkeypatch.setattr(
        "beam_warp.decomposition.roughness_finder.solve_roughness",
        lambda _, profile: SimpleNamespace(roughness=np.float32([profile]), standard_error=np.zeros(1), report={}),
    )

    def found(greys=(0.3, 0.3), key="light and options", shown=None):
        source, archive = source_of(tmp_path, balls(*greys), shown), FrameArchive(tmp_path, None)
        plan = JobPlan(source=source, light=None, persistent=persistent, key=key, archive=archive)
        return RoughnessFinder(plan).arrays(source.first)["roughness"][0]

    other = 0.0 if change == {"greys": (0.3, 0.4)} and not persistent else 1.0
    assert [found(), found(), found(**change), found(**change)] == [0.0, 0.0, other, other]
