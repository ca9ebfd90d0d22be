"""How a trained simulator is run, to trade accuracy for time; settings that were tuned lie in a file beside weights."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from gsim3d.cameras import InputSpec
from gsim3d.effects.spec import EffectsSpec, Sleep
from gsim3d.errors import InputError, did_you_mean
from gsim3d.io.files import MAX_TEXT, read_file, shown, typed
from gsim3d.io.plain import parse_json
from gsim3d.ops.raster import CUTOFFS
from gsim3d.presets import ModelConfig
from gsim3d.state import DYNAMIC, Particles

PRECISIONS = ("fp32", "tf32", "bf16", "fp16")
DTYPES = {"bf16": torch.bfloat16, "fp16": torch.float16}
PARTS = ("encoder", "dynamics", "renderer")
SPEEDS = ("exact", "balanced", "fast")
N_CURVES = 4  # along which a cloud is cut into patches
SPEEDS_FILE = "speeds.json"  # {digest of a checkpoint: {kind of device: {speed: setting}}}


@dataclass(frozen=True)
class Setting:
    """How a trained simulator is run. The default is the reference: float32 throughout, nothing left out.

    Attributes:
        encoder: precision, "fp32", "tf32", "bf16" or "fp16"; positions, codes, splats and sums are float32 in all.
        dynamics: the same.
        renderer: the same.
        captured: the rollout is replayed from a CUDA graph.
        context_views: input cameras; None: as many as in training.
        history: input steps; None: as many as in training.
        background: as EffectsSpec.dynamics.background; None: that of the training.
        kept: share of the particles of each step, moving and other ones alike, that is retained: the most opaque.
        sh_degree: of rendered colours; None: the model's.
        cutoff: as :func:`gsim3d.ops.rasterize_gaussians`.
        patch_size: largest number of particles that attend to each other; None: the model's.
        grid: factor to the model's cell size.
        shrink: images are rendered this factor smaller, and enlarged again to be compared.
        every: steps between two rendered ones.
        least_opacity: Gaussians below it are not drawn; pixels leave out what is below 1/255 in any case.
        compiled: the network of the dynamics runs through torch.compile.
        sleep: cells that a particle at rest moves in one step at most, and is not computed; None: as in training.
        orders: of the curves that cut clouds into patches; the predictions of as many are averaged, at most 4.
        checkpoint: name of another one that takes this one's place; None: none does.
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
    least_opacity: float = 0.0
    compiled: bool = False
    sleep: float | None = None
    orders: int = 1
    checkpoint: str | None = None

    def __post_init__(self):
        for part in PARTS:
            require(part, getattr(self, part), getattr(self, part) in PRECISIONS, f"one of {', '.join(PRECISIONS)}")
        require("cutoff", self.cutoff, self.cutoff in CUTOFFS, f"one of {', '.join(CUTOFFS)}")
        require("kept", self.kept, 0 < self.kept <= 1, "above 0 and at most 1")
        require("grid", self.grid, 0 < self.grid < 1e3, "above 0")
        require("least_opacity", self.least_opacity, 0 <= self.least_opacity < 1, "at least 0 and below 1")
        require("sleep", self.sleep, self.sleep is None or 0 <= self.sleep < 1e3, "at least 0")
        require("orders", self.orders, self.orders in (1, 2, 4), "1, 2 or 4")
        if self.captured and self._needs_python:
            raise InputError("setting: captured does not fit " + " and ".join(self._needs_python))
        require("sh_degree", self.sh_degree, self.sh_degree in (None, 0, 1, 2, 3), "0, 1, 2 or 3")
        for name in ("context_views", "history", "patch_size", "shrink", "every"):
            value = getattr(self, name)
            require(name, value, value is None or (isinstance(value, int) and value >= 1), "an integer of at least 1")

    @property
    def _needs_python(self) -> list[str]:
        """What of it a graph cannot repeat: it knows no sleep, and one order of the curves."""
        changed = {name: getattr(self, name) for name in ("compiled", "sleep", "orders")}
        defaults = {f.name: f.default for f in dataclasses.fields(self)}
        return [name for name, value in changed.items() if value != defaults[name]]

    @property
    def fits_a_graph(self) -> bool:
        """Whether what it changes can be replayed from a CUDA graph."""
        return not self._needs_python

    @property
    def name(self) -> str:
        """What differs from the reference, in words."""
        changed = self.to_dict()
        if precisions := {changed.pop(part, "fp32") for part in PARTS} - {"fp32"}:
            parts = [part for part in PARTS if getattr(self, part) != "fp32"]
            where = "" if len(parts) == len(PARTS) else f" {'+'.join(parts)}"
            changed = {"precision": f"{'/'.join(sorted(precisions))}{where}", **changed}
        for switch, what in (("captured", "graph captured"), ("compiled", "compiled")):
            if changed.pop(switch, False):
                changed = {what: "", **changed}
        return (
            ", ".join(f"{key.replace('_', ' ')} {short(value)}".strip() for key, value in changed.items())
            or "reference"
        )

    @property
    def undrawn(self) -> Setting:
        """What of it changes the particles."""
        drawing = {
            "renderer": "fp32",
            "sh_degree": None,
            "cutoff": "exact",
            "least_opacity": 0.0,
            "shrink": 1,
            "every": 1,
        }
        return dataclasses.replace(self, **drawing)

    @property
    def given(self) -> Setting:
        """What of it changes the encoder's work."""
        names = ("encoder", "context_views", "history", "checkpoint")
        return Setting(**{name: getattr(self, name) for name in names})

    def to_dict(self) -> dict[str, Any]:
        """Fields that differ from the reference."""
        return {f.name: v for f in dataclasses.fields(self) if (v := getattr(self, f.name)) != f.default}

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> Setting:
        """Raises InputError for an unknown key or a value of another type."""
        return typed(cls, values, "setting")

    @contextlib.contextmanager
    def precision(self, part: str, device: str) -> Iterator[None]:
        """A context in which ``part`` computes as the setting says, and convolutions repeat bit by bit."""
        precision, products = getattr(self, part), torch.backends.cuda.matmul
        tf32, before = precision == "tf32", products.allow_tf32
        autocast = torch.autocast(device, DTYPES.get(precision, torch.float32), enabled=precision in DTYPES)
        convolutions = torch.backends.cudnn.flags(enabled=True, benchmark=False, deterministic=True, allow_tf32=tf32)
        try:
            products.allow_tf32 = tf32
            with autocast, convolutions:
                yield
        finally:
            products.allow_tf32 = before

    def of_model(self, config: ModelConfig) -> ModelConfig:
        """The model in the geometry of the setting; weights fit all."""
        dynamics = config.dynamics
        patches = tuple(min(size, self.patch_size or size) for size in dynamics.patch_sizes)
        changed = dataclasses.replace(dynamics, grid_size=dynamics.grid_size * self.grid, patch_sizes=patches)
        return config if changed == dynamics else dataclasses.replace(config, dynamics=changed)

    def of_effects(self, spec: EffectsSpec, is_asymmetric: bool) -> EffectsSpec:
        """What a model that was trained for ``spec`` computes."""
        sleep = spec.dynamics.sleep
        if self.sleep is not None:
            sleep = Sleep(policy="approx" if is_asymmetric else "exact", eps=self.sleep)
        dynamics = dataclasses.replace(
            spec.dynamics,
            history=self.history or spec.dynamics.history,
            background=self.background or spec.dynamics.background,
            sleep=None if self.captured else sleep,
        )
        appearance = spec.appearance
        if self.sh_degree is not None:
            appearance = dataclasses.replace(appearance, view_dependent=self.sh_degree)
        return dataclasses.replace(spec, dynamics=dynamics, appearance=appearance)

    def of_inputs(self, inputs: InputSpec) -> InputSpec:
        """What is encoded, of the ``inputs`` of the training."""
        views = min(self.context_views or inputs.context_views, inputs.context_views)
        history = min(self.history or inputs.history, inputs.history)
        return dataclasses.replace(inputs, context_views=views, history=history)

    def retained(self, particles: Particles) -> Particles:
        """The most opaque share of the moving and of the other particles of each cloud."""
        if self.kept == 1:
            return particles
        group = 2 * particles.row_cloud() + (particles.activity == DYNAMIC)
        order = torch.argsort(particles.opacities, descending=True, stable=True)
        order = order[torch.argsort(group[order], stable=True)]
        counts = torch.bincount(group, minlength=2 * particles.n_clouds)
        rank = torch.arange(len(order), device=order.device) - (counts.cumsum(0) - counts)[group[order]]
        kept = torch.zeros_like(group, dtype=torch.bool)
        kept[order] = rank < (counts[group[order]] * self.kept).ceil()
        return particles.select_rows(kept)

    def averaged(self, predict: Callable[[tuple[tuple[int, ...], ...]], Particles], n_levels: int) -> Particles:
        """The mean of what ``predict`` returns for several orders of the curves, of which it is given those of each
        level."""
        predictions = []
        for k in range(0, N_CURVES, N_CURVES // self.orders):
            predictions.append(predict((tuple((k + row) % N_CURVES for row in range(N_CURVES)),) * n_levels))
        rows = [prediction.row_fields() for prediction in predictions]
        floats = [name for name, value in rows[0].items() if value.is_floating_point()]
        means = {name: torch.stack([row[name] for row in rows]).mean(0) for name in floats}
        if "quats" in means:
            means["quats"] = torch.nn.functional.normalize(means["quats"], dim=-1)
        return dataclasses.replace(predictions[0], **means)


def read_speeds(folder: Path) -> dict[str, Any]:
    """All that is tuned in ``folder``, a mapping by digest of a checkpoint and kind of device; empty where nothing is.

    Raises:
        InputError: the file is damaged.
    """
    path = folder / SPEEDS_FILE
    if not path.is_file():
        return {}
    try:
        content = parse_json(read_file(path, MAX_TEXT))
    except ValueError as error:
        raise InputError(f"{path} cannot be read: {error}") from None
    if not isinstance(content, dict):
        raise InputError(f"{path} must hold a mapping of checkpoints")
    return content


def load_speed(folder: Path, digest: str | None, device: str, speed: str) -> Setting:
    """The setting that was tuned for a checkpoint in ``folder`` on this kind of device.

    Args:
        folder: of the weights.
        digest: that names the checkpoint.
        device: "cpu" or "cuda".
        speed: one of SPEEDS.
    Raises:
        InputError: it was not tuned; the message says how to.
    """
    if speed not in SPEEDS:
        raise InputError(f"speed: must be one of {', '.join(SPEEDS)}; got {speed!r}{did_you_mean(speed, SPEEDS)}")
    if speed == "exact":
        return Setting()
    found = read_speeds(folder)
    for key in (digest, device, speed):
        found = found.get(key)
        if not isinstance(found, dict):
            raise InputError(
                f"speed {speed}: this checkpoint is not tuned for {device} (in {folder / SPEEDS_FILE}); run "
                "gsim3d profile CHECKPOINT first"
            )
    return Setting.from_dict(found)


def require(name: str, value: object, fine: bool, what: str) -> None:
    if not fine:
        raise InputError(f"setting: {name} must be {what}; got {shown(value)}")


def short(value: object) -> str:
    return f"{value:.3g}" if isinstance(value, float) else str(value)
