"""``gsim3d export``: Gaussians as a file that other tools open, or as a film."""

from __future__ import annotations

import argparse

from gsim3d.cli.arguments import number, whole

EPILOG = """\
FILE's suffix chooses the format (docs/reference/splat_formats.md has their bounds):
  .ply             3DGS layout, read by everything               .spz              Niantic, Babylon, Cesium
  .compressed.ply  PlayCanvas, SuperSplat                        .glb              glTF with KHR_gaussian_splatting
  .splat           web viewers; no view dependence               .usdc .usda       USD with time (gsim3d[usd])
  .mp4             a film from a camera that circles around      .html             plays in a browser, one file

examples:
  gsim3d export runs/ball --to ball.usdc                  all predicted frames of gsim3d simulate
  gsim3d export runs/ball --frame -1 --to ball.spz        the last one
  gsim3d export runs/ball --to ball.mp4 --size 720
  gsim3d export garden.ply --to garden.splat
"""
FPS = 24.0


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the options of `gsim3d export` to ``parser``."""
    parser.description = "Write 3D Gaussians in a format that other tools open, or as a film."
    parser.epilog = EPILOG
    parser.add_argument(
        "target", metavar="TARGET", help="a file of Gaussians, a folder with one a frame, or what gsim3d simulate wrote"
    )
    parser.add_argument("--to", metavar="FILE", required=True, help="file to write; must not exist yet")
    parser.add_argument("--frame", type=whole(-(10**6), 10**6), metavar="N", help="one frame; negative: from the end")
    parser.add_argument("--fps", type=number(0, 1e6, above=True), help="frames a second (default: TARGET's, else 24)")
    parser.add_argument("--up", choices=("y", "z"), help="axis that points up in TARGET (default: as its format says)")
    parser.add_argument("--up-to", choices=("y", "z"), help="the same in FILE (default: as its readers expect)")
    parser.add_argument("--size", type=whole(16, 4096), default=512, metavar="PX", help="of a film (default 512)")
    parser.add_argument("--turns", type=number(-1e3, 1e3), default=0.25, help="of a film's camera (default 0.25)")


def run(args: argparse.Namespace) -> int:
    """Writes the file; returns the exit code."""
    from tqdm import tqdm

    from gsim3d.errors import InputError
    from gsim3d.io import write_video
    from gsim3d.io.files import new_output_path
    from gsim3d.io.formats import format_of, write_splats
    from gsim3d.io.orbit import orbit_frames
    from gsim3d.io.sequence import open_sequence
    from gsim3d.viewer import write_player

    out, sequence = new_output_path(args.to, "file"), open_sequence(args.target, args.up)
    fps = args.fps or sequence.fps or FPS
    chosen = range(len(sequence))
    if args.frame is not None:
        if not -len(sequence) <= args.frame < len(sequence):
            raise InputError(f"--frame {args.frame}: {args.target} has {len(sequence)} frames, from 0")
        chosen = [args.frame % len(sequence)]
    frames = (sequence[frame] for frame in tqdm(chosen, unit="frame", disable=None, leave=False))
    if out.suffix.lower() == ".mp4":
        if args.size % 2:
            raise InputError(f"--size must be even, as films are; got {args.size}")
        write_video(out, list(orbit_frames(frames, len(chosen), args.size, args.turns)), fps)
        what = f"a film of {args.size}x{args.size} pixels"
    elif out.suffix.lower() == ".html":
        made = list(frames)
        write_player(out, made, fps=fps, title=out.stem)
        what = f"{max(one.means.shape[0] for one in made):,} Gaussians for any browser"
    else:
        suffix, kind = format_of(out)
        if len(chosen) > 1 and not kind.has_time:
            raise InputError(
                f"--to {args.to}: {suffix} holds one frame, and {args.target} has {len(sequence)}: choose one with "
                "--frame, or write .html, .usdc or .mp4"
            )
        made = list(frames)
        write_splats(out, made if kind.has_time else made[0], fps=fps, up=args.up_to)
        lost = max(made, key=lambda one: one.sh.shape[1]).sh.shape[1] > (kind.most_degree + 1) ** 2
        what = f"{made[0].means.shape[0]:,} Gaussians, {kind.about}"
        what += f"; colours that depend on the view are not kept by {suffix}" if lost else ""
    rate = f"{len(chosen)} frames, {fps:g} a second, " if len(chosen) > 1 else ""
    print(f"{out}: {rate}{what}; {out.stat().st_size / 1e6:.2f} MB")
    return 0
