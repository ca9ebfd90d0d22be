"""Real spherical harmonics of view-dependent colour: basis, damping, rotation."""

import functools
import math

import torch
from torch import Tensor

MAX_DEGREE = 3
SH_0 = 0.28209479177387814  # the constant of the basis
# Radians between neighbours of the spiral of 2 l + 1 directions on which degree l is read, and where it starts: with
# these the harmonics' values there have condition numbers of 1.4, 2.4 and 3.4.
SPIRALS = {1: (4.32, 0.5), 2: (5.20, 1.0), 3: (4.04, 0.98)}


def sh_basis(directions: Tensor, degree: int) -> Tensor:
    """[..., 3] unit directions -> [..., (degree + 1)^2], the real basis of 3D Gaussian splatting, degree at most 3."""
    x, y, z = directions.unbind(-1)
    xx, yy, zz = x * x, y * y, z * z
    basis = [torch.full_like(x, SH_0)]
    if degree > 0:
        basis += [-0.4886025119029199 * y, 0.4886025119029199 * z, -0.4886025119029199 * x]
    if degree > 1:
        a, b, c = 1.0925484305920792, 0.31539156525252005, 0.5462742152960396
        basis += [a * x * y, -a * y * z, b * (2 * zz - xx - yy), -a * x * z, c * (xx - yy)]
    if degree > 2:
        a, b, c, d = 0.5900435899266435, 2.890611442640554, 0.4570457994644658, 0.3731763325901154
        basis += [-a * y * (3 * xx - yy), b * x * y * z, -c * y * (4 * zz - xx - yy)]
        basis += [d * z * (2 * zz - 3 * xx - 3 * yy), -c * x * (4 * zz - xx - yy)]
        basis += [b / 2 * z * (xx - yy), -a * x * (xx - 3 * yy)]
    return torch.stack(basis, -1)


def painted(sh: Tensor, paint: Tensor) -> Tensor:
    """Coefficients [N, K, 3] of colours that went through the matrices ``paint`` [N, 3, 3]."""
    offset = 0.5 * (paint.sum(2) - 1) / SH_0  # colours are sums of harmonics plus a half
    sh = sh @ paint.mT
    return torch.cat([sh[:, :1] + offset[:, None], sh[:, 1:]], 1)


def lit(sh: Tensor, light: Tensor) -> Tensor:
    """Coefficients [N, K, 3] of colours that are multiplied by ``light`` [N, 3]."""
    offset = 0.5 * (light - 1) / SH_0
    sh = sh * light[:, None]
    return torch.cat([sh[:, :1] + offset[:, None], sh[:, 1:]], 1)


def degree_damping(degree: int, like: Tensor) -> Tensor:
    """[(degree + 1)^2]: 1 for the constant, then 0.1 / 4^l, so that colour starts almost independent of the view."""
    return _damping(degree, like.dtype, like.device)


@functools.lru_cache(maxsize=64)
def _damping(degree: int, dtype: torch.dtype, device: torch.device) -> Tensor:
    values = [0.1 * 0.25**level if level else 1.0 for level in range(degree + 1) for _ in range(2 * level + 1)]
    with torch.inference_mode(False):
        return torch.tensor(values, dtype=dtype, device=device)


def rotate_harmonics(sh: Tensor, rotations: Tensor) -> Tensor:
    """Coefficients of the functions turned along: the new colour in direction ``R d`` is the old one in ``d``.

    Degree by degree: with n_i fixed directions and Y the basis, the turned coefficients are ``Y(R n)^T Y(n)^-T sh``,
    a polynomial in the entries of R. It is exact for every rotation, and smooth.

    Args:
        sh: [N, K, C], K = 1, 4, 9 or 16.
        rotations: [N, 3, 3].
    """
    degree = math.isqrt(sh.shape[1]) - 1
    turned = [sh[:, :1]]
    for level in range(1, degree + 1):
        columns = slice(level**2, (level + 1) ** 2)
        directions, read = _reading(level, sh.dtype, sh.device)
        values = sh_basis(directions @ rotations.mT, level)[..., columns]  # [N, 2 l + 1 directions, 2 l + 1]
        turned.append(values.mT @ (read @ sh[:, columns]))
    return torch.cat(turned, 1)


@functools.lru_cache(maxsize=64)
def _reading(level: int, dtype: torch.dtype, device: torch.device) -> tuple[Tensor, Tensor]:
    """The directions [2 l + 1, 3] on which a degree is read, and what turns their values into coefficients.

    The same tensors at every call, so nothing is sent to the device: read them, never write to them.
    """
    with torch.inference_mode(False), torch.no_grad():
        turn, start = SPIRALS[level]
        i = torch.arange(2 * level + 1, dtype=torch.float64, device="cpu")
        z = (i + start) / (2 * level + 1)
        radius = (1 - z * z).clamp(min=0).sqrt()
        directions = torch.stack([radius * torch.cos(turn * i), radius * torch.sin(turn * i), z], -1)
        read = torch.linalg.inv(sh_basis(directions, level)[:, level**2 :]).T
        return directions.to(device, dtype), read.to(device, dtype)


@functools.lru_cache(maxsize=64)
def readings(dtype: torch.dtype, device: torch.device) -> Tensor:
    """[128]: of degrees 1 to 3 the directions, then what turns values into coefficients; for
    :func:`gsim3d.ops.decode_gaussians`."""
    with torch.inference_mode(False):
        parts = [part.flatten() for level in range(1, MAX_DEGREE + 1) for part in _reading(level, dtype, device)]
        return torch.cat(parts)
