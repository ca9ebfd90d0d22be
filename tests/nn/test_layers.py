"""Layers over packed rows."""

import pytest
import torch
from torch.nn import functional as F

from gsim3d.nn.layers import (
    RowBatchNorm,
    RowLayerNorm,
    RowLinear,
    _combine,
    _statistics,
    exact_convolutions,
    product_dtype,
    round_weights,
    rounded_weights,
    tf32_only_if_asked,
    use_rounded,
)
from gsim3d.train.loop import deterministic
from tests.asserts import assert_close_relative_to_max, assert_same_bits, with_threads


def rows(n, channels=24, seed=0, dtype=torch.float32):
    return torch.randn(n, channels, generator=torch.Generator().manual_seed(seed), dtype=dtype)


@pytest.mark.parametrize("n", [0, 1, 2, 3, 5, 15, 16, 17, 100])
def test_rows_do_not_depend_on_the_rows_beside_them(n):
    torch.manual_seed(0)
    for layer in (RowLinear(24, 40), RowLayerNorm(24), RowBatchNorm(24).eval()):
        assert_same_bits(layer(rows(300)[:n].clone()), layer(rows(300))[:n], type(layer).__name__)


@pytest.mark.parametrize("gelu", [False, True])
def test_linear_is_torchs(gelu):
    torch.manual_seed(0)
    layer, x, results = RowLinear(24, 40), rows(50).requires_grad_(), []
    parameters = (x, layer.weight, layer.bias)
    for y in (layer(x, gelu=gelu), F.gelu(F.linear(*parameters)) if gelu else F.linear(*parameters)):
        first = torch.autograd.grad(y.square().sum(), parameters, create_graph=True)
        second = torch.autograd.grad(sum(g.square().sum() for g in first), parameters)
        results.append((y, *first, *second))
    for ours, theirs in zip(*results, strict=True):
        assert_close_relative_to_max(ours, theirs, 1e-5)
    with torch.no_grad():
        assert_same_bits(layer(x, gelu=gelu), results[0][0].detach())


def test_layer_norm_is_torchs():
    ours, theirs = RowLayerNorm(24), torch.nn.LayerNorm(24)
    for layer in (ours, theirs):
        torch.manual_seed(1)
        torch.nn.init.normal_(layer.weight), torch.nn.init.normal_(layer.bias)
    assert_close_relative_to_max(ours(rows(50)), theirs(rows(50)), 1e-6)
    assert ours.state_dict().keys() == theirs.state_dict().keys()


def test_gradients_on_one_thread_and_two_differ_by_rounding_at_most():
    torch.manual_seed(0)
    layers = torch.nn.Sequential(RowLinear(24, 24), RowLayerNorm(24), RowBatchNorm(24))

    def run():
        layers.zero_grad()
        layers(rows(3000)).square().sum().backward()
        return [p.grad.clone() for p in layers.parameters()]

    for one, two in zip(with_threads(1, run), with_threads(2, run), strict=True):
        assert_close_relative_to_max(two, one, 1e-5)


@pytest.mark.parametrize("training", [False, True])
def test_batch_norm_is_torchs(training):
    ours = RowBatchNorm(24).double().train(training)
    theirs = torch.nn.BatchNorm1d(24, eps=1e-3, momentum=0.01).double().train(training)
    x = rows(50, dtype=torch.float64)
    assert_close_relative_to_max(ours(x), theirs(x), 1e-13)
    assert_close_relative_to_max(ours.running_mean, theirs.running_mean, 1e-13)
    assert_close_relative_to_max(ours.running_var, theirs.running_var, 1e-13)


@pytest.mark.parametrize("n", [0, 1])
def test_batch_norm_of_one_row_or_none(n):
    layer = RowBatchNorm(4)
    out = layer(rows(n, 4))
    assert torch.isfinite(out).all() and not out.any()
    assert layer.running_mean.tolist() == [0] * 4 and layer.running_var.tolist() == [1] * 4


def test_statistics_of_several_processes_are_those_of_all_rows():
    x = rows(60, dtype=torch.float64)
    mean, var, n_rows = _statistics(x)
    parts = []
    for part in (x[:10], x[10:10], x[10:11], x[11:]):
        count = part.new_full((1,), part.shape[0])
        center = part.sum(0) / count.clamp(min=1)
        parts.append(torch.cat([count, center, (part - center).square().sum(0)]))
    combined = _combine(tuple(parts), 24)
    assert combined[0] == n_rows == 60
    assert_close_relative_to_max(combined[1], mean, 1e-13)
    assert_close_relative_to_max(combined[2] / 60, var, 1e-13)
    assert combined[0] == _combine(tuple(parts[::-1]), 24)[0]


