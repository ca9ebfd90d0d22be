"""The report of ``gsim3d profile``: report.json, report.csv, three figures, and a page with all of them."""

import base64
import csv
import io
import shlex
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from html import escape
from pathlib import Path

import numpy as np

from gsim3d.data import Scene, find_scenes, split_scenes
from gsim3d.errors import InputError, did_you_mean
from gsim3d.evaluate.pictures import pyplot
from gsim3d.evaluate.report import write_json
from gsim3d.evaluate.scoring import METRICS, measurable
from gsim3d.io.files import write_whole
from gsim3d.io.machine import machine
from gsim3d.io.terminal import in_columns
from gsim3d.numerics.speed import SPEEDS_FILE, read_checkpoints
from gsim3d.pretrained import folder_of
from gsim3d.profile.autotune import PROMISES, part_times, save_speeds, tune
from gsim3d.profile.settings import GROUPS, KINDS, Group
from gsim3d.profile.sweep import FULL, NO_TIME, QUICK, REST, BenchmarkCase, Point, Sweep, TimeLimit, front, tie
from gsim3d.profile.timing import SECTIONS, Timing
from gsim3d.synth.run import generate
from gsim3d.synth.worlds import WORLDS
from gsim3d.train.restore import Restored, restore
from gsim3d.train.run import run_folder

FORMAT = 3
BATCH = 4  # scenes in the batch of the throughput
FULL_STEPS = 24  # of generated scenes, where whole videos are predicted
SLOW_METRICS = ("lpips_vgg", "fvd")  # take seconds a setting
CAPTIONS = {
    "cost.png": "Lost accuracy over the time of a step. Stars: presets of --speed; dashed lines: their limits.",
    "sections.png": "Time of a step by section.",
    "horizon.png": "Error over the prediction horizon.",
}
COLORS = {"exact": "#2e8b57", "near-exact": "#1f5fbf", "model": "#c0504d"}
GREY = "#a8a8a8"
MIN_LOSS, MAX_LOSS = 1e-4, 3.0  # shares of the gain; the figure clamps losses to them
STYLE = """body{font:15px/1.5 sans-serif;max-width:1080px;margin:2em auto;padding:0 1em;color:#222}
table{border-collapse:collapse;font-size:13px;margin:.5em 0}
td,th{padding:2px 8px;text-align:right;border-bottom:1px solid #ddd}
td:nth-child(2),th:nth-child(2),td:nth-child(3),th:nth-child(3){text-align:left}
.front td{font-weight:bold}.failed td{color:#c00000}figure{margin:1.5em 0}figcaption{font-size:13px;color:#555}
img{max-width:100%}code{background:#f3f3f3;padding:2px 4px;white-space:pre-wrap}"""
EXPLAINED = """\
step, p95: time of one simulated step with its images at batch 1, median and 95th percentile. agreement: PSNR against
the reference run of the same checkpoint. position: largest distance of a moving particle from there, in cells.
kept: share of the reference's gain in dB over the constant baseline. Columns after it: scores against the video.
tie: the difference in time is below the spread of repeated measurements. Bold: on the Pareto front of time and
agreement."""


