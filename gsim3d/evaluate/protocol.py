"""Evaluation protocol: encode the first steps of a scene, predict the rest, score against ground truth and baselines.

Baselines:

- ``constant``: the model's own last encoded particles; shows the gain of the dynamics;
- ``copy``: the last true input frame of the same camera;
- ``constant_velocity``: the last encoded particles; movable ones keep the velocity of their centroid;
- ``release_constant``: the first predicted step; the baseline of the published evaluation;
- ``perfect_ground``, ``perfect_body``: ``constant`` with true pixels of ground or bodies (masked PSNR only);
  isolates the error of the other pixels.

Predictions of other models (predictions.py) are scored on the same steps, views and scenes.
"""

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
from gsim3d.data.recording import BACKGROUND, MOVING
from gsim3d.dynamics import RestLog
from gsim3d.effects.edits import Edit
from gsim3d.errors import FitWarning, InputError, NumericalError
from gsim3d.evaluate.physics import measure_tracks, moving_points
from gsim3d.evaluate.predictions import Predictions
from gsim3d.evaluate.scoring import ALONE, EXACT_PARTS, NEEDS_LABELS, PLAIN_METRICS, SceneScores, SceneTruth
from gsim3d.io.terminal import progress
from gsim3d.numerics.speed import draw, encode_histories
from gsim3d.numerics.trust import MOST_LEFT_OUT, VARIANTS, rollout_with_spread
from gsim3d.state import DYNAMIC, Particles, concatenate
from gsim3d.train.processes import Processes
from gsim3d.train.restore import Restored
from gsim3d.train.samples import context_cameras, spread_views

METHODS = ("model", "constant", "copy", "constant_velocity", "release_constant", *EXACT_PARTS)
TOGETHER = 8  # largest number of scenes that a GPU predicts in one rollout
MOST_PIXELS = 2**21  # largest number of input pixels in one rollout
CLIPS = 48  # default number of clips for FVD


@dataclass(frozen=True)
class Prediction:
    """Encoded and predicted particles of one scene."""

    particles: Particles  #: one cloud per step; the first ``n_encoded`` are encoded, the others predicted
    n_encoded: int  #: number of encoded steps
    context_cams: tuple[int, ...]  #: input cameras
    resting: float = 0.0  #: fraction of the predicted particles that were at rest and skipped
    #: [S - n_encoded, N] metres, see :func:`gsim3d.numerics.trust.rollout_with_spread`; None: not computed
    spread: Tensor | None = None

    @property
    def n_steps(self) -> int:
        return self.particles.n_clouds

    def step(self, number: int) -> Particles:
        """Returns the particles of one step."""
        return self.particles.select_clouds(torch.tensor([number], device=self.particles.means.device))


