"""Runs settings on a benchmark case: first how wrong each is, then what it costs. Failures are results too."""

from __future__ import annotations

import dataclasses
import math
import random
import statistics
import time
from collections import OrderedDict
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import torch
from torch import Tensor

from gsim3d.cameras import Cameras, Frames
from gsim3d.data import Scene
from gsim3d.dynamics import RestLog, last_steps
from gsim3d.errors import CaptureError, InputError, NumericalError
from gsim3d.evaluate.metrics import PSNR_CAP, mean_of_counted, psnr
from gsim3d.evaluate.perceptual.fvd import MIN_CLIPS, frechet_distance
from gsim3d.evaluate.protocol import default_views, horizon
from gsim3d.evaluate.report import write_json
from gsim3d.evaluate.scoring import METRICS, PLAIN_METRICS, SceneScores, SceneTruth
from gsim3d.io.files import MAX_TEXT, read_file
from gsim3d.io.plain import parse_json
from gsim3d.io.settings import from_dict
from gsim3d.numerics.speed import Setting
from gsim3d.profile.settings import GROUPS, Group, Runner
from gsim3d.profile.timing import (
    GAPS,
    SECTIONS,
    DeviceClock,
    GraphStopwatch,
    Stopwatch,
    Timing,
    machine,
    medians_of,
    time_call,
    watched,
)  # fmt: skip
from gsim3d.state import DYNAMIC, Particles
from gsim3d.train.restore import Restored

MOST_KEPT = 8  # encoded scenes
COMPARE, ROUNDS, PRESETS, REST = 0.4, 0.6, 0.8, 0.9  # shares of a time limit after which no more of a part is begun
NO_TIME = "no time left"


# ---- what is measured, and how long ----


@dataclass(frozen=True)
class Effort:
    """How long to measure.

    Attributes:
        n_rounds: times that all settings are timed, each in another order; at least 3 tell differences from noise.
        repeats: steps that are timed in each round, and encodings of the input.
        warm_up: calls in each round that do not count.
        n_steps, n_scenes: of the rollouts that are compared; None: all.
        few: whether groups take as few settings as they say.
    """

    n_rounds: int = 3
    repeats: int = 7
    warm_up: int = 1
    n_steps: int | None = None
    n_scenes: int | None = None
    few: bool = False


QUICK = Effort(n_steps=12, n_scenes=2, few=True)
FULL = Effort(repeats=10, n_scenes=16)


class TimeLimit:
    """Seconds that may be used from now on; None: as many as it takes."""

    def __init__(self, seconds: float | None = None, now: Callable[[], float] = time.monotonic):
        self._seconds, self._now, self._start = seconds or math.inf, now, now()

    def is_over(self, share: float) -> bool:
        """Whether ``share`` of the time is used."""
        return self._now() - self._start >= share * self._seconds


@dataclass(frozen=True)
class Agreement:
    """How near a setting is to the reference run.

    Attributes:
        psnr, psnr_worst: dB of the images, mean and worst.
        position_mean, position_max: of moving particles, in cells, over all steps; None where they are others.
    """

    psnr: float
    psnr_worst: float
    position_mean: float | None
    position_max: float | None


@dataclass(eq=False)
class Point:
    """One setting and all that was measured of it.

    Attributes:
        setting: how the simulator is run.
        group, kind: of the setting.
        failure: why there is no result; "" where there is one.
        agreement: with the reference.
        task: metric -> error against the video, the mean over steps of the mean over scenes.
        by_step: metric -> its value at each step.
        encode, step: timings of the input's encoding, and of one simulated step and its images; one a round.
        once: seconds before the first step (capture of a graph).
        peak: bytes of the GPU that a step takes beside the model and its input; 0 on a CPU.
        resting: share of the particles that slept.
    """

    setting: Setting
    group: str
    kind: str
    failure: str = ""
    agreement: Agreement | None = None
    task: dict = field(default_factory=dict)
    by_step: dict = field(default_factory=dict)
    encode: tuple[Timing, ...] = ()
    step: tuple[Timing, ...] = ()
    once: float = 0.0
    peak: int = 0
    resting: float = 0.0

    @property
    def step_seconds(self) -> float:
        """The median over all rounds."""
        return statistics.median(seconds for timing in self.step for seconds in timing.repeats)

    @property
    def spread(self) -> float:
        """Seconds by which two measurements of it differ: its slowest and its fastest round, or halves of a round."""
        parts = [timing.repeats for timing in self.step]
        if len(parts) == 1:
            half = len(parts[0]) // 2
            parts = [part for part in (parts[0][:half], parts[0][half:]) if part]
        medians = [statistics.median(part) for part in parts]
        return max(medians) - min(medians)

    def sections(self) -> dict[str, float]:
        """Seconds of a step by section: medians over rounds in which they were watched."""
        return medians_of([timing.sections for timing in self.step if timing.sections])


