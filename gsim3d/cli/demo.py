"""Generates multi-view video of falling bodies and predicts it with a simulator.

Output in DIR:
  held_out/      generated multi-view video of soft bodies falling on a round ground, not seen in training
  rollout.mp4    these scenes, truth above prediction
  psnr.png       PSNR over time, with baselines
  metrics.json   all numbers; the most important ones are printed
  gaussians/     the predicted 3D Gaussians of one scene, one .ply per step
  overview.png   input views, Gaussians, predicted and true frames in one picture

With --train, which trains a small model, also
  data/          instead of held_out/: smaller scenes, a few of them held out
  model/         checkpoints and log of the training; the result is saved as model.safetensors

Takes one to three minutes on 2 cores; 7 to 10 minutes with --train. Run again, the command resumes.

examples:
  gsim3d demo --out runs/demo
  gsim3d demo --train --out runs/demo
"""

import argparse


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--out", metavar="DIR", required=True, help="output folder, created if absent")
    parser.add_argument("--train", action="store_true", help="train a new simulator from scratch")


def run(args: argparse.Namespace) -> int:
    from gsim3d.evaluate.demo import SHIPPED, DemoConfig, run_demo
    from gsim3d.pretrained import names

    run_demo(args.out, DemoConfig() if args.train or SHIPPED.simulator not in names() else SHIPPED)
    return 0
