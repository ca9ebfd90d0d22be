"""Which rows are one body: told apart once, by the gaps between bodies, before they touch."""

from __future__ import annotations

import torch
from torch import Tensor

from gsim3d.dynamics.matter import Matter
from gsim3d.dynamics.samples import SAMPLES, squares
from gsim3d.state import Particles, constant, take_runs, with_attribute

NEIGHBOURS = 8  # within reach of every second row, itself one of them
LEAST = 0.1  # of the rows of the largest part: smaller ones belong to what is nearest
NECK = 0.1  # of the rows of a part: so many within reach of another part are more than two bodies have that touch
HOPS = 16  # in which what is connected finds out; the way that is known doubles


@torch.no_grad()
def bodies(history: Particles, grid_size: float) -> Tensor:
    """[N, 3] metres, the middle of the body that each movable row of the newest clouds belongs to; of other rows where
    they are.

    Rows are connected where they are within reach of each other and both have as many neighbours there as every second
    row (DBSCAN, Ester et al., 1996, with a density that is read off the rows); all others, and small parts, belong to
    the nearest part. Parts with more than a neck between them are one body. Up to ``SAMPLES`` rows of a scene are
    looked at.

    Args:
        history: clouds sorted by (scene, step).
        grid_size: metres, edge of the dynamics' cells.
    Returns:
        Rows of the newest clouds, packed. No gradients.
    """
    matter = Matter.of(history, grid_size)
    if matter is None:
        return history.means.new_zeros(0, 3)
    with torch.autocast(history.means.device.type, enabled=False):
        samples, clouds = matter.samples, history.clouds
        part = _parts(samples.places, samples.known)
        same = ((part[:, :, None] == part[:, None]) & samples.known[:, None]).to(samples.places.dtype)
        middle = same @ samples.places / same.sum(2, keepdim=True).clamp(min=1)
        nearest = _nearest(squares(matter.places, samples.places), samples.known)
        scenes = constant(tuple(clouds.scenes[q] for q in matter.newest), middle.device)
        found = middle.gather(1, nearest[:, :, None].expand(-1, -1, 3)).double()
        found = found + matter.here + history.origin[scenes][:, None]
        found, may_move = (matter.packed(x.to(history.means.dtype)) for x in (found, torch.ones_like(found[:, :, :1])))
        here = take_runs(with_attribute(history, "body").body, clouds.row_runs(matter.newest))
        return torch.where(may_move > 0, found, here)


def _parts(places: Tensor, known: Tensor) -> Tensor:
    """int64 [B, S], a number of the body that each of the samples belongs to."""
    far = torch.where(known[:, :, None] & known[:, None], squares(places, places), torch.inf)
    reach = far.topk(NEIGHBOURS, dim=2, largest=False).values[:, :, -1]
    half = (known.sum(1, keepdim=True) - 1).clamp(min=0) // 2
    near = (far <= reach.sort(1).values.gather(1, half)[:, :, None]) & known[:, None]
    dense = (near.sum(2) >= NEIGHBOURS) & known
    part = _connected(near & dense[:, :, None] & dense[:, None])
    size = ((part[:, :, None] == part[:, None]) & dense[:, None]).sum(2)
    is_large = dense & (size >= LEAST * torch.where(dense, size, 0).amax(1, keepdim=True))
    part = part.gather(1, _nearest(far, is_large))

    of_part = (part[:, :, None] == torch.arange(SAMPLES, device=part.device)) & known[:, :, None]
    of_part = of_part.to(places.dtype)  # [B, rows, parts]
    meets = (near.to(places.dtype) @ of_part > 0).to(places.dtype)
    wide = of_part.mT @ meets > NECK * of_part.sum(1)[:, :, None]  # [B, parts, parts]
    by_row = wide.gather(1, part[:, :, None].expand_as(wide))
    linked = by_row.gather(2, part[:, None].expand_as(wide))
    return _connected(linked | linked.mT)


def _nearest(far: Tensor, wanted: Tensor) -> Tensor:
    """int64 [B, M], of ``far`` [B, M, S] the sample that is nearest, one of those that are ``wanted`` [B, S]."""
    return torch.where(wanted[:, None], far, torch.inf).argmin(2)


def _connected(near: Tensor) -> Tensor:
    """int64 [B, S], the first of the samples that each is connected with by steps between those that are ``near``."""
    each = torch.arange(SAMPLES, device=near.device)
    first = each.expand(near.shape[:2])
    for _ in range(HOPS):
        first = torch.minimum(torch.where(near, first[:, None], SAMPLES).amin(2), each)
        first = torch.minimum(first, first.gather(1, first))
    return first
