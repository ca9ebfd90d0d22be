"""Positions and displacements below a cell as features of the network."""

import dataclasses

import pytest
import torch

from gsim3d.priors import SubcellMotionConfig
from tests.asserts import assert_close_relative_to_max, assert_same_bits
from tests.dynamics.scenes import TINY, make_dynamics, make_history
from tests.priors.scenes import context, with_priors

pytestmark = pytest.mark.usefixtures("one_thread")
PLAIN = dataclasses.replace(TINY, position_features=False)
SEEING = with_priors(PLAIN, SubcellMotionConfig())


def centered(history):
    """The same history with all particles in the centers of their cells, and no velocity."""
    cells = torch.floor((history.means.double() - history.row_origin()) / TINY.grid_size) + 0.5
    means = (history.row_origin() + TINY.grid_size * cells).float()
    return dataclasses.replace(history, means=means, velocity=torch.zeros_like(means))


def nudged(history):
    return dataclasses.replace(history, means=history.means + 0.3 * TINY.grid_size)


def displacements(dynamics, history):
    newest = history.means[history.cu_rows[-2] :]
    return (dynamics(history).means.double() - newest.double()).float()


def test_without_it_the_network_is_blind_below_a_cell():
    dynamics, history = make_dynamics(PLAIN), centered(make_history())
    assert_close_relative_to_max(displacements(dynamics, nudged(history)), displacements(dynamics, history), 1e-4)


@pytest.mark.parametrize("change", ["position", "velocity"])
def test_network_reads_both(change):
    dynamics, history = make_dynamics(SEEING), centered(make_history())
    moved = nudged(history) if change == "position" else dataclasses.replace(history, velocity=history.velocity + 0.02)
    before = displacements(dynamics, history)
    assert_close_relative_to_max(displacements(dynamics, moved), before, 1e-4)  # projections begin at 0
    torch.nn.init.normal_(dynamics.priors.get("subcell_motion").in_proj.weight)
    assert (displacements(dynamics, moved) - displacements(dynamics, history)).abs().max() > 1e-3 * before.abs().max()


def test_features():
    history = centered(make_history())
    velocity = torch.rand(history.means.shape, generator=torch.Generator().manual_seed(0)) - 0.5
    moved = dataclasses.replace(nudged(history), velocity=velocity)
    ctx = context(moved, SubcellMotionConfig(), grid_size=TINY.grid_size)
    inside, last = ctx.priors.get("subcell_motion").features(ctx).split(3, 1)
    assert_close_relative_to_max(inside, torch.full_like(inside, 0.6), 1e-3)
    assert_close_relative_to_max(last, velocity / TINY.grid_size, 1e-6)


def test_step_holds_its_displacement():
    dynamics, history = make_dynamics(SEEING), make_history()
    step = dynamics(history)
    newest = history.means[history.cu_rows[-2] :]
    assert step.velocity.abs().max() > 0
    assert_same_bits(step.velocity, step.means - newest)
