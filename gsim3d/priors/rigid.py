"""Rigid motions and planes that fit particles within windows."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from gsim3d.state import constant

SQUARINGS = 10  # of a matrix: what is left is its largest eigenvalue's, to the power 2^10
SMALLEST = 1e-30  # of what is divided by
STIFFNESS = 1e-5  # against turning, relative to the window's size: a point and a line do not turn
STRAIGHT = 1e-4  # radians: a smaller turn has an arc as long as its chord
THINNEST = 1e-3  # of a window's size, squared: no plane is thinner


class RigidFit:
    """Least squares of rigid motions, for ``positions`` [B, S, 3] weighted by each of ``window`` [B, G, S].

    Attributes:
        center: [B, G, 3] of the particles in the window.
        inertia: [B, G, 3, 3] about it, over their mass.
    """

    def __init__(self, window: Tensor, positions: Tensor, radius: float):
        self.window, self.positions, self.center = window, positions, window @ positions
        products = (positions[:, :, :, None] * positions[:, :, None]).flatten(2)
        scatter = (window @ products).unflatten(2, (3, 3)) - self.center[:, :, :, None] * self.center[:, :, None]
        size = scatter.diagonal(dim1=2, dim2=3).sum(2)[:, :, None, None] + STIFFNESS * radius**2
        self.inertia = size * torch.eye(3, device=size.device, dtype=size.dtype) - scatter

    def fit(self, paths: Tensor) -> tuple[Tensor, Tensor]:
        """The displacement of the center and the spin (rad), both [B, G, 3], of ``paths`` [B, S, 3]."""
        moved = self.window @ paths
        impulse = self.window @ torch.linalg.cross(self.positions, paths) - torch.linalg.cross(self.center, moved)
        return moved, solve3(self.inertia, impulse)


def next_displacement(positions: Tensor, velocity: Tensor, spin: Tensor, center: Tensor) -> Tensor:
    """[B, N, 3], the displacement in the next step of rigid motions that go on, at ``positions`` [B, N, 3]."""
    turning, angle = torch.linalg.cross(spin, positions - center), _size(spin)
    towards_axis = 0.5 * torch.sinc(angle / (2 * math.pi)).square() * torch.linalg.cross(spin, turning)
    return velocity + torch.sinc(angle / math.pi) * turning + towards_axis


def spin_of(fitted: Tensor) -> Tensor:
    """[B, G, 3] rad, the spins whose fit to paths of positions halfway is ``fitted``: chords of a turn are those of
    twice the tangent of its half."""
    tangent = 0.5 * _size(fitted)
    return torch.atan(tangent) / tangent * fitted


def _size(spin: Tensor) -> Tensor:
    """[..., 1] rad; not less than ``STRAIGHT``."""
    return spin.square().sum(-1, keepdim=True).clamp(min=STRAIGHT**2).sqrt()


def solve3(matrices: Tensor, values: Tensor) -> Tensor:
    """The solutions [..., 3] of symmetric systems [..., 3, 3], by Cramer's rule, which a graph can capture."""
    a, b, c = matrices.unbind(-2)
    rows = torch.linalg.cross(b, c), torch.linalg.cross(c, a), torch.linalg.cross(a, b)
    determinant = (a * rows[0]).sum(-1, keepdim=True)
    return torch.stack([(row * values).sum(-1) for row in rows], -1) / determinant


def best_rotation(products: Tensor) -> Tensor:
    """Rotations [..., 3, 3] that take vectors nearest to others, from sums [..., 3, 3] of their outer products, the
    others first.

    Where several rotations are as good, as for points on a line, the result is their mean and no rotation; for sums of
    nothing it is 0.

    Source:
        Horn 1987: the rotation of the eigenvector q of a symmetric 4 x 4 matrix with the largest eigenvalue; powers of
        the matrix become q q^T, whose entries make up the rotation.
    """
    of_quats = constant(OF_QUATS, products.device).to(products.dtype).unflatten(0, (9, 16))
    matrix = (products.flatten(-2) @ of_quats).unflatten(-1, (4, 4))
    one = torch.eye(4, dtype=products.dtype, device=products.device)
    matrix = matrix + matrix.square().sum((-2, -1), keepdim=True).sqrt() * one  # no eigenvalue is below 0
    return (largest_eigenspace(matrix).flatten(-2) @ of_quats.T).unflatten(-1, (3, 3))


def largest_eigenspace(matrices: Tensor) -> Tensor:
    """v v^T [..., n, n] of the unit eigenvector v with the largest eigenvalue of symmetric matrices [..., n, n] without
    negative ones, by a high power of the matrix. For several as large it is their mean; for zeros it is 0."""
    for _ in range(2):  # numbers stay far from the smallest
        matrices = _of_trace_one(matrices)
        for _ in range(SQUARINGS // 2):
            matrices = matrices @ matrices
    return _of_trace_one(matrices)


def _of_trace_one(matrices: Tensor) -> Tensor:
    return matrices / matrices.diagonal(dim1=-2, dim2=-1).sum(-1)[..., None, None].clamp(min=SMALLEST)


def _of_quats() -> tuple[int, ...]:
    """9 x 16: each entry of the matrix of a unit quaternion q = (w, x, y, z) as a sum of the entries of q q^T."""
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
    """The center and the unit normal, both [B, M, 3], of the planes through ``points`` [B, S, 3] weighted by each of
    ``window`` [B, M, S], of ``radius`` metres; normals have either sign, and that of nothing is 0."""
    center = window @ points
    products = (points[:, :, :, None] * points[:, :, None]).flatten(2)
    scatter = (window @ products).unflatten(2, (3, 3)) - center[:, :, :, None] * center[:, :, None]
    # Rounded products (TF32) of large coordinates may have a trace below 0; the other norm bounds all eigenvalues then.
    size = torch.maximum(scatter.diagonal(dim1=2, dim2=3).sum(2), scatter.square().sum((2, 3)).sqrt())
    size = size[:, :, None, None] + THINNEST * radius**2
    across = largest_eigenspace(size * torch.eye(3, dtype=size.dtype, device=size.device) - scatter)
    longest = across.diagonal(dim1=2, dim2=3).argmax(2)[:, :, None, None].expand(-1, -1, 1, 3)
    normal = across.gather(2, longest)[:, :, 0]
    return center, normal / normal.norm(dim=2, keepdim=True).clamp(min=SMALLEST)
