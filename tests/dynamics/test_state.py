"""Layout of the network's channels and update of the state."""

import dataclasses

import pytest
import torch

from gsim3d.compat.released_model import ReleasedDynamicsConfig
from gsim3d.dynamics.step import StateLayout, position_features
from gsim3d.math.rotations import rotate_left, rotation_matrices
from gsim3d.priors.base import bounded
from gsim3d.state import FROZEN, split_rows
from tests.asserts import assert_close_relative_to_max, assert_same_bits
from tests.dynamics.scenes import EXPLICIT, TINY, advance, float_fields, make_history

LATENT = StateLayout.of(dataclasses.replace(TINY, position_features=False))


def test_channels_of_the_latent_state():
    assert LATENT.inputs == (("dynamic_latents", 4), ("opacities", 1), ("static_latents", 3))
    assert LATENT.outputs == (("dynamic_latents", 4), ("means", 3))
    particles = make_history((5,))
    packed = torch.cat(LATENT.input_columns(particles), 1)
    assert_same_bits(packed[:, 4], particles.opacities)
    assert_same_bits(packed[:, 5:], particles.static_latents)


def test_channels_of_the_explicit_state():
    layout = StateLayout.of(dataclasses.replace(EXPLICIT, dynamic_latents=0, position_features=False))
    assert [name for name, _ in layout.inputs] == ["sh", "opacities", "quats", "scales", "static_latents"]
    assert [name for name, _ in layout.outputs] == ["sh", "means", "opacities", "quats", "scales"]
    assert (layout.in_channels, layout.out_channels) == (12 + 1 + 4 + 3 + 3, 12 + 3 + 1 + 3 + 3)
    particles = make_history((5,), config=EXPLICIT)
    packed = torch.cat(layout.input_columns(particles), 1)
    assert_same_bits(packed[:, :4].contiguous(), particles.sh[:, :, 0].contiguous(), "red harmonics come first")
    assert_same_bits(packed[:, 13:17], particles.quats.roll(-1, 1), "real part last")


def test_gradients_of_runs_of_rows():
    x = torch.arange(24.0, dtype=torch.float64).view(8, 3).requires_grad_()
    runs = [(1, 3), (3, 3), (4, 5), (6, 7)]
    weight = torch.rand(8, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))

    def loss(pieces):  # the last but one has no gradient
        return sum((weight[a:b] * piece**3).sum() for piece, (a, b) in zip(pieces, runs) if a != 4)

    found, expected = (torch.autograd.grad(loss(f(x)), x, create_graph=True)[0] for f in (
        lambda x: split_rows(x, runs), lambda x: [x[a:b] for a, b in runs]
    ))  # fmt: skip
    assert_same_bits(found, expected)
    assert_same_bits(*(torch.autograd.grad(first.sum(), x)[0] for first in (found, expected)))
    assert_same_bits(torch.cat(split_rows(x, runs[::-1])), torch.cat([x[a:b] for a, b in runs[::-1]]))


def test_position_features_are_relative_to_origin_and_cell():
    particles = dataclasses.replace(
        make_history((1,)), means=torch.tensor([[1.25, 2.0, 3.375]]), origin=torch.tensor([[1.0, 1.0, 1.0]]).double()
    )
    features = position_features(particles, grid_size=0.5, length=2.0)
    assert features.tolist() == [[0.125, 0.5, 1.1875, 0.0, -1.0, 0.5]]


def test_predicted_increments_are_bounded():
    particles = make_history((20,), config=EXPLICIT)
    layout = StateLayout.of(EXPLICIT)
    prediction = 50 * torch.randn(20, layout.out_channels, generator=torch.Generator().manual_seed(0))
    (after,) = advance(layout, particles, prediction)
    moves = particles.activity != FROZEN
    assert ((after.means - particles.means).abs() <= EXPLICIT.max_step * 1.001).all()
    assert ((after.dynamic_latents - particles.dynamic_latents).abs() <= EXPLICIT.max_latent_step * 1.001).all()
    assert after.opacities.min() == 0 and after.opacities.max() == 1
    assert after.scales.min() >= EXPLICIT.scale_min and after.scales.max() <= EXPLICIT.scale_max
    assert_close_relative_to_max(after.quats.norm(dim=1), torch.ones(20), 1e-6)
    assert not torch.equal(after.quats[moves], particles.quats[moves])


def test_unlimited_increments():
    x = torch.tensor([-5.0, 0.1])
    assert bounded(x, None) is x
    assert_same_bits(bounded(x, 2.0), 2 * torch.tanh(x))


def random_prediction(layout, n, scale=0.3):
    return scale * torch.randn(n, layout.out_channels, generator=torch.Generator().manual_seed(0))


