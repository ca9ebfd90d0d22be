"""patch_attention against a dense float64 softmax."""

import dataclasses
import functools
import hashlib
import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from gsim3d.errors import NumericalError
from gsim3d.ops import PatchTable, patch_attention
from tests.asserts import (
    assert_close_relative_to_max,
    assert_same_bits,
    assert_same_bits_for_any_threads,
    gradients,
)
from tests.golden_files import golden
from tests.oracle import patch_attn as oracle

DTYPES = {torch.float32: "float32", torch.float64: "float64"}
# (queries, keys) of patches: around one and two tiles of 64, one row, no keys, no queries.
RAGGED = ((3, 1), (70, 130), (0, 4), (5, 0), (64, 64), (1, 65), (2, 63))
DIMS = (4, 8, 12, 16, 20, 32, 48, 64, 96, 128, 200, 256)


@dataclasses.dataclass(frozen=True)
class Case:
    """Inputs of one call; qkv tensors are [N, H, D]."""

    q: torch.Tensor
    k: torch.Tensor
    v: torch.Tensor
    table: PatchTable
    scale: float

    @property
    def inputs(self):
        return self.q, self.k, self.v

    def to(self, *args):
        table = PatchTable(*(t.to(args[0]) if isinstance(args[0], torch.device) else t for t in lists(self.table)))
        return Case(*(x.to(*args) for x in self.inputs), table, self.scale)

    def attend(self, q=None, k=None, v=None):
        q, k, v = self.inputs if q is None else (q, k, v)
        return patch_attention(q, k, v, self.table, scale=self.scale)

    def attend_oracle(self, q=None, k=None, v=None):
        q, k, v = self.inputs if q is None else (q, k, v)
        return oracle.patch_attention(q, k, v, *lists(self.table), self.scale)


def lists(table):
    return table.q_rows, table.kv_rows, table.cu_q, table.cu_k


def offsets(counts):
    return torch.tensor([0, *counts]).cumsum(0)


def random_case(sizes=RAGGED, *, heads=2, dim=16, n_keys=150, spare=3, scale=None, dtype=torch.float64, seed=0):
    """Key rows drawn with repetition, so that some serve several patches, some the same patch twice, some none."""
    g = torch.Generator().manual_seed(seed)
    cu_q, cu_k = offsets(n for n, _ in sizes), offsets(n for _, n in sizes)
    n_queries = int(cu_q[-1]) + spare
    q_rows = torch.randperm(n_queries, generator=g)[: int(cu_q[-1])]
    kv_rows = torch.randint(0, max(1, n_keys), (int(cu_k[-1]),), generator=g)
    q = torch.randn(n_queries, heads, dim, generator=g, dtype=dtype)
    k, v = (torch.randn(n_keys, heads, dim, generator=g, dtype=dtype) for _ in range(2))
    return Case(q, k, v, PatchTable(q_rows, kv_rows, cu_q, cu_k), dim**-0.5 if scale is None else scale)


