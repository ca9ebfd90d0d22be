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
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from gsim3d.cameras import Frames
from gsim3d.data import Scene, make_frames
from gsim3d.data.recording import BACKGROUND
from gsim3d.dynamics import RestLog, concatenate
from gsim3d.effects.edits import Edit
from gsim3d.errors import FitWarning, InputError, NumericalError
from gsim3d.evaluate.predictions import Predictions
from gsim3d.evaluate.scoring import EXACT_PARTS, PLAIN_METRICS, SceneScores, SceneTruth
from gsim3d.io.terminal import progress
from gsim3d.numerics.speed import draw, encode
from gsim3d.state import DYNAMIC, Particles
from gsim3d.train.processes import Processes
from gsim3d.train.restore import Restored
from gsim3d.train.samples import context_cameras, spread_views

METHODS = ("model", "constant", "copy", "constant_velocity", "release_constant", *EXACT_PARTS)
TOGETHER = 8  # scenes that a GPU predicts in one rollout, fewer where they are large
MOST_PIXELS = 2**21  # of the input images of one rollout
CLIPS = 48  # of which FVD is measured


@dataclass(frozen=True)
class Prediction:
    """Encoded and predicted particles of one scene.

    Attributes:
        particles: one cloud a step, the first ``n_encoded`` of them encoded.
        n_encoded: encoded steps.
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

    def step(self, number: int) -> Particles:
        """The particles of one step."""
        return self.particles.select_clouds(torch.tensor([number], device=self.particles.means.device))


def default_views(
    restored: Restored, scene: Scene, context: Sequence[int] | None = None, target: Sequence[int] | None = None
) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """(context, target) cameras: those named, and for what is not named

    inputs spread evenly, none of them a named target; targets those that training never had as inputs, else the rest.
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


def horizon(scene: Scene, n_encoded: int, n_future: int | None) -> int:
    """Steps that can be predicted and compared: ``n_future``, or all that the scene has after ``n_encoded``.

    Raises:
        InputError: the scene is too short, or the number below 1.
    """
    if n_future is not None:
        _check_count(n_future)
    known = scene.n_steps - n_encoded
    if known < (n_future or 1):
        raise InputError(f"{scene.path}: {n_future or 1} steps to compare, but only {max(0, known)} after the input")
    return n_future or known


def _check_count(n_future: int) -> None:
    if n_future < 1:
        raise InputError(f"the number of steps to predict must be at least 1; got {n_future}")


def predict(
    restored: Restored,
    scene: Scene,
    context_cams: Sequence[int],
    n_future: int,
    start: int = 0,
    edits: Sequence[Edit] = (),
    on_steps: Callable[[int], object] | None = None,
) -> Prediction:
    """Encodes ``history`` steps of a scene from ``start`` and rolls out ``n_future`` steps, also beyond its last frame.

    Args:
        restored: the model.
        scene: whose frames are given.
        context_cams: input cameras.
        n_future: steps to predict.
        start: first given step.
        edits: changes of the scene on the way.
        on_steps: is called with the number of steps that have just been simulated.
    Raises:
        InputError: images of another size than in training, cameras and steps that the scene has not, or an edit that
            cannot be made.
    """
    options = {"start": start, "edits": edits, "on_steps": on_steps}
    return predict_together(restored, [scene], n_future, [context_cams], **options)[0]


def check_cameras(scene: Scene, cams: Sequence[int]) -> None:
    """Raises InputError where the scene does not have one of ``cams``."""
    if bad := [cam for cam in cams if not 0 <= cam < scene.n_cams]:
        raise InputError(f"{scene.path}: camera {bad[0]} does not exist; the scene has {scene.n_cams}")


def encode_folder(restored: Restored, folder: str | Path, resample: bool = False) -> Particles:
    """The first ``history`` steps of the scene in ``folder``, seen by its default views."""
    scene = restored.open_scene(folder, resample=resample)
    return encode_steps(restored, scene, default_views(restored, scene)[0])


def predict_together(
    restored: Restored,
    scenes: Sequence[Scene],
    n_future: int,
    contexts: Sequence[Sequence[int]] | None = None,
    *,
    start: int = 0,
    edits: Sequence[Edit] = (),
    on_steps: Callable[[int], object] | None = None,
) -> list[Prediction]:
    """:func:`predict` of several scenes in one rollout.

    Args:
        restored: the model.
        scenes: to predict.
        n_future: steps to predict.
        contexts: input cameras of each scene; default: those of :func:`default_views`.
        start: first given step.
        edits: changes of the scenes on the way.
        on_steps: is called with the number of steps that have just been simulated.
    """
    _check_count(n_future)

    def counted(predict: Callable) -> Callable:
        def wrapped(*state, **options):
            steps = predict(*state, **options)
            on_steps(steps.n_clouds)
            return steps

        return wrapped

    contexts = [default_views(restored, scene)[0] for scene in scenes] if contexts is None else contexts
    encoded, log = _encode(restored, scenes, contexts, start), RestLog()
    options = {"edits": edits, "log": log, "wrap": on_steps and counted}
    steps = restored.simulator.predict(encoded, n_future, restored.plan, **options).steps
    together, n_encoded = concatenate([encoded, *steps]), restored.n_encoded
    n_steps = n_encoded + n_future
    return [
        Prediction(
            together.select_clouds(range(b * n_steps, (b + 1) * n_steps)) if len(scenes) > 1 else together,
            n_encoded,
            tuple(context),
            log.resting_share,
        )
        for b, context in enumerate(contexts)
    ]


