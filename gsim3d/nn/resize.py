"""Resizing of maps as two matrix products, whose gradients need no atomics and repeat bit by bit."""

import functools
from typing import Literal

import torch
from torch import Tensor

CUBIC = -0.75  # slope of the cubic kernel at distance 1, as of torch's own

Kind = Literal["linear", "corners", "cubic"]


def resize(x: Tensor, size: tuple[int, int], kind: Kind = "linear", offset: float = 0.0) -> Tensor:
    """Returns maps [..., h, w] at another size (height, width), in their dtype, also under autocast.

    "linear" averages over the pixels that a smaller pixel covers; "corners" aligns the centres of the outermost pixels;
    "cubic" is bicubic, without averaging. ``offset`` is added to ``size`` where it gives the scale.
    """
    if tuple(x.shape[-2:]) == tuple(size):
        return x
    rows, cols = (_weights(n, m, kind, offset, x.dtype, x.device) for n, m in zip(x.shape[-2:], size, strict=True))
    with torch.autocast(x.device.type, enabled=False):
        return rows @ (x @ cols.mT)


@functools.cache
def _weights(n: int, m: int, kind: Kind, offset: float, dtype: torch.dtype, device: torch.device) -> Tensor:
    """[m, n], by which ``n`` pixels become ``m``."""
    with torch.inference_mode(False):
        index = torch.arange(m, dtype=torch.float64)
        if kind == "corners":
            at, width = index * ((n - 1) / max(m - 1, 1)), 1.0
        else:
            step = n / (m + offset)
            at, width = (index + 0.5) * step - 0.5, max(step, 1.0)
        if kind != "cubic":
            distance = (at.clamp(0, n - 1)[:, None] - torch.arange(n)).abs() / width
            weights = (1 - distance).clamp(min=0)
            return (weights / weights.sum(1, keepdim=True)).to(device, dtype)
        taps = at.floor().long()[:, None] + torch.arange(-1, 3)
        weights, distance = torch.zeros(m, n, dtype=torch.float64), (at[:, None] - taps).abs()
        near = ((CUBIC + 2) * distance - (CUBIC + 3)) * distance**2 + 1
        far = ((distance - 5) * distance + 8) * distance * CUBIC - 4 * CUBIC
        cubic = torch.where(distance <= 1, near, torch.where(distance < 2, far, 0))
        return weights.scatter_add_(1, taps.clamp(0, n - 1), cubic).to(device, dtype)
