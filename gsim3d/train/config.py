"""Configuration of a training run. Attributes of each class are the keys of the YAML file of `gsim3d train`."""

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, Literal

import torch

from gsim3d.data import Fitting
from gsim3d.data.scene import SIZE_MULTIPLE
from gsim3d.dynamics import DynamicsConfig
from gsim3d.effects.plan import Plan
from gsim3d.errors import InputError, check_ranges
from gsim3d.io.settings import from_dict, to_dict, upgraded

MANY = 10**9  # upper limit of step counts
LARGEST_SIDE = 2**15  # pixels of an image
DTYPES = {"fp32": torch.float32, "bf16": torch.bfloat16, "fp16": torch.float16}

Precision = Literal["fp32", "bf16", "fp16"]


@dataclass(frozen=True)
class PhaseConfig:
    """A phase of the training. Phases run one after another with the same optimizer state."""

    steps: int  #: number of optimizer steps
    #: number of simulated steps after the encoded ones; 0 trains encoder and renderer only. Time and memory grow in
    #: proportion.
    horizon: int = 0
    #: largest number of simulated steps that gradients flow through; longer horizons are simulated in segments without
    #: gradients between them; with ``captured`` each has its backward pass before the next. 0: all.
    cut: int = 0
    history: int = 0  #: number of encoded steps; 0: ``data.history``
    batch: int = 1  #: scenes per optimizer step, over all processes
    target_views: int = 5  #: target images per step
    #: windows start within so many first steps of a scene; 0: anywhere. Bodies at rest teach little.
    begin_within: int = 0
    from_start: float = 0.0  #: fraction of the windows, 0 to 1, that start at a scene's first step
    learning_rate: float = 2e-4  #: peak learning rate of the phase's one-cycle schedule
    encoder_rate: float = 1.0  #: learning rate of the encoder, relative to the other parts
    warm_up: float = 0.01  #: fraction of the phase's steps, 0 to 1, until the peak

    REMOVED: ClassVar[dict] = {"lead": 0, "lit_before": 0, "dynamics_alone": False, "masked_out": 0}

    def __post_init__(self):
        check_ranges(self, steps=(1, MANY), batch=(1, 10**5), target_views=(1, 10**4), learning_rate=(0, 1))
        check_ranges(self, **dict.fromkeys(("horizon", "cut", "history"), (0, 10**5)))
        check_ranges(self, begin_within=(0, MANY), from_start=(0, 1), warm_up=(0, 1), encoder_rate=(0, 1e3))


