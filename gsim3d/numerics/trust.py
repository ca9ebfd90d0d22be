"""How far a prediction can be trusted: spread over variants, bounds of the error, and inputs unlike the validated ones.

A rollout predicts variants of a scene in one batch: with other serialization orders and patches, and from shorter
histories. The spread of a particle over them, and the number of steps, give a bound of its error by a map that
``gsim3d evaluate --calibrate-trust`` fits to scenes with known motion and writes beside the weights (TRUST_FILE).
"""

import dataclasses
import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from gsim3d.cameras import Cameras, Frames
from gsim3d.effects.plan import Plan
from gsim3d.errors import InputError, UnfamiliarInput, naming
from gsim3d.io.files import MAX_TEXT, read_file
from gsim3d.io.plain import is_number, parse_json
from gsim3d.io.settings import from_dict
from gsim3d.ops.curve import Pyramid
from gsim3d.ops.raster import rasterize_gaussians
from gsim3d.state import DYNAMIC, FROZEN, CloudTable, Particles, concatenate, newest_clouds

TRUST_FILE = "trust.json"  # {digest of a checkpoint: Trust}
# Oldest input steps left out, and cells by which the grid of curves, patches and coarse cells is shifted. The first
# variant is the prediction itself.
VARIANTS = ((0, (0, 0, 0)), (1, (5, 2, 3)), (2, (3, 7, 1)))
MOST_LEFT_OUT = max(left_out for left_out, _ in VARIANTS)
LEAST_SPREAD = 1e-4  # metres, added to the spread
LEVEL = 0.9  # share of particles that a bound holds for, unless another is given


@dataclass(frozen=True)
class Trust:
    """Calibration of a simulator: bounds of errors, and ranges of measures of the input.

    The bound of a particle is a function of ``spread_power * log(spread + LEAST_SPREAD) + step_power * log(step)``,
    linear between ``scores``, and rises with both.

    Attributes:
        n_scenes: number of scenes of the calibration.
        n_steps: number of predicted steps of the calibration.
        spread_power: exponent of the spread, at least 0.
        step_power: exponent of the step, at least 0.
        scores: ascending values of the function's argument.
        levels: ascending shares of particles in (0, 1).
        bounds: for each level the bound in metres at each of ``scores``.
        ranges: measure of :func:`input_measures` -> mean and standard deviation.
        threshold: deviation in standard deviations above which an input is unfamiliar.
    """

    n_scenes: int
    n_steps: int
    spread_power: float
    step_power: float
    scores: tuple[float, ...]
    levels: tuple[float, ...]
    bounds: tuple[tuple[float, ...], ...]
    ranges: dict[str, tuple[float, float]]
    threshold: float

    def __post_init__(self):
        if not self.scores or [len(row) for row in self.bounds] != [len(self.scores)] * len(self.levels):
            raise InputError("bounds must have a row for each of levels, with a value for each of scores")
        if list(self.scores) != sorted(self.scores) or self.threshold <= 0:
            raise InputError("scores must ascend, and threshold must be above 0")
        for name, pair in self.ranges.items():
            if not (isinstance(pair, (tuple, list)) and len(pair) == 2 and all(is_number(x, float) for x in pair)):
                raise InputError(f"ranges: {name} must have a mean and a standard deviation")

    def score(self, spread: Tensor, first: int = 1) -> Tensor:
        """Argument of the bound: float64 [S, N], larger for larger expected errors.

        Args:
            spread: [S, N] metres, of S steps.
            first: number of the first of them, 1 for the first predicted step.
        """
        steps = torch.arange(first, first + len(spread), dtype=torch.float64, device=spread.device)[:, None]
        return self.spread_power * (spread.double() + LEAST_SPREAD).log() + self.step_power * steps.log()

    def bound(self, spread: Tensor, level: float = LEVEL, first: int = 1) -> Tensor:
        """Bound of the errors [S, N] in metres that holds for a share ``level`` of the particles.

        Args:
            spread, first: see :meth:`score`.
            level: one of ``levels``.

        Raises:
            InputError: ``level`` is not one of ``levels``.
        """
        if level not in self.levels:
            raise InputError(f"trust: level must be one of {', '.join(map(str, self.levels))}; got {level}")
        table = torch.tensor([self.scores, self.bounds[self.levels.index(level)]], dtype=torch.float64)
        scores, bounds = table.to(spread.device)
        score = self.score(spread, first).clamp(scores[0], scores[-1])
        above = torch.searchsorted(scores, score).clamp(min(1, len(scores) - 1), len(scores) - 1)
        width = (scores[above] - scores[above - 1]).clamp(min=1e-12)
        return torch.lerp(bounds[above - 1], bounds[above], ((score - scores[above - 1]) / width).clamp(0, 1))

    def verdict(self, bounds: Tensor, particles: Particles, most: float) -> str:
        """Says from which predicted step on the mean bound of the moving particles exceeds ``most`` metres.

        Args:
            bounds: [S, N], of :meth:`bound`.
            particles: particles of a predicted step.
            most: bound that is asked for.
        """
        moving = particles.activity == DYNAMIC
        means = bounds[:, moving].mean(1).tolist() if bool(moving.any()) else [0.0] * len(bounds)
        step = next((step for step, mean in enumerate(means, 1) if mean > most), None)
        said = f"the mean bound of the error ({LEVEL:.0%} of the moving particles) "
        if step is None:
            said += f"stays within {most:g} m for all {len(means)} predicted steps (at most {max(means):.3g} m)"
        else:
            said += f"exceeds {most:g} m from predicted step {step} on ({means[step - 1]:.3g} m)"
        if len(means) > self.n_steps:
            said += f"; steps after {self.n_steps} are beyond the calibration, and their bounds may be too small"
        return said

    def unfamiliar(self, measures: dict[str, float]) -> list[str]:
        """Describes each measure that is out of its range, with its value and the range."""
        found = []
        for name, (mean, deviation) in self.ranges.items():
            value, reach = measures.get(name, math.nan), self.threshold * deviation
            if not abs(value - mean) <= reach:
                shown = f"no {name}" if math.isnan(value) else f"{name} {value:.4g}"
                found.append(f"{shown} (validated: {mean - reach:.4g} to {mean + reach:.4g})")
        return found


