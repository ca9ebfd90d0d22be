"""Float64 references for pooling: a loop over segments, plain torch, differentiable in x."""

import torch
from torch import Tensor


def _segments(rows: Tensor, cu_rows: Tensor) -> list[Tensor]:
    cu = cu_rows.tolist()
    return [rows[begin:end] for begin, end in zip(cu, cu[1:])]


def pool_max(x: Tensor, rows: Tensor, cu_rows: Tensor) -> Tensor:
    """Of equal maxima the first in the list is taken (and gets the gradient)."""
    out = []
    for listed in _segments(rows, cu_rows):
        best = x.new_zeros(x.shape[1])
        for i, row in enumerate(listed.tolist()):
            best = x[row] if i == 0 else torch.where(x[row] > best, x[row], best)
        out.append(best)
    return torch.stack(out) if out else x.new_zeros(0, x.shape[1])


def pool_mean(x: Tensor, rows: Tensor, cu_rows: Tensor) -> Tensor:
    out = [x[listed].sum(0) / max(1, len(listed)) for listed in _segments(rows, cu_rows)]
    return torch.stack(out) if out else x.new_zeros(0, x.shape[1])


def unpool(x: Tensor, rows: Tensor, cu_rows: Tensor, n_rows: int) -> Tensor:
    owner = [-1] * n_rows
    for segment, listed in enumerate(_segments(rows, cu_rows)):
        for row in listed.tolist():
            owner[row] = segment
    zero = x.new_zeros(x.shape[1])
    return torch.stack([x[s] if s >= 0 else zero for s in owner]) if owner else x.new_zeros(0, x.shape[1])
