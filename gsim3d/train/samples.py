"""What one training step sees: windows of scenes, their input images and the images that the loss compares."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from gsim3d.cameras import Frames
from gsim3d.data import Scene, Window, generator, make_frames
from gsim3d.data.fitting import frame_stride
from gsim3d.errors import InputError
from gsim3d.train.config import DataConfig, StageConfig

LONG_AGO = 1000  # steps: more than any history has


@dataclass(frozen=True)
class Batch:
    """Windows of B scenes, all of n_context + n_lead + n_future steps.

    context: input images of the first n_context steps of each.
    targets: images of these and of the last n_future; image i shows cloud b * (n_context + n_future) + t. Where only
        the dynamics learns, of the last n_future alone.
    dynamics_alone, cut: as of :class:`gsim3d.train.config.StageConfig`.
    has_own_background: the first of the n_context steps tells the background alone, as if seen long ago.
    """

    context: Frames
    targets: Frames
    n_context: int
    n_future: int
    n_lead: int = 0
    dynamics_alone: bool = False
    cut: int = 0
    has_own_background: bool = False

    @property
    def n_past(self) -> int:
        """Encoded steps among the targets."""
        return 0 if self.dynamics_alone else self.n_context

    def to(self, device: str | torch.device) -> Batch:
        return dataclasses.replace(self, context=self.context.to(device), targets=self.targets.to(device))

    def target_step(self) -> Tensor:
        """int64 [I], the step in its window that each target image shows."""
        return self.targets.cameras.image_cloud % (self.n_past + self.n_future)


def check_scenes(scenes: Sequence[Scene], data: DataConfig, stages: Sequence[StageConfig]) -> None:
    """Raises InputError, naming the scene, where windows or views of a stage do not fit."""
    if not scenes:
        raise InputError("there is no scene to train on")
    for scene in scenes:
        first = scenes[0]
        if (scene.width, scene.height) != (first.width, first.height):
            raise InputError(
                f"{scene.path}: images of {scene.width}x{scene.height} pixels, those of {first.path} have "
                f"{first.width}x{first.height}; data.resize brings all to one size"
            )
        if frame_stride(scene.fps, first.fps) != 1 and min(scene.n_steps, first.n_steps) > 1:
            raise InputError(
                f"{scene.path}: {scene.fps:g} frames per second, {first.path} has {first.fps:g}; a model has one rate"
            )
        for stage in stages:
            n_steps = (stage.history or data.history) + stage.lead + stage.horizon + longest_gap(stage)
            if scene.n_steps < n_steps:
                raise InputError(f"{scene.path}: {scene.n_steps} steps; windows of {n_steps} steps do not fit")
            if scene.n_cams - data.targets_apart * data.context_views < stage.target_views:
                raise InputError(f"{scene.path}: {scene.n_cams} cameras; {stage.target_views} target views do not fit")
        if len(context_cameras(scene, data)) < data.context_views:
            raise InputError(f"{scene.path}: too few cameras for {data.context_views} context views")


def context_cameras(scene: Scene, data: DataConfig) -> list[int]:
    """Cameras whose images may be an input, ascending."""
    allowed = data.context_cameras or range(scene.n_cams)
    for name in ("context_cameras", "target_only_cameras"):
        if bad := [cam for cam in getattr(data, name) or () if not 0 <= cam < scene.n_cams]:
            raise InputError(
                f"{scene.path}: camera {bad[0]} of data.{name} does not exist; the scene has {scene.n_cams}"
            )
    return sorted(set(allowed) - set(data.target_only_cameras))


def draw_batch(
    scenes: Sequence[Scene], data: DataConfig, stage: StageConfig, seed: int, step: int, samples: Sequence[int]
) -> Batch:
    """Samples number ``samples`` of optimizer step ``step``: functions of (seed, step, sample) only.

    Context views are spread evenly around the list of allowed cameras, turned at random, the same at all steps of a
    window; target views are any cameras, drawn afresh at every step.
    """
    windows = draw_windows(scenes, data, stage, seed, step, samples)
    n_context = windows[0].n_context
    chosen = [window.scene for window in windows]
    steps = [window.steps for window in windows]
    shown = slice(first_target(stage, n_context), None)
    masked = all(scene.has_segmentation() for scene in chosen)
    context_cams = [window.context_cams for window in windows]
    context = make_frames(chosen, context_cams, [s[:n_context] for s in steps], masked=masked)
    target_cams = [window.target_cams[shown] for window in windows]
    targets = make_frames(chosen, target_cams, [s[shown] for s in steps], masked=masked)
    return batch_of(stage, windows, thinned(context, data), targets)


def batch_of(stage: StageConfig, windows: Sequence[Window], context: Frames, targets: Frames) -> Batch:
    """The batch of ``windows``, given their images."""
    window, masked_out = windows[0], [window.masked_out for window in windows]
    if any(masked_out):
        context, targets = (_without_background(frames, masked_out) for frames in (context, targets))
    how = {"dynamics_alone": stage.dynamics_alone, "cut": stage.cut, "has_own_background": stage.lit_before > 0}
    if stage.lit_before:
        context = dataclasses.replace(context, cloud_step=context.cloud_step + LONG_AGO * (context.cloud_step > 0))
    return Batch(context, targets, window.n_context, stage.horizon, window.lead, **how)


def _without_background(frames: Frames, masked_out: Sequence[bool]) -> Frames:
    """``frames`` in which some scenes show what may move alone.

    Raises:
        InputError: nobody knows what may move.
    """
    if frames.dynamic is None or frames.masks is None:
        raise InputError("masked_out: needs scenes with a segmentation; a scene of this step has none")
    scenes = torch.tensor(masked_out, device=frames.images.device)
    chosen = scenes[frames.cloud_scene[frames.cameras.image_cloud]]
    shown = frames.dynamic | ~chosen[:, None, None]
    images = torch.where(shown[:, None], frames.images, 0)
    return dataclasses.replace(frames, images=images, masks=frames.masks & shown)


def first_target(stage: StageConfig, n_context: int) -> int:
    """The first of a window's steps that the loss looks at."""
    return n_context if stage.dynamics_alone else 0


