"""A use of the public API that mypy checks (tests/test_types.py); it is not run."""

from pathlib import Path

import torch
from torch import Tensor

import gsim3d
from gsim3d import Cameras, EffectsSpec, Frames, Gaussians, Particles, Simulator, StabilityReport, ops
from gsim3d.effects.edits import Edit, Move, Remove
from gsim3d.effects.plan import Plan
from gsim3d.effects.selection import Selection
from gsim3d.effects.spec import DynamicsEffects, OutputEffects, Sleep
from gsim3d.io import read_ply, write_ply
from gsim3d.ops.raster import Rendering


def predict(frames: Frames, cameras: Cameras, folder: Path) -> list[Tensor]:
    simulator: Simulator = Simulator.from_pretrained("elastic-small", device="cpu", speed="exact")
    spec = EffectsSpec(dynamics=DynamicsEffects(background="frozen", sleep=Sleep(patience=4)))
    plan: Plan = simulator.plan(spec)
    report = StabilityReport()
    state: Particles = simulator.encode(frames, on_invalid="drop", report=report)
    edits = [Edit(0, Remove(Selection("frozen"))), Edit(1, Move("moving", (0.0, 0.0, 0.1)))]
    steps: list[Particles] = simulator.rollout(state, 4, plan, edits=edits, report=report)
    images: Rendering = simulator.render(steps[-1], cameras, plan=simulator.plan(EffectsSpec(outputs=OutputEffects())))
    simulator.save_pretrained(folder)
    gaussians: Gaussians = read_ply(folder / "step.ply")
    write_ply(folder / "copy.ply", gaussians)
    report.check()
    finding_count: int = report.total
    assert finding_count == 0 and gsim3d.__version__
    return [step.means for step in steps] + [images.color]


def kernels(x: Tensor, rows: Tensor, cu_rows: Tensor) -> Tensor:
    pooled: Tensor = ops.pool_max(x, rows, cu_rows)
    return torch.relu(pooled)
