"""Timings and sections, on a fake device with known times."""

import pytest
import torch

from gsim3d.cuda_graphs import Captured
from gsim3d.profile import timing
from gsim3d.profile.timing import DeviceClock, GraphStopwatch, Stopwatch, Timing, time_call, watched
from tests.profile.fakes import FakeClock, FakeGraph, FakeSimulator

SECTIONS = {"encode": 2e-3, "dense layers": 3e-3, "head": 1e-3, "state and guards": 0.5e-3}


def watched_call(clock, repeats=5):
    simulator, stopwatch = FakeSimulator(clock), Stopwatch(clock)

    def call():
        with watched(simulator, stopwatch), stopwatch.running():
            simulator()

    return time_call(call, clock, repeats, sections=lambda: stopwatch.seconds)


def test_sections_sum_to_total():
    found = watched_call(FakeClock())
    assert found.median == pytest.approx(6.5e-3) and found.sections == pytest.approx(SECTIONS)
    assert list(found.sections) == [name for name in timing.SECTIONS if name in SECTIONS]


def test_nested_section_counts_for_itself():
    clock = FakeClock()
    stopwatch = Stopwatch(clock)
    with stopwatch.running():
        stopwatch.enter("dense layers")
        clock.work(1.0)
        stopwatch.enter("attention")
        clock.work(5.0)
        stopwatch.leave()
        clock.work(2.0)
        stopwatch.leave()
    assert stopwatch.seconds == pytest.approx({"state and guards": 0.0, "dense layers": 3.0, "attention": 5.0})


@pytest.mark.parametrize("cost", [0.0, 0.2e-3])
def test_graph_stopwatch_times_every_replay(cost):
    """Sections exclude host time and the cost of marks; warm-up runs before the capture are not recorded."""
    clock = FakeClock(launch=4e-3, cost=cost)
    simulator, stopwatch = FakeSimulator(clock), GraphStopwatch(clock)
    with watched(simulator, stopwatch), stopwatch.capturing():
        graph = FakeGraph(simulator, clock)
    for _ in range(2):
        with stopwatch.running():
            graph()
        assert stopwatch.seconds == pytest.approx(SECTIONS)
    with watched(simulator, stopwatch), stopwatch.running():
        graph()
        simulator.renderer()  # drawn behind the graph; the host launches it while the graph runs
    assert stopwatch.seconds == pytest.approx({**SECTIONS, "head": 2e-3})
    simulator()  # no longer watched
    assert len(stopwatch._marks) == 6
    eager = watched_call(FakeClock(host_share=0.0, launch=4e-3))
    assert sum(eager.sections.values()) > 2 * 6.5e-3  # launched one by one, the device waits for the host


def test_warm_up_does_not_count():
    clock, seconds = FakeClock(), iter([9.0, 9.0, 1.0, 2.0, 4.0])
    found = time_call(lambda: clock.work(next(seconds)), clock, repeats=3, warm_up=2)
    assert found.repeats == (1.0, 2.0, 4.0)
    assert found.median == 2.0 and found.p95 == 4.0


def test_timing_waits_for_the_device():
    clock = FakeClock(host_share=0.0)
    assert time_call(lambda: clock.work(3.0), clock, repeats=2).repeats == (3.0, 3.0)


def test_timing_split_over_steps():
    assert Timing((2.0, 4.0), {"head": 1.0}).split_over(2) == Timing((1.0, 2.0), {"head": 0.5})


def test_watched_restores_ops():
    before = torch.ops.gsim3d.unpool
    with pytest.raises(KeyError, match="fails"):
        with watched(FakeSimulator(FakeClock()), Stopwatch(FakeClock())):
            assert torch.ops.gsim3d.unpool is not before
            raise KeyError("fails")
    assert torch.ops.gsim3d.unpool is before


def test_device_clock_measures_work(device):
    clock = DeviceClock(device)
    first, start = clock.mark(), clock.now()
    torch.randn(500, 500, device=device) @ torch.randn(500, 500, device=device)
    last = clock.mark()
    clock.wait()
    assert 0 < clock.seconds(first, last) < 10 and clock.now() > start


def test_device_clock_marks_in_graph(device):
    clock = DeviceClock(device)
    assert not clock.capturing()
    if torch.device(device).type == "cpu":
        assert clock.mark_cost() == 0.0
        return
    cell = torch.zeros((), device=device)

    def marked():
        first = clock.mark()
        cell.add_(1)
        return first, clock.mark()

    graph = Captured(marked, device)
    for _ in range(2):
        first, last = graph()
        assert 0 < clock.seconds(first, last) < 0.1
    assert 0 <= clock.mark_cost() < 1e-4
