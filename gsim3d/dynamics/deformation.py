"""How bodies are bent: the way from each particle to where it would be had the matter around it kept its shape."""

from __future__ import annotations

import torch
from torch import Tensor

from gsim3d.dynamics.clouds import with_field
from gsim3d.dynamics.matter import Matter
from gsim3d.dynamics.rigid import turned_most
from gsim3d.types import Particles, constant, take_runs

DEFORMATION_CHANNELS = 3


@torch.no_grad()
def deformation(history: Particles, length: float, grid_size: float, matter: Matter | None = None) -> Tensor:
    """[N, 3] metres, from each movable row of the newest clouds to where it would be if the matter in a Gaussian window
    around it had only moved and turned since ``history.reference``; 0 of other rows.

    What pulls an elastic body back is a function of it, and a history of a few steps does not tell it: a body that is
    squeezed looks like one that was made so.

    Args:
        history: clouds sorted by (scene, step).
        length: metres, standard deviation of the window; about the radius of a body.
        grid_size: metres, edge of the dynamics' cells.
        matter: of ``history``, with windows of that length; None: found here.
    Returns:
        Rows of the newest clouds, packed. No gradients.
    """
    matter = matter or Matter.of(history, grid_size, length)
    if matter is None:
        return history.means.new_zeros(0, 3)
    clouds, now = history.clouds, matter.samples
    reference = take_runs(with_field(history, "reference").reference, clouds.row_runs(matter.newest))
    with torch.autocast(reference.device.type, enabled=False):
        scenes = constant(tuple(clouds.scenes[q] for q in matter.newest), reference.device)
        before = (matter.padded(reference).double() - history.origin[scenes][:, None]).to(reference.dtype)
        then = now.take(before)
        there = now.mean_of(then)[:, None]
        then = torch.where(now.known[:, :, None], then - there, 0)
        centre, began = matter.window @ now.places, matter.window @ then
        products = matter.window @ (now.places[:, :, :, None] * then[:, :, None]).flatten(2)
        turns = turned_most(products.unflatten(2, (3, 3)) - centre[:, :, :, None] * began[:, :, None])
        shifts = centre - (turns @ began[:, :, :, None])[..., 0]
        *columns, shift = matter.lattice.at(matter.places, *turns.unbind(3), shifts)
        kept = (torch.stack(columns, 3) @ (before - there)[:, :, :, None])[..., 0] + shift
        return matter.packed(torch.where(matter.rows.wanted[:, :, None], kept - matter.places, 0))
