"""The report of what accuracy costs in time: numbers, one table, three figures, and a page that holds all of it."""

from __future__ import annotations

import base64
import csv
import io
import shlex
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from html import escape
from math import log10
from pathlib import Path
from textwrap import wrap

import torch

from gsim3d.data import Scene, find_scenes, split_scenes
from gsim3d.errors import CaptureError, InputError, did_you_mean
from gsim3d.evaluate.pictures import pyplot
from gsim3d.evaluate.report import write_json
from gsim3d.evaluate.scoring import METRICS, measurable
from gsim3d.io.files import write_whole
from gsim3d.io.locks import only_one_writer
from gsim3d.io.terminal import in_columns
from gsim3d.numerics.speed import SPEEDS_FILE
from gsim3d.pretrained import folder_of
from gsim3d.profile.autotune import part_times, save_speeds, tune
from gsim3d.profile.settings import GROUPS, KINDS, Group
from gsim3d.profile.sweep import (
    FULL,
    NO_TIME,
    QUICK,
    REST,
    BenchmarkCase,
    Point,
    Stepping,
    Sweep,
    TimeLimit,
    front,
    tie,
)
from gsim3d.profile.timing import SECTIONS, Timing, machine, time_call
from gsim3d.train.restore import Restored, restore

FORMAT = 3
BATCH = 4  # scenes that are simulated together
SLOW_METRICS = ("lpips_vgg", "fvd")  # seconds a setting
CAPTIONS = {
    "cost.png": "What accuracy costs: further left is faster, further down is less lost. Stars are the presets of "
    "--speed; dashed lines are what they promise.",
    "sections.png": "Where the time of a step goes.",
    "horizon.png": "How the error grows with the horizon.",
}
COLORS = {"exact": "#2e8b57", "near-exact": "#1f5fbf", "model": "#c0504d"}
GREY, RED = "#a8a8a8", "#c00000"
PROMISED = {0.999: "99.9 % kept", 0.99: "99 % kept"}
LEAST_LOSS, MOST_LOSS = 1e-4, 3.0  # of the gain; what is lost less, or won, and what is lost more is drawn there
STYLE = """body{font:15px/1.5 sans-serif;max-width:1080px;margin:2em auto;padding:0 1em;color:#222}
table{border-collapse:collapse;font-size:13px;margin:.5em 0}
td,th{padding:2px 8px;text-align:right;border-bottom:1px solid #ddd}
td:nth-child(2),th:nth-child(2),td:nth-child(3),th:nth-child(3){text-align:left}
.front td{font-weight:bold}.failed td{color:#c00000}figure{margin:1.5em 0}figcaption{font-size:13px;color:#555}
img{max-width:100%}code{background:#f3f3f3;padding:2px 4px;white-space:pre-wrap}"""
EXPLAINED = """\
Time of one simulated step and its images at batch 1, median and 95th percentile. agreement and position (of moving
particles, the largest, in cells) are against the reference run of the same checkpoint, the columns behind kept against
the video. kept: share of the reference's gain over particles held still, in dB. A tie is a difference in time below
what two measurements of one thing differ by. Bold: no other setting is both faster and nearer to the reference."""


# ---- the command ----


