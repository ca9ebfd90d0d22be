"""Normalisation of channels and its activation, in the eight sections that every op has."""

import pytest
import torch

from gsim3d.errors import NumericalError
from gsim3d.ops import norm_gelu
from tests.asserts import assert_close_relative_to_max, assert_same_bits, assert_same_bits_for_any_threads, gradients
from tests.oracle import row_norm as oracle

LOW = [torch.float16, torch.bfloat16]
SHAPES = [(70, 16), (33, 64), (20, 19), (9, 512), (300, 7), (1100, 40), (300, 200)]


def inputs(n=70, channels=16, dtype=torch.float64, seed=0):
    """x, mean, scale, bias."""
    g = torch.Generator().manual_seed(seed)
    shapes = ((n, channels), (channels,), (channels,), (channels,))
    return [torch.randn(*shape, generator=g, dtype=torch.float64).to(dtype) for shape in shapes]


def cotangent_of(n=70, channels=16):
    return inputs(n, channels, seed=1)[0]


def tolerance_of(dtype):
    return "row_norm_float32" if dtype == torch.float32 else "row_norm_float64"


# 1 forward against the oracle, 2 backward against autograd of the oracle
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("shape", SHAPES)
def test_forward_and_gradients_equal_the_oracle(shape, dtype, device):
    values = inputs(*shape, dtype=dtype)
    actual = gradients(norm_gelu, [t.to(device) for t in values], cotangent_of(*shape))
    expected = gradients(oracle.norm_gelu, [t.double() for t in values], cotangent_of(*shape))
    for what, a, b in zip(("result", "x", "mean", "scale", "bias"), actual, expected, strict=True):
        assert_close_relative_to_max(a, b, tolerance_of(dtype), what)


# 3 gradcheck
def test_gradcheck():
    torch.autograd.gradcheck(norm_gelu, [t.requires_grad_() for t in inputs(4, 5)])


# 4 CPU against CUDA
@pytest.mark.parametrize("shape", SHAPES)
def test_cuda_equals_cpu(shape, devices):
    values = inputs(*shape, dtype=torch.float32)
    cpu, cuda = (gradients(norm_gelu, [t.to(d) for t in values], cotangent_of(*shape)) for d in devices)
    for a, b in zip(cuda, cpu, strict=True):
        assert_close_relative_to_max(a, b, "row_norm_float32")


@pytest.mark.parametrize("dtype", LOW)
@pytest.mark.parametrize("shape", SHAPES)
def test_low_precision_errs_no_more_than_torch(shape, dtype, devices):
    """Rows in 16 bits, all else float32: at most twice torch's error in the same dtypes."""
    x, *others = (t.to(devices[1]) for t in inputs(*shape, dtype=torch.float32))
    values = [x.to(dtype), *others]

    def plain(x, mean, scale, bias):
        return torch.nn.functional.gelu((x - mean) * scale + bias)

    exact = gradients(oracle.norm_gelu, [t.cpu().double() for t in values], cotangent_of(*shape))
    ours, torchs = (gradients(f, values, cotangent_of(*shape)) for f in (norm_gelu, plain))
    for a, b, truth in zip(ours, torchs, exact, strict=True):
        assert a.dtype == b.dtype
        error, allowed = ((t.cpu().double() - truth).abs().max().item() for t in (a, b))
        assert error <= 2 * allowed + 1e-6 * truth.abs().max().item()


@pytest.mark.parametrize("dtype", LOW)
def test_rows_stay_in_their_dtype_under_autocast(dtype, devices):
    x, *others = (t.to(devices[1]) for t in inputs(dtype=torch.float32))
    with torch.autocast("cuda", dtype):
        wide, narrow = norm_gelu(x, *others), norm_gelu(x.to(dtype), *others)
    assert wide.dtype == narrow.dtype == torch.float32
    assert_same_bits(wide, norm_gelu(x, *others))
    assert_same_bits(narrow, norm_gelu(x.to(dtype).float(), *others))


@pytest.mark.parametrize("dtype", LOW)
def test_gradient_of_a_plain_activation_and_the_bias_before_it(dtype, devices):
    x, grad = (f(600, 96).to(devices[1], dtype) for f in (lambda *s: inputs(*s)[0], cotangent_of))
    zero, one = torch.zeros(96, device=devices[1]), torch.ones(96, device=devices[1])
    grad_x, _, grad_bias = torch.ops.gsim3d.norm_gelu_backward(grad, x, zero, one, zero)
    exact = torch.ops.aten.gelu_backward(grad.double(), x.double())
    assert grad_x.dtype == dtype and grad_bias.dtype == torch.float32
    torchs = torch.ops.aten.gelu_backward(grad, x).double()
    assert (grad_x.double() - exact).abs().max() <= 2 * (torchs - exact).abs().max()
    assert_close_relative_to_max(grad_bias, exact.sum(0), "row_norm_float32")


def test_runs_in_a_cuda_graph(devices):
    values = [t.to(devices[1]) for t in inputs(100, 64, dtype=torch.float32)]
    expected = norm_gelu(*values)
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        out = norm_gelu(*values)
    graph.replay()
    assert_same_bits(out, expected)


