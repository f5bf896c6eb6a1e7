"""Poses, axes, pixel centres and depth agree with an independent renderer: exact meshes drawn over its pictures."""

import numpy as np
from scipy import ndimage

from beam_warp.capture.capture import Capture
from beam_warp.image.metrics import angles_between, block_means
from beam_warp.raster.gbuffer import rasterize
from beam_warp.world.gaussians import GaussianCloud
from beam_warp.world.quaternions import turns_from_z

SAMPLES = 200_000
"""Discs on the mesh, one standard deviation apart: 3 mm on a person, half a pixel of these captures."""

FINER = 4
"""Times finer than the picture, whose box filter is then a mean: the low-pass is half of a fine pixel."""

MAX_DEPTH_ERROR = 5e-4
"""[m], median over solid pixels. A shift of half a pixel, the likeliest mistake, makes it 1.2 mm or more."""

MAX_NORMAL_ERROR = 5.0
"""[degree], median over solid pixels. The truth's are smooth where the mesh is flat, which makes it 2.6 at most."""

MIN_OVERLAP = 0.95
"""Intersection over union. Discs on the outline reach over it by about their standard deviation, half a pixel, and the
outline of these figures is 8 % of their area per pixel of width. A mirrored or turned view overlaps by half at most."""


def surface_discs(vertices, faces, rng):
    """Opaque discs that cover a mesh, uniform by area."""
    corners = vertices[faces].astype(np.float64)
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = 0.5 * np.linalg.norm(cross, axis=1)
    face = rng.choice(len(area), SAMPLES, p=area / area.sum())
    normals = cross[face] / (2.0 * area[face, None])
    spacing = np.sqrt(area.sum() / SAMPLES)
    return GaussianCloud(
        positions=np.einsum("ni,nij->nj", rng.dirichlet([1, 1, 1], SAMPLES), corners[face]),
        orientations=turns_from_z(normals),
        scales=np.tile([spacing, spacing, 0.0], (SAMPLES, 1)),
        opacities=np.ones(SAMPLES),
        normals=normals,
    )


def test_drawn_meshes_lie_on_the_truth(data_dir, rng):
    folder = data_dir / "captures" / "walker"
    records = [r for r in Capture.read(folder).select(split="test", frames=[0]) if r.truth_path is not None]
    assert len(records) == 4
    mesh = np.load(folder / "truth" / "mesh_0000.npz")
    cloud = surface_discs(mesh["vertices"], mesh["faces"], rng)
    for record in records[:2]:
        truth = record.truth().channels
        coverage = truth["A"]
        buffer = rasterize(cloud, record.camera.supersampled(FINER), channels=("normals",), device="cpu")
        alpha = block_means(buffer.alpha, FINER)
        depth = block_means(buffer.alpha * buffer.depth, FINER) / np.maximum(alpha, 1e-6)
        normals = block_means(buffer.channels["normals"], FINER)
        solid = coverage > 0.999
        known = record.truth().stack("normal.X", "normal.Y", "normal.Z")
        assert np.median(angles_between(normals[solid], known[solid])) < MAX_NORMAL_ERROR, record.name
        assert (alpha[solid] > 0.99).mean() > 0.99
        assert np.median(np.abs(depth - truth["depth"])[solid]) < MAX_DEPTH_ERROR, record.name
        drawn, wanted = alpha > 0.5, coverage > 0.5
        assert (drawn & wanted).sum() / (drawn | wanted).sum() > MIN_OVERLAP, record.name
        assert not (drawn & ~ndimage.binary_dilation(wanted, iterations=2)).any()
