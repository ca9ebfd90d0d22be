"""Bodies of particles that images showed: a number for each particle, which simulated steps and edits keep."""

import dataclasses
import statistics
from collections.abc import Sequence

import torch
from torch import Tensor

from gsim3d.state import FROZEN, Particles

NEIGHBORS, REACH = 8, 1.3  # a body reaches as far as so many times the median distance to this nearest neighbour
SOLID = 0.3  # least opacity of a particle that connects others
LEAST_SHARE = 0.03  # of a body in the particles of the largest; smaller pieces belong to what is nearest
MOST, CHUNK = 8192, 1024  # particles of a step that are connected, others belong to the nearest; rows of distances


@torch.no_grad()
def with_bodies(state: Particles) -> Particles:
    """Returns the encoded steps of a scene with ``label``: the number of the body, -1 in the background.

    Gaps tell bodies apart, in the newest step that has the typical number of them; the particles of other steps, which
    are not the same, are matched to it. Body 0 has the most particles in the newest step.
    """
    clouds = [state.select_clouds([cloud]) for cloud in range(state.n_clouds)]
    rows = [(cloud.activity != FROZEN).nonzero()[:, 0].cpu() for cloud in clouds]
    points = [cloud.means.cpu()[mine] for cloud, mine in zip(clouds, rows, strict=True)]
    pieces = [_pieces(cloud, mine) for cloud, mine in zip(clouds, rows, strict=True)]
    counts = [int(piece.max()) + 1 if len(piece) else 0 for piece in pieces]
    typical = statistics.median_high(counts)
    begin = max(step for step, count in enumerate(counts) if count == typical)
    numbers = {begin: pieces[begin]}
    for step in (*range(begin - 1, -1, -1), *range(begin + 1, len(clouds))):
        known = step + 1 if step < begin else step - 1
        near = numbers[known][_nearest(points[step], points[known])] if len(points[known]) else pieces[step] * 0
        if counts[step] >= typical > 0:  # else bodies touch in this step
            votes = torch.zeros(counts[step], typical)
            votes.index_put_((pieces[step], near), torch.ones(()), accumulate=True)
            near = votes.argmax(1)[pieces[step]]
        numbers[step] = near
    order = torch.bincount(numbers[len(clouds) - 1], minlength=typical).argsort(descending=True).argsort()
    label = torch.full((state.n_rows,), -1)
    label[state.activity.cpu() != FROZEN] = order[torch.cat([numbers[step] for step in range(len(clouds))])]
    return dataclasses.replace(state, label=label.to(state.means.device))


def with_copies(state: Particles, counts: Sequence[int]) -> Particles:
    """Returns ``state`` with other bodies for the particles that each step has beyond its first ``counts``."""
    is_copy = torch.cat([torch.arange(now) >= before for now, before in zip(state.clouds.counts, counts, strict=True)])
    is_copy = is_copy.to(state.label.device) & (state.label >= 0)
    label = state.label.clone()
    label[is_copy] = label.max() + 1 + torch.unique(label[is_copy], return_inverse=True)[1]
    return dataclasses.replace(state, label=label)


def _pieces(cloud: Particles, rows: Tensor) -> Tensor:
    """Number of the piece of each of the ``rows`` of a step, int64 on the CPU."""
    points = cloud.means.cpu()[rows]
    solid = points[cloud.opacities.cpu()[rows] > SOLID]
    if len(solid) < NEIGHBORS:
        return torch.zeros_like(rows)
    solid = solid[:: -(-len(solid) // MOST)]
    found = [torch.cdist(some, solid).topk(NEIGHBORS, largest=False) for some in solid.split(CHUNK)]
    distances, near = (torch.cat(some) for some in zip(*found))
    is_near, label = distances <= REACH * distances[:, -1].median(), torch.arange(len(solid))
    while True:  # to the smallest number that is connected
        least = torch.where(is_near, label[near], len(solid)).amin(1)
        least = label.scatter_reduce(0, near[is_near], least[:, None].expand_as(near)[is_near], "amin")
        if torch.equal(least := least[least], label):
            break
        label = least
    count = torch.bincount(label)
    is_large = (count >= LEAST_SHARE * count.max())[label]
    found = torch.unique(label[is_large], return_inverse=True)[1]
    return found[_nearest(points, solid[is_large])]


def _nearest(points: Tensor, others: Tensor) -> Tensor:
    return torch.cat([torch.cdist(some, others).argmin(1) for some in points.split(CHUNK)])
