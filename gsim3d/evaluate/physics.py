"""Physical measures of moving points by step: momentum, energy, rigidity, penetration, permanence.

Every point has the same weight. Each method has points of its own, such as particles on visible surfaces; the truth
beside it is of the same points, where the generator's bodies carry them from the last given step on.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from gsim3d.data import Scene
from gsim3d.data.actions import UNREADABLE
from gsim3d.errors import InputError, naming
from gsim3d.state import DYNAMIC, Particles
from gsim3d.synth.embedding import ParticleCloud, bind_deformed

GRAVITY = 9.81  # m/s^2
MARGIN = 0.5  # metres around the scene's bounds
TRUE = "true "  # start of the name of a measure of the truth


@dataclass(frozen=True)
class Measure:
    """A physical measure."""

    label: str  #: name and unit in tables
    formula: str  #: definition, with v the velocity from the step before, h the mean height of both, <> over points
    digits: int  #: number of decimals in tables


MEASURES = {
    "momentum": Measure("momentum [m/s]", "|<v>|", 3),
    "energy": Measure("energy [J/kg]", "<|v|^2> / 2 + 9.81 <h>", 3),
    "rigidity": Measure("rigidity [m]", "rms distance to the rigid motion of each body since the last given step", 4),
    "penetration": Measure("penetration [m]", "<max(0, ground - z)>", 4),
    "permanence": Measure("permanence", f"share of points within {MARGIN} m of the scene's bounds", 3),
}


def measure(
    points: Tensor, bodies: Tensor, fps: float, bounds: Tensor, ground: float | None = 0.0
) -> dict[str, Tensor]:
    """Returns each measure of MEASURES at every step after the first, float64 [S - 1]; NaN from a step on whose points
    are not all finite.

    Args:
        points: [S, N, 3] metres, in correspondence over the steps; z is up.
        bodies: int64 [N], the body of each point.
        fps: steps per second.
        bounds: [2, 3] metres, lowest and highest corner.
        ground: its height in metres; None: there is none, and penetration is NaN.

    Raises:
        InputError: there are fewer than two steps, or no points.
    """
    points = points.double()
    if points.ndim != 3 or points.shape[0] < 2 or points.shape[1] == 0:
        raise InputError(f"measure: points must be [S >= 2, N >= 1, 3]; got {list(points.shape)}")
    broken = (~points.isfinite()).flatten(1).any(1).cumsum(0) > 0
    points = points.masked_fill(broken[:, None, None], 0)
    velocities = points.diff(dim=0) * fps
    later, heights = points[1:], points[..., 2].mean(1)
    low, high = bounds.double()
    inside = ((later >= low - MARGIN) & (later <= high + MARGIN)).all(-1).double()
    found = {
        "momentum": velocities.mean(1).norm(dim=1),
        "energy": velocities.square().sum(-1).mean(1) / 2 + GRAVITY * (heights[1:] + heights[:-1]) / 2,
        "rigidity": _residuals(points, bodies).square().mean(1).sqrt(),
        "penetration": ((math.nan if ground is None else ground) - later[..., 2]).clamp_min(0).mean(1),
        "permanence": inside.mean(1),
    }
    return {name: values.masked_fill(broken[1:], math.nan) for name, values in found.items()}


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


def measure_tracks(tracks: Mapping[str, Tensor], scene: Scene, steps: range) -> dict[str, dict[str, Tensor]]:
    """Measures the moving points [S, N, 3] of each method over ``steps``, of which the first is the last given one.

    Methods without points are left out. If the scene has its states, each method also has the measures of the truth of
    its points, named ``TRUE + name``.
    """
    states, found = true_states(scene), {}
    given = scene.fps, torch.from_numpy(scene.bounds), scene.ground_height
    for name, points in tracks.items():
        if points.shape[1] == 0:
            continue
        bodies, truth = torch.zeros(points.shape[1], dtype=torch.int64), {}
        if states is not None and bool(points[0].isfinite().all()):
            true, bodies = carried(points[0], [nodes[steps.start : steps.stop] for nodes in states])
            truth = {TRUE + key: values for key, values in measure(true, bodies, *given).items()}
        found[name] = measure(points, bodies, *given) | truth
    return found


def carried(points: Tensor, bodies: Sequence[Tensor]) -> tuple[Tensor, Tensor]:
    """Returns where bodies of :func:`true_states` carry ``points`` [N, 3] of their first step, float64 [S, N, 3], and
    which, int64 [N]: that of the nearest node; of the 4 axes of a rigid one, the first is its origin."""
    points = points.double()
    starts = [own[0, :1] if own.shape[1] == 4 and own.ndim == 3 else own[0].flatten(0, -2) for own in bodies]
    body = torch.stack([torch.cdist(points, start.double()).amin(1) for start in starts]).argmin(0)
    moved = points.repeat(min(map(len, bodies)), 1, 1)
    for number, nodes in enumerate(bodies):
        if (own := body == number).any():
            steps, inside = nodes.double().numpy()[: len(moved)], points[own].numpy()
            binding = bind_deformed(steps[0], inside) if steps.ndim == 5 else ParticleCloud(steps).bind(inside)
            moved[:, own] = torch.from_numpy(np.stack([binding.move(step) for step in steps]))
    return moved, body


def moving_points(particles: Particles, steps: Sequence[int]) -> Tensor:
    """Returns the positions [S, N, 3], on the CPU, of the particles that move in the first of ``steps``: indices of
    clouds with the same particles."""
    clouds = [particles.select_clouds(torch.tensor([step])) for step in steps]
    moving = clouds[0].activity == DYNAMIC
    return torch.stack([cloud.means[moving] for cloud in clouds]).cpu()


def shape_change(points: Tensor, bodies: Tensor) -> float:
    """Returns the largest rms in metres of ``bodies`` (int64 [N]) to their first shapes at the last step of ``points``
    [S, N, 3]; NaN without points."""
    last = _residuals(points[[0, -1]].double(), bodies)[0]
    return max((last[bodies == body].square().mean().sqrt().item() for body in bodies.unique()), default=math.nan)


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


def true_states(scene: Scene) -> list[Tensor] | None:
    """Returns the nodes of each body and cloth as generated at the scene's steps, [S, N, 3], of control grids
    [S, c+1, c+1, c+1, 3]; None if it has no ``states.npz``, or is not in metres. Raises InputError if the file is
    damaged, or shorter than the scene."""
    file = scene.path / "states.npz"
    if not file.is_file() or scene.fitting.unit_cameras:
        return None
    with naming(f"{file}: cannot be read", UNREADABLE), np.load(file, allow_pickle=False) as states:
        found = [torch.from_numpy(states[name]) for name in states.files if name != "actors"]
    for nodes in found:
        if nodes.ndim < 3 or nodes.shape[-1] != 3 or not nodes.isfinite().all():
            raise InputError(f"{file}: each body must be [T, ..., 3] finite numbers; got {list(nodes.shape)}")
    stride = round(scene.generated.get("fps", scene.fps) / scene.fps)
    found = [nodes[::stride] for nodes in found]
    if found and min(map(len, found)) < scene.n_steps:
        raise InputError(f"{file}: {min(map(len, found))} steps, fewer than the scene has")
    return [_used(nodes) - torch.from_numpy(scene.world_offset) for nodes in found] or None


def _used(nodes: Tensor) -> Tensor:
    """Nodes [S, ..., 3] as a list [S, N, 3] without unused ones, at the origin; those of a whole lattice as given."""
    unused = (nodes == 0).all(-1).any(0)
    return nodes if nodes.ndim == 5 and not unused.any() else nodes.flatten(1, -2)[:, ~unused.flatten()]
