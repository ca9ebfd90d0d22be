"""Rotations as quaternions, from the camera's frame into the world's."""

import torch
import torch.nn.functional as F
from torch import Tensor


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


def with_positive_largest(quats: Tensor) -> Tensor:
    """[..., 4], of the two quaternions of each rotation the one whose largest component is positive."""
    largest = quats.detach().gather(-1, quats.detach().abs().argmax(-1, keepdim=True))
    return torch.where(largest < 0, -quats, quats)
