"""The training loss: all errors that a configuration asks for, weighted over time."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from gsim3d.cameras import Frames
from gsim3d.evaluate.perceptual.lpips import LPIPS
from gsim3d.state import Particles
from gsim3d.train.config import LossConfig
from gsim3d.train.losses import body_errors, image_errors, image_loss, mean_by_step, shape_errors


def training_loss(
    settings: LossConfig,
    perceptual: LPIPS | None,
    images: Tensor,
    bodies: Tensor | None,
    begin: Particles,
    steps: Sequence[Particles],
    targets: Frames,
    weights: Tensor,
) -> tuple[Tensor, Tensor]:
    """The loss, and each step's unweighted mean squared error.

    Args:
        perceptual: where ``settings`` ask for it.
        images: [I, H, W, 3] that ``targets`` should have been.
        bodies: likewise, of :func:`bodies_alone`; None where ``settings`` do not ask for them.
        begin, steps: where the simulation begins, and its steps.
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
    if bodies is not None and shown is not None:
        counts = shown if targets.valid is None else shown & targets.valid
        bodies = bodies if targets.valid is None else bodies * targets.valid[..., None]
        wrong = wrong + settings.bodies * body_errors(bodies, truth * counts[..., None])
    loss = image_loss(wrong, step, weights)
    if settings.shape and steps:
        bent = shape_errors(begin, steps, settings.shape_length)
        loss = loss + settings.shape * (weights[n_steps - len(steps) :] * bent).sum()
    with torch.no_grad():
        errors = mean_by_step(image_errors(images, truth, targets.valid), step, n_steps)
    return loss, errors
