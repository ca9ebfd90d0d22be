"""Error and time of a simulator under many settings: one point each, failures included."""

from __future__ import annotations

import dataclasses
import random
import statistics
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import torch
from torch import Tensor

from gsim3d.data import Scene
from gsim3d.data.recording import BACKGROUND
from gsim3d.errors import HardCaseError, InputError
from gsim3d.evaluate.metrics import PSNR_CAP, SSIM_WINDOW, mean_of_counted, psnr, ssim
from gsim3d.evaluate.protocol import default_views, horizon
from gsim3d.pareto.runner import Runner
from gsim3d.pareto.settings import KNOBS, Knob, Setting
from gsim3d.pareto.timing import Clock, Timing, peak_memory, time_call, time_stages
from gsim3d.train.restore import Restored
from gsim3d.types import DYNAMIC, Cameras, Particles


@dataclass(frozen=True)
class Effort:
    """How long to measure.

    n_rounds: times that all settings are gone through, each in another order; at least 3 say how far two medians of the
        same thing are apart.   repeats: of a call in each round.   n_steps: of the rollout that is compared.
    n_scenes: that are compared.
    """

    n_rounds: int = 3
    repeats: int = 7
    n_steps: int | None = None
    n_scenes: int | None = None
    warm_up: int = 1


QUICK, FULL = Effort(n_steps=12, n_scenes=2), Effort(repeats=10, n_scenes=16)


@dataclass(frozen=True)
class Agreement:
    """With the reference run. psnr, psnr_worst: dB, of the rendered steps, mean and worst image.

    position_mean, position_max: of what may move, in cells, over all steps; None where the particles are others.
    """

    psnr: float
    psnr_worst: float
    position_mean: float | None
    position_max: float | None


@dataclass(eq=False)
class Point:
    """One setting. Times in seconds: ``encode`` of the input, ``step`` of one simulated step and its images.

    failure: why there is nothing else, or "".   task: metric -> mean over steps of the mean over scenes, against the truth.
    by_step: metric -> a value for each rendered step.   once: seconds before the first step (capture).
    peak: bytes, of the GPU; of the process, so far, on a CPU.
    """

    setting: Setting
    knob: str
    kind: str
    failure: str = ""
    agreement: Agreement | None = None
    task: dict[str, float | None] = field(default_factory=dict)
    by_step: dict[str, list[float | None]] = field(default_factory=dict)
    encode: list[Timing] = field(default_factory=list)
    step: list[Timing] = field(default_factory=list)
    once: float = 0.0
    peak: int = 0

    @property
    def step_seconds(self) -> float:
        return median_of(self.step)

    @property
    def spread(self) -> float:
        """Seconds between the slowest and the fastest round."""
        medians = [timing.median for timing in self.step]
        return max(medians) - min(medians)

    def stages(self) -> dict[str, float]:
        """Seconds of a step, by stage: medians over rounds."""
        names = dict.fromkeys(name for timing in self.step for name in timing.stages)
        return {name: statistics.median(timing.stages.get(name, 0.0) for timing in self.step) for name in names}


def median_of(timings: Sequence[Timing]) -> float:
    return statistics.median(seconds for timing in timings for seconds in timing.repeats)


class Subject:
    """What is measured: a simulator, and scenes that it has not seen.

    Args:
        scenes: with the same cameras.
        n_steps: to predict; default to the end of the shortest film.
    """

    def __init__(self, restored: Restored, scenes: Sequence[Scene], n_steps: int | None = None):
        self.restored, self.scenes = restored, list(scenes)
        for scene in self.scenes:
            restored.check_scene(scene)
        self.views = [default_views(restored, scene) for scene in self.scenes]
        n_given = restored.data.history
        self.n_steps = min(horizon(scene, n_given, None) for scene in self.scenes)
        self.n_steps = min(self.n_steps, n_steps or self.n_steps)
        self.first = n_given

    def runner(self, setting: Setting = Setting()) -> Runner:
        return Runner(self.restored, setting)

    def start(self, runner: Runner, number: int) -> Particles:
        """The encoded state of scene ``number``."""
        return runner.encode(runner.frames([self.scenes[number]], [self.views[number][0]]))

    def cameras(self, number: int, step: int) -> Cameras:
        """The target views of scene ``number`` at predicted step ``step``, counted from 0."""
        scene, (_, targets) = self.scenes[number], self.views[number]
        return scene.cameras_at(list(targets), [self.first + step]).to(self.restored.device)

    def cameras_of(self, numbers: Sequence[int], step: int) -> Cameras:
        """The target views of several scenes, cloud after cloud."""
        parts = [self.cameras(number, step) for number in numbers]
        tensors = {
            name: torch.cat([getattr(part, name) for part in parts]) for name in ("viewmats", "Ks", "near", "far")
        }
        clouds = torch.cat([part.image_cloud + cloud for cloud, part in enumerate(parts)])
        return dataclasses.replace(parts[0], image_cloud=clouds, **tensors)

    def truth(self, number: int, steps: Sequence[int]) -> tuple[Tensor, Tensor | None]:
        """([S, V, H, W, 3] in [0, 1], bool [S, V, H, W] of what is no background) of predicted steps."""
        scene, targets = self.scenes[number], list(self.views[number][1])
        filmed = [self.first + step for step in steps]
        images = scene.images(targets, filmed).permute(0, 1, 3, 4, 2).to(self.restored.device).float() / 255
        if not scene.has_segmentation():
            return images, None
        return images, (scene.segmentation(targets, filmed) != BACKGROUND).to(self.restored.device)