@dataclass(frozen=True)
class DataConfig:
    """Frames and views of a sample."""

    history: int = 2  #: number of encoded steps (T of the paper)
    #: if above 0, every optimizer step draws its number of encoded steps from this to ``history``, so that the model
    #: supports all of them. A phase's own ``history`` takes precedence.
    shortest_history: int = 0
    context_views: int = 4  #: input images per step
    #: if above 0, every optimizer step draws its number of input images from this to ``context_views``
    fewest_views: int = 0
    context_cameras: tuple[int, ...] = ()  #: input cameras; empty: all but ``target_only_cameras``
    target_only_cameras: tuple[int, ...] = ()  #: cameras that are never an input, but may be a target
    #: every n-th row and column of the pixels of static geometry becomes a particle. Larger values are cheaper and blur
    #: the background.
    background_stride: int = 1
    body_stride: int = 1  #: every n-th row and column of the pixels of movable bodies becomes a particle
    masks: bool = True  #: read the labels of input images; if False, all their pixels are of movable bodies
    #: largest fraction, 0 to 1, of a scene's background that is presented to the dynamics as movable, drawn per scene
    #: and in cubes; augmentation for models with an asymmetric background, whose particles at rest may be awake or
    #: asleep
    unfrozen_background: float = 0.0
    #: standard deviation in metres along each axis of a displacement of the movable particles of each encoded step
    #: before simulation, smooth in space; training noise that the network learns to correct, as in graph network
    #: simulators. Evaluation and the images of the encoded steps have none.
    position_noise: float = 0.0
    #: (width, height) in pixels: images are resized to cover it and centre-cropped; empty: as recorded
    resize: tuple[int, ...] = ()
    near_far: tuple[float, ...] = ()  #: depth range of all scenes in metres; empty: each scene's own
    #: draw targets only from cameras that are not an input of the window. Otherwise a model can overfit to input views
    #: with tiny particles right in front of each camera.
    targets_apart: bool = False
    unit_cameras: bool = False  #: divide lengths by the largest coordinate of a scene's cameras
    #: targets are the input images, each drawn from the particles of the other cameras; for captures with few cameras.
    #: ``target_views`` has no effect.
    leave_one_out: bool = False
    subsample_fps: float = 0.0  #: take every k-th frame of a scene, so that it has this rate; 0: all frames

    RENAMED: ClassVar[dict] = {"thawed": "unfrozen_background"}

    def __post_init__(self):
        check_ranges(self, history=(1, 10**5), shortest_history=(0, 10**5), unfrozen_background=(0, 1))
        check_ranges(self, context_views=(1, 10**4), fewest_views=(0, 10**4))
        check_ranges(self, background_stride=(1, LARGEST_SIDE), body_stride=(1, LARGEST_SIDE))
        check_ranges(self, subsample_fps=(0, 1e6), position_noise=(0, 1e6))
        if self.leave_one_out and (min(self.fewest_views or 2, self.context_views) < 2 or self.targets_apart):
            raise InputError("data.leave_one_out: needs two input views or more, and targets_apart: false")
        for least, most in (("shortest_history", "history"), ("fewest_views", "context_views")):
            if getattr(self, least) > getattr(self, most):
                raise InputError(
                    f"data.{least}: must be at most data.{most}, {getattr(self, most)}; got {getattr(self, least)}"
                )
        sides = [side for side in self.resize if 1 <= side <= LARGEST_SIDE and side % SIZE_MULTIPLE == 0]
        if self.resize and not len(sides) == len(self.resize) == 2:
            wanted = f"must be [width, height], multiples of {SIZE_MULTIPLE} up to {LARGEST_SIDE}"
            raise InputError(f"data.resize: {wanted}; got {list(self.resize)}")
        if self.near_far and (len(self.near_far) != 2 or not 0 < self.near_far[0] < self.near_far[1]):
            raise InputError(f"data.near_far: must be [near, far] with 0 < near < far; got {list(self.near_far)}")
        if set(self.context_cameras) & set(self.target_only_cameras):
            raise InputError("data: context_cameras and target_only_cameras share a camera")

    @property
    def fitting(self) -> Fitting:
        """Conversion with which scenes are opened."""
        return Fitting(self.resize or None, self.near_far or None, self.unit_cameras)


@dataclass(frozen=True)
class LossConfig:
    """Weights of the loss."""

    #: weight of the first simulated step, 0 to 1; the encoded steps share the rest (lambda of the paper)
    balance: float = 0.5
    discount: float = 0.87  #: weight of a simulated step relative to the previous one, 0 to 1 (gamma of the paper)
    body_weight: float = 0.0  #: weight added to pixels of movable bodies; other pixels have weight 1
    #: sum logarithms, as in PSNR: of errors on bodies (times 1 + body_weight), elsewhere, of LPIPS (times perceptual)
    relative: bool = False
    #: weight of LPIPS (VGG), added to the squared error; 0.05 in the paper, 0.01 for its rigid bodies. Install its
    #: weights with `gsim3d weights lpips`.
    perceptual: float = 0.0
    #: multiply the colour channels of each camera's predicted images by the gains (2/3 to 3/2) that fit all its targets
    #: of the window best, relative to the scene's mean, for cameras that differ in exposure or white balance
    image_gain: bool = False

    REMOVED: ClassVar[dict] = {"shape": 0, "shape_length": ..., "bodies": 0}

    def __post_init__(self):
        check_ranges(self, balance=(0, 1), discount=(0, 1), body_weight=(0, 1e6), perceptual=(0, 1e6))


