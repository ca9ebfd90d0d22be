"""Clouds of particles as a history: which is newest, which are the last, and what comes behind them.

All of it is bookkeeping on numbers that the host knows (:class:`gsim3d.state.CloudTable`); nothing waits for a device.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import torch
from torch import Tensor
from torch.nn import functional as F

from gsim3d.state import CloudTable, Particles, split_rows

# That only some particles have.
OPTIONAL_FIELDS = (
    "orientations",
    "color_transform",
    "frozen_appearance",
    "initial_latents",
    "velocity",
    "irradiance_gain",
    "light_occlusion",
    "rest_positions",
    "body",
)


def newest_clouds(clouds: CloudTable) -> list[int]:
    """The last cloud of each scene that has one."""
    return _newest(clouds.scenes, clouds.steps)


def _newest(scenes: Sequence[int], steps: Sequence[int]) -> list[int]:
    places = list(zip(scenes, steps))
    if any(b <= a for a, b in zip(places, places[1:])):
        raise ValueError(
            "particles: clouds must be sorted by (scene, step), each once; "
            f"got scenes {list(scenes)}, steps {list(steps)}"
        )
    return [q for q in range(len(scenes)) if q + 1 == len(scenes) or scenes[q + 1] != scenes[q]]


def _last(scenes: Sequence[int], steps: Sequence[int], n_steps: int) -> list[int]:
    """The last ``n_steps`` clouds of each scene."""
    kept, begin = [], 0
    for last in _newest(scenes, steps):
        kept += range(max(begin, last + 1 - n_steps), last + 1)
        begin = last + 1
    return kept


def append_step(history: Particles, step: Particles, max_steps: int) -> Particles:
    """``history`` with the clouds of ``step`` behind it; of each scene the last ``max_steps`` clouds stay.

    Scenes without a cloud in ``step`` stay as they are.
    """
    return concatenate([history, step], max_steps)


def last_steps(particles: Particles, n_steps: int) -> Particles:
    """The last ``n_steps`` clouds of each scene."""
    kept = _last(particles.clouds.scenes, particles.clouds.steps, n_steps)
    return particles if len(kept) == particles.n_clouds else particles.select_clouds(kept)


def with_field(particles: Particles, name: str, width: int = 3) -> Particles:
    """``particles`` with the field ``name``, one of ``OPTIONAL_FIELDS``, which changes nothing where there was none;
    what has no velocity rests. ``width``: channels, where the field itself does not say how many."""
    if getattr(particles, name) is not None:
        return particles
    like = particles.means.new_ones(particles.n_rows, 1)
    identity = {
        "orientations": lambda: F.pad(like, (0, 3)),
        "color_transform": lambda: torch.diag_embed(like.expand(-1, 3)),
        "frozen_appearance": lambda: torch.zeros_like(particles.activity, dtype=torch.bool),
        "initial_latents": lambda: _finite(particles.dynamic_latents),
        "velocity": lambda: torch.zeros_like(particles.means),
        "irradiance_gain": lambda: torch.ones_like(particles.means),
        "light_occlusion": lambda: -like.expand(-1, width),
        "rest_positions": lambda: _finite(particles.means.detach()),
        "body": lambda: _finite(particles.means.detach()),
    }
    return dataclasses.replace(particles, **{name: identity[name]()})


def _finite(values: Tensor) -> Tensor:
    """0 for what is no number: a guard puts its row to sleep, and does not look at what that remembers."""
    return values.nan_to_num(0, 0, 0)


def alike(parts: Sequence[Particles]) -> list[Particles]:
    """``parts`` with the same fields: what some have of ``OPTIONAL_FIELDS``, all have."""
    for name in OPTIONAL_FIELDS:
        known = [getattr(part, name) for part in parts if getattr(part, name) is not None]
        if known:
            parts = [with_field(part, name, known[0].shape[-1]) for part in parts]
    return list(parts)


def concatenate(parts: Sequence[Particles], max_steps: int | None = None) -> Particles:
    """The clouds of several particle sets of the same scenes in one, sorted by (scene, step); with ``max_steps`` the
    last of each scene, each once."""
    parts = alike(parts)
    tables = [part.clouds for part in parts]
    places = [(table.scenes[q], table.steps[q], p, q) for p, table in enumerate(tables) for q in range(len(table))]
    places.sort(key=lambda place: place[:2])
    if max_steps is not None:
        scenes, steps = [place[0] for place in places], [place[1] for place in places]
        places = [places[i] for i in _last(scenes, steps, max_steps)]
    table = CloudTable.make(
        (tables[p].count(q) for _, _, p, q in places),
        (scene for scene, *_ in places),
        (step for _, step, *_ in places),
        parts[0].cu_rows.device,
    )
    taken = [sorted(q for *_, of, q in places if of == p) for p in range(len(parts))]
    runs = [[table.row_runs([q])[0] for q in clouds] for table, clouds in zip(tables, taken, strict=True)]
    order = {cloud: i for i, cloud in enumerate((p, q) for p, clouds in enumerate(taken) for q in clouds)}
    fields = {}
    for name, value in parts[0].row_fields().items():
        pieces = [rows for part, of in zip(parts, runs, strict=True) for rows in split_rows(getattr(part, name), of)]
        fields[name] = torch.cat([pieces[order[p, q]] for *_, p, q in places]) if places else value
    return parts[0].with_clouds(table, **fields)


def single_steps(particles: Particles) -> list[Particles]:
    """The clouds of scenes with equally many steps, step by step: one cloud a scene in each."""
    n_scenes = len(newest_clouds(particles.clouds))
    n_steps = particles.n_clouds // n_scenes if n_scenes else 1
    if n_steps == 1:
        return [particles]
    return [particles.select_clouds(range(step, particles.n_clouds, n_steps)) for step in range(n_steps)]
