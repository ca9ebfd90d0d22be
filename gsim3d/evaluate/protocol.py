"""Encode the first steps of a scene, predict all others, compare them with the truth and with cheap predictions.

Baselines:

- ``constant``: the model's own last encoded particles, held still (what the dynamics adds);
- ``copy``: the true last input frame of the same camera (no model at all);
- ``constant_velocity``: the last encoded step; what may move goes on as far a step as its centroid went last;
- ``release_constant``: the first predicted step, held still (the baseline of the published evaluation);
- ``perfect_ground``, ``perfect_body``: ``constant`` with the true pixels of the ground, or of the bodies (masked PSNR
  alone): what the other pixels cost.

Predictions of other models (predictions.py) are scored on the same steps, views and scenes.
"""

from __future__ import annotations

import dataclasses
import hashlib
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import torch
from torch import Tensor

from gsim3d.data import Scene, make_frames
from gsim3d.data.recording import BACKGROUND
from gsim3d.dynamics import RestLog, concatenate
from gsim3d.effects.edits import Edit
from gsim3d.errors import FitWarning, InputError, NumericalError
from gsim3d.evaluate.predictions import Predictions
from gsim3d.evaluate.scoring import EXACT_PARTS, PLAIN_METRICS, SceneScores, SceneTruth
from gsim3d.io.terminal import progress
from gsim3d.nn.layers import exact_convolutions
from gsim3d.state import DYNAMIC, Particles
from gsim3d.train.processes import Processes
from gsim3d.train.restore import Restored
from gsim3d.train.samples import context_cameras, spread_views, subsampled

METHODS = ("model", "constant", "copy", "constant_velocity", "release_constant", *EXACT_PARTS)
TOGETHER = 8  # scenes that a GPU predicts in one rollout, fewer where they are large
MOST_PIXELS = 2**21  # of the input images of one rollout
CLIPS = 48  # of which FVD is measured


@dataclass(frozen=True)
class Prediction:
    """Encoded and predicted particles of one scene.

    particles: one cloud a step, the first ``n_encoded`` of them encoded.
    context_cams: cameras whose images were the input.
    resting: share of the predicted particles that rested and were not computed.
    """

    particles: Particles
    n_encoded: int
    context_cams: tuple[int, ...]
    resting: float = 0.0

    @property
    def n_steps(self) -> int:
        return self.particles.n_clouds


def default_views(
    restored: Restored, scene: Scene, context: Sequence[int] | None = None, target: Sequence[int] | None = None
) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """(context, target) cameras: those named, and for what is not named

    inputs spread evenly, none of them a named target; targets those kept from training's inputs, else all the rest.
    """
    data = restored.data_of(scene)
    if not context:
        cameras = [cam for cam in context_cameras(scene, data) if cam not in (target or ())]
        count = min(data.context_views, len(cameras))
        if count < min(2, restored.data.context_views):
            raise InputError(
                f"{scene.path}: {len(cameras)} cameras left as inputs; training had {restored.data.context_views} "
                "views (--context names inputs)"
            )
        context = spread_views(cameras, count, 0)
        if count < restored.data.context_views:
            warnings.warn(
                f"fitted to the model: {count} input views, cameras {' '.join(map(str, context))}; training had "
                f"{restored.data.context_views} (--context names inputs)",
                FitWarning,
                stacklevel=2,
            )
    if not target:
        rest = tuple(cam for cam in range(scene.n_cams) if cam not in context)
        target = data.target_only_cameras or rest or context
    return tuple(context), tuple(target)


@torch.no_grad()
def predict(
    restored: Restored,
    scene: Scene,
    context_cams: Sequence[int],
    n_future: int,
    start: int = 0,
    edits: Sequence[Edit] = (),
) -> Prediction:
    """Encodes ``history`` steps of a scene from ``start`` and rolls out ``n_future`` steps, also beyond the film's end.

    Args:
        edits: changes of the scene on the way.
    Raises:
        InputError: images of another size than in training, cameras and steps that the scene has not, or an edit that
            cannot be made.
    """
    if n_future < 1:
        raise InputError(f"the number of steps to predict must be at least 1; got {n_future}")
    encoded = encode_steps(restored, scene, context_cams, start)
    with exact_convolutions():
        steps = restored.simulator.rollout(encoded, n_future, restored.plan, edits=edits, log=(log := RestLog()))
    return Prediction(concatenate([encoded, *steps]), restored.data.history, tuple(context_cams), log.resting_share)


