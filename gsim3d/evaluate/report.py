"""Aggregation of scores over scenes and steps, and reports as JSON, CSV, markdown and text."""

import csv
import io
import json
import math
import statistics
from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor

from gsim3d.evaluate.metrics import mean_of_counted
from gsim3d.evaluate.perceptual.fvd import MIN_CLIPS, TREND_CLIPS, frechet_distance
from gsim3d.evaluate.physics import MEASURES, TRUE, Measure
from gsim3d.evaluate.scoring import METRICS, RING_WIDTH, SceneScores
from gsim3d.io.files import write_whole
from gsim3d.synth.held_out import describe_set

REGIONS = (
    "masked: foreground; body: movable bodies; ground: the rest of the foreground; ring: ground within "
    f"{RING_WIDTH:g} diameters of a body"
)
ADDED = ("masked", "body", "ground")  # regions for which added_mse is reported


def summarize(scores: Sequence[SceneScores], not_measured: dict[str, str] | None = None) -> dict:
    """Aggregates scores to the content of metrics.json.

    - ``past.M``, ``future.M``, ``future_late.M``: mean of metric M over scenes, then over input steps, predicted steps,
      or the second half of the predicted steps.
    - ``past_std.M``, ``future_std.M``: mean over steps of the standard deviation between scenes.
    - ``<method>.future.M``: the same for baselines and other predictions, over the scenes that have them;
      ``n_scenes_of``: method -> how many, if not all.
    - ``future.fvd``: distance between all predicted and all true clips.
    - ``body_share``: fraction of the foreground covered by bodies.
    - ``added_mse.R``: mean squared error in region R, predicted steps minus input steps.
    - ``physics``: method -> measure of :func:`gsim3d.evaluate.physics.measure_tracks` -> mean over scenes for each
      predicted step.
    - ``by_step``, ``by_step_std``: mean over scenes and deviation between scenes, for each step.
    - ``not_measured``: metric -> reason.

    Undefined values (empty masks, the deviation of a single scene) are null.

    Args:
        scores: scores of one or more scenes.
        not_measured: metrics that were not requested -> reason.
    """
    n_encoded = scores[0].n_encoded
    n_steps = min(s.n_steps for s in scores)
    late = n_encoded + (n_steps - n_encoded) // 2
    missing = dict(not_measured or {})
    for scene in scores:
        missing = {**scene.not_measured, **missing}
    methods = {method: [s for s in scores if method in s.values] for one in scores for method in one.values}
    result: dict = {
        "n_scenes": len(scores),
        "n_encoded_steps": n_encoded,
        "n_future_steps": n_steps - n_encoded,
        "methods": list(methods),
        "n_scenes_of": {method: len(own) for method, own in methods.items() if len(own) < len(scores)},
    }
    by_step: dict = {}
    by_step_std: dict = {}
    for method, own in methods.items():
        prefix = _prefix(method)
        for metric in METRICS:
            if metric in missing or metric not in own[0].values[method]:
                continue
            table = torch.stack([s.values[method][metric][:n_steps] for s in own])
            mean, deviation = table.nanmean(0), _deviation(table)
            if method == "model":
                result[f"past.{metric}"] = mean_of_counted(mean[:n_encoded])
                result[f"past_std.{metric}"] = mean_of_counted(deviation[:n_encoded])
            result[f"{prefix}future.{metric}"] = mean_of_counted(mean[n_encoded:])
            result[f"{prefix}future_late.{metric}"] = mean_of_counted(mean[late:])
            result[f"{prefix}future_std.{metric}"] = mean_of_counted(deviation[n_encoded:])
            by_step[f"{prefix}{metric}"] = _numbers(mean)
            by_step_std[f"{prefix}{metric}"] = _numbers(deviation)
    if all(s.body_share is not None for s in scores):
        by_step["body_share"] = _numbers(torch.stack([s.body_share[:n_steps] for s in scores]).nanmean(0))
    scenes = {s.scene: _of_scene(s, missing) for s in scores}
    for key in ("body_share", *(f"added_mse.{part}" for part in ADDED)):
        if known := [scene[key] for scene in scenes.values() if scene.get(key) is not None]:
            result[key] = statistics.fmean(known)
    if any(s.clips for s in scores) and "fvd" not in missing:
        _add_fvd(result, missing, scores)
    result["physics"] = _mean_physics(scores, n_steps - n_encoded)
    result["not_measured"] = missing
    result["by_step"] = by_step
    result["by_step_std"] = by_step_std
    result["scenes"] = scenes
    return result


