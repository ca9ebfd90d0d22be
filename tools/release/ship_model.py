#!/usr/bin/env python
"""Puts a trained simulator into the package, with its model card.

    python tools/release/train.py elastic --minutes 22 --state runs/elastic --out runs/elastic
    python tools/release/score.py elastic-small --checkpoint runs/elastic/elastic-velocity.weights.safetensors \
        --data runs/held_out --out runs/scores
    python tools/release/ship_model.py elastic-small --state runs/elastic --scores runs/scores --limitations LIST.md
    gsim3d doctor --stability elastic-small DATA --out runs/laws
    gsim3d doctor --stability elastic-small DATA --full --out runs/laws-full
    python tools/release/ship_model.py elastic-small --laws runs/laws runs/laws-full
    python tools/release/ship_model.py      # updates the invariances in all cards, and the curves in docs/results

LIST.md has 3 to 5 points, seen in the predicted videos; later calls keep the list of the card.
"""

import argparse
import dataclasses
import json
import math
import shutil
import sys
from pathlib import Path

import yaml

ROOT = Path(__file__).resolve().parent.parent.parent
sys.path.insert(0, str(ROOT))
import gsim3d  # noqa: E402
from gsim3d import pretrained  # noqa: E402
from gsim3d.errors import InputError  # noqa: E402
from gsim3d.evaluate.pictures import pyplot, save_figure, write_curves  # noqa: E402
from gsim3d.io import checkpoint  # noqa: E402
from gsim3d.numerics.speed import SPEEDS_FILE  # noqa: E402
from gsim3d.numerics.trust import TRUST_FILE  # noqa: E402
from gsim3d.synth.worlds import VALIDATION_SEED  # noqa: E402
from gsim3d.testing.invariances import INVARIANCES  # noqa: E402
from gsim3d.train.restore import model_config  # noqa: E402
from tools.release.curve import SCORES  # noqa: E402
from tools.release.recipes import Recipe, recipe  # noqa: E402
from tools.release.state import CURVE, load_progress, weights_file  # noqa: E402

PICTURES = ROOT / "docs" / "results" / "models"
LOGGED = 400  # lines that are kept of a log
CURVES = ("psnr_masked", "psnr", "ssim")
SETS = {
    "held_out": "as in training, another seed",
    "unseen": "unseen shapes",
    "several": "several bodies",
    "no-ground": "no ground",
    "raised": "raised ground",
}
VIOLATED, LIMITATIONS = "### Invariances that it violates\n\n", "## Limitations\n\n"
LICENCE = "\n\n## Licence and version\n"


