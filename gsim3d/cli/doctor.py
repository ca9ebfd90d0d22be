"""Checks the installation and runs a self-test of every op.

Without options: lists installed packages and compiled modules, and compares every op with known answers.

With --stability: tests invariances of the model (to translation, rotation, reordering, repetition and splitting of
scenes, and to a far particle) and runs stress tests on your scenes (black images, one view, NaN, coinciding particles,
unusual cameras, a long rollout, gradients). Each failure names camera, particle and step, and writes a file to
DIR/failures that reproduces it. The report is DIR/report.md and DIR/report.json. Failures that the model card of a
shipped simulator lists are reported as known failures.

examples:
  gsim3d doctor
  gsim3d doctor --stability runs/model runs/data
  gsim3d doctor --stability elastic-small runs/data --full
  gsim3d doctor --stability small my_scene --steps 1000
  gsim3d doctor --stability --replay runs/stability/failures/translate.safetensors

Exit code 0: all required packages work and all checks hold. 1: a failure, known or not. 2: the check could not run.
"""

import argparse
from pathlib import Path

from gsim3d.cli.arguments import whole
from gsim3d.errors import InputError


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument_group("stability of a model or of scenes").add_argument
    add(
        "--stability",
        nargs="*",
        metavar="PATH",
        help="test invariances and run stress tests of a checkpoint, or of a preset with random weights (default: "
        "tiny), on a scene or folder of scenes (default: random images)",
    )
    add("--out", metavar="DIR", default="runs/stability", help="folder of the report (default: %(default)s)")
    add("--steps", type=whole(1), default=100, help="steps of the long rollout (default: %(default)s)")
    add("--only", nargs="+", metavar="CHECK", default=(), help="checks to run (default: all)")
    add("--full", action="store_true", help="all particles, four views and the whole history (default: a sample)")
    add("--replay", metavar="FILE", help="rerun the check of FILE, a file in DIR/failures")
    add("--device", choices=("cpu", "cuda"), default="cpu", help="where to compute (default: cpu)")


def run(args: argparse.Namespace) -> int:
    if args.stability is None and not args.replay:
        from gsim3d.testing.doctor import check_installation

        if args.only or args.full or args.device != "cpu":
            raise InputError("--only, --full and --device need --stability (see gsim3d doctor --help)")
        return 0 if check_installation() else 1
    from gsim3d.pretrained.loading import check_device
    from gsim3d.testing.stability import check_stability, describe, replay

    check_device(args.device)
    if args.replay:
        report = replay(args.replay, args.device)
        print(describe(report))
        return 0 if report.healthy else 1
    out, options = Path(args.out), {"n_steps": args.steps, "only": args.only, "device": args.device}
    report = check_stability(args.stability, out, **options, full=args.full)
    print(describe(report))
    print(f"written: {out / 'report.md'}, {out / 'report.json'}")
    return 0 if report.healthy else 1