def tie(a: Point, b: Point) -> bool:
    """Whether the times of two points are nearer than two measurements of one thing."""
    return abs(a.step_seconds - b.step_seconds) < max(a.spread, b.spread)


def front(points: Sequence[Point], error: Callable[[Point], float | None]) -> list[Point]:
    """Those that no other point beats in both time and error, fastest first."""
    best, chosen = math.inf, []
    usable = [p for p in points if not p.failure and error(p) is not None]
    for point in sorted(usable, key=lambda p: (p.step_seconds, error(p))):
        if error(point) < best:
            best = error(point)
            chosen.append(point)
    return chosen


def disagreement(point: Point) -> float | None:
    """Root mean squared error of images against the reference's, from the agreement's PSNR."""
    return None if point.agreement is None else 10 ** (-min(point.agreement.psnr, PSNR_CAP) / 20)


# ---- the case ----


class Failed(Exception):
    """A setting has no result; the message says why."""


@dataclass(frozen=True)
class Rollout:
    """One predicted scene.

    Attributes:
        images: of each step [S, V, H, W, 3].
        moving: positions of moving particles at each step [n, 3].
        resting: share of the particles that slept.
    """

    images: Tensor
    moving: list[Tensor]
    resting: float = 0.0


class BenchmarkCase:
    """A trained simulator, scenes that it has not seen, and its reference run on them.

    Args:
        restored: the simulator.
        scenes: with the same cameras.
        n_steps: to predict; default to the end of the shortest video.
        metrics: of the error against the video, as :func:`gsim3d.evaluate.scoring.measurable` gives them.
    Raises:
        InputError: scenes do not fit the model.

    Attributes:
        not_measured: metric -> why it has no value.
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
        self._encoded: OrderedDict[tuple[Setting, int], Particles] = OrderedDict()

    def runner(self, setting: Setting = Setting()) -> Runner:
        """The simulator under ``setting``, made once."""
        if setting not in self._runners:
            self._runners[setting] = Runner(self.restored, setting)
        return self._runners[setting]

    def frames(self, runner: Runner, numbers: Sequence[int]) -> Frames:
        """What ``runner`` encodes of scenes."""
        return runner.frames([self.scenes[n] for n in numbers], [self.views[n][0] for n in numbers])

    def start(self, runner: Runner, numbers: Sequence[int]) -> Particles:
        """The encoded state of scenes, as ``runner`` simulates it. The last few scenes are kept."""
        if len(numbers) > 1:
            return runner.encode(self.frames(runner, numbers))
        key = runner.setting.of_input, numbers[0]
        if key not in self._encoded:
            self._encoded[key] = runner.encode_all(self.frames(runner, numbers))
            while len(self._encoded) > MOST_KEPT:
                self._encoded.popitem(last=False)
        self._encoded.move_to_end(key)
        return runner.subsampled(self._encoded[key])

    def cameras(self, numbers: Sequence[int], step: int) -> Cameras:
        """The target views of scenes at predicted step ``step``, counted from 0."""
        parts = [self.scenes[n].cameras_at(list(self.views[n][1]), [self.first + step]) for n in numbers]
        names = ("viewmats", "Ks", "near", "far")
        tensors = {name: torch.cat([getattr(part, name) for part in parts]) for name in names}
        clouds = torch.cat([part.image_cloud + cloud for cloud, part in enumerate(parts)])
        return dataclasses.replace(parts[0], image_cloud=clouds, **tensors).to(self.device)

    def predict(self, setting: Setting, number: int) -> Rollout:
        """The whole horizon of one scene. Raises Failed: memory ran out, or a number is not finite."""
        runner, log = self.runner(setting), RestLog()
        images, moving = [], []
        try:
            for step, newest in enumerate(runner.steps(self.start(runner, [number]), self.n_steps, log)):
                if not newest.means.isfinite().all():
                    raise Failed(f"particles are not finite at step {step + 1}")
                image = runner.images(newest, self.cameras([number], step))
                if not image.isfinite().all():
                    raise Failed(f"images are not finite at step {step + 1}")
                images.append(image)
                moving.append(newest.means[newest.activity == DYNAMIC])
        except torch.OutOfMemoryError:
            raise Failed("out of memory") from None
        except (NumericalError, InputError) as error:
            raise Failed(str(error)) from None
        return Rollout(torch.stack(images), moving, log.resting_share)

    def newest(self, number: int) -> Particles:
        """The last encoded step of a scene, in the reference run."""
        return last_steps(self.start(self.runner(), [number]), 1)

    @cached_property
    def reference(self) -> list[Rollout]:
        """The reference's rollout of each scene."""
        return [self.predict(Setting(), number) for number in range(len(self.scenes))]

    @cached_property
    def truths(self) -> list[SceneTruth]:
        """What each scene's rollout is compared with."""
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
        """Scores by step of the last encoded particles, held still."""
        runner, scores = self.runner(), []
        for number, truth in enumerate(self.truths):
            newest = self.newest(number)
            images = [runner.images(newest, self.cameras([number], step)) for step in range(self.n_steps)]
            scores.append(truth.score([("", torch.stack(images))]))
        return _means(scores)[1]

    def compare(self, point: Point) -> None:
        """Fills in how wrong ``point`` is, against the reference and against the video, or why it has no result."""
        cell = self.restored.simulator.config.dynamics.grid_size
        scores, differences, distances, resting = [], [], [], []
        try:
            for number, (reference, truth) in enumerate(zip(self.reference, self.truths, strict=True)):
                found = reference if point.setting == Setting() else self.predict(point.setting, number)
                differences.append(psnr(found.images.flatten(0, 1), reference.images.flatten(0, 1)).cpu())
                distances.append(_distances(found, reference, cell))
                scores.append(truth.score([("", found.images)]))
                resting.append(found.resting)
        except Failed as error:
            point.failure = str(error)
            return
        images, positions = torch.cat(differences), None
        if all(distance is not None for distance in distances):
            positions = torch.cat(distances)
        known = positions is not None and len(positions)
        point.agreement = Agreement(
            float(images.mean()),
            float(images.min()),
            float(positions.mean()) if known else None,
            float(positions.max()) if known else None,
        )
        point.task, point.by_step = _means(scores)
        point.resting = statistics.fmean(resting)

    @property
    def metric(self) -> str:
        """The metric of the gain: PSNR without background, where scenes have masks."""
        return "psnr_masked" if "psnr_masked" in self.constant else "psnr"

    def gain(self, point: Point) -> float | None:
        """How many dB better than particles held still, the mean over steps."""
        pairs = zip(point.by_step[self.metric], self.constant[self.metric], strict=True)
        gains = [ours - constant for ours, constant in pairs if ours is not None and constant is not None]
        return statistics.fmean(gains) if gains else None

    def share_kept(self, point: Point, reference: Point) -> float | None:
        """Share of the reference's gain that ``point`` keeps: 1 less what it loses."""
        if not point.by_step or not reference.by_step:
            return None
        whole, kept = self.gain(reference), self.gain(point)
        return None if not whole or kept is None else 1 - (whole - kept) / abs(whole)


