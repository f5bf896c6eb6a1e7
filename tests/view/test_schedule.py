"""What is drawn next: coarse while something moves, then finer; the newest, and nobody waits for ever."""

import itertools

import pytest

from beam_warp.view.schedule import SCALES, SMALLEST_SIDE, STILL_AFTER, Pace, Schedule
from beam_warp.view.state import TRACED, Viewpoint, ViewState

PAGE = Viewpoint((1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 0.6, 1280, 720)
MOVED = Viewpoint((1.0, 0.0, 0.0, 0.0), (0.1, 0.0, 0.0), 0.6, 1280, 720)


def slow():
    """A pace that takes a quarter of each side."""
    pace = Pace(100.0)
    for pixels in (1000.0, 100_000.0):
        pace.note(pixels, pixels / 576.0)  # 57,600 pixels of 320 x 180 take 100 ms
    return pace


def scheduled(state=None, **paces):
    schedule = Schedule(state or ViewState(), **({"moving": slow()} | paces))
    schedule.look(1, PAGE, now=0.0)
    return schedule


def carried_out(schedule, now, milliseconds=None, **said):
    order = schedule.next(now)
    if order is not None:
        schedule.done(order, milliseconds=milliseconds, **said)
    return order


def test_a_pace_learns_both_parts_of_the_cost():
    pace = Pace(100.0)
    assert pace.expected(1000.0) is None
    for pixels in (10_000.0, 40_000.0, 10_000.0):
        pace.note(pixels, 30.0 + 0.001 * pixels)
    # exact for a line, but for the rounding of sums of squares: 1e9 of 1e-16
    assert pace.expected(250_000.0) == pytest.approx(280.0, rel=1e-9)


def test_the_largest_size_that_is_fast_enough():
    pace = Pace(100.0)
    for pixels in (10_000.0, 40_000.0):
        pace.note(pixels, 20.0 + 0.0005 * pixels)  # 160,000 pixels take 100 ms
    width, height = 800, 400
    chosen = pace.scale(width, height)
    assert chosen * chosen * width * height <= 160_000.0
    larger = [scale for scale in SCALES if scale > chosen]
    assert all(scale * scale * width * height > 160_000.0 for scale in larger)


def test_what_does_not_get_faster_is_not_made_small():
    pace = Pace(100.0)
    for pixels in (10_000.0, 500_000.0):
        pace.note(pixels, 900.0 + 1e-5 * pixels)  # a million Gaussians: pixels hardly count
    assert pace.scale(1280, 720) == 1.0


def test_one_size_alone_is_a_guess_that_is_tried():
    pace = Pace(100.0)
    pace.note(1280 * 720, 400.0)
    assert pace.scale(1280, 720) < 1.0


def test_nonsense_teaches_nothing():
    pace = Pace(100.0)
    for pixels, milliseconds in ((0.0, 1.0), (float("nan"), 1.0), (10.0, float("nan")), (10.0, -1.0)):
        pace.note(pixels, milliseconds)
    assert pace.expected(10.0) is None


def test_pictures_keep_a_least_size():
    pace = Pace(1.0)
    for pixels in (1000.0, 100_000.0):
        pace.note(pixels, pixels)
    assert pace.scale(400, 300) * 300 >= SMALLEST_SIDE
    assert pace.scale(40, 30) == 1.0  # a page smaller than that


def test_coarse_then_finer_then_nothing():
    schedule = scheduled()
    first = carried_out(schedule, 0.0)
    assert (first.kind, first.scale, first.is_last) == ("moving", 0.25, False)
    assert schedule.next(0.5 * STILL_AFTER) is None
    assert schedule.wait(0.5 * STILL_AFTER) == pytest.approx(0.5 * STILL_AFTER)
    still = [carried_out(schedule, 2 * STILL_AFTER) for _ in range(3)]
    assert [(o.kind, o.scale, o.is_last) for o in still[:2]] == [("still", 0.5, False), ("still", 1.0, True)]
    assert still[2] is None
    assert schedule.wait(2 * STILL_AFTER) is None


def test_a_change_starts_over():
    schedule = scheduled()
    for _ in range(3):
        carried_out(schedule, 1.0)
    schedule.look(1, PAGE, now=2.0)  # the same: nothing moves
    assert schedule.next(2.0) is None
    schedule.look(1, MOVED, now=3.0)
    assert carried_out(schedule, 3.0).viewpoint == MOVED
    schedule.show(ViewState(rotation=30.0), now=4.0)
    order = carried_out(schedule, 4.0)
    assert (order.kind, order.state.rotation) == ("moving", 30.0)


def test_stale_pictures_are_not_wanted():
    schedule = scheduled()
    carried_out(schedule, 0.0)
    fine = schedule.next(1.0)
    assert schedule.is_wanted(fine)
    schedule.look(1, MOVED, now=1.1)
    assert not schedule.is_wanted(fine)
    schedule.done(fine, milliseconds=None)
    assert schedule.next(1.1).kind == "moving"
    late = schedule.next(1.1)
    schedule.look(1, PAGE, now=1.2)
    assert schedule.is_wanted(late)  # else what moves faster than it is drawn would never be seen
    schedule.leave(1)
    assert not schedule.is_wanted(late)


def test_two_pages_take_turns_and_what_moves_goes_first():
    schedule = scheduled()
    schedule.look(2, MOVED, now=0.0)
    assert [carried_out(schedule, 0.0).client for _ in range(2)] == [1, 2]
    schedule.look(2, PAGE, now=0.9)
    assert carried_out(schedule, 1.0).client == 2
    assert carried_out(schedule, 1.0).client == 1
    both = [carried_out(schedule, 2.0) for _ in range(4)]
    assert sorted({order.client for order in both if order is not None}) == [1, 2]
    schedule.leave(2)
    schedule.show(ViewState(exposure=1.0), now=3.0)
    assert carried_out(schedule, 3.0).client == 1
    assert schedule.next(3.0) is None


def test_a_page_without_size_waits():
    schedule = Schedule(ViewState())
    schedule.look(1, Viewpoint((1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 0.6, 0, 0), now=0.0)
    assert schedule.next(0.0) is None
    assert schedule.wait(0.0) is None


def test_paths_are_traced_when_still_up_to_a_limit():
    schedule = scheduled(ViewState(mode=TRACED, samples=8), traced=Pace(500.0, first_pixels=1e9))
    assert carried_out(schedule, 0.0).kind == "moving"
    assert schedule.next(0.1) is None
    for count in itertools.count(1):
        order = carried_out(schedule, 1.0, milliseconds=300.0, samples=4, is_over=count == 2)
        if order is None:
            break
        assert (order.kind, order.scale) == ("traced", 1.0)
    assert count == 3
    schedule.show(ViewState(mode=TRACED, samples=16), now=2.0)  # more paths: what there is goes on
    assert schedule.next(2.0).kind == "traced"
    assert schedule.next(2.0).version == schedule.seen(1)[1]


def test_a_traced_picture_grows_while_it_has_few_paths():
    schedule = scheduled(ViewState(mode=TRACED), traced=Pace(500.0, first_pixels=60_000.0))
    carried_out(schedule, 0.0)
    first = carried_out(schedule, 1.0, milliseconds=10.0, samples=1)
    assert first.scale == 0.25
    grown = carried_out(schedule, 1.0, milliseconds=10.0, samples=1)
    assert grown.scale > first.scale
    for _ in range(10):
        last = carried_out(schedule, 1.0, milliseconds=20.0, samples=8)
    assert last.scale == 1.0


def test_as_many_paths_as_a_moment_has_room_for():
    schedule = scheduled(ViewState(mode=TRACED), traced=Pace(500.0, first_pixels=1e9))
    carried_out(schedule, 0.0)
    order = schedule.next(1.0)
    assert schedule.samples_at_a_time(order, 100) == 1  # nothing is known
    schedule.done(order, milliseconds=50.0, samples=1)
    assert schedule.samples_at_a_time(order, 100) == 10
    assert schedule.samples_at_a_time(order, 3) == 3