@pytest.mark.parametrize("predicts", ["from_newest", "from_previous", "absolute"])
def test_first_step_of_call_matches_single_step(predicts):
    config = dataclasses.replace(EXPLICIT, predicts=predicts)
    particles = make_history((20,), config=config)
    one, three = StateLayout.of(config), StateLayout.of(dataclasses.replace(config, steps_per_call=3))
    prediction = random_prediction(three, 20)
    (alone,) = advance(one, particles, prediction[:, : one.out_channels])
    steps = advance(three, particles, prediction)
    assert len(steps) == 3
    for name, value in float_fields(alone).items():
        assert_same_bits(getattr(steps[0], name), value, name)
    frozen = particles.activity == FROZEN
    for step in steps:
        assert_same_bits(step.means[frozen], particles.means[frozen])
        assert_same_bits(step.quats[frozen], particles.quats[frozen])
        assert not torch.equal(step.sh[frozen], particles.sh[frozen])


def test_increments_from_previous_step_accumulate():
    config = dataclasses.replace(EXPLICIT, predicts="from_previous", steps_per_call=2)
    newest_only = dataclasses.replace(config, predicts="from_newest", steps_per_call=1)
    particles = make_history((20,), config=config, frozen_share=0.0)
    layout, single = StateLayout.of(config), StateLayout.of(newest_only)
    prediction = 0.1 * random_prediction(layout, 20)  # far from the limits of scales and opacities
    _, second = advance(layout, particles, prediction)
    (first,) = advance(single, particles, prediction[:, : single.out_channels])
    (again,) = advance(single, first, prediction[:, single.out_channels :])
    for name, value in float_fields(again).items():
        assert_close_relative_to_max(getattr(second, name), value, 1e-6, name)


def test_absolute_predictions():
    config = ReleasedDynamicsConfig(**{**vars(EXPLICIT), "predicts": "absolute"})
    layout = StateLayout.of(config)
    assert dict(layout.outputs)["quats"] == 4
    particles = make_history((20,), config=config, frozen_share=0.0)
    prediction = random_prediction(layout, 20, 3.0)
    (after,) = advance(layout, particles, prediction)
    parts = dict(zip(dict(layout.outputs), prediction.split([n for _, n in layout.outputs], 1), strict=True))
    assert_close_relative_to_max(after.means, parts["means"], 1e-6)
    assert_close_relative_to_max(after.opacities, parts["opacities"][:, 0].sigmoid(), 1e-6)
    direction = torch.nn.functional.normalize(parts["quats"].roll(1, 1), dim=1)
    assert_close_relative_to_max(after.quats, direction, 1e-6)
    assert after.scales.min() > config.scale_min and after.scales.max() < config.scale_max


@pytest.mark.parametrize("predicts", ["from_newest", "from_previous", "absolute"])
def test_sleeping_particles_keep_their_bits(predicts):
    config = dataclasses.replace(EXPLICIT, predicts=predicts, steps_per_call=2)
    layout = StateLayout.of(config)
    particles = make_history((20,), config=config)
    awake = torch.arange(20) % 3 > 0
    for step in advance(layout, particles, random_prediction(layout, 20), awake):
        for name, value in float_fields(particles).items():
            assert_same_bits(getattr(step, name)[~awake], value[~awake], name)
        assert not torch.equal(step.dynamic_latents[awake], particles.dynamic_latents[awake])


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-5, 9e-5, 1.1e-4, 1.0, 3.0, 7.0])
def test_rotation_vectors_use_world_axes(angle):
    g = torch.Generator().manual_seed(0)
    quats = torch.randn(10, 4, generator=g, dtype=torch.float64)
    axes = torch.nn.functional.normalize(torch.randn(10, 3, generator=g, dtype=torch.float64), dim=1)
    skew = torch.zeros(10, 3, 3, dtype=torch.float64)
    x, y, z = (angle * axes).unbind(1)
    skew[:, 0, 1], skew[:, 0, 2], skew[:, 1, 2] = -z, y, -x
    expected = torch.linalg.matrix_exp(skew - skew.mT) @ rotation_matrices(quats / quats.norm(dim=1, keepdim=True))
    turned = rotate_left(quats, angle * axes)
    assert_close_relative_to_max(rotation_matrices(turned), expected, 1e-12)
    assert (turned.gather(1, turned.abs().argmax(1, keepdim=True)) > 0).all()


def test_rotation_gradients_at_zero():
    g = torch.Generator().manual_seed(1)
    quats = torch.randn(4, 4, generator=g, dtype=torch.float64, requires_grad=True)
    vectors = torch.randn(4, 3, generator=g, dtype=torch.float64)
    vectors[0] = 0
    vectors[1] *= 1e-6
    assert torch.autograd.gradcheck(rotate_left, (quats, vectors.requires_grad_()), atol=1e-6)
