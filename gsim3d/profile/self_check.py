"""Whether the timing can be trusted on this machine: done for real, and printed in the report.

Everything is repeated in rounds, in another order each, until the spread of the rounds says the result precisely enough
to judge it, or the time is over. A check holds where the whole interval of its result is within the bound, fails where
it is not, and says that the machine is too noisy where only the width of the interval is to blame: noise never helps.
On a GPU a step is replayed from a graph: one that the host launches kernel by kernel leaves gaps, which hide a delay.
"""

from __future__ import annotations

import math
import random
import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from gsim3d.errors import CaptureError, InputError
from gsim3d.profile.settings import Setting
from gsim3d.profile.stepping import Stepping
from gsim3d.profile.subject import Subject
from gsim3d.profile.timing import ADDS_UP, Clock, GraphStopwatch, Stopwatch, time_call

STAGES_DELAYED = ("convolution", "attention", "sort and raster")
DELAY, DELAY_SHARE = 5e-3, 0.3  # that is injected: seconds, or of a step where that is more
TOLERANCE = 0.1  # of the delay, by which stages may be wrong
NOISE = 0.03  # by which the order of settings may move a median
CERTAIN = 0.95  # of an interval of a median
LEAST_ROUNDS = 9  # of which one to each side may be an outlier
MOST_ROUNDS, MOST_SECONDS = 60, 15.0  # of each of the two parts of the check
VISIT = 7  # steps of a setting that are timed in turn, as in a round of the report
PLAIN, WHOLE, ALONE, BLIND = "watched", "unwatched", "delay alone", "without waiting"  # what a round has


@dataclass(frozen=True)
class Check:
    """One check of the timing: what was done, whether it holds, what was seen; whether more rounds would tell more."""

    name: str
    holds: bool
    seen: str
    is_precise: bool = True

    def __str__(self) -> str:
        return f"{'holds' if self.holds else 'FAILS'}: {self.name}: {self.seen}"


@dataclass(frozen=True)
class Interval:
    """The median of the numbers that were seen, and the ends between which that of all there could be lies."""

    median: float
    low: float
    high: float

    @classmethod
    def of(cls, values: Sequence[float]) -> Interval:
        """By order: with ``CERTAIN``, whatever their distribution; of fewer than 6 values without ends."""
        ordered, n = sorted(values), len(values)
        below, rank = 0.0, 0  # chance that no more than ``rank`` values are on one side of the median
        while (below := below + math.comb(n, rank) / 2**n) <= (1 - CERTAIN) / 2:
            rank += 1
        ends = (ordered[rank - 1], ordered[n - rank]) if rank else (-math.inf, math.inf)
        return cls(statistics.median(ordered), *ends)

    @property
    def reach(self) -> float:
        """How far from the median it goes at most."""
        return max(self.high - self.median, self.median - self.low)

    def is_within(self, bound: float) -> bool:
        return max(abs(self.low), abs(self.high)) <= bound

    def in_ms(self) -> str:
        return f"{1e3 * self.median:.2f} ms (± {1e3 * self.reach:.2f})"

    def in_percent(self) -> str:
        return f"{self.median:.1%} (± {self.reach:.1%})"


Rounds = dict[str, list]


def repeat(
    tasks: Mapping[str, Callable[[], Any]], checks: Callable[[Rounds], list[Check]], seconds: float = MOST_SECONDS
) -> list[Check]:
    """The checks of what ``tasks`` give, in rounds, each in another order, until every check is precise."""
    shuffle, found, start = random.Random(0).shuffle, {name: [] for name in tasks}, time.monotonic()
    for n in range(1, MOST_ROUNDS + 1):
        order = list(tasks)
        shuffle(order)
        for name in order:
            found[name].append(tasks[name]())
        judged = checks(found)
        is_over = time.monotonic() - start > seconds
        if n >= LEAST_ROUNDS and (is_over or all(check.is_precise for check in judged)):
            break
    return judged


def judged(name: str, intervals: Sequence[Interval], bound: float, seen: str) -> Check:
    """Whether what was found is within the bound, however far it may be off."""
    holds = all(found.is_within(bound) for found in intervals)
    if not holds and all(found.low <= bound and found.high >= -bound for found in intervals):
        seen += "; this machine is too noisy to tell"
    return Check(name, holds, seen, all(found.reach <= bound / 2 for found in intervals))


