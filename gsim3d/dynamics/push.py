"""What the background does to bodies: it stops rows that would get behind it, and nothing else moves a body as one."""

from __future__ import annotations

import torch
from torch import Tensor

from gsim3d.dynamics.contact import FIRM, Beside
from gsim3d.dynamics.matter import Matter
from gsim3d.dynamics.rigid import LITTLE, SMALLEST, RigidFit
from gsim3d.state import Particles, take_runs

REACHING = 4  # power of the nearness to the background, which is as much as a row is pushed by it
LEAST = 1e-6  # metres a step along a surface: slower rows are held
PASSES, MOST_TIMES = 3, 50.0  # in which a solid body gets out of the background, and the longest way of one


class Pushes:
    """The background near the rows of ``matter``, the newest ones of ``history``.

    length: metres, of the windows of ``matter``, about the radius of a body.
    friction: most of what a stopped row loses along a surface, over what it loses towards it (a number).
    skin: metres over the background at which rows stop: they are seen inside of their bodies (a number).
    solid: what stops some rows moves their body in the same step. Rows that are less opaque than ``contact.FIRM`` stop
        none: they lie outside of the bodies that they are seen of, and a ball would stand on them.
    """

    def __init__(
        self,
        history: Particles,
        matter: Matter,
        beside: Beside,
        length: float,
        friction: Tensor,
        skin: Tensor,
        solid: bool = False,
    ):
        self._matter, self._friction, self._solid = matter, friction, solid
        with torch.no_grad(), torch.autocast(history.means.device.type, enabled=False):
            self._body = RigidFit(matter.window, matter.samples.places, length, LITTLE)
            (self._centre,) = matter.of_rows(self._body.centre)
        height, self._normal = beside.surface(self._centre)
        runs = history.clouds.row_runs(matter.newest)
        newest = take_runs(history.means, runs)
        self._stops = take_runs(history.opacities.detach(), runs)[:, None] >= FIRM if solid else None
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
            for _ in range(PASSES if self._solid else 0):
                moves = moves + self._pushed(self._stopped(moves))
            return moves + self._stopped(moves)

    def _pushed(self, stopped: Tensor) -> Tensor:
        """How bodies move as one, each so far that the squares of what its rows, ``stopped``, still miss are least."""
        moves = self._as_one(stopped)
        with torch.no_grad():
            missed, done = (self._mean((stopped * x).sum(1, keepdim=True)) for x in (stopped, moves))
            times = (missed / done.clamp(min=SMALLEST)).clamp(1, MOST_TIMES)
        return times * moves

    def _mean(self, values: Tensor) -> Tensor:
        """[N, 1], of the rows in the window around each row."""
        matter = self._matter
        (found,) = matter.of_rows(matter.window @ matter.samples.take(matter.padded(values.expand(-1, 3))))
        return matter.packed(found)[:, :1]

    def _as_one(self, moves: Tensor) -> Tensor:
        """The rigid part of ``moves`` of the rows in the window around each row."""
        matter = self._matter
        found = self._body.fit(matter.samples.take(matter.padded(moves)))
        moved, spin = matter.of_rows(*found)
        return matter.packed(moved + torch.linalg.cross(spin, matter.places - self._centre))

    def _stopped(self, moves: Tensor) -> Tensor:
        """What is to be added to ``moves``. A row that is behind the surface may stay there."""
        into = (moves * self._normal).sum(1, keepdim=True)
        stop = torch.minimum((-into).clamp(min=0), (-self._height - into).clamp(min=0))
        along = moves - into * self._normal
        if self._stops is not None:
            stop = stop * self._stops
        speed = along.square().sum(1, keepdim=True).clamp(min=LEAST**2).sqrt()
        held = (self._friction.clamp(min=0) * stop / speed).clamp(max=1)
        return stop * self._normal - held * along
