"""How fine the viewer's next picture is: coarse enough while something moves, refined once it is still."""

import pytest

from clsurf.view.pace import BUDGET, FINE, FULL, SETTLE, STEPS, Pace


def shown(pace, seconds_of, start, count, gap=0.05):
    """The qualities of pictures drawn while something moves."""
    out, now = [], start
    for _ in range(count):
        pace = pace.touched(now)
        quality = pace.quality(now)
        pace = pace.drawn(quality, seconds_of(quality), now)
        out.append(quality)
        now += gap
    return pace, out


@pytest.mark.parametrize("full_seconds", [0.005, 0.1, 0.5, 2.0])
def test_moving_pictures_get_coarse_enough_and_no_coarser(full_seconds):
    """Drawing time goes with the number of pixels: in the end every picture keeps to the budget, or nearly."""
    def seconds(quality):
        return full_seconds / quality.reduce**2 * (0.7 if quality.lod > 4 else 1)
    pace, qualities = shown(Pace(), seconds, 0.0, 40)
    late = [seconds(q) for q in qualities[10:]]
    assert max(late) <= max(BUDGET, full_seconds / STEPS[-1][0]**2)
    assert len({q for q in qualities[20:]}) == 1  # it does not flicker between two
    if full_seconds < BUDGET:
        assert qualities[-1].reduce == 1
    _, after = shown(pace, lambda q: 1e-4, 10.0, 20)  # something easier to draw
    assert (after[-1].reduce, after[-1].lod) == STEPS[0]


def test_a_slow_canvas_gets_smaller_pictures():
    """Drawn fast, but far apart: half the size, as long as it moves; none of it where the movement pauses."""
    pace, qualities = shown(Pace(), lambda q: 0.01, 0.0, 12, gap=0.08)
    assert [q.reduce for q in qualities[-8:]] == [2] * 8
    _, qualities = shown(pace, lambda q: 0.01, 5.0, 12, gap=0.03)
    assert qualities[-1].reduce == 1
    _, qualities = shown(Pace(), lambda q: 0.01, 0.0, 12, gap=0.4)
    assert qualities[-1].reduce == 1


def test_still_pictures_are_refined_step_by_step():
    pace = Pace().touched(10.0)
    assert pace.quality(10.0).lod == STEPS[0][1] and pace.due(10.0) == pytest.approx(SETTLE)
    pace = pace.drawn(pace.quality(10.0), 0.01, 10.0)
    later = 10.0 + SETTLE
    assert pace.due(later) == 0.0 and pace.quality(later) == FULL
    pace = pace.drawn(FULL, 0.01, later)
    assert pace.due(later) == 0.0 and pace.quality(later) == FINE
    assert pace.drawn(FINE, 0.05, later).due(later) is None
    slow = Pace().stale().drawn(FULL, 1.0, later)
    assert slow.due(later) is None and slow.quality(later) == FULL  # the fine one would take seconds
    assert pace.stale().quality(later) == FULL