def profile(
    checkpoint: str,
    data: str,
    out: Path,
    *,
    scenes: str = "test",
    preset: str = "quick",
    settings: Sequence[str] | None = None,
    metrics: Sequence[str] | None = None,
    minutes: float | None = None,
    device: str = "cpu",
    progress: Callable[[str], None] = lambda doing: None,
) -> tuple[dict, list[Path]]:
    """Measures, tunes and writes; what report.json holds, and the files. A call that was ended is gone on with.

    Args:
        checkpoint, data, out, scenes, preset, settings, metrics, minutes, device: the options of ``gsim3d profile``.
        progress: is called with what is being done.
    Raises:
        InputError: an option is wrong, or the reference run has no result.
    """
    limit, quick = TimeLimit(minutes and 60 * minutes), preset == "quick"
    groups = _groups(settings)
    effort = replace(QUICK if quick else FULL, few=quick and settings is None)
    measured, not_measured = measurable(metrics)
    if quick and metrics is None:
        slow = [name for name in measured if name in SLOW_METRICS]
        not_measured |= dict.fromkeys(slow, "slow: named with --metrics, or --preset full")
        measured = tuple(name for name in measured if name not in slow)
    pyplot()
    restored = restore(checkpoint, device)
    if out.exists() and not out.is_dir():
        raise InputError(f"--out: {out} is not a folder")
    case = BenchmarkCase(restored, _scenes(restored, data, scenes, effort.n_scenes), effort.n_steps, measured)
    out.mkdir(parents=True, exist_ok=True)
    with only_one_writer(out):
        sweep = Sweep(case, effort, limit, progress, out / "measured.json")
        points, not_run = sweep.points(groups)
        sweep.run(points)
        if points[0].failure:
            raise InputError(f"{checkpoint}: the reference run has no result: {points[0].failure}")
        for point in (point for point in points if point.failure == NO_TIME):
            before = not_run.get(point.group, "more time than --minutes gave, for")
            not_run[point.group] = f"{before} {point.setting.name};"
        points = [point for point in points if point.failure != NO_TIME]
        presets = tune(sweep, points)
        points = list(dict.fromkeys([*points, *presets.values()]))
        progress("many scenes together")
        rates = [throughput(sweep, point) for point in dict.fromkeys(presets.values()) if not limit.is_over(REST)]
        content = as_dict(case, points, presets) | {
            "command": shlex.join(["gsim3d", "profile", *sys.argv[2:]]),
            "throughput": rates,
            "not_run": not_run,
            "not_measured": {**case.not_measured, **not_measured},
        }
        files = write(out, case, points, presets, content)
        files.append(_keep_speeds(folder_of(checkpoint), out, restored, presets, part_times(case, points[0])))
    return content, files


def _groups(names: Sequence[str] | None) -> Sequence[Group]:
    known = {group.name: group for group in GROUPS}
    if unknown := [name for name in names or () if name not in known]:
        hint = did_you_mean(unknown[0], known)
        raise InputError(f"--settings: {unknown[0]!r} does not exist; settings: {', '.join(map(repr, known))}{hint}")
    return GROUPS if names is None else [known[name] for name in names]


def _scenes(restored: Restored, data: str, which: str, count: int | None) -> list[Scene]:
    folders = find_scenes(data)
    folders = folders if which == "all" else split_scenes(folders)[1] or folders
    return [restored.open_scene(folder) for folder in folders[:count]]


def _keep_speeds(folder: Path, out: Path, *kept) -> Path:
    """In the checkpoint's ``folder``, where ``--speed`` reads them; in ``out`` where nothing can be written there."""
    try:
        return save_speeds(folder, *kept)
    except OSError as error:
        print(f"{error.filename or folder}: {error.strerror}; copy {SPEEDS_FILE} there, for gsim3d simulate")
        return save_speeds(out, *kept)


def throughput(sweep: Sweep, point: Point, n_scenes: int = BATCH) -> dict:
    """Simulated steps a second of a batch of scenes together, images included; or why they cannot be had."""
    case, setting = sweep.case, point.setting
    numbers = [n % len(case.scenes) for n in range(n_scenes)]
    found = {"setting": setting.name, "scenes": n_scenes, "steps_a_second": None, "problem": ""}
    try:
        stepping = Stepping(case, setting, sweep.clock, numbers, None if setting.captured else 1)
        timing = time_call(stepping, sweep.clock, sweep.effort.repeats, sweep.effort.warm_up)
    except torch.OutOfMemoryError:
        return found | {"problem": "out of memory"}
    except (CaptureError, InputError) as error:
        return found | {"problem": str(error)}
    return found | {"steps_a_second": n_scenes * stepping.span / timing.median}


