"""What ``gsim3d export --scene`` does: a film or player with the truth beside what was predicted."""

from pathlib import Path

import numpy as np

from gsim3d.errors import InputError
from gsim3d.io import write_video
from gsim3d.io.files import new_output_path
from gsim3d.viewer.films import film_frames
from gsim3d.viewer.live import Layers
from gsim3d.viewer.player import View, write_player
from gsim3d.viewer.targets import open_target


def export_comparison(
    target: str | Path,
    to: str | Path,
    scene: str | Path,
    *,
    camera: int = 0,
    start: int = 0,
    fps: float | None = None,
    up: str | None = None,
) -> str:
    """Writes the .mp4 or .html file ``to``; returns one line about what was written.

    Args:
        target: Gaussians of every frame, as of :func:`gsim3d.viewer.export.export`.
        scene: recorded scene that they predict.
        camera: of the scene, that sees both.
        start: step of the scene that the first frame shows.
        fps: frames per second; None: those of ``target``, else of the scene.
        up: "y" or "z", the axis that points up in ``target``; None: as its format says.
    Raises:
        InputError: a file cannot be read, the scene lacks the camera or the step, or ``to`` has another suffix.
    """
    out = new_output_path(to, "file")
    if out.suffix.lower() not in (".mp4", ".html"):
        raise InputError(f"--scene: {to} holds no true images; write .mp4 or .html")
    shown = open_target(target, scene=scene, start=start, fps=fps, up=up)
    recorded = shown.scene
    if not 0 <= camera < recorded.n_cams:
        raise InputError(f"--camera {camera}: {scene} has {recorded.n_cams} cameras, from 0")
    pairs = [shown.beside(frame, camera, Layers()) for frame in range(shown.n_frames)]
    truth, predicted = np.split(np.stack(pairs), 2, axis=2)
    if out.suffix.lower() == ".mp4":
        write_video(out, film_frames({"truth": truth[:, None], "predicted": predicted[:, None]}, shown.fps), shown.fps)
    else:
        seen = recorded.cameras_at([camera], [start])
        view = View(seen.viewmats[0].numpy(), seen.Ks[0].numpy(), seen.width, seen.height)
        frames = [shown.gaussians(frame) for frame in range(shown.n_frames)]
        write_player(out, frames, fps=shown.fps, title=out.stem, view=view, truth=list(truth))
    rate = f"{shown.n_frames} frames, {shown.fps:g} a second"
    return f"{out}: {rate}, truth beside prediction; {out.stat().st_size / 1e6:.2f} MB"
