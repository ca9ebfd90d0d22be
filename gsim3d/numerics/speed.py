"""Settings that trade accuracy for time, and the file of tuned settings in a checkpoint's folder."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from gsim3d.cameras import Cameras, Frames, FrameSource, InputSpec
from gsim3d.cuda_graphs import Prediction
from gsim3d.effects.edits import Edit
from gsim3d.effects.plan import Plan
from gsim3d.effects.spec import EffectsSpec, Sleep
from gsim3d.errors import InputError, check_one_of, check_ranges, check_whole
from gsim3d.io.files import shown
from gsim3d.io.settings import from_dict
from gsim3d.numerics.trust import MOST_LEFT_OUT, check_input, read_checkpoints, without_oldest
from gsim3d.ops.raster import CUTOFFS, Rendering
from gsim3d.presets import ModelConfig
from gsim3d.state import DYNAMIC, Particles

PRECISIONS = ("fp32", "tf32", "bf16", "fp16")
DTYPES = {"bf16": torch.bfloat16, "fp16": torch.float16}
PARTS = ("encoder", "dynamics", "renderer")
SPEEDS = ("exact", "balanced", "fast")
SPEEDS_FILE = "speeds.json"  # {digest of a checkpoint: {device type: {speed: setting}}}; see read_checkpoints


@dataclass(frozen=True)
class Setting:
    """Options of inference. The default is the reference: float32 without approximations."""

    #: precision, "fp32", "tf32", "bf16" or "fp16"; positions, codes, splats and sums are always float32
    encoder: str = "fp32"
    dynamics: str = "fp32"  #: precision of the dynamics
    renderer: str = "fp32"  #: precision of the renderer
    captured: bool = False  #: rolls out with ``graph="auto"``, from a CUDA graph when calls repeat
    context_views: int | None = None  #: input cameras; None: as in training
    history: int | None = None  #: input steps; None: as in training
    background: str | None = None  #: replaces ``EffectsSpec.dynamics.background``; None: as in training
    kept: float = 1.0  #: fraction of particles that are retained, the most opaque of the moving and of the other ones
    sh_degree: int | None = None  #: degree of rendered colours; None: the model's
    cutoff: str = "exact"  #: as in :func:`gsim3d.ops.rasterize_gaussians`
    patch_size: int | None = None  #: largest number of particles in a patch; None: the model's
    grid: float = 1.0  #: factor on the model's cell size
    least_opacity: float = 0.0  #: smallest opacity of rendered Gaussians; contributions below 1/255 are always skipped
    #: largest displacement of a particle at rest, which sleeps, in cells/step; None: as in training
    sleep: float | None = None

    def __post_init__(self):
        for name, known in {**dict.fromkeys(PARTS, PRECISIONS), "cutoff": CUTOFFS}.items():
            check_one_of(name, getattr(self, name), known)
        check_ranges(self, kept=(1e-6, 1), grid=(1e-3, 1e3), least_opacity=(0, 1), sleep=(0, 1e3), sh_degree=(0, 3))
        check_ranges(self, **dict.fromkeys(("context_views", "history", "patch_size"), (1, 1e6)))
        if self.captured and self.sleep is not None:
            raise InputError("captured does not fit sleep: a CUDA graph computes all particles")

    @property
    def name(self) -> str:
        """Text of the options that differ from the reference."""
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
        """The setting reduced to options of the encoder."""
        return Setting(encoder=self.encoder, context_views=self.context_views, history=self.history)

    def to_dict(self) -> dict[str, Any]:
        """Options that differ from the reference."""
        return {f.name: v for f in dataclasses.fields(self) if (v := getattr(self, f.name)) != f.default}

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> Setting:
        """Inverse of :meth:`to_dict`. Raises InputError for unknown keys and wrong types."""
        return from_dict(cls, values, "setting: ")

    @contextlib.contextmanager
    def precision(self, part: str, device: str) -> Iterator[None]:
        """Context with the precision of ``part`` and deterministic convolutions."""
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
        """The model's configuration with the cell and patch sizes of this setting; weights are unchanged."""
        dynamics = config.dynamics
        patches = tuple(min(size, self.patch_size or size) for size in dynamics.patch_sizes)
        changed = dataclasses.replace(dynamics, grid_size=dynamics.grid_size * self.grid, patch_sizes=patches)
        return config if changed == dynamics else dataclasses.replace(config, dynamics=changed)

    def of_effects(self, spec: EffectsSpec, is_asymmetric: bool) -> EffectsSpec:
        """Spec of a model trained for ``spec`` under this setting."""
        sleep = spec.dynamics.sleep
        if self.sleep is not None:
            sleep = Sleep(policy="approx" if is_asymmetric else "exact", eps=self.sleep)
        appearance, dynamics = spec.appearance, spec.dynamics
        given = {name: getattr(self, name) or getattr(dynamics, name) for name in ("history", "background")}
        dynamics = dataclasses.replace(dynamics, **given, sleep=None if self.captured else sleep)
        if self.sh_degree is not None:
            appearance = dataclasses.replace(appearance, view_dependent=self.sh_degree)
        return dataclasses.replace(spec, dynamics=dynamics, appearance=appearance)

    def of_inputs(self, inputs: InputSpec) -> InputSpec:
        """Input spec under this setting, from that of the training."""
        views = min(self.context_views or inputs.context_views, inputs.context_views)
        history = min(self.history or inputs.history, inputs.history)
        return dataclasses.replace(inputs, context_views=views, history=history)

    def retained(self, particles: Particles) -> Particles:
        """Selects the fraction ``kept`` of moving and of other particles in each cloud, the most opaque ones."""
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


