"""Errors of images and shapes, and their weights over time."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import torch
from torch import Tensor
from torch.nn import functional as F

from gsim3d.dynamics import last_steps
from gsim3d.state import DYNAMIC, Particles, constant

BALANCE = 0.5  # lambda of the paper: weight of the first simulated step; the encoded ones share the rest
DISCOUNT = 0.87  # gamma of the paper: weight of a simulated step relative to the one before it
PARTNERS = (1, 2, 3, 5, 8, 13, 21, 34, 55, 89, 144, 233, 377, 610, 987, 1597)  # rows further on, of shape_errors
BODY_SCALES = (1, 4, 16)  # pixels, edges of the squares whose means body_errors compares
LEAST_WEIGHT = 1e-12  # of an image's pixels together: one without any has an error of 0
LEAST_SQUARE = 1e-12  # added to squared distances: a root has no gradient at 0


def time_weights(n_past: int, n_future: int, *, balance: float = BALANCE, discount: float = DISCOUNT) -> Tensor:
    """Weight of each step: ``(1 - balance) / n_past`` for encoded ones, ``balance * discount^j`` for simulated ones.

    Without simulated steps ``balance`` is 0: the loss is the plain mean over the encoded steps. The simulated part is
    not normalised, so a longer rollout weighs more.

    Returns:
        float32 [n_past + n_future].
    """
    if n_past < 1 or n_future < 0:
        raise ValueError(f"time_weights: n_past >= 1 and n_future >= 0 are needed; got {n_past}, {n_future}")
    if n_future == 0:
        return torch.full((n_past,), 1 / n_past)
    past = torch.full((n_past,), (1 - balance) / n_past)
    return torch.cat([past, balance * discount ** torch.arange(n_future, dtype=torch.float32)])


def image_errors(pred: Tensor, target: Tensor, weight: Tensor | None = None) -> Tensor:
    """Mean squared error of each image [I] from [I, H, W, C]; ``weight`` [I, H, W] makes it a weighted mean."""
    errors = (pred - target).square().mean(-1)
    if weight is None:
        return errors.mean((1, 2))
    return (errors * weight).sum((1, 2)) / weight.sum((1, 2)).clamp(min=LEAST_WEIGHT)


def mean_by_step(values: Tensor, step: Tensor, n_steps: int) -> Tensor:
    """Means [n_steps] of the values [I] of each step [I] (int64); a product with a small matrix, so order is fixed."""
    member = (step[None] == torch.arange(n_steps, device=step.device)[:, None]).to(values.dtype)
    return (member * values).sum(1) / member.sum(1).clamp(min=1)


def image_loss(errors: Tensor, step: Tensor, weights: Tensor) -> Tensor:
    """``sum_t weights[t] * mean over images of step t`` of the errors of each image.

    Args:
        errors: [I].
        step: int64 [I], the step that each image shows.
        weights: [S] of :func:`time_weights`.
    """
    by_step = mean_by_step(errors, step, weights.shape[0])
    return (weights.to(by_step) * by_step).sum()


def bodies_alone(particles: Particles) -> Particles:
    """``particles`` of which only those are drawn that may move: also where others hide them."""
    moves = particles.activity == DYNAMIC
    return dataclasses.replace(particles, opacities=torch.where(moves, particles.opacities, 0))


def body_errors(pred: Tensor, target: Tensor) -> Tensor:
    """Mean squared error of each image [I] from [I, H, W, C], of pixels and of squares of them: a body in a wrong place
    is seen from further away, the larger the squares."""
    wrong = (pred - target).permute(0, 3, 1, 2)
    sizes = [size for size in BODY_SCALES if size <= min(wrong.shape[2:])]
    return torch.stack([F.avg_pool2d(wrong, size).square().mean((1, 2, 3)) for size in sizes]).mean(0)


def shape_errors(begin: Particles, steps: Sequence[Particles], length: float) -> Tensor:
    """How much bodies change their shape in each simulated step [S]: 0 where every distance stays.

    Of pairs of movable particles of a scene that are about ``length`` metres apart in ``begin``, or less, the mean of
    sqrt(1 + (change of the distance / length)^2) - 1, as the isometry of Dynamic 3D Gaussians (Luiten et al., 2024).
    It also holds what no camera sees. Partners are rows at fixed distances: neighbours in an image, neighbours on the
    next lines, and what other views saw.

    Args:
        begin: of which ``steps`` are the future; its newest clouds have their rows.
    """
    begin = last_steps(begin, 1)
    cloud, places = begin.row_cloud(), begin.means.detach()
    partner = torch.arange(begin.n_rows, device=places.device) + constant(PARTNERS, places.device)[:, None]
    moves = (begin.activity == DYNAMIC) & places.isfinite().all(1)
    pairs = moves & _partners(moves) & (cloud == _partners(cloud)) & (partner < begin.n_rows)
    far = _distances(places, pairs)
    weight = torch.where(pairs, torch.exp(-0.5 * (far / length).square()), 0)
    changes = torch.stack([_distances(step.means, pairs) - far for step in steps])
    errors = torch.sqrt(1 + (changes / length).square()) - 1
    return (errors * weight).sum((1, 2)) / weight.sum().clamp(min=1)


def _partners(x: Tensor) -> Tensor:
    """[P, N, ...], the values [N, ...] of each row's partners; behind the last row begins the first. Not indexed: the
    gradient of what is rolled is rolled back."""
    return torch.stack([x.roll(-offset, 0) for offset in PARTNERS])


def _distances(places: Tensor, pairs: Tensor) -> Tensor:
    """[P, N] from each place to its partners; of what is no pair any number, without a gradient."""
    between = torch.where(pairs[:, :, None], places - _partners(places), 1)
    return (between.square().sum(2) + LEAST_SQUARE).sqrt()
