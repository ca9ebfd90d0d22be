"""Measures settings on a benchmark case: first their errors, then their times. A setting may fail."""

import dataclasses
import math
import random
import statistics
import time
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from pathlib import Path

import torch
from torch import Tensor

from gsim3d.cameras import Cameras, Frames
from gsim3d.data import Scene
from gsim3d.dynamics import RestLog
from gsim3d.errors import CaptureError, InputError, NumericalError
from gsim3d.evaluate.metrics import mean_of_counted, psnr
from gsim3d.evaluate.perceptual.fvd import MIN_CLIPS, frechet_distance
from gsim3d.evaluate.protocol import default_views, horizon
from gsim3d.evaluate.report import write_json
from gsim3d.evaluate.scoring import METRICS, PLAIN_METRICS, SceneScores, SceneTruth
from gsim3d.io.files import MAX_TEXT, read_file
from gsim3d.io.machine import machine
from gsim3d.io.plain import parse_json
from gsim3d.io.settings import from_dict
from gsim3d.numerics.speed import Setting
from gsim3d.profile.settings import GROUPS, Group, Runner
from gsim3d.profile.timing import GAPS, DeviceClock, GraphStopwatch, Stopwatch, Timing, medians_of, time_call, watched
from gsim3d.state import DYNAMIC, Particles, last_steps
from gsim3d.train.restore import Restored

MAX_CACHED = 8  # encoded scenes kept in memory
COMPARE, ROUNDS, PRESETS, REST = 0.4, 0.6, 0.8, 0.9  # fractions of the time limit after which each phase starts no more
NO_TIME = "no time left"


@dataclass(frozen=True)
class Effort:
    """Number of measurements."""

    #: passes over all settings, each in a different order; at least 3 separate differences from noise
    n_rounds: int = 3
    repeats: int = 7  #: timed steps and timed encodings in each round
    warm_up: int = 1  #: untimed calls in each round
    n_steps: int | None = None  #: predicted steps that are compared; None: all
    n_scenes: int | None = None  #: scenes that are compared; None: all
    few: bool = False  #: limits each group to its ``Group.few`` settings


QUICK = Effort(n_steps=12, n_scenes=2, few=True)
FULL = Effort(repeats=10, n_scenes=16)


class TimeLimit:
    """A budget of ``seconds`` from now on; None: unlimited."""

    def __init__(self, seconds: float | None = None, now: Callable[[], float] = time.monotonic):
        self._seconds, self._now, self._start = seconds or math.inf, now, now()

    def is_over(self, share: float) -> bool:
        """Whether this fraction of the budget is used."""
        return self._now() - self._start >= share * self._seconds


@dataclass(frozen=True)
class Agreement:
    """Agreement of a setting with the reference run."""

    psnr: float  #: mean PSNR of the images in dB
    #: largest distance of moving particles over all steps, in cells; None if the particle sets differ
    position_max: float | None


@dataclass(eq=False)
class Point:
    """A setting and its measurements."""

    setting: Setting  #: how the simulator runs
    group: str  #: name of its group
    kind: str  #: key of KINDS
    failure: str = ""  #: reason why there is no result, or ""
    agreement: Agreement | None = None  #: agreement with the reference run
    task: dict = field(default_factory=dict)  #: metric -> score against the video: mean over scenes, then over steps
    by_step: dict = field(default_factory=dict)  #: metric -> score at each step
    encode: tuple[Timing, ...] = ()  #: timings of the encoding of the input, one a round
    step: tuple[Timing, ...] = ()  #: timings of one simulated step with its images, one a round
    capture_seconds: float = 0.0  #: seconds of the graph capture before the first step
    peak_bytes: int = 0  #: GPU memory in bytes that a step allocates on top of model and input; 0 on a CPU
    resting_share: float = 0.0  #: fraction of sleeping particles

    @property
    def step_seconds(self) -> float:
        """Median seconds of a step over all rounds."""
        return statistics.median(seconds for timing in self.step for seconds in timing.repeats)

    @property
    def spread(self) -> float:
        """Seconds between the medians of the slowest and fastest round, or of the halves of a single round."""
        parts = [timing.repeats for timing in self.step]
        if len(parts) == 1:
            half = len(parts[0]) // 2
            parts = [part for part in (parts[0][:half], parts[0][half:]) if part]
        medians = [statistics.median(part) for part in parts]
        return max(medians) - min(medians)

    def sections(self) -> dict[str, float]:
        """Section -> seconds of a step: medians over the rounds that recorded sections."""
        return medians_of([timing.sections for timing in self.step if timing.sections])