def cotangent_of(case, seed=1):
    return torch.randn(case.q.shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def self_case(sizes, **options):
    """Queries and keys are the same rows, each in one patch."""
    case = random_case([(n, n) for n in sizes], n_keys=sum(sizes), spare=0, **options)
    return dataclasses.replace(case, table=dataclasses.replace(case.table, kv_rows=case.table.q_rows))


# ---- 1 forward against the oracle ----------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", DTYPES, ids=DTYPES.values())
@pytest.mark.parametrize("dim", DIMS)
def test_forward(device, dim, dtype):
    case = random_case(dim=dim, dtype=dtype)
    actual = case.to(device).attend()
    assert actual.dtype == dtype
    assert_close_relative_to_max(actual, case.attend_oracle(), f"patch_attn_{DTYPES[dtype]}")


@pytest.mark.parametrize("dtype", DTYPES, ids=DTYPES.values())
@pytest.mark.parametrize("scale", [0.0, -0.3, 1e-30, 3.0])
def test_any_scale(device, scale, dtype):
    case = random_case(scale=scale, dtype=dtype)
    expected = gradients(case.attend_oracle, case.inputs, cotangent_of(case))
    moved = case.to(device)
    for a, e in zip(gradients(moved.attend, moved.inputs, cotangent_of(case)), expected, strict=True):
        assert_close_relative_to_max(a, e, f"patch_attn_scale_{DTYPES[dtype]}")


def test_default_scale():
    case = random_case(dim=16)
    assert_same_bits(patch_attention(*case.inputs, case.table), dataclasses.replace(case, scale=0.25).attend())


@pytest.mark.parametrize("dtype", DTYPES, ids=DTYPES.values())
def test_weights_are_accurate_over_the_whole_range(device, dtype):
    # Two keys, values 0 and 1: the result is w / (1 + w) with w = exp(-x); relative, not absolute, error of w.
    limit = {torch.float32: 80.0, torch.float64: 700.0}[dtype]
    x = torch.linspace(0, limit, 4001, dtype=dtype)
    q, k, v = x.new_zeros(4001, 1, 4), x.new_zeros(2, 1, 4), x.new_zeros(2, 1, 4)
    q[:, 0, 0], k[1, 0, 0], v[1] = x, -1, 1
    rows, cu = torch.arange(4001), torch.tensor([0, 4001])
    case = Case(q, k, v, PatchTable(rows, torch.tensor([0, 1]), cu, torch.tensor([0, 2])), 1.0).to(device)
    exact = x.double()
    relative = case.attend()[:, 0, 0].cpu().double() / (torch.exp(-exact) / (1 + torch.exp(-exact)))
    assert_close_relative_to_max(relative, torch.ones_like(relative), f"patch_attn_weight_{DTYPES[dtype]}")


@pytest.mark.golden
def test_published_block(device):
    g = golden("e_block_nodup")
    w = g / "order0/w"
    order, pad = g["point_in/serialized_order"][0], g["pad"]
    cu_k = g["cu_seqlens"].long()
    # Queries of a patch are the sorted rows whose place in the padded list lies inside it.
    patch = torch.searchsorted(cu_k, g["unpad"], right=True) - 1
    cu_q = offsets(torch.bincount(patch, minlength=cu_k.shape[0] - 1).tolist())
    table = PatchTable(order[torch.argsort(patch, stable=True)], order[pad], cu_q, cu_k)
    qkv = torch.nn.functional.linear(g["order0/norm1_out"], w["attn.qkv.weight"], w["attn.qkv.bias"])
    q, k, v = qkv.view(-1, 3, 2, 8).to(device).unbind(1)
    out = patch_attention(q, k, v, PatchTable(*(t.to(device) for t in lists(table)))).flatten(1).cpu()
    out = torch.nn.functional.linear(out, w["attn.proj.weight"], w["attn.proj.bias"])
    assert_close_relative_to_max(out, g["order0/attn_out"], "patch_attn_golden")


# ---- 2 backward against autograd of the oracle ---------------------------------------------------------------------


@pytest.mark.parametrize("dtype", DTYPES, ids=DTYPES.values())
@pytest.mark.parametrize("dim", DIMS)
def test_backward(device, dim, dtype):
    case = random_case(dim=dim, dtype=dtype)
    expected = gradients(case.attend_oracle, case.inputs, cotangent_of(case))
    moved = case.to(device)
    for name, a, e in zip("oqkv", gradients(moved.attend, moved.inputs, cotangent_of(case)), expected, strict=True):
        assert_close_relative_to_max(a, e, f"patch_attn_grad_{DTYPES[dtype]}", name)


def test_long_patches(device):
    # Several tasks a patch and many key tiles; float32 sums of 300 terms.
    case = random_case(((600, 300),), dim=8, heads=1, n_keys=300, dtype=torch.float32)
    expected = gradients(case.attend_oracle, case.inputs, cotangent_of(case))
    moved = case.to(device)
    for a, e in zip(gradients(moved.attend, moved.inputs, cotangent_of(case)), expected, strict=True):
        assert_close_relative_to_max(a, e, "patch_attn_grad_float32")


def test_views_of_one_tensor(device):
    case = self_case((70, 30, 9), dim=20, dtype=torch.float32).to(device)
    qkv = torch.stack(case.inputs, 1)
    expected = gradients(case.attend, case.inputs, cotangent_of(case))
    out, grad = gradients(lambda x: case.attend(*x.unbind(1)), [qkv], cotangent_of(case))
    assert_same_bits(out, expected[0])
    assert_same_bits(grad, torch.stack(expected[1:], 1))


def backward_arguments(case, dtype):
    """Arguments of the backward ops, all rows in one tensor, in ``dtype``."""
    q, k, v = torch.stack([x.to(dtype) for x in case.inputs], 1).unbind(1)
    table = (*lists(case.table), case.scale)
    out, stats = torch.ops.gsim3d.patch_attention(q, k, v, *table)
    return cotangent_of(case).to(out), q, k, v, out, stats, *table


@pytest.mark.parametrize("dtype", [*DTYPES, torch.bfloat16], ids=[*DTYPES.values(), "bfloat16"])
@pytest.mark.parametrize("dim", [16, 20])
def test_packed_gradients(device, dim, dtype):
    if dtype == torch.bfloat16 and device.type == "cpu":
        pytest.skip("16-bit attention needs a GPU")
    case = random_case(dim=dim, n_keys=sum(n for n, _ in RAGGED) + 3)  # as many keys as queries
    arguments = backward_arguments(case.to(device), dtype)
    expected = torch.stack(torch.ops.gsim3d.patch_attention_backward(*arguments), 1)
    assert expected.any(2).any(2).any(0).all()
    assert_same_bits(torch.ops.gsim3d.patch_attention_backward_packed(*arguments), expected)


# ---- 3 gradcheck ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("scale", [0.5, -0.5])
def test_gradcheck(scale):
    case = random_case(((2, 3), (1, 2), (2, 0)), dim=4, heads=2, n_keys=4, scale=scale)
    assert torch.autograd.gradcheck(case.attend, [x.requires_grad_() for x in case.inputs])


# ---- 4 CPU against CUDA --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", DTYPES, ids=DTYPES.values())
@pytest.mark.parametrize("dim", [16, 20, 64, 256])
def test_devices_agree(devices, dim, dtype):
    case = random_case(dim=dim, dtype=dtype)
    cpu, cuda = (gradients(case.to(d).attend, case.to(d).inputs, cotangent_of(case)) for d in devices)
    for a, e in zip(cuda, cpu, strict=True):
        assert_close_relative_to_max(a, e, f"patch_attn_grad_{DTYPES[dtype]}")


# ---- 5 opcheck -----------------------------------------------------------------------------------------------------


def test_opcheck(device):
    case = random_case(((2, 3), (4, 5)), dim=4, dtype=torch.float32).to(device)
    args = (*case.inputs, *lists(case.table), case.scale)
    leaves = (*(x.clone().requires_grad_() for x in case.inputs), *args[3:])
    torch.library.opcheck(torch.ops.gsim3d.patch_attention.default, leaves)
    out, stats = torch.ops.gsim3d.patch_attention(*args)
    torch.library.opcheck(
        torch.ops.gsim3d.patch_attention_backward.default,
        (torch.ones_like(out), *case.inputs, out, stats, *args[3:]),
        test_utils=("test_schema", "test_faketensor"),
    )
    packed = torch.ops.gsim3d.patch_attention_backward_packed
    square = backward_arguments(self_case((2, 3), dim=4).to(device), torch.float32)
    torch.library.opcheck(packed.default, square, test_utils=("test_schema", "test_faketensor"))
    with pytest.raises(ValueError, match="patch_attention_backward_packed: k must be"):
        packed(torch.ones_like(out), *case.inputs, out, stats, *args[3:])


def test_autocast_on_the_cpu_computes_in_float32():
    case = random_case(((5, 9),), dtype=torch.float32)
    low = [x.bfloat16() for x in case.inputs]
    with torch.autocast("cpu", torch.bfloat16):
        actual = case.attend(*low)
    assert_same_bits(actual, case.attend(*(x.float() for x in low)))


# ---- 6 torch.compile -----------------------------------------------------------------------------------------------


def test_compile(device):
    case = random_case(dtype=torch.float32).to(device)

    def f(q, k, v):
        return 2 * patch_attention(q * 1.5, k, v, case.table)

    expected = gradients(f, case.inputs, cotangent_of(case))
    actual = gradients(torch.compile(f, fullgraph=True), case.inputs, cotangent_of(case))
    for a, e in zip(actual, expected, strict=True):
        assert_same_bits(a, e)


# ---- 7 edges -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("sizes", [(), ((0, 0),), ((0, 3),), ((3, 0), (0, 0))], ids=str)
@pytest.mark.parametrize("heads", [0, 2])
def test_empty_patches(device, sizes, heads):
    case = random_case(sizes, heads=heads, dtype=torch.float32).to(device)
    for result in gradients(case.attend, case.inputs, cotangent_of(case)):
        assert torch.count_nonzero(result) == 0


def test_empty_rows(device):
    case = random_case((), n_keys=0, spare=0, dtype=torch.float32).to(device)
    assert [x.shape for x in gradients(case.attend, case.inputs, cotangent_of(case))] == [(0, 2, 16)] * 4


def test_one_key_is_copied(device):
    case = random_case(((4, 1),), dtype=torch.float32).to(device)
    out = case.attend()
    assert_same_bits(out[case.table.q_rows], case.v[case.table.kv_rows].expand(4, -1, -1))


def test_rows_outside_the_table(device):
    case = random_case(dtype=torch.float32)
    moved = case.to(device)
    out, grad_q, grad_k, grad_v = gradients(moved.attend, moved.inputs, cotangent_of(case))
    with_keys = oracle.multiplicity(*lists(case.table), case.q.shape[0], case.k.shape[0])
    queries, keys = with_keys.sum(1), with_keys.sum(0)
    for x, counts in ((out, queries), (grad_q, queries), (grad_k, keys), (grad_v, keys)):
        assert torch.count_nonzero(x[counts == 0]) == 0 and (counts == 0).any()
        assert torch.count_nonzero(x[counts > 0]) > 0


@pytest.mark.parametrize("offset", [0, 2**20])
@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e3, 1e25])
def test_huge_logits(device, scale, offset):
    # Whole numbers keep every dot product exact in float32, so logits up to 1e31 must give the weights of differences.
    case = random_case(dim=16, scale=scale, dtype=torch.float32)
    whole = [(2 * x).round() for x in case.inputs]
    whole[0][..., 0], whole[1][..., 0] = 1024, offset / 1024
    case = dataclasses.replace(case, q=whole[0], k=whole[1])
    expected = gradients(case.attend_oracle, case.inputs, cotangent_of(case))
    moved = case.to(device)
    for a, e in zip(gradients(moved.attend, moved.inputs, cotangent_of(case)), expected, strict=True):
        # Channel 0 only carries the offset; its gradients are 1024 times a sum that cancels.
        assert_close_relative_to_max(a[..., 1:], e[..., 1:], "patch_attn_huge_logits")


