"""Costs of predicted particles and images, for planners: each returns one value a sequence, and is differentiable.

Positions are metres. Sequences share the number of particles: [K, T, N, 3].
"""

import torch
from torch import Tensor


def mean_distance(positions: Tensor, target: Tensor) -> Tensor:
    """Mean distance of the last positions to targets with known correspondence, metres [K].

    Args:
        positions: [K, T, N, 3].
        target: [N, 3].
    """
    return (positions[:, -1] - target).norm(dim=-1).mean(-1)


def center_distance(positions: Tensor, goal: Tensor) -> Tensor:
    """Distance of the centroid to ``goal``, the mean over time plus the last, metres [K].

    Args:
        positions: [K, T, N, 3].
        goal: [3].
    """
    distance = (positions.mean(-2) - goal).norm(dim=-1)
    return distance.mean(-1) + distance[:, -1]


def chamfer(positions: Tensor, target: Tensor) -> Tensor:
    """Symmetric Chamfer distance of the last positions to ``target``, metres [K].

    The mean distance of particles to the nearest target, plus that of targets to the nearest particle.

    Args:
        positions: [K, T, N, 3].
        target: [M, 3].
    """
    distances = torch.cdist(positions[:, -1], target.expand(len(positions), -1, -1))
    return distances.amin(2).mean(1) + distances.amin(1).mean(1)


def image_distance(images: Tensor, target: Tensor) -> Tensor:
    """Mean squared difference of images [K, ...] to ``target`` [...] of the same cameras, [K]."""
    return (images - target).square().flatten(1).mean(1)


def smoothness(actions: Tensor) -> Tensor:
    """Mean squared difference of consecutive actions, in squared units of an action [K]; [K, H, A] given."""
    return actions.diff(dim=1).square().sum(-1).mean(-1) if actions.shape[1] > 1 else actions.new_zeros(len(actions))
