"""How the simulators that come with gsim3d are trained: recipes, and a trainer that goes by the clock."""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from types import MappingProxyType

import torch

from gsim3d.errors import HardCaseError
from gsim3d.generate.stage import GRAVITY
from gsim3d.generate.world import World
from gsim3d.generate.worlds import build_world
from gsim3d.train.captured import CapturedLoss, Prepared
from gsim3d.train.config import DataConfig, LossConfig, OptimizerConfig, StageConfig, TrainConfig
from gsim3d.train.films import Filming, FilmStore
from gsim3d.train.log import memory_gib
from gsim3d.train.loop import Trainer, deterministic
from gsim3d.train.precision import PrecisionConfig
from gsim3d.train.processes import Processes
from gsim3d.train.samples import Batch
from gsim3d.train.sittings import Progress, save_state

FIRST_FILMS = 32  # before training begins
SEED, HELD_OUT_SEED = 20261208, 77  # of the trajectories; `gsim3d generate` without --seed makes others
WARM_UP = 40  # steps at the beginning of a sitting
COOL_DOWN = 0.25  # of a sitting's training, in which the learning rate falls to LAST_RATE of its peak
LAST_RATE = 0.03
SAVE_EVERY = 120.0  # seconds


@dataclass(frozen=True)
class Recipe:
    """How one simulator is trained.

    world, options: `gsim3d generate WORLD --preset diverse`, and options to change.
    in_turn: further options; trajectories are made with one set of them after another.
    capacity: trajectories that are kept at a time.   held_out: that are predicted and scored at the end of a sitting.
    first_films: before training begins.
    begin_with: simulator whose weights a run begins with; None: random ones.
    """

    world: str
    train: TrainConfig
    options: dict = field(default_factory=dict)
    in_turn: tuple[dict, ...] = ({},)
    capacity: int = 600
    held_out: int = 14
    first_films: int = FIRST_FILMS
    begin_with: str | None = None

    def worlds(self) -> list[World]:
        """What makes its trajectories, in turn."""
        changes = [{"seed": SEED, **self.options, **options} for options in self.in_turn]
        return [build_world(self.world, "diverse", options) for options in changes]


# `small` with a lighter encoder, so that three sets of weights in 16 bits stay below 25 MB; without drop path and
# shuffled curves, as the runs are far too short to overfit. Particles begin large and cannot become very small, targets
# come from other cameras and the depth range is tight: else, within ten steps, all particles hide before their cameras.
MODEL = {
    "encoder": {"transformer_layers": 3, "refine_unet_dim": 24},
    "dynamics": {
        "drop_path": 0.0,
        "shuffle_orders": False,
        "motion_length": 0.3,
        "lights": ((0.36, 0.24, 0.9),),  # the lamp of the worlds; training may turn it
        "velocity": True,
        "deformation": True,
        "turning": True,
        "position_waves": 4,
        "background": "relit",  # what shadows change would add up else
        "max_latent_step": 8.0,  # of latents of size 4: from lit to dark at once
    },
    "renderer": {"scale_min": 0.002, "initial_scale": 0.03},
}


MASKED_OUT = 0.3  # of windows of images: bodies are seen where there is no ground, too
BEGINNING = 100, 200, 400  # steps of the dynamics alone: how things move right now, in short rollouts, with other light
TURN = 10, 30, 50  # likewise, in each round: with other light, in short rollouts, in long ones


