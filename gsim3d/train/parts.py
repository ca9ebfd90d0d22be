"""Where simulations of a training step begin, and long ones whose gradients do not flow back to there."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import torch

from gsim3d.dynamics import Dynamics, concatenate
from gsim3d.state import ASLEEP, DYNAMIC, FROZEN, CloudTable, Particles, newest_clouds


def in_parts(
    rollout: Callable[[Particles, int], list[Particles]], state: Particles, n_steps: int, cut: int
) -> list[Particles]:
    """``n_steps`` steps of ``rollout``; gradients flow back through ``cut`` of them at most, 0: through all."""
    steps = []
    while len(steps) < n_steps:
        part = rollout(state, min(cut or n_steps, n_steps - len(steps)))
        state = concatenate([state, *part]).detach()
        steps += part
    return steps


def with_first_background(particles: Particles, dynamics: Dynamics) -> Particles:
    """All but the first cloud of each scene, the newest ones in front of the background of the first, which knows what
    stood in its light then.

    Rows that are replaced sleep and are not drawn: nothing waits for the device.
    """
    table = particles.clouds
    first = [q for q, scene in enumerate(table.scenes) if q == 0 or scene != table.scenes[q - 1]]
    newest = newest_clouds(table)
    older = particles.select_clouds(sorted(set(range(len(table))) - set(first) - set(newest)))
    background = _without(dynamics.in_light(particles.select_clouds(first)), DYNAMIC)
    bodies = _without(particles.select_clouds(newest), FROZEN)
    counts = [background.clouds.count(b) + bodies.clouds.count(b) for b in range(len(newest))]
    whole = CloudTable.make(counts, bodies.clouds.scenes, bodies.clouds.steps, particles.means.device)
    return concatenate([older, concatenate([background, bodies]).with_clouds(whole)])


def _without(particles: Particles, activity: int) -> Particles:
    gone = particles.activity == activity
    return dataclasses.replace(
        particles,
        activity=torch.where(gone, ASLEEP, particles.activity),
        opacities=torch.where(gone, 0, particles.opacities),
    )
