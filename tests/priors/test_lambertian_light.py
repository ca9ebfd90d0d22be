"""Lambertian light: irradiance of surfaces with shadows, and its use in the dynamics."""

import dataclasses
from functools import partial

import pytest
import torch
from torch.nn import functional as F

from gsim3d.dynamics import rollout
from gsim3d.priors import padding
from gsim3d.priors.lighting import SOFT, lambert
from gsim3d.priors.movable import Movable
from gsim3d.state import ASLEEP, DYNAMIC, FROZEN, last_steps
from tests.asserts import assert_close_relative_to_max, assert_same_bits
from tests.dynamics.scenes import TINY, batch, make_dynamics, make_history, permute_rows
from tests.priors.scenes import with_priors
from tests.priors.test_occlusion_light import CELL, HEIGHT, LAMBERT, RADIUS, light_of, under_a_ball

pytestmark = pytest.mark.usefixtures("one_thread")

SLANTED = torch.tensor([[0.36, 0.24, 0.9]])
TOWARDS = SLANTED[0] / SLANTED[0].norm()
LIT = with_priors(TINY, LAMBERT, grid_size=CELL)


def irradiance(history, lights, cell, facing=None):
    """Irradiance and cosine of the newest particles, [N, L] each."""
    return lambert(Movable(history, cell), lights, cell, LAMBERT, facing)


def opaque(history):
    return dataclasses.replace(history, opacities=torch.full_like(history.opacities, 0.8))


def scene(n=2000, **options):
    """Opaque particles of a ball over a ground."""
    return opaque(under_a_ball(n, **options))


def parts(history, values):
    """Positions of ground (from below the ball's center) and ball (from its center), and their values."""
    newest = last_steps(history, 1)
    moves, places = newest.activity == DYNAMIC, newest.means - 1.0
    return (places[~moves], values[~moves]), (places[moves] - torch.tensor([0.0, 0.0, HEIGHT]), values[moves])


def softened(cosine):
    return ((cosine + SOFT) / (1 + SOFT)).clamp(min=0)


@pytest.mark.parametrize("n", [600, 2000])
def test_cosine_of_ball(n):
    history = scene(n)
    lit, facing = irradiance(history, SLANTED, CELL)
    _, (places, of_ball) = parts(history, torch.cat([lit, facing], 1))
    expected = softened(F.normalize(places, dim=1) @ TOWARDS)
    assert (of_ball[:, 1] - expected).abs().mean() < 0.03
    front = expected > 0.2
    assert (of_ball[front, 0] / of_ball[front, 1]).min() > 0.8  # its own rows do not stand in the way


@pytest.mark.parametrize("light", [(0.0, 0.0, 1.0), (0.0, 0.0, 0.02), (0.6, 0.0, 0.8), (-0.3, 0.5, 0.8)])
def test_shadow_on_ground(light):
    light, history = torch.tensor([light]), scene()
    towards = light[0] / light.norm()
    lit, facing = irradiance(history, light, CELL)
    (places, of_ground), _ = parts(history, torch.cat([lit, facing], 1))
    off = torch.linalg.cross(torch.tensor([0.0, 0.0, HEIGHT]) - places, towards.expand_as(places)).norm(dim=1)
    share = of_ground[:, 0] / of_ground[:, 1]
    assert_close_relative_to_max(of_ground[:, 1], softened(towards[2]).expand(len(places)), 0.01)
    assert share[off < RADIUS].max() < 0.1 and share[off > RADIUS + 0.1].min() > 0.95


def test_sheet_faces_light():
    ticks = torch.arange(30) * 0.03
    x, y = (v.flatten() for v in torch.meshgrid(ticks, ticks, indexing="ij"))
    history = opaque(make_history((len(x),), frozen_share=0.0))
    history = dataclasses.replace(history, means=torch.stack([1 + x, 1 + y, 1 + 0 * x], 1))
    lit, facing = irradiance(history, SLANTED, CELL)
    assert_close_relative_to_max(facing[:, 0], softened(TOWARDS[2]).expand(len(x)), 0.01)
    assert (lit / facing).min() > 0.9


def test_shadow_is_independent_of_number_of_particles():
    few, many = (parts(h, irradiance(h, SLANTED, CELL)[0])[0][1] for h in (scene(700), scene(4000)))
    assert (few - many).abs().mean() < 0.02 and few.min() < 0.3


def test_frozen_sleeping_or_transparent_particles_cast_no_shadow():
    over = scene()
    for activity, opacity in ((FROZEN, 0.8), (ASLEEP, 0.8), (DYNAMIC, 0.1)):
        moves = over.activity == DYNAMIC
        changed = dataclasses.replace(
            over,
            activity=torch.where(moves, activity, over.activity).to(torch.uint8),
            opacities=torch.where(moves, opacity, over.opacities),
        )
        lit, facing = irradiance(changed, SLANTED, CELL)
        assert_same_bits(lit, facing)