def test_batch_norm_gradients():
    x = rows(5, 3, dtype=torch.float64).requires_grad_()
    layer = RowBatchNorm(3).double()
    assert torch.autograd.gradcheck(layer, x)


def test_rounded_weights_follow_the_weights():
    layer = RowLinear(4, 3)
    before = rounded_weights(layer, torch.bfloat16)
    assert rounded_weights(layer, torch.bfloat16)[0] is before[0]
    assert rounded_weights(layer, torch.float32)[0] is layer.weight
    with torch.no_grad():
        layer.weight.mul_(2)
    after = rounded_weights(layer, torch.bfloat16)
    assert after[0] is before[0]  # the same memory: a captured graph reads the new values
    assert_same_bits(after[0], layer.weight.detach().bfloat16())
    layer.load_state_dict(RowLinear(4, 3).state_dict())
    assert_same_bits(rounded_weights(layer, torch.bfloat16)[0], layer.weight.detach().bfloat16())
    assert_same_bits(rounded_weights(layer, torch.float16)[0], layer.weight.detach().half())
    with torch.inference_mode():
        assert_same_bits(rounded_weights(layer, torch.bfloat16)[0], layer.weight.detach().bfloat16())
    assert set(layer.state_dict()) == {"weight", "bias"}


def test_weights_are_rounded_at_once(device, monkeypatch):
    layers = [RowLinear(4, 3).to(device), RowLinear(3, 5, bias=False).to(device), RowLinear(2, 2).to(device)]
    rounded_weights(layers[2], torch.bfloat16)
    calls, copy = [], torch._foreach_copy_
    monkeypatch.setattr(torch, "_foreach_copy_", lambda to, of: (calls.append(len(to)), copy(to, of)))
    for expected in ([3], [3, 3]):
        with use_rounded(round_weights(layers, torch.bfloat16)):
            for layer in layers:
                weight, bias = rounded_weights(layer, torch.bfloat16)
                assert_same_bits(weight, layer.weight.detach().bfloat16())
                assert bias is None if layer.bias is None else torch.equal(bias, layer.bias.bfloat16())
        assert calls == expected
        with torch.no_grad():
            layers[0].weight.mul_(2), layers[1].weight.mul_(2), layers[0].bias.add_(1)
    assert_same_bits(rounded_weights(layers[0], torch.bfloat16)[0], layers[0].weight.detach().bfloat16())
    with use_rounded(round_weights(layers, torch.float32)):
        assert rounded_weights(layers[0], torch.float32)[0] is layers[0].weight


def test_products_follow_autocast_on_cuda_only():
    with torch.autocast("cpu", torch.bfloat16):
        assert product_dtype(torch.ones(2, 2)) == torch.float32
    assert product_dtype(torch.ones(2, 2, dtype=torch.float64)) == torch.float64


@pytest.mark.parametrize("n", [3, 100])
def test_linear_layer_has_the_gradients_of_torchs(n, device):
    torch.manual_seed(0)
    layer = RowLinear(24, 7).double().to(device)
    x = rows(n, dtype=torch.float64).to(device).requires_grad_()
    results = []
    for f in (layer, lambda x: torch.nn.functional.linear(x, layer.weight, layer.bias)):
        out = f(x)
        results.append([out, *torch.autograd.grad(out.sin().sum(), [x, layer.weight, layer.bias])])
    for a, b in zip(*results, strict=True):
        assert_close_relative_to_max(a, b, 1e-13)


@pytest.mark.parametrize("training", [False, True])
def test_activation_behind_batch_norm(training, device):
    torch.manual_seed(0)
    layer = RowBatchNorm(24).double().to(device).train(training)
    torch.nn.init.normal_(layer.weight), torch.nn.init.normal_(layer.bias)
    x = rows(60, dtype=torch.float64).to(device).requires_grad_()
    results = []
    for f in (layer.activated, lambda x: torch.nn.functional.gelu(layer(x))):
        out = f(x)
        results.append([out, *torch.autograd.grad(out.sin().sum(), [x, layer.weight, layer.bias])])
    for a, b in zip(*results, strict=True):
        assert_close_relative_to_max(a, b, 1e-12)