def encode(simulator: Any, source: Frames | FrameSource, names: Sequence[str] = ()) -> Particles:
    """Encodes frames to the initial state of :func:`predict`; see :func:`encode_histories`."""
    return encode_histories(simulator, source, names, 0)[0]


def encode_histories(
    simulator: Any, source: Frames | FrameSource, names: Sequence[str] = (), left_out: int = MOST_LEFT_OUT
) -> list[Particles]:
    """Encodes frames, also without their 1 to ``left_out`` oldest steps, and warns as :func:`check_input` does, with
    ``names`` of the scenes. Raises InputError if the image size is wrong."""
    inputs = InputSpec() if simulator.inputs is None else simulator.inputs
    if not isinstance(source, Frames) and not hasattr(source, "input_frames"):
        kinds = f"a scene (gsim3d.data.Scene.open), Frames or Particles; got {type(source).__name__}"
        raise InputError(f"predict: source must be {kinds}")
    frames = source if isinstance(source, Frames) else source.input_frames(inputs)
    size = (frames.cameras.width, frames.cameras.height)
    if inputs.image_size and size != tuple(inputs.image_size):
        wanted, got = ("x".join(map(str, pixels)) for pixels in (inputs.image_size, size))
        scaled = f"Scene.open(folder, fitting=Fitting({tuple(inputs.image_size)})) scales them"
        raise InputError(f"predict: images must be {wanted} pixels, as in training; got {got}; {scaled}")
    setting, device = simulator.setting, next(simulator.parameters()).device
    frames, states = frames.to(device), []
    with setting.precision("encoder", device.type):
        for n_steps in range(left_out + 1):
            some = without_oldest(frames, n_steps)
            some = some.subsample(inputs.background_stride, inputs.body_stride, inputs.masks)
            states.append(setting.retained(simulator.encode(some)))
    check_input(simulator, frames, states[0], names)
    return states


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
    """:meth:`gsim3d.Simulator.predict` under the simulator's setting; ``options`` go to the rollout."""
    check_whole("predict: steps", steps)
    if not isinstance(cameras, Cameras | None):
        raise InputError(f"predict: cameras must be Cameras, such as scene.cameras_at([0], [0]); got {shown(cameras)}")
    state = source if isinstance(source, Particles) else encode(simulator, source)
    setting, device = simulator.setting, state.means.device
    with setting.precision("dynamics", device.type):
        graph = "auto" if setting.captured else None
        states = simulator.rollout(state, steps, plan, edits=edits, graph=graph, **options)
    images = []
    if cameras is not None:
        images = [draw(simulator, step, cameras.to(device), background, plan) for step in states]
    return Prediction(states, images)


def draw(
    simulator: Any, particles: Particles, cameras: Cameras, background: torch.Tensor | None, plan: Plan
) -> Rendering:
    """Renders predicted particles under the simulator's setting."""
    setting = simulator.setting
    if setting.least_opacity:
        particles = particles.select_rows(particles.opacities >= setting.least_opacity)
    with setting.precision("renderer", particles.means.device.type):
        return simulator._draw(particles, cameras, background, plan, cutoff=setting.cutoff)


def load_speed(folder: Path, digest: str | None, device: str, speed: str) -> Setting:
    """Reads the tuned setting of the checkpoint in ``folder`` for a device, "cpu" or "cuda", and one of SPEEDS. Raises
    InputError if the checkpoint is not tuned for this device."""
    check_one_of("speed:", speed, SPEEDS)
    if speed == "exact":
        return Setting()
    found = read_checkpoints(folder / SPEEDS_FILE)
    for key in (digest, device, speed):
        found = found.get(key)
        if not isinstance(found, dict):
            lacks = f"this checkpoint is not tuned for {device} (in {folder / SPEEDS_FILE})"
            raise InputError(f"speed {speed}: {lacks}; run gsim3d profile CHECKPOINT first")
    return Setting.from_dict(found)