def test_known_cosines_of_frozen_particles_are_kept():
    history = scene()
    lit, facing = irradiance(history, SLANTED, CELL)
    again = irradiance(history, SLANTED, CELL, facing=facing)
    assert_same_bits(again[0], lit)
    moves = last_steps(history, 1).activity == DYNAMIC
    half = irradiance(history, SLANTED, CELL, facing=0.5 * facing)
    assert_close_relative_to_max(half[0][~moves], 0.5 * lit[~moves], 1e-6)
    assert_same_bits(half[0][moves], lit[moves])


def test_direction_gradient_matches_finite_difference():
    history = scene(300)
    history = dataclasses.replace(history, means=history.means.double())
    light = torch.tensor([[0.2, 0.1, 0.5]], dtype=torch.float64, requires_grad=True)
    weights = torch.rand(last_steps(history, 1).n_rows, 1, dtype=torch.float64)
    _, known = irradiance(history, light.detach(), CELL)

    def total(x):
        """Irradiance of the ground; the start of rays at the ball has no gradient."""
        lit = irradiance(history, x, CELL, facing=known)[0]
        return (lit * weights)[last_steps(history, 1).activity == FROZEN].sum()

    (gradient,) = torch.autograd.grad(total(light), [light])
    for axis in range(3):
        step = torch.zeros(1, 3, dtype=torch.float64)
        step[0, axis] = 1e-6
        difference = (total(light.detach() + step) - total(light.detach() - step)) / 2e-6
        assert abs(float(difference - gradient[0, axis])) < 1e-3 * float(gradient.abs().max())


def test_batch_equals_single_scenes_in_any_order():
    one, other = scene(200), opaque(make_history((7, 50), seed=1))
    both = torch.cat(irradiance(batch([one, other]), SLANTED, CELL), 1)
    alone = torch.cat([torch.cat(irradiance(q, SLANTED, CELL), 1) for q in (one, other)])
    assert_close_relative_to_max(both, alone, 2e-3)  # the normals of a few rows without order depend on rounding
    shuffled, order = permute_rows(one)
    newest = order[one.cu_rows[-2] :] - one.cu_rows[-2]
    assert_close_relative_to_max(
        irradiance(shuffled, SLANTED, CELL)[0], irradiance(one, SLANTED, CELL)[0][newest], 2e-3
    )


@pytest.mark.parametrize("learns", [False, True])
def test_blocks_one_after_another_have_the_same_bits(learns, monkeypatch):
    history, found = scene(3000), []
    for block_by_block in (padding.block_by_block, lambda f, *blocks: f(*blocks)):
        monkeypatch.setattr(padding, "block_by_block", block_by_block)
        lights = SLANTED.clone().requires_grad_(learns)
        lit, facing = irradiance(history, lights, CELL)
        found.append((lit, facing, *(torch.autograd.grad(lit.sum(), [lights]) if learns else ())))
    for actual, expected in zip(*found, strict=True):
        assert_same_bits(actual, expected)


@pytest.mark.parametrize("n_rows", [(0, 50), (1, 1)])
def test_no_shadow_without_movable_particles(n_rows):
    lit, facing = irradiance(opaque(make_history(n_rows, frozen_share=1.0)), SLANTED, CELL)
    assert lit.shape == facing.shape == (n_rows[-1], 1)
    assert_same_bits(lit, facing)


def test_invalid_positions_give_finite_results():
    history = scene()
    means = history.means.clone()
    means[-1], means[-5], means[-2200] = torch.nan, torch.inf, torch.nan
    for found in irradiance(dataclasses.replace(history, means=means), SLANTED, CELL):
        assert found.isfinite().all() and found.any()


def test_isolated_particle():
    """Windows of a distant particle hold one particle or none."""
    history = scene()
    means = history.means.clone()
    means[-3:] += torch.tensor([[5.0, 0.0, 0.0], [0.0, 7.0, 0.0], [0.0, 0.0, 9.0]])
    lit, facing = irradiance(dataclasses.replace(history, means=means), SLANTED, CELL)
    assert (lit >= 0).all() and (facing <= 1).all() and facing.isfinite().all()


def test_on_gpu(devices):
    history = batch([scene(600), opaque(make_history((30, 40)))])
    expected, actual = (torch.cat(irradiance(history.to(d), SLANTED.to(d), CELL), 1).cpu() for d in devices)
    assert (actual - expected).abs().mean() < 1e-3
    assert_same_bits(torch.cat(irradiance(history.to(devices[1]), SLANTED.to(devices[1]), CELL), 1).cpu(), actual)


def test_compiled(device):
    history, lights = scene(50).to(device), SLANTED.to(device)
    history.clouds
    compiled = torch.compile(irradiance, fullgraph=True)
    for actual, expected in zip(compiled(history, lights, CELL), irradiance(history, lights, CELL)):
        assert_close_relative_to_max(actual, expected, 1e-3)