def tie(a: Point, b: Point) -> bool:
    """Whether the step times of two points differ by less than the spread of their measurements."""
    return abs(a.step_seconds - b.step_seconds) < max(a.spread, b.spread)


def front(points: Sequence[Point], error: Callable[[Point], float | None]) -> list[Point]:
    """Returns the Pareto front of ``points`` in step time and ``error``, sorted by step time.

    Points that failed or have no error (None) are left out.
    """
    best, chosen = math.inf, []
    usable = [p for p in points if not p.failure and error(p) is not None]
    for point in sorted(usable, key=lambda p: (p.step_seconds, error(p))):
        if error(point) < best:
            best = error(point)
            chosen.append(point)
    return chosen


def reason(error: Exception) -> str:
    """The text of a report for the error of a setting."""
    return "out of memory" if isinstance(error, torch.OutOfMemoryError) else str(error)


@dataclass(frozen=True)
class Rollout:
    """A predicted scene of S steps and V views."""

    images: Tensor  #: [S, V, H, W, 3] in [0, 1]
    moving: list[Tensor]  #: S tensors [n, 3], positions of the moving particles
    resting_share: float = 0.0  #: fraction of sleeping particles


class BenchmarkCase:
    """A trained simulator, held-out scenes, and the reference run on them.

    Args:
        restored: trained simulator.
        scenes: scenes with the same cameras.
        n_steps: predicted steps; None: to the end of the shortest video.
        metrics: scores against the video, from :func:`gsim3d.evaluate.scoring.measurable`.

    Attributes:
        not_measured: metric -> reason why it has no value.

    Raises:
        InputError: scenes do not fit the model.
    """

    def __init__(
        self,
        restored: Restored,
        scenes: Sequence[Scene],
        n_steps: int | None = None,
        metrics: Sequence[str] = PLAIN_METRICS,
    ):
        self.restored, self.scenes, self.metrics = restored, list(scenes), tuple(metrics)
        self.first, self.device = restored.data.history, restored.device
        for scene in self.scenes:
            restored.check_scene(scene)
        self.views = [default_views(restored, scene) for scene in self.scenes]
        self.n_steps = min(horizon(scene, self.first, None) for scene in self.scenes)
        self.n_steps = min(self.n_steps, n_steps or self.n_steps)
        self.not_measured: dict[str, str] = {}
        self._runners: dict[Setting, Runner] = {}
        self._encoded = lru_cache(MAX_CACHED)(self._encode)

    def runner(self, setting: Setting = Setting()) -> Runner:
        """Returns the cached simulator of ``setting``."""
        if setting not in self._runners:
            self._runners[setting] = Runner(self.restored, setting)
        return self._runners[setting]

    def frames(self, runner: Runner, numbers: Sequence[int]) -> Frames:
        """Input frames of the scenes with these indices."""
        return runner.frames([self.scenes[n] for n in numbers], [self.views[n][0] for n in numbers])

    def start(self, runner: Runner, numbers: Sequence[int]) -> Particles:
        """Initial state of the scenes for ``runner``. Recent encodings of single scenes are cached."""
        if len(numbers) > 1:
            return runner.subsampled(runner.encode(self.frames(runner, numbers)))
        return runner.subsampled(self._encoded(runner.setting.of_input, numbers[0]))

    def _encode(self, given: Setting, number: int) -> Particles:
        runner = self.runner(given)
        return runner.encode(self.frames(runner, [number]))

    def cameras(self, numbers: Sequence[int], step: int) -> Cameras:
        """Target cameras of the scenes at predicted step ``step`` (from 0)."""
        parts = [self.scenes[n].cameras_at(list(self.views[n][1]), [self.first + step]) for n in numbers]
        names = ("viewmats", "Ks", "near", "far")
        tensors = {name: torch.cat([getattr(part, name) for part in parts]) for name in names}
        clouds = torch.cat([part.image_cloud + cloud for cloud, part in enumerate(parts)])
        return dataclasses.replace(parts[0], image_cloud=clouds, **tensors).to(self.device)

    def predict(self, setting: Setting, number: int) -> Rollout:
        """Predicts all steps of one scene.

        Raises:
            NumericalError: particles or images are not finite.
            InputError: the model does not support the setting.
        """
        runner, log = self.runner(setting), RestLog()
        images, moving = [], []
        for step, newest in enumerate(runner.steps(self.start(runner, [number]), self.n_steps, log)):
            if not newest.means.isfinite().all():
                raise NumericalError(f"particles are not finite at step {step + 1}")
            image = runner.images(newest, self.cameras([number], step))
            if not image.isfinite().all():
                raise NumericalError(f"images are not finite at step {step + 1}")
            images.append(image)
            moving.append(newest.means[newest.activity == DYNAMIC])
        return Rollout(torch.stack(images), moving, log.resting_share)

    def newest(self, number: int) -> Particles:
        """Particles of the last encoded step of a scene in the reference run."""
        return last_steps(self.start(self.runner(), [number]), 1)

    @cached_property
    def reference(self) -> list[Rollout]:
        """Reference rollout of each scene."""
        return [self.predict(Setting(), number) for number in range(len(self.scenes))]

    @cached_property
    def truths(self) -> list[SceneTruth]:
        """Ground truth of each scene."""
        found, steps = [], range(self.first, self.first + self.n_steps)
        for scene, (_, targets) in zip(self.scenes, self.views, strict=True):
            images = scene.images(list(targets), steps).permute(0, 1, 3, 4, 2).to(self.device).float() / 255
            labels = scene.segmentation(list(targets), steps).to(self.device) if scene.has_segmentation() else None
            valid = scene.valid(list(targets), steps)
            valid = None if valid is None else valid.to(self.device)
            found.append(SceneTruth(scene.name, images, labels, valid, 0, self.metrics))
            self.not_measured |= found[-1].not_measured
        return found

    @cached_property
    def constant(self) -> dict[str, list[float | None]]:
        """Metric -> score at each step of the constant baseline, which repeats the last encoded particles."""
        runner, scores = self.runner(), []
        for number, truth in enumerate(self.truths):
            newest = self.newest(number)
            images = [runner.images(newest, self.cameras([number], step)) for step in range(self.n_steps)]
            scores.append(truth.score([("", torch.stack(images))]))
        return _means(scores)[1]

    def compare(self, point: Point) -> None:
        """Sets the errors of ``point`` against the reference and the video, or its ``failure``."""
        cell = self.restored.simulator.config.dynamics.grid_size
        scores, differences, distances, resting = [], [], [], []
        try:
            for number, (reference, truth) in enumerate(zip(self.reference, self.truths, strict=True)):
                found = reference if point.setting == Setting() else self.predict(point.setting, number)
                differences.append(psnr(found.images.flatten(0, 1), reference.images.flatten(0, 1)).cpu())
                distances.append(_distances(found, reference, cell))
                scores.append(truth.score([("", found.images)]))
                resting.append(found.resting_share)
        except (torch.OutOfMemoryError, NumericalError, InputError) as error:
            point.failure = reason(error)
            return
        images, largest = torch.cat(differences), None
        if all(distance is not None for distance in distances) and len(positions := torch.cat(distances)):
            largest = float(positions.max())
        point.agreement = Agreement(float(images.mean()), largest)
        point.task, point.by_step = _means(scores)
        point.resting_share = statistics.fmean(resting)

    @property
    def metric(self) -> str:
        """Metric of the gain: "psnr_masked" if the scenes have masks, else "psnr"."""
        return "psnr_masked" if "psnr_masked" in self.constant else "psnr"

    def gain(self, point: Point) -> float | None:
        """PSNR above the constant baseline in dB, mean over steps."""
        pairs = zip(point.by_step[self.metric], self.constant[self.metric], strict=True)
        gains = [ours - constant for ours, constant in pairs if ours is not None and constant is not None]
        return statistics.fmean(gains) if gains else None

    def share_kept(self, point: Point, reference: Point) -> float | None:
        """Fraction of the gain of ``reference`` that ``point`` retains; None if there is no gain to compare."""
        if not point.by_step or not reference.by_step:
            return None
        whole, kept = self.gain(reference), self.gain(point)
        return None if not whole or kept is None else 1 - (whole - kept) / abs(whole)


