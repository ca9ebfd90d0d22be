"""Attention inside patches of a serialized order, without storing the score matrix."""

import torch
from torch import Tensor

from gsim3d.ops._arguments import check_numbers, check_real, check_tensors
from gsim3d.ops._register import fake, register_autocast, register_gradients
from gsim3d.ops.curve import PatchTable


def patch_attention(
    q: Tensor, k: Tensor, v: Tensor, table: PatchTable, *, scale: float | None = None, check: bool = True
) -> Tensor:
    """Softmax attention of every query row over the key rows of its patch.

    ``out[i] = sum_j softmax_j(scale * <q[i], k[j]>) v[j]`` for each head, over the keys ``j`` in
    ``kv_rows[cu_k[p]:cu_k[p + 1]]`` of the patch ``p`` that lists ``i`` in ``q_rows[cu_q[p]:cu_q[p + 1]]``.
    A query row that no patch lists, or whose patch has no keys, gets 0.

    Args:
        q: queries [Nq, H, D], float32 or float64, on CUDA also bfloat16 and float16 (their softmax and sums are
            float32); D a multiple of 4 from 4 to 128, fastest 16, 32 and 64. Under ``torch.autocast`` CUDA computes in
            its dtype and the CPU in float32.
        k, v: keys and values [Nk, H, D]. The three may be views of one qkv tensor; they are read in place.
        table: patches; a row at most once in ``q_rows``, any number of times in ``kv_rows``. What the lists hold behind
            the last offsets is in no patch.
        scale: factor of the dot products; default ``D ** -0.5``.
        check: look for numbers that cannot be used, on the CPU; a model that guards its numbers itself leaves it out.
    Returns:
        [Nq, H, D], dtype of ``q``.
    Gradients:
        ``q``, ``k`` and ``v``, once.
    Determinism:
        equal bits for any number of threads, with AVX2 and AVX-512, on one GPU in every run, for any numbering
        of the rows, and with any other patches beside; only the order of the keys inside a patch rounds differently.
    Raises:
        NumericalError: a number is not finite or beyond 1e15 (float64: 1e150); CPU only.
        ValueError, TypeError: a shape, dtype, head dim, scale or table is malformed; the message names the argument.
            CUDA does not look into the table: rows out of range take no part.
    Source:
        Dao et al. 2022 (FlashAttention), applied to the patches of Point Transformer V3 (Wu et al. 2024).

    Example:
        >>> from gsim3d.ops import PatchTable
        >>> rows, cu = torch.tensor([0, 1, 2]), torch.tensor([0, 1, 3])
        >>> x = torch.ones(3, 1, 4)
        >>> patch_attention(x, x, torch.arange(12.0).view(3, 1, 4), PatchTable(rows, rows, cu, cu))[:, 0, 0]
        tensor([0., 6., 6.])
    """
    if check:
        check_tensors("patch_attention", q=q, k=k, v=v, **_lists(table))
        check_real("patch_attention", **({} if scale is None else {"scale": scale}))
        check_numbers("patch_attention", q=q, k=k, v=v)
    return torch.ops.gsim3d.patch_attention(q, k, v, *_lists(table).values(), _scale(q, scale))[0]


def joint_attention(
    q: Tensor,
    k: Tensor,
    v: Tensor,
    other_k: Tensor,
    other_v: Tensor,
    table: PatchTable,
    other_table: PatchTable,
    *,
    scale: float | None = None,
    check: bool = True,
) -> Tensor:
    """Softmax attention of every query row over the key rows of its patches in two tables, in one softmax.

    Args:
        q, k, v, table: as in :func:`patch_attention`.
        other_k, other_v: keys and values [No, H, D] of the other table.
        other_table: patches of the same queries; a patch may have nearly all of them.
        scale, check: as in :func:`patch_attention`.
    Returns:
        [Nq, H, D], dtype of ``q``; 0 for a query row without keys.
    Gradients:
        ``q``, keys and values, once.
    Determinism, Raises: as :func:`patch_attention`. In 16 bits the result over the first table is rounded before the
        other joins it.

    Example:
        >>> rows, cu = torch.tensor([0, 1]), torch.tensor([0, 2])
        >>> x, table = torch.ones(2, 1, 4), PatchTable(rows, rows, cu, cu)
        >>> joint_attention(x, x, 2 * x, x, 4 * x, table, table)[:, 0, 0]
        tensor([3., 3.])
    """
    if check:
        numbers = {"q": q, "k": k, "v": v, "other_k": other_k, "other_v": other_v}
        check_tensors("joint_attention", **numbers, **_lists(table), **_lists(other_table, "other_"))
        check_real("joint_attention", **({} if scale is None else {"scale": scale}))
        check_numbers("joint_attention", **numbers)
    lists = *_lists(table).values(), *_lists(other_table).values()
    return torch.ops.gsim3d.joint_attention(q, k, v, other_k, other_v, *lists, _scale(q, scale))[0]


