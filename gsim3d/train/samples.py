"""Training samples: windows of scenes with their input and target images."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import torch
from torch import Tensor

from gsim3d.cameras import Frames, TensorRecord
from gsim3d.data import Scene, Window, generator, make_frames
from gsim3d.data.fitting import frame_stride
from gsim3d.effects.spec import EffectsSpec, Sleep
from gsim3d.errors import InputError
from gsim3d.priors.position_waves import relative_positions
from gsim3d.state import DYNAMIC, FROZEN, Particles, split_rows
from gsim3d.train.config import DataConfig, PhaseConfig

WAVES, WAVELENGTHS = 16, (4.0, 64.0)  # of position noise, in cells
READERS = 2  # threads that read batches, and number of batches read ahead


@dataclass(frozen=True)
class Batch(TensorRecord):
    """Windows of B scenes, each of n_context + n_future steps."""

    context: Frames  #: input images of the first n_context steps of each window
    targets: Frames  #: target images of all steps; image i shows cloud b * (n_context + n_future) + t
    n_context: int  #: number of encoded steps
    n_future: int  #: number of simulated steps
    cut: int = 0  #: see :class:`gsim3d.train.config.PhaseConfig`
    noise: Tensor | None = None  #: result of :func:`draw_noise`


class BatchReader:
    """Reads the batches of a run, prefetching those of the next steps.

    Args:
        draw: function (step, samples) -> batch; deterministic, called in other threads.
        n_steps: number of steps of the run.
    """

    def __init__(self, draw: Callable[[int, tuple[int, ...]], Batch], n_steps: int):
        self._draw, self._n_steps = draw, n_steps
        self._ahead: dict[tuple, Future] = {}
        self._pool = ThreadPoolExecutor(READERS)

    def __call__(self, step: int, samples: Sequence[int]) -> Batch:
        now, *later = ((number, tuple(samples)) for number in range(step, step + 1 + READERS))
        known = self._ahead.pop(now, None)
        for key in list(self._ahead):
            if key[0] < step:  # prefetched, but not used: the next phase has other samples
                self._ahead.pop(key, None)
        for key in later:
            if key[0] < self._n_steps and key not in self._ahead:
                self._ahead[key] = self._pool.submit(self._draw, *key)
        return self._draw(*now) if known is None else known.result()


def check_scenes(scenes: Sequence[Scene], data: DataConfig, phases: Sequence[PhaseConfig]) -> None:
    """Raises InputError if a scene has too few steps or cameras for a phase, or differs from the others."""
    if not scenes:
        raise InputError("there is no scene to train on")
    for scene in scenes:
        first = scenes[0]
        if (scene.width, scene.height) != (first.width, first.height):
            own, other = f"{scene.width}x{scene.height} pixels", f"{first.width}x{first.height}; set data.resize"
            raise InputError(f"{scene.path}: images of {own}, those of {first.path} have {other}")
        if frame_stride(scene.fps, first.fps) != 1 and min(scene.n_steps, first.n_steps) > 1:
            own = f"{scene.path}: {scene.fps:g} frames per second"
            raise InputError(f"{own}, {first.path} has {first.fps:g}; rates must be equal")
        for phase in phases:
            n_steps = (phase.history or data.history) + phase.horizon
            if scene.n_steps < n_steps:
                own = f"{scene.path}: {scene.n_steps} steps"
                raise InputError(f"{own}; windows of {n_steps} steps do not fit: lower history or horizon")
            if not data.leave_one_out and scene.n_cams - data.targets_apart * data.context_views < phase.target_views:
                raise InputError(f"{scene.path}: {scene.n_cams} cameras; {phase.target_views} target views do not fit")
        if (given := len(context_cameras(scene, data))) < (wanted := data.context_views):
            raise InputError(f"{scene.path}: {given} cameras may be inputs; lower data.context_views ({wanted})")


def context_cameras(scene: Scene, data: DataConfig) -> list[int]:
    """Returns the allowed input cameras, ascending."""
    allowed = data.context_cameras or range(scene.n_cams)
    for name in ("context_cameras", "target_only_cameras"):
        if bad := [cam for cam in getattr(data, name) or () if not 0 <= cam < scene.n_cams]:
            raise InputError(f"{scene.path}: has {scene.n_cams} cameras; camera {bad[0]} of data.{name} does not exist")
    return sorted(set(allowed) - set(data.target_only_cameras))


def draw_batch(
    scenes: Sequence[Scene], data: DataConfig, phase: PhaseConfig, seed: int, step: int, samples: Sequence[int]
) -> Batch:
    """Draws ``samples`` of optimizer step ``step``; each depends on (seed, step, sample) only.

    Context views are evenly spaced in the list of allowed cameras, with a random offset, and equal at all steps of a
    window; target views are drawn from all cameras at every step.
    """
    windows = draw_windows(scenes, data, phase, seed, step, samples)
    n_context, chosen = windows[0].n_context, [window.scene for window in windows]
    given = [window.steps[:n_context] for window in windows]
    context = make_frames(chosen, [window.context_cams for window in windows], given)
    target_cams, steps = [window.target_cams for window in windows], [window.steps for window in windows]
    targets = dataclasses.replace(make_frames(chosen, target_cams, steps), actions=None)
    if context.actions is not None:  # of the window, so that all batches have the same shape
        actions = context.actions.between((0,) * len(chosen), n_context + phase.horizon)
        context = dataclasses.replace(context, actions=actions)
    noise = draw_noise(data, n_context, seed, step, samples)
    return Batch(subsampled(context, data), targets, n_context, phase.horizon, phase.cut, noise)


def draw_windows(
    scenes: Sequence[Scene], data: DataConfig, phase: PhaseConfig, seed: int, step: int, samples: Sequence[int]
) -> list[Window]:
    """Draws the windows of :func:`draw_batch`; reads only the numbers of steps and cameras of ``scenes``."""
    n_context = history_at(data, phase, seed, step)
    data = dataclasses.replace(data, context_views=_drawn(data.fewest_views, data.context_views, seed, step, "views"))
    return [_draw_window(scenes, data, phase, n_context, seed, step, sample) for sample in samples]


def history_at(data: DataConfig, phase: PhaseConfig, seed: int, step: int) -> int:
    """Returns the number of encoded steps of an optimizer step."""
    return phase.history or _drawn(data.shortest_history, data.history, seed, step, "history")


def _drawn(least: int, most: int, seed: int, step: int, purpose: str) -> int:
    """Draws an integer from ``least`` to ``most``, equal for all samples of a step; ``most`` if least is 0."""
    return int(generator(seed, step, 0, f"number of {purpose}").integers(least, most + 1)) if least else most


def _draw_window(
    scenes: Sequence[Scene], data: DataConfig, phase: PhaseConfig, n_context: int, seed: int, step: int, sample: int
) -> Window:
    rng = generator(seed, step, sample, "window")
    scene = scenes[int(rng.integers(len(scenes)))]
    n_steps = n_context + phase.horizon
    n_starts = scene.n_steps - n_steps + 1
    start = int(rng.integers(min(n_starts, phase.begin_within or n_starts)))
    if rng.random() < phase.from_start:
        start = 0
    views = generator(seed, step, sample, "views")
    cameras = context_cameras(scene, data)
    context = spread_views(cameras, data.context_views, int(views.integers(len(cameras))))
    seen = [cam for cam in range(scene.n_cams) if not (data.targets_apart and cam in context)]
    targets = tuple(
        tuple(seen[index] for index in views.permutation(len(seen))[: phase.target_views]) for _ in range(n_steps)
    )
    targets = (context,) * n_steps if data.leave_one_out else targets
    return Window(scene, start, n_context, (context,) * n_context, targets)


def spread_views(cameras: Sequence[int], count: int, turn: int) -> tuple[int, ...]:
    """Returns ``count`` of ``cameras``, evenly spaced in the circular list from index ``turn``."""
    n = len(cameras)
    return tuple(sorted(cameras[(turn + k * n // count) % n] for k in range(count)))


def subsampled(frames: Frames, data: DataConfig) -> Frames:
    """Returns ``frames`` with the masks and strides of ``data``."""
    return frames.subsample(data.background_stride, data.body_stride, data.masks)


def draw_noise(data: DataConfig, n_context: int, seed: int, step: int, samples: Sequence[int]) -> Tensor | None:
    """Draws ``data.position_noise`` of all Q encoded clouds; None: there is none. Returns float64 [Q, WAVES, 7]: for
    each wave the phase's gradient in 1 / cell, the phase, and the amplitude along each axis in metres."""
    if not data.position_noise:
        return None
    clouds = []
    for sample in samples:
        rng = generator(seed, step, sample, "position noise")
        along, moved = rng.standard_normal((2, n_context, WAVES, 3))
        length, phase = rng.uniform(*np.log(WAVELENGTHS), (n_context, WAVES, 1)), rng.random((n_context, WAVES, 1))
        along *= 2 * np.pi / np.exp(length) / np.linalg.norm(along, axis=-1, keepdims=True)
        moved *= data.position_noise * (2 / WAVES) ** 0.5
        clouds.append(np.concatenate([along, 2 * np.pi * phase, moved], -1))
    return torch.from_numpy(np.concatenate(clouds))


