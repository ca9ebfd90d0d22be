"""What it costs that the published training cuts gradients: the same runs with gradients cut and kept.

    gsim3d generate elastic --preset mini --out runs/data
    python tools/cut_gradients.py --data runs/data --out runs/cut --device cuda --together 6
    python tools/cut_gradients.py --picture runs/cut docs/figures/cut_gradients.png

The release wraps attention, MLPs and the depth predictor in re-entrant checkpoints, which pass on no gradient of
tensors inside dictionaries: attention and MLP of every block, their norms and the latents of the encoder keep their
random first values. Here these branches are detached, which has the same effect, in one run of each pair; both runs
of a pair have the same first weights and see the same samples in the same order. Stopped, or out of --minutes, and
started again, it goes on where it was.
"""

import argparse
import dataclasses
import json
import math
import statistics
import sys
import time
from functools import partial
from pathlib import Path

from torch import nn

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))
from gsim3d.data import Scene, find_scenes, split_scenes  # noqa: E402
from gsim3d.evaluate.protocol import score_scene  # noqa: E402
from gsim3d.evaluate.report import summarize, write_json  # noqa: E402
from gsim3d.io.settings import to_dict  # noqa: E402
from gsim3d.nn.point_transformer import Block  # noqa: E402
from gsim3d.simulator import Simulator  # noqa: E402
from gsim3d.train.config import DataConfig, LossConfig, OptimizerConfig, PhaseConfig, TrainConfig  # noqa: E402
from gsim3d.train.loop import Trainer  # noqa: E402
from gsim3d.train.restore import restore  # noqa: E402
from gsim3d.train.side_by_side import side_by_side  # noqa: E402

RUN = TrainConfig(
    preset="tiny",
    model={"dynamics": {"zero_init": False}},  # else blocks learn nothing before the last layer has
    data=DataConfig(history=2, context_views=4, target_only_cameras=(2, 7), background_stride=2),
    phases=(
        PhaseConfig(steps=700, history=1, batch=2, target_views=2, learning_rate=2e-3),
        PhaseConfig(steps=1200, horizon=4, batch=2, target_views=2, from_start=0.4, learning_rate=1e-3),
        PhaseConfig(steps=1100, horizon=8, batch=2, target_views=2, from_start=0.4, learning_rate=1e-3),
    ),
    loss=LossConfig(body_weight=2.0),
    optimizer=OptimizerConfig(ema_decay=0.98),
    captured=True,
)
SMOOTHED = 200  # steps that a point of the curves is a mean of
MEASURED = ("future.psnr_masked", "future.psnr", "future_late.psnr_masked")


def cut(simulator: Simulator) -> None:
    """Attention, MLPs and latents get and pass on no gradient, as under the published checkpoints."""
    for module in simulator.modules():
        if isinstance(module, Block):
            module.fused = False  # hooks see modules only
            for branch in (module.attention, module.mlp):
                branch.register_forward_hook(_detached)
    simulator.encoder.heads.to_latents.register_forward_hook(_detached)


def _detached(module: nn.Module, inputs: tuple, output):
    return output.detach()


def train_and_score(
    out: Path, config: TrainConfig, folders: tuple, is_cut: bool, device: str, end: float, progress: bool
) -> dict[str, float] | None:
    """Trains in the folder ``out``, from where it was left; what held-out scenes say.

    None where training did not come to its end by ``end``, on the clock of time.monotonic.
    """
    train, test = ([Scene.open(folder, fitting=config.data.fitting) for folder in part] for part in folders)
    asked = {"train": to_dict(config), "scenes": [[scene.name for scene in part] for part in (train, test)]}
    file = out / "metrics.json"
    known = json.loads(file.read_text()) if file.is_file() else {}
    if known.get("asked") != asked:
        trainer = Trainer(config, train, out, device=device)
        if is_cut:
            cut(trainer.simulator)
        trainer.run(end=end, progress=progress)
        if trainer.step < config.n_steps:
            return None
        restored = restore(out, device)
        scores = [score_scene(restored, scene, metrics=("psnr", "psnr_masked")) for scene in test]
        known = {"asked": asked, **summarize(scores)}
        write_json(file, known)
    return {name: known[name] for name in MEASURED} | {"constant": known["constant.future.psnr_masked"]}


