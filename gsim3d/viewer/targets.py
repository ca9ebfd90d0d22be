"""What the live viewer opens without a simulator: files of Gaussians and recorded scenes."""

import dataclasses
import warnings
from dataclasses import dataclass
from pathlib import Path

import torch

from gsim3d.data import Scene, layouts
from gsim3d.errors import FitWarning, InputError
from gsim3d.io.particles import STATE, read_particles
from gsim3d.io.sequence import GAUSSIANS, Sequence, open_sequence
from gsim3d.state import Gaussians, Particles
from gsim3d.train.restore import Restored
from gsim3d.viewer.live import Target

FPS = 24.0  # of files that do not say


def open_target(
    target: str | Path,
    *,
    scene: str | Path | None = None,
    start: int = 0,
    fps: float | None = None,
    up: str | None = None,
) -> Target:
    """What ``target`` holds, to be looked at.

    Args:
        target: a file of Gaussians, a folder with one a frame, what ``gsim3d simulate`` wrote, or a recorded scene.
        scene: recorded scene that the Gaussians predict: its cameras and images are shown beside them.
        start: step of the scene that the first frame shows.
        fps: frames a second; None: those of ``target``, else of the scene, else FPS.
        up: "y" or "z", the axis that points up in files of Gaussians; None: as their format says.
    Raises:
        InputError: it is nothing of that kind, or is damaged; the message names it.
    """
    path = Path(target)
    if path.is_file() and state_of(path):
        raise InputError(f"{path}: a state is drawn by its simulator: name it with --checkpoint")
    if path.is_dir() and not (path / GAUSSIANS).is_dir() and layouts.find_layout(path):
        if scene is not None or up is not None:
            raise InputError(f"{path} is a recorded scene; --scene and --up belong to files of Gaussians")
        recorded = Scene.open(path)
        return Target(recorded.name, fps or recorded.fps, scene=recorded, first=_checked(recorded, start))
    sequence = open_sequence(path, up)
    recorded = None if scene is None else Scene.open(scene)
    name, fps = path.resolve().name, fps or sequence.fps
    if recorded is not None:
        frames, first = _InAxesOf(recorded, sequence), _checked(recorded, start)
        return Target(name, fps or recorded.fps, frames=frames, scene=recorded, first=first)
    if start:
        raise InputError(f"--start {start}: {path} has no such step without --scene")
    return Target(name, fps or FPS, frames=sequence)


def state_of(target: str | Path) -> Path | None:
    """The file of the state that ``target`` is, or that lies in this run; None: there is none."""
    path = Path(target)
    file = path / STATE if path.is_dir() else path
    return file if file.suffix == Path(STATE).suffix and file.is_file() else None


def open_state(path: Path, restored: Restored) -> Particles:
    """The particles of a state. Raises InputError where they are not those of a model like ``restored``."""
    particles, model = read_particles(path)
    restored.simulator._check(particles, str(path))
    if model != restored.checkpoint.digest:
        said = f"{path}: written with another checkpoint, whose particles may mean something else"
        warnings.warn(said, FitWarning, stacklevel=2)
    return particles


@dataclass(frozen=True)
class _InAxesOf:
    """Frames of a sequence, read when they are asked for, with positions that count from where a scene's do."""

    scene: Scene
    sequence: Sequence

    def __len__(self) -> int:
        return len(self.sequence)

    def __getitem__(self, frame: int) -> Gaussians:
        gaussians, offset = self.sequence[frame], torch.as_tensor(self.scene.world_offset, dtype=torch.float64)[None]
        if not offset.any() and gaussians.world_offset is None:
            return gaussians
        own = torch.zeros(1, 3, dtype=torch.float64) if gaussians.world_offset is None else gaussians.world_offset
        means = (gaussians.means.double() + own - offset).float()
        return dataclasses.replace(gaussians, means=means, world_offset=offset)


def _checked(scene: Scene, start: int) -> int:
    if not 0 <= start < scene.n_steps:
        raise InputError(f"--start {start}: {scene.path} has {scene.n_steps} steps, from 0")
    return start
