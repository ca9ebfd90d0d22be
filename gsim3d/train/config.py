"""What a training run is."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Literal

from gsim3d.data import Fitting
from gsim3d.data.scene import SIZE_MULTIPLE
from gsim3d.errors import InputError, check_ranges
from gsim3d.train.losses import BALANCE, DISCOUNT
from gsim3d.train.precision import PrecisionConfig

MANY = 10**9  # steps; more than any run has
LARGEST_SIDE = 2**15  # pixels of an image


@dataclass(frozen=True)
class StageConfig:
    """A part of the training with one kind of sample; the optimizer runs through all parts.

    steps: optimizer steps.
    horizon: simulated steps after the encoded ones; 0 trains encoder and renderer alone.
    lead: in every other optimizer step, on average, so many steps are simulated before these, without loss and
        gradients: the model learns to go on from its own states, which a long rollout needs.
    lit_before: the background is first seen in an encoded step of its own, up to so many steps before the others: so a
        model that relights it learns what shadows do meanwhile, which is not simulated. Needs dynamics_alone.
    cut: gradients flow back through so many simulated steps at most: a longer horizon is simulated in parts, each of
        which begins where the one before ended; 0: through all.
    dynamics_alone: only the dynamics learns. Encoder and renderer compute without gradients, and encoded steps are not
        compared: a step costs less, so that there is time for more of them between those that train all parts. The
        weights of the simulated steps add up to 1.
    masked_out: share of the windows whose images show what may move alone, black elsewhere: an encoder that always saw
        a ground below bodies tells their depth from where they are above it. For stages without simulated steps, since
        bodies would land on what nobody sees; scenes need a segmentation.
    history: encoded steps; 0: as many as the data section says.
    batch: scenes a step, of all processes together.
    target_views: images of each step that the loss compares.
    begin_within: windows begin at one of so many first steps of a scene; 0: anywhere. Bodies that have come to rest
        teach little.
    from_start: share of the windows that begin at a scene's first step, whatever else is drawn.
    learning_rate: peak, reached after ``warm_up`` of the stage's steps, then falling (one cycle a stage).
    warm_up: share of the stage's steps.
    """

    steps: int
    horizon: int = 0
    lead: int = 0
    lit_before: int = 0
    cut: int = 0
    dynamics_alone: bool = False
    masked_out: float = 0.0
    history: int = 0
    batch: int = 1
    target_views: int = 5
    begin_within: int = 0
    from_start: float = 0.0
    learning_rate: float = 2e-4
    warm_up: float = 0.01

    def __post_init__(self):
        check_ranges(self, steps=(1, MANY), batch=(1, 10**5), target_views=(1, 10**4), learning_rate=(0, 1))
        check_ranges(self, **dict.fromkeys(("horizon", "lead", "lit_before", "cut", "history"), (0, 10**5)))
        check_ranges(self, begin_within=(0, MANY), from_start=(0, 1), warm_up=(0, 1), masked_out=(0, 1))
        for name in ("lead", "dynamics_alone"):
            if getattr(self, name) and not self.horizon:
                raise InputError(f"{name}: needs a horizon of 1 or more")
        if self.lit_before and not self.dynamics_alone:
            raise InputError("lit_before: needs dynamics_alone: true")
        if self.masked_out and self.horizon:
            raise InputError(f"masked_out: needs horizon: 0; got {self.horizon}")


@dataclass(frozen=True)
class DataConfig:
    """Which frames and views a sample shows.

    history: T, encoded steps.
    shortest_history: every optimizer step draws its number of encoded steps from here to ``history``, so that one model
        serves them all; 0: always ``history``. A stage with a history of its own keeps that.
    context_views: input images of each step.
    fewest_views: every optimizer step draws its number of input images from here to ``context_views``; 0: always all.
    context_cameras: the cameras they come from; empty: all but ``target_only_cameras``.
    target_only_cameras: cameras that are never an input; a loss may look at them.
    background_stride: of pixels that show what never moves, those on every n-th row and column become particles.
    body_stride: likewise, of pixels that show what may move.
    thawed: of every scene's background a share drawn from 0 to this one is shown to the dynamics as movable, by cubes:
        so a model with an asymmetric background learns that rows at rest may be awake or asleep.
    resize: (width, height) pixels: films are scaled to cover it and cropped around the centre; empty: as filmed.
    near_far: metres, the depth range of all scenes; empty: each scene's own.
    targets_apart: targets come from cameras that are no input of their window. Else a model may learn to show each
        input to its own camera only: particles right before it, too small to be seen by others.
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
    thawed: float = 0.0
    resize: tuple[int, ...] = ()
    near_far: tuple[float, ...] = ()
    targets_apart: bool = False
    unit_cameras: bool = False

    def __post_init__(self):
        check_ranges(self, history=(1, 10**5), shortest_history=(0, 10**5), thawed=(0, 1))
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
    """Weights of the loss: ``balance`` and ``discount`` as in :func:`gsim3d.train.losses.time_weights`.

    body_weight: extra weight of pixels that show a body that may move, relative to 1 of any other pixel.
    perceptual: weight of LPIPS (VGG) beside the squared error, 0.05 in the paper and 0.01 for its rigid bodies; its
        weights come with `gsim3d weights lpips`.
    bodies: weight of :func:`gsim3d.train.losses.body_errors` beside the squared error, of images of what may move
        alone: a body that others hide, or that is far from its place, is told where to go. Every image is made twice.
    shape: weight of :func:`gsim3d.train.losses.shape_errors` of simulated steps beside the squared error.
    shape_length: metres, how far apart pairs are whose distance should stay.
    """

    balance: float = BALANCE
    discount: float = DISCOUNT
    body_weight: float = 0.0
    perceptual: float = 0.0
    bodies: float = 0.0
    shape: float = 0.0
    shape_length: float = 0.2

    def __post_init__(self):
        check_ranges(self, balance=(0, 1), discount=(0, 1), shape_length=(1e-6, 1e6))
        check_ranges(self, **dict.fromkeys(("body_weight", "perceptual", "bodies", "shape"), (0, 1e6)))


