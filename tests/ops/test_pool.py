"""Grid pooling and unpooling, in the eight sections that every op has."""

import pytest
import torch

from gsim3d.errors import NumericalError
from gsim3d.ops import pool_max, pool_mean, unpool
from tests.asserts import (
    assert_close_relative_to_max,
    assert_same_bits,
    assert_same_bits_for_any_threads,
    gradients,
)
from tests.oracle import pool as oracle

DTYPES = [torch.float32, torch.float64]


def segments(n_rows: int, n_segments: int, left_out: int = 0, seed: int = 0):
    """Random ragged segments, some empty; ``left_out`` rows are in none."""
    generator = torch.Generator().manual_seed(seed)
    rows = torch.randperm(n_rows, generator=generator)[: n_rows - left_out]
    cuts = torch.randint(0, len(rows) + 1, (n_segments - 1,), generator=generator).sort().values
    return rows, torch.cat([torch.tensor([0]), cuts, torch.tensor([len(rows)])])


def features(*shape, dtype=torch.float64, seed=1):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64).to(dtype)


def functions(rows, cu_rows, n_rows):
    """name -> (gsim3d, oracle, rows of the input)."""
    m = len(cu_rows) - 1
    return {
        "max": (lambda x: pool_max(x, rows, cu_rows), lambda x: oracle.pool_max(x, rows.cpu(), cu_rows.cpu()), n_rows),
        "mean": (
            lambda x: pool_mean(x, rows, cu_rows),
            lambda x: oracle.pool_mean(x, rows.cpu(), cu_rows.cpu()),
            n_rows,
        ),
        "unpool": (
            lambda x: unpool(x, rows, cu_rows, n_rows),
            lambda x: oracle.unpool(x, rows.cpu(), cu_rows.cpu(), n_rows),
            m,
        ),
    }


def tolerance_of(dtype):
    return "pool_float32" if dtype == torch.float32 else "pool_float64"


NAMES = ["max", "mean", "unpool"]
SHAPES = [(200, 60, 0, 37), (200, 60, 25, 16), (90, 7, 3, 1), (30, 30, 0, 8)]  # rows, segments, left out, channels


# 1 forward against the oracle, 2 backward against autograd of the oracle
@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("name", NAMES)
def test_forward_and_gradient_equal_the_oracle(name, shape, dtype, device):
    n_rows, n_segments, left_out, channels = shape
    rows, cu_rows = (t.to(device) for t in segments(n_rows, n_segments, left_out))
    ours, reference, n_in = functions(rows, cu_rows, n_rows)[name]
    x = features(n_in, channels, dtype=dtype)
    cotangent = features(*reference(x).shape, dtype=dtype, seed=2)
    actual = gradients(ours, [x.to(device)], cotangent)
    expected = gradients(reference, [x.double()], cotangent)
    for what, a, b in zip(("result", "gradient"), actual, expected):
        assert_close_relative_to_max(a, b, tolerance_of(dtype), what)


# 3 gradcheck
@pytest.mark.parametrize("name", NAMES)
def test_gradcheck(name):
    rows, cu_rows = segments(12, 5, 2)
    ours, _, n_in = functions(rows, cu_rows, 12)[name]
    x = torch.randperm(n_in * 3, generator=torch.Generator().manual_seed(0)).reshape(n_in, 3).double()  # no ties
    torch.autograd.gradcheck(ours, [x.requires_grad_()])


# 4 CPU against CUDA
@pytest.mark.parametrize("name", NAMES)
def test_cuda_equals_cpu(name, devices):
    results = []
    for device in devices:
        rows, cu_rows = (t.to(device) for t in segments(200, 60, 25))
        ours, _, n_in = functions(rows, cu_rows, 200)[name]
        x = features(n_in, 32, dtype=torch.float32).to(device)
        cotangent = features(*ours(x).shape, dtype=torch.float32, seed=2)
        results.append(gradients(ours, [x], cotangent))
    for cpu, cuda in zip(*results):
        assert_close_relative_to_max(cuda, cpu, "pool_float32")


