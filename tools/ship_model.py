#!/usr/bin/env python
"""Puts a trained simulator into the package, with its model card, and writes the page of all of them.

    python tools/release/train.py elastic --minutes 22 --state runs/elastic --out runs/elastic
    python tools/score_shipped.py elastic-small --checkpoint runs/elastic/elastic-pure.weights.safetensors \
        --data runs/held_out --out runs/scores
    python tools/ship_model.py elastic-small --state runs/elastic --scores runs/scores --wrong runs/wrong.md
    python tools/ship_model.py                        # writes docs/trained.md and its pictures anew

WRONG says what is wrong with the model's films, in one's own words, for the card; once shipped it is kept.
"""

import argparse
import dataclasses
import json
import math
import shutil
import sys
from pathlib import Path

import yaml

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))
from gsim3d import pretrained  # noqa: E402
from gsim3d.errors import InputError  # noqa: E402
from gsim3d.evaluate.pictures import write_curves  # noqa: E402
from gsim3d.evaluate.report import markdown  # noqa: E402
from gsim3d.profile.autotune import SPEEDS  # noqa: E402
from gsim3d.synth.worlds import VALIDATION_SEED  # noqa: E402
from gsim3d.train import checkpoint  # noqa: E402
from tools.release.recipes import Recipe, recipe  # noqa: E402
from tools.release.state import CURVE, load_progress, weights_file  # noqa: E402

PAGE = ROOT / "docs" / "trained.md"
LOGGED = 400  # lines that are kept of a log
CURVES = ("psnr_masked", "psnr", "ssim")
SETS = {
    "held_out": "as in training, another seed",
    "unseen": "unseen shapes",
    "several": "several bodies",
    "no-ground": "no ground",
    "raised": "raised ground",
}
LAWS_HEAD = "## Laws that it breaks\n\n"
WRONG_HEAD = "## What is wrong with it\n\n"
INTRO = """# Trained simulators

Written by `python tools/ship_model.py`; do not edit. Their names stand wherever a CHECKPOINT is expected:

```bash
gsim3d generate elastic --preset diverse --trajectories 7 --out runs/films
gsim3d simulate elastic-small runs/films/ball/0000 --out runs/ball
gsim3d evaluate elastic-small runs/films --scenes all
```

Scores are of trajectories that no training saw, from four cameras, {history} steps given, all later ones predicted, as
[evaluation.md](evaluation.md) defines them; `tools/score_shipped.py` measures them. How they were trained:
[training.md](training.md#the-simulators-that-come-with-gsim3d).
"""


