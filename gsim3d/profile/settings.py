"""Settings that trade accuracy for time, and a trained simulator that runs under one of them."""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from gsim3d.cameras import Cameras, Frames
from gsim3d.cuda_graphs import CapturedRollout
from gsim3d.data import Scene
from gsim3d.dynamics import RestLog
from gsim3d.evaluate.protocol import input_frames
from gsim3d.numerics.speed import PARTS, PRECISIONS, Setting, draw
from gsim3d.simulator import Simulator
from gsim3d.state import Particles
from gsim3d.train.restore import Restored
from gsim3d.train.samples import subsampled

if TYPE_CHECKING:
    from gsim3d.profile.sweep import BenchmarkCase

KINDS = {
    "exact": "changes results by rounding only",
    "near-exact": "skips contributions below a stated threshold",
    "model": "changes the function that the model computes",
}
POWERS = [2**k for k in range(20)]
TOGETHER = 4  # steps that are timed together if the first step costs more than later ones


class Runner:
    """A trained simulator under one setting.

    Args:
        restored: simulator as trained.
        setting: how to run it.

    Attributes:
        simulator: simulator with the configuration of the setting.
        plan: its plan.
        restored: ``restored`` with both.

    Raises:
        InputError: the model does not support the setting.
    """

    def __init__(self, restored: Restored, setting: Setting = Setting()):
        self.simulator, self.setting, self.device = _changed(restored.simulator, setting), setting, restored.device
        asymmetric = self.simulator.config.dynamics.is_asymmetric
        self.plan = self.simulator.plan(setting.of_effects(restored.plan.spec, asymmetric))
        self.restored = replace(restored, simulator=self.simulator, plan=self.plan)

    def frames(self, scenes: Sequence[Scene], context: Sequence[Sequence[int]]) -> Frames:
        """Input images of the cameras ``context``, one list a scene.

        A shorter history than in training takes the last of the training's input steps.
        """
        frames = input_frames(self.restored, scenes, context, self.restored.data.history - self.restored.n_encoded)
        return subsampled(frames, self.restored.data).to(self.device)

    @torch.no_grad()
    def encode(self, frames: Frames) -> Particles:
        """Encodes ``frames`` to particles."""
        with self.setting.precision("encoder", self.device.type):
            return self.simulator.encode(frames)

    @torch.no_grad()
    def subsampled(self, particles: Particles) -> Particles:
        """Initial state of a rollout from the output of :meth:`encode`."""
        return self.simulator._prepare(self.setting.retained(particles), self.plan)

    @torch.no_grad()
    def steps(self, state: Particles, n_steps: int, log: RestLog | None = None) -> list[Particles]:
        """Particles of each of ``n_steps`` predicted steps. ``log`` counts sleeping particles."""
        with self.setting.precision("dynamics", self.device.type):
            return self.simulator.rollout(state, n_steps, self.plan, log=log)

    def span(self, n_steps: int) -> int:
        """Number of steps that are timed as one call, at most ``n_steps``."""
        config = self.simulator.config.dynamics
        if self.setting.sleep is not None:
            return n_steps  # particles fall asleep only after several steps
        needs_more = self.setting.captured or config.is_asymmetric
        return max(config.steps_per_call, min(n_steps, TOGETHER) if needs_more else 1)

    @torch.no_grad()
    def images(self, particles: Particles, cameras: Cameras) -> Tensor:
        """Renders ``particles``: [I, H, W, 3] in [0, 1]."""
        return draw(self.simulator, particles, cameras, None, self.plan).color.float().clamp(0, 1)

    @property
    def draws_in_graph(self) -> bool:
        """Whether a CUDA graph of the rollout includes rendering: all Gaussians, in the precision of the dynamics."""
        setting = self.setting
        same = setting.renderer == setting.dynamics and not setting.least_opacity
        return same and self.simulator.draws_in_graphs

    def captured(self, state: Particles, n_steps: int, cameras: Cameras) -> CapturedRollout:
        """Captures the rollout of ``state``, with rendering if :attr:`draws_in_graph`, as a CUDA graph."""
        drawn = cameras if self.draws_in_graph else None
        with self.setting.precision("dynamics", self.device.type):
            return CapturedRollout(
                self.simulator, state, n_steps, self.plan, cameras=drawn, copies=False, cutoff=self.setting.cutoff
            )


