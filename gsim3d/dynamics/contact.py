"""What rests beside what can move: the way from each particle to the background near it, and its surface there."""

from __future__ import annotations

import torch
from torch import Tensor

from gsim3d.dynamics.matter import Matter
from gsim3d.dynamics.planes import planes
from gsim3d.dynamics.samples import FAINTEST, Samples, grouped, squares, ungrouped, weights
from gsim3d.state import FROZEN, Particles

CONTACT_CHANNELS = 4
WINDOW = 0.5  # of the length: standard deviation of the window in which places of the background are averaged
SOLID = 0.1  # opacity; below it are rows at silhouettes, whose depth was not known
FIRM = 0.5  # opacity of what stops bodies: what stays behind in the air has less


class Beside:
    """What is frozen near the rows of ``matter``, the newest ones of ``history`` that may move; None has none.

    Up to ``samples.SAMPLES`` rows of a scene's background are looked at, evenly spread, none of those that are
    transparent. Scenes do not see each other. No gradients.

    length: metres; larger than what a step moves a row, so that a contact is seen before it happens.
    opacity: of rows that are looked at, or more.
    contact: [N, 4], of :func:`contact`.
    """

    def __init__(self, history: Particles, length: float, matter: Matter | None, opacity: float = SOLID):
        self._matter, self.length = matter, length
        if matter is None:
            self.contact = history.means.new_zeros(0, CONTACT_CHANNELS)
            return
        with torch.no_grad(), torch.autocast(history.means.device.type, enabled=False):
            self._rests = Samples(matter.rows.that_are(history, FROZEN, opacity))
            self._here = self._rests.mean[:, None]
            self._rests.seen_from(self._here)
            self._places = matter.rows.places - self._here
            places, self._around, known = grouped(self._places, self._rests.places, self._rests.known)
            self._window = weights(squares(places, self._around) * (-0.5 / (WINDOW * length) ** 2), known)
            way = (ungrouped(self._window @ self._around, self._places) - self._places) / length
            near = (-0.5 * way.square().sum(2, keepdim=True)).clamp(min=FAINTEST).exp()
            any_rests = (self._rests.n > 0)[:, None, None]
            self.contact = matter.packed(torch.where(any_rests, torch.cat([near * way, near], 2), 0))

    def surface(self, centre: Tensor) -> tuple[Tensor, Tensor]:
        """The plane through the background near each row: the height [N, 1] of the row over it, metres, and its unit
        normal [N, 3]. Bodies are in front of it: ``centre`` [B, m, 3], of the body of each row of ``matter``, from
        ``matter.here``. 0 of rows that do not move, and where nothing is frozen."""
        with torch.no_grad(), torch.autocast(self._places.device.type, enabled=False):
            found = planes(self._window, self._around, WINDOW * self.length)
            middle, normal = (ungrouped(x, self._places) for x in found)
            ahead = ((centre + self._matter.here - self._here - middle) * normal).sum(2, keepdim=True)
            normal = torch.where(ahead < 0, -normal, normal)
            height = ((self._places - middle) * normal).sum(2, keepdim=True)
            found = self._matter.packed(torch.cat([height, normal], 2))
            return found[:, :1], found[:, 1:]


def contact(history: Particles, length: float, grid_size: float, matter: Matter | None = None) -> Tensor:
    """[N, 4]: how near what is frozen is to each row of the newest clouds that moves, exp(-d^2 / 2 length^2), and that
    times the way there in units of ``length``, which comes first. 0 of other rows, and where nothing is frozen.

    The way leads to the mean of the background within a Gaussian window around its nearest part: of a plane it is the
    normal, and a row that got behind the plane is told the way back (:class:`Beside`).

    Args:
        history: clouds sorted by (scene, step).
        length: metres; larger than what a step moves a row.
        grid_size: metres, edge of the dynamics' cells.
        matter: of ``history``; None: found here.
    Returns:
        Rows of the newest clouds, packed. No gradients.
    """
    return Beside(history, length, matter or Matter.of(history, grid_size)).contact
