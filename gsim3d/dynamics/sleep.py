"""Particles that came to rest are not computed until something near them moves.

A particle is quiet after ``patience`` steps in which it changed by no more than ``eps``. By the policy "exact" a scene
sleeps once all its particles are quiet: scenes do not see each other. By "approx" space is cut into cubes with edges of
``halo`` metres. A cube sleeps while no restless particle is in it or in one of its 26 neighbours, or will be in the
next step if it moves on as in the last; else it wakes at once. A particle that moves by less than ``halo`` a step, or
steadily, meets no sleeping particle. Which particles fall asleep is decided every ``patience`` steps only, since other
sleepers make another background. Sleeping particles are a background to the others, so "approx" needs a model of
``background="asymmetric"``.

A particle that sleeps misses changes of up to ``eps`` a step. Where a simulation without sleep would change none of a
sleeping scene by more, the two differ by at most ``eps`` times the steps slept; with ``eps=0`` by nothing, for then the
network was shown the same state in all steps of its history and changed nothing.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field

import torch
from torch import Tensor

from gsim3d.effects.spec import Sleep
from gsim3d.state import ASLEEP, ATTRIBUTES, FROZEN, Particles, constant

CUBE_BITS = 16  # of a cube along an axis; cubes further out share the outermost
WEIGHTS = (1 << 3 * CUBE_BITS, 1 << 2 * CUBE_BITS, 1 << CUBE_BITS, 1)  # of scene, x, y, z in the number of a cube


@dataclass
class RestLog:
    """What a rollout did not compute.

    Attributes:
        n_rows: of the newest clouds, all scenes.
        moving: for each step, particles that were computed.
        remembered: how often a background was computed.
        calls: of the network, over what moves.
    """

    n_rows: int = 0
    moving: list[int] = field(default_factory=list)
    remembered: int = 0
    calls: int = 0

    @property
    def resting_share(self) -> float:
        """Of all particles and steps."""
        total = self.n_rows * len(self.moving)
        return 1 - sum(self.moving) / total if total else 0.0


class Sleepers:
    """Who sleeps, from one step to the next.

    Args:
        rule: when particles sleep.
        newest: one cloud a scene, the particles that may sleep; all are awake.
        grid_size: metres, edge of a cell.
        history: steps that the model sees: what falls asleep has been the same in all of them.
        changing: fields that a step may change; None: all but those that no model predicts.
    """

    def __init__(
        self, rule: Sleep, newest: Particles, grid_size: float, history: int, changing: Iterable[str] | None = None
    ):
        self.rule, self.patience = rule, max(rule.patience, history)
        self.reach = rule.eps * grid_size
        self.changing = (
            {name for name in newest.row_fields() if ATTRIBUTES[name].predicted} if changing is None else set(changing)
        )
        self.asleep = torch.zeros(newest.n_rows, dtype=torch.bool, device=newest.means.device)
        self.anybody = False  # sleeps
        self.moved_last = torch.zeros_like(self.asleep, dtype=torch.int64)
        self.n_steps = 0

    @torch.no_grad()
    def look(self, before: Particles, after: Particles) -> bool:
        """Whether other particles sleep in the next step than before, by what this step changed.

        Waits for the device only where a particle sleeps or may fall asleep now.
        """
        self.n_steps += 1
        moved = (
            after.activity != before.activity
        ) > self.rule.eps  # what vanishes from the sight of others changed by 1
        for name in sorted(self.changing):
            allowed = self.reach if name == "means" else self.rule.eps
            moved |= _largest(getattr(after, name) - getattr(before, name)) > allowed
        self.moved_last.masked_fill_(moved, self.n_steps)
        may_fall_asleep = self.n_steps % self.patience == 0
        if not (may_fall_asleep or self.anybody):
            return False
        may_sleep = self._may_sleep(before, after)
        asleep = may_sleep if may_fall_asleep else may_sleep & self.asleep
        if torch.equal(asleep, self.asleep):
            return False
        self.asleep, self.anybody = asleep, bool(asleep.any())
        return True

    def _may_sleep(self, before: Particles, after: Particles) -> Tensor:
        restless = self.moved_last > self.n_steps - self.patience
        scene = after.cloud_scene[after.row_cloud()]
        if self.rule.policy == "exact":
            n_restless = torch.zeros(after.origin.shape[0], dtype=torch.int64, device=scene.device)
            return n_restless.index_add_(0, scene, restless.long())[scene] == 0
        both = after.means, 2 * after.means - before.means
        here, ahead = (_cubes(places, after.origin, scene, self.rule.halo) for places in both)
        stirs = restless & (after.activity != ASLEEP)
        return ~_near(here, torch.cat([here[stirs], ahead[stirs]])) & ~restless & (after.activity != FROZEN)


def _largest(change: Tensor) -> Tensor:
    """[N] of [N, ...], the largest size in each particle."""
    return change.abs().flatten(1).amax(1) if change.dim() > 1 else change.abs()


def _cubes(places: Tensor, origin: Tensor, scene: Tensor, edge: float) -> Tensor:
    """int64 [N], the scene and cube of every particle as one number."""
    cubes = torch.floor((places.double() - origin[scene]) / edge).nan_to_num()
    cubes = cubes.clamp(1, 2**CUBE_BITS - 2).long()  # a cube further out would have neighbours elsewhere
    return (torch.cat([scene[:, None], cubes], 1) * constant(WEIGHTS, scene.device)).sum(1)


def _near(cubes: Tensor, stirred: Tensor) -> Tensor:
    """bool [N]: particles whose cube is one of ``stirred`` or a neighbour of it."""
    steps = torch.arange(-1, 2, device=cubes.device)
    offsets = torch.cartesian_prod(steps, steps, steps) @ constant(WEIGHTS, cubes.device)[1:]
    return torch.isin(cubes, torch.unique(stirred)[:, None] + offsets)