def delayed_stage(found: Rounds, stage: str) -> Check:
    """A delay in one stage must move that stage by as much as it takes alone, and no other."""
    names = dict.fromkeys(name for stages in found[PLAIN] for name in stages if name != stage)
    pairs = list(zip(found[PLAIN], found[stage], strict=True))
    moved = [with_it.get(stage, 0.0) - without.get(stage, 0.0) for without, with_it in pairs]
    others = {name: Interval.of([b.get(name, 0.0) - a.get(name, 0.0) for a, b in pairs]) for name in names}
    delay, own = statistics.median(found[ALONE]), Interval.of(moved)
    error = Interval.of([seconds - wasted for seconds, wasted in zip(moved, found[ALONE], strict=True)])
    seen = f"{stage} moved by {own.in_ms()}"
    if others:
        farthest = max(others, key=lambda name: abs(others[name].median))
        seen += f", of the others {farthest} most, by {others[farthest].in_ms()}"
    return judged(f"{1e3 * delay:.1f} ms wasted in {stage}", [error, *others.values()], TOLERANCE * delay, seen)


def adds_up(found: Rounds) -> Check:
    """Stages must add up to the whole of a call in which nothing is marked."""
    sums = [sum(stages.values()) for stages in found[PLAIN]]
    off = Interval.of([stages / whole - 1 for stages, whole in zip(sums, found[WHOLE], strict=True)])
    seen = f"stages {1e3 * statistics.median(sums):.2f} ms, whole {1e3 * statistics.median(found[WHOLE]):.2f} ms"
    name = f"stages add up to the whole within {ADDS_UP:.0%}"
    return judged(name, [off], ADDS_UP, f"{seen}, apart by {off.in_percent()}")


def wait_is_needed(found: Rounds) -> Check:
    """Without a wait for the device, the whole must fall visibly short of its stages; else nothing would tell."""
    sums = [sum(stages.values()) for stages in found[PLAIN]]
    share = Interval.of([blind / whole for blind, whole in zip(found[BLIND], sums, strict=True)])
    with_wait, without = (1e3 * statistics.median(found[name]) for name in (WHOLE, BLIND))
    holds = share.high < 1 - ADDS_UP
    seen = f"{with_wait:.2f} ms with, {without:.2f} ms without"
    return Check("a timing that does not wait for the device is noticed", holds, seen, holds)


def order(found: Rounds, names: Sequence[str], how: str = "") -> Check:
    """The order in which settings are measured must not move medians; ``found``: pairs, in one order and another."""
    moved = {name: Interval.of([second / first - 1 for first, second in found[name]]) for name in names}
    worst = max(moved, key=lambda name: abs(moved[name].median))
    seen = f"{worst} moved most, by {moved[worst].in_percent()}"
    name = f"another order of settings{how} moves medians by less than {NOISE:.0%}"
    return judged(name, list(moved.values()), NOISE, seen)


def check_stages(
    watched: Callable[[dict[str, float]], Callable[[], dict[str, float]]],
    bare: Callable[[], Any],
    launch: Callable[[], Any],
    clock: Clock,
    blind: Clock | None,
    stages: Sequence[str] = STAGES_DELAYED,
    seconds: float = MOST_SECONDS,
    most: float = math.inf,
) -> list[Check]:
    """The checks of one step.

    Args:
        watched: (delays by stage) -> the step, which gives its stages.   bare: the step, unwatched.
        launch: the step, without a wait of its own.   blind: as ``clock``, but its ``wait`` does nothing; or None.
        seconds: after which no more rounds are made than must be.   most: seconds that these may take.
    """
    step = time_call(bare, clock, 2, 1).median
    delay = max(DELAY, DELAY_SHARE * step)
    if LEAST_ROUNDS * (3 + 2 * len(stages)) * step > most:
        return [Check("the timing", False, f"not checked: of steps of {step:.2g} s there is no time for enough")]

    def alone() -> float:
        clock.delay(delay)  # the device is busy while it is asked for what counts
        first = clock.mark()
        clock.delay(delay)
        last = clock.mark()
        clock.wait()
        return clock.seconds(first, last)

    def without_waiting() -> float:
        clock.wait()
        seconds = time_call(launch, blind, 1, 0).median
        clock.wait()
        return seconds

    tasks = {PLAIN: watched({}), WHOLE: lambda: time_call(bare, clock, 1, 0).median, ALONE: alone}
    tasks |= {stage: watched({stage: delay}) for stage in stages}
    if blind is not None:
        tasks[BLIND] = without_waiting
    for task in tasks.values():  # nothing of a first call counts
        task()

    def checks(found: Rounds) -> list[Check]:
        last = [wait_is_needed(found)] if blind is not None else []
        return [adds_up(found), *(delayed_stage(found, stage) for stage in stages), *last]

    return repeat(tasks, checks, seconds)