def default_views(
    restored: Restored, scene: Scene, context: Sequence[int] | None = None, target: Sequence[int] | None = None
) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Returns (context, target) cameras; raises InputError if too few are left as inputs.

    Args:
        context: different input cameras. Default: as many as in training, evenly spaced, without ``target``.
        target: target cameras. Default: those that training excluded from inputs, else all that are not inputs.
    """
    data, trained, least = restored.data_of(scene), restored.data.context_views, len(context or ())
    if not context:
        least = min(2, trained)
        cameras = [cam for cam in context_cameras(scene, data) if cam not in (target or ())]
        context = spread_views(cameras, min(data.context_views, len(cameras)), 0)
    if len(set(context)) < least:
        left = f"{len(set(context))} cameras left as inputs; training used {trained} views"
        raise InputError(f"{scene.path}: {left} (set inputs with --context, each once)")
    if len(context) < trained:
        given = f"{len(context)} input view{'s' * (len(context) > 1)}, cameras {' '.join(map(str, context))}"
        warning = f"fitted to the model: {given}; training used {trained} (set inputs with --context)"
        warnings.warn(warning, FitWarning, stacklevel=2)
    if not target:
        rest = tuple(cam for cam in range(scene.n_cams) if cam not in context)
        target = data.target_only_cameras or rest or context
    return tuple(context), tuple(target)


def horizon(scene: Scene, n_encoded: int, n_future: int | None) -> int:
    """Returns the number of steps to predict: ``n_future``, or by default all steps after the first ``n_encoded``.
    Raises InputError if the scene is too short, or ``n_future`` is below 1."""
    if n_future is not None:
        _check_count(n_future)
    known = scene.n_steps - n_encoded
    if known < (n_future or 1):
        raise InputError(f"{scene.path}: {n_future or 1} steps to score, but only {max(0, known)} after the input")
    return n_future or known


def _check_count(n_future: int) -> None:
    if n_future < 1:
        raise InputError(f"the number of steps to predict must be at least 1; got {n_future}")


def predict(restored: Restored, scene: Scene, context_cams: Sequence[int], n_future: int, **options) -> Prediction:
    """Predicts one scene, see :func:`predict_together`."""
    return predict_together(restored, [scene], n_future, [context_cams], **options)[0]


def check_cameras(scene: Scene, cams: Sequence[int]) -> None:
    """Raises InputError if one of ``cams`` does not exist in the scene."""
    if bad := [cam for cam in cams if not 0 <= cam < scene.n_cams]:
        raise InputError(f"{scene.path}: camera {bad[0]} does not exist; the scene has {scene.n_cams}")


def encode_folder(restored: Restored, folder: str | Path, resample: bool = False) -> Particles:
    """Encodes the first steps of the scene in ``folder`` from its default views."""
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
    with_spread: bool = False,
) -> list[Prediction]:
    """Encodes the input steps of scenes from ``start`` and predicts them in one rollout, also past their last frame.

    Args:
        restored: the model.
        scenes: scenes to predict.
        n_future: number of steps to predict.
        contexts: input cameras of each scene. Default: those of :func:`default_views`.
        start: first input step.
        edits: edits to apply during the rollout.
        on_steps: called with the number of steps just simulated.
        with_spread: also predict variants, whose spread the predictions then have; takes no edits.

    Raises:
        InputError: the image size differs from training, a camera or step does not exist, or an edit is invalid.
    """
    _check_count(n_future)
    if with_spread and edits:
        raise InputError("edits: the spread of variants is not defined for scenes with edits")
    n_together = len(scenes) * (len(VARIANTS) if with_spread else 1)

    def counted(predict: Callable) -> Callable:
        def wrapped(*state, **options):
            steps = predict(*state, **options)
            on_steps(steps.n_clouds // n_together)
            return steps

        return wrapped

    contexts = [default_views(restored, scene)[0] for scene in scenes] if contexts is None else contexts
    simulator, log, spreads = restored.simulator, RestLog(), [None] * len(scenes)
    options = {"log": log, "wrap": on_steps and counted}
    if with_spread:
        histories = _encode(restored, scenes, contexts, start, MOST_LEFT_OUT)
        steps, spread = rollout_with_spread(simulator, histories, n_future, restored.plan, **options)
        encoded, spreads = histories[0], spread.split(steps[0].clouds.counts, 1)
    else:
        encoded = _encode(restored, scenes, contexts, start)[0]
        steps = simulator.predict(encoded, n_future, restored.plan, edits=edits, **options).steps
    together, n_encoded = concatenate([encoded, *steps]), restored.n_encoded
    n_steps = n_encoded + n_future
    return [
        Prediction(
            together.select_clouds(range(b * n_steps, (b + 1) * n_steps)) if len(scenes) > 1 else together,
            n_encoded,
            tuple(context),
            log.resting_share,
            spread,
        )
        for b, (context, spread) in enumerate(zip(contexts, spreads, strict=True))
    ]


def encode_steps(restored: Restored, scene: Scene, context_cams: Sequence[int], start: int = 0) -> Particles:
    """Encodes the input steps of a scene from ``start``."""
    return _encode(restored, [scene], [context_cams], start)[0]


@torch.no_grad()
def _encode(
    restored: Restored, scenes: Sequence[Scene], contexts: Sequence[Sequence[int]], start: int = 0, left_out: int = 0
) -> list[Particles]:
    frames, names = input_frames(restored, scenes, contexts, start), [str(scene.path) for scene in scenes]
    return encode_histories(restored.simulator, frames, names, left_out)


def input_frames(
    restored: Restored, scenes: Sequence[Scene], contexts: Sequence[Sequence[int]], start: int = 0
) -> Frames:
    """Packs the input images of scenes from step ``start``; the simulator's setting may reduce the number of views."""
    n_encoded, most = restored.n_encoded, restored.simulator.setting.context_views
    for scene in scenes:
        restored.check_scene(scene)
        if not 0 <= start <= scene.n_steps - n_encoded:
            raise InputError(
                f"{scene.path}: needs {n_encoded} steps from step {start}, but the scene has {scene.n_steps} steps"
            )
    if most is not None:
        contexts = [[cams[k * len(cams) // most] for k in range(min(most, len(cams)))] for cams in contexts]
    steps = [range(start, start + n_encoded)] * len(scenes)
    return make_frames(scenes, [list(cams) for cams in contexts], steps)


@torch.no_grad()
def render_steps(restored: Restored, particles: Particles, scene: Scene, cams: Sequence[int], start: int = 0) -> Tensor:
    """Renders every cloud of one scene's particles from ``cams``; moving cameras start at step ``start``.

    Returns:
        Images [S, V, H, W, 3], clamped to [0, 1].
    """
    n_steps, n_views = particles.n_clouds, len(cams)
    cameras = scene.cameras_at(cams, range(start, start + n_steps)).to(particles.means.device)
    images = draw(restored.simulator, particles, cameras, None, restored.plan).color.float()
    return images.clamp(0, 1).unflatten(0, (n_steps, n_views))


def constant_velocity(prediction: Prediction) -> Particles:
    """Computes the constant-velocity baseline, one cloud per future step.

    Movable particles of the last encoded step keep the velocity of their centroid. The velocity is 0 if there is only
    one encoded step, or if one of the last two has no movable particles.
    """
    last = prediction.n_encoded - 1
    final = prediction.step(last)
    centroids = [
        cloud.means[cloud.activity == DYNAMIC].mean(0)  # NaN without movable particles
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
    """Predicts a scene from its steps at ``start``, and scores every method on the target views.

    Args:
        restored: the model; None scores only ``others`` and ``copy``.
        scene: scene to predict.
        context_cams: input cameras. Default: those of :func:`default_views`.
        target_cams: target cameras. Default: those of :func:`default_views`; required without a model.
        n_encoded: number of input steps of ``others``; the model uses its own.
        n_future: number of steps to predict. Default: to the end of the scene.
        metrics: see :func:`gsim3d.evaluate.scoring.measurable`.
        methods: subset of METHODS.
        others: predictions of other models.
        prediction: result of :func:`predict` for these cameras and steps. Default: computed here.
        start: first input step, and first scored step.
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

    fits, tracks = [other for other in others if hasattr(other, "found")], {}

    def predicted() -> Iterator[tuple[str, Tensor]]:
        baselines: dict[str, Callable[[], Tensor]] = {
            "copy": lambda: images[n_encoded - 1].expand(n_future, *images.shape[1:])
        }
        if restored is not None:
            made = prediction or predict(restored, scene, context_cams, n_future, start=start)
            rendered = render_steps(restored, made.particles, scene, cams, start)
            tracks.update(_tracks(made))
            yield "model", rendered
            baselines = {
                "constant": lambda: _held(restored, made, rendered, n_encoded - 1, scene, cams, start),
                **baselines,
                "constant_velocity": lambda: render_steps(restored, constant_velocity(made), scene, cams, n_given),
                "release_constant": lambda: _held(restored, made, rendered, n_encoded, scene, cams, start),
            }
        for other in others:
            theirs = other.images(scene, cams, n_given, n_future).to(device).float() / 255
            if scene.recording.real_background and labels is not None:  # the true images are masked, too
                theirs *= (labels[n_encoded:] != BACKGROUND)[..., None]
            if other in fits:
                tracks[other.name] = other.points(scene, cams, n_given, n_future)
            yield other.name, theirs
        yield from ((name, make()) for name, make in baselines.items() if name in methods)

    scores = truth.score(predicted())
    alone = [
        (f"{other.name}{ALONE}", other.object_images(scene, cams, n_given, n_future).to(device).float() / 255)
        for other in fits
    ]
    if alone:  # against the object on black
        objects, own = images * (labels == MOVING)[..., None], [m for m in metrics if m not in (*NEEDS_LABELS, "fvd")]
        truth = SceneTruth(scene.name, objects, labels, valid, n_encoded, own)
        scores.values.update(truth.score(alone).values)
    physics = measure_tracks(tracks, scene, range(n_given - 1, n_given + n_future)) if tracks else {}
    fitted = {other.name: other.found() for other in fits}
    return dataclasses.replace(scores, digest=digest, physics=physics, fitted=fitted)


def _tracks(prediction: Prediction) -> dict[str, Tensor]:
    """Moving points [S, N, 3] of the model and its baselines from the last given step on."""
    last = prediction.n_encoded - 1
    held = concatenate([prediction.step(last), constant_velocity(prediction)])
    model = moving_points(prediction.particles, range(last, prediction.n_steps))
    velocity = moving_points(held, range(held.n_clouds))
    return {"model": model, "constant": model[:1].expand_as(model), "constant_velocity": velocity}


def score_scenes(
    restored: Restored | None,
    scenes: Sequence[Scene],
    views: Sequence[tuple[Sequence[int] | None, Sequence[int]]],
    *,
    n_encoded: int,
    n_future: int,
    metrics: Sequence[str] = PLAIN_METRICS,
    methods: Sequence[str] = METHODS,
    others: Sequence[Sequence[Predictions]] | None = None,
    clips: int = CLIPS,
    processes: Processes | None = None,
    quiet: bool = True,
    start: int = 0,
) -> list[SceneScores]:
    """Scores scenes with :func:`score_scene`; a GPU predicts several per rollout.

    Args:
        restored, n_encoded, n_future, metrics, methods, start: see :func:`score_scene`.
        scenes: scenes to predict.
        views: (context, target) cameras of each scene.
        others: predictions of other models for each scene.
        clips: largest number of clips for FVD, taken from evenly spaced scenes.
        processes: processes that share the scenes. All must call this function, and all return the same scores, equal
            in bits to those of a single process.
        quiet: hide the progress bar.
    """
    processes, groups = processes or Processes(), [[number] for number in range(len(scenes))]
    if restored is not None:
        groups = _batches(restored, scenes, [context for context, _ in views])
    n_for_fvd = min(len(scenes), max(1, clips // max(len(targets) for _, targets in views)))
    for_fvd = {k * len(scenes) // n_for_fvd for k in range(n_for_fvd)}
    given = {"n_encoded": n_encoded, "n_future": n_future, "methods": methods, "start": start}

    def scored(group: Sequence[int]) -> Iterator[tuple[int, SceneScores]]:
        predictions = [None] * len(group)
        if len(group) > 1:
            together = [scenes[number] for number in group], n_future, [views[number][0] for number in group]
            predictions = predict_together(restored, *together, start=start)
        for number, prediction in zip(group, predictions, strict=True):
            (context, targets), own = views[number], [m for m in metrics if m != "fvd" or number in for_fvd]
            cams = {"context_cams": context, "target_cams": targets, "others": others[number] if others else ()}
            yield number, score_scene(restored, scenes[number], **cams, **given, metrics=own, prediction=prediction)

    scores: dict[int, SceneScores] = {}
    quiet = quiet or not processes.is_first
    with _two_threads(), progress(None, "scenes", len(scenes), unit="scene", quiet=quiet) as bar:
        for first in range(0, len(groups), processes.count):
            mine = first + processes.rank
            try:
                found = [pair for group in groups[mine : mine + 1] for pair in scored(group)]
            except (InputError, NumericalError) as error:  # gathered and raised in all processes, to avoid a deadlock
                found = error
            for share in processes.gather(found):
                if isinstance(share, Exception):
                    raise share
                scores.update(share)
            bar.update(len(scores) - bar.n)
    return [scores[number] for number in range(len(scenes))]


def _batches(restored: Restored, scenes: Sequence[Scene], contexts: Sequence[Sequence[int]]) -> list[list[int]]:
    """Groups consecutive scenes into batches on a GPU, for any number of processes; on a CPU each is its own."""
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
    """Runs torch with at least two threads: with one, as set by torchrun, its convolutions use other kernels."""
    n_threads = torch.get_num_threads()
    torch.set_num_threads(max(2, n_threads))
    try:
        yield
    finally:
        torch.set_num_threads(n_threads)


def _digest(images: Tensor, labels: Tensor | None) -> str:
    """Returns a hash of the true images and labels."""
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
    """Renders the predicted steps with the particles of cloud ``step`` held constant."""
    later = range(prediction.n_encoded, prediction.n_steps)
    if not scene.cameras_move:
        return rendered[step].expand(len(later), *rendered.shape[1:])
    still = prediction.step(step)
    return torch.cat([render_steps(restored, still, scene, cams, start + seen) for seen in later])
