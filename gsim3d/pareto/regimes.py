"""The other ways to use a simulator: many scenes at once, and training it."""

from __future__ import annotations

import dataclasses
import tempfile
from dataclasses import dataclass

from gsim3d.errors import InputError
from gsim3d.pareto.measure import Subject
from gsim3d.pareto.settings import Setting
from gsim3d.pareto.timing import Clock, Timing, time_call
from gsim3d.train.config import TrainConfig
from gsim3d.train.loop import Trainer, deterministic
from gsim3d.train.settings import from_dict

BATCH = 4


@dataclass(frozen=True)
class Throughput:
    """Simulated steps a second of all scenes of a batch together, images included."""

    setting: Setting
    n_scenes: int
    timing: Timing

    @property
    def steps_a_second(self) -> float:
        return self.n_scenes / self.timing.median


def throughput(
    subject: Subject, setting: Setting, clock: Clock, repeats: int = 20, n_scenes: int = BATCH
) -> Throughput:
    """Of a batch of ``n_scenes``, the subject's scenes in turn."""
    runner = subject.runner(dataclasses.replace(setting, captured=False))
    numbers = [n % len(subject.scenes) for n in range(n_scenes)]
    frames = runner.frames([subject.scenes[n] for n in numbers], [subject.views[n][0] for n in numbers])
    state, cameras = runner.encode(frames), subject.cameras_of(numbers, 0)
    timing = time_call(lambda: runner.images(runner.newest(runner.step(state)), cameras), clock, repeats)
    return Throughput(setting, n_scenes, timing)


@dataclass(frozen=True)
class TrainingStep:
    """Seconds of one optimizer step with the checkpoint's own configuration, last stage; or why it cannot be had."""

    batch: int = 0
    horizon: int = 0
    timing: Timing | None = None
    problem: str = ""


def training_step(subject: Subject, clock: Clock, repeats: int = 3) -> TrainingStep:
    """Trains on the subject's scenes from new weights, and keeps nothing."""
    saved = subject.restored.checkpoint.config.get("train")
    if saved is None:
        return TrainingStep(problem="the checkpoint does not hold the configuration of its training")
    try:
        config = from_dict(TrainConfig, saved, "train")
        stage = dataclasses.replace(config.stages[-1], steps=10**6)
        config = dataclasses.replace(config, stages=(stage,))
        with tempfile.TemporaryDirectory() as folder, deterministic():
            trainer = Trainer(config, subject.scenes, folder, device=subject.restored.device.type)
            trainer.simulator.train()
            timing = time_call(trainer.train_step, clock, repeats, warm_up=1)
    except InputError as error:
        return TrainingStep(problem=str(error))
    return TrainingStep(stage.batch, stage.horizon, timing)
