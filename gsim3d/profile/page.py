"""The report as one page without scripts or anything from elsewhere."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from html import escape

from gsim3d.evaluate.scoring import METRICS
from gsim3d.profile import published
from gsim3d.profile.timing import ADDS_UP

CAPTIONS = {
    "cost.png": "What accuracy costs: further left is faster, further down is less lost. Stars are the presets of "
    "<code>--speed</code>; dashed lines are what they promise.",
    "agreement.png": "How far each setting is from the reference run of the same checkpoint.",
    "task.png": "How far each setting is from the film.",
    "stages.png": "Where the time of a step goes.",
    "horizon.png": "How the error grows with the horizon.",
    "training.png": "What training time bought, from the log of the training, on its own scenes.",
}
STYLE = """body{font:15px/1.5 sans-serif;max-width:1080px;margin:2em auto;padding:0 1em;color:#222}
table{border-collapse:collapse;font-size:13px;margin:.5em 0}
td,th{padding:2px 8px;text-align:right;border-bottom:1px solid #ddd}
.left td,.left th,td:nth-child(2),th:nth-child(2),td:nth-child(3),th:nth-child(3){text-align:left}
.front td{font-weight:bold}.failed td{color:#c00000}figure{margin:1.5em 0}figcaption{font-size:13px;color:#555}
img{max-width:100%}code{background:#f3f3f3;padding:2px 4px;white-space:pre-wrap}"""


def page(content: dict, pictures: dict[str, bytes], regimes: Sequence[str]) -> str:
    """Args: content: of report.json.   pictures: PNG files by name.   regimes: lines about the other ways to use it."""
    shown = {
        name: f"<figure><img alt='{name}' src='data:image/png;base64,{base64.b64encode(data).decode()}'>"
        f"<figcaption>{CAPTIONS[name]}</figcaption></figure>"
        for name, data in pictures.items()
    }
    subject = {name: value for name, value in content["subject"].items() if name != "steps_a_call"}
    facts = {**content["machine"], **subject}
    parts = [
        f"<h1>What accuracy costs in time</h1><p>Made by <code>{escape(content['command'])}</code></p>",
        _promises(content),
        shown["cost.png"],
        "<h2>Settings</h2>",
        _settings(content),
        *(shown[name] for name in ("agreement.png", "task.png", "stages.png")),
        "<h2>Horizon</h2>",
        _horizons(content),
        shown["horizon.png"],
        f"<h2>Many scenes, and training</h2>{_list(regimes)}",
        _hours(content["training"]),
        shown.get("training.png", ""),
        "<h2>Not turned</h2>" + _list(f"{name}: needs {why}" for name, why in content["not_turned"].items()),
        _not_measured(content["not_measured"]),
        "<h2>Self-check</h2>" + _list(content["self_check"]) if content["self_check"] else "",
        _published(content),
        "<h2>Measured on</h2>" + _list(f"{name.replace('_', ' ')}: {value}" for name, value in facts.items()),
    ]
    head = f"<meta charset=utf-8><title>gsim3d: accuracy against time</title><style>{STYLE}</style>"
    return f"<!doctype html><html lang=en>{head}\n" + "\n".join(part for part in parts if part) + "\n</html>\n"


def _list(lines) -> str:
    return "<ul>" + "".join(f"<li>{escape(str(line))}" for line in lines) + "</ul>"


def _cell(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"


def share_in_words(value: float | None) -> str:
    """Of the gain: where the reference hardly gains anything, shares of it say nothing."""
    if value is None:
        return "-"
    return f"{value:.2%}" if 0 <= value <= 2 else "below 0" if value < 0 else "above 200%"


def _promises(content: dict) -> str:
    """What the presets are, in a sentence each."""
    rows, lines = content["points"], []
    for name, preset in content["presets"].items():
        row = rows[preset["number"]]
        text = f"<b>{escape(name)}</b>: {escape(row['name'])}, {row['step_ms']['median']:.3g} ms a step"
        if preset["setting"]:
            text += f", {preset['faster']:.2f} times as fast, keeps {share_in_words(preset['kept'])} of the gain"
        lines.append(f"<li>{text}")
    gain = rows[0]["gain_db"]
    note = ""
    if gain is not None and gain <= 0:
        note = "<p>This checkpoint gains nothing over particles that hold still: shares below are of its loss.</p>"
    return f"<ul>{''.join(lines)}</ul>{note}"


def _settings(content: dict) -> str:
    rows = []
    extra = [name for name in ("lpips_alex", "lpips_vgg", "fvd") if name in content["points"][0].get("task", {})]
    for row in content["points"]:
        start = f"<td>{row['number']}<td>{escape(row['name'])}<td>{escape(row['kind'])}"
        if "failure" in row:
            rows.append(f"<tr class=failed>{start}<td colspan={11 + len(extra)}>{escape(row['failure'])}")
            continue
        agreement, step, task = row["agreement"] or {}, row["step_ms"], row["task"]
        cells = [f"{step['median']:.2f}", f"{step['p95']:.2f}", f"{row['encode_ms']['median']:.1f}"]
        cells += [f"{row['once_ms']:.0f}", "tie" if row["tie_with_reference"] else f"{row['faster']:.2f}x"]
        cells += [_cell(agreement.get("psnr"), 1), _cell(agreement.get("position_max"), 3), share_in_words(row["kept"])]
        cells += [_cell(task.get("psnr_masked"), 2), _cell(task.get("psnr"), 2), _cell(task.get("ssim"), 4)]
        cells += [_cell(task.get(name), METRICS[name].digits) for name in extra]
        mark = " class=front" if row["on_front"]["agreement"] else ""
        rows.append(f"<tr{mark}>{start}" + "".join(f"<td>{cell}" for cell in cells))
    heads = [
        "#",
        "setting",
        "kind",
        "step ms",
        "p95",
        "encode ms",
        "once ms",
        "faster",
        "agreement dB",
        "position",
        "kept",
    ]
    heads += ["masked dB", "PSNR dB", "SSIM", *(METRICS[name].label for name in extra)]
    first = content["points"][0].get("step_ms", {})
    return (
        f"<table><tr>{''.join(f'<th>{head}' for head in heads)}{''.join(rows)}</table><p>Bold: no other is both faster "
        f"and nearer to the reference. Time of one simulated step and its images, median and 95th percentile of "
        f"{first.get('repeats', 0)} repeats, fewer where steps are timed together; <i>agreement</i> and "
        "<i>position</i> (of what may move, the largest, in cells) are against the reference, the columns behind "
        "<i>kept</i> against the film; <i>kept</i>: share of the reference's gain over particles held still, in dB. "
        "A tie is nearer to the "
        "reference's time than two measurements of one thing. Stages of a step add up to it within "
        f"{ADDS_UP:.0%}, or report.json says by how much they do not.</p>"
        + _list(f"{kind}: {text}" for kind, text in content["kinds"].items())
    )


def _horizons(content: dict) -> str:
    rows = content["horizons"]
    names = [name for name in rows[0] if name not in ("steps", "constant_psnr")]
    head = "".join(f"<th>{escape(name)} dB<th>ms" for name in names)
    body = ""
    for row in rows:
        cells = "".join(f"<td>{_cell(row[name]['psnr'], 2)}<td>{row[name]['ms']:.0f}" for name in names)
        body += f"<tr><td>{row['steps']}<td>{_cell(row['constant_psnr'], 2)}{cells}"
    return (
        f"<table><tr><th>steps<th>held still dB{head}{body}</table><p>PSNR of the last of so many steps, without "
        "background where it is known, and the time of all of them, encoding and what is paid once included.</p>"
    )


def _hours(training: dict | None) -> str:
    if training is None:
        return ""
    reached = [
        f"{share} of the last PSNR after {hours:.3g} h" for share, hours in training["hours_to"].items() if hours
    ]
    spent = f"{training['steps'][-1]:,} steps in {training['hours'][-1]:.3g} h"
    return f"<p>Training: {'; '.join([spent, *reached])}.</p>"


def _not_measured(missing: dict) -> str:
    return "<h2>Not measured</h2>" + _list(f"{name}: {why}" for name, why in missing.items()) if missing else ""


def _published(content: dict) -> str:
    rows = ""
    for row in content["published"]:
        ours = f"{row['ours']:.4g}" if row["ours"] is not None else "-"
        how = escape(row["how"]) if row["ours"] is None else ""
        rows += f"<tr><td>{escape(row['what'])}<td>{escape(row['setting'])}<td>{row['published']}<td>{ours}"
        rows += f"<td>{escape(row['unit'])}<td>{how}"
    return (
        "<h2>Where the authors' numbers stand</h2><p>Theirs are masked PSNR of their own data after up to 120,000 "
        "optimizer steps, each row trained anew but for the history; ours are of this checkpoint and these scenes. "
        "Compare differences, not values. A modality is history, steps of it advanced at once, steps a call, calls.</p>"
        "<table class=left><tr><th>what<th>setting<th>published<th>here<th>unit<th>how to get it here"
        f"{rows}</table><p>What is inconsistent in print:</p>{_list(published.INCONSISTENT)}"
    )
