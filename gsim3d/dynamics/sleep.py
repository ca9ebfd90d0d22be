"""Rows that came to rest are not computed until something near them moves.

A row is quiet after ``patience`` steps in which it changed by no more than ``eps``. By the policy "exact" a scene sleeps
once all its rows are quiet: scenes do not see each other. By "approx" space is cut into cubes with edges of ``halo``
metres. A cube sleeps while no row in it or in one of its 26 neighbours is restless, and wakes in the step after one has
become so. A row that moves by less than ``halo`` a step is in a neighbouring cube one step before it can be in the
sleeping one: whom it may meet is awake by then. Who falls asleep is asked every ``patience`` steps only, since others
asleep make another background. Rows asleep are a background to those awake, so "approx" needs a model of
``background="asymmetric"``.

A row that sleeps misses changes of up to ``eps`` a step. Where a simulation that never sleeps would change no row of a
sleeping scene by more, the two differ by at most ``eps`` times the steps slept; with ``eps=0`` by nothing, for then the
network was shown the same state in all steps of its history and changed nothing.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import torch
from torch import Tensor

from gsim3d.effects import Sleep
from gsim3d.types import ASLEEP, FROZEN, Particles

CUBE_BITS = 16  # of a cube along an axis; cubes further out share the outermost


@dataclass
class RestLog:
    """What a rollout did not compute.

    n_rows: of the newest clouds, all scenes.
    moving: for each step, rows that were computed.
    remembered: how often a background was computed.   calls: of the network, over what moves.
    """

    n_rows: int = 0
    moving: list[int] = field(default_factory=list)
    remembered: int = 0
    calls: int = 0

    @property
    def resting_share(self) -> float:
        """Of all rows and steps."""
        total = self.n_rows * len(self.moving)
        return 1 - sum(self.moving) / total if total else 0.0


class Sleepers:
    """Who sleeps, from one step to the next.

    Args:
        rule: when rows sleep.
        newest: one cloud a scene, the rows that are looked after; all are awake.
        grid_size: metres, edge of a cell.
        history: steps that the model sees: who falls asleep has been the same in all of them.
    """

    def __init__(self, rule: Sleep, newest: Particles, grid_size: float, history: int):
        self.rule, self.patience = rule, max(rule.patience, history)
        self.reach = rule.eps * grid_size
        self.asleep = torch.zeros(newest.n_rows, dtype=torch.bool, device=newest.means.device)
        self.steps_at_rest = torch.zeros_like(self.asleep, dtype=torch.int64)
        self.n_steps = 0

    @torch.no_grad()
    def look(self, before: Particles, after: Particles) -> None:
        """Notes what a step changed, and decides who sleeps in the next."""
        at_rest = _largest_change(before.means, after.means) <= self.reach
        for name, value in after.row_fields().items():
            if name not in ("means", "activity", "static_latents", "turns", "paint"):
                at_rest &= _largest_change(getattr(before, name), value) <= self.rule.eps
        at_rest |= (after.activity == ASLEEP) & (before.activity == ASLEEP)
        self.steps_at_rest = torch.where(at_rest, self.steps_at_rest + 1, 0)
        restless = self.steps_at_rest < self.patience
        scene = after.cloud_scene[after.row_cloud()]
        if self.rule.policy == "exact":
            n_restless = torch.zeros(after.origin.shape[0], dtype=torch.int64, device=scene.device)
            may_sleep = n_restless.index_add_(0, scene, restless.long())[scene] == 0
        else:
            stirred = _near(_cubes(after, scene, self.rule.halo), restless & (after.activity != ASLEEP))
            may_sleep = ~stirred & ~restless & (after.activity != FROZEN)
        self.n_steps += 1
        self.asleep = may_sleep if self.n_steps % self.patience == 0 else may_sleep & self.asleep


def _largest_change(before: Tensor, after: Tensor) -> Tensor:
    return (after - before).abs().flatten(1).amax(1) if after.dim() > 1 else (after - before).abs()


def _cubes(particles: Particles, scene: Tensor, edge: float) -> Tensor:
    """int64 [N, 4]: scene and cube of every row."""
    place = torch.floor((particles.means.double() - particles.origin[scene]) / edge).nan_to_num()
    place = place.clamp(1, 2**CUBE_BITS - 2).long()  # a cube further out would have neighbours elsewhere
    return torch.cat([scene[:, None], place], 1)


def _near(cubes: Tensor, restless: Tensor) -> Tensor:
    """bool [N]: rows whose cube or a neighbour of it holds a row that is restless."""
    weights = torch.tensor([1 << 3 * CUBE_BITS, 1 << 2 * CUBE_BITS, 1 << CUBE_BITS, 1], device=cubes.device)
    steps = torch.arange(-1, 2, device=cubes.device)
    offsets = torch.cartesian_prod(steps, steps, steps) @ weights[1:]
    keys = (cubes * weights).sum(1)
    stirred = torch.unique(keys[restless])[:, None] + offsets
    return torch.isin(keys, stirred)
