"""The picture of an evaluation: truth, ours and what differs, and nothing differs where nothing does."""

from dataclasses import replace

import numpy as np
import pytest
from support.figure_asset import figure_asset

from beam_warp.evaluate.materials import EvaluateOptions, score_materials
from beam_warp.evaluate.perceptual import PerceptualMetrics
from beam_warp.evaluate.sheet import SHADE, evaluation_sheet
from beam_warp.image.panels import MARGIN, TITLE_HEIGHT


@pytest.fixture(scope="module")
def views(relit_capture):
    kept = []
    asset, options = figure_asset(frame_count=1), EvaluateOptions(samples=1, relighters=(), device="cpu")
    score_materials(asset, relit_capture, options, metrics=PerceptualMetrics(), observe=kept.append)
    return kept


def panels(sheet, columns, lines):
    """Cut a sheet into its panels."""
    height = (sheet.shape[0] - MARGIN) // lines - TITLE_HEIGHT - MARGIN
    width = (sheet.shape[1] - MARGIN) // columns - MARGIN
    places = [(line, column) for line in range(lines) for column in range(columns)]
    tops = [MARGIN + line * (height + TITLE_HEIGHT + MARGIN) + TITLE_HEIGHT for line, _ in places]
    lefts = [MARGIN + column * (width + MARGIN) for _, column in places]
    return [sheet[top : top + height, left : left + width] for top, left in zip(tops, lefts, strict=True)]


def test_equal_images_do_not_differ(views):
    """Novel view, occlusion, base colour and roughness: two lines of two for each view."""
    same = [
        replace(
            view,
            truth=replace(view.truth, channels=view.drawn.layers()),
            drawn=replace(view.drawn, radiance=view.record.image().linear_rgba()[..., :3]),
        )
        for view in views[:2]
    ]
    found = panels(evaluation_sheet(same), 6, 4)
    for first in range(0, 24, 3):
        truth, ours, difference = found[first : first + 3]
        if first % 6 or first % 12:  # the novel view's coverage is ours in one and the capture's in the other
            np.testing.assert_array_equal(truth, ours)
        assert difference.max() == 0
        assert (truth != SHADE).any()


def test_a_difference_is_four_times_as_bright(views):
    """Occlusion too dark by 0.1 of the coverage differs by 0.4 of it."""
    (view,) = views[:1]
    layers = view.drawn.layers()
    layers["ambient_occlusion"] = np.minimum(layers["ambient_occlusion"] + np.float32(0.1), 1.0)
    other = replace(view, truth=replace(view.truth, channels=layers))
    difference = panels(evaluation_sheet([other]), 6, 2)[5]
    assert difference.max() == round(255 * 0.4 * float(layers["A"].max()))
    assert (difference[..., 0] == difference[..., 1]).all()
