"""What becomes of bodies if nothing is predicted: free fall, contacts, and the way back to a shape."""

import dataclasses

import pytest
import torch

from gsim3d.dynamics import DynamicsConfig, last_steps, rollout
from gsim3d.dynamics.mechanics import Law, mechanics
from gsim3d.types import ASLEEP, DYNAMIC, FROZEN
from tests.asserts import assert_close_relative_to_max, assert_same_bits
from tests.dynamics.scenes import TINY, batch, make_dynamics, make_history, permute_rows

pytestmark = pytest.mark.usefixtures("one_thread")

LENGTH, CONTACT, CELL = 0.2, 0.15, 0.02
HOW = LENGTH, CONTACT, CELL
FALL = (0.0, 0.0, -0.005)
RADIUS = 0.2
OBEYING = dataclasses.replace(
    TINY, grid_size=CELL, motion_length=LENGTH, velocity=True, deformation=True, contact_length=CONTACT, gravity=FALL
)


def law(gravity=FALL, stiffness=0.8, friction=1.0, damping=0.5, dtype=torch.float32):
    return Law(*(torch.tensor(x, dtype=dtype) for x in (gravity, stiffness, friction, damping)))


def ball(height, velocity=(0.0, 0.0, 0.0), spin=(0.0, 0.0, 0.0), n=300, ground=True, opacity=0.9, seed=0):
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
        opacities=torch.full_like(history.opacities, opacity),
        velocity=torch.cat([0 * floor, turning + torch.tensor(velocity)]),
        reference=means,
    )


def film(history, n_steps, of=None):
    """[n_steps + 1, n, 3]: where the ball's rows are, from the middle of the ground."""
    moves, shown = history.activity == DYNAMIC, [history.means]
    for _ in range(n_steps):
        step = mechanics(history, *HOW, of or law())
        history = dataclasses.replace(history, means=history.means + step, velocity=step)
        shown.append(history.means)
    return torch.stack(shown)[:, moves] - 1.0


def test_in_flight_bodies_follow_a_parabola_and_turn():
    places = film(ball(2.0, (0.03, 0.01, 0.02), (0.0, 0.05, 0.0)), 12)
    k = torch.arange(13.0)[:, None]
    expected = k * torch.tensor([0.03, 0.01, 0.02]) + k * (k + 1) / 2 * torch.tensor(FALL)
    centre = places.mean(1)
    assert_close_relative_to_max(centre - centre[0], expected, 0.03)
    shape = places - centre[:, None]
    turned = torch.tensor(0.6)
    c, s = turned.cos(), turned.sin()
    turn = torch.tensor([[c, 0, s], [0, 1, 0], [-s, 0, c]])
    assert_close_relative_to_max(shape[-1], shape[0] @ turn.T, 0.05)


def test_what_falls_on_the_ground_is_squeezed_and_comes_to_rest():
    places = film(ball(0.3), 120)
    low, centre = places[:, :, 2].amin(1), places[:, :, 2].mean(1)
    lands = int((low < 0.005).nonzero()[0])
    assert 8 < lands < 13  # sqrt(2 0.3 / 0.005) = 11
    assert low.min() > -0.03
    assert centre[lands : lands + 8].min() < RADIUS - 0.01
    assert RADIUS - 0.06 < centre[-1] < RADIUS  # its weight bends it
    assert (centre[-1] - centre[-2]).abs() < 1e-3 and low[-1] > -0.01


def test_stiff_bodies_jump_higher_and_soft_ones_are_squeezed_more():
    soft, stiff = (film(ball(0.3), 40, law(stiffness=s))[:, :, 2] for s in (0.3, 0.9))
    lowest = soft.mean(1).min(), stiff.mean(1).min()
    assert lowest[0] < lowest[1] - 0.02
    assert stiff.mean(1)[14:].max() > soft.mean(1)[14:].max() + 0.02


def test_friction_makes_what_slides_turn_and_slows_it():
    slides = ball(0.0, (0.05, 0.0, 0.0))
    rough, smooth = (film(slides, 10, law(friction=f, damping=0.0)) for f in (1.0, 0.0))
    assert smooth[-1, :, 0].mean() > 0.48
    assert rough[-1, :, 0].mean() < smooth[-1, :, 0].mean() - 0.03
    top = slides.means[slides.activity == DYNAMIC, 2].argmax()
    forward = [(x[-1, top] - x[-1].mean(0))[0] for x in (smooth, rough)]
    assert forward[0].abs() < 0.05 and forward[1] > forward[0] + 0.05  # it rolls


