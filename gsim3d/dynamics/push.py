"""What the background does to a body: it pushes the rows near it, and their body takes the push as one."""

from __future__ import annotations

import torch
from torch import Tensor

from gsim3d.dynamics.matter import Matter
from gsim3d.dynamics.rigid import RigidFit, solved

STIFFNESS = 1e-5  # of windows against turning: what it takes of a spin it takes in every step
LEAST = 1e-4  # share of the matter around a row: a smaller one near the background is pushed less


def pushed(changes: Tensor, near: Tensor, matter: Matter | None, length: float, inertia: Tensor) -> Tensor:
    """[N, 3], ``changes`` of how rows move with the laws of motion kept: what rows of a body do to each other changes
    neither its momentum nor its spin, and a push does both, by where it is.

    Of the changes of rows in a window their own rigid part goes. In its place comes what a push gives that changes the
    window's velocity by the mean change of its rows near the background: that velocity, and the spin of it about the
    centre.

    Args:
        changes: [N, 3] metres a step, of the rows of the newest clouds, packed.
        near: [N, 1] from 0 to 1, how much each counts as near the background.
        matter: of them, with windows of ``length`` metres, about the radius of a body; None: there are no rows.
        inertia: of bodies, over that of the rows that are seen of them (a number).
    Returns:
        Gradients: of ``changes`` and ``inertia``.
    """
    if matter is None:
        return changes
    with torch.autocast(changes.device.type, enabled=False):
        places, window = matter.samples.places, matter.window
        body = RigidFit(window, places, length, STIFFNESS)
        sampled = matter.samples.take(matter.padded(changes))
        moved, spin = body.fit(sampled)
        touching = window * matter.samples.take(matter.padded(near)).mT
        touching = touching / touching.sum(2, keepdim=True).clamp(min=LEAST)
        push = touching @ sampled
        torque = touching @ torch.linalg.cross(places, sampled) - torch.linalg.cross(body.centre, push)
        turn = solved(body.inertia, torque) / inertia
        moved, spin, centre = matter.lattice.at(matter.places, push - moved, turn - spin, body.centre)
        return changes + matter.packed(moved + torch.linalg.cross(spin, matter.places - centre))
