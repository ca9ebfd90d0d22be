"""What the background does to rows near it their body takes as one; what its rows do to each other does not move it."""

import dataclasses

import pytest
import torch

from gsim3d.dynamics import DynamicsConfig, rollout
from gsim3d.dynamics.matter import Matter
from gsim3d.dynamics.push import pushed
from gsim3d.types import DYNAMIC
from tests.asserts import assert_close_relative_to_max, assert_same_bits
from tests.dynamics.scenes import batch, make_dynamics
from tests.dynamics.test_flight import CELL, FLYING, RADIUS, ball

pytestmark = pytest.mark.usefixtures("one_thread")

WIDE = 5.0  # metres: a window of all rows alike
PUSHED = dataclasses.replace(FLYING, pushes=True)
ONE = torch.ones(())


def touched(history):
    """[N, 1], the lowest tenth of the ball's radius."""
    return ((history.activity == DYNAMIC) & (history.means[:, 2] < 1.0 + 0.1 * RADIUS)).to(history.means)[:, None]


def shares(history, changes, inertia=ONE, length=WIDE):
    """How ``changes`` of the ball are shared, and where its rows are from its centre."""
    found = pushed(changes, touched(history), Matter.of(history, CELL, length), length, inertia)
    moves = history.activity == DYNAMIC
    places = history.means[moves] - history.means[moves].mean(0)
    return found[moves], places


def noise(history, seed=0):
    return 0.01 * torch.randn(history.n_rows, 3, generator=torch.Generator().manual_seed(seed))


def test_what_rows_do_to_each_other_neither_moves_nor_turns_their_body():
    history = ball(0.0)
    found, places = shares(history, torch.where(touched(history) > 0, 0, noise(history) + 0.02))
    assert found.abs().max() > 0.01
    assert found.mean(0).abs().max() < 1e-4 and torch.linalg.cross(places, found).mean(0).abs().max() < 1e-5


@pytest.mark.parametrize("push", [(0.0, 0.0, 0.03), (0.02, 0.0, 0.0), (0.01, -0.01, 0.02)])
@pytest.mark.parametrize("inertia", [1.0, 0.6])
def test_a_push_moves_and_turns_the_body_by_where_it_is(push, inertia):
    history, push = ball(0.0), torch.tensor(push)
    found, places = shares(history, touched(history) * push, torch.tensor(inertia))
    assert_close_relative_to_max(found.mean(0), push, 0.05)
    momentum = torch.linalg.cross(places, found).mean(0)
    lever = places[(touched(history)[history.activity == DYNAMIC] > 0)[:, 0]].mean(0)
    assert_close_relative_to_max(momentum, torch.linalg.cross(lever, push) / inertia, 0.05)
    # but for what the pushed rows do beside the others, all rows go on as one
    others = (touched(history)[history.activity == DYNAMIC] == 0)[:, 0]
    turn = torch.linalg.lstsq(torch.stack([torch.linalg.cross(e.expand_as(places), places) for e in torch.eye(3)], 2)
                              .flatten(0, 1), (found - found.mean(0)).flatten()[:, None]).solution[:, 0]  # fmt: skip
    as_one = push + torch.linalg.cross(turn.expand_as(places), places)
    assert (found - as_one)[others].norm(dim=1).mean() < 0.15 * push.norm()


def test_rows_that_cannot_move_keep_what_they_were_given_and_scenes_do_not_meet():
    one, other = ball(0.0), ball(0.0, n=200, seed=3)
    both = batch([one, other])
    changes = [noise(history, seed) for seed, history in enumerate((one, other))]
    found = pushed(torch.cat(changes), touched(both), Matter.of(both, CELL, 0.2), 0.2, ONE)
    alone = [pushed(c, touched(h), Matter.of(h, CELL, 0.2), 0.2, ONE) for c, h in zip(changes, (one, other))]
    assert_close_relative_to_max(found, torch.cat(alone), 1e-5)
    rests = both.activity != DYNAMIC
    assert_same_bits(found[rests], torch.cat(changes)[rests])
    assert_same_bits(pushed(changes[0], touched(one), None, 0.2, ONE), changes[0])


def test_gradients():
    history = dataclasses.replace(ball(0.0, n=20, ground=False), velocity=None, reference=None)
    history = dataclasses.replace(history, means=history.means.double())
    matter, near = Matter.of(history, CELL, 0.3), 0.5 * touched(history) + 0.1
    changes, inertia = noise(history).double().requires_grad_(), torch.tensor(0.7, dtype=torch.float64).requires_grad_()
    assert torch.autograd.gradcheck(lambda c, i: pushed(c, near, matter, 0.3, i), (changes, inertia))


def test_in_flight_nothing_pushes():
    history = ball(2.0, (0.03, 0.01, 0.02), (0.0, 0.05, 0.0))
    one, other = (rollout(make_dynamics(config), history, 5, max_steps=2)[-1] for config in (PUSHED, FLYING))
    moves = history.activity == DYNAMIC
    assert_close_relative_to_max((one.means - history.means)[moves], (other.means - history.means)[moves], 2e-3)


def test_on_the_ground_a_body_is_pushed_and_weights_learn_from_it():
    history = ball(0.0, (0.03, 0.0, 0.0))
    one, other = make_dynamics(PUSHED), make_dynamics(FLYING)
    other.load_state_dict({k: v for k, v in one.state_dict().items() if k != "inertia"})
    means = [rollout(dynamics, history, 1, max_steps=2)[0].means for dynamics in (one, other)]
    moves = history.activity == DYNAMIC
    assert (means[0] - means[1])[moves].abs().max() > 1e-4
    assert_same_bits(means[0][~moves], means[1][~moves])
    means[0].square().sum().backward()
    assert one.inertia.grad.abs() > 0 and one.net.head.fc2.weight.grad.any()


def test_a_gpu_pushes_the_same(devices):
    history = ball(0.0)
    changes, near = noise(history), touched(history)
    expected, actual, again = (
        pushed(changes.to(d), near.to(d), Matter.of(history.to(d), CELL, 0.2), 0.2, ONE.to(d)).cpu()
        for d in (*devices, devices[1])
    )
    assert_close_relative_to_max(actual, expected, 1e-4)
    assert_same_bits(again, actual)


def test_compiled_it_is_the_same(device):
    history = ball(0.0, n=60).to(device)
    changes, near = noise(history.to("cpu")).to(device), touched(history)
    history.clouds

    def found(changes, near, history):
        return pushed(changes, near, Matter.of(history, CELL, 0.2), 0.2, ONE.to(changes))

    expected = found(changes, near, history)
    assert_close_relative_to_max(torch.compile(found, fullgraph=True)(changes, near, history), expected, 1e-4)


def test_pushes_need_gravity():
    with pytest.raises(ValueError, match="pushes needs gravity"):
        DynamicsConfig(**{**dataclasses.asdict(PUSHED), "quirks": PUSHED.quirks, "gravity": None})
