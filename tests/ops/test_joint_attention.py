"""joint_attention against one float64 softmax over the keys of both tables, in the eight sections that every op has."""

import dataclasses

import pytest
import torch

from gsim3d.errors import NumericalError
from gsim3d.ops import PatchTable, joint_attention, patch_attention
from tests.asserts import (
    assert_close_relative_to_max,
    assert_same_bits,
    assert_same_bits_for_any_threads,
    gradients,
)
from tests.ops.test_patch_attn import DIMS, DTYPES, RAGGED, cotangent_of, lists, offsets, random_case
from tests.oracle import patch_attn as oracle

LOW_PRECISION = {torch.bfloat16: "bfloat16", torch.float16: "float16"}
NAMES = ("out", "q", "k", "v", "other_k", "other_v")


@dataclasses.dataclass(frozen=True)
class Case:
    inputs: tuple[torch.Tensor, ...]  # q, k, v, other_k, other_v
    tables: tuple[PatchTable, PatchTable]
    scale: float

    def to(self, *args):
        tables = self.tables
        if isinstance(args[0], torch.device):
            tables = tuple(PatchTable(*(t.to(args[0]) for t in lists(table))) for table in tables)
        return Case(tuple(x.to(*args) for x in self.inputs), tables, self.scale)

    @property
    def q(self):
        return self.inputs[0]

    def attend(self, *inputs):
        return joint_attention(*(inputs or self.inputs), *self.tables, scale=self.scale)

    def groups(self):
        """(queries, keys, keys of the other table) for each pair of patches that share queries; one may be
        none."""
        patch = torch.full((2, len(self.q)), -1)
        keys = [[], []]
        for which, table in enumerate(self.tables):
            q_rows, kv_rows, cu_q, cu_k = lists(table)
            keys[which] = [*kv_rows[: cu_k[-1]].split(cu_k.diff().tolist()), kv_rows[:0]]
            for p, rows in enumerate(q_rows[: cu_q[-1]].split(cu_q.diff().tolist())):
                patch[which, rows] = p
        for own, other in patch.unique(dim=1).T.tolist():
            rows = ((patch[0] == own) & (patch[1] == other)).nonzero()[:, 0]
            yield rows, keys[0][own], keys[1][other]

    def attend_oracle(self, *inputs):
        q, k, v, other_k, other_v = inputs or self.inputs
        rows, own, other = zip(*self.groups(), strict=True)
        keys = [torch.cat([a, len(k) + b]) for a, b in zip(own, other, strict=True)]
        table = torch.cat(rows), torch.cat(keys), offsets(map(len, rows)), offsets(map(len, keys))
        return oracle.patch_attention(q, torch.cat([k, other_k]), torch.cat([v, other_v]), *table, self.scale)

    def attend_plainly(self, *inputs):
        """Plain torch in the dtype of its arguments."""
        q, k, v, other_k, other_v = inputs or self.inputs
        out = q.new_zeros(q.shape)
        for rows, own, other in self.groups():
            keys, values = torch.cat([k[own], other_k[other]]), torch.cat([v[own], other_v[other]])
            shares = (torch.einsum("ihd,jhd->hij", q[rows], keys) * self.scale).softmax(-1)
            out = out.index_put((rows,), torch.einsum("hij,jhd->ihd", shares, values))
        return out


# Of the other table: patches of other sizes, some without queries or keys, one with most queries.
OTHER = ((60, 33), (0, 5), (1, 0), (80, 90), (2, 1))


def joint_case(sizes=RAGGED, other_sizes=OTHER, n_keys=150, **options):
    n_q = max(sum(n for n, _ in s) for s in (sizes, other_sizes)) + 3
    own, other = (
        random_case(s, n_keys=n, spare=n_q - sum(q for q, _ in s), seed=i, **options)
        for i, (s, n) in enumerate(((sizes, n_keys), (other_sizes, n_keys + 7)))
    )
    return Case((*own.inputs, other.k, other.v), (own.table, other.table), own.scale)


def results_of(case, attend=None):
    return gradients(attend or case.attend, case.inputs, cotangent_of(case).to(case.q.dtype))


# 1 forward against the oracle, 2 backward against autograd of the oracle
@pytest.mark.parametrize("dtype", DTYPES, ids=DTYPES.values())
@pytest.mark.parametrize("dim", DIMS)
def test_forward_and_gradients(device, dim, dtype):
    case = joint_case(dim=dim, dtype=dtype)
    for name, a, e in zip(NAMES, results_of(case.to(device)), results_of(case, case.attend_oracle), strict=True):
        assert a.dtype == dtype
        kind = "patch_attn" if name == NAMES[0] else "patch_attn_grad"
        assert_close_relative_to_max(a, e, f"{kind}_{DTYPES[dtype]}", name)


