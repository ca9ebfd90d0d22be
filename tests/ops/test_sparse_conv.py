"""Sparse convolution, in the eight sections that every op has."""

import itertools
import math
import os
import subprocess
import sys

import pytest
import torch

from gsim3d.errors import NumericalError
from gsim3d.ops import KernelMap, PyramidSpec, Voxels, build_pyramid, sparse_conv
from tests.asserts import (
    assert_close_relative_to_max,
    assert_same_bits,
    assert_same_bits_for_any_threads,
    gradients,
    relative_to_max,
)
from tests.cuda_graph import captured
from tests.oracle import sparse_conv as oracle

RULES = ["mean", "first"]


def random_cells(n: int, side: int, clouds: int = 2, seed: int = 0) -> torch.Tensor:
    """int64 [n, 4]; several rows share a cell where the box is small."""
    generator = torch.Generator().manual_seed(seed)
    cells = torch.randint(0, side, (n, 4), generator=generator)
    cells[:, 0] %= clouds
    return cells


def geometry(cells, kernel_size, device="cpu"):
    tables = [t.to(device) for t in oracle.kernel_tables(cells, kernel_size)]
    return Voxels(*tables[:3]), KernelMap(kernel_size, *tables[3:])


def parameters(n, c_in, c_out, kernel_size, dtype=torch.float64, seed=1):
    """x, weight, bias, cotangent."""
    generator = torch.Generator().manual_seed(seed)
    shapes = [(n, c_in), (c_out, *[kernel_size] * 3, c_in), (c_out,), (n, c_out)]
    return [torch.randn(shape, generator=generator, dtype=torch.float64).to(dtype) for shape in shapes]


def convolution(voxels, kernel_map, duplicates="mean"):
    return lambda x, w, b=None: sparse_conv(x, w, b, voxels, kernel_map, duplicates=duplicates)


def with_plan(voxels, kernel_map):
    plan = torch.ops.gsim3d.sparse_conv_plan(*raw_arguments(voxels, kernel_map), kernel_map.kernel_size)
    return voxels, replaced(kernel_map, plan=plan)


def raw_arguments(voxels, kernel_map):
    return voxels.row_voxel, voxels.rows, voxels.cu_rows, kernel_map.tap_in, kernel_map.tap_out, kernel_map.cu_taps


# 1 forward against the oracle, 2 backward against autograd of the oracle
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("duplicates", RULES)
@pytest.mark.parametrize("kernel_size, c_in, c_out", [(3, 5, 7), (3, 33, 70), (5, 17, 16), (1, 4, 8)])
def test_forward_and_gradients_equal_the_oracle(kernel_size, c_in, c_out, duplicates, dtype, device):
    cells = random_cells(60, 3)
    x, weight, bias, cotangent = parameters(60, c_in, c_out, kernel_size, dtype)
    ours = convolution(*geometry(cells, kernel_size, device), duplicates)
    actual = gradients(ours, [t.to(device) for t in (x, weight, bias)], cotangent)
    expected = gradients(
        lambda x, w, b: oracle.sparse_conv(x, w, b, cells, duplicates),
        [t.double() for t in (x, weight, bias)],
        cotangent,
    )
    name = "sparse_conv_float32" if dtype == torch.float32 else "sparse_conv_float64"
    for what, a, b in zip(("result", "grad x", "grad weight", "grad bias"), actual, expected):
        assert_close_relative_to_max(a, b, name, what)


@pytest.mark.parametrize("kernel_size", [3, 5])
@pytest.mark.parametrize("duplicates", RULES)
def test_equals_a_dense_convolution_where_no_voxel_is_shared(kernel_size, duplicates, device):
    cells = torch.unique(random_cells(150, 7, clouds=1), dim=0)
    cells = cells[torch.randperm(len(cells), generator=torch.Generator().manual_seed(0))]
    x, weight, bias, cotangent = parameters(len(cells), 6, 9, kernel_size)
    ours = convolution(*geometry(cells, kernel_size, device), duplicates)
    actual = gradients(ours, [t.to(device) for t in (x, weight, bias)], cotangent)
    expected = gradients(lambda x, w, b: oracle.dense_conv(x, w, b, cells), [x, weight, bias], cotangent)
    for a, b in zip(actual, expected):
        assert_close_relative_to_max(a, b, "sparse_conv_float64")