# ---- numbers ----


def as_dict(case: BenchmarkCase, points: Sequence[Point], presets: dict[str, Point]) -> dict:
    """What report.json holds of a case; times in milliseconds, memory in MiB.

    Args:
        points: the first is the reference.
        presets: name -> one of ``points``.
    """
    restored, reference = case.restored, points[0]
    best = {id(point) for point in front(points, lambda p: p.agreement and -p.agreement.psnr)}
    rows = []
    for number, point in enumerate(points):
        row = {
            "number": number,
            "name": point.setting.name,
            "setting": point.setting.to_dict(),
            "group": point.group,
            "kind": point.kind,
        }
        rows.append(row)
        if point.failure:
            row["failure"] = point.failure
            continue
        sections = {name: 1e3 * seconds for name, seconds in point.sections().items()}
        row |= {
            "agreement": vars(point.agreement),
            "task": point.task,
            "by_step": point.by_step,
            "gain_db": case.gain(point),
            "kept": case.share_kept(point, reference),
            "resting": point.resting,
            "step_ms": {**_times(point.step), "spread": 1e3 * point.spread, "sections": sections},
            "encode_ms": _times(point.encode),
            "once_ms": 1e3 * point.once,
            "peak_mib": point.peak / 2**20,
            "faster": reference.step_seconds / point.step_seconds,
            "tie_with_reference": point is not reference and tie(point, reference),
            "on_front": id(point) in best,
        }
    number_of = {id(point): number for number, point in enumerate(points)}
    height, width = restored.image_size
    return {
        "format": FORMAT,
        "machine": machine(case.device),
        "case": {
            "checkpoint": restored.checkpoint.digest,
            "scenes": len(case.scenes),
            "steps": case.n_steps,
            "image": f"{height} x {width} pixels",
            "views": len(case.views[0][1]),
            "history": restored.data.history,
        },
        "kinds": KINDS,
        "constant": case.constant,
        "settings": rows,
        "presets": {name: number_of[id(point)] for name, point in presets.items()},
    }


def _times(timings: Sequence[Timing]) -> dict[str, float]:
    whole = Timing(tuple(seconds for timing in timings for seconds in timing.repeats))
    return {"median": 1e3 * whole.median, "p95": 1e3 * whole.p95, "repeats": len(whole.repeats)}


def write(
    folder: Path, case: BenchmarkCase, points: Sequence[Point], presets: dict[str, Point], content: dict
) -> list[Path]:
    """Writes report.json, report.csv, report.html and the figures; the files."""
    pictures = {
        "cost.png": cost_figure(points, case, presets),
        "sections.png": sections_figure(points),
        "horizon.png": horizon_figure(points, case, presets),
    }
    for name, data in pictures.items():
        (folder / name).write_bytes(data)
    write_json(folder / "report.json", content)
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(cells(content, plain=True))
    write_whole(folder / "report.csv", text.getvalue())
    write_whole(folder / "report.html", page(content, pictures))
    return [folder / name for name in ("report.html", "report.json", "report.csv", *pictures)]


# ---- the table ----


def share_in_words(value: float | None) -> str:
    """Of the gain: where the reference hardly gains anything, shares of it say nothing."""
    if value is None:
        return "-"
    return f"{value:.2%}" if 0 <= value <= 2 else "below 0" if value < 0 else "above 200%"


