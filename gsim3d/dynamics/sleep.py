"""Sleep: particles at rest are not computed until something near them moves.

A particle is quiet if it changed by at most ``eps`` a step for ``patience`` steps. With the policy "exact", a scene
sleeps once all its particles are quiet. With "approx", space is divided into cubes with edges of ``halo`` metres. A
cube sleeps while neither it nor any of its 26 neighbours contains a restless particle, now or in the next step at
constant velocity; otherwise it wakes immediately. So a particle that moves by less than ``halo`` a step, or at constant
velocity, never meets a sleeping particle. Particles fall asleep only at multiples of ``patience`` steps, since every
change of the sleeping set recomputes the background. Sleeping particles are part of the background, so "approx" needs
``background="asymmetric"``.

The error is at most ``eps`` times the steps slept, as long as a simulation without sleep would change no particle of a
sleeping scene by more than ``eps`` a step. With ``eps=0`` it is 0: the network received the same state in all steps of
its history and changed nothing.
"""

from collections.abc import Iterable
from dataclasses import dataclass, field

import torch
from torch import Tensor

from gsim3d.effects.spec import Sleep
from gsim3d.state import ASLEEP, ATTRIBUTES, FROZEN, Particles, constant

CUBE_BITS = 16  # bits of a cube index along an axis; indices are clamped to them
WEIGHTS = (1 << 3 * CUBE_BITS, 1 << 2 * CUBE_BITS, 1 << CUBE_BITS, 1)  # of scene, x, y, z in the key of a cube


@dataclass
class RestLog:
    """Counts of computed particles in a rollout."""

    n_rows: int = 0  #: particles of the newest clouds of all scenes
    moving: list[int] = field(default_factory=list)  #: computed particles of each step
    remembered: int = 0  #: number of computed backgrounds
    calls: int = 0  #: calls of the network for moving particles

    @property
    def resting_share(self) -> float:
        """Fraction of particles, over all steps, that were not computed."""
        total = self.n_rows * len(self.moving)
        return 1 - sum(self.moving) / total if total else 0.0


class Sleepers:
    """Decides by ``rule`` in each step which particles sleep: ``asleep``, bool [N]. At first all are awake.

    Args:
        newest: initial particles, one cloud a scene.
        grid_size: edge of a cell in metres.
        history: steps in the model's input. Particles fall asleep only if they were quiet in all of them.
        changing: attributes that a step may change; None: all predicted attributes.
    """

    def __init__(
        self, rule: Sleep, newest: Particles, grid_size: float, history: int, changing: Iterable[str] | None = None
    ):
        self.rule, self.patience = rule, max(rule.patience, history)
        self.reach = rule.eps * grid_size
        predicted = {name for name in newest.row_fields() if ATTRIBUTES[name].predicted}
        self.changing = predicted if changing is None else set(changing)
        self.asleep = torch.zeros(newest.n_rows, dtype=torch.bool, device=newest.means.device)
        self.any_asleep = False
        self.last_change = torch.zeros_like(self.asleep, dtype=torch.int64)  # step of the last change
        self.n_steps = 0

    @torch.no_grad()
    def update(self, before: Particles, after: Particles) -> bool:
        """Updates ``asleep`` by the changes of a step. Returns whether it changed.

        Needs a device sync only while particles sleep or may fall asleep.
        """
        self.n_steps += 1
        moved = (after.activity != before.activity) > self.rule.eps  # a change of activity counts as 1
        for name in sorted(self.changing):
            allowed = self.reach if name == "means" else self.rule.eps
            change = (getattr(after, name) - getattr(before, name)).abs()
            moved |= (change.flatten(1).amax(1) if change.dim() > 1 else change) > allowed
        self.last_change.masked_fill_(moved, self.n_steps)
        may_fall_asleep = self.n_steps % self.patience == 0
        if not (may_fall_asleep or self.any_asleep):
            return False
        may_sleep = self._may_sleep(before, after)
        asleep = may_sleep if may_fall_asleep else may_sleep & self.asleep
        if torch.equal(asleep, self.asleep):
            return False
        self.asleep, self.any_asleep = asleep, bool(asleep.any())
        return True

    def _may_sleep(self, before: Particles, after: Particles) -> Tensor:
        restless = self.last_change > self.n_steps - self.patience
        scene = after.row_scene()
        if self.rule.policy == "exact":
            n_restless = torch.zeros(after.origin.shape[0], dtype=torch.int64, device=scene.device)
            return n_restless.index_add_(0, scene, restless.long())[scene] == 0
        both = after.means, 2 * after.means - before.means
        here, ahead = (_cubes(positions, after.origin, scene, self.rule.halo) for positions in both)
        stirs = restless & (after.activity != ASLEEP)
        return ~_near(here, torch.cat([here[stirs], ahead[stirs]])) & ~restless & (after.activity != FROZEN)


def _cubes(positions: Tensor, origin: Tensor, scene: Tensor, edge: float) -> Tensor:
    """Key of the scene and cube of every particle, int64 [N]."""
    cubes = torch.floor((positions.double() - origin[scene]) / edge).nan_to_num()
    cubes = cubes.clamp(1, 2**CUBE_BITS - 2).long()  # so that neighbours have valid keys
    return (torch.cat([scene[:, None], cubes], 1) * constant(WEIGHTS, scene.device)).sum(1)


def _near(cubes: Tensor, restless: Tensor) -> Tensor:
    """bool [N]: whether a cube is one of ``restless`` or a neighbour of one."""
    steps = torch.arange(-1, 2, device=cubes.device)
    offsets = torch.cartesian_prod(steps, steps, steps) @ constant(WEIGHTS, cubes.device)[1:]
    return torch.isin(cubes, torch.unique(restless)[:, None] + offsets)
