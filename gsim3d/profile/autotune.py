"""Finds the fastest setting that keeps a promise, and keeps it for later runs."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path

from gsim3d.errors import InputError
from gsim3d.evaluate.report import write_json
from gsim3d.numerics import speed
from gsim3d.numerics.speed import SPEEDS_FILE, Setting, read_speeds
from gsim3d.profile.limit import PRESETS, TimeLimit
from gsim3d.profile.measure import Comparison, Effort, Point, measure, points_of, ties
from gsim3d.profile.part_times import PartTimes
from gsim3d.profile.settings import KNOBS, NOT_TUNED, Knob
from gsim3d.profile.subject import Subject
from gsim3d.profile.timing import Clock, DeviceClock
from gsim3d.train.restore import Restored

# preset -> share of the reference's gain over the constant baseline, in dB, that it keeps at least
PROMISES = {"exact": None, "balanced": 0.999, "fast": 0.99}
TIMES = "measured"  # the key of times, beside the presets of a device


def autotune(
    subject: Subject,
    *,
    max_ms: float | None = None,
    min_agreement_psnr: float | None = None,
    knobs: Sequence[Knob] = KNOBS,
    effort: Effort = Effort(),
) -> Point:
    """The best setting within a limit: with ``max_ms`` the most accurate one whose step takes at most as long; with
    ``min_agreement_psnr`` the fastest one that agrees with the reference that well. Measured on ``subject``.

    Args:
        knobs: that may be turned.   effort: how long to measure; at least 3 rounds tell differences from noise.
    Raises:
        InputError: not exactly one limit, or no setting keeps it; the message says how near one came.
    """
    if (max_ms is None) == (min_agreement_psnr is None):
        raise InputError("autotune: give either max_ms or min_agreement_psnr")
    clock = DeviceClock(subject.device)
    comparison = Comparison(subject, clock=None if effort.apart else clock)
    points, _ = points_of(subject, knobs, effort)
    measure(comparison, points, clock, effort)
    if max_ms is not None:
        return _most_accurate(comparison, points, max_ms, clock, effort)

    def keeps(point: Point) -> bool:
        return point.agreement.psnr >= min_agreement_psnr

    return fastest(comparison, points, keeps, clock, effort)


def tune(
    comparison: Comparison,
    points: Sequence[Point],
    clock: Clock,
    effort: Effort,
    progress: Callable[[str], None] = lambda doing: None,
    limit: TimeLimit = TimeLimit(),
) -> dict[str, Point]:
    """The setting of each preset, from measured ``points``, of which the first is the reference."""
    reference, measured = points[0], {}

    def keeping(share: float) -> Callable[[Point], bool]:
        return lambda point: keeps_gain(comparison, point, reference, share)

    found = {"exact": reference}
    for name, share in PROMISES.items():
        if share is not None:
            found[name] = fastest(comparison, points, keeping(share), clock, effort, measured, progress, limit)
    return found


def keeps_gain(comparison: Comparison, point: Point, reference: Point, share: float) -> bool:
    """Whether ``point`` keeps this share of the reference's gain over the constant baseline, at its rendered steps."""
    kept = comparison.share_kept(point, reference)
    return kept is not None and kept >= share


def fastest(
    comparison: Comparison,
    points: Sequence[Point],
    keeps: Callable[[Point], bool],
    clock: Clock,
    effort: Effort,
    measured: dict[Setting, Point] | None = None,
    progress: Callable[[str], None] = lambda doing: None,
    limit: TimeLimit = TimeLimit(),
) -> Point:
    """The reference with every turn that keeps the promise and saves time, added one by one and measured together.

    measured: what was measured together before; what is now, is added.   limit: once it is over nothing more is.
    """
    measured = {} if measured is None else measured
    useful = [p for p in points[1:] if p.knob not in NOT_TUNED and _saves(p, points) and keeps(p)]
    if not useful:
        return points[0]
    useful.sort(key=lambda p: p.step_seconds)
    best = max((p for p in useful if p is useful[0] or ties(p, useful[0])), key=lambda p: p.agreement.psnr)
    for point in useful:
        both = _both(best, point)
        if both is None:
            continue
        if both.setting not in measured:
            if limit.is_over(PRESETS):
                break
            measured[both.setting] = both
            measure(comparison, [both], clock, effort, progress)
        both = measured[both.setting]
        if not both.failure and keeps(both) and _faster(both, best):
            best = both
    return best