def test_two_runs_have_the_same_bits(device):
    values = [t.to(device) for t in inputs(2000, 96, dtype=torch.float32)]
    first, second = (gradients(norm_gelu, values, cotangent_of(2000, 96)) for _ in range(2))
    for a, b in zip(first, second, strict=True):
        assert_same_bits(a, b)


# 5 opcheck
def test_opcheck():
    values = [t.requires_grad_() for t in inputs(6, 5, dtype=torch.float32)]
    torch.library.opcheck(torch.ops.gsim3d.norm_gelu.default, (*values, torch.float32))


def test_opcheck_of_the_gradient():
    values = inputs(6, 5, dtype=torch.float32)
    checks = ("test_schema", "test_faketensor")
    torch.library.opcheck(torch.ops.gsim3d.norm_gelu_backward.default, (values[0], *values), test_utils=checks)


# 6 torch.compile
def test_compiled_equals_eager():
    values = inputs(40, 6, dtype=torch.float32)
    f = lambda x, *others: norm_gelu(x.sin(), *others)  # noqa: E731
    eager = gradients(f, values, cotangent_of(40, 6))
    compiled = gradients(torch.compile(f, fullgraph=True, backend="aot_eager"), values, cotangent_of(40, 6))
    for a, b in zip(compiled, eager, strict=True):
        assert_close_relative_to_max(a, b, "row_norm_float32")


# 7 edges
@pytest.mark.parametrize("shape", [(0, 4), (3, 0), (1, 1)])
def test_empty_rows_and_channels_and_one_value(shape, device):
    results = gradients(norm_gelu, [t.to(device) for t in inputs(*shape)], cotangent_of(*shape))
    assert results[0].shape == shape
    for result in results:
        assert torch.isfinite(result).all()
        assert shape[0] or not result.any()


def test_row_does_not_depend_on_the_rows_it_is_packed_with(device):
    x, *others = (t.to(device) for t in inputs(130, 48, dtype=torch.float32))
    alone = norm_gelu(x[77:78], *others)
    assert_same_bits(norm_gelu(x, *others)[77:78], alone)
    x[3] = float("nan")
    assert_same_bits(norm_gelu(x, *others, check=False)[77:78], alone)


def test_poison_is_refused_on_the_cpu():
    x, mean, *others = inputs(dtype=torch.float32)
    mean[2] = float("nan")
    with pytest.raises(NumericalError, match="norm_gelu: mean must be finite .* got nan in row 2"):
        norm_gelu(x, mean, *others)


def test_non_contiguous_and_unaligned_inputs(device):
    x, *others = (t.to(device) for t in inputs(20, 12, dtype=torch.float32))
    expected = norm_gelu(x, *others)
    shifted = torch.cat([x.new_zeros(1), x.flatten()])[1:].view(20, 12)
    for actual in (norm_gelu(x.T.contiguous().T, *others), norm_gelu(shifted, *others)):
        assert_close_relative_to_max(actual, expected, "row_norm_float32")


def test_large_values_are_passed_or_cut(device):
    x = torch.tensor([[1e20, -1e20]], device=device, requires_grad=True)
    zero, one = torch.zeros(2, device=device), torch.ones(2, device=device)
    out = norm_gelu(x, zero, one, zero, check=False)
    assert out.tolist() == [[x[0, 0].item(), 0]]
    assert torch.autograd.grad(out.sum(), x)[0].tolist() == [[1, 0]]


def test_same_bits_for_any_number_of_threads():
    values = inputs(3000, 48, dtype=torch.float32)
    assert_same_bits_for_any_threads(lambda: gradients(norm_gelu, values, cotangent_of(3000, 48)))


def test_autocast_on_the_cpu_computes_in_float32():
    x, *others = inputs(20, 8, dtype=torch.float32)
    with torch.autocast("cpu", torch.bfloat16):
        out = norm_gelu(x.bfloat16(), *others)
    assert_same_bits(out, norm_gelu(x.bfloat16().float(), *others))


# 8 error messages
@pytest.mark.parametrize(
    "wrong, message",
    [
        (dict(x=torch.zeros(3)), r"x must be \[N, C\]"),
        (dict(x=torch.zeros(3, 4, dtype=torch.int32)), "must be float32 or float64.*got int32"),
        (dict(mean=torch.ones(5)), r"mean must be \[C\] = \[4\]; got \[5\]"),
        (dict(scale=torch.ones(4, 1)), r"scale must be \[C\] = \[4\]; got \[4, 1\]"),
        (dict(bias=torch.ones(4, dtype=torch.float64)), "bias must be float32; got float64"),
    ],
)
def test_malformed_arguments_raise(wrong, message):
    good = dict(x=torch.zeros(3, 4), mean=torch.zeros(4), scale=torch.ones(4), bias=torch.zeros(4))
    with pytest.raises(ValueError, match=f"norm_gelu: .*{message}"):
        norm_gelu(**(good | wrong))
