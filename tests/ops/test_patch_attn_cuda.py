"""patch_attention on CUDA alone: 16-bit numbers, unchecked tables, graphs, autocast."""

import dataclasses

import pytest
import torch

from gsim3d.ops import PatchTable
from tests.asserts import assert_close_relative_to_max, assert_same_bits, gradients, relative_to_max
from tests.ops.test_patch_attn import DTYPES, RAGGED, cotangent_of, lists, offsets, random_case, self_case

LOW_PRECISION = {torch.bfloat16: "bfloat16", torch.float16: "float16"}
# (queries, keys): ragged, and patches longer than what a block keeps in shared memory.
FEW_HEADS, MANY_HEADS = 2, 96  # with many, blocks that own all of a head and a patch fill the GPU
SHAPES = {"ragged": (RAGGED, 150), "patch": (((1024, 1024),) * 2, 1500), "long": (((1100, 70), (33, 1100)), 1100)}


def low_precision_case(devices, shape, **options):
    sizes, n_keys = SHAPES[shape]
    return random_case(sizes, n_keys=n_keys, **options).to(devices[1])


def plain_attention(case, q, k, v):
    """Plain torch in the dtype of its arguments, patch by patch; differentiable."""
    out = q.new_zeros(q.shape)
    patches = (rows.split(cu.diff().tolist()) for rows, cu in zip(lists(case.table)[:2], lists(case.table)[2:]))
    for queries, keys in zip(*patches, strict=True):
        logits = torch.einsum("ihd,jhd->hij", q[queries], k[keys]) * case.scale
        out = out.index_put((queries,), torch.einsum("hij,jhd->ihd", logits.softmax(-1), v[keys]))
    return out


@pytest.mark.unraced("the tool dies of torch's own 16-bit products")
@pytest.mark.parametrize("dtype", LOW_PRECISION, ids=LOW_PRECISION.values())
@pytest.mark.parametrize("scale", [None, -0.6, 4.0])
@pytest.mark.parametrize(
    "shape, dim, heads",
    [("ragged", dim, FEW_HEADS) for dim in (8, 16, 32, 48, 64)]
    + [("patch", dim, FEW_HEADS) for dim in (16, 64)]
    + [("long", dim, FEW_HEADS) for dim in (16, 32, 64, 128)]
    + [(shape, 16, MANY_HEADS) for shape in SHAPES],
)
def test_low_precision_errs_no_more_than_torch(devices, shape, dim, heads, scale, dtype):
    """Against float64, at most twice the error of plain torch in the same dtype."""
    case = low_precision_case(devices, shape, heads=heads, dim=dim, scale=scale, dtype=dtype)
    cotangent = cotangent_of(case).to(dtype)
    exact = gradients(lambda *x: plain_attention(case, *x), [x.double() for x in case.inputs], cotangent)
    plain = gradients(lambda *x: plain_attention(case, *x), case.inputs, cotangent)
    for name, a, b, e in zip("oqkv", gradients(case.attend, case.inputs, cotangent), plain, exact, strict=True):
        assert a.dtype == dtype and relative_to_max(a, e) <= 2 * relative_to_max(b, e), name


@pytest.mark.parametrize("dtype", [*DTYPES, *LOW_PRECISION], ids=[*DTYPES.values(), *LOW_PRECISION.values()])
@pytest.mark.parametrize("heads", [FEW_HEADS, MANY_HEADS])
@pytest.mark.parametrize("shape", SHAPES)
def test_cuda_gives_the_same_bits_in_every_run(devices, shape, heads, dtype):
    case = low_precision_case(devices, shape, heads=heads, dtype=dtype)
    first = gradients(case.attend, case.inputs, cotangent_of(case))
    for _ in range(3):
        for a, e in zip(gradients(case.attend, case.inputs, cotangent_of(case)), first, strict=True):
            assert_same_bits(a, e)


