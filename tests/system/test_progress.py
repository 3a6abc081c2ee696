"""The places of stages on the bar, by expected seconds, and by those that were measured before."""

import pytest

from splinecli.system import progress
from splinecli.system.progress import Clock


@pytest.fixture
def time(monkeypatch):
    """Seconds [now] of a clock that only tests move."""
    now = [0.0]
    monkeypatch.setattr("time.perf_counter", lambda: now[0])
    monkeypatch.setattr(progress, "_PACES", {})
    return now


def run(time, seconds):
    """Return the places on the bar at the ends of four stages that take these seconds."""
    shown = [0.0]
    places, clock = list[float](), Clock(lambda amount, note: shown.append(shown[-1] + amount))
    clock.expect({"read": 1, "estimate": 1, "pictures": 1, "write": 1})
    for stage, each in zip(("read", "estimate", "pictures", "write"), seconds, strict=True):
        advance = clock.begin(stage)
        time[0] += each
        advance(1)
        places.append(shown[-1])
    clock.seconds()
    return places


def test_stages_have_the_shares_that_were_measured_in_this_process(time):
    assert run(time, (1, 2, 4, 1)) == pytest.approx([0.25, 0.5, 0.75, 1])
    assert run(time, (1, 1, 1, 1)) == pytest.approx([0.125, 0.375, 0.875, 1])


def test_a_stage_of_several_parts_ends_with_the_last(time):
    places = [0.0]
    clock = Clock(lambda amount, note: places.append(places[-1] + amount))
    clock.expect({"read": 1, "pictures": 2, "write": 1})
    clock.begin("read")(1)
    clock.begin("pictures", note="maps")
    advance = clock.begin("pictures", 4, "albedo")
    assert places[-1] == pytest.approx(0.25)
    advance(2)
    assert places[-1] == pytest.approx(0.5)
    clock.begin("pictures", 4, "material")(1)
    assert places[-1] == pytest.approx(0.5)  # never moves back
