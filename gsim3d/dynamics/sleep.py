"""Rows that came to rest are not computed until something near them moves.

A row is quiet after ``patience`` steps in which it changed by no more than ``eps``. By the policy "exact" a scene
sleeps once all its rows are quiet: scenes do not see each other. By "approx" space is cut into cubes with edges of
``halo`` metres. A cube sleeps while no row in it or in one of its 26 neighbours is restless, and wakes in the step
after one has become so. A row that moves by less than ``halo`` a step is in a neighbouring cube one step before it can
be in the sleeping one: whom it may meet is awake by then. Who falls asleep is asked every ``patience`` steps only,
since others asleep make another background. Rows asleep are a background to those awake, so "approx" needs a model of
``background="asymmetric"``.

A row that sleeps misses changes of up to ``eps`` a step. Where a simulation that never sleeps would change no row of a
sleeping scene by more, the two differ by at most ``eps`` times the steps slept; with ``eps=0`` by nothing, for then the
network was shown the same state in all steps of its history and changed nothing.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field

import torch
from torch import Tensor

from gsim3d.effects import Sleep
from gsim3d.types import ASLEEP, FROZEN, Particles

NEVER_PREDICTED = {"activity", "static_latents", "turns", "paint"}
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
        changing: fields that a step may change; None: all but those that no model predicts.
    """

    def __init__(
        self, rule: Sleep, newest: Particles, grid_size: float, history: int, changing: Iterable[str] | None = None
    ):
        self.rule, self.patience = rule, max(rule.patience, history)
        self.reach = rule.eps * grid_size
        self.changing = newest.row_fields().keys() - NEVER_PREDICTED if changing is None else set(changing)
        self.asleep = torch.zeros(newest.n_rows, dtype=torch.bool, device=newest.means.device)
        self.anybody = False  # sleeps
        self.moved_last = torch.zeros_like(self.asleep, dtype=torch.int64)
        self.n_steps = 0

    @torch.no_grad()
    def look(self, before: Particles, after: Particles) -> bool:
        """Notes what a step changed, and decides who sleeps in the next: whether these are others than before.

        Waits for the device only where somebody sleeps or may fall asleep now.
        """
        self.n_steps += 1
        moved = (
            after.activity != before.activity
        ) > self.rule.eps  # who vanishes from the sight of others changed by 1
        for name in sorted(self.changing):
            allowed = self.reach if name == "means" else self.rule.eps
            moved |= _largest(getattr(after, name) - getattr(before, name)) > allowed
        self.moved_last.masked_fill_(moved, self.n_steps)
        may_fall_asleep = self.n_steps % self.patience == 0
        if not (may_fall_asleep or self.anybody):
            return False
        may_sleep = self._may_sleep(after)
        asleep = may_sleep if may_fall_asleep else may_sleep & self.asleep
        if torch.equal(asleep, self.asleep):
            return False
        self.asleep, self.anybody = asleep, bool(asleep.any())
        return True

    def _may_sleep(self, particles: Particles) -> Tensor:
        restless = self.moved_last > self.n_steps - self.patience
        scene = particles.cloud_scene[particles.row_cloud()]
        if self.rule.policy == "exact":
            n_restless = torch.zeros(particles.origin.shape[0], dtype=torch.int64, device=scene.device)
            return n_restless.index_add_(0, scene, restless.long())[scene] == 0
        stirred = _near(_cubes(particles, scene, self.rule.halo), restless & (particles.activity != ASLEEP))
        return ~stirred & ~restless & (particles.activity != FROZEN)


def _largest(change: Tensor) -> Tensor:
    """[N] of [N, ...], the largest size in each row."""
    return change.abs().flatten(1).amax(1) if change.dim() > 1 else change.abs()


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
