"""Segmentation of particles into bodies, by the gaps between bodies when they are encoded."""

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from gsim3d.cameras import Frames
from gsim3d.priors.base import Prior, PriorConfig, StepContext
from gsim3d.priors.movable import Movable
from gsim3d.priors.padding import SAMPLES, squared_distances
from gsim3d.state import Particles, with_attribute

HOPS = 16  # iterations of connected components; each doubles the length of known paths


@dataclass(frozen=True)
class SegmentationConfig(PriorConfig):
    """Density-based clustering of encoded particles.

    Attributes:
        neighbors: minimum number of neighbours of a core particle, including itself. The radius is the median distance
            to the neighbour of that rank.
        min_share: smallest size of a cluster over that of the largest; smaller ones join the nearest cluster.
        neck: largest fraction of a cluster's particles that may be within the radius of another cluster; clusters in
            closer contact are merged.
    """

    type = "segmentation"
    neighbors: int = 8
    min_share: float = 0.1
    neck: float = 0.1

    RANGES = {"neighbors": (1, SAMPLES), "min_share": (0, 1), "neck": (0, 1)}


class Segmentation(Prior, config=SegmentationConfig):
    """Assigns encoded particles to bodies: ``body`` is the center of the body of each particle."""

    def initialize(self, particles: Particles, ctx: StepContext, frames: Frames | None = None) -> Particles:
        """Segments particles without bodies. Known bodies are kept, also by edits."""
        return self.begin(particles, ctx)

    def begin(self, particles: Particles, ctx: StepContext) -> Particles:
        if particles.body is not None:
            return particles
        here = with_attribute(particles, "body").body
        if ctx.is_empty:
            return replace(particles, body=here)
        found = segment_bodies(ctx.with_particles(particles).movable, particles, self.config)
        is_newest = ctx.scatter_newest(torch.ones_like(found[:, :1], dtype=torch.bool))
        return replace(particles, body=torch.where(is_newest, ctx.scatter_newest(found), here))


@torch.no_grad()
def segment_bodies(movable: Movable, particles: Particles, config: SegmentationConfig) -> Tensor:
    """Center of the body of each particle of the newest clouds [N, 3] in metres, without gradients.

    Clusters up to SAMPLES particles of a scene; the others join the nearest. A particle that cannot move is a body of
    its own.

    Source:
        DBSCAN, Ester et al. 1996, with a radius from the density of the particles, and a merge of clusters in contact.
    """
    with torch.autocast(particles.means.device.type, enabled=False):
        samples = movable.samples
        cluster = _clusters(samples.positions, samples.known, config)
        same = ((cluster[:, :, None] == cluster[:, None]) & samples.known[:, None]).to(samples.positions.dtype)
        middle = same @ samples.positions / same.sum(2, keepdim=True).clamp(min=1)
        nearest = _nearest(squared_distances(movable.positions, samples.positions), samples.known)
        found = middle.gather(1, nearest[:, :, None].expand(-1, -1, 3)).double()
        found = found + movable.center + particles.origin[movable.scenes][:, None]
        both, dtype = (found, torch.ones_like(found[:, :, :1])), particles.means.dtype
        found, can_move = (movable.scatter(x.to(dtype)) for x in both)
        newest = particles.select_clouds(movable.newest)
        return torch.where(can_move > 0, found, with_attribute(newest, "body").body)


def _clusters(positions: Tensor, known: Tensor, config: SegmentationConfig) -> Tensor:
    """Index of the body of each sample, int64 [B, S]."""
    distances = torch.where(known[:, :, None] & known[:, None], squared_distances(positions, positions), torch.inf)
    core_distances = distances.topk(config.neighbors, dim=2, largest=False).values[:, :, -1]
    median = (known.sum(1, keepdim=True) - 1).clamp(min=0) // 2
    near = (distances <= core_distances.sort(1).values.gather(1, median)[:, :, None]) & known[:, None]
    dense = (near.sum(2) >= config.neighbors) & known
    cluster = _connected(near & dense[:, :, None] & dense[:, None])
    size = ((cluster[:, :, None] == cluster[:, None]) & dense[:, None]).sum(2)
    is_large = dense & (size >= config.min_share * torch.where(dense, size, 0).amax(1, keepdim=True))
    cluster = cluster.gather(1, _nearest(distances, is_large))

    members = (cluster[:, :, None] == torch.arange(SAMPLES, device=cluster.device)) & known[:, :, None]
    members = members.to(positions.dtype)  # [B, samples, clusters]
    touches = (near.to(positions.dtype) @ members > 0).to(positions.dtype)
    merged = members.mT @ touches > config.neck * members.sum(1)[:, :, None]  # [B, clusters, clusters]
    by_sample = merged.gather(1, cluster[:, :, None].expand_as(merged))
    linked = by_sample.gather(2, cluster[:, None].expand_as(merged))
    return _connected(linked | linked.mT)


def _nearest(distances: Tensor, mask: Tensor) -> Tensor:
    """Index of the nearest sample in ``mask`` [B, S], from squared distances [B, M, S]: int64 [B, M]."""
    return torch.where(mask[:, None], distances, torch.inf).argmin(2)


def _connected(near: Tensor) -> Tensor:
    """Connected components of the adjacency ``near`` [B, S, S]: smallest index in each component, int64 [B, S]."""
    each = torch.arange(SAMPLES, device=near.device)
    first = each.expand(near.shape[:2])
    for _ in range(HOPS):
        first = torch.minimum(torch.where(near, first[:, None], SAMPLES).amin(2), each)
        first = torch.minimum(first, first.gather(1, first))
    return first
