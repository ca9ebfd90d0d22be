"""`gsim3d bound`: the command of gsim3d.synth.bound."""

from __future__ import annotations

import argparse
import math

from gsim3d.cli.arguments import whole
from gsim3d.errors import InputError
from gsim3d.io.files import MAX_TEXT, read_file
from gsim3d.io.plain import parse_json

EPILOG = """\
The scenes of a set that gsim3d generate made are simulated again, with errors in how bodies start that images leave
open, and rendered exactly:

  elastic, cloth   velocity 0.42 mm a step, place 2 mm, angle 10 mrad
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
    """Adds the options of `gsim3d bound` to ``parser``."""
    parser.description = "What a perfect simulator scores that sees the start of a scene as well as images show it."
    parser.epilog = EPILOG
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
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
    """Prints the bounds of the set that ``args`` names; returns the exit code."""
    from gsim3d.synth.bound import bound

    given = None if args.given is None else read_given(args.given)
    summary = bound(
        args.set,
        given=given,
        trajectories=args.trajectories,
        processes=args.processes,
        out=args.out,
        progress=not args.quiet,
    )
    print(table(summary))
    return 0


def read_given(text: str) -> dict[str, float]:
    """Metric -> PSNR of given steps, dB, from a number or from a file that `gsim3d evaluate` wrote.

    Raises: InputError where it is neither.
    """
    try:
        given = {"psnr_masked": float(text)}
    except ValueError:
        try:
            scores = parse_json(read_file(text, MAX_TEXT))
            given = {metric: scores.get(f"past.{metric}") for metric in ("psnr_masked", "psnr_body")}
            given = {metric: float(value) for metric, value in given.items() if value is not None}
        except (OSError, ValueError, TypeError, AttributeError) as error:
            raise InputError(f"--given: {text} is neither a number nor a file of scores ({error})") from None
    if "psnr_masked" not in given:
        raise InputError(f"--given: {text} has no past.psnr_masked: name metrics.json of gsim3d evaluate")
    for metric, value in given.items():
        if not math.isfinite(value):
            raise InputError(f"--given: {metric} must be finite; got {value}")
    return given


def table(summary: dict) -> str:
    """The bounds by object and of all scenes, in dB with standard errors."""
    kinds = [
        (f"{part}{label}{more}", f"{kind}{suffix}", metric)
        for metric, part in (("psnr_masked", ""), ("psnr_body", "bodies: "))
        for suffix, more in (("", ""), ("_given", " + given"))
        for kind, label in (("one", "one"), ("mean", f"mean of {summary['samples']}"))
        if metric in summary.get(f"{kind}{suffix}", {})
    ]
    rows = [["", *(label for label, _, _ in kinds)]]
    for name, values in [*summary["objects"].items(), ("all", summary)]:
        cells = []
        for _, kind, metric in kinds:
            mean, error = values[kind][metric]
            cells.append(f"{mean:.2f}" + ("" if error is None else f" +- {error:.2f}"))
        rows.append([name, *cells])
    widths = [max(map(len, column)) for column in zip(*rows)]
    lines = [
        "  ".join([row[0].ljust(widths[0]), *(cell.rjust(w) for cell, w in zip(row[1:], widths[1:]))]) for row in rows
    ]
    given = "".join(f", {metric} of given steps {value:.2f}" for metric, value in (summary["given"] or {}).items())
    head = f"{summary['world']}, {summary['n_scenes']} scenes, {summary['n_future_steps']} steps, dB{given}"
    return "\n".join([head, *lines])