@pytest.mark.parametrize("dtype", [torch.float32, *LOW_PRECISION], ids=["float32", *LOW_PRECISION.values()])
@pytest.mark.parametrize("dim, heads", [(16, FEW_HEADS), (16, MANY_HEADS), (32, FEW_HEADS), (48, FEW_HEADS)])
def test_cuda_skips_rows_out_of_range(devices, dim, heads, dtype):
    case = random_case(((70, 90), (20, 33)), heads=heads, dim=dim, n_keys=100, spare=0, dtype=dtype)
    q_rows, kv_rows, cu_q, cu_k = lists(case.table)
    bad_q, bad_k = torch.arange(90) % 7 == 3, torch.arange(123) % 5 == 2

    def kept(bad, cu):
        return offsets(part.sum() for part in (~bad).split(cu.diff().tolist()))

    table = PatchTable(q_rows[~bad_q], kv_rows[~bad_k], kept(bad_q, cu_q), kept(bad_k, cu_k))
    short = dataclasses.replace(case, table=table).to(devices[1])
    wrong_q = torch.where(bad_q, torch.tensor([-1, 90, 2**40])[torch.arange(90) % 3], q_rows)
    wrong_k = torch.where(bad_k, torch.tensor([-(2**40), 100, -1])[torch.arange(123) % 3], kv_rows)
    wrong = dataclasses.replace(case, table=PatchTable(wrong_q, wrong_k, cu_q, cu_k)).to(devices[1])
    expected = gradients(short.attend, short.inputs, cotangent_of(case))
    tolerance = {torch.float32: 1e-6, torch.bfloat16: 2e-2, torch.float16: 2e-3}[dtype]
    for a, e in zip(gradients(wrong.attend, wrong.inputs, cotangent_of(case)), expected, strict=True):
        assert_close_relative_to_max(a, e, tolerance)


def test_cuda_stays_inside_its_memory_for_any_offsets(devices):
    case = random_case(dtype=torch.bfloat16).to(devices[1])
    for cu in ([-5, 10**15, 3, 3, -(10**15), 70, 80, 99], [9] * 8, [200, 0, 0, 0, 0, 0, 0, 0]):
        wrong = torch.tensor(cu, device=devices[1])
        for q_offsets, k_offsets in ((wrong, case.table.cu_k), (case.table.cu_q, wrong), (wrong, wrong)):
            table = dataclasses.replace(case.table, cu_q=q_offsets, cu_k=k_offsets)
            out = dataclasses.replace(case, table=table).attend()
            assert torch.isfinite(out).all()


@pytest.mark.parametrize("heads", [FEW_HEADS, MANY_HEADS])
def test_slots_that_no_patch_takes(devices, heads):
    """As with tables of fixed size: lists are longer than the patches, and all rows are listed."""
    case = random_case(((70, 90), (20, 33)), heads=heads, n_keys=200, spare=10, dtype=torch.bfloat16)
    unlisted = torch.tensor(sorted({*range(100)} - {*case.table.q_rows.tolist()}))
    q_rows, kv_rows = torch.cat([case.table.q_rows, unlisted]), torch.cat([case.table.kv_rows, torch.arange(200)])
    longer = dataclasses.replace(case, table=dataclasses.replace(case.table, q_rows=q_rows, kv_rows=kv_rows))
    case, longer = case.to(devices[1]), longer.to(devices[1])
    expected = gradients(case.attend, case.inputs, cotangent_of(case))
    for a, e in zip(gradients(longer.attend, longer.inputs, cotangent_of(case)), expected, strict=True):
        assert_same_bits(a, e)
    assert torch.count_nonzero(expected[0][unlisted]) == 0


@pytest.mark.parametrize("dtype", LOW_PRECISION, ids=LOW_PRECISION.values())
@pytest.mark.parametrize("dim, heads", [(16, FEW_HEADS), (16, MANY_HEADS), (32, FEW_HEADS), (64, FEW_HEADS)])
@pytest.mark.parametrize("factor", [30.0, 1e3])
def test_low_precision_with_huge_logits(devices, factor, dim, heads, dtype):
    """Sharp weights, up to one-hot: right where they are decided, finite everywhere."""
    case = random_case(RAGGED + ((40, 600),), n_keys=600, heads=heads, dim=dim, dtype=dtype)
    case = dataclasses.replace(case, q=case.q * factor).to(devices[1])
    cotangent = cotangent_of(case).to(dtype)
    results = gradients(case.attend, case.inputs, cotangent)
    assert all(torch.isfinite(x).all() for x in results)
    exact = gradients(lambda *x: plain_attention(case, *x), [x.double() for x in case.inputs], cotangent)
    for name, a, e in zip("oqkv", results, exact, strict=True):
        # Differences of logits near 1e4 carry the rounding of float32 into the weights of near ties.
        limit = {torch.bfloat16: 2e-2, torch.float16: 1e-2}[dtype] * (1 if name in "ov" else 10)
        assert_close_relative_to_max(a, e, limit, name)