def profile(
    checkpoint: str,
    data: str | None,
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
    """Measures all settings, tunes the presets and writes the report. An interrupted call continues.

    Args:
        checkpoint: name or run folder.
        data: folder of scenes, or one scene; None: generated scenes, see :func:`generated`.
        out: folder of the report.
        scenes: "test" for the scenes held out in training, or "all".
        preset: "quick" or "full".
        settings: names of the groups to measure; None: all.
        metrics: scores against the video; None: all that can be computed.
        minutes: time budget; None: unlimited.
        device: "cpu" or "cuda".
        progress: called with a description of each measurement.
    Returns:
        The content of report.json, and the paths of the written files.
    Raises:
        InputError: an option is invalid, or the reference run failed.
    """
    limit, quick = TimeLimit(minutes and 60 * minutes), preset == "quick"
    groups = _groups(settings)
    effort = replace(QUICK if quick else FULL, few=quick and settings is None)
    measured, not_measured = measurable(metrics)
    if quick and metrics is None:
        slow = [name for name in measured if name in SLOW_METRICS]
        not_measured |= dict.fromkeys(slow, "slow; name it with --metrics or use --preset full")
        measured = tuple(name for name in measured if name not in slow)
    pyplot()
    restored = restore(checkpoint, device)
    with run_folder(out):
        if data is None:
            data, scenes = generated(checkpoint, restored, out / "scenes", effort.n_steps or FULL_STEPS), "all"
        case = BenchmarkCase(restored, _scenes(restored, data, scenes, effort.n_scenes), effort.n_steps, measured)
        sweep = Sweep(case, effort, limit, progress, out / "measured.json")
        points, not_run = sweep.points(groups)
        sweep.run(points)
        if points[0].failure:
            raise InputError(f"{checkpoint}: the reference run failed: {points[0].failure}")
        for point in (left_out := [point for point in points if point.failure == NO_TIME]):
            before = not_run.get(point.group, "a larger --minutes, for")
            not_run[point.group] = f"{before} {point.setting.name};"
        points = [point for point in points if point.failure != NO_TIME]
        presets = tune(sweep, points)
        points = list(dict.fromkeys([*points, *presets.values()]))
        progress("throughput")
        rates = [sweep.throughput(point, BATCH) for point in dict.fromkeys(presets.values()) if not limit.is_over(REST)]
        content = as_dict(case, points, presets) | {
            "command": shlex.join(["gsim3d", "profile", *sys.argv[2:]]),
            "throughput": rates,
            "not_run": not_run,
            "not_measured": {**case.not_measured, **not_measured},
        }
        files = write(out, case, points, presets, content)
        times, is_partial = part_times(case, points[0]), bool(settings or left_out)
        files.append(_keep_speeds(folder_of(checkpoint), out, is_partial, restored, presets, times))
    return content, files


def _groups(names: Sequence[str] | None) -> Sequence[Group]:
    known = {group.name: group for group in GROUPS}
    if unknown := [name for name in names or () if name not in known]:
        hint = did_you_mean(unknown[0], known)
        raise InputError(f"--settings: unknown name {unknown[0]!r}; settings: {', '.join(map(repr, known))}{hint}")
    return GROUPS if names is None else [known[name] for name in names]


def generated(checkpoint: str, restored: Restored, folder: Path, n_steps: int) -> Path:
    """Generates two scenes in ``folder``, of the world that a shipped simulator is named after, or else of soft bodies,
    with the image size and frame rate of the training and ``n_steps`` after the input. Returns the folder."""
    world = next((name for name in WORLDS if Path(checkpoint).name == f"{name}-small"), "elastic")
    changes = {"image_size": max(restored.image_size), "n_frames": restored.n_encoded + n_steps, "n_trajectories": 2}
    changes |= {} if restored.fps is None else {"fps": restored.fps}
    generate(folder, world, preset="published", processes=1, progress=False, **changes)
    return folder


def _scenes(restored: Restored, data: str, which: str, count: int | None) -> list[Scene]:
    found = find_scenes(data)
    chosen = found if which == "all" else split_scenes(found)[1] or found
    return [restored.open_scene(folder) for folder in chosen[:count]]


def _keep_speeds(folder: Path, out: Path, is_partial: bool, restored: Restored, *kept) -> Path:
    """Saves presets in the checkpoint's ``folder``, for ``--speed``; in ``out`` if it is read-only or has better."""
    known = read_checkpoints(folder / SPEEDS_FILE).get(restored.checkpoint.digest, {})
    if is_partial and restored.device.type in known:
        print(f"{folder / SPEEDS_FILE}: kept, as only some settings were measured; theirs: {out / SPEEDS_FILE}")
        return save_speeds(out, restored, *kept)
    try:
        return save_speeds(folder, restored, *kept)
    except OSError as error:
        print(f"{error.filename or folder}: {error.strerror}; for --speed, copy {out / SPEEDS_FILE} there")
        return save_speeds(out, restored, *kept)


def as_dict(case: BenchmarkCase, points: Sequence[Point], presets: dict[str, Point]) -> dict:
    """Content of report.json for a case: times in milliseconds, memory in MiB. ``points``: measured ones, the reference
    first; ``presets``: preset -> one of them."""
    restored, reference = case.restored, points[0]
    best = front(points, lambda p: p.agreement and -p.agreement.psnr)
    rows = []
    for number, point in enumerate(points):
        name, values = point.setting.name, point.setting.to_dict()
        rows.append({"number": number, "name": name, "setting": values, "group": point.group, "kind": point.kind})
        if point.failure:
            rows[-1]["failure"] = point.failure
            continue
        sections = {name: 1e3 * seconds for name, seconds in point.sections().items()}
        rows[-1] |= {
            "agreement": vars(point.agreement),
            "task": point.task,
            "by_step": point.by_step,
            "gain_db": case.gain(point),
            "kept": case.share_kept(point, reference),
            "resting_share": point.resting_share,
            "step_ms": {**_times(point.step), "spread": 1e3 * point.spread, "sections": sections},
            "encode_ms": _times(point.encode),
            "capture_ms": 1e3 * point.capture_seconds,
            "peak_mib": point.peak_bytes / 2**20,
            "faster": reference.step_seconds / point.step_seconds,
            "tie_with_reference": point is not reference and tie(point, reference),
            "on_front": point in best,
        }
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
        "presets": {name: points.index(point) for name, point in presets.items()},
    }