def _distances(found: Rollout, reference: Rollout, cell: float) -> Tensor | None:
    """Of every moving particle at every step, in cells; None where the two have other particles."""
    pairs = list(zip(found.moving, reference.moving, strict=True))
    if any(a.shape != b.shape for a, b in pairs):
        return None
    return torch.cat([(a - b).double().norm(dim=1) / cell for a, b in pairs]).cpu()


def _means(scores: Sequence[SceneScores]) -> tuple[dict[str, float | None], dict[str, list[float | None]]]:
    """Means over scenes, then over steps, FVD of all clips; and means over scenes by step."""
    values = [score.values[""] for score in scores]
    by_step = {name: torch.stack([s[name] for s in values]).nanmean(0) for name in values[0] if METRICS[name].by_step}
    whole = {name: mean_of_counted(steps) for name, steps in by_step.items()}
    clips = [torch.cat([score.clips[of] for score in scores]) for of in ("truth", "") if scores[0].clips]
    if clips and len(clips[0]) >= MIN_CLIPS:
        whole["fvd"] = frechet_distance(*clips)
    return whole, {name: [None if v != v else v for v in steps.tolist()] for name, steps in by_step.items()}


# ---- the sweep ----


class Stepping:
    """Simulates and draws ``span`` steps of a setting when called, always from the same state, and waits for a graph.

    Args:
        case, setting: what is run.
        clock: of its device.
        numbers: scenes that are simulated together.
        span: steps of a call; None: as many as must be timed together.
        stopwatch: follows the sections of every call; one of a graph makes its marks a part of the graph.
    Raises:
        CaptureError, InputError: the setting cannot be captured.

    Attributes:
        once: seconds that the capture took.
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
        self.once, self._graph, self._stopwatch = 0.0, None, stopwatch
        if setting.captured:
            clock.wait()
            start = clock.now()
            marked = isinstance(stopwatch, GraphStopwatch)
            with watched(self.runner.simulator, stopwatch) if marked else nullcontext():
                with stopwatch.capturing() if marked else nullcontext():
                    self._graph = self.runner.captured(self.state, self.span, self.cameras)
            clock.wait()
            self.once = clock.now() - start

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
    """Measures settings on a case: first how wrong each is, then, of those that have a result, what they cost.

    Args:
        case, effort: what to measure, and how long.
        limit: once a part of it is over, less is measured, but one round of whatever was compared.
        progress: is called with what is being done.
        file: keeps what was measured, so that a sweep that was ended goes on there; None: nothing is kept.
    """

    def __init__(
        self,
        case: BenchmarkCase,
        effort: Effort = Effort(),
        limit: TimeLimit | None = None,
        progress: Callable[[str], None] = lambda doing: None,
        file: Path | None = None,
        clock: DeviceClock | None = None,
    ):
        self.case, self.effort, self.limit, self.progress = case, effort, limit or TimeLimit(), progress
        self.clock = clock or DeviceClock(case.device)
        self._file, self._graphs = file, {}
        self._points = self._load() if file is not None and file.is_file() else {}

    def points(self, groups: Sequence[Group] = GROUPS) -> tuple[list[Point], dict[str, str]]:
        """The reference and every setting of ``groups`` that this case has; and what the other groups need."""
        points, missing = [self.point(Setting(), "reference", "exact")], {}
        for group in groups:
            found = group.settings(self.case)
            if not found:
                missing[group.name] = group.needs
            if self.effort.few and len(found) > group.few:
                apart = (len(found) - 1) / max(1, group.few - 1)
                found = [found[-1 - int(n * apart)] for n in reversed(range(group.few))]
            for setting in found:
                if self.case.device.type == "cuda" and setting.sleep is None:  # else it waits for the host
                    setting = dataclasses.replace(setting, captured=True)
                points.append(self.point(setting, group.name, group.kind))
        return points, missing

    def point(self, setting: Setting, group: str, kind: str) -> Point:
        """That of ``setting``, with what was measured of it before."""
        return self._points.setdefault(setting, Point(setting, group, kind))

    def run(self, points: Sequence[Point]) -> None:
        """Fills in ``points``."""
        for point in sorted(points, key=lambda p: repr(p.setting.of_input) != repr(Setting())):
            self.progress(f"error: {point.setting.name}")
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
                self.progress(f"time, round {n + 1}: {point.setting.name}")
                if not point.failure and len(point.step) <= n:
                    self._time(point)
            self._time_inputs([point for point in points if not point.failure and len(point.encode) <= n])
            self._save()

    def _time_inputs(self, points: Sequence[Point]) -> None:
        """One round of each input; equal ones are encoded once."""
        for given in dict.fromkeys(point.setting.of_input for point in points):
            runner = self.case.runner(given)
            frames = self.case.frames(runner, [0])
            repeats = self.effort.repeats if given == Setting() else 1 + self.effort.repeats // 3
            timing = time_call(lambda: runner.encode_all(frames), self.clock, repeats, self.effort.warm_up)
            for point in points:
                if point.setting.of_input == given:
                    point.encode += (timing,)

    def _time(self, point: Point) -> None:
        """One round of one point, or why it cannot be."""
        try:
            timing = self._timing(point)
        except torch.OutOfMemoryError:
            point.failure = "out of memory while timed"
        except (CaptureError, InputError) as error:
            point.failure = str(error)
        else:
            point.step += (timing,)

    def _timing(self, point: Point) -> Timing:
        case, setting, effort = self.case, point.setting, self.effort
        span = case.runner(setting).span(case.n_steps)
        if case.device.type == "cpu":
            stopwatch = Stopwatch(self.clock)
            stepping = Stepping(case, setting, self.clock, stopwatch=stopwatch)
            repeats = max(2, math.ceil(effort.repeats / span))
            timing = time_call(stepping, self.clock, repeats, effort.warm_up, lambda: stopwatch.seconds)
            return timing.split_over(span)
        free, total = torch.cuda.mem_get_info(case.device)
        if free < total / 2:
            self._graphs.clear()
        torch.cuda.reset_peak_memory_stats(case.device)
        before = torch.cuda.memory_allocated(case.device)
        stepping = self._graphs.get(setting) or Stepping(case, setting, self.clock)
        if setting.captured:
            self._graphs[setting], point.once = stepping, point.once or stepping.once
        timing = time_call(stepping, self.clock, effort.repeats, effort.warm_up)
        point.peak = max(point.peak, torch.cuda.max_memory_allocated(case.device) - before)
        if not point.step and setting.sleep is None:
            timing = Timing(timing.repeats, self.sections_of_graph(setting, timing))
        return timing.split_over(span)

    def sections_of_graph(self, setting: Setting, timing: Timing) -> dict[str, float]:
        """Medians of a call, from a graph of its own, since marks are a part of it.

        Where ``timing`` is of calls that the host launches, the GPU does the same and waits for the host in the rest.
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
        return {name: sections[name] for name in SECTIONS if name in sections}

    def _conditions(self) -> dict:
        """What must be the same for numbers of before to hold."""
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
        except (ValueError, AttributeError, KeyError, TypeError):  # of another version: nothing but time is lost
            return {}
        return {point.setting: point for point in points} if content == self._conditions() else {}
