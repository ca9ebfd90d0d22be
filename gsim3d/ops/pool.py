"""Grid pooling and unpooling: segment reductions of feature rows, and the way back."""

import torch
from torch import Tensor
from torch.nn import functional as F

from gsim3d.ops._arguments import as_given, check_numbers, check_tensors, check_whole, widened, within_memory
from gsim3d.ops._register import call, expanded, fakes, one_by_one, register_autocast, register_gradients


def pool_max(x: Tensor, rows: Tensor, cu_rows: Tensor, *, check: bool = True) -> Tensor:
    """Channelwise maximum over segments of rows.

    ``out[s, c] = max(x[rows[i], c] for i in range(cu_rows[s], cu_rows[s + 1]))``; 0 where a segment is empty.

    Args:
        x: features [N, C], floating point; 16-bit ones are computed in float32.
        rows: int64 [R], the rows of segment 0, then of segment 1, ...; each row at most once.
        cu_rows: int64 [M + 1], ascending offsets into ``rows`` from 0 to at most R; rows listed behind are in none.
        check: look for numbers that cannot be used, on the CPU; a model that guards its numbers itself leaves it out.
    Returns:
        [M, C], dtype of ``x``.
    Gradients:
        ``x``, to any order and in forward mode; of equal maxima the one listed first receives it.
    Raises:
        NumericalError: a number of ``x`` is not finite or beyond 1e15 (float64: 1e150); CPU only.
        ValueError, TypeError: an argument is malformed; the message names it. CUDA does not look into the index lists:
            rows out of range take no part.
    Source:
        grid pooling of Point Transformer V2/V3 (Wu et al. 2022, 2024).

    Example:
        >>> x = torch.tensor([[1.0], [5.0], [3.0]])
        >>> pool_max(x, torch.tensor([0, 1, 2]), torch.tensor([0, 2, 3]))
        tensor([[5.],
                [3.]])
    """
    if check:
        _check("pool_max", x, rows, cu_rows)
    return as_given(call("pool_max", widened(x), rows, cu_rows)[0], x)


def pool_mean(x: Tensor, rows: Tensor, cu_rows: Tensor, *, check: bool = True) -> Tensor:
    """Mean over segments of rows; 0 where a segment is empty.

    Args:
        x, rows, cu_rows, check: as in :func:`pool_max`.
    Returns:
        [M, C], dtype of ``x``.
    Gradients:
        ``x``, to any order and in forward mode.
    Raises:
        NumericalError, ValueError, TypeError: as :func:`pool_max`.

    Example:
        >>> pool_mean(torch.tensor([[1.0], [5.0]]), torch.tensor([0, 1]), torch.tensor([0, 2]))
        tensor([[3.]])
    """
    if check:
        _check("pool_mean", x, rows, cu_rows)
    return as_given(call("pool_mean", widened(x), rows, cu_rows), x)


def unpool(x: Tensor, rows: Tensor, cu_rows: Tensor, n_rows: int, *, check: bool = True) -> Tensor:
    """Copies each segment's features to the segment's rows: the adjoint of a segment sum.

    Args:
        x: features [M, C] of the segments.
        rows, cu_rows, check: as in :func:`pool_max`.
        n_rows: N, rows of the result.
    Returns:
        [N, C]; rows that no segment lists are 0.
    Gradients:
        ``x``, to any order and in forward mode; summed in the order of ``rows``, so equal bits for any number of
        threads.

    Example:
        >>> unpool(torch.tensor([[7.0]]), torch.tensor([1, 0]), torch.tensor([0, 2]), 3)
        tensor([[7.],
                [7.],
                [0.]])
    """
    if check:
        check_whole("unpool", n_rows=n_rows)
        _check("unpool", x, rows, cu_rows)
    out = within_memory("unpool", f"n_rows={n_rows}", call, "unpool", widened(x), rows, cu_rows, n_rows)
    return as_given(out, x)


def _check(op: str, x: Tensor, rows: Tensor, cu_rows: Tensor) -> None:
    check_tensors(op, x=x, rows=rows, cu_rows=cu_rows)
    check_numbers(op, x=x)


def _maxima(x, rows, cu_rows):
    shape = (cu_rows.shape[0] - 1, x.shape[1])
    return x.new_empty(shape), x.new_empty(shape, dtype=torch.int64)


def _of_segments(x, rows, cu_rows, *_):
    return x.new_empty(cu_rows.shape[0] - 1, x.shape[1])


def _of_rows(x, *lists_and_n_rows):
    return x.new_empty(lists_and_n_rows[-1], x.shape[1])


fakes(
    pool_max=_maxima,
    pool_max_backward=_of_rows,
    pool_mean=_of_segments,
    pool_mean_backward=_of_rows,
    unpool=_of_rows,
    unpool_backward=_of_segments,
)

