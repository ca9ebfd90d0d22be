"""What rests is not computed: the work of a step falls with the share of rows at rest, by counts; times are benchmarks."""

import dataclasses

import pytest
import torch

from gsim3d.dynamics import Parts
from gsim3d.dynamics.background import Reader
from gsim3d.dynamics.point_transformer import Attention
from gsim3d.types import FROZEN
from tests.dynamics.scenes import make_history
from tests.effects.resting import make_simulator

pytestmark = pytest.mark.usefixtures("one_thread")

N_ROWS = 400


def multiply_adds(net, call):
    """Of all matrix products, of convolutions (a tap for every row that is there), and of attention."""
    counted = []

    def product(module, inputs, output):
        counted.append(inputs[0].shape[0] * module.weight.numel())

    def attention(module, inputs, output):
        x, patches, row, beside = inputs
        tables = [patches] + ([beside.patches[row]] if isinstance(beside, Reader) else [])
        counted.extend(2 * x.shape[1] * (t.cu_q.diff() * t.cu_k.diff()).sum().item() for t in tables)

    hooks = [module.register_forward_hook(product) for module in net._products]
    hooks += [module.register_forward_hook(attention) for module in net.modules() if isinstance(module, Attention)]
    call()
    for hook in hooks:
        hook.remove()
    return sum(counted)


def test_pays_off_the_more_rests_the_less_is_computed():
    simulator, history = make_simulator(), make_history((N_ROWS,) * 4, frozen_share=0.0)
    dynamics, work = simulator.dynamics, []
    for share in (0.0, 0.5, 0.9, 0.99):
        activity = torch.where(torch.arange(N_ROWS) < share * N_ROWS, FROZEN, 0).to(torch.uint8).repeat(4)
        parts = Parts.of(dataclasses.replace(history, activity=activity), asymmetric=True)
        background = dynamics.remember(parts.background)
        work.append(multiply_adds(dynamics.net, lambda: dynamics(parts.moving, background=background)))
    assert work[0] > 1.3 * work[1] and work[0] > 4 * work[2] and work[2] > 4 * work[3] > 0


def test_a_background_costs_less_than_a_step_in_which_it_moves():
    simulator, history = make_simulator(), make_history((N_ROWS,) * 4, frozen_share=1.0)
    dynamics, net = simulator.dynamics, simulator.dynamics.net
    thawed = dataclasses.replace(history, activity=torch.zeros_like(history.activity))
    made = multiply_adds(net, lambda: dynamics.remember(Parts.of(history, asymmetric=True).newest))
    assert 3 * made < multiply_adds(net, lambda: dynamics(thawed))
