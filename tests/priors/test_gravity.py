"""Gravity: ballistic flight for any prediction, and full predictions in contact."""

import dataclasses

import pytest
import torch

from gsim3d.dynamics import rollout
from gsim3d.errors import InputError
from gsim3d.priors import GravityConfig, InertiaConfig, ProximityConfig, ShapeMatchingConfig
from gsim3d.state import DYNAMIC, FROZEN, last_steps
from tests.asserts import assert_close_relative_to_max, assert_same_bits
from tests.dynamics.scenes import TINY, batch, make_dynamics, make_history
from tests.priors.scenes import build, context, with_priors, without_prior

pytestmark = pytest.mark.usefixtures("one_thread")

LENGTH, CONTACT, CELL = 0.2, 0.15, 0.02
FALL = (0.0, 0.0, -0.005)
RADIUS = 0.2
GRAVITY = GravityConfig(acceleration=FALL, radius=LENGTH)
NEAR = ProximityConfig(range=CONTACT)
FLYING = with_priors(
    dataclasses.replace(TINY, grid_size=CELL),
    NEAR,
    InertiaConfig(radius=LENGTH),
    ShapeMatchingConfig(radius=LENGTH, stiffness=0.3),
    GRAVITY,
)


def ball(height, velocity=(0.0, 0.0, 0.0), spin=(0.0, 0.0, 0.0), n=300, ground=True, seed=0):
    """A ball of 20 cm with its lowest point at ``height`` over frozen particles 4 cm apart."""
    g = torch.Generator().manual_seed(seed)
    places = RADIUS * torch.nn.functional.normalize(torch.randn(n, 3, generator=g), dim=1)
    ticks = (torch.arange(40) - 20) * 0.04
    x, y = (v.flatten() for v in torch.meshgrid(ticks, ticks, indexing="ij"))
    floor = torch.stack([x, y, 0 * x], 1)[: len(x) if ground else 0]
    turning = torch.linalg.cross(torch.tensor(spin).expand_as(places), places)
    history = make_history((len(floor) + n,), seed=seed)
    activity = torch.tensor([FROZEN] * len(floor) + [DYNAMIC] * n, dtype=history.activity.dtype)
    means = torch.cat([floor, places + torch.tensor([0.0, 0.0, height + RADIUS])]) + 1.0
    return dataclasses.replace(
        history,
        means=means,
        activity=activity,
        opacities=torch.full_like(history.opacities, 0.9),
        velocity=torch.cat([0 * floor, turning + torch.tensor(velocity)]),
        rest_positions=means,
    )


def touch_of(history, priors=None):
    ctx = context(history, NEAR, InertiaConfig(), GRAVITY, grid_size=CELL, priors=priors)
    return ctx.priors.get("gravity").touch(ctx)


@pytest.mark.parametrize("ground", [True, False])
def test_flight_is_ballistic_for_any_prediction(ground):
    history = ball(2.0, (0.03, 0.01, 0.02), (0.0, 0.05, 0.0), ground=ground)
    moves = history.activity == DYNAMIC
    seen = []
    for seed in (0, 1):
        steps = rollout(make_dynamics(FLYING, seed=seed), history, 12, max_steps=2)
        seen.append(torch.stack([history.means, *(step.means for step in steps)])[:, moves] - 1.0)
    assert_close_relative_to_max(seen[1], seen[0], 2e-3)  # how fast it goes back to its shape differs
    k = torch.arange(13.0)[:, None]
    expected = k * torch.tensor([0.03, 0.01, 0.02]) + k * (k + 1) / 2 * torch.tensor(FALL)
    centre = seen[0].mean(1)
    assert_close_relative_to_max(centre - centre[0], expected, 0.03)
    c, s = torch.tensor(0.6).cos(), torch.tensor(0.6).sin()
    turn = torch.tensor([[c, 0, s], [0, 1, 0], [-s, 0, c]])
    shape = seen[0] - centre[:, None]
    assert_close_relative_to_max(shape[-1], shape[0] @ turn.T, 0.05)