def draw_windows(
    scenes: Sequence[Scene], data: DataConfig, stage: StageConfig, seed: int, step: int, samples: Sequence[int]
) -> list[Window]:
    """What :func:`draw_batch` shows of which scene; of ``scenes`` only the numbers of steps and cameras are read."""
    n_context = history_at(data, stage, seed, step) + (stage.lit_before > 0)
    data = dataclasses.replace(data, context_views=_drawn(data.fewest_views, data.context_views, seed, step, "views"))
    return [_draw_window(scenes, data, stage, n_context, seed, step, sample) for sample in samples]


def history_at(data: DataConfig, stage: StageConfig, seed: int, step: int) -> int:
    """Encoded steps of all samples of an optimizer step."""
    return stage.history or _drawn(data.shortest_history, data.history, seed, step, "history")


def lead_at(stage: StageConfig, seed: int, step: int) -> int:
    """Steps that all samples of an optimizer step simulate ahead of their horizon."""
    return stage.lead * int(generator(seed, step, 0, "lead").integers(2)) if stage.lead else 0


def _drawn(least: int, most: int, seed: int, step: int, purpose: str) -> int:
    """Any whole number from ``least`` to ``most``, the same for all samples of a step; ``most`` where least is 0."""
    return int(generator(seed, step, 0, f"number of {purpose}").integers(least, most + 1)) if least else most


def thinned(frames: Frames, data: DataConfig) -> Frames:
    """``frames`` of which those pixels become particles that the strides of ``data`` leave."""
    fixed, moving = data.background_stride, data.body_stride
    if fixed == moving == 1 or frames.masks is None or frames.dynamic is None:
        return frames
    kept = torch.where(frames.dynamic, _every(moving, frames.masks), _every(fixed, frames.masks))
    return dataclasses.replace(frames, masks=frames.masks & kept)


def _every(stride: int, like: Tensor) -> Tensor:
    """bool [H, W]: every n-th row and column of images [I, H, W]."""
    kept = torch.zeros(like.shape[1:], dtype=torch.bool, device=like.device)
    kept[stride // 2 :: stride, stride // 2 :: stride] = True
    return kept


def spread_views(cameras: Sequence[int], count: int, turn: int) -> tuple[int, ...]:
    """``count`` of ``cameras``, evenly spread around the list, shifted by ``turn`` places."""
    n = len(cameras)
    return tuple(sorted(cameras[(turn + k * n // count) % n] for k in range(count)))


def longest_gap(stage: StageConfig) -> int:
    """Steps that a background of its own takes, with those behind it."""
    return stage.lit_before + (stage.lit_before > 0)


def _draw_window(
    scenes: Sequence[Scene], data: DataConfig, stage: StageConfig, n_context: int, seed: int, step: int, sample: int
) -> Window:
    rng = generator(seed, step, sample, "window")
    scene = scenes[int(rng.integers(len(scenes)))]
    n_steps, lead = n_context + stage.horizon, lead_at(stage, seed, step)
    n_starts = scene.n_steps - n_steps - lead - stage.lit_before + 1
    start = int(rng.integers(min(n_starts, stage.begin_within or n_starts)))
    if rng.random() < stage.from_start:
        start = 0
    views = generator(seed, step, sample, "views")
    cameras = context_cameras(scene, data)
    context = spread_views(cameras, data.context_views, int(views.integers(len(cameras))))
    seen = [cam for cam in range(scene.n_cams) if not (data.targets_apart and cam in context)]
    targets = tuple(
        tuple(seen[place] for place in views.permutation(len(seen))[: stage.target_views]) for _ in range(n_steps)
    )
    gap = int(generator(seed, step, sample, "gap").integers(stage.lit_before + 1)) if stage.lit_before else 0
    masked_out = bool(stage.masked_out) and generator(seed, step, sample, "background").random() < stage.masked_out
    return Window(scene, start, n_context, (context,) * n_context, targets, lead, gap, bool(masked_out))
