"""Steps that cannot be used: nothing changes, the log says why, and a run that cannot go on says what to do."""

import dataclasses
import math

import pytest
import torch

from gsim3d.errors import InputError, NumericalError
from gsim3d.io import checkpoint
from gsim3d.numerics.report import StabilityReport
from gsim3d.train.config import PhaseConfig
from gsim3d.train.gradients import StepWatch, mean_of_norms, norms_by_module
from gsim3d.train.loop import Trainer
from tests.test_simulator import awake, make_frames, make_simulator
from tests.tiny_scenes import write_scenes
from tests.train.test_loop import CONFIG, curve, scenes

pytestmark = pytest.mark.usefixtures("one_thread")
PHASE = PhaseConfig(steps=8, horizon=2, target_views=1, learning_rate=1e-3)
SETTINGS = dataclasses.replace(CONFIG, phases=(PHASE,), checkpoint_every=2)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return write_scenes(tmp_path_factory.mktemp("scenes"), 2)


def spoil(trainer, steps, factor=math.nan):
    """At these steps the loss is multiplied by ``factor``."""
    loss = trainer.loss
    trainer.loss = lambda *given: tuple(value * (factor if trainer.step in steps else 1) for value in loss(*given))


def contents(trainer):
    moments = {f"{i}.{k}": v for i, state in enumerate(trainer.optimizer.state.values()) for k, v in state.items()}
    average = {f"average.{name}": value for name, value in trainer.average.items()}
    return {name: value.clone() for name, value in {**trainer.simulator.state_dict(), **moments, **average}.items()}


@pytest.mark.parametrize("norm", ["layer", "batch"])
def test_a_skipped_step_leaves_weights_moments_averages_and_statistics(folder, tmp_path, norm):
    settings = dataclasses.replace(SETTINGS, model={"dynamics": {"norm": norm}})
    trainer = Trainer(settings, scenes(folder), tmp_path)
    trainer.simulator.train()
    assert "skipped" not in trainer.train_step()
    before = contents(trainer)
    spoil(trainer, [1])
    entry = trainer.train_step()
    assert entry["skipped"] == "the loss is not finite" and trainer.n_skipped == 1
    after = contents(trainer)
    assert len(after) > len(trainer.parameters) and all(torch.equal(after[name], before[name]) for name in before)
    assert "skipped" not in trainer.train_step() and trainer.n_skipped_in_a_row == 0


def test_a_gradient_that_is_not_finite_is_named(folder, tmp_path):
    trainer = Trainer(SETTINGS, scenes(folder), tmp_path)
    gradients = trainer._gradients

    def broken(samples):
        loss, errors, grads, watch = gradients(samples)
        grads = [g if g is None else torch.full_like(g, math.inf if i == 3 else 1.0) for i, g in enumerate(grads)]
        return loss, errors, grads, watch

    trainer._gradients = broken
    third = list(trainer.parameters)[3]
    entry = trainer.train_step()
    assert entry["skipped"] == f"the gradient is not finite, first that of {third}"
    assert entry["grad_norm_by_module"]["encoder"] == "inf" and math.isfinite(entry["loss"])


def test_unusable_number_skips_the_step(folder, tmp_path):
    trainer = Trainer(SETTINGS, scenes(folder), tmp_path)
    encode = trainer.simulator.encode

    def broken(frames, **options):
        particles = encode(frames, **options)
        latents = particles.dynamic_latents.clone()
        latents[5] = math.nan
        return dataclasses.replace(particles, dynamic_latents=latents)

    trainer.simulator.encode = broken
    entry = trainer.train_step()
    assert entry["skipped"].startswith("rollout: particles.dynamic_latents: not finite")
    assert entry["loss"] == "nan" and trainer.n_skipped == 1
    settings = dataclasses.replace(SETTINGS, model={"stability": {"on_invalid": "drop"}})
    trainer = Trainer(settings, scenes(folder), tmp_path)
    encode, trainer.simulator.encode = trainer.simulator.encode, broken
    entry = trainer.train_step()
    assert "skipped" not in entry and entry["unusable_particles"] >= 1 and math.isfinite(entry["grad_norm"])


