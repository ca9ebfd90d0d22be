"""Spring-mass dynamics of Spring-Gaus: anchors, springs to fixed neighbours, a ground plane, and bound Gaussians.

Source: Zhong et al. 2024, "Reconstruction and Simulation of Elastic Objects with Spring-Mass 3D Gaussians". Where paper
and published program differ, the program is followed.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional as F
from torch.utils.checkpoint import checkpoint

from gsim3d.errors import InputError, NumericalError

GRAVITY = 9.8  # m/s^2
FIRM = 16  # nearest neighbours, whose springs are never softened
SLACK = 1e-6  # metres of extension that count as 0
TINY = 1e-14
MOST_SUBSTEPS = 500


@dataclass(frozen=True)
class Springs:
    """Anchors at rest and the springs between them."""

    rest: Tensor  #: [N, 3] metres, positions at frame 0
    neighbors: Tensor  #: int64 [N, k], the nearest other anchors, nearest first; a directed graph
    lengths: Tensor  #: [N, k] metres, rest lengths


class SpringState(NamedTuple):
    """What moves."""

    positions: Tensor  #: [N, 3] metres
    velocities: Tensor  #: [N, 3] m/s


def build_springs(points: Tensor, *, n_anchors: int, n_neighbors: int, edge: float, seed: int) -> Springs:
    """Returns the springs of an object.

    Anchors are the centres of occupied voxels of ``points``, at most ``n_anchors``, drawn without replacement.

    Args:
        points: [P, 3] metres, points inside the object.
        n_anchors: largest number of anchors.
        n_neighbors: springs of each anchor, fewer if there are fewer anchors.
        edge: metres, of a voxel; a tenth of it if there are fewer occupied voxels than anchors.
        seed: of the draw.

    Raises:
        InputError: the points occupy a single voxel.
    """
    for size in (edge, edge / 10):
        cells = torch.unique(torch.floor(points.detach().double() / size), dim=0)
        if len(cells) >= n_anchors:
            break
    if len(cells) < 2:
        raise InputError(f"build_springs: the points occupy {len(cells)} voxel of {size:g} m; give a smaller edge")
    chosen = torch.randperm(len(cells), generator=torch.Generator().manual_seed(seed))[:n_anchors].sort().values
    rest = ((cells[chosen.to(cells.device)] + 0.5) * size).to(points.dtype)
    distances, neighbors = torch.cdist(rest, rest).fill_diagonal_(math.inf).sort(dim=1, stable=True)
    k = min(n_neighbors, len(rest) - 1)
    return Springs(rest, neighbors[:, :k].contiguous(), distances[:, :k].contiguous())


def bind(points: Tensor, rest: Tensor, count: int = 16) -> tuple[Tensor, Tensor]:
    """Returns indices int64 [P, K] of the nearest anchors of each point and weights [P, K] that sum to 1.

    Weights are proportional to ``distance ** -0.5``; points follow ``(weights[..., None] * anchors[indices]).sum(1)``.
    """
    distances, indices = torch.cdist(points, rest).topk(min(count, len(rest)), largest=False)
    weights = 1 / (distances.sqrt() + TINY)
    return indices, weights / weights.sum(1, keepdim=True)


def softness(shape: Tensor, k: int) -> Tensor:
    """Returns [k] factors in [0, 1] of the springs to neighbours 0 to k - 1; ``shape`` [] shortens their reach."""
    far = max(0, k - FIRM)
    ranks = torch.arange(far, dtype=shape.dtype, device=shape.device) / max(1, far)
    soft = (2 - torch.exp(F.softplus(shape) * ranks)).clamp(0, 1)
    return torch.cat([soft.new_ones(k - far), soft])


def friction(parameter: Tensor) -> Tensor:
    """Returns the factor of the tangential velocity at the ground in each substep, in [0, 1]; 1 is frictionless."""
    return (1.2 * parameter.sigmoid() - 0.1).clamp(0, 1)


def accelerations(
    state: SpringState, springs: Springs, stiffness: Tensor, factors: Tensor, damping: Tensor | float, power: float
) -> Tensor:
    """Returns the acceleration [N, 3] in m/s^2 of each anchor (mass 1) by its own springs, without gravity."""
    apart = state.positions[springs.neighbors] - state.positions[:, None]
    lengths = apart.square().sum(-1).clamp_min(TINY**2).sqrt()
    along = apart / (lengths + TINY)[..., None]
    extension = lengths - springs.lengths
    extension = torch.where(extension.abs() < SLACK, 0.0, extension)
    pull = stiffness[:, None] / springs.lengths * factors * extension
    if power:
        pull = pull * (1 + (lengths / springs.lengths - 1).abs()) ** power
    faster = ((state.velocities[springs.neighbors] - state.velocities[:, None]) * along).sum(-1)
    return ((pull + damping / springs.lengths * faster)[..., None] * along).sum(1)


def advance_frame(
    state: SpringState,
    springs: Springs,
    *,
    stiffness: Tensor,
    factors: Tensor,
    damping: Tensor | float,
    grip: Tensor | float,
    seconds: float,
    substeps: int,
    ground: float | None,
    gravity: float = GRAVITY,
    power: float = 0.5,
) -> SpringState:
    """Returns the state one frame later: semi-implicit Euler, ``substeps`` times.

    An anchor at or below the ground is set onto it; its vertical velocity ends, the tangential one is scaled.

    Args:
        state: positions and velocities.
        springs: anchors and springs.
        stiffness: [N] of the springs of each anchor.
        factors: [k], see :func:`softness`.
        damping: of the velocity along a spring.
        grip: see :func:`friction`; applied in each substep.
        seconds: length of the frame.
        substeps: number of substeps.
        ground: metres, its height along z; None: there is none.
        gravity: m/s^2 along -z.
        power: of the strain that stiffens a spring.

    Gradients:
        state, stiffness, factors, damping and grip; each substep is computed again in the backward pass.
    """
    h = seconds / substeps
    down = state.positions.new_tensor([0.0, 0.0, -gravity])

    def substep(x: Tensor, v: Tensor, stiffness: Tensor, factors: Tensor) -> tuple[Tensor, Tensor]:
        v = v + h * (accelerations(SpringState(x, v), springs, stiffness, factors, damping, power) + down)
        x = x + h * v
        if ground is not None:
            touching = x[:, 2:] <= ground
            v = torch.where(touching, torch.cat([grip * v[:, :2], torch.zeros_like(v[:, 2:])], 1), v)
            x = torch.cat([x[:, :2], x[:, 2:].clamp_min(ground)], 1)
        return x, v

    x, v = state
    for _ in range(substeps):
        if torch.is_grad_enabled():
            x, v = checkpoint(substep, x, v, stiffness, factors, use_reentrant=False)
        else:
            x, v = substep(x, v, stiffness, factors)
    return SpringState(x, v)


def advance_safely(frame: int, substeps: int, more: int, **given) -> tuple[SpringState, int]:
    """Returns :func:`advance_frame` with ``more`` substeps as often as a number is not finite, and their number.

    Raises:
        NumericalError: it is not finite with the most substeps; the message names ``frame``.
    """
    while True:
        state = advance_frame(substeps=substeps, **given)
        if all(bool(part.isfinite().all()) for part in state):
            return state, substeps
        if substeps + more > MOST_SUBSTEPS:
            raise NumericalError(f"spring-gaus: frame {frame} is not finite with {substeps} substeps")
        substeps += more
