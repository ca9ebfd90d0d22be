"""What becomes of matter in flight, whatever is predicted: it flies on, turns and falls."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from gsim3d.dynamics.matter import Matter
from gsim3d.dynamics.push import REACHING, Pushes

HOLDING = 2  # power of the nearness to the background, which is as much as shares of motions count
TOUCHING = 0.02  # mean nearness of the matter around a row to what is frozen, from which on it touches that in full
BACK, STIFF_BACK = 0.3, 1.2  # share of the way back to its shape that a row goes in a step if nothing is predicted


@dataclass(frozen=True)
class Flight:
    """How far each row of the newest clouds is from flying.

    near: [N, 1], how far shares of motions count, from 0 to 1: as far as what is frozen is near.
    touch: [N, 1], of :func:`touching`.
    gravity: [3] metres a step, of every step.
    pushes: what the background does, where nothing but shares is predicted; None: that is predicted.
    """

    near: Tensor
    touch: Tensor
    gravity: Tensor
    pushes: Pushes | None = None

    @classmethod
    def of(cls, near: Tensor, matter: Matter | None, gravity: Tensor, pushes: Pushes | None = None) -> Flight:
        """near: [N, 1] from 0 to 1, how near what is frozen is, of :func:`gsim3d.dynamics.contact.contact`."""
        return cls(near**HOLDING, touching(near**REACHING, matter), gravity, pushes)

    def moves(self, onward: Tensor, changes: Tensor, motions: Tensor, back: Tensor) -> Tensor:
        """[N, 3] metres, how rows move in a step.

        Args:
            onward: [N, 3], how they do by themselves, but for gravity.
            changes, motions: [N, 3], what is predicted, and what of motions is kept beside ``onward``.
            back: [N, 3], towards the shape that bodies had.
        """
        if self.pushes is None:
            return onward + self.falls + self.touch * changes + self.near * motions + back
        return self.pushes.moves(onward + self.gravity, self.touch * motions, back)

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
        (mean,) = matter.of_rows(matter.window @ sampled)
        return (matter.packed(mean)[:, :1] / TOUCHING).clamp(max=1)
