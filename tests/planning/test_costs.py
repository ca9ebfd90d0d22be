"""Costs of planners against their definitions, and their gradients."""

import torch

from gsim3d.planning import costs

POSITIONS = torch.rand(3, 4, 5, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
TARGET = torch.rand(5, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(1))


def test_the_distance_of_the_centroid():
    centers = POSITIONS.mean(2)
    expected = [sum((c - TARGET[0]).norm() for c in path) / 4 + (path[-1] - TARGET[0]).norm() for path in centers]
    assert torch.allclose(costs.center_distance(POSITIONS, TARGET[0]), torch.stack(expected))


def test_chamfer_ignores_order_and_counts():
    shuffled = TARGET[[3, 1, 0, 4, 2]].expand(1, 1, 5, 3)
    assert costs.chamfer(shuffled, TARGET).item() < 1e-12
    nearest = [min(float((a - b).norm()) for b in TARGET[:2]) for a in POSITIONS[0, -1]]
    back = [min(float((a - b).norm()) for b in POSITIONS[0, -1]) for a in TARGET[:2]]
    expected = sum(nearest) / 5 + sum(back) / 2
    assert abs(costs.chamfer(POSITIONS[:1], TARGET[:2]).item() - expected) < 1e-9


def test_costs_are_differentiable():
    given = POSITIONS.clone().requires_grad_()
    assert torch.autograd.gradcheck(lambda p: costs.chamfer(p, TARGET), given)
    assert torch.autograd.gradcheck(lambda p: costs.center_distance(p, TARGET[0]), given)
    assert torch.autograd.gradcheck(lambda images: costs.image_distance(images, POSITIONS[0]), given)
    assert costs.image_distance(POSITIONS + 0.5, POSITIONS[1])[1].item() == 0.25
