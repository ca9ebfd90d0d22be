"""What planners need for PushToGoal: dynamics over sequences of pusher velocities, and a cost."""

from contextlib import suppress
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from gsim3d.envs.model import ModelScenes, ModelState
from gsim3d.envs.push import PushToGoal, bounded_velocity
from gsim3d.errors import InputError
from gsim3d.synth.cameras import Rig
from gsim3d.synth.pushing import PUSHER_RADIUS, SIZE
from gsim3d.synth.scene_setup import Unstable

BEHIND = SIZE / 2 + PUSHER_RADIUS  # metres behind the body, seen from the goal, where the pusher should be
APPROACH = 0.3  # weight of the pusher's distance to that position; small beside the goal's
FINAL = 2.0  # weight of the last distance to the goal beside the mean


@dataclass(frozen=True)
class PushStates:
    """Predicted positions of K sequences, metres; not finite where the simulation failed."""

    centers: Tensor  #: [K, H, 2] of the body
    pusher: Tensor  #: [K, H, 2]
    points: Tensor | None = None  #: [K, H, 256, 3] of the body; None in MuJoCo
    images: Tensor | None = None  #: [K, V, h, w, 3] after the last step, RGB in [0, 1]; None without cameras


class TrueDynamics:
    """Dynamics for planners: MuJoCo itself, one sequence after the other.

    Args:
        task: simulates in the episode that it has at each call, and leaves it in the state that was given.
    """

    def __init__(self, task: PushToGoal):
        self.task = task.unwrapped

    def __call__(self, state: np.ndarray, actions: Tensor) -> PushStates:
        """Positions after each of ``actions`` [K, H, 2], m/s, from ``state``, one of the current episode."""
        simulation, shape = self.task.simulation, tuple(actions.shape)
        if len(shape) != 3 or shape[2] != 2:
            raise InputError(f"actions must be [K, H, 2]; got {list(shape)}")
        centers, pusher = np.full(shape, np.nan), np.full(shape, np.nan)
        try:
            for k, sequence in enumerate(actions.detach().double().cpu()):
                simulation.restore(state)
                with suppress(Unstable):
                    for step, action in enumerate(sequence):
                        velocity = bounded_velocity(torch.from_numpy(simulation.pusher[:2]), action)
                        simulation.step(velocity.numpy())
                        centers[k, step], pusher[k, step] = simulation.centers[0, :2], simulation.pusher[:2]
        finally:
            simulation.restore(state)
        return PushStates(torch.from_numpy(centers), torch.from_numpy(pusher))


class ModelDynamics:
    """Dynamics for planners: a learned simulator, all sequences in one batch. Gradients flow to actions.

    Args:
        scenes: one scene; calls leave it as it is.
        reach: see :meth:`gsim3d.envs.model.ModelScenes.repeated`.
        rig: cameras of the predicted images, for costs of images.
    """

    def __init__(self, scenes: ModelScenes, reach: float | None = None, rig: Rig | None = None):
        self.scenes, self.reach, self.rig = scenes, reach, rig

    def __call__(self, state: ModelState, actions: Tensor) -> PushStates:
        """Positions after each of ``actions`` [K, H, 2], m/s, from ``state``."""
        copies = self.scenes.repeated(state, len(actions), self.reach)
        steps = []
        for action in actions.to(copies.device, torch.float64).unbind(1):
            PushToGoal.act(copies, action)
            steps.append((copies.centers()[:, 0, :2], copies.actors()[:, 0, :2], copies.points()))
        images = None if self.rig is None else copies.colors(self.rig)
        return PushStates(*(torch.stack(of, 1) for of in zip(*steps, strict=True)), images)


@dataclass(frozen=True)
class GoalCost:
    """Cost of PushToGoal: the body's distance to the goal, and the pusher's to the position behind the body.

    ``mean_t |c_t - g| + 2 |c_H - g| + 0.3 mean_t |p_t - b_t|`` with ``b = c + d (c - g) / |c - g|``. Without the last
    term all sequences that do not reach the body have the same cost.
    """

    goal: Tensor  #: [2] metres

    def __call__(self, states: PushStates, actions: Tensor) -> Tensor:
        away = states.centers - self.goal.to(states.centers)
        distance = away.norm(dim=-1)
        behind = states.centers + BEHIND * away / distance.clamp_min(1e-6)[..., None]
        approach = (states.pusher - behind).norm(dim=-1).mean(-1)
        return distance.mean(-1) + FINAL * distance[:, -1] + APPROACH * approach