@dataclass(frozen=True)
class OptimizerConfig:
    """AdamW, clipped at a global gradient norm.

    encoder_rate: learning rate of the encoder, relative to that of the other parts.
    ema_decay: of the averaged weights; 0: no averaging. A step counts for the weights that it moves.
    max_skipped: steps in a row whose loss or gradient is not finite, then the run stops. Fewer stop at a rare bad
        sample; more only take longer to tell that weights or data are beyond help.
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
class TrainConfig:
    """A training run.

    preset: the model's sizes, a function of gsim3d.presets such as ``tiny``.
    model: changes of the preset, nested like the model section of a checkpoint's config.yaml.
    effects: what a scene calls for, as :class:`gsim3d.effects.spec.EffectsSpec` reads it.
    stages: run one after another.
    in_turn, rounds: stages behind these that take turns: all of them one after another, so many times.
    precision: "fp32", "bf16" or "fp16" for each part of the model.
    recompute: parts of a step that the backward pass computes again instead of keeping them, which saves memory and
        changes no bit: "encoder", "steps" (all of a simulated step), "images". Beside "steps",
        ``model.dynamics.checkpointing`` halves what one simulated step holds and costs another pass.
    captured: on a GPU, steps run from CUDA graphs (gsim3d.train.captured): the same sums in fewer seconds where a step
        has more small kernels than the host can launch. For models without drop path, shuffled curves and batch
        normalisation; numbers differ from those without by rounding.
    seed: all randomness follows from it and from the step.
    workers: samples of a step that are computed at the same time, each on its share of the CPU threads; the numbers are
        the same for any count above 0. 0: a step's samples form one batch, as a GPU and batch normalisation want it.
    checkpoint_every, log_every: steps; the last step is always saved.
    keep_checkpoints: older ones are removed.
    """

    stages: tuple[StageConfig, ...] = (StageConfig(steps=1000), StageConfig(steps=4000, horizon=12))
    preset: str = "tiny"
    in_turn: tuple[StageConfig, ...] = ()
    rounds: int = 1
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

    def __post_init__(self):
        check_ranges(self, seed=(0, 2**63 - 1), workers=(0, 10**4), rounds=(1, MANY), keep_checkpoints=(1, MANY))
        check_ranges(self, checkpoint_every=(1, MANY), log_every=(1, MANY))
        if not self.stages:
            raise InputError("stages: at least one is needed")

    @property
    def all_stages(self) -> tuple[StageConfig, ...]:
        return (*self.stages, *self.in_turn)

    @property
    def n_steps(self) -> int:
        return _count(self.stages) + self.rounds * _count(self.in_turn)

    def stage_of(self, step: int) -> tuple[StageConfig, int]:
        """The stage that optimizer step ``step`` belongs to, and the step's place in it."""
        once = _count(self.stages)
        if once <= step < self.n_steps:
            step = once + (step - once) % _count(self.in_turn)
        for stage in self.all_stages:
            if step < stage.steps:
                return stage, step
            step -= stage.steps
        raise IndexError("step lies after the last stage")


def _is_side(pixels: int) -> bool:
    return 1 <= pixels <= LARGEST_SIDE and pixels % SIZE_MULTIPLE == 0


def _count(stages: tuple[StageConfig, ...]) -> int:
    return sum(stage.steps for stage in stages)
