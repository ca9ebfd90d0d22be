"""The optimizer's step is that of torch's AdamW and Muon behind torch's clipping."""

import copy
import dataclasses

import pytest
import torch
from torch import nn

from gsim3d.train.config import OptimizerConfig
from gsim3d.train.optimizer import Optimizer, is_matrix, orthogonalized

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


def matrices_of(device):
    """A convolution of each part, whose weights Muon updates, and their biases, which it does not."""
    torch.manual_seed(0)
    parts = nn.Conv2d(16, 24, 3), nn.Linear(40, 20), nn.Linear(20, 33)
    return nn.Sequential(*parts).to(device, memory_format=torch.channels_last)


def test_matrices_are_updated_as_by_muon_of_torch(device):
    config = OptimizerConfig(muon=True, weight_decay=0.1)
    ours, theirs = (list(matrices_of(device).parameters()) for _ in range(2))
    first = [p.detach().clone() for p in ours]
    optimizer = Optimizer({f"{'encoder' if k < 2 else 'net'}.{k}": p for k, p in enumerate(ours)}, config)
    # Torch's is of matrices alone: a kernel is one of output channels x the rest.
    theirs[0] = nn.Parameter(theirs[0].detach().flatten(1))
    groups = [{"params": [theirs[0]]}, {"params": [theirs[2], theirs[4]]}]
    muon = torch.optim.Muon(groups, weight_decay=0.1, momentum=0.95, adjust_lr_fn="match_rms_adamw")
    adam = torch.optim.AdamW(theirs[1::2], weight_decay=0.1, betas=(config.beta1, config.beta2), eps=config.eps)
    for k, rate in enumerate(RATES):
        gradients = [
            torch.randn(p.shape, generator=torch.Generator().manual_seed(9 * k + j)) for j, p in enumerate(ours)
        ]
        gradients = [g.to(device) for g in gradients]
        norm = torch.nn.utils.get_total_norm(gradients)
        share = (config.clip_norm / (norm + 1e-6)).clamp(max=1.0)
        for p, gradient in zip(theirs, gradients, strict=True):
            p.grad = (share * gradient).reshape(p.shape)
        muon.param_groups[0]["lr"], muon.param_groups[1]["lr"] = ENCODER_RATE * rate, rate
        muon.step()
        for group in adam.param_groups:
            group["lr"] = rate
        adam.step()
        optimizer.update(gradients, norm, rate, ENCODER_RATE)
    for k, (p, expected, before) in enumerate(zip(ours, theirs, first, strict=True)):
        if k == 1:  # the encoder's bias, whose rate torch was not given
            continue
        moved = (expected.reshape(p.shape) - before).abs().max()
        assert (p - expected.reshape(p.shape)).abs().max() < 0.03 * moved  # torch orthogonalizes in bfloat16
        assert set(optimizer.state[p]) == ({"exp_avg"} if k % 2 == 0 else {"step", "exp_avg", "exp_avg_sq"})


@pytest.mark.parametrize("shape", [(32, 32), (24, 100), (100, 24), (64, 900)])
def test_orthogonalized_matrices_keep_their_singular_vectors(shape, device):
    matrix = torch.randn(shape, generator=torch.Generator().manual_seed(0)).to(device)
    made = orthogonalized([matrix, 100 * matrix, 0 * matrix, torch.eye(20, device=device)])
    u, _, v = torch.linalg.svd(matrix.double(), full_matrices=False)
    values = u.mT @ made[0].double() @ v.mT
    assert (values.diagonal() > 0.6).all() and (values.diagonal() < 1.25).all()
    assert (values - values.diagonal().diag()).abs().max() < (0.05 if matrix.is_cuda else 1e-5)
    torch.testing.assert_close(made[1], made[0], rtol=0, atol=0.02 if matrix.is_cuda else 1e-5)
    assert not made[2].any() and made[2].shape == shape


def test_muon_resumes_with_the_same_bits(device):
    first = list(matrices_of(device).parameters())
    names = [f"{'encoder' if k < 2 else 'net'}.{k}" for k in range(len(first))]
    optimizer = Optimizer(dict(zip(names, first, strict=True)), OptimizerConfig(muon=True))
    take(optimizer, draw(first, 1), RATES[0])
    again = [nn.Parameter(copy.deepcopy(p.detach())) for p in first]
    resumed = Optimizer(dict(zip(names, again, strict=True)), OptimizerConfig(muon=True))
    for p, q in zip(first, again, strict=True):
        if optimizer.state[p]:
            resumed.restore(q, {kind: value.cpu().clone() for kind, value in optimizer.state[p].items()})
    for parameters, one in ((first, optimizer), (again, resumed)):
        take(one, draw(parameters, 2), RATES[1])
    for p, q in zip(first, again, strict=True):
        assert torch.equal(p, q)


def test_small_matrices_and_vectors_are_not_of_muon():
    shapes = {(16, 16): True, (15, 64): False, (64, 15): False, (64,): False, (16, 2, 3, 3): True, (8, 32, 3, 3): False}
    assert {shape: is_matrix(torch.empty(shape)) for shape in shapes} == shapes
