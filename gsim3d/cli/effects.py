"""``gsim3d effects infer``: the smallest spec under which a model predicts a scene as well as under its own."""

from __future__ import annotations

import argparse
from functools import partial

from gsim3d.cli.arguments import add_fitting, decibels
from gsim3d.io.terminal import progress
from gsim3d.pretrained import CHECKPOINT_HELP

EPILOG = """\
Each effect that the checkpoint's spec has on is switched off alone, or lowered, and predictions of four steps at the
video's begin, middle and end are compared with it: what it is worth is how many dB of PSNR that loses, what it costs
is the time of a step and its images. The smallest settings within the tolerance are combined; while the combination
loses more, the one that is worth most is put back. What is measured as slower is not proposed.

It is the model that is measured: if its predictions are hardly better than particles held still (the first line shows
both), it has not learned what the effects are for, and the proposal says little about the scene. Times of a few
milliseconds waver; let nothing else run.

examples:
  gsim3d effects infer runs/data/ball/0000 runs/model --tolerance 0.1dB
  gsim3d simulate runs/model runs/data/ball/0000 --out runs/ball --effects runs/data/ball/0000/effects.yaml
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.description = "Finds out which effects a scene needs, and writes them to effects.yaml."
    parser.epilog = EPILOG
    parser.add_argument("action", choices=("infer",), help="infer: switch effects off one by one and compare")
    parser.add_argument("scene", metavar="SCENE", help="scene folder of any layout (docs/reference/data.md)")
    parser.add_argument("checkpoint", metavar="CHECKPOINT", help=CHECKPOINT_HELP)
    parser.add_argument(
        "--tolerance", type=decibels, default="0.1dB", metavar="X", help="PSNR that may be lost (default: 0.1dB)"
    )
    parser.add_argument("--out", metavar="FILE", help="file to write; must not exist yet (default: SCENE/effects.yaml)")
    add_fitting(parser)
    parser.add_argument("--quiet", action="store_true", help="no progress bar")
    parser.add_argument("--device", choices=("cpu", "cuda"), default="cpu", help="where to predict (default: cpu)")


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