def test_long_taps_are_summed_in_several_blocks(device):
    """More pairs than a block of the weight gradient holds, at the centre and beside it."""
    n = 9000
    cells = torch.stack([torch.zeros(n, dtype=torch.int64), torch.arange(n), *torch.zeros(2, n, dtype=torch.int64)], 1)
    none = torch.zeros(0, dtype=torch.int64)
    rows = torch.arange(n)
    counts = torch.zeros(27, dtype=torch.int64)
    counts[4], counts[22] = n - 1, n - 1  # offsets (-1, 0, 0) and (1, 0, 0)
    cu_taps = torch.cat([none.new_zeros(1), torch.cumsum(counts, 0)])
    kernel_map = KernelMap(3, torch.cat([rows[:-1], rows[1:]]), torch.cat([rows[1:], rows[:-1]]), cu_taps)
    voxels = Voxels(rows, rows, torch.arange(n + 1))
    voxels = Voxels(*(t.to(device) for t in (voxels.row_voxel, voxels.rows, voxels.cu_rows)))
    kernel_map = KernelMap(3, *(t.to(device) for t in (kernel_map.tap_in, kernel_map.tap_out, kernel_map.cu_taps)))
    x, weight, bias, cotangent = parameters(n, 3, 4, 3)
    actual = gradients(convolution(voxels, kernel_map), [t.to(device) for t in (x, weight, bias)], cotangent)
    expected = gradients(lambda x, w, b: oracle.dense_conv(x, w, b, cells), [x, weight, bias], cotangent)
    for a, b in zip(actual, expected):
        assert_close_relative_to_max(a, b, 1e-13)


# 3 gradcheck
@pytest.mark.parametrize("duplicates", RULES)
def test_gradcheck(duplicates):
    x, weight, bias, _ = parameters(10, 2, 1, 3)
    inputs = [t.requires_grad_() for t in (x, weight, bias)]
    torch.autograd.gradcheck(convolution(*geometry(random_cells(10, 2, clouds=1), 3), duplicates), inputs)


# 4 CPU against CUDA
@pytest.mark.parametrize("duplicates", RULES)
def test_cuda_equals_cpu(duplicates, devices):
    cells = random_cells(300, 5)
    x, weight, bias, cotangent = parameters(300, 32, 48, 3, torch.float32)
    results = []
    for device in devices:
        ours = convolution(*geometry(cells, 3, device), duplicates)
        results.append(gradients(ours, [t.to(device) for t in (x, weight, bias)], cotangent))
    for cpu, cuda in zip(*results):
        assert_close_relative_to_max(cuda, cpu, "sparse_conv_float32")


LOW_PRECISION = [torch.float16, torch.bfloat16]
LOW_PRECISION_CASES = [
    (700, 9, 3, 64, 64),  # neighbours in most taps, a few shared voxels
    (1500, 60, 3, 64, 48),  # hardly any neighbours
    (900, 6, 3, 128, 128),  # most voxels are shared
    (700, 9, 3, 192, 264),  # several stages of channels, several blocks of outputs
    (300, 5, 5, 129, 40),  # rows that are no multiples of 16 bytes
    (300, 5, 3, 16, 33),
    (200, 4, 1, 8, 130),
    (9000, 24, 3, 40, 64),  # tiles that no other block shares
    (33000, 60, 3, 72, 72),  # large tiles
]