def _times(timings: Sequence[Timing]) -> dict[str, float]:
    whole = Timing(tuple(seconds for timing in timings for seconds in timing.repeats))
    return {"median": 1e3 * whole.median, "p95": 1e3 * whole.p95, "repeats": len(whole.repeats)}


def write(
    folder: Path, case: BenchmarkCase, points: Sequence[Point], presets: dict[str, Point], content: dict
) -> list[Path]:
    """Writes report.html, report.json, report.csv and the figures. Returns their paths."""
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


def share_in_words(value: float | None) -> str:
    """A share of the gain as a percentage. Shares outside [0, 2] mean a reference with almost no gain."""
    if value is None:
        return "-"
    return f"{value:.2%}" if 0 <= value <= 2 else "below 0" if value < 0 else "above 200%"


def cells(content: dict, *, plain: bool = False) -> list[list[str]]:
    """The table of settings in report.json as text: a row of headings, then a row a setting; ``plain``: numbers with
    six digits and all metrics, for other programs."""
    metrics = [name for name in content["settings"][0]["task"] if plain or name not in ("psnr_ground", "psnr_ring")]
    columns: list[tuple[str, Callable[[dict], float | None], int]] = [
        ("step ms", lambda row: row["step_ms"]["median"], 2),
        ("p95 ms", lambda row: row["step_ms"]["p95"], 2),
        ("encode ms", lambda row: row["encode_ms"]["median"], 1),
        ("capture ms", lambda row: row["capture_ms"], 0),
        ("peak MiB", lambda row: row["peak_mib"], 0),
        ("faster", lambda row: row["faster"], 2),
        ("agreement dB", lambda row: row["agreement"]["psnr"], 1),
        ("position", lambda row: row["agreement"]["position_max"], 3),
        ("kept", lambda row: row["kept"], 4),
        *((METRICS[n].label, lambda row, n=n: row["task"].get(n), METRICS[n].digits) for n in metrics),
    ]
    found = [["#", "setting", "kind", *(heading for heading, *_ in columns)]]
    for row in content["settings"]:
        if "failure" in row:
            texts = [f"failed: {row['failure']}", *[""] * (len(columns) - 1)]
        elif plain:
            values = [value(row) for _, value, _ in columns]
            texts = ["" if value is None else f"{value:.6g}" for value in values]
        else:
            values = [(value(row), digits) for _, value, digits in columns]
            texts = ["-" if value is None else f"{value:.{digits}f}" for value, digits in values]
            texts[5] = "tie" if row["tie_with_reference"] else texts[5]
            texts[8] = share_in_words(row["kept"])
        found.append([str(row["number"]), row["name"], row["kind"], *texts])
    return found


