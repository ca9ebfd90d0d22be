"""The residual sum between two normalisations, in the eight sections that every op has."""

import itertools

import pytest
import torch

from gsim3d.errors import NumericalError
from gsim3d.ops import residual_norm
from tests.asserts import assert_close_relative_to_max, assert_same_bits, assert_same_bits_for_any_threads
from tests.oracle import row_norm as oracle

LOW = [torch.float16, torch.bfloat16]
SHAPES = [(70, 16), (33, 64), (20, 19), (9, 512), (300, 7), (5, 1000), (1100, 40)]
PARTS = list(itertools.product([False, True], repeat=3))  # keep, branch_norm, norm


def inputs(n=70, channels=16, dtype=torch.float64, parts=(True, True, True), seed=0):
    """x, branch, keep and the weights of both norms, as far as ``parts`` wants them."""
    g = torch.Generator().manual_seed(seed)
    random = lambda *shape: torch.randn(*shape, generator=g, dtype=torch.float64)  # noqa: E731
    made = [random(n, channels), random(n, channels) * (0.5 + random(n, 1).abs()) + random(n, 1)]
    keep = (random(n, 1) > -0.5).double() * 1.5
    weights = [random(channels) for _ in range(4)]
    made += ([keep] if parts[0] else []) + weights[:2] * parts[1] + weights[2:] * parts[2]
    return [t.to(dtype) for t in made]


def call(f, parts):
    """f as a function of the tensors that :func:`inputs` makes."""

    def run(x, branch, *others):
        others = list(others)
        keep = others.pop(0) if parts[0] else None
        branch_norm, norm = ((others.pop(0), others.pop(0)) if has else None for has in parts[1:])
        return f(x, branch, keep=keep, branch_norm=branch_norm, norm=norm)

    return run


def gradients(f, values, cotangents, parts):
    """sum and out, then the gradients of all inputs but keep."""
    leaves = [v.detach().clone().requires_grad_(not (parts[0] and i == 2)) for i, v in enumerate(values)]
    outs = call(f, parts)(*leaves)
    wanted = [leaf for leaf in leaves if leaf.requires_grad]
    return [
        *(o.detach() for o in outs),
        *torch.autograd.grad(outs, wanted, [c.to(o) for c, o in zip(cotangents, outs)]),
    ]


def cotangents_of(n, channels):
    return inputs(n, channels, parts=(False, False, False), seed=1)


def tolerance_of(dtype):
    return "row_norm_float32" if dtype == torch.float32 else "row_norm_float64"


# 1 forward against the oracle, 2 backward against autograd of the oracle
@pytest.mark.parametrize("parts", PARTS)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("shape", SHAPES)
def test_forward_and_gradients_equal_the_oracle(shape, dtype, parts, device):
    values, cotangents = inputs(*shape, dtype=dtype, parts=parts), cotangents_of(*shape)
    actual = gradients(residual_norm, [t.to(device) for t in values], cotangents, parts)
    expected = gradients(oracle.residual_norm, [t.double() for t in values], cotangents, parts)
    for i, (a, b) in enumerate(zip(actual, expected, strict=True)):
        assert_close_relative_to_max(a, b, tolerance_of(dtype), f"tensor {i}")


@pytest.mark.parametrize("used", [0, 1])
def test_one_result_alone_carries_gradients(used, device):
    values = inputs(40, 12)
    leaves = [v.to(device).requires_grad_(i != 2) for i, v in enumerate(values)]
    others = [v.double().requires_grad_(i != 2) for i, v in enumerate(values)]
    wanted = lambda tensors: [t for t in tensors[:5] if t.requires_grad]  # noqa: E731
    parts = (True, True, True)
    actual = torch.autograd.grad(call(residual_norm, parts)(*leaves)[used].square().sum(), wanted(leaves))
    expected = torch.autograd.grad(call(oracle.residual_norm, parts)(*others)[used].square().sum(), wanted(others))
    for a, b in zip(actual, expected, strict=True):
        assert_close_relative_to_max(a, b, "row_norm_float64")


