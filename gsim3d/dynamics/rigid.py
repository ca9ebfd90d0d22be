"""Rigid motions that fit the paths of matter within windows: at the nodes of a lattice, and between them."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from gsim3d.dynamics.samples import grouped, ungrouped
from gsim3d.state import constant

SQUARINGS = 10  # of a matrix: what is left is its largest eigenvalue's, to the power 2^10
NODES = 6  # of the lattice that spans the movable rows of a scene, along each axis
SMALLEST = 1e-30  # of what is divided by
STIFFNESS = 1e-3  # against turning, relative to the window's size: a point and a line do not turn
LITTLE = 1e-5  # likewise, of paths that are known: what it takes of a spin it takes in every step
STRAIGHT = 1e-4  # radian: a smaller turn has an arc as long as its chord


class Lattice:
    """nodes: [B, G, 3] that span ``places`` [B, S, 3], those that are ``known`` [B, S]."""

    def __init__(self, places: Tensor, known: Tensor):
        here = known[:, :, None]
        low, high = (side * torch.where(here, side * places, torch.inf).amin(1, keepdim=True) for side in (1, -1))
        self._low, high = (torch.where(x.isfinite(), x, 0) for x in (low, high))
        self._size = high - self._low
        self._ticks = torch.linspace(0, 1, NODES, device=low.device, dtype=low.dtype)
        unit = torch.stack(torch.meshgrid(self._ticks, self._ticks, self._ticks, indexing="ij"), -1).flatten(0, 2)
        self.nodes = self._low + unit * self._size

    def at(self, places: Tensor, *values: Tensor) -> tuple[Tensor, ...]:
        """[B, N, 3] at ``places`` [B, N, 3], of each of ``values`` [B, G, 3].

        A product with the share of every node: on a GPU its gradient has a fixed order, that of grid_sample has not.
        """
        place = ((places - self._low) / self._size.clamp(min=1e-6)).clamp(0, 1)
        place, field = grouped(place, torch.cat(values, 2))
        x, y, z = (1 - (NODES - 1) * (place[..., None] - self._ticks).abs()).clamp(min=0).unbind(2)
        shares = (x[..., :, None, None] * y[..., None, :, None] * z[..., None, None, :]).flatten(2)
        return ungrouped(shares @ field, places).split(3, 2)


class RigidFit:
    """Of rows at ``places`` [B, S, 3], as far as each window [B, G, S] counts them.

    centre: [B, G, 3] of the rows in the window.   inertia: [B, G, 3, 3] about it, over their mass.
    """

    def __init__(self, window: Tensor, places: Tensor, length: float, stiffness: float = STIFFNESS):
        self.window, self.places, self.centre = window, places, window @ places
        products = (places[:, :, :, None] * places[:, :, None]).flatten(2)
        scatter = (window @ products).unflatten(2, (3, 3)) - self.centre[:, :, :, None] * self.centre[:, :, None]
        size = scatter.diagonal(dim1=2, dim2=3).sum(2)[:, :, None, None] + stiffness * length**2
        self.inertia = size * torch.eye(3, device=size.device, dtype=size.dtype) - scatter

    def fit(self, paths: Tensor) -> tuple[Tensor, Tensor]:
        """How far the centre moved and the spin (rad), both [B, G, 3], of ``paths`` [B, S, 3]."""
        moved = self.window @ paths
        impulse = self.window @ torch.linalg.cross(self.places, paths) - torch.linalg.cross(self.centre, moved)
        return moved, solved(self.inertia, impulse)


def onward_at(places: Tensor, velocity: Tensor, spin: Tensor, centre: Tensor) -> Tensor:
    """[B, N, 3], what comes next at ``places`` of rigid motions there, [B, N, 3] all of them, however far they turn."""
    turning, angle = torch.linalg.cross(spin, places - centre), _size(spin)
    towards_axis = 0.5 * torch.sinc(angle / (2 * math.pi)).square() * torch.linalg.cross(spin, turning)
    return velocity + torch.sinc(angle / math.pi) * turning + towards_axis


def spin_of(fitted: Tensor) -> Tensor:
    """[B, G, 3] rad, of the spins that :class:`RigidFit` finds in paths of the places halfway: the chords of a turn are
    those of twice the tangent of its half."""
    tangent = 0.5 * _size(fitted)
    return torch.atan(tangent) / tangent * fitted


def _size(spin: Tensor) -> Tensor:
    """[..., 1] rad; not less than ``STRAIGHT``."""
    return spin.square().sum(-1, keepdim=True).clamp(min=STRAIGHT**2).sqrt()


def solved(matrices: Tensor, values: Tensor) -> Tensor:
    """The solutions [..., 3] of symmetric systems [..., 3, 3], by Cramer's rule: a graph can capture it."""
    a, b, c = matrices.unbind(-2)
    rows = torch.linalg.cross(b, c), torch.linalg.cross(c, a), torch.linalg.cross(a, b)
    determinant = (a * rows[0]).sum(-1, keepdim=True)
    return torch.stack([(row * values).sum(-1) for row in rows], -1) / determinant


def turned_most(products: Tensor) -> Tensor:
    """Rotations [..., 3, 3] that take vectors nearest to others, of sums [..., 3, 3] of their products, those of the
    others first (Horn, 1987).

    The rotation is that of the eigenvector q of a symmetric 4 x 4 matrix with the largest eigenvalue: powers of the
    matrix become q q^T, whose entries a rotation is made of. Where several are as good, as for points on a line, it is
    the mean of them and no rotation; of no products it is 0.
    """
    of_quats = constant(OF_QUATS, products.device).to(products.dtype).unflatten(0, (9, 16))
    matrix = (products.flatten(-2) @ of_quats).unflatten(-1, (4, 4))
    one = torch.eye(4, dtype=products.dtype, device=products.device)
    matrix = matrix + matrix.square().sum((-2, -1), keepdim=True).sqrt() * one  # no eigenvalue is below 0
    return (of_largest(matrix).flatten(-2) @ of_quats.T).unflatten(-1, (3, 3))


def of_largest(matrices: Tensor) -> Tensor:
    """v v^T [..., n, n] of the eigenvector v of length 1 with the largest eigenvalue of symmetric matrices [..., n, n]
    without negative ones: a high power of the matrix. Of several as large it is the mean; of zeros it is 0."""
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