def table(content: dict) -> str:
    """The report as text for a terminal: the main columns and the throughput."""
    rows = [[row[n] for n in (1, 3, 4, 8, 9, 11)] for row in cells(content)]
    rows = [[*row[:1], "failed", *row[2:]] if row[1].startswith("failed") else row for row in rows]
    return "\n".join([in_columns(rows), *throughput_in_words(content)])


def throughput_in_words(content: dict) -> list[str]:
    """A line of throughput for each measured setting."""
    lines = []
    for row in content["throughput"]:
        rate = row["steps_a_second"]
        found = row["problem"] if rate is None else f"{rate:.3g} steps a second"
        lines.append(f"{row['setting']}: {found} in a batch of {row['scenes']} scenes, with images")
    return lines


def page(content: dict, pictures: dict[str, bytes]) -> str:
    """The report as one HTML page without scripts or external files, of the content of report.json and ``pictures``:
    file name -> PNG."""
    rows, presets = content["settings"], []
    for name, number in content["presets"].items():
        row = rows[number]
        text = f"{name}: {row['name']}, {row['step_ms']['median']:.3g} ms a step"
        if row["setting"]:
            text += f", {row['faster']:.2f} times as fast, retains {share_in_words(row['kept'])} of the gain"
        presets.append(text)
    if rows[0]["gain_db"] is not None and rows[0]["gain_db"] <= 0:
        presets.append("This checkpoint has no gain over the constant baseline: shares below are of its loss.")
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
    parts = {
        "Presets of --speed": _list(presets),
        "Settings": f"<table>{html}</table><p>{EXPLAINED}</p>{_list(f'{k}: {v}' for k, v in content['kinds'].items())}",
        "Figures": figures,
        "Throughput": _list(throughput_in_words(content)),
        "Not run": _list(f"{name}: needs {why}" for name, why in content["not_run"].items()),
        "Not measured": _list(f"{name}: {why}" for name, why in content["not_measured"].items()),
        "Machine and case": _list(f"{name}: {value}" for name, value in (content["machine"] | content["case"]).items()),
    }
    return (
        f"<!doctype html><html lang=en><meta charset=utf-8><title>gsim3d: accuracy against time</title>"
        f"<style>{STYLE}</style>\n<h1>Accuracy against time</h1>"
        f"<p>Command: <code>{escape(content['command'])}</code></p>\n"
        + "\n".join(f"<h2>{heading}</h2>{part}" for heading, part in parts.items())
        + "\n</html>\n"
    )


def _list(lines) -> str:
    return "<ul>" + "".join(f"<li>{escape(str(line))}" for line in lines) + "</ul>"


