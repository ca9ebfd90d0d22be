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

from gsim3d.errors import CaptureError, InputError
from gsim3d.evaluate.metrics import PSNR_CAP, mean_of_counted, psnr
from gsim3d.evaluate.perceptual.fvd import MIN_CLIPS, frechet_distance
from gsim3d.evaluate.scoring import METRICS, PLAIN_METRICS, SceneScores, SceneTruth
from gsim3d.profile.limit import COMPARE, LEFT_OUT, ROUNDS, TimeLimit
from gsim3d.profile.predict import Predicted, Unusable, predict_together, timing_of, told
from gsim3d.profile.settings import KNOBS, Knob, Setting, turned
from gsim3d.profile.stepping import Stepping, TooLong, bytes_held, compile_once
from gsim3d.profile.subject import Subject
from gsim3d.profile.timing import GAPS, STAGES, Clock, GraphStopwatch, Timing, peak_memory, time_call, time_stages


@dataclass(frozen=True)
class Effort:
    """How long to measure.

    n_rounds: times that all settings are gone through, each in another order; at least 3 say how far two medians of the
        same thing are apart.   repeats: steps that are timed in each round, and encodings of the reference's input.
    n_steps: of the rollout that is compared.   n_scenes: that are compared.
    encodings: in each round, of inputs that are not the reference's; None: as many as of that.
    fewest_turns: of every knob as few as it says.   slow_turns: of slow knobs as well.
    metrics: of the task error.
    apart: steps are timed apart from the rollouts that are compared; False: on the way, which is faster, where marks
        cost nothing, on a CPU; the reference is then gone through three times.
    """

    n_rounds: int = 3
    repeats: int = 7
    n_steps: int | None = None
    n_scenes: int | None = None
    warm_up: int = 1
    encodings: int | None = None
    fewest_turns: bool = False
    slow_turns: bool = True
    metrics: tuple[str, ...] = PLAIN_METRICS
    apart: bool = True


QUICK = Effort(n_steps=12, n_scenes=2, encodings=3, fewest_turns=True, slow_turns=False)
QUICK_ON_CPU = dataclasses.replace(QUICK, encodings=1, apart=False)
FULL = Effort(repeats=10, n_scenes=16)
FEWEST = 3  # repeats of a round where the time is nearly over
COMPILE_SECONDS, LEAST_COMPILE = 120.0, 20.0  # that a setting may be compiled; what is not worth to be begun


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

    failure: why there is nothing else, or "".
    task: metric -> mean over steps of the mean over scenes, against the truth.
    by_step: metric -> a value for each rendered step.   once: seconds before the first step (capture).
    peak: bytes, of the GPU; of the process, so far, on a CPU.   resting: share of the rows that slept.
    noise: share by which the times of one thing differ on this machine, where it was measured once only.
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
    resting: float = 0.0
    noise: float = 0.0

    @property
    def step_seconds(self) -> float:
        return median_of(self.step)

    @property
    def spread(self) -> float:
        """Seconds between the slowest and the fastest round: two measurements of one thing."""
        timings = self.step
        if len(timings) == 1 and not self.noise:  # of a single round, between its halves
            seconds = timings[0].repeats
            half = len(seconds) // 2
            timings = [Timing(part) for part in (seconds[:half], seconds[half:]) if part]
        rounds = [timing.steady for timing in timings]
        return max(max(rounds) - min(rounds), self.noise * self.step_seconds)

    def stages(self) -> dict[str, float]:
        """Seconds of a step, by stage: medians over rounds in which they were watched."""
        watched = [timing.stages for timing in self.step if timing.stages]
        names = dict.fromkeys(name for stages in watched for name in stages)
        return {name: statistics.median(stages.get(name, 0.0) for stages in watched) for name in names}


def median_of(timings: Sequence[Timing]) -> float:
    return statistics.median(seconds for timing in timings for seconds in timing.repeats)


