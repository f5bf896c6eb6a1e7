"""The 3D filter's limits: closed forms at the borders, a float64 twin, refusals, threads."""

import numpy as np
import pytest
import warp as wp

from beam_warp.errors import InvalidArrayError, InvalidOptionError
from beam_warp.reconstruction.sampling_limits import FILTER_VARIANCE, IMAGE_MARGIN, NEAR, SamplingLimits
from beam_warp.world.camera import Camera


def limits(positions, cameras, device, count=None):
    out = wp.full(len(positions) if count is None else count, -1.0, dtype=float, device=device)
    SamplingLimits(cameras, device=device).write(wp.array(positions, dtype=wp.vec3, device=device), out)
    return out.numpy()


def camera(focal=100.0, width=60, height=40, pose=None):
    return Camera(width, height, focal, 0.8 * focal, 0.5 * width, 0.5 * height, np.eye(4) if pose is None else pose)


def twin(positions, cameras):
    """The limits in float64, a camera at a time."""
    finest = np.full(len(positions), np.inf)
    for one in cameras:
        x, y, z = one.project(positions).T
        with np.errstate(invalid="ignore"):
            across = np.abs(x / one.width - 0.5) <= 0.5 + IMAGE_MARGIN
            down = np.abs(y / one.height - 0.5) <= 0.5 + IMAGE_MARGIN
        sees = (z > NEAR) & across & down
        finest = np.where(sees, np.minimum(finest, z / max(one.focal_x, one.focal_y)), finest)
    return np.where(np.isfinite(finest), np.sqrt(FILTER_VARIANCE) * finest, 0.0)


def test_a_pixel_at_the_nearest_view(device):
    near, far = camera(), np.eye(4)
    far[2, 3] = -3.0
    found = limits([[0.0, 0.0, 2.0]], [camera(pose=far), near], device)
    np.testing.assert_allclose(found, np.sqrt(0.2) * 2.0 / 100.0, rtol=1e-6)


@pytest.mark.parametrize(
    ("position", "seen"),
    [
        ((0.0, 0.0, 0.5), True),
        ((0.0, 0.0, 0.0099), False),
        ((0.0, 0.0, -1.0), False),
        ((0.389, 0.0, 1.0), True),  # 30 + 0.15 * 60 = 39 pixels from the centre at a focal length of 100
        ((0.391, 0.0, 1.0), False),
        ((-0.389, 0.0, 1.0), True),
        ((0.0, 0.324, 1.0), True),  # 20 + 0.15 * 40 = 26 pixels at 80
        ((0.0, -0.326, 1.0), False),
        ((np.nan, 0.0, 1.0), False),
    ],
)
def test_where_a_view_ends(device, position, seen):
    assert (limits([position], [camera()], device)[0] > 0.0) == seen


@pytest.mark.parametrize("count", [255, 257, 5000])
def test_equals_the_twin(device, rng, count):
    cameras = [
        Camera.look_at(rng.normal(0.0, 3.0, 3), rng.normal(0.0, 0.3, 3), width=50, height=40, vertical_fov=f)
        for f in (15.0, 30.0, 45.0, 60.0, 75.0)
    ]
    positions = rng.normal(0.0, 1.5, (count, 3)).astype(np.float32)
    expected = twin(positions, cameras)
    found = limits(positions, cameras, device)
    # Depths are sums of four products of magnitude 10: 1e-5 metres; borders may fall either way within that.
    edge = np.abs(expected - found) > 1e-5
    for i in np.flatnonzero(edge):
        around = twin(positions[i] + rng.normal(0.0, 1e-5, (64, 3)), cameras)
        assert np.abs(around - found[i]).min() < 1e-5
    assert edge.mean() < 1e-2


def test_refusals():
    with pytest.raises(InvalidOptionError, match="cameras must be at least one"):
        SamplingLimits([], device="cpu")
    with pytest.raises(InvalidArrayError, match="limits must be a warp array"):
        limits(np.zeros((3, 3)), [camera()], "cpu", count=2)
