"""The optimizer's step is that of torch's AdamW behind torch's clipping."""

import copy
import dataclasses

import pytest
import torch
from torch import nn

from gsim3d.train.config import OptimizerConfig
from gsim3d.train.optimizer import Optimizer

CONFIG = OptimizerConfig(beta1=0.8, beta2=0.95, weight_decay=0.1, clip_norm=0.5)
ENCODER_RATE = 0.3
RATES = (1e-2, 3e-2, 1e-3, 2e-2)


def model(device):
    torch.manual_seed(0)
    parts = nn.Conv2d(3, 4, 3), nn.Conv2d(4, 2, 1), nn.Linear(5, 6), nn.Linear(6, 1)
    return nn.Sequential(*parts).to(device, memory_format=torch.channels_last)


def named(parameters):
    """The first five belong to the encoder."""
    return {f"{'encoder' if k < 5 else 'dynamics'}.{k}": parameter for k, parameter in enumerate(parameters)}


def draw(parameters, k):
    """Gradients that lie otherwise in memory than their weights; some have none, those of the first step are small."""
    g = torch.Generator().manual_seed(k)
    size = 0.01 if k == 0 else 1.0
    gradients = [size * torch.randn(p.shape, generator=g).to(p.device) for p in parameters]
    return [None if j == k % 3 else gradient for j, gradient in enumerate(gradients)]


def take(optimizer, gradients, rate):
    norm = torch.nn.utils.get_total_norm([gradient for gradient in gradients if gradient is not None])
    optimizer.update(gradients, norm, rate, ENCODER_RATE)


def moments(optimizer, parameters):
    return [dict(optimizer.state[p]) for p in parameters]


@pytest.mark.parametrize("clip_norm", [0.5, 0.0])
def test_optimizer_step_equals_torch(clip_norm, device):
    config = dataclasses.replace(CONFIG, clip_norm=clip_norm)
    ours, theirs = (list(model(device).parameters()) for _ in range(2))
    optimizer = Optimizer(named(ours), config)
    groups = [{"params": theirs[:5]}, {"params": theirs[5:]}]
    plain = torch.optim.AdamW(groups, lr=0.0, betas=(0.8, 0.95), eps=config.eps, weight_decay=0.1)
    for k, rate in enumerate(RATES):
        before = [(p.detach().clone(), p._version) for p in ours]
        gradients = draw(ours, k)
        for p, gradient in zip(theirs, gradients, strict=True):
            p.grad = None if gradient is None else gradient.clone()
        if clip_norm:
            torch.nn.utils.clip_grad_norm_(theirs, clip_norm)
        plain.param_groups[0]["lr"], plain.param_groups[1]["lr"] = ENCODER_RATE * rate, rate
        plain.step()
        take(optimizer, gradients, rate)
        for p, expected, gradient, (value, version) in zip(ours, theirs, gradients, before, strict=True):
            torch.testing.assert_close(p, expected, rtol=1e-5, atol=1e-7)
            assert torch.equal(p, value) == (gradient is None)
            assert (p._version > version) == (gradient is not None), "copies of the weights must be made anew"
    for mine, their in zip(moments(optimizer, ours), moments(plain, theirs), strict=True):
        assert mine.keys() == their.keys()
        for kind, value in their.items():
            torch.testing.assert_close(mine[kind].cpu(), value.cpu(), rtol=1e-5, atol=1e-9)


def test_optimizer_restores_the_same_bits(device):
    first = list(model(device).parameters())
    optimizer = Optimizer(named(first), CONFIG)
    for k in range(2):
        take(optimizer, draw(first, k), RATES[k])
    again = [nn.Parameter(copy.deepcopy(p.detach())) for p in first]
    resumed = Optimizer(named(again), CONFIG)
    for p, q in zip(first, again, strict=True):
        if optimizer.state[p]:
            saved = {kind: value.cpu().contiguous().clone() for kind, value in optimizer.state[p].items()}
            resumed.restore(q, saved)
    for k in range(2, 4):
        for parameters, one in ((first, optimizer), (again, resumed)):
            take(one, draw(parameters, k), RATES[k])
    for p, q in zip(first, again, strict=True):
        assert torch.equal(p, q)
        assert all(torch.equal(value, resumed.state[q][kind]) for kind, value in optimizer.state[p].items())


def test_optimizer_without_gradients_changes_nothing(device):
    parameters = list(model(device).parameters())
    before = [p.detach().clone() for p in parameters]
    optimizer = Optimizer(named(parameters), CONFIG)
    optimizer.update([None] * len(parameters), torch.zeros((), device=device), 0.1, ENCODER_RATE)
    assert all(torch.equal(p, value) for p, value in zip(parameters, before, strict=True))