def ship(name: str, made: Recipe, state: Path, scores: Path, wrong: str) -> Path:
    """Makes the folder of the simulator in the package, from the state of a run of the recipe ``made``."""
    progress = load_progress(state, made.name)
    measured = json.loads((scores / f"{name}.scores.json").read_text())
    weights = weights_file(state, made.name)
    saved = checkpoint.load(weights)
    if measured["checkpoint"] != saved.digest:
        raise InputError(f"{scores / name}.scores.json: of other weights than those in {state}")
    folder = pretrained.FOLDER / name
    folder.mkdir(exist_ok=True)
    shutil.copyfile(weights, folder / pretrained.WEIGHTS)
    speeds = folder / SPEEDS
    if speeds.is_file() and saved.digest not in json.loads(speeds.read_text()):
        speeds.unlink()  # of the weights before
    (folder / pretrained.LAWS).unlink(missing_ok=True)  # of old weights; measured by gsim3d doctor --stability --full
    (folder / "config.yaml").write_text(yaml.safe_dump(saved.config, sort_keys=False))
    kept = progress.curve[:: max(1, -(-len(progress.curve) // LOGGED))]
    (folder / "training.jsonl").write_text("".join(json.dumps(logged(row)) + "\n" for row in kept))
    (folder / "scores.json").write_text(json.dumps(measured) + "\n")
    world = dataclasses.replace(made.stream(), seed=progress.runs[-1]["seed"])
    described = {
        "steps": progress.step,
        "training_seconds": progress.seconds,
        "skipped_steps": progress.n_skipped,
        "windows": progress.windows,
        "runs": progress.runs,
        "trajectories_begun": progress.next_trajectory,
        "world": {"world": made.world, "preset": made.preset, **dataclasses.asdict(world)},
        "held_out_seed": VALIDATION_SEED,
    }
    (folder / "recipe.json").write_text(json.dumps(described, indent=1) + "\n")
    (folder / "README.md").write_text(card(name, described, measured, saved.config, wrong))
    if (picture := scores / f"{name}.frames.png").is_file():
        shutil.copyfile(picture, PAGE.parent / f"trained-{name}-frames.png")
    return folder


def logged(row: list[float]) -> dict:
    """A line of training.jsonl: one logged step, as ``gsim3d train`` logs it."""
    known = {column: value for column, value in zip(CURVE, row, strict=True) if math.isfinite(value)}
    return {**known, "step": int(known["step"]), "machine": {"seconds": known.pop("seconds")}}


def card(name: str, recipe: dict, scores: dict, config: dict, wrong: str) -> str:
    """The model card."""
    data, devices = config["data"], sorted({run["device"] for run in recipe["runs"]})
    used = sum(run["trajectories"] for run in recipe["runs"])
    changes = [json.dumps(options) for run in recipe["runs"] for options in run.get("in_turn", ()) if options]
    changed = f" (some with {', '.join(dict.fromkeys(changes))})" if changes else ""
    world, begun = recipe["world"], recipe["runs"][0].get("began_with")
    n_runs = len(recipe["runs"])
    before = f"; begun with the weights of `{begun['name']}` at step {begun['step']:,}" if begun else ""
    put = "".join(f"; then without training: {run['then']}" for run in recipe["runs"] if "then" in run)
    return f"""# {name}

A gsim3d simulator of the world `{world["world"]}`: `gsim3d simulate {name} SCENE --out DIR`. Apache-2.0.

- **Sees** {data["history"]} steps from {data["context_views"]} calibrated cameras at {world["image_size"]} pixels with
  masks, {world["fps"]:g} steps a second; predicts particles, drawn as 3D Gaussians from any view.
- **Trained on** {used:,} trajectories of {world["n_frames"]} steps and {world["n_cams"]} cameras, made by
  `gsim3d generate {world["world"]} --preset {world["preset"]} --seed {world["seed"]}`{changed}, never the same twice;
  from images alone.
- **Budget** {recipe["steps"]:,} optimizer steps in {recipe["training_seconds"]:,.0f} s of training,
  {n_runs} run{"s" if n_runs > 1 else ""}, on {" and ".join(devices)}; {recipe["skipped_steps"]} steps were
  skipped{before}{put}.
- **Weights** averaged, bfloat16. `config.yaml` has all settings, `training.jsonl` a part of the log, `recipe.json` the
  data.

## Scores

{score_table(scores)}

PSNR in dB, masked: without background. {sum(scores[s]["n_scenes"] for s in SETS if s in scores)} trajectories with seed
{recipe["held_out_seed"]}; all numbers: `scores.json`.

{WRONG_HEAD}{wrong.strip()}
"""


def score_table(scores: dict) -> str:
    """A row for each set: the model beside its baselines."""
    lines = [
        "| trajectories | steps | masked PSNR | constant | copy | constant velocity | PSNR | SSIM |",
        "| --- | ---: | ---: | ---: | ---: | ---: | ---: | ---: |",
    ]
    for subset, what in SETS.items():
        if subset in scores:
            s = scores[subset]
            masked = [s[f"{method}future.psnr_masked"] for method in ("", "constant.", "copy.", "constant_velocity.")]
            numbers = " | ".join(f"{value:.2f}" for value in (*masked, s["future.psnr"]))
            lines.append(f"| {what} ({s['n_scenes']}) | {s['n_future_steps']} | {numbers} | {s['future.ssim']:.3f} |")
    return "\n".join(lines)


def with_laws(card: str, name: str) -> str:
    """The model card with a table of laws.json, where the model breaks laws."""
    head, wrong = card.split(WRONG_HEAD)
    head = head.split(LAWS_HEAD)[0].rstrip()
    laws = pretrained.broken_laws(pretrained.FOLDER / name / pretrained.WEIGHTS)
    if not laws:
        return f"{head}\n\n{WRONG_HEAD}{wrong}"
    rows = "\n".join(
        f"| {law} | {found['what']} | {found['error']:.3g} | {found['bound'] or 'equal bits'} |"
        for law, found in laws.items()
    )
    command = f"gsim3d doctor --stability {name} DATA"
    said = f"Largest errors that `{command}`, sampled and with `--full`, found on two scenes:"
    table = f"| law | number | error | allowed |\n| --- | --- | ---: | ---: |\n{rows}"
    return f"{head}\n\n{LAWS_HEAD}{said}\n\n{table}\n\n{WRONG_HEAD}{wrong}"


def write_page() -> None:
    """docs/trained.md of all simulators in the package, and their curves."""
    history = {checkpoint.load(name).config["data"]["history"] for name in pretrained.names()}
    parts = [INTRO.format(history=" or ".join(map(str, sorted(history))))]
    for name in pretrained.names():
        folder = pretrained.FOLDER / name
        scores, recipe = (json.loads((folder / f"{part}.json").read_text()) for part in ("scores", "recipe"))
        curves = PAGE.parent / f"trained-{name}.png"
        write_curves(curves, scores["held_out"], recipe["world"]["fps"], CURVES)
        text = with_laws((folder / "README.md").read_text(), name)
        (folder / "README.md").write_text(text)
        _, body = text.split("\n", 1)
        parts.append(f"## {name}\n{body.replace(chr(10) + '## ', chr(10) + '### ')}")
        parts.append(f"![Scores by step]({curves.name})\n")
        if (picture := PAGE.parent / f"trained-{name}-frames.png").is_file():
            sets = ", ".join(what for subset, what in SETS.items() if subset in scores)
            parts.append(f"![Truth above prediction]({picture.name})\n\nTruth above prediction, from top: {sets}.\n")
        parts.append("All methods over the full horizon:\n\n" + markdown(scores["held_out"], recipe["world"]["world"]))
    PAGE.write_text("\n".join(parts))


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("name", nargs="?", help="such as elastic-small (left out: only the page is written)")
    parser.add_argument("--arm", default="pure", help="of the recipe (default: pure)")
    parser.add_argument("--state", type=Path, help="what tools/release/train.py wrote")
    parser.add_argument("--scores", type=Path, help="what score_shipped wrote")
    parser.add_argument("--wrong", type=Path, help="text of what is wrong (default: that of the card that is there)")
    args = parser.parse_args(arguments)
    if args.name:
        known = pretrained.FOLDER / args.name / "README.md"
        if args.wrong is None and not known.is_file():
            raise InputError("--wrong is needed: look at the films, and say what is wrong")
        wrong = args.wrong.read_text() if args.wrong else known.read_text().split(WRONG_HEAD)[1]
        print(f"written: {ship(args.name, recipe(args.name.split('-')[0], args.arm), args.state, args.scores, wrong)}")
    write_page()
    print(f"written: {PAGE}")


if __name__ == "__main__":
    try:
        main()
    except InputError as error:
        sys.exit(f"ship_model: error: {error}")