def gathered_convolution(voxels, kernel_map, duplicates):
    """Plain torch: the values of all taps of every row side by side, one matrix product; differentiable."""
    n_voxels, taps = len(voxels.cu_rows) - 1, kernel_map.kernel_size**3
    counts = voxels.cu_rows.diff()
    tap = torch.repeat_interleave(torch.arange(taps, device=counts.device), kernel_map.cu_taps.diff())
    table = torch.full((n_voxels, taps), n_voxels, device=counts.device)
    table[kernel_map.tap_out, tap] = kernel_map.tap_in
    table = table[voxels.row_voxel]

    def plain(x, weight, bias):
        if duplicates == "first":
            values = x[voxels.rows[voxels.cu_rows[:-1]]]
        else:
            sums = x.new_zeros(n_voxels, x.shape[1]).index_add(0, voxels.row_voxel, x)
            values = sums / counts[:, None].to(x)
        read = torch.cat([values, x.new_zeros(1, x.shape[1])])[table]
        read = torch.cat([read[:, : taps // 2], x[:, None], read[:, taps // 2 + 1 :]], 1)
        return torch.nn.functional.linear(read.flatten(1), weight.flatten(1), bias)

    return plain


@pytest.mark.unraced("the tool dies of torch's own 16-bit products")
@pytest.mark.parametrize("planned", [False, True])
@pytest.mark.parametrize("dtype", LOW_PRECISION)
@pytest.mark.parametrize("duplicates", RULES)
@pytest.mark.parametrize("n, side, kernel_size, c_in, c_out", LOW_PRECISION_CASES)
def test_low_precision_errs_no_more_than_torch(n, side, kernel_size, c_in, c_out, duplicates, dtype, planned, devices):
    """Against float64, at most twice the error of plain torch in the same dtype."""
    tables = geometry(random_cells(n, side), kernel_size, devices[1])
    tables = with_plan(*tables) if planned else tables
    inputs = [t.to(devices[1]) for t in parameters(n, c_in, c_out, kernel_size, dtype)]
    inputs[1] /= (c_in * kernel_size**3) ** 0.5
    *inputs, cotangent = inputs
    plain = gathered_convolution(*tables, duplicates)
    exact = gradients(plain, [t.double() for t in inputs], cotangent)
    actual = gradients(convolution(*tables, duplicates), inputs, cotangent)
    for name, a, b, e in zip(("result", "x", "weight", "bias"), actual, gradients(plain, inputs, cotangent), exact):
        assert a.dtype == dtype and relative_to_max(a, e) <= 2 * relative_to_max(b, e), name


@pytest.mark.parametrize("dtype", LOW_PRECISION)
@pytest.mark.parametrize("n, side, channels", [(1500, 30, 64), (200, 6, 136), (900, 9, 33), (5000, 24, 320)])
def test_weight_gradients_of_low_precision_are_float32(n, side, channels, dtype, devices):
    """No sum is rounded to 16 bits: where no voxel has two rows, only the order of float32 sums differs. Rounded
    gradients are these, rounded once."""
    cells = random_cells(n, side).unique(dim=0)
    tables = geometry(cells, 3, devices[1])
    *inputs, cotangent = (t.to(devices[1]) for t in parameters(len(cells), channels, channels, 3, dtype))
    arguments = cotangent, inputs[0], 3, *raw_arguments(*tables), False
    actual = torch.ops.gsim3d.sparse_conv_grad_weight(*arguments)
    for a, rounded in zip(actual, torch.ops.gsim3d.sparse_conv_grad_weight(*arguments, True), strict=True):
        assert_same_bits(rounded, a.to(dtype))
    exact = gradients(gathered_convolution(*tables, "mean"), [t.double() for t in inputs], cotangent)[2:]
    for a, e in zip(actual, exact, strict=True):
        assert a.dtype == torch.float32
        assert_close_relative_to_max(a, e, 1e-5)


@pytest.mark.parametrize("dtype", LOW_PRECISION)
def test_low_precision_gives_the_same_bits_in_every_run(dtype, devices):
    """All that the test against torch computes, without torch's own products: racecheck sees every kernel here."""
    for n, side, kernel_size, c_in, c_out in LOW_PRECISION_CASES:
        tables = geometry(random_cells(n, side), kernel_size, devices[1])
        *inputs, cotangent = (t.to(devices[1]) for t in parameters(n, c_in, c_out, kernel_size, dtype))
        for duplicates, chosen in itertools.product(RULES, (tables, with_plan(*tables))):
            first, second = (gradients(convolution(*chosen, duplicates), inputs, cotangent) for _ in range(2))
            for a, b in zip(first, second, strict=True):
                assert_same_bits(a, b)


@pytest.mark.parametrize("duplicates", RULES)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64, *LOW_PRECISION])
def test_cuda_gives_the_same_bits_in_every_run(dtype, duplicates, devices):
    n = 1500  # in every tap several blocks of rows; racecheck takes minutes for more
    *inputs, cotangent = (t.to(devices[1]) for t in parameters(n, 72, 136, 3, dtype))
    tables = geometry(random_cells(n, 10), 3, devices[1])
    planned = with_plan(*tables)
    for chosen in (tables, planned):
        ours = convolution(*chosen, duplicates)
        first = gradients(ours, inputs, cotangent)
        for _ in range(2):
            for a, b in zip(gradients(ours, inputs, cotangent), first, strict=True):
                assert_same_bits(a, b)
    assert_same_bits(with_plan(*tables)[1].plan, planned[1].plan)
    assert_same_bits(convolution(*planned)(*inputs), convolution(*tables)(*inputs))


def test_pairs_without_mirror_images_on_cuda(devices):
    """Without a plan nothing is taken for granted about the pairs."""
    voxels, whole = geometry(random_cells(2000, 9), 3, devices[1])
    keep = whole.tap_out % 3 == 0
    counts = torch.zeros_like(whole.cu_taps)
    tap = torch.repeat_interleave(torch.arange(27, device=keep.device), whole.cu_taps.diff())
    counts[1:] = torch.cumsum(torch.bincount(tap[keep], minlength=27), 0)
    kernel_map = KernelMap(3, whole.tap_in[keep], whole.tap_out[keep], counts)
    x, weight, bias, cotangent = (t.to(devices[1]) for t in parameters(2000, 32, 64, 3, torch.float16))
    plain = gathered_convolution(voxels, kernel_map, "mean")
    exact = gradients(plain, [t.double() for t in (x, weight, bias)], cotangent.double())
    actual = gradients(convolution(voxels, kernel_map), [x, weight, bias], cotangent)
    for a, b in zip(actual, exact):
        assert relative_to_max(a, b) < 2e-3


@pytest.mark.parametrize("dtype", [torch.float32, torch.float16])
def test_cuda_skips_indices_out_of_range(dtype, devices):
    """Pairs of voxels that do not exist take no part, whatever the lists hold."""
    n, channels = 300, 16
    cells = random_cells(n, 6, clouds=1)
    voxels, kernel_map = geometry(cells, 3, devices[1])
    x, weight, bias, cotangent = (t.to(devices[1]) for t in parameters(n, channels, channels, 3, dtype))
    keep = kernel_map.tap_in != kernel_map.tap_in[7]
    counts = torch.zeros_like(kernel_map.cu_taps)
    tap = torch.repeat_interleave(torch.arange(27, device=keep.device), kernel_map.cu_taps.diff())
    counts[1:] = torch.cumsum(torch.bincount(tap[keep], minlength=27), 0)
    fewer = KernelMap(3, kernel_map.tap_in[keep], kernel_map.tap_out[keep], counts)
    beyond = torch.where(keep, kernel_map.tap_in, len(voxels.cu_rows) + 5)
    wrong = KernelMap(3, beyond, kernel_map.tap_out, kernel_map.cu_taps)
    expected = convolution(voxels, fewer)(x, weight, bias)
    assert_same_bits(convolution(voxels, wrong)(x, weight, bias), expected)
    for far in (-(2**62), 2**62, 10**6):
        lists = [torch.full_like(t, far) for t in (voxels.row_voxel, voxels.rows, voxels.cu_rows)]
        pairs = [torch.full_like(t, far) for t in (kernel_map.tap_in, kernel_map.tap_out, kernel_map.cu_taps)]
        for broken in (
            (Voxels(*lists), kernel_map),
            (voxels, KernelMap(3, *pairs)),
            (Voxels(voxels.row_voxel, lists[1], voxels.cu_rows), kernel_map),
        ):
            gradients(convolution(*broken), [x, weight, bias], cotangent)
            gradients(convolution(*with_plan(*broken)), [x, weight, bias], cotangent)
    for far in (-(2**31), 2**31 - 1, 10**6):
        plan = torch.full_like(with_plan(voxels, kernel_map)[1].plan, far)
        gradients(convolution(voxels, replaced(kernel_map, plan=plan)), [x, weight, bias], cotangent)
    torch.cuda.synchronize()
    assert_same_bits(convolution(voxels, fewer)(x, weight, bias), expected)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float16])