def cells(content: dict, *, plain: bool = False) -> list[list[str]]:
    """The table, headings first: of a row number, setting, kind, then what was measured, or why nothing was.

    Args:
        content: of report.json.
        plain: all numbers as they are, for other programs.
    """
    metrics = [name for name in content["settings"][0]["task"] if plain or name not in ("psnr_ground", "psnr_ring")]
    columns: list[tuple[str, Callable[[dict], float | None], int]] = [
        ("step ms", lambda row: row["step_ms"]["median"], 2),
        ("p95 ms", lambda row: row["step_ms"]["p95"], 2),
        ("encode ms", lambda row: row["encode_ms"]["median"], 1),
        ("once ms", lambda row: row["once_ms"], 0),
        ("peak MiB", lambda row: row["peak_mib"], 0),
        ("faster", lambda row: row["faster"], 2),
        ("agreement dB", lambda row: row["agreement"]["psnr"], 1),
        ("position", lambda row: row["agreement"]["position_max"], 3),
        ("kept", lambda row: row["kept"], 4),
        *(
            (METRICS[name].label, lambda row, name=name: row["task"].get(name), METRICS[name].digits)
            for name in metrics
        ),
    ]
    found = [["#", "setting", "kind", *(heading for heading, *_ in columns)]]
    for row in content["settings"]:
        values = [] if "failure" in row else [(value(row), digits) for _, value, digits in columns]
        if plain:
            texts = ["" if value is None else f"{value:.6g}" for value, _ in values]
        else:
            texts = ["-" if value is None else f"{value:.{digits}f}" for value, digits in values]
            if texts and row["tie_with_reference"]:
                texts[5] = "tie"
            texts[8:9] = [share_in_words(row["kept"])] if texts else []
        failure = [f"failed: {row['failure']}", *[""] * (len(columns) - 1)] if "failure" in row else []
        found.append([str(row["number"]), row["name"], row["kind"], *texts, *failure])
    return found


def table(content: dict) -> str:
    """The report for a terminal: a few columns of the table, and what was measured of many scenes."""
    rows = [[row[n] for n in (1, 3, 4, 8, 9, 11)] for row in cells(content)]
    rows = [[*row[:1], "failed", *row[2:]] if row[1].startswith("failed") else row for row in rows]
    return "\n".join([in_columns(rows), *throughput_in_words(content)])


def throughput_in_words(content: dict) -> list[str]:
    """A line for each setting."""
    lines = []
    for row in content["throughput"]:
        rate = row["steps_a_second"]
        found = row["problem"] if rate is None else f"{rate:.3g} steps a second"
        lines.append(f"{row['setting']}: {found} of {row['scenes']} scenes together, with images")
    return lines


# ---- the page ----


def page(content: dict, pictures: dict[str, bytes]) -> str:
    """The report as one page without scripts or anything from elsewhere."""
    rows, lists = content["settings"], []
    for name, number in content["presets"].items():
        row = rows[number]
        text = f"{name}: {row['name']}, {row['step_ms']['median']:.3g} ms a step"
        if row["setting"]:
            text += f", {row['faster']:.2f} times as fast, keeps {share_in_words(row['kept'])} of the gain"
        lists.append(text)
    if rows[0]["gain_db"] is not None and rows[0]["gain_db"] <= 0:
        lists.append("This checkpoint gains nothing over particles that hold still: shares below are of its loss.")
    figures = "".join(
        f"<figure><img alt='{name}' src='data:image/png;base64,{base64.b64encode(data).decode()}'>"
        f"<figcaption>{escape(CAPTIONS[name])}</figcaption></figure>"
        for name, data in pictures.items()
    )
    head, *body = cells(content)
    html = f"<tr>{''.join(f'<th>{escape(cell)}' for cell in head)}"
    for row, texts in zip(rows, body, strict=True):
        style = "failed" if "failure" in row else "front" if row["on_front"] else ""
        html += f"<tr class='{style}'>{''.join(f'<td>{escape(text)}' for text in texts)}"
    facts = {**content["machine"], **content["case"]}
    parts = {
        "Presets of --speed": _list(lists),
        "Settings": f"<table>{html}</table><p>{EXPLAINED}</p>{_list(f'{k}: {v}' for k, v in content['kinds'].items())}",
        "Figures": figures,
        "Many scenes": _list(throughput_in_words(content)),
        "Not run": _list(f"{name}: needs {why}" for name, why in content["not_run"].items()),
        "Not measured": _list(f"{name}: {why}" for name, why in content["not_measured"].items()),
        "Measured on": _list(f"{name}: {value}" for name, value in facts.items()),
    }
    return (
        f"<!doctype html><html lang=en><meta charset=utf-8><title>gsim3d: accuracy against time</title>"
        f"<style>{STYLE}</style>\n<h1>What accuracy costs in time</h1>"
        f"<p>Made by <code>{escape(content['command'])}</code></p>\n"
        + "\n".join(f"<h2>{heading}</h2>{part}" for heading, part in parts.items())
        + "\n</html>\n"
    )


