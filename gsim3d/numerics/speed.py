"""How a trained simulator is run, to trade accuracy for time; settings that were tuned lie in a file beside weights."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from gsim3d.cameras import Cameras, Frames, FrameSource, InputSpec
from gsim3d.cuda_graphs import CapturedRollout, Prediction
from gsim3d.effects.edits import Edit
from gsim3d.effects.plan import Plan
from gsim3d.effects.spec import EffectsSpec, Sleep
from gsim3d.errors import InputError, check_ranges, did_you_mean
from gsim3d.io.files import MAX_TEXT, read_file, shown
from gsim3d.io.plain import parse_json
from gsim3d.io.settings import from_dict
from gsim3d.ops.raster import CUTOFFS, Rendering
from gsim3d.presets import ModelConfig
from gsim3d.state import DYNAMIC, Particles

PRECISIONS = ("fp32", "tf32", "bf16", "fp16")
DTYPES = {"bf16": torch.bfloat16, "fp16": torch.float16}
PARTS = ("encoder", "dynamics", "renderer")
SPEEDS = ("exact", "balanced", "fast")
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
        least_opacity: Gaussians below it are not drawn; pixels leave out what is below 1/255 in any case.
        sleep: cells that a particle at rest moves in one step at most, and is not computed; None: as in training.
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
    least_opacity: float = 0.0
    sleep: float | None = None

    def __post_init__(self):
        for name, known in {**dict.fromkeys(PARTS, PRECISIONS), "cutoff": CUTOFFS}.items():
            if getattr(self, name) not in known:
                raise InputError(f"{name} must be one of {', '.join(known)}; got {shown(getattr(self, name))}")
        check_ranges(self, kept=(1e-6, 1), grid=(1e-3, 1e3), least_opacity=(0, 1), sleep=(0, 1e3), sh_degree=(0, 3))
        check_ranges(self, **dict.fromkeys(("context_views", "history", "patch_size"), (1, 1e6)))
        if self.captured and self.sleep is not None:
            raise InputError("captured does not fit sleep: a CUDA graph computes every particle")

    @property
    def name(self) -> str:
        """What differs from the reference, in words."""
        changed = self.to_dict()
        if precisions := {changed.pop(part, "fp32") for part in PARTS} - {"fp32"}:
            parts = [part for part in PARTS if getattr(self, part) != "fp32"]
            where = "" if len(parts) == len(PARTS) else f" {'+'.join(parts)}"
            changed = {"precision": f"{'/'.join(sorted(precisions))}{where}", **changed}
        if changed.pop("captured", False):
            changed = {"graph captured": "", **changed}
        values = {key: f"{v:.3g}" if isinstance(v, float) else v for key, v in changed.items()}
        return ", ".join(f"{key.replace('_', ' ')} {v}".strip() for key, v in values.items()) or "reference"

    @property
    def of_input(self) -> Setting:
        """What of it changes the encoder's work."""
        return Setting(encoder=self.encoder, context_views=self.context_views, history=self.history)

    def to_dict(self) -> dict[str, Any]:
        """Fields that differ from the reference."""
        return {f.name: v for f in dataclasses.fields(self) if (v := getattr(self, f.name)) != f.default}

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> Setting:
        """Raises InputError for an unknown key or a value of another type."""
        return from_dict(cls, values, "setting: ")

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


def encode(simulator: Any, source: Frames | FrameSource) -> Particles:
    """The particles from which :func:`predict` simulates. Raises InputError for images of another size."""
    inputs = InputSpec() if simulator.inputs is None else simulator.inputs
    frames = source if isinstance(source, Frames) else source.input_frames(inputs)
    size = (frames.cameras.width, frames.cameras.height)
    if inputs.image_size and size != tuple(inputs.image_size):
        wanted = "x".join(map(str, inputs.image_size))
        raise InputError(f"predict: images must be of {wanted} pixels, as in training; got {size[0]}x{size[1]}")
    setting, device = simulator.setting, next(simulator.parameters()).device
    frames = frames.subsample(inputs.background_stride, inputs.body_stride).to(device)
    with setting.precision("encoder", device.type):
        return setting.retained(simulator.encode(frames))


def predict(
    simulator: Any,
    source: Frames | FrameSource | Particles,
    steps: int,
    plan: Plan,
    cameras: Cameras | None,
    background: torch.Tensor | None,
    edits: Sequence[Edit],
    **options: Any,
) -> Prediction:
    """:meth:`gsim3d.Simulator.predict`, as the setting of the simulator says; ``options`` are those of the rollout."""
    if steps < 1:
        raise InputError(f"predict: steps must be at least 1; got {steps}")
    state = source if isinstance(source, Particles) else encode(simulator, source)
    setting, device = simulator.setting, state.means.device
    with setting.precision("dynamics", device.type):
        if setting.captured and not edits and device.type == "cuda":
            states = CapturedRollout(simulator, state, steps, plan)(state).steps
        else:
            states = simulator.rollout(state, steps, plan, edits=edits, **options)
    images = []
    if cameras is not None:
        images = [draw(simulator, step, cameras.to(device), background, plan) for step in states]
    return Prediction(states, images)


def draw(
    simulator: Any, particles: Particles, cameras: Cameras, background: torch.Tensor | None, plan: Plan
) -> Rendering:
    """Images of particles that ``simulator`` predicted, as its setting says."""
    setting = simulator.setting
    if setting.least_opacity:
        particles = particles.select_rows(particles.opacities >= setting.least_opacity)
    with setting.precision("renderer", particles.means.device.type):
        return simulator._draw(particles, cameras, background, plan, cutoff=setting.cutoff)


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
