"""Clouds of particles as a history: which is newest, which are the last, and what comes behind them."""

from __future__ import annotations

import dataclasses

import torch
from torch import Tensor

from gsim3d.types import Particles


def newest_clouds(particles: Particles) -> Tensor:
    """int64 [scenes that have a cloud], the last cloud of each."""
    scene, step = particles.cloud_scene, particles.cloud_step
    ascending = (scene[1:] > scene[:-1]) | ((scene[1:] == scene[:-1]) & (step[1:] > step[:-1]))
    if not bool(ascending.all()):
        raise ValueError(
            "particles: clouds must be sorted by (scene, step), each once; "
            f"got scenes {scene.tolist()}, steps {step.tolist()}"
        )
    is_last = torch.ones_like(scene, dtype=torch.bool)
    is_last[:-1] = scene[1:] != scene[:-1]
    return is_last.nonzero()[:, 0]


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


def single_steps(particles: Particles) -> list[Particles]:
    """The clouds of scenes with equally many steps, step by step: one cloud a scene in each."""
    n_scenes = newest_clouds(particles).shape[0]
    n_steps = particles.n_clouds // n_scenes if n_scenes else 1
    clouds = torch.arange(particles.n_clouds, device=particles.cloud_scene.device)
    return [particles.select_clouds(clouds[clouds % n_steps == step]) for step in range(n_steps)]
