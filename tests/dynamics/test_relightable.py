"""Relightable background: the network reads its initial latents, so that errors do not accumulate."""

import dataclasses

import pytest
import torch

from gsim3d.dynamics import rollout
from gsim3d.state import DYNAMIC, FROZEN, append_step, concatenate, last_steps, with_attribute
from tests.asserts import assert_same_bits
from tests.dynamics.scenes import EXPLICIT, SEEING, TINY, batch, float_fields, make_dynamics, make_history

RELIGHTABLE = dataclasses.replace(TINY, background="relightable", priors=SEEING)
pytestmark = pytest.mark.usefixtures("one_thread")


def frozen_rows(particles):
    return particles.activity == FROZEN


def with_latents(particles, rows, latents):
    return dataclasses.replace(
        particles, dynamic_latents=torch.where(rows[:, None], latents, particles.dynamic_latents)
    )


def test_network_reads_background_of_newest_step_only():
    dynamics, history = make_dynamics(RELIGHTABLE), make_history((40, 40, 30))
    older = frozen_rows(history) & (history.row_cloud() < 2)
    assert older.any()
    other = with_latents(history, older, torch.full_like(history.dynamic_latents, 9.0))
    assert_same_bits(dynamics(other).means, dynamics(history).means)
    moved = dataclasses.replace(history, means=torch.where(older[:, None], history.means + 0.05, history.means))
    assert_same_bits(dynamics(moved).dynamic_latents, dynamics(history).dynamic_latents)
    newest = frozen_rows(history) & (history.row_cloud() == 2)
    seen = with_latents(history, newest, torch.full_like(history.dynamic_latents, 9.0))
    assert not torch.equal(dynamics(seen).means, dynamics(history).means)
    symmetric = make_dynamics(dataclasses.replace(RELIGHTABLE, background="symmetric"))
    assert not torch.equal(symmetric(other).means, symmetric(history).means)


def test_network_reads_initial_latents_of_background():
    dynamics, history = make_dynamics(RELIGHTABLE), make_history((30, 30))
    history = with_attribute(history, "initial_latents")
    frozen = frozen_rows(history)
    dark = with_latents(history, frozen, torch.full_like(history.dynamic_latents, -3.0))
    expected, step = dynamics(history), dynamics(dark)
    for name, value in float_fields(expected).items():
        assert_same_bits(getattr(step, name), value, name)
    newest = last_steps(history, 1)
    frozen = frozen_rows(newest)
    assert_same_bits(step.initial_latents[frozen], newest.dynamic_latents[frozen])
    assert not torch.equal(step.dynamic_latents[frozen], newest.dynamic_latents[frozen])


@pytest.mark.parametrize("features, is_seen", [("all", False), ("dynamic", False), ("frozen", True), ("none", True)])
def test_network_reads_initial_latents_of_changing_bodies(features, is_seen):
    """With constant latents, the network reads the current ones."""
    dynamics, history = make_dynamics(RELIGHTABLE), with_attribute(make_history((30, 30)), "initial_latents")
    bodies = history.activity == DYNAMIC
    dark = with_latents(history, bodies, torch.full_like(history.dynamic_latents, -3.0))
    changes = dynamics.layout.changes(features)
    before, step = dynamics(history, changes=changes), dynamics(dark, changes=changes)
    assert torch.equal(step.means, before.means) != is_seen


def test_predicted_changes_do_not_accumulate():
    """The same prediction is not added again in every step."""
    dynamics, history = make_dynamics(RELIGHTABLE), make_history((30, 30, 30, 30))
    still = {name: value[:30].repeat(4, *[1] * (value.dim() - 1)) for name, value in history.row_fields().items()}
    history = history.with_clouds(history.clouds, **still)
    bodies, frozen = (last_steps(history, 1).activity == kind for kind in (DYNAMIC, FROZEN))

    def predict(state):
        step, before = dynamics(state), last_steps(state, 1)
        step = dataclasses.replace(
            step,
            means=before.means,
            velocity=torch.zeros_like(before.means),
            dynamic_latents=torch.where(bodies[:, None], before.dynamic_latents, step.dynamic_latents),
        )
        return dynamics.initialize(step)

    first, *others = rollout(predict, history, 4, 4)
    assert not torch.equal(first.dynamic_latents[frozen], history.dynamic_latents[:30][frozen])
    for step in others:
        assert_same_bits(step.dynamic_latents, first.dynamic_latents)


def test_rollout_continues_from_its_steps():
    dynamics = make_dynamics(RELIGHTABLE)
    history = batch([make_history((30, 20)), make_history((10, 25), 1)])
    whole = rollout(dynamics, history, 5, 4)
    begun = rollout(dynamics, history, 2, 4)
    state = concatenate([history, *begun], 4)
    assert_same_bits(rollout(dynamics, state, 3, 4)[-1].dynamic_latents, whole[-1].dynamic_latents)
    one_by_one = history
    for _ in range(5):
        one_by_one = append_step(one_by_one, dynamics(one_by_one), 4)
    assert_same_bits(last_steps(one_by_one, 1).dynamic_latents, whole[-1].dynamic_latents)


def test_scenes_are_independent():
    dynamics = make_dynamics(RELIGHTABLE)
    histories = [make_history((30, 20), 1), make_history((15, 25), 2)]
    together = dynamics(batch(histories))
    alone = [dynamics(history) for history in histories]
    assert_same_bits(together.dynamic_latents, torch.cat([step.dynamic_latents for step in alone]))
    assert_same_bits(together.means, torch.cat([step.means for step in alone]))


def test_gradients_flow_to_initial_latents():
    dynamics, history = make_dynamics(RELIGHTABLE), make_history((30, 30))
    latents = history.dynamic_latents.requires_grad_()
    steps = rollout(dynamics, history, 3, 4)
    (gradient,) = torch.autograd.grad(steps[-1].dynamic_latents.square().sum(), [latents])
    frozen, newest = frozen_rows(history), history.row_cloud() == 1
    assert gradient[frozen & newest].abs().amax(1).gt(0).all()
    assert gradient[frozen & ~newest].eq(0).all()


def test_explicit_models_are_refused():
    with pytest.raises(ValueError, match='background="relightable" does not support explicit models'):
        dataclasses.replace(EXPLICIT, background="relightable")
