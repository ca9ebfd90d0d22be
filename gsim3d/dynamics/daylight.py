"""Light on the surfaces that particles make: how much of a lamp far away reaches each, by its direction and shadows."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from gsim3d.dynamics.matter import Matter
from gsim3d.dynamics.planes import planes
from gsim3d.dynamics.rigid import SMALLEST
from gsim3d.dynamics.samples import FAINTEST, Few, Samples, grouped, squares, ungrouped
from gsim3d.dynamics.shade import EDGE, between
from gsim3d.state import DYNAMIC, FROZEN, Particles

OPAQUE = 0.3  # opacity; below it are rows at silhouettes, whose depth was not known
# Standard deviations of windows, in cells.
FLAT = 2.5  # in which a surface is a plane
BODY = 12.5  # whose mean is inside a body: that is how a surface knows its outside
BEAM = 1.5  # in which a ray meets matter
START = 3.0  # cells above a surface that moves, where its rays begin: its own rows would be in their way
TOWARDS = 1.5  # cells: a surface with as much matter on both sides shows the light its front
EDGE_LAYERS = 0.7  # surfaces, as a ray meets in its window at the edge of a body
SOFT = 0.15  # cosine by which a face that is turned away is lit still: normals are not exact


def daylight(
    history: Particles,
    lights: Tensor,
    grid_size: float,
    matter: Matter | None = None,
    facing: Tensor | None = None,
) -> tuple[Tensor, Tensor]:
    """How much of each light reaches each row of the newest clouds, and how much its surface faces it, both [N, L] from
    0 to 1: the first is the second times the share of the light that no movable matter takes.

    A row is part of the plane through its opaque neighbours, of those that move like it or of those that rest; the
    outside is where there is less of them. A ray towards the light loses half of it where it meets the rows of
    ``EDGE_LAYERS`` surfaces that move, and almost all where it meets those of two. Up to ``samples.SAMPLES`` rows of a
    scene that move and as many that rest are looked at, evenly spread. Scenes do not see each other. 0 of rows that are
    asleep.

    Args:
        history: clouds sorted by (scene, step).
        lights: [L, 3], directions towards lamps far away, of any length.
        grid_size: metres, edge of the dynamics' cells.
        matter: of ``history``; None: found here.
        facing: [N, L], of rows that rest what was found before; None: it is found here.
    Returns:
        Rows of the newest clouds, packed. Gradients: of ``lights``.
    """
    matter = matter or Matter.of(history, grid_size)
    if matter is None:
        nothing = history.means.new_zeros(0, len(lights))
        return nothing, nothing
    with torch.autocast(history.means.device.type, enabled=False):
        with torch.no_grad():
            moves, rests = matter.everything, matter.everything.that_are(history, FROZEN)
            moving, is_lit = moves.wanted[:, :, None], (moves.wanted | rests.wanted)[:, :, None]
            places = torch.where(moving, moves.places, rests.places) - matter.here
            solid = Samples(moves.that_are(history, DYNAMIC, OPAQUE))
            solid.seen_from(matter.here)
            surface = _Surface(places, matter.few, solid, grid_size)
            one_layer = _one_layer(solid, BEAM * grid_size)
            behind = None
            if facing is None:
                ground = Samples(moves.that_are(history, FROZEN, OPAQUE))
                ground.seen_from(matter.here)
                behind = _Surface(places, Few(rests.wanted), ground, grid_size)
        towards, lit = [], []
        for n, light in enumerate(lights.unbind(0)):
            direction = light / light.norm()
            faces = surface.faces(direction, grid_size)
            other = matter.apart(facing)[:, :, n] if behind is None else behind.faces(direction, grid_size)
            faces = torch.where(moving[:, :, 0], faces, other)
            with torch.no_grad():
                above = places + START * grid_size * torch.where(moving, surface.normals(direction, grid_size), 0)
            layers = between(above, solid, light, BEAM * grid_size, 0.0, EDGE * grid_size) / one_layer
            towards.append(faces)
            lit.append(faces * (-math.log(2) * (layers / EDGE_LAYERS).square()).exp())
        found = (torch.where(is_lit, torch.stack(values, 2), 0) for values in (lit, towards))
        return tuple(matter.together(values) for values in found)


class _Surface:
    """The plane through the samples near each of ``few`` of the ``places`` [B, M, 3]."""

    def __init__(self, places: Tensor, few: Few, samples: Samples, grid_size: float):
        flat, body, rows = FLAT * grid_size, BODY * grid_size, few.take(places)
        places, around, known = grouped(rows, samples.places, samples.known[:, None])
        far = squares(places, around)
        near = torch.where(known, (far * (-0.5 / flat**2)).clamp_(min=FAINTEST).exp_(), 0)
        window = near.div_(near.sum(2, keepdim=True).clamp(min=SMALLEST))
        _, normal = planes(window, around, flat)
        wide = torch.where(known, far.mul_(-0.5 / body**2).clamp_(min=FAINTEST).exp_(), 0)
        wide = wide.div_(wide.sum(2, keepdim=True).clamp(min=SMALLEST))
        out = ((places - wide @ around) * normal).sum(2, keepdim=True)
        normal, out = (ungrouped(x, rows) for x in (normal, out))
        self._normal, self._out = few.put(normal), few.put(out)[:, :, 0]

    def normals(self, direction: Tensor, grid_size: float) -> Tensor:
        """[B, M, 3], towards the outside, or the light ``direction`` where that is not clear."""
        out = self._out + TOWARDS * grid_size * (self._normal @ direction)
        return torch.where((out < 0)[:, :, None], -self._normal, self._normal)

    def faces(self, direction: Tensor, grid_size: float) -> Tensor:
        """[B, M], the cosine of the angle between surface and light, 0 where it is turned away."""
        with torch.no_grad():
            normals = self.normals(direction, grid_size)
        return ((normals @ direction + SOFT) / (1 + SOFT)).clamp(min=0)


def _one_layer(samples: Samples, beam: float) -> Tensor:
    """[B, 1], what :func:`between` counts where a ray meets one surface: samples near a sample."""
    near = (squares(samples.places, samples.places) * (-0.5 / beam**2)).clamp(min=FAINTEST).exp()
    both = samples.known[:, :, None] & samples.known[:, None]
    return (torch.where(both, near, 0).sum((1, 2)) / samples.known.sum(1).clamp(min=1)).clamp(min=1)[:, None]
