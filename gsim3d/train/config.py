"""Settings of a training run. The attributes of each class are the keys of the YAML file that `gsim3d train` reads."""

from __future__ import annotations

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

MANY = 10**9  # steps; more than any run has
LARGEST_SIDE = 2**15  # pixels of an image
DTYPES = {"fp32": torch.float32, "bf16": torch.bfloat16, "fp16": torch.float16}

Precision = Literal["fp32", "bf16", "fp16"]


@dataclass(frozen=True)
class PhaseConfig:
    """A part of the training with one kind of sample. Phases follow one another; the optimizer goes on through all.

    Attributes:
        steps: optimizer steps.
        horizon: simulated steps after the encoded ones; 0 trains encoder and renderer alone. Longer ones teach longer
            rollouts and cost time and memory in proportion.
        cut: simulated steps that gradients flow back through at most: a longer horizon is simulated in segments, each
            of which begins where the one before ended; 0: through all.
        history: encoded steps; 0: as many as ``data.history``.
        batch: scenes in an optimizer step, of all processes together.
        target_views: images of each step that the loss compares.
        begin_within: windows begin at one of so many first steps of a scene; 0: anywhere. Bodies at rest teach little.
        from_start: share, 0 to 1, of the windows that begin at a scene's first step, whatever else is drawn.
        learning_rate: peak, reached after ``warm_up`` of the phase's steps, then falling (one cycle a phase).
        warm_up: share of the phase's steps, 0 to 1.
    """

    steps: int
    horizon: int = 0
    cut: int = 0
    history: int = 0
    batch: int = 1
    target_views: int = 5
    begin_within: int = 0
    from_start: float = 0.0
    learning_rate: float = 2e-4
    warm_up: float = 0.01

    REMOVED: ClassVar[dict] = {"lead": 0, "lit_before": 0, "dynamics_alone": False, "masked_out": 0}

    def __post_init__(self):
        check_ranges(self, steps=(1, MANY), batch=(1, 10**5), target_views=(1, 10**4), learning_rate=(0, 1))
        check_ranges(self, **dict.fromkeys(("horizon", "cut", "history"), (0, 10**5)))
        check_ranges(self, begin_within=(0, MANY), from_start=(0, 1), warm_up=(0, 1))


@dataclass(frozen=True)
class DataConfig:
    """Which frames and views a sample shows.

    Attributes:
        history: encoded steps (T of the paper).
        shortest_history: every optimizer step draws its number of encoded steps from here to ``history``, so that one
            model serves them all; 0: always ``history``. A phase with a history of its own keeps that.
        context_views: input images of each step.
        fewest_views: every optimizer step draws its number of input images from here to ``context_views``; 0: always
            all.
        context_cameras: the cameras they come from; empty: all but ``target_only_cameras``.
        target_only_cameras: cameras that are never an input; the loss may compare them.
        background_stride: pixels; of the pixels that show what never moves, every n-th row and column becomes
            particles. Larger ones cost less and blur the background.
        body_stride: the same, of the pixels that show what may move.
        unfrozen_background: of every scene's background a share drawn from 0 to this one (0 to 1) is shown to the
            dynamics as movable, by cubes, so that a model with an asymmetric background learns that particles at rest
            may be awake or asleep.
        resize: (width, height) pixels: images are scaled to cover it and cropped around the centre; empty: as recorded.
        near_far: metres, the depth range of all scenes; empty: each scene's own.
        targets_apart: targets come from cameras that are no input of their window. Else a model may learn to show each
            input to its own camera only: particles right before it, too small for others to see.
        unit_cameras: lengths are in units of the largest coordinate of a scene's cameras.
    """

    history: int = 2
    shortest_history: int = 0
    context_views: int = 4
    fewest_views: int = 0
    context_cameras: tuple[int, ...] = ()
    target_only_cameras: tuple[int, ...] = ()
    background_stride: int = 1
    body_stride: int = 1
    unfrozen_background: float = 0.0
    resize: tuple[int, ...] = ()
    near_far: tuple[float, ...] = ()
    targets_apart: bool = False
    unit_cameras: bool = False

    RENAMED: ClassVar[dict] = {"thawed": "unfrozen_background"}

    def __post_init__(self):
        check_ranges(self, history=(1, 10**5), shortest_history=(0, 10**5), unfrozen_background=(0, 1))
        check_ranges(self, context_views=(1, 10**4), fewest_views=(0, 10**4))
        check_ranges(self, background_stride=(1, LARGEST_SIDE), body_stride=(1, LARGEST_SIDE))
        for least, most in (("shortest_history", "history"), ("fewest_views", "context_views")):
            if getattr(self, least) > getattr(self, most):
                raise InputError(
                    f"data.{least}: must be at most data.{most}, {getattr(self, most)}; got {getattr(self, least)}"
                )
        if self.resize and (len(self.resize) != 2 or not all(map(_is_side, self.resize))):
            wanted = f"must be [width, height], multiples of {SIZE_MULTIPLE} up to {LARGEST_SIDE}"
            raise InputError(f"data.resize: {wanted}; got {list(self.resize)}")
        if self.near_far and (len(self.near_far) != 2 or not 0 < self.near_far[0] < self.near_far[1]):
            raise InputError(f"data.near_far: must be two rising distances above 0; got {list(self.near_far)}")
        if set(self.context_cameras) & set(self.target_only_cameras):
            raise InputError("data: context_cameras and target_only_cameras share a camera")

    @property
    def fitting(self) -> Fitting:
        """How scenes are to be opened."""
        return Fitting(self.resize or None, self.near_far or None, self.unit_cameras)