def _mean_physics(scores: Sequence[SceneScores], n_future: int) -> dict:
    """Means over the scenes that have a method, of what all of these have."""
    found = {}
    for method in dict.fromkeys(method for s in scores for method in s.physics):
        own = [s.physics[method] for s in scores if method in s.physics]
        shared = (name for name in own[0] if all(name in one for one in own))
        found[method] = {name: _numbers(torch.stack([one[name][:n_future] for one in own]).mean(0)) for name in shared}
    return found


def physics_table(summary: dict) -> list[str]:
    """Formats the physical measures at the first, middle and last predicted step, with formulas; empty without them."""
    if not summary.get("physics"):
        return []
    n_future = summary["n_future_steps"]
    steps = sorted({0, n_future // 2, n_future - 1})
    head = ["Physics", "Method", *(f"step {summary['n_encoded_steps'] + step}" for step in steps)]
    lines = ["", _row(head), _row(["---"] * len(head))]
    for name, measure in MEASURES.items():
        for method, values in summary["physics"].items():
            both = [values[key] for key in (name, TRUE + name) if key in values]
            texts = ([_number(one[step], measure) for one in both] for step in steps)
            lines.append(_row([measure.label, method, *map(" of ".join, texts)]))
    formulas = "; ".join(f"{name}: {measure.formula}" for name, measure in MEASURES.items())
    said = "Per unit mass, points weighted equally, v from step to step, h halfway; of: the truth of a method's points"
    return [*lines, "", f"{said}. {formulas}."]


def _add_fvd(result: dict, missing: dict, scores: Sequence[SceneScores]) -> None:
    counted = [s.clips for s in scores if s.clips]
    result["n_clips"] = sum(len(clips["truth"]) for clips in counted)
    if result["n_clips"] < MIN_CLIPS:
        missing["fvd"] = f"at least {MIN_CLIPS} clips (scenes times target views) are required; there is 1"
        return
    for method in dict.fromkeys(method for clips in counted for method in clips if method != "truth"):
        predicted, true = (torch.cat([clips[of] for clips in counted if method in clips]) for of in (method, "truth"))
        if len(true) >= MIN_CLIPS:
            result[f"{_prefix(method)}future.fvd"] = frechet_distance(predicted, true)


def _of_scene(scores: SceneScores, missing: dict) -> dict:
    """Aggregates the scores of one scene over steps, see :func:`summarize`."""
    first, late = scores.n_encoded, (scores.n_encoded + scores.n_steps) // 2
    parts = {"past": slice(first), "future": slice(first, None), "future_late": slice(late, None)}
    found = {name: value for name, value in (("digest", scores.digest), ("fitted", scores.fitted)) if value}
    if scores.body_share is not None:
        found["body_share"] = mean_of_counted(scores.body_share)
    for method, metrics in scores.values.items():
        for metric, values in metrics.items():
            for part, steps in parts.items():
                if metric not in missing and (method == "model" or part != "past"):
                    found[f"{_prefix(method)}{part}.{metric}"] = mean_of_counted(values[steps])
    for part in ADDED:
        if found.get(f"past.psnr_{part}") is not None and found.get(f"future.psnr_{part}") is not None:
            errors = 10 ** (-scores.values["model"][f"psnr_{part}"] / 10)
            found[f"added_mse.{part}"] = float(errors[first:].nanmean() - errors[:first].nanmean())
    return found


def write_json(path: str | Path, content: dict) -> None:
    """Writes ``content`` atomically."""
    write_whole(path, json.dumps(content, indent=1, allow_nan=False) + "\n")


def write_csv(path: str | Path, scores: Sequence[SceneScores]) -> None:
    """Writes one row per scene, method and step: scene, method, step, part (given or predicted), and the metrics.

    Undefined values are empty. FVD is not included, because it has no value per step.
    """
    metrics = [name for name in METRICS if any(name in s.values[method] for s in scores for method in s.values)]
    text = io.StringIO()
    rows = csv.writer(text, lineterminator="\n")
    rows.writerow(["scene", "method", "step", "part", *metrics])
    for s in scores:
        for method, values in s.values.items():
            first = 0 if method == "model" else s.n_encoded
            for step in range(first, s.n_steps):
                numbers = [float(values[m][step]) if m in values else math.nan for m in metrics]
                part = "given" if step < s.n_encoded else "predicted"
                rows.writerow([s.scene, method, step, part, *("" if math.isnan(v) else repr(v) for v in numbers)])
    write_whole(path, text.getvalue())


def markdown(summary: dict, dataset: str) -> str:
    """Formats the summary as markdown: mean ± deviation per method, as in the paper; then means per part."""
    shown = [m for m in METRICS if any(f"{_prefix(method)}future.{m}" in summary for method in summary["methods"])]
    span = f"{summary['n_encoded_steps']}-{summary['n_future_steps']}"
    head = [f"{METRICS[m].label} ({'↑' if METRICS[m].rises else '↓'})" for m in shown]
    lines = [_row(["Dataset", "Method", *head]), _row(["---"] * (2 + len(head)))]
    for method in summary["methods"]:
        key = f"{_prefix(method)}future"
        lines.append(_row([dataset, f"{method} ({span})", *(_with_deviation(summary, key, m) for m in shown)]))
    by_step = [m for m in shown if METRICS[m].by_step]
    lines += ["", _row(["Horizon", "Method", *(METRICS[m].label for m in by_step)]), _row(["---"] * (2 + len(by_step)))]
    for name, part in (("given steps", "past"), ("predicted, all", "future"), ("second half", "future_late")):
        for method in summary["methods"]:
            key = f"{_prefix(method)}{part}"
            if any(f"{key}.{m}" in summary for m in by_step):
                lines.append(_row([name, method, *(_number(summary.get(f"{key}.{m}"), m) for m in by_step)]))
    lines += physics_table(summary)
    n_scenes = f"{summary['n_scenes']} scene{'s' * (summary['n_scenes'] > 1)}"
    lines += ["", f"{n_scenes}; {summary['n_encoded_steps']} steps given, "
              f"{summary['n_future_steps']} predicted. Mean over steps of the mean over scenes ± mean over steps of "
              f"the standard deviation between scenes. Of PSNR, {REGIONS}."]  # fmt: skip
    return "\n".join([*lines, *(f"\n{note}" for note in [*facts(summary), *notes(summary)])]) + "\n"


def facts(summary: dict) -> list[str]:
    """Describes the data set, the size of its bodies, and the error added by prediction."""
    found = [describe_set(summary["set"])] if summary.get("set") else []
    if summary.get("body_share") is not None:
        found.append(f"Bodies: {summary['body_share']:.1%} of the foreground.")
    added = {part: value for part in ADDED if (value := summary.get(f"added_mse.{part}")) is not None}
    if added:
        decibels = {part: f" ({-10 * math.log10(mse):.2f} dB)" for part, mse in added.items() if mse > 0}
        numbers = ", ".join(f"{part} {mse:.5f}{decibels.get(part, '')}" for part, mse in added.items())
        found.append(f"Mean squared error, predicted minus given steps: {numbers}.")
    return found


def notes(summary: dict) -> list[str]:
    """Returns caveats: methods that are not in all scenes, metrics not measured, and an FVD from too few clips."""
    some = summary.get("n_scenes_of", {})
    found = [f"{method}: mean over {n} of {summary['n_scenes']} scenes" for method, n in some.items()]
    found += [f"{METRICS[m].label}: not measured: {reason}" for m, reason in summary["not_measured"].items()]
    if 0 < summary.get("n_clips", 0) < TREND_CLIPS and "fvd" not in summary["not_measured"]:
        found.append(f"FVD: {summary['n_clips']} clips; with fewer than {TREND_CLIPS} it is biased and noisy")
    return found


def table(summary: dict) -> str:
    """Formats the summary as text: one line per method, then the first method by step."""
    methods = summary["methods"]
    shown = [m for m in METRICS if f"{_prefix(methods[0])}future.{m}" in summary]
    by_step = [m for m in shown if METRICS[m].by_step]
    rows = [("model, given steps", "past")] if "model" in methods else []
    for method in methods:
        prefix = _prefix(method)
        if not any(f"{prefix}future.{m}" in summary for m in shown):
            continue
        rows += [(f"{method}, predicted steps", f"{prefix}future"), ("  second half of them", f"{prefix}future_late")]
    width = max([34, *(len(name) + 2 for name, _ in rows)])
    lines = [
        f"{summary['n_scenes']} scene{'s' * (summary['n_scenes'] > 1)}, {summary['n_encoded_steps']} steps given, "
        f"{summary['n_future_steps']} predicted (PSNR in dB; {REGIONS})",
        *facts(summary),
        "",
        f"{'':{width}}" + "".join(f"{METRICS[m].label:>13}" for m in shown),
    ]
    for name, key in rows:
        lines.append(f"{name:{width}}" + "".join(f"{_number(summary.get(f'{key}.{m}'), m):>13}" for m in shown))
    lines += ["", f"{f'{methods[0]}, step':{width}}" + "".join(f"{METRICS[m].label:>13}" for m in by_step)]
    first = 0 if "model" in methods else summary["n_encoded_steps"]
    for step in range(first, summary["n_encoded_steps"] + summary["n_future_steps"]):
        kind = "given" if step < summary["n_encoded_steps"] else "predicted"
        numbers = [_number(summary["by_step"][f"{_prefix(methods[0])}{m}"][step], m) for m in by_step]
        lines.append(f"{f'{step:4d} {kind}':{width}}" + "".join(f"{number:>13}" for number in numbers))
    lines += physics_table(summary)
    extra = notes(summary)
    return "\n".join([*lines, *([""] if extra else []), *extra])


def _prefix(method: str) -> str:
    return "" if method == "model" else f"{method}."


def _row(cells: Sequence[str]) -> str:
    return "| " + " | ".join(cells) + " |"


def _with_deviation(summary: dict, key: str, metric: str) -> str:
    deviation = summary.get(f"{key}_std.{metric}")
    mean = _number(summary.get(f"{key}.{metric}"), metric)
    return mean if deviation is None else f"{mean} ± {_number(deviation, metric)}"


def _deviation(table: Tensor) -> Tensor:
    """Returns the sample standard deviation [S] over scenes of [scenes, S], ignoring NaN; NaN for fewer than two."""
    counted = (~table.isnan()).sum(0)
    squares = (table - table.nanmean(0)).square().nansum(0)
    return torch.where(counted > 1, squares / (counted - 1).clamp(min=1), torch.nan).sqrt()


def _numbers(values: Tensor) -> list[float | None]:
    return [None if math.isnan(value) else value for value in values.tolist()]


def _number(value: float | None, kind: str | Measure) -> str:
    digits = METRICS[kind].digits if isinstance(kind, str) else kind.digits
    return "-" if value is None else f"{value:.{digits}f}"
