"""How bodies are bent: the way from each particle to where it would be had the matter around it kept its shape."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional as F

from gsim3d.dynamics.clouds import newest_clouds, with_field
from gsim3d.dynamics.rigid import Lattice, turned_most
from gsim3d.dynamics.samples import Rows, Samples, squares, weights
from gsim3d.types import Particles, constant, take_runs

DEFORMATION_CHANNELS = 3


@torch.no_grad()
def deformation(history: Particles, length: float, grid_size: float) -> Tensor:
    """[N, 3] metres, from each movable row of the newest clouds to where it would be if the matter in a Gaussian window
    around it had only moved and turned since ``history.reference``; 0 of other rows.

    What pulls an elastic body back is a function of it, and a history of a few steps does not tell it: a body that is
    squeezed looks like one that was made so.

    Args:
        history: clouds sorted by (scene, step).
        length: metres, standard deviation of the window; about the radius of a body.
        grid_size: metres, edge of the dynamics' cells.
    Returns:
        Rows of the newest clouds, packed. No gradients.
    """
    clouds, newest = history.clouds, newest_clouds(history.clouds)
    counts = [clouds.count(q) for q in newest]
    if not any(counts):
        return history.means.new_zeros(0, 3)
    reference = take_runs(with_field(history, "reference").reference, clouds.row_runs(newest))
    with torch.autocast(reference.device.type, enabled=False):
        now, rows = Samples(history, newest, grid_size), Rows(history, newest, grid_size)
        here = now.mean[:, None]
        now.seen_from(here)
        most = rows.wanted.shape[1]
        scenes = constant(tuple(clouds.scenes[q] for q in newest), reference.device)
        before = torch.stack([F.pad(part, (0, 0, 0, most - len(part))) for part in reference.split(counts)])
        before = (before.double() - history.origin[scenes][:, None]).to(reference.dtype)
        then = now.take(before)
        there = now.mean_of(then)[:, None]
        then = torch.where(now.known[:, :, None], then - there, 0)
        lattice = Lattice(now.places, now.known)
        window = weights(squares(lattice.nodes, now.places) * (-0.5 / length**2), now.known)
        centre, began = window @ now.places, window @ then
        products = window @ (now.places[:, :, :, None] * then[:, :, None]).flatten(2)
        turns = turned_most(products.unflatten(2, (3, 3)) - centre[:, :, :, None] * began[:, :, None])
        shifts = centre - (turns @ began[:, :, :, None])[..., 0]
        places = rows.places - here
        *columns, shift = lattice.at(places, *turns.unbind(3), shifts)
        kept = (torch.stack(columns, 3) @ (before - there)[:, :, :, None])[..., 0] + shift
        found = torch.where(rows.wanted[:, :, None], kept - places, 0)
    return torch.cat([found[b, :n] for b, n in enumerate(counts)])
