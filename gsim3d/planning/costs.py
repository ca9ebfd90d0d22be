"""Costs of predicted particles and images for planners: each returns one value a sequence, and is differentiable.

Positions are metres. Sequences share the number of particles: [K, T, N, 3].
"""

import torch
from torch import Tensor


def center_distance(positions: Tensor, goal: Tensor) -> Tensor:
    """Distance of the centroid of ``positions`` [K, T, N, 3] to ``goal`` [3], mean over time plus the last, m [K]."""
    distance = (positions.mean(-2) - goal).norm(dim=-1)
    return distance.mean(-1) + distance[:, -1]


def chamfer(positions: Tensor, target: Tensor) -> Tensor:
    """Symmetric Chamfer distance of the last of ``positions`` [K, T, N, 3] to ``target`` [M, 3], metres [K]: the mean
    distance of particles to the nearest target, plus that of targets to the nearest particle."""
    distances = torch.cdist(positions[:, -1], target.expand(len(positions), -1, -1))
    return distances.amin(2).mean(1) + distances.amin(1).mean(1)


def image_distance(images: Tensor, target: Tensor) -> Tensor:
    """Mean squared difference of images [K, ...] to ``target`` [...] of the same cameras, [K]."""
    return (images - target).square().flatten(1).mean(1)