class Comparison:
    """Compares settings with the reference and with the truth; the reference's own predictions are made once.

    metrics: of the task error, as :func:`gsim3d.evaluate.scoring.measurable`.
    not_measured: metric -> why it has no value.   clock: times steps on the way; None: nothing is timed.
    noise: as of Point, once the reference was timed three times.   spent: seconds by stage, of each setting.
    encodings: timings of each input so far.
    """

    def __init__(self, subject: Subject, metrics: Sequence[str] = PLAIN_METRICS, clock: Clock | None = None):
        self.subject, self.metrics, self.clock, self.noise = subject, tuple(metrics), clock, 0.0
        self.not_measured: dict[str, str] = {}
        self.spent: dict[Setting, list[dict[str, float]]] = {}
        self.encodings: dict[Setting, list[Timing]] = {}
        self._truths: dict[tuple[int, tuple[int, ...], tuple[str, ...]], SceneTruth] = {}

    @cached_property
    def reference(self) -> list[Predicted]:
        return self._run_reference()

    def _run_reference(self) -> list[Predicted]:
        runner, predictions = self.subject.runner(), []
        for number in range(len(self.subject.scenes)):
            predictions += predict_together(self.subject, [runner], number, self.clock)
            if isinstance(predictions[-1], Unusable):
                raise predictions[-1]
        return predictions

    def reference_times(self, warm_up: int, n_runs: int = 3) -> list[Timing]:
        """Of ``n_runs`` of the reference, those made so far among them; tells :attr:`noise`."""
        runs = [[spent for predicted in self.reference for spent in predicted.spent]]
        if (again := self.spent.get(Setting(), runs[0])) != runs[0]:  # beside settings that draw otherwise
            runs.append(again)
        while len(runs) < n_runs:
            runs.append([spent for predicted in self._run_reference() for spent in predicted.spent])
        timings = [timing_of(run, warm_up) for run in runs]
        rounds = [timing.steady for timing in timings]
        self.noise = (max(rounds) - min(rounds)) / statistics.median(rounds)
        return timings

    @cached_property
    def constant(self) -> dict[str, list[float | None]]:
        """Scores by step of the last encoded particles, held still."""
        subject, runner, scores = self.subject, self.subject.runner(), []
        wanted = [name for name in self.metrics if METRICS[name].by_step and METRICS[name].weights is None]
        for number in range(len(subject.scenes)):
            newest = runner.newest(subject.start(runner, number))
            steps = range(subject.n_steps)
            images = torch.stack([runner.images(newest, subject.cameras(number, step)) for step in steps])
            scores.append(self._scores(number, Predicted(tuple(steps), images, []), wanted))
        return _mean_over(scores)[1]

    def of(self, setting: Setting) -> Found:
        """What one setting gets wrong. Raises Unusable."""
        found = self.of_all([setting])[0]
        if isinstance(found, Unusable):
            raise found
        return found

    def of_all(self, settings: Sequence[Setting]) -> list[Found | Unusable]:
        """As :meth:`of`, of settings that differ in how they draw only."""
        subject, runners = self.subject, [self.subject.runner(setting) for setting in settings]
        cell = subject.restored.simulator.config.dynamics.grid_size
        found: list[list | Unusable] = [[] for _ in settings]
        for number, reference in enumerate(self.reference):
            left = [n for n, known in enumerate(found) if isinstance(known, list)]
            if not left:
                break
            predictions = [reference]
            if list(settings) != [Setting()]:
                predictions = predict_together(subject, [runners[n] for n in left], number, self.clock)
            for n, predicted in zip(left, predictions, strict=True):
                if isinstance(predicted, Unusable):
                    found[n] = predicted
                    continue
                differences = _psnr(predicted.images, reference.images[list(predicted.steps)])
                distances = _distances(predicted, reference, cell)
                scores = self._scores(number, predicted, self.metrics)
                found[n].append((differences, distances, scores, predicted))
        return [known if isinstance(known, Unusable) else _found(known) for known in found]

    def gain(self, by_step: dict[str, list[float | None]], every: int = 1) -> float | None:
        """How many dB better than the constant baseline at the rendered steps, without background where it is known."""
        metric = "psnr_masked" if "psnr_masked" in self.constant else "psnr"
        pairs = zip(by_step[metric], self.constant[metric][::every], strict=True)
        gains = [ours - constant for ours, constant in pairs if ours is not None and constant is not None]
        return statistics.fmean(gains) if gains else None

    def share_kept(self, point: Point, reference: Point) -> float | None:
        """Share of the reference's gain that ``point`` keeps, at its rendered steps; 1 less what it loses."""
        if not point.by_step or not reference.by_step:
            return None
        every = point.setting.every
        at_same_steps = {metric: values[::every] for metric, values in reference.by_step.items()}
        whole, kept = self.gain(at_same_steps, every), self.gain(point.by_step, every)
        return None if not whole or kept is None else 1 - (whole - kept) / abs(whole)

    def _scores(self, number: int, predicted: Predicted, metrics: Sequence[str]) -> SceneScores:
        key = number, predicted.steps, tuple(metrics)
        if key not in self._truths:
            name = self.subject.scenes[number].name
            self._truths[key] = SceneTruth(name, *self.subject.truth(number, predicted.steps), 0, metrics)
        truth = self._truths[key]
        if len(predicted.steps) == self.subject.n_steps:
            self.not_measured.update(truth.not_measured)
        return truth.score([("", predicted.images)])