def _recipe(
    world: str,
    near_far: tuple[float, float],
    begin_within: int,
    *,
    rollouts_within: int | None = None,
    strides: tuple[int, int] = (3, 2),
    batch: int = 4,
    rollout: tuple[int, int] = (48, 24),
    images: tuple[int, int] = (400, 20),
    beginning: tuple[int, int, int] = BEGINNING,
    rate: float = 8e-4,
    lit_before: int = 40,
    contact_length: float = 0.15,
    shape: float = 0.005,
    shape_length: float = 0.2,
    surfaces: bool = False,
    flies: bool = False,
    solid: bool = False,
    changing: str = "all",
    recompute: tuple[str, ...] = (),
    capacity: int = 600,
    options: Mapping = MappingProxyType({}),
    in_turn: tuple[dict, ...] = ({},),
) -> Recipe:
    """A recipe in which encoder and renderer learn from images of many scenes, and in turn with them the dynamics.

    A joint step of 12 simulated steps spends almost half of its time in the encoder, mostly on the way back.

    begin_within: of images.   rollouts_within: windows of rollouts begin within so many steps; None: twice as many.
    strides: of the pixels of ground and bodies.
    batch: scenes in steps with other light are four times as many, in short rollouts twice.
    rollout: their steps, and through how many of them gradients flow back.
    images: steps of images before all others, and in each round; more where the encoder does not know the world yet.
    beginning: steps behind the images, before the rounds; 0 where the weights that a run begins with know how things
        move.
    rate: of learning, of short rollouts; long ones have three quarters of it.
    lit_before: as of StageConfig, in rollouts of two steps.
    contact_length: as of DynamicsConfig; more than bodies fall in a step.
    shape, shape_length: as of LossConfig; the length less than bodies are apart.
    surfaces: as of DynamicsConfig; what rests then changes in the light alone.
    recompute: as of TrainConfig.
    flies: with the world's gravity, and pushes, as of DynamicsConfig: not where bodies touch no more than what moves.
    solid: as of DynamicsConfig.
    changing: as of AppearanceEffects.
    Others as in Recipe.
    """
    # All views that are no input: what images cost beside the encoder is little.
    # At a rate of 1e-3 a good encoder was lost twice, for hundreds of steps.
    seen = partial(StageConfig, history=1, batch=16, target_views=8, begin_within=begin_within, learning_rate=3e-4)
    seen = partial(seen, masked_out=MASKED_OUT)
    within = 2 * begin_within if rollouts_within is None else rollouts_within
    dynamics = partial(StageConfig, dynamics_alone=True, target_views=3, begin_within=within)
    short = partial(dynamics, horizon=12, batch=2 * batch, from_start=0.25, learning_rate=rate)
    lit = partial(dynamics, begin_within=begin_within // 2, horizon=2, lit_before=lit_before)
    lit = partial(lit, batch=4 * batch, learning_rate=rate)
    horizon, cut = rollout
    fps = build_world(world, "diverse", {}).fps
    first = (
        partial(dynamics, horizon=4, batch=2 * batch, from_start=0.1, learning_rate=rate),
        short,
        lit,  # where shadows are, before they follow what was simulated
    )
    train = TrainConfig(
        preset="small",
        model={
            **MODEL,
            "dynamics": {
                **MODEL["dynamics"],
                "contact_length": contact_length,
                "surfaces": surfaces,
                "gravity": (0.0, 0.0, -GRAVITY / fps**2) if flies else None,
                "pushes": flies,
                "solid": solid,
            },
        },
        # How a look differs from the one that it had at first: bodies turn in the light, and shadows fall. From step to
        # step what is rendered in the wrong place would learn to fade, not where to go.
        effects={"appearance": {"changing": changing}},
        data=DataConfig(
            history=4,
            context_views=4,
            target_only_cameras=(2, 7),
            background_stride=strides[0],
            body_stride=strides[1],
            resize=(128, 128),
            near_far=near_far,
            targets_apart=True,
        ),
        stages=(
            seen(steps=images[0]),
            *(stage(steps=steps) for stage, steps in zip(first, beginning, strict=True) if steps),
        ),
        in_turn=(
            seen(steps=images[1]),
            lit(steps=TURN[0]),
            short(steps=TURN[1]),
            dynamics(
                steps=TURN[2],
                horizon=horizon,
                cut=cut,
                batch=batch,
                from_start=0.5,
                learning_rate=0.75 * rate,
            ),
        ),
        rounds=100_000,
        # A score counts the last step like the first. What the ground hides would leave its body unseen.
        loss=LossConfig(
            body_weight=3.0, balance=0.15, discount=0.98, bodies=1.0, shape=shape, shape_length=shape_length
        ),
        optimizer=OptimizerConfig(clip_norm=1.0, ema_decay=0.995),
        precision=PrecisionConfig(encoder="bf16", dynamics="bf16"),
        recompute=recompute,
        captured=True,
        log_every=20,
    )
    return Recipe(world, train, dict(options), in_turn, capacity, begin_with=f"{world}-small")


# Where cameras are the same in all films, an encoder knows depths by heart. The held-out sets have those in the middle.
OTHER_CAMERAS = {"camera_spread": 0.06}
# Lower than the held-out grounds, of 15 to 30 cm.
OTHER_GROUND = {"ground_height": (-0.25, 0.14)}
# From low above the ground, at metres a second: bodies that rise are rare else.
THROWN_UP = {"drop_height": (0.05, 0.5), "lift": (0.5, 2.5)}
RECIPES = {
    # Bodies fall for half a second, jump, and then hardly move. Rollouts begin before they land: one that is squeezed
    # where a rollout begins looks like one that was made so. The ground is seen with more particles than elsewhere, as
    # more than half of what encoded images miss is at the edges of its squares. All graphs together take 81 GiB; where
    # a GPU has less they share what there is.
    "elastic": _recipe(
        "elastic",
        (1.75, 5.0),
        24,
        rollouts_within=12,
        strides=(2, 2),
        rollout=(48, 24),
        recompute=("steps",),
        images=(60, 30),
        beginning=(0, 0, 0),
        rate=6e-4,
        shape=0.015,
        surfaces=True,
        flies=True,
        changing="dynamic",
        capacity=200,
        in_turn=({}, {}, {}, THROWN_UP, OTHER_GROUND),
    ),
    # A cloth swings to the end and fills half of an image: more particles, and less memory for trajectories and graphs.
    "cloth": _recipe(
        "cloth",
        (1.6, 4.8),
        0,
        strides=(4, 2),
        batch=2,
        rollout=(36, 18),
        images=(60, 120),
        beginning=(0, 0, 0),
        rate=6e-4,
        shape=0.015,
        shape_length=0.1,
        recompute=("steps",),
        capacity=120,
    ),
    # Where a body comes to after it has landed nobody knows: looks that may change learn to be blurred and dark there,
    # from the first step on.
    "rigid": _recipe(
        "rigid",
        (1.7, 5.2),
        12,
        rollout=(24, 12),
        images=(60, 60),
        beginning=(0, 0, 100),
        lit_before=20,
        contact_length=0.4,
        shape=0.2,
        shape_length=0.15,
        surfaces=True,
        flies=True,
        solid=True,
        changing="none",
        options=OTHER_CAMERAS,
        in_turn=({}, {}, OTHER_GROUND),
    ),
}


class SittingTrainer(Trainer):
    """Trains on what a store holds, at a rate that follows the clock: it rises, stays and falls in every sitting.

    Each of several processes draws a batch of the configuration's size from a store of its own; all go by the clock of
    the first one.
    """

    def __init__(
        self, config: TrainConfig, store: FilmStore, out: Path, device: str, processes: Processes | None = None
    ):
        self.store = store
        config = _for_all(config, processes.count if processes else 1)
        super().__init__(config, store.films[:1], out, device=device, processes=processes)
        self.first_step, self.begin, self.now, self.end = 0, 0.0, 0.0, math.inf
        self._side = torch.cuda.Stream() if device == "cuda" else None
        self._next: tuple[int, Future] | None = None

    def _capture(self) -> CapturedLoss:
        captured = super()._capture()
        captured.alone, captured.meanwhile = self.store.lock, self._draw_next
        return captured

    def begin_sitting(self, end: float) -> None:
        """From now to ``end``, on the clock of time.monotonic."""
        self.processes.check_same(weights=self.parameters.values())
        self.begin, self.end = self.processes.gather((time.monotonic(), end))[0]
        self.first_step, self.now = self.step, self.begin
        self.out.mkdir(parents=True, exist_ok=True)
        self.simulator.train()

    def goes_on(self) -> bool:
        """Looks at the clock: whether the sitting is not over."""
        self.now = self.processes.gather(time.monotonic())[0]
        return self.now < self.end

    def learning_rate(self, stage: StageConfig, place: int) -> float:
        rise = min(1.0, (self.step - self.first_step + 1) / WARM_UP)
        left = (self.end - self.now) / max(1e-9, self.end - self.begin)
        fall = min(1.0, max(0.0, left) / COOL_DOWN)
        return stage.learning_rate * rise * (LAST_RATE + (1 - LAST_RATE) * fall)

    def _batch(self, samples: list[int]) -> Batch:
        return self._draw(self.step, samples)

    def _draw(self, step: int, samples: Sequence[int]) -> Batch:
        stage, _ = self.config.stage_of(step)
        return self.store.draw(self.config.data, stage, self.config.seed, step, samples)

    def _prepared(self, samples: list[int]) -> Prepared:
        """Drawn while the GPU computed the step before."""
        ahead = self._next if self._next is not None and self._next[0] == self.step else self._begin_to_draw(self.step)
        # The last one was copied by a step that is over: only now may its memory be used anew.
        self._read = ahead[1].result()
        return self._read

    def _draw_next(self) -> None:
        self._next = self._begin_to_draw(self.step + 1)

    def _begin_to_draw(self, step: int) -> tuple[int, Future]:
        return step, self._reader.submit(self._draw_beside, step)

    @torch.no_grad()
    def _draw_beside(self, step: int) -> Prepared:
        """Draws a batch on a stream of its own."""
        stage, _ = self.config.stage_of(step)
        if self._side is not None:
            torch.cuda.set_device(self._side.device)  # of this thread
        with self.store.lock, torch.cuda.stream(self._side):
            prepared = self.captured.prepare(self._draw(step, self.processes.share(stage.batch)))
            if self._side is not None:
                self._side.synchronize()
        return prepared


def _for_all(config: TrainConfig, n_processes: int) -> TrainConfig:
    """``config`` with batches of so many processes together."""
    larger = {
        name: tuple(dataclasses.replace(stage, batch=n_processes * stage.batch) for stage in getattr(config, name))
        for name in ("stages", "in_turn")
    }
    return dataclasses.replace(config, **larger)


def train(
    trainer: SittingTrainer,
    filming: Filming,
    progress: Progress,
    sitting: dict,
    *,
    end: float,
    out: Path,
    name: str,
    say: Callable[[str], None] = print,
) -> None:
    """Trains until the clock (time.monotonic) shows ``end``, saves now and then and at last.

    Args:
        progress: before this sitting.
        sitting: what the progress will say of it, beside steps, seconds and trajectories.
        out, name: where the state goes.
        say: is told of every logged step.
    Raises:
        HardCaseError: too many steps in a row met numbers that cannot be used.
    """
    steps, seconds, settings, gather = trainer.step, trainer.seconds, trainer.config, trainer.processes.gather

    def save() -> None:
        done = {
            **sitting,
            "steps": [steps, trainer.step],
            "training_seconds": round(trainer.seconds - seconds, 1),
            "trajectories": sum(gather(filming.count)),
        }
        known = {"next_trajectory": max(gather(filming.next)), "sittings": [*progress.sittings, done]}
        if trainer.captured:
            for needed in gather(trainer.captured.needed):
                trainer.captured.make_room(needed)
            known["needed"] = trainer.captured.needed
        if trainer.processes.is_first:
            save_state(trainer, out, name, dataclasses.replace(progress, **known))

    trainer.begin_sitting(end)
    saved = trainer.begin
    with deterministic(), trainer.log.opened(tensorboard=False):
        while trainer.goes_on():
            start = time.perf_counter()
            entry = trainer.train_step()
            spent = time.perf_counter() - start
            trainer.seconds += spent
            if entry["step"] % settings.log_every == 0 or "skipped" in entry:
                machine = {"seconds": trainer.seconds, "step_seconds": spent, "memory_gib": memory_gib(trainer.device)}
                entry |= {
                    "trajectories": sum(gather(filming.count)),
                    "captures": trainer.captured.captures if trainer.captured else 0,
                }
                trainer.log.write(entry, machine)
                say(line(entry, machine))
            if trainer.n_skipped_in_a_row >= settings.optimizer.max_skipped:
                raise HardCaseError(f"{name}: step {entry['step']}: {entry['skipped']}", step=entry["step"])
            filming.check()
            if trainer.now - saved > SAVE_EVERY:
                save()
                saved = trainer.now
    save()
    trainer.processes.check_same(weights=trainer.parameters.values())


def line(entry: dict, machine: dict) -> str:
    """What is said of a step."""
    if "skipped" in entry:  # its numbers may be none
        return f"step {entry['step']:6d}  skipped: {entry['skipped']}"
    known = {name: entry.get(f"{name}_psnr") for name in ("past", "future")}
    decibels = " ".join(f"{name} {value:.2f}" for name, value in known.items() if isinstance(value, float))
    return (
        f"step {entry['step']:6d}  loss {entry['loss']:.5f}  {decibels} dB  "
        f"norm {entry['grad_norm']:.3f}  rate {entry['learning_rate']:.1e}  {machine['step_seconds']:.3f} s  "
        f"{machine['memory_gib']:.1f} GiB  {entry['particles']:.0f} particles  {entry['trajectories']} trajectories  "
        f"{entry['captures']} captures"
    )
