"""The report of accuracy against time: report.json, report.csv, pictures, and one page that holds all of it."""

from __future__ import annotations

import csv
import io
import os
from collections.abc import Sequence
from pathlib import Path

from gsim3d.evaluate.report import write_json
from gsim3d.profile import budget, figures, published
from gsim3d.profile.budget import Training
from gsim3d.profile.measure import Comparison, Point, ties
from gsim3d.profile.page import page, share_in_words
from gsim3d.profile.regimes import Throughput, TrainingStep, Work
from gsim3d.profile.settings import KINDS
from gsim3d.profile.timing import STAGES, Timing

FORMAT = 2


def as_dict(
    points: Sequence[Point],
    comparison: Comparison,
    conditions: dict,
    presets: dict[str, Point],
    training: Training | None = None,
) -> dict:
    """What report.json holds; times in milliseconds, memory in MiB.

    Args:
        conditions: what was measured, where and how; "subject", "regimes", "not_turned" among it; "unfinished": why it
            is not all that there will be.
    """
    best = {name: {id(p) for p in figures.on_front(points, name)} for name in figures.AXES}
    reference, rows = points[0], []
    for number, point in enumerate(points):
        row: dict = {
            "number": number,
            "name": point.setting.name,
            "setting": point.setting.to_dict(),
            "knob": point.knob,
            "kind": point.kind,
        }
        if point.failure:
            rows.append({**row, "failure": point.failure})
            continue
        stages = point.stages()
        row["agreement"] = None if point.agreement is None else vars(point.agreement)
        row["task"], row["gain_db"] = point.task, comparison.gain(point.by_step, point.setting.every)
        row["kept"] = comparison.share_kept(point, reference)
        row["by_step"], row["resting"] = point.by_step, point.resting
        row["step_ms"] = {**_times(point.step), "spread": 1e3 * point.spread, "stages": _ms(stages)}
        row["step_ms"]["unexplained"] = abs(sum(stages.values()) / point.step_seconds - 1) if stages else None
        row["encode_ms"] = _times(point.encode)
        row["once_ms"], row["peak_mib"] = 1e3 * point.once, point.peak / 2**20
        row["faster"] = reference.step_seconds / point.step_seconds
        row["tie_with_reference"] = point is not reference and ties(point, reference)
        row["on_front"] = {name: id(point) in best[name] for name in figures.AXES}
        rows.append(row)
    content = {
        "format": FORMAT,
        **conditions,
        "constant": comparison.constant,
        "not_measured": {**comparison.not_measured, **conditions.get("not_measured", {})},
        "kinds": KINDS,
        "points": rows,
        "presets": {name: _promise(point, points, rows) for name, point in presets.items()},
        "horizons": _horizons(comparison, {**presets, "exact": reference}),
        "training": budget.as_dict(training),
    }
    return {**content, "published": published.beside(content)}


def _promise(point: Point, points: Sequence[Point], rows: Sequence[dict]) -> dict:
    number = next(n for n, known in enumerate(points) if known is point)
    row = rows[number]
    return {"number": number, "setting": row["setting"], "faster": row["faster"], "kept": row["kept"]}


def _times(timings: Sequence[Timing]) -> dict[str, float]:
    whole = Timing(tuple(seconds for timing in timings for seconds in timing.repeats))
    return {"median": 1e3 * whole.median, "p95": 1e3 * whole.p95, "repeats": len(whole.repeats)}


def _ms(stages: dict[str, float]) -> dict[str, float]:
    return {name: 1e3 * stages[name] for name in STAGES if name in stages}


def _horizons(comparison: Comparison, named: dict[str, Point]) -> list[dict]:
    """Error and time, encoding included, of rollouts of 1, 2, 4, ... steps."""
    n_steps = comparison.subject.n_steps
    metric = "psnr_masked" if "psnr_masked" in comparison.constant else "psnr"
    lengths = sorted({2**k for k in range(n_steps.bit_length()) if 2**k < n_steps} | {n_steps})
    rows = []
    for length in lengths:
        row: dict = {"steps": length, "constant_psnr": comparison.constant[metric][length - 1]}
        for name, point in named.items():
            drawn = (length - 1) // point.setting.every
            encoded = _times(point.encode)["median"] if point.encode else 0.0
            time = encoded + 1e3 * (point.once + length * point.step_seconds)
            row[name] = {"psnr": point.by_step[metric][drawn], "ms": time}
        rows.append(row)
    return rows


def regimes_as_dict(
    throughputs: Sequence[Throughput], training: TrainingStep, work: Sequence[tuple[str, Work | None]] = ()
) -> dict:
    """The other ways to use the simulator, and what a GPU does in a step, for ``conditions``."""
    rows = [
        {
            "setting": t.setting.name,
            "scenes": t.n_scenes,
            "steps_a_second": t.steps_a_second,
            "step_ms": None if t.timing is None else _times([t.timing]),
            "problem": t.problem,
        }
        for t in throughputs
    ]
    step: dict = {"problem": training.problem}
    if training.timing is not None:
        step = {"batch": training.batch, "horizon": training.horizon, "step_ms": _times([training.timing])}
    return {"throughput": rows, "training": step, "gpu": [{"setting": name, **vars(w)} for name, w in work if w]}


