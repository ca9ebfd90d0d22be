"""Predicts the scenes of a subject under several settings at once, and says why where that fails."""

from __future__ import annotations

import statistics
from collections.abc import Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, field

import torch
from torch import Tensor

from gsim3d.dynamics import RestLog
from gsim3d.errors import InputError, NumericalError
from gsim3d.profile.runner import Runner
from gsim3d.profile.subject import Subject
from gsim3d.profile.timing import Clock, Stopwatch, Timing, watched
from gsim3d.state import DYNAMIC

Stages = dict[str, float]


@dataclass(frozen=True)
class Predicted:
    """Of one scene: images of each rendered step [S, V, H, W, 3], and what may move of every step: places [n, 3].

    resting: share of the rows that slept.
    spent: seconds by stage of a step, of each span of steps that are timed together; none where nothing was timed.
    """

    steps: tuple[int, ...]
    images: Tensor
    moving: list[Tensor]
    resting: float = 0.0
    spent: list[Stages] = field(default_factory=list)


class Unusable(Exception):
    """A setting has no result; the message says why."""


FAILURES = (Unusable, torch.OutOfMemoryError, NumericalError, InputError)


def predict(subject: Subject, runner: Runner, number: int) -> Predicted:
    """The whole horizon of one scene.

    Raises:
        Unusable: memory ran out, or a number is not finite; the message names the step.
    """
    predicted = predict_together(subject, [runner], number)[0]
    if isinstance(predicted, Unusable):
        raise predicted
    return predicted


def predict_together(
    subject: Subject, runners: Sequence[Runner], number: int, clock: Clock | None = None
) -> list[Predicted | Unusable]:
    """As :func:`predict`, of runners whose settings differ in how they draw only: the first one simulates for all.

    clock: times every step and its images on the way; None: nothing is timed.
    """
    step, scene, log = 0, subject.scenes[number], RestLog()
    drawn: list[dict[int, Tensor] | Unusable] = [{} for _ in runners]
    moving: list[Tensor] = []
    failures = (Exception,) if runners[0].setting.compiled else FAILURES  # a compiler raises anything
    simulated, shown = _Timer(clock, runners[0]), [_Timer(clock, runner) for runner in runners]
    try:
        steps = runners[0].steps(subject.start(runners[0], number), subject.n_steps, log)
        for step in range(subject.n_steps):
            with simulated.running():
                newest = next(steps)
            if not newest.means.isfinite().all():
                raise Unusable(f"particles are not finite at step {step + 1}")
            moving.append(newest.means[newest.activity == DYNAMIC])
            cameras = subject.cameras(number, step)
            for n, (runner, timer) in enumerate(zip(runners, shown, strict=True)):
                if isinstance(drawn[n], Unusable):
                    continue
                if step % runner.setting.every:
                    timer.spent.append({})
                    continue
                try:
                    with timer.running():
                        image = runner.images(newest, cameras)
                    drawn[n][step] = runner.enlarged(image, scene.height, scene.width)
                    if not drawn[n][step].isfinite().all():
                        raise Unusable(f"images are not finite at step {step + 1}")
                except FAILURES as error:
                    drawn[n] = told(error, step)
    except failures as error:
        drawn = [told(error, step)] * len(runners)
    return [
        (
            images
            if isinstance(images, Unusable)
            else Predicted(
                tuple(images),
                torch.stack(list(images.values())),
                moving,
                log.resting_share,
                _by_span(
                    simulated.spent, timer.spent, subject.n_steps if runner.at_once else runner.span(subject.n_steps)
                ),
            )
        )
        for images, runner, timer in zip(drawn, runners, shown, strict=True)
    ]


class _Timer:
    """Seconds by stage of each call of a runner."""

    def __init__(self, clock: Clock | None, runner: Runner):
        self.spent: list[Stages] = []
        self._clock, self._simulator = clock, runner.simulator
        self._stopwatch = None if clock is None or runner.setting.compiled else Stopwatch(clock)

    def running(self):
        return nullcontext() if self._stopwatch is None else self._watching()

    @contextmanager
    def _watching(self):
        with watched(self._simulator, self._stopwatch), self._stopwatch.running():
            yield
        self.spent.append(self._stopwatch.seconds)


def _by_span(simulated: Sequence[Stages], shown: Sequence[Stages], span: int) -> list[Stages]:
    """Means over ``span`` steps each; steps behind the last whole span are left out."""
    found = []
    for begin in range(0, len(simulated) - span + 1, span):
        total: Stages = {}
        for stages in (*simulated[begin : begin + span], *shown[begin : begin + span]):
            for name, seconds in stages.items():
                total[name] = total.get(name, 0.0) + seconds / span
        found.append(total)
    return found


def timing_of(spent: Sequence[Stages], warm_up: int) -> Timing:
    """Of spans of all scenes; the first ``warm_up`` do not count where most are left."""
    counted = spent[warm_up:] if len(spent) > 2 * warm_up else spent
    names = dict.fromkeys(name for stages in counted for name in stages)
    medians = {name: statistics.median(stages.get(name, 0.0) for stages in counted) for name in names}
    return Timing(tuple(sum(stages.values()) for stages in counted), medians)


def told(error: Exception, step: int) -> Unusable:
    """Why a setting has no result, in a line; what is none of the known failures is the compiler's."""
    if isinstance(error, Unusable):
        return error
    if isinstance(error, torch.OutOfMemoryError):
        return Unusable(f"out of memory at step {step + 1}")
    if isinstance(error, (NumericalError, InputError)):
        return Unusable(f"step {step + 1}: {error}")
    return Unusable(f"cannot be compiled: {type(error).__name__}: {(str(error).splitlines() or [''])[0][:120]}")
