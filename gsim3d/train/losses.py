"""The training loss: errors of images, weighted over time."""

from __future__ import annotations

import torch
from torch import Tensor

from gsim3d.cameras import Frames
from gsim3d.evaluate.perceptual.lpips import LPIPS
from gsim3d.train.config import LossConfig

LEAST_WEIGHT = 1e-12  # of an image's pixels together: one without any has an error of 0


def training_loss(
    settings: LossConfig, perceptual: LPIPS | None, images: Tensor, targets: Frames, weights: Tensor
) -> tuple[Tensor, Tensor]:
    """The loss, and each step's unweighted mean squared error.

    Args:
        settings: weights of its terms.
        perceptual: the network, where ``settings`` have a weight for it.
        images: [I, H, W, 3], what the target cameras should have seen.
        targets: what they saw; image i shows step ``image_cloud[i]`` modulo S.
        weights: [S] of :func:`time_weights`.
    """
    n_steps, truth, shown = weights.shape[0], targets.images.permute(0, 2, 3, 1), targets.dynamic
    weight = 1 + settings.body_weight * shown if settings.body_weight and shown is not None else None
    if targets.valid is not None:
        weight = targets.valid.float() if weight is None else weight * targets.valid
    step = targets.cameras.image_cloud % n_steps
    wrong = image_errors(images, truth, weight)
    if perceptual is not None:
        seen = images if targets.valid is None else torch.where(targets.valid[..., None], images, truth)
        wrong = wrong + settings.perceptual * perceptual(seen.permute(0, 3, 1, 2), targets.images)
    with torch.no_grad():
        errors = mean_by_step(image_errors(images, truth, targets.valid), step, n_steps)
    return image_loss(wrong, step, weights), errors


def time_weights(n_past: int, n_future: int, *, balance: float = 0.5, discount: float = 0.87) -> Tensor:
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