@dataclass(frozen=True)
class LossConfig:
    """Weights of the loss.

    Attributes:
        balance: weight of the first simulated step, 0 to 1; the encoded steps share the rest (lambda of the paper).
        discount: weight of a simulated step relative to the one before it, 0 to 1 (gamma of the paper).
        body_weight: extra weight of pixels that show a body that may move, relative to 1 of any other pixel.
        perceptual: weight of LPIPS (VGG) beside the squared error, 0.05 in the paper and 0.01 for its rigid bodies; its
            weights come with `gsim3d weights lpips`.
    """

    balance: float = 0.5
    discount: float = 0.87
    body_weight: float = 0.0
    perceptual: float = 0.0

    REMOVED: ClassVar[dict] = {"bodies": 0, "shape": 0, "shape_length": ...}

    def __post_init__(self):
        check_ranges(self, balance=(0, 1), discount=(0, 1), body_weight=(0, 1e6), perceptual=(0, 1e6))


@dataclass(frozen=True)
class OptimizerConfig:
    """AdamW, clipped at a global gradient norm.

    Attributes:
        beta1: decay of the averaged gradient, below 1.
        beta2: decay of the averaged squared gradient, below 1.
        eps: added to the root of the averaged square.
        weight_decay: relative to the learning rate.
        clip_norm: largest norm of all gradients together; 0: no clipping.
        encoder_rate: learning rate of the encoder, relative to that of the other parts.
        ema_decay: of the averaged weights, below 1; 0: no averaging. A step counts for the weights that it moves.
        max_skipped: steps in a row whose loss or gradient is not finite, then the run stops. Lower ones stop at a rare
            bad sample; higher ones only take longer to find that weights or data are beyond help.
    """

    beta1: float = 0.9
    beta2: float = 0.999
    eps: float = 1e-8
    weight_decay: float = 1e-3
    clip_norm: float = 0.5
    encoder_rate: float = 1.0
    ema_decay: float = 0.999
    max_skipped: int = 20

    def __post_init__(self):
        check_ranges(self, **dict.fromkeys(("beta1", "beta2", "ema_decay"), (0, 1)))
        check_ranges(self, eps=(1e-12, 1), weight_decay=(0, 1e3), clip_norm=(0, 1e6), encoder_rate=(0, 1e3))
        check_ranges(self, max_skipped=(1, MANY))
        for name in ("beta1", "beta2", "ema_decay"):
            if getattr(self, name) >= 1:
                raise InputError(f"optimizer.{name} must be below 1; got {getattr(self, name)}")


@dataclass(frozen=True)
class PrecisionConfig:
    """What matrix products, convolutions and attention of each part read: "fp32", "bf16" or "fp16".

    Weights, the residual stream, norms, positions, depths, curve codes, splats, losses, sums and the optimizer are
    float32 throughout. With "fp16" anywhere the loss is scaled, see :class:`gsim3d.train.optimizer.LossScale`.

    Attributes:
        encoder: of the encoder.
        dynamics: of the dynamics.
        renderer: of the renderer's head.
    """

    encoder: Precision = "fp32"
    dynamics: Precision = "fp32"
    renderer: Precision = "fp32"

    @property
    def scales_loss(self) -> bool:
        """Whether gradients could be too small for their numbers."""
        return "fp16" in (self.encoder, self.dynamics, self.renderer)

    def of(self, part: str, device: str) -> torch.autocast:
        """A context in which ``part`` computes as configured, whatever context is around it."""
        dtype = DTYPES[getattr(self, part)]
        return torch.autocast(device, dtype, enabled=dtype != torch.float32)


