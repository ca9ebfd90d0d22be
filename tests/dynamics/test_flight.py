"""Matter in flight flies on, turns and falls, whatever is predicted; what touches something does what is predicted."""

import dataclasses

import pytest
import torch

from gsim3d.dynamics import DynamicsConfig, last_steps, rollout
from gsim3d.dynamics.flight import touching
from gsim3d.dynamics.matter import Matter
from gsim3d.state import DYNAMIC, FROZEN
from tests.asserts import assert_close_relative_to_max, assert_same_bits
from tests.dynamics.scenes import TINY, batch, make_dynamics, make_history

pytestmark = pytest.mark.usefixtures("one_thread")

LENGTH, CONTACT, CELL = 0.2, 0.15, 0.02
FALL = (0.0, 0.0, -0.005)
RADIUS = 0.2
FLYING = dataclasses.replace(
    TINY, grid_size=CELL, motion_length=LENGTH, velocity=True, deformation=True, contact_length=CONTACT, gravity=FALL
)


def ball(height, velocity=(0.0, 0.0, 0.0), spin=(0.0, 0.0, 0.0), n=300, ground=True, seed=0):
    """A ball of 20 cm whose lowest point is so high over a ground of frozen rows, 4 cm apart; metres and steps."""
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


def flight_of(history, dynamics=None):
    return (dynamics or make_dynamics(FLYING)).flight(history)


@pytest.mark.parametrize("ground", [True, False])
def test_in_flight_bodies_follow_a_parabola_and_turn_whatever_is_predicted(ground):
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


def test_on_the_ground_what_is_predicted_counts_in_full():
    """That of shares of motions as far as each row is near the ground."""
    history = ball(0.0, (0.03, 0.0, 0.0))
    moves = history.activity == DYNAMIC
    flight = flight_of(history)
    assert (flight.touch[moves] == 1).all() and not flight.falls[moves].any()
    lowest, highest = history.means[moves, 2].argmin(), history.means[moves, 2].argmax()
    near = flight.near[moves, 0]
    assert near[lowest] > 0.95 and near[highest] < 0.05
    steps = [rollout(make_dynamics(FLYING, seed=seed), history, 1, max_steps=2)[0] for seed in (0, 1)]
    assert (steps[0].means - steps[1].means)[moves].abs().amax(1).gt(1e-4).all()


def test_how_far_a_body_touches_falls_with_its_height():
    heights = (0.0, 0.05, 0.1, 0.13, 0.2, 0.3, 1.0)
    touch = torch.stack([flight_of(ball(h)).touch[-300:].mean() for h in heights])
    assert (touch.diff() <= 0).all() and touch[0] == 1 and 0.05 < touch[3] < 0.95
    assert touch[-2] < 0.02 and touch[-1] < 1e-6
    assert not flight_of(ball(0.0, ground=False)).touch.any()


def test_where_products_are_rounded_it_is_the_same():
    history = ball(0.35)
    with torch.autocast("cpu", torch.bfloat16):
        rounded = flight_of(history)
    assert_same_bits(rounded.touch, flight_of(history).touch)


def test_scenes_do_not_see_each_other():
    one, other = ball(0.2), ball(0.0, seed=2, n=200, ground=False)
    both = flight_of(batch([one, other]))
    assert_close_relative_to_max(both.touch, torch.cat([flight_of(q).touch for q in (one, other)]), 1e-4)


def test_where_there_is_nothing_nothing_touches():
    history = ball(0.02)
    nobody = history.select_rows(torch.zeros(history.n_rows, dtype=torch.bool))
    flight = flight_of(nobody)
    assert flight.near.shape == flight.touch.shape == (0, 1) and flight.falls.shape == (0, 3)
    means = history.means.clone()
    means[-1], means[3] = torch.nan, torch.inf
    assert flight_of(dataclasses.replace(history, means=means)).touch.isfinite().all()


def test_a_model_without_gravity_knows_no_flight():
    assert make_dynamics(dataclasses.replace(FLYING, gravity=None)).flight(ball(1.0)) is None


def test_training_reaches_gravity_and_velocities():
    dynamics, history = make_dynamics(FLYING), ball(0.3, (0.0, 0.0, -0.05), n=100)
    history = dataclasses.replace(history, velocity=history.velocity.requires_grad_())
    steps = rollout(dynamics, history, 3, max_steps=2)
    assert_same_bits(steps[0].velocity, steps[0].means - history.means)
    steps[-1].means.square().sum().backward()
    assert dynamics.gravity.grad[2].abs() > 0 and dynamics.gravity.grad.isfinite().all()
    assert history.velocity.grad[history.activity == DYNAMIC].abs().amax(1).gt(0).all()


def test_a_gpu_finds_the_same(devices):
    history = batch([ball(0.2, (0.01, 0.0, -0.05)), ball(0.1, seed=2, ground=False)])
    expected, actual, again = (
        flight_of(history.to(d), make_dynamics(FLYING).to(d)).touch.cpu() for d in (*devices, devices[1])
    )
    assert_close_relative_to_max(actual, expected, 1e-4)
    assert_same_bits(again, actual)


def test_compiled_it_is_the_same(device):
    history = ball(0.35, n=50).to(device)
    near = flight_of(history, make_dynamics(FLYING).to(device)).near
    history.clouds

    def found(near, history):
        return touching(near, Matter.of(history, CELL, LENGTH))

    expected = found(near, last_steps(history, 1))
    assert 0 < expected[-50:].mean() < 1
    assert_close_relative_to_max(torch.compile(found, fullgraph=True)(near, history), expected, 1e-4)


@pytest.mark.parametrize(
    "change", [{"velocity": False}, {"contact_length": None}, {"steps_per_call": 2}, {"gravity": (1.0,)}]
)
def test_settings_that_make_no_sense_are_refused(change):
    with pytest.raises(ValueError, match="gravity"):
        DynamicsConfig(**{**dataclasses.asdict(FLYING), **change})
