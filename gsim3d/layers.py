"""Layers over packed rows: a row's result has the same bits whatever rows are packed with it.

(Batch normalisation in training is the exception.) Gradients repeat bit by bit on the same number of threads; how BLAS
splits the rows of a matrix product over threads is its own affair.
"""

from __future__ import annotations

import torch
import torch.distributed
import torch.distributed.nn.functional
from torch import Tensor, nn
from torch.nn import functional as F

from gsim3d.ops import row_norm

MIN_ROWS = 16  # matrix products of fewer rows go through other code in BLAS, which rounds differently


def row_linear(x: Tensor, weight: Tensor, bias: Tensor | None) -> Tensor:
    """``F.linear`` of [N, C]."""
    n_rows = x.shape[0]
    if n_rows >= MIN_ROWS:
        return F.linear(x, weight, bias)
    return F.linear(F.pad(x, (0, 0, 0, MIN_ROWS - n_rows)), weight, bias)[:n_rows]


class RowLinear(nn.Linear):
    """``nn.Linear`` of [N, C]."""

    def forward(self, x: Tensor) -> Tensor:
        return row_linear(x, self.weight, self.bias)


def rounded_weights(module: nn.Module, dtype: torch.dtype) -> tuple[Tensor, ...]:
    """``module.weight`` and ``module.bias`` in ``dtype``, without gradients.

    The copies are kept and made again, in the same memory, once a weight has changed: a simulation rounds its weights
    once. Changes are noticed as autograd notices them, so not those made through ``weight.data``.
    """
    tensors = module.weight, module.bias
    if module.weight.dtype == dtype:
        return tensors
    if module.weight.is_cuda and torch.cuda.is_current_stream_capturing():
        return tuple(t.detach().to(dtype) for t in tensors)  # part of the graph: made at each replay
    key = (dtype, *(key for t in tensors for key in (t.data_ptr(), t._version)))
    known, copies = module.__dict__.get("_rounded", (None, ()))
    if known == key:
        return copies
    with torch.inference_mode(False), torch.no_grad():
        if known is not None and known[0] == dtype and copies[0].device == module.weight.device:
            torch._foreach_copy_(copies, tensors)
        else:
            copies = tuple(t.to(dtype) for t in tensors)
    module.__dict__["_rounded"] = key, copies
    return copies


class RowLayerNorm(nn.LayerNorm):
    """``nn.LayerNorm`` of [N, C], and the residual sum behind it; see :func:`gsim3d.ops.row_norm`."""

    def forward(self, x: Tensor, residual: Tensor | None = None) -> Tensor:
        return row_norm(x, self.weight, self.bias, residual, eps=self.eps, check=False)


class RowBatchNorm(nn.Module):
    """Normalises each channel by statistics over rows; running statistics in evaluation.

    Differs from ``nn.BatchNorm1d`` in three ways: one row or none is fine (running statistics are then kept),
    statistics are float32 or wider, and processes combine theirs in the order of their ranks, so a run repeats bit by bit.
    """

    EPS = 1e-3
    MOMENTUM = 0.01

    def __init__(self, channels: int):
        super().__init__()
        self.weight = nn.Parameter(torch.ones(channels))
        self.bias = nn.Parameter(torch.zeros(channels))
        self.register_buffer("running_mean", torch.zeros(channels))
        self.register_buffer("running_var", torch.ones(channels))

    def forward(self, x: Tensor) -> Tensor:
        if not self.training:
            return self._normalise(x, self.running_mean, self.running_var)
        mean, var, n_rows = _statistics(widened(x))
        with torch.no_grad():
            rate = self.MOMENTUM * (n_rows > 1).to(self.running_var)
            self.running_mean.lerp_(mean.to(self.running_mean), rate)
            unbiased = var * n_rows / (n_rows - 1).clamp(min=1)
            self.running_var.lerp_(unbiased.to(self.running_var), rate)
        return self._normalise(x, mean, var)

    def _normalise(self, x: Tensor, mean: Tensor, var: Tensor) -> Tensor:
        scale = self.weight * torch.rsqrt(var + self.EPS)
        return (x - mean) * scale + self.bias


def _statistics(x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Mean and biased variance of each column over the rows of all processes, and the number of rows."""
    n_rows = x.new_full((), x.shape[0])
    mean = x.sum(0) / n_rows.clamp(min=1)
    spread = (x - mean).square().sum(0)
    if torch.distributed.is_available() and torch.distributed.is_initialized():
        mine = torch.cat([n_rows[None], mean, spread])
        n_rows, mean, spread = _combine(torch.distributed.nn.functional.all_gather(mine), x.shape[1])
    return mean, spread / n_rows.clamp(min=1), n_rows


def _combine(parts: tuple[Tensor, ...], n_channels: int) -> tuple[Tensor, Tensor, Tensor]:
    """Row counts, means and sums of squared deviations of several processes as one, added in the order given."""
    counts, means, spreads = zip(*(part.split([1, n_channels, n_channels]) for part in parts), strict=True)
    n_rows = sum(counts).clamp(min=1)
    mean = sum(count * mean for count, mean in zip(counts, means, strict=True)) / n_rows
    between = sum(count * (part - mean).square() for count, part in zip(counts, means, strict=True))
    return sum(counts)[0], mean, sum(spreads) + between


def widened(x: Tensor) -> Tensor:
    """What 16-bit layers computed, as float32: positions, depths and all that is added up over steps are never 16-bit."""
    return x.float() if x.dtype in (torch.float16, torch.bfloat16) else x


def make_norm(kind: str, channels: int) -> nn.Module:
    """"layer" or "batch"."""
    return RowLayerNorm(channels) if kind == "layer" else RowBatchNorm(channels)


def exact_convolutions():
    """A context in which a GPU's dense convolutions are float32 proper (no TF32) and repeat bit by bit."""
    return torch.backends.cudnn.flags(enabled=True, benchmark=False, deterministic=True, allow_tf32=False)