@pytest.mark.parametrize("n", [0, 1, 2, 60])
def test_batch_norm_as_one_node_is_that_of_many(n, device):
    torch.manual_seed(0)
    one, many = (RowBatchNorm(24).double().to(device) for _ in range(2))
    torch.nn.init.normal_(one.weight), torch.nn.init.normal_(one.bias)
    many.load_state_dict(one.state_dict())
    x = (3 + rows(n, dtype=torch.float64)).to(device).requires_grad_()
    results = []
    for layer, f in ((one, one.activated_in_training), (many, lambda x: torch.nn.functional.gelu(many(x)))):
        out = f(x)
        gradients = torch.autograd.grad(out.sin().sum(), [x, layer.weight, layer.bias])
        results.append([out, *gradients, layer.running_mean, layer.running_var])
    for a, b in zip(*results, strict=True):
        assert_close_relative_to_max(a, b, 1e-12)


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16])
def test_layers_under_autocast_err_no_more_than_torchs(dtype, devices):
    torch.manual_seed(0)
    linear, norm = RowLinear(24, 40).to(devices[1]), RowBatchNorm(40).to(devices[1])
    x = rows(200).to(devices[1]).requires_grad_()
    inputs = [x, linear.weight, linear.bias, norm.weight, norm.bias]

    def run(f):
        out = f(x)
        return [out, *torch.autograd.grad(out.float().square().sum(), inputs)]

    exact = run(lambda x: torch.nn.functional.gelu(norm(torch.nn.functional.linear(x, linear.weight, linear.bias))))
    with torch.autocast("cuda", dtype):
        ours = run(lambda x: norm.activated(linear(x)))
        torchs = run(
            lambda x: torch.nn.functional.gelu(norm(torch.nn.functional.linear(x, linear.weight, linear.bias)))
        )
    for a, b, truth in zip(ours, torchs, exact, strict=True):
        error, allowed = ((t.float() - truth).abs().max().item() for t in (a, b))
        assert error <= 2 * allowed + 1e-3 * truth.abs().max().item()


@pytest.mark.parametrize("context", [tf32_only_if_asked, deterministic])
def test_convolutions_use_tf32_only_if_asked(context):
    cudnn = torch.backends.cudnn
    assert cudnn.conv.fp32_precision == "tf32"  # torch's default
    for inner in (tf32_only_if_asked, exact_convolutions):
        with context(), inner():
            assert cudnn.conv.fp32_precision != "tf32"
        with exact_convolutions(), context():
            assert cudnn.conv.fp32_precision != "tf32"
    torch.backends.cuda.matmul.allow_tf32 = True
    try:
        with context():
            assert cudnn.conv.fp32_precision == "tf32"
    finally:
        torch.backends.cuda.matmul.allow_tf32 = False
    assert cudnn.conv.fp32_precision == "tf32" and cudnn.allow_tf32


def test_some_outputs_follow_the_weights():
    """Kept without gradients until a weight changes, and never behind a gradient."""
    layer, x = RowLinear(5, 9), torch.rand(20, 5)
    runs, columns = [(0, 2), (4, 5), (7, 9)], [0, 1, 4, 7, 8]
    for _ in range(2):
        with torch.no_grad():
            first = layer.some(x, runs)
            assert_close_relative_to_max(first, layer(x)[:, columns], 1e-6)
            assert_same_bits(layer.some(x, runs), first)
            assert_close_relative_to_max(layer.some(x, runs[:1]), layer(x)[:, :2], 1e-6)
            layer.weight.mul_(2)
            layer.bias.add_(1)
    layer.some(x, runs).sum().backward()
    used = torch.zeros(9, dtype=torch.bool)
    used[columns] = True
    assert torch.equal(layer.weight.grad.any(1), used) and torch.equal(layer.bias.grad > 0, used)


def test_transforms_of_linear_layers():
    layer, x = RowLinear(8, 4), torch.randn(20, 8, generator=torch.Generator().manual_seed(0))
    expected = torch.autograd.grad(layer(x).square().sum(), layer.weight)[0]
    loss = lambda weight: torch.func.functional_call(layer, {"weight": weight}, (x,)).square().sum()  # noqa: E731
    assert_close_relative_to_max(torch.func.grad(loss)(layer.weight.detach()), expected, 1e-5)
    along = torch.ones_like(expected)
    _, tangent = torch.func.jvp(loss, (layer.weight.detach(),), (along,))
    assert_close_relative_to_max(tangent, (expected * along).sum(), 1e-5)