# 5 opcheck
@pytest.mark.parametrize("op", ["pool_max", "pool_mean", "unpool"])
def test_opcheck(op):
    rows, cu_rows = segments(12, 5, 2)
    more = (12,) if op == "unpool" else ()
    x = features(5 if op == "unpool" else 12, 3, dtype=torch.float32).requires_grad_()
    torch.library.opcheck(getattr(torch.ops.gsim3d, op).default, (x, rows, cu_rows, *more))


@pytest.mark.parametrize("op", ["pool_max_backward", "pool_mean_backward", "unpool_backward"])
def test_opcheck_of_gradients(op):
    rows, cu_rows = segments(12, 5, 2)
    grad = features(12 if op == "unpool_backward" else 5, 3, dtype=torch.float32)
    arguments = {
        "pool_max_backward": lambda: (grad, torch.ops.gsim3d.pool_max(features(12, 3), rows, cu_rows)[1], 12),
        "pool_mean_backward": lambda: (grad, rows, cu_rows, 12),
        "unpool_backward": lambda: (grad, rows, cu_rows),
    }[op]()
    checks = ("test_schema", "test_faketensor")
    torch.library.opcheck(getattr(torch.ops.gsim3d, op).default, arguments, test_utils=checks)


# 6 torch.compile
def test_compiled_equals_eager():
    rows, cu_rows = segments(40, 9)

    def block(x, rows, cu_rows):
        return unpool(pool_max(x, rows, cu_rows) + pool_mean(x.sin(), rows, cu_rows), rows, cu_rows, x.shape[0])

    x, cotangent = features(40, 6, dtype=torch.float32), features(40, 6, dtype=torch.float32, seed=2)
    compiled = torch.compile(block, fullgraph=True, backend="aot_eager")
    eager = gradients(lambda x: block(x, rows, cu_rows), [x], cotangent)
    for a, b in zip(gradients(lambda x: compiled(x, rows, cu_rows), [x], cotangent), eager):
        assert_close_relative_to_max(a, b, "pool_float32")


# 7 edges
def test_empty_inputs(device):
    none = torch.zeros(0, dtype=torch.int64, device=device)
    zero = torch.zeros(1, dtype=torch.int64, device=device)
    x = torch.zeros(0, 4, device=device)
    assert pool_max(x, none, zero).shape == pool_mean(x, none, zero).shape == (0, 4)
    assert unpool(x, none, zero, 0).shape == (0, 4)
    assert pool_max(torch.zeros(3, 0, device=device), none, zero).shape == (0, 0)


def test_empty_segments_and_unlisted_rows_are_zero(device):
    x = torch.tensor([[1.0], [2.0], [3.0]], device=device, requires_grad=True)
    rows, cu_rows = torch.tensor([2], device=device), torch.tensor([0, 0, 1, 1], device=device)
    for pool in (pool_max, pool_mean):
        out = pool(x, rows, cu_rows)
        assert out.tolist() == [[0.0], [3.0], [0.0]]
        assert torch.autograd.grad(out.sum(), x)[0].tolist() == [[0.0], [0.0], [1.0]]
    assert unpool(x, rows, cu_rows, 3).tolist() == [[0.0], [0.0], [2.0]]


def test_one_row(device):
    rows, cu_rows = torch.tensor([0], device=device), torch.tensor([0, 1], device=device)
    x = torch.tensor([[-5.0, 2.0]], device=device)
    for out in (pool_max(x, rows, cu_rows), pool_mean(x, rows, cu_rows), unpool(x, rows, cu_rows, 1)):
        assert_same_bits(out, x)


@pytest.mark.parametrize("channels", [1, 3, 8, 16, 20, 32])
def test_first_of_equal_maxima_gets_the_gradient(channels, device):
    x = torch.ones(4, channels, device=device, requires_grad=True)
    out = pool_max(x, torch.tensor([2, 0, 3, 1], device=device), torch.tensor([0, 3, 4], device=device))
    grad = torch.autograd.grad(out.sum(), x)[0]
    assert grad[:, 0].tolist() == [0.0, 1.0, 1.0, 0.0] and torch.equal(grad, grad[:, :1].expand_as(grad))


