"""``gsim3d demo``: multi-view video is made and predicted, by a shipped simulator or one trained here."""

from __future__ import annotations

import argparse

EPILOG = """\
Writes into DIR:
  held_out/      multi-view video of soft bodies that fall on a round ground, made here; no training saw it
  rollout.mp4    these scenes, truth above prediction
  psnr.png       PSNR over time against the baselines
  metrics.json   all numbers; the most important ones are printed
  gaussians/     the predicted 3D Gaussians of one scene, a .ply for each step
  overview.png   input views, Gaussians, predicted and true frames in one picture

With --train, the main job at a small size, also
  data/          instead of held_out/: smaller scenes, of which a few are held out
  model/         checkpoints and log of the training; model.safetensors beside it is the result in one file

One to three minutes on 2 cores; 7 to 10 minutes with --train. Stopped and started again, it goes on where it was.

examples:
  gsim3d demo --out runs/demo
  gsim3d demo --train --out runs/demo
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.description = "Makes multi-view video of falling bodies and predicts it with a simulator that never saw it."
    parser.epilog = EPILOG
    parser.add_argument("--out", metavar="DIR", required=True, help="folder for everything; made if absent")
    parser.add_argument("--train", action="store_true", help="learn the simulator here, from scratch")


def run(args: argparse.Namespace) -> int:
    from gsim3d.evaluate.demo import SHIPPED, DemoConfig, run_demo
    from gsim3d.pretrained import names

    run_demo(args.out, DemoConfig() if args.train or SHIPPED.simulator not in names() else SHIPPED)
    return 0
