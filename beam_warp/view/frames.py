"""A thread that draws the newest picture that each page wants, and never a queue of older ones."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from beam_warp.view.painter import CloudPainter, Picture, TracedPicture
from beam_warp.view.schedule import Order, Schedule
from beam_warp.view.state import Viewpoint, ViewState
from beam_warp.world.camera import Camera

log = logging.getLogger(__name__)

NOBODY = -1
"""Page number of errors before there is a page; nobody is told of them."""


@dataclass(frozen=True, eq=False)
class PagePicture:
    """A picture on its way to a page.

    Attributes:
        picture: Picture to show.
        milliseconds: Time that it took; for a traced one, the time of each path of every pixel.
        is_last: True if nothing finer follows.
    """

    picture: Picture
    milliseconds: float
    is_last: bool


class FrameLoop:
    """Draws in a thread of its own, until it is closed. What fails is reported, and the thread goes on."""

    def __init__(
        self,
        painter: CloudPainter,
        schedule: Schedule,
        deliver: Callable[[int, PagePicture], None],
        report: Callable[[int, Exception], None],
    ) -> None:
        """Start the thread.

        Args:
            painter: Draws.
            schedule: Decides; used by this loop alone from now on.
            deliver: Takes a page's frame, in the loop's thread.
            report: Takes what failed for a page, in the loop's thread; once until something changes.
        """
        self._painter = painter
        self._schedule = schedule
        self._deliver = deliver
        self._report = report
        self._changed = threading.Condition()
        self._is_closed = False
        self._exports: list[tuple[int, Callable[[Picture], None]]] = []
        self._tracings: dict[int, tuple[int, float, TracedPicture]] = {}
        self._cost_key: object = None
        self._thread = threading.Thread(target=self._run, name="beam-view-frames", daemon=True)
        self._thread.start()

    def look(self, client: int, viewpoint: Viewpoint) -> None:
        """Say where a page looks from."""
        with self._changed:
            self._schedule.look(client, viewpoint, time.monotonic())
            self._changed.notify()

    def leave(self, client: int) -> None:
        """Say that a page is gone."""
        with self._changed:
            self._schedule.leave(client)
            self._tracings.pop(client, None)
            self._changed.notify()

    def change(self, **values: Any) -> ViewState:
        """Change what is looked at, and return it; see `ViewState.changed`."""
        with self._changed:
            self._schedule.show(self._schedule.state.changed(**values), time.monotonic())
            self._changed.notify()
            return self._schedule.state

    @property
    def state(self) -> ViewState:
        """State that is shown."""
        with self._changed:
            return self._schedule.state

    def export(self, client: int, take: Callable[[Picture], None]) -> None:
        """Draw what a page sees in the page's full size, or take what was traced for it, and hand it over."""
        with self._changed:
            self._exports.append((client, take))
            self._changed.notify()

    def close(self) -> None:
        """End the thread; waits for the picture that it is at."""
        with self._changed:
            self._is_closed = True
            self._changed.notify()
        if self._thread is not threading.current_thread():
            self._thread.join(timeout=30.0)

    def _warm_up(self) -> None:
        """Draw the first state small, so that kernels and light are ready when somebody comes to look."""
        self._painter.draw(self.state, Camera.look_at((0, -3, 0), (0, 0, 0), width=32, height=32, vertical_fov=35.0))

    def _run(self) -> None:
        self._guarded(NOBODY, self._warm_up)
        while True:
            with self._changed:
                while not self._is_closed and not self._exports:
                    wait = self._schedule.wait(time.monotonic())
                    if wait == 0.0:
                        break
                    self._changed.wait(wait)
                if self._is_closed:
                    return
                export = self._exports.pop(0) if self._exports else None
                order = None if export else self._schedule.next(time.monotonic())
            if export is not None:
                self._guarded(export[0], lambda export=export: self._export(*export))
            elif order is not None and not self._guarded(order.client, lambda order=order: self._carry_out(order)):
                with self._changed:  # it is not tried again before something changes
                    self._schedule.failed(order)
                    self._tracings.pop(order.client, None)

    def _guarded(self, client: int, work: Callable[[], None]) -> bool:
        """Work; report what fails, and return False then. Nothing ends the thread."""
        try:
            work()
            return True
        except Exception as error:
            log.exception("drawing for page %d failed", client)
            try:
                self._report(client, error)
            except Exception:
                log.exception("page %d could not be told", client)
            return False

    def _carry_out(self, order: Order) -> None:
        """Draw, and deliver where somebody still waits for it."""
        started = time.monotonic()
        samples = 0
        is_over = False
        key = (order.kind, self._painter.cost_key(order.state))
        if order.kind == "traced":
            tracing = self._tracing(order)
            with self._changed:
                left = order.state.samples - tracing.sample_count
                samples = self._schedule.samples_at_a_time(order, left)
            if left > 0:
                tracing.advance(samples)
            is_over = tracing.sample_count >= order.state.samples
            picture = tracing.picture()
        else:
            camera = order.viewpoint.camera(order.scale, self._schedule.longest)
            picture = self._painter.draw(order.state, camera, is_quick=order.kind == "moving")
        drawn = 1000.0 * (time.monotonic() - started) / max(samples, 1)
        with self._changed:
            is_wanted = self._schedule.is_wanted(order)
            if not is_wanted or order.kind != "traced":
                self._tracings.pop(order.client, None)
        if is_wanted:
            is_last = order.is_last and (order.kind != "traced" or is_over)
            self._deliver(order.client, PagePicture(picture, drawn, is_last))
        taken = 1000.0 * (time.monotonic() - started)
        with self._changed:
            is_typical = key == self._cost_key  # the first one of a kind makes ready what the next ones find
            self._cost_key = key
            self._schedule.done(order, milliseconds=taken if is_typical else None, samples=samples, is_over=is_over)

    def _tracing(self, order: Order) -> TracedPicture:
        """Return what is traced for a page: as it was left, or a new one."""
        version, scale, tracing = self._tracings.get(order.client, (-1, 0.0, None))
        if tracing is None or (version, scale) != (order.version, order.scale):
            tracing = self._painter.trace(order.state, order.viewpoint.camera(order.scale, self._schedule.longest))
            self._tracings[order.client] = (order.version, order.scale, tracing)
        return tracing

    def _export(self, client: int, take: Callable[[Picture], None]) -> None:
        with self._changed:
            seen, state = self._schedule.seen(client), self._schedule.state
            version, _, tracing = self._tracings.get(client, (-1, 0.0, None))
        if seen is None or not seen[0].is_usable:
            return
        if tracing is not None and version == seen[1]:
            take(tracing.picture())
        else:
            take(self._painter.draw(state, seen[0].camera(1.0, self._schedule.longest)))
