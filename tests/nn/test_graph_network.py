"""The graph network: its edges against all pairs, invariances, gradients, refusals, training and checkpoints."""

import dataclasses

import pytest
import torch

from gsim3d import InputSpec, Simulator, presets
from gsim3d.dynamics import DynamicsConfig
from gsim3d.errors import InputError
from gsim3d.evaluate.plan_costs import Workload, predicted_cost
from gsim3d.nn.graph_network import Graph, GraphConfig
from gsim3d.priors import PositionWavesConfig, SegmentationConfig
from gsim3d.state import last_steps
from tests.asserts import assert_close_relative_to_max, assert_same_bits
from tests.dynamics.scenes import TINY, batch, float_fields, make_dynamics, make_history, permute_rows

pytestmark = pytest.mark.usefixtures("one_thread")

SIZE = GraphConfig(channels=16, layers=2)
GRAPH = dataclasses.replace(TINY, graph=SIZE, position_features=False)
SIZES = [(40, 30), (25,), (20, 0, 30, 12), (0, 9)]


@pytest.mark.parametrize("earlier", [False, True])
@pytest.mark.parametrize("sizes", [(40, 30, 50), (25,)])
def test_edges_join_all_nodes_of_cells_that_touch(sizes, earlier):
    stage = make_dynamics(GRAPH).geometry(batch([make_history(sizes), make_history(sizes, 1)])).stages[1]
    graph, n = Graph.of(stage, 4, torch.zeros(1), earlier=earlier), stage.n_rows
    number = torch.arange(n, dtype=torch.float64)[:, None]
    listed = graph.receivers.cu_rows[-1]
    ends = [
        x[:listed, 0].long() for x in (graph.at_edges(number, graph.senders), graph.at_edges(number, graph.receivers))
    ]
    found = list(zip(*(x.tolist() for x in ends), (4 * graph.age[:listed, 0]).tolist(), strict=True))
    age = 3 - stage.time_index if stage.time_index is not None else torch.zeros(n)
    near = (stage.grid[:, None] - stage.grid).abs().amax(-1) <= 1
    near &= (stage.cloud[:, None] == stage.cloud) & (age == 0) & ((age[:, None] > 0) == earlier)
    expected = [(s, r, float(age[s])) for s, r in near.nonzero().tolist()]
    assert sorted(found) == sorted(expected) and (len(expected) > n / len(sizes) or (earlier and len(sizes) == 1))
    assert graph.at_edges(number, graph.senders)[listed:].eq(0).all()


def test_scenes_of_a_batch_equal_each_alone():
    dynamics, histories = make_dynamics(GRAPH), [make_history(sizes, i) for i, sizes in enumerate(SIZES)]
    together, alone = dynamics(batch(histories)), [dynamics(history) for history in histories]
    for name, value in float_fields(together).items():
        assert_same_bits(value, torch.cat([getattr(step, name) for step in alone]), name)


def test_permutation_of_particles():
    dynamics, history = make_dynamics(GRAPH), make_history((40, 40))
    permuted, order = permute_rows(history)
    step, permuted_step = dynamics(history), dynamics(permuted)
    for name in ("means", "dynamic_latents"):
        assert_close_relative_to_max(getattr(permuted_step, name), getattr(step, name)[order[40:] - 40], 1e-6, name)


def test_motion_does_not_depend_on_the_place():
    dynamics, history = make_dynamics(GRAPH), make_history((30, 30), frozen_share=0.0)
    history = dataclasses.replace(history, means=(history.means * 2**16).round() / 2**16)
    shift = torch.tensor([64.0, 16.0, 3.0]) * TINY.grid_size
    step, moved = dynamics(history), dynamics(dataclasses.replace(history, means=history.means + shift))
    displacement = step.means - history.means[30:]
    assert displacement.abs().max() > 1e-3
    assert_close_relative_to_max(moved.means - shift - history.means[30:], displacement, 1e-4)


def test_earlier_steps_and_neighbours_change_the_step():
    dynamics, history = make_dynamics(GRAPH), make_history((30, 30), frozen_share=0.0)
    step = dynamics(history)
    assert not torch.equal(dynamics(last_steps(history, 1)).means, step.means)
    later = dataclasses.replace(history, cloud_step=torch.tensor([0, 2]))
    assert not torch.equal(dynamics(later).means, step.means)


def test_gradients_match_differences():
    dynamics = make_dynamics(GRAPH, dtype=torch.float64)
    history = make_history((3, 4), frozen_share=0.0, dtype=torch.float64)

    def advanced(means, latents):
        step = dynamics(dataclasses.replace(history, means=means, dynamic_latents=latents))
        return step.means, step.dynamic_latents

    assert torch.autograd.gradcheck(advanced, [x.requires_grad_() for x in (history.means, history.dynamic_latents)])


