"""The dynamics on pyramids with a capacity: results do not depend on it."""

import dataclasses

import pytest
import torch

from gsim3d.nn.graph_network import GraphConfig
from gsim3d.ops import PyramidCapacity
from gsim3d.state import ASLEEP
from tests.asserts import assert_close_relative_to_max, assert_same_bits
from tests.cuda_graph import captured
from tests.dynamics.scenes import EXPLICIT, SEEING, TINY, batch, float_fields, make_dynamics, make_history

MOVING = dataclasses.replace(TINY, priors=SEEING)
RELIGHTABLE = dataclasses.replace(MOVING, background="relightable")
GRAPH = dataclasses.replace(TINY, graph=GraphConfig(channels=16, layers=2), background="relightable")
pytestmark = pytest.mark.usefixtures("one_thread")

SIZES = [[(40, 30)], [(1,)], [(0, 12)], [(12, 0)], [(40, 30), (3,), (5, 6, 7), (60, 0, 1, 2)]]


def some_asleep(history):
    """Particles with invalid positions, outside the grid, and asleep."""
    means, activity = history.means.clone(), history.activity.clone()
    means[::7], means[3::11], activity[5::13] = torch.nan, -1.0, ASLEEP
    return dataclasses.replace(history, means=means, activity=activity)


def with_room(dynamics, history, factor=1.25, generator=None):
    exact = dynamics.geometry(history)
    capacity = PyramidCapacity.of(exact, dynamics.capacity(history), factor)
    return dynamics.geometry(history, capacity=capacity, generator=generator)


@pytest.mark.parametrize("asleep", [False, True])
@pytest.mark.parametrize("config", [TINY, EXPLICIT, MOVING, RELIGHTABLE, GRAPH])
@pytest.mark.parametrize("sizes", SIZES)
@pytest.mark.parametrize("factor", [1.0, 1.25, 4.0])
def test_capacity_changes_no_bit(factor, sizes, config, asleep):
    dynamics = make_dynamics(config)
    history = batch([make_history(n_rows, seed=i, config=config) for i, n_rows in enumerate(sizes)])
    history = some_asleep(history) if asleep else history
    step = dynamics(history, pyramid=with_room(dynamics, history, factor))
    for name, value in float_fields(dynamics(history)).items():
        assert_same_bits(getattr(step, name), value, name)


def test_given_pyramid_changes_no_bit():
    dynamics, history = make_dynamics(), some_asleep(make_history((40, 30)))
    assert_same_bits(dynamics(history, pyramid=dynamics.geometry(history)).means, dynamics(history).means)


@pytest.mark.parametrize("norm", ["layer", "batch"])
def test_gradients_are_independent_of_capacity(norm):
    config = dataclasses.replace(TINY, norm=norm)
    dynamics, history = make_dynamics(config, dtype=torch.float64), make_history((40, 30), dtype=torch.float64)
    history = some_asleep(history)
    latents = history.dynamic_latents.requires_grad_()
    grads = []
    for pyramid in (dynamics.geometry(history), with_room(dynamics, history, 3.0)):
        step = dynamics(history, pyramid=pyramid)
        loss = step.dynamic_latents.square().sum() + step.means.nan_to_num().square().sum()
        grads.append(torch.autograd.grad(loss, [latents, *dynamics.parameters()]))
    for exact, given in zip(*grads, strict=True):
        assert torch.isfinite(exact).all()
        assert_close_relative_to_max(given, exact, 1e-12)


def test_padding_is_finite_and_changes_no_particle():
    dynamics, history = make_dynamics(), make_history((40, 30))
    pyramid, exact = with_room(dynamics, history, 4.0), dynamics.geometry(history)
    packed = torch.cat(dynamics.layout.input_columns(history), 1)
    expected = dynamics.net(packed, exact)
    features = dynamics.net(torch.ops.gsim3d.pool_mean(packed, pyramid.rows, pyramid.cu_rows), pyramid)
    assert torch.isfinite(features).all()
    assert_same_bits(features, expected)
    stages = []
    for encoder in dynamics.net.encoder:
        encoder.register_forward_hook(lambda module, inputs, output: stages.append(output[0]))
    dynamics(history, pyramid=pyramid)
    for stage, x in zip(pyramid.stages, stages, strict=True):
        assert x.shape[0] == stage.n_rows and torch.isfinite(x).all()


