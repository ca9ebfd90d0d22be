"""``gsim3d export``: Gaussians as a file that other tools open, or as a video."""

from __future__ import annotations

import argparse

from gsim3d.cli.arguments import number, whole

EPILOG = """\
FILE's suffix chooses the format (docs/reference/splat_formats.md has their bounds):
  .ply             3DGS layout, read by everything               .spz              Niantic, Babylon, Cesium
  .compressed.ply  PlayCanvas, SuperSplat                        .glb              glTF with KHR_gaussian_splatting
  .splat           web viewers; no view dependence               .usdc .usda       USD with time (gsim3d[usd])
  .mp4             a video from a camera that circles around      .html             plays in a browser, one file

examples:
  gsim3d export runs/ball --to ball.usdc                  all predicted frames of gsim3d simulate
  gsim3d export runs/ball --frame -1 --to ball.spz        the last one
  gsim3d export runs/ball --to ball.mp4 --size 720        a film from an orbiting camera, with the time
  gsim3d export garden.ply --to orbit.mp4                 once around a single frame, in six seconds
  gsim3d export garden.ply --to garden.splat
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.description = "Write 3D Gaussians in a format that other tools open, or as a video."
    parser.epilog = EPILOG
    parser.add_argument(
        "target", metavar="TARGET", help="a file of Gaussians, a folder with one a frame, or what gsim3d simulate wrote"
    )
    parser.add_argument("--to", metavar="FILE", required=True, help="file to write; must not exist yet")
    parser.add_argument("--frame", type=whole(-(10**6), 10**6), metavar="N", help="one frame; negative: from the end")
    parser.add_argument("--fps", type=number(0, 1e6, above=True), help="frames a second (default: TARGET's, else 24)")
    parser.add_argument("--up", choices=("y", "z"), help="axis that points up in TARGET (default: as its format says)")
    parser.add_argument("--up-to", choices=("y", "z"), help="the same in FILE (default: as its readers expect)")
    parser.add_argument("--size", type=whole(16, 4096), default=512, metavar="PX", help="of a video (default 512)")
    turns = "of a video's camera (default 0.25; 1 around a single frame)"
    parser.add_argument("--turns", type=number(-1e3, 1e3), help=turns)


def run(args: argparse.Namespace) -> int:
    from gsim3d.viewer.export import export

    print(export(**vars(args)))
    return 0
