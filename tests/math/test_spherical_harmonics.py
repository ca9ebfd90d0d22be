"""Spherical harmonics turn with the particle, exactly."""

import numpy as np
import pytest
import torch

from gsim3d.compat.released_harmonics import rotate_unpaired_harmonics
from gsim3d.math.rotations import rotation_matrices, unit_quats
from gsim3d.math.spherical_harmonics import degree_damping, rotate_harmonics, sh_basis
from tests.asserts import assert_close_relative_to_max


def random_rotations(n, seed=0):
    quats = torch.randn(n, 4, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return rotation_matrices(unit_quats(quats))


def directions(n, seed=1):
    d = torch.randn(n, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return torch.nn.functional.normalize(d, dim=1)


def test_basis_is_orthonormal():
    # Gauss-Legendre in z, evenly spaced angles: exact for products of two functions of degree 3
    z, weights = (torch.from_numpy(a) for a in np.polynomial.legendre.leggauss(8))
    angle = torch.arange(16, dtype=torch.float64) * (2 * torch.pi / 16)
    radius = (1 - z * z).sqrt()
    d = torch.stack([radius[:, None] * angle.cos(), radius[:, None] * angle.sin(), z[:, None].expand(8, 16)], -1)
    basis = sh_basis(d, 3).flatten(0, 1)
    gram = (basis * weights.repeat_interleave(16)[:, None]).mT @ basis * (2 * torch.pi / 16)
    assert_close_relative_to_max(gram, torch.eye(16, dtype=torch.float64), 1e-12)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_turned_colour_in_a_turned_direction_is_the_old_colour(degree):
    n, k = 20, (degree + 1) ** 2
    rotations, d = random_rotations(n), directions(n)
    sh = torch.randn(n, k, 3, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    before = torch.einsum("nk,nkc->nc", sh_basis(d, degree), sh)
    turned = (rotations @ d[:, :, None])[..., 0]
    after = torch.einsum("nk,nkc->nc", sh_basis(turned, degree), rotate_harmonics(sh, rotations))
    assert_close_relative_to_max(after, before, 1e-13)


def test_identity_and_composition():
    rotations, others = random_rotations(8), random_rotations(8, seed=5)
    sh = torch.randn(8, 16, 3, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    eye = torch.eye(3, dtype=torch.float64).expand(8, 3, 3)
    assert_close_relative_to_max(rotate_harmonics(sh, eye), sh, 1e-14)
    twice = rotate_harmonics(rotate_harmonics(sh, rotations), others)
    assert_close_relative_to_max(twice, rotate_harmonics(sh, others @ rotations), 1e-13)


def test_gradients():
    rotations, sh = random_rotations(2).requires_grad_(), torch.randn(2, 16, 2, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(rotate_harmonics, (sh, rotations))


def test_unpaired_harmonics_agree_where_nothing_turns_and_differ_elsewhere():
    sh = torch.randn(6, 16, 3, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    permute = torch.eye(3, dtype=torch.float64)[[2, 0, 1]].expand(6, 3, 3)
    eye = torch.eye(3, dtype=torch.float64).expand(6, 3, 3)
    assert_close_relative_to_max(rotate_unpaired_harmonics(sh, eye), rotate_harmonics(sh, permute.mT), 1e-13)
    rotations = random_rotations(6)
    paired = rotate_harmonics(rotate_harmonics(sh, permute.mT), rotations)
    assert (rotate_unpaired_harmonics(sh, rotations) - paired).abs().max() > 0.1


def test_damping():
    assert degree_damping(1, torch.zeros(1)).tolist() == pytest.approx([1, 0.025, 0.025, 0.025])