def _changed(simulator: Simulator, setting: Setting) -> Simulator:
    """Returns a simulator with the same weights and the configuration of ``setting``."""
    config = setting.of_model(simulator.config)
    if config == simulator.config:
        other = copy.copy(simulator)
    else:
        other = type(simulator)(config)
        other.load_state_dict(simulator.state_dict())
        other.absent, other.effects = simulator.absent, simulator.effects
        other = other.to(next(simulator.parameters()).device).train(simulator.training)
    other.setting, other.inputs = setting, setting.of_inputs(simulator.inputs)
    return other


@dataclass(frozen=True)
class Group:
    """Settings that vary one quantity."""

    name: str  #: name of the quantity
    kind: str  #: key of KINDS
    #: case -> settings; empty if the model or device does not support any
    settings: Callable[[BenchmarkCase], list[Setting]]
    needs: str = ""  #: requirement for a non-empty list
    few: int = 2  #: number of settings in a quick report, evenly spaced over the list and including its last one


def _precisions(case: BenchmarkCase) -> list[Setting]:
    if case.device.type != "cuda":
        return []
    whole = [Setting(p, p, p) for p in PRECISIONS[1:]]
    encoder, dynamics, renderer = (Setting(**{part: "bf16"}) for part in PARTS)
    return [whole[0], encoder, renderer, dynamics, whole[2], whole[1]]  # of 3: tf32, bf16 dynamics, bf16


def _histories(case: BenchmarkCase) -> list[Setting]:
    trained = min(case.restored.data.history, case.restored.plan.history)
    return [Setting(history=n) for n in POWERS if n < trained]


def _patches(case: BenchmarkCase) -> list[Setting]:
    dynamics = case.restored.simulator.config.dynamics
    largest = max(dynamics.patch_sizes) if dynamics.graph is None else 0
    return [Setting(patch_size=n) for n in reversed([n for n in POWERS if 32 <= n < largest][-3:])]


GROUPS = (
    Group("precision", "model", _precisions, "a GPU: on a CPU there is only float32", few=3),
    Group("graph capture", "exact", lambda case: [Setting(captured=True)] * (case.device.type == "cuda"), "a GPU"),
    Group(
        "context views",
        "model",
        lambda case: [Setting(context_views=n) for n in range(1, case.restored.data.context_views)],
        "more than one context view",
    ),
    Group("history", "model", _histories, "a model of more than one step of history"),
    Group(
        "background",
        "model",
        lambda case: [Setting(background="masked_out")] * (case.restored.plan.spec.dynamics.background != "masked_out"),
        "background particles",
    ),
    Group("particles kept", "model", lambda case: [Setting(kept=share) for share in (0.75, 0.5, 0.25, 0.1)]),
    Group(
        "degree of colours",
        "model",
        lambda case: [Setting(sh_degree=n) for n in range(case.restored.plan.sh_degree)],
        "a model with view-dependent colour",
    ),
    Group(
        "cutoff of Gaussians",
        "near-exact",
        lambda case: [Setting(cutoff="tile3sigma"), *(Setting(least_opacity=least) for least in (1 / 255, 0.02))],
    ),
    Group("sleep", "near-exact", lambda case: [Setting(sleep=cells) for cells in (1e-3, 1e-2, 0.1)], few=1),
    Group("patch size", "model", _patches, "patches of more than 32 particles", few=1),
    Group("grid size", "model", lambda case: [Setting(grid=factor) for factor in (0.5, 2.0)]),
)