@pytest.mark.parametrize("dtype", DTYPES, ids=DTYPES.values())
@pytest.mark.parametrize("scale", [0.0, -0.3, 1e-30, 3.0])
def test_any_scale(device, scale, dtype):
    case = joint_case(scale=scale, dtype=dtype)
    for name, a, e in zip(NAMES, results_of(case.to(device)), results_of(case, case.attend_oracle), strict=True):
        assert_close_relative_to_max(a, e, f"patch_attn_scale_{DTYPES[dtype]}", name)


@pytest.mark.parametrize("dtype", [*DTYPES, *LOW_PRECISION], ids=[*DTYPES.values(), *LOW_PRECISION.values()])
@pytest.mark.parametrize("dim", [16, 20])
def test_one_table_without_keys_leaves_the_other(device, dim, dtype):
    """The bits of patch_attention, whichever of the two it is."""
    if device.type == "cpu" and dtype in LOW_PRECISION:
        pytest.skip("the CPU computes in float32 and float64")
    case = joint_case(dim=dim, dtype=dtype).to(device)
    q, k, v, other_k, other_v = case.inputs
    own, other = case.tables
    nothing = dataclasses.replace(other, cu_k=torch.zeros_like(other.cu_k))
    blind = dataclasses.replace(own, cu_k=torch.zeros_like(own.cu_k))
    alone = patch_attention(q, k, v, own, scale=case.scale)
    assert_same_bits(joint_attention(q, k, v, other_k, other_v, own, nothing, scale=case.scale), alone)
    alone = patch_attention(q, other_k, other_v, other, scale=case.scale)
    assert_same_bits(joint_attention(q, k, v, other_k, other_v, blind, other, scale=case.scale), alone)


# 3 gradcheck
@pytest.mark.parametrize("scale", [0.5, -0.5])
def test_gradcheck(scale):
    case = joint_case(((3, 2), (1, 5), (0, 1)), ((4, 3), (1, 0)), n_keys=6, dim=4, scale=scale)
    torch.autograd.gradcheck(case.attend, [x.requires_grad_() for x in case.inputs])


# 4 CPU against CUDA
@pytest.mark.parametrize("dtype", DTYPES, ids=DTYPES.values())
@pytest.mark.parametrize("dim", [16, 20, 64])
def test_devices_agree(devices, dim, dtype):
    case = joint_case(RAGGED + ((300, 700),), ((2, 90), (430, 600)), n_keys=700, dim=dim, dtype=dtype)
    for name, a, e in zip(NAMES, results_of(case.to(devices[1])), results_of(case), strict=True):
        assert_close_relative_to_max(a, e, f"patch_attn_{DTYPES[dtype]}", name)


SHAPES = {
    "ragged": (RAGGED, OTHER),
    "nearly all in one": (((1024, 1024),) * 2 + ((40, 40),), ((30, 20), (2000, 1024), (9, 1100))),
    "many patches": (((300, 70),), ((1, 2),) * 290 + ((3, 40),)),
}


@pytest.mark.parametrize("dtype", LOW_PRECISION, ids=LOW_PRECISION.values())
@pytest.mark.parametrize("shape, dim", [(s, d) for s in SHAPES for d in (16, 32, 64)] + [("ragged", 8), ("ragged", 48)])
def test_low_precision_errs_no_more_than_torch(devices, shape, dim, dtype):
    """Against float64, and plain torch in the same dtype. Of a patch with two keys each gradient is one product: which
    of the two errs more in its worst number is a matter of luck, by a factor of two either way."""
    case = joint_case(*SHAPES[shape], n_keys=1100, dim=dim, dtype=dtype)
    wide, plain = case.to(torch.float64), results_of(case, case.attend_plainly)
    exact = results_of(wide, wide.attend_oracle)
    for name, a, b, e in zip(NAMES, results_of(case.to(devices[1])), plain, exact, strict=True):
        ours, theirs = (x.double().cpu() - e for x in (a, b))
        assert a.dtype == dtype and ours.square().mean() <= 1.5**2 * theirs.square().mean(), name
        assert ours.abs().max() <= 3 * theirs.abs().max(), name


