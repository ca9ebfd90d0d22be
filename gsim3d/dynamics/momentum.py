"""How particles go on that have been simulated: their last step is known row by row, and with it their momentum."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional as F

from gsim3d.dynamics.clouds import newest_clouds
from gsim3d.dynamics.rigid import Lattice, RigidFit, onward_at
from gsim3d.dynamics.samples import Rows, Samples, squares, weights
from gsim3d.types import DYNAMIC, Particles, constant, take_runs

STIFFNESS = 1e-5  # of fits to known paths: what it takes of a spin it takes in every step


def momentum(history: Particles, onward: Tensor, length: float, grid_size: float) -> Tensor:
    """[N, 2, 3] metres a step: what comes next at each row of the newest clouds if the matter in a Gaussian window
    around it goes on and turns as in its last step; and the last step of the row itself.

    Where the last step was predicted it is known for every row, and what a contact did to some of a body's rows is
    part of the momentum of the body at once.

    Args:
        history: clouds sorted by (scene, step).
        onward: [N, 3] metres a step, of :func:`gsim3d.dynamics.motion.motion`; the last step of rows of which none is
            known.
        length: metres, standard deviation of the window; about the radius of a body.
        grid_size: metres, edge of the dynamics' cells.
    Returns:
        Rows of the newest clouds, packed. Gradients: of places in the last two steps, where these tell the last one.
    """
    clouds, newest = history.clouds, newest_clouds(history.clouds)
    own, known = own_motion(history, onward)
    counts = [clouds.count(q) for q in newest]
    if not any(counts):
        return torch.stack([own, own], 1)
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
        rigid = onward_at(places, *lattice.at(places, *body.fit(now.take(paths)), body.centre))
    rigid = torch.cat([rigid[b, :n] for b, n in enumerate(counts)])
    return torch.stack([torch.where(known, rigid, onward), own], 1)


def own_motion(history: Particles, otherwise: Tensor) -> tuple[Tensor, Tensor]:
    """[N, 3] metres a step, how each row of the newest clouds moved since the step before it; bool [N, 1], where that
    is known.

    A row is the same particle where both clouds have as many rows, and at its place in the list the same static
    latents, bit by bit: steps that are predicted keep all that, encoded ones do not.

    Args:
        history: clouds sorted by (scene, step).
        otherwise: [N, 3], of rows that cannot be told.
    Returns:
        Rows of the newest clouds, packed. Gradients: of the means, and of ``otherwise``.
    """
    clouds, newest = history.clouds, newest_clouds(history.clouds)
    first = [0, *(q + 1 for q in newest[:-1])]
    known = [q > f and clouds.count(q) == clouds.count(q - 1) for f, q in zip(first, newest, strict=True)]
    runs = clouds.row_runs(newest)
    then = clouds.row_runs([q - k for q, k in zip(newest, known, strict=True)])
    gaps = [clouds.steps[q] - clouds.steps[q - k] for q, k in zip(newest, known, strict=True)]
    means, static, activity = (
        (take_runs(values, runs), take_runs(values, then))
        for values in (history.means, history.static_latents, history.activity)
    )
    moved = means[0] - means[1]
    same = (static[0] == static[1]).all(1) & (activity[0] == DYNAMIC) & (activity[1] == DYNAMIC)
    same = same & moved.isfinite().all(1)
    if any(gap != 1 for gap in gaps):
        counts = constant(tuple(clouds.count(q) for q in newest), moved.device)
        gap = constant(tuple(gaps), moved.device).repeat_interleave(counts, output_size=len(moved))
        same, moved = same & (gap > 0), moved / gap.clamp(min=1)[:, None]
    return torch.where(same[:, None], moved, otherwise), same[:, None]
