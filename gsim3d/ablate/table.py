"""One table of all rows: means over the seeds, and differences that are larger than what the seed alone does."""

from __future__ import annotations

import statistics
from typing import TYPE_CHECKING

import torch

from gsim3d.io.settings import to_dict
from gsim3d.profile import machine

if TYPE_CHECKING:
    from gsim3d.ablate.study import Study

FORMAT = 1
ENOUGH = 3  # runs of a row that tell a difference from chance
PSNRS = {"psnr_masked": "PSNR masked", "psnr": "PSNR", "psnr_body": "PSNR body"}
METHODS = ("", "constant.", "copy.")
VALUES = (*(f"{method}{metric}" for metric in PSNRS for method in METHODS), "step_seconds")
EXPLAINED = """\
PSNR in dB, means over the seeds and their standard deviation; masked: without background; body: what may move;
constant: the row's own last encoded particles held still; copy: the last given image. Seconds are those of an optimizer
step, the median of the last stage, with other runs beside it where --together says so. The paper's numbers are PSNR of
its own data and budget (docs/results/accuracy_vs_time.md says where they contradict each other): compare
differences, not values."""


def as_dict(study: Study, results: dict[str, list[dict]], command: str) -> dict:
    """What ablation.json holds.

    Of each row: what differs, the paper's number, ``runs`` (a seed each) and means of those that were scored;
    ``difference`` to the first row in dB of masked PSNR (of all pixels where scenes have no masks); ``spread``: how far
    apart runs of one row are at most, of either row; ``tie``: whether the difference is within it, null with one seed;
    ``same_as``: the row it is.

    Args:
        results: runs by the name of a row whose run is its own, as far as there are any.
    """
    rows = []
    for row in study.rows:
        same = study.same_as(row.name)
        entry: dict = {"row": row.name, "differs": row.differs, "paper": row.paper or None}
        if same != row.name:
            entry["same_as"] = same
        runs = results.get(same, [])
        rows.append({**entry, "runs": runs, **_means(_scored(runs))})
    first = rows[0]
    metric = "psnr_masked" if first.get("psnr_masked") is not None else "psnr"
    for row in rows[1:]:
        row.update(_compared(row, first, metric))
    return {
        "format": FORMAT,
        "command": command,
        "machine": machine.facts(torch.device(study.device)),
        "base": to_dict(study.base),
        "scenes": {"trained": len(study.train), "held_out": len(study.test)},
        "steps": {"before": study.n_given, "predicted": study.n_future},
        "seeds": study.n_seeds,
        "compared": metric,
        "rows": rows,
    }


def told(run: dict) -> str:
    """What a run came to, in a few words."""
    if "failure" in run:
        return f"failed: {run['failure']}"
    if "trained" in run:
        return f"{run['trained']} of {run['of']} optimizer steps; call again to go on"
    return ", ".join(f"{label} {run[metric]:.2f}" for metric, label in PSNRS.items() if run.get(metric) is not None)


def _scored(runs: list[dict]) -> list[dict]:
    return [run for run in runs if "failure" not in run and "trained" not in run]


def _means(runs: list[dict]) -> dict:
    """Of every value that all runs have."""
    known = [name for name in VALUES if runs and all(run.get(name) is not None for run in runs)]
    return {name: statistics.fmean(run[name] for run in runs) for name in known}


def _compared(row: dict, first: dict, metric: str) -> dict:
    if metric not in row or metric not in first:
        return {}
    difference, spreads = row[metric] - first[metric], []
    for runs in (row["runs"], first["runs"]):
        values = [run[metric] for run in _scored(runs)]
        if len(values) < 2:
            return {"difference": difference, "spread": None, "tie": None}
        spreads.append(max(values) - min(values))
    return {"difference": difference, "spread": max(spreads), "tie": abs(difference) <= max(spreads)}


def markdown(content: dict) -> str:
    """The table for people, and what a reader of it must know."""
    rows, n_seeds = content["rows"], content["seeds"]
    head = ["row", "what differs", *(cell for label in PSNRS.values() for cell in (label, "constant, copy"))]
    head += [f"against {rows[0]['row']}", "s a step", "paper"]
    lines = [_line(head), _line(["---"] * len(head))]
    for row in rows:
        cells = [row["row"], row["differs"]]
        for metric in PSNRS:
            values = [_number(row.get(f"{method}{metric}")) for method in METHODS]
            cells += [values[0] + _deviation(row, metric), ", ".join(values[1:])]
        seconds = row.get("step_seconds")
        cells += [_against(row), "-" if seconds is None else f"{seconds:.3g}", row["paper"] or "-"]
        lines.append(_line(cells))
    lines += ["", _conditions(content), "", EXPLAINED, "", _of_ties(n_seeds), "", f"Made by `{content['command']}`"]
    for row in rows:
        for run in row["runs"]:
            if "same_as" not in row and run not in _scored(row["runs"]):
                lines += ["", f"{row['row']}, seed {run['seed']}: {told(run)}"]
    return "\n".join(lines) + "\n"


def _conditions(content: dict) -> str:
    base, scenes, steps, n_seeds = (content[name] for name in ("base", "scenes", "steps", "seeds"))
    budget = sum(stage["steps"] for stage in base["phases"])
    return (
        f"Base run: preset {base['preset']}, {budget} optimizer steps; {scenes['trained']} scenes trained on, "
        f"{scenes['held_out']} held out and scored; {steps['predicted']} steps predicted after the first "
        f"{steps['before']}; {n_seeds} {'seed' if n_seeds == 1 else 'seeds'}; {content['machine']['device']}."
    )


def _of_ties(n_seeds: int) -> str:
    if n_seeds == 1:
        return "One seed: whether a difference is more than chance is not known (--seeds 3)."
    few = "" if n_seeds >= ENOUGH else f" {n_seeds} seeds are few: {ENOUGH} or more tell it from chance."
    return f"A tie: the difference is not larger than that between two runs of one row.{few}"


def _against(row: dict) -> str:
    if "same_as" in row:
        return f"is {row['same_as']}"
    if "difference" not in row:
        return "failed" if any("failure" in run for run in row["runs"]) else "-"
    if row["tie"]:
        return f"tie (within {row['spread']:.2f})"
    return f"{round(row['difference'], 2) + 0.0:+.2f}"


def _deviation(row: dict, metric: str) -> str:
    values = [run[metric] for run in _scored(row["runs"]) if run.get(metric) is not None]
    return f" ± {statistics.stdev(values):.2f}" if len(values) > 1 else ""


def _line(cells: list[str]) -> str:
    return "| " + " | ".join(cells) + " |"


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.2f}"
