"""Split of a history into moving particles, which the network advances, and a static background."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from gsim3d.state import ASLEEP, FROZEN, Particles, last_steps, newest_clouds


@dataclass(frozen=True)
class Partition:
    """Moving particles and background of a history. Scenes without moving particles are in neither part."""

    newest: Particles  #: newest cloud of every scene, with all its particles
    moving: Particles  #: all clouds, reduced to moving particles
    background: Particles | None  #: static, awake particles of the newest clouds; None for symmetric models
    rows: Tensor  #: int64, indices into ``newest`` of the newest particles in ``moving``

    @classmethod
    def of(cls, history: Particles, *, asymmetric: bool, asleep: Tensor | None = None) -> Partition:
        """Splits ``history``; needs a device sync, to count particles.

        If ``asymmetric``, frozen particles are static and form the background. Otherwise they count as moving, since
        their latents change, and only whole scenes may be asleep. ``asleep``: bool, sleeping particles of the newest
        clouds, static as well; all clouds of a scene must then have the same particles.
        """
        newest, background = last_steps(history, 1), None
        if not asymmetric and asleep is None:
            return cls(newest, _awake(history), None, torch.arange(newest.n_rows, device=newest.means.device))
        rests = history.activity == FROZEN if asymmetric else torch.zeros_like(history.activity, dtype=torch.bool)
        if asleep is not None:
            rests = rests | _in_every_cloud(history, newest, asleep)
        moving = _awake(history.select_rows(~rests))
        marked = history.with_clouds(history.clouds, activity=rests.to(torch.uint8))
        newest_rests = last_steps(marked, 1).activity > 0
        if asymmetric:
            awake = set(moving.clouds.scenes)
            background = newest.select_rows(newest_rests & (newest.activity != ASLEEP))
            background = background.select_clouds([q for q, s in enumerate(newest.clouds.scenes) if s in awake])
        return cls(newest, moving, background, torch.nonzero(~newest_rests)[:, 0])

    @property
    def nothing_moves(self) -> bool:
        return self.moving.n_clouds == 0

    def whole(self, step: Particles | None, ahead: int) -> Particles:
        """All particles ``ahead`` steps after the newest, with the moving ones from ``step`` (None: nothing moved)."""
        later = self.newest.clouds.ahead(ahead)
        if step is None:
            return self.newest.with_clouds(later)
        if self.rows.shape[0] == self.newest.n_rows:
            return step.with_clouds(later)
        fields = self.newest.row_fields()
        del fields["static_latents"]
        changed = {name: value.index_copy(0, self.rows, getattr(step, name)) for name, value in fields.items()}
        return self.newest.with_clouds(later, **changed)


def _awake(moving: Particles) -> Particles:
    """Clouds of the scenes whose newest cloud has particles."""
    table = moving.clouds
    awake = {table.scenes[q] for q in newest_clouds(table) if table.count(q) > 0}
    kept = [q for q, scene in enumerate(table.scenes) if scene in awake]
    return moving if len(kept) == len(table) else moving.select_clouds(kept)


def _in_every_cloud(history: Particles, newest: Particles, asleep: Tensor) -> Tensor:
    """bool [M] for ``history``: repeats the marks of the newest cloud of a scene for all its clouds."""
    table, starts = history.clouds, dict(zip(newest.clouds.scenes, zip(newest.clouds.starts, newest.clouds.starts[1:])))
    marks = [asleep[slice(*starts[scene])] for scene in table.scenes]
    return torch.cat(marks) if marks else asleep
