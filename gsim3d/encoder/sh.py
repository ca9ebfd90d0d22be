"""Turning rotations and spherical harmonics from the camera's frame into the world's."""

import math

import torch
import torch.nn.functional as F
from torch import Tensor

N_DIRECTIONS = 64  # on which rotated harmonics are matched; 16 independent ones would do


def sh_basis(directions: Tensor, degree: int) -> Tensor:
    """[..., 3] unit directions -> [..., (degree + 1)^2], the real basis of 3D Gaussian splatting, degree at most 3."""
    x, y, z = directions.unbind(-1)
    xx, yy, zz = x * x, y * y, z * z
    basis = [torch.full_like(x, 0.28209479177387814)]
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


def degree_damping(degree: int, like: Tensor) -> Tensor:
    """[(degree + 1)^2]: 1 for the constant, then 0.1 / 4^l, so that colour starts out almost independent of the view."""
    levels = torch.arange((degree + 1) ** 2, device=like.device).double().sqrt().floor()
    return torch.where(levels == 0, 1.0, 0.1 * 0.25**levels).to(like.dtype)


def rotation_of_harmonics(rotations: Tensor, degree: int, released: bool) -> Tensor:
    """[I, 3, 3] float64 -> [I, K, K]: coefficients seen in the turned frame, in the standard basis.

    released: turn and read coefficients as the published model does, whose basis has permuted axes and whose rotation
    ignores the signs of that basis and keeps 1e-3 rad away from turns about the y axis.
    """
    i = torch.arange(N_DIRECTIONS, dtype=torch.float64, device=rotations.device) + 0.5
    z, angle = 1 - 2 * i / N_DIRECTIONS, math.pi * (1 + 5**0.5) * i
    radius = (1 - z * z).sqrt()
    directions = torch.stack([radius * angle.cos(), radius * angle.sin(), z], -1)
    read_standard = torch.linalg.pinv(sh_basis(directions, degree))
    if not released:
        return read_standard @ sh_basis(directions @ rotations, degree)
    permuted = directions[:, [2, 0, 1]]
    turned = (directions @ _clamped_rotation(rotations))[..., [2, 0, 1]]
    signs = torch.pow(-1.0, torch.arange((degree + 1) ** 2, device=rotations.device)).double()
    turn = torch.linalg.pinv(sh_basis(permuted, degree)) @ sh_basis(turned, degree)
    return read_standard @ sh_basis(permuted, degree) @ (signs[:, None] * turn * signs)


def _clamped_rotation(rotations: Tensor) -> Tensor:
    """The rotation as rebuilt from Y-X-Y Euler angles whose axis is clamped to stay inside (-1, 1)."""
    axis = F.normalize(rotations[..., 1], dim=-1).clamp(-1 + 1e-6, 1 - 1e-6)
    alpha, beta = torch.atan2(axis[..., 0], axis[..., 2]), axis[..., 1].acos()
    first = _about_y(alpha) @ _about_x(beta)
    rest = first.mT @ rotations
    return first @ _about_y(torch.atan2(rest[..., 0, 2], rest[..., 0, 0]))


def _about_y(angle: Tensor) -> Tensor:
    c, s, zero, one = angle.cos(), angle.sin(), torch.zeros_like(angle), torch.ones_like(angle)
    return torch.stack([c, zero, s, zero, one, zero, -s, zero, c], -1).unflatten(-1, (3, 3))


def _about_x(angle: Tensor) -> Tensor:
    c, s, zero, one = angle.cos(), angle.sin(), torch.zeros_like(angle), torch.ones_like(angle)
    return torch.stack([one, zero, zero, zero, c, -s, zero, s, c], -1).unflatten(-1, (3, 3))


def rotation_to_quat(rotations: Tensor) -> Tensor:
    """[..., 3, 3] -> [..., 4] unit quaternions (w, x, y, z), from the largest component, which divides safely."""
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = (row.unbind(-1) for row in rotations.unbind(-2))
    rows = torch.stack(
        [
            torch.stack([1 + xx + yy + zz, zy - yz, xz - zx, yx - xy], -1),
            torch.stack([zy - yz, 1 + xx - yy - zz, xy + yx, xz + zx], -1),
            torch.stack([xz - zx, xy + yx, 1 - xx + yy - zz, yz + zy], -1),
            torch.stack([yx - xy, xz + zx, yz + zy, 1 - xx - yy + zz], -1),
        ],
        -2,
    )
    largest = rows.diagonal(dim1=-2, dim2=-1).argmax(-1)
    chosen = rows.gather(-2, largest[..., None, None].expand(*largest.shape, 1, 4))[..., 0, :]
    return F.normalize(chosen, dim=-1)


def quat_multiply(a: Tensor, b: Tensor) -> Tensor:
    """[..., 4] x [..., 4], (w, x, y, z): first b, then a."""
    aw, ax, ay, az = a.unbind(-1)
    bw, bx, by, bz = b.unbind(-1)
    return torch.stack(
        [
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ],
        -1,
    )
