"""gsim3d evaluate: measure predictions on a data set."""

from __future__ import annotations

import argparse

EPILOG = """\
Every scene's first steps are encoded, all others predicted and compared with the film, seen from cameras that
were no input. Prints PSNR (masked and unmasked) and SSIM for the model and for four baselines, then by step, and
writes the same as JSON.

examples:
  gsim3d evaluate runs/model runs/data
  gsim3d evaluate model.safetensors runs/data --scenes all --steps 16 --out metrics.json
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.description = "Measures how well a simulator predicts the scenes of a data set."
    parser.epilog = EPILOG
    parser.add_argument("checkpoint", metavar="CHECKPOINT", help="run folder, checkpoint folder or .safetensors file")
    parser.add_argument("data", metavar="DATA", help="folder with scenes, or one scene folder")
    parser.add_argument(
        "--scenes",
        choices=("test", "train", "all"),
        default="test",
        help="which part of the data set (default: test, the scenes that `gsim3d train` holds out)",
    )
    parser.add_argument("--steps", type=int, help="steps to predict (default: to the end of each film)")
    parser.add_argument("--out", metavar="FILE", help="JSON file (default: metrics.json beside the checkpoint's files)")


def run(args: argparse.Namespace) -> int:
    from pathlib import Path

    from tqdm import tqdm

    from gsim3d.data import Scene, find_scenes, split_scenes
    from gsim3d.errors import InputError
    from gsim3d.evaluate.protocol import check_horizon, score_scene
    from gsim3d.evaluate.report import summarize, table, write_json
    from gsim3d.train.restore import restore

    restored = restore(args.checkpoint)
    folders = find_scenes(args.data)
    train, test = split_scenes(folders)
    folders = {"all": folders, "train": train, "test": test or folders}[args.scenes]
    scenes = [Scene.open(folder) for folder in folders]
    for scene in scenes:
        restored.check_scene(scene)
        check_horizon(restored, scene, args.steps)
    checkpoint = Path(args.checkpoint)
    out = Path(args.out) if args.out else (checkpoint if checkpoint.is_dir() else checkpoint.parent) / "metrics.json"
    if not out.parent.is_dir():
        raise InputError(f"--out: the folder {out.parent} does not exist")
    scores = [score_scene(restored, scene, n_future=args.steps) for scene in tqdm(scenes, desc="scenes", unit="scene")]
    summary = summarize(scores)
    print(table(summary))
    write_json(out, summary)
    print(f"\nwritten: {out}")
    return 0