def _both(best: Point, point: Point) -> Point | None:
    """The settings of two points in one; None where both turn the same knob, or cannot be had together."""
    changes, before = point.setting.to_dict(), best.setting.to_dict()
    if set(changes) & set(before) - {"captured"} or set(changes) <= set(before):
        return None
    try:
        return Point(dataclasses.replace(best.setting, **changes), "together", "model")
    except InputError:
        return None


def _saves(point: Point, points: Sequence[Point]) -> bool:
    """Whether what ``point`` turns saves time, and not only the graph that it is replayed from."""
    graph = next((p for p in points if p.setting == Setting(captured=True) and not p.failure), None)
    if graph is None or not point.setting.captured or point is graph:
        return _faster(point, points[0])
    return _faster(point, graph) and point.step_seconds < points[0].step_seconds


def _faster(point: Point, than: Point) -> bool:
    return not point.failure and point.step_seconds < than.step_seconds and not ties(point, than)


def _most_accurate(
    comparison: Comparison, points: Sequence[Point], max_ms: float, clock: Clock, effort: Effort
) -> Point:
    usable = [p for p in points if not p.failure and p.knob not in NOT_TUNED]
    within = [p for p in usable if 1e3 * p.step_seconds <= max_ms]
    if within:
        return max(within, key=lambda p: p.agreement.psnr)
    # None alone is fast enough: the nearest to the reference first, turns are added until one is.
    best = points[0]
    for point in sorted(usable, key=lambda p: -p.agreement.psnr):
        both = _both(best, point)
        if both is None or not _faster(point, points[0]):
            continue
        measure(comparison, [both], clock, effort)
        if both.failure:
            continue
        if _faster(both, best):
            best = both
        if 1e3 * best.step_seconds <= max_ms:
            return best
    raise InputError(
        f"autotune: no setting takes at most {max_ms:g} ms a step; the fastest takes {1e3 * best.step_seconds:.3g}"
    )


def save_speeds(folder: Path, restored: Restored, presets: dict[str, Point], times: PartTimes | None = None) -> Path:
    """Keeps the tuned presets of a checkpoint on its device, and what its reference took, in ``folder``/speeds.json,
    beside those of others."""
    path, known = folder / SPEEDS_FILE, read_speeds(folder)
    digest, device = restored.checkpoint.digest, restored.device.type
    settings = {name: point.setting.to_dict() for name, point in presets.items()}
    if times is not None:
        settings[TIMES] = dataclasses.asdict(times)
    write_json(path, {**known, digest: {**known.get(digest, {}), device: settings}})
    return path


def load_speed(folder: Path, restored: Restored, preset: str) -> Setting:
    """As :func:`gsim3d.numerics.speed.load_speed`, of the option --speed."""
    try:
        return speed.load_speed(folder, restored.checkpoint.digest, restored.device.type, preset)
    except InputError as error:
        raise InputError(f"--{error}") from None


def load_times(folder: Path, restored: Restored) -> dict[str, PartTimes]:
    """Kind of device -> what the reference of a checkpoint took where it was measured; empty where it was not."""
    devices = read_speeds(folder).get(restored.checkpoint.digest)
    known = {name: kept[TIMES] for name, kept in (devices or {}).items() if isinstance(kept, dict) and TIMES in kept}
    return {
        name: PartTimes.from_dict(values, f"{folder / SPEEDS_FILE}: {name}: {TIMES}") for name, values in known.items()
    }