@dataclass(frozen=True)
class Found:
    """What one setting gets wrong; fields as of Point."""

    agreement: Agreement
    task: dict[str, float | None]
    by_step: dict[str, list[float | None]]
    resting: float
    spent: list[dict[str, float]]


def _found(of_scenes: list[tuple]) -> Found:
    differences, distances, scores, predicted = zip(*of_scenes, strict=True)
    images = torch.cat(differences)
    known = all(distance is not None for distance in distances)
    apart = torch.cat(distances) if known else torch.zeros(0)
    agreement = Agreement(
        float(images.mean()),
        float(images.min()),
        float(apart.mean()) if len(apart) else None,
        float(apart.max()) if len(apart) else None,
    )
    resting = statistics.fmean(p.resting for p in predicted)
    return Found(agreement, *_mean_over(scores), resting, [spent for p in predicted for spent in p.spent])


def _psnr(images: Tensor, reference: Tensor) -> Tensor:
    return psnr(images.flatten(0, 1), reference.flatten(0, 1)).cpu()


def _distances(predicted: Predicted, reference: Predicted, cell: float) -> Tensor | None:
    """Of every moving particle at every step, in cells; None where the two have other particles."""
    if any(a.shape != b.shape for a, b in zip(predicted.moving, reference.moving, strict=True)):
        return None
    pairs = zip(predicted.moving, reference.moving, strict=True)
    return torch.cat([(a - b).double().norm(dim=1) / cell for a, b in pairs]).cpu()


def _mean_over(scores: Sequence[SceneScores]) -> tuple[dict[str, float | None], dict[str, list[float | None]]]:
    """Means over scenes, then over steps, FVD of all clips; and means over scenes by step."""
    values = [score.values[""] for score in scores]
    by_step = {name: torch.stack([s[name] for s in values]).nanmean(0) for name in values[0]}
    whole = {name: mean_of_counted(steps) for name, steps in by_step.items()}
    clips = [torch.cat([score.clips[of] for score in scores]) for of in ("truth", "") if scores[0].clips]
    if clips and len(clips[0]) >= MIN_CLIPS:
        whole["fvd"] = frechet_distance(*clips)
    return whole, {name: [None if v != v else v for v in steps.tolist()] for name, steps in by_step.items()}


def points_of(
    subject: Subject, knobs: Sequence[Knob] = KNOBS, effort: Effort = Effort()
) -> tuple[list[Point], dict[str, str]]:
    """The reference, and every turn of every knob that this simulator has here; and what the other knobs need."""
    settings, missing = turned(subject, knobs, fewest=effort.fewest_turns, slow=effort.slow_turns)
    turns = [Point(setting, knob.name, knob.kind) for setting, knob in settings.items()]
    return [Point(Setting(), "reference", "exact"), *turns], missing