@dataclass(frozen=True)
class TrainConfig:
    """A training run.

    Attributes:
        phases: run one after another.
        preset: the model's sizes, a function of gsim3d.presets such as ``tiny``.
        model: changes of the preset, nested like the model section of a checkpoint's config.yaml.
        effects: what a scene calls for, as :class:`gsim3d.effects.spec.EffectsSpec` reads it.
        data: frames and views of a sample.
        loss: weights of the loss.
        optimizer: AdamW and averaging.
        precision: "fp32", "bf16" or "fp16" for each part of the model.
        recompute: parts of a step that the backward pass computes again instead of storing them, which saves memory and
            changes no bit: "encoder", "steps" (all of a simulated step), "images". Beside "steps",
            ``model.dynamics.checkpointing`` halves what one simulated step stores and costs another pass.
        captured: on a GPU, steps run from CUDA graphs (gsim3d.train.captured): the same sums in fewer seconds where a
            step has more small kernels than the host can launch. For models without drop path, shuffled curves and
            batch normalisation; numbers differ from those without by rounding.
        seed: all randomness follows from it and from the step.
        workers: samples of a step that are computed at the same time, each on its share of the CPU threads; the numbers
            are the same for any count above 0. 0: a step's samples form one batch, as GPUs and batch norm want it.
        checkpoint_every: steps between checkpoints; the last step is always saved.
        keep_checkpoints: older ones are removed.
        log_every: steps between lines of the log.
    """

    phases: tuple[PhaseConfig, ...] = (PhaseConfig(steps=1000), PhaseConfig(steps=4000, horizon=12))
    preset: str = "tiny"
    model: dict = dataclasses.field(default_factory=dict)
    effects: dict = dataclasses.field(default_factory=dict)
    data: DataConfig = DataConfig()
    loss: LossConfig = LossConfig()
    optimizer: OptimizerConfig = OptimizerConfig()
    precision: PrecisionConfig = PrecisionConfig()
    recompute: tuple[Literal["encoder", "steps", "images"], ...] = ()
    captured: bool = False
    seed: int = 0
    workers: int = 0
    checkpoint_every: int = 500
    keep_checkpoints: int = 2
    log_every: int = 10

    RENAMED: ClassVar[dict] = {"stages": "phases"}
    REMOVED: ClassVar[dict] = {"in_turn": [], "rounds": ...}

    def __post_init__(self):
        check_ranges(self, seed=(0, 2**63 - 1), workers=(0, 10**4), keep_checkpoints=(1, MANY))
        check_ranges(self, checkpoint_every=(1, MANY), log_every=(1, MANY))
        if not self.phases:
            raise InputError("phases: at least one is needed")

    @property
    def n_steps(self) -> int:
        """Optimizer steps of all phases."""
        return sum(phase.steps for phase in self.phases)

    def phase_of(self, step: int) -> tuple[PhaseConfig, int]:
        """The phase that optimizer step ``step`` belongs to, and the step's number in it."""
        for phase in self.phases:
            if step < phase.steps:
                return phase, step
            step -= phase.steps
        raise IndexError("step lies after the last phase")


def _is_side(pixels: int) -> bool:
    return 1 <= pixels <= LARGEST_SIDE and pixels % SIZE_MULTIPLE == 0


# May change between two runs of one folder without changing the curve; so may the number of workers, if there are any.
FREE_SETTINGS = ("captured", "checkpoint_every", "keep_checkpoints", "log_every", "recompute")
# May change as well, so that a run which diverged can go on; the curve is another one from there on.
FREE_OF_SECTIONS = {"optimizer": ("clip_norm", "max_skipped"), "phases": ("learning_rate", "warm_up")}


def check_settings(config: TrainConfig, dynamics: DynamicsConfig, plan: Plan, n_processes: int = 1) -> None:
    """Raises InputError where settings do not go together, or do not fit the model or the number of processes."""
    for history in {config.data.history, *(phase.history for phase in config.phases if phase.horizon)}:
        if history > plan.history:
            raise InputError(f"data.history: {history} steps, but this model sees up to {plan.history}")
    if config.data.unfrozen_background and not dynamics.is_asymmetric:
        raise InputError(
            'data.unfrozen_background: needs a model of background "asymmetric"; others do not know frozen particles'
        )
    if config.workers and dynamics.norm == "batch":
        raise InputError("workers: must be 0 for a model with batch normalisation, which needs all samples at once")
    if config.captured and config.workers:
        raise InputError("captured: needs workers 0")
    if config.workers and n_processes > 1:
        raise InputError(f"workers: must be 0 in {n_processes} processes, which share the samples of a step themselves")
    for i, phase in enumerate(config.phases):
        if phase.batch < n_processes:
            raise InputError(f"phases[{i}].batch: {phase.batch} samples are too few for {n_processes} processes")


def check_same_run(config: TrainConfig, saved: dict, out: Path) -> None:
    """Raises InputError where the run in ``out``, whose settings are ``saved``, was started with another ``config``."""
    before = _fixed(to_dict(from_dict(TrainConfig, upgraded(TrainConfig, saved), base=config)))
    for name, value in _fixed(to_dict(config)).items():
        if name not in FREE_SETTINGS and before[name] != value:
            raise InputError(f"{out}: was started with another {name!r}; use the same or another folder")


def _fixed(settings: dict) -> dict:
    """A run's settings without those parts of its sections that may change."""
    fixed = {**settings, "workers": bool(settings["workers"])}
    for name, free in FREE_OF_SECTIONS.items():
        sections = settings[name] if isinstance(settings[name], list) else [settings[name]]
        fixed[name] = [{key: value for key, value in s.items() if key not in free} for s in sections]
    return fixed
