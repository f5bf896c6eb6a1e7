"""The thread that draws: the newest state reaches every page, what fails is told and survived, and it ends."""

import threading
import time
from contextlib import contextmanager

import numpy as np
import pytest

from beam_warp.view.frames import NOBODY, FrameLoop
from beam_warp.view.painter import Picture
from beam_warp.view.schedule import Pace, Schedule
from beam_warp.view.state import TRACED, Viewpoint, ViewState

PAGE = Viewpoint((1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 0.6, 64, 48)
PATIENCE = 20.0


class FakeTracing:
    def __init__(self, state, camera):
        self.state, self.camera = state, camera
        self.sample_count = 0

    def advance(self, samples):
        self.sample_count += samples

    def picture(self):
        pixels = np.zeros((self.camera.height, self.camera.width, 3), np.uint8)
        return Picture(pixels, dict, 0, samples=self.sample_count)


class FakePainter:
    """Paints the frame's number; fails for frame 13; can be made to wait."""

    def __init__(self):
        self.gate = threading.Event()
        self.gate.set()
        self.drawn = []
        self.traced = 0

    def draw(self, state, camera, *, is_quick=False):
        self.gate.wait(PATIENCE)
        if state.frame == 13:
            raise ValueError("thirteen")
        self.drawn.append(state.frame)
        return Picture(np.full((camera.height, camera.width, 3), state.frame, np.uint8), dict, 5)

    def trace(self, state, camera):
        self.traced += 1
        return FakeTracing(state, camera)

    def cost_key(self, state):
        return state.channel


class Pages:
    """What pages were given, by page."""

    def __init__(self):
        self.frames = []
        self.errors = []
        self._news = threading.Condition()

    def deliver(self, client, frame):
        with self._news:
            self.frames.append((client, frame))
            self._news.notify_all()

    def report(self, client, error):
        with self._news:
            self.errors.append((client, error))
            self._news.notify_all()

    def wait(self, condition):
        with self._news:
            assert self._news.wait_for(lambda: condition(self), PATIENCE), (len(self.frames), self.errors)

    def wait_for_frame(self, client, shown):
        self.wait(lambda p: any(c == client and f.picture.pixels.flat[0] == shown and f.is_last for c, f in p.frames))


@contextmanager
def serving(**state):
    """A loop with its painter and its pages; it ends whatever happened."""
    painter, pages = FakePainter(), Pages()
    loop = FrameLoop(painter, Schedule(ViewState(**state), traced=Pace(500.0)), pages.deliver, pages.report)
    try:
        yield loop, painter, pages
    finally:
        painter.gate.set()
        loop.close()
    assert not loop._thread.is_alive()


@pytest.fixture
def served():
    with serving() as parts:
        yield parts


def test_a_page_gets_its_picture(served):
    loop, _, pages = served
    loop.look(1, PAGE)
    pages.wait_for_frame(1, 0)
    assert pages.frames[-1][1].picture.pixels.shape == (48, 64, 3)
    assert loop.change(frame=3).frame == 3
    pages.wait_for_frame(1, 3)
    assert pages.frames[-1][1].milliseconds >= 0.0


def test_two_pages_of_two_sizes(served):
    loop, _, pages = served
    loop.look(1, PAGE)
    loop.look(2, Viewpoint((1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 1.0), 0.6, 30, 40))
    pages.wait_for_frame(1, 0)
    pages.wait_for_frame(2, 0)
    sizes = {client: frame.picture.pixels.shape for client, frame in pages.frames if frame.is_last}
    assert sizes == {1: (48, 64, 3), 2: (40, 30, 3)}


def test_a_resized_page_gets_its_new_size(served):
    loop, _, pages = served
    loop.look(1, PAGE)
    pages.wait_for_frame(1, 0)
    loop.look(1, Viewpoint(PAGE.wxyz, PAGE.position, PAGE.fov, 100, 20))
    pages.wait(lambda p: p.frames[-1][1].picture.pixels.shape == (20, 100, 3) and p.frames[-1][1].is_last)


def test_states_that_nobody_waits_for_are_not_drawn(served):
    loop, painter, pages = served
    loop.look(1, PAGE)
    pages.wait_for_frame(1, 0)
    painter.gate.clear()
    for frame in range(1, 100):
        loop.change(frame=frame)
        if frame == 1:
            time.sleep(0.05)  # the thread is at it now
    painter.gate.set()
    pages.wait_for_frame(1, 99)
    assert len(set(painter.drawn)) <= 4  # 0, the one it was at, at most one between, 99


def test_what_fails_is_told_once_and_survived(served):
    loop, _, pages = served
    loop.look(1, PAGE)
    pages.wait_for_frame(1, 0)
    loop.change(frame=13)
    pages.wait(lambda p: p.errors)
    time.sleep(0.6)  # nothing changes: nothing is tried again once it is still
    assert [(client, str(error)) for client, error in pages.errors] == [(1, "thirteen")]
    loop.change(frame=4)
    pages.wait_for_frame(1, 4)


def test_a_page_that_leaves_in_the_middle_of_a_frame(served):
    loop, painter, pages = served
    loop.look(1, PAGE)
    pages.wait_for_frame(1, 0)
    painter.gate.clear()
    loop.change(frame=5)
    time.sleep(0.05)
    loop.leave(1)
    painter.gate.set()
    loop.look(2, PAGE)
    pages.wait_for_frame(2, 5)
    assert not [frame for client, frame in pages.frames if client == 1 and frame.picture.pixels.flat[0] == 5]
    assert not pages.errors


def test_a_page_that_cannot_be_given_anything(served):
    loop, _, pages = served

    def refuse(client, frame):
        if client == 1:
            raise ConnectionError("gone")
        pages.deliver(client, frame)

    loop._deliver = refuse
    loop.look(1, PAGE)
    loop.look(2, PAGE)
    pages.wait_for_frame(2, 0)
    assert {client for client, _ in pages.errors} <= {1}


def test_paths_add_up_to_the_limit(served):
    loop, painter, pages = served
    loop.change(mode=TRACED, samples=5)
    loop.look(1, PAGE)
    pages.wait(lambda p: any(f.is_last and f.picture.samples == 5 for _, f in p.frames))
    counts = [frame.picture.samples for _, frame in pages.frames if frame.picture.samples]
    assert counts == sorted(counts)
    assert max(counts) == 5
    traced = painter.traced
    loop.change(samples=9)
    pages.wait(lambda p: any(f.is_last and f.picture.samples == 9 for _, f in p.frames))
    assert painter.traced == traced  # it went on


def test_a_picture_to_keep_is_of_full_size(served):
    loop, _, pages = served
    kept = []
    loop.look(1, PAGE)
    loop.change(frame=6)
    loop.export(1, lambda picture: (kept.append(picture), pages.deliver(NOBODY, None)))
    pages.wait(lambda p: (NOBODY, None) in p.frames)
    assert kept[0].pixels.shape == (48, 64, 3)
    assert kept[0].pixels.flat[0] == 6
    loop.export(7, kept.append)  # a page that is gone
    loop.change(frame=7)
    pages.wait(lambda p: any(f is not None and f.picture.pixels.flat[0] == 7 for _, f in p.frames))
    assert len(kept) == 1


def test_a_first_state_that_cannot_be_drawn():
    with serving(frame=13) as (loop, _, pages):
        loop.look(1, PAGE)
        pages.wait(lambda p: any(client == 1 for client, _ in p.errors))
        loop.change(frame=1)
        pages.wait_for_frame(1, 1)


def test_it_ends_while_it_draws(served):
    loop, painter, pages = served
    loop.look(1, PAGE)
    pages.wait_for_frame(1, 0)
    painter.gate.clear()
    loop.change(frame=2)
    time.sleep(0.05)
    threading.Timer(0.2, painter.gate.set).start()
    loop.close()
    assert not loop._thread.is_alive()