def _distances(found: Rollout, reference: Rollout, cell: float) -> Tensor | None:
    """Distances of moving particles between two rollouts, in cells [S * n], or None if the particle sets differ."""
    pairs = list(zip(found.moving, reference.moving, strict=True))
    if any(a.shape != b.shape for a, b in pairs):
        return None
    return torch.cat([(a - b).double().norm(dim=1) / cell for a, b in pairs]).cpu()


def _means(scores: Sequence[SceneScores]) -> tuple[dict[str, float | None], dict[str, list[float | None]]]:
    """Scores averaged over scenes and steps (FVD: over all clips), and scores averaged over scenes at each step."""
    values = [score.values[""] for score in scores]
    by_step = {name: torch.stack([s[name] for s in values]).nanmean(0) for name in values[0] if METRICS[name].by_step}
    whole = {name: mean_of_counted(steps) for name, steps in by_step.items()}
    clips = [torch.cat([score.clips[of] for score in scores]) for of in ("truth", "") if scores[0].clips]
    if clips and len(clips[0]) >= MIN_CLIPS:
        whole["fvd"] = frechet_distance(*clips)
    return whole, {name: [None if v != v else v for v in steps.tolist()] for name, steps in by_step.items()}


class Stepping:
    """A callable that simulates and renders ``span`` steps from the same initial state.

    Args:
        case: simulator and scenes.
        setting: how to run it; ``setting.captured`` captures a CUDA graph here.
        clock: clock of the device.
        numbers: indices of the scenes of the batch.
        span: steps a call; None: :meth:`Runner.span`.
        stopwatch: records the sections of every call; a GraphStopwatch is captured into the graph.

    Attributes:
        capture_seconds: seconds of the capture.

    Raises:
        CaptureError: the graph cannot be captured.
        InputError: the model does not support the setting.
    """

    def __init__(
        self,
        case: BenchmarkCase,
        setting: Setting,
        clock: DeviceClock,
        numbers: Sequence[int] = (0,),
        span: int | None = None,
        stopwatch: Stopwatch | None = None,
    ):
        self.runner = case.runner(setting)
        self.state, self.cameras = case.start(self.runner, numbers), case.cameras(numbers, 0)
        self.span = self.runner.span(case.n_steps) if span is None else span
        self.capture_seconds, self._graph, self._stopwatch = 0.0, None, stopwatch
        if setting.captured:
            clock.wait()
            start = clock.now()
            marked = isinstance(stopwatch, GraphStopwatch)
            with watched(self.runner.simulator, stopwatch) if marked else nullcontext():
                with stopwatch.capturing() if marked else nullcontext():
                    self._graph = self.runner.captured(self.state, self.span, self.cameras)
            clock.wait()
            self.capture_seconds = clock.now() - start

    def __call__(self) -> None:
        if self._stopwatch is None:
            return self._run()
        with watched(self.runner.simulator, self._stopwatch), self._stopwatch.running():
            self._run()

    def _run(self) -> None:
        replays = self._graph is not None
        steps = self._graph(self.state).steps if replays else self.runner.steps(self.state, self.span)
        if not (replays and self.runner.draws_in_graph):
            for newest in steps:
                self.runner.images(newest, self.cameras)


