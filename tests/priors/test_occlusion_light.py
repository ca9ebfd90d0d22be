"""Optical depth towards directional lights, and its use in the dynamics."""

import copy
import dataclasses
from functools import partial

import pytest
import torch

from gsim3d.dynamics import rollout
from gsim3d.errors import InputError
from gsim3d.priors import DirectionalLightConfig
from gsim3d.priors.lighting import optical_depth
from gsim3d.priors.movable import Movable
from gsim3d.priors.padding import SAMPLES
from gsim3d.state import ASLEEP, DYNAMIC, FROZEN, last_steps
from tests.asserts import assert_close_relative_to_max, assert_same_bits
from tests.dynamics.scenes import TINY, batch, make_dynamics, make_history, permute_rows
from tests.priors.scenes import with_priors

pytestmark = pytest.mark.usefixtures("one_thread")

CELL = 0.02
ZENITH = torch.tensor([[0.0, 0.0, 1.0]])
LIGHTS = ((0.0, 0.0, 1.0), (0.0, 0.6, 0.8))
OCCLUSION = DirectionalLightConfig(directions=LIGHTS, shading="occlusion", strength=0.2, unit=0.1, beam=2.0)
LAMBERT = DirectionalLightConfig(directions=LIGHTS)
LIT = with_priors(TINY, OCCLUSION)
HEIGHT, RADIUS, SPACING = 0.6, 0.2, 0.05


def shade(history, lights, cell):
    """Optical depth of the newest particles, [N, L]."""
    return optical_depth(Movable(history, cell), lights, cell, beam=2.0)


def light_of(dynamics):
    return dynamics.priors.get("directional_light")


def under_a_ball(n=600, seed=0, n_steps=2, height=HEIGHT):
    """Frozen particles of a ground 5 cm apart, and a ball of 20 cm (the last ``n`` particles) over its center."""
    g = torch.Generator().manual_seed(seed)
    ticks = (torch.arange(41) - 20) * SPACING
    x, y = (v.flatten() for v in torch.meshgrid(ticks, ticks, indexing="ij"))
    ball = torch.nn.functional.normalize(torch.randn(n, 3, generator=g), dim=1) * RADIUS
    places = torch.cat([torch.stack([x, y, 0 * x], 1), ball + torch.tensor([0.0, 0.0, height])]) + 1.0
    history = make_history((len(places),) * n_steps, seed=seed)
    activity = torch.tensor([FROZEN] * len(x) + [DYNAMIC] * n).repeat(n_steps)
    return dataclasses.replace(history, means=places.repeat(n_steps, 1), activity=activity.to(history.activity.dtype))


def ground_of(history, lights=ZENITH):
    """Optical depth and positions of the ground's particles."""
    frozen = last_steps(history, 1).activity == FROZEN
    places = last_steps(history, 1).means[frozen] - 1.0
    return shade(history, lights, CELL)[frozen], places


@pytest.mark.parametrize("light", [(0.0, 0.0, 1.0), (0.0, 0.0, 0.02), (0.6, 0.0, 0.8), (-0.3, 0.5, 0.8)])
def test_optical_depth_of_shadow(light):
    light = torch.tensor([light])
    shaded, places = ground_of(under_a_ball(), light)
    way = torch.tensor([0.0, 0.0, HEIGHT]) - places
    off = torch.linalg.cross(way, (light / light.norm()).expand_as(way)).norm(dim=1)
    inside, outside = off < RADIUS - 0.05, off > RADIUS + 0.15
    assert inside.any() and outside.any()
    assert shaded[inside].min() > 1 and shaded[outside].max() < 0.1


def test_far_side_of_body_is_occluded():
    history = under_a_ball(2000)
    newest = last_steps(history, 1)
    shaded = shade(history, ZENITH, CELL)[newest.activity == DYNAMIC][:, 0]
    height = newest.means[newest.activity == DYNAMIC, 2] - 1.0 - HEIGHT
    assert shaded[height > 0.8 * RADIUS].mean() < 0.3 and shaded[height < -0.7 * RADIUS].min() > 2


def test_bodies_behind_light_or_at_rest_occlude_nothing():
    below = under_a_ball(height=-HEIGHT)
    assert ground_of(below)[0].max() < 1e-6
    over = under_a_ball()
    for activity in (FROZEN, ASLEEP):
        rests = torch.where(over.activity == DYNAMIC, activity, over.activity).to(torch.uint8)
        assert not shade(dataclasses.replace(over, activity=rests), ZENITH, CELL).any()


def test_samples_stand_for_all_particles():
    few, many = (ground_of(under_a_ball(n))[0].exp() - 1 for n in (SAMPLES, 4 * SAMPLES))
    assert abs(float(many.sum() / few.sum()) - 4) < 0.2