def trust_of(simulator: Any, checkpoint: str | Path) -> Trust:
    """Returns the calibration of a simulator. Raises InputError with the command that makes one if there is none."""
    if simulator.trust is None:
        command = f"gsim3d evaluate {checkpoint} DATA --scenes all --calibrate-trust"
        lacks = f"{checkpoint}: errors are not calibrated, or not at this --speed"
        raise InputError(f"{lacks}; calibrate them on generated scenes: {command}")
    return simulator.trust


def load_trust(folder: Path, digest: str | None) -> Trust | None:
    """Reads the calibration of a checkpoint in ``folder``; None if there is none. Raises InputError if it is wrong."""
    found = read_checkpoints(folder / TRUST_FILE).get(digest)
    return None if found is None else from_dict(Trust, found, f"{folder / TRUST_FILE}: ")


def read_checkpoints(path: Path) -> dict[str, Any]:
    """Reads plain values by the digest of a checkpoint, {} without a file. Raises InputError if it is invalid."""
    if not path.is_file():
        return {}
    with naming(f"{path} cannot be read", ValueError):
        content = parse_json(read_file(path, MAX_TEXT))
    if not isinstance(content, dict):
        raise InputError(f"{path} must hold a mapping of checkpoints")
    return content


def without_oldest(frames: Frames, n_steps: int) -> Frames:
    """Leaves out the oldest ``n_steps`` steps of every scene; of two or more steps, two remain."""
    if n_steps == 0:
        return frames
    scenes = frames.cloud_scene.tolist()
    kept = []
    for scene in dict.fromkeys(scenes):
        own = [cloud for cloud, other in enumerate(scenes) if other == scene]
        kept += own[max(0, min(n_steps, len(own) - 2)) :]
    device, cameras = frames.images.device, frames.cameras
    number = torch.full((len(scenes),), -1, device=device)
    number[kept] = torch.arange(len(kept), device=device)
    images = (number[cameras.image_cloud] >= 0).nonzero()[:, 0]
    names = ("images", "masks", "dynamic", "valid", "backbone_features")
    fields = {name: value[images] for name in names if (value := getattr(frames, name)) is not None}
    fields["cameras"] = cameras.select(images, number[cameras.image_cloud[images]])
    fields |= {name: getattr(frames, name)[kept] for name in ("cloud_scene", "cloud_step")}
    return dataclasses.replace(frames, **fields)


