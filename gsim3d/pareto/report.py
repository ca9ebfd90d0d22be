"""The report of accuracy against time: report.json, report.csv, pictures, and one page that holds all of it."""

from __future__ import annotations

import base64
import csv
import html
import io
import os
import platform
from collections.abc import Sequence
from pathlib import Path

import torch

import gsim3d
from gsim3d.evaluate.metrics import PSNR_CAP
from gsim3d.evaluate.pictures import pyplot
from gsim3d.evaluate.report import write_json
from gsim3d.pareto.measure import Comparison, Point, disagreement, front, ties
from gsim3d.pareto.regimes import Throughput, TrainingStep
from gsim3d.pareto.settings import KINDS, KNOBS
from gsim3d.pareto.timing import ADDS_UP, STAGES, Timing

FORMAT = 1
COLORS = {"exact": "#2e8b57", "near-exact": "#1f5fbf", "model": "#c0504d", "needs-training": "#7f7f7f"}
STAGE_COLORS = ("#4c72b0", "#dd8452", "#55a868", "#c44e52", "#8172b3", "#937860", "#da8bc3", "#8c8c8c", "#ccb974")
AXES = {
    "agreement": ("PSNR against the reference [dB]", lambda p: p.agreement.psnr if p.agreement else None),
    "task": ("PSNR against the truth [dB]", lambda p: p.task.get("psnr_masked", p.task.get("psnr"))),
}


def machine(device: torch.device) -> dict[str, object]:
    """What the numbers were measured on, and with."""
    facts: dict[str, object] = {
        "gsim3d": gsim3d.__version__,
        "torch": torch.__version__,
        "python": platform.python_version(),
    }
    if device.type == "cuda":
        facts["device"] = torch.cuda.get_device_name(device)
        facts["cuda"] = torch.version.cuda
        try:
            import pynvml

            pynvml.nvmlInit()
            facts["driver"] = pynvml.nvmlSystemGetDriverVersion()
        except Exception:  # without the package or the right to ask, the report says nothing about it
            pass
    else:
        facts["device"] = f"CPU, {torch.get_num_threads()} threads"
        facts["processor"] = _processor()
    return facts


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor() or platform.machine()
    return next((line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), platform.machine())


