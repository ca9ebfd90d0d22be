"""Turns videos of still cameras into a simulator, step by step.

Steps, each of which prints what it decides and why, writes its result, and is skipped when it is done:

  calibrate   cameras.json beside the videos (gsim3d calibrate), unless there are cameras
  check       files and angles; errors of matched features and of moving bodies              OUT/check.json
  propose     frame rate, crop, size, stride, depth range; prepared scenes in OUT/scenes     OUT/proposal.json
  settings    of the training: steps that fit into --minutes                                 OUT/settings.json
  train       the model in OUT/model; an interrupted training continues                      OUT/train.json
  score       held-out steps against the constant baseline                                   OUT/metrics.json

Refused unless --force: cameras further than 45 degrees from their nearest neighbour, and calibrations that do not fit.
Delete a file in OUT to repeat its step and those below; other videos or cameras need OUT/check.json deleted.

examples:
  gsim3d capture videos --board 7 5 0.04 --out runs/capture --device cuda
  gsim3d capture scene_with_cameras --out runs/capture --minutes 5
"""

import argparse

from gsim3d.cli.arguments import number
from gsim3d.cli.calibrate import add_calibration, calibration_of


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("folder", metavar="DIR", help="folder with the videos of a take, or a folder for each take; or scenes")
    add("--out", metavar="OUT", required=True, help="run folder, created or continued")
    add_calibration(parser)
    add("--minutes", type=number(0, 1e5, above=True), default=15.0, help="time to train (default: 15)")
    add("--depth", nargs=2, metavar=("MODEL", "FILE"), help="pretrained depth: its encoder.vit.model and weights")
    add("--device", choices=("cpu", "cuda"), default="cpu", help="where to train (default: cpu)")
    add("--force", action="store_true", help="go on where the check refuses")


def run(args: argparse.Namespace) -> int:
    from gsim3d.capture.run import capture

    options = {"minutes": args.minutes, "device": args.device, "depth": args.depth, "force": args.force}
    capture(args.folder, args.out, **calibration_of(args), **options)
    return 0