@pytest.mark.parametrize("poison", [float("nan"), float("inf"), -float("inf")])
@pytest.mark.parametrize("which", range(3), ids=("q", "k", "v"))
def test_poison_stays_in_its_patches(device, which, poison):
    case = self_case((70, 5, 66), dtype=torch.float32).to(device)
    clean = gradients(case.attend, case.inputs, cotangent_of(case))
    inputs = [x.clone() for x in case.inputs]
    inputs[which][case.table.q_rows[72], 1, 3] = poison
    unchecked = functools.partial(patch_attention, table=case.table, scale=case.scale, check=False)
    dirty = gradients(unchecked, inputs, cotangent_of(case))
    other = torch.cat([case.table.q_rows[:70], case.table.q_rows[75:]])
    for a, e in zip(dirty, clean, strict=True):
        assert_same_bits(a[other], e[other])
        assert_same_bits(a[:, 0], e[:, 0])
    assert not torch.isfinite(dirty[0]).all()


@pytest.mark.parametrize("poison", [float("nan"), float("inf"), 1e30])
@pytest.mark.parametrize("which", ["q", "k", "v"])
def test_poison_is_refused_on_the_cpu(which, poison):
    case = random_case(dtype=torch.float32)
    inputs = {"q": case.q, "k": case.k, "v": case.v}
    inputs[which] = inputs[which].clone()
    inputs[which][5, 1, 3] = poison
    with pytest.raises(NumericalError, match=f"patch_attention: {which} must be finite .* in row 5") as caught:
        patch_attention(**inputs, table=case.table)
    assert caught.value.tensor == which and caught.value.row == 5


