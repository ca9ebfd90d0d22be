"""What the live viewer opens: files of Gaussians, recorded scenes, and scenes that a simulator predicts."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Sequence
from pathlib import Path

import torch

from gsim3d.data import Scene, layouts
from gsim3d.effects.edits import Duplicate, Edit, Move, Operation, Recolor, Remove, Throw, structure_of
from gsim3d.effects.selection import Selection
from gsim3d.effects.spec import OutputEffects
from gsim3d.errors import InputError
from gsim3d.io.sequence import GAUSSIANS, open_sequence
from gsim3d.state import Gaussians
from gsim3d.train.restore import Restored
from gsim3d.viewer.live import Target

FPS = 24.0  # of files that do not say
OPERATIONS = {"move": Move, "throw": Throw, "remove": Remove, "duplicate": Duplicate, "recolor": Recolor}
VECTORS = {"move": "by", "throw": "velocity", "duplicate": "by", "recolor": "color"}


class Simulation:
    """A scene and the simulator that predicts it, loaded once.

    Attributes:
        target: what it shows: encoded frames, then predicted ones.
        edits: changes of the scene up to now, their steps counted from the first predicted one.
        seconds_a_step: that the last prediction took.
    """

    def __init__(self, restored: Restored, scene: Scene, n_steps: int | None = None, start: int = 0):
        """
        Args:
            restored: simulator.
            scene: opened by ``restored``.
            n_steps: to predict; None: to the end of the recording.
            start: first input step.
        Raises:
            InputError: the scene has too few steps or cameras.
        """
        simulator, self.edits, self.seconds_a_step = restored.simulator, (), 0.0
        self._simulator, self._spec = simulator, dataclasses.replace(restored.plan.spec, outputs=OutputEffects())
        frames = scene.input_frames(simulator.inputs, start=start)
        strides = simulator.inputs.background_stride, simulator.inputs.body_stride
        with torch.no_grad():
            self._state = simulator.encode(frames.subsample(*strides).to(restored.device))
        self._offset = [float(x) for x in scene.world_offset]
        encoded = [self._state.select_clouds([cloud]) for cloud in range(self._state.n_clouds)]
        self.target = Target(
            scene.name,
            scene.fps,
            draw=simulator.renderer,
            particles=encoded,
            scene=scene,
            first=start,
            n_encoded=len(encoded),
        )
        self.simulate_on(len(encoded) - 1, n_steps or max(1, scene.n_steps - start - len(encoded)), ())

    @torch.no_grad()
    def simulate_on(self, frame: int, n_steps: int, operations: Sequence[Operation] = ()) -> float:
        """Predicts the frames after ``frame`` anew; earlier edits stay, those after ``frame`` are dropped.

        The rollout starts at the encoded steps each time: the history after an edit holds its change of the past.

        Args:
            frame: the last that stays as it is.
            n_steps: to predict after it.
            operations: changes of the scene right after ``frame``.
        Returns:
            Seconds that a step took.
        Raises:
            InputError: an operation cannot be made, and nothing has changed; or ``frame`` is not the last encoded or a
                predicted one.
        """
        step = frame + 1 - self.target.n_encoded
        if not 0 <= step <= self.target.n_frames - self.target.n_encoded or n_steps < 1:
            raise InputError(
                f"simulate on: frame {frame} must be from {self.target.n_encoded - 1} to {self.target.n_frames - 1}, "
                f"and steps at least 1; got {n_steps}"
            )
        edits = (*(edit for edit in self.edits if edit.step < step), *(Edit(step, one) for one in operations))
        plan = self._simulator.plan(dataclasses.replace(self._spec, structure=structure_of(edits)))
        began = time.perf_counter()
        steps = self._simulator.rollout(self._state, step + n_steps, plan, edits=edits)
        seconds = (time.perf_counter() - began) / len(steps)
        self.edits, self.seconds_a_step = edits, seconds
        self.target.replace([*self.target.particles[: self.target.n_encoded], *steps])
        return seconds

    def operation(
        self,
        name: str,
        which: str,
        vector: Sequence[float],
        box: tuple[Sequence[float], Sequence[float]] | None = None,
    ) -> Operation:
        """The operation that a user chose.

        Args:
            name: one of OPERATIONS.
            which: particles, as of :class:`gsim3d.effects.selection.Selection`.
            vector: metres of a move or a copy, metres a step of a throw, or a colour.
            box: lowest and highest corner, in the axes of the viewer; None: everywhere.
        Raises:
            InputError: there is no such operation or selection.
        """
        if name not in OPERATIONS:
            raise InputError(f"operation must be one of {', '.join(OPERATIONS)}; got {name!r}")
        corners = None
        if box is not None:
            corners = tuple(tuple(float(x) + o for x, o in zip(corner, self._offset, strict=True)) for corner in box)
        fields = {VECTORS[name]: tuple(float(x) for x in vector)} if name in VECTORS else {}
        return OPERATIONS[name](Selection(which, corners), **fields)


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
    if path.is_dir() and not (path / GAUSSIANS).is_dir() and _is_scene(path):
        if scene is not None or up is not None:
            raise InputError(f"{path} is a recorded scene; --scene and --up belong to files of Gaussians")
        recorded = Scene.open(path)
        return Target(recorded.name, fps or recorded.fps, scene=recorded, first=_checked(recorded, start))
    sequence = open_sequence(path, up)
    recorded = None if scene is None else Scene.open(scene)
    if recorded is None and start:
        raise InputError(f"--start {start}: {path} has no such step without --scene")

    def read(frame: int) -> Gaussians:
        gaussians = sequence[frame]
        return gaussians if recorded is None else _in_axes_of(recorded, gaussians)

    return Target(
        path.resolve().name,
        fps or sequence.fps or (FPS if recorded is None else recorded.fps),
        n_frames=len(sequence),
        read=read,
        scene=recorded,
        first=0 if recorded is None else _checked(recorded, start),
    )


def _is_scene(folder: Path) -> bool:
    try:
        layouts.layout_of(folder)
    except InputError:
        return False
    return True


def _checked(scene: Scene, start: int) -> int:
    if not 0 <= start < scene.n_steps:
        raise InputError(f"--start {start}: {scene.path} has {scene.n_steps} steps, from 0")
    return start


def _in_axes_of(scene: Scene, gaussians: Gaussians) -> Gaussians:
    """``gaussians`` with positions that count from the point that the scene's cameras count from."""
    offset = torch.as_tensor(scene.world_offset, dtype=torch.float64)[None]
    if not offset.any() and gaussians.world_offset is None:
        return gaussians
    own = torch.zeros(1, 3, dtype=torch.float64) if gaussians.world_offset is None else gaussians.world_offset
    means = (gaussians.means.double() + own - offset).float()
    return dataclasses.replace(gaussians, means=means, world_offset=offset)
