"""Poses, axes, pixel centres and depth agree with an independent renderer: exact meshes drawn over its pictures."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import ndimage

from beam_warp.assets import GaussianCloud
from beam_warp.captures import Capture
from beam_warp.rasterizing import rasterize

SAMPLES = 200_000
"""Discs on the mesh: 3 mm apart on a person, half a pixel of these captures."""

FINER = 4
"""Times finer than the picture: the low-pass then widens a silhouette by a quarter of a picture's pixel."""

MAX_DEPTH_ERROR = 2e-3
"""[m], median. A pixel spans 6 mm; half a pixel of shift in either direction moves the median further than this."""

MIN_OVERLAP = 0.96
"""Intersection over union. The outline of these figures is 8 % of their area in pixels: a shift of half a pixel along
both sides, or the quarter of a pixel above, costs less than 4 %; mirrored or turned views cost tens of per cent."""


def surface_discs(vertices, faces, rng):
    """Opaque discs that cover a mesh, uniform by area."""
    corners = vertices[faces].astype(np.float64)
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = 0.5 * np.linalg.norm(cross, axis=1)
    face = rng.choice(len(area), SAMPLES, p=area / area.sum())
    normals = cross[face] / (2.0 * area[face, None])
    turn = np.concatenate([np.cross([0.0, 0.0, 1.0], normals), 1.0 + normals[:, 2:]], axis=1)
    turn[turn[:, 3] < 1e-9] = (1.0, 0.0, 0.0, 0.0)  # straight down
    spacing = np.sqrt(area.sum() / SAMPLES)
    return GaussianCloud(
        positions=np.einsum("ni,nij->nj", rng.dirichlet([1, 1, 1], SAMPLES), corners[face]),
        orientations=turn / np.linalg.norm(turn, axis=1, keepdims=True),
        scales=np.tile([0.5 * spacing, 0.5 * spacing, 0.0], (SAMPLES, 1)),
        opacities=np.ones(SAMPLES),
    )


def finer(camera):
    """The same view with smaller pixels."""
    names = ("width", "height", "focal_x", "focal_y", "center_x", "center_y")
    return replace(camera, **{name: FINER * getattr(camera, name) for name in names})


@pytest.mark.parametrize("name", ["walker", "runner"])
def test_drawn_meshes_lie_on_the_truth(data_dir, rng, name):
    folder = data_dir / "captures" / name
    records = [r for r in Capture.read(folder).select(split="test", frames=[0]) if r.truth_path is not None]
    assert len(records) == 4
    mesh = np.load(folder / "truth" / "mesh_0000.npz")
    cloud = surface_discs(mesh["vertices"], mesh["faces"], rng)
    for record in records[:2]:
        truth = record.truth().channels
        coverage = truth["A"]
        buffer = rasterize(cloud, record.camera, channels=(), device="cpu")
        solid = coverage > 0.999
        assert (buffer.alpha[solid] > 0.99).mean() > 0.99
        depth_error = np.abs(buffer.depth - truth["depth"])[solid]
        assert np.median(depth_error) < MAX_DEPTH_ERROR, record.name
        drawn = rasterize(cloud, finer(record.camera), channels=(), device="cpu").alpha
        height, width = coverage.shape
        drawn = drawn.reshape(height, FINER, width, FINER).mean(axis=(1, 3)) > 0.5
        wanted = coverage > 0.5
        overlap = (drawn & wanted).sum() / (drawn | wanted).sum()
        assert overlap > MIN_OVERLAP, record.name
        assert not (drawn & ~ndimage.binary_dilation(wanted, iterations=2)).any()
