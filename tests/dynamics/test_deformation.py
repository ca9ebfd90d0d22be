"""What rows remember of the shape that bodies had, and what they are told of it."""

import dataclasses
import math

import pytest
import torch

from gsim3d.dynamics import DynamicsConfig, last_steps, rollout, with_attribute
from gsim3d.dynamics.deformation import deformation
from gsim3d.dynamics.rigid import turned_most
from gsim3d.dynamics.state import BACK
from gsim3d.effects.edits import Move, Rotate
from gsim3d.state import FROZEN
from tests.asserts import assert_close_relative_to_max, assert_same_bits
from tests.dynamics.scenes import TINY, batch, make_dynamics, make_history

pytestmark = pytest.mark.usefixtures("one_thread")

LENGTH = 0.2
HOW = LENGTH, TINY.grid_size
REMEMBERING = dataclasses.replace(TINY, motion_length=LENGTH, deformation=True)
QUARTER = torch.tensor([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
SQUEEZED = torch.diag(torch.tensor([1.1, 1.1, 0.7]))


def bent(matrix, n=300, seed=0, frozen_share=0.0):
    """A ball of 10 cm, around (1, 1, 1) at first; now at (1.2, 1, 0.9), its places multiplied by ``matrix``."""
    g = torch.Generator().manual_seed(seed)
    ball = 0.1 * torch.nn.functional.normalize(torch.randn(n, 3, generator=g), dim=1)
    history = make_history((n,), seed=seed, frozen_share=frozen_share)
    now = ball @ matrix.T + torch.tensor([1.2, 1.0, 0.9])
    return dataclasses.replace(history, means=now, rest_positions=1.0 + ball)


def random_rotations(n, dtype=torch.float64):
    g = torch.Generator().manual_seed(3)
    q = torch.linalg.qr(torch.randn(n, 3, 3, generator=g, dtype=dtype))[0]
    return q * torch.linalg.det(q)[:, None, None]


@pytest.mark.parametrize("size", [(0.3, 0.3, 0.3), (0.3, 0.2, 0.0), (0.3, 0.05, 0.05)])
def test_rotations_of_points_are_found(size):
    g, turns = torch.Generator().manual_seed(1), random_rotations(50)
    points = torch.randn(50, 100, 3, generator=g, dtype=torch.float64) * torch.tensor(size, dtype=torch.float64)
    found = turned_most((points @ turns.mT).mT @ points)
    torch.testing.assert_close(found, turns, atol=1e-6, rtol=0)


def test_the_rotation_is_the_nearest_one():
    """Of products of any matrix, as the polar decomposition has it."""
    g = torch.Generator().manual_seed(2)
    products = torch.eye(3) + 0.3 * torch.randn(40, 3, 3, generator=g, dtype=torch.float64)
    u, _, vh = torch.linalg.svd(products)
    sign = torch.linalg.det(u @ vh)
    nearest = u @ torch.diag_embed(torch.stack([torch.ones_like(sign), torch.ones_like(sign), sign], 1)) @ vh
    torch.testing.assert_close(turned_most(products), nearest, atol=1e-6, rtol=0)


def test_of_nothing_it_is_none():
    assert not turned_most(torch.zeros(2, 3, 3)).any()


@pytest.mark.parametrize("degrees", [0, 60, 180])
def test_a_body_that_moves_and_turns_is_not_bent(degrees):
    turn = torch.linalg.matrix_exp(math.radians(degrees) * torch.tensor([[0.0, -0.6, 0.8], [0.6, 0, 0], [-0.8, 0, 0]]))
    assert deformation(bent(turn), *HOW).abs().max() < 1e-5


@pytest.mark.parametrize("turn", [torch.eye(3), QUARTER])
def test_a_squeezed_body_is_told_the_way_back(turn):
    """In a window that is larger than the body, so that all of it counts."""
    history = bent(turn @ SQUEEZED)
    way = deformation(history, 1.0, TINY.grid_size)
    expected = (history.rest_positions - 1) @ turn.T - (history.means - torch.tensor([1.2, 1.0, 0.9]))
    assert_close_relative_to_max(way, expected - expected.mean(0), 0.05)


def test_in_a_window_of_its_size_it_is_told_part_of_it():
    history = bent(SQUEEZED)
    way = deformation(history, 0.05, TINY.grid_size)
    top = history.rest_positions[:, 2] > 1.08
    assert 0.002 < way[top, 2].mean() < 0.028


def test_scenes_do_not_see_each_other():
    scenes = [bent(SQUEEZED), bent(QUARTER @ SQUEEZED, seed=2)]
    together = deformation(batch(scenes), *HOW)
    assert_close_relative_to_max(together, torch.cat([deformation(scene, *HOW) for scene in scenes]), 1e-4)


def test_frozen_rows_are_not_bent_and_do_not_count():
    history = bent(SQUEEZED, frozen_share=0.3)
    frozen = history.activity == FROZEN
    way = deformation(history, *HOW)
    assert not way[frozen].any() and way[~frozen].any()
    assert_close_relative_to_max(way[~frozen], deformation(history.select_rows(~frozen), *HOW), 1e-4)


def test_nothing_is_bent_where_nothing_is_or_nothing_is_remembered():
    history = bent(SQUEEZED)
    assert deformation(history.select_rows(torch.zeros(300, dtype=torch.bool)), *HOW).shape == (0, 3)
    assert deformation(dataclasses.replace(history, rest_positions=None), *HOW).abs().max() < 1e-6


def test_a_place_that_is_none_spoils_nothing():
    history = bent(SQUEEZED)
    means, others = history.means.clone(), torch.arange(300) != 7
    means[7] = torch.nan
    reference = torch.where(others[:, None], history.rest_positions, torch.nan)
    way = deformation(dataclasses.replace(history, means=means, rest_positions=reference), *HOW)
    assert way.isfinite().all()
    assert_close_relative_to_max(way[others], deformation(history, *HOW)[others], 0.05)


def test_simulated_rows_remember_where_they_were():
    dynamics, history = make_dynamics(REMEMBERING), make_history((60, 60))
    steps = rollout(dynamics, history, 3, max_steps=2)
    for step in steps:
        assert_same_bits(step.rest_positions, last_steps(history, 1).means)


@pytest.mark.parametrize("background", ["asymmetric", "relightable"])
def test_where_the_background_is_not_computed_anew_bodies_remember_too(background):
    config = dataclasses.replace(REMEMBERING, norm="layer", background=background, zero_init=True, velocity=True)
    history = with_attribute(bent(SQUEEZED, frozen_share=0.3), "velocity")
    moved = make_dynamics(config)(history).means - history.means
    assert_close_relative_to_max(moved, BACK * deformation(history, *HOW), 1e-3)


def test_a_share_of_the_way_back_is_gone():
    history = with_attribute(bent(SQUEEZED), "velocity")
    dynamics = make_dynamics(dataclasses.replace(REMEMBERING, velocity=True, zero_init=True))
    dynamics.net.head.fc2.bias.detach()[-3:] = 2 * torch.tensor(0.1).atanh()
    moved = dynamics(history).means - history.means
    assert_close_relative_to_max(moved, (0.2 + BACK) * deformation(history, *HOW), 1e-3)


@pytest.mark.parametrize("steps_per_call", [1, 3])
def test_untrained_a_bent_body_gets_its_shape_back(steps_per_call):
    config = dataclasses.replace(REMEMBERING, zero_init=True, steps_per_call=steps_per_call)
    history = bent(SQUEEZED)
    step = last_steps(make_dynamics(config)(history), 1)
    left = (1 - BACK) ** steps_per_call
    assert_close_relative_to_max(step.means - history.means, (1 - left) * deformation(history, *HOW), 1e-3)
    end = rollout(make_dynamics(config), history, 12, max_steps=1)[-1]
    assert deformation(end, *HOW).abs().max() < 0.05 * deformation(history, *HOW).abs().max()


def test_the_network_reads_it():
    """Without the columns that read it the next step is another one."""
    dynamics, history = make_dynamics(REMEMBERING), bent(SQUEEZED)
    step = dynamics(history)
    with torch.no_grad():
        dynamics.net.stem.told.weight[:, :3] = 0
    assert (dynamics(history).dynamic_latents - step.dynamic_latents).abs().max() > 1e-6


@pytest.mark.parametrize("edit", [Move(by=(0.1, 0.0, 0.2)), Rotate(axis=(1.0, 2.0, 0.5), degrees=130)])
def test_edits_that_move_and_turn_bodies_do_not_bend_them(edit):
    history = bent(torch.eye(3))
    assert deformation(edit.apply(history, None), *HOW).abs().max() < 1e-5


def test_a_gpu_finds_the_same(devices):
    expected, actual = (deformation(bent(SQUEEZED).to(device), *HOW).cpu() for device in devices)
    assert_close_relative_to_max(actual, expected, 1e-4)


def test_settings_that_make_no_sense_are_refused():
    with pytest.raises(ValueError, match="deformation needs motion_length"):
        DynamicsConfig(deformation=True)


def test_compiled_it_is_the_same(device):
    history = bent(SQUEEZED).to(device)
    history.clouds
    compiled = torch.compile(deformation, fullgraph=True)
    assert_close_relative_to_max(compiled(history, *HOW), deformation(history, *HOW), 1e-4)