def test_touching_bodies_do_not_fall_and_gains_count_in_full():
    history = ball(0.0, (0.03, 0.0, 0.0))
    moves = history.activity == DYNAMIC
    ctx = context(history, NEAR, InertiaConfig(), GRAVITY, grid_size=CELL)
    gravity = ctx.priors.get("gravity")
    assert (gravity.touch(ctx)[moves] == 1).all() and not gravity.fall(ctx)[moves].any()
    steps = []
    for bias in (0.0, 0.5):
        dynamics = make_dynamics(dataclasses.replace(FLYING, zero_init=True))
        torch.nn.init.constant_(dynamics.priors.get("inertia").gain_head.bias, bias)
        steps.append(rollout(dynamics, history, 1, max_steps=2)[0])
    assert (steps[0].means - steps[1].means)[moves].abs().amax(1).gt(1e-4).all()


def test_touch_decreases_with_height():
    heights = (0.0, 0.05, 0.1, 0.13, 0.2, 0.3, 1.0)
    touch = torch.stack([touch_of(ball(h))[-300:].mean() for h in heights])
    assert (touch.diff() <= 0).all() and touch[0] == 1 and 0.05 < touch[3] < 0.95
    assert touch[-2] < 0.02 and touch[-1] < 1e-6
    assert not touch_of(ball(0.0, ground=False)).any()


def test_touch_under_autocast():
    history = ball(0.35)
    with torch.autocast("cpu", torch.bfloat16):
        rounded = touch_of(history)
    assert_same_bits(rounded, touch_of(history))


def test_batch_equals_single_scenes():
    one, other = ball(0.2), ball(0.0, seed=2, n=200, ground=False)
    both = touch_of(batch([one, other]))
    assert_close_relative_to_max(both, torch.cat([touch_of(q) for q in (one, other)]), 1e-4)


def test_gravity_of_empty_or_invalid_scene():
    history = ball(0.02)
    empty = history.select_rows(torch.zeros(history.n_rows, dtype=torch.bool))
    assert make_dynamics(FLYING)(empty).means.shape == (0, 3)
    means = history.means.clone()
    means[-1], means[3] = torch.nan, torch.inf
    assert touch_of(dataclasses.replace(history, means=means)).isfinite().all()


def test_gravity_and_velocity_have_gradients():
    dynamics, history = make_dynamics(FLYING), ball(0.3, (0.0, 0.0, -0.05), n=100)
    history = dataclasses.replace(history, velocity=history.velocity.requires_grad_())
    steps = rollout(dynamics, history, 3, max_steps=2)
    assert_same_bits(steps[0].velocity, steps[0].means - history.means)
    steps[-1].means.square().sum().backward()
    acceleration = dynamics.priors.get("gravity").acceleration
    assert acceleration.grad[2].abs() > 0 and acceleration.grad.isfinite().all()
    assert history.velocity.grad[history.activity == DYNAMIC].abs().amax(1).gt(0).all()


def test_on_gpu(devices):
    history = batch([ball(0.2, (0.01, 0.0, -0.05)), ball(0.1, seed=2, ground=False)])
    expected, actual, again = (touch_of(history.to(d)).cpu() for d in (*devices, devices[1]))
    assert_close_relative_to_max(actual, expected, 1e-4)
    assert_same_bits(again, actual)


def test_compiled_touch(device):
    history = last_steps(ball(0.35, n=50), 1).to(device)
    history.clouds
    priors = build(history, NEAR, InertiaConfig(), GRAVITY)
    expected = touch_of(history)
    assert 0 < expected[-50:].mean() < 1
    assert_close_relative_to_max(torch.compile(touch_of, fullgraph=True)(history, priors), expected, 1e-4)


@pytest.mark.parametrize("name", ["proximity", "inertia"])
def test_gravity_needs_other_priors(name):
    with pytest.raises(InputError, match=f"gravity needs {name} before it"):
        without_prior(FLYING, name)


def test_acceleration_must_be_a_vector():
    with pytest.raises(InputError, match="acceleration must have three components"):
        GravityConfig(acceleration=(1.0,))
