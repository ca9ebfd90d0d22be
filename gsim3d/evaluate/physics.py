"""Physical measures of moving points by step: momentum, energy, rigidity, penetration, permanence.

Every point has the same weight. Predicted points are particles on visible surfaces, true ones the nodes of the
generator's bodies, so compare how measures change rather than their values.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from gsim3d.data import Scene
from gsim3d.data.actions import UNREADABLE
from gsim3d.errors import InputError
from gsim3d.state import DYNAMIC, Particles

GRAVITY = 9.81  # m/s^2
MARGIN = 0.5  # metres around the scene's bounds


@dataclass(frozen=True)
class Measure:
    """A physical measure."""

    label: str  #: name and unit in tables
    formula: str  #: definition, with v the velocity from the step before, x the position, and <> the mean over points
    digits: int  #: number of decimals in tables


MEASURES = {
    "momentum": Measure("momentum [m/s]", "|<v>|", 3),
    "energy": Measure("energy [J/kg]", "<|v|^2> / 2 + 9.81 <z>", 3),
    "rigidity": Measure("rigidity [m]", "rms distance to the rigid motion of each body since the last given step", 4),
    "penetration": Measure("penetration [m]", "<max(0, -z)>", 4),
    "permanence": Measure("permanence", f"share of points within {MARGIN} m of the scene's bounds", 3),
}


def measure(points: Tensor, bodies: Tensor, fps: float, bounds: Tensor | None = None) -> dict[str, Tensor]:
    """Returns each measure of MEASURES at every step after the first, float64 [S - 1].

    Args:
        points: [S, N, 3] metres, in correspondence over the steps; z is up and the ground at 0.
        bodies: int64 [N], the body of each point.
        fps: steps per second.
        bounds: [2, 3] metres; None: all of space.

    Raises:
        InputError: there are fewer than two steps, or no points.
    """
    points = points.double()
    if points.ndim != 3 or points.shape[0] < 2 or points.shape[1] == 0:
        raise InputError(f"measure: points must be [S >= 2, N >= 1, 3]; got {list(points.shape)}")
    velocities = points.diff(dim=0) * fps
    later, height = points[1:], points[1:, :, 2]
    inside = torch.ones_like(height)
    if bounds is not None:
        low, high = bounds.double()
        inside = ((later >= low - MARGIN) & (later <= high + MARGIN)).all(-1).double()
    return {
        "momentum": velocities.mean(1).norm(dim=1),
        "energy": velocities.square().sum(-1).mean(1) / 2 + GRAVITY * height.mean(1),
        "rigidity": _residuals(points, bodies).square().mean(1).sqrt(),
        "penetration": (-height).clamp_min(0).mean(1),
        "permanence": inside.mean(1),
    }


def _residuals(points: Tensor, bodies: Tensor) -> Tensor:
    """Distance [S - 1, N] of each point to its place in the best rigid motion of its body since step 0 (Kabsch)."""
    distances = torch.zeros_like(points[1:, :, 0])
    for body in bodies.unique():
        own = bodies == body
        centred = points[:, own] - points[:, own].mean(1, keepdim=True)
        first, later = centred[0], centred[1:]
        u, _, vh = torch.linalg.svd(first.mT @ later)  # [S - 1, 3, 3]
        signs = torch.ones(len(later), 3, dtype=points.dtype, device=points.device)
        signs[:, 2] = torch.linalg.det(u @ vh)
        distances[:, own] = (first @ (u * signs[:, None]) @ vh - later).norm(dim=-1)
    return distances


def measure_particles(
    particles: Particles, scene: Scene, first: int, truth: Sequence[Tensor] | None
) -> dict[str, Tensor]:
    """Measures the moving particles of clouds ``first`` (the last given step) and later, one cloud a step with the same
    particles; empty if none moves. ``truth``: true nodes [N, 3] of each body at ``first``, to tell bodies apart; None:
    one body."""
    points = moving_points(particles, range(first, particles.n_clouds))
    if points.shape[1] == 0:
        return {}
    bodies = torch.zeros(points.shape[1], dtype=torch.int64)
    if truth is not None:
        bodies = nearest_body(points[0], truth)
    return measure(points, bodies, scene.fps, torch.from_numpy(scene.bounds))


def moving_points(particles: Particles, steps: Sequence[int]) -> Tensor:
    """Returns the positions [S, N, 3], on the CPU, of the particles that move in the first of ``steps``: indices of
    clouds with the same particles."""
    clouds = [particles.select_clouds(torch.tensor([step])) for step in steps]
    moving = clouds[0].activity == DYNAMIC
    return torch.stack([cloud.means[moving] for cloud in clouds]).cpu()


def shape_change(points: Tensor, copies: int = 1) -> float:
    """Returns the largest rms in metres of ``copies`` bodies to their first shapes at the last step of ``points``
    [S, N, 3], those of one copy after those of another."""
    bodies = torch.arange(copies).repeat_interleave(points.shape[1] // copies)
    last = _residuals(points[[0, -1]].double(), bodies)[0]
    return max(last[bodies == body].square().mean().sqrt().item() for body in range(copies))


def fall_ratio(given: Sequence[float], height: float, n_steps: int, fps: float) -> float | None:
    """Returns how far a body fell over how far a free one would have, from its mean heights ``given`` at successive
    steps (metres; their velocity is fitted under gravity) to ``height``, ``n_steps`` later; None if it is given at one
    step only."""
    if len(given) < 2:
        return None
    heights, ago = np.asarray(given[:-1]), np.arange(len(given) - 1, 0, -1) / fps
    velocity = (ago * (given[-1] - GRAVITY / 2 * ago**2 - heights)).sum() / (ago**2).sum()
    time = n_steps / fps
    return float((given[-1] - height) / (GRAVITY / 2 * time**2 - velocity * time))


def nearest_body(points: Tensor, truth: Sequence[Tensor]) -> Tensor:
    """Returns the body int64 [N] that each of ``points`` [N, 3] is on, by the nodes [M, 3] of each body in ``truth``;
    of the 4 axes of a rigid one, the first is its origin."""
    nodes = [own[:1] if len(own) == 4 else own for own in truth]
    return torch.stack([torch.cdist(points.double(), own.double()).amin(1) for own in nodes]).argmin(0)


def measure_truth(states: Sequence[Tensor], scene: Scene, steps: range) -> dict[str, Tensor]:
    """Measures the true nodes of all bodies over ``steps``, of which the first is the last given one."""
    points = torch.cat([nodes[list(steps)] for nodes in states], 1)
    bodies = torch.cat([torch.full((nodes.shape[1],), k) for k, nodes in enumerate(states)])
    return measure(points, bodies, scene.fps, torch.from_numpy(scene.bounds))


def true_states(scene: Scene) -> list[Tensor] | None:
    """Returns the nodes [T, N, 3] of each body and cloth as generated; None if the scene has no ``states.npz``. Raises
    InputError if it is damaged, or does not fit the scene."""
    file = scene.path / "states.npz"
    if not file.is_file():
        return None
    try:
        with np.load(file, allow_pickle=False) as states:
            found = [torch.from_numpy(states[name]) for name in states.files if name != "actors"]
    except UNREADABLE as error:
        raise InputError(f"{file}: cannot be read: {error}") from None
    for nodes in found:
        if nodes.ndim < 3 or nodes.shape[-1] != 3 or not nodes.isfinite().all():
            raise InputError(f"{file}: each body must be [T, ..., 3] finite numbers; got {list(nodes.shape)}")
    flat = [nodes.flatten(1, -2) for nodes in found]
    return [nodes[:, ~(nodes == 0).all(-1).any(0)] for nodes in flat]  # a lattice has unused nodes, at the origin
