"""Turning rotations and spherical harmonics from the camera's frame into the world's."""

import torch
import torch.nn.functional as F
from torch import Tensor

from gsim3d.harmonics import rotate_harmonics, rotate_unpaired_harmonics


def rotation_of_harmonics(rotations: Tensor, degree: int, released: bool) -> Tensor:
    """[I, 3, 3] -> [I, K, K]: turns coefficients of colours seen in the cameras' frames into the world.

    released: the published model's way, which reads them in a basis of its own and keeps 1e-3 rad away from turns about
    the y axis.
    """
    n_harmonics = (degree + 1) ** 2
    each = torch.eye(n_harmonics, dtype=rotations.dtype, device=rotations.device).repeat(len(rotations), 1, 1)
    if released:
        return rotate_unpaired_harmonics(each, _clamped_rotation(rotations))
    return rotate_harmonics(each, rotations)


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