def variants(histories: Sequence[Particles]) -> Particles:
    """Packs the variants of all scenes; variant k of scene b is scene ``b * len(VARIANTS) + k``. ``histories``: the
    state encoded from all input steps, and without the 1, 2 ... oldest ones."""
    state, count, parts = histories[0], len(VARIANTS), []
    origin, offset = (x if x is None else x.repeat_interleave(count, 0) for x in (state.origin, state.world_offset))
    actions = state.actions
    if actions is not None:
        actions = actions.select([scene for scene in range(len(state.origin)) for _ in VARIANTS])
    for k, (left_out, _) in enumerate(VARIANTS):
        part = histories[min(left_out, len(histories) - 1)]
        table = part.clouds
        table = CloudTable.make(table.counts, (s * count + k for s in table.scenes), table.steps, origin.device)
        parts.append(part.with_clouds(table, origin=origin, world_offset=offset, actions=actions))
    return concatenate(parts)


@torch.no_grad()
def rollout_with_spread(
    simulator: Any, histories: Sequence[Particles], n_steps: int, plan: Plan, **options: Any
) -> tuple[list[Particles], Tensor]:
    """Predicts scenes and their variants in one batched rollout.

    Grids are not shifted with ``background="asymmetric"``, and a graph network has none: such models vary only by
    histories, which takes three or more input steps.

    Args:
        simulator: a :class:`gsim3d.Simulator`.
        histories: see :func:`variants`.
        n_steps: number of steps to predict.
        plan: plan of the effects.
        options: of :meth:`gsim3d.Simulator.rollout`, without edits and actors.

    Returns:
        The steps as :meth:`gsim3d.Simulator.rollout` returns them, and the spread float32 [n_steps, N] in metres: the
        root mean square distance of the variants of a particle from their mean.

    Raises:
        InputError: cells of the model depend on all scenes of a call.
    """
    config, count, state = simulator.config.dynamics, len(VARIANTS), histories[0]
    if not config.origin_of_scene:
        raise InputError("spread: scenes of one call change each other in the published model; use another checkpoint")
    cells = torch.tensor([cells for _, cells in VARIANTS], dtype=torch.float64, device=state.means.device)
    shifts = (cells * config.grid_size).repeat(len(state.origin), 1)

    def shifted(history: Particles) -> Pyramid:
        return simulator.dynamics.geometry(dataclasses.replace(history, origin=history.origin - shifts))

    geometry = None if config.is_asymmetric else shifted
    with simulator.setting.precision("dynamics", state.means.device.type):
        rolled = simulator.rollout(variants(histories), n_steps, plan, geometry=geometry, **options)
    steps, spreads = [], []
    for step in rolled:
        first, starts = step.select_clouds(range(0, step.n_clouds, count)), step.clouds.starts[::count]
        table = first.clouds
        table = CloudTable.make(table.counts, (s // count for s in table.scenes), table.steps, state.means.device)
        of_scenes = {"origin": state.origin, "world_offset": state.world_offset, "actions": state.actions}
        steps.append(first.with_clouds(table, **of_scenes))
        means = [step.means[a:b].unflatten(0, (count, -1)) for a, b in zip(starts, starts[1:])]
        spreads.append(torch.cat([(x - x.mean(0)).square().sum(-1).mean(0).sqrt() for x in means]))
    return steps, torch.stack(spreads)


@torch.no_grad()
def draw_values(simulator: Any, particles: Particles, values: Tensor, cameras: Cameras) -> Tensor:
    """Renders a value of each particle, such as its bound: [I, H, W] from ``values`` [N], 0 where nothing is drawn."""
    gaussians = simulator.renderer(particles, sh_degree=0)
    fields = (gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities)
    colors, cu_rows = values.float()[:, None].expand(-1, 3), gaussians.cu_rows
    return rasterize_gaussians(*fields, cameras, colors=colors, cu_rows=cu_rows, on_invalid="drop").color[..., 0]


@torch.no_grad()
def input_measures(simulator: Any, frames: Frames, state: Particles) -> list[dict[str, float]]:
    """Measures the newest input step of each scene: cameras, lens, ground, size of bodies, error of re-rendering.
    ``frames`` are not subsampled yet; ``state``: the particles encoded from them."""
    return [_measures(simulator, frames, state, cloud) for cloud in newest_clouds(state.clouds)]


def _measures(simulator: Any, frames: Frames, state: Particles, cloud: int) -> dict[str, float]:
    chosen = (frames.cameras.image_cloud == cloud).nonzero()[:, 0]
    cameras = frames.cameras.select(chosen, torch.zeros_like(chosen))
    particles, images = state.select_clouds([cloud]), frames.images[chosen]
    shown = torch.ones_like(images[:, 0], dtype=torch.bool) if frames.masks is None else frames.masks[chosen]
    body = shown if frames.dynamic is None else shown & frames.dynamic[chosen]
    ground = shown & ~body
    moving, still = (particles.means[particles.activity == kind].double() for kind in (DYNAMIC, FROZEN))
    base = 0.0 if frames.world_offset is None else frames.world_offset[state.clouds.scenes[cloud], 2]  # of the files
    values = {f"{name} pixels [%]": 100 * mask.double().mean() for name, mask in (("body", body), ("ground", ground))}
    if len(moving):
        values["body radius [m]"] = (moving - moving.mean(0)).square().sum(-1).mean().sqrt()
    if len(still):
        values["ground height [m]"] = still[:, 2].median() + base
    if bool(ground.any()):
        colors = images.movedim(1, -1)[ground].double()
        values |= {f"ground {name}": colors[:, k].mean() for k, name in enumerate(("red", "green", "blue"))}
    with simulator.setting.precision("renderer", images.device.type):
        rendered = simulator.render(particles, cameras).color.movedim(-1, 1).clamp(0, 1)
    error = (rendered - images).double().square().mean(1)[shown].mean()
    values |= {"re-rendering PSNR [dB]": -10 * error.clamp(min=1e-10).log10(), **_camera_measures(cameras, base)}
    return dict(zip(values, torch.stack([v.cpu() for v in values.values()]).tolist(), strict=True))


def _camera_measures(cameras: Cameras, base: Tensor | float) -> dict[str, Tensor]:
    rotations, translations = cameras.viewmats[:, :3, :3].double(), cameras.viewmats[:, :3, 3:].double()
    places, forward = -(rotations.mT @ translations)[..., 0], rotations[:, 2]
    first, second = torch.triu_indices(len(places), len(places), 1, device=places.device)
    values = {
        "camera height [m]": places[:, 2].mean() + base,
        "camera pitch [degrees]": torch.rad2deg(forward[:, 2].clamp(-1, 1).asin()).mean(),
        "field of view [degrees]": torch.rad2deg(2 * (cameras.height / 2 / cameras.Ks[:, 1, 1].double()).atan()).mean(),
        "near depth [m]": cameras.near.double().mean(),
        "far depth [m]": cameras.far.double().mean(),
    }
    if len(places) > 1:
        values["distance of cameras [m]"] = (places[first] - places[second]).norm(dim=1).mean()
        cosines = (forward[first] * forward[second]).sum(1).clamp(-1, 1)
        values["angle between cameras [degrees]"] = torch.rad2deg(cosines.acos()).mean()
    return values


def check_input(simulator: Any, frames: Frames, state: Particles, names: Sequence[str] = ()) -> None:
    """Warns with :class:`gsim3d.errors.UnfamiliarInput` about scenes outside of the validated ranges, if the simulator
    has a calibration. ``frames``, ``state``: see :func:`input_measures`; ``names``: of the scenes, default: numbers."""
    if simulator.trust is None:
        return
    for scene, measures in enumerate(input_measures(simulator, frames, state)):
        if found := simulator.trust.unfamiliar(measures):
            said = f"unlike the validation scenes, predictions may be wrong: {'; '.join(found)}"
            warnings.warn(f"{names[scene] if names else f'scene {scene}'}: {said}", UnfamiliarInput, stacklevel=3)