def test_direction_gradient_matches_finite_difference():
    """Along every axis, in float64."""
    history = under_a_ball(300)
    history = dataclasses.replace(history, means=history.means.double())
    light = torch.tensor([[0.2, 0.1, 0.5]], dtype=torch.float64, requires_grad=True)
    weights = torch.rand(last_steps(history, 1).n_rows, 1, dtype=torch.float64)

    def total(x):
        return (shade(history, x, CELL) * weights).sum()

    (gradient,) = torch.autograd.grad(total(light), [light])
    for axis in range(3):
        step = torch.zeros(1, 3, dtype=torch.float64)
        step[0, axis] = 1e-5
        difference = (total(light.detach() + step) - total(light.detach() - step)) / 2e-5
        assert abs(float(difference - gradient[0, axis])) < 1e-4 * float(gradient.abs().max())


def test_batch_equals_single_scenes_in_any_order():
    one, other = under_a_ball(200), make_history((7, 50), seed=1)
    both = shade(batch([one, other]), ZENITH, CELL)
    assert_close_relative_to_max(both, torch.cat([shade(q, ZENITH, CELL) for q in (one, other)]), 1e-5)
    shuffled, order = permute_rows(one)
    newest = order[one.cu_rows[-2] :] - one.cu_rows[-2]
    assert_close_relative_to_max(shade(shuffled, ZENITH, CELL), shade(one, ZENITH, CELL)[newest], 1e-5)


def test_far_from_origin():
    near = under_a_ball()
    far = dataclasses.replace(near, means=near.means + 500, origin=near.origin + 500)
    assert_close_relative_to_max(shade(far, ZENITH, CELL), shade(near, ZENITH, CELL), 0.01)


@pytest.mark.parametrize("n_rows", [(0, 50), (1, 1)])
def test_optical_depth_without_movable_particles(n_rows):
    found = shade(make_history(n_rows, frozen_share=1.0), ZENITH, CELL)
    assert found.shape == (n_rows[-1], 1) and not found.any()


def test_invalid_positions_give_finite_results():
    history = under_a_ball()
    means = history.means.clone()
    means[-1], means[-5], means[-2000] = torch.nan, torch.inf, torch.nan
    found = shade(dataclasses.replace(history, means=means), ZENITH, CELL)
    assert found.isfinite().all() and found.any()


def test_on_gpu(devices):
    history, lights = batch([under_a_ball(), make_history((30, 40))]), torch.tensor([[0.2, 0.1, 0.5]])
    expected, actual = (shade(history.to(device), lights.to(device), CELL).cpu() for device in devices)
    assert_close_relative_to_max(actual, expected, 1e-4)
    assert_same_bits(shade(history.to(devices[1]), lights.to(devices[1]), CELL).cpu(), actual)


def test_compiled(device):
    history, lights = under_a_ball(50).to(device), ZENITH.to(device)
    history.clouds
    compiled = torch.compile(shade, fullgraph=True)
    assert_close_relative_to_max(compiled(history, lights, CELL), shade(history, lights, CELL), 1e-4)


def test_network_reads_occlusion_and_direction_has_gradient():
    """Zeroing the projections of the features changes the prediction; gradients flow through the irradiance."""
    dynamics, history = make_dynamics(LIT), under_a_ball(100)
    torch.nn.init.normal_(light_of(dynamics).in_proj.weight)
    torch.nn.init.normal_(light_of(dynamics).gain_head.weight)
    step = dynamics(history)
    assert not (step.irradiance_gain == 1).all()
    step.irradiance_gain.square().sum().backward()
    assert light_of(dynamics).directions.grad.abs().amax(1).gt(0).all()
    for columns in (slice(0, 2), slice(2, 4)):  # now, and where rows were encoded
        other = copy.deepcopy(dynamics)
        with torch.no_grad():
            light_of(other).in_proj.weight[:, columns] = 0
        assert (other(history).dynamic_latents - step.dynamic_latents).abs().max() > 1e-5


def unoccluded(n_rows, n_lights=2):
    return torch.zeros(n_rows, n_lights)


@pytest.mark.parametrize("background", ["symmetric", "relightable"])
def test_irradiance_gain_compares_now_with_encoding(background):
    config = dataclasses.replace(LIT, zero_init=True, background=background)
    dynamics, history = make_dynamics(config), under_a_ball()
    light_of(dynamics).extinction.data = torch.tensor([[0.3, 0.2, 0.1], [0.0, 0.1, 0.2]])
    shaded = shade(history, torch.tensor(LIGHTS), LIT.grid_size)
    assert shaded.amin(0).max() < 0.1 and shaded.amax(0).min() > 2
    began = 0.5 + unoccluded(history.n_rows)
    step = dynamics(dynamics.initialize(dataclasses.replace(history, light_occlusion=began)))
    expected = (2 * (((0.5 - shaded) @ light_of(dynamics).extinction) / 2).tanh()).exp()
    assert_close_relative_to_max(step.irradiance_gain, expected, 1e-5)
    assert_same_bits(step.light_occlusion[:, :2], began[: len(shaded)])
    assert_close_relative_to_max(step.light_occlusion[:, 2:], shaded, 1e-5)
    change = torch.tensor([0.1, 0.0, -0.4])
    light_of(dynamics).gain_head.bias.detach()[:] = change
    step = dynamics(history)  # as far as is known they began here
    assert_close_relative_to_max(step.light_occlusion, shaded.repeat(1, 2), 1e-5)
    brighter = step.irradiance_gain
    assert_close_relative_to_max(brighter, (2 * (change / 2).tanh()).exp().expand_as(brighter), 1e-5)