def encode_steps(restored: Restored, scene: Scene, context_cams: Sequence[int], start: int = 0) -> Particles:
    """``history`` steps of a scene from ``start``. Errors as in :func:`predict`."""
    return _encode(restored, [scene], [context_cams], start)


@torch.no_grad()
def _encode(
    restored: Restored, scenes: Sequence[Scene], contexts: Sequence[Sequence[int]], start: int = 0
) -> Particles:
    return encode(restored.simulator, input_frames(restored, scenes, contexts, start))


def input_frames(
    restored: Restored, scenes: Sequence[Scene], contexts: Sequence[Sequence[int]], start: int = 0
) -> Frames:
    """Images of ``history`` steps of scenes from ``start``, by as many of the cameras ``contexts`` as the simulator's
    setting says. Errors as in :func:`predict`."""
    n_encoded, most = restored.n_encoded, restored.simulator.setting.context_views
    for scene in scenes:
        restored.check_scene(scene)
        if not 0 <= start <= scene.n_steps - n_encoded:
            raise InputError(
                f"{scene.path}: {n_encoded} steps from step {start} on do not fit its {scene.n_steps} steps"
            )
    if most is not None:
        contexts = [[cams[k * len(cams) // most] for k in range(min(most, len(cams)))] for cams in contexts]
    steps = [range(start, start + n_encoded)] * len(scenes)
    return make_frames(scenes, [list(cams) for cams in contexts], steps)


@torch.no_grad()
def render_steps(restored: Restored, particles: Particles, scene: Scene, cams: Sequence[int], start: int = 0) -> Tensor:
    """Images [S, V, H, W, 3], clipped to [0, 1], of every cloud of one scene's particles, seen by cameras ``cams``.

    The first cloud is step ``start`` of the scene, which matters where cameras move.
    """
    n_steps, n_views = particles.n_clouds, len(cams)
    cameras = scene.cameras_at(cams, range(start, start + n_steps)).to(particles.means.device)
    images = draw(restored.simulator, particles, cameras, None, restored.plan).color.float()
    return images.clamp(0, 1).unflatten(0, (n_steps, n_views))


def constant_velocity(prediction: Prediction) -> Particles:
    """What may move goes on from the last encoded step at the speed of its centroid; one cloud a future step.

    Nothing moves where there was one step only, or where one of the last two shows nothing that may move.
    """
    last = prediction.n_encoded - 1
    final = prediction.step(last)
    centroids = [
        cloud.means[cloud.activity == DYNAMIC].mean(0)  # NaN where nothing may move
        for cloud in (prediction.step(max(0, last - 1)), final)
    ]
    velocity = torch.nan_to_num(centroids[1] - centroids[0])
    moving = (final.activity == DYNAMIC).to(final.means.dtype)[:, None]
    steps = [
        dataclasses.replace(final, means=final.means + j * velocity * moving, cloud_step=final.cloud_step + j)
        for j in range(1, prediction.n_steps - last)
    ]
    return concatenate(steps)


def score_scene(
    restored: Restored | None,
    scene: Scene,
    *,
    context_cams: Sequence[int] | None = None,
    target_cams: Sequence[int] | None = None,
    n_encoded: int | None = None,
    n_future: int | None = None,
    metrics: Sequence[str] = PLAIN_METRICS,
    methods: Sequence[str] = METHODS,
    others: Sequence[Predictions] = (),
    prediction: Prediction | None = None,
    start: int = 0,
) -> SceneScores:
    """Predicts a scene from its first steps, or those from ``start`` on, and scores every method on the target views.

    Args:
        restored: the model; None: only ``others`` and ``copy`` are scored.
        scene: to predict.
        context_cams: input cameras; default: those of :func:`default_views`.
        target_cams: cameras to compare; default: those of :func:`default_views`; without a model they must be given.
        n_encoded: steps that the others were given; the model always takes those of its training.
        n_future: steps to predict; default: to the end of the scene.
        metrics: see :func:`gsim3d.evaluate.scoring.measurable`.
        methods: of METHODS.
        others: predictions of other models.
        prediction: what :func:`predict` gave for these cameras and steps; None: it is made here.
        start: first given step; the scores begin there.
    """
    if restored is not None:
        context_cams, target_cams = default_views(restored, scene, context_cams, target_cams)
        n_encoded = restored.n_encoded
    n_given = start + n_encoded
    n_future = horizon(scene, n_given, n_future)
    cams, steps = list(target_cams), range(start, n_given + n_future)
    device = torch.device("cpu") if restored is None else restored.device
    images = scene.images(cams, steps)
    labels = scene.segmentation(cams, steps) if scene.has_segmentation() else None
    digest = _digest(images, labels)
    images = images.permute(0, 1, 3, 4, 2).to(device).float() / 255
    labels = None if labels is None else labels.to(device)
    valid = scene.valid(cams, steps)
    valid = None if valid is None else valid.to(device)
    truth = SceneTruth(scene.name, images, labels, valid, n_encoded, metrics)

    def predicted() -> Iterator[tuple[str, Tensor]]:
        baselines: dict[str, Callable[[], Tensor]] = {
            "copy": lambda: images[n_encoded - 1].expand(n_future, *images.shape[1:])
        }
        if restored is not None:
            made = prediction or predict(restored, scene, context_cams, n_future, start)
            rendered = render_steps(restored, made.particles, scene, cams, start)
            yield "model", rendered
            baselines = {
                "constant": lambda: _held(restored, made, rendered, n_encoded - 1, scene, cams, start),
                **baselines,
                "constant_velocity": lambda: render_steps(restored, constant_velocity(made), scene, cams, n_given),
                "release_constant": lambda: _held(restored, made, rendered, n_encoded, scene, cams, start),
            }
        for other in others:
            theirs = other.images(scene, cams, n_given, n_future).to(device).float() / 255
            if scene.recording.real_background and labels is not None:  # the video's own background is black there
                theirs *= (labels[n_encoded:] != BACKGROUND)[..., None]
            yield other.name, theirs
        yield from ((name, make()) for name, make in baselines.items() if name in methods)

    return dataclasses.replace(truth.score(predicted()), digest=digest)


def score_scenes(
    restored: Restored | None,
    scenes: Sequence[Scene],
    views: Sequence[tuple[Sequence[int] | None, Sequence[int]]],
    *,
    n_encoded: int,
    n_future: int,
    metrics: Sequence[str] = PLAIN_METRICS,
    methods: Sequence[str] = METHODS,
    others: Sequence[Predictions] = (),
    clips: int = CLIPS,
    processes: Processes | None = None,
    quiet: bool = True,
) -> list[SceneScores]:
    """:func:`score_scene` of every scene, in their order; a GPU predicts several together.

    Args:
        restored: as in :func:`score_scene`, like n_encoded, n_future, metrics, methods and others.
        scenes: to predict.
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
    given = {"n_encoded": n_encoded, "n_future": n_future, "methods": methods, "others": others}

    def scored(group: Sequence[int]) -> Iterator[tuple[int, SceneScores]]:
        predictions = [None] * len(group)
        if len(group) > 1:
            contexts = [views[number][0] for number in group]
            predictions = predict_together(restored, [scenes[number] for number in group], n_future, contexts)
        for number, prediction in zip(group, predictions, strict=True):
            (context, targets), own = views[number], [m for m in metrics if m != "fvd" or number in for_fvd]
            cams = {"context_cams": context, "target_cams": targets}
            yield number, score_scene(restored, scenes[number], **cams, **given, metrics=own, prediction=prediction)

    scores: dict[int, SceneScores] = {}
    quiet = quiet or not processes.is_first
    with _two_threads(), progress(None, "scenes", len(scenes), unit="scene", quiet=quiet) as bar:
        for first in range(0, len(groups), processes.count):
            mine = first + processes.rank
            try:
                found = [pair for group in groups[mine : mine + 1] for pair in scored(group)]
            except (InputError, NumericalError) as error:  # raised in all processes: none waits for another
                found = error
            for share in processes.gather(found):
                if isinstance(share, Exception):
                    raise share
                scores.update(share)
            bar.update(len(scores) - bar.n)
    return [scores[number] for number in range(len(scenes))]


def _batches(restored: Restored, scenes: Sequence[Scene], contexts: Sequence[Sequence[int]]) -> list[list[int]]:
    """Numbers of the scenes that are predicted together: neighbours, alone on a CPU.

    They depend on the scenes and the device only, so that any number of processes gets the same numbers.
    """
    found: list[list[int]] = []
    for number, (scene, context) in enumerate(zip(scenes, contexts, strict=True)):
        kind = scene.has_segmentation(), len(context)
        most = min(TOGETHER, MOST_PIXELS // (scene.width * scene.height * restored.data.history * len(context)))
        fits = restored.device.type == "cuda" and found and len(found[-1]) < most
        if fits and kind == (scenes[found[-1][0]].has_segmentation(), len(contexts[found[-1][0]])):
            found[-1].append(number)
        else:
            found.append([number])
    return found


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
    still = prediction.step(step)
    return torch.cat([render_steps(restored, still, scene, cams, start + seen) for seen in later])
