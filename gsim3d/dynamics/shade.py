"""What stands in the light of a particle: how much movable matter there is on its way to a lamp far away."""

from __future__ import annotations

import torch
from torch import Tensor

from gsim3d.dynamics.matter import Matter
from gsim3d.dynamics.samples import FAINTEST, Samples, grouped, squares, ungrouped
from gsim3d.state import FROZEN, Particles

BEAM = 2.0  # cells: standard deviation of the beam of light in which matter is counted
NEAREST = 3.0  # cells towards the light, from which on matter counts half; less is the surface that a row is part of
EDGE = 0.5  # cells, over which it begins to count


def shade(history: Particles, lights: Tensor, grid_size: float, matter: Matter | None = None) -> Tensor:
    """[N, L]: log(1 + n) of each row of the newest clouds and each light, where n is the matter between them: rows of
    its scene that move, counted in a Gaussian beam from the row towards the light. 0 of rows that are asleep.

    A shadow falls where n is large: on the background, on another body, and on the side of a body that is turned away.
    Up to ``samples.SAMPLES`` movable rows of a scene are looked at, evenly spread. Scenes do not see each other.

    Args:
        history: clouds sorted by (scene, step).
        lights: [L, 3], directions towards lamps far away, of any length.
        grid_size: metres, edge of the dynamics' cells.
        matter: of ``history``; None: found here.
    Returns:
        Rows of the newest clouds, packed. Gradients: of ``lights``.
    """
    matter = matter or Matter.of(history, grid_size)
    if matter is None:
        return history.means.new_zeros(0, len(lights))
    with torch.autocast(history.means.device.type, enabled=False):
        with torch.no_grad():
            moves, rests = matter.everything, matter.everything.that_are(history, FROZEN)
            places = torch.where(moves.wanted[:, :, None], moves.places, rests.places) - matter.here
            is_lit = moves.wanted | rests.wanted
        cells = (BEAM * grid_size, NEAREST * grid_size, EDGE * grid_size)
        each = (matter.samples.n / matter.samples.known.sum(1).clamp(min=1)).to(places.dtype)[:, None]
        found = [each * between(places, matter.samples, light, *cells) for light in lights.unbind(0)]
        return matter.together(torch.where(is_lit[:, :, None], torch.stack(found, 2).log1p(), 0))


def between(places: Tensor, matter: Samples, light: Tensor, beam: float, nearest: float, edge: float) -> Tensor:
    """[B, M], how many samples are between each of ``places`` [B, M, 3] and the light, in a Gaussian beam, from
    ``nearest`` on, where they begin to count over ``edge``; metres. What is near a beam enters it when the light turns:
    that is its gradient."""
    direction, rows = light / light.norm(), places
    places, there, known = grouped(rows, matter.places, matter.known)
    with torch.no_grad():
        ahead = (there * direction).sum(2)[:, None] - (places * direction).sum(2)[:, :, None]
        off = squares(places, there).sub_(ahead.square()).clamp_(min=0)
        begun = (ahead - nearest).div_(edge).sigmoid_()
        counted = off.mul_(-0.5 / beam**2).clamp_(min=FAINTEST).exp_().mul_(begun)
        counted.masked_fill_(~known[:, None], 0)
        if not direction.requires_grad:
            return ungrouped(counted.sum(2), rows)
        # By the direction, the squared way off changes by -2 ahead * way, and the way ahead by the way.
        by_way = counted * (ahead / beam**2 + (1 - begun) / edge)
        slope = by_way @ there - by_way.sum(2, keepdim=True) * places
        found = counted.sum(2)
    return ungrouped(found + slope @ (direction - direction.detach()), rows)
