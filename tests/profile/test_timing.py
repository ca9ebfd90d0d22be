"""Stages and medians, on a clock that does what it is told."""

import pytest
import torch

from gsim3d.cuda_graphs import Captured
from gsim3d.profile.timing import DeviceClock, GraphStopwatch, Stopwatch, Timing, time_call, time_stages, watched
from tests.profile.fakes import FakeClock, FakeGraph, FakeSimulator


def stages_of(clock, **options):
    simulator = FakeSimulator(clock)
    return time_stages(simulator, [simulator], clock, repeats=5, **options)


def test_stages_add_up_to_the_whole():
    timing = stages_of(FakeClock())
    assert timing.median == pytest.approx(6.5e-3)
    assert timing.stages == pytest.approx(
        {"encode": 2e-3, "dense layers": 3e-3, "head": 1e-3, "state and guards": 0.5e-3}
    )
    assert sum(timing.stages.values()) == pytest.approx(timing.median)


def test_a_stage_within_another_counts_as_itself_only():
    clock = FakeClock()
    stopwatch = Stopwatch(clock)
    with stopwatch.running():
        with stopwatch.stage("dense layers"):
            clock.work(1.0)
            with stopwatch.stage("attention"):
                clock.work(5.0)
            clock.work(2.0)
    assert stopwatch.seconds == pytest.approx({"state and guards": 0.0, "dense layers": 3.0, "attention": 5.0})


@pytest.mark.parametrize("cost", [0.0, 0.2e-3])
def test_stages_of_a_graph_are_those_of_every_replay(cost):
    """Neither the host nor the marks are in them, and what is run before the capture has no marks."""
    clock = FakeClock(launch=4e-3, cost=cost)
    simulator, stopwatch = FakeSimulator(clock), GraphStopwatch(clock)
    with watched(simulator, stopwatch), stopwatch.capturing():
        graph = FakeGraph(simulator, clock)
    expected = {"encode": 2e-3, "dense layers": 3e-3, "head": 1e-3, "state and guards": 0.5e-3}
    for _ in range(2):
        with stopwatch.running():
            graph()
        assert stopwatch.seconds == pytest.approx(expected)
    with watched(simulator, stopwatch), stopwatch.running():
        graph()
        simulator.renderer()  # drawn behind the graph; the host asks for it while the graph runs
    assert stopwatch.seconds == pytest.approx({**expected, "head": 2e-3})
    simulator()  # no longer watched
    assert len(stopwatch._marks) == 6
    eager = stages_of(FakeClock(host_share=0.0, launch=4e-3))
    assert sum(eager.stages.values()) > 2 * 6.5e-3  # one by one the device waits for the host in between


def test_warm_up_does_not_count():
    clock, seconds = FakeClock(), iter([9.0, 9.0, 1.0, 2.0, 4.0])
    timing = time_call(lambda: clock.work(next(seconds)), clock, repeats=3, warm_up=2)
    assert timing.repeats == (1.0, 2.0, 4.0)
    assert timing.median == 2.0 and timing.p95 == 4.0


def test_two_levels_do_not_look_like_noise():
    """A scene of 1 s and one of 2 s: the median of both jumps where the mean of the middle half hardly moves."""
    first, second = Timing((1.0, 1.0, 1.0, 2.0, 2.0, 2.0, 2.0)), Timing((1.0, 1.0, 1.0, 1.0, 2.0, 2.0, 2.0))
    assert abs(first.median - second.median) == 1.0
    assert abs(first.steady - second.steady) < 0.25
    assert Timing((3.0,)).steady == 3.0 and Timing((1.0, 2.0, 3.0, 100.0)).steady == 2.5


def test_ops_are_put_back():
    before = torch.ops.gsim3d.unpool
    with pytest.raises(KeyError, match="fails"):
        with watched(FakeSimulator(FakeClock()), Stopwatch(FakeClock())):
            assert torch.ops.gsim3d.unpool is not before
            raise KeyError("fails")
    assert torch.ops.gsim3d.unpool is before


def test_the_clock_of_a_device(device):
    clock = DeviceClock(device)
    clock.wait()
    first, start = clock.mark(), clock.now()
    clock.delay(0.02)
    last = clock.mark()
    clock.wait()
    assert 0.01 < clock.seconds(first, last) < 10
    assert clock.now() - start > 0.01


def test_marks_and_delays_are_part_of_a_graph(device):
    """And are passed in every replay; what a mark takes is little."""
    clock = DeviceClock(device)
    assert not clock.capturing()
    if torch.device(device).type == "cpu":
        assert clock.mark_cost() == 0.0
        return

    def delayed():
        first = clock.mark()
        clock.delay(0.01)
        return first, clock.mark()

    graph = Captured(delayed, device)
    for _ in range(2):
        first, last = graph()
        assert 0.005 < clock.seconds(first, last) < 0.1
    assert 0 <= clock.mark_cost() < 1e-4
