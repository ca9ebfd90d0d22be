"""Decoding of predicted Gaussians, in the eight sections that every op has."""

import pytest
import torch

from gsim3d.errors import NumericalError
from gsim3d.math.rotations import rotation_matrices, unit_quats
from gsim3d.math.spherical_harmonics import degree_damping, readings, rotate_harmonics
from gsim3d.ops import decode_gaussians
from tests.asserts import assert_close_relative_to_max, assert_same_bits, assert_same_bits_for_any_threads

LOW, HIGH = 0.001, 0.1
DEGREES = [(3, 3), (3, 2), (3, 0), (2, 2), (1, 1), (0, 0), (2, -1), (-1, -1)]  # of a row, and of what is kept


def inputs(n=70, degree=3, dtype=torch.float64, device="cpu"):
    raw = torch.randn(n, 3 * (degree + 1) ** 2 + 7, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    return raw.to(device, dtype), readings_of(dtype, device)


def readings_of(dtype, device="cpu"):
    return readings(torch.float64 if dtype == torch.float64 else torch.float32, torch.device(device))


def decode(raw, table, degree=3):
    return decode_gaussians(raw, table, degree=degree, scale_min=LOW, scale_max=HIGH)


def oracle(raw, degree=3):
    """The same by plain torch."""
    n_terms, kept = (raw.shape[1] - 7) // 3, (degree + 1) ** 2
    sh, quats, scales = raw.split([raw.shape[1] - 7, 4, 3], 1)
    quats = unit_quats(quats.roll(1, 1))
    if not kept:
        return quats, LOW + (HIGH - LOW) * scales.sigmoid(), raw[:, :0, None].expand(-1, -1, 3)
    damping = degree_damping(round(n_terms**0.5) - 1, sh)[:kept, None]
    sh = rotate_harmonics(sh.unflatten(1, (3, -1))[:, :, :kept].mT * damping, rotation_matrices(quats))
    return quats, LOW + (HIGH - LOW) * scales.sigmoid(), sh


def run(f, raw, degree=3):
    """Results, and the gradient for seeded cotangents."""
    raw = raw.detach().requires_grad_()
    out, g = f(raw), torch.Generator().manual_seed(1)
    cotangents = [torch.randn(t.shape, generator=g, dtype=torch.float64).to(t) for t in out]
    return [*(t.detach() for t in out), *torch.autograd.grad(out, raw, cotangents)]


def assert_same(actual, expected, tolerance):
    for what, a, b in zip(("quats", "scales", "sh", "gradient"), actual, expected, strict=True):
        assert a.shape == b.shape
        if b.numel():
            assert_close_relative_to_max(a, b, tolerance, what)


# 1 forward against the oracle, 2 backward against autograd of the oracle
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("degrees", DEGREES)
def test_forward_and_gradients_equal_the_oracle(degrees, dtype, device):
    raw, table = inputs(degree=degrees[0], dtype=dtype, device=device)
    raw[5, -7:-3] = 0  # no direction: the identity, without a gradient
    actual = run(lambda raw: decode(raw, table, degrees[1]), raw)
    expected = run(lambda raw: oracle(raw, degrees[1]), raw.cpu().double())
    assert_same(actual, expected, "decode_float32" if dtype == torch.float32 else "decode_float64")
    assert actual[0][5].tolist() == [1, 0, 0, 0] and not actual[3][5, -7:-3].any()


# 3 gradcheck
@pytest.mark.parametrize("degree", [-1, 0, 1, 2, 3])
def test_gradcheck(degree):
    raw, table = inputs(3, degree)
    torch.autograd.gradcheck(lambda raw: decode(raw, table, degree), raw.requires_grad_())


# 4 CPU against CUDA
@pytest.mark.parametrize("n", [1, 63, 64, 65, 1000])
def test_cuda_equals_cpu(n, devices):
    cpu, cuda = (run(lambda raw: decode(raw, inputs(n, device=d, dtype=torch.float32)[1]),
                     inputs(n, device=d, dtype=torch.float32)[0]) for d in devices)  # fmt: skip
    assert_same(cuda, cpu, "decode_float32")


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_16_bit_rows_are_computed_in_float32(dtype, devices):
    raw, table = inputs(200, dtype=dtype, device=devices[1])
    narrow = run(lambda raw: decode(raw, table), raw)
    wide = run(lambda raw: decode(raw, table), raw.float())
    assert narrow[3].dtype == dtype
    for a, b in zip(narrow, [*wide[:3], wide[3].to(dtype)], strict=True):
        assert_same_bits(a, b)
    with torch.autocast("cuda", dtype):
        assert_same_bits(decode(raw, table)[2], wide[2])


def test_runs_in_a_cuda_graph(devices):
    raw, table = inputs(100, dtype=torch.float32, device=devices[1])
    expected, graph = decode(raw, table), torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        out = decode(raw, table)
    graph.replay()
    for a, b in zip(out, expected, strict=True):
        assert_same_bits(a, b)


def test_two_runs_have_the_same_bits(device):
    raw, table = inputs(3000, dtype=torch.float32, device=device)
    first, second = (run(lambda raw: decode(raw, table), raw) for _ in range(2))
    for a, b in zip(first, second, strict=True):
        assert_same_bits(a, b)


def test_same_bits_for_any_number_of_threads():
    raw, table = inputs(5000, dtype=torch.float32)
    assert_same_bits_for_any_threads(lambda: run(lambda raw: decode(raw, table), raw))


# 5 opcheck
def test_opcheck():
    raw, table = inputs(6, dtype=torch.float32)
    torch.library.opcheck(torch.ops.gsim3d.decode_gaussians.default, (raw.requires_grad_(), table, 3, LOW, HIGH))
    grads = [torch.ones(6, 4), torch.ones(6, 3), torch.ones(6, 9, 3)]
    torch.library.opcheck(
        torch.ops.gsim3d.decode_gaussians_backward.default,
        (*grads, raw.detach(), table, 2, LOW, HIGH),
        test_utils=("test_schema", "test_faketensor"),
    )


# 6 torch.compile
def test_compiled_equals_eager():
    raw, table = inputs(40, dtype=torch.float32)
    f = lambda raw: decode(raw.sin(), table)  # noqa: E731
    compiled = torch.compile(f, fullgraph=True, backend="aot_eager")
    assert_same(run(compiled, raw), run(f, raw), "decode_float32")


# 7 edges
def test_empty_rows(device):
    raw, table = inputs(0, device=device)
    assert [t.shape for t in run(lambda raw: decode(raw, table), raw)] == [(0, 4), (0, 3), (0, 16, 3), (0, 55)]


def test_numbers_of_any_size_give_finite_results(device):
    raw, table = inputs(12, device=device, dtype=torch.float32)
    for i, size in enumerate((1e15, -1e15, 1e-30, 1e-38)):
        raw[i, -7:] = size
    for result in run(lambda raw: decode(raw, table), raw):
        assert torch.isfinite(result).all()


# 8 errors
def test_malformed_arguments_raise():
    raw, table = inputs(4, degree=2)
    for arguments, named in (
        ((raw[0], table, 2), "raw"),
        ((raw[:, 1:], table, 2), "raw must have 3 K"),
        ((raw, table, 3), "at least 16"),
        ((raw, table, -2), "degree must be -1 to 3"),
        ((raw, table[1:], 2), "readings"),
        ((raw, table.float(), 2), "readings"),
    ):
        with pytest.raises(ValueError, match=named):
            decode(*arguments)
    for bounds in ((-1.0, 0.1), (0.1, 0.05), (0.0, float("inf")), (float("nan"), 1.0)):
        with pytest.raises(ValueError, match="scale_min and scale_max must"):
            decode_gaussians(raw, table, degree=2, scale_min=bounds[0], scale_max=bounds[1])
    with pytest.raises(TypeError, match="degree must be a whole number"):
        decode(raw, table, 1.5)


def test_numbers_that_are_none_raise():
    raw, table = inputs(4)
    raw[2, 7] = torch.nan
    with pytest.raises(NumericalError, match="raw must be finite .* row 2"):
        decode(raw, table)


@pytest.mark.parametrize("size", [-9.9e14, 2e3, torch.inf])
@pytest.mark.parametrize("place", [0, 74, 127])
def test_readings_too_large_for_products_raise(place, size):
    raw, table = inputs(4)
    table = table.clone()
    table[place] = size
    with pytest.raises(NumericalError, match=f"readings must be finite and at most 1000 .* row {place}"):
        decode(raw, table)


@pytest.mark.parametrize("degree", range(4))
def test_largest_numbers_stay_finite(degree):
    raw = torch.full((3, 55), 1e15, requires_grad=True)
    with torch.no_grad():
        raw[1] *= -1
        raw[2, ::2] *= -1
    outputs = decode_gaussians(raw, torch.full((128,), 1e3), degree=degree, scale_min=0.0, scale_max=1.0)
    (grad,) = torch.autograd.grad(sum(x.sum() for x in outputs), raw)
    assert all(x.isfinite().all() for x in outputs) and grad.isfinite().all()