@dataclass(frozen=True)
class Predicted:
    """Of one scene: images of each rendered step [S, V, H, W, 3], and what may move of every step: places [n, 3]."""

    steps: tuple[int, ...]
    images: Tensor
    moving: list[Tensor]


class Unusable(Exception):
    """A setting has no result; the message says why."""


def predict(subject: Subject, runner: Runner, number: int) -> Predicted:
    """The whole horizon of one scene.

    Raises:
        Unusable: memory ran out, or a number is not finite; the message names the step.
    """
    step, scene = 0, subject.scenes[number]
    steps, images, moving = [], [], []
    try:
        state = subject.start(runner, number)
        for step in range(subject.n_steps):
            state = runner.step(state)
            newest = runner.newest(state)
            moving.append(newest.means[newest.activity == DYNAMIC])
            if not newest.means.isfinite().all():
                raise Unusable(f"particles are not finite at step {step + 1}")
            if step % runner.setting.every:
                continue
            image = runner.enlarged(runner.images(newest, subject.cameras(number, step)), scene.height, scene.width)
            if not image.isfinite().all():
                raise Unusable(f"images are not finite at step {step + 1}")
            steps.append(step)
            images.append(image)
    except torch.OutOfMemoryError:
        raise Unusable(f"out of memory at step {step + 1}") from None
    except (HardCaseError, InputError) as error:
        raise Unusable(f"step {step + 1}: {error}") from None
    return Predicted(tuple(steps), torch.stack(images), moving)


class Comparison:
    """Compares settings with the reference and with the truth; the reference's own predictions are made once."""

    def __init__(self, subject: Subject):
        self.subject = subject

    @cached_property
    def reference(self) -> list[Predicted]:
        runner = self.subject.runner()
        return [predict(self.subject, runner, number) for number in range(len(self.subject.scenes))]

    @cached_property
    def constant(self) -> dict[str, list[float | None]]:
        """Scores by step of the last encoded particles, held still."""
        subject, runner, scores = self.subject, self.subject.runner(), []
        for number in range(len(subject.scenes)):
            newest = runner.newest(subject.start(runner, number))
            steps = range(subject.n_steps)
            images = torch.stack([runner.images(newest, subject.cameras(number, step)) for step in steps])
            scores.append(self._scores(number, Predicted(tuple(steps), images, [])))
        return _mean_over(scores)[1]

    def of(self, setting: Setting) -> tuple[Agreement, dict, dict]:
        """(agreement, task error, task error by step) of one setting. Raises Unusable."""
        subject, runner = self.subject, self.subject.runner(setting)
        differences, distances, scores = [], [], []
        for number, reference in enumerate(self.reference):
            predicted = predict(subject, runner, number)
            differences.append(_psnr(predicted.images, reference.images[list(predicted.steps)]))
            distances.append(_distances(predicted, reference, subject.restored.simulator.config.dynamics.grid_size))
            scores.append(self._scores(number, predicted))
        images = torch.cat(differences)
        known = all(distance is not None for distance in distances)
        apart = torch.cat(distances) if known else torch.zeros(0)
        agreement = Agreement(
            float(images.mean()),
            float(images.min()),
            float(apart.mean()) if len(apart) else None,
            float(apart.max()) if len(apart) else None,
        )
        return agreement, *_mean_over(scores)

    def gain(self, by_step: dict[str, list[float | None]], every: int = 1) -> float | None:
        """How many dB better than the constant baseline at the rendered steps, without the background where it is known."""
        metric = "psnr_masked" if "psnr_masked" in self.constant else "psnr"
        pairs = zip(by_step[metric], self.constant[metric][::every], strict=True)
        gains = [ours - constant for ours, constant in pairs if ours is not None and constant is not None]
        return statistics.fmean(gains) if gains else None

    def _scores(self, number: int, predicted: Predicted) -> dict[str, Tensor]:
        """metric -> [S], means over views."""
        truth, counted = self.subject.truth(number, predicted.steps)
        shape = predicted.images.shape[:2]
        a, b = predicted.images.flatten(0, 1), truth.flatten(0, 1)
        scores = {"psnr": psnr(a, b)}
        if counted is not None:
            scores["psnr_masked"] = psnr(a, b, counted.flatten(0, 1))
        if min(a.shape[1:3]) >= SSIM_WINDOW:
            scores["ssim"] = ssim(a, b)
        return {name: values.reshape(shape).nanmean(1).cpu() for name, values in scores.items()}


