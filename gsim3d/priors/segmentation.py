"""Segmentation: which particles are one body, found once, by the gaps between bodies before they touch."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from gsim3d.cameras import Frames
from gsim3d.priors.base import Prior, PriorConfig, StepContext
from gsim3d.priors.movable import Movable
from gsim3d.priors.padding import SAMPLES, squared_distances
from gsim3d.state import Particles, with_attribute

HOPS = 16  # in which connected samples find their first; the way that is known doubles


@dataclass(frozen=True)
class SegmentationConfig(PriorConfig):
    """Density-based clustering of encoded particles.

    Attributes:
        neighbors: within reach of every second particle, itself one of them.
        min_share: of the particles of the largest cluster; smaller ones belong to the nearest cluster.
        neck: share of a cluster's particles that may be within reach of another one without both being one body.
    """

    type = "segmentation"
    neighbors: int = 8
    min_share: float = 0.1
    neck: float = 0.1

    RANGES = {"neighbors": (1, SAMPLES), "min_share": (0, 1), "neck": (0, 1)}


class Segmentation(Prior, config=SegmentationConfig):
    """Gives encoded particles their ``body``."""

    def initialize(self, particles: Particles, ctx: StepContext, frames: Frames | None = None) -> Particles:
        """As :meth:`begin`: bodies are kept once they are known, also through edits."""
        return self.begin(particles, ctx)

    def begin(self, particles: Particles, ctx: StepContext) -> Particles:
        if particles.body is not None:
            return particles
        here = with_attribute(particles, "body").body
        if ctx.is_empty:
            return replace(particles, body=here)
        found = segment_bodies(ctx.later(particles).movable, particles, self.config)
        is_newest = ctx.of_all(torch.ones_like(found[:, :1], dtype=torch.bool))
        return replace(particles, body=torch.where(is_newest, ctx.of_all(found), here))


@torch.no_grad()
def segment_bodies(movable: Movable, particles: Particles, config: SegmentationConfig) -> Tensor:
    """[N, 3] metres, for each particle of the newest clouds the middle of its body; for unmovable ones where they are.

    Up to SAMPLES particles of a scene are clustered; the others belong to the nearest. No gradients.

    Source:
        DBSCAN, Ester et al. 1996, with a density that is read off the particles; clusters with more than a neck between
        them are joined.
    """
    with torch.autocast(particles.means.device.type, enabled=False):
        samples = movable.samples
        cluster = _clusters(samples.positions, samples.known, config)
        same = ((cluster[:, :, None] == cluster[:, None]) & samples.known[:, None]).to(samples.positions.dtype)
        middle = same @ samples.positions / same.sum(2, keepdim=True).clamp(min=1)
        nearest = _nearest(squared_distances(movable.positions, samples.positions), samples.known)
        found = middle.gather(1, nearest[:, :, None].expand(-1, -1, 3)).double()
        found = found + movable.center + particles.origin[movable.scenes][:, None]
        found, can_move = (
            movable.packed(x.to(particles.means.dtype)) for x in (found, torch.ones_like(found[:, :, :1]))
        )
        newest = particles.select_clouds(movable.newest)
        return torch.where(can_move > 0, found, with_attribute(newest, "body").body)


def _clusters(positions: Tensor, known: Tensor, config: SegmentationConfig) -> Tensor:
    """int64 [B, S], a number of the body of each of the samples."""
    far = torch.where(known[:, :, None] & known[:, None], squared_distances(positions, positions), torch.inf)
    reach = far.topk(config.neighbors, dim=2, largest=False).values[:, :, -1]
    half = (known.sum(1, keepdim=True) - 1).clamp(min=0) // 2
    near = (far <= reach.sort(1).values.gather(1, half)[:, :, None]) & known[:, None]
    dense = (near.sum(2) >= config.neighbors) & known
    cluster = _connected(near & dense[:, :, None] & dense[:, None])
    size = ((cluster[:, :, None] == cluster[:, None]) & dense[:, None]).sum(2)
    is_large = dense & (size >= config.min_share * torch.where(dense, size, 0).amax(1, keepdim=True))
    cluster = cluster.gather(1, _nearest(far, is_large))

    members = (cluster[:, :, None] == torch.arange(SAMPLES, device=cluster.device)) & known[:, :, None]
    members = members.to(positions.dtype)  # [B, samples, clusters]
    meets = (near.to(positions.dtype) @ members > 0).to(positions.dtype)
    wide = members.mT @ meets > config.neck * members.sum(1)[:, :, None]  # [B, clusters, clusters]
    by_sample = wide.gather(1, cluster[:, :, None].expand_as(wide))
    linked = by_sample.gather(2, cluster[:, None].expand_as(wide))
    return _connected(linked | linked.mT)


def _nearest(far: Tensor, wanted: Tensor) -> Tensor:
    """int64 [B, M], of ``far`` [B, M, S] the nearest sample among ``wanted`` [B, S]."""
    return torch.where(wanted[:, None], far, torch.inf).argmin(2)


def _connected(near: Tensor) -> Tensor:
    """int64 [B, S], for each sample the first one that steps between ``near`` [B, S, S] ones lead to."""
    each = torch.arange(SAMPLES, device=near.device)
    first = each.expand(near.shape[:2])
    for _ in range(HOPS):
        first = torch.minimum(torch.where(near, first[:, None], SAMPLES).amin(2), each)
        first = torch.minimum(first, first.gather(1, first))
    return first