def _list(lines) -> str:
    return "<ul>" + "".join(f"<li>{escape(str(line))}" for line in lines) + "</ul>"


# ---- figures ----


def cost_figure(points: Sequence[Point], case: BenchmarkCase, presets: dict[str, Point]) -> bytes:
    """What each share of the accuracy costs: the lost share of the reference's gain against the time of a step."""
    shares = {id(p): case.share_kept(p, points[0]) for p in points if not p.failure}
    usable = [p for p in points if shares.get(id(p)) is not None]

    def lost(point: Point) -> float:
        return min(MOST_LOSS, max(LEAST_LOSS, 1 - shares[id(point)]))

    figure, axes = pyplot().subplots(figsize=(9.5, 6.4), layout="constrained")
    best = front(usable, lost)
    _draw_points(axes, points, usable, best, lost, {id(p) for p in presets.values()})
    axes.set(xscale="log", yscale="log", ylabel="share of the gain that is lost")
    axes.set_xlabel("time of a simulated step and its images [ms]; bars: rounds differ by so much")
    axes.set_ylim(LEAST_LOSS / 1.8, 12 * MOST_LOSS)  # space for what is said of the presets
    ticks = {LEAST_LOSS: "none", 1e-3: "0.1 %", 1e-2: "1 %", 0.1: "10 %", 1.0: "100 %", MOST_LOSS: "more"}
    axes.set_yticks(list(ticks), list(ticks.values()))
    axes.yaxis.set_minor_locator(pyplot().NullLocator())
    axes.xaxis.set_major_formatter("{x:g}")
    axes.xaxis.set_minor_formatter("{x:g}")
    for share, text in PROMISED.items():
        axes.axhline(1 - share, color="#444444", linewidth=1, linestyle="--", zorder=1)
        axes.text(1.005, 1 - share, text, transform=axes.get_yaxis_transform(), va="center", fontsize=9)
    _mark_presets(axes, {name: p for name, p in presets.items() if p in usable}, points[0], lost)
    gain = case.gain(points[0])
    whole = "" if gain is None else f" (the gain: {gain:.2f} dB over particles held still)"
    axes.set_title(f"What 99.9 % and 99 % of the model's gain cost{whole}", fontsize=11)
    return _png(figure)


def _draw_points(axes, points, usable, best, error: Callable[[Point], float], marked: set[int]) -> None:
    """Points, the front through them, and what failed at the edge; numbers are those of the table."""
    number = {id(p): n for n, p in enumerate(points)}
    placed: list[tuple[float, float]] = []
    for point in usable:
        chosen = point in best or point is points[0]
        x, y, color = 1e3 * point.step_seconds, error(point), COLORS[point.kind] if chosen else GREY
        axes.plot(x, y, "o", color=color, markersize=8 if chosen else 5, zorder=4 if chosen else 3)
        axes.errorbar(x, y, xerr=500 * point.spread, fmt="none", ecolor="#d0d0d0", zorder=2)
        text = f"{number[id(point)]}" + (f" {point.setting.name}" if chosen and id(point) not in marked else "")
        near = sum(abs(log10(x) - a) < 0.1 and abs(log10(y) - b) < 0.15 for a, b in placed)
        placed.append((log10(x), log10(y)))
        label = {"xytext": (5, 4 + 9 * near), "textcoords": "offset points", "fontsize": 8 if chosen else 7}
        axes.annotate(text, (x, y), **label, color=color, zorder=4)
    axes.plot(
        *zip(*sorted((1e3 * p.step_seconds, error(p)) for p in best)), "-", color="#444444", linewidth=1, zorder=2
    )
    for n, point in enumerate(p for p in points if p.failure):
        text = f"failed: {number[id(point)]} {point.setting.name}: {point.failure[:60]}"
        axes.text(0.995, 0.02 + 0.035 * n, text, transform=axes.transAxes, ha="right", fontsize=7, color=RED)
    for kind in dict.fromkeys(p.kind for p in points):
        axes.plot([], [], "o", color=COLORS[kind], label=f"{kind}: {KINDS[kind]}")
    axes.plot([], [], "o", color=GREY, label="beaten by another in both; numbers: see the table")
    axes.legend(fontsize=7.5, ncols=2, loc="upper center", bbox_to_anchor=(0.5, -0.1))


