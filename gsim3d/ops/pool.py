"""Grid pooling and unpooling: segment reductions of feature rows, and the way back."""

import torch
from torch import Tensor
from torch.nn import functional as F

from gsim3d.ops._arguments import as_given, check_numbers, check_tensors, check_whole, widened, within_memory
from gsim3d.ops._register import call, fake, folded_segments, one_by_one, register_autocast, register_gradients


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
        check_tensors("pool_max", x=x, rows=rows, cu_rows=cu_rows)
        check_numbers("pool_max", x=x)
    return as_given(call("pool_max", widened(x), rows, cu_rows)[0], x)


def pool_mean(x: Tensor, rows: Tensor, cu_rows: Tensor, *, check: bool = True) -> Tensor:
    """Mean over segments of rows; 0 where a segment is empty.

    Args:
        x: features [N, C], floating point; 16-bit ones are computed in float32.
        rows: int64 [R], as in :func:`pool_max`.
        cu_rows: int64 [M + 1], as in :func:`pool_max`.
        check: as in :func:`pool_max`.
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
        check_tensors("pool_mean", x=x, rows=rows, cu_rows=cu_rows)
        check_numbers("pool_mean", x=x)
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
        check_tensors("unpool", x=x, rows=rows, cu_rows=cu_rows)
        check_whole("unpool", n_rows=n_rows)
        check_numbers("unpool", x=x)
    out = within_memory("unpool", f"n_rows={n_rows}", call, "unpool", widened(x), rows, cu_rows, n_rows)
    return as_given(out, x)


@fake("pool_max")
def _(x, rows, cu_rows):
    shape = (cu_rows.shape[0] - 1, x.shape[1])
    return x.new_empty(shape), x.new_empty(shape, dtype=torch.int64)


@fake("pool_max_backward")
def _(grad, argmax, n_rows):
    return grad.new_empty(n_rows, grad.shape[1])


@fake("pool_mean")
def _(x, rows, cu_rows):
    return x.new_empty(cu_rows.shape[0] - 1, x.shape[1])


@fake("pool_mean_backward")
def _(grad, rows, cu_rows, n_rows):
    return grad.new_empty(n_rows, grad.shape[1])


@fake("unpool")
def _(x, rows, cu_rows, n_rows):
    return x.new_empty(n_rows, x.shape[1])


@fake("unpool_backward")
def _(grad, rows, cu_rows):
    return grad.new_empty(cu_rows.shape[0] - 1, grad.shape[1])


# Each op below is linear in its features, once the rows of maxima are known; a gradient is an op of this list again.


def _first(x: Tensor, is_batched: bool, size: int) -> Tensor:
    return x if is_batched else x.expand(size, *x.shape)


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


def _pool_max_gradient_setup(ctx, inputs, output):
    ctx.save_for_backward(inputs[1])


def _pool_max_gradient_backward(ctx, grad):
    return _at_maxima(grad, ctx.saved_tensors[0]), None, None


def _pool_max_gradient_batched(size, inputs, is_batched):
    (grad, argmax), n_rows = map(_first, inputs[:2], is_batched, (size, size)), inputs[2]
    first = n_rows * torch.arange(size, device=argmax.device)[:, None, None]
    argmax = torch.where(argmax < 0, argmax, argmax + first)
    grad_x = call("pool_max_backward", grad.flatten(0, 1), argmax.flatten(0, 1), size * n_rows)
    return grad_x.unflatten(0, (size, n_rows))


def _linear_jvp(op):
    return lambda inputs, tangents, outputs: call(op, tangents[0], *inputs[1:])


def _batched_lists(op, has_segments: bool, gives_segments: bool):
    """Matrices in one call, one below the other. ``has_segments``, ``gives_segments``: x, out have a row a segment."""

    def batched(size, inputs, is_batched):
        if any(is_batched[1:]):
            return one_by_one(op)(size, inputs, is_batched)
        x, rows, cu_rows, *n_rows = inputs
        n = n_rows[0] if n_rows else x.shape[1]
        x = F.pad(x, (0, 0, 0, 1)) if has_segments else x
        lists = folded_segments(size, rows, cu_rows, n)
        result = call(op, x.flatten(0, 1), *lists, *(size * n for n in n_rows))
        out = (result[0] if isinstance(result, tuple) else result).unflatten(0, (size, -1))
        out = out[:, :-1] if gives_segments else out
        if not isinstance(result, tuple):
            return out
        argmax = result[1].unflatten(0, (size, -1))[:, :-1]
        first = n * torch.arange(size, device=rows.device)[:, None, None]
        return out, torch.where(argmax < 0, argmax, argmax - first)

    return batched


def _unpool_backward(ctx, grad):
    return call("unpool_backward", grad, *ctx.saved_tensors), None, None, None


def _segment_sum_backward(ctx, grad):
    return call("unpool", grad, *ctx.saved_tensors, ctx.n_rows), None, None


def _pool_mean_backward(ctx, grad):
    return call("pool_mean_backward", grad, *ctx.saved_tensors, ctx.n_rows), None, None


def _pool_mean_gradient_backward(ctx, grad):
    return call("pool_mean", grad, *ctx.saved_tensors), None, None, None


register_gradients(
    "pool_max",
    _pool_max_backward,
    _pool_max_setup,
    jvp=_pool_max_jvp,
    batched=_batched_lists("pool_max", False, True),
)
register_gradients(
    "pool_max_backward",
    _pool_max_gradient_backward,
    _pool_max_gradient_setup,
    jvp=_linear_jvp("pool_max_backward"),
    batched=_pool_max_gradient_batched,
)
for _op, _backward, _has_segments in (
    ("pool_mean", _pool_mean_backward, False),
    ("pool_mean_backward", _pool_mean_gradient_backward, True),
    ("unpool", _unpool_backward, True),
    ("unpool_backward", _segment_sum_backward, False),
):
    register_gradients(
        _op,
        _backward,
        _setup_lists,
        jvp=_linear_jvp(_op),
        batched=_batched_lists(_op, _has_segments, not _has_segments),
    )
for _op in ("pool_max", "pool_mean", "unpool", "unpool_backward"):
    register_autocast(_op, "float32")
