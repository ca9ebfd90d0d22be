"""How particles that carry their velocity go on and turn: the momentum of the matter around each, and its own."""

from __future__ import annotations

import torch
from torch import Tensor

from gsim3d.dynamics.matter import Matter
from gsim3d.dynamics.rigid import LITTLE, RigidFit, onward_at, spin_of
from gsim3d.dynamics.state import rotate_left
from gsim3d.state import Particles, newest_clouds, take_runs, with_attribute


def momentum(history: Particles, length: float, grid_size: float, matter: Matter | None = None) -> Tensor:
    """[N, 3, 3] metres a step, of the velocities that particles carry: how the matter in a Gaussian window around each
    row of the newest clouds moves; how the row itself will if that goes on and turns as one body; and the row's own.

    What a contact did to some of a body's rows in their last step is part of the momentum of the body at once.

    Args:
        history: clouds sorted by (scene, step); what carries no velocity rests.
        length: metres, standard deviation of the window; about the radius of a body.
        grid_size: metres, edge of the dynamics' cells.
        matter: of ``history``, with windows of that length; None: found here.
    Returns:
        Rows of the newest clouds, packed. Gradients: of velocities.
    """
    clouds = history.clouds
    own = take_runs(with_attribute(history, "velocity").velocity, clouds.row_runs(newest_clouds(clouds)))
    matter = matter or Matter.of(history, grid_size, length)
    moved = (own, own) if matter is None else _rigid(matter, own, length)
    return torch.stack([*moved, own], 1)


def _rigid(matter: Matter, own: Tensor, length: float) -> tuple[Tensor, Tensor]:
    """[N, 3] twice, of rows that moved by ``own`` [N, 3]: the motion of the window around each, and what comes next of
    the rigid motion of that window."""
    with torch.autocast(own.device.type, enabled=False):
        found = matter.of_rows(*_of_windows(matter, own, length, since=True))
        return matter.packed(found[0]), matter.packed(onward_at(matter.places, *found))


def _of_windows(matter: Matter, moved: Tensor, length: float, since: bool) -> tuple[Tensor, Tensor, Tensor]:
    """How far each window moved, its spin (rad) and its centre, [B, G, 3] each, of rows that moved by ``moved``, from
    where they are or, ``since`` then, to there."""
    paths, half = matter.samples.take(matter.padded(moved)), -0.5 if since else 0.5
    body = RigidFit(matter.window, matter.samples.places + half * paths, length, LITTLE)
    velocity, fitted = body.fit(paths)
    return velocity, spin_of(fitted), body.centre - half * velocity


@torch.no_grad()
def turned(turns: Tensor, moved: Tensor, length: float, matter: Matter | None) -> Tensor:
    """[N, 4], ``turns`` of the rows of the newest clouds after a step: turned on with the matter around each.

    Args:
        turns: [N, 4] (w, x, y, z), before the step.
        moved: [N, 3] metres, by the step.
        length: metres, standard deviation of the window; about the radius of a body.
        matter: before the step, with windows of that length; None: there are no rows.
    """
    if matter is None:
        return turns
    with torch.autocast(moved.device.type, enabled=False):
        _, spin, _ = _of_windows(matter, moved, length, since=False)
        (spin,) = matter.of_rows(spin)
        return rotate_left(turns, matter.packed(spin))
