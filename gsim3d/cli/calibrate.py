"""Computes intrinsics, poses and time offsets of videos, and writes cameras.json.

DIR holds one video a camera, <camera>.mp4, or one folder of such videos for each take. The cameras must not move.

With --board, videos of a ChArUco board lie in DIR/board (or the videos show it themselves): move the board slowly,
tilted, into all corners of every image, then lay it on the floor in view of a camera. The world is the
board at the end: z points out of its printed side, lengths are metres. Without --board, COLMAP matches features of
the still background (pip install 'gsim3d[capture]'); lengths are metres with --scale only.

Videos that start at different times are aligned by the motion that they show, if it then agrees clearly better. Writes
cameras.json beside the videos (docs/reference/data.md, videos), with the reprojection error of each camera.

examples:
  gsim3d calibrate videos --board 7 5 0.04
  gsim3d calibrate videos --scale left right 1.2
"""

import argparse
from typing import Any

from gsim3d.cli.arguments import number
from gsim3d.errors import InputError


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("folder", metavar="DIR", help="folder with the videos of a take, or a folder for each take")
    add_calibration(parser)
    parser.add_argument("--synchronous", action="store_true", help="the videos start at one time: do not align them")
    parser.add_argument("--force", action="store_true", help="also write a calibration that does not fit")


def add_calibration(parser: argparse.ArgumentParser) -> None:
    """Adds the options that describe the board or the scale."""
    add, length = parser.add_argument, number(0, above=True)
    board = ("COLUMNS", "ROWS", "SIDE")
    add("--board", nargs=3, type=length, metavar=board, help="squares of a ChArUco board, and their side in metres")
    add("--marker", type=length, metavar="M", default=0.0, help="side of its markers, metres (default: 0.75 squares)")
    add("--dictionary", default="4X4_50", help="its markers, by OpenCV's name (default: 4X4_50)")
    add("--scale", nargs=3, metavar=("A", "B", "M"), help="two cameras and the distance between them in metres")


def calibration_of(args: argparse.Namespace) -> dict[str, Any]:
    """Returns the arguments ``board`` and ``scale`` of :func:`gsim3d.capture.calibrate.calibrate`."""
    from gsim3d.capture.board import Board

    board = Board(*args.board, args.marker, args.dictionary) if args.board else None
    try:
        scale = args.scale and (*args.scale[:2], number(0, above=True)(args.scale[2]))
    except (ValueError, argparse.ArgumentTypeError):
        raise InputError(f"--scale: M must be a positive number of metres; got {args.scale[2]!r}") from None
    return {"board": board, "scale": scale}


def run(args: argparse.Namespace) -> int:
    from gsim3d.capture.calibrate import calibrate

    calibrate(args.folder, **calibration_of(args), synchronous=args.synchronous, force=args.force)
    return 0
