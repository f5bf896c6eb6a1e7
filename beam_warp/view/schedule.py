"""Order of a viewer's pictures: coarse ones while something moves, finer and finer ones once nothing does."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import Literal

from beam_warp.view.state import Viewpoint, ViewState

STILL_AFTER = 0.2
"""Time after the last change from which nothing counts as moving [s]."""

SCALES = (1.0, 0.75, 0.5, 0.375, 0.25, 0.1875, 0.125)
"""Sides of pictures over those of the page; few, so that arrays made for a size serve many frames."""

SMALLEST_SIDE = 96
"""Pictures of moving things are not made smaller than this, but for pages that are [pixel]."""

FORGETTING = 0.8
"""Weight of a measured picture once the next one is measured."""

PATIENCE = 1.5
"""Where no size is fast enough, pictures may take this much longer than the fastest ones."""

EARLY_SAMPLES = 4
"""A traced picture that has more paths a pixel keeps its size."""

LONGEST_SIDE = 2048
"""Pictures are not made larger than this, whatever the page [pixel]."""


@dataclass
class Pace:
    """Model of the cost of pictures, time = a + b pixels, that finds the size that is fast enough.

    Attributes:
        target: Time that a picture may take [ms].
        first_pixels: Size of the first picture, when nothing is known.
    """

    target: float
    first_pixels: float = 2.0**17
    _sums: list[float] = field(default_factory=lambda: [0.0] * 5)

    def note(self, pixels: float, milliseconds: float) -> None:
        """Learn from a picture."""
        if not (pixels > 0.0 and milliseconds >= 0.0 and math.isfinite(milliseconds)):
            return
        news = (1.0, pixels, milliseconds, pixels * pixels, pixels * milliseconds)
        self._sums = [FORGETTING * old + new for old, new in zip(self._sums, news, strict=True)]

    def expected(self, pixels: float) -> float | None:
        """Return how long a picture of a size takes [ms]; None while nothing is known."""
        count, sum_x, sum_y, sum_xx, sum_xy = self._sums
        if count == 0.0:
            return None
        mean_x, mean_y = sum_x / count, sum_y / count
        variance = sum_xx / count - mean_x * mean_x
        if variance > 1e-3 * mean_x * mean_x:
            slope = (sum_xy / count - mean_x * mean_y) / variance
            slope = min(max(slope, 0.0), mean_y / mean_x)  # neither part is negative
        else:  # of one size so far: half of it for the pixels is a guess to try another one by
            slope = 0.5 * mean_y / mean_x
        return mean_y + slope * (pixels - mean_x)

    def scale(self, width: int, height: int, longest: int = LONGEST_SIDE) -> float:
        """Return the largest of `SCALES` at which a page of a size is fast enough; at least one is given."""
        largest = min(1.0, longest / max(width, height))
        usable = [s for s in SCALES if s <= largest and s * min(width, height) >= SMALLEST_SIDE] or [largest]
        pixels = [s * s * width * height for s in usable]
        times = [self.expected(count) for count in pixels]
        if times[0] is None:
            return next((s for s, count in zip(usable, pixels, strict=True) if count <= self.first_pixels), usable[-1])
        known = [time for time in times if time is not None]
        limit = max(self.target, PATIENCE * known[-1])
        return next((s for s, time in zip(usable, known, strict=True) if time <= limit), usable[-1])


@dataclass(frozen=True)
class Order:
    """A picture to draw.

    Attributes:
        client: Page that the picture is for.
        version: Version of state and viewpoint; a picture of an older one is stale.
        state: State to draw.
        viewpoint: Viewpoint of the page.
        kind: ``"moving"``: quickly; ``"still"``: finer than the last one; ``"traced"``: more paths for the last one.
        scale: Sides of the picture over those of the page.
        is_last: True if nothing finer follows, but more paths.
    """

    client: int
    version: int
    state: ViewState
    viewpoint: Viewpoint
    kind: Literal["moving", "still", "traced"]
    scale: float
    is_last: bool


@dataclass
class _Page:
    """What is known of a page, and what it was given last."""

    viewpoint: Viewpoint
    version: int
    changed: float
    drawn_version: int = -1
    drawn_scale: float = 0.0
    is_sharp: bool = False
    traced_version: int = -1
    traced_scale: float = 0.0
    traced_samples: int = 0
    is_traced_out: bool = False
    served: int = 0


class Schedule:
    """Decides what to draw next; takes times as arguments, and draws nothing."""

    def __init__(
        self, state: ViewState, *, moving: Pace | None = None, traced: Pace | None = None, longest: int = LONGEST_SIDE
    ) -> None:
        """Start without pages.

        Args:
            state: First state.
            moving: Pace of pictures while something moves; a tenth of a second each by default.
            traced: Pace of one path a pixel; half a second by default.
            longest: No side of a picture is longer [pixel].
        """
        self.moving = moving or Pace(100.0)
        self.traced = traced or Pace(500.0, first_pixels=2.0**16)
        self.longest = longest
        self._state = state
        self._pages: dict[int, _Page] = {}
        self._version = 0
        self._turn = 0

    @property
    def state(self) -> ViewState:
        """State that is shown."""
        return self._state

    def look(self, client: int, viewpoint: Viewpoint, now: float) -> None:
        """Take note of where a page looks from; the first time, of the page."""
        page = self._pages.get(client)
        if page is not None and page.viewpoint == viewpoint:
            return
        self._version += 1
        if page is None:
            self._pages[client] = _Page(viewpoint, self._version, now)
        else:
            page.viewpoint, page.version, page.changed = viewpoint, self._version, now

    def leave(self, client: int) -> None:
        """Forget a page."""
        self._pages.pop(client, None)

    def show(self, state: ViewState, now: float) -> None:
        """Take note of what is looked at."""
        if state == self._state:
            return
        before, self._state = self._state, state
        self._version += 1
        goes_on = replace(before, samples=state.samples) == state  # only the number of paths is another
        for page in self._pages.values():
            if goes_on:
                page.is_traced_out = False
            else:
                page.version, page.changed = self._version, now

    def seen(self, client: int) -> tuple[Viewpoint, int] | None:
        """Return where a page looks from, and the version of what it sees; None if it is gone."""
        page = self._pages.get(client)
        return None if page is None else (page.viewpoint, page.version)

    def is_wanted(self, order: Order) -> bool:
        """True if the page is there and the picture not stale; of what moves, a late one is better than none."""
        page = self._pages.get(order.client)
        return page is not None and (order.kind == "moving" or page.version == order.version)

    def next(self, now: float) -> Order | None:
        """Return what to draw; None if nothing is due. Pages that move come first, then who waited longest."""
        orders = [
            (order.kind != "moving", self._pages[client].served, client, order) for client, order in self._due(now)
        ]
        if not orders:
            return None
        order = min(orders, key=lambda entry: entry[:3])[3]
        self._turn += 1
        self._pages[order.client].served = self._turn
        return order

    def wait(self, now: float) -> float | None:
        """Return after how long something is due [s], 0 if it is; None if only a change makes it so."""
        if any(True for _ in self._due(now)):
            return 0.0
        later = [
            page.changed + STILL_AFTER - now
            for page in self._pages.values()
            if page.viewpoint.is_usable and page.changed + STILL_AFTER > now
        ]
        return max(min(later), 1e-3) if later else None

    def done(self, order: Order, *, milliseconds: float | None, samples: int = 0, is_over: bool = False) -> None:
        """Take note that an order was carried out.

        Args:
            order: The order.
            milliseconds: How long it took; None where that says nothing about the next one.
            samples: Paths a pixel that were added, of an order of kind ``"traced"``.
            is_over: True if no further paths are wanted.
        """
        width, height = order.viewpoint.size(order.scale, self.longest)
        if milliseconds is not None:
            if order.kind == "traced":
                self.traced.note(width * height, milliseconds / max(samples, 1))
            elif order.kind == "moving":
                self.moving.note(width * height, milliseconds)
        page = self._pages.get(order.client)
        if page is None:
            return
        if order.kind == "traced":
            goes_on = (page.traced_version, page.traced_scale) == (order.version, order.scale)
            page.traced_samples = samples + (page.traced_samples if goes_on else 0)
            page.traced_version, page.traced_scale = order.version, order.scale
            page.is_traced_out = is_over and page.version == order.version
        else:
            page.drawn_version, page.drawn_scale, page.is_sharp = order.version, order.scale, order.is_last

    def failed(self, order: Order) -> None:
        """Take note that an order cannot be carried out: the page gets nothing before something changes."""
        page = self._pages.get(order.client)
        if page is not None and page.version == order.version:
            page.drawn_version = page.traced_version = order.version
            page.is_sharp = page.is_traced_out = True

    def samples_at_a_time(self, order: Order, left: int) -> int:
        """Return how many paths a pixel to add: as many as a moment has room for, at most ``left``."""
        width, height = order.viewpoint.size(order.scale, self.longest)
        expected = self.traced.expected(width * height)
        return 1 if not expected else max(1, min(left, int(self.traced.target / expected), 64))

    def _due(self, now: float) -> Iterator[tuple[int, Order]]:
        """Yield (client, order) of every page that has something to draw."""
        for client, page in self._pages.items():
            order = self._order(client, page, now)
            if order is not None:
                yield client, order

    def _order(self, client: int, page: _Page, now: float) -> Order | None:
        """Return what to draw for a page now."""
        view = page.viewpoint
        if not view.is_usable:
            return None
        full = min(1.0, self.longest / max(view.width, view.height))
        quick = self.moving.scale(view.width, view.height, self.longest)
        if page.drawn_version != page.version:
            return Order(client, page.version, self._state, view, "moving", quick, False)
        if now - page.changed < STILL_AFTER:
            return None
        if self._state.is_traced:
            better = self.traced.scale(view.width, view.height, self.longest)
            if page.traced_version == page.version:
                if page.is_traced_out:
                    return None
                # The first paths tell what they cost: where there is time for a larger picture, it starts over.
                is_early = page.traced_samples <= EARLY_SAMPLES and better >= 1.5 * page.traced_scale
                scale = better if is_early else page.traced_scale
            else:
                scale = better
            return Order(client, page.version, self._state, view, "traced", scale, True)
        if page.is_sharp:
            return None
        finer = min(full, 2.0 * page.drawn_scale)
        if finer > 0.7 * full:  # nearly there: one picture instead of two
            finer = full
        return Order(client, page.version, self._state, view, "still", finer, finer >= full)
