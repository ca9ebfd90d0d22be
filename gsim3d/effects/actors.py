"""Kinematic particles: a rollout moves the particles of actors as prescribed, and the network sees where they go.

    pusher = Actor(displacements, of=Selection("moving", box=((-0.1, -0.1, 0.0), (0.1, 0.1, 0.2))))
    steps = simulator.rollout(state, 24, actors=[pusher])

The input of the step from t to t + 1 holds an actor at its position at t, and its last displacement is the one of this
step: older positions are shifted by the difference, and its velocity is replaced. After the step its predicted position
is replaced, too. Appearance and opacity stay predicted.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from gsim3d.effects.selection import Selection, newest_mask
from gsim3d.errors import InputError
from gsim3d.state import DYNAMIC, Particles, last_steps, newest_clouds


@dataclass(frozen=True)
class Actor:
    """Particles that move as prescribed.

    Attributes:
        displacements: [T, 3] or, for each scene, [B, T, 3], metres: entry t is the displacement from step t of the
            rollout to step t + 1. Gradients flow to it.
        of: which particles, a Selection or its ``which``; resolved once, when the rollout begins, in each step of the
            history.
    """

    displacements: Tensor
    of: Selection | str = Selection()

    def __post_init__(self):
        if isinstance(self.of, str):
            object.__setattr__(self, "of", Selection(self.of))


class Actors:
    """The actors of one rollout.

    Args:
        actors: their particles must not overlap.
        state: last steps of every scene, from which the rollout begins.
        n_steps: of the rollout.

    Raises:
        InputError: displacements have a wrong shape, are too few or not finite; or particles are frozen, missing or
            selected twice.

    Attributes:
        state: ``state``, whose attribute ``actor`` holds the number of each particle's actor, or -1; the history of
            actors ends with their first displacement.
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
            try:
                mask = actor.of.mask(state)
            except InputError as error:
                raise InputError(f"actors[{number}]: {error}") from None
            if bool((marks[mask] >= 0).any()):
                raise InputError(f"actors[{number}]: some of its particles belong to another actor")
            if bool((state.activity[mask] != DYNAMIC).any()):
                raise InputError(f"actors[{number}]: frozen particles cannot be moved; select others")
            marks = marks.masked_fill(mask, number)
        self.state = self._begun(dataclasses.replace(state, actor=marks))

    def wrap(self, predict: Callable[..., Particles]) -> Callable[..., Particles]:
        """``predict``, a function of the history and what else the dynamics reads, with prescribed actors."""

        def step(history: Particles, *others, **options) -> Particles:
            newest = last_steps(history, 1)
            coming = self._displacement(newest, 0)
            predicted = predict(self._shifted(history), *others, **options)
            rows = (newest.actor >= 0)[:, None]
            fields = {"means": torch.where(rows, newest.means + coming, predicted.means)}
            if predicted.velocity is not None:
                fields["velocity"] = torch.where(rows, coming, predicted.velocity)
            return dataclasses.replace(predicted, **fields)

        return step

    def _displacement(self, particles: Particles, later: int) -> Tensor:
        """[N, 3], the displacement of each particle's actor ``later`` steps after the newest; of others: any."""
        table = particles.clouds
        step = max(0, table.steps[-1] - self._first[table.scenes[-1]] + later)
        scene = self._scene_index[particles.cloud_scene[particles.row_cloud()]]
        return self._displacements[particles.actor.clamp_min(0), scene, step]

    def _shifted(self, history: Particles) -> Particles:
        """``history`` whose actors' last displacement is the coming one; their newest positions stay."""
        before, coming = self._displacement(history, -1), self._displacement(history, 0)
        newest, rows = newest_mask(history)[:, None], (history.actor >= 0)[:, None]
        fields = {"means": torch.where(rows & ~newest, history.means + before - coming, history.means)}
        if history.velocity is not None:
            fields["velocity"] = torch.where(rows & newest, coming, history.velocity)
        return dataclasses.replace(history, **fields)

    def _begun(self, state: Particles) -> Particles:
        """``state`` whose actors came to the newest step by their first displacement.

        Particles of two encoded steps are not aligned: it is the centroid of an actor that moves so far.
        """
        table, means = state.clouds, state.means.clone()
        clouds = {place: slice(*table.row_runs([q])[0]) for q, place in enumerate(zip(table.scenes, table.steps))}
        for scene, newest in self._first.items():
            older = [step for known, step in clouds if known == scene and step < newest]
            for number in range(len(self._displacements)) if older else ():
                now, last = clouds[scene, newest], clouds[scene, older[-1]]
                chosen = [state.actor[cloud] == number for cloud in (now, last)]
                if not all(bool(mask.any()) for mask in chosen):
                    continue  # the actor is in other scenes, or was not seen before
                moved = state.means[now][chosen[0]].mean(0) - state.means[last][chosen[1]].mean(0)
                change = moved / (newest - older[-1]) - self._displacements[number, self._scene_index[scene], 0]
                for step in older:
                    rows = (state.actor[clouds[scene, step]] == number)[:, None]
                    means[clouds[scene, step]] += torch.where(rows, (newest - step) * change, 0)
        return dataclasses.replace(state, means=means)


def _checked(actor: Actor, number: int, n_scenes: int, n_steps: int) -> Tensor:
    """[B, T, 3] displacements of an actor. Raises InputError that names its number."""
    given, where = actor.displacements, f"actors[{number}].displacements"
    if given.dim() == 2:
        given = given.expand(n_scenes, *given.shape)
    if given.dim() != 3 or given.shape[0] != n_scenes or given.shape[2] != 3:
        raise InputError(f"{where} must be [T, 3] or [{n_scenes}, T, 3]; got {list(actor.displacements.shape)}")
    if given.shape[1] < n_steps:
        raise InputError(f"{where} has {given.shape[1]} steps; the rollout has {n_steps}")
    if not bool(given.isfinite().all()):
        raise InputError(f"{where} must be finite")
    return given[:, :n_steps]
