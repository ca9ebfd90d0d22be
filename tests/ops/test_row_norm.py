"""Layer normalisation of packed rows, in the eight sections that every op has."""

import pytest
import torch

from gsim3d.errors import NumericalError
from gsim3d.ops import row_norm
from tests.asserts import assert_close_relative_to_max, assert_same_bits, assert_same_bits_for_any_threads, gradients
from tests.oracle import row_norm as oracle

DTYPES = [torch.float32, torch.float64]
LOW = [torch.float16, torch.bfloat16]
SHAPES = [(70, 16), (33, 64), (20, 19), (9, 512), (300, 7), (5, 1000), (7, 257), (1100, 40)]


def inputs(n=70, channels=16, dtype=torch.float64, residual=True, seed=0):
    """x, weight, bias and residual; rows have their own means and scales."""
    g = torch.Generator().manual_seed(seed)
    random = lambda *shape: torch.randn(*shape, generator=g, dtype=torch.float64)  # noqa: E731
    x = random(n, channels) * (0.5 + random(n, 1).abs()) + random(n, 1)
    made = [x, random(channels), random(channels)] + ([random(n, channels)] if residual else [])
    return [t.to(dtype) for t in made]


def tolerance_of(dtype):
    return "row_norm_float32" if dtype == torch.float32 else "row_norm_float64"


# 1 forward against the oracle, 2 backward against autograd of the oracle
@pytest.mark.parametrize("residual", [False, True])
@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("shape", SHAPES)
def test_forward_and_gradients_equal_the_oracle(shape, dtype, residual, device):
    values = inputs(*shape, dtype=dtype, residual=residual)
    cotangent = inputs(*shape, dtype=dtype, seed=1)[0]
    actual = gradients(row_norm, [t.to(device) for t in values], cotangent)
    expected = gradients(oracle.row_norm, [t.double() for t in values], cotangent)
    for what, a, b in zip(("result", "x", "weight", "bias", "residual"), actual, expected):
        assert_close_relative_to_max(a, b, tolerance_of(dtype), what)


# 3 gradcheck
@pytest.mark.parametrize("residual", [False, True])
def test_gradcheck(residual):
    values = [t.requires_grad_() for t in inputs(4, 5, residual=residual)]
    torch.autograd.gradcheck(row_norm, values)


# 4 CPU against CUDA
@pytest.mark.parametrize("shape", SHAPES)
def test_cuda_equals_cpu(shape, devices):
    cotangent = inputs(*shape, dtype=torch.float32, seed=1)[0]
    cpu, cuda = (
        gradients(row_norm, [t.to(d) for t in inputs(*shape, dtype=torch.float32)], cotangent) for d in devices
    )
    for a, b in zip(cuda, cpu):
        assert_close_relative_to_max(a, b, "row_norm_float32")


@pytest.mark.parametrize("dtype", LOW)
@pytest.mark.parametrize("shape", SHAPES)
def test_low_precision_errs_no_more_than_torch(shape, dtype, devices):
    """Rows in 16 bits, sums in float32: at most twice torch's error in the same dtype."""
    values = [t.to(devices[1]) for t in inputs(*shape, dtype=torch.float32, residual=False)]
    low = [values[0].to(dtype), *values[1:]]
    cotangent = inputs(*shape, dtype=torch.float32, seed=1)[0].to(dtype)

    def plain(x, weight, bias):
        return torch.nn.functional.layer_norm(x.float(), weight.shape, weight, bias).to(dtype)

    exact = gradients(oracle.row_norm, [t.cpu().double() for t in low], cotangent.double())
    for ours, torchs, truth in zip(gradients(row_norm, low, cotangent), gradients(plain, low, cotangent), exact):
        assert ours.dtype == torchs.dtype
        error, allowed = ((t.cpu().double() - truth).abs().max().item() for t in (ours, torchs))
        assert error <= 2 * allowed + 1e-6 * truth.abs().max().item()


@pytest.mark.parametrize("dtype", LOW)
def test_rows_and_results_of_different_dtypes(dtype, devices):
    x, weight, bias, residual = (t.to(devices[1]) for t in inputs(50, 64, dtype=torch.float32))
    mixed = row_norm(x.to(dtype), weight, bias, residual)
    assert mixed.dtype == torch.float32
    assert_close_relative_to_max(mixed, row_norm(x.to(dtype).float(), weight, bias, residual), "row_norm_float32")
    with torch.autocast("cuda", dtype):
        narrow, wide = row_norm(x, weight, bias), row_norm(x.to(dtype), weight, bias, residual)
    assert narrow.dtype == dtype and wide.dtype == torch.float32
    assert_same_bits(narrow, row_norm(x, weight, bias).to(dtype))
    assert_same_bits(wide, mixed)


def test_runs_in_a_cuda_graph(devices):
    values = [t.to(devices[1]) for t in inputs(100, 64, dtype=torch.float32)]
    expected = row_norm(*values)
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        out = row_norm(*values)
    graph.replay()
    assert_same_bits(out, expected)


def test_two_runs_have_the_same_bits(device):
    values = [t.to(device) for t in inputs(2000, 96, dtype=torch.float32)]
    first, second = (gradients(row_norm, values, values[3]) for _ in range(2))
    for a, b in zip(first, second):
        assert_same_bits(a, b)


# 5 opcheck
@pytest.mark.parametrize("residual", [False, True])
def test_opcheck(residual):
    x, weight, bias, *rest = (t.requires_grad_() for t in inputs(6, 5, dtype=torch.float32, residual=residual))
    arguments = (x, weight, bias, rest[0] if rest else None, 1e-5, torch.float32)
    torch.library.opcheck(torch.ops.gsim3d.row_norm.default, arguments)