def test_recomputed_gradients_have_equal_bits():
    grads = []
    for checkpointing in (False, True):
        dynamics = make_dynamics(dataclasses.replace(GRAPH, checkpointing=checkpointing)).train()
        step = dynamics(make_history((30, 40)))
        (step.means.square().sum() + step.dynamic_latents.square().sum()).backward()
        grads.append({name: p.grad for name, p in dynamics.net.named_parameters()})
    for name, grad in grads[0].items():
        assert grad.isfinite().all() and grad.any(), name
        assert_same_bits(grads[1][name], grad, name)


def test_training_learns_the_motion_of_the_history():
    """A body that falls at its speed: the network has to read it from where its particles were."""
    dynamics, losses = make_dynamics(dataclasses.replace(GRAPH, zero_init=True)).train(), []
    optimizer = torch.optim.Adam(dynamics.parameters(), 3e-3)
    for number in range(100):
        histories = [make_history((30, 30), 8 * number + k, frozen_share=0.0) for k in range(4)]
        speeds = [0.02 * (k - 1.5) for k in range(4)]
        for history, speed in zip(histories, speeds, strict=True):
            history.means[30:] = history.means[:30] + torch.tensor([0, 0, speed])
        moved = (dynamics(batch(histories)).means - torch.cat([h.means[30:] for h in histories]))[:, 2]
        loss = (moved - torch.tensor(speeds).repeat_interleave(30)).square().mean() / 5e-4  # 1: it predicts no motion
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    assert sum(losses[-10:]) / 10 < 0.5 < 0.99 < losses[0]


@pytest.mark.parametrize("bits", [0, 1])
def test_short_histories_and_no_layers(bits):
    dynamics = make_dynamics(dataclasses.replace(GRAPH, history_bits=bits, graph=GraphConfig(channels=8, layers=0)))
    history = make_history((20,) * 2**bits)
    assert dynamics(history).means.isfinite().all()
    with pytest.raises(ValueError, match="a history must span at most"):
        dynamics(make_history((20,) * (2**bits + 1)))


def test_half_precision_keeps_positions_exact(device):
    """Far from the origin 16-bit positions would be off by cells."""
    dynamics, history = make_dynamics(GRAPH).to(device), make_history((40, 30)).to(device)
    history = history.with_clouds(history.clouds, means=history.means + 64)
    step = dynamics(history)
    with torch.autocast(device.type, torch.bfloat16):
        halved = dynamics(history)
    assert halved.means.dtype == torch.float32
    assert_close_relative_to_max(halved.means - history.means[40:], step.means - history.means[40:], 0.05)


@pytest.mark.parametrize(
    "changes, message",
    [
        ({"norm": "batch"}, 'graph needs norm="layer"'),
        ({"background": "asymmetric"}, 'background="symmetric" or "relightable"'),
        ({"history_bits": 6}, "graph needs history_bits of at most 5"),
        ({"priors": (PositionWavesConfig(),)}, "position_waves needs the point transformer"),
    ],
)
def test_unsupported_settings_are_refused(changes, message):
    with pytest.raises(InputError, match=message):
        dataclasses.replace(GRAPH, **changes)


def test_priors_without_features_are_fine():
    dynamics, history = (
        make_dynamics(dataclasses.replace(GRAPH, priors=(SegmentationConfig(),))),
        make_history((30, 30)),
    )
    assert dynamics(history).means.isfinite().all()


def test_checkpoint_says_its_network_and_predicts_the_same_bits(tmp_path):
    config = presets.tiny()
    config = dataclasses.replace(config, dynamics=dataclasses.replace(config.dynamics, graph=SIZE))
    simulator = Simulator(config).eval()
    simulator.inputs = InputSpec(history=2, context_views=2, image_size=(64, 64), fps=30.0)
    loaded = Simulator.from_pretrained(simulator.save_pretrained(tmp_path / "model"))
    assert loaded.config == config and loaded.config.dynamics.network == "graph network"
    assert DynamicsConfig().network == "point transformer"
    history = make_history((30, 40), config=config.dynamics)
    for name, value in float_fields(simulator.dynamics(history)).items():
        assert_same_bits(getattr(loaded.dynamics(history), name), value, name)


def test_cost_grows_with_layers_and_history():
    model, work = presets.small(), Workload(1000, 500)
    costs = []
    for layers, bits in ((4, 1), (8, 1), (8, 2)):
        dynamics = dataclasses.replace(model.dynamics, graph=GraphConfig(layers=layers), history_bits=bits)
        changed = dataclasses.replace(model, dynamics=dynamics)
        costs.append(predicted_cost(Simulator(changed).plan(), changed, work)["dynamics"])
    assert 0 < costs[0] < costs[1] < costs[2]