def cost_figure(points: Sequence[Point], case: BenchmarkCase, presets: dict[str, Point]) -> bytes:
    """PNG of the lost share of the reference's gain over the time of a step, with Pareto front and presets."""
    usable = [p for p in points if not p.failure and case.share_kept(p, points[0]) is not None]

    def loss(point: Point) -> float:
        return min(MAX_LOSS, max(MIN_LOSS, 1 - case.share_kept(point, points[0])))

    figure, axes = pyplot().subplots(figsize=(9.5, 6.4), layout="constrained")
    best = front(usable, loss)
    for point in usable:
        chosen = point in best or point is points[0]
        x, y, color = 1e3 * point.step_seconds, loss(point), COLORS[point.kind] if chosen else GREY
        axes.errorbar(x, y, xerr=500 * point.spread, fmt="o", color=color, ecolor="#d0d0d0", ms=8 if chosen else 5)
        text = f"{points.index(point)} {point.setting.name if chosen else ''}"
        axes.annotate(text, (x, y), xytext=(5, 4), textcoords="offset points", fontsize=8, color=color)
    axes.plot([1e3 * p.step_seconds for p in best], [loss(p) for p in best], color="#444444", linewidth=1)
    for kind in dict.fromkeys(p.kind for p in points):
        axes.plot([], [], "o", color=COLORS[kind], label=f"{kind}: {KINDS[kind]}")
    axes.plot([], [], "o", color=GREY, label="not on the Pareto front; numbers: see the table")
    for name, point in presets.items():
        if point in usable:
            x, text = 1e3 * point.step_seconds, f"{name}: {point.setting.name}, {1e3 * point.step_seconds:.3g} ms"
            axes.plot(x, loss(point), "*", color="#e0a030", markersize=18, markeredgecolor="#444444", label=text)
    for share in PROMISES.values():
        if share is not None:
            axes.axhline(1 - share, color="#444444", linewidth=1, linestyle="--", zorder=1)
            axes.text(1.005, 1 - share, f"{share:.1%} kept", transform=axes.get_yaxis_transform(), va="center")
    axes.set(xscale="log", yscale="log", ylim=(MIN_LOSS / 1.8, 2 * MAX_LOSS), ylabel="lost share of the gain")
    axes.set_xlabel("time of a simulated step with its images [ms]; bars: spread of the rounds")
    ticks = {MIN_LOSS: "none", 1e-3: "0.1 %", 1e-2: "1 %", 0.1: "10 %", 1.0: "100 %", MAX_LOSS: "more"}
    axes.set_yticks(list(ticks), list(ticks.values()))
    axes.yaxis.set_minor_locator(pyplot().NullLocator())
    axes.xaxis.set_major_formatter("{x:g}")
    axes.xaxis.set_minor_formatter("{x:g}")
    axes.legend(fontsize=7.5, ncols=2, loc="upper center", bbox_to_anchor=(0.5, -0.1))
    return _png(figure)


def sections_figure(points: Sequence[Point]) -> bytes:
    """PNG of the time of a step, by section."""
    shown = [(n, p) for n, p in enumerate(points) if not p.failure and p.sections()]
    figure, axes = pyplot().subplots(figsize=(9.5, 1.4 + 0.28 * len(shown)), layout="constrained")
    left = np.zeros(len(shown))
    for n, name in enumerate(SECTIONS):
        widths = np.array([1e3 * p.sections().get(name, 0.0) for _, p in shown])
        if widths.any():
            axes.barh(range(len(shown)), widths, left=left, color=pyplot().cm.tab10(n), label=name)
            left += widths
    axes.set_yticks(range(len(shown)), [f"{n} {p.setting.name}" for n, p in shown], fontsize=8)
    axes.invert_yaxis()
    axes.set_xlabel("time of a step, by section [ms]")
    axes.legend(fontsize=8, ncols=5, loc="lower center", bbox_to_anchor=(0.4, 1))
    return _png(figure)


def horizon_figure(points: Sequence[Point], case: BenchmarkCase, presets: dict[str, Point]) -> bytes:
    """PNG of the PSNR at each predicted step, for the reference, the presets and the constant baseline."""
    figure, axes = pyplot().subplots(figsize=(9.5, 4.5), layout="constrained")
    curves = {p.setting.name: p.by_step[case.metric] for p in (points[0], *presets.values())}
    curves["constant"] = case.constant[case.metric]
    for label, values in curves.items():
        axes.plot(range(1, 1 + len(values)), values, "--" if label == "constant" else "-", label=label)
    axes.set(xlabel="predicted step", ylabel="PSNR against the video [dB]")
    axes.legend(fontsize=8)
    return _png(figure)


def _png(figure) -> bytes:
    data = io.BytesIO()
    figure.savefig(data, format="png", dpi=110)
    pyplot().close(figure)
    return data.getvalue()
