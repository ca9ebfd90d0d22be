"""How matter has moved: a velocity for every particle, read off clouds whose rows do not correspond."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional as F

from gsim3d.dynamics.clouds import newest_clouds
from gsim3d.dynamics.samples import Rows, Samples, squares, weights
from gsim3d.types import CloudTable, Particles, constant

NODES = 6  # of the lattice that spans the movable rows of a scene, along each axis
PASSES = 3  # in which the window follows the matter, and in which rows are matched
REACH = 0.2  # of the window's length: how far from where it is expected a row is looked for
LIKENESS = 0.12  # how far apart the latents of one place may be, relative to how far they spread
LEAST_SPREAD = 1e-12  # of latents, squared: where all look the same the place alone counts
STIFFNESS = 1e-3  # against turning, relative to the window's size: a point and a line do not turn


@torch.no_grad()
def motion(history: Particles, length: float, grid_size: float) -> Tensor:
    """[N, 2, 3] metres a step: how movable matter around each row of the newest clouds moved since the step before it;
    and how the row itself will if it goes on as since the oldest step, turning as it did. 0 of rows that do not move,
    and where there is one step only.

    Of two clouds the means within a Gaussian window are compared. The window lies around a place in the newer cloud,
    and around where that place came from in the older one (mean shift), so that a body that flies as a whole has its
    velocity everywhere, beside others too, and a squeezed one that of its parts. Over the whole history rows are
    matched as well, by place and latents, and the rigid motion that fits the matches in a window tells how it turns.
    All this is done at the nodes of a lattice and interpolated between them: rows have no order (up to ``SAMPLES`` of
    them), and scenes do not see each other.

    Args:
        history: clouds sorted by (scene, step).
        length: metres, standard deviation of the window; about the radius of a body.
        grid_size: metres, edge of the dynamics' cells.
    Returns:
        Rows of the newest clouds, packed. No gradients.
    """
    clouds, newest = history.clouds, newest_clouds(history.clouds)
    if not any(clouds.count(q) for q in newest):
        return history.means.new_zeros(0, 2, 3)
    first = [0, *(q + 1 for q in newest[:-1])]
    before = [max(f, q - 1) for f, q in zip(first, newest, strict=True)]
    with torch.autocast(history.means.device.type, enabled=False):
        now, last, oldest = (Samples(history, chosen, grid_size) for chosen in (newest, before, first))
        here = now.mean[:, None]
        for samples in (now, last, oldest):
            samples.seen_from(here)
        lattice = _Lattice(now)
        window = weights(squares(lattice.nodes, now.places) * (-0.5 / length**2), now)
        moved, expected = (_shift(now, then, lattice.nodes, window, length) for then in (last, oldest))
        velocity, spin, centre = _rigid_motion(now, oldest, lattice, window, expected, length)
        a_step, all_steps = _share(clouds, before, newest, now, last), _share(clouds, first, newest, now, oldest)
        rows = Rows(history, newest, grid_size)
        fields = moved * a_step, velocity * all_steps, spin * all_steps, centre
        places = rows.places - here
        moved, velocity, spin, centre = lattice.at(places, *fields)
        turning = torch.linalg.cross(spin, places - centre)
        onward = velocity + turning + 0.5 * torch.linalg.cross(spin, turning)
        result = torch.where(rows.wanted[:, :, None, None], torch.stack([moved, onward], 2), 0)
    return torch.cat([result[b, : clouds.count(q)] for b, q in enumerate(newest)])


class _Lattice:
    """nodes: [B, G, 3] that span what can move."""

    def __init__(self, now: Samples):
        here = now.known[:, :, None]
        low, high = (side * torch.where(here, side * now.places, torch.inf).amin(1, keepdim=True) for side in (1, -1))
        self._low, high = (torch.where(x.isfinite(), x, 0) for x in (low, high))
        self._size = high - self._low
        ticks = torch.linspace(0, 1, NODES, device=low.device, dtype=low.dtype)
        unit = torch.stack(torch.meshgrid(ticks, ticks, ticks, indexing="ij"), -1).flatten(0, 2)
        self.nodes = self._low + unit * self._size

    def at(self, places: Tensor, *values: Tensor) -> tuple[Tensor, ...]:
        """[B, N, 3] at places [B, N, 3], of each of ``values`` [B, G, 3]."""
        field = torch.cat(values, 2).mT.unflatten(2, (NODES, NODES, NODES))
        place = 2 * (places - self._low) / self._size.clamp(min=1e-6) - 1
        place = place.clamp(-1, 1).flip(2)[:, None, None]
        found = F.grid_sample(field, place, padding_mode="border", align_corners=True)[:, :, 0, 0].mT
        return found.split(3, 2)


def _shift(now: Samples, then: Samples, nodes: Tensor, window: Tensor, length: float) -> Tensor:
    """[B, G, 3], how far the matter in the window around each node has moved."""
    around = window @ now.places
    moved = (now.mean - then.mean)[:, None].expand_as(nodes)
    for _ in range(PASSES):
        moved = around - weights(squares(nodes - moved, then.places) * (-0.5 / length**2), then) @ then.places
    return moved


def _rigid_motion(
    now: Samples, then: Samples, lattice: _Lattice, window: Tensor, moved: Tensor, length: float
) -> tuple[Tensor, Tensor, Tensor]:
    """Velocity, spin (rad) and centre [B, G, 3] of the rigid motion that takes matter in each window from ``then`` to
    ``now``, if it moved about as far as ``moved``."""
    mean = now.mean_of(now.latents)[:, None]
    looks, looked = now.latents - mean, then.latents - mean
    spread = now.mean_of(looks.square().sum(2, keepdim=True)).clamp(min=LEAST_SPREAD)[:, None]
    unlike = squares(looks, looked) * (-0.5 / (LIKENESS**2 * spread))
    places, centre, spin = now.places, window @ now.places, torch.zeros_like(moved)
    products = (places[:, :, :, None] * places[:, :, None]).flatten(2)
    scatter = (window @ products).unflatten(2, (3, 3)) - centre[:, :, :, None] * centre[:, :, None]
    size = scatter.diagonal(dim1=2, dim2=3).sum(2)[:, :, None, None] + STIFFNESS * length**2
    inertia = size * torch.eye(3, device=size.device, dtype=size.dtype) - scatter
    for _ in range(PASSES):
        velocity, turns, middle = lattice.at(places, moved, spin, centre)
        expected = velocity + torch.linalg.cross(turns, places - middle)
        match = weights(unlike - squares(places - expected, then.places) * (0.5 / (REACH * length) ** 2), then)
        paths = places - match @ then.places
        moved = window @ paths
        impulse = window @ torch.linalg.cross(places, paths) - torch.linalg.cross(centre, moved)
        spin = _solved(inertia, impulse)
    return moved, spin, centre


def _solved(matrices: Tensor, values: Tensor) -> Tensor:
    """The solutions [..., 3] of symmetric systems [..., 3, 3], by Cramer's rule: a graph can capture it."""
    a, b, c = matrices.unbind(-2)
    rows = torch.linalg.cross(b, c), torch.linalg.cross(c, a), torch.linalg.cross(a, b)
    determinant = (a * rows[0]).sum(-1, keepdim=True)
    return torch.stack([(row * values).sum(-1) for row in rows], -1) / determinant


def _share(clouds: CloudTable, earlier: list[int], newest: list[int], now: Samples, then: Samples) -> Tensor:
    """[B, 1, 1], one over the steps between two clouds; 0 where they are one, or one of them has nothing that moves."""
    gaps = tuple(clouds.steps[q] - clouds.steps[e] for q, e in zip(newest, earlier, strict=True))
    gaps = constant(gaps, now.n.device)
    known = (gaps > 0) & (now.n > 0) & (then.n > 0)
    return (known / gaps.clamp(min=1))[:, None, None].to(now.places.dtype)
