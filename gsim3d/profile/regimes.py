"""The other ways to use a simulator: many scenes at once, and training it."""

from __future__ import annotations

import dataclasses
import tempfile
from collections import defaultdict
from dataclasses import dataclass

import torch

from gsim3d.errors import CaptureError, InputError
from gsim3d.io.settings import from_dict, upgraded
from gsim3d.profile.machine import energy
from gsim3d.profile.settings import Setting
from gsim3d.profile.stepping import Stepping
from gsim3d.profile.subject import Subject
from gsim3d.profile.timing import Clock, Timing, time_call
from gsim3d.train.config import TrainConfig
from gsim3d.train.loop import Trainer, deterministic

BATCH = 4
LARGEST_KERNELS = 12  # that are listed
SORTING = ("Sort", "sort")  # in the names of kernels that sort
CAPTURE_SECONDS = 30.0  # in which a training step must be replayed once
ENERGY_SECONDS = 1.0  # a counter of energy is read some ten times a second


@dataclass(frozen=True)
class Throughput:
    """Simulated steps a second of all scenes of a batch together, images included; or why they cannot be had."""

    setting: Setting
    n_scenes: int
    timing: Timing | None
    problem: str = ""

    @property
    def steps_a_second(self) -> float | None:
        return None if self.timing is None else self.n_scenes / self.timing.median


def throughput(
    subject: Subject, setting: Setting, clock: Clock, repeats: int = 20, n_scenes: int = BATCH
) -> Throughput:
    """Of a batch of ``n_scenes``, the subject's scenes in turn, from a graph where the setting is."""
    numbers = [n % len(subject.scenes) for n in range(n_scenes)]
    try:
        stepping = Stepping(subject, setting, clock, numbers, None if setting.captured else 1)
        timing = time_call(stepping, clock, repeats, max(1, repeats // 7))
    except torch.OutOfMemoryError:
        return Throughput(setting, n_scenes, None, "out of memory")
    except (CaptureError, InputError) as error:
        return Throughput(setting, n_scenes, None, str(error))
    timing = Timing(tuple(seconds / stepping.span for seconds in timing.repeats))
    return Throughput(setting, n_scenes, timing)


@dataclass(frozen=True)
class TrainingStep:
    """Seconds of one optimizer step with the checkpoint's own configuration, last phase; or why it cannot be had."""

    batch: int = 0
    horizon: int = 0
    timing: Timing | None = None
    problem: str = ""


@dataclass(frozen=True)
class Work:
    """What a GPU does in a step and its images, in milliseconds: means of steps that are run together.

    whole_ms: from an idle device to an idle device.   busy_ms: in which at least one kernel ran.
    gaps_ms: the rest, in which it waited for the host.   sorting_ms: of kernels that sort.
    kernels: the largest, (name, ms, launches).
    joules: of the whole board; None where its driver does not tell.
    """

    whole_ms: float
    busy_ms: float
    gaps_ms: float
    sorting_ms: float
    kernels: list[tuple[str, float, float]]
    joules: float | None


def gpu_work(subject: Subject, setting: Setting, clock: Clock) -> Work | None:
    """Of one setting, by torch's profiler; None where it may not look at the GPU."""
    from torch.profiler import ProfilerActivity, profile

    stepping = Stepping(subject, setting, clock)
    whole = time_call(stepping, clock).median / stepping.span
    with profile(activities=[ProfilerActivity.CUDA]) as seen:
        stepping()
        clock.wait()
    on_gpu = [event for event in seen.events() if event.device_type == torch.autograd.DeviceType.CUDA]
    spans = [(event.name, event.time_range.start / 1e3, event.time_range.end / 1e3) for event in on_gpu]
    if not spans:
        return None
    n_calls = max(1, int(ENERGY_SECONDS / (whole * stepping.span)))
    with energy(subject.device) as used:
        for _ in range(n_calls):
            stepping()
        clock.wait()
        joules = used()
    each = None if joules is None else joules / (n_calls * stepping.span)
    return work_of(spans, 1e3 * whole, each, stepping.span)


def work_of(spans: list[tuple[str, float, float]], whole_ms: float, joules: float | None, n_steps: int = 1) -> Work:
    """From (kernel, begin, end) in milliseconds of ``n_steps``; kernels on several streams overlap."""
    busy, end_before = 0.0, float("-inf")
    totals: dict[str, list] = defaultdict(lambda: [0.0, 0])
    for name, begin, end in sorted(spans, key=lambda span: span[1]):
        busy += max(0.0, end - max(begin, end_before))
        end_before = max(end, end_before)
        totals[name][0] += end - begin
        totals[name][1] += 1
    busy /= n_steps
    means = ((name, ms / n_steps, count / n_steps) for name, (ms, count) in totals.items())
    kernels = sorted(means, key=lambda kernel: -kernel[1])
    sorting = sum(ms for name, ms, _ in kernels if any(word in name for word in SORTING))
    largest = [(name[:120], ms, count) for name, ms, count in kernels[:LARGEST_KERNELS]]
    return Work(whole_ms, busy, max(0.0, whole_ms - busy), sorting, largest, joules)


def training_step(subject: Subject, clock: Clock, repeats: int = 3, quick: bool = False) -> TrainingStep:
    """Trains on the subject's scenes from new weights, and keeps nothing.

    Films that are shorter than its windows are simulated to their end.

    quick: one scene at a time, only as many steps as gradients flow back through, and none before it is timed.
    """
    saved = subject.restored.checkpoint.config.get("train")
    if saved is None:
        return TrainingStep(problem="the checkpoint does not hold the configuration of its training")
    try:
        config = from_dict(TrainConfig, upgraded(TrainConfig, saved), "train")
        phase = dataclasses.replace(config.phases[-1], steps=10**6)
        if quick:
            phase = dataclasses.replace(phase, batch=1, horizon=phase.cut or phase.horizon)
        known = min(scene.n_steps for scene in subject.scenes) - (phase.history or config.data.history)
        if known > 0:
            phase = dataclasses.replace(phase, horizon=min(phase.horizon, known))
        config = dataclasses.replace(config, phases=(phase,))
        with tempfile.TemporaryDirectory() as folder, deterministic():
            trainer = Trainer(config, subject.scenes, folder, device=subject.restored.device.type)
            trainer.simulator.train()
            timing = _steady_steps(trainer, clock, repeats, warm_up=0 if quick else 1)
    except (InputError, CaptureError) as error:
        return TrainingStep(problem=str(error))
    except torch.OutOfMemoryError:
        return TrainingStep(problem=f"out of memory, with {phase.batch} scenes")
    if timing is None:
        return TrainingStep(problem=f"every step was captured anew in {CAPTURE_SECONDS:.0f} s")
    return TrainingStep(phase.batch, phase.horizon, timing)


def _steady_steps(trainer: Trainer, clock: Clock, repeats: int, warm_up: int) -> Timing | None:
    """Optimizer steps, but for those that capture a graph, of which a training has few; None: there is no other."""
    time_call(trainer.train_step, clock, 0, warm_up)
    start, seconds = clock.now(), []
    while len(seconds) < repeats and (trainer.captured is None or clock.now() - start < CAPTURE_SECONDS):
        before = _captures(trainer)
        step = time_call(trainer.train_step, clock, 1, 0).median
        if _captures(trainer) == before:
            seconds.append(step)
    return Timing(tuple(seconds)) if seconds else None


def _captures(trainer: Trainer) -> int:
    return 0 if trainer.captured is None else trainer.captured.captures
