"""Rotation of spherical harmonics as in the published model."""

import torch
from torch import Tensor
from torch.nn import functional as F

from gsim3d.math.spherical_harmonics import rotate_harmonics

AXIS_LIMIT = 1 - 1e-6  # clamp of the axis components from which the published model derives Euler angles


def rotate_released_harmonics(sh: Tensor, rotations: Tensor) -> Tensor:
    """Rotates predicted coefficients [N, K, C] to world space by ``rotations`` [N, 3, 3] as published weights expect.

    Coefficients are in the published basis (polar axis y), but are rotated by matrices of another sign convention, so
    colours do not rotate with the particle. Rotations are kept 1e-3 rad away from those about the y axis.
    """
    return rotate_unpaired_harmonics(sh, clamp_polar_axis(rotations))


def clamp_polar_axis(rotations: Tensor) -> Tensor:
    """Rebuilds ``rotations`` [N, 3, 3] from Euler angles (y, x, y) whose axis ``R y`` is clamped to (-1, 1).

    Keeps 1.4e-3 rad away from rotations that map the y axis to itself. Uses sines and cosines, because angles have zero
    or infinite gradients where the axis is clamped.
    """
    axis = F.normalize(rotations[..., 1], dim=-1).clamp(-AXIS_LIMIT, AXIS_LIMIT)
    x, y, z = axis.unbind(-1)
    first = _about_y(*_unit_or_first(z, x)) @ _about_x(y, ((1 - y) * (1 + y)).sqrt())
    rest = first.mT @ rotations
    return first @ _about_y(*_unit_or_first(rest[..., 0, 0], rest[..., 0, 2]))


def _unit_or_first(c: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
    """Normalises (c, s) to length 1; returns (1, 0), without gradient, where the length is 0."""
    squared = c * c + s * s
    short = squared < torch.finfo(c.dtype).tiny
    length = torch.where(short, 1, squared).sqrt()
    return torch.where(short, 1, c / length), torch.where(short, 0, s / length)


def _about_y(c: Tensor, s: Tensor) -> Tensor:
    zero, one = torch.zeros_like(c), torch.ones_like(c)
    return torch.stack([c, zero, s, zero, one, zero, -s, zero, c], -1).unflatten(-1, (3, 3))


def _about_x(c: Tensor, s: Tensor) -> Tensor:
    zero, one = torch.zeros_like(c), torch.ones_like(c)
    return torch.stack([one, zero, zero, zero, c, -s, zero, s, c], -1).unflatten(-1, (3, 3))


def rotate_unpaired_harmonics(sh: Tensor, rotations: Tensor) -> Tensor:
    """Rotates ``sh`` as the published model does; takes its basis, returns the standard basis.

    The published basis is the standard one evaluated at (z, x, y). It differs from that of the published rotation
    matrices by alternating signs, which the published model omits.
    """
    permute = published_axes(rotations)
    signs = torch.pow(-1.0, torch.arange(sh.shape[1], device=sh.device)).to(sh)[:, None]
    turned = signs * rotate_harmonics(signs * sh, permute @ rotations @ permute.mT)
    return rotate_harmonics(turned, permute.mT.expand_as(rotations))


def published_axes(like: Tensor) -> Tensor:
    """Returns the permutation [3, 3] from (x, y, z) to (z, x, y), the argument of published harmonics."""
    return torch.eye(3, dtype=like.dtype, device=like.device)[[2, 0, 1]]
