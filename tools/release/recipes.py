"""Recipes of the simulators that are trained for release: the published model, and arms with priors beside it.

All arms of a world share stream, loss and schedule; they differ in what is built into the dynamics.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from functools import partial
from typing import Any

from gsim3d.errors import InputError
from gsim3d.synth.scene_setup import GRAVITY
from gsim3d.synth.world import World
from gsim3d.synth.worlds import VALIDATION_SEED, build_world
from gsim3d.train.config import DataConfig, LossConfig, OptimizerConfig, PhaseConfig, PrecisionConfig, TrainConfig

SEED = 20261126  # of the training stream; `gsim3d generate` without --seed makes other trajectories
RATE = 5e-4
FOREVER = 10_000_000  # steps of the last phase: the clock ends a run


@dataclass(frozen=True)
class Recipe:
    """How one simulator is trained.

    Attributes:
        name: of the files of its runs.
        world, preset, options: `gsim3d generate WORLD --preset PRESET`, and options that differ.
        train: configuration of one process; several processes draw a batch of that size each.
        capacity: trajectories in device memory at a time; the newest replace the oldest.
        first_films: trajectories that must be there before training begins.
        n_validation: trajectories that are predicted and scored.
    """

    name: str
    world: str
    train: TrainConfig
    preset: str = "published"
    options: dict[str, Any] = field(default_factory=dict)
    capacity: int = 240
    first_films: int = 24
    n_validation: int = 24

    def stream(self) -> World:
        """The world whose trajectories are trained on, without end."""
        return build_world(self.world, self.preset, {"seed": SEED, **self.options})

    def validation(self) -> dict[str, Any]:
        """Arguments of :func:`gsim3d.synth.generate` that make the validation set: the stream's, another seed."""
        given = {"seed": VALIDATION_SEED, "n_trajectories": self.n_validation, **self.options}
        return {"world": self.world, "preset": self.preset, **given}


# Without drop path and shuffled curves, which no CUDA graph repeats. Particles begin large, and targets come from other
# cameras: else, within ten steps, all particles hide before their cameras.
MODEL = {
    "encoder": {"transformer_layers": 3, "refine_unet_dim": 24},
    "dynamics": {
        "drop_path": 0.0,
        "shuffle_orders": False,
        "position_features": False,  # as published: no absolute positions, so that scenes may be edited
        "background": "relightable",  # frozen particles are computed once a step
        "max_latent_step": 8.0,
    },
    "renderer": {"scale_min": 0.002, "initial_scale": 0.03},
}
POSITIONS = {"position_features": True, "position_waves": 4}


@dataclass(frozen=True)
class _World:
    """What recipes of a world differ in.

    begin_within: windows begin at one of so many first steps; 0: anywhere. Bodies at rest teach little.
    contact_length: metres, more than bodies fall in a step.   lands: whether bodies meet frozen ground.
    rigid: whether bodies keep their shape.
    """

    begin_within: int
    contact_length: float
    lands: bool = True
    rigid: bool = False
    strides: tuple[int, int] = (2, 1)


WORLDS = {
    "elastic": _World(begin_within=40, contact_length=0.15),
    "cloth": _World(begin_within=0, contact_length=0.15, lands=False, strides=(3, 2)),
    "rigid": _World(begin_within=12, contact_length=0.4, rigid=True),
}


def _priors(world: str) -> dict[str, Any]:
    """All hand-made parts of the dynamics."""
    settings = WORLDS[world]
    fps = build_world(world, "published", {}).fps
    return {
        **POSITIONS,
        "motion_length": 0.3,
        "lights": ((0.36, 0.24, 0.9),),  # the lamp of the worlds; training may turn it
        "velocity": True,
        "deformation": True,
        "turning": True,
        "contact_length": settings.contact_length,
        "surfaces": settings.lands,
        "gravity": (0.0, 0.0, -GRAVITY / fps**2) if settings.lands else None,
        "pushes": settings.lands,
        "solid": settings.rigid,
    }


ARMS = {
    "pure": lambda world: {},
    "positions": lambda world: POSITIONS,
    "motion": lambda world: {"motion_length": 0.3},
    "priors": _priors,
}


def recipe(world: str, arm: str = "pure") -> Recipe:
    """The recipe of ``arm`` in ``world``.

    Raises:
        InputError: there is no such world or arm.
    """
    for given, known in ((world, WORLDS), (arm, ARMS)):
        if given not in known:
            raise InputError(f"{given!r} is not known; choose from {', '.join(known)}")
    settings, built_in = WORLDS[world], ARMS[arm](world)
    joint = partial(PhaseConfig, begin_within=settings.begin_within, from_start=0.1, learning_rate=RATE)
    images = PhaseConfig(
        steps=1000, history=1, batch=16, target_views=6, begin_within=settings.begin_within, learning_rate=2 * RATE
    )
    train = TrainConfig(
        preset="small",
        model={**MODEL, "dynamics": {**MODEL["dynamics"], **built_in}},
        # Bodies that are lit by a prior change in its light alone.
        effects={"appearance": {"changing": "dynamic"}} if built_in.get("surfaces") else {},
        data=DataConfig(
            history=4,
            context_views=4,
            target_only_cameras=(2, 7),
            background_stride=settings.strides[0],
            body_stride=settings.strides[1],
            targets_apart=True,
        ),
        phases=(
            images,
            joint(steps=600, horizon=2, batch=8),
            joint(steps=1200, horizon=6, batch=4),
            joint(steps=6000, horizon=12, batch=4),
            joint(steps=FOREVER, horizon=24, cut=12, batch=4),
        ),
        loss=LossConfig(),
        optimizer=OptimizerConfig(encoder_rate=0.3),
        precision=PrecisionConfig(encoder="bf16", dynamics="bf16"),
        captured=True,
        log_every=20,
    )
    return Recipe(f"{world}-{arm}", world, train)


def of_processes(config: TrainConfig, count: int) -> TrainConfig:
    """``config`` with batches of ``count`` processes together."""
    phases = tuple(dataclasses.replace(phase, batch=count * phase.batch) for phase in config.phases)
    return dataclasses.replace(config, phases=phases)
