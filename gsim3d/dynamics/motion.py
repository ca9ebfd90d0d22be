"""How matter has moved: a velocity for every particle, read off clouds whose rows do not correspond."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional as F

from gsim3d.dynamics.clouds import newest_clouds
from gsim3d.ops.sentinel import CELLS
from gsim3d.types import DYNAMIC, Particles, constant

NODES = 6  # of the lattice that spans the movable rows of a scene, along each axis
CHUNK = 256  # rows that are added at once
PASSES = 3  # in which the window follows the matter


@torch.no_grad()
def motion(history: Particles, length: float, grid_size: float) -> Tensor:
    """[N, 2, 3] metres a step: the mean motion of movable matter around each row of the newest clouds, since the step
    before it and since the oldest one; 0 of rows that do not move, and where there is one step only.

    Of two clouds the means within a Gaussian window are compared. The window lies around a place in the newer cloud,
    and around where that place came from in the older one (mean shift), so that a body that flies as a whole has its
    velocity everywhere, beside others too, and a squeezed one that of its parts. It is found at the nodes of a lattice
    and interpolated between them: the result does not depend on the order of rows, and scenes do not see each other.

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
    now = _Cloud(history, newest, grid_size)
    centre = now.mean
    low, high = (now.extent(side, centre)[:, :, None] for side in (-1, 1))
    ticks = torch.linspace(0, 1, NODES, device=low.device, dtype=low.dtype)
    nodes = low + torch.stack(torch.meshgrid(ticks, ticks, ticks, indexing="ij")).flatten(1) * (high - low)
    around = now.window(nodes, centre, length)
    velocities = []
    for earlier in ([max(f, q - 1) for f, q in zip(first, newest, strict=True)], first):
        gaps = [max(1, clouds.steps[q] - clouds.steps[e]) for q, e in zip(newest, earlier, strict=True)]
        then = _Cloud(history, earlier, grid_size)
        moved = (now.mean - then.mean)[:, :, None].expand_as(nodes)
        for _ in range(PASSES):
            moved = around - then.window(nodes - moved, centre, length)
        is_known = (now.n > 0) & (then.n > 0)
        moved = torch.where(is_known[:, None, None], moved, 0)
        velocities.append(moved / constant(tuple(gaps), moved.device)[:, None, None])
    field = torch.cat(velocities, 1).unflatten(2, (NODES, NODES, NODES))
    place = 2 * (now.places - centre[:, :, None] - low) / (high - low).clamp(min=1e-6) - 1
    place = torch.where(now.moves[:, None], place, 0).mT.flip(2)[:, None, None]
    rows = F.grid_sample(field, place, padding_mode="border", align_corners=True)[:, :, 0, 0].mT
    rows = torch.where(now.moves[:, :, None], rows, 0)
    return torch.cat([rows[b, : clouds.count(q)] for b, q in enumerate(newest)]).unflatten(1, (2, 3))


class _Cloud:
    """One cloud of every scene, padded.

    places: [B, 3, M] from the origins of the scenes.   moves: bool [B, M], rows that can move.
    n: [B] of them.   mean: [B, 3] of their places.
    """

    def __init__(self, history: Particles, chosen: list[int], grid_size: float):
        table, device = history.clouds, history.means.device
        size = -(-max(1, max(table.count(q) for q in chosen)) // CHUNK) * CHUNK
        starts = constant(tuple(table.starts[q] for q in chosen), device)
        counts = constant(tuple(table.count(q) for q in chosen), device)
        scenes = constant(tuple(table.scenes[q] for q in chosen), device)
        place = torch.arange(size, device=device)
        rows = (starts[:, None] + place).clamp(max=history.n_rows - 1)
        places = history.means.detach()[rows].double() - history.origin[scenes][:, None]
        is_seen = ((places >= 0) & (places / grid_size < CELLS)).all(2)  # inside the workspace, not NaN
        self.moves = (place < counts[:, None]) & (history.activity[rows] == DYNAMIC) & is_seen
        self.places = torch.where(self.moves[:, :, None], places, 0).to(history.means.dtype).mT
        self.n = self.moves.sum(1)
        self.mean = _sum(self.places) / self.n.clamp(min=1)[:, None]

    def extent(self, side: int, centre: Tensor) -> Tensor:
        """[B, 3], the corner of the box around all that moves, from ``centre``: -1 the lower, 1 the upper."""
        none = self.places.new_full((), -torch.inf)
        reach = torch.where(self.moves[:, None], side * (self.places - centre[:, :, None]), none).amax(2)
        return side * torch.where(reach.isfinite(), reach, 0)

    def window(self, nodes: Tensor, centre: Tensor, length: float) -> Tensor:
        """[B, 3, G], means of places in windows around ``nodes`` [B, 3, G], both from ``centre``."""
        places = (self.places - centre[:, :, None])[:, :, None]
        squares = [(nodes[:, axis, :, None] - places[:, axis]).square() for axis in range(3)]
        closeness = torch.where(self.moves[:, None], sum(squares) * (-0.5 / length**2), -torch.inf)
        weights = torch.exp(closeness - closeness.amax(2, keepdim=True)).nan_to_num(0)
        sums = torch.stack([_sum(weights * places[:, axis]) for axis in range(3)], 1)
        return sums / _sum(weights).clamp(min=1)[:, None]


def _sum(x: Tensor) -> Tensor:
    """Over the last axis, in an order that zeros behind it do not change."""
    first, *others = x.unflatten(-1, (-1, CHUNK)).sum(-1).unbind(-1)
    for part in others:
        first = first + part
    return first
