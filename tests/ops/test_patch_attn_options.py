"""Grouped heads, 32-bit lists, log-sum-exp and 16 bits on the CPU."""

import pytest
import torch
from torch.autograd import gradcheck, gradgradcheck

from gsim3d import ops

pytestmark = pytest.mark.usefixtures("one_thread")
# The third patch has no keys; query row 3 is in no patch.
LISTS = ([4, 0, 1, 5, 2], [0, 3, 3, 1, 2], [0, 2, 4, 5], [0, 3, 5, 5])


def heads(n: int, h: int, seed: int = 0, device="cpu") -> torch.Tensor:
    return torch.randn(n, h, 8, generator=torch.Generator().manual_seed(seed), dtype=torch.float64).to(device)


def case(device, h: int = 2, h_keys: int = 2) -> list[torch.Tensor]:
    """Queries, keys and values."""
    return [heads(6, h, 0, device), heads(5, h_keys, 1, device), heads(5, h_keys, 2, device)]


def attend(q, k, v, **options):
    table = ops.PatchTable(*(torch.tensor(x, device=q.device) for x in LISTS))
    return ops.patch_attention(q, k, v, table, **options)


def scores(q, k, scale: float) -> torch.Tensor:
    """[Nq, H, Nk], with repeats of a key row as often as a patch lists it; -inf elsewhere."""
    counts = torch.zeros(len(q), len(k), dtype=q.dtype, device=q.device)
    q_rows, kv_rows, cu_q, cu_k = LISTS
    for p in range(len(cu_q) - 1):
        for i in q_rows[cu_q[p] : cu_q[p + 1]]:
            for j in kv_rows[cu_k[p] : cu_k[p + 1]]:
                counts[i, j] += 1
    return scale * torch.einsum("ihd,jhd->ihj", q, k) + counts.log()[:, None]


def test_grouped_heads_read_shared_keys(device):
    q, k, v = case(device, 4)
    torch.testing.assert_close(attend(q, k, v), attend(q, k[:, [0, 0, 1, 1]], v[:, [0, 0, 1, 1]]))
    assert gradcheck(attend, [x.requires_grad_() for x in (q, k, v)])
    with pytest.raises(ValueError, match="k must have H=3 heads or a divisor"):
        attend(heads(6, 3, device=device), k, v)
    with pytest.raises(ValueError, match="v must have as many heads as k, 2; got 1"):
        attend(q, k, v[:, :1])


def test_32_bit_lists(device):
    q, k, v = case(device)
    wide, narrow = (
        ops.PatchTable(*(torch.tensor(x, dtype=t, device=device) for x in LISTS)) for t in (torch.int64, torch.int32)
    )
    assert torch.equal(ops.patch_attention(q, k, v, narrow), ops.patch_attention(q, k, v, wide))


def test_vmap_leaves_out_rows_behind_the_last_offset(device):
    q_rows, kv_rows, *offsets = LISTS
    table = ops.PatchTable(*(torch.tensor(x, device=device) for x in (q_rows + [3], kv_rows + [4, 4], *offsets)))
    q, k, v = (torch.stack([x, x.roll(1, 0)]) for x in case(device))
    found = torch.func.vmap(lambda *one: ops.patch_attention(*one, table))(q, k, v)
    assert torch.equal(found, torch.stack([attend(*one) for one in zip(q, k, v)]))
    assert not found[:, 3].any()


@pytest.mark.parametrize("scale", [0.7, -0.7])
def test_log_sum_exp(scale, device):
    q, k, v = case(device)
    out, lse = attend(q, k, v, scale=scale, return_lse=True)
    assert torch.equal(out, attend(q, k, v, scale=scale))
    torch.testing.assert_close(lse, scores(q, k, scale).logsumexp(-1))
    assert lse[2:4].eq(-torch.inf).all()

    def finite(q, k):
        return attend(q, k, v, scale=scale, return_lse=True)[1][[0, 1, 4, 5]]

    inputs = [q.requires_grad_(), k.requires_grad_()]
    assert gradcheck(finite, inputs, check_forward_ad=True)
    assert gradgradcheck(finite, inputs)


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16], ids=str)
def test_16_bits_on_the_cpu_are_rounded_once(dtype):
    q, k, v = (x.to(dtype) for x in case("cpu"))
    out, lse = attend(q, k, v, return_lse=True)
    expected = attend(q.float(), k.float(), v.float(), return_lse=True)
    assert torch.equal(out, expected[0].to(dtype)) and torch.equal(lse, expected[1])


def test_compiled():
    q, k, v = case("cpu", 4)
    compiled = torch.compile(attend, fullgraph=True, backend="aot_eager")
    for got, expected in zip(compiled(q, k, v, return_lse=True), attend(q, k, v, return_lse=True), strict=True):
        torch.testing.assert_close(got, expected)
