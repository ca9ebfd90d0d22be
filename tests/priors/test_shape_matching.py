"""Shape matching: residuals to the rest shape, and elastic displacements."""

import dataclasses
import math

import pytest
import torch

from gsim3d.dynamics import rollout
from gsim3d.effects.edits import Move, Rotate
from gsim3d.priors import InertiaConfig, ShapeMatchingConfig
from gsim3d.priors.rigid import best_rotation
from gsim3d.state import FROZEN, last_steps
from tests.asserts import assert_close_relative_to_max, assert_same_bits
from tests.dynamics.scenes import TINY, batch, make_dynamics, make_history
from tests.priors.scenes import build, context, with_priors

pytestmark = pytest.mark.usefixtures("one_thread")

LENGTH = 0.2
BACK = 0.3
MATCHING = ShapeMatchingConfig(radius=LENGTH, stiffness=BACK, position_gradients=False)
ELASTIC = with_priors(TINY, InertiaConfig(radius=LENGTH), MATCHING)
QUARTER = torch.tensor([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
SQUEEZED = torch.diag(torch.tensor([1.1, 1.1, 0.7]))


def residual(history, radius=LENGTH, priors=None):
    ctx = context(history, dataclasses.replace(MATCHING, radius=radius), grid_size=TINY.grid_size, priors=priors)
    return ctx.priors.get("shape_matching").residual(ctx)


def bent(matrix, n=300, seed=0, frozen_share=0.0):
    """A ball of 10 cm with rest center (1, 1, 1), now at (1.2, 1, 0.9) and deformed by ``matrix``."""
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
def test_best_rotation_of_points(size):
    g, turns = torch.Generator().manual_seed(1), random_rotations(50)
    points = torch.randn(50, 100, 3, generator=g, dtype=torch.float64) * torch.tensor(size, dtype=torch.float64)
    found = best_rotation((points @ turns.mT).mT @ points)
    torch.testing.assert_close(found, turns, atol=1e-6, rtol=0)


def test_best_rotation_matches_polar_decomposition():
    """For random matrices."""
    g = torch.Generator().manual_seed(2)
    products = torch.eye(3) + 0.3 * torch.randn(40, 3, 3, generator=g, dtype=torch.float64)
    u, _, vh = torch.linalg.svd(products)
    sign = torch.linalg.det(u @ vh)
    nearest = u @ torch.diag_embed(torch.stack([torch.ones_like(sign), torch.ones_like(sign), sign], 1)) @ vh
    torch.testing.assert_close(best_rotation(products), nearest, atol=1e-6, rtol=0)


def test_best_rotation_of_nothing():
    assert not best_rotation(torch.zeros(2, 3, 3)).any()


@pytest.mark.parametrize("degrees", [0, 60, 180])
def test_rigid_motion_has_no_residual(degrees):
    turn = torch.linalg.matrix_exp(math.radians(degrees) * torch.tensor([[0.0, -0.6, 0.8], [0.6, 0, 0], [-0.8, 0, 0]]))
    assert residual(bent(turn)).abs().max() < 1e-5


@pytest.mark.parametrize("turn", [torch.eye(3), QUARTER])
def test_residual_of_squeezed_body(turn):
    """With a window larger than the body."""
    history = bent(turn @ SQUEEZED)
    way = residual(history, 1.0)
    expected = (history.rest_positions - 1) @ turn.T - (history.means - torch.tensor([1.2, 1.0, 0.9]))
    assert_close_relative_to_max(way, expected - expected.mean(0), 0.05)


def test_residual_in_small_window():
    history = bent(SQUEEZED)
    way = residual(history, 0.05)
    top = history.rest_positions[:, 2] > 1.08
    assert 0.002 < way[top, 2].mean() < 0.028


def test_batch_equals_single_scenes():
    scenes = [bent(SQUEEZED), bent(QUARTER @ SQUEEZED, seed=2)]
    together = residual(batch(scenes))
    assert_close_relative_to_max(together, torch.cat([residual(scene) for scene in scenes]), 1e-4)


def test_frozen_particles_have_no_residual():
    history = bent(SQUEEZED, frozen_share=0.3)
    frozen = history.activity == FROZEN
    way = residual(history)
    assert not way[frozen].any() and way[~frozen].any()
    assert_close_relative_to_max(way[~frozen], residual(history.select_rows(~frozen)), 1e-4)


def test_residual_without_particles_or_rest_shape():
    history = bent(SQUEEZED)
    empty = history.select_rows(torch.zeros(300, dtype=torch.bool))
    assert make_dynamics(ELASTIC)(empty).n_rows == 0
    assert residual(dataclasses.replace(history, rest_positions=None)).abs().max() < 1e-6


def test_invalid_position_changes_no_other_particle():
    history = bent(SQUEEZED)
    means, others = history.means.clone(), torch.arange(300) != 7
    means[7] = torch.nan
    reference = torch.where(others[:, None], history.rest_positions, torch.nan)
    way = residual(dataclasses.replace(history, means=means, rest_positions=reference))
    assert way.isfinite().all()
    assert_close_relative_to_max(way[others], residual(history)[others], 0.05)


def test_rollout_keeps_rest_positions():
    dynamics, history = make_dynamics(ELASTIC), make_history((60, 60))
    steps = rollout(dynamics, history, 3, max_steps=2)
    for step in steps:
        assert_same_bits(step.rest_positions, last_steps(history, 1).means)


@pytest.mark.parametrize("background", ["asymmetric", "relightable"])
def test_shape_matching_for_every_background(background):
    config = dataclasses.replace(ELASTIC, norm="layer", background=background, zero_init=True)
    history = bent(SQUEEZED, frozen_share=0.3)
    moved = make_dynamics(config)(history).means - history.means
    assert_close_relative_to_max(moved, BACK * residual(history), 1e-3)


def test_gain_adds_to_stiffness():
    history = bent(SQUEEZED)
    dynamics = make_dynamics(dataclasses.replace(ELASTIC, zero_init=True))
    dynamics.priors.get("shape_matching").gain_head.bias.detach()[:] = 2 * torch.tensor(0.1).atanh()
    moved = dynamics(history).means - history.means
    assert_close_relative_to_max(moved, (0.2 + BACK) * residual(history), 1e-3)


def test_untrained_rollout_restores_shape():
    config = with_priors(TINY, MATCHING, zero_init=True)
    history = bent(SQUEEZED)
    step = make_dynamics(config)(history)
    assert_close_relative_to_max(step.means - history.means, BACK * residual(history), 1e-3)
    end = rollout(make_dynamics(config), history, 12, max_steps=1)[-1]
    assert residual(end).abs().max() < 0.05 * residual(history).abs().max()


def test_network_reads_features():
    """Zeroing the projections of the features changes the prediction."""
    dynamics, history = make_dynamics(ELASTIC), bent(SQUEEZED)
    torch.nn.init.normal_(dynamics.priors.get("shape_matching").in_proj.weight)
    step = dynamics(history)
    with torch.no_grad():
        dynamics.priors.get("shape_matching").in_proj.weight[:] = 0
    assert (dynamics(history).dynamic_latents - step.dynamic_latents).abs().max() > 1e-6


@pytest.mark.parametrize("edit", [Move(by=(0.1, 0.0, 0.2)), Rotate(axis=(1.0, 2.0, 0.5), degrees=130)])
def test_edits_leave_no_residual(edit):
    history = bent(torch.eye(3))
    assert residual(edit.apply(history, None)).abs().max() < 1e-5


def test_on_gpu(devices):
    expected, actual = (residual(bent(SQUEEZED).to(device)).cpu() for device in devices)
    assert_close_relative_to_max(actual, expected, 1e-4)


def test_compiled(device):
    history = bent(SQUEEZED).to(device)
    history.clouds
    priors, compiled = build(history, MATCHING), torch.compile(residual, fullgraph=True)
    assert_close_relative_to_max(compiled(history, priors=priors), residual(history), 1e-4)