# 3 gradcheck
@pytest.mark.parametrize("parts", PARTS)
def test_gradcheck(parts):
    values = [v.requires_grad_(not (parts[0] and i == 2)) for i, v in enumerate(inputs(4, 5, parts=parts))]
    torch.autograd.gradcheck(call(residual_norm, parts), values)


# 4 CPU against CUDA
@pytest.mark.parametrize("parts", PARTS)
@pytest.mark.parametrize("shape", SHAPES)
def test_cuda_equals_cpu(shape, parts, devices):
    values, cotangents = inputs(*shape, dtype=torch.float32, parts=parts), cotangents_of(*shape)
    cpu, cuda = (gradients(residual_norm, [t.to(d) for t in values], cotangents, parts) for d in devices)
    for a, b in zip(cuda, cpu, strict=True):
        assert_close_relative_to_max(a, b, "row_norm_float32")


@pytest.mark.parametrize("parts", PARTS)
@pytest.mark.parametrize("dtype", LOW)
@pytest.mark.parametrize("shape", SHAPES)
def test_low_precision_errs_no_more_than_torch(shape, dtype, parts, devices):
    """A branch in 16 bits, all sums in float32: at most twice torch's error in the same dtypes."""
    values, cotangents = inputs(*shape, dtype=torch.float32, parts=parts), cotangents_of(*shape)
    values = [t.to(devices[1]) for t in values]
    values[1] = values[1].to(dtype)

    def plain(x, branch, keep, branch_norm, norm):
        normalised = torch.nn.functional.layer_norm
        branch = branch.float() if branch_norm is None else normalised(branch.float(), x.shape[1:], *branch_norm)
        total = x + (branch if keep is None else keep * branch)
        return total, (total if norm is None else normalised(total, x.shape[1:], *norm)).to(dtype)

    cotangents[1] = cotangents[1].to(dtype)
    exact = gradients(oracle.residual_norm, [t.cpu().double() for t in values], cotangents, parts)
    ours, torchs = (gradients(f, values, cotangents, parts) for f in (residual_norm, plain))
    for a, b, truth in zip(ours, torchs, exact, strict=True):
        assert a.dtype == b.dtype
        error, allowed = ((t.cpu().double() - truth).abs().max().item() for t in (a, b))
        assert error <= 2 * allowed + 1e-6 * truth.abs().max().item()


@pytest.mark.parametrize("dtype", LOW)
def test_follows_autocast_on_cuda(dtype, devices):
    x, branch, keep, *weights = (t.to(devices[1]) for t in inputs(dtype=torch.float32))
    with torch.autocast("cuda", dtype):
        total, out = residual_norm(x, branch, keep=keep, branch_norm=weights[:2], norm=weights[2:])
    expected = residual_norm(x, branch.to(dtype), keep=keep, branch_norm=weights[:2], norm=weights[2:])
    assert total.dtype == torch.float32 and out.dtype == dtype
    assert_same_bits(total, expected[0])
    assert_same_bits(out, expected[1])


def test_runs_in_a_cuda_graph(devices):
    values = [t.to(devices[1]) for t in inputs(100, 64, dtype=torch.float32)]
    run = call(residual_norm, (True, True, True))
    expected = run(*values)
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        outs = run(*values)
    graph.replay()
    for a, b in zip(outs, expected, strict=True):
        assert_same_bits(a, b)


def test_two_runs_have_the_same_bits(device):
    parts, values = (True, True, True), [t.to(device) for t in inputs(2000, 96, dtype=torch.float32)]
    first, second = (gradients(residual_norm, values, cotangents_of(2000, 96), parts) for _ in range(2))
    for a, b in zip(first, second, strict=True):
        assert_same_bits(a, b)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("shape", [*SHAPES, (513, 2048), (0, 8), (4, 0)])