def regimes_in_words(regimes: dict) -> list[str]:
    lines = []
    for row in regimes["throughput"]:
        scenes = f"{row['scenes']} scenes together, with images"
        rate = row["steps_a_second"]
        lines.append(
            f"{row['setting']}: "
            + (f"{rate:.3g} steps a second of {scenes}" if rate else f"{row['problem']}: {scenes}")
        )
    training = regimes["training"]
    if "problem" in training:
        lines.append(f"training step: not measured: {training['problem']}")
    else:
        batch = f"{training['batch']} scenes, {training['horizon']} steps fed back"
        lines.append(f"training step ({batch}): {training['step_ms']['median'] / 1e3:.3g} s")
    for row in regimes["gpu"]:
        text = f"{row['setting']}: of {row['whole_ms']:.2f} ms a step the GPU works {row['busy_ms']:.2f}, "
        text += f"host gaps {row['gaps_ms']:.2f}; sorting {row['sorting_ms']:.3f}"
        if row["joules"] is not None:
            text += f"; {row['joules']:.3g} J a step"
        lines.append(text)
    return lines


def write(
    folder: Path,
    points: Sequence[Point],
    comparison: Comparison,
    conditions: dict,
    presets: dict[str, Point],
    training: Training | None = None,
) -> tuple[dict, list[Path]]:
    """Writes report.json, report.csv, report.html and a PNG of each figure; each appears complete or not at all.

    Returns: what report.json holds, and the files.
    """
    content = as_dict(points, comparison, conditions, presets, training)
    pictures = {
        "cost.png": figures.cost(points, comparison, presets),
        "agreement.png": figures.scatter(points, "agreement"),
        "task.png": figures.scatter(points, "task"),
        "stages.png": figures.stages(points),
        "horizon.png": figures.horizon(points, comparison, presets),
    }
    if training is not None:
        pictures["training.png"] = figures.training(training)
    numbers = write_numbers(folder, content)
    files = {**pictures, "report.html": page(content, pictures, regimes_in_words(content["regimes"])).encode()}
    for name, text in files.items():
        _put(folder / name, text)
    return content, [*numbers, *(folder / name for name in files)]


def write_numbers(folder: Path, content: dict) -> list[Path]:
    """Writes report.json and report.csv of what :func:`as_dict` gave, and names them."""
    write_json(folder / "report.json", content)
    _put(folder / "report.csv", _csv(content).encode())
    return [folder / "report.json", folder / "report.csv"]


def _put(file: Path, content: bytes) -> None:
    part = file.with_name(f".{file.name}.part")
    part.write_bytes(content)
    os.replace(part, file)


def _csv(content: dict) -> str:
    text = io.StringIO()
    rows = csv.writer(text, lineterminator="\n")
    metrics = list(content["points"][0].get("task", {}))
    rows.writerow(
        ["number", "setting", "knob", "kind", "step_ms", "step_p95_ms", "encode_ms", "once_ms", "faster", "peak_mib",
         "agreement_psnr", "position_max_cells", "gain_db", "kept", *metrics, "failure"]
    )  # fmt: skip
    for row in content["points"]:
        start = [row["number"], row["name"], row["knob"], row["kind"]]
        if "failure" in row:
            rows.writerow([*start, *[""] * (10 + len(metrics)), row["failure"]])
            continue
        agreement = row["agreement"] or {}
        numbers = [row["step_ms"]["median"], row["step_ms"]["p95"], row["encode_ms"]["median"], row["once_ms"]]
        numbers += [row["faster"], row["peak_mib"], agreement.get("psnr"), agreement.get("position_max")]
        numbers += [row["gain_db"], row["kept"], *(row["task"].get(metric) for metric in metrics)]
        rows.writerow([*start, *("" if number is None else f"{number:.6g}" for number in numbers), ""])
    return text.getvalue()


def table(content: dict) -> str:
    """The report for a terminal."""
    width = max(len(row["name"]) for row in content["points"]) + 2
    lines = [
        f"{'setting':{width}}{'step ms':>10}{'p95':>10}{'faster':>9}{'agreement dB':>14}{'gain dB':>9}{'kept':>11}"
    ]
    for row in content["points"]:
        if "failure" in row:
            lines.append(f"{row['name']:{width}}failed: {row['failure']}")
            continue
        step, agreement = row["step_ms"], row["agreement"] or {}
        faster = "tie" if row["tie_with_reference"] else f"{row['faster']:.2f}x"
        near, gain = (
            f"{v:.{d}f}" if v is not None else "-" for v, d in ((agreement.get("psnr"), 1), (row["gain_db"], 2))
        )
        kept = share_in_words(row["kept"])
        star = "*" if row["on_front"]["agreement"] else ""
        times = f"{step['median']:10.2f}{step['p95']:10.2f}{faster:>9}"
        lines.append(f"{row['name']:{width}}{times}{near:>14}{gain:>9}{kept:>11} {star}")
    return "\n".join(
        [*lines, "* no other is both faster and nearer to the reference", "", *regimes_in_words(content["regimes"])]
    )