def displaced(particles: Particles, noise: Tensor | None, cell: float) -> Particles:
    """Displaces the movable particles of each cloud by the waves of :func:`draw_noise`, for cells of ``cell`` metres.

    Neighbours move together, as with the errors of a network: the mean of independent displacements would vanish.
    """
    if noise is None:
        return particles
    starts, places = particles.clouds.starts, relative_positions(particles).detach() / cell
    parts = zip(split_rows(places, list(pairwise(starts))), noise, strict=True)
    moved = torch.cat([(part @ waves[:, :3].T + waves[:, 3]).sin() @ waves[:, 4:] for part, waves in parts])
    moved = torch.where((particles.activity == DYNAMIC)[:, None], moved.to(particles.means), 0)
    return dataclasses.replace(particles, means=particles.means + moved)


def unfreeze(particles: Particles, most: float, spec: EffectsSpec, rng: np.random.Generator) -> Particles:
    """Makes a random fraction, drawn for each scene up to ``most``, of the frozen background movable (an augmentation).
    All or none of the frozen particles of a cube become movable, at all steps; the sleep rule of ``spec``, or the
    default one, gives the edge length of cubes. One draw of ``rng`` per scene and per cube."""
    edge = (spec.dynamics.sleep or Sleep()).halo
    scene = particles.row_scene()
    cube = torch.floor((particles.means.detach().double() - particles.origin[scene]) / edge).nan_to_num().long()
    _, index = torch.unique(torch.cat([scene[:, None], cube], 1), dim=0, return_inverse=True)
    shares = torch.as_tensor(most * rng.random(particles.origin.shape[0]), device=scene.device)
    draws = torch.as_tensor(rng.random(int(index.max()) + 1 if index.numel() else 0), device=scene.device)
    movable = (particles.activity == FROZEN) & (draws[index] < shares[scene])
    return dataclasses.replace(particles, activity=torch.where(movable, DYNAMIC, particles.activity))