def test_opcheck_of_the_gradient():
    x, weight, bias, residual = inputs(6, 5, dtype=torch.float32)
    stats = torch.ops.gsim3d.row_norm(x, weight, bias, None, 1e-5, torch.float32)[1]
    checks = ("test_schema", "test_faketensor")
    torch.library.opcheck(torch.ops.gsim3d.row_norm_backward.default, (residual, x, weight, stats), test_utils=checks)


# 6 torch.compile
def test_compiled_equals_eager():
    values = inputs(40, 6, dtype=torch.float32)
    compiled = torch.compile(lambda x, w, b, r: row_norm(x.sin(), w, b, r), fullgraph=True, backend="aot_eager")
    eager = gradients(lambda x, w, b, r: row_norm(x.sin(), w, b, r), values, values[3])
    for a, b in zip(gradients(compiled, values, values[3]), eager):
        assert_close_relative_to_max(a, b, "row_norm_float32")


# 7 edges
def test_empty_rows_and_channels(device):
    x = torch.zeros(0, 4, device=device, requires_grad=True)
    weight = torch.ones(4, device=device, requires_grad=True)
    out = row_norm(x, weight, weight)
    grads = torch.autograd.grad(out.sum(), [x, weight])
    assert out.shape == (0, 4) and grads[0].shape == (0, 4) and grads[1].tolist() == [0.0] * 4
    none = torch.zeros(0, device=device)
    assert row_norm(torch.zeros(3, 0, device=device), none, none).shape == (3, 0)


def test_equal_channels_are_zero_before_the_shift(device):
    x = torch.full((2, 8), 5.0, device=device, requires_grad=True)
    weight, bias = torch.full((8,), 2.0, device=device), torch.arange(8.0, device=device)
    out = row_norm(x, weight, bias)
    assert_same_bits(out, bias.expand(2, 8).contiguous())
    assert torch.isfinite(torch.autograd.grad(out.square().sum(), x)[0]).all()


def test_row_does_not_depend_on_the_rows_it_is_packed_with(device):
    x, weight, bias, residual = (t.to(device) for t in inputs(130, 48, dtype=torch.float32))
    alone = row_norm(x[77:78], weight, bias, residual[77:78])
    assert_same_bits(row_norm(x, weight, bias, residual)[77:78], alone)
    x[3] = float("nan")
    assert_same_bits(row_norm(x, weight, bias, residual, check=False)[77:78], alone)


def test_poison_is_refused_on_the_cpu():
    x, weight, bias, residual = inputs(130, 48, dtype=torch.float32)
    x[3, 7] = float("nan")
    with pytest.raises(NumericalError, match="row_norm: x must be finite .* got nan in row 3"):
        row_norm(x, weight, bias, residual)


def test_non_contiguous_and_unaligned_inputs(device):
    x, weight, bias, residual = (t.to(device) for t in inputs(20, 12, dtype=torch.float32))
    expected = row_norm(x, weight, bias, residual)
    wide = torch.cat([x, x], 1)[:, :12]
    assert_same_bits(row_norm(wide, weight, bias, residual.T.contiguous().T), expected)
    shifted = torch.cat([x.new_zeros(1), x.flatten()])[1:].view(20, 12)
    assert_close_relative_to_max(row_norm(shifted, weight, bias, residual), expected, "row_norm_float32")


def test_large_values_stay_finite(device):
    x, weight, bias = (t.to(device) for t in inputs(10, 32, dtype=torch.float32, residual=False))
    x = (x * 1e15).requires_grad_()
    out = row_norm(x, weight, bias, check=False)
    assert torch.isfinite(out).all() and torch.isfinite(torch.autograd.grad(out.sum(), x)[0]).all()


def test_same_bits_for_any_number_of_threads():
    values = inputs(3000, 48, dtype=torch.float32)
    assert_same_bits_for_any_threads(lambda: gradients(row_norm, values, values[3]))


def test_autocast_on_the_cpu_computes_in_float32():
    x, weight, bias = inputs(20, 8, dtype=torch.float32, residual=False)
    with torch.autocast("cpu", torch.bfloat16):
        out = row_norm(x.bfloat16(), weight, bias)
    assert_same_bits(out, row_norm(x.bfloat16().float(), weight, bias))


# 8 error messages
@pytest.mark.parametrize(
    "wrong, message",
    [
        (dict(x=torch.zeros(3)), r"x must be \[N, C\]"),
        (dict(x=torch.zeros(3, 4, dtype=torch.int32)), "must be float32 or float64.*got int32"),
        (dict(weight=torch.ones(5)), r"weight must be \[C\] = \[4\]; got \[5\]"),
        (dict(bias=torch.ones(4, dtype=torch.float64)), "bias must be float32; got float64"),
        (dict(residual=torch.zeros(2, 4)), r"residual must be \[N, C\] like x = \[3, 4\]; got \[2, 4\]"),
        (dict(eps=0.0), "eps must be at least 1e-30; got 0"),
        (dict(residual=torch.zeros(3, 4, dtype=torch.float64)), "must be float32 or float64; got float32 and float64"),
    ],
)
def test_malformed_arguments_raise(wrong, message):
    good = dict(x=torch.zeros(3, 4), weight=torch.ones(4), bias=torch.ones(4), residual=None, eps=1e-5)
    with pytest.raises(ValueError, match=f"row_norm: .*{message}"):
        row_norm(**(good | wrong))
