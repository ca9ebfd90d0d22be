"""What it costs that the published training cuts gradients: the same runs with gradients cut and kept.

    gsim3d generate elastic --preset mini --out runs/data
    python tools/cut_gradients.py --data runs/data --out runs/cut --device cuda

The release wraps attention, MLPs and the depth predictor in re-entrant checkpoints, which pass on no gradient of
tensors inside dictionaries: attention and MLP of every block, their norms and the latents of the encoder keep their
random first values. Here these branches are detached, which has the same effect, in one run of each pair; both runs
of a pair have the same first weights and see the same samples in the same order. Stopped and started again, it goes
on where it was.
"""

import argparse
import dataclasses
import json
import statistics
from pathlib import Path

from torch import nn

from gsim3d.data import Scene, find_scenes, split_scenes
from gsim3d.dynamics.point_transformer import Block
from gsim3d.evaluate.protocol import score_scene
from gsim3d.evaluate.report import summarize, write_json
from gsim3d.simulator import Simulator
from gsim3d.train.config import DataConfig, LossConfig, OptimizerConfig, StageConfig, TrainConfig
from gsim3d.train.loop import Trainer
from gsim3d.train.restore import restore

RUN = TrainConfig(
    preset="tiny",
    model={"dynamics": {"zero_init": False}},  # else blocks learn nothing before the last layer has
    data=DataConfig(history=2, context_views=4, target_only_cameras=(2, 7), background_stride=2),
    stages=(
        StageConfig(steps=800, history=1, batch=2, target_views=2, learning_rate=2e-3),
        StageConfig(steps=2400, horizon=8, batch=2, target_views=2, from_start=0.4, learning_rate=1e-3),
    ),
    loss=LossConfig(body_weight=2.0),
    optimizer=OptimizerConfig(ema_decay=0.98),
)
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


def train_and_score(config: TrainConfig, folders: tuple, out: Path, is_cut: bool, device: str) -> dict[str, float]:
    """Trains in the folder ``out``, from where it was left; what held-out scenes say."""
    train, test = ([Scene.open(folder, fitting=config.data.fitting) for folder in part] for part in folders)
    trainer = Trainer(config, train, out, device=device)
    if is_cut:
        cut(trainer.simulator)
    trainer.run()
    restored = restore(out, device)
    file = out / "metrics.json"
    known = json.loads(file.read_text()) if file.is_file() else {}
    if known.get("checkpoint") != restored.checkpoint.digest:
        scores = [score_scene(restored, scene, metrics=("psnr", "psnr_masked")) for scene in test]
        known = {"checkpoint": restored.checkpoint.digest, **summarize(scores)}
        write_json(file, known)
    return {name: known[name] for name in MEASURED} | {"constant": known["constant.future.psnr_masked"]}


def table(results: dict[str, list[dict[str, float]]]) -> str:
    """Mean and standard deviation over the seeds, dB."""
    lines = ["| gradients | " + " | ".join(results["kept"][0]) + " |", "| --- " * (1 + len(results["kept"][0])) + "|"]
    for kind, seeds in results.items():
        cells = []
        for name in seeds[0]:
            values = [seed[name] for seed in seeds]
            spread = f" ± {statistics.stdev(values):.2f}" if len(values) > 1 else ""
            cells.append(f"{statistics.mean(values):.2f}{spread}")
        lines.append(f"| {kind} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def main(arguments: list[str] | None = None, config: TrainConfig = RUN) -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", required=True, help="folder with scenes")
    parser.add_argument("--out", required=True, type=Path, help="folder for the runs")
    parser.add_argument("--device", choices=["cpu", "cuda"], default="cpu")
    parser.add_argument("--seeds", type=int, default=3)
    args = parser.parse_args(arguments)
    folders = split_scenes(find_scenes(args.data))
    results: dict[str, list] = {"kept": [], "cut": []}
    for seed in range(args.seeds):
        for kind, scores in results.items():
            print(f"seed {seed}, gradients {kind}", flush=True)
            run = dataclasses.replace(config, seed=seed)
            scores.append(train_and_score(run, folders, args.out / f"{kind}_{seed}", kind == "cut", args.device))
    print(table(results))
    write_json(args.out / "metrics.json", results)


if __name__ == "__main__":
    main()