def test_bfloat16_at_the_ends_of_its_range(devices):
    case = random_case(((70, 130),), dtype=torch.bfloat16)
    for q_factor, scale in ((1e30, 1.0), (1e30, 1e-30), (1.0, 1e30), (1e-30, 1e30)):
        extreme = dataclasses.replace(case, q=case.q * q_factor, scale=scale).to(devices[1])
        exact = plain_attention(extreme, *(x.double() for x in extreme.inputs))
        assert_close_relative_to_max(extreme.attend(), exact, 1e-2)


@pytest.mark.parametrize("poison", [float("nan"), float("inf"), -float("inf")])
@pytest.mark.parametrize("which", range(3), ids=("q", "k", "v"))
@pytest.mark.parametrize("heads", [FEW_HEADS, MANY_HEADS])
def test_low_precision_poison_reaches_its_patch_alone(devices, heads, which, poison):
    case = self_case((70, 33, 66), heads=heads, dtype=torch.bfloat16).to(devices[1])
    clean = gradients(case.attend, case.inputs, cotangent_of(case))
    inputs = [x.clone() for x in case.inputs]
    inputs[which][case.table.q_rows[72], 1, 3] = poison
    dirty = gradients(case.attend, inputs, cotangent_of(case))
    other = torch.cat([case.table.q_rows[:70], case.table.q_rows[103:]])
    for a, e in zip(dirty, clean, strict=True):
        assert_same_bits(a[other], e[other])
        assert_same_bits(a[:, 0], e[:, 0])
    reached = case.table.q_rows[70:103] if which > 0 else case.table.q_rows[72:73]
    if which == 2 or poison != poison:
        assert not torch.isfinite(dirty[0][reached, 1]).all(1).any()


def shifted(x):
    """Not aligned to 16 bytes."""
    return torch.cat([x.flatten()[:1], x.flatten()])[1:].view(x.shape)


@pytest.mark.parametrize("dtype", LOW_PRECISION, ids=LOW_PRECISION.values())
def test_low_precision_views_of_one_tensor(devices, dtype):
    for dim in (16, 20):
        case = self_case((70, 30, 9), dim=dim, dtype=dtype).to(devices[1])
        expected = gradients(case.attend, case.inputs, cotangent_of(case))
        for place in (lambda x: x, shifted):
            qkv = torch.stack(case.inputs, 1)
            results = gradients(lambda x: case.attend(*place(x).unbind(1)), [qkv], cotangent_of(case))
            assert_close_relative_to_max(results[0], expected[0], 1e-2)
            assert_close_relative_to_max(results[1], torch.stack(expected[1:], 1), 1e-2)


@pytest.mark.parametrize("dtype", LOW_PRECISION, ids=LOW_PRECISION.values())
def test_autocast_on_cuda_follows_its_dtype(devices, dtype):
    case = random_case(dtype=torch.float32).to(devices[1])
    with torch.autocast("cuda", dtype):
        actual = gradients(case.attend, case.inputs, cotangent_of(case))
        exact = case.attend(*(x.double() for x in case.inputs))
    low = [x.to(dtype) for x in case.inputs]
    expected = gradients(case.attend, low, cotangent_of(case).to(dtype))
    for a, e in zip(actual, expected, strict=True):
        assert_same_bits(a.to(dtype), e)
    assert actual[0].dtype == dtype and actual[1].dtype == torch.float32 and exact.dtype == torch.float64


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_cuda_graph(devices, dtype):
    case = random_case(dtype=dtype).to(devices[1])
    leaves = [x.clone().requires_grad_() for x in case.inputs]
    cotangent = cotangent_of(case).to(dtype).to(devices[1])

    def run():
        out = case.attend(*leaves)
        return (out.detach(), *torch.autograd.grad(out, leaves, cotangent))

    side = torch.cuda.Stream()
    with torch.cuda.stream(side):
        expected = run()
        graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(graph, stream=side):
            results = run()
    for x in results:
        x.fill_(float("nan"))
    graph.replay()
    torch.cuda.synchronize()
    for a, e in zip(results, expected, strict=True):
        assert_same_bits(a, e)


def test_tables_must_be_on_the_device_of_the_queries(devices):
    case = random_case(dtype=torch.float32)
    with pytest.raises(TypeError, match="q_rows is on cpu, but q on cuda:0"):
        dataclasses.replace(case.to(devices[1]), table=case.table).attend()