def test_non_contiguous(device):
    case = random_case(dtype=torch.float32, dim=20).to(device)
    expected = gradients(case.attend, case.inputs, cotangent_of(case))
    strided = [x.permute(2, 1, 0).contiguous().permute(2, 1, 0) for x in case.inputs]
    doubled = dataclasses.replace(case, table=PatchTable(*(torch.stack([t, t], 1)[:, 0] for t in lists(case.table))))
    leaves = [x.requires_grad_() for x in strided]
    out = doubled.attend(*leaves)
    cotangent = cotangent_of(case).float().to(device).permute(2, 0, 1).contiguous().permute(1, 2, 0)
    for a, e in zip((out, *torch.autograd.grad(out, leaves, cotangent)), expected, strict=True):
        assert_same_bits(a, e)


def test_expanded_cotangent(device):
    case = random_case(dtype=torch.float32).to(device)
    expected = gradients(case.attend, case.inputs, torch.ones_like(case.q))[1:]
    leaves = [x.clone().requires_grad_() for x in case.inputs]
    for a, e in zip(torch.autograd.grad(case.attend(*leaves).sum(), leaves), expected, strict=True):
        assert_same_bits(a, e)


@pytest.mark.parametrize("dtype", DTYPES, ids=DTYPES.values())
def test_numbering_of_rows_does_not_matter(device, dtype):
    case = random_case(dtype=dtype).to(device)
    cotangent = cotangent_of(case)
    to_q, to_k = (torch.randperm(n, generator=torch.Generator().manual_seed(n)) for n in (len(case.q), len(case.k)))
    from_q, from_k = to_q.argsort(), to_k.argsort()  # new row to_q[i] is old row i
    table = dataclasses.replace(
        case.table, q_rows=to_q.to(device)[case.table.q_rows], kv_rows=to_k.to(device)[case.table.kv_rows]
    )
    renamed = Case(case.q[from_q], case.k[from_k], case.v[from_k], table, case.scale)
    out, grad_q, grad_k, grad_v = gradients(renamed.attend, renamed.inputs, cotangent[from_q])
    expected = gradients(case.attend, case.inputs, cotangent)
    for a, e in zip((out[to_q], grad_q[to_q], grad_k[to_k], grad_v[to_k]), expected, strict=True):
        assert_same_bits(a, e)