def test_rows_that_no_voxel_lists_are_zero_on_cuda(dtype, devices):
    cells = random_cells(400, 6, clouds=1)
    voxels, kernel_map = geometry(cells, 3, devices[1])
    lost = torch.arange(0, 400, 7, device=devices[1])
    rows = torch.where(torch.isin(voxels.rows, lost), 400, voxels.rows)
    tables = Voxels(voxels.row_voxel, rows, voxels.cu_rows), kernel_map
    x, weight, bias, cotangent = (t.to(devices[1]) for t in parameters(400, 48, 64, 3, dtype))
    for chosen in (tables, with_plan(*tables)):
        old = [torch.full_like(t, math.nan) for t in (cotangent, x) for _ in range(4)]
        del old  # results may lie where these lay
        out, grad_x, *_ = gradients(convolution(*chosen), [x, weight, bias], cotangent)
        for result in (out, grad_x):
            assert not result[lost].any()
            assert result.any(1).sum() == 400 - len(lost)


@pytest.mark.parametrize("dtype", LOW_PRECISION)
def test_rows_that_start_anywhere_in_memory(dtype, devices):
    voxels, kernel_map = geometry(random_cells(100, 4), 3, devices[1])
    x, weight, bias, _ = (t.to(devices[1]) for t in parameters(100, 16, 24, 3, dtype))
    shifted = torch.cat([x.new_zeros(1), x.flatten()])[1:].view(100, 16)
    ours = convolution(voxels, kernel_map)
    assert_same_bits(ours(shifted, weight, bias), ours(x, weight, bias))


