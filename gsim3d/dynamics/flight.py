"""What becomes of matter in flight, whatever is predicted: it flies on, turns and falls."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from gsim3d.dynamics.matter import Matter

TOUCHING = 0.02  # mean nearness of the matter around a row to what is frozen, from which on it touches that in full


@dataclass(frozen=True)
class Flight:
    """How far each row of the newest clouds is from flying.

    near: [N, 1], how near what is frozen is to it, from 0 to 1, of :func:`gsim3d.dynamics.contact.contact`.
    touch: [N, 1], of :func:`touching`.
    gravity: [3] metres a step, of every step.
    """

    near: Tensor
    touch: Tensor
    gravity: Tensor

    @property
    def falls(self) -> Tensor:
        """[N, 3] metres a step, of every step."""
        return (1 - self.touch) * self.gravity


def touching(near: Tensor, matter: Matter | None) -> Tensor:
    """[N, 1], from 0 of rows around which all matter flies to 1 of those around which some touches what is frozen: a
    contact anywhere changes how the whole body moves.

    Args:
        near: [N, 1] of the rows of the newest clouds, packed.
        matter: of them, with windows about the size of a body; None: there are no rows.
    """
    if matter is None:
        return near
    with torch.autocast(near.device.type, enabled=False):
        sampled = matter.samples.take(matter.padded(near.expand(-1, 3)))
        (mean,) = matter.lattice.at(matter.places, matter.window @ sampled)
        return (matter.packed(mean)[:, :1] / TOUCHING).clamp(max=1)