def measure(
    comparison: Comparison,
    points: Sequence[Point],
    clock: Clock,
    effort: Effort,
    progress: Callable[[str], None] = lambda doing: None,
    limit: TimeLimit = TimeLimit(),
    after_round: Callable[[int], None] = lambda n_rounds: None,
) -> None:
    """Fills in what ``points`` get wrong and what they cost, or why they have no result.

    limit: of what would take longer, less is measured: at least one round of whatever was compared.
    after_round: is told how many rounds of all settings are over.
    """
    subject = comparison.subject
    compare(comparison, [point for point in points if not point.setting.compiled], progress, limit)
    reference = next((point for point in points if point.setting == Setting()), None)
    if reference is not None and reference.failure:
        return
    for point in points:
        if point.setting.compiled:
            seconds = min(COMPILE_SECONDS, limit.left(COMPARE))
            progress(f"compiling, {seconds:.0f} s at most: {point.setting.name}")
            _compile(subject, point, clock, seconds)
            compare(comparison, [point], progress, limit)
    apart = [point for point in points if effort.apart or point.setting.compiled]
    if not effort.apart:
        if reference is not None:
            reference.step = comparison.reference_times(effort.warm_up, 2 if limit.is_over(ROUNDS) else 3)
        for point in points:
            if point in apart or point.failure:
                continue
            point.noise = comparison.noise
            point.step = point.step or [timing_of(comparison.spent[point.setting], effort.warm_up)]
    if limit.is_over(ROUNDS):
        effort = dataclasses.replace(effort, repeats=min(effort.repeats, FEWEST), encodings=1)
    ready: dict[Setting, Stepping] = {}
    for n in range(effort.n_rounds):
        if n and limit.is_over(ROUNDS):
            break
        time_points(subject, apart, clock, effort, progress=progress, rounds=(n,), ready=ready)
        time_encodings(subject, points, clock, effort, progress, (n,), comparison.encodings)
        after_round(n + 1)


def n_runs(points: Sequence[Point], effort: Effort) -> int:
    """How often :func:`measure` tells its progress."""
    apart = sum(effort.apart or point.setting.compiled for point in points)
    compiled = sum(point.setting.compiled for point in points)
    return len(points) + compiled + effort.n_rounds * (apart + len({point.setting.given for point in points}))


def compare(
    comparison: Comparison,
    points: Sequence[Point],
    progress: Callable[[str], None] = lambda doing: None,
    limit: TimeLimit = TimeLimit(),
) -> None:
    """Fills in what ``points`` get wrong, or why they have no result."""
    groups: dict[Setting, list[Point]] = {}
    for point in points:
        groups.setdefault(point.setting.undrawn, []).append(point)
    order = list(dict.fromkeys(undrawn.given for undrawn in groups))  # what is encoded alike, one after another
    on_host = comparison.subject.device.type == "cpu"
    for undrawn in sorted(groups, key=lambda undrawn: order.index(undrawn.given)):
        group = [point for point in groups[undrawn] if not point.failure]
        for point in groups[undrawn]:
            progress(f"error: {point.setting.name}")
        if limit.is_over(COMPARE) and undrawn != Setting():
            for point in group:
                point.failure = LEFT_OUT
            continue
        with peak_memory(comparison.subject.device) as peak:
            all_found = comparison.of_all([point.setting for point in group]) if group else []
        for point, found in zip(group, all_found, strict=True):
            if isinstance(found, Unusable):
                point.failure = str(found)
            else:
                point.agreement, point.task = found.agreement, found.task
                point.peak = peak() if on_host else 0  # a GPU's memory also holds what the comparison needs
                point.by_step, point.resting = found.by_step, found.resting
                comparison.spent[point.setting] = found.spent


def time_points(
    subject: Subject,
    points: Sequence[Point],
    clock: Clock,
    effort: Effort,
    seed: int = 0,
    progress: Callable[[str], None] = lambda doing: None,
    rounds: Sequence[int] | None = None,
    ready: dict[Setting, Stepping] | None = None,
) -> None:
    """Fills in what a step of ``points`` without failure costs, in rounds, each in another order.

    rounds: numbers of those that are gone through; default all.   ready: graphs that were captured in earlier ones.
    """
    ready = {} if ready is None else ready
    for n in range(effort.n_rounds) if rounds is None else rounds:
        order = list(points)
        random.Random(seed + n).shuffle(order)
        for point in order:
            progress(f"time, round {n + 1}: {point.setting.name}")
            if not point.failure:
                try:
                    _time(subject, point, clock, effort, ready)
                except torch.OutOfMemoryError:
                    point.failure = "out of memory while timed"
                except (CaptureError, InputError) as error:
                    point.failure = str(error)


