"""``gsim3d bound``: what a perfect simulator scores."""

from __future__ import annotations

import argparse

from gsim3d.cli.arguments import whole

EPILOG = """\
The scenes of a set that gsim3d generate made are simulated again, with errors in how bodies start that images leave
open, and rendered exactly:

  elastic, cloth   velocity 0.42 mm a step, position 2 mm, angle 10 mrad
  rigid            velocity 1 mm a step, spin 3 %

All of the last of the four given steps, of this length and in random directions. "one" is the PSNR of one such
simulation over all later steps and cameras, masked (without background) and of bodies; "mean of 4" that of the mean
image of four. --given adds the squared error of a model's given steps, which a perfect simulator would keep.

examples:
  gsim3d bound data/elastic --trajectories 24
  gsim3d bound data/elastic --given 34.4
  gsim3d bound data/elastic --given runs/model/metrics.json --out runs/bound

With --out it may be killed at any time: run it again and it goes on where it stopped.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.description = "What a perfect simulator scores that sees the start of a scene as well as images show it."
    parser.epilog = EPILOG
    parser.add_argument("set", metavar="SET", help="data set that gsim3d generate made")
    parser.add_argument(
        "--given",
        metavar="DB|FILE",
        help="a model's error of given steps: masked PSNR in dB, or metrics.json of gsim3d evaluate",
    )
    parser.add_argument("--trajectories", type=whole(1), metavar="N", help="the first N of the set (default: all)")
    parser.add_argument("--out", metavar="DIR", help="folder for bound.json and what each scene gave")
    parser.add_argument("--processes", type=whole(1), metavar="N", help="default: one a core")
    parser.add_argument("--quiet", action="store_true", help="no progress bar")


def run(args: argparse.Namespace) -> int:
    from gsim3d.synth.bound import bound, read_given, table

    given = None if args.given is None else read_given(args.given)
    options = {"trajectories": args.trajectories, "processes": args.processes, "out": args.out}
    print(table(bound(args.set, given=given, progress=not args.quiet, **options)))
    return 0
