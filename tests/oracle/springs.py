"""Springs in plain torch, substep by substep; gradients by autograd."""

import math

import torch

SLACK = 1e-6  # metres of extension that count as 0


def pulls(x, v, neighbors, owners, lengths, stiffness, damping, power):
    """Accelerations [N, 3] by springs; ``owners`` [S] feel them."""
    apart, faster = x[neighbors] - x[owners], v[neighbors] - v[owners]
    squared = apart.square().sum(1)
    distance = torch.where(squared > 0, squared, 1.0).sqrt()
    along = apart / distance[:, None]
    extension = distance - lengths
    extension = torch.where(extension.abs() < SLACK, 0.0, extension)
    pull = stiffness * extension * (1 + (distance / lengths - 1).abs()) ** power
    pull = pull + damping * (faster * along).sum(1)
    return torch.zeros_like(x).index_add(0, owners, torch.where(squared > 0, pull, 0.0)[:, None] * along)


def advance(
    x, v, neighbors, cu_springs, *, lengths, stiffness, damping, grip, external, seconds, substeps, ground=None,
    power=0.5,
):  # fmt: skip
    owners = torch.arange(len(x)).repeat_interleave(cu_springs.diff())
    h, height = seconds / substeps, -math.inf if ground is None else ground
    for _ in range(substeps):
        v = v + h * (pulls(x, v, neighbors, owners, lengths, stiffness, damping, power) + external)
        x = x + h * v
        touching = x[:, 2:] <= height
        slowed = torch.cat([grip[:, None] * v[:, :2], torch.zeros_like(v[:, 2:])], 1)
        v = torch.where(touching, slowed, v)
        x = torch.cat([x[:, :2], torch.where(touching, height, x[:, 2:])], 1)
    return x, v
