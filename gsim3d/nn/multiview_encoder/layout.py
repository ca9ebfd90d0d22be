"""Memory formats of feature maps on a GPU: one copy brings them there, in the precision in which they are read.

Convolutions read channels-last, group norms channels-first. By themselves both would copy other formats, apart from
every change of precision, and again in the backward pass.
"""

import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from gsim3d.nn.layers import product_dtype


def for_convolution(x: Tensor) -> Tensor:
    """``x`` [N, C, H, W] as a convolution reads it; on the CPU as it is."""
    return _Relaid.apply(x, product_dtype(x), torch.channels_last) if _matters(x) else x


def by_pixel(x: Tensor) -> Tensor:
    """``x`` [N, C, H, W] as convolutions on a GPU write it, in its own precision; on the CPU as it is."""
    return _Relaid.apply(x, x.dtype, torch.channels_last) if _matters(x) else x


class GroupNorm(nn.GroupNorm):
    """torch's, on input in its memory format."""

    def forward(self, x: Tensor) -> Tensor:
        return super().forward(_Relaid.apply(x, self.weight.dtype, torch.contiguous_format) if _matters(x) else x)


def two_convolutions(dim: int, hidden: int, out_dim: int) -> nn.Sequential:
    """3x3 convolutions with GELU between them."""
    return nn.Sequential(nn.Conv2d(dim, hidden, 3, 1, 1), nn.GELU(), nn.Conv2d(hidden, out_dim, 3, 1, 1))


def _matters(x: Tensor) -> bool:
    return x.is_cuda and not torch.compiler.is_compiling()


class _Relaid(torch.autograd.Function):
    """``x.to(dtype, memory_format=...)``, whose gradient has the memory format of ``x``."""

    @staticmethod
    def forward(ctx, x: Tensor, dtype: torch.dtype, memory_format: torch.memory_format) -> Tensor:
        by_pixel = x.dim() == 4 and x.is_contiguous(memory_format=torch.channels_last)
        ctx.dtype, ctx.format = x.dtype, torch.channels_last if by_pixel else torch.contiguous_format
        return x.to(dtype, memory_format=memory_format)

    @staticmethod
    @once_differentiable
    def backward(ctx, grad: Tensor) -> tuple[Tensor, None, None]:
        return grad.to(ctx.dtype, memory_format=ctx.format), None, None
