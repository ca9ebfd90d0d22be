"""Trains a simulator on multi-view video; writes checkpoints and a log into a run folder.

CONFIG is a YAML file. Missing keys have defaults; unknown keys are an error. For example:

  preset: tiny
  data: {history: 2, context_views: 4, target_only_cameras: [2, 7]}
  phases:
    - {steps: 400, history: 1, batch: 2, learning_rate: 2.0e-3}      # encoder and renderer
    - {steps: 800, horizon: 8, learning_rate: 1.0e-3}                # all parts, 8 simulated steps

The scenes that `gsim3d evaluate` scores by default are held out (about every 8th; see gsim3d.data.split_scenes). Run
again, the command resumes from the last checkpoint, with the same numbers as an uninterrupted run. Several processes,
on one or more machines (tools/slurm/train.sbatch), share the samples of every step.

examples:
  gsim3d train --print-config > train.yaml
  gsim3d train train.yaml --data runs/data --out runs/model
  gsim3d train train.yaml --data runs/data --out runs/model --export model.safetensors
  torchrun --nproc-per-node 4 -m gsim3d train train.yaml --data runs/data --out runs/model --device cuda
"""

import argparse

from gsim3d.cli.arguments import whole


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("config", metavar="CONFIG", nargs="?", help="YAML file with the run's settings")
    add("--data", metavar="DIR", help="folder with scenes of any layout (docs/reference/data.md)")
    add("--cache", metavar="DIR", help="cache decoded images in this folder, for data sets larger than memory")
    add("--out", metavar="DIR", help="run folder, created if absent")
    add("--device", choices=("cpu", "cuda"), default="cpu", help="device (default: cpu)")
    add("--until", type=whole(1), metavar="STEP", help="stop after this optimizer step (default: the last)")
    add("--export", metavar="FILE", help="also write the result as one .safetensors file")
    add("--tensorboard", action="store_true", help="also log to OUT/tensorboard, with sample videos")
    add("--wandb", action="store_true", help="also log to Weights & Biases (see its own settings)")
    add("--viewer", action="store_true", help="show the prediction of a held-out scene, updated at each checkpoint")
    add("--profile", action="store_true", help="write a trace of two steps to OUT/profile")
    add("--print-config", action="store_true", help="print all settings with their defaults and exit")


def run(args: argparse.Namespace) -> int:
    import yaml

    from gsim3d.data import find_scenes, split_scenes
    from gsim3d.errors import InputError
    from gsim3d.io.files import output_path, read_yaml
    from gsim3d.io.settings import from_dict, to_dict
    from gsim3d.synth.held_out import refuse_held_out
    from gsim3d.train.config import TrainConfig

    config = from_dict(TrainConfig, read_yaml(args.config), f"{args.config}: ") if args.config else TrainConfig()
    if args.print_config:
        print(yaml.safe_dump(to_dict(config), sort_keys=False), end="")
        return 0
    for name in ("config", "data", "out"):
        if getattr(args, name) is None:
            raise InputError(f"{'CONFIG' if name == 'config' else f'--{name}'} is required (see gsim3d train --help)")
    if args.export:
        output_path(args.export, ".safetensors", "--export")
    folders, held_out = split_scenes(find_scenes(args.data))
    refuse_held_out(folders)
    names = ("cache", "device", "until", "export", "tensorboard", "wandb", "profile")
    options = {name: getattr(args, name) for name in names}

    from gsim3d.train.run import train
    from gsim3d.viewer.training import showing_samples

    viewer = showing_samples if args.viewer else None
    train(config, folders, args.out, **options, viewer=viewer, held_out=held_out)
    return 0
