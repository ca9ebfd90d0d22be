"""Pages made from the code and from stored numbers, written to docs/_generated when the documentation is built."""

import argparse
import dataclasses
import importlib
import importlib.util
import inspect
import json
import re
from pathlib import Path
from statistics import mean, stdev

DOCS = Path(__file__).parent
ROOT, RESULTS = DOCS.parent, DOCS / "results"
CAPTURES_HEAD = ("videos", "encoder", "machine", "minutes", "steps", "windows")
CAPTURES_HEAD += ("masked PSNR dB", "constant dB", "copy dB", "above constant", "above copy", "above plane sweep")
CAPTURE_METHODS = "model", "constant", "copy"
COST_HEAD = ("#", "setting", "kind", "step ms", "p95", "encode ms", "faster", "agreement dB", "masked PSNR dB", "kept")


def write_pages(folder: Path) -> None:
    """Writes every page that changed."""
    folder.mkdir(exist_ok=True)
    pages = {
        "commands": commands(),
        "configuration": configuration(),
        "benchmarks": benchmarks(),
        "effects_cost": effects_cost(),
        "resting": resting(),
        "training_steps": training_steps(),
        "stability": stability(),
        "settings": settings(),
        "trust": trust(),
        "captures": captures(RESULTS / "captures"),
        "notebook": notebook(ROOT / "examples" / "predict_look_edit_score.ipynb"),
        **{f"model_{name}": model(name) for name in model_names()},
        **{f"cost_{name}": cost(name) for name in model_names()},
    }
    for name, text in pages.items():
        file = folder / f"{name}.md"
        if not file.is_file() or file.read_text() != text:
            file.write_text(text)


def table(head: tuple[str, ...], rows) -> str:
    """A markdown table."""
    lines = [head, ("---",) * len(head), *rows]
    return "\n".join("| " + " | ".join(str(cell).replace("|", "\\|") for cell in line) + " |" for line in lines) + "\n"


# -------------------------------------------------------------------------------------------------- from the code


def commands() -> str:
    """The help of every command."""
    from gsim3d.cli.main import COMMANDS, command

    parts = []
    for name, (_, summary) in COMMANDS.items():
        _, parser = command(name)
        parser.formatter_class = lambda prog: argparse.RawDescriptionHelpFormatter(prog, width=100)
        parts.append(
            f"## {name}\n\n{summary[0].upper()}{summary[1:]}.\n\n```text\n{parser.format_help().strip()}\n```\n"
        )
    return "\n".join(parts)


def configuration() -> str:
    """Every setting of a training run and of a model, from the dataclasses."""
    from gsim3d.nn.graph_network import GraphConfig
    from gsim3d.presets import ModelConfig
    from gsim3d.train.config import TrainConfig

    sections: dict[type, str] = {}
    _collect(TrainConfig, "", sections)
    _collect(ModelConfig, "model", sections)
    _collect(GraphConfig, "model.dynamics.graph", sections)
    return "\n".join(_section(kind, path) for kind, path in sections.items())


def _collect(kind: type, path: str, sections: dict[type, str]) -> None:
    """``kind`` and the dataclasses in its fields, with the key under which they stand."""
    if kind in sections:
        return
    sections[kind] = path
    for field in dataclasses.fields(kind):
        default = _default(field)
        values = default if isinstance(default, tuple) else (default,)
        for value in values[:1]:
            if dataclasses.is_dataclass(value):
                _collect(type(value), f"{path}.{field.name}".lstrip("."), sections)


def _default(field: dataclasses.Field):
    return field.default if field.default_factory is dataclasses.MISSING else field.default_factory()


def _section(kind: type, path: str) -> str:
    known = attributes(kind)
    rows = []
    for field in dataclasses.fields(kind):
        value = _default(field)
        nested = value[:1] if isinstance(value, tuple) else (value,)
        shown = "" if value is dataclasses.MISSING or any(map(dataclasses.is_dataclass, nested)) else f"`{value!r}`"
        rows.append((f"`{field.name}`", shown, known.get(field.name, "")))
    summary = inspect.getdoc(kind).split("\n\n")[0].replace("\n", " ")
    title = f"`{path}`" if path else "Top level"
    return f"## {title}\n\n{_markdown(summary)}\n\n{table(('setting', 'default', 'meaning'), rows)}"


def attributes(kind: type) -> dict[str, str]:
    """Field name -> text, from the section "Attributes" of the docstring of a dataclass, and "#:" at its fields."""
    lines = inspect.getdoc(kind).split("\nAttributes:\n")[-1].splitlines()
    found, names = {}, ()
    for line in lines:
        if entry := re.match(r" {0,4}((?:\w+)(?:, \w+)*): (.*)", line):
            names = entry[1].split(", ")
            found.update(dict.fromkeys(names, entry[2]))
        elif names and line.strip():
            found.update({name: f"{found[name]} {line.strip()}" for name in names})
    above: list[str] = []
    for line in inspect.getsource(kind).splitlines():
        if entry := re.match(r" {4}(\w+): [^#]*(?:#: (.*))?$", line):
            found |= {entry[1]: text} if (text := entry[2] or " ".join(above)) else {}
        above = [*above, line.strip()[3:]] if line.strip().startswith("#: ") else []
    return {name: _markdown(text) for name, text in found.items()}


