"""Finds the effects that a scene requires, and writes them to effects.yaml.

Each effect of the checkpoint's specification is disabled or reduced on its own. Predictions of four steps at the start,
middle and end of the video then give its worth, the loss of PSNR in dB, and its cost, the time of a step with images.
The smallest settings within the tolerance are combined; while the combination loses more, the setting of the effect
with the largest loss is restored. Settings that are slower are not proposed.

The result depends on the model: if its predictions are hardly better than constant particles (the first line shows
both), it has not learned to use the effects, and the proposal says little about the scene. Times of a few milliseconds
are noisy; stop other programs.

examples:
  gsim3d effects infer runs/data/ball/0000 runs/model --tolerance 0.1dB
  gsim3d simulate runs/model runs/data/ball/0000 --out runs/ball --effects runs/data/ball/0000/effects.yaml
"""

import argparse
from functools import partial

from gsim3d.cli.arguments import add_fitting, decibels
from gsim3d.io.terminal import progress
from gsim3d.pretrained import CHECKPOINT_HELP


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("action", choices=("infer",), help="infer: disable effects one by one and compare")
    add("scene", metavar="SCENE", help="scene folder of any layout (docs/reference/data.md)")
    add("checkpoint", metavar="CHECKPOINT", help=CHECKPOINT_HELP)
    add("--tolerance", type=decibels, default="0.1dB", metavar="X", help="largest loss of PSNR (default: 0.1dB)")
    add("--out", metavar="FILE", help="file to write; must not exist (default: SCENE/effects.yaml)")
    add_fitting(parser)
    add("--quiet", action="store_true", help="no progress bar")
    add("--device", choices=("cpu", "cuda"), default="cpu", help="device (default: cpu)")


def run(args: argparse.Namespace) -> int:
    import textwrap
    from pathlib import Path

    from gsim3d.effects.spec import FILE
    from gsim3d.evaluate.infer_effects import infer
    from gsim3d.io.files import new_output_path, with_parents
    from gsim3d.train.restore import restore

    out = new_output_path(args.out or Path(args.scene) / FILE, "file")
    restored = restore(args.checkpoint, args.device)
    scene = restored.open_scene(args.scene, args.keep, args.resample)
    proposal = infer(
        restored, scene, args.tolerance, partial(progress, None, "settings", unit="setting", quiet=args.quiet)
    )
    proposal.spec.save(with_parents(out))
    print(f"{scene.name}: {proposal}; written to {out}:")
    print(textwrap.indent(out.read_text(), "  ").rstrip())
    return 0