def test_sum_of_rows_is_the_gradient_of_a_bias(shape, dtype, device):
    grad = inputs(*shape, dtype=dtype, parts=(False,) * 3)[0]
    actual = torch.ops.gsim3d.linear_grad_bias(grad.to(device))
    assert actual.dtype == dtype
    assert_close_relative_to_max(actual, grad.double().sum(0), tolerance_of(dtype))


@pytest.mark.parametrize("dtype", LOW)
@pytest.mark.parametrize("shape", [(3000, 96), (700, 1536), (33, 7)])
def test_sum_of_rows_of_low_precision_is_float32(shape, dtype, devices):
    grad = inputs(*shape, parts=(False,) * 3)[0].to(devices[1], dtype)
    actual = torch.ops.gsim3d.linear_grad_bias(grad)
    assert actual.dtype == torch.float32
    assert_close_relative_to_max(actual, grad.double().sum(0), "row_norm_float32")


def test_gradient_of_the_branch_is_summed_for_a_bias_before_it(device):
    x, branch, keep, *weights = (t.to(device) for t in inputs())
    total, _, *stats = torch.ops.gsim3d.residual_norm(x, branch, keep, *weights, 1e-5)
    grads = torch.ops.gsim3d.residual_norm_backward(x, branch, branch, total, keep, weights[0], weights[2], *stats)
    assert_close_relative_to_max(grads[2], grads[1].sum(0), "row_norm_float64")


# 5 opcheck
@pytest.mark.parametrize("parts", [(True, True, True), (False, False, True), (False, False, False)])
def test_opcheck(parts):
    x, branch, *others = (t.requires_grad_() for t in inputs(6, 5, dtype=torch.float32, parts=parts))
    keep = others.pop(0).detach() if parts[0] else None
    weights = [others.pop(0) if has else None for has in (parts[1], parts[1], parts[2], parts[2])]
    torch.library.opcheck(torch.ops.gsim3d.residual_norm.default, (x, branch, keep, *weights, 1e-5))


@pytest.mark.parametrize("parts", PARTS)
def test_opcheck_of_the_gradients(parts):
    x, branch, *others = inputs(6, 5, dtype=torch.float32, parts=parts)
    keep = others.pop(0) if parts[0] else None
    weights = [others.pop(0) if has else None for has in (parts[1], parts[1], parts[2], parts[2])]
    total, _, *stats = torch.ops.gsim3d.residual_norm(x, branch, keep, *weights, 1e-5)
    arguments = (x, None, branch, total, keep, weights[0], weights[2], *stats)
    checks = ("test_schema", "test_faketensor")
    torch.library.opcheck(torch.ops.gsim3d.residual_norm_backward.default, arguments, test_utils=checks)
    torch.library.opcheck(torch.ops.gsim3d.linear_grad_bias.default, (x,), test_utils=checks)


# 6 torch.compile
def test_compiled_equals_eager():
    parts, values = (True, True, True), inputs(40, 6, dtype=torch.float32)
    f = lambda x, *others, **kw: residual_norm(x.sin(), *others, **kw)  # noqa: E731
    eager = gradients(f, values, cotangents_of(40, 6), parts)
    compiled = gradients(torch.compile(f, fullgraph=True, backend="aot_eager"), values, cotangents_of(40, 6), parts)
    for a, b in zip(compiled, eager, strict=True):
        assert_close_relative_to_max(a, b, "row_norm_float32")


# 7 edges
@pytest.mark.parametrize("parts", PARTS)
@pytest.mark.parametrize("shape", [(0, 4), (3, 0), (1, 1)])
def test_empty_rows_and_channels_and_one_value(shape, parts, device):
    values = [t.to(device) for t in inputs(*shape, parts=parts)]
    results = gradients(residual_norm, values, cotangents_of(*shape), parts)
    assert results[0].shape == results[1].shape == shape
    for result in results:
        assert torch.isfinite(result).all()
        assert shape[0] or not result.any()


