"""Actors: kinematic particles with prescribed displacements, which the network receives as input.

    pusher = Actor(displacements, of=Selection("moving", box=((-0.1, -0.1, 0.0), (0.1, 0.1, 0.2))))
    steps = simulator.rollout(state, 24, actors=[pusher])

In the input of the step from t to t + 1, the last displacement of an actor is its displacement of this step: its older
positions are shifted by the difference, and its velocity is replaced. After the step, its position and velocity are
replaced, too. Appearance and opacity are predicted.
"""

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from gsim3d.effects.selection import Selection, newest_mask
from gsim3d.errors import InputError, naming
from gsim3d.state import DYNAMIC, Particles, last_steps, newest_clouds, with_velocity


@dataclass(frozen=True)
class Actor:
    """Particles with prescribed displacements.

    Attributes:
        displacements: displacement from step t of the rollout to step t + 1 in metres, [T, 3] or [B, T, 3] for B
            scenes. Gradients flow to it.
        of: selected particles, a Selection or its ``which``; resolved once at the start of the rollout, in each step of
            the history.
    """

    displacements: Tensor
    of: Selection | str = Selection()

    def __post_init__(self):
        if isinstance(self.of, str):
            object.__setattr__(self, "of", Selection(self.of))


class Actors:
    """The actors of a rollout.

    Args:
        actors: actors with disjoint particles.
        state: initial history of the rollout.
        n_steps: steps of the rollout.

    Attributes:
        state: initial history with the attribute ``actor``, the index of each particle's actor or -1. The last
            displacement of actors equals their first one.

    Raises:
        InputError: displacements have a wrong shape, are too few or not finite; or particles are frozen, missing or
            selected twice.
    """

    def __init__(self, actors: Sequence[Actor], state: Particles, n_steps: int):
        table, newest = state.clouds, newest_clouds(state.clouds)
        scenes = [table.scenes[q] for q in newest]
        self._first = {table.scenes[q]: table.steps[q] for q in newest}
        self._scene_index = torch.zeros(max(scenes, default=0) + 1, dtype=torch.int64, device=state.means.device)
        for index, scene in enumerate(scenes):
            self._scene_index[scene] = index
        given = [_checked(actor, number, len(scenes), n_steps) for number, actor in enumerate(actors)]
        self._displacements = torch.stack(given).to(state.means)  # [A, B, T, 3]
        marks = torch.full_like(state.activity, -1, dtype=torch.int64)
        for number, actor in enumerate(actors):
            with naming(f"actors[{number}]"):
                mask = actor.of.mask(state)
            if bool((marks[mask] >= 0).any()):
                raise InputError(f"actors[{number}]: some of its particles belong to another actor")
            if bool((state.activity[mask] != DYNAMIC).any()):
                raise InputError(f"actors[{number}]: frozen particles cannot be moved; select others")
            marks = marks.masked_fill(mask, number)
        self.state = self._begun(dataclasses.replace(state, actor=marks))

    def wrap(self, predict: Callable[..., Particles]) -> Callable[..., Particles]:
        """Wraps ``predict`` (history, ... -> next step), so that actors move as prescribed."""

        def step(history: Particles, *others, **options) -> Particles:
            newest = last_steps(history, 1)
            coming = self._displacement(newest, 0)
            predicted = predict(self._shifted(history), *others, **options)
            rows = (newest.actor >= 0)[:, None]
            means = torch.where(rows, newest.means + coming, predicted.means)
            return with_velocity(dataclasses.replace(predicted, means=means), rows, coming)

        return step

    def _displacement(self, particles: Particles, later: int) -> Tensor:
        """Displacement [N, 3] of each particle's actor, ``later`` steps after the newest; arbitrary for others."""
        table = particles.clouds
        step = max(0, table.steps[-1] - self._first[table.scenes[-1]] + later)
        scene = self._scene_index[particles.row_scene()]
        return self._displacements[particles.actor.clamp_min(0), scene, step]

    def _shifted(self, history: Particles) -> Particles:
        """Shifts older positions of actors, so that their last displacement equals the next one."""
        before, coming = self._displacement(history, -1), self._displacement(history, 0)
        newest, rows = newest_mask(history)[:, None], (history.actor >= 0)[:, None]
        means = torch.where(rows & ~newest, history.means + before - coming, history.means)
        return with_velocity(dataclasses.replace(history, means=means), rows & newest, coming)

    def _begun(self, state: Particles) -> Particles:
        """Shifts older positions of actors, so that their last displacement equals their first one.

        Encoded steps have no correspondence of particles, so the displacement is that of an actor's centroid.
        """
        table, means = state.clouds, state.means.clone()
        clouds = {place: slice(*table.row_runs([q])[0]) for q, place in enumerate(zip(table.scenes, table.steps))}
        for scene, newest in self._first.items():
            older = [step for known, step in clouds if known == scene and step < newest]
            for number in range(len(self._displacements)) if older else ():
                now, last = clouds[scene, newest], clouds[scene, older[-1]]
                chosen = [state.actor[cloud] == number for cloud in (now, last)]
                if not all(bool(mask.any()) for mask in chosen):
                    continue  # not in this scene, or not visible in the older step
                moved = state.means[now][chosen[0]].mean(0) - state.means[last][chosen[1]].mean(0)
                change = moved / (newest - older[-1]) - self._displacements[number, self._scene_index[scene], 0]
                for step in older:
                    rows = (state.actor[clouds[scene, step]] == number)[:, None]
                    means[clouds[scene, step]] += torch.where(rows, (newest - step) * change, 0)
        return dataclasses.replace(state, means=means)


def _checked(actor: Actor, number: int, n_scenes: int, n_steps: int) -> Tensor:
    """Displacements of an actor [B, T, 3]. Errors name its number."""
    given, where = actor.displacements, f"actors[{number}].displacements"
    given = given.expand(n_scenes, *given.shape) if given.dim() == 2 else given
    if given.dim() != 3 or given.shape[0] != n_scenes or given.shape[2] != 3:
        raise InputError(f"{where} must be [T, 3] or [{n_scenes}, T, 3]; got {list(actor.displacements.shape)}")
    if given.shape[1] < n_steps:
        raise InputError(f"{where} has {given.shape[1]} steps; the rollout has {n_steps}")
    if not bool(given.isfinite().all()):
        raise InputError(f"{where} must be finite")
    return given[:, :n_steps]