@pytest.mark.unraced("runs the kernels of other tests five times")
@pytest.mark.parametrize("dtype", [torch.float32, *LOW_PRECISION], ids=["float32", *LOW_PRECISION.values()])
@pytest.mark.parametrize("shape", SHAPES)
def test_cuda_gives_the_same_bits_in_every_run(devices, shape, dtype):
    case = joint_case(*SHAPES[shape], n_keys=1100, dtype=dtype).to(devices[1])
    first = results_of(case)
    for _ in range(3):
        for a, e in zip(results_of(case), first, strict=True):
            assert_same_bits(a, e)


@pytest.mark.parametrize("dtype", LOW_PRECISION, ids=LOW_PRECISION.values())
def test_keys_that_are_not_aligned(devices, dtype):
    """Those of one table only: each takes its own way."""
    case = joint_case(dtype=dtype).to(devices[1])
    expected = results_of(case)
    for moved in ((1, 2), (3, 4)):
        inputs = [x if i not in moved else torch.cat([x.flatten()[:1], x.flatten()])[1:].view(x.shape)
                  for i, x in enumerate(case.inputs)]  # fmt: skip
        assert_close_relative_to_max(case.attend(*inputs), expected[0], 1e-2)


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_cuda_graph(devices, dtype):
    case = joint_case(dtype=dtype).to(devices[1])
    side = torch.cuda.Stream()
    with torch.cuda.stream(side):
        expected = case.attend()
        graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(graph, stream=side):
            result = case.attend()
    result.fill_(float("nan"))
    graph.replay()
    torch.cuda.synchronize()
    assert_same_bits(result, expected)


# 5 opcheck
def test_opcheck(device):
    case = joint_case(dtype=torch.float32).to(device)
    inputs = [x.requires_grad_() for x in case.inputs]
    tables = [x for table in case.tables for x in lists(table)]
    torch.library.opcheck(torch.ops.gsim3d.joint_attention.default, (*inputs, *tables, case.scale))


def test_autocast_on_the_cpu_computes_in_float32():
    case = joint_case(dtype=torch.float32)
    with torch.autocast("cpu", torch.bfloat16):
        out = case.attend(*(x.bfloat16() for x in case.inputs))
    assert_same_bits(out, case.attend(*(x.bfloat16().float() for x in case.inputs)))


def test_autocast_on_cuda_follows_its_dtype(devices):
    case = joint_case(dtype=torch.float32).to(devices[1])
    with torch.autocast("cuda", torch.bfloat16):
        out = case.attend()
    assert_same_bits(out, case.attend(*(x.bfloat16() for x in case.inputs)))


# 6 torch.compile
def test_compile(device):
    case = joint_case(dtype=torch.float32).to(device)
    compiled = torch.compile(lambda *x: case.attend(*x).sin(), fullgraph=True, backend="aot_eager")
    expected = results_of(case, lambda *x: case.attend(*x).sin())
    for name, a, e in zip(NAMES, results_of(case, compiled), expected, strict=True):
        assert_close_relative_to_max(a, e, "patch_attn_float32", name)


# 7 edges
def test_empty_patches(device):
    rows, cu = torch.zeros(0, dtype=torch.int64, device=device), torch.zeros(1, dtype=torch.int64, device=device)
    table, x = PatchTable(rows, rows, cu, cu), torch.ones(3, 2, 4, device=device)
    assert not joint_attention(x, x, x, x[:0], x[:0], table, table).any()
    assert joint_attention(x[:0], x, x, x, x, table, table).shape == (0, 2, 4)


@pytest.mark.parametrize("dtype", DTYPES, ids=DTYPES.values())
@pytest.mark.parametrize("which", [0, 1])
def test_one_table_may_have_all_the_weight(device, which, dtype):
    """Logits thousands apart: exponentials neither overflow nor leave a NaN."""
    case = joint_case(dtype=dtype)
    q, k, v, other_k, other_v = case.inputs
    keys = [k, other_k]
    keys[which] = keys[which] * 1e4
    case = dataclasses.replace(case, inputs=(q, keys[0], v, keys[1], other_v))
    for name, a, e in zip(NAMES, results_of(case.to(device)), results_of(case, case.attend_oracle), strict=True):
        assert torch.isfinite(a).all()
        if name == "out":
            assert_close_relative_to_max(a, e, 1e-3 if dtype == torch.float32 else 1e-10, name)


@pytest.mark.parametrize("dtype", DTYPES, ids=DTYPES.values())
def test_table_without_keys_has_no_weight_whatever_the_logits(device, dtype):
    """All logits are far below 0; many queries have keys in one table only."""
    case = joint_case(dtype=dtype)
    q, k, v, other_k, other_v = case.inputs
    case = dataclasses.replace(case, inputs=(q.abs() * 100, -k.abs(), v, -other_k.abs(), other_v))
    expected = case.attend_oracle()
    assert_close_relative_to_max(case.to(device).attend(), expected, 1e-3 if dtype == torch.float32 else 1e-10)