def test_overflow_is_counted():
    dynamics, history = make_dynamics(), make_history((40, 30))
    capacity = PyramidCapacity.of(dynamics.geometry(history), history.n_rows, 1.0)
    sizes = (capacity.sizes[0], *(size // 2 for size in capacity.sizes[1:]))
    pyramid = dynamics.geometry(history, capacity=dataclasses.replace(capacity, sizes=sizes))
    assert pyramid.found[0] == PyramidCapacity.TOO_LARGE
    step = dynamics(history, pyramid=pyramid)
    assert_same_bits(step.means, history.means[40:])
    assert_same_bits(step.dynamic_latents, history.dynamic_latents[40:])


def test_unseen_particles_need_no_capacity():
    dynamics, history = make_dynamics(RELIGHTABLE), some_asleep(make_history((400, 300, 200), frozen_share=0.8))
    assert dynamics.capacity(history) < 0.6 * history.n_rows
    assert make_dynamics(MOVING).capacity(history) == history.n_rows
    pyramid = with_room(dynamics, history, 1.0)
    assert pyramid.rows.shape[0] == dynamics.capacity(history)
    expected, step = dynamics(history), dynamics(history, pyramid=pyramid)
    for name, value in float_fields(expected).items():
        assert_same_bits(getattr(step, name), value, name)


def test_too_many_seen_particles_are_counted():
    dynamics, history = make_dynamics(RELIGHTABLE), make_history((40, 30), frozen_share=0.8)
    exact = dynamics.geometry(history)
    n_seen = exact.stages[0].n_rows
    roomy = PyramidCapacity.of(exact, dynamics.capacity(history))
    small = dataclasses.replace(roomy, sizes=(n_seen - 1, *roomy.sizes[1:]))
    found = dynamics.geometry(history, capacity=small).found.tolist()
    assert found[:2] == [PyramidCapacity.TOO_LARGE, n_seen] and not small.fits(found)
    pyramid = dynamics.geometry(history, capacity=small.grown(found))
    assert pyramid.found[0] == 0
    assert_same_bits(dynamics(history, pyramid=pyramid).means, dynamics(history).means)


def test_batch_norm_refuses_padding():
    dynamics, history = make_dynamics(dataclasses.replace(TINY, norm="batch")), make_history((40, 30))
    pyramid = with_room(dynamics, history)
    dynamics(history, pyramid=pyramid)
    with pytest.raises(ValueError, match='norm="batch" cannot be trained with a pyramid of given capacity'):
        dynamics.train()(history, pyramid=pyramid)


@pytest.mark.parametrize("asleep", [False, True])
def test_capacity_on_cuda_matches_cpu(asleep, devices):
    dynamics = make_dynamics(TINY, dtype=torch.float64)
    history = batch(
        [make_history((40, 30), dtype=torch.float64), make_history((300, 200, 100), 1, dtype=torch.float64)]
    )
    history = some_asleep(history) if asleep else history
    expected = dynamics(history)
    dynamics, history = dynamics.to(devices[1]), history.to(devices[1])
    step = dynamics(history, pyramid=with_room(dynamics, history))
    for name, value in float_fields(expected).items():
        finite = torch.isfinite(value)
        assert torch.equal(torch.isfinite(getattr(step, name)).cpu(), finite)
        assert_close_relative_to_max(getattr(step, name).cpu()[finite], value[finite], 1e-11, name)


def test_captured_step_with_other_particles(devices):
    dynamics = make_dynamics(TINY).to(devices[1])
    history = make_history((400, 300)).to(devices[1])
    history = history.with_clouds(history.clouds)
    capacity = PyramidCapacity.of(dynamics.geometry(history), history.n_rows, 1.5)

    def step():
        with torch.no_grad():
            return dynamics(history, pyramid=dynamics.geometry(history, capacity=capacity))

    graph, results = captured(step)
    for seed in (1, 2):
        other = make_history((400, 300), seed=seed).to(devices[1])
        history.means.copy_(other.means)
        history.dynamic_latents.copy_(other.dynamic_latents)
        graph.replay()
        assert_same_bits(results.means, step().means)
        with torch.no_grad():
            exact = dynamics(history)
        assert_close_relative_to_max(results.means, exact.means, "dynamics_order")
        assert_close_relative_to_max(results.dynamic_latents, exact.dynamic_latents, "dynamics_order")