@dataclass(frozen=True)
class OptimizerConfig:
    """AdamW with gradient clipping and weight averaging."""

    beta1: float = 0.9  #: decay of the first moment, below 1
    beta2: float = 0.999  #: decay of the second moment, below 1
    eps: float = 1e-8  #: added to the root of the second moment
    weight_decay: float = 1e-3  #: decoupled weight decay, multiplied by the learning rate
    clip_norm: float = 0.5  #: largest global gradient norm; 0: no clipping
    #: decay of the exponential moving average of the weights, below 1; 0: no average. Only weights that a step updates
    #: are averaged in.
    ema_decay: float = 0.999
    #: number of consecutive steps with a loss or gradient that is not finite, after which training stops
    max_skipped: int = 20

    REMOVED: ClassVar[dict] = {"encoder_rate": 1.0}

    def __post_init__(self):
        check_ranges(self, **dict.fromkeys(("beta1", "beta2", "ema_decay"), (0, 1)))
        check_ranges(self, eps=(1e-12, 1), weight_decay=(0, 1e3), clip_norm=(0, 1e6))
        check_ranges(self, max_skipped=(1, MANY))
        for name in ("beta1", "beta2", "ema_decay"):
            if getattr(self, name) >= 1:
                raise InputError(f"optimizer.{name} must be below 1; got {getattr(self, name)}")


@dataclass(frozen=True)
class PrecisionConfig:
    """Input precision of matrix products, convolutions and attention: "fp32", "bf16" or "fp16".

    Weights, the residual stream, norms, positions, depths, curve codes, splats, losses, sums and the optimizer are
    always float32. "fp16" enables loss scaling, see :class:`gsim3d.train.optimizer.LossScale`.
    """

    encoder: Precision = "fp32"  #: precision of the encoder
    dynamics: Precision = "fp32"  #: precision of the dynamics
    renderer: Precision = "fp32"  #: precision of the renderer's head
    perceptual: Precision = "fp32"  #: precision of the convolutions of LPIPS in the loss

    @property
    def scales_loss(self) -> bool:
        """Whether the loss is scaled to keep float16 gradients from underflowing."""
        return "fp16" in (self.encoder, self.dynamics, self.renderer)

    def of(self, part: str, device: str) -> torch.autocast:
        """Returns the autocast context of ``part``, independent of surrounding contexts."""
        dtype = DTYPES[getattr(self, part)]
        return torch.autocast(device, dtype, enabled=dtype != torch.float32)