@pytest.mark.parametrize("dtype", LOW_PRECISION)
def test_autocast_is_followed_on_cuda(dtype, devices):
    voxels, kernel_map = geometry(random_cells(50, 4), 3, devices[1])
    ours = convolution(voxels, kernel_map)
    x, weight, bias, cotangent = (t.to(devices[1]) for t in parameters(50, 8, 16, 3, torch.float32))
    with torch.autocast("cuda", dtype=dtype):
        actual = gradients(ours, [x, weight, bias], cotangent)
    assert actual[0].dtype == dtype and all(t.dtype == torch.float32 for t in actual[1:])
    expected = gradients(ours, [t.to(dtype) for t in (x, weight, bias)], cotangent)
    for a, b in zip(actual, expected):
        assert_same_bits(a.to(dtype), b)


def test_capture_in_a_cuda_graph(devices):
    voxels, kernel_map = geometry(random_cells(500, 8), 3, devices[1])
    x, weight, bias, cotangent = (t.to(devices[1]) for t in parameters(500, 32, 32, 3, torch.float16))
    ours = convolution(voxels, kernel_map)
    leaves = [t.clone().requires_grad_() for t in (x, weight, bias)]

    def step():
        out = ours(*leaves)
        return [out, *torch.autograd.grad(out, leaves, cotangent)]

    graph, results = captured(step)
    with torch.no_grad():
        leaves[0].copy_(x.flip(0))
    graph.replay()
    for a, b in zip(results, gradients(ours, [x.flip(0), weight, bias], cotangent)):
        assert_same_bits(a, b)


# 5 opcheck
def test_opcheck():
    voxels, kernel_map = geometry(random_cells(12, 2), 3)
    x, weight, bias, cotangent = parameters(12, 2, 3, 3, torch.float32)
    tables = raw_arguments(voxels, kernel_map)
    inputs = [t.requires_grad_() for t in (x, weight, bias)]
    torch.library.opcheck(torch.ops.gsim3d.sparse_conv.default, (*inputs, *tables, False))
    checks = ("test_schema", "test_faketensor")
    x, weight = x.detach(), weight.detach()
    for op, arguments in (
        (torch.ops.gsim3d.sparse_conv_grad_input, (cotangent, weight, *tables, True)),
        (torch.ops.gsim3d.sparse_conv_grad_weight, (cotangent, x, 3, *tables, True)),
    ):
        torch.library.opcheck(op.default, arguments, test_utils=checks)


# 6 torch.compile
def test_compiled_equals_eager():
    voxels, kernel_map = geometry(random_cells(40, 3), 3)
    x, weight, bias, cotangent = parameters(40, 4, 6, 3, torch.float32)

    def block(x, weight, bias):
        return sparse_conv(x.sin(), weight, bias, voxels, kernel_map).relu()

    compiled = torch.compile(block, fullgraph=True, backend="aot_eager")
    eager = gradients(block, [x, weight, bias], cotangent)
    for a, b in zip(gradients(compiled, [x, weight, bias], cotangent), eager):
        assert_close_relative_to_max(a, b, "sparse_conv_float32")


# 7 edges
def test_empty_rows(device):
    voxels, kernel_map = geometry(torch.zeros(0, 4, dtype=torch.int64), 3, device)
    x, weight, bias, cotangent = (t.to(device) for t in parameters(0, 2, 3, 3))
    out, grad_x, grad_weight, grad_bias = gradients(convolution(voxels, kernel_map), [x, weight, bias], cotangent)
    assert out.shape == (0, 3) and grad_x.shape == (0, 2)
    assert grad_weight.shape == weight.shape and not grad_weight.any() and not grad_bias.any()


@pytest.mark.parametrize("duplicates", RULES)
def test_one_row_reads_itself_only(duplicates, device):
    cells = torch.tensor([[0, 4, 5, 6]])
    x, weight, bias, _ = (t.to(device) for t in parameters(1, 3, 2, 3))
    out = convolution(*geometry(cells, 3, device), duplicates)(x, weight, bias)
    assert_close_relative_to_max(out, x @ weight[:, 1, 1, 1].T + bias, 1e-14)


