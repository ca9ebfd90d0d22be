"""Clouds of particles as a history: which is newest, which are the last, and what comes behind them.

All of it is bookkeeping on numbers that the host knows (:class:`gsim3d.types.CloudTable`); nothing waits for a device.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import torch
from torch.nn import functional as F

from gsim3d.types import CloudTable, Particles


def newest_clouds(clouds: CloudTable) -> list[int]:
    """The last cloud of each scene that has one."""
    places = list(zip(clouds.scenes, clouds.steps))
    if any(b <= a for a, b in zip(places, places[1:])):
        raise ValueError(
            "particles: clouds must be sorted by (scene, step), each once; "
            f"got scenes {list(clouds.scenes)}, steps {list(clouds.steps)}"
        )
    scenes = clouds.scenes
    return [q for q in range(len(scenes)) if q + 1 == len(scenes) or scenes[q + 1] != scenes[q]]


def append_step(history: Particles, step: Particles, max_steps: int) -> Particles:
    """``history`` with the clouds of ``step`` behind it; of each scene the last ``max_steps`` clouds stay.

    Scenes without a cloud in ``step`` stay as they are.
    """
    return last_steps(concatenate([history, step]), max_steps)


def last_steps(particles: Particles, n_steps: int) -> Particles:
    """The last ``n_steps`` clouds of each scene."""
    newest, kept, begin = newest_clouds(particles.clouds), [], 0
    for last in newest:
        kept += range(max(begin, last + 1 - n_steps), last + 1)
        begin = last + 1
    return particles if len(kept) == particles.n_clouds else particles.select_clouds(kept)


def with_look(particles: Particles, name: str) -> Particles:
    """``particles`` with the field ``name``, "turns" or "paint", which changes nothing where there was none."""
    if getattr(particles, name) is not None:
        return particles
    like = particles.means.new_ones(particles.n_rows, 1)
    identity = F.pad(like, (0, 3)) if name == "turns" else torch.diag_embed(like.expand(-1, 3))
    return dataclasses.replace(particles, **{name: identity})


def alike(parts: Sequence[Particles]) -> list[Particles]:
    """``parts`` with the same fields: what some have of "turns" and "paint", all have."""
    for name in ("turns", "paint"):
        if any(getattr(part, name) is not None for part in parts):
            parts = [with_look(part, name) for part in parts]
    return list(parts)


def concatenate(parts: Sequence[Particles]) -> Particles:
    """The clouds of several particle sets of the same scenes in one, sorted by (scene, step)."""
    parts = alike(parts)
    tables = [part.clouds for part in parts]
    places = [(table.scenes[q], table.steps[q], p, q) for p, table in enumerate(tables) for q in range(len(table))]
    places.sort(key=lambda place: place[:2])
    table = CloudTable.make(
        (tables[p].count(q) for _, _, p, q in places),
        (scene for scene, *_ in places),
        (step for _, step, *_ in places),
        parts[0].cu_rows.device,
    )
    pieces = [(p, *tables[p].row_runs([q])[0]) for *_, p, q in places]
    fields = {
        name: torch.cat([getattr(parts[p], name)[begin:end] for p, begin, end in pieces]) if pieces else value
        for name, value in parts[0].row_fields().items()
    }
    return parts[0].with_clouds(table, **fields)


def single_steps(particles: Particles) -> list[Particles]:
    """The clouds of scenes with equally many steps, step by step: one cloud a scene in each."""
    n_scenes = len(newest_clouds(particles.clouds))
    n_steps = particles.n_clouds // n_scenes if n_scenes else 1
    if n_steps == 1:
        return [particles]
    return [particles.select_clouds(range(step, particles.n_clouds, n_steps)) for step in range(n_steps)]