def test_irradiance_gain_does_not_accumulate():
    """It is computed anew in every step."""
    dynamics, history = make_dynamics(dataclasses.replace(LIT, zero_init=True)), under_a_ball()
    held = torch.zeros(history.n_rows, dtype=torch.bool)
    held[::3] = True
    history = dynamics.initialize(
        dataclasses.replace(history, light_occlusion=0.5 + unoccluded(history.n_rows), frozen_appearance=held)
    )
    for who in ("all", "dynamic", "frozen", "none"):
        first, *_, last = rollout(partial(dynamics, changes=dynamics.layout.changes(who)), history, 3, 2)
        rows, moves = last_steps(history, 1).frozen_appearance, last_steps(history, 1).activity == DYNAMIC
        kept = rows | {"all": rows, "dynamic": ~moves, "frozen": moves, "none": ~rows}[who]
        assert (last.irradiance_gain[kept] == 1).all() and (last.irradiance_gain[~kept] != 1).any() == (who != "none")
        assert_same_bits(last.irradiance_gain, first.irradiance_gain)  # nothing moved


def test_encoded_particles_have_light_occlusion():
    dynamics, history = make_dynamics(LIT), under_a_ball(n_steps=2)
    known = dynamics.initialize(history)
    newest = known.row_cloud() == 1
    shaded = shade(history, light_of(dynamics).directions, LIT.grid_size)
    assert_close_relative_to_max(known.light_occlusion[newest], shaded.repeat(1, 2), 1e-6)
    assert (known.light_occlusion[~newest] == -1).all()
    gone = known.select_rows(known.activity == FROZEN)  # the ball is taken away: its shadow goes with it
    step = make_dynamics(dataclasses.replace(LIT, zero_init=True))(gone)
    before = last_steps(gone, 1).light_occlusion[:, :2].sum(1)
    assert (step.irradiance_gain[before > 2] > 1.2).all() and (step.irradiance_gain[before == 0] == 1).all()


@pytest.mark.parametrize("directions", [(), ((0.0, 0.0, 0.0),), ((0.0, 1.0),)])
def test_directions_must_be_vectors(directions):
    with pytest.raises(InputError, match="directions"):
        DirectionalLightConfig(directions=directions)


def test_asymmetric_background_is_refused():
    with pytest.raises(InputError, match="directional_light needs background"):
        dataclasses.replace(LIT, background="asymmetric")


@pytest.mark.parametrize("light", [OCCLUSION, LAMBERT], ids=["occlusion", "lambert"])
def test_shadow_follows_body_in_same_step(light):
    """A step has the light of its final positions, which the next step starts from."""
    config = with_priors(LIT, light, grid_size=CELL, zero_init=True)
    dynamics, history = make_dynamics(config), under_a_ball()
    names = [name for name, n in dynamics.layout.outputs for _ in range(n)]
    dynamics.net.head.fc2.bias.detach()[names.index("means")] = 2.0
    known = dynamics.initialize(history)
    for step in (dynamics(known),):
        moved = (step.means - last_steps(known, 1).means)[:, 0].abs().max()
        here = dynamics.initialize(step)
        assert moved > 0.2
        assert_close_relative_to_max(step.light_occlusion, here.light_occlusion, 1e-6)
        n_lights = len(LIGHTS)
        assert (step.light_occlusion[:, :n_lights] - step.light_occlusion[:, -n_lights:]).abs().max() > 0.3
        assert (step.irradiance_gain[step.activity == FROZEN] - 1).abs().max() > 0.1


@pytest.mark.parametrize("light", [OCCLUSION, LAMBERT], ids=["occlusion", "lambert"])
def test_sleeping_particles_keep_light_occlusion(light):
    config = with_priors(LIT, light, grid_size=CELL)
    dynamics, history = make_dynamics(config), under_a_ball()
    known = dynamics.initialize(history)
    asleep = torch.arange(known.n_rows) % 2 == 0
    known = dataclasses.replace(known, activity=torch.where(asleep, ASLEEP, known.activity))
    rows = last_steps(known, 1).activity == ASLEEP
    step = dynamics(known)
    assert_same_bits(step.light_occlusion[rows], last_steps(known, 1).light_occlusion[rows])
    assert_same_bits(dynamics.initialize(step).light_occlusion[rows], step.light_occlusion[rows])
    assert (step.light_occlusion[rows] > 0).any() and not torch.equal(
        step.light_occlusion[~rows], last_steps(known, 1).light_occlusion[~rows]
    )