def test_order_of_queries_inside_a_patch_does_not_matter(device):
    case = self_case((70, 30), dtype=torch.float32).to(device)
    shuffle = torch.cat([torch.randperm(70), 70 + torch.randperm(30)]).to(device)
    shuffled = dataclasses.replace(case, table=dataclasses.replace(case.table, q_rows=case.table.q_rows[shuffle]))
    assert_same_bits(shuffled.attend(), case.attend())


def test_batch_is_its_members(device):
    sizes = RAGGED[1:] + ((300, 300),)
    whole = random_case(sizes, dtype=torch.float32).to(device)
    # Each patch alone, with its own copies of the key rows it lists.
    cotangent = cotangent_of(whole).float().to(device)
    out, grad_q = (torch.zeros_like(whole.q) for _ in range(2))
    grad_k, grad_v = (torch.zeros(len(whole.table.kv_rows), 2, 16, device=device) for _ in range(2))
    for p, (n_queries, n_keys) in enumerate(sizes):
        queries = slice(whole.table.cu_q[p], whole.table.cu_q[p + 1])
        keys = slice(whole.table.cu_k[p], whole.table.cu_k[p + 1])
        rows, entries = whole.table.q_rows[queries], whole.table.kv_rows[keys]
        table = PatchTable(
            torch.arange(n_queries), torch.arange(n_keys), torch.tensor([0, n_queries]), torch.tensor([0, n_keys])
        )
        alone = Case(whole.q[rows], whole.k[entries], whole.v[entries], table, whole.scale).to(device)
        results = gradients(alone.attend, alone.inputs, cotangent[rows])
        out[rows], grad_q[rows], grad_k[keys], grad_v[keys] = results
    summed_k, summed_v = torch.zeros_like(whole.k), torch.zeros_like(whole.v)
    for entry, row in enumerate(whole.table.kv_rows.tolist()):
        summed_k[row] += grad_k[entry]
        summed_v[row] += grad_v[entry]
    expected = gradients(whole.attend, whole.inputs, cotangent)
    for a, e in zip((out, grad_q), expected[:2], strict=True):
        assert_same_bits(a, e)
    assert_same_bits(summed_v, expected[3])
    assert_close_relative_to_max(summed_k, expected[2], "patch_attn_grad_float32")


