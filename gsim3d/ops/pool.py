"""Grid pooling and unpooling: segment reductions of feature rows, and the way back."""

import torch
from torch import Tensor

from gsim3d.ops._arguments import check_numbers, check_tensors, check_whole, within_memory
from gsim3d.ops._register import fake, register_autocast, register_gradients


def pool_max(x: Tensor, rows: Tensor, cu_rows: Tensor, *, check: bool = True) -> Tensor:
    """Channelwise maximum over segments of rows.

    ``out[s, c] = max(x[rows[i], c] for i in range(cu_rows[s], cu_rows[s + 1]))``; 0 where a segment is empty.

    Args:
        x: features [N, C], float32 or float64.
        rows: int64 [R], the rows of segment 0, then of segment 1, ...; each row at most once.
        cu_rows: int64 [M + 1], ascending offsets into ``rows`` from 0 to at most R; rows listed behind are in none.
        check: look for numbers that cannot be used, on the CPU; a model that guards its numbers itself leaves it out.
    Returns:
        [M, C], dtype of ``x``.
    Gradients:
        ``x``, once; of equal maxima the one listed first receives it.
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
    return torch.ops.gsim3d.pool_max(x, rows, cu_rows)[0]


def pool_mean(x: Tensor, rows: Tensor, cu_rows: Tensor, *, check: bool = True) -> Tensor:
    """Mean over segments of rows; 0 where a segment is empty.

    Args:
        x: features [N, C], float32 or float64.
        rows: int64 [R], as in :func:`pool_max`.
        cu_rows: int64 [M + 1], as in :func:`pool_max`.
        check: as in :func:`pool_max`.
    Returns:
        [M, C], dtype of ``x``.
    Gradients:
        ``x``, once.
    Raises:
        NumericalError, ValueError, TypeError: as :func:`pool_max`.

    Example:
        >>> pool_mean(torch.tensor([[1.0], [5.0]]), torch.tensor([0, 1]), torch.tensor([0, 2]))
        tensor([[3.]])
    """
    if check:
        check_tensors("pool_mean", x=x, rows=rows, cu_rows=cu_rows)
        check_numbers("pool_mean", x=x)
    return torch.ops.gsim3d.pool_mean(x, rows, cu_rows)


def unpool(x: Tensor, rows: Tensor, cu_rows: Tensor, n_rows: int, *, check: bool = True) -> Tensor:
    """Copies each segment's features to the segment's rows: the adjoint of a segment sum.

    Args:
        x: features [M, C] of the segments.
        rows, cu_rows, check: as in :func:`pool_max`.
        n_rows: N, rows of the result.
    Returns:
        [N, C]; rows that no segment lists are 0.
    Gradients:
        ``x``, once; summed in the order of ``rows``, so equal bits for any number of threads.

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
    kernel = torch.ops.gsim3d.unpool
    return within_memory("unpool", f"n_rows={n_rows}", kernel, x, rows, cu_rows, n_rows)


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


def _pool_max_setup(ctx, inputs, output):
    ctx.set_materialize_grads(False)
    ctx.save_for_backward(output[1])
    ctx.mark_non_differentiable(output[1])
    ctx.n_rows = inputs[0].shape[0]


def _pool_max_backward(ctx, grad, _grad_argmax):
    if grad is None:
        return None, None, None
    return torch.ops.gsim3d.pool_max_backward(grad, ctx.saved_tensors[0], ctx.n_rows), None, None


def _pool_mean_setup(ctx, inputs, output):
    x, rows, cu_rows = inputs
    ctx.save_for_backward(rows, cu_rows)
    ctx.n_rows = x.shape[0]


def _pool_mean_backward(ctx, grad):
    return torch.ops.gsim3d.pool_mean_backward(grad, *ctx.saved_tensors, ctx.n_rows), None, None


def _unpool_setup(ctx, inputs, output):
    ctx.save_for_backward(inputs[1], inputs[2])


def _unpool_backward(ctx, grad):
    return torch.ops.gsim3d.unpool_backward(grad, *ctx.saved_tensors), None, None, None


register_gradients("pool_max", _pool_max_backward, _pool_max_setup, gradient_ops=["pool_max_backward"])
register_gradients("pool_mean", _pool_mean_backward, _pool_mean_setup, gradient_ops=["pool_mean_backward"])
register_gradients("unpool", _unpool_backward, _unpool_setup, gradient_ops=["unpool_backward"])
for _op in ("pool_max", "pool_mean", "unpool"):
    register_autocast(_op, "float32")
