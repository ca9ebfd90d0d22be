"""``gsim3d doctor``: what is installed, compiled and missing, how to get it, and a self-test of every op."""

from __future__ import annotations

import argparse

from gsim3d.cli.arguments import whole

EPILOG = """\
Without options: what is installed and compiled, and every op against plain torch.

With --stability: invariances of the model (a scene that is moved, rotated, reordered, repeated, split, or extended by
a far particle has the same future) and stress tests on your scenes (black images, one view, NaN, coinciding particles,
unusual cameras, a long rollout, gradients). Each failure names camera, particle and step, and leaves a file in
DIR/failures that reproduces it. The report is DIR/report.md and DIR/report.json. What a simulator that comes with
gsim3d is known to break, by its model card, is called a known failure.

examples:
  gsim3d doctor
  gsim3d doctor --stability runs/model runs/data
  gsim3d doctor --stability elastic-small runs/data --full
  gsim3d doctor --stability small my_scene --steps 1000
  gsim3d doctor --stability --replay runs/stability/failures/translate.safetensors

Exit code 0: everything required works, every check holds. 1: something is broken, known or not. 2: the check could
not run.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.description = __doc__
    parser.epilog = EPILOG
    group = parser.add_argument_group("stability of a model or of scenes")
    group.add_argument(
        "--stability",
        nargs="*",
        metavar="PATH",
        help="check invariances and run stress tests instead: of a checkpoint, or of a preset with random weights "
        "(default: tiny), on a scene or folder of scenes (default: random images)",
    )
    group.add_argument(
        "--out", metavar="DIR", default="runs/stability", help="folder of the report (default: %(default)s)"
    )
    group.add_argument("--steps", type=whole(1), default=100, help="length of the long rollout (default: %(default)s)")
    group.add_argument("--only", nargs="+", metavar="CHECK", default=(), help="checks to make (default: all)")
    group.add_argument(
        "--full", action="store_true", help="all particles, four views and the whole history (default: a sample)"
    )
    group.add_argument("--replay", metavar="FILE", help="make the check again that FILE, from a report, reproduces")
    group.add_argument("--device", choices=("cpu", "cuda"), default="cpu", help="where to compute (default: cpu)")


def run(args: argparse.Namespace) -> int:
    if args.stability is None and not args.replay:
        from gsim3d.testing.doctor import check_installation

        return 0 if check_installation() else 1
    from pathlib import Path

    from gsim3d.pretrained.loading import check_device
    from gsim3d.testing.stability import Job, check_stability, describe, replay

    check_device(args.device)
    if args.replay:
        report = replay(args.replay, args.device)
        print(describe(report))
        return 0 if report.healthy else 1
    job = Job(args.stability, Path(args.out), args.steps, args.only, args.device, full=args.full)
    report = check_stability(job)
    print(describe(report))
    print(f"written: {job.out / 'report.md'}, {job.out / 'report.json'}")
    return 0 if report.healthy else 1