def _markdown(text: str) -> str:
    """reStructuredText roles and literals as markdown."""
    return re.sub(r":\w+:`~?([^`]+)`", r"`\1`", text).replace("``", "`")


def settings() -> str:
    """What ``gsim3d profile`` varies."""
    from gsim3d.profile.settings import GROUPS

    return table(("settings", "kind", "needs"), ((group.name, group.kind, group.needs or "-") for group in GROUPS))


def notebook(file: Path) -> str:
    """The cells of an executed notebook, with their pictures."""
    parts = []
    for cell in json.loads(file.read_text())["cells"]:
        source = "".join(cell["source"])
        parts.append(source if cell["cell_type"] == "markdown" else f"```python\n{source}\n```")
        for output in cell.get("outputs", ()):
            data = output.get("data", {})
            if "image/jpeg" in data:
                parts.append(f"![picture](data:image/jpeg;base64,{''.join(data['image/jpeg']).strip()})")
            else:
                parts.append("```text\n" + "".join(data.get("text/plain", output.get("text", ""))) + "\n```")
    return "\n\n".join(parts) + "\n"


# ---------------------------------------------------------------------------------------------- from stored numbers


def _tool(name: str):
    spec = importlib.util.spec_from_file_location(f"docs_{name}", ROOT / "tools" / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def _report():
    return importlib.import_module("report")  # of tools/bench


def _records() -> dict:
    return json.loads((RESULTS / "benchmarks.json").read_text())


def benchmarks() -> str:
    """Every op against its peers."""
    return _report().page(_records())


def effects_cost() -> str:
    """What each effect costs."""
    return _report().effects(_records()["effects"])


def resting() -> str:
    """What particles at rest save."""
    report = _report()
    return report.rest(report.rows_of(report.SLEEPING))


def training_steps() -> str:
    """Time and memory of a training step."""
    report = _report()
    return report.steps_table(json.loads(report.STEPS.read_text()))


def stability() -> str:
    """Every hard case, constant and guard."""
    return _tool("stability").page(json.loads((RESULTS / "stability.json").read_text()))


def captures(folder: Path) -> str:
    """Scores of the videos of generated scenes, of the runs of tools/capture_videos.sh."""
    found = {tuple(file.stem.split("-")): json.loads(file.read_text()) for file in sorted(folder.glob("*-*.json"))}
    if not found:
        return "Not measured yet.\n"
    windows = {run: scores["of_windows"] for run, scores in found.items()}
    for encoder in sorted({encoder for _, encoder in windows}):
        runs = [own for (_, other), own in windows.items() if other == encoder]
        windows["all", encoder] = {method: sum((run[method] for run in runs), []) for method in CAPTURE_METHODS}

    def apart(a: list[float], b: list[float]) -> str:
        differences = [x - y for x, y in zip(a, b, strict=True)]
        error = f" ± {stdev(differences) / len(a) ** 0.5:.2f}" if len(a) > 1 else ""
        return f"{mean(differences):+.2f}{error}"

    rows = []
    for (clips, encoder), own in windows.items():
        run, sweep = found.get((clips, encoder), {}), windows.get((clips, "plane_sweep"))
        is_paired = encoder != "plane_sweep" and sweep and sweep["copy"] == own["copy"]  # of the same windows
        rows.append(
            (clips.replace("_", " "), encoder, *(run.get(key, "") for key in ("device", "minutes", "steps")))
            + (len(own["model"]), *(f"{mean(own[method]):.2f}" for method in CAPTURE_METHODS))
            + tuple(apart(own["model"], own[method]) for method in CAPTURE_METHODS[1:])
            + (apart(own["model"], sweep["model"]) if is_paired else "",)
        )
    return table(CAPTURES_HEAD, rows)


def trust() -> str:
    """How well calibrated bounds hold, and which changed inputs are announced."""
    results = json.loads((RESULTS / "elastic-small.trust.json").read_text())
    head = ("set", "scenes", "particles and steps", "mean error m", "area m", "step alone m", "perfect m", "difference")
    rows = []
    for name, found in results["sets"].items():
        for key, label in (("risk_coverage", "all steps"), ("within_steps", "within steps")):
            areas = [found[key][by] for by in ("trust", "step", "perfect")]
            counts = found["n_scenes"], f"{found['n_samples']:,}", f"{found['mean_error']:.4f}"
            numbers, error = [f"{area:.4f}" for area in areas], found.get("ratio_error", {}).get(key)
            difference = f"{areas[0] / areas[1] - 1:+.1%}" + ("" if error is None else f" ± {error:.1%}")
            rows.append((f"{name}, {label}", *counts, *numbers, difference))
    areas = table(head, rows)
    levels = list(results["sets"]["validation"]["reliability"])
    rows = [(name, *(f"{s:.0%}" for s in found["reliability"].values())) for name, found in results["sets"].items()]
    shares = table(("level of the bound", *(f"{float(level):.0%}" for level in levels)), rows)
    rows = [
        (name, found["scenes"], found["announced"], ", ".join(f"{m} ({n})" for m, n in found["measures"].items()))
        for name, found in results["detection"].items()
    ]
    detected = table(("inputs", "number", "announced", "measures out of range (inputs)"), rows)
    totals: dict[str, list[int]] = {}
    for name, found in results["detection"].items():
        kind = totals.setdefault(name if name in results["sets"] else name.partition(",")[0], [0, 0])
        kind[:] = kind[0] + found["announced"], kind[1] + found["scenes"]
    rows = [
        (kind, f"{n} of {of}", f"{n / of:.0%}", "{:.0%} to {:.0%}".format(*wilson(n, of)))
        for kind, (n, of) in totals.items()
    ]
    kinds = table(("inputs", "announced", "share", "95 % interval"), rows)
    titles = "## Risk and coverage", "## Reliability", "## Unfamiliar inputs", "## Unfamiliar inputs by kind"
    parts = areas, shares, detected, kinds
    return "\n".join(f"{title}\n\n{text}" for title, text in zip(titles, parts, strict=True))


def wilson(count: int, total: int) -> tuple[float, float]:
    """Interval of a share that is known from ``count`` of ``total``, at 95 % (Wilson)."""
    square = 1.96**2 / total
    middle, half = count / total + square / 2, (square * (count / total * (1 - count / total) + square / 4)) ** 0.5
    return max(0.0, (middle - half) / (1 + square)), min(1.0, (middle + half) / (1 + square))


def model_names() -> list[str]:
    """The shipped simulators."""
    from gsim3d import pretrained

    return pretrained.names()


def model(name: str) -> str:
    """The model card, the scores of all methods, the curves, and the edits that docs/make_edits.py measured."""
    from gsim3d import pretrained
    from gsim3d.evaluate.report import markdown

    folder = pretrained.FOLDER / name
    scores, recipe = (json.loads((folder / f"{part}.json").read_text()) for part in ("scores", "recipe"))
    card = (folder / "README.md").read_text()
    parts = [card, "## Scores of all methods\n", markdown(scores["held_out"], recipe["world"]["world"])]
    place = RESULTS / "models"
    for picture, text in ((f"{name}.png", "Scores by step"), (f"{name}-frames.png", "Truth above prediction")):
        if (place / picture).is_file():
            parts.append(f"![{text}]({picture})\n")
    if history := recipe.get("scores"):
        rows = [
            [f"{e['windows']:,}", *(f"{e[s]:.2f}" for s in ("past", "future", "body", "constant"))] for e in history
        ]
        parts += ["## Scores on the way\n", table(("windows", "given steps", "future", "bodies", "constant"), rows)]
        parts.append(f"Validation trajectories, masked PSNR in dB.\n\n![Scores against windows]({name}-windows.png)\n")
    if (edits := place / f"{name}.edits.json").is_file():
        content = json.loads(edits.read_text())
        old = "" if content["checkpoint"] == scores["checkpoint"] else "Measured with earlier weights.\n\n"
        parts.append(
            f"## Edits of encoded particles\n\n{old}{content['table']}\n\nMade by `python docs/make_edits.py`.\n"
        )
        parts += [f"![{picture.stem}]({picture.name})\n" for picture in sorted(place.glob(f"{name}-edits-*.png"))]
    return "\n".join(parts)


def cost(name: str) -> str:
    """The reports of accuracy against time of a shipped simulator."""
    from gsim3d import pretrained

    digest = json.loads((pretrained.FOLDER / name / "scores.json").read_text())["checkpoint"]
    parts = []
    for file in sorted((RESULTS / "cost").glob(f"{name}-*.json")):
        content = json.loads(file.read_text())
        old = "" if content["checkpoint"] == digest else "Measured with earlier weights of this simulator.\n\n"
        facts = f"`{content['command']}`; {content['measured_on']}."
        lines = "".join(f"- {line}\n" for line in content["throughput"])
        shown = [f"![{part}]({file.stem}-{part}.png)" for part in ("cost", "stages", "horizon")]
        parts.append(
            f"## {content['device']}\n\n{old}{shown[0]}\n\n{table(COST_HEAD, content['rows'])}\n{lines}\n{facts}\n\n"
            + "\n\n".join(shown[1:])
        )
    return "\n\n".join(parts) + "\n"
