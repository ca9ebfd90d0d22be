"""How the published model turns spherical harmonics."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional as F

from gsim3d.math.spherical_harmonics import rotate_harmonics

AXIS_LIMIT = 1 - 1e-6  # of each component of the axis from which the published model derives its angles


def rotate_released_harmonics(sh: Tensor, rotations: Tensor) -> Tensor:
    """Predicted coefficients [N, K, C] turned into the world by ``rotations`` [N, 3, 3] as published weights expect it.

    They are in the published basis (the polar axis is y) and turn with matrices of another sign convention, so colours
    do not turn with the particle, by a rotation that keeps 1e-3 rad away from turns about the y axis.
    """
    return rotate_unpaired_harmonics(sh, clamp_polar_axis(rotations))


def clamp_polar_axis(rotations: Tensor) -> Tensor:
    """``rotations`` [N, 3, 3] as rebuilt from Euler angles (y, x, y) whose axis ``R y`` is clamped inside (-1, 1).

    Keeps 1.4e-3 rad away from rotations that map the y axis to itself. Written in sines and cosines: where the axis is
    clamped, angles have no gradient or an infinite one.
    """
    axis = F.normalize(rotations[..., 1], dim=-1).clamp(-AXIS_LIMIT, AXIS_LIMIT)
    x, y, z = axis.unbind(-1)
    first = _about_y(*_unit_or_first(z, x)) @ _about_x(y, ((1 - y) * (1 + y)).sqrt())
    rest = first.mT @ rotations
    return first @ _about_y(*_unit_or_first(rest[..., 0, 0], rest[..., 0, 2]))


def _unit_or_first(c: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
    """(c, s) over its length: cosine and sine of its angle; (1, 0), without a gradient, where it has no length."""
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
    """What the published model does with ``sh`` in its basis: the turned coefficients, in the standard basis.

    Its basis is the standard one of (z, x, y) and equals that of its rotation matrices up to alternating signs, which
    it leaves out.
    """
    permute = published_axes(rotations)
    signs = torch.pow(-1.0, torch.arange(sh.shape[1], device=sh.device)).to(sh)[:, None]
    turned = signs * rotate_harmonics(signs * sh, permute @ rotations @ permute.mT)
    return rotate_harmonics(turned, permute.mT.expand_as(rotations))


def published_axes(like: Tensor) -> Tensor:
    """[3, 3]: (x, y, z) -> (z, x, y), the directions that the published renderer's harmonics are functions of."""
    return torch.eye(3, dtype=like.dtype, device=like.device)[[2, 0, 1]]
