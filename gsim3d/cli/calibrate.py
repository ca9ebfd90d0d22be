"""``gsim3d calibrate``: cameras of own films, from a ChArUco board or structure from motion."""

from __future__ import annotations

import argparse
from typing import Any

from gsim3d.cli.arguments import number

EPILOG = """\
DIR holds one film a camera, <camera>.mp4, or one folder of such films for each take. The cameras must not move.

With --board, films of a ChArUco board lie in DIR/board (or the films show it themselves): move the board slowly,
tilted, into all corners of every image, then lay it on the floor in view of a camera. The world is the
board at the end: z points out of its printed side, lengths are metres. Without --board, COLMAP matches features of
the still background (pip install 'gsim3d[capture]'); lengths are metres with --scale only.

Films that start at different times are aligned by the motion that they show. Writes cameras.json beside the films
(docs/reference/data.md, videos), with the reprojection error of each camera.

examples:
  gsim3d calibrate films --board 7x5 --square 0.04
  gsim3d calibrate films --scale left:right=1.2
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.description = "Computes intrinsics, poses and time offsets of films, and writes cameras.json."
    parser.epilog = EPILOG
    parser.add_argument("folder", metavar="DIR", help="folder with the films of a take, or with a folder for each take")
    add_calibration(parser)
    parser.add_argument("--force", action="store_true", help="also write a calibration that does not fit")


def add_calibration(parser: argparse.ArgumentParser) -> None:
    """Adds the options that describe the board or the scale."""
    add, length = parser.add_argument, number(0, 10, above=True)
    add("--board", type=_squares, metavar="CxR", help="columns x rows of squares of a ChArUco board, such as 7x5")
    add("--square", type=length, metavar="M", help="side of its squares, metres")
    add("--marker", type=length, metavar="M", default=0.0, help="side of its markers, metres (default: 0.75 squares)")
    add("--dictionary", default="4X4_50", help="its markers, by OpenCV's name (default: 4X4_50)")
    add("--scale", type=_scale, metavar="A:B=M", help="distance between two cameras, metres, such as left:right=1.2")


def calibration_of(args: argparse.Namespace) -> dict[str, Any]:
    """Returns the arguments ``board`` and ``scale`` of :func:`gsim3d.capture.calibrate.calibrate`."""
    from gsim3d.capture.board import Board
    from gsim3d.errors import InputError

    if (args.board is None) != (args.square is None):
        raise InputError("--board and --square belong together")
    board = args.board and Board(*args.board, args.square, args.marker, args.dictionary)
    return {"board": board, "scale": args.scale}


def _squares(text: str) -> tuple[int, int]:
    try:
        columns, rows = map(int, text.lower().split("x"))
    except ValueError:
        raise argparse.ArgumentTypeError(f"must be COLUMNSxROWS, such as 7x5; got {text!r}") from None
    return columns, rows


def _scale(text: str) -> tuple[str, str, float]:
    names, _, metres = text.rpartition("=")
    first, colon, second = names.partition(":")
    try:
        length = float(metres)
    except ValueError:
        length = 0.0
    if not colon or not 0 < length < float("inf"):
        raise argparse.ArgumentTypeError(f"must be CAMERA:CAMERA=METRES, such as left:right=1.2; got {text!r}")
    return first, second, length


def run(args: argparse.Namespace) -> int:
    from gsim3d.capture.calibrate import calibrate

    calibrate(args.folder, **calibration_of(args), force=args.force)
    return 0
