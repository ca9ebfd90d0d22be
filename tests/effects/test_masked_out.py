"""A background that is masked out is not there; one that is frozen is seen. Neither moves the cells of the rest."""

import pytest
import torch

from gsim3d.effects.spec import DynamicsEffects, EffectsSpec
from gsim3d.state import DYNAMIC, FROZEN, last_steps
from tests.asserts import assert_same_bits
from tests.test_simulator import awake, make_frames, make_simulator

pytestmark = pytest.mark.usefixtures("one_thread")


def encoded():
    simulator = awake(make_simulator())
    return simulator, simulator.encode(make_frames((2,))).detach()


def test_masked_out_keeps_cells():
    simulator, state = encoded()
    moving = state.activity == DYNAMIC
    state = state.with_clouds(state.clouds, means=torch.where(moving[:, None], state.means, state.means - 0.37))
    masked = simulator._prepare(state, simulator.plan(EffectsSpec(DynamicsEffects("masked_out"))))
    assert 0 < masked.n_rows == int(moving.sum()) < state.n_rows
    assert (state.means.min(0).values < masked.means.min(0).values).all(), "the background reaches further"
    whole, rest = simulator.dynamics.geometry(state), simulator.dynamics.geometry(masked)
    kept = moving[whole.rows[whole.cu_rows[:-1]]]
    assert torch.equal(whole.stages[0].grid[kept], rest.stages[0].grid)


def test_frozen_background_changes_prediction():
    simulator, state = encoded()
    frozen, masked = (
        simulator.rollout(state, 1, simulator.plan(EffectsSpec(DynamicsEffects(mode))))[0]
        for mode in ("frozen", "masked_out")
    )
    still = frozen.activity == FROZEN
    assert_same_bits(frozen.means[still], last_steps(state, 1).means[still])
    assert masked.n_rows == int((~still).sum()), "absent"
    assert not torch.equal(masked.means, frozen.means[~still]), "moving particles read the background"


def test_masked_out_background_has_no_influence():
    """Any other background, at any place, and the rest has the same bits."""
    simulator, state = encoded()
    plan = simulator.plan(EffectsSpec(DynamicsEffects("masked_out")))
    frozen = state.activity == FROZEN
    means = torch.where(frozen[:, None], state.means.flip(0) - 0.7, state.means)
    other = state.with_clouds(state.clouds, means=means, dynamic_latents=state.dynamic_latents + frozen[:, None])
    for step, expected in zip(simulator.rollout(other, 2, plan), simulator.rollout(state, 2, plan), strict=True):
        assert_same_bits(step.means, expected.means)
        assert_same_bits(step.dynamic_latents, expected.dynamic_latents)
