"""gsim3d train: learn a simulator from a data set."""

from __future__ import annotations

import argparse

from gsim3d.cli.arguments import whole

EPILOG = """\
CONFIG is a YAML file; what it leaves out has a default, what it does not know is an error. For example

  preset: tiny
  data: {history: 2, context_views: 4, target_only_cameras: [2, 7]}
  phases:
    - {steps: 400, history: 1, batch: 2, learning_rate: 2.0e-3}      # encoder and renderer
    - {steps: 800, horizon: 8, learning_rate: 1.0e-3}                # all parts, 8 simulated steps

Scenes that `gsim3d evaluate` measures by default are left out (every 8th or so; see gsim3d.data.split_scenes).
Called again, it goes on from the last checkpoint and repeats the same numbers as a run that was never stopped.
Several processes, on one machine or many (tools/slurm/train.sbatch), share the samples of every step.

examples:
  gsim3d train --print-config > train.yaml
  gsim3d train train.yaml --data runs/data --out runs/model
  gsim3d train train.yaml --data runs/data --out runs/model --export model.safetensors
  torchrun --nproc-per-node 4 -m gsim3d train train.yaml --data runs/data --out runs/model --device cuda
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.description = "Learns a simulator from multi-view video; writes checkpoints and a log into a run folder."
    parser.epilog = EPILOG
    parser.add_argument("config", metavar="CONFIG", nargs="?", help="YAML file with the run's settings")
    parser.add_argument("--data", metavar="DIR", help="folder with scenes of any layout (docs/reference/data.md)")
    parser.add_argument(
        "--cache", metavar="DIR", help="keep decoded images in files here, for sets larger than the memory"
    )
    parser.add_argument("--out", metavar="DIR", help="run folder; made if absent")
    parser.add_argument("--device", choices=("cpu", "cuda"), default="cpu", help="where to train (default: cpu)")
    parser.add_argument(
        "--until", type=whole(1), metavar="STEP", help="stop after this optimizer step (default: the last)"
    )
    parser.add_argument("--export", metavar="FILE", help="also write the result as one .safetensors file")
    parser.add_argument("--tensorboard", action="store_true", help="also log to OUT/tensorboard, with sample videos")
    parser.add_argument("--profile", action="store_true", help="write a trace of two steps to OUT/profile, then go on")
    parser.add_argument("--print-config", action="store_true", help="print all settings with their defaults and exit")


def run(args: argparse.Namespace) -> int:
    from contextlib import nullcontext
    from pathlib import Path

    import yaml

    from gsim3d.data import Scene, find_scenes, split_scenes
    from gsim3d.errors import InputError
    from gsim3d.io import checkpoint
    from gsim3d.io.files import output_path, with_parents
    from gsim3d.io.settings import from_dict, load_yaml, to_dict
    from gsim3d.synth.held_out import origin_of
    from gsim3d.train.config import TrainConfig

    config = from_dict(TrainConfig, load_yaml(args.config)) if args.config else TrainConfig()
    if args.print_config:
        print(yaml.safe_dump(to_dict(config), sort_keys=False), end="")
        return 0
    for name in ("config", "data", "out"):
        if getattr(args, name) is None:
            raise InputError(f"{'CONFIG' if name == 'config' else f'--{name}'} is needed (see gsim3d train --help)")
    if args.export:
        output_path(args.export, ".safetensors", "--export")
    folders, _ = split_scenes(find_scenes(args.data))
    for folder in folders:
        if (origin := origin_of(folder)) and origin.set_name:
            raise InputError(
                f"{folder}: of the {origin.set_name} set (seed {origin.seed}), which no training may see; generate "
                "trajectories with another --seed"
            )
    if args.cache:
        Path(args.cache).mkdir(parents=True, exist_ok=True)  # a folder that cannot be is told before work begins
    scenes = [Scene.open(folder, cache_dir=args.cache, fitting=config.data.fitting) for folder in folders]

    from gsim3d.cuda_graphs import has_no_room
    from gsim3d.io.locks import only_one_writer
    from gsim3d.train.loop import Trainer
    from gsim3d.train.processes import joined

    out = Path(args.out)
    out.mkdir(parents=True, exist_ok=True)
    with joined(args.device) as processes, only_one_writer(out) if processes.is_first else nullcontext():
        say = print if processes.is_first else lambda *_: None
        trainer = Trainer(config, scenes, args.out, device=args.device, processes=processes)
        if trainer.step:
            came = "" if trainer.same_scenes else "; scenes have come since, so the curve is another one from here on"
            say(f"going on from step {trainer.step} of {config.n_steps}{came}")
        try:
            trainer.run(until=args.until, tensorboard=args.tensorboard, profile=args.profile)
        except (RuntimeError, MemoryError) as error:
            if not has_no_room(error):
                raise
            raise InputError(
                f"step {trainer.step}: out of memory ({args.device}): a smaller batch or fewer target_views, larger "
                f"strides of data, or recompute: [encoder, steps, images] need less; {args.out} goes on from its last "
                "checkpoint"
            ) from None
        say(f"trained to step {trainer.step} of {config.n_steps}: {args.out}")
        if args.export and processes.is_first:
            checkpoint.export(checkpoint.load(args.out), with_parents(Path(args.export)))
            say(f"written: {args.export}")
    return 0