def test_missing_bias_and_missing_gradients(device):
    cells = random_cells(30, 3)
    x, weight, _, cotangent = (t.to(device) for t in parameters(30, 3, 4, 3))
    ours = convolution(*geometry(cells, 3, device))
    expected = gradients(ours, [x, weight, torch.zeros(4, device=device, dtype=x.dtype)], cotangent)[:3]
    for a, b in zip(gradients(ours, [x, weight], cotangent), expected):
        assert_same_bits(a, b)
    fixed = gradients(lambda x: ours(x, weight), [x], cotangent)
    assert_same_bits(fixed[1], expected[1])
    assert not ours(x, weight).requires_grad


@pytest.mark.parametrize("c_in, c_out", [(1, 1), (8, 16), (16, 31), (32, 33), (24, 100), (130, 12)])
def test_channel_counts_beside_the_vector_widths(c_in, c_out, device):
    cells = random_cells(25, 2)
    x, weight, bias, cotangent = parameters(25, c_in, c_out, 3, torch.float32)
    ours = convolution(*geometry(cells, 3, device))
    actual = gradients(ours, [t.to(device) for t in (x, weight, bias)], cotangent)
    inputs = [t.double() for t in (x, weight, bias)]
    expected = gradients(lambda x, w, b: oracle.sparse_conv(x, w, b, cells, "mean"), inputs, cotangent)
    for a, b in zip(actual, expected):
        assert_close_relative_to_max(a, b, "sparse_conv_float32")


def test_cloud_does_not_change_another(device):
    """Bit for bit, also when the other cloud has shared voxels and is packed before."""
    alone, other = random_cells(50, 6, clouds=1), random_cells(200, 3, clouds=1, seed=5)
    both = torch.cat([other, alone + torch.tensor([1, 0, 0, 0])])
    x, weight, bias, _ = parameters(250, 8, 8, 3, torch.float32)
    x, weight, bias = (t.to(device) for t in (x, weight, bias))
    packed = convolution(*geometry(both, 3, device))(x, weight, bias)[200:]
    assert_same_bits(packed, convolution(*geometry(alone, 3, device))(x[200:], weight, bias))


def test_order_of_rows_does_not_matter_for_the_mean(device):
    cells = random_cells(80, 3)
    order = torch.randperm(80, generator=torch.Generator().manual_seed(3))
    x, weight, bias, _ = (t.to(device) for t in parameters(80, 4, 5, 3))
    out = convolution(*geometry(cells, 3, device))(x, weight, bias)
    permuted = convolution(*geometry(cells[order], 3, device))(x[order.to(device)], weight, bias)
    assert_close_relative_to_max(permuted, out[order.to(device)], "sparse_conv_float64")


def test_nan_reaches_the_neighbours_only(device):
    cells = torch.tensor([[0, 0, 0, 0], [0, 1, 0, 0], [0, 5, 5, 5]])
    x, weight, bias, _ = (t.to(device) for t in parameters(3, 3, 2, 3, torch.float32))
    x[0] = float("nan")
    out = sparse_conv(x, weight, bias, *geometry(cells, 3, device), check=False)
    assert out[:2].isnan().all() and torch.isfinite(out[2]).all()


@pytest.mark.parametrize("which", ["x", "weight", "bias"])
def test_poison_is_refused_on_the_cpu(which):
    x, weight, bias, _ = parameters(3, 3, 2, 3, torch.float32)
    arguments = {"x": x, "weight": weight, "bias": bias}
    arguments[which][1] = float("nan")
    voxels, kernel_map = geometry(torch.tensor([[0, 0, 0, 0], [0, 1, 0, 0], [0, 5, 5, 5]]), 3)
    with pytest.raises(NumericalError, match=f"sparse_conv: {which} must be finite .* got nan in row 1"):
        sparse_conv(**arguments, voxels=voxels, kernel_map=kernel_map)


def test_non_contiguous_inputs(device):
    cells = random_cells(30, 3)
    x, weight, bias, _ = (t.to(device) for t in parameters(30, 4, 6, 3))
    ours = convolution(*geometry(cells, 3, device))
    strided = ours(x.T.contiguous().T, weight.permute(4, 1, 2, 3, 0).contiguous().permute(4, 1, 2, 3, 0), bias)
    assert_same_bits(strided, ours(x, weight, bias))


