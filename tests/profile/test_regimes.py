"""Many scenes at once, and a training step with the checkpoint's own configuration."""

import dataclasses
from types import SimpleNamespace

import pytest
import torch

from gsim3d.cuda_graphs import CapturedRollout
from gsim3d.errors import CaptureError
from gsim3d.io.checkpoint import Checkpoint
from gsim3d.io.settings import to_dict
from gsim3d.profile import report
from gsim3d.profile.regimes import _steady_steps, throughput, training_step
from gsim3d.profile.settings import Setting
from gsim3d.profile.timing import DeviceClock
from gsim3d.train.config import DataConfig, PhaseConfig, TrainConfig
from tests.profile.fakes import FakeClock

pytestmark = pytest.mark.usefixtures("one_thread")


def test_scenes_of_a_batch_look_as_alone(subject):
    runner = subject.runner()
    frames = runner.frames(subject.scenes, [views[0] for views in subject.views])
    images = runner.images(runner.newest(runner.step(runner.encode(frames))), subject.cameras_of([0, 1], 0))
    for number in range(2):
        newest = runner.newest(runner.step(subject.start(runner, number)))
        alone = runner.images(newest, subject.cameras(number, 0))
        torch.testing.assert_close(images[number : number + 1], alone, rtol=0, atol=1e-5)


def test_throughput_counts_all_scenes(subject):
    found = throughput(subject, Setting(), DeviceClock("cpu"), repeats=2, n_scenes=3)
    assert found.n_scenes == 3
    assert found.steps_a_second == pytest.approx(3 / found.timing.median)


def test_a_batch_is_replayed_where_the_setting_is(subject, monkeypatch):
    """Four steps of all scenes a replay, and each counts."""
    replays, call = [], CapturedRollout.__call__

    def counted(self, state, cameras=None):
        replays.append((len(state.clouds.scenes), self._n_steps))
        return call(self, state, cameras)

    monkeypatch.setattr(CapturedRollout, "__call__", counted)
    found = throughput(subject, Setting(captured=True), DeviceClock("cpu"), repeats=2, n_scenes=3)
    assert replays == [(3 * subject.restored.data.history, 4)] * 3  # one of them to warm up
    assert len(found.timing.repeats) == 2 and found.steps_a_second == pytest.approx(3 / found.timing.median)
    replays.clear()
    throughput(subject, Setting(), DeviceClock("cpu"), repeats=2, n_scenes=2)
    assert not replays


def test_a_batch_that_cannot_be_captured_is_told(subject, monkeypatch):
    def fails(*args, **options):
        raise CaptureError("Captured: no")

    monkeypatch.setattr("gsim3d.profile.runner.CapturedRollout", fails)
    found = throughput(subject, Setting(captured=True), DeviceClock("cpu"))
    assert found.problem == "Captured: no" and found.steps_a_second is None


def test_what_has_no_memory_is_told(subject, monkeypatch):
    def full(*args, **options):
        raise torch.OutOfMemoryError("too large")

    monkeypatch.setattr("gsim3d.profile.regimes.time_call", full)
    many = throughput(subject, Setting(), DeviceClock("cpu"), n_scenes=3)
    assert many.timing is None and many.steps_a_second is None
    config = TrainConfig(
        phases=(PhaseConfig(steps=5, horizon=1, target_views=1),), data=DataConfig(history=2, context_views=2)
    )
    saved = Checkpoint({}, {"train": to_dict(config)})
    copy = type(subject)(dataclasses.replace(subject.restored, checkpoint=saved), subject.scenes)
    step = training_step(copy, DeviceClock("cpu"))
    assert step.problem == "out of memory, with 1 scenes"
    regimes = report.regimes_as_dict([many], step, [("reference", None)])
    assert report.regimes_in_words(regimes)[0] == "reference: out of memory: 3 scenes together, with images"
    assert regimes["gpu"] == []


def test_training_step_is_of_the_last_phase(subject):
    assert "does not hold the configuration" in training_step(subject, DeviceClock("cpu")).problem
    phases = (PhaseConfig(steps=5, horizon=1), PhaseConfig(steps=5, horizon=2, batch=2, target_views=1))
    config = TrainConfig(phases=phases, data=DataConfig(history=2, context_views=2, background_stride=2), seed=3)

    def trained(config, **options):
        saved = Checkpoint({}, {"train": to_dict(config)})
        copy = dataclasses.replace(subject.restored, checkpoint=saved)
        changed = type(subject)(copy, subject.scenes)
        return training_step(changed, DeviceClock("cpu"), repeats=1, **options)

    step = trained(config)
    assert (step.batch, step.horizon) == (2, 2) and step.timing.median > 0
    long = PhaseConfig(steps=5, horizon=50, cut=2, target_views=1)
    n_steps = min(scene.n_steps for scene in subject.scenes)
    assert trained(dataclasses.replace(config, phases=(long,))).horizon == n_steps - 2
    assert trained(dataclasses.replace(config, phases=(long,)), quick=True).horizon == 2
    ahead = dataclasses.replace(long, history=50)
    assert "do not fit" in trained(dataclasses.replace(config, phases=(ahead,))).problem
    found = report.regimes_as_dict([], step)["training"]
    assert found["step_ms"]["median"] == pytest.approx(1e3 * step.timing.median)


class CapturingTrainer:
    """Captures a graph in the first steps, which takes seconds."""

    def __init__(self, clock, n_captures):
        self.clock, self.captured, self.left = clock, SimpleNamespace(captures=0), n_captures

    def train_step(self):
        new = self.left > 0
        self.left -= new
        self.captured.captures += new
        self.clock.work(7.0 if new else 0.2)


def test_captures_are_no_training_steps():
    clock = FakeClock()
    assert _steady_steps(CapturingTrainer(clock, 3), clock, 3, 1).repeats == pytest.approx((0.2, 0.2, 0.2))
    assert _steady_steps(CapturingTrainer(clock, 1000), clock, 3, 1) is None
