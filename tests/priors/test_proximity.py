"""Proximity to the static background and position waves, and their use in the dynamics."""

import dataclasses

import pytest
import torch

from gsim3d.priors import InertiaConfig, PositionWavesConfig, ProximityConfig
from gsim3d.state import ASLEEP, DYNAMIC, FROZEN, last_steps
from tests.asserts import assert_close_relative_to_max, assert_same_bits
from tests.dynamics.scenes import TINY, batch, make_dynamics, make_history, permute_rows
from tests.priors.scenes import build, context, with_priors

pytestmark = pytest.mark.usefixtures("one_thread")

LENGTH = 0.15
NEAR, SOLID = ProximityConfig(range=LENGTH), ProximityConfig().min_opacity
CONDITIONED = with_priors(TINY, PositionWavesConfig(count=3), NEAR)
SPACING = 0.05


def contact(history, priors=None):
    ctx = context(history, NEAR, grid_size=TINY.grid_size, priors=priors)
    return ctx.priors.get("proximity").geometry(ctx).features


def above_ground(heights, seed=0, slope=0.0, n_steps=2):
    """Particles over the center of a square of frozen particles 5 cm apart, with a slope along x."""
    ticks = torch.arange(31) * SPACING
    x, y = (v.flatten() for v in torch.meshgrid(ticks, ticks, indexing="ij"))
    ground = torch.stack([x, y, slope * (x - 0.75)], 1)
    bodies = torch.tensor([[0.75, 0.75, h] for h in heights]).double()
    places = torch.cat([ground.double(), bodies]) + torch.tensor([1.0, 1.0, 1.0]).double()
    history = make_history((len(places),) * n_steps, seed=seed)
    activity = torch.tensor([FROZEN] * len(ground) + [DYNAMIC] * len(heights)).repeat(n_steps)
    return dataclasses.replace(
        history,
        means=places.float().repeat(n_steps, 1),
        activity=activity.to(history.activity.dtype),
        opacities=torch.full_like(history.opacities, 0.8),
    )


def way_and_proximity(history, heights):
    way, near = contact(history)[-len(heights) :].split([3, 1], 1)
    return way / near * LENGTH, near


def test_proximity_over_plane():
    heights = [0.02, 0.1, 0.2, 0.4]
    way, near = way_and_proximity(above_ground(heights), heights)
    height = torch.tensor(heights)
    assert_close_relative_to_max(way[:, 2], -height, 0.01)
    assert way[:, :2].abs().max() < 0.01
    assert_close_relative_to_max(near[:, 0], (-0.5 * (height / LENGTH) ** 2).exp(), 0.02)


def test_direction_below_plane_points_to_surface():
    way, near = way_and_proximity(above_ground([-0.06]), [-0.06])
    assert abs(float(way[0, 2]) - 0.06) < 0.003 and near > 0.9


def test_direction_over_slope_is_normal():
    slope, height = 0.5, 0.1
    way, _ = way_and_proximity(above_ground([height], slope=slope), [height])
    normal = torch.tensor([slope, 0.0, -1.0]) / (1 + slope**2) ** 0.5
    assert_close_relative_to_max(way[0], normal * height / (1 + slope**2) ** 0.5, 0.1)


def test_proximity_is_zero_without_opaque_frozen_neighbors():
    history = above_ground([0.1, 3.0])
    found = contact(history)
    frozen = last_steps(history, 1).activity == FROZEN
    assert found.shape == (len(frozen), 4)
    assert not found[frozen].any() and found[-2, 3] > 0.7 and found[-1].abs().max() < 1e-6
    for change in ({"opacities": torch.full_like(history.opacities, SOLID / 2)},
                   {"activity": torch.full_like(history.activity, DYNAMIC)}):  # fmt: skip
        assert not contact(dataclasses.replace(history, **change)).any()
    asleep = torch.where(history.activity == DYNAMIC, ASLEEP, history.activity)
    assert not contact(dataclasses.replace(history, activity=asleep)).any()


def test_batch_equals_single_scenes_in_any_order():
    one, other = above_ground([0.1, 0.05]), above_ground([0.2], seed=1, n_steps=3)
    both = contact(batch([one, other]))
    assert_close_relative_to_max(both, torch.cat([contact(one), contact(other)]), 1e-5)
    other_order, order = permute_rows(one)
    newest = order[one.cu_rows[-2] :] - one.cu_rows[-2]
    assert_close_relative_to_max(contact(other_order), contact(one)[newest], 1e-5)


def test_far_from_origin():
    heights = [0.02, 0.1, -0.05]
    near = above_ground(heights)
    far = dataclasses.replace(near, means=near.means + 500, origin=near.origin + 500)
    assert_close_relative_to_max(contact(far), contact(near), 1e-3)


def test_invalid_positions_give_finite_results():
    history = above_ground([0.1])
    means = history.means.clone()
    means[-1], means[-5] = torch.nan, torch.inf
    found = contact(dataclasses.replace(history, means=means))
    assert found.isfinite().all() and not found.any()


def test_on_gpu(devices):
    history = batch([above_ground([0.02, 0.1]), make_history((30, 40))])
    expected, actual = (contact(history.to(device)).cpu() for device in devices)
    assert_close_relative_to_max(actual, expected, 1e-4)
    assert_same_bits(contact(history.to(devices[1])).cpu(), actual)


def test_compiled(device):
    history = above_ground([0.02, 0.1]).to(device)
    history.clouds
    priors, compiled = build(history, NEAR), torch.compile(contact, fullgraph=True)
    assert_close_relative_to_max(compiled(history, priors), contact(history), 1e-4)


@pytest.mark.parametrize("name", ["position_waves", "proximity"])
def test_network_reads_features(name):
    dynamics, history = make_dynamics(CONDITIONED), above_ground([0.02, 0.05])
    before = dynamics(history)
    torch.nn.init.normal_(dynamics.priors.get(name).in_proj.weight)
    assert (dynamics(history).means - before.means).abs().max() > 1e-5


def test_position_waves():
    ctx = context(above_ground([0.3]), PositionWavesConfig(count=3), grid_size=1.0)
    history, waves = ctx.history, ctx.priors.get("position_waves").features(ctx).unflatten(1, (3, 2, 3))
    places = history.means.double() - history.origin[0]
    for k in range(3):
        angles = 2 * torch.pi * places * 2**k / 4.0
        assert_close_relative_to_max(waves[:, k, 0], angles.sin(), 1e-6)
        assert_close_relative_to_max(waves[:, k, 1], angles.cos(), 1e-6)


def test_relightable_background_of_older_steps_is_ignored():
    relightable = with_priors(CONDITIONED, InertiaConfig(radius=0.2), background="relightable")
    dynamics, history = make_dynamics(relightable), above_ground([0.02, 0.05])
    older = (history.activity == FROZEN) & (history.row_cloud() == 0)
    moved = dataclasses.replace(history, means=torch.where(older[:, None], history.means + 0.05, history.means))
    assert_same_bits(dynamics(moved).means, dynamics(history).means)


def test_asymmetric_background_is_refused():
    with pytest.raises(ValueError, match='proximity needs background "symmetric"'):
        dataclasses.replace(CONDITIONED, background="asymmetric")


@pytest.mark.parametrize("count", [0, 17])
def test_number_of_waves(count):
    with pytest.raises(ValueError, match="count"):
        PositionWavesConfig(count=count)
