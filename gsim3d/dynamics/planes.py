"""Planes that fit rows within windows."""

from __future__ import annotations

import torch
from torch import Tensor

from gsim3d.dynamics.rigid import SMALLEST, of_largest

ROUND = 1e-3  # of the window's size, squared: no plane is thinner


def planes(window: Tensor, points: Tensor, length: float) -> tuple[Tensor, Tensor]:
    """The middle and the unit normal, both [B, M, 3], of the plane through ``points`` [B, S, 3] as far as each window
    [B, M, S] of ``length`` metres counts them; normals have either sign, and that of nothing is 0."""
    middle = window @ points
    products = (points[:, :, :, None] * points[:, :, None]).flatten(2)
    scatter = (window @ products).unflatten(2, (3, 3)) - middle[:, :, :, None] * middle[:, :, None]
    # Rounded products (TF32) of places far away may have a trace below 0; the other norm bounds all eigenvalues then.
    size = torch.maximum(scatter.diagonal(dim1=2, dim2=3).sum(2), scatter.square().sum((2, 3)).sqrt())
    size = size[:, :, None, None] + ROUND * length**2
    across = of_largest(size * torch.eye(3, dtype=size.dtype, device=size.device) - scatter)
    longest = across.diagonal(dim1=2, dim2=3).argmax(2)[:, :, None, None].expand(-1, -1, 1, 3)
    normal = across.gather(2, longest)[:, :, 0]
    return middle, normal / normal.norm(dim=2, keepdim=True).clamp(min=SMALLEST)