@pytest.mark.parametrize("channels", [1, 16])
@pytest.mark.parametrize("bad_row", [0, 1, 2])
def test_nan_and_infinity_pass_through(bad_row, channels, device):
    rows, cu_rows = torch.tensor([0, 1, 2, 3], device=device), torch.tensor([0, 3, 4], device=device)
    x = features(4, channels, dtype=torch.float32).to(device)
    x[bad_row] = float("nan")
    out, argmax = torch.ops.gsim3d.pool_max(x, rows, cu_rows)
    assert out[0].isnan().all() and (argmax[0] == bad_row).all() and not out[1].isnan().any()
    assert pool_mean(x, rows, cu_rows, check=False)[0].isnan().all()
    x[bad_row] = float("-inf")
    assert torch.isfinite(pool_max(x, rows, cu_rows, check=False)).all()


@pytest.mark.parametrize("poison", [float("nan"), float("-inf"), -1e30])
def test_poison_is_refused_on_the_cpu(poison):
    rows, cu_rows = torch.tensor([0, 1, 2, 3]), torch.tensor([0, 3, 4])
    x = features(4, 3, dtype=torch.float32)
    x[2, 1] = poison
    for name, call in {
        "pool_max": lambda: pool_max(x, rows, cu_rows),
        "pool_mean": lambda: pool_mean(x, rows, cu_rows),
        "unpool": lambda: unpool(x, rows, torch.arange(5), 4),
    }.items():
        with pytest.raises(NumericalError, match=f"{name}: x must be finite .* in row 2"):
            call()


def test_result_beyond_memory_is_named():
    with pytest.raises(MemoryError, match="unpool: there is no memory for the result of n_rows=4611686018427387904"):
        unpool(torch.ones(1, 1), torch.tensor([0]), torch.tensor([0, 1]), 2**62)


@pytest.mark.parametrize("what", [None, "3", [1.0], torch.ones(3).to_sparse()])
def test_sparse_argument_is_named(what):
    with pytest.raises(TypeError, match="pool_max: rows must be a (dense )?tensor; got"):
        pool_max(torch.ones(3, 1), what, torch.tensor([0, 3]))
    with pytest.raises(TypeError, match="n_rows must be a whole number"):
        unpool(torch.ones(1, 1), torch.tensor([0]), torch.tensor([0, 1]), what)


def test_non_contiguous_inputs(device):
    rows, cu_rows = (t.to(device) for t in segments(20, 6))
    x = features(8, 20, dtype=torch.float32).to(device).T  # strides (1, 20)
    wide = torch.stack([rows, rows], 1)[:, 0]
    for pool in (pool_max, pool_mean):
        assert_same_bits(pool(x, wide, cu_rows), pool(x.contiguous(), rows, cu_rows))
    small = features(8, 6, dtype=torch.float32).to(device).T
    assert_same_bits(unpool(small, rows, cu_rows, 20), unpool(small.contiguous(), rows, cu_rows, 20))


def test_autocast_computes_in_float32(device):
    rows, cu_rows = (t.to(device) for t in segments(20, 6))
    x = features(20, 8, dtype=torch.float32).to(device).bfloat16()
    with torch.autocast(device.type, torch.bfloat16):
        outs = [pool_max(x, rows, cu_rows), pool_mean(x, rows, cu_rows), unpool(x[:6], rows, cu_rows, 20)]
    assert {out.dtype for out in outs} == {torch.float32}
    assert_same_bits(outs[1], pool_mean(x.float(), rows, cu_rows))


def test_one_large_segment(device):
    rows, cu_rows = torch.arange(1000, device=device), torch.tensor([0, 1000], device=device)
    x = features(1000, 19).to(device)
    assert_same_bits(pool_max(x, rows, cu_rows)[0], x.max(0).values)
    assert_close_relative_to_max(pool_mean(x, rows, cu_rows)[0], x.mean(0), 1e-12)


