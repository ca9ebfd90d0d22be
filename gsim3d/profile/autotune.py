"""Finds the fastest setting within an accuracy limit, and saves the tuned presets with the checkpoint."""

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from statistics import fmean
from typing import Any

from gsim3d.errors import InputError
from gsim3d.evaluate.plan_costs import Workload
from gsim3d.evaluate.plan_report import TIMES, PartTimes
from gsim3d.evaluate.report import write_json
from gsim3d.io.machine import machine
from gsim3d.numerics.speed import SPEEDS_FILE, Setting, read_checkpoints
from gsim3d.profile.settings import GROUPS, Group
from gsim3d.profile.sweep import MAX_CACHED, PRESETS, BenchmarkCase, Effort, Point, Sweep, tie
from gsim3d.profile.timing import GAPS
from gsim3d.state import DYNAMIC
from gsim3d.train.restore import Restored

# preset -> smallest share of the reference's gain (PSNR above the constant baseline, in dB) that it may retain
PROMISES = {"exact": None, "balanced": 0.999, "fast": 0.99}
PART_OF_SECTION = {"head": "gaussians", "sort and raster": "images", GAPS: "host"}  # other sections: "dynamics"


def autotune(
    case: BenchmarkCase,
    *,
    max_ms: float | None = None,
    min_agreement_psnr: float | None = None,
    groups: Sequence[Group] = GROUPS,
    effort: Effort = Effort(),
) -> Point:
    """Measures settings on ``case`` and returns the best one within a limit.

    Args:
        case: simulator and scenes.
        max_ms: largest time of a step in milliseconds; returns the most accurate setting within it.
        min_agreement_psnr: smallest PSNR against the reference in dB; returns the fastest setting within it.
        groups: settings to try.
        effort: number of measurements; use at least 3 rounds to separate differences from noise.
    Raises:
        InputError: not exactly one limit is given, or no setting is within it.
    """
    if (max_ms is None) == (min_agreement_psnr is None):
        raise InputError("autotune: give either max_ms or min_agreement_psnr")
    sweep = Sweep(case, effort)
    points, _ = sweep.points(groups)
    sweep.run(points)
    if max_ms is None:
        return fastest(sweep, points, lambda point: point.agreement.psnr >= min_agreement_psnr)
    usable = [p for p in points if not p.failure]
    if 1e3 * min(p.step_seconds for p in usable) > max_ms:
        usable.append(fastest(sweep, points, lambda point: True))  # no single setting is fast enough: combine them
    within = [p for p in usable if 1e3 * p.step_seconds <= max_ms]
    if within:
        return max(within, key=lambda p: p.agreement.psnr)
    least = 1e3 * min(p.step_seconds for p in usable)
    raise InputError(f"autotune: no setting takes at most {max_ms:g} ms a step; the fastest takes {least:.3g} ms")


def tune(sweep: Sweep, points: Sequence[Point]) -> dict[str, Point]:
    """Returns the point of each preset in PROMISES, from measured ``points``, the reference first."""
    case, reference = sweep.case, points[0]
    return {
        name: reference if share is None else fastest(sweep, points, keeping(case, reference, share))
        for name, share in PROMISES.items()
    }


def keeping(case: BenchmarkCase, reference: Point, share: float) -> Callable[[Point], bool]:
    """Returns a predicate: whether a point retains at least ``share`` of the gain of ``reference``."""

    def keeps(point: Point) -> bool:
        kept = case.share_kept(point, reference)
        return kept is not None and kept >= share

    return keeps


def fastest(sweep: Sweep, points: Sequence[Point], keeps: Callable[[Point], bool]) -> Point:
    """Greedily combines the settings that save time and satisfy ``keeps``, and measures each combination."""
    useful = [p for p in points[1:] if _saves(p, points) and keeps(p)]
    if not useful:
        return points[0]
    useful.sort(key=lambda p: p.step_seconds)
    best = max((p for p in useful if p is useful[0] or tie(p, useful[0])), key=lambda p: p.agreement.psnr)
    for point in useful:
        both = _both(sweep, best, point)
        if both is None:
            continue
        if not both.step and sweep.limit.is_over(PRESETS):
            break
        sweep.run([both])
        if not both.failure and keeps(both) and _faster(both, best):
            best = both
    return best


def _both(sweep: Sweep, best: Point, point: Point) -> Point | None:
    """Combination of two settings; None if they change the same option or exclude each other."""
    changes, before = point.setting.to_dict(), best.setting.to_dict()
    if set(changes) & set(before) - {"captured"} or set(changes) <= set(before):
        return None
    try:
        return sweep.point(dataclasses.replace(best.setting, **changes), "together", "model")
    except InputError:
        return None


def _saves(point: Point, points: Sequence[Point]) -> bool:
    """Whether ``point`` saves time beyond what graph capture alone saves."""
    graph = next((p for p in points if p.setting == Setting(captured=True) and not p.failure), None)
    if graph is None or not point.setting.captured or point is graph:
        return _faster(point, points[0])
    return _faster(point, graph) and point.step_seconds < points[0].step_seconds


def _faster(point: Point, than: Point) -> bool:
    return not point.failure and point.step_seconds < than.step_seconds and not tie(point, than)


def part_times(case: BenchmarkCase, reference: Point) -> PartTimes | None:
    """Milliseconds of the parts of a step of ``reference``; None if its sections were not recorded."""
    if not reference.sections():
        return None
    parts: dict[str, float] = {}
    for section, seconds in reference.sections().items():
        part = PART_OF_SECTION.get(section, "dynamics")
        parts[part] = parts.get(part, 0.0) + 1e3 * seconds
    newest = [case.newest(number).activity for number in range(len(case.scenes))[:MAX_CACHED]]
    moving = round(fmean(int((activity == DYNAMIC).sum()) for activity in newest))
    height, width = case.restored.image_size
    work = Workload(moving, round(fmean(map(len, newest))) - moving, len(case.views[0][1]), height * width)
    facts = machine(case.device)
    return PartTimes(", ".join(facts[name] for name in ("processor", "device") if name in facts), work, **parts)


def save_speeds(folder: Path, restored: Restored, presets: dict[str, Point], times: PartTimes | None = None) -> Path:
    """Saves presets and part times of a checkpoint on its device in ``folder``/speeds.json. Returns the path."""
    known = read_checkpoints(path := folder / SPEEDS_FILE)
    digest, device = restored.checkpoint.digest, restored.device.type
    settings: dict[str, Any] = {name: point.setting.to_dict() for name, point in presets.items()}
    if times is not None:
        settings[TIMES] = asdict(times)
    write_json(path, {**known, digest: {**known.get(digest, {}), device: settings}})
    return path