def check_order(
    calls: Mapping[str, Callable[[], Any]], launched: Sequence[str], clock: Clock, seconds: float = MOST_SECONDS
) -> list[Check]:
    """Whether what is timed before a setting moves its median.

    Args:
        calls: of settings by name.   launched: names of those whose kernels the host of a GPU launches one by one; they
            are judged apart, since the noise of the host is in them.
    """
    rough = sum(time_call(call, clock, 2, 1).median for call in calls.values())
    n_calls = min(VISIT, max(1, int(seconds / (2 * LEAST_ROUNDS * rough))))

    def visit(name: str) -> float:
        return time_call(calls[name], clock, n_calls, min(1, n_calls - 1)).median

    def both() -> dict[str, tuple[float, float]]:
        first = {name: visit(name) for name in calls}
        second = {name: visit(name) for name in reversed(calls)}
        return {name: (first[name], second[name]) for name in calls}

    def checks(found: Rounds) -> list[Check]:
        pairs = {name: [seen[name] for seen in found[PLAIN]] for name in calls}
        replayed = [name for name in calls if name not in launched]
        judged_apart = [order(pairs, launched, " that the host launches")] if launched else []
        return [order(pairs, replayed), *judged_apart]

    return repeat({PLAIN: both}, checks, seconds)


def self_check(
    subject: Subject,
    clock: Clock,
    blind: Clock | None,
    progress: Callable[[str], None] = lambda doing: None,
    seconds: float = MOST_SECONDS,
    most: float = math.inf,
) -> list[Check]:
    """All checks, on the reference's step.

    Args:
        blind: as ``clock``, but its ``wait`` does nothing; None where there is nothing to wait for (a CPU).
        seconds: after which each of the two parts ends, once it has the fewest rounds that can be judged.
        most: seconds that these may take; where they would take longer, nothing is checked.
    """
    progress("self-check: stages")
    bare = _reference(subject, clock)
    reference = bare.runner.setting
    from_graph = reference.captured

    def watched(delays: dict[str, float]) -> Callable[[], dict[str, float]]:
        stopwatch = (GraphStopwatch if from_graph else Stopwatch)(clock, delays)
        stepping = Stepping(subject, reference, clock, span=1, stopwatch=stopwatch)

        def stages() -> dict[str, float]:
            clock.wait()
            stepping()
            return stopwatch.seconds

        return stages

    checks = check_stages(watched, bare, bare.launch, clock, blind, seconds=seconds, most=most)
    if len(checks) == 1:
        return checks
    progress("self-check: order of settings")
    settings = [Setting(), Setting(kept=0.5), Setting(cutoff="tile3sigma")]
    if from_graph:
        graphs = [reference, Setting(kept=0.5, captured=True), Setting("bf16", "bf16", "bf16", captured=True)]
        settings = [*graphs, Setting()]
    calls = {setting.name: Stepping(subject, setting, clock) for setting in settings}
    return [*checks, *check_order(calls, [Setting().name] if from_graph else [], clock, seconds)]


def _reference(subject: Subject, clock: Clock) -> Stepping:
    """The reference's step, on a GPU from a graph that draws too, where there can be one."""
    captured = Setting(captured=True)
    if subject.device.type == "cuda" and subject.runner(captured).draws_in_graph:
        try:
            return Stepping(subject, captured, clock, span=1)
        except (CaptureError, InputError):
            pass
    return Stepping(subject, Setting(), clock, span=1)
