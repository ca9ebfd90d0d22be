"""The training loss: image errors weighted over time."""

import torch
from torch import Tensor

from gsim3d.cameras import Cameras, Frames
from gsim3d.evaluate.perceptual.lpips import LPIPS
from gsim3d.train.config import LossConfig

MAX_GAIN = 1.5
LEAST_ERROR = 1e-5  # added before a logarithm; 50 dB
LEAST_WEIGHT = 1e-12  # lower bound of the total pixel weight of an image, so that empty images have error 0


def training_loss(
    settings: LossConfig, perceptual: LPIPS | None, images: Tensor, targets: Frames, weights: Tensor
) -> tuple[Tensor, Tensor]:
    """Computes the loss, and the unweighted mean squared error of each step.

    Args:
        settings: weights of the terms.
        perceptual: LPIPS network, if ``settings.perceptual`` is not 0.
        images: [I, H, W, 3], rendered images of the target cameras.
        targets: ground truth; image i shows step ``image_cloud[i] % S``.
        weights: [S], from :func:`time_weights`.
    """
    n_steps, truth, shown = weights.shape[0], targets.images.permute(0, 2, 3, 1), targets.dynamic
    weight = 1 + settings.body_weight * shown if settings.body_weight and shown is not None else None
    if targets.valid is not None:
        weight = targets.valid.float() if weight is None else weight * targets.valid
    if settings.image_gain:
        images = images * relative_gains(images.detach(), truth, targets.cameras, n_steps, weight)
    step = targets.cameras.image_cloud % n_steps
    if settings.relative:
        wrong = relative_errors(images, truth, shown, settings.body_weight, targets.valid)
    else:
        wrong = image_errors(images, truth, weight)
    if perceptual is not None:
        seen = images if targets.valid is None else torch.where(targets.valid[..., None], images, truth)
        distance = perceptual(seen.permute(0, 3, 1, 2), targets.images)
        wrong = wrong + settings.perceptual * ((distance + LEAST_ERROR).log() if settings.relative else distance)
    with torch.no_grad():
        errors = mean_by_step(image_errors(images, truth, targets.valid), step, n_steps)
    return image_loss(wrong, step, weights), errors


def time_weights(n_past: int, n_future: int, *, balance: float = 0.5, discount: float = 0.87) -> Tensor:
    """Returns step weights: ``(1 - balance) / n_past`` for encoded, ``balance * discount^j`` for simulated steps.

    Without simulated steps the loss is the mean over the encoded steps. The simulated part is not normalised, so longer
    rollouts have a larger total weight.

    Returns:
        float32 [n_past + n_future].
    """
    if n_past < 1 or n_future < 0:
        raise ValueError(f"time_weights: must have n_past >= 1 and n_future >= 0; got {n_past}, {n_future}")
    past = torch.full((n_past,), (1 - balance * (n_future > 0)) / n_past)
    return torch.cat([past, balance * discount ** torch.arange(n_future, dtype=torch.float32)])


def image_errors(pred: Tensor, target: Tensor, weight: Tensor | None = None) -> Tensor:
    """Returns the mean squared error [I] of images [I, H, W, C], optionally weighted by ``weight`` [I, H, W]."""
    errors = (pred - target).square().mean(-1)
    if weight is None:
        return errors.mean((1, 2))
    return (errors * weight).sum((1, 2)) / weight.sum((1, 2)).clamp(min=LEAST_WEIGHT)


def relative_errors(
    pred: Tensor, target: Tensor, bodies: Tensor | None, body_weight: float = 0.0, valid: Tensor | None = None
) -> Tensor:
    """Returns log(e_1 + LEAST_ERROR) + (1 + body_weight) log(e_2 + LEAST_ERROR) [I] of images [I, H, W, C]: e_2 is the
    squared error of pixels on ``bodies`` (bool [I, H, W]), e_1 that of the others (None: of all), each a sum over its
    pixels divided by all of the image. Pixels that are not ``valid`` (bool [I, H, W]) have none."""
    errors = (pred - target).square().mean(-1)
    errors = errors if valid is None else errors * valid
    parts = [(1.0, errors)] if bodies is None else [(1.0, errors * ~bodies), (1 + body_weight, errors * bodies)]
    return sum(share * (part.mean((1, 2)) + LEAST_ERROR).log() for share, part in parts)


def relative_gains(
    pred: Tensor, target: Tensor, cameras: Cameras, n_steps: int, weight: Tensor | None = None
) -> Tensor:
    """Returns gains [I, 1, 1, C] of images [I, H, W, C], one for each camera of a scene, relative to the scene's mean.

    A gain has the least error over all given images of a pose and scene (``cameras.image_cloud // n_steps``), of whole
    windows in training. So errors that grow over time are not forgiven, unless the camera moves. Without the division
    of gains (1 / MAX_GAIN to MAX_GAIN) by their geometric mean, a model would not learn how bright it is.
    """
    scene = cameras.image_cloud // n_steps
    same_scene = (scene[:, None] == scene)[..., None]
    same_camera = same_scene & (cameras.viewmats[:, None] == cameras.viewmats).flatten(2).all(2, keepdim=True)
    weight = 1 if weight is None else weight[..., None]
    power, match = ((same_camera * (weight * pred * other).sum((1, 2))).sum(1) for other in (pred, target))
    gain = torch.where(power > 0, match / power.clamp(min=LEAST_WEIGHT), 1).clamp(1 / MAX_GAIN, MAX_GAIN).log()
    return (gain - (same_scene * gain).sum(1) / same_scene.sum(1)).exp()[:, None, None]


def mean_by_step(values: Tensor, step: Tensor, n_steps: int) -> Tensor:
    """Averages values [I] by step [I] (int64) to [n_steps]; a matrix product, so the order of sums is fixed."""
    member = (step[None] == torch.arange(n_steps, device=step.device)[:, None]).to(values.dtype)
    return (member * values).sum(1) / member.sum(1).clamp(min=1)


def image_loss(errors: Tensor, step: Tensor, weights: Tensor) -> Tensor:
    """Computes ``sum_t weights[t] * mean of errors at step t`` for the ``errors`` [I] of images at ``step`` int64 [I];
    ``weights`` [S] of :func:`time_weights`."""
    return (weights.to(errors) * mean_by_step(errors, step, weights.shape[0])).sum()