def test_a_run_that_only_skips_stops_and_can_go_on_with_another_rate(folder, tmp_path):
    optimizer = dataclasses.replace(CONFIG.optimizer, max_skipped=3)
    settings = dataclasses.replace(SETTINGS, optimizer=optimizer)
    trainer = Trainer(settings, scenes(folder), tmp_path)
    spoil(trainer, range(3, 9))
    with pytest.raises(NumericalError) as caught:
        trainer.run(progress=False)
    message = str(caught.value)
    assert message.startswith(
        "training: 3 consecutive steps were skipped up to step 5, the last because the loss is not finite"
    )
    assert "optimizer.clip_norm" in message and str(tmp_path) in message and caught.value.step == 5
    assert [line["step"] for line in curve(tmp_path) if "skipped" in line] == [3, 4, 5]
    saved = checkpoint.load(tmp_path)
    assert all(bool(value.isfinite().all()) for value in saved.model.values())
    calmer = dataclasses.replace(
        settings,
        phases=(dataclasses.replace(PHASE, learning_rate=1e-4),),
        optimizer=dataclasses.replace(optimizer, clip_norm=0.1),
    )
    trainer = Trainer(calmer, scenes(folder), tmp_path)
    assert trainer.step == saved.state["step"] == 4
    trainer.run(progress=False)
    assert trainer.step == 8 and trainer.n_skipped_in_a_row == 0
    with pytest.raises(InputError, match="different 'phases'"):
        Trainer(dataclasses.replace(calmer, phases=(dataclasses.replace(PHASE, horizon=1),)), scenes(folder), tmp_path)


def test_norms_of_gradients_are_logged_by_module_and_by_step(folder, tmp_path):
    trainer = Trainer(SETTINGS, scenes(folder), tmp_path)
    entry = trainer.train_step()
    assert sorted(entry["grad_norm_by_module"]) == ["dynamics", "encoder", "renderer"]
    together = math.sqrt(sum(norm**2 for norm in entry["grad_norm_by_module"].values()))
    assert together == pytest.approx(entry["grad_norm"], rel=1e-5)
    assert len(entry["grad_norm_by_step"]) == 2 and all(norm > 0 for norm in entry["grad_norm_by_step"])
    seldom = Trainer(dataclasses.replace(SETTINGS, log_every=7), scenes(folder), tmp_path / "seldom")
    seldom.train_step()
    assert "grad_norm_by_module" not in seldom.train_step()


def test_norms_through_a_rollout_are_those_of_its_states():
    simulator, frames = awake(make_simulator()), make_frames((2,))
    watch = StepWatch()
    steps = simulator.rollout(simulator.encode(frames), 3, report=StabilityReport())
    watch.follow(steps)
    loss = steps[-1].means.square().sum() + steps[-1].dynamic_latents.square().sum()
    fields = [[step.means, step.dynamic_latents, step.static_latents, step.opacities] for step in steps]
    grads = [torch.autograd.grad(loss, f, retain_graph=True, allow_unused=True) for f in fields]
    watch.follow(steps)  # forgets what those calls left
    loss.backward()
    for norm, expected in zip(watch.norms(), grads, strict=True):
        total = math.sqrt(sum(float(g.double().square().sum()) for g in expected if g is not None))
        assert norm == pytest.approx(total, rel=1e-6)
    assert mean_of_norms([[3.0, 0.0], [4.0, 2.0]]) == [2.5, 1.0]


class Blocked(torch.autograd.Function):
    """An operator that returns no gradient, as those on CUDA do for what nothing reads."""

    @staticmethod
    def forward(ctx, x):
        return x.clone()

    @staticmethod
    def backward(ctx, grad):
        return None


def test_norms_where_an_operator_returns_no_gradient():
    step = make_simulator().encode(make_frames((1,)))
    step = dataclasses.replace(step, means=2 * step.means.detach().requires_grad_())
    watch = StepWatch()
    watch.follow([step])
    Blocked.apply(step.means).sum().backward()
    assert watch.norms() == [0.0]


def test_norms_by_module_without_gradient():
    grads = {"a.x": torch.tensor([3.0]), "a.y": torch.tensor([4.0]), "b.z": None, "c.w": torch.zeros(2)}
    assert norms_by_module(grads) == {"a": 5.0, "c": 0.0}
