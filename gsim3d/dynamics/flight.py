"""What becomes of matter in flight, whatever is predicted: it flies on, turns and falls."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import torch
from torch import Tensor

from gsim3d.dynamics.matter import Matter

HOLDING, REACHING = 2, 4  # powers of the nearness: what shares of motions count, and what a touch is told from
TOUCHING = 0.02  # mean nearness of the matter around a row to what is frozen, from which on it touches that in full


@dataclass(frozen=True)
class Flight:
    """How far each row of the newest clouds is from flying.

    near: [N, 1], how far shares of motions count, from 0 to 1: as far as what is frozen is near.
    touch: [N, 1], of :func:`touching`.
    gravity: [3] metres a step, of every step.
    push: what bodies make of changes [N, 3] of their rows, of :func:`gsim3d.dynamics.push.pushed`; None: all of them.
    """

    near: Tensor
    touch: Tensor
    gravity: Tensor
    push: Callable[[Tensor], Tensor] | None = None

    @classmethod
    def of(
        cls,
        near: Tensor,
        matter: Matter | None,
        gravity: Tensor,
        push: Callable[[Tensor, Tensor, Matter | None], Tensor] | None = None,
    ) -> Flight:
        """near: [N, 1] from 0 to 1, how near what is frozen is, of :func:`gsim3d.dynamics.contact.contact`."""
        reach = near**REACHING
        push = None if push is None else partial(push, near=reach, matter=matter)
        return cls(near**HOLDING, touching(reach, matter), gravity, push)

    def changed(self, changes: Tensor) -> Tensor:
        """[1, N, 3], what happens of ``changes`` that are predicted, and what does by itself."""
        changes = self.touch * changes
        return self.falls + (changes if self.push is None else self.push(changes[0])[None])

    @property
    def falls(self) -> Tensor:
        """[N, 3] metres a step, of every step."""
        return (1 - self.touch) * self.gravity


def touching(near: Tensor, matter: Matter | None) -> Tensor:
    """[N, 1], from 0 of rows around which all matter flies to 1 of those around which some touches what is frozen: a
    contact anywhere changes how the whole body moves.

    Args:
        near: [N, 1] of the rows of the newest clouds, packed, from 0 to 1.
        matter: of them, with windows about the size of a body; None: there are no rows.
    """
    if matter is None:
        return near
    with torch.autocast(near.device.type, enabled=False):
        sampled = matter.samples.take(matter.padded(near.expand(-1, 3)))
        (mean,) = matter.lattice.at(matter.places, matter.window @ sampled)
        return (matter.packed(mean)[:, :1] / TOUCHING).clamp(max=1)