@pytest.mark.parametrize("background", ["symmetric", "relightable"])
def test_irradiance_gain_is_ratio_times_prediction(background):
    """Irradiance now over that at encoding, times the predicted gain."""
    dynamics, history = make_dynamics(dataclasses.replace(LIT, zero_init=True, background=background)), scene(600)
    strength = torch.tensor([[0.8, 1.0, 1.2], [0.1, 0.0, 0.3]])
    light_of(dynamics).strength.data = strength
    known = dynamics.initialize(history)
    newest = last_steps(known, 1)
    lit, facing, now = newest.light_occlusion.split(2, 1)
    assert_same_bits(lit, now)
    found = irradiance(history, light_of(dynamics).directions, CELL)
    assert_close_relative_to_max(lit, found[0], 1e-6)
    assert_close_relative_to_max(facing, found[1], 1e-6)
    assert (known.light_occlusion[: -newest.n_rows] == -1).all()
    assert (dynamics(known).irradiance_gain - 1).abs().max() < 1e-5  # nothing moved
    moves = newest.activity == DYNAMIC
    aside = torch.where((known.activity == DYNAMIC)[:, None], torch.tensor([0.3, 0.0, 0.0]), 0)
    moved = dataclasses.replace(known, means=known.means + aside)
    step = dynamics(moved)
    then, now = (
        (1 + values @ strength)
        for values in (lit, irradiance(moved, light_of(dynamics).directions, CELL, facing=facing)[0])
    )
    assert_close_relative_to_max(step.irradiance_gain, now / then, 1e-4)
    assert step.irradiance_gain[~moves].min() < 0.6 and step.irradiance_gain[~moves].max() > 1.5
    assert_same_bits(step.light_occlusion[:, :4], newest.light_occlusion[:, :4])
    light_of(dynamics).gain_head.bias.detach()[:] = torch.tensor([0.1, 0.0, -0.4])
    more = (2 * (torch.tensor([0.1, 0.0, -0.4]) / 2).tanh()).exp()
    assert_close_relative_to_max(dynamics(moved).irradiance_gain, step.irradiance_gain * more, 1e-4)


def test_irradiance_changes_all_but_frozen_appearance():
    dynamics, history = make_dynamics(LIT), scene(300)
    torch.nn.init.normal_(light_of(dynamics).gain_head.weight, std=0.1)
    known = dynamics.initialize(history)
    aside = torch.where((known.activity == DYNAMIC)[:, None], torch.tensor([0.3, 0.0, 0.0]), 0)
    held = torch.arange(known.n_rows) % 3 == 0
    known = dataclasses.replace(known, means=known.means + aside, frozen_appearance=held)
    moves = last_steps(known, 1).activity == DYNAMIC
    light = {}
    for who in ("all", "dynamic", "frozen", "none"):
        *_, last = rollout(partial(dynamics, changes=dynamics.layout.changes(who)), known, 2, 2)
        assert (last.irradiance_gain[last.frozen_appearance] == 1).all() and (
            last.irradiance_gain[~last.frozen_appearance] != 1
        ).any()
        light[who] = last.irradiance_gain
    assert_close_relative_to_max(light["frozen"][~moves], light["all"][~moves], 0.2)
    assert (light["none"][~moves] - light["all"][~moves]).abs().max() > 1e-4  # what is predicted is not of all
    assert (light["none"][~moves] - light["dynamic"][~moves]).abs().max() < 0.2


def test_light_parameters_have_gradients():
    dynamics, history = make_dynamics(LIT), scene(100)
    torch.nn.init.normal_(light_of(dynamics).gain_head.weight)
    known = dynamics.initialize(history)
    aside = torch.where((known.activity == DYNAMIC)[:, None], torch.tensor([0.1, 0.0, 0.0]), 0)
    step = dynamics(dataclasses.replace(known, means=known.means + aside))
    step.irradiance_gain.square().sum().backward()
    assert (
        light_of(dynamics).directions.grad.abs().amax(1).gt(0).all()
        and light_of(dynamics).strength.grad.abs().gt(0).all()
    )
    assert light_of(dynamics).in_proj.weight.grad.abs().amax(0).gt(0).all()


def test_optimizer_step_turns_direction_slowly():
    dynamics = make_dynamics(LIT)
    before, rate = F.normalize(light_of(dynamics).directions.detach(), dim=1), 1e-3
    light_of(dynamics).directions.grad = torch.tensor([[1.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    torch.optim.AdamW([light_of(dynamics).directions], lr=rate).step()
    turned = (F.normalize(light_of(dynamics).directions.detach(), dim=1) - before).norm(dim=1)
    assert turned.gt(0).all() and turned.max() < 0.1 * rate


def test_encoding_time_defaults_to_start():
    dynamics, history = make_dynamics(dataclasses.replace(LIT, zero_init=True)), scene(300)
    step = dynamics(history)
    assert (step.irradiance_gain - 1).abs().max() < 1e-5
    assert_close_relative_to_max(
        step.light_occlusion[:, :2], irradiance(history, light_of(dynamics).directions, CELL)[0], 0.3
    )
    assert (step.light_occlusion >= 0).all()
