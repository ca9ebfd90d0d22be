"""What can be turned to trade accuracy for time: each knob declared once, with what turning it may change."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch

from gsim3d.errors import InputError
from gsim3d.ops.raster import CUTOFFS
from gsim3d.train.restore import Restored

PRECISIONS = ("fp32", "tf32", "bf16", "fp16")
PARTS = ("encoder", "dynamics", "renderer")
KINDS = {
    "exact": "may change results by rounding only",
    "near-exact": "leaves out what is below a stated threshold",
    "model": "changes the function that the model computes",
    "needs-training": "needs a checkpoint of its own",
}


@dataclass(frozen=True)
class Setting:
    """How a trained simulator is run. The default is the reference: float32 throughout, nothing left out.

    encoder, dynamics, renderer: precision of each part, "fp32", "tf32", "bf16" or "fp16"; positions, codes, splats and
        sums are float32 in all.
    captured: the rollout is replayed from a CUDA graph.
    context_views, history: input cameras and steps; None: those of the training.
    background: as EffectsSpec.dynamics.background; None: that of the training.
    kept: share of the particles of each step, moving and other ones alike, that is kept: the most opaque.
    sh_degree: of rendered colours; None: the model's.
    cutoff: as :func:`gsim3d.ops.rasterize_gaussians`.
    patch_size: largest number of rows that attend to each other; None: the model's.
    grid: factor to the model's cell size.
    shrink: images are rendered this factor smaller, and enlarged again to be compared.
    every: steps between two rendered ones.
    """

    encoder: str = "fp32"
    dynamics: str = "fp32"
    renderer: str = "fp32"
    captured: bool = False
    context_views: int | None = None
    history: int | None = None
    background: str | None = None
    kept: float = 1.0
    sh_degree: int | None = None
    cutoff: str = "exact"
    patch_size: int | None = None
    grid: float = 1.0
    shrink: int = 1
    every: int = 1

    def __post_init__(self):
        for part in PARTS:
            _require(part, getattr(self, part), getattr(self, part) in PRECISIONS, f"one of {', '.join(PRECISIONS)}")
        _require("cutoff", self.cutoff, self.cutoff in CUTOFFS, f"one of {', '.join(CUTOFFS)}")
        _require("kept", self.kept, 0 < self.kept <= 1, "above 0 and at most 1")
        _require("grid", self.grid, 0 < self.grid < 1e3, "above 0")
        for name in ("context_views", "history", "patch_size", "shrink", "every"):
            value = getattr(self, name)
            _require(name, value, value is None or (isinstance(value, int) and value >= 1), "an integer of at least 1")

    @property
    def name(self) -> str:
        """What differs from the reference, in words."""
        changed = self.to_dict()
        if precisions := {changed.pop(part, "fp32") for part in PARTS} - {"fp32"}:
            parts = [part for part in PARTS if getattr(self, part) != "fp32"]
            where = "" if len(parts) == len(PARTS) else f" {'+'.join(parts)}"
            changed = {"precision": f"{'/'.join(sorted(precisions))}{where}", **changed}
        if changed.pop("captured", False):
            changed = {"graph": "captured", **changed}
        return ", ".join(f"{key.replace('_', ' ')} {value}" for key, value in changed.items()) or "reference"

    def to_dict(self) -> dict[str, Any]:
        """Fields that differ from the reference."""
        return {f.name: v for f in dataclasses.fields(self) if (v := getattr(self, f.name)) != f.default}

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> Setting:
        """Raises InputError for an unknown key."""
        known = [f.name for f in dataclasses.fields(cls)]
        if unknown := sorted(set(values) - set(known)):
            raise InputError(f"setting: unknown key {unknown[0]}; known: {', '.join(known)}")
        return cls(**values)


@dataclass(frozen=True)
class Knob:
    """kind: a key of KINDS.   turns: settings of a simulator on a device, each with only this knob turned.

    needs: what must be trained or built first, where ``turns`` gives nothing.
    """

    name: str
    kind: str
    turns: Callable[[Restored, torch.device], list[Setting]]
    needs: str = ""


def _require(name: str, value: object, fine: bool, what: str) -> None:
    if not fine:
        raise InputError(f"setting: {name} must be {what}; got {value!r}")


def _powers_below(limit: int, least: int = 1) -> list[int]:
    return [n for n in (2**k for k in range(20)) if least <= n < limit]


def _precisions(restored: Restored, device: torch.device) -> list[Setting]:
    if device.type != "cuda":
        return []
    whole = [Setting(p, p, p) for p in PRECISIONS[1:]]
    return whole + [Setting(**{part: "bf16"}) for part in PARTS]


def _captured(restored: Restored, device: torch.device) -> list[Setting]:
    return [Setting(captured=True), Setting("bf16", "bf16", "bf16", captured=True)] if device.type == "cuda" else []


def _views(restored: Restored, device: torch.device) -> list[Setting]:
    return [Setting(context_views=n) for n in range(1, restored.data.context_views)]


def _history(restored: Restored, device: torch.device) -> list[Setting]:
    return [Setting(history=n) for n in _powers_below(min(restored.data.history, restored.plan.history))]


def _background(restored: Restored, device: torch.device) -> list[Setting]:
    trained = restored.plan.spec.dynamics.background
    return [Setting(background="masked_out")] if trained != "masked_out" else []


def _kept(restored: Restored, device: torch.device) -> list[Setting]:
    return [Setting(kept=share) for share in (0.75, 0.5, 0.25, 0.1)]


def _degrees(restored: Restored, device: torch.device) -> list[Setting]:
    return [Setting(sh_degree=n) for n in range(restored.plan.sh_degree)]


def _cutoffs(restored: Restored, device: torch.device) -> list[Setting]:
    return [Setting(cutoff="tile3sigma")]


def _patches(restored: Restored, device: torch.device) -> list[Setting]:
    return [Setting(patch_size=n) for n in _powers_below(max(restored.simulator.config.dynamics.patch_sizes), 32)[-3:]]


def _grids(restored: Restored, device: torch.device) -> list[Setting]:
    return [Setting(grid=factor) for factor in (0.5, 2.0)]


def _images(restored: Restored, device: torch.device) -> list[Setting]:
    return [Setting(shrink=2), Setting(every=4)]


def _none(restored: Restored, device: torch.device) -> list[Setting]:
    return []


KNOBS = (
    Knob("precision", "model", _precisions, "a GPU: on a CPU there is only float32"),
    Knob("graph capture", "exact", _captured, "a GPU"),
    Knob("context views", "model", _views, "more than one context view"),
    Knob("history", "model", _history, "a model of more than one step of history"),
    Knob("background", "model", _background, "particles of a background"),
    Knob("particles kept", "model", _kept),
    Knob("degree of colours", "model", _degrees, "a model with view-dependent colour"),
    Knob("cutoff of Gaussians", "near-exact", _cutoffs),
    Knob("patch size", "model", _patches, "patches of more than 32 rows"),
    Knob("grid size", "model", _grids),
    Knob("image size and decoded frames", "exact", _images),
    Knob("steps a call", "needs-training", _none, "dynamics.steps_per_call in the training's model section"),
    Knob("model size", "needs-training", _none, "another preset, or channels in the training's model section"),
    Knob("training steps", "needs-training", _none, "a run folder with earlier checkpoints"),
)
