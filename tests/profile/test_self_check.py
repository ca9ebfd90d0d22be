"""The timing's own check holds where the timing is right, and fails for every flaw that it is there to find."""

import itertools
import math
import random

import pytest

from gsim3d.profile import self_check
from gsim3d.profile.self_check import Interval, check_order, check_stages
from gsim3d.profile.timing import DeviceClock, GraphStopwatch, Stopwatch, watched
from tests.profile.fakes import FakeClock, FakeGraph, FakeSimulator

STAGES = ("encode", "dense layers", "head")


def of_a_graph(clock, spoil=lambda stages: stages):
    """(what check_stages watches, the bare step), replayed from graphs."""
    simulator = FakeSimulator(clock)

    def watch(delays):
        stopwatch = GraphStopwatch(clock, delays)
        with watched(simulator, stopwatch), stopwatch.capturing():
            graph = FakeGraph(simulator, clock)

        def stages():
            clock.wait()
            with stopwatch.running():
                graph()
            return spoil(dict(stopwatch.seconds))

        return stages

    return watch, FakeGraph(simulator, clock)


def launched_one_by_one(clock):
    simulator = FakeSimulator(clock)

    def watch(delays):
        stopwatch = Stopwatch(clock, delays)

        def stages():
            clock.wait()
            with watched(simulator, stopwatch), stopwatch.running():
                simulator()
            return stopwatch.seconds

        return stages

    return watch, simulator


class BlindClock:
    """``clock``, whose wait does nothing."""

    def __init__(self, clock):
        self.now = clock.now

    def wait(self):
        pass


def checked(watch, step, clock, blind=None):
    return check_stages(watch, step, step, clock, blind, STAGES)


def test_a_right_timing_holds():
    clock = FakeClock(host_share=0.0, launch=1e-3)
    checks = checked(*of_a_graph(clock), clock, BlindClock(clock))
    assert len(checks) == 2 + len(STAGES) and all(check.holds for check in checks), [str(c) for c in checks]
    assert checks[1].name == "5.0 ms wasted in encode"
    clock = FakeClock()  # a CPU: the host does all work itself
    assert all(check.holds for check in checked(*launched_one_by_one(clock), clock))


def test_a_delay_that_hides_gaps_of_the_host_is_noticed():
    """Where the host launches more slowly than the device works, 5 ms in one stage are taken from the next ones."""
    clock = FakeClock(host_share=0.0, launch=4e-3)
    failed = [check for check in checked(*launched_one_by_one(clock), clock) if not check.holds]
    assert "wasted in encode" in failed[0].name
    assert "of the others" in failed[0].seen and "too noisy" not in failed[0].seen


@pytest.mark.parametrize(
    ("flaw", "failing"),
    [
        (lambda stages: {**stages, "head": stages["head"] + 0.25 * stages["encode"]}, "wasted in encode"),
        (lambda stages: {**stages, "encode": 0.8 * stages["encode"]}, "wasted in encode"),
        (lambda stages: {**stages, "encode": min(stages["encode"], 3e-3)}, "wasted in encode"),
        (lambda stages: {name: s for name, s in stages.items() if name != "head"}, "add up"),
        (lambda stages: {name: 1.05 * s for name, s in stages.items()}, "add up"),
    ],
)
def test_wrong_stages_are_noticed(flaw, failing):
    clock = FakeClock()
    failed = [check for check in checked(*of_a_graph(clock, flaw), clock) if not check.holds]
    assert any(failing in check.name for check in failed)
    assert all("too noisy" not in check.seen for check in failed)


def test_a_timing_without_waiting_is_noticed():
    """The check holds where leaving out the wait changes what is seen, and fails where it does not."""
    clock = FakeClock(host_share=0.1)
    assert checked(*of_a_graph(clock), clock, BlindClock(clock))[-1].holds
    last = checked(*of_a_graph(clock), clock, clock)[-1]
    assert last.name.startswith("a timing that does not wait") and not last.holds


