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

from gsim3d.errors import InputError, NumericalError
from gsim3d.ops import SpringLists, advance_springs

GRAVITY = 9.8  # m/s^2
FIRM = 16  # nearest neighbours, whose springs are never softened
TINY = 1e-14
MOST_SUBSTEPS = 500
LARGEST = 1e6  # metres and m/s of a state that is still counted as finite


@dataclass(frozen=True)
class Springs:
    """Anchors at rest, and springs of each to as many of the nearest other anchors; a directed graph."""

    rest: Tensor  #: [N, 3] metres, positions at frame 0
    lengths: Tensor  #: [N, k] metres, rest lengths, shortest first
    lists: SpringLists  #: the springs of anchor 0, then those of anchor 1, ...


class SpringState(NamedTuple):
    """What moves."""

    positions: Tensor  #: [N, 3] metres
    velocities: Tensor  #: [N, 3] m/s


def connect(rest: Tensor, n_neighbors: int) -> Springs:
    """Returns the springs of anchors ``rest`` [N, 3] to ``n_neighbors`` each, fewer if there are fewer anchors."""
    n, k = len(rest), min(n_neighbors, len(rest) - 1)
    neighbors = _distances(rest, rest).fill_diagonal_(math.inf).sort(dim=1, stable=True).indices[:, :k]
    lengths = (rest[neighbors] - rest[:, None]).norm(dim=2)
    offsets = k * torch.arange(n + 1, device=rest.device)
    return Springs(rest, lengths, SpringLists.from_neighbors(neighbors.flatten(), offsets))


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
    return connect(((cells[chosen.to(cells.device)] + 0.5) * size).to(points.dtype), n_neighbors)


def _distances(a: Tensor, b: Tensor) -> Tensor:
    """Distances [A, B], by differences: products would lose those of neighbours far from the origin."""
    return torch.cdist(a, b, compute_mode="donot_use_mm_for_euclid_dist")


def bind(points: Tensor, rest: Tensor, count: int = 16) -> tuple[Tensor, Tensor]:
    """Returns indices int64 [P, K] of the nearest anchors of each point and weights [P, K] that sum to 1.

    Weights are proportional to ``distance ** -0.5``; points follow ``(weights[..., None] * anchors[indices]).sum(1)``.
    """
    distances, indices = _distances(points, rest).topk(min(count, len(rest)), largest=False)
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
    """Returns the state one frame later, by :func:`gsim3d.ops.advance_springs`, with gradients of all tensors.

    Args:
        state: positions and velocities.
        springs: anchors and springs.
        stiffness: [N] of the springs of each anchor.
        factors: [k], see :func:`softness`.
        damping: of the velocity along a spring.
        grip: see :func:`friction`; applied in each substep.
        seconds, substeps, ground, power: of the op.
        gravity: m/s^2 along -z.
    """
    ones = torch.ones_like(springs.rest)
    numbers = {
        "lengths": springs.lengths.flatten(),
        "stiffness": (stiffness[:, None] * factors / springs.lengths).flatten(),
        "damping": (damping / springs.lengths).flatten(),
        "grip": grip * ones[:, 0],
        "external": F.pad(-gravity * ones[:, :1], (2, 0)),
    }
    options = {"seconds": seconds, "substeps": substeps, "ground": ground, "power": power}
    return SpringState(*advance_springs(*state, springs.lists, **numbers, **options))


def advance_safely(frame: int, substeps: int, more: int, **given) -> tuple[SpringState, int]:
    """Returns :func:`advance_frame` with ``more`` substeps as often as a number is not finite, and their number.

    Raises:
        NumericalError: it is not finite with the most substeps; the message names ``frame``.
    """
    while True:
        state = advance_frame(substeps=substeps, **given)
        if bool((torch.stack(state).abs() < LARGEST).all()):
            return state, substeps
        if substeps + more > MOST_SUBSTEPS:
            raise NumericalError(f"spring-gaus: frame {frame} is not finite with {substeps} substeps")
        substeps += more
