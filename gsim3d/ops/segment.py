"""Sums, minima and softmax over consecutive rows."""

import torch
from torch import Tensor

from gsim3d.ops._arguments import as_given, check_numbers, check_splits, check_tensors, widened
from gsim3d.ops._register import call
from gsim3d.ops.pool import pool_max


def segment_sum(x: Tensor, cu_rows: Tensor, *, check: bool = True) -> Tensor:
    """Sums over segments of consecutive rows; 0 where a segment is empty.

    ``out[s] = sum(x[cu_rows[s]:cu_rows[s + 1]])``. Rows in another order: :func:`pool_mean` takes a list of them.

    Args:
        x: features [N, C], floating point; 16-bit ones are summed in float32.
        cu_rows: int64 [M + 1], ascending offsets from 0 to at most N; rows behind are in none.
        check: as in :func:`pool_max`.
    Returns:
        [M, C], dtype of ``x``.
    Gradients:
        ``x``, to any order and in forward mode.
    Determinism:
        summed in the order of the rows: equal bits for any number of threads.
    Raises:
        NumericalError, ValueError, TypeError: as :func:`pool_max`.

    Example:
        >>> segment_sum(torch.tensor([[1.0], [5.0], [3.0]]), torch.tensor([0, 2, 3]))
        tensor([[6.],
                [3.]])
    """
    if check:
        _check("segment_sum", x, cu_rows)
    return as_given(call("unpool_backward", widened(x), _rows(x), cu_rows), x)


def segment_min(x: Tensor, cu_rows: Tensor, *, check: bool = True) -> Tensor:
    """Channelwise minima over segments of consecutive rows; 0 where a segment is empty.

    Args:
        x: features [N, C], floating point.
        cu_rows, check: as in :func:`segment_sum`.
    Returns:
        [M, C], dtype of ``x``.
    Gradients:
        ``x``, to any order and in forward mode; of equal minima the first row receives it.
    Raises:
        NumericalError, ValueError, TypeError: as :func:`pool_max`.

    Example:
        >>> segment_min(torch.tensor([[1.0], [5.0], [3.0]]), torch.tensor([0, 2, 3]))
        tensor([[1.],
                [3.]])
    """
    if check:
        _check("segment_min", x, cu_rows)
    return 0 - pool_max(-x, _rows(x), cu_rows, check=False)


def segment_softmax(x: Tensor, cu_rows: Tensor, *, check: bool = True) -> Tensor:
    """Softmax of each channel over the rows of a segment; 0 for rows in none.

    Args:
        x: scores [N, C], floating point; 16-bit ones are computed in float32.
        cu_rows, check: as in :func:`segment_sum`.
    Returns:
        [N, C], dtype of ``x``; each channel sums to 1 over the rows of a segment.
    Gradients:
        ``x``, to any order and in forward mode.
    Determinism:
        as :func:`segment_sum`.
    Raises:
        NumericalError, ValueError, TypeError: as :func:`pool_max`.

    Example:
        >>> segment_softmax(torch.tensor([[0.0], [0.0], [7.0]]), torch.tensor([0, 2, 3]))
        tensor([[0.5000],
                [0.5000],
                [1.0000]])
    """
    if check:
        _check("segment_softmax", x, cu_rows)
    wide, rows = widened(x), _rows(x)
    n_rows = x.shape[0]
    # The largest score changes no result, so that it needs no gradient.
    largest = call("pool_max", wide.detach(), rows, cu_rows)[0]
    listed = call("unpool", torch.ones_like(largest), rows, cu_rows, n_rows) > 0
    below = torch.where(listed, wide - call("unpool", largest, rows, cu_rows, n_rows), 0)
    weights = torch.where(listed, below.exp(), 0)
    totals = call("unpool_backward", weights, rows, cu_rows)
    return as_given(weights / torch.where(listed, call("unpool", totals, rows, cu_rows, n_rows), 1), x)


def _rows(x: Tensor) -> Tensor:
    return torch.arange(x.shape[0], device=x.device)


def _check(op: str, x: Tensor, cu_rows: Tensor) -> None:
    check_tensors(op, x=x, cu_rows=cu_rows)
    if x.dim() != 2 or not x.is_floating_point():
        raise ValueError(f"{op}: x must be [N, C], floating point; got {list(x.shape)} {x.dtype}")
    check_splits(op, x.shape[0], to_end=False, cu_rows=cu_rows)
    check_numbers(op, x=x)
