"""Scores of many scenes in one table: means over scenes by step, then over steps."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor

from gsim3d.evaluate.metrics import mean_of_counted
from gsim3d.evaluate.protocol import METHODS, METRICS, SceneScores


def summarize(scores: Sequence[SceneScores]) -> dict:
    """What metrics.json holds.

    ``past.M`` and ``future.M``: the mean over steps of the mean over scenes of metric M; ``future_late.M`` over the
    second half of the horizon only; ``future_std.M``: the mean over steps of the standard deviation between scenes. The
    same with the prefix ``constant.``, ``copy.``, ... for the baselines. ``by_step``: means over scenes for each step. A
    value that does not exist (an empty mask everywhere, one scene's deviation) is null.
    """
    n_encoded = scores[0].n_encoded
    n_steps = min(len(s.values["model"]["psnr"]) for s in scores)
    late = n_encoded + (n_steps - n_encoded) // 2
    result: dict = {"n_scenes": len(scores), "n_encoded_steps": n_encoded, "n_future_steps": n_steps - n_encoded}
    by_step: dict = {}
    for method in METHODS:
        prefix = "" if method == "model" else f"{method}."
        for metric in METRICS:
            if not all(metric in s.values[method] for s in scores):
                continue
            table = torch.stack([s.values[method][metric][:n_steps] for s in scores])
            mean = table.nanmean(0)
            if method == "model":
                result[f"past.{metric}"] = mean_of_counted(mean[:n_encoded])
            result[f"{prefix}future.{metric}"] = mean_of_counted(mean[n_encoded:])
            result[f"{prefix}future_late.{metric}"] = mean_of_counted(mean[late:])
            result[f"{prefix}future_std.{metric}"] = mean_of_counted(_deviation(table[:, n_encoded:]))
            by_step[f"{prefix}{metric}"] = [None if math.isnan(value) else value for value in mean.tolist()]
    result["by_step"] = by_step
    result["scenes"] = {
        s.scene: {
            f"future.{metric}": mean_of_counted(s.values["model"][metric][n_encoded:])
            for metric in METRICS
            if metric in s.values["model"]
        }
        for s in scores
    }
    return result


def write_json(path: str | Path, content: dict) -> None:
    """Writes ``content``; the file appears complete or not at all."""
    path = Path(path)
    part = path.with_name(f".{path.name}.part")
    part.write_text(json.dumps(content, indent=1, allow_nan=False) + "\n")
    os.replace(part, path)


def table(summary: dict) -> str:
    """The summary for people: one line a method, then the model by step."""
    shown = [m for m in METRICS if f"future.{m}" in summary]
    head = {"psnr": "PSNR", "psnr_masked": "PSNR masked", "psnr_body": "PSNR body", "ssim": "SSIM"}
    lines = [
        f"{summary['n_scenes']} scenes, {summary['n_encoded_steps']} steps given, {summary['n_future_steps']} predicted"
        " (PSNR in dB; masked: without background; body: what may move)",
        "",
        f"{'':34}" + "".join(f"{head[m]:>13}" for m in shown),
    ]
    rows = [("model, given steps", "past")]
    for method in METHODS:
        prefix = "" if method == "model" else f"{method}."
        rows += [(f"{method}, predicted steps", f"{prefix}future"), ("  second half of them", f"{prefix}future_late")]
    for name, key in rows:
        lines.append(f"{name:34}" + "".join(f"{_number(summary.get(f'{key}.{m}'), m):>13}" for m in shown))
    lines += ["", f"{'step':34}" + "".join(f"{head[m]:>13}" for m in shown)]
    for step in range(summary["n_encoded_steps"] + summary["n_future_steps"]):
        kind = "given" if step < summary["n_encoded_steps"] else "predicted"
        values = "".join(f"{_number(summary['by_step'][m][step], m):>13}" for m in shown)
        lines.append(f"{f'{step:4d} {kind}':34}{values}")
    return "\n".join(lines)


def _deviation(table: Tensor) -> Tensor:
    """Standard deviation [S] over scenes (n - 1) of [scenes, S]; NaN for a single scene."""
    return table.std(0) if len(table) > 1 else torch.full(table.shape[1:], torch.nan)


def _number(value: float | None, metric: str) -> str:
    return "-" if value is None else f"{value:.4f}" if metric == "ssim" else f"{value:.2f}"
