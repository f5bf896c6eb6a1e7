"""One picture of an evaluation: for some views the truth, ours and what differs, channel by channel."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from beam_warp.evaluate.drawn import true_channel
from beam_warp.evaluate.scores import ImageScore
from beam_warp.evaluate.views import ScoredView
from beam_warp.image.color import linear_to_srgb
from beam_warp.image.metrics import bounding_box
from beam_warp.image.panels import BACKGROUND, Panel, gray, lay_out

AMPLIFICATION = 4
"""Factor by which differences are brightened: a quarter of the display's range becomes white."""

MARGIN = 4
"""Width of the margin around the subject [pixel of the view]."""

ROWS = (300, 600)
"""Panels of fewer rows are enlarged, those of more reduced, by a whole factor."""

SHADE = round(255 * BACKGROUND)


class _Compared(NamedTuple):
    """One channel of one view; images are display-referred and over black, coverage is apart."""

    title: str
    ours: NDArray[np.floating[Any]]
    truth: NDArray[np.floating[Any]]
    score: ImageScore
    our_alpha: NDArray[np.floating[Any]]


def evaluation_sheet(views: Sequence[ScoredView]) -> NDArray[np.uint8]:
    """Draw some views, each in two lines of channels; colours as they are compared, without exposure.

    Args:
        views: At least one.

    Returns:
        8-bit sRGB, ``(H, W, 3)``.
    """
    boxes = [_box(view) for view in views]
    height = max(rows.stop - rows.start for rows, _ in boxes)
    width = max(columns.stop - columns.start for _, columns in boxes)
    panels: list[Panel] = []
    channels = [list(_channels(view)) for view in views]
    in_line = -(-max(map(len, channels)) // 2)
    for view, box, compared in zip(views, boxes, channels, strict=True):
        for number, channel in enumerate(compared):
            title = channel.title if number else f"{view.record.name}: {channel.title}"
            for caption, pixels, behind in _triple(title, channel, view.truth.channels["A"]):
                panels.append((caption, _fitted(_padded(pixels[box], height, width, behind))))
        blank = _fitted(np.full((height, width, 3), SHADE, np.uint8))
        panels += [("", blank)] * 3 * (2 * in_line - len(compared))
    return lay_out(panels, 3 * in_line)


def _channels(view: ScoredView) -> Iterator[_Compared]:
    """Yield every channel that was scored."""
    drawn, truth, scores = view.drawn, view.truth, view.scores
    truth_alpha = truth.channels["A"]
    if drawn.radiance is not None:
        known = view.record.image().linear_rgba()[..., :3]
        score = scores.channels["novel_view"]
        yield _Compared("novel view", _display(drawn.radiance), _display(known), score, drawn.alpha)
    for name, title in (
        ("ambient_occlusion", "ambient occlusion"),
        ("base_color", "base colour"),
        ("roughness", "roughness"),
    ):
        known = true_channel(truth, name)
        if known is None:
            continue
        ours = drawn.channels[name]
        ours, known = map(_display if ours.ndim == 3 else gray, (ours, known))
        over_black = ours * drawn.alpha[..., None], known * truth_alpha[..., None]
        yield _Compared(title, *over_black, scores.channels[name], drawn.alpha)
    for relighter, by_light in view.relit.items():
        for light, image in by_light.items():
            known = view.record.relit(light).linear_rgba()[..., :3]
            score = scores.relit[relighter][light]
            yield _Compared(f"{light}, {relighter}", _display(image.rgb), _display(known), score, image.alpha)


def _triple(
    title: str, channel: _Compared, truth_alpha: NDArray[np.floating[Any]]
) -> Iterator[tuple[str, NDArray[np.uint8], int]]:
    """Yield truth, ours and their difference: a caption, pixels, and the shade around them."""
    score = channel.score
    yield title, _over_background(channel.truth, truth_alpha), SHADE
    ours = _over_background(channel.ours, channel.our_alpha)
    yield f"ours: {score.psnr:.1f} dB, SSIM {score.ssim:.3f}", ours, SHADE
    difference = np.clip(AMPLIFICATION * np.abs(channel.ours - channel.truth), 0.0, 1.0)
    yield f"difference, {AMPLIFICATION} times", np.rint(255.0 * difference).astype(np.uint8), 0


def _over_background(over_black: NDArray[np.floating[Any]], alpha: NDArray[np.floating[Any]]) -> NDArray[np.uint8]:
    """Composite display colours, which lie over black, over the background of pictures."""
    return np.rint(255.0 * np.clip(over_black + BACKGROUND * (1.0 - alpha[..., None]), 0.0, 1.0)).astype(np.uint8)


def _display(linear: NDArray[np.floating[Any]]) -> NDArray[np.floating[Any]]:
    return linear_to_srgb(np.clip(linear, 0.0, 1.0))


def _box(view: ScoredView) -> tuple[slice, slice]:
    """Return rows and columns of the subject with a margin."""
    alpha = view.truth.channels["A"]
    rows, columns = (
        slice(max(part.start - MARGIN, 0), min(part.stop + MARGIN, size))
        for part, size in zip(bounding_box(alpha), alpha.shape, strict=True)
    )
    return rows, columns


def _padded(pixels: NDArray[np.uint8], height: int, width: int, shade: int) -> NDArray[np.uint8]:
    """Centre a panel on a larger one."""
    rows, columns = height - pixels.shape[0], width - pixels.shape[1]
    around = ((rows // 2, rows - rows // 2), (columns // 2, columns - columns // 2), (0, 0))
    return np.pad(pixels, around, constant_values=shade)


def _fitted(pixels: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Reduce or enlarge a panel by a whole factor."""
    rows, columns = pixels.shape[:2]
    least, most = ROWS
    factor = -(-rows // most)
    if factor > 1:
        kept = pixels[: rows // factor * factor, : max(columns // factor, 1) * factor]
        blocks = kept.reshape(rows // factor, factor, -1, factor, 3)
        return np.rint(blocks.mean(axis=(1, 3))).astype(np.uint8)
    factor = -(-least // rows)
    return np.repeat(np.repeat(pixels, factor, axis=0), factor, axis=1)