def _lists(table: PatchTable, prefix: str = "") -> dict[str, Tensor]:
    return {f"{prefix}{name}": getattr(table, name) for name in ("q_rows", "kv_rows", "cu_q", "cu_k")}


def _scale(q: Tensor, scale: float | None) -> float:
    if scale is not None:
        return float(scale)
    return q.shape[-1] ** -0.5 if q.dim() and q.shape[-1] else 1.0


@fake("patch_attention")
def _(q, k, v, q_rows, kv_rows, cu_q, cu_k, scale):
    stats_dtype = torch.promote_types(q.dtype, torch.float32)
    return q.new_empty(q.shape), q.new_empty(q.shape[0], q.shape[1], 2, dtype=stats_dtype)


@fake("patch_attention_backward")
def _(grad, q, k, v, out, stats, q_rows, kv_rows, cu_q, cu_k, scale):
    return q.new_empty(q.shape), k.new_empty(k.shape), k.new_empty(k.shape)


@fake("patch_attention_backward_packed")
def _(grad, q, k, v, out, stats, q_rows, kv_rows, cu_q, cu_k, scale):
    return q.new_empty(q.shape[0], 3, *q.shape[1:])


def _setup(ctx, inputs, output):
    ctx.set_materialize_grads(False)
    ctx.mark_non_differentiable(output[1])
    q, k, v, q_rows, kv_rows, cu_q, cu_k, ctx.scale = inputs
    ctx.save_for_backward(q, k, v, *output, q_rows, kv_rows, cu_q, cu_k)


def _backward(ctx, grad, _grad_stats):
    if grad is None:
        return (None,) * 8
    grads = torch.ops.gsim3d.patch_attention_backward(grad, *ctx.saved_tensors, ctx.scale)
    return *grads, None, None, None, None, None


@fake("joint_attention")
def _(q, k, v, other_k, other_v, *lists_and_scale):
    stats_dtype = torch.promote_types(q.dtype, torch.float32)
    return q.new_empty(q.shape), q.new_empty(q.shape[0], q.shape[1], 2, dtype=stats_dtype)


def _joint_setup(ctx, inputs, output):
    ctx.set_materialize_grads(False)
    ctx.mark_non_differentiable(output[1])
    *tensors, ctx.scale = inputs
    ctx.save_for_backward(*tensors, *output)


def _joint_backward(ctx, grad, _grad_stats):
    if grad is None:
        return (None,) * 14
    q, *keys, out, stats = ctx.saved_tensors
    # Each table's part of the gradient follows from its own keys and the result over both.
    own, other = (
        torch.ops.gsim3d.patch_attention_backward(grad, q, *kv, out, stats, *lists, ctx.scale)
        for kv, lists in ((keys[:2], keys[4:8]), (keys[2:4], keys[8:]))
    )
    return own[0] + other[0], *own[1:], *other[1:], *(None,) * 9


_own_ops = ["patch_attention_backward", "patch_attention_backward_packed"]
_rules = {"patch_attention": (_backward, _setup, _own_ops), "joint_attention": (_joint_backward, _joint_setup, [])}
for _name, (_gradients, _context, _gradient_ops) in _rules.items():
    register_gradients(_name, _gradients, _context, gradient_ops=_gradient_ops)
    register_autocast(_name, "follow")
