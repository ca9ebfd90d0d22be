"""What rests beside what can move: the way from each particle to the background near it."""

from __future__ import annotations

import torch
from torch import Tensor

from gsim3d.dynamics.matter import Matter
from gsim3d.dynamics.samples import FAINTEST, Samples, squares, weights
from gsim3d.types import FROZEN, Particles

CONTACT_CHANNELS = 4
WINDOW = 0.5  # of the length: standard deviation of the window in which places of the background are averaged
SOLID = 0.1  # opacity; below it are rows at silhouettes, whose depth was not known


@torch.no_grad()
def contact(history: Particles, length: float, grid_size: float, matter: Matter | None = None) -> Tensor:
    """[N, 4]: how near what is frozen is to each row of the newest clouds that moves, exp(-d^2 / 2 length^2), and that
    times the way there in units of ``length``, which comes first. 0 of other rows, and where nothing is frozen.

    The way leads to the mean of the background within a Gaussian window around its nearest part: of a plane it is the
    normal, and a row that got behind the plane is told the way back. Up to ``samples.SAMPLES`` rows of a scene's
    background are looked at, evenly spread, none of those that are transparent. Scenes do not see each other.

    Args:
        history: clouds sorted by (scene, step).
        length: metres; larger than what a step moves a row, so that a contact is seen before it happens.
        grid_size: metres, edge of the dynamics' cells.
        matter: of ``history``; None: found here.
    Returns:
        Rows of the newest clouds, packed. No gradients.
    """
    matter = matter or Matter.of(history, grid_size)
    if matter is None:
        return history.means.new_zeros(0, CONTACT_CHANNELS)
    with torch.autocast(history.means.device.type, enabled=False):
        rests = Samples(matter.rows.that_are(history, FROZEN, SOLID))
        here = rests.mean[:, None]
        rests.seen_from(here)
        places = matter.rows.places - here
        window = weights(squares(places, rests.places) * (-0.5 / (WINDOW * length) ** 2), rests.known)
        way = (window @ rests.places - places) / length
        near = (-0.5 * way.square().sum(2, keepdim=True)).clamp(min=FAINTEST).exp()
        any_rests = (rests.n > 0)[:, None, None]
        return matter.packed(torch.where(any_rests, torch.cat([near * way, near], 2), 0))