@torch.no_grad()
def encode_steps(restored: Restored, scene: Scene, context_cams: Sequence[int], start: int = 0) -> Particles:
    """``history`` steps of a scene from ``start``. Errors as :func:`predict`."""
    restored.check_scene(scene)
    n_encoded = restored.data.history
    if not 0 <= start <= scene.n_steps - n_encoded:
        raise InputError(f"{scene.path}: {n_encoded} steps from step {start} on do not fit its {scene.n_steps} steps")
    masked = scene.has_segmentation()
    frames = make_frames([scene], [list(context_cams)], [range(start, start + n_encoded)], masked=masked)
    frames = subsampled(frames, restored.data).to(restored.device)
    with exact_convolutions():
        return restored.simulator.encode(frames)


@torch.no_grad()
def predict_together(
    restored: Restored, scenes: Sequence[Scene], n_future: int, contexts: Sequence[Sequence[int]] | None = None
) -> list[Prediction]:
    """:func:`predict` of several scenes from their first steps, in one rollout.

    Args:
        contexts: input cameras of each scene; default: those of :func:`default_views`.
    """
    for scene in scenes:
        restored.check_scene(scene)
    contexts = [default_views(restored, scene)[0] for scene in scenes] if contexts is None else contexts
    n_encoded, masked = restored.data.history, all(scene.has_segmentation() for scene in scenes)
    frames = make_frames(scenes, contexts, [range(n_encoded)] * len(scenes), masked=masked)
    with exact_convolutions():
        encoded = restored.simulator.encode(subsampled(frames, restored.data).to(restored.device))
        together = concatenate([encoded, *restored.simulator.rollout(encoded, n_future, restored.plan)])
    n_steps = n_encoded + n_future
    return [
        Prediction(together.select_clouds(range(b * n_steps, (b + 1) * n_steps)), n_encoded, tuple(context))
        for b, context in enumerate(contexts)
    ]