def time_encodings(
    subject: Subject,
    points: Sequence[Point],
    clock: Clock,
    effort: Effort,
    progress: Callable[[str], None] = lambda doing: None,
    rounds: Sequence[int] | None = None,
    known: dict[Setting, list[Timing]] | None = None,
) -> None:
    """Fills in what the input of ``points`` costs: once for those whose input is the same, in rounds.

    rounds: as of :func:`time_points`.   known: timings so far by input, which are added to; enough are not repeated.
    """
    known = {} if known is None else known
    for n in range(effort.n_rounds) if rounds is None else rounds:
        for given in dict.fromkeys(point.setting.given for point in points):
            progress(f"time, round {n + 1}: encoding of {given.name}")
            timings = known.setdefault(given, [])
            if len(timings) <= n and any(not p.failure and p.setting.given == given for p in points):
                timings.append(_time_encoding(subject, given, clock, effort))
    for point in points:
        point.encode = known[point.setting.given]


def _time_encoding(subject: Subject, given: Setting, clock: Clock, effort: Effort) -> Timing:
    runner = subject.runner(given)
    frames = subject.frames(runner, 0)
    repeats = effort.repeats if given == Setting() else effort.encodings or effort.repeats
    return time_call(lambda: runner.seen(frames), clock, repeats, effort.warm_up if effort.apart else 0)


def _time(subject: Subject, point: Point, clock: Clock, effort: Effort, ready: dict[Setting, Stepping]) -> None:
    """One round of one point."""
    setting, on_host = point.setting, subject.device.type == "cpu"
    if not on_host and _is_crowded(subject.device):
        ready.clear()
    with peak_memory(subject.device, bytes_held(subject, setting)) as peak:
        stepping = ready.get(setting) or Stepping(subject, setting, clock)
        repeats = max(2, -(-effort.repeats // stepping.span)) if on_host else effort.repeats
        if setting.captured:
            ready[setting], point.once = stepping, point.once or stepping.once
            timing = time_call(stepping, clock, repeats, effort.warm_up)
        elif setting.compiled or (not on_host and setting.fits_a_graph):
            timing = time_call(stepping, clock, repeats, effort.warm_up)
        else:
            timing = time_stages(
                stepping, [stepping.runner.simulator], clock, repeats, effort.warm_up, alone=not on_host
            )
        point.peak = max(point.peak, peak())
    if not timing.stages and setting.fits_a_graph and not point.step:
        timing = Timing(timing.repeats, _stages_of_graph(subject, setting, clock, timing))
    span = stepping.span
    each = tuple(seconds / span for seconds in timing.repeats)
    point.step.append(Timing(each, {name: seconds / span for name, seconds in timing.stages.items()}))


def _stages_of_graph(subject: Subject, setting: Setting, clock: Clock, timing: Timing) -> dict[str, float]:
    """Medians of a call, of a graph of its own, since marks are a part of it. Where ``timing`` is of calls that the
    host launches, the GPU does the same, and waits for the host the rest of the time. None of what fits no graph."""
    stopwatch, span = GraphStopwatch(clock), subject.runner(setting).span(subject.n_steps)
    try:
        marked = Stepping(subject, dataclasses.replace(setting, captured=True), clock, span=span, stopwatch=stopwatch)
    except (CaptureError, InputError):
        return {}
    seen = []
    for n in range(1 + len(timing.repeats)):
        marked()
        if n:
            seen.append(stopwatch.seconds)
    stages = {name: statistics.median(stages.get(name, 0.0) for stages in seen) for name in STAGES if name in seen[0]}
    if not setting.captured:
        stages[GAPS] = max(0.0, timing.median - sum(stages.values()))
    return stages


def _is_crowded(device: torch.device) -> bool:
    """Whether captured graphs should give back their memory."""
    free, total = torch.cuda.mem_get_info(device)
    return free < total / 2


def _compile(subject: Subject, point: Point, clock: Clock, seconds: float) -> None:
    """Compiles what ``point`` runs, or says why not."""
    if seconds < LEAST_COMPILE:
        point.failure = LEFT_OUT
        return
    try:
        point.once = compile_once(Stepping(subject, point.setting, clock), clock, seconds)
    except TooLong:
        point.failure = f"not compiled after {seconds:.3g} s"
    except Exception as error:  # a compiler raises anything
        point.failure = str(told(error, 0))


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
