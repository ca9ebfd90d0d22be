"""Report of a plan: active priors, switches and outputs, and predicted costs (``gsim3d plan``)."""

from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import torch

from gsim3d.data import Scene, make_frames
from gsim3d.effects.plan import Plan
from gsim3d.effects.spec import EffectsSpec, OutputEffects
from gsim3d.errors import InputError
from gsim3d.evaluate.plan_costs import Workload, background_cost, predicted_cost
from gsim3d.io.settings import from_dict
from gsim3d.io.terminal import in_columns
from gsim3d.numerics.speed import SPEEDS_FILE, read_checkpoints
from gsim3d.presets import ModelConfig
from gsim3d.simulator import Simulator
from gsim3d.train.config import DataConfig
from gsim3d.train.restore import Restored
from gsim3d.train.samples import context_cameras, spread_views, subsampled

TIMES = "measured"  # key of measured times in a speeds file, next to the presets of a device


@dataclass(frozen=True)
class PartTimes:
    """Measured times of the parts of a reference step: the checkpoint's spec, without CUDA graphs."""

    on: str  #: name of the machine
    work: Workload  #: workload at which the times were measured
    dynamics: float = 0.0  #: milliseconds of the parts of :func:`gsim3d.evaluate.plan_costs.predicted_cost`
    gaussians: float = 0.0  #: milliseconds of the parts of :func:`gsim3d.evaluate.plan_costs.predicted_cost`
    images: float = 0.0  #: milliseconds of the parts of :func:`gsim3d.evaluate.plan_costs.predicted_cost`
    host: float = 0.0  #: milliseconds in which a GPU waits for the host

    def __post_init__(self):
        if not all(type(count) is int and count >= 0 for count in asdict(self.work).values()):
            raise InputError(f"work must hold counts; got {asdict(self.work)}")

    def predicted(self, own: Plan, plan: Plan, model: ModelConfig, work: Workload) -> dict[str, float]:
        """Predicts the milliseconds of each part under ``plan`` by multiply-adds from the times, which were measured
        with ``own``."""
        before, after = predicted_cost(own, model, self.work), predicted_cost(plan, model, work)
        scaled = {part: getattr(self, part) * after[part] / max(before[part], 1.0) for part in after}
        return {**scaled, "host": self.host} if self.host else scaled


def load_times(folder: Path, restored: Restored) -> dict[str, PartTimes]:
    """Reads device -> measured times of a checkpoint's reference step; empty if it was not profiled."""
    devices = read_checkpoints(where := folder / SPEEDS_FILE).get(restored.checkpoint.digest) or {}
    known = {name: kept[TIMES] for name, kept in devices.items() if isinstance(kept, dict) and TIMES in kept}
    return {name: from_dict(PartTimes, values, f"{where}: {name}: {TIMES}: ") for name, values in known.items()}


def workload(scene: Scene, data: DataConfig) -> Workload:
    """Counts the particles of the first step of ``scene`` for a model trained on ``data``, and one image."""
    cameras = context_cameras(scene, data)
    views = spread_views(cameras, min(data.context_views, len(cameras)), 0)
    frames = subsampled(make_frames([scene], [list(views)], [range(1)]), data)
    masks = torch.ones_like(frames.images[:, 0], dtype=torch.bool) if frames.masks is None else frames.masks
    moving = masks if frames.dynamic is None else masks & frames.dynamic
    n_moving = int(moving.sum())
    n_points = 0 if frames.actions is None else frames.actions.n_points
    return Workload(n_moving, int(masks.sum()) - n_moving, 1, scene.height * scene.width, n_points)


def plan_report(
    simulator: Simulator, plan: Plan, work: Workload, times: dict[str, PartTimes], own: Plan
) -> Iterator[str]:
    """Yields the paragraphs of the report: active parts, unused parameters, and predicted costs of a step.

    Args:
        times: device -> times measured with the checkpoint's plan ``own``.
    """
    switches = [(name, "switch", setting) for name, setting in plan.switches]
    priors = [(name, "prior", f"number {n} of {len(plan.priors)}") for n, name in enumerate(plan.priors, 1)]
    outputs = [(name, "output", "image") for name in plan.outputs]
    yield in_columns([("on", "", ""), *priors, *switches, *outputs])
    sizes = {name: p.numel() * p.element_size() for name, p in simulator.named_parameters()}
    unused = sum(sizes[name] for name in plan.unused)
    count = f"{len(plan.unused)} of {len(sizes)}, {unused / 1024:.1f} of {sum(sizes.values()) / 1024:.1f} KiB"
    yield "\n  ".join([f"parameters not needed: {count}", *plan.unused])
    largest = simulator.plan(EffectsSpec(outputs=OutputEffects(depth=True, alpha=True)))
    costs = [{k: v / 1e6 for k, v in predicted_cost(p, simulator.config, work).items()} for p in (plan, largest)]
    once = background_cost(plan, simulator.config, work)
    free = predicted_cost(plan, simulator.config, replace(work, actions=0))["dynamics"] / 1e6
    acting = costs[0]["dynamics"] - free
    yield "\n".join(
        ["predicted multiply-adds of one step and one image, in millions", _compared(*costs)]
        + [f"background, once per rollout: {once / 1e6:.1f}"] * (once > 0)
        + [f"actions, in dynamics: {acting:.1f} for {work.actions} points"] * (acting > 0)
    )
    for device, measured in times.items():
        costs = [measured.predicted(own, p, simulator.config, work) for p in (plan, largest)]
        head = f"predicted milliseconds on {device}, scaled from gsim3d profile's measurement ({measured.on})"
        yield f"{head}\n{_compared(*costs)}"


def _compared(costs: dict[str, float], largest: dict[str, float]) -> str:
    """Formats the costs of the parts of a step, for a plan and for the largest plan of the model."""
    parts = [(part, costs[part], largest[part]) for part in largest]
    parts.append(("all", sum(costs.values()), sum(largest.values())))
    rows = [(part, f"{one:.1f}", f"{most:.1f}", f"{one / max(most, 1e-6):.2f}") for part, one, most in parts]
    return in_columns([("part", "this plan", "largest plan", "share"), *rows])
