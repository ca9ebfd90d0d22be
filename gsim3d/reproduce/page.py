"""The page of a reproduction: markdown, figures, and all numbers as JSON."""

from __future__ import annotations

import contextlib
import statistics
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from gsim3d.evaluate.compare import LEAST, paired
from gsim3d.evaluate.pictures import pyplot, save_figure, write_curves
from gsim3d.evaluate.report import facts, notes, physics_table, summarize, write_json
from gsim3d.evaluate.scoring import ALONE, METRICS, measurable
from gsim3d.io.files import with_parents, write_whole
from gsim3d.reproduce.cells import from_json
from gsim3d.reproduce.entries import CAMERAS, EDITS, HISTORY, MAIN, METHODS, SPEED, TRAINED

if TYPE_CHECKING:
    from gsim3d.reproduce.run import Row

COLUMNS = {  # key of the numbers -> title, decimals
    "future.psnr_masked": ("PSNR masked", 2),
    "future.psnr_body": ("PSNR body", 2),
    "future.psnr": ("PSNR", 2),
    "future.ssim": ("SSIM", 4),
    "future.lpips_alex": ("LPIPS alex", 4),
    "future.lpips_vgg": ("LPIPS vgg", 4),
    "future.fvd": ("FVD", 1),
    "past.psnr_masked": ("given steps", 2),
    "encode_ms": ("ms to encode", 1),
    "step_ms": ("ms a step", 2),
    "steps_a_second": ("steps a second", 1),
    "seconds": ("s to fit", 1),
    "parameters": ("parameters", 0),
    "substeps": ("substeps a frame", 0),
    "through": ("through the ground, %", 1),
    "shape_cm": ("shape, cm", 2),
    "true_cm": ("true shape, cm", 2),
    "copies_cm": ("shape of copies, cm", 2),
    "fall": ("fall over free fall", 3),
    "above_cm": ("above raised ground, cm", 1),
}
ORDER = {table: n for n, table in enumerate((MAIN, SPEED, HISTORY, CAMERAS, EDITS, TRAINED))}
CURVES = ("psnr_masked", "psnr_body", "ssim")
EXPLAINED = f"""\
PSNR in dB over predicted steps; masked: foreground, body: moving bodies. ±: standard error of paired differences over
scenes; "=" marks differences within {LEAST:g} of them. Last: change of masked PSNR (Speed: of ms a step) since the run
before in this folder. Edits: of particles that end above the ground, shape is the rms distance to the best rigid motion
over all steps, of the worst copy; above the raised ground: the lowest twentieth of them at the end. Fall without ground
over free fall, after 20 steps.
Paper: other data, which was never released, and other budgets: compare differences, not values.
Cost: all seconds of a row, with scoring. "ms a step" includes rendering; "s to fit" of a method that is fitted to each
scene are those of its start, dynamics and images. Parameters: weights, or fitted values; baselines add none."""


@dataclass
class Line:
    """A line of a table."""

    row: Row  #: the row that it belongs to; baselines share that of the first model
    label: str  #: its name
    numbers: dict[str, float]  #: keys of COLUMNS -> value
    by_scene: dict[str, float]  #: scene -> value that is compared: masked PSNR (PSNR without masks), or milliseconds
    #: see :func:`gsim3d.evaluate.report.summarize`; {} for rows without images
    summary: dict = field(default_factory=dict)
    #: (mean, standard error) of the difference to the first line of the table or model; None for the first
    against: tuple[float, float | None] | None = None
    last: float | None = None  #: mean change since the last run; None if there was none