def test_order_of_the_tables_does_not_matter(device):
    case = joint_case().to(device)
    q, k, v, other_k, other_v = case.inputs
    swapped = joint_attention(q, other_k, other_v, k, v, *case.tables[::-1], scale=case.scale)
    assert_close_relative_to_max(swapped, case.attend(), 1e-14)


@pytest.mark.parametrize("poison", [float("nan"), float("inf")])
def test_poison_stays_in_its_patches(device, poison):
    case = joint_case(dtype=torch.float32).to(device)
    clean, table = case.attend(), case.tables[1]
    inputs = [x.clone() for x in case.inputs]
    inputs[4][table.kv_rows[0], 1, 3] = poison
    dirty = joint_attention(*inputs, *case.tables, scale=case.scale, check=False)
    has_it = [bool((keys == table.kv_rows[0]).any()) for keys in table.kv_rows.split(table.cu_k.diff().tolist())]
    reached = torch.zeros(len(clean), dtype=torch.bool, device=device)
    for rows, hit in zip(table.q_rows.split(table.cu_q.diff().tolist()), has_it, strict=True):
        reached[rows] = hit
    assert reached.any() and not torch.isfinite(dirty[reached, 1, 3]).any()
    assert_same_bits(dirty[~reached], clean[~reached])
    assert_same_bits(dirty[:, 0], clean[:, 0])


@pytest.mark.parametrize("which", range(5))
def test_poison_is_refused_on_the_cpu(which):
    case = joint_case(dtype=torch.float32)
    inputs = [x.clone() for x in case.inputs]
    inputs[which][3, 1, 2] = float("nan")
    with pytest.raises(NumericalError, match=f"joint_attention: {NAMES[1:][which]} must be finite"):
        case.attend(*inputs)


def test_views_of_one_tensor(device):
    case = joint_case(((40, 40), (7, 7)), ((50, 30),), n_keys=53).to(device)
    q, k, v, other_k, other_v = case.inputs
    qkv = torch.stack([q, k, v], 1)
    assert_same_bits(joint_attention(*qkv.unbind(1), other_k, other_v, *case.tables, scale=case.scale), case.attend())


@pytest.mark.parametrize("sizes", [(RAGGED, OTHER), (((600, 70),), ((700, 300),))], ids=("ragged", "long"))
def test_same_bits_for_any_threads(sizes):
    case = joint_case(*sizes, n_keys=300, dtype=torch.float32)
    assert_same_bits_for_any_threads(lambda: results_of(case))


# 8 error messages
@pytest.mark.parametrize(
    "wrong, message",
    [
        ({3: torch.zeros(157, 2, 8)}, r"other table: k must be \[Nk, H, D\].*got \[157, 2, 8\]"),
        ({4: torch.zeros(9, 2, 16)}, r"other table: v must be \[Nk, H, D\].*got \[9, 2, 16\]"),
        ({3: torch.zeros(157, 2, 16)}, "other table: k must be float64; got float32"),
        ({1: torch.zeros(150, 3, 16).double()}, r"k must be \[Nk, H, D\].*got \[150, 3, 16\]"),
    ],
)
def test_malformed_tensors_raise(wrong, message):
    case = joint_case()
    with pytest.raises(ValueError, match=f"joint_attention: {message}"):
        case.attend(*(wrong.get(i, x) for i, x in enumerate(case.inputs)))


@pytest.mark.parametrize("which, name", [(0, ""), (1, "other table: ")])
def test_malformed_tables_raise(which, name):
    case = joint_case()
    for field, value, message in (
        ("q_rows", torch.full_like(case.tables[which].q_rows, 10**6), r"q_rows must be in \[0, N\)"),
        ("kv_rows", case.tables[which].kv_rows.float(), "kv_rows must be int64; got float32"),
        ("cu_q", case.tables[which].cu_q + 1, "cu_q must run from 0"),
        ("cu_k", case.tables[which].cu_k[1:], r"cu_k must be \[P \+ 1\]"),
    ):
        tables = list(case.tables)
        tables[which] = dataclasses.replace(tables[which], **{field: value})
        with pytest.raises(ValueError, match=f"joint_attention: {name}{message}"):
            dataclasses.replace(case, tables=tuple(tables)).attend()
