"""Encode the first steps of a scene, predict all others, compare them with the truth and with cheap predictions.

Baselines:

- ``constant``: the model's own last encoded particles, held still (what the dynamics adds);
- ``copy``: the true last input frame of the same camera (no model at all);
- ``constant_velocity``: the last encoded step; what may move goes on as far a step as its centroid went last;
- ``release_constant``: the first predicted step, held still (the baseline of the published evaluation).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from gsim3d.data import Scene, make_frames
from gsim3d.dynamics import concatenate
from gsim3d.errors import InputError
from gsim3d.evaluate.metrics import psnr, ssim
from gsim3d.train.restore import Restored
from gsim3d.train.samples import context_cameras, spread_views, thin_background
from gsim3d.types import DYNAMIC, Particles

METHODS = ("model", "constant", "copy", "constant_velocity", "release_constant")
METRICS = ("psnr", "psnr_masked", "psnr_body", "ssim")


@dataclass(frozen=True)
class Prediction:
    """Encoded and predicted particles of one scene.

    particles: one cloud a step, the first ``n_encoded`` of them encoded.
    context_cams: cameras whose images were the input.
    """

    particles: Particles
    n_encoded: int
    context_cams: tuple[int, ...]

    @property
    def n_steps(self) -> int:
        return self.particles.n_clouds


@dataclass(frozen=True)
class SceneScores:
    """Scores of one scene: metric values [S] by step for each method, means over the target views.

    Steps before ``n_encoded`` are reconstructions, the others predictions; baselines have NaN at the former. A value
    that no image has (an empty mask) is NaN.
    """

    scene: str
    n_encoded: int
    values: dict[str, dict[str, Tensor]]


def default_views(restored: Restored, scene: Scene) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """(context, target) cameras: inputs spread evenly; targets those kept from training's inputs, else all the rest."""
    cameras = context_cameras(scene, restored.data)
    if len(cameras) < restored.data.context_views:
        raise InputError(f"{scene.path}: {len(cameras)} usable cameras; training had {restored.data.context_views} views")
    context = spread_views(cameras, restored.data.context_views, 0)
    target = restored.data.target_only_cameras or tuple(c for c in range(scene.n_cams) if c not in context)
    return context, target or context


@torch.no_grad()
def predict(restored: Restored, scene: Scene, context_cams: Sequence[int], n_future: int, start: int = 0) -> Prediction:
    """Encodes ``history`` steps of a scene from ``start`` and rolls out ``n_future`` steps, also beyond the film's end.

    Raises:
        InputError: images of another size than in training, or cameras and steps that the scene has not.
    """
    restored.check_scene(scene)
    n_encoded = restored.data.history
    if not 0 <= start <= scene.n_steps - n_encoded:
        raise InputError(f"{scene.path}: {n_encoded} steps from step {start} on do not fit its {scene.n_steps} steps")
    if n_future < 1:
        raise InputError(f"the number of steps to predict must be at least 1; got {n_future}")
    masked = scene.has_segmentation()
    frames = make_frames([scene], [list(context_cams)], [range(start, start + n_encoded)], masked=masked)
    encoded = restored.simulator.encode(thin_background(frames, restored.data.background_stride))
    steps = restored.simulator.rollout(encoded, n_future, restored.plan)
    return Prediction(concatenate([encoded, *steps]), n_encoded, tuple(context_cams))


@torch.no_grad()
def render_steps(
    restored: Restored, particles: Particles, scene: Scene, cams: Sequence[int], start: int = 0
) -> Tensor:
    """Images [S, V, H, W, 3], clipped to [0, 1], of every cloud of one scene's particles, seen by cameras ``cams``.

    The first cloud is step ``start`` of the film, which matters where cameras move.
    """
    n_steps, n_views = particles.n_clouds, len(cams)
    cameras = scene.cameras_at(cams, range(start, start + n_steps))
    images = restored.simulator.render(particles, cameras, plan=restored.plan).color
    return images.clamp(0, 1).unflatten(0, (n_steps, n_views))


