"""`.splat` files: bytes that are packed here from the layout, and what a round trip may lose."""

import struct

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from support.radiant_cloud import radiant_cloud
from support.shapes import unit

from beam_warp import converters
from beam_warp.errors import AssetFormatError
from beam_warp.image.color import DISPLAY_SRGB
from beam_warp.world.gaussians import GaussianSequence
from beam_warp.world.harmonics import SH_C0

EPSILON = np.finfo(np.float32).eps


def row(position, scale, rgba, wxyz):
    return struct.pack("<6f8B", *position, *scale, *rgba, *wxyz)


SOUND = row((1, -2, 3), (0.5, 0.25, 0.125), (255, 0, 51, 204), (128, 255, 128, 128))


def test_rows_are_read_as_the_layout_says(tmp_path):
    (tmp_path / "a.splat").write_bytes(SOUND + row((0, 0, 0), (0, 1, 2), (0, 0, 0, 0), (0, 128, 128, 128)))
    sequence = converters.read(tmp_path / "a.splat")
    cloud = sequence[0]
    assert cloud.positions.tolist() == [[1, -2, 3], [0, 0, 0]]
    assert cloud.scales.tolist() == [[0.5, 0.25, 0.125], [0, 1, 2]]
    assert cloud.orientations.tolist() == [[1, 0, 0, 0], [0, 0, 0, -1]]
    assert np.allclose(cloud.opacities, [0.8, 0.0], rtol=EPSILON)
    assert np.allclose(0.5 + SH_C0 * cloud.radiance[:, 0], [[1.0, 0.0, 0.2], [0, 0, 0]], atol=2 * EPSILON)
    assert (cloud.axes, cloud.radiance_color_space, cloud.sh_degree) == ("rdf", DISPLAY_SRGB, 0)
    assert sequence.metadata["notes"].startswith("axes are not stated: taken as rdf")


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (SOUND[:-1], r"a\.splat must have rows of 32 bytes, got 31 bytes"),
        (SOUND + row((0, 0, 0), (1, 1, 1), (0, 0, 0, 0), (128,) * 4), "got a zero quaternion at row 1"),
        (
            row((np.nan, 0, 0), (1, 1, 1), (0, 0, 0, 0), (0,) * 4),
            "positions must be finite, got NaN or infinity at row 0",
        ),
        (row((0, 0, 0), (1, -1, 1), (0, 0, 0, 0), (0,) * 4), r"scales must lie in \[0, .*got -1 at row 0"),
    ],
)
def test_malformed_files_are_refused_and_rows_dropped_on_request(tmp_path, content, message):
    (tmp_path / "a.splat").write_bytes(content)
    with pytest.raises(AssetFormatError, match=message):
        converters.read(tmp_path / "a.splat")
    if len(content) == 64:
        assert len(converters.read(tmp_path / "a.splat", drop_invalid=True)[0]) == 1


@settings(max_examples=30, deadline=None)
@given(
    orientations=arrays(np.float64, (4, 4), elements=st.floats(-1, 1)).filter(
        lambda q: (np.linalg.norm(q, axis=1) > 0.1).all()
    ),
    radiance=arrays(np.float32, (4, 4, 3), elements=st.floats(-4.0, 4.0, width=32)),
    opacities=arrays(np.float32, (4,), elements=st.floats(0.0, 1.0, width=32)),
)
def test_a_round_trip_loses_at_most_half_a_step(tmp_path_factory, orientations, radiance, opacities):
    path = tmp_path_factory.mktemp("trip") / "a.splat"
    cloud = radiant_cloud(4, orientations=unit(orientations), radiance=radiance, opacities=opacities, axes="rdf")
    converters.write(GaussianSequence.from_clouds([cloud]), path)
    back = converters.read(path)[0]
    assert np.array_equal(back.positions, cloud.positions)
    assert np.array_equal(back.scales, cloud.scales)
    assert np.abs(back.opacities - cloud.opacities).max() <= 0.5 / 255 + EPSILON
    shown = np.clip(0.5 + SH_C0 * cloud.radiance[:, 0], 0.0, 1.0)
    assert np.abs(0.5 + SH_C0 * back.radiance[:, 0] - shown).max() <= 0.5 / 255 + 4 * EPSILON
    # Each component is off by at most 1/256, so the vector by 2/256, and once more by the division by its length.
    signs = np.sign(np.sum(back.orientations * cloud.orientations, axis=1, keepdims=True))
    assert np.linalg.norm(back.orientations * signs - cloud.orientations, axis=1).max() <= 4 / 256