def table(results: dict[str, list[dict[str, float]]]) -> str:
    """Mean and standard deviation over the seeds, dB."""
    names = [*MEASURED, "constant"]
    lines = ["| gradients | " + " | ".join(names) + " |", "| --- " * (1 + len(names)) + "|"]
    for kind, seeds in results.items():
        cells = []
        for name in names:
            values = [seed[name] for seed in seeds]
            spread = f" ± {statistics.stdev(values):.2f}" if len(values) > 1 else ""
            cells.append(f"{statistics.mean(values):.2f}{spread}")
        lines.append(f"| {kind} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def curve(run: Path) -> list[tuple[float, float]]:
    """(step, PSNR of simulated steps) of a run's log, each a mean over SMOOTHED steps."""
    parts: dict[int, list[float]] = {}
    for line in (run / "metrics.jsonl").read_text().splitlines():
        entry = json.loads(line)
        if isinstance(entry.get("future_psnr"), float):
            parts.setdefault(entry["step"] // SMOOTHED, []).append(entry["future_psnr"])
    return [((part + 0.5) * SMOOTHED, statistics.mean(values)) for part, values in sorted(parts.items())]


def draw(results: dict, path: Path) -> None:
    """Curves of all runs, and what held-out scenes say."""
    from gsim3d.evaluate.pictures import pyplot

    plt = pyplot()
    figure, (left, right) = plt.subplots(1, 2, figsize=(10, 3.8), layout="constrained")
    for (kind, runs), color in zip(results.items(), ("#1f5fbf", "#c0504d"), strict=True):
        for seed, run in enumerate(runs):
            label = f"gradients {kind}" if seed == 0 else None
            left.plot(*zip(*run["curve"], strict=True), color=color, linewidth=1.3, label=label)
        for place, name in enumerate(MEASURED):
            values = [run[name] for run in runs]
            x = place + (0.15 if kind == "cut" else -0.15)
            right.bar(x, statistics.mean(values), 0.28, color=color, alpha=0.4)
            right.plot([x] * len(values), values, "o", color=color, markersize=4)
    left.set(title="simulated steps of training samples", xlabel="optimizer step", ylabel="PSNR, dB")
    left.legend(fontsize=8)
    right.set(title="held-out scenes, a dot for each seed", ylabel="dB", xticks=range(len(MEASURED)))
    right.set_xticklabels(
        [name.replace("future", "all steps").replace("all steps_late", "second half") for name in MEASURED]
    )
    lowest = min(run[name] for runs in results.values() for run in runs for name in MEASURED)
    right.set_ylim(bottom=lowest - 2)
    figure.savefig(path, dpi=110)


def main(arguments: list[str] | None = None, config: TrainConfig = RUN) -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", help="folder with scenes")
    parser.add_argument("--out", type=Path, help="folder for the runs")
    parser.add_argument("--device", choices=["cpu", "cuda"], default="cpu")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--together", type=int, default=1, metavar="N", help="runs at a time, a process each")
    parser.add_argument("--minutes", type=float, default=math.inf, help="train no longer; the next call goes on")
    parser.add_argument(
        "--picture", nargs=2, type=Path, metavar=("OUT", "FILE"), help="draw what OUT/metrics.json says"
    )
    args = parser.parse_args(arguments)
    if args.picture:
        draw(json.loads((args.picture[0] / "metrics.json").read_text()), args.picture[1])
        return
    if args.data is None or args.out is None:
        parser.error("--data and --out are needed")
    end = time.monotonic() + 60 * args.minutes
    folders, say = split_scenes(find_scenes(args.data)), partial(print, flush=True)
    runs = {f"{kind}_{seed}": (kind, seed) for seed in range(args.seeds) for kind in ("kept", "cut")}
    common = (args.device, end, args.together == 1)
    jobs = {
        name: (args.out / name, dataclasses.replace(config, seed=seed), folders, kind == "cut", *common)
        for name, (kind, seed) in runs.items()
    }
    scores = {}
    for name, found in side_by_side(train_and_score, jobs, args.together, say):
        scores[name] = found
        say(f"{name}: {'call again to go on' if found is None else found}")
    if None in scores.values():
        return
    results: dict[str, list] = {"kept": [], "cut": []}
    for name, (kind, _) in runs.items():
        results[kind].append({**scores[name], "curve": curve(args.out / name)})
    print(table(results))
    write_json(args.out / "metrics.json", results)


if __name__ == "__main__":
    main()
