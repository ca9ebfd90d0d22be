"""Stages, medians and the checks of the timing, on a clock that does what it is told."""

import pytest
import torch

from gsim3d.pareto import self_check
from gsim3d.pareto.timing import DeviceClock, Stopwatch, Timing, time_call, time_stages, watched
from tests.pareto.fakes import FakeClock, FakeSimulator


def stages_of(clock, **options):
    simulator = FakeSimulator(clock)
    return time_stages(simulator, [simulator], clock, repeats=5, **options)


def test_stages_add_up_to_the_whole():
    timing = stages_of(FakeClock())
    assert timing.median == pytest.approx(6.5e-3)
    assert timing.stages == pytest.approx(
        {"encode": 2e-3, "dense layers": 3e-3, "head": 1e-3, "state and guards": 0.5e-3}
    )
    assert timing.unexplained < 1e-9
    assert self_check.adds_up(timing).holds


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


@pytest.mark.parametrize("stage", ["encode", "dense layers", "head"])
def test_a_delay_moves_its_own_stage_alone(stage):
    plain, delayed = stages_of(FakeClock()), stages_of(FakeClock(), delays={stage: self_check.DELAY})
    assert self_check.delayed_stage(plain, delayed, stage).holds
    other = "head" if stage != "head" else "encode"
    assert not self_check.delayed_stage(plain, delayed, other).holds


def test_a_timing_without_waiting_is_noticed():
    """The host runs ahead of the device, which is what a GPU looks like."""
    clock = FakeClock(host_share=0.1)
    waiting = stages_of(clock)
    blind = FakeClock(waits=False, host_share=0.1)
    simulator = FakeSimulator(blind)
    assert self_check.wait_is_needed(waiting, time_call(simulator, blind, repeats=5)).holds
    assert not self_check.wait_is_needed(waiting, waiting).holds


def test_stages_that_do_not_add_up_are_noticed():
    assert not self_check.adds_up(Timing((1.0,), {"encode": 0.9})).holds
    assert self_check.adds_up(Timing((1.0,), {"encode": 0.98})).holds


def test_an_order_that_matters_is_noticed():
    names = ["a", "b"]
    assert self_check.order([1.0, 2.0], [1.01, 1.99], names).holds
    noisy = self_check.order([1.0, 2.0], [1.01, 2.2], names)
    assert not noisy.holds
    assert "b moved most, by 10.0%" in noisy.seen and "too noisy" in noisy.seen


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
