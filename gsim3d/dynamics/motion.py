"""How matter has moved: a velocity for every particle, read off clouds whose rows do not correspond."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional as F

from gsim3d.dynamics.clouds import newest_clouds
from gsim3d.types import DYNAMIC, Particles, constant

NODES = 6  # of the lattice that spans the movable rows of a scene, along each axis
PASSES = 2  # in which the window follows the matter


@torch.no_grad()
def motion(history: Particles, length: float) -> Tensor:
    """[N, 2, 3] metres a step: the mean motion of movable matter around each row of the newest clouds, since the step
    before it and since the oldest one; 0 of rows that do not move, and where there is one step only.

    Of two clouds the means within a Gaussian window are compared. The window lies around a place in the newer cloud,
    and around where that place came from in the older one (mean shift), so that a body that flies as a whole has its
    velocity everywhere, beside others too, and a squeezed one that of its parts. It is found at the nodes of a lattice
    and interpolated between them: the result does not depend on the order of rows, and scenes do not see each other.

    Args:
        history: clouds sorted by (scene, step).
        length: metres, standard deviation of the window; about the radius of a body.
    Returns:
        Rows of the newest clouds, packed. No gradients.
    """
    clouds, newest = history.clouds, newest_clouds(history.clouds)
    first = [0, *(q + 1 for q in newest[:-1])]
    with torch.autocast(history.means.device.type, enabled=False):
        now = _Cloud(history, newest)
        centre = now.mean[:, None]
        low, high = (now.extent(side, centre) for side in (-1, 1))
        steps = torch.linspace(0, 1, NODES, device=low.device, dtype=low.dtype)
        grid = torch.stack(torch.meshgrid(steps, steps, steps, indexing="ij"), 3).reshape(1, -1, 3)
        nodes = low + grid * (high - low)
        around = now.window(nodes, centre, length)
        velocities = []
        for earlier in ([max(f, q - 1) for f, q in zip(first, newest, strict=True)], first):
            gaps = [max(1, clouds.steps[q] - clouds.steps[e]) for q, e in zip(newest, earlier, strict=True)]
            then = _Cloud(history, earlier)
            moved = (now.mean - then.mean)[:, None].expand_as(nodes)
            for _ in range(PASSES):
                moved = around - then.window(nodes - moved, centre, length)
            is_known = (now.n > 0) & (then.n > 0)
            moved = torch.where(is_known[:, None, None], moved, 0)
            velocities.append(moved / constant(tuple(gaps), moved.device)[:, None, None])
        field = torch.cat(velocities, 2).mT.unflatten(2, (NODES, NODES, NODES))
        place = 2 * (now.places - centre - low) / (high - low).clamp(min=1e-6) - 1
        place = torch.where(now.moves[:, :, None], place, 0).flip(2)[:, None, None]
        rows = F.grid_sample(field, place, padding_mode="border", align_corners=True)[:, :, 0, 0].mT
        rows = torch.where(now.moves[:, :, None], rows, 0)
    return torch.cat([rows[b, : clouds.count(q)] for b, q in enumerate(newest)]).unflatten(1, (2, 3))


class _Cloud:
    """One cloud of every scene, padded.

    places: [B, M, 3].   moves: bool [B, M], rows that can move.   n: [B] of them.   mean: [B, 3] of their places.
    """

    def __init__(self, history: Particles, chosen: list[int]):
        table, device = history.clouds, history.means.device
        size = max(1, max(table.count(q) for q in chosen))
        starts = constant(tuple(min(table.starts[q], max(0, history.n_rows - 1)) for q in chosen), device)
        counts = constant(tuple(table.count(q) for q in chosen), device)
        place = torch.arange(size, device=device)
        rows = (starts[:, None] + place).clamp(max=history.n_rows - 1)
        places = history.means.detach()[rows]
        moves = (place < counts[:, None]) & (history.activity[rows] == DYNAMIC) & places.isfinite().all(2)
        self.places, self.moves = torch.where(moves[:, :, None], places, 0), moves
        self.n = moves.sum(1)
        self.mean = self.places.sum(1) / self.n.clamp(min=1)[:, None]

    def extent(self, side: int, centre: Tensor) -> Tensor:
        """[B, 1, 3], the corner of the box around all that moves, from ``centre``: -1 the lower, 1 the upper."""
        none = self.places.new_full((), -torch.inf)
        reach = torch.where(self.moves[:, :, None], side * (self.places - centre), none).amax(1, keepdim=True)
        return side * torch.where(reach.isfinite(), reach, 0)

    def window(self, nodes: Tensor, centre: Tensor, length: float) -> Tensor:
        """[B, G, 3], means of places in windows around ``nodes``, both from ``centre``."""
        places = self.places - centre
        products = torch.baddbmm(places.square().sum(2)[:, None], nodes, places.mT, alpha=-2)
        closeness = products * (-0.5 / length**2)  # but for what is the same for all rows
        return torch.where(self.moves[:, None], closeness, -torch.inf).softmax(2).nan_to_num(0) @ places