# Each op below is linear in its features, once the rows of maxima are known; a gradient is an op of this list again.


def _setup_lists(ctx, inputs, output):
    x, rows, cu_rows, *_ = inputs
    ctx.save_for_backward(rows, cu_rows)
    ctx.n_rows = x.shape[0]


def _pool_max_setup(ctx, inputs, output):
    ctx.set_materialize_grads(False)
    ctx.save_for_backward(output[1])
    ctx.mark_non_differentiable(output[1])
    ctx.n_rows = inputs[0].shape[0]


def _pool_max_backward(ctx, grad, _grad_argmax):
    if grad is None:
        return None, None, None
    return call("pool_max_backward", grad, ctx.saved_tensors[0], ctx.n_rows), None, None


def _at_maxima(x: Tensor, argmax: Tensor) -> Tensor:
    return torch.where(argmax < 0, 0, x.gather(0, argmax.clamp(min=0)) if x.shape[0] else 0)


def _pool_max_jvp(inputs, tangents, outputs):
    return None if tangents[0] is None else _at_maxima(tangents[0], outputs[1]), None


def _of_max_setup(ctx, inputs, output):
    ctx.save_for_backward(inputs[1])


def _of_max_backward(ctx, grad):
    return _at_maxima(grad, ctx.saved_tensors[0]), None, None


def _of_max_batched(size, inputs, is_batched):
    (grad, argmax), n_rows = expanded(size, inputs[:2], is_batched[:2]), inputs[2]
    first = n_rows * torch.arange(size, device=argmax.device)[:, None, None]
    argmax = torch.where(argmax < 0, argmax, argmax + first)
    grad_x = call("pool_max_backward", grad.flatten(0, 1), argmax.flatten(0, 1), size * n_rows)
    return grad_x.unflatten(0, (size, n_rows))


def _linear_jvp(op):
    return lambda inputs, tangents, outputs: call(op, tangents[0], *inputs[1:])


def _folded_segments(size: int, rows: Tensor, cu_rows: Tensor, n_rows: int) -> tuple[Tensor, Tensor]:
    """Segments of ``size`` matrices of ``n_rows`` rows, one below the other; each has one more, of the rows in none."""
    entry = torch.arange(size, device=rows.device)[:, None]
    last = rows.new_full((1,), size * rows.shape[0])
    return (rows + n_rows * entry).flatten(), torch.cat([(cu_rows + rows.shape[0] * entry).flatten(), last])


def _batched_lists(op, has_segments: bool, gives_segments: bool):
    """Matrices in one call, one below the other. ``has_segments``, ``gives_segments``: x, out have a row a segment."""

    def batched(size, inputs, is_batched):
        if any(is_batched[1:]):
            return one_by_one(op)(size, inputs, is_batched)
        x, rows, cu_rows, *n_rows = inputs
        n = n_rows[0] if n_rows else x.shape[1]
        x = F.pad(x, (0, 0, 0, 1)) if has_segments else x
        lists = _folded_segments(size, rows, cu_rows, n)
        result = call(op, x.flatten(0, 1), *lists, *(size * n for n in n_rows))
        out = (result[0] if isinstance(result, tuple) else result).unflatten(0, (size, -1))
        out = out[:, :-1] if gives_segments else out
        if not isinstance(result, tuple):
            return out
        argmax = result[1].unflatten(0, (size, -1))[:, :-1]
        first = n * torch.arange(size, device=rows.device)[:, None, None]
        return out, torch.where(argmax < 0, argmax, argmax - first)

    return batched


def _to_rows(op: str):
    """The gradient of sums over segments, or of means: ``op``."""
    return lambda ctx, grad: (call(op, grad, *ctx.saved_tensors, ctx.n_rows), None, None)


def _to_segments(op: str):
    return lambda ctx, grad: (call(op, grad, *ctx.saved_tensors), None, None, None)


_batched = _batched_lists("pool_max", False, True)
register_gradients("pool_max", _pool_max_backward, _pool_max_setup, jvp=_pool_max_jvp, batched=_batched)
_of_max = "pool_max_backward"
register_gradients(_of_max, _of_max_backward, _of_max_setup, jvp=_linear_jvp(_of_max), batched=_of_max_batched)
for _op, _backward, _has_segments in (
    ("pool_mean", _to_rows("pool_mean_backward"), False),
    ("pool_mean_backward", _to_segments("pool_mean"), True),
    ("unpool", _to_segments("unpool_backward"), True),
    ("unpool_backward", _to_rows("unpool"), False),
):
    _batched = _batched_lists(_op, _has_segments, not _has_segments)
    register_gradients(_op, _backward, _setup_lists, jvp=_linear_jvp(_op), batched=_batched)
for _op in ("pool_max", "pool_mean", "unpool", "unpool_backward"):
    register_autocast(_op, "float32")
