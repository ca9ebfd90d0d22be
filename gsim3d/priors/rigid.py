"""Weighted least-squares fits of rigid motions, rotations and planes to particles."""

import math

import torch
from torch import Tensor

from gsim3d.state import constant

SQUARINGS = 10  # power iteration by squaring: the matrix to the power 2^10
SMALLEST = 1e-30  # smallest divisor
STIFFNESS = 1e-5  # regularisation of the inertia, over radius^2: points and lines do not rotate
STRAIGHT = 1e-4  # smallest angle in rad
THINNEST = 1e-3  # regularisation of the scatter matrix of a plane, over radius^2


class RigidFit:
    """Least-squares fit of rigid motions of ``positions`` [B, S, 3] with the weights ``window`` [B, G, S].

    Attributes:
        center: weighted mean [B, G, 3].
        inertia: inertia tensor about the center over the mass, [B, G, 3, 3].
    """

    def __init__(self, window: Tensor, positions: Tensor, radius: float):
        self.window, self.positions, self.center = window, positions, window @ positions
        products = (positions[:, :, :, None] * positions[:, :, None]).flatten(2)
        scatter = (window @ products).unflatten(2, (3, 3)) - self.center[:, :, :, None] * self.center[:, :, None]
        size = scatter.diagonal(dim1=2, dim2=3).sum(2)[:, :, None, None] + STIFFNESS * radius**2
        self.inertia = size * torch.eye(3, device=size.device, dtype=size.dtype) - scatter

    def fit(self, paths: Tensor) -> tuple[Tensor, Tensor]:
        """Fits displacements ``paths`` [B, S, 3]. Returns translation and spin (rad), [B, G, 3] each."""
        moved = self.window @ paths
        impulse = self.window @ torch.linalg.cross(self.positions, paths) - torch.linalg.cross(self.center, moved)
        return moved, solve3(self.inertia, impulse)


def next_displacement(positions: Tensor, velocity: Tensor, spin: Tensor, center: Tensor) -> Tensor:
    """Displacement [B, N, 3] of ``positions`` in the next step, if rigid motions (all [B, N, 3]) continue."""
    turning, angle = torch.linalg.cross(spin, positions - center), _size(spin)
    towards_axis = 0.5 * torch.sinc(angle / (2 * math.pi)).square() * torch.linalg.cross(spin, turning)
    return velocity + torch.sinc(angle / math.pi) * turning + towards_axis


def spin_of(fitted: Tensor) -> Tensor:
    """Spin [B, G, 3] in rad from ``fitted``, the fit of displacements at their midpoints: the chord of a rotation by
    angle a, at its midpoint, has the slope 2 tan(a / 2)."""
    tangent = 0.5 * _size(fitted)
    return torch.atan(tangent) / tangent * fitted


def _size(spin: Tensor) -> Tensor:
    """Angle [..., 1] in rad, at least ``STRAIGHT``."""
    return spin.square().sum(-1, keepdim=True).clamp(min=STRAIGHT**2).sqrt()


def solve3(matrices: Tensor, values: Tensor) -> Tensor:
    """Solves symmetric systems [..., 3, 3] for [..., 3] by Cramer's rule, which CUDA graphs can capture."""
    a, b, c = matrices.unbind(-2)
    rows = torch.linalg.cross(b, c), torch.linalg.cross(c, a), torch.linalg.cross(a, b)
    determinant = (a * rows[0]).sum(-1, keepdim=True)
    return torch.stack([(row * values).sum(-1) for row in rows], -1) / determinant


def best_rotation(products: Tensor) -> Tensor:
    """Rotations R [..., 3, 3] that minimise ``sum |b - R a|^2``, from ``products`` = sum b a^T [..., 3, 3].

    If the minimum is not unique, as for points on a line, the result is the mean of the minima and no rotation. For
    zero products it is 0.

    Source:
        Horn 1987: the unit quaternion q is the eigenvector of a symmetric 4 x 4 matrix with the largest eigenvalue.
        Powers of the matrix converge to q q^T, whose entries give the rotation.
    """
    of_quats = constant(OF_QUATS, products.device).to(products.dtype).unflatten(0, (9, 16))
    matrix = (products.flatten(-2) @ of_quats).unflatten(-1, (4, 4))
    one = torch.eye(4, dtype=products.dtype, device=products.device)
    matrix = matrix + matrix.square().sum((-2, -1), keepdim=True).sqrt() * one  # makes it positive semidefinite
    return (largest_eigenspace(matrix).flatten(-2) @ of_quats.T).unflatten(-1, (3, 3))


def largest_eigenspace(matrices: Tensor) -> Tensor:
    """Projection v v^T on the eigenvector v with the largest eigenvalue of positive semidefinite matrices [..., n, n].

    Computed by repeated squaring. A multiple eigenvalue gives the mean of its projections, a zero matrix gives 0.
    """
    for _ in range(2):  # twice, against underflow
        matrices = _of_trace_one(matrices)
        for _ in range(SQUARINGS // 2):
            matrices = matrices @ matrices
    return _of_trace_one(matrices)


def _of_trace_one(matrices: Tensor) -> Tensor:
    return matrices / matrices.diagonal(dim1=-2, dim2=-1).sum(-1)[..., None, None].clamp(min=SMALLEST)


def _of_quats() -> tuple[int, ...]:
    """Matrix 9 x 16 from the entries of q q^T to those of the rotation of the unit quaternion q = (w, x, y, z)."""
    ww, xx, yy, zz = 0, 5, 10, 15
    wx, wy, wz, xy, xz, yz = ((1, 4), (2, 8), (3, 12), (6, 9), (7, 13), (11, 14))
    sums = [
        ((ww, xx), (yy, zz)), (xy, wz), ((*xz, *wy), ()),
        ((*xy, *wz), ()), ((ww, yy), (xx, zz)), (yz, wx),
        (xz, wy), ((*yz, *wx), ()), ((ww, zz), (xx, yy)),
    ]  # fmt: skip
    return tuple((k in added) - (k in taken) for added, taken in sums for k in range(16))


OF_QUATS = _of_quats()


def fit_planes(window: Tensor, points: Tensor, radius: float) -> tuple[Tensor, Tensor]:
    """Fits planes to ``points`` [B, S, 3] by PCA with the weights ``window`` [B, M, S], of ``radius`` metres.

    Returns:
        Center and unit normal, [B, M, 3] each. Normals have an arbitrary sign, and are 0 for zero weights.
    """
    center = window @ points
    products = (points[:, :, :, None] * points[:, :, None]).flatten(2)
    scatter = (window @ products).unflatten(2, (3, 3)) - center[:, :, :, None] * center[:, :, None]
    # With TF32, the trace of large coordinates may round below 0; the Frobenius norm then bounds the eigenvalues.
    size = torch.maximum(scatter.diagonal(dim1=2, dim2=3).sum(2), scatter.square().sum((2, 3)).sqrt())
    size = size[:, :, None, None] + THINNEST * radius**2
    across = largest_eigenspace(size * torch.eye(3, dtype=size.dtype, device=size.device) - scatter)
    longest = across.diagonal(dim1=2, dim2=3).argmax(2)[:, :, None, None].expand(-1, -1, 1, 3)
    normal = across.gather(2, longest)[:, :, 0]
    return center, normal / normal.norm(dim=2, keepdim=True).clamp(min=SMALLEST)
