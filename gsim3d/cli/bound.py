"""Scores a perfect simulator whose initial state has the uncertainty of the input images.

Simulates and renders the scenes of a generated set again, with errors in the initial state of bodies that input images
do not determine:

  elastic, cloth   velocity 0.42 mm/step, position 2 mm, angle 10 mrad
  rigid            velocity 1 mm/step, spin 3 %

The errors have these magnitudes at the last of the four input steps, and random directions. "one" is the PSNR of one
simulation over all later steps and cameras, masked (without background) and on bodies; "mean of 4" that of the mean
image of four. --given adds the squared error of a model's input steps, which a perfect simulator would retain.

examples:
  gsim3d bound data/elastic --trajectories 24
  gsim3d bound data/elastic --given 34.4
  gsim3d bound data/elastic --given runs/model/metrics.json --out runs/bound

With --out, an interrupted command continues when it is run again.
"""

import argparse

from gsim3d.cli.arguments import whole


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("set", metavar="SET", help="data set of gsim3d generate")
    help = "a model's error of the input steps: masked PSNR in dB, or metrics.json of gsim3d evaluate"
    add("--given", metavar="DB|FILE", help=help)
    add("--trajectories", type=whole(1), metavar="N", help="number of trajectories (default: all)")
    add("--out", metavar="DIR", help="folder for bound.json and the errors of each scene")
    add("--processes", type=whole(1), metavar="N", help="number of processes (default: number of cores)")
    add("--quiet", action="store_true", help="no progress bar")


def run(args: argparse.Namespace) -> int:
    from gsim3d.synth.bound import bound, read_given, table

    given = None if args.given is None else read_given(args.given)
    options = {"trajectories": args.trajectories, "processes": args.processes, "out": args.out}
    print(table(bound(args.set, given=given, progress=not args.quiet, **options)))
    return 0
