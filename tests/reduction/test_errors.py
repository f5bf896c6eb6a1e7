"""Where merged Gaussians err is measured, and the merge after that keeps more of them there."""

from dataclasses import replace

import numpy as np
import pytest
from reduction.test_job import LIGHTS, QUICK, ball

from beam_warp.evaluate.relit import RelitComparison
from beam_warp.raster.rasterizer import Rasterizer
from beam_warp.raster.sources import upload_gaussians
from beam_warp.reduction.errors import carried_errors
from beam_warp.reduction.job import Reducer
from beam_warp.reduction.merging import MergeOrder
from beam_warp.reduction.sensitivity import MATERIALS, material_rows
from beam_warp.world.clusters import Clusters

COUNT = 1200


@pytest.fixture(scope="module")
def half_fine() -> Reducer:
    """A ball whose upper part has fine rings of light and dark, and whose lower part has one colour."""
    plain = ball(COUNT)
    height = plain[0].positions[:, 2:]
    rings = 0.5 + 0.4 * np.sin(14.0 * height) * np.ones(3)
    cloud = plain[0].with_arrays(base_color=np.where(height > 0.2, rings, 0.4))
    options = replace(QUICK, height=64, views=24, steps=96)
    return Reducer(replace(plain, read_frame=lambda _: cloud), LIGHTS, options)


def merged_by(order: MergeOrder, reducer: Reducer, count: int):
    """Clusters of the original's Gaussians, and the Gaussian that each becomes."""
    labels, cloud = order.labels(count), reducer.original[0]
    return labels, Clusters(cloud, labels, reducer.sensitivity.visible).cloud(cloud)


def test_carried_errors_are_those_of_pixels_by_alpha(half_fine):
    _, cloud = merged_by(half_fine._order, half_fine, 200)
    found = half_fine.sensitivity
    how = {"raster": half_fine.raster, "device": "cpu"}
    errors = carried_errors({0: cloud}, found, **how)
    assert errors.min() >= 0.0
    total = 0.0
    for view in found.views:
        drawer = Rasterizer(len(cloud), [view.camera], value_count=MATERIALS, options=half_fine.raster, device="cpu")
        images, slopes = drawer.draw(upload_gaussians(cloud, "cpu", values=material_rows(cloud))), drawer.adjoints()
        view.slopes(images, slopes)
        away = images.channels[0].numpy() - view.target.numpy(), images.alpha.numpy() - view.alpha.numpy()
        each = (away[0] * slopes.channels[0].numpy()).sum(axis=1) + away[1] * slopes.alpha.numpy()  # Euler: twice d'Md
        total += 0.5 * float(each @ images.alpha.numpy())
    assert errors.sum() == pytest.approx(total, rel=1e-4)
    assert carried_errors({0: half_fine.original[0]}, found, **how).max() < 1e-6 * errors.max()


def test_more_is_kept_where_a_first_merge_errs_and_relit_images_are_closer(half_fine, monkeypatch):
    weighted, plain = half_fine._order, MergeOrder([half_fine.original[0]], half_fine.sensitivity, "cpu")
    monkeypatch.setattr(half_fine, "_order", plain)
    bad = half_fine._factors() > 1.5
    comparison = RelitComparison(half_fine.original, half_fine.trials, device="cpu")
    draws = half_fine.trials.draw("certificate", range(16), [0])
    kept, psnr = [], []
    for order in (plain, weighted):
        monkeypatch.setattr(half_fine, "_order", order)
        kept.append(len(set(order.labels(240)[bad])))
        psnr.append(comparison.errors(half_fine.reduced(240), draws, keep=True).psnr.mean())
    assert kept[1] > 1.5 * kept[0]
    assert psnr[1] > psnr[0] + 0.1