def as_dict(points: Sequence[Point], comparison: Comparison, conditions: dict) -> dict:
    """What report.json holds; times in milliseconds, memory in MiB."""
    best = {name: {id(p) for p in _front(points, name)} for name in AXES}
    reference = points[0]
    rows = []
    for point in points:
        row: dict = {
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
        row["by_step"] = point.by_step
        row["step_ms"] = {**_times(point.step), "spread": 1e3 * point.spread, "stages": _ms(stages)}
        row["step_ms"]["unexplained"] = abs(sum(stages.values()) / point.step_seconds - 1) if stages else None
        row["encode_ms"] = _times(point.encode)
        row["once_ms"], row["peak_mib"] = 1e3 * point.once, point.peak / 2**20
        row["faster"] = reference.step_seconds / point.step_seconds
        row["tie_with_reference"] = point is not reference and ties(point, reference)
        row["on_front"] = {name: id(point) in best[name] for name in AXES}
        rows.append(row)
    missing = {knob.name: knob.needs for knob in KNOBS if knob.name not in {p.knob for p in points}}
    return {
        "format": FORMAT, **conditions, "constant": comparison.constant, "kinds": KINDS, "points": rows, "not_turned": missing
    }  # fmt: skip


def _times(timings: Sequence[Timing]) -> dict[str, float]:
    whole = Timing(tuple(seconds for timing in timings for seconds in timing.repeats))
    return {"median": 1e3 * whole.median, "p95": 1e3 * whole.p95, "repeats": len(whole.repeats)}


def _ms(stages: dict[str, float]) -> dict[str, float]:
    return {name: 1e3 * stages[name] for name in STAGES if name in stages}


def _front(points: Sequence[Point], axis: str) -> list[Point]:
    if axis == "agreement":
        return front(points, disagreement)
    value = AXES[axis][1]
    return front(points, lambda p: None if value(p) is None else -value(p))


def regimes_as_dict(throughputs: Sequence[Throughput], training: TrainingStep) -> dict:
    """The other ways to use the simulator, for ``conditions``."""
    rows = [
        {
            "setting": t.setting.name,
            "scenes": t.n_scenes,
            "steps_a_second": t.steps_a_second,
            "step_ms": _times([t.timing]),
        }
        for t in throughputs
    ]
    step: dict = {"problem": training.problem}
    if training.timing is not None:
        step = {"batch": training.batch, "horizon": training.horizon, "step_ms": _times([training.timing])}
    return {"throughput": rows, "training": step}


def _regimes(regimes: dict) -> list[str]:
    lines = [
        f"{row['setting']}: {row['steps_a_second']:.3g} steps a second of {row['scenes']} scenes at once, images included"
        for row in regimes["throughput"]
    ]
    training = regimes["training"]
    if "problem" in training:
        return [*lines, f"training step: not measured: {training['problem']}"]
    batch = f"{training['batch']} scenes, {training['horizon']} steps fed back"
    return [*lines, f"training step ({batch}): {training['step_ms']['median'] / 1e3:.3g} s"]


def write(folder: Path, points: Sequence[Point], comparison: Comparison, conditions: dict) -> list[Path]:
    """Writes report.json, report.csv, report.html and a PNG of each figure; each appears complete or not at all."""
    content = as_dict(points, comparison, conditions)
    pictures = {
        "agreement.png": _scatter(points, "agreement"),
        "task.png": _scatter(points, "task"),
        "stages.png": _stages(points),
        "horizon.png": _horizon(points),
    }
    write_json(folder / "report.json", content)
    files = {
        "report.csv": _csv(content).encode(),
        **pictures,
        "report.html": _page(content, pictures).encode(),
    }
    for name, text in files.items():
        part = folder / f".{name}.part"
        part.write_bytes(text)
        os.replace(part, folder / name)
    return [folder / "report.json", *(folder / name for name in files)]


def _csv(content: dict) -> str:
    text = io.StringIO()
    rows = csv.writer(text, lineterminator="\n")
    metrics = list(content["points"][0].get("task", {}))
    rows.writerow(
        ["setting", "knob", "kind", "step_ms", "step_p95_ms", "encode_ms", "faster", "peak_mib", "agreement_psnr",
         "position_max_cells", "gain_db", *metrics, "failure"]
    )  # fmt: skip
    for row in content["points"]:
        if "failure" in row:
            rows.writerow([row["name"], row["knob"], row["kind"], *[""] * (8 + len(metrics)), row["failure"]])
            continue
        agreement = row["agreement"] or {}
        numbers = [row["step_ms"]["median"], row["step_ms"]["p95"], row["encode_ms"]["median"], row["faster"]]
        numbers += [row["peak_mib"], agreement.get("psnr"), agreement.get("position_max"), row["gain_db"]]
        numbers += [row["task"].get(metric) for metric in metrics]
        cells = ["" if number is None else f"{number:.6g}" for number in numbers]
        rows.writerow([row["name"], row["knob"], row["kind"], *cells, ""])
    return text.getvalue()


def _scatter(points: Sequence[Point], axis: str) -> bytes:
    """Error against time, both on logarithmic axes; failures at the right edge."""
    plt = pyplot()
    label, value = AXES[axis]
    figure, axes = plt.subplots(figsize=(9, 6), layout="constrained")
    usable = [p for p in points if not p.failure and value(p) is not None]
    best = _front(points, axis)
    for point in usable:
        on_front = point in best or point is points[0]
        x, y = 1e3 * point.step_seconds, 10 ** (-value(point) / 20)
        color = COLORS[point.kind] if on_front else "#bbbbbb"
        axes.plot(x, y, "o", color=color, markersize=8 if on_front else 5, zorder=3)
        axes.annotate(point.setting.name, (x, y), (5, 4), textcoords="offset points", fontsize=7, color=color)
    line = sorted((1e3 * p.step_seconds, 10 ** (-value(p) / 20)) for p in best)
    axes.plot(*zip(*line), "-", color="#444444", linewidth=1, zorder=2)
    axes.set(xscale="log", yscale="log", xlabel="time of a simulated step and its images [ms]")
    axes.set_ylabel("root mean squared error of images")
    second = axes.secondary_yaxis("right", functions=(_decibel, _error))
    second.set_ylabel(label)
    second.set_yticks(range(5, 105, 5), [str(n) for n in range(5, 105, 5)])
    second.minorticks_off()
    for n, point in enumerate(p for p in points if p.failure):
        text = f"{point.setting.name}: {point.failure[:60]}"
        axes.text(0.995, 0.99 - 0.035 * n, f"failed: {text}", transform=axes.transAxes, ha="right", va="top",
                  fontsize=7, color="#c00000")  # fmt: skip
    for kind, color in COLORS.items():
        if any(p.kind == kind for p in points):
            axes.plot([], [], "o", color=color, label=f"{kind}: {KINDS[kind]}")
    axes.plot([], [], "o", color="#bbbbbb", label="beaten by another in both")
    axes.legend(fontsize=7, ncols=2, loc="upper center", bbox_to_anchor=(0.5, -0.09))
    return _png(figure)


def _decibel(error):
    import numpy as np

    return -20 * np.log10(np.maximum(error, 10 ** (-PSNR_CAP / 20)))


def _error(decibel):
    return 10 ** (-decibel / 20)


def _stages(points: Sequence[Point]) -> bytes:
    plt = pyplot()
    shown = [p for p in points if not p.failure and p.stages()]
    figure, axes = plt.subplots(figsize=(9, 1.2 + 0.32 * len(shown)), layout="constrained")
    left = [0.0] * len(shown)
    for name, color in zip(STAGES, STAGE_COLORS, strict=True):
        widths = [1e3 * p.stages().get(name, 0.0) for p in shown]
        if any(widths):
            axes.barh(range(len(shown)), widths, left=left, color=color, label=name)
            left = [a + b for a, b in zip(left, widths)]
    axes.set_yticks(range(len(shown)), [p.setting.name for p in shown], fontsize=7)
    axes.invert_yaxis()
    axes.set_xlabel("time of a step, by stage [ms]")
    axes.legend(fontsize=7, ncols=4, loc="lower center", bbox_to_anchor=(0.5, 1))
    return _png(figure)


def _horizon(points: Sequence[Point]) -> bytes:
    """How the error against the truth grows with the horizon, of the settings on the front."""
    plt = pyplot()
    figure, axes = plt.subplots(figsize=(9, 4.5), layout="constrained")
    for point in dict.fromkeys([points[0], *_front(points, "task")]) if not points[0].failure else []:
        metric = "psnr_masked" if "psnr_masked" in point.by_step else "psnr"
        every = point.setting.every
        values = [float("nan") if v is None else v for v in point.by_step[metric]]
        axes.plot([1 + every * n for n in range(len(values))], values, label=point.setting.name)
    axes.set(xlabel="predicted step", ylabel=AXES["task"][0])
    axes.legend(fontsize=7)
    return _png(figure)


def _png(figure) -> bytes:
    data = io.BytesIO()
    figure.savefig(data, format="png", dpi=110)
    pyplot().close(figure)
    return data.getvalue()


def _page(content: dict, pictures: dict[str, bytes]) -> str:
    """One page without scripts or anything from elsewhere."""
    e = html.escape
    rows = []
    for row in content["points"]:
        if "failure" in row:
            rows.append(f"<tr class=failed><td>{e(row['name'])}<td>{e(row['kind'])}<td colspan=8>{e(row['failure'])}")
            continue
        agreement, step = row["agreement"] or {}, row["step_ms"]
        cells = [e(row["name"]), e(row["kind"]), f"{step['median']:.2f}", f"{step['p95']:.2f}"]
        cells += [f"{row['encode_ms']['median']:.1f}", "tie" if row["tie_with_reference"] else f"{row['faster']:.2f}x"]
        cells += [_cell(agreement.get("psnr"), 1), _cell(agreement.get("position_max"), 3), _cell(row["gain_db"], 2)]
        cells += [_cell(row["task"].get("ssim"), 4)]
        mark = " class=front" if row["on_front"]["agreement"] else ""
        rows.append(f"<tr{mark}>" + "".join(f"<td>{cell}" for cell in cells))
    facts = "".join(f"<li>{e(str(k))}: {e(str(v))}" for k, v in {**content["machine"], **content["subject"]}.items())
    figures = "".join(
        f"<img alt='{name}' src='data:image/png;base64,{base64.b64encode(data).decode()}'>"
        for name, data in pictures.items()
    )
    kinds = "".join(f"<li><b>{e(kind)}</b>: {e(text)}" for kind, text in KINDS.items())
    missing = "".join(f"<li>{e(name)}: needs {e(needs)}" for name, needs in content["not_turned"].items())
    other = "".join(f"<li>{e(line)}" for line in _regimes(content["regimes"]))
    checks = "".join(f"<li>{e(line)}" for line in content.get("self_check", []))
    return f"""<!doctype html><html lang=en><meta charset=utf-8><title>gsim3d: accuracy against time</title><style>
body{{font:15px/1.5 sans-serif;max-width:1000px;margin:2em auto;padding:0 1em;color:#222}}
table{{border-collapse:collapse;font-size:13px}}td,th{{padding:2px 8px;text-align:right;border-bottom:1px solid #ddd}}
td:first-child,th:first-child,td:nth-child(2){{text-align:left}}.front td{{font-weight:bold}}.failed td{{color:#c00000}}
img{{max-width:100%}}code{{background:#f3f3f3;padding:2px 4px}}</style>
<h1>What accuracy costs in time</h1><p>Made by <code>{e(content["command"])}</code></p><ul>{facts}</ul>
{figures}
<h2>Settings</h2><p>Bold: no other is both faster and nearer to the reference. Time of one simulated step and its images,
median and 95th percentile of {content["points"][0].get("step_ms", {}).get("repeats", 0)} repeats; position error of what
may move, largest, in cells; gain over particles held still. A tie is nearer to the reference's time than two measurements
of one thing; stages of a step add up to it within {ADDS_UP:.0%}, or the table of the report says by how much they do not.</p>
<table><tr><th>setting<th>kind<th>step ms<th>p95<th>encode ms<th>faster<th>agreement dB<th>position<th>gain dB<th>SSIM
{"".join(rows)}</table><ul>{kinds}</ul>
<h2>Many scenes, and training</h2><ul>{other}</ul><h2>Not turned</h2><ul>{missing}</ul>{f"<h2>Self-check</h2><ul>{checks}</ul>" if checks else ""}</html>
"""


def _cell(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"


def table(content: dict) -> str:
    """The report for a terminal."""
    width = max(len(row["name"]) for row in content["points"]) + 2
    lines = [f"{'setting':{width}}{'step ms':>10}{'p95':>10}{'faster':>9}{'agreement dB':>14}{'gain dB':>9}"]
    for row in content["points"]:
        if "failure" in row:
            lines.append(f"{row['name']:{width}}failed: {row['failure']}")
            continue
        step, agreement = row["step_ms"], row["agreement"] or {}
        faster = "tie" if row["tie_with_reference"] else f"{row['faster']:.2f}x"
        star = "*" if row["on_front"]["agreement"] else ""
        lines.append(
            f"{row['name']:{width}}{step['median']:10.2f}{step['p95']:10.2f}{faster:>9}"
            f"{_cell(agreement.get('psnr'), 1):>14}{_cell(row['gain_db'], 2):>9} {star}"
        )
    return "\n".join(
        [*lines, "* no other is both faster and nearer to the reference", "", *_regimes(content["regimes"])]
    )