def _mark_presets(axes, presets: dict[str, Point], reference: Point, lost: Callable[[Point], float]) -> None:
    """A star on each preset, and a box that says what it is."""
    for index, point in enumerate(sorted(set(presets.values()), key=lambda p: p.step_seconds)):
        x, y = 1e3 * point.step_seconds, lost(point)
        axes.plot(x, y, "*", color="#e0a030", markersize=18, markeredgecolor="#444444", zorder=5)
        names = " = ".join(name for name, chosen in presets.items() if chosen is point)
        faster = reference.step_seconds / point.step_seconds
        text = "\n".join([f"{names}: {x:.3g} ms, {faster:.2f} times as fast", *wrap(point.setting.name, 36)])
        box = {"boxstyle": "round", "facecolor": "#fff8e8", "edgecolor": "#e0a030"}
        at = {"xytext": (0.015 + 0.345 * index, 0.98), "textcoords": "axes fraction", "va": "top"}
        axes.annotate(text, (x, y), **at, fontsize=8.5, bbox=box, arrowprops={"arrowstyle": "-", "color": "#e0a030"})


def sections_figure(points: Sequence[Point]) -> bytes:
    """Where the time of a step goes."""
    shown = [(n, p) for n, p in enumerate(points) if not p.failure and p.sections()]
    figure, axes = pyplot().subplots(figsize=(9.5, 1.4 + 0.28 * len(shown)), layout="constrained")
    left = [0.0] * len(shown)
    for n, name in enumerate(SECTIONS):
        widths = [1e3 * p.sections().get(name, 0.0) for _, p in shown]
        if any(widths):
            axes.barh(range(len(shown)), widths, left=left, color=pyplot().cm.tab10(n), label=name)
            left = [a + b for a, b in zip(left, widths)]
    axes.set_yticks(range(len(shown)), [f"{n} {p.setting.name}" for n, p in shown], fontsize=8)
    axes.invert_yaxis()
    axes.set_xlabel("time of a step, by section [ms]")
    axes.legend(fontsize=8, ncols=5, loc="lower center", bbox_to_anchor=(0.4, 1))
    return _png(figure)


def horizon_figure(points: Sequence[Point], case: BenchmarkCase, presets: dict[str, Point]) -> bytes:
    """How the error against the video grows with the horizon: of the reference and the presets."""
    figure, axes = pyplot().subplots(figsize=(9.5, 4.5), layout="constrained")
    curves = {p.setting.name: p.by_step[case.metric] for p in (points[0], *presets.values())}
    curves["particles held still"] = case.constant[case.metric]
    for label, values in curves.items():
        known = [float("nan") if v is None else v for v in values]
        axes.plot(range(1, 1 + len(known)), known, "--" if label == "particles held still" else "-", label=label)
    axes.set(xlabel="predicted step", ylabel="PSNR against the video [dB]")
    axes.legend(fontsize=8)
    return _png(figure)


def _png(figure) -> bytes:
    data = io.BytesIO()
    figure.savefig(data, format="png", dpi=110)
    pyplot().close(figure)
    return data.getvalue()