@pytest.mark.parametrize("sizes", [RAGGED, ((600, 70),), ((1, 1),) * 200], ids=("ragged", "long", "tiny"))
def test_same_bits_for_any_threads(sizes):
    case = random_case(sizes, dtype=torch.float32)
    assert_same_bits_for_any_threads(lambda: gradients(case.attend, case.inputs, cotangent_of(case)))


def bits_of_all_dims() -> str:
    """A hash of forward and backward results, for the comparison of instruction sets."""
    digest = hashlib.sha256()
    for dtype in DTYPES:
        for dim in (4, 16, 20, 32, 64):
            case = random_case(dim=dim, dtype=dtype)
            for x in gradients(case.attend, case.inputs, cotangent_of(case)):
                digest.update(x.numpy().tobytes())
    return digest.hexdigest()


def test_same_bits_for_any_instruction_set():
    run = subprocess.run(
        [sys.executable, "-c", "from tests.ops.test_patch_attn import *; print(bits_of_all_dims())"],
        cwd=Path(__file__).parents[2],
        env={**os.environ, "GSIM3D_SIMD": "avx2"},
        capture_output=True,
        text=True,
    )
    assert run.returncode == 0, run.stderr
    assert run.stdout.strip() == bits_of_all_dims()


# ---- 8 error messages ----------------------------------------------------------------------------------------------


def rows(*values):
    return torch.tensor(values, dtype=torch.int64)


WRONG = {
    "q must be": dict(q=torch.zeros(3, 8)),
    "k must be": dict(k=torch.zeros(3, 2, 12)),
    "v must be": dict(v=torch.zeros(2, 1, 8)),
    "k must be float32": dict(k=torch.zeros(3, 1, 8, dtype=torch.float64)),
    "q must be float32 or float64": {name: torch.zeros(3, 1, 8, dtype=torch.int32) for name in "qkv"},
    "head dim must be a multiple of 4 from 4 to 256; got 6": {name: torch.zeros(3, 1, 6) for name in "qkv"},
    "head dim must be a multiple of 4 from 4 to 256; got 260": {name: torch.zeros(3, 1, 260) for name in "qkv"},
    "head dim must be a multiple of 4 from 4 to 256; got 0": {name: torch.zeros(3, 1, 0) for name in "qkv"},
    "q_rows must be int64": dict(q_rows=torch.zeros(3, dtype=torch.int16)),
    "kv_rows must have one dimension": dict(kv_rows=torch.zeros(3, 1, dtype=torch.int64)),
    "q_rows must be in [0, N) with N=3 from q; got 3 at 2": dict(q_rows=rows(0, 1, 3)),
    "q_rows must list a row at most once; got 1 again at 2": dict(q_rows=rows(0, 1, 1)),
    "kv_rows must be in [0, N) with N=3 from k; got -1 at 0": dict(kv_rows=rows(-1, 0, 1)),
    "cu_q must be": dict(cu_q=rows()),
    "cu_k must be": dict(cu_k=rows(0, 3)),
    "cu_q must run from 0 to at most the number of listed rows, 3; got 0 .. 4": dict(cu_q=rows(0, 1, 4)),
    "cu_k must run from 0": dict(cu_k=rows(1, 1, 3)),
    "cu_k must not descend; got 4 then 3 at 1": dict(cu_k=rows(0, 4, 3)),
    "scale must be finite, at most 1e30 in size; got nan": dict(scale=float("nan")),
    "scale must be finite, at most 1e30 in size; got -inf": dict(scale=-float("inf")),
}


@pytest.mark.parametrize("message", WRONG)
def test_errors(message):
    right = dict(
        q=torch.zeros(3, 1, 8),
        k=torch.zeros(3, 1, 8),
        v=torch.zeros(3, 1, 8),
        q_rows=rows(0, 1, 2),
        kv_rows=rows(0, 1, 2),
        cu_q=rows(0, 2, 3),
        cu_k=rows(0, 2, 3),
        scale=1.0,
    )
    with pytest.raises(ValueError) as error:
        torch.ops.gsim3d.patch_attention(*{**right, **WRONG[message]}.values())
    assert str(error.value).startswith("patch_attention: ") and message in str(error.value)


def test_a_table_that_is_none_is_refused():
    x = torch.zeros(3, 1, 8)
    with pytest.raises(TypeError, match="patch_attention: table.q_rows must be a tensor; got tuple"):
        patch_attention(x, x, x, (rows(0), rows(0), rows(0, 1), rows(0, 1)))
