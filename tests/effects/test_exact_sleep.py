"""Why ``exact`` lets whole scenes sleep only: within a scene every body's next step depends on every other one."""

import dataclasses

import pytest
import torch

from gsim3d.state import DYNAMIC, last_steps
from tests.asserts import assert_same_bits
from tests.dynamics.scenes import TINY, batch, make_history
from tests.effects.resting import ASYMMETRIC, make_simulator

pytestmark = pytest.mark.usefixtures("one_thread")

N, FAR = 60, 1000  # particles of a body; cells between two, many times what all convolutions together reach


def two_bodies(config, nudge=0.0):
    """One scene: a body, and another far away that is ``nudge`` metres from its place."""
    body = make_history((2 * N, 2 * N), frozen_share=0.0)
    other = torch.arange(body.n_rows) % (2 * N) >= N
    shift = torch.tensor([FAR * config.grid_size + nudge, 0.0, 0.0])
    return dataclasses.replace(body, means=body.means + other[:, None] * shift), other


@torch.no_grad()
@pytest.mark.parametrize("config", [TINY, ASYMMETRIC], ids=["symmetric", "asymmetric"])
def test_exact_sleep_scene_with_distant_bodies_stays_awake(config):
    """Else one could sleep while the other moves, and both had the bits of never sleeping."""
    simulator = make_simulator(config)
    state, other = two_bodies(config)
    assert bool((state.activity == DYNAMIC).all())
    (step,) = simulator.rollout(state, 1)
    (nudged,) = simulator.rollout(two_bodies(config, nudge=2 * config.grid_size)[0], 1)
    (alone,) = simulator.rollout(state.select_rows(~other), 1)
    near = ~other[: 2 * N]
    here = last_steps(state, 1).means[near]
    for changed in (nudged.means[near], alone.means):
        assert (changed - step.means[near]).abs().max() > 1e-3 * (step.means[near] - here).abs().max()


@torch.no_grad()
@pytest.mark.parametrize("config", [TINY, ASYMMETRIC], ids=["symmetric", "asymmetric"])
def test_exact_sleep_of_separate_scenes(config):
    simulator = make_simulator(config)
    state, other = two_bodies(config)
    bodies = [state.select_rows(rows) for rows in (~other, other)]
    (both,) = simulator.rollout(batch(bodies), 1)
    for scene, body in enumerate(bodies):
        assert_same_bits(both.select_clouds([scene]).means, simulator.rollout(body, 1)[0].means)
