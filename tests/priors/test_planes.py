"""Weighted plane fits."""

import pytest
import torch

from gsim3d.priors.rigid import fit_planes

LENGTH = 0.05  # metres


def _flat(n: int = 200) -> torch.Tensor:
    """Points [1, n, 3] of a horizontal square of 10 cm at a distance of 1 m."""
    points = torch.rand(1, n, 3, generator=torch.Generator().manual_seed(0)) * torch.tensor([0.1, 0.1, 0.0])
    return points + torch.tensor([0.6, -0.5, 0.4])


def test_plane_normal():
    points = _flat()
    window = torch.full((1, 1, 200), 1 / 200)
    middle, normal = fit_planes(window, points, LENGTH)
    torch.testing.assert_close(middle[0, 0], points[0].mean(0))
    assert normal[0, 0, 2].abs() > 0.99


@pytest.mark.parametrize("error", (-1e-2, -1e-3, 1e-3, 1e-2))
def test_plane_normal_with_tf32_rounding(error):
    # Sums of shares that are not 1: what is left of the spread has eigenvalues below 0 then, as rounding leaves them.
    window = torch.full((1, 1, 200), (1 + error) / 200)
    _, normal = fit_planes(window, _flat(), LENGTH)
    torch.testing.assert_close(normal.norm(dim=2), torch.ones(1, 1))
