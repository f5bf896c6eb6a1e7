"""Small assets with every channel, made afresh for each test."""

import numpy as np
import pytest
from support.broken_assets import Asset

from beam_warp.image.color import DISPLAY_SRGB
from beam_warp.world.gaussians import GaussianCloud, GaussianSequence


def make_cloud(seed=0, count=6, *, degree=1, relightable=True, axes="rub", **changes):
    """A cloud whose positions, orientations and occlusion depend on the seed, and nothing else does."""
    moving, fixed = np.random.default_rng(seed), np.random.default_rng(99)

    def directions(rng, columns):
        vectors = rng.normal(size=(count, columns))
        return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)

    arrays = {
        "positions": moving.normal(size=(count, 3)),
        "orientations": directions(moving, 4),
        "scales": 0.01 + 0.05 * fixed.random((count, 3)),
        "opacities": fixed.random(count),
    }
    if degree is not None:
        arrays |= {"radiance": fixed.normal(size=(count, (degree + 1) ** 2, 3)), "radiance_color_space": DISPLAY_SRGB}
    if relightable:
        arrays |= {
            "base_color": fixed.random((count, 3)),
            "roughness": fixed.random(count),
            "ambient_occlusion": moving.random(count),
            "normals": directions(fixed, 3),
            "normal_confidence": fixed.random(count),
            "ambient_occlusion_error": fixed.random(count),
            "base_color_error": 2.0 * fixed.random((count, 3)),
            "observability": fixed.integers(0, 64, count),
            "ids": np.arange(count) * 10**12,
            "roughness_error": 0.5 * fixed.random(count),
        }
    return GaussianCloud(**(arrays | changes), axes=axes)


def make_sequence(frames=3, count=6, *, metadata=None, **options):
    return GaussianSequence.from_clouds(
        [make_cloud(seed, count, **options) for seed in range(frames)], frames_per_second=24.0, metadata=metadata
    )


@pytest.fixture
def cloud():
    return make_cloud


@pytest.fixture
def sequence():
    return make_sequence


@pytest.fixture
def asset(tmp_path):
    return Asset(tmp_path, make_sequence, make_cloud)