def noisy(share, clock):
    """A stopwatch whose every measurement of a stage is off by up to this share, to both sides."""
    off = random.Random(0).uniform
    return of_a_graph(clock, lambda stages: {name: s * (1 + off(-share, share)) for name, s in stages.items()})


def test_noise_does_not_help():
    """It fails a check that would hold without it, and says why; a little of it is averaged away."""
    clock = FakeClock()
    assert all(check.holds for check in checked(*noisy(0.005, clock), clock))
    loud = checked(*noisy(0.4, clock), clock)[1:]
    assert not any(check.holds for check in loud) and any("too noisy to tell" in check.seen for check in loud)


def steps(clock, seconds, after_another=0.0):
    """Calls by name; the first one after a call of another takes longer by a share."""
    last = [None]

    def call(name):
        late = after_another if last[0] not in (None, name) and last[0] < name else 0.0
        clock.work(seconds[name] * (1 + late))
        last[0] = name

    return {name: lambda name=name: call(name) for name in seconds}


def test_an_order_that_matters_is_noticed(monkeypatch):
    seconds = {"a": 1e-3, "b": 2e-3, "c": 3e-3}
    clock = FakeClock()
    (check,) = check_order(steps(clock, seconds), [], clock)
    assert check.holds and "moved most, by 0.0% (± 0.0%)" in check.seen
    monkeypatch.setattr(self_check, "VISIT", 1)  # the first call counts: what ran before is in it
    (check,) = check_order(steps(clock, seconds, after_another=0.1), [], clock)
    assert not check.holds and "too noisy" not in check.seen


def test_a_drift_is_no_effect_of_the_order():
    """A machine that becomes slower all the time is still told from one where the order matters, or called noisy."""
    clock, factor = FakeClock(), [1.0]

    def call():
        factor[0] *= 1.00001
        clock.work(1e-3 * factor[0])

    (check,) = check_order({"a": call, "b": call}, [], clock)
    assert check.holds


def test_a_noisy_host_fails_its_own_check_only():
    """Settings that the host launches are judged apart from those replayed from a graph."""
    clock, signs = FakeClock(), itertools.cycle([1.3, 0.8, 1.0, 0.7, 1.2])
    calls = {"graph": lambda: clock.work(1e-3), "reference": lambda: clock.work(1e-3 * next(signs))}
    replayed, launched = check_order(calls, ["reference"], clock)
    assert replayed.holds and "that the host launches" in launched.name
    steady = dict.fromkeys(calls, calls["graph"])
    assert all(check.holds for check in check_order(steady, ["reference"], clock))


def test_without_time_nothing_is_claimed():
    clock = FakeClock()
    watch, step = of_a_graph(clock)
    (check,) = check_stages(watch, step, step, clock, None, STAGES, most=0.1)
    assert not check.holds and "not checked: of steps of 0.0065 s" in check.seen


def test_the_interval_of_a_median():
    assert Interval.of(range(5)).reach == math.inf  # too few to say anything
    assert (Interval.of(range(6)).low, Interval.of(range(6)).high) == (0, 5)
    assert Interval.of([1.0] * 8 + [50.0]).reach == 0 == Interval.of([1.0] * 7 + [50.0, -50.0]).reach
    twenty = Interval.of(range(20))
    assert (twenty.median, twenty.low, twenty.high) == (9.5, 5, 14)


def test_on_a_real_simulator(subject, one_thread):
    """Every check is made and says what it saw; whether it holds is the machine's affair."""
    told = []
    checks = self_check.self_check(subject, DeviceClock("cpu"), None, told.append, seconds=0.5)
    assert [check.name.split(" within ")[0].split(" ms ")[-1] for check in checks] == [
        "stages add up to the whole",
        *(f"wasted in {stage}" for stage in self_check.STAGES_DELAYED),
        "another order of settings moves medians by less than 3%",
    ]
    assert told == ["self-check: stages", "self-check: order of settings"]
    assert all("±" in check.seen for check in checks)