def constant_velocity(prediction: Prediction) -> Particles:
    """What may move goes on from the last encoded step at the speed of its centroid; one cloud a future step."""
    encoded = prediction.particles
    last = prediction.n_encoded - 1
    final = encoded.select_clouds(torch.tensor([last]))
    centroids = [_moving_centroid(encoded.select_clouds(torch.tensor([q]))) for q in range(max(0, last - 1), last + 1)]
    velocity = centroids[-1] - centroids[0]
    moving = (final.activity == DYNAMIC).to(final.means.dtype)[:, None]
    steps = []
    for j in range(1, prediction.n_steps - last):
        moved = final.means + j * velocity * moving
        steps.append(dataclasses.replace(final, means=moved, cloud_step=final.cloud_step + j))
    return concatenate(steps)


def check_horizon(restored: Restored, scene: Scene, n_future: int | None) -> int:
    """Steps that can be predicted and compared: ``n_future``, or all that the film has after the input.

    Raises:
        InputError: the film is too short.
    """
    known = scene.n_steps - restored.data.history
    n_future = known if n_future is None else n_future
    if n_future > known or n_future < 1:
        raise InputError(f"{scene.path}: {n_future} steps to compare, but only {max(0, known)} after the input")
    return n_future


def score_scene(
    restored: Restored,
    scene: Scene,
    *,
    context_cams: Sequence[int] | None = None,
    target_cams: Sequence[int] | None = None,
    n_future: int | None = None,
) -> SceneScores:
    """Predicts a scene from its first steps and scores every method on the target views.

    Args:
        context_cams, target_cams: default those of :func:`default_views`.
        n_future: steps to predict; default to the end of the film.
    """
    defaults = default_views(restored, scene)
    context_cams, target_cams = context_cams or defaults[0], list(target_cams or defaults[1])
    n_encoded = restored.data.history
    n_future = check_horizon(restored, scene, n_future)
    prediction = predict(restored, scene, context_cams, n_future)
    steps = range(n_encoded + n_future)
    truth = scene.images(target_cams, steps).permute(0, 1, 3, 4, 2).float() / 255
    labels = scene.segmentation(target_cams, steps) if scene.has_segmentation() else None
    images = {"model": render_steps(restored, prediction.particles, scene, target_cams)}
    images["constant"] = _held(images["model"], n_encoded - 1, n_encoded)
    images["copy"] = _held(truth, n_encoded - 1, n_encoded)
    moved = render_steps(restored, constant_velocity(prediction), scene, target_cams)
    images["constant_velocity"] = torch.cat([images["model"][:n_encoded], moved])
    images["release_constant"] = _held(images["model"], n_encoded, n_encoded)
    filmed = scene.valid(target_cams, steps)
    values = {name: _scores(images[name], truth, labels, filmed) for name in METHODS}
    for name in METHODS[1:]:
        for metric in values[name].values():
            metric[:n_encoded] = torch.nan
    return SceneScores(scene.name, n_encoded, values)


def _moving_centroid(cloud: Particles) -> Tensor:
    moving = cloud.means[cloud.activity == DYNAMIC]
    return moving.mean(0) if len(moving) else cloud.means.new_zeros(3)


def _held(images: Tensor, step: int, n_encoded: int) -> Tensor:
    """``images`` with every future step replaced by that of ``step``."""
    held = images.clone()
    held[n_encoded:] = images[step]
    return held


def _scores(images: Tensor, truth: Tensor, labels: Tensor | None, filmed: Tensor | None) -> dict[str, Tensor]:
    """Metric -> float64 [S], means over the views that have a value; what was not filmed is no error."""
    n_steps, n_views = images.shape[:2]
    flat, true = images.flatten(0, 1), truth.flatten(0, 1)
    inside = None
    if filmed is not None:
        inside = filmed.flatten(0, 1)
        flat = flat * inside[..., None]
    scores = {"psnr": psnr(flat, true, inside)}
    if labels is not None:
        scores["psnr_masked"] = psnr(flat, true, labels.flatten(0, 1) > 0)
        scores["psnr_body"] = psnr(flat, true, labels.flatten(0, 1) == 3)
    scores["ssim"] = ssim(flat, true)
    return {name: value.reshape(n_steps, n_views).nanmean(1) for name, value in scores.items()}