def test_damping_ends_rolling():
    rolls = ball(0.0, (0.04, 0.0, 0.0), (0.0, 0.2, 0.0))
    free, damped = (film(rolls, 40, law(damping=d))[-1, :, 0].mean() for d in (0.0, 0.5))
    assert damped < 0.6 * free


@pytest.mark.parametrize("change", ["no ground", "transparent", "beside it"])
def test_nothing_stops_what_meets_nothing(change):
    history = ball(0.02, ground=change != "no ground")
    if change == "transparent":
        opacities = torch.where(history.activity == FROZEN, 0.3, history.opacities)
        history = dataclasses.replace(history, opacities=opacities)
    if change == "beside it":
        aside = torch.where((history.activity == DYNAMIC)[:, None], torch.tensor([1.5, 0.0, 0.0]), 0)
        history = dataclasses.replace(history, means=history.means + aside, reference=history.reference + aside)
    centre = film(history, 10)[:, :, 2].mean(1)
    assert_close_relative_to_max(centre[-1] - centre[0], torch.tensor(55 * FALL[2]), 0.02)


def test_a_ceiling_stops_what_rises():
    history = ball(0.3)
    flipped = torch.tensor([1.0, 1.0, -1.0])
    means = 1 + (history.means - 1) * flipped
    history = dataclasses.replace(history, means=means, reference=means)
    high = film(history, 30, law(gravity=(0.0, 0.0, 0.005)))[:, :, 2]
    assert high.amax() < 0.03 and high[-1].amax() > -0.15


def test_a_bent_body_goes_back_to_its_shape():
    history = ball(2.0)
    moves = history.activity == DYNAMIC
    centre = history.means[moves].mean(0)
    squeezed = centre + (history.means - centre) * torch.tensor([1.1, 1.1, 0.7])
    squeezed = torch.where(moves[:, None], squeezed, history.means)
    places = film(dataclasses.replace(history, means=squeezed), 8, law(gravity=(0.0, 0.0, 0.0)))
    before = history.means[moves] - 1.0
    assert (places[-1] - before).norm(dim=1).mean() < 0.2 * (places[0] - before).norm(dim=1).mean()


def test_what_rests_or_sleeps_does_not_move():
    history = ball(0.1)
    asleep = torch.where(torch.arange(len(history.activity)) % 7 == 0, ASLEEP, history.activity).to(torch.uint8)
    step = mechanics(dataclasses.replace(history, activity=asleep), *HOW, law())
    assert not step[asleep != DYNAMIC].any() and step[asleep == DYNAMIC].abs().amax(1).gt(0).all()


def test_scenes_do_not_see_each_other_and_rows_have_no_order():
    one, other = ball(0.02, (0.01, 0.0, -0.05)), ball(0.1, seed=2, n=200, ground=False)
    both = mechanics(batch([one, other]), *HOW, law())
    assert_close_relative_to_max(both, torch.cat([mechanics(q, *HOW, law()) for q in (one, other)]), 1e-4)
    shuffled, order = permute_rows(one)
    assert_close_relative_to_max(mechanics(shuffled, *HOW, law()), mechanics(one, *HOW, law())[order], 0.02)


def test_far_from_the_origin_it_is_the_same():
    near = ball(0.02, (0.01, 0.0, -0.05))
    moved = {"means": near.means + 400, "origin": near.origin + 400, "reference": near.reference + 400}
    far = mechanics(dataclasses.replace(near, **moved), *HOW, law())
    assert_close_relative_to_max(far, mechanics(near, *HOW, law()), 0.02)


def test_nothing_and_no_numbers_spoil_nothing():
    history = ball(0.02, (0.0, 0.0, -0.05))
    nobody = history.select_rows(torch.zeros(history.n_rows, dtype=torch.bool))
    assert mechanics(nobody, *HOW, law()).shape == (0, 3)
    means = history.means.clone()
    means[-1], means[3] = torch.nan, torch.inf
    step = mechanics(dataclasses.replace(history, means=means), *HOW, law())
    assert step.isfinite().all()
    assert_close_relative_to_max(step[10:-1], mechanics(history, *HOW, law())[10:-1], 0.1)


