"""Runs a trained simulator as a setting says."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager
from functools import partial

import torch
import torch.nn.functional as F
from torch import Tensor

from gsim3d.cameras import Cameras, Frames
from gsim3d.cuda_graphs import CapturedRollout
from gsim3d.data import Scene, make_frames
from gsim3d.dynamics import RestLog, append_step, concatenate, last_steps
from gsim3d.effects.edits import Edit
from gsim3d.errors import InputError
from gsim3d.evaluate.protocol import Prediction
from gsim3d.profile.settings import Setting
from gsim3d.simulator import Simulator
from gsim3d.state import Particles
from gsim3d.train.restore import Restored
from gsim3d.train.samples import subsampled

TOGETHER = 4  # steps that are timed together where the first costs more than those that follow


class Runner:
    """A trained simulator under one setting.

        runner = Runner(restored, Setting(history=2))
        state = runner.encode(runner.frames([scene], [context]))
        state = runner.step(state)
        images = runner.images(last_steps(state, 1), cameras)

    Raises:
        InputError: the model cannot do what the setting asks for.
    """

    def __init__(self, restored: Restored, setting: Setting = Setting()):
        self.restored, self.setting, self.device = restored, setting, restored.device
        self.simulator = _changed(restored.simulator, setting)
        asymmetric = self.simulator.config.dynamics.is_asymmetric
        self.plan = self.simulator.plan(setting.of_effects(restored.plan.spec, asymmetric))
        config = self.simulator.config.dynamics
        # A background that rests, who sleeps, and several steps a call are the affair of a whole rollout.
        self.at_once = setting.sleep is not None or config.is_asymmetric or config.steps_per_call > 1
        self.n_encoded = min(setting.history or restored.data.history, restored.data.history)

    @property
    def skipped(self) -> int:
        """First input steps that a history shorter than the training's leaves out."""
        return self.restored.data.history - self.n_encoded

    def frames(self, scenes: Sequence[Scene], context: Sequence[Sequence[int]], start: int = 0) -> Frames:
        """Input images: of the steps from ``start`` that the training's history has, the last ones."""
        steps = [range(start + self.skipped, start + self.restored.data.history)] * len(scenes)
        if self.setting.context_views is not None:
            context = [_spread(cams, self.setting.context_views) for cams in context]
        masked = all(scene.has_segmentation() for scene in scenes)
        frames = make_frames(scenes, [list(cams) for cams in context], steps, masked=masked)
        return subsampled(frames, self.restored.data).to(self.device)

    def encode(self, frames: Frames) -> Particles:
        """The state from which to simulate."""
        return self.chosen(self.seen(frames))

    @torch.no_grad()
    def seen(self, frames: Frames) -> Particles:
        """All particles of ``frames``."""
        with self._precision("encoder"):
            return self.simulator.encode(frames)

    @torch.no_grad()
    def chosen(self, particles: Particles) -> Particles:
        """What of :meth:`seen` is simulated."""
        return self.simulator._prepare(self.setting.retained(particles), self.plan)

    @torch.no_grad()
    def step(self, state: Particles) -> Particles:
        """The state one call of the dynamics later."""
        with self._precision("dynamics"):
            if self.setting.orders == 1:
                return self.simulator.step(state, self.plan)
            state = self.simulator._prepare(state, self.plan)
            return append_step(state, self._averaged(state), self.plan.history)

    def steps(self, state: Particles, n_steps: int, log: RestLog | None = None) -> Iterator[Particles]:
        """The newest step of every scene, ``n_steps`` times. ``log`` is told what rested."""
        if self.at_once:
            with torch.no_grad(), self._precision("dynamics"):
                steps = self.simulator.rollout(state, n_steps, self.plan, log=log)
            yield from steps
            return
        for _ in range(n_steps):
            state = self.step(state)
            yield self.newest(state)

    def span(self, n_steps: int) -> int:
        """Steps that must be timed together, of ``n_steps`` that can be."""
        setting, config = self.setting, self.simulator.config.dynamics
        if setting.sleep is not None:
            return n_steps
        alone = not (setting.captured or config.is_asymmetric)
        return max(setting.every, config.steps_per_call, 1 if alone else min(n_steps, TOGETHER))

    @torch.no_grad()
    def images(self, particles: Particles, cameras: Cameras) -> Tensor:
        """[I, H, W, 3] in [0, 1] of particles as :meth:`step` made them."""
        if self.setting.least_opacity:
            particles = particles.select_rows(particles.opacities >= self.setting.least_opacity)
        with self._precision("renderer"):
            rendering = self.simulator._draw(
                particles, self._smaller(cameras), plan=self.plan, cutoff=self.setting.cutoff
            )
        return rendering.color.float().clamp(0, 1)

    @torch.no_grad()
    def predict(
        self,
        scene: Scene,
        context: Sequence[int],
        n_future: int,
        start: int = 0,
        edits: Sequence[Edit] = (),
        on_steps: Callable[[int], object] | None = None,
    ) -> Prediction:
        """As :func:`gsim3d.evaluate.protocol.predict`, of the steps from ``start + skipped`` on. Errors likewise.
        ``on_steps`` is called with the number of steps that have just been simulated."""
        self.restored.check_scene(scene)
        if not 0 <= start <= scene.n_steps - self.restored.data.history:
            raise InputError(f"{scene.path}: the input steps from step {start} on do not fit its {scene.n_steps} steps")
        if n_future < 1:
            raise InputError(f"the number of steps to predict must be at least 1; got {n_future}")
        encoded = self.encode(self.frames([scene], [context], start))
        log = RestLog()
        with self._precision("dynamics"):
            if self.setting.captured and not edits:
                steps = CapturedRollout(self.simulator, encoded, n_future, self.plan)(encoded).steps
            else:
                steps = self._rollout(encoded, n_future, edits, log, on_steps)
        return Prediction(concatenate([encoded, *steps]), self.n_encoded, tuple(context), log.resting_share)

    def newest(self, state: Particles) -> Particles:
        """The last step of every scene."""
        return last_steps(state, 1)

    def enlarged(self, images: Tensor, height: int, width: int) -> Tensor:
        """Images of a setting that shrinks them, in their full size."""
        if images.shape[1:3] == (height, width):
            return images
        return F.interpolate(images.permute(0, 3, 1, 2), (height, width), mode="bilinear").permute(0, 2, 3, 1)

    @property
    def draws_in_graph(self) -> bool:
        """Whether a graph of the rollout can draw as well: all rows of every step, in the precision of the dynamics."""
        setting = self.setting
        all_of_it = not setting.least_opacity and setting.every == 1
        return all_of_it and self.simulator.draws_in_graphs and setting.renderer == setting.dynamics

    def captured(self, state: Particles, n_steps: int, cameras: Cameras) -> CapturedRollout:
        """The rollout of ``state`` as a graph, in the precision of the dynamics; it draws where it can."""
        drawn = self._smaller(cameras) if self.draws_in_graph else None
        with self._precision("dynamics"):
            return CapturedRollout(
                self.simulator, state, n_steps, self.plan, cameras=drawn, copies=False, cutoff=self.setting.cutoff
            )

    def _precision(self, part: str) -> AbstractContextManager[None]:
        return self.setting.precision(part, self.device.type)

    def _rollout(
        self, state: Particles, n_steps: int, edits: Sequence[Edit], log: RestLog, on_steps: Callable | None
    ) -> list[Particles]:
        def counted(predict: Callable) -> Callable:
            def wrapped(*state, **options):
                steps = predict(*state, **options)
                on_steps(steps.n_clouds)
                return steps

            return wrapped

        if self.setting.orders == 1:
            wrap = None if on_steps is None else counted
            return self.simulator.rollout(state, n_steps, self.plan, edits=edits, log=log, wrap=wrap)
        if edits:
            raise InputError("setting: orders cannot be averaged while a scene is edited; use another --speed")
        return list(self.steps(state, n_steps))

    def _averaged(self, state: Particles) -> Particles:
        """The next step, by several orders of the curves: the mean of what each predicts."""
        geometry, n_levels = self.simulator.dynamics.geometry, self.simulator.config.dynamics.n_stages

        def predict(curves: tuple) -> Particles:
            return self.simulator.rollout(state, 1, self.plan, geometry=partial(geometry, curves=curves))[0]

        return self.setting.averaged(predict, n_levels)

    def _smaller(self, cameras: Cameras) -> Cameras:
        factor = self.setting.shrink
        if factor == 1:
            return cameras
        width, height = math.ceil(cameras.width / factor), math.ceil(cameras.height / factor)
        scale = torch.tensor([width / cameras.width, height / cameras.height, 1.0], device=cameras.Ks.device)
        return dataclasses.replace(cameras, Ks=cameras.Ks * scale[:, None], width=width, height=height)


def _spread(cams: Sequence[int], count: int) -> list[int]:
    return [cams[k * len(cams) // count] for k in range(min(count, len(cams)))]


def _changed(simulator: Simulator, setting: Setting) -> Simulator:
    """``simulator``, or one with its weights in another geometry, or compiled."""
    config = setting.of_model(simulator.config)
    if config == simulator.config and not setting.compiled:
        return simulator
    device = next(simulator.parameters()).device
    other = type(simulator)(config)
    other.load_state_dict(simulator.state_dict())
    other.absent, other.effects, other.inputs = simulator.absent, simulator.effects, simulator.inputs
    if setting.compiled:
        other.dynamics.net.compile(dynamic=True)
    return other.to(device).train(simulator.training)
