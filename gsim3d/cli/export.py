"""Writes 3D Gaussians in a format that other tools open, or as a video.

FILE's suffix chooses the format (docs/reference/splat_formats.md has their bounds):
  .ply             3DGS layout, read by everything               .spz              Niantic, Babylon, Cesium
  .compressed.ply  PlayCanvas, SuperSplat                        .glb              glTF with KHR_gaussian_splatting
  .splat           web viewers; no view dependence               .usdc .usda       USD with time (gsim3d[usd])
  .mp4             a video from a camera that circles around      .html             plays in a browser, one file

examples:
  gsim3d export runs/ball --to ball.usdc                  all predicted frames of gsim3d simulate
  gsim3d export runs/ball --to ball.mp4 --size 720        a video from an orbiting camera, with the time
  gsim3d export garden.ply --to orbit.mp4                 once around a single frame, in six seconds
  gsim3d export runs/ball --scene data/elastic/ball/0000 --to ball.html    truth beside prediction; also .mp4
"""

import argparse

from gsim3d.cli.arguments import number, whole


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    help = "a file of Gaussians, a folder with one a frame, or what gsim3d simulate wrote"
    add("target", metavar="TARGET", help=help)
    add("--to", metavar="FILE", required=True, help="file to write; must not exist yet")
    add("--frame", type=whole(-(10**6), 10**6), metavar="N", help="one frame; negative: from the end")
    add("--fps", type=number(0, 1e6, above=True), help="frames a second (default: TARGET's, else 24)")
    add("--up", choices=("y", "z"), help="axis that points up in TARGET (default: as its format says)")
    add("--up-to", choices=("y", "z"), help="the same in FILE (default: as its readers expect)")
    add("--size", type=whole(16, 4096), metavar="PX", help="of a video (default 512)")
    add("--turns", type=number(-1e3, 1e3), help="of a video's camera (default 0.25; 1 around a single frame)")
    add("--scene", metavar="SCENE", help="recorded scene that TARGET predicts: truth beside it")
    add("--start", type=whole(0), default=0, help="step of SCENE that is shown first (default 0)")
    add("--camera", type=whole(0), default=0, metavar="CAM", help="of SCENE (default 0)")


def run(args: argparse.Namespace) -> int:
    from gsim3d.errors import InputError
    from gsim3d.io.sequence import open_sequence
    from gsim3d.io.terminal import progress
    from gsim3d.viewer.export import FPS, write_frames
    from gsim3d.viewer.targets import open_target

    if args.scene is None and (args.start or args.camera):
        raise InputError("--start and --camera belong to --scene")
    of_format = {"mp4": ("up_to",), "html": ("up_to", "size", "turns")}
    unused = of_format.get(args.to.lower().rpartition(".")[2], ("size", "turns"))
    if given := [f"--{name.replace('_', '-')}" for name in unused if getattr(args, name) is not None]:
        raise InputError(f"{args.to}: no file of this format has {' or '.join(given)}")
    if args.scene is None:
        sequence = open_sequence(args.target, args.up)
        chosen = range(len(sequence))[slice(None) if args.frame is None else slice(args.frame, args.frame + 1 or None)]
        if not chosen:
            raise InputError(f"--frame {args.frame}: {args.target} has {len(sequence)} frames, from 0")
        frames, fps = (sequence[one] for one in progress(chosen, unit="frame")), args.fps or sequence.fps or FPS
        options = {"fps": fps, "up": args.up_to, "size": args.size or 512, "turns": args.turns}
        print(write_frames(args.to, frames, len(chosen), **options))
        return 0
    if args.frame is not None or args.size or args.turns is not None:
        raise InputError("--frame, --size and --turns do not go with --scene: its camera sees every frame")
    shown = open_target(args.target, scene=args.scene, start=args.start, fps=args.fps, up=args.up)
    print(shown.export_beside(args.to, args.camera))
    return 0