def test_same_bits_for_any_number_of_threads():
    rows, cu_rows = segments(5000, 1200, 300)
    x, small = features(5000, 48, dtype=torch.float32), features(1200, 48, dtype=torch.float32)

    def run():
        max_and_mean = [gradients(f, [x], small) for f, _, _ in list(functions(rows, cu_rows, 5000).values())[:2]]
        return [*max_and_mean[0], *max_and_mean[1], *gradients(lambda s: unpool(s, rows, cu_rows, 5000), [small], x)]

    assert_same_bits_for_any_threads(run)


# 8 error messages
def call(x=None, rows=(0, 1), cu_rows=(0, 1, 2)):
    x = torch.zeros(3, 2) if x is None else x
    rows = torch.tensor(rows, dtype=torch.int64) if isinstance(rows, tuple) else rows
    cu_rows = torch.tensor(cu_rows, dtype=torch.int64) if isinstance(cu_rows, tuple) else cu_rows
    return x, rows, cu_rows


@pytest.mark.parametrize(
    "wrong, message",
    [
        (dict(x=torch.zeros(3)), r"x must be \[N, C\].*got \[3\]"),
        (dict(x=torch.zeros(3, 2, dtype=torch.int32)), "x must be float32 or float64; got int32"),
        (dict(rows=torch.zeros(2)), "rows must be int64; got float32"),
        (dict(cu_rows=torch.zeros(3, dtype=torch.int32)), "cu_rows must be int64; got int32"),
        (dict(rows=torch.zeros(1, 2, dtype=torch.int64)), r"rows must be \[R\]"),
        (dict(cu_rows=torch.zeros(0, dtype=torch.int64)), r"cu_rows must be \[M \+ 1\]; got \[0\]"),
        (dict(rows=(0, 3)), r"rows must be in \[0, N\) with N=3; got 3 at 1"),
        (dict(rows=(-1, 0)), r"rows must be in \[0, N\) with N=3; got -1 at 0"),
        (dict(rows=(1, 1)), "rows must list a row at most once; got 1 again at 1"),
        (dict(rows=(0, 1, 2, 0), cu_rows=(0, 1, 4)), "rows must list each of the N=3 rows at most once; got 4 entries"),
        (dict(cu_rows=(0, 1, 3)), r"cu_rows must run from 0 to at most len\(rows\)=2; got 0 .. 3"),
        (dict(cu_rows=(0, 2, 1)), "cu_rows must not descend; got 2 then 1 at 1"),
        (dict(cu_rows=(0, 3, 2)), "cu_rows must not descend; got 3 then 2 at 1"),
        (dict(cu_rows=(1, 2)), "cu_rows must run from 0"),
    ],
)
def test_malformed_arguments_raise(wrong, message):
    for op, name in ((pool_max, "pool_max"), (pool_mean, "pool_mean")):
        with pytest.raises(ValueError, match=f"{name}: {message}"):
            op(*call(**wrong))


def test_malformed_arguments_of_unpool_raise():
    _, rows, cu_rows = call()
    with pytest.raises(ValueError, match=r"unpool: x must be \[M, C\] = \[2, \*\]; got \[3, 2\]"):
        unpool(torch.zeros(3, 2), rows, cu_rows, 3)
    with pytest.raises(ValueError, match="unpool: rows must list each of the N=1 rows at most once"):
        unpool(torch.zeros(2, 2), rows, cu_rows, 1)
    with pytest.raises(ValueError, match="unpool: rows must list a row at most once; got 1 again at 1"):
        unpool(torch.zeros(2, 2), torch.tensor([1, 1]), cu_rows, 3)
    with pytest.raises(ValueError, match=r"unpool: rows must be in \[0, N\) with N=3; got 7 at 0"):
        unpool(torch.zeros(2, 2), torch.tensor([7, 1]), cu_rows, 3)
    with pytest.raises(ValueError, match="unpool: n_rows must not be negative; got -1"):
        unpool(torch.zeros(0, 2), rows[:0], cu_rows[:1], -1)


def test_wrong_argmax_raises():
    with pytest.raises(ValueError, match=r"pool_max_backward: argmax must be in \[-1, N\) with N=2; got 2"):
        torch.ops.gsim3d.pool_max_backward(torch.zeros(1, 1), torch.tensor([[2]]), 2)
