"""Whether the timing can be trusted on this machine: done for real, and printed in the report."""

from __future__ import annotations

from dataclasses import dataclass

from gsim3d.pareto.measure import Effort, Point, time_points
from gsim3d.pareto.settings import Setting
from gsim3d.pareto.subject import Subject
from gsim3d.pareto.timing import ADDS_UP, Clock, Timing, time_call, time_stages

DELAY, TOLERANCE = 5e-3, 0.5e-3  # seconds that are injected, and by which stages may be wrong
NOISE = 0.03  # by which the order of settings may move a median


@dataclass(frozen=True)
class Check:
    """One check of the timing: what was done, whether it holds, and what was seen."""

    name: str
    holds: bool
    seen: str

    def __str__(self) -> str:
        return f"{'holds' if self.holds else 'FAILS'}: {self.name}: {self.seen}"


def delayed_stage(plain: Timing, delayed: Timing, stage: str) -> Check:
    """A delay in one stage must move that stage by as much, and no other."""
    names = dict.fromkeys([*plain.stages, *delayed.stages])
    moved = {name: delayed.stages.get(name, 0.0) - plain.stages.get(name, 0.0) for name in names}
    others = {name: change for name, change in moved.items() if name != stage}
    farthest = max(others, key=lambda name: abs(others[name]), default=None)
    holds = abs(moved.get(stage, 0.0) - DELAY) <= TOLERANCE and all(abs(c) <= TOLERANCE for c in others.values())
    seen = f"{stage} moved by {1e3 * moved.get(stage, 0.0):.2f} ms"
    if farthest is not None:
        seen += f", of the others {farthest} most, by {1e3 * others[farthest]:.2f} ms"
    return Check(f"{1e3 * DELAY:.0f} ms wasted in {stage}", holds, seen)


def adds_up(timing: Timing) -> Check:
    """Stages must add up to the whole."""
    whole = 1e3 * timing.median
    seen = f"stages {1e3 * sum(timing.stages.values()):.2f} ms, whole {whole:.2f} ms"
    return Check(f"stages add up to the whole within {ADDS_UP:.0%}", timing.unexplained <= ADDS_UP, seen)


def wait_is_needed(waiting: Timing, not_waiting: Timing) -> Check:
    """Without a wait for the device, the whole must fall visibly short of its stages; else nothing would tell."""
    short = not_waiting.median < (1 - ADDS_UP) * sum(waiting.stages.values())
    seen = f"{1e3 * waiting.median:.2f} ms with, {1e3 * not_waiting.median:.2f} ms without"
    return Check("a timing that does not wait for the device is noticed", short, seen)


def order(first: list[float], second: list[float], names: list[str]) -> Check:
    """The order in which settings are measured must not move their medians."""
    moved = [abs(b / a - 1) for a, b in zip(first, second, strict=True)]
    worst = max(range(len(moved)), key=moved.__getitem__)
    seen = f"{names[worst]} moved most, by {moved[worst]:.1%}"
    if moved[worst] > NOISE:
        seen += "; this machine is too noisy for differences as small"
    return Check(f"another order of settings moves medians by less than {NOISE:.0%}", moved[worst] <= NOISE, seen)


def self_check(subject: Subject, clock: Clock, blind: Clock | None, repeats: int = 20) -> list[Check]:
    """All checks on the reference's step.

    Args:
        blind: as ``clock``, but its ``wait`` does nothing; None where there is nothing to wait for (a CPU).
    """
    runner, cameras = subject.runner(), subject.cameras(0, 0)
    state = subject.start(runner, 0)

    def call() -> None:
        runner.images(runner.newest(runner.step(state)), cameras)

    plain = time_stages(call, [runner.simulator], clock, repeats)
    checks = [adds_up(plain)]
    for stage in ("convolution", "attention", "sort and raster"):
        delayed = time_stages(call, [runner.simulator], clock, repeats, delays={stage: DELAY})
        checks.append(delayed_stage(plain, delayed, stage))
    if blind is not None:
        checks.append(wait_is_needed(plain, time_call(call, blind, repeats)))
    medians = []
    for seed in (1, 2):
        points = [Point(s, "", "exact") for s in (Setting(), Setting(kept=0.5), Setting(cutoff="tile3sigma"))]
        time_points(subject, points, clock, Effort(n_rounds=1, repeats=repeats), seed)
        medians.append([point.step_seconds for point in points])
    checks.append(order(*medians, [point.setting.name for point in points]))
    return checks
