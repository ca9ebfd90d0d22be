"""What becomes of bodies if nothing is predicted: they fly on, fall, hit what is frozen, and go back to their shape."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from gsim3d.dynamics.clouds import with_field
from gsim3d.dynamics.deformation import Shape
from gsim3d.dynamics.matter import Matter
from gsim3d.dynamics.momentum import STIFFNESS
from gsim3d.dynamics.planes import planes
from gsim3d.dynamics.rigid import RigidFit, onward_at
from gsim3d.dynamics.samples import Samples, squares, weights
from gsim3d.types import FROZEN, Particles, constant, take_runs

SUBSTEPS = 2  # of a step: bodies hit the ground harder than one step can tell
SOLID = 0.5  # opacity; below it frozen rows stop nothing: at silhouettes their depth was not known
WINDOW = 0.5  # of the contact's length: standard deviation of the window in which frozen rows are a plane
TOUCHING = 0.2  # share of the matter around a row that touches something, from which on contact slows it in full
SMALLEST = 1e-9  # metres


@dataclass(frozen=True)
class Law:
    """What a body does, parameters that training may change.

    gravity: [3] metres a step, of every step.
    stiffness: share of the way back to its shape that a row goes in a step.
    friction: of sliding on what is frozen.   damping: share of the way along it that matter which touches it loses.
    """

    gravity: Tensor
    stiffness: Tensor
    friction: Tensor
    damping: Tensor


def mechanics(
    history: Particles, length: float, contact_length: float, grid_size: float, law: Law, matter: Matter | None = None
) -> Tensor:
    """[N, 3] metres, how each movable row of the newest clouds moves in the next step; 0 of others.

    A window of matter goes on as it moved, as one rigid body, and falls; rows go part of the way back to the shape that
    matter had; and what would get behind frozen rows is put on the plane that they make, and slides there less
    (position based dynamics: Müller et al., 2005 and 2007). So a body that is stopped below turns, rolls and is
    squeezed; how high it jumps is for the network to say. All this happens ``SUBSTEPS`` times.

    Args:
        history: clouds sorted by (scene, step); what carries no velocity rests.
        length: metres, standard deviation of the window; about the radius of a body.
        contact_length: metres, of contacts with what is frozen.
        grid_size: metres, edge of the dynamics' cells.
        matter: of ``history``, with windows of that length; None: found here.
    Returns:
        Rows of the newest clouds, packed. Gradients: of velocities and ``law``.
    """
    matter = matter or Matter.of(history, grid_size, length)
    if matter is None:
        return history.means.new_zeros(0, 3)
    runs = history.clouds.row_runs(matter.newest)
    velocity, reference = (
        matter.padded(take_runs(getattr(with_field(history, name), name), runs)) for name in ("velocity", "reference")
    )
    device, n = history.means.device, SUBSTEPS
    scenes = constant(tuple(history.clouds.scenes[q] for q in matter.newest), device)
    with torch.autocast(device.type, enabled=False):
        reference = (reference.detach().double() - history.origin[scenes][:, None]).to(matter.places.dtype)
        shape = Shape(matter, reference)
        height, normal, near = _planes(matter, history, WINDOW * contact_length)
        stays = (1 - law.stiffness) ** (1 / n)
        moves = matter.rows.wanted[:, :, None]
        places, sampled = matter.places, matter.samples.places
        # The mean of a step is not its end: what falls is faster then.
        step = velocity / n + law.gravity * ((n - 1) / (2 * n * n))
        total = torch.zeros_like(step)
        for _ in range(n):
            fit = RigidFit(matter.window, sampled, length, STIFFNESS)
            found = matter.lattice.at(matter.places, *fit.fit(matter.samples.take(step)), fit.centre)
            onward = onward_at(places, *found)
            step = onward + law.gravity / n**2 + (1 - stays) * shape.way_back(places, sampled)
            into = -(height + (step * normal).sum(2, keepdim=True))
            touches = moves & (into > 0)
            push = torch.where(touches, near * into, 0)
            slide = step - (step * normal).sum(2, keepdim=True) * normal
            held = (law.friction * push / slide.norm(dim=2, keepdim=True).clamp(min=SMALLEST)).clamp(max=1)
            with torch.no_grad():
                touching = matter.samples.take((touches * near).expand(-1, -1, 3))
                (touched,) = matter.lattice.at(matter.places, matter.window @ touching)
                touched = (touched[..., :1] / TOUCHING).clamp(max=1)
            along = onward - (onward * normal).sum(2, keepdim=True) * normal
            step = step + push * normal - held * slide - (law.damping / n) * touched * (1 - held) * along
            step = torch.where(moves, step, 0)
            total = total + step
            with torch.no_grad():
                height = height + (step * normal).sum(2, keepdim=True)
                places, sampled = places + step, sampled + matter.samples.take(step)
        return matter.packed(total)


@torch.no_grad()
def _planes(matter: Matter, history: Particles, length: float) -> tuple[Tensor, Tensor, Tensor]:
    """Of each row the frozen plane near it: height above it [B, M, 1], its normal [B, M, 3] towards the side of the
    matter that moves, and how much of a plane is there [B, M, 1], from 0 to 1."""
    rests = Samples(matter.rows.that_are(history, FROZEN, SOLID))
    rests.seen_from(matter.here)
    window = weights(squares(matter.places, rests.places) * (-0.5 / length**2), rests.known)
    middle, normal = planes(window, rests.places, length)
    side = (normal * middle).sum(2, keepdim=True)  # of the plane; what moves is around the origin
    normal = torch.where(side > 0, -normal, normal)
    way = matter.places - middle
    height = (way * normal).sum(2, keepdim=True)
    aside = (way - height * normal).square().sum(2, keepdim=True)
    near = (aside * (-0.5 / length**2)).exp()
    return height, normal, torch.where((rests.n > 0)[:, None, None], near, 0)