class Sweep:
    """Measures settings on a case: first the errors of all settings, then the times of those that did not fail.

    Args:
        case: simulator and scenes.
        effort: number of measurements.
        limit: time budget. If it runs short, settings and rounds are skipped; every compared setting gets one round.
        progress: called with a description of each measurement.
        file: JSON file of the results, from which an interrupted sweep continues; None: results are not saved.
    """

    def __init__(
        self,
        case: BenchmarkCase,
        effort: Effort = Effort(),
        limit: TimeLimit | None = None,
        progress: Callable[[str], None] = lambda doing: None,
        file: Path | None = None,
    ):
        self.case, self.effort, self.limit, self.progress = case, effort, limit or TimeLimit(), progress
        self.clock = DeviceClock(case.device)
        self._file, self._graphs = file, {}
        self._points = self._load() if file is not None and file.is_file() else {}

    def points(self, groups: Sequence[Group] = GROUPS) -> tuple[list[Point], dict[str, str]]:
        """Returns points of the reference and all settings of ``groups``, and group -> requirement of empty groups."""
        points, missing = [self.point(Setting(), "reference", "exact")], {}
        for group in groups:
            found = group.settings(self.case)
            if not found:
                missing[group.name] = group.needs
            if self.effort.few and len(found) > group.few:
                apart = (len(found) - 1) / max(1, group.few - 1)
                found = [found[-1 - int(n * apart)] for n in reversed(range(group.few))]
            for setting in found:
                if self.case.device.type == "cuda" and setting.sleep is None:  # sleep needs a sync
                    setting = dataclasses.replace(setting, captured=True)
                points.append(self.point(setting, group.name, group.kind))
        return points, missing

    def point(self, setting: Setting, group: str, kind: str) -> Point:
        """Returns the point of ``setting``, with its earlier measurements."""
        return self._points.setdefault(setting, Point(setting, group, kind))

    def run(self, points: Sequence[Point]) -> None:
        """Measures ``points`` in place."""
        for point in sorted(points, key=lambda p: repr(p.setting.of_input) != repr(Setting())):
            self.progress(f"errors: {point.setting.name}")
            if point.agreement is None and not point.failure:
                if self.limit.is_over(COMPARE) and point.setting != Setting():
                    point.failure = NO_TIME
                    continue
                self.case.compare(point)
                self._save()
                if point.failure and point.setting == Setting():
                    return
        for n in range(self.effort.n_rounds):
            if n and self.limit.is_over(ROUNDS):
                break
            order = list(points)
            random.Random(n).shuffle(order)
            for point in order:
                self.progress(f"timing, round {n + 1}: {point.setting.name}")
                if point.failure or len(point.step) > n:
                    continue
                try:
                    point.step += (self._timing(point),)
                except (torch.OutOfMemoryError, CaptureError, InputError) as error:
                    point.failure = f"timing: {reason(error)}"
            self._time_inputs([point for point in points if not point.failure and len(point.encode) <= n])
            self._save()

    def _time_inputs(self, points: Sequence[Point]) -> None:
        """Times one round of encodings; settings with equal inputs share a timing."""
        for given in dict.fromkeys(point.setting.of_input for point in points):
            runner = self.case.runner(given)
            frames = self.case.frames(runner, [0])
            repeats = self.effort.repeats if given == Setting() else 1 + self.effort.repeats // 3
            timing = time_call(lambda: runner.encode(frames), self.clock, repeats, self.effort.warm_up)
            for point in points:
                if point.setting.of_input == given:
                    point.encode += (timing,)

    def _timing(self, point: Point) -> Timing:
        case, setting, effort = self.case, point.setting, self.effort
        if case.device.type == "cpu":
            stopwatch = Stopwatch(self.clock)
            stepping = Stepping(case, setting, self.clock, stopwatch=stopwatch)
            repeats = max(2, math.ceil(effort.repeats / stepping.span))
            timing = time_call(stepping, self.clock, repeats, effort.warm_up, lambda: stopwatch.seconds)
            return timing.split_over(stepping.span)
        free, total = torch.cuda.mem_get_info(case.device)
        if free < total / 2:
            self._graphs.clear()
        torch.cuda.reset_peak_memory_stats(case.device)
        before = torch.cuda.memory_allocated(case.device)
        stepping = self._graphs.get(setting) or Stepping(case, setting, self.clock)
        if setting.captured:
            self._graphs[setting], point.capture_seconds = stepping, point.capture_seconds or stepping.capture_seconds
        timing = time_call(stepping, self.clock, effort.repeats, effort.warm_up)
        point.peak_bytes = max(point.peak_bytes, torch.cuda.max_memory_allocated(case.device) - before)
        if not point.step and setting.sleep is None:
            timing = Timing(timing.repeats, self.sections_of_graph(setting, timing))
        return timing.split_over(stepping.span)

    def sections_of_graph(self, setting: Setting, timing: Timing) -> dict[str, float]:
        """Section -> median seconds of a call, measured on a separate graph with events.

        If ``timing`` is of a setting without a graph, the time above the sum of sections counts as GAPS.
        """
        stopwatch, span = GraphStopwatch(self.clock), self.case.runner(setting).span(self.case.n_steps)
        captured = dataclasses.replace(setting, captured=True)
        try:
            marked = Stepping(self.case, captured, self.clock, span=span, stopwatch=stopwatch)
        except (CaptureError, InputError):
            return {}
        sections = time_call(marked, self.clock, len(timing.repeats), 1, lambda: stopwatch.seconds).sections
        if not setting.captured:
            sections[GAPS] = max(0.0, timing.median - sum(sections.values()))
        return sections

    def throughput(self, point: Point, n_scenes: int) -> dict:
        """Simulated steps a second of a batch of ``n_scenes`` with images, or the problem of the measurement."""
        setting, found = point.setting, {"setting": point.setting.name, "scenes": n_scenes, "steps_a_second": None}
        numbers = [n % len(self.case.scenes) for n in range(n_scenes)]
        try:
            stepping = Stepping(self.case, setting, self.clock, numbers, None if setting.captured else 1)
            timing = time_call(stepping, self.clock, self.effort.repeats, self.effort.warm_up)
        except (torch.OutOfMemoryError, CaptureError, InputError) as error:
            return found | {"problem": reason(error)}
        return found | {"steps_a_second": n_scenes * stepping.span / timing.median, "problem": ""}

    def _conditions(self) -> dict:
        """Facts that must be equal for saved measurements to be reused."""
        case, facts = self.case, machine(self.case.device)
        names = ("device", "processor", "sources", "torch")
        return {
            "checkpoint": case.restored.checkpoint.digest,
            "scenes": [str(scene.path) for scene in case.scenes],
            "steps": case.n_steps,
            "metrics": list(case.metrics),
            "effort": dataclasses.asdict(self.effort),
            **{name: facts[name] for name in names if name in facts},
        }

    def _save(self) -> None:
        if self._file is not None:
            points = [dataclasses.asdict(p) for p in self._points.values() if p.failure != NO_TIME]
            write_json(self._file, {**self._conditions(), "points": points})

    def _load(self) -> dict[Setting, Point]:
        try:
            content = parse_json(read_file(self._file, MAX_TEXT))
            points = [from_dict(Point, values, f"{self._file}: ") for values in content.pop("points")]
        except (ValueError, AttributeError, KeyError, TypeError):  # written by another version
            return {}
        return {point.setting: point for point in points} if content == self._conditions() else {}