@dataclass(frozen=True)
class TrainConfig:
    """A training run."""

    #: phases, run one after another
    phases: tuple[PhaseConfig, ...] = (PhaseConfig(steps=1000), PhaseConfig(steps=4000, horizon=12))
    preset: str = "tiny"  #: model sizes, a function of gsim3d.presets such as ``tiny``
    #: overrides of the preset, nested like the model section of a checkpoint's config.yaml
    model: dict = dataclasses.field(default_factory=dict)
    #: .safetensors file of Depth Anything 3 or DINOv2 that a new run with ``backbone: vit_dpt`` starts from
    #: (:func:`gsim3d.compat.depth_weights.load_depth_weights`); empty: none
    pretrained_depth: str = ""
    #: effects to simulate, see :class:`gsim3d.effects.spec.EffectsSpec`
    effects: dict = dataclasses.field(default_factory=dict)
    data: DataConfig = DataConfig()  #: frames and views of a sample
    loss: LossConfig = LossConfig()  #: weights of the loss
    optimizer: OptimizerConfig = OptimizerConfig()  #: AdamW and weight averaging
    precision: PrecisionConfig = PrecisionConfig()  #: "fp32", "bf16" or "fp16" for each part of the model
    #: activation checkpointing of "encoder", "steps" (each simulated step) or "images"; saves memory with equal
    #: results. ``model.dynamics.checkpointing`` additionally checkpoints the blocks within a step.
    recompute: tuple[Literal["encoder", "steps", "images"], ...] = ()
    #: on a GPU, run steps as CUDA graphs (gsim3d.train.captured); faster if kernel launches dominate. Not supported
    #: with drop path, shuffled curves or batch normalisation. Results differ by rounding.
    captured: bool = False
    seed: int = 0  #: seed of all randomness, together with the step
    #: number of samples computed in parallel on shares of the CPU threads; results are equal for any number above 0. 0:
    #: the samples of a step form one batch, as required by GPUs and batch normalisation.
    workers: int = 0
    checkpoint_every: int = 500  #: steps between checkpoints; the last step is always saved
    keep_checkpoints: int = 2  #: number of checkpoints to keep
    log_every: int = 10  #: steps between log entries

    RENAMED: ClassVar[dict] = {"stages": "phases"}
    REMOVED: ClassVar[dict] = {"in_turn": [], "rounds": ...}

    def __post_init__(self):
        check_ranges(self, seed=(0, 2**63 - 1), workers=(0, 10**4), keep_checkpoints=(1, MANY))
        check_ranges(self, checkpoint_every=(1, MANY), log_every=(1, MANY))
        if not self.phases:
            raise InputError("phases: must contain at least one phase")

    @property
    def n_steps(self) -> int:
        """Number of optimizer steps of all phases."""
        return sum(phase.steps for phase in self.phases)

    def phase_of(self, step: int) -> tuple[PhaseConfig, int]:
        """Returns the phase of optimizer step ``step``, and the step's index in the phase."""
        for phase in self.phases:
            if step < phase.steps:
                return phase, step
            step -= phase.steps
        raise IndexError("step lies after the last phase")


# Settings that may change when a run is resumed, without changing the results up to rounding.
FREE_SETTINGS = ("captured", "checkpoint_every", "keep_checkpoints", "log_every", "pretrained_depth", "recompute")
# Settings of sections that may change when a run is resumed, to recover a diverged run; they change the results.
FREE_OF_SECTIONS = {"optimizer": ("clip_norm", "max_skipped"), "phases": ("learning_rate", "encoder_rate", "warm_up")}


def check_settings(config: TrainConfig, dynamics: DynamicsConfig, plan: Plan, n_processes: int = 1) -> None:
    """Raises InputError if settings contradict each other, the model or the number of processes."""
    for history in {config.data.history, *(phase.history for phase in config.phases if phase.horizon)}:
        if history > plan.history:
            raise InputError(f"data.history: {history} steps, but this model takes at most {plan.history}")
    if config.data.unfrozen_background and not dynamics.is_asymmetric:
        raise InputError('data.unfrozen_background: requires a model with background "asymmetric"')
    if config.workers and dynamics.norm == "batch":
        raise InputError("workers: must be 0 for a model with batch normalisation, which needs all samples at once")
    if config.captured and config.workers:
        raise InputError("captured: requires workers: 0")
    if config.workers and n_processes > 1:
        raise InputError(f"workers: must be 0 with {n_processes} processes, which already share the samples of a step")
    for i, phase in enumerate(config.phases):
        if phase.batch < n_processes:
            raise InputError(f"phases[{i}].batch: must be at least the {n_processes} processes; got {phase.batch}")


def check_same_run(config: TrainConfig, saved: dict, out: Path) -> None:
    """Raises InputError if the run in ``out`` was started with settings ``saved`` that differ from ``config``."""
    before = _fixed(to_dict(from_dict(TrainConfig, upgraded(TrainConfig, saved), base=config)))
    for name, value in _fixed(to_dict(config)).items():
        if name not in FREE_SETTINGS and before[name] != value:
            raise InputError(f"{out}: was started with a different {name!r}; restore it, or use another folder")


def _fixed(settings: dict) -> dict:
    """Returns the settings of a run without those that may change within sections."""
    fixed = {**settings, "workers": bool(settings["workers"])}
    for name, free in FREE_OF_SECTIONS.items():
        sections = settings[name] if isinstance(settings[name], list) else [settings[name]]
        fixed[name] = [{key: value for key, value in s.items() if key not in free} for s in sections]
    return fixed
