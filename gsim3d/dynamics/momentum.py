"""How particles that carry their velocity go on: the momentum of the matter around each, and its own."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional as F

from gsim3d.dynamics.clouds import newest_clouds, with_field
from gsim3d.dynamics.rigid import Lattice, RigidFit, onward_at
from gsim3d.dynamics.samples import Rows, Samples, squares, weights
from gsim3d.types import Particles, take_runs

STIFFNESS = 1e-5  # of fits to known paths: what it takes of a spin it takes in every step


def momentum(history: Particles, length: float, grid_size: float) -> Tensor:
    """[N, 3, 3] metres a step, of the velocities that particles carry: how the matter in a Gaussian window around each
    row of the newest clouds moves; how the row itself will if that goes on and turns as one body; and the row's own.

    What a contact did to some of a body's rows in their last step is part of the momentum of the body at once.

    Args:
        history: clouds sorted by (scene, step); what carries no velocity rests.
        length: metres, standard deviation of the window; about the radius of a body.
        grid_size: metres, edge of the dynamics' cells.
    Returns:
        Rows of the newest clouds, packed. Gradients: of velocities.
    """
    clouds = history.clouds
    own = take_runs(with_field(history, "velocity").velocity, clouds.row_runs(newest_clouds(clouds)))
    return torch.stack([*_rigid(history, own, length, grid_size), own], 1)


def _rigid(history: Particles, own: Tensor, length: float, grid_size: float) -> tuple[Tensor, Tensor]:
    """[N, 3] twice, of rows that moved by ``own`` [N, 3]: the motion of the window around each, and what comes next of
    the rigid motion of that window."""
    clouds, newest = history.clouds, newest_clouds(history.clouds)
    counts = [clouds.count(q) for q in newest]
    if not any(counts):
        return own, own
    with torch.autocast(own.device.type, enabled=False):
        with torch.no_grad():
            now, rows = Samples(history, newest, grid_size), Rows(history, newest, grid_size)
            here = now.mean[:, None]
            now.seen_from(here)
            places, lattice = rows.places - here, Lattice(now.places, now.known)
            window = weights(squares(lattice.nodes, now.places) * (-0.5 / length**2), now.known)
            body = RigidFit(window, now.places, length, STIFFNESS)
        most = rows.wanted.shape[1]
        paths = torch.stack([F.pad(part, (0, 0, 0, most - len(part))) for part in own.split(counts)])
        found = lattice.at(places, *body.fit(now.take(paths)), body.centre)
        of_rows = (torch.where(rows.wanted[:, :, None], x, 0) for x in (found[0], onward_at(places, *found)))
    moved, rigid = (torch.cat([x[b, :n] for b, n in enumerate(counts)]) for x in of_rows)
    return moved, rigid