def ship(name: str, made: Recipe, state: Path, scores: Path, limitations: str) -> Path:
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
    for file in (folder / SPEEDS_FILE, folder / TRUST_FILE):
        if file.is_file() and saved.digest not in json.loads(file.read_text()):
            file.unlink()  # of the weights before
    (folder / pretrained.LAWS).unlink(missing_ok=True)  # of old weights; measured by gsim3d doctor --stability --full
    (folder / "config.yaml").write_text(yaml.safe_dump(saved.config, sort_keys=False))
    kept = progress.curve[:: max(1, -(-len(progress.curve) // LOGGED))]
    (folder / "training.jsonl").write_text("".join(json.dumps(logged(row)) + "\n" for row in kept))
    (folder / "scores.json").write_text(json.dumps(measured) + "\n")
    world = dataclasses.replace(made.stream(), seed=progress.runs[-1]["seed"])
    size = sum(value.numel() for name, value in saved.weights.items() if name.startswith("dynamics."))
    described = {
        "dynamics": f"{model_config(made.train).dynamics.network}, {size:,} parameters",
        "steps": progress.step,
        "training_seconds": progress.seconds,
        "skipped_steps": progress.n_skipped,
        "windows": progress.windows,
        "scores": [{key: entry[key] for key in ("windows", *SCORES)} for entry in progress.scores],
        "runs": progress.runs,
        "trajectories_begun": progress.next_trajectory,
        "world": {"world": made.world, "preset": made.preset, **dataclasses.asdict(world)},
        "held_out_seed": VALIDATION_SEED,
    }
    (folder / "recipe.json").write_text(json.dumps(described, indent=1) + "\n")
    (folder / "README.md").write_text(card(name, described, measured, saved.config, limitations))
    if (picture := scores / f"{name}.frames.png").is_file():
        shutil.copyfile(picture, PICTURES / f"{name}-frames.png")
    return folder


def logged(row: list[float]) -> dict:
    """A line of training.jsonl: one logged step, as ``gsim3d train`` logs it."""
    known = {column: value for column, value in zip(CURVE, row, strict=True) if math.isfinite(value)}
    return {**known, "step": int(known["step"]), "machine": {"seconds": known.pop("seconds")}}


def card(name: str, recipe: dict, scores: dict, config: dict, limitations: str) -> str:
    """The model card."""
    data, devices = config["data"], sorted({run["device"] for run in recipe["runs"]})
    used = sum(run["trajectories"] for run in recipe["runs"])
    changes = [json.dumps(options) for run in recipe["runs"] for options in run.get("in_turn", ()) if options]
    changed = f", some with {', '.join(dict.fromkeys(changes))}" if changes else ""
    world, begun = recipe["world"], recipe["runs"][0].get("began_with")
    n_runs, n_scored = len(recipe["runs"]), sum(scores[s]["n_scenes"] for s in SETS if s in scores)
    before = f"\n- Initial weights: `{begun['name']}` at step {begun['step']:,}." if begun else ""
    actors = ", ".join(config["model"]["dynamics"].get("actions") or ())
    known = f"\n- Input: positions of its actors at all steps, also of the future: {actors}." if actors else ""
    put = "".join(f"\n- Changed after training: {run['then']}." for run in recipe["runs"] if "then" in run)
    return f"""# {name}

Predicts videos of the generated world `{world["world"]}`.

## Intended use

Research on learned simulation, and a start for training on similar scenes. Not for safety-critical predictions.

## Inputs and outputs

- Input: {data["history"]} steps from {data["context_views"]} calibrated cameras at {world["image_size"]} pixels,
  with masks, {world["fps"]:g} frames a second.{known}
- Output: particles of every later step, rendered as 3D Gaussians from any camera.
- Dynamics: {recipe["dynamics"]}.

## How to load

```python
from gsim3d import Simulator

simulator = Simulator.from_pretrained("{name}")
```

## Training data and compute

- Data: {used:,} trajectories of {world["n_frames"]} steps and {world["n_cams"]} cameras, each used once, from
  `gsim3d generate {world["world"]} --preset {world["preset"]} --seed {world["seed"]}`{changed}.
  Supervision: images alone.
- Compute: {recipe["steps"]:,} optimizer steps ({recipe["windows"]:,} windows) in {recipe["training_seconds"]:,.0f} s,
  {n_runs} run{"s" if n_runs > 1 else ""}, {" and ".join(devices)}; {recipe["skipped_steps"]} steps
  skipped.{before}{put}
- Weights: averaged, bfloat16. Settings: `config.yaml`; log: `training.jsonl`; data: `recipe.json`.

## Evaluation

{score_table(scores)}

PSNR in dB; masked: without background, as given steps, bodies and baselines are. {n_scored}
held-out trajectories, seed {recipe["held_out_seed"]}. All numbers: `scores.json`.

{LIMITATIONS}{limitations.strip()}{LICENCE}
Apache-2.0. gsim3d {gsim3d.__version__}, sha256 of the weights {scores["checkpoint"][:16]}.
"""


def score_table(scores: dict) -> str:
    """A row for each set: the model beside its baselines."""
    lines = [
        "| trajectories | steps | given | masked PSNR | bodies | constant | copy | constant velocity | PSNR | SSIM |",
        "| --- | ---: | ---: | ---: | ---: | ---: | ---: | ---: | ---: | ---: |",
    ]
    for subset, what in SETS.items():
        if subset in scores:
            s = scores[subset]
            still = [s[f"{method}.future.psnr_masked"] for method in ("constant", "copy", "constant_velocity")]
            own = s["past.psnr_masked"], s["future.psnr_masked"], s["future.psnr_body"]
            numbers = " | ".join(f"{value:.2f}" for value in (*own, *still, s["future.psnr"]))
            lines.append(f"| {what} ({s['n_scenes']}) | {s['n_future_steps']} | {numbers} | {s['future.ssim']:.3f} |")
    return "\n".join(lines)


def with_invariances(card: str, name: str) -> str:
    """The model card with a table of laws.json, where the model violates invariances."""
    head, rest = card.split(LIMITATIONS)
    head = head.split(VIOLATED)[0].rstrip()
    broken = pretrained.known_failures(pretrained.FOLDER / name / pretrained.WEIGHTS)
    if not broken:
        return f"{head}\n\n{LIMITATIONS}{rest}"
    rows = "\n".join(
        f"| {law} | {found['what']} | {found['error']:.3g} | {found['bound'] or 'equal bits'} |"
        for law, found in broken.items()
    )
    said = f"Largest errors of `gsim3d doctor --stability {name} DATA`, sampled and with `--full`, on two scenes:"
    table = f"| invariance | quantity | error | allowed |\n| --- | --- | ---: | ---: |\n{rows}"
    return f"{head}\n\n{VIOLATED}{said}\n\n{table}\n\n{LIMITATIONS}{rest}"


def keep_laws(name: str, reports: list[Path]) -> None:
    """Writes laws.json: the worst error of each invariance that `gsim3d doctor --stability` found violated."""
    worst: dict[str, dict] = {}
    for report in reports:
        for finding in json.loads((report / "report.json").read_text())["findings"]:
            for found in finding["failures"] if finding["check"] in INVARIANCES else ():
                if found["error"] > worst.get(finding["check"], {"error": 0.0})["error"]:
                    error = float(f"{found['error']:.3g}")
                    worst[finding["check"]] = {"what": found["what"], "error": error, "bound": found["bound"]}
    (pretrained.FOLDER / name / pretrained.LAWS).unlink(missing_ok=True)
    if worst:
        (pretrained.FOLDER / name / pretrained.LAWS).write_text(json.dumps(worst, indent=1) + "\n")


def draw_windows(path: Path, scores: list[dict]) -> None:
    """Draws the validation scores on the way of a run."""
    figure, axes = pyplot().subplots(figsize=(6, 3.8), layout="constrained")
    for score, label in zip(SCORES, ("given steps", "future", "bodies", "constant"), strict=True):
        axes.plot([entry["windows"] for entry in scores], [entry[score] for entry in scores], ".-", label=label)
    axes.set(xlabel="training windows", ylabel="masked PSNR of validation trajectories, dB")
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8)
    save_figure(figure, path)


def update_cards() -> None:
    """Writes the invariances into all cards, and the curves of the scores into the documentation."""
    for name in pretrained.names():
        folder = pretrained.FOLDER / name
        scores, recipe = (json.loads((folder / f"{part}.json").read_text()) for part in ("scores", "recipe"))
        write_curves(PICTURES / f"{name}.png", scores["held_out"], recipe["world"]["fps"], CURVES)
        if recipe.get("scores"):
            draw_windows(PICTURES / f"{name}-windows.png", recipe["scores"])
        readme = folder / "README.md"
        readme.write_text(with_invariances(readme.read_text(), name))


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("name", nargs="?", help="such as elastic-small (left out: only the cards are updated)")
    parser.add_argument("--arm", default="velocity", help="of the recipe (default: velocity)")
    parser.add_argument("--state", type=Path, help="what tools/release/train.py wrote")
    parser.add_argument("--scores", type=Path, help="what score.py wrote")
    parser.add_argument("--laws", type=Path, nargs="+", metavar="DIR", help="what gsim3d doctor --stability wrote")
    parser.add_argument("--limitations", type=Path, help="markdown list (default: that of the present card)")
    args = parser.parse_args(arguments)
    if args.name and args.state:
        known = pretrained.FOLDER / args.name / "README.md"
        if args.limitations is None and not known.is_file():
            raise InputError("--limitations is needed: a list of what is wrong in the predicted videos")
        text = known.read_text().split(LIMITATIONS)[1].split(LICENCE)[0] if known.is_file() else ""
        limitations = args.limitations.read_text() if args.limitations else text
        made = recipe(args.name.split("-")[0], args.arm)
        print(f"written: {ship(args.name, made, args.state, args.scores, limitations)}")
    if args.laws:
        keep_laws(args.name, args.laws)
    update_cards()


if __name__ == "__main__":
    try:
        main()
    except InputError as error:
        sys.exit(f"ship_model: error: {error}")
