"""The training loss: errors of images, weighted over time."""

from __future__ import annotations

import torch
from torch import Tensor

BALANCE = 0.5  # lambda of the paper: weight of the first simulated step; the encoded ones share the rest
DISCOUNT = 0.87  # gamma of the paper: weight of a simulated step relative to the one before it
LEAST_WEIGHT = 1e-12  # of an image's pixels together: one without any has an error of 0


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
