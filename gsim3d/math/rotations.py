"""Rotations as quaternions (w, x, y, z) and as matrices."""

import torch
from torch import Tensor
from torch.nn import functional as F

MIN_QUAT_NORM = 1e-6  # a shorter quaternion has no direction worth a gradient

SMALL_ANGLE_SQUARED = 1e-8  # radians^2; smaller rotations are their series: a square root has no gradient at 0


def unit_quats(quats: Tensor) -> Tensor:
    """[..., 4] normalised; the identity, without a gradient, where shorter than 1e-6."""
    short = quats.detach().norm(dim=-1, keepdim=True) < MIN_QUAT_NORM
    identity = torch.zeros_like(quats)
    identity[..., 0] = 1
    quats = torch.where(short, identity, quats)
    return quats / quats.norm(dim=-1, keepdim=True)


def quat_product(a: Tensor, b: Tensor) -> Tensor:
    """[..., 4]: the rotation ``b``, then ``a``."""
    aw, av, bw, bv = a[..., :1], a[..., 1:], b[..., :1], b[..., 1:]
    return torch.cat([aw * bw - (av * bv).sum(-1, keepdim=True), aw * bv + bw * av + torch.linalg.cross(av, bv)], -1)


def rotation_to_quat(rotations: Tensor) -> Tensor:
    """[..., 3, 3] -> [..., 4] unit quaternions (w, x, y, z), from the largest component, which divides safely."""
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = (row.unbind(-1) for row in rotations.unbind(-2))
    rows = [
        [1 + xx + yy + zz, zy - yz, xz - zx, yx - xy],
        [zy - yz, 1 + xx - yy - zz, xy + yx, xz + zx],
        [xz - zx, xy + yx, 1 - xx + yy - zz, yz + zy],
        [yx - xy, xz + zx, yz + zy, 1 - xx - yy + zz],
    ]
    rows = torch.stack([torch.stack(row, -1) for row in rows], -2)
    largest = rows.diagonal(dim1=-2, dim2=-1).argmax(-1)
    chosen = rows.gather(-2, largest[..., None, None].expand(*largest.shape, 1, 4))[..., 0, :]
    return F.normalize(chosen, dim=-1)


def with_positive_largest(quats: Tensor) -> Tensor:
    """[..., 4], of the two quaternions of each rotation the one whose largest component is positive."""
    largest = quats.detach().gather(-1, quats.detach().abs().argmax(-1, keepdim=True))
    return torch.where(largest < 0, -quats, quats)


def rotation_matrices(quats: Tensor) -> Tensor:
    """Unit quaternions [N, 4] (w, x, y, z) -> [N, 3, 3]."""
    w, x, y, z = quats.unbind(1)
    rows = [
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip
    return torch.stack(rows, 1).unflatten(1, (3, 3))


def rotate_left(quats: Tensor, rotation_vectors: Tensor) -> Tensor:
    """Unit quaternions of ``quats`` turned further about world axes: exp(v) q.

    Of the two quaternions of a rotation the result is the one whose largest component is positive: the network reads
    quaternions, and should see one rotation as one.

    Args:
        quats: [N, 4] (w, x, y, z), any length; shorter than 1e-6 counts as the identity and has no gradient.
        rotation_vectors: [N, 3] radians, world axes.
    """
    angle_squared = rotation_vectors.square().sum(1, keepdim=True)
    small = angle_squared < SMALL_ANGLE_SQUARED
    angle = torch.where(small, 1.0, angle_squared).sqrt()
    # sin(angle / 2) / angle and cos(angle / 2), by their series where the quotient would lose its gradient
    ratio = torch.where(small, 0.5 - angle_squared / 48, torch.sin(angle / 2) / angle)
    w = torch.where(small, 1 - angle_squared / 8, torch.cos(angle / 2))
    v = ratio * rotation_vectors
    return with_positive_largest(quat_product(torch.cat([w, v], 1), unit_quats(quats)))
