"""What ``gsim3d export`` does: Gaussians of a file or folder in a format that other tools open, or as a video."""

from __future__ import annotations

from pathlib import Path

from gsim3d.errors import InputError
from gsim3d.io import write_video
from gsim3d.io.files import new_output_path
from gsim3d.io.formats import format_of, write_splats
from gsim3d.io.orbit import orbit_frames
from gsim3d.io.sequence import open_sequence
from gsim3d.io.terminal import progress
from gsim3d.viewer.player import write_player

FPS = 24.0


def export(
    target: str | Path,
    to: str | Path,
    *,
    frame: int | None = None,
    fps: float | None = None,
    up: str | None = None,
    up_to: str | None = None,
    size: int = 512,
    turns: float = 0.25,
) -> str:
    """Writes the file ``to``, whose suffix is its format; returns one line about what was written.

    Args:
        target: a file of Gaussians, a folder with one a frame, or what ``gsim3d simulate`` wrote.
        frame: one frame, negative: from the end; None: all.
        fps: frames per second; None: those of ``target``, else 24.
        up: "y" or "z", the axis that points up in ``target``; None: as its format says.
        up_to: the same in ``to``.
        size: pixels, width and height of a video.
        turns: turns of a video's camera around the scene.
    Raises:
        InputError: ``target`` cannot be read, or ``to`` cannot hold it.
    """
    out, sequence = new_output_path(to, "file"), open_sequence(target, up)
    fps, suffix = fps or sequence.fps or FPS, out.suffix.lower()
    chosen = range(len(sequence))
    if frame is not None:
        if not -len(sequence) <= frame < len(sequence):
            raise InputError(f"--frame {frame}: {target} has {len(sequence)} frames, from 0")
        chosen = [frame % len(sequence)]
    frames = (sequence[index] for index in progress(chosen, unit="frame"))
    if suffix == ".mp4":
        if size % 2:
            raise InputError(f"--size must be even for a video; got {size}")
        write_video(out, list(orbit_frames(frames, len(chosen), size, turns)), fps)
        what = f"a video of {size}x{size} pixels"
    elif suffix == ".html":
        gaussians = list(frames)
        write_player(out, gaussians, fps=fps, title=out.stem)
        what = f"{max(one.means.shape[0] for one in gaussians):,} Gaussians for any browser"
    else:
        suffix, kind = format_of(out)
        if len(chosen) > 1 and not kind.has_time:
            raise InputError(
                f"--to {to}: {suffix} holds one frame, and {target} has {len(sequence)}: choose one with --frame, or "
                "write .html, .usdc or .mp4"
            )
        gaussians = list(frames)
        write_splats(out, gaussians if kind.has_time else gaussians[0], fps=fps, up=up_to)
        what = f"{gaussians[0].means.shape[0]:,} Gaussians, {kind.about}"
        if max(one.sh.shape[1] for one in gaussians) > (kind.most_degree + 1) ** 2:
            what += f"; colours that depend on the view are not kept by {suffix}"
    rate = f"{len(chosen)} frames, {fps:g} a second, " if len(chosen) > 1 else ""
    return f"{out}: {rate}{what}; {out.stat().st_size / 1e6:.2f} MB"
