"""What ``gsim3d export`` does: Gaussians of a file or folder in a format that other tools open, or as a video."""

from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np

from gsim3d.errors import InputError
from gsim3d.io import write_video
from gsim3d.io.files import new_output_path, with_parents
from gsim3d.io.formats import format_of, write_splats
from gsim3d.io.orbit import orbit_frames
from gsim3d.state import Gaussians
from gsim3d.viewer.clips import write_time
from gsim3d.viewer.player import write_player

FPS = 24.0
ORBIT = 6.0  # seconds of a video of a single frame


def write_frames(
    to: str | Path,
    frames: Iterable[Gaussians],
    count: int,
    *,
    fps: float = FPS,
    up: str | None = None,
    size: int = 512,
    turns: float | None = None,
    start: int = 0,
) -> str:
    """Writes the file ``to``, whose suffix is its format; returns one line about what was written.

    Args:
        frames: ``count`` single frames.
        fps: frames a second.
        up: "y" or "z", the axis that points up in ``to``; None: as its format says.
        size: pixels, width and height of a video.
        turns: turns of a video's camera around the scene; None: a quarter, one around a single frame.
        start: number of the first predicted frame, of a player.
    Raises:
        InputError: ``to`` cannot hold it.
    """
    out = with_parents(new_output_path(to, "file", "--to"))
    if (suffix := out.suffix.lower()) == ".mp4":
        if size % 2:
            raise InputError(f"--size must be even for a video; got {size}")
        write_video(out, _orbit(list(frames), fps, size, turns), fps)
        what = f"a video of {size}x{size} pixels"
    elif suffix == ".html":
        write_player(out, gaussians := list(frames), fps=fps, title=out.stem, start=start)
        what = f"{max(one.means.shape[0] for one in gaussians):,} Gaussians for any browser"
    else:
        suffix, kind = format_of(out, (".mp4", ".html"))
        if count > 1 and not kind.has_time:
            instead = "choose one (--frame), or write .html, .usdc or .mp4"
            raise InputError(f"{to}: {suffix} holds one frame, and there are {count}: {instead}")
        gaussians = list(frames)
        write_splats(out, gaussians if kind.has_time else gaussians[0], fps=fps, up=up)
        what = f"{gaussians[0].means.shape[0]:,} Gaussians, {kind.about}"
        if max(one.sh.shape[1] for one in gaussians) > (kind.most_degree + 1) ** 2:
            what += f"; colours that depend on the view are not kept by {suffix}"
    rate = f"{count} frames, {fps:g} a second, " if count > 1 else ""
    return f"{out}: {rate}{what}; {out.stat().st_size / 1e6:.2f} MB"


def _orbit(frames: list[Gaussians], fps: float, size: int, turns: float | None) -> Iterator[np.ndarray]:
    """Images of ``frames`` with their time, or of a single one from all sides."""
    if len(frames) == 1:
        count = max(2, round(ORBIT * fps))
        yield from orbit_frames(frames * count, count, size, 1.0 if turns is None else turns)
        return
    for step, image in enumerate(orbit_frames(frames, len(frames), size, 0.25 if turns is None else turns)):
        write_time(image, step, fps)
        yield image