def _psnr(images: Tensor, reference: Tensor) -> Tensor:
    return psnr(images.flatten(0, 1), reference.flatten(0, 1)).cpu()


def _distances(predicted: Predicted, reference: Predicted, cell: float) -> Tensor | None:
    """Of every moving particle at every step, in cells; None where the two have other particles."""
    if any(a.shape != b.shape for a, b in zip(predicted.moving, reference.moving, strict=True)):
        return None
    pairs = zip(predicted.moving, reference.moving, strict=True)
    return torch.cat([(a - b).double().norm(dim=1) / cell for a, b in pairs]).cpu()


def _mean_over(scores: list[dict[str, Tensor]]) -> tuple[dict[str, float | None], dict[str, list[float | None]]]:
    """Means over scenes, then over steps; and means over scenes by step."""
    by_step = {name: torch.stack([s[name] for s in scores]).nanmean(0) for name in scores[0]}
    whole = {name: mean_of_counted(values) for name, values in by_step.items()}
    return whole, {name: [None if v != v else v for v in values.tolist()] for name, values in by_step.items()}


def points_of(restored: Restored, knobs: Sequence[Knob] = KNOBS) -> list[Point]:
    """The reference, and every turn of every knob that this simulator has here."""
    points = [Point(Setting(), "reference", "exact")]
    for knob in knobs:
        points += [Point(setting, knob.name, knob.kind) for setting in knob.turns(restored, restored.device)]
    return points


def compare(
    comparison: Comparison, points: Sequence[Point], progress: Callable[[str], None] = lambda doing: None
) -> None:
    """Fills in what ``points`` get wrong, or why they have no result."""
    for point in points:
        progress(f"error: {point.setting.name}")
        try:
            point.agreement, point.task, point.by_step = comparison.of(point.setting)
        except Unusable as problem:
            point.failure = str(problem)


def time_points(
    subject: Subject,
    points: Sequence[Point],
    clock: Clock,
    effort: Effort,
    seed: int = 0,
    progress: Callable[[str], None] = lambda doing: None,
) -> None:
    """Fills in what ``points`` without failure cost, in rounds, each in another order."""
    for n in range(effort.n_rounds):
        order = list(points)
        random.Random(seed + n).shuffle(order)
        for point in order:
            progress(f"time, round {n + 1}: {point.setting.name}")
            if not point.failure:
                try:
                    _time(subject, point, clock, effort)
                except torch.OutOfMemoryError:
                    point.failure = "out of memory while timed"


def _time(subject: Subject, point: Point, clock: Clock, effort: Effort) -> None:
    """One round of one point."""
    runner, cameras = subject.runner(point.setting), subject.cameras(0, 0)
    frames = runner.frames(subject.scenes[:1], [subject.views[0][0]])
    options = {"repeats": effort.repeats, "warm_up": effort.warm_up}
    with peak_memory(subject.restored.device) as peak:
        point.encode.append(time_call(lambda: runner.encode(frames), clock, **options))
        state, every = runner.encode(frames), point.setting.every

        def call() -> None:
            for n in range(every):
                newest = runner.newest(runner.step(state))
                if n == 0:
                    runner.images(newest, cameras)

        if point.setting.captured:
            point.step.append(_time_graph(subject, point, runner, frames, clock, effort))
        else:
            timing = time_stages(call, [runner.simulator], clock, **options)
            point.step.append(
                Timing(
                    tuple(seconds / every for seconds in timing.repeats),
                    {name: seconds / every for name, seconds in timing.stages.items()},
                )
            )
        point.peak = max(point.peak, peak())


def _time_graph(subject: Subject, point: Point, runner: Runner, frames, clock: Clock, effort: Effort) -> Timing:
    n_steps = min(subject.n_steps, 4)
    state, cameras = runner.encode(frames), subject.cameras(0, 0)
    clock.wait()
    start = clock.now()
    captured = runner.captured(state, n_steps, cameras)
    clock.wait()
    point.once = clock.now() - start
    timing = time_call(lambda: captured(state), clock, effort.repeats, effort.warm_up)
    return dataclasses.replace(timing, repeats=tuple(seconds / n_steps for seconds in timing.repeats))


def front(points: Sequence[Point], error: Callable[[Point], float | None]) -> list[Point]:
    """Those that no other point beats in both time and error, fastest first."""
    best, chosen = float("inf"), []
    usable = [p for p in points if not p.failure and error(p) is not None]
    for point in sorted(usable, key=lambda p: (p.step_seconds, error(p))):
        if error(point) < best:
            best = error(point)
            chosen.append(point)
    return chosen


def disagreement(point: Point) -> float | None:
    """Root mean squared error of images against the reference's, from the agreement's PSNR; of equal images 1e-5."""
    return None if point.agreement is None else 10 ** (-min(point.agreement.psnr, PSNR_CAP) / 20)


def ties(a: Point, b: Point) -> bool:
    """Whether the times of two points are nearer than two measurements of one thing."""
    return abs(a.step_seconds - b.step_seconds) < max(a.spread, b.spread)
