"""Costs of effects: counts of computed particles fall with the share at rest (times: see the benchmarks)."""

import dataclasses

import pytest
import torch

from gsim3d.dynamics import Partition
from gsim3d.dynamics.frozen_context import Reader
from gsim3d.effects.spec import DynamicsEffects, EffectsSpec
from gsim3d.evaluate.plan_costs import Workload, background_cost, predicted_cost
from gsim3d.nn.point_transformer import Attention
from gsim3d.state import FROZEN
from tests.dynamics.scenes import TINY, make_history
from tests.effects.resting import ASYMMETRIC, make_simulator

pytestmark = pytest.mark.usefixtures("one_thread")

N_ROWS = 400


def multiply_adds(net, call):
    """Of all matrix products and convolutions (a tap for every row that is there); of attention to own patches; of
    attention to a background."""
    counted = [0, 0, 0]

    def product(module, inputs, output):
        counted[0] += inputs[0].shape[0] * module.weight.numel()

    def attention(module, inputs, output):
        x, patches, row, beside = inputs
        tables = [patches] + ([beside.patches[row]] if isinstance(beside, Reader) else [])
        for i, table in enumerate(tables):
            counted[1 + i] += 2 * x.shape[1] * (table.cu_q.diff() * table.cu_k.diff()).sum().item()

    hooks = [module.register_forward_hook(product) for module in net._products]
    hooks += [module.register_forward_hook(attention) for module in net.modules() if isinstance(module, Attention)]
    call()
    for hook in hooks:
        hook.remove()
    return counted


def test_sleep_cost_falls_with_resting_share():
    simulator, history = make_simulator(), make_history((N_ROWS,) * 4, frozen_share=0.0)
    dynamics, work = simulator.dynamics, []
    for share in (0.0, 0.5, 0.9, 0.99):
        activity = torch.where(torch.arange(N_ROWS) < share * N_ROWS, FROZEN, 0).to(torch.uint8).repeat(4)
        parts = Partition.of(dataclasses.replace(history, activity=activity), asymmetric=True)
        background = dynamics.remember(parts.background)
        work.append(sum(multiply_adds(dynamics.net, lambda: dynamics(parts.moving, background=background))))
    assert work[0] > 1.3 * work[1] and work[0] > 4 * work[2] and work[2] > 4 * work[3] > 0


def test_background_cost_is_below_dynamic_cost():
    simulator, history = make_simulator(), make_history((N_ROWS,) * 4, frozen_share=1.0)
    dynamics, net = simulator.dynamics, simulator.dynamics.net
    thawed = dataclasses.replace(history, activity=torch.zeros_like(history.activity))
    made = sum(multiply_adds(net, lambda: dynamics.remember(Partition.of(history, asymmetric=True).newest)))
    assert 3 * made < sum(multiply_adds(net, lambda: dynamics(thawed)))


@pytest.mark.parametrize("share", [0.5, 0.9])
def test_predicted_cost_counts_joint_attention(share):
    """On a ground whose points are a cell apart it tells what moving rows pay for seeing those that rest."""
    simulator, n = make_simulator(), 48
    ground = torch.cartesian_prod(torch.arange(n), torch.arange(n), torch.tensor([3])) * ASYMMETRIC.grid_size
    history = make_history((n * n,), frozen_share=0.0)
    rests = torch.arange(n * n) < share * n * n
    history = dataclasses.replace(history, means=ground, activity=torch.where(rests, FROZEN, 0).to(torch.uint8))
    parts, dynamics = Partition.of(history, asymmetric=True), simulator.dynamics
    background = dynamics.remember(parts.background)
    *_, counted = multiply_adds(dynamics.net, lambda: dynamics(parts.moving, background=background))
    plan = simulator.plan(EffectsSpec(dynamics=DynamicsEffects(history=1)))
    moving, resting = int((~rests).sum()), int(rests.sum())
    beside, alone = (
        predicted_cost(plan, simulator.config, Workload(moving, frozen))["dynamics"] for frozen in (resting, 0)
    )
    assert beside - alone == pytest.approx(counted, rel=0.2)
    assert background_cost(plan, simulator.config, Workload(moving, resting)) > 0
    assert background_cost(plan, simulator.config, Workload(moving, 0)) == 0
    symmetric = make_simulator(TINY)
    assert background_cost(symmetric.plan(), symmetric.config, Workload(moving, resting)) == 0