@pytest.mark.parametrize("wanted", ["velocity", "gravity", "stiffness", "friction", "damping"])
def test_gradients_are_those_of_differences(wanted):
    """In float64, of a ball that slides as it lands."""
    history = ball(0.01, (0.02, 0.0, -0.03), n=60)
    history = dataclasses.replace(history, reference=history.reference * torch.tensor([0.9, 1.0, 1.1]))  # it is bent
    exact = {name: getattr(history, name).double() for name in ("means", "velocity", "reference")}
    history = dataclasses.replace(history, **exact)
    laws = law(friction=0.3, dtype=torch.float64)
    g = torch.Generator().manual_seed(1)
    weights = torch.rand(history.means.shape, generator=g, dtype=torch.float64)
    value = history.velocity if wanted == "velocity" else getattr(laws, wanted)
    way = torch.randn(value.shape, generator=g, dtype=torch.float64) * (0.01 if value.dim() else 1)

    def total(x):
        if wanted == "velocity":
            return (mechanics(dataclasses.replace(history, velocity=x), *HOW, laws) * weights).sum()
        return (mechanics(history, *HOW, dataclasses.replace(laws, **{wanted: x})) * weights).sum()

    x = value.clone().requires_grad_()
    (gradient,) = torch.autograd.grad(total(x), [x])
    slope = (gradient * way).sum()
    difference = (total(value + 1e-6 * way) - total(value - 1e-6 * way)) / 2e-6
    # Of the second half of the step places are constants to the gradient, which is that of velocities.
    assert slope.abs() > 1e-6 and abs(float(difference - slope)) < 0.15 * abs(float(difference))


def test_a_gpu_finds_the_same(devices):
    history = batch([ball(0.02, (0.01, 0.0, -0.05)), ball(0.1, seed=2, ground=False)])
    of = {d: Law(*(x.to(d) for x in dataclasses.astuple(law()))) for d in devices}
    expected, actual = (mechanics(history.to(d), *HOW, of[d]).cpu() for d in devices)
    assert_close_relative_to_max(actual, expected, 1e-3)
    assert_same_bits(mechanics(history.to(devices[1]), *HOW, of[devices[1]]).cpu(), actual)


def test_compiled_it_is_the_same(device):
    history = ball(0.02, (0.01, 0.0, -0.05), n=50).to(device)
    of = Law(*(x.to(device) for x in dataclasses.astuple(law())))
    history.clouds
    compiled = torch.compile(mechanics, fullgraph=True)
    assert_close_relative_to_max(compiled(history, *HOW, of), mechanics(history, *HOW, of), 1e-3)


def test_untrained_dynamics_obeys_and_training_reaches_its_law():
    dynamics = make_dynamics(dataclasses.replace(OBEYING, zero_init=True))
    history = ball(0.02, (0.0, 0.0, -0.05), n=100)
    middle = history.means[history.activity == DYNAMIC].mean(0)
    bent = middle + (history.means - middle) * torch.tensor([1.0, 1.0, 1.2])
    history = dataclasses.replace(history, velocity=history.velocity.requires_grad_(), reference=bent)
    steps = rollout(dynamics, history, 3, max_steps=2)
    expected = mechanics(history, *HOW, dynamics.law())
    assert_close_relative_to_max(steps[0].means - history.means, expected, 1e-4)
    assert_same_bits(steps[0].velocity, steps[0].means - history.means)
    steps[-1].means.square().sum().backward()
    assert dynamics.gravity.grad[2].abs() > 0 and dynamics.contacts.grad.abs().gt(0).sum() >= 2
    moves = history.activity == DYNAMIC
    assert history.velocity.grad[moves].abs().amax(1).gt(0).all()


@pytest.mark.parametrize("value", [-1.0, 0.0, 1.0, 5.0])
def test_a_law_that_training_took_to_its_limits_still_has_gradients(value):
    dynamics, history = make_dynamics(OBEYING), ball(0.02, (0.0, 0.0, -0.05), n=100)
    dynamics.contacts.data.fill_(value)
    step = mechanics(history, *HOW, dynamics.law())
    step.square().sum().backward()
    assert step.isfinite().all()
    assert dynamics.contacts.grad.isfinite().all() and dynamics.gravity.grad.isfinite().all()


@pytest.mark.parametrize(
    "change", [{"velocity": False}, {"contact_length": None}, {"steps_per_call": 2}, {"gravity": (1.0,)}]
)
def test_settings_that_make_no_sense_are_refused(change):
    with pytest.raises(ValueError, match="gravity"):
        DynamicsConfig(**{**dataclasses.asdict(OBEYING), "quirks": OBEYING.quirks, **change})