def test_autocast_computes_in_float32_on_the_cpu():
    voxels, kernel_map = geometry(random_cells(20, 3), 3)
    x, weight, bias, _ = parameters(20, 4, 6, 3, torch.float32)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        out = sparse_conv(x.bfloat16(), weight, bias, voxels, kernel_map)
    assert_same_bits(out, sparse_conv(x.bfloat16().float(), weight, bias, voxels, kernel_map))


def test_reads_the_geometry_of_build_pyramid():
    cells = random_cells(70, 4, clouds=1)
    spec = PyramidSpec(1.0, 0, (), (), (16,), ((3, 5),))
    zero, origin = torch.zeros(1, dtype=torch.int64), torch.zeros(1, 3, dtype=torch.float64)
    stage = build_pyramid(cells[:, 1:] + 0.5, torch.tensor([0, 70]), zero, zero, origin, spec).stages[0]
    for kernel_size in (3, 5):
        x, weight, bias, _ = parameters(70, 4, 6, kernel_size)
        out = sparse_conv(x, weight, bias, stage.voxels, stage.kernel_maps[kernel_size])
        assert_close_relative_to_max(out, oracle.sparse_conv(x, weight, bias, cells, "mean"), "sparse_conv_float64")


def test_pyramid_keeps_the_plan_of_large_kernels_for_gradients_only(devices):
    positions = (random_cells(3000, 12, clouds=1)[:, 1:] + 0.5).to(devices[1])
    spec = PyramidSpec(1.0, 0, (), (), (16,), ((3, 5),))
    zero, origin = torch.zeros(1, dtype=torch.int64), torch.zeros(1, 3, dtype=torch.float64)
    clouds = (t.to(devices[1]) for t in (torch.tensor([0, 3000]), zero, zero, origin))
    arguments = positions, *clouds, spec
    stage = build_pyramid(*arguments).stages[0]
    with torch.no_grad():
        plans = [kernel_map.plan for kernel_map in build_pyramid(*arguments).stages[0].kernel_maps.values()]
    assert [plan is None for plan in plans] == [False, True]
    planned = stage.kernel_maps[5]
    x, weight, bias, cotangent = (t.to(devices[1]) for t in parameters(3000, 24, 32, 5, torch.bfloat16))
    results = []
    for kernel_map in (planned, replaced(planned, plan=None)):
        ours = convolution(stage.voxels, kernel_map)
        results.append(gradients(ours, [x, weight, bias], cotangent))
    for index, (kept, anew) in enumerate(zip(*results, strict=True)):
        if index == 1:  # the gradient of x: taps are summed in mirrored order
            assert relative_to_max(kept, anew) < 2**-7
        else:
            assert_same_bits(kept, anew, f"result {index}")


def scene_for_bits():
    x, weight, bias, cotangent = parameters(2000, 20, 40, 3, torch.float32)
    ours = {rule: convolution(*geometry(random_cells(2000, 12), 3), rule) for rule in RULES}
    return [t for rule in RULES for t in gradients(ours[rule], [x, weight, bias], cotangent)]


def test_same_bits_for_any_number_of_threads():
    assert_same_bits_for_any_threads(scene_for_bits)


def test_same_bits_for_any_vector_width(tmp_path):
    """GSIM3D_SIMD=avx2 forbids the wide variant, which other processors do not have."""
    file = tmp_path / "narrow.pt"
    scene = "from tests.ops.test_sparse_conv import scene_for_bits"
    code = f"import sys, torch; {scene}; torch.save(scene_for_bits(), sys.argv[1])"
    subprocess.run([sys.executable, "-c", code, str(file)], env={**os.environ, "GSIM3D_SIMD": "avx2"}, check=True)
    for actual, expected in zip(scene_for_bits(), torch.load(file)):
        assert_same_bits(actual, expected)


# 8 error messages
def two_neighbours():
    """Rows 0 and 1 share a voxel; row 2 is beside them at +z."""
    return geometry(torch.tensor([[0, 0, 0, 0], [0, 0, 0, 0], [0, 0, 0, 1]]), 3)


def replaced(part, **fields):
    return type(part)(**{**vars(part), **{k: torch.tensor(v) if isinstance(v, list) else v for k, v in fields.items()}})


TAP_12, TAP_14 = [0] * 13 + [1] * 2, [2] * 13  # the pairs of two_neighbours: one in tap 12, one in tap 14