def _batches(restored: Restored, scenes: Sequence[Scene], contexts: Sequence[Sequence[int]]) -> list[list[int]]:
    """Numbers of the scenes that are predicted together: neighbours, alone on a CPU.

    They depend on the scenes and the device only, so that any number of processes gets the same numbers.
    """
    found: list[list[int]] = []
    for number, (scene, context) in enumerate(zip(scenes, contexts, strict=True)):
        kind = scene.has_segmentation(), len(context)
        most = min(TOGETHER, MOST_PIXELS // (scene.width * scene.height * restored.data.history * len(context)))
        room = restored.device.type == "cuda" and found and len(found[-1]) < most
        if room and kind == (scenes[found[-1][0]].has_segmentation(), len(contexts[found[-1][0]])):
            found[-1].append(number)
        else:
            found.append([number])
    return found


@torch.no_grad()
def render_steps(restored: Restored, particles: Particles, scene: Scene, cams: Sequence[int], start: int = 0) -> Tensor:
    """Images [S, V, H, W, 3], clipped to [0, 1], of every cloud of one scene's particles, seen by cameras ``cams``.

    The first cloud is step ``start`` of the film, which matters where cameras move.
    """
    n_steps, n_views = particles.n_clouds, len(cams)
    cameras = scene.cameras_at(cams, range(start, start + n_steps)).to(particles.means.device)
    images = restored.simulator.render(particles, cameras, plan=restored.plan).color
    return images.clamp(0, 1).unflatten(0, (n_steps, n_views))


def constant_velocity(prediction: Prediction) -> Particles:
    """What may move goes on from the last encoded step at the speed of its centroid; one cloud a future step.

    Nothing moves where there was one step only, or where one of the last two shows nothing that may move.
    """
    encoded = prediction.particles
    last = prediction.n_encoded - 1
    final = _cloud(encoded, last)
    centroids = [_moving_centroid(_cloud(encoded, q)) for q in range(max(0, last - 1), last + 1)]
    velocity = torch.nan_to_num(centroids[-1] - centroids[0])
    moving = (final.activity == DYNAMIC).to(final.means.dtype)[:, None]
    steps = []
    for j in range(1, prediction.n_steps - last):
        moved = final.means + j * velocity * moving
        steps.append(dataclasses.replace(final, means=moved, cloud_step=final.cloud_step + j))
    return concatenate(steps)


def horizon(scene: Scene, n_encoded: int, n_future: int | None) -> int:
    """Steps that can be predicted and compared: ``n_future``, or all that the film has after ``n_encoded``.

    Raises:
        InputError: the film is too short, or the number below 1.
    """
    if n_future is not None and n_future < 1:
        raise InputError(f"the number of steps to predict must be at least 1; got {n_future}")
    known = scene.n_steps - n_encoded
    if known < (n_future or 1):
        raise InputError(f"{scene.path}: {n_future or 1} steps to compare, but only {max(0, known)} after the input")
    return n_future or known


def score_scene(
    restored: Restored | None,
    scene: Scene,
    *,
    context_cams: Sequence[int] | None = None,
    target_cams: Sequence[int] | None = None,
    n_encoded: int | None = None,
    n_future: int | None = None,
    metrics: Sequence[str] = PLAIN_METRICS,
    others: Sequence[Predictions] = (),
    prediction: Prediction | None = None,
    start: int = 0,
) -> SceneScores:
    """Predicts a scene from its first steps, or those from ``start`` on, and scores every method on the target views.

    Args:
        restored: the model; None: only ``others`` and ``copy`` are scored.
        context_cams, target_cams: default those of :func:`default_views`; without a model targets must be given.
        n_encoded: steps that the others were given; the model always takes those of its training.
        n_future: steps to predict; default to the end of the film.
        metrics: see :func:`gsim3d.evaluate.scoring.measurable`.
        others: predictions of other models.
        prediction: what :func:`predict` gave for these cameras and steps; None: it is made here.
        start: first given step; the scores begin there.
    """
    if restored is not None:
        context_cams, target_cams = default_views(restored, scene, context_cams, target_cams)
        n_encoded = restored.data.history
    n_given = start + n_encoded
    n_future = horizon(scene, n_given, n_future)
    cams, steps = list(target_cams), range(start, n_given + n_future)
    device = torch.device("cpu") if restored is None else restored.device
    images = scene.images(cams, steps)
    labels = scene.segmentation(cams, steps) if scene.has_segmentation() else None
    digest = _digest(images, labels)
    images = images.permute(0, 1, 3, 4, 2).to(device).float() / 255
    labels = None if labels is None else labels.to(device)
    filmed = scene.valid(cams, steps)
    filmed = None if filmed is None else filmed.to(device)
    truth = SceneTruth(scene.name, images, labels, filmed, n_encoded, metrics)

    def methods() -> Iterator[tuple[str, Tensor]]:
        nonlocal prediction
        if restored is not None:
            prediction = prediction or predict(restored, scene, context_cams, n_future, start)
            rendered = render_steps(restored, prediction.particles, scene, cams, start)
            yield "model", rendered
        for other in others:
            predicted = other.images(scene, cams, n_given, n_future).to(device).float() / 255
            if scene.recording.real_background and labels is not None:  # the film's own background is black there
                predicted *= (labels[n_encoded:] != BACKGROUND)[..., None]
            yield other.name, predicted
        if restored is not None:
            yield "constant", _held(restored, prediction, rendered, n_encoded - 1, scene, cams, start)
        yield "copy", images[n_encoded - 1].expand(n_future, *images.shape[1:])
        if restored is not None:
            yield "constant_velocity", render_steps(restored, constant_velocity(prediction), scene, cams, n_given)
            yield "release_constant", _held(restored, prediction, rendered, n_encoded, scene, cams, start)

    return dataclasses.replace(truth.score(methods()), digest=digest)


def score_scenes(
    restored: Restored | None,
    scenes: Sequence[Scene],
    views: Sequence[tuple[Sequence[int] | None, Sequence[int]]],
    *,
    n_encoded: int,
    n_future: int,
    metrics: Sequence[str] = PLAIN_METRICS,
    others: Sequence[Predictions] = (),
    clips: int = CLIPS,
    processes: Processes | None = None,
    quiet: bool = True,
) -> list[SceneScores]:
    """:func:`score_scene` of every scene, in their order; a GPU predicts several together.

    Args:
        views: (context, target) cameras of each scene.
        clips: of which FVD is measured, at most: those of scenes spread evenly.
        processes: that share the scenes; every one must call it, and each returns all scores: those of one process,
            bit for bit.
        quiet: show no progress.
    """
    processes = processes or Processes()
    groups = [[number] for number in range(len(scenes))]
    if restored is not None:
        groups = _batches(restored, scenes, [context for context, _ in views])
    n_for_fvd = min(len(scenes), max(1, clips // max(len(targets) for _, targets in views)))
    for_fvd = {k * len(scenes) // n_for_fvd for k in range(n_for_fvd)}

    def scored(group: Sequence[int]) -> Iterator[tuple[int, SceneScores]]:
        predictions = [None] * len(group)
        if len(group) > 1:
            chosen, contexts = ([given[number] for number in group] for given in (scenes, [c for c, _ in views]))
            predictions = predict_together(restored, chosen, n_future, contexts)
        for number, prediction in zip(group, predictions, strict=True):
            context, targets = views[number]
            yield (
                number,
                score_scene(
                    restored,
                    scenes[number],
                    context_cams=context,
                    target_cams=targets,
                    n_encoded=n_encoded,
                    n_future=n_future,
                    metrics=[metric for metric in metrics if metric != "fvd" or number in for_fvd],
                    others=others,
                    prediction=prediction,
                ),
            )

    scores: dict[int, SceneScores] = {}
    quiet = quiet or not processes.is_first
    with _two_threads(), progress(None, "scenes", len(scenes), unit="scene", quiet=quiet) as bar:
        for first in range(0, len(groups), processes.count):
            mine = first + processes.rank
            try:
                found = [pair for group in groups[mine : mine + 1] for pair in scored(group)]
            except (InputError, NumericalError) as error:  # raised in all processes: none waits for another
                found = error
            for part in processes.gather(found):
                if isinstance(part, Exception):
                    raise part
                scores.update(part)
            bar.update(len(scores) - bar.n)
    return [scores[number] for number in range(len(scenes))]


@contextmanager
def _two_threads() -> Iterator[None]:
    """At least two: with one, torch convolves by other kernels, and torchrun gives each process one."""
    n_threads = torch.get_num_threads()
    torch.set_num_threads(max(2, n_threads))
    try:
        yield
    finally:
        torch.set_num_threads(n_threads)


def _digest(images: Tensor, labels: Tensor | None) -> str:
    """Hash of the true images and labels."""
    digest = hashlib.sha256(repr([images.shape, labels is None]).encode())
    for values in (images, labels):
        if values is not None:
            digest.update(values.contiguous().numpy())
    return digest.hexdigest()


def _held(
    restored: Restored,
    prediction: Prediction,
    rendered: Tensor,
    step: int,
    scene: Scene,
    cams: Sequence[int],
    start: int = 0,
) -> Tensor:
    """Images of the predicted steps that would be seen if everything stood still as it is at cloud ``step``."""
    later = range(prediction.n_encoded, prediction.n_steps)
    if not scene.cameras_move:
        return rendered[step].expand(len(later), *rendered.shape[1:])
    still = _cloud(prediction.particles, step)
    return torch.cat([render_steps(restored, still, scene, cams, start + seen) for seen in later])


def _cloud(particles: Particles, step: int) -> Particles:
    return particles.select_clouds(torch.tensor([step], device=particles.means.device))


def _moving_centroid(cloud: Particles) -> Tensor:
    """[3]; NaN where nothing may move."""
    return cloud.means[cloud.activity == DYNAMIC].mean(0)