def write(out: Path, rows: Sequence[Row], about: dict) -> tuple[dict, list[Path]]:
    """Writes reproduce.md, reproduce.json and figures/; returns the content of the JSON file, and the paths."""
    parts, files, lines = [], [], []
    for table, world in dict.fromkeys((row.table, row.world) for row in sorted(rows, key=lambda row: ORDER[row.table])):
        own_rows = [row for row in rows if (row.table, row.world) == (table, world)]
        if table in (HISTORY, CAMERAS):  # beside each model as trained
            models = {row.model for row in own_rows if row.cells}
            own_rows[:0] = [r for r in rows if (r.table, r.world) == (MAIN, world) and r.model in models]
        own = _lines(own_rows, table)
        if not own:
            continue
        if table == MAIN:
            speeds = [row for row in rows if (row.table, row.world) == (SPEED, world) and row.cells]
            times = {row.model: _numbers(row.cells, "")[0] for row in speeds}
            for line in own:
                found = times.get(line.label, {"parameters": 0} if line.label in METHODS else {})
                line.numbers |= {key: found[key] for key in ("step_ms", "parameters") if key in found}
        pictures = _figures(out / "figures", table, world, own)
        parts += [f"## {table}: {world}", _table(own), _remarks(own) if table == MAIN else ""]
        parts += [f"![{path.stem}](figures/{path.name})" for path in pictures]
        files += pictures
        lines += [line for line in own if line.row.table == table]
    n_cells, n_missing = (sum(map(len, found)) for found in zip(*((row.cells, row.missing) for row in rows)))
    machine = f"gsim3d {about['gsim3d']}, torch {about['torch']}, on {about['device']}"
    head = [
        "# Reproduction of the paper",
        f"Made by `{about['command']}` with {machine}. {n_cells} of {n_cells + n_missing} measurements are made.",
        EXPLAINED,
    ]
    missing = _missing(rows)
    lists = ["## Missing", "\n".join(f"- {line}" for line in missing)] if missing else []
    unmeasured = [f"{METRICS[name].label} is not measured: {reason}." for name, reason in measurable()[1].items()]
    page, data = out / "reproduce.md", out / "reproduce.json"
    write_whole(page, "\n\n".join(part for part in [*head, *parts, *lists, *unmeasured] if part) + "\n")
    content = {**about, "made": n_cells, "lines": [_as_dict(line) for line in lines], "missing": missing}
    write_json(data, content)
    return content, [page, data, *files]


def _lines(rows: Sequence[Row], table: str) -> list[Line]:
    """Lines of one table and world, with differences to the first."""
    models = list(dict.fromkeys(row.model for row in rows))
    known = sorted((row for row in rows if row.cells), key=lambda row: models.index(row.model))
    found = [_line(row, method) for row in known for method in _fitted(row) or [""]]
    if known and table == MAIN and known[0].model:
        found[1:1] = [_line(known[0], method) for method in METHODS]
    for line in found if table != SPEED else ():
        first = next(other for other in found if table == MAIN or other.row.model == line.row.model)
        line.against = None if line is first else _difference(line, first.by_scene)
    return found


def _fitted(row: Row) -> list[str]:
    """The methods in a cell of a row that is fitted to each scene."""
    scores = next(iter(row.cells.values()))["result"].get("scores")
    return [name for name in scores["values"] if name not in METHODS] if scores and not row.model else []


def _line(row: Row, method: str = "") -> Line:
    """The line of a row; with ``method`` that of a baseline in its cells."""
    numbers, by_scene, summary = _numbers(row.cells, method)
    line = Line(row, method or row.label, numbers, by_scene, summary)
    with contextlib.suppress(KeyError, TypeError, ValueError):  # written by another version
        change = _difference(line, _numbers(row.before, method)[1]) if row.before else None
        line.last = change and change[0]
    return line


def _numbers(cells: dict[str, dict], method: str) -> tuple[dict, dict, dict]:
    """(numbers, by_scene, summary) of the cells of a row."""
    results = {scene: cell["result"] for scene, cell in cells.items()}
    first = next(iter(results.values()))
    if "scores" not in first:
        return first["numbers"], first.get("by_scene", {"": first["numbers"].get("step_ms")}), {}
    own = {scene: result["scores"] for scene, result in results.items()}
    summary = summarize([from_json({**scores, "scene": scene}, method or "model") for scene, scores in own.items()])
    fits = [fit for scene in summary["scenes"].values() for fit in scene.get("fitted", {}).values()]
    for key in ("substeps", "seconds", "parameters") if fits else ():
        summary[key] = statistics.fmean(fit[key] for fit in fits)
    head = "psnr_masked" if "future.psnr_masked" in summary else "psnr"
    by_scene = {scene: scores.get(f"future.{head}") for scene, scores in summary["scenes"].items()}
    by_scene = {} if method.endswith(ALONE) else by_scene  # the others are of whole images
    return {key: summary[key] for key in COLUMNS if summary.get(key) is not None}, by_scene, summary


def _difference(line: Line, other: dict[str, float]) -> tuple[float, float | None] | None:
    """Mean and standard error of the paired difference over the scenes of both; None if they share none."""
    both = ((value, other.get(scene)) for scene, value in line.by_scene.items())
    pairs = [a - b for a, b in both if a is not None and b is not None]
    return paired(pairs) if pairs else None