@pytest.mark.parametrize(
    "wrong, message",
    [
        (dict(x=torch.zeros(3)), r"x must be \[N, C_in\]"),
        (dict(x=torch.zeros(3, 2, dtype=torch.float16)), "weight must be float16; got float32"),
        (dict(x=torch.zeros(3, 3)), "weight must be .* with C_in=3 from x; got"),
        (dict(weight=torch.zeros(4, 2, 2, 2, 2)), r"kernel_map must have .* size \(2, 2, 2\); got \(3, 3, 3\)"),
        (dict(weight=torch.zeros(4, 3, 3, 2)), r"weight must be \[C_out, K, K, K, C_in\]; got \[4, 3, 3, 2\]"),
        (dict(weight=torch.zeros(4, 3, 3, 1, 2)), r"kernel_map must have .* size \(3, 3, 1\); got \(3, 3, 3\)"),
        (dict(bias=torch.zeros(3)), r"bias must be \[C_out\] = \[4\]; got \[3\]"),
        (dict(bias=torch.zeros(4, dtype=torch.float64)), "bias must be float32; got float64"),
        (dict(duplicates="last"), 'duplicates must be "mean" or "first"; got \'last\''),
        (dict(row_voxel=[0, 0]), r"row_voxel must be \[N\] = \[3\]; got \[2\]"),
        (dict(row_voxel=[0.0, 0.0, 1.0]), "row_voxel must be int64; got float32"),
        (dict(row_voxel=[0, 1, 1]), "row_voxel must agree with voxel_rows: row 1 is listed in voxel 0; got 1"),
        (dict(rows=[0, 0, 2]), "voxel_rows must ascend inside a voxel; got 0 then 0"),
        (dict(rows=[0, 3, 2]), r"voxel_rows must be in \[0, N\) with N=3; got 3 at 1"),
        (dict(cu_rows=[0, 2]), "cu_voxel_rows must run from 0 to N=3; got 0 .. 2"),
        (dict(cu_rows=[0, 0, 3]), "cu_voxel_rows must ascend, no voxel is empty; got 0 then 0 at 0"),
        (dict(cu_rows=[0, 9, 3]), "cu_voxel_rows must ascend, no voxel is empty; got 0 then 9 at 0"),
        (dict(cu_rows=[0, 2, 3, 2, 3]), "cu_voxel_rows must stay at N=3 behind the last row; got 2 at 3"),
        (dict(cu_taps=TAP_12 + [3] * 13), r"cu_taps must run from 0 to at most len\(tap_in\)=2; got 0 .. 3"),
        (dict(tap_in=[1]), r"tap_out must be \[L\] like tap_in"),
        (dict(tap_in=[0, 2]), r"tap_in must be in \[0, V\) with V=2; got 2 at 1"),
        (dict(tap_out=[-1, 1]), r"tap_out must be in \[0, V\) with V=2; got -1 at 0"),
        (dict(cu_taps=[0, 2]), r"cu_taps must be \[K\^3 \+ 1\] = \[28\]; got \[2\]"),
        (dict(cu_taps=TAP_12 + [3] * 12 + [2]), "cu_taps must not descend; got 3 then 2"),
        (dict(cu_taps=[0] * 14 + [2] * 14), "the centre tap 13 must have no pairs; got 2"),
        (dict(cu_taps=[0] * 15 + [2] * 13), "tap_out must ascend inside a tap; got 1 then 0"),
        (
            dict(cu_taps=[0] * 15 + [2] * 13, tap_in=[1, 1], tap_out=[0, 1]),
            "tap_in must ascend inside a tap; got 1 then 1",
        ),
    ],
)
def test_malformed_arguments_raise(wrong, message):
    voxels, kernel_map = two_neighbours()
    arguments = dict(x=torch.zeros(3, 2), weight=torch.zeros(4, 3, 3, 3, 2), bias=None, duplicates="mean")
    voxels = replaced(voxels, **{k: v for k, v in wrong.items() if k in vars(voxels)})
    kernel_map = replaced(kernel_map, **{k: v for k, v in wrong.items() if k in vars(kernel_map)})
    arguments.update({k: v for k, v in wrong.items() if k in arguments})
    with pytest.raises(ValueError, match=f"sparse_conv: {message}"):
        sparse_conv(**arguments, voxels=voxels, kernel_map=kernel_map)


def test_integers_are_refused():
    voxels, kernel_map = two_neighbours()
    with pytest.raises(ValueError, match="sparse_conv: x must be float32 or float64; got int32"):
        sparse_conv(torch.zeros(3, 2).int(), torch.zeros(4, 3, 3, 3, 2).int(), None, voxels, kernel_map)
