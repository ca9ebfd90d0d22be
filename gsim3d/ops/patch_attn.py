"""Attention inside patches of a serialized order, without storing the score matrix."""

import torch
from torch import Tensor

from gsim3d.ops._arguments import as_given, check_numbers, check_real, check_tensors, widened_on_cpu
from gsim3d.ops._attention_derivatives import gradients_of_gradients, tangent
from gsim3d.ops._register import call, define, expanded, fakes, one_by_one, register_autocast, register_gradients
from gsim3d.ops.curve import PatchTable


def patch_attention(
    q: Tensor,
    k: Tensor,
    v: Tensor,
    table: PatchTable,
    *,
    scale: float | None = None,
    return_lse: bool = False,
    check: bool = True,
) -> Tensor | tuple[Tensor, Tensor]:
    """Softmax attention of every query row over the key rows of its patch.

    ``out[i] = sum_j softmax_j(scale * <q[i], k[j]>) v[j]`` for each head, over the keys ``j`` in
    ``kv_rows[cu_k[p]:cu_k[p + 1]]`` of the patch ``p`` that lists ``i`` in ``q_rows[cu_q[p]:cu_q[p + 1]]``.
    A query row that no patch lists, or whose patch has no keys, gets 0.

    Args:
        q: queries [Nq, H, D], floating point (softmax and sums of 16-bit ones are float32); D a multiple of 4 from 4 to
            256, fastest 16, 32 and 64. Under ``torch.autocast`` CUDA computes in its dtype and the CPU in float32.
        k, v: keys and values [Nk, H, D]. The three may be views of one qkv tensor; they are read in place. Or
            [Nk, H / G, D]: head h of the queries reads head h // G.
        table: patches, int64 or int32; a row at most once in ``q_rows``, any number of times in ``kv_rows``. What the
            lists hold behind the last offsets is in no patch.
        scale: factor of the dot products; default ``D ** -0.5``.
        return_lse: whether the logarithms of the sums of exp(scale <q, k>) are returned too, float32 or float64.
        check: look for numbers that cannot be used, on the CPU; a model that guards its numbers itself leaves it out.
    Returns:
        [Nq, H, D], dtype of ``q``; with ``return_lse`` and lse [Nq, H], -inf where there are no keys.
    Gradients:
        ``q``, ``k`` and ``v``, to any order and in forward mode. Beyond the first order in reverse mode the scores of
        all patches are stored.
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
    given, scale = q, _scale(q, scale)
    q, k, v = widened_on_cpu(q, *_for_each_head(q, k, v))
    lists = [rows.long() if rows.dtype == torch.int32 else rows for rows in _lists(table).values()]
    out, stats = call("patch_attention", q, k, v, *lists, scale)
    out = as_given(out, given)
    return (out, call("attention_log_sum_exp", stats, q, k, *lists, scale)) if return_lse else out


def _for_each_head(q: Tensor, k: Tensor, v: Tensor) -> list[Tensor]:
    """Keys and values with a head for each one of the queries."""
    if any(x.dim() != 3 for x in (q, k, v)) or k.shape[1] in (0, q.shape[1]):
        return [k, v]
    if q.shape[1] % k.shape[1]:
        raise ValueError(f"patch_attention: k must have H={q.shape[1]} heads or a divisor of it; got {k.shape[1]}")
    if v.shape[1] != k.shape[1]:
        raise ValueError(f"patch_attention: v must have as many heads as k, {k.shape[1]}; got {v.shape[1]}")
    return [x.repeat_interleave(q.shape[1] // k.shape[1], 1) for x in (k, v)]


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
    return call("joint_attention", q, k, v, other_k, other_v, *lists, _scale(q, scale))[0]


def _lists(table: PatchTable, prefix: str = "") -> dict[str, Tensor]:
    return {f"{prefix}table.{name}": getattr(table, name, table) for name in ("q_rows", "kv_rows", "cu_q", "cu_k")}


def _scale(q: Tensor, scale: float | None) -> float:
    if scale is not None:
        return float(scale)
    return q.shape[-1] ** -0.5 if q.dim() and q.shape[-1] else 1.0


# The same computation; what it returns there is not the whole gradient, so that it has none itself.
_patch_backward = torch.ops.gsim3d.patch_attention_backward.default
define(str(_patch_backward._schema).replace("gsim3d::patch", "joint", 1), _patch_backward)
_tensors = "Tensor stats, Tensor q, Tensor k, Tensor q_rows, Tensor kv_rows, Tensor cu_q, Tensor cu_k"
define(
    f"attention_log_sum_exp({_tensors}, float scale) -> Tensor",
    lambda stats, *others: stats[..., 1].log() + abs(others[-1]) * stats[..., 0],
)


def _attention(q, *_):
    stats_dtype = torch.promote_types(q.dtype, torch.float32)
    return q.new_empty(q.shape), q.new_empty(q.shape[0], q.shape[1], 2, dtype=stats_dtype)


def _attention_gradients(grad, q, k, *_):
    return q.new_empty(q.shape), k.new_empty(k.shape), k.new_empty(k.shape)


fakes(
    patch_attention=_attention,
    patch_attention_backward=_attention_gradients,
    patch_attention_backward_packed=lambda grad, q, *_: q.new_empty(q.shape[0], 3, *q.shape[1:]),
    joint_attention=_attention,
    joint_attention_backward=_attention_gradients,
    attention_log_sum_exp=lambda stats, *_: stats.new_empty(stats.shape[:2]),
)


def _setup(ctx, inputs, output):
    ctx.set_materialize_grads(False)
    ctx.mark_non_differentiable(output[1])
    q, k, v, q_rows, kv_rows, cu_q, cu_k, ctx.scale = inputs
    ctx.save_for_backward(q, k, v, *output, q_rows, kv_rows, cu_q, cu_k)


def _backward(ctx, grad, _grad_stats):
    if grad is None:
        return (None,) * 8
    grads = call("patch_attention_backward", grad, *ctx.saved_tensors, ctx.scale)
    return *grads, None, None, None, None, None


def _jvp(inputs, tangents, outputs):
    return tangent(*inputs[:3], *_along(inputs[:3], tangents), inputs[3:7], inputs[7]), None


def _along(tensors, tangents):
    return [torch.zeros_like(x) if t is None else t for x, t in zip(tensors, tangents)]


def _gradient_setup(ctx, inputs, output):
    grad, q, k, v, _, _, *lists, ctx.scale = inputs
    ctx.save_for_backward(grad, q, k, v, *lists)


def _gradient_backward(ctx, by_q, by_k, by_v):
    grad, q, k, v, *lists = ctx.saved_tensors
    return *gradients_of_gradients(grad, q, k, v, by_q, by_k, by_v, lists, ctx.scale), *(None,) * 7


def _gradient_jvp(inputs, tangents, outputs):
    # Second derivatives are symmetric: along a direction of q, k, v they are those of the gradient's product with it.
    by_grad, *along = _along(inputs[:4], tangents)
    curved = gradients_of_gradients(*inputs[:4], *along, inputs[6:-1], inputs[-1])[1:]
    return tuple(a + b for a, b in zip(call(_gradient, by_grad, *inputs[1:]), curved, strict=True))


def _batched(op: str, n_floats: int):
    """Patches of a batch one after another, where they share their table; else one by one."""

    def batched(size, inputs, is_batched):
        if any(is_batched[n_floats:]):
            return one_by_one(op)(size, inputs, is_batched)
        floats = expanded(size, inputs[:n_floats], is_batched[:n_floats])
        q, k = (floats[0], floats[1]) if n_floats == 3 else (floats[1], floats[2])
        table = _one_after_another(size, *inputs[n_floats:-1], q.shape[1], k.shape[1])
        results = call(op, *(x.flatten(0, 1) for x in floats), *table, inputs[-1])
        return tuple(x.unflatten(0, (size, -1)) for x in results)

    return batched


def _one_after_another(size, q_rows, kv_rows, cu_q, cu_k, n_q, n_k):
    """The table of ``size`` copies. Rows that no patch lists become a patch without keys, and one without queries."""
    entry = torch.arange(size, device=q_rows.device)[:, None]
    cu_q = torch.cat([cu_q, cu_q.new_full((1,), q_rows.shape[0])]) + q_rows.shape[0] * entry
    cu_k = torch.cat([cu_k, cu_k[-1:]]) + kv_rows.shape[0] * entry
    return (q_rows + n_q * entry).flatten(), (kv_rows + n_k * entry).flatten(), cu_q.flatten(), cu_k.flatten()


# With P the softmax of the scores, the gradient of the log-sum-exp is scale P K for queries, scale P^T Q for keys.


def _lse_setup(ctx, inputs, output):
    _, *tensors, ctx.scale = inputs
    ctx.save_for_backward(*tensors)


def _lse_backward(ctx, grad):
    q, k, *lists = ctx.saved_tensors
    mean, stats = call("patch_attention", q, k, k, *lists, ctx.scale)
    scaled = (ctx.scale * grad)[..., None].to(q.dtype)
    by_k = call("patch_attention_backward", scaled * q, q, k, k, mean, stats, *lists, ctx.scale)[2]
    return None, scaled * mean, by_k, *(None,) * 5


def _lse_jvp(inputs, tangents, outputs):
    (_, q, k, *lists, scale), (_, by_q, by_k) = inputs, _along(inputs[:3], tangents)
    mean, moved = (call("patch_attention", q, k, x, *lists, scale)[0] for x in (k, by_k))
    return scale * (by_q * mean + q * moved).sum(-1, dtype=outputs[0].dtype)


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
    tables, gradient = ((keys[:2], keys[4:8]), (keys[2:4], keys[8:])), torch.ops.gsim3d.joint_attention_backward
    own, other = (gradient(grad, q, *kv, out, stats, *lists, ctx.scale) for kv, lists in tables)
    return own[0] + other[0], *own[1:], *other[1:], *(None,) * 9


_op, _gradient, _lse = "patch_attention", "patch_attention_backward", "attention_log_sum_exp"
_packed = [f"{_gradient}_packed"]
register_gradients(_op, _backward, _setup, gradient_ops=_packed, jvp=_jvp, batched=_batched(_op, 3))
register_gradients(_gradient, _gradient_backward, _gradient_setup, jvp=_gradient_jvp, batched=_batched(_gradient, 6))
register_gradients(_lse, _lse_backward, _lse_setup, jvp=_lse_jvp, batched=one_by_one(_lse))
register_gradients("joint_attention", _joint_backward, _joint_setup, gradient_ops=["joint_attention_backward"])
register_autocast(_op, "follow")
register_autocast("joint_attention", "follow")
register_autocast(_lse, "float32")