def _table(lines: Sequence[Line]) -> str:
    shown = [key for key in COLUMNS if any(key in line.numbers for line in lines)]
    head = ["row", *(COLUMNS[key][0] for key in shown), "against first, dB", "last", "paper (other data)"]
    cells = [[*head, "scenes", "cost, s", "device", "seed"]]
    cells.append(["---"] * len(cells[0]))
    for line in lines:
        row, whole = line.row, line.label == line.row.label
        cost = sum(cell["seconds"] for cell in row.cells.values())
        cells.append(
            [
                line.label,
                *(f"{line.numbers[key]:,.{COLUMNS[key][1]}f}" if key in line.numbers else "-" for key in shown),
                _against(line.against),
                "-" if line.last is None else f"{line.last:+.2f}",
                whole and row.paper or "-",
                str(len(row.cells)),
                f"{cost:.1f}" if whole else "-",
                ", ".join(sorted({cell["device"] for cell in row.cells.values()})),
                "-" if row.seed is None else str(row.seed),
            ]
        )
    return "\n".join(f"| {' | '.join(texts)} |" for texts in cells)


def _against(difference: tuple[float, float | None] | None) -> str:
    if difference is None:
        return "-"
    mean, error = difference
    if error is None:
        return f"{mean:+.2f}"
    return f"{'= ' if abs(mean) <= LEAST * error else ''}{mean:+.2f} ± {error:.2f}"


def _merged(lines: Sequence[Line]) -> dict:
    """One summary with every line as a method, for curves and physical measures over time."""
    first = lines[0].summary
    merged = {key: first[key] for key in ("n_encoded_steps", "n_future_steps")}
    merged["n_future_steps"] = min(line.summary["n_future_steps"] for line in lines)
    for key in ("by_step", "by_step_std"):
        merged[key] = {f"{ln.label}.{m}": v for ln in lines for m, v in ln.summary[key].items() if m in METRICS}
    physics = {line.label: line.summary["physics"]["model"] for line in lines if "model" in line.summary["physics"]}
    return {**merged, "methods": [line.label for line in lines], "physics": physics}


def _remarks(lines: Sequence[Line]) -> str:
    """Caveats of the main table, and the physical measures of its methods."""
    first = lines[0].summary
    return "\n".join([f"{text}\n" for text in [*facts(first), *notes(first)]] + physics_table(_merged(lines))[1:])


def _figures(folder: Path, table: str, world: str, lines: Sequence[Line]) -> list[Path]:
    """Writes the figures of a table: curves over time, accuracy against time; returns all that belong to it."""
    if table == EDITS:
        return [folder / cell["result"]["figure"] for line in lines for cell in line.row.cells.values()]
    if not lines[0].summary:
        return []
    curves = folder / f"{table} {world} curves.png".lower().replace(" ", "-")
    write_curves(with_parents(curves), _merged(lines), None, CURVES)
    if table != MAIN or all(_seconds(line) is None for line in lines):
        return [curves]
    file = folder / f"accuracy-against-time-{world}.png"
    figure, axes = pyplot().subplots(figsize=(6, 4), layout="constrained")
    for k, line in enumerate(line for line in lines if line.by_scene):
        value, seconds = line.numbers.get("future.psnr_masked", line.numbers.get("future.psnr")), _seconds(line)
        if seconds is None:  # a baseline without a time of its own
            axes.axhline(value, color=f"C{k}", linestyle="--", linewidth=1, label=line.label)
        else:
            axes.plot(seconds, value, "o", color=f"C{k}", label=line.label)
    axes.set(xscale="log", xlabel="seconds a predicted step (fits: all of it)", ylabel="PSNR masked, dB", title=world)
    axes.margins(x=0.2)
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8)
    save_figure(figure, file)
    return [curves, file]


def _seconds(line: Line) -> float | None:
    """Seconds a predicted step: of a model measured alone, of a fitted method those of its fit; None if unknown."""
    if "seconds" in line.numbers:
        return line.numbers["seconds"] / line.summary["n_future_steps"]
    return line.numbers["step_ms"] / 1e3 if "step_ms" in line.numbers else None


def _missing(rows: Sequence[Row]) -> list[str]:
    """One line for each table, world and reason: the rows, with their numbers of missing measurements."""
    found: dict[tuple[str, str, str], list[str]] = {}
    for row in rows:
        for reason in row.missing.values():
            found.setdefault((row.table, row.world, reason), []).append(row.label)
    return [
        f"{table}, {world}: {reason}: " + ", ".join(f"{name} ({labels.count(name)})" for name in dict.fromkeys(labels))
        for (table, world, reason), labels in found.items()
    ]


def _as_dict(line: Line) -> dict:
    row = line.row
    return {
        "table": row.table,
        "world": row.world,
        "row": line.label,
        "numbers": line.numbers,
        "by_scene": line.by_scene,
        "against_first": line.against,
        "since_last": line.last,
        "paper_other_data": row.paper if line.label == row.label else "",
        "seconds": {scene: cell["seconds"] for scene, cell in row.cells.items()},
        "devices": sorted({cell["device"] for cell in row.cells.values()}),
        "seed": row.seed,
    }
