"""From one step to many: the history that slides along, and the steps that come out."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import torch

from gsim3d.dynamics.dynamics import newest_clouds
from gsim3d.types import Particles


def append_step(history: Particles, step: Particles, max_steps: int) -> Particles:
    """``history`` with the clouds of ``step`` behind it; of each scene the last ``max_steps`` clouds stay.

    Scenes without a cloud in ``step`` stay as they are.
    """
    return last_steps(concatenate([history, step]), max_steps)


def last_steps(particles: Particles, n_steps: int) -> Particles:
    """The last ``n_steps`` clouds of each scene."""
    newest = newest_clouds(particles)
    counts = torch.diff(newest, prepend=newest.new_full((1,), -1))  # clouds of each scene
    age = torch.repeat_interleave(newest, counts) - torch.arange(particles.n_clouds, device=newest.device)
    return particles.select_clouds((age < n_steps).nonzero()[:, 0])


def concatenate(parts: list[Particles]) -> Particles:
    """The clouds of several particle sets of the same scenes in one, sorted by (scene, step)."""
    first = parts[0]
    scene = torch.cat([p.cloud_scene for p in parts])
    step = torch.cat([p.cloud_step for p in parts])
    counts = torch.cat([torch.diff(p.cu_rows) for p in parts])
    order = torch.argsort(step, stable=True)
    order = order[torch.argsort(scene[order], stable=True)]
    fields = {}
    for name in Particles.ROW_FIELDS:
        if getattr(first, name) is not None:
            pieces = [piece for p in parts for piece in getattr(p, name).split(torch.diff(p.cu_rows).tolist())]
            fields[name] = torch.cat([pieces[q] for q in order.tolist()]) if pieces else getattr(first, name)
    cu_rows = torch.zeros(len(counts) + 1, dtype=torch.int64, device=counts.device)
    cu_rows[1:] = torch.cumsum(counts[order], 0)
    return dataclasses.replace(first, **fields, cu_rows=cu_rows, cloud_scene=scene[order], cloud_step=step[order])


def rollout(
    predict: Callable[[Particles], Particles], history: Particles, n_steps: int, max_steps: int
) -> list[Particles]:
    """The next ``n_steps`` steps, each fed back; gradients flow through all of them.

    Args:
        predict: last steps of every scene -> the next step, as :class:`Dynamics`.
        history: where to start from.
        n_steps: how many steps to predict.
        max_steps: how many steps of each scene ``predict`` is given at most.
    Returns:
        One Particles a step, one cloud a scene each; rows are those of the newest step of ``history`` throughout.
    """
    history, steps = last_steps(history, max_steps), []
    for _ in range(n_steps):
        steps.append(predict(history))
        history = append_step(history, steps[-1], max_steps)
    return steps