@pytest.mark.parametrize("channels", [48, 19])
def test_row_does_not_depend_on_the_rows_it_is_packed_with(channels, device):
    x, branch, keep, *weights = (t.to(device) for t in inputs(130, channels, dtype=torch.float32))

    def run(rows, **kw):
        return residual_norm(x[rows], branch[rows], keep=keep[rows], branch_norm=weights[:2], norm=weights[2:], **kw)

    alone = run(slice(77, 78))
    for a, b in zip(run(slice(None)), alone, strict=True):
        assert_same_bits(a[77:78], b)
    x[3] = float("nan")
    for a, b in zip(run(slice(None), check=False), alone, strict=True):
        assert_same_bits(a[77:78], b)


def test_poison_is_refused_on_the_cpu():
    x, branch = inputs(dtype=torch.float32, parts=(False,) * 3)
    branch[5, 2] = float("inf")
    with pytest.raises(NumericalError, match="residual_norm: branch must be finite .* got inf in row 5"):
        residual_norm(x, branch)


def test_non_contiguous_and_unaligned_inputs(device):
    x, branch, keep, *weights = (t.to(device) for t in inputs(20, 12, dtype=torch.float32))
    norms = dict(keep=keep, branch_norm=weights[:2], norm=weights[2:])
    expected = residual_norm(x, branch, **norms)
    shifted = torch.cat([branch.new_zeros(1), branch.flatten()])[1:].view(20, 12)
    for actual in (
        residual_norm(x.T.contiguous().T, torch.cat([branch, branch], 1)[:, :12], **norms),
        residual_norm(x, shifted, **norms),
    ):
        for a, b in zip(actual, expected, strict=True):
            assert_close_relative_to_max(a, b, "row_norm_float32")


def test_same_bits_for_any_number_of_threads():
    values, parts = inputs(3000, 48, dtype=torch.float32), (True, True, True)
    assert_same_bits_for_any_threads(lambda: gradients(residual_norm, values, cotangents_of(3000, 48), parts))


def test_autocast_on_the_cpu_computes_in_float32():
    x, branch = inputs(20, 8, dtype=torch.float32, parts=(False,) * 3)
    with torch.autocast("cpu", torch.bfloat16):
        total, out = residual_norm(x, branch.bfloat16())
    assert_same_bits(total, x + branch.bfloat16().float())
    assert_same_bits(out, total)


# 8 error messages
@pytest.mark.parametrize(
    "wrong, message",
    [
        (dict(x=torch.zeros(3)), r"x must be \[N, C\]"),
        (dict(branch=torch.zeros(2, 4)), r"branch must be \[N, C\] like x = \[3, 4\]; got \[2, 4\]"),
        (dict(branch=torch.zeros(3, 4, dtype=torch.int32)), "branch must be float32 or float64; got int32"),
        (dict(branch=torch.zeros(3, 4, dtype=torch.float64)), "x must be float64; got float32"),
        (dict(keep=torch.zeros(3)), r"keep must be \[N, 1\] = \[3, 1\]; got \[3\]"),
        (dict(norm=(torch.ones(4), torch.ones(5))), r"bias must be \[C\] = \[4\]; got \[5\]"),
        (dict(branch_norm=(torch.ones(4), None)), r"branch_norm\[1\] must be a tensor; got NoneType"),
        (dict(norm=torch.ones(2, 4)), r"norm must be a pair \(weight, bias\); got Tensor"),
        (dict(eps=0.0), "eps must be at least 1e-30; got 0"),
    ],
)
def test_malformed_arguments_raise(wrong, message):
    good = dict(x=torch.zeros(3, 4), branch=torch.zeros(3, 4))
    with pytest.raises((ValueError, TypeError), match=f"residual_norm: .*{message}"):
        residual_norm(**(good | wrong))
