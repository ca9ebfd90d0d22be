"""What the background does to bodies: it stops rows that would get behind it, and nothing else moves a body as one."""

from __future__ import annotations

import torch
from torch import Tensor

from gsim3d.dynamics.contact import Beside
from gsim3d.dynamics.matter import Matter
from gsim3d.dynamics.rigid import LITTLE, RigidFit
from gsim3d.types import Particles, take_runs

REACHING = 4  # power of the nearness to the background, which is as much as a row is pushed by it
LEAST = 1e-6  # metres a step along a surface: slower rows are held


class Pushes:
    """The background near the rows of ``matter``, the newest ones of ``history``.

    length: metres, of the windows of ``matter``, about the radius of a body.
    friction: most of what a stopped row loses along a surface, over what it loses towards it (a number).
    skin: metres over the background at which rows stop: they are seen inside of their bodies (a number).
    """

    def __init__(
        self, history: Particles, matter: Matter, beside: Beside, length: float, friction: Tensor, skin: Tensor
    ):
        self._matter, self._friction = matter, friction
        with torch.no_grad(), torch.autocast(history.means.device.type, enabled=False):
            self._body = RigidFit(matter.window, matter.samples.places, length, LITTLE)
            (self._centre,) = matter.lattice.at(matter.places, self._body.centre)
        height, self._normal = beside.surface(self._centre)
        newest = take_runs(history.means, history.clouds.row_runs(matter.newest))
        # For gradients: a row that is stopped comes to the same height wherever it was, and a higher one is less near.
        raised = ((newest - newest.detach()) * self._normal).sum(1, keepdim=True)
        self._height = height + raised - skin
        self._near = beside.contact[:, -1:] ** REACHING * (1 - REACHING / beside.length**2 * height * raised)

    def moves(self, onward: Tensor, motions: Tensor, back: Tensor) -> Tensor:
        """[N, 3] metres, how rows of the newest clouds move in a step.

        What rows of a body do to each other changes neither its momentum nor its spin: of that their rigid part in a
        window goes. ``back`` is of this kind, and ``motions`` as far as a row is not near the background. Then rows
        that would get behind it stop at its surface, and slide along it as far as friction lets them.

        Args:
            onward: [N, 3], what happens by itself.
            motions: [N, 3], what of motions is kept beside it.
            back: [N, 3], towards the shape that bodies had.
        Gradients: of all of them, of friction and skin, and of places as far as they tell where rows stop and how near
            they are.
        """
        with torch.autocast(onward.device.type, enabled=False):
            inner = (1 - self._near) * motions + back
            moves = onward + self._near * motions + inner - self._as_one(inner)
            return moves + self._stopped(moves)

    def _as_one(self, moves: Tensor) -> Tensor:
        """The rigid part of ``moves`` of the rows in the window around each row."""
        matter = self._matter
        found = self._body.fit(matter.samples.take(matter.padded(moves)))
        moved, spin = matter.lattice.at(matter.places, *found)
        return matter.packed(moved + torch.linalg.cross(spin, matter.places - self._centre))

    def _stopped(self, moves: Tensor) -> Tensor:
        """What is to be added to ``moves``. A row that is behind the surface may stay there."""
        into = (moves * self._normal).sum(1, keepdim=True)
        stop = torch.minimum((-into).clamp(min=0), (-self._height - into).clamp(min=0))
        along = moves - into * self._normal
        speed = along.square().sum(1, keepdim=True).clamp(min=LEAST**2).sqrt()
        held = (self._friction.clamp(min=0) * stop / speed).clamp(max=1)
        return stop * self._normal - held * along
