"""Recipes of the simulators that are trained for release: configs/train/WORLD.yaml, and arms beside it.

Every row of gsim3d/evaluate/ablations.yaml is an arm, too: the recipe with one change.
"""

import dataclasses
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from gsim3d.errors import InputError
from gsim3d.evaluate.ablations import changed, load_ablations
from gsim3d.io.files import read_yaml
from gsim3d.io.settings import from_dict
from gsim3d.synth.world import World
from gsim3d.synth.worlds import VALIDATION_SEED, build_world
from gsim3d.train.config import TrainConfig

CONFIGS = Path(__file__).resolve().parent.parent.parent / "configs" / "train"
WORLDS = ("elastic", "cloth", "rigid", "push")
SEED = 20261126  # of the training stream; `gsim3d generate` without --seed makes other trajectories


@dataclass(frozen=True)
class Recipe:
    """How one simulator is trained."""

    name: str  #: of the files of its runs
    world: str  #: `gsim3d generate WORLD --preset PRESET`
    train: TrainConfig  #: configuration of one process; several processes draw a batch of that size each
    preset: str = "published"  #: of the world
    options: dict[str, Any] = field(default_factory=dict)  #: of the world, where they differ from the preset
    capacity: int = 240  #: trajectories in device memory at a time; the newest replace the oldest
    n_first: int = 12  #: trajectories that must be there before training begins
    n_validation: int = 24  #: trajectories that are predicted and scored

    def stream(self) -> World:
        """The world whose trajectories are trained on, without end."""
        return build_world(self.world, self.preset, {"seed": SEED, **self.options})

    def validation(self) -> dict[str, Any]:
        """Arguments of :func:`gsim3d.synth.generate` that make the validation set: the stream's, another seed."""
        given = {"seed": VALIDATION_SEED, "n_trajectories": self.n_validation, **self.options}
        return {"world": self.world, "preset": self.preset, **given}


def recipe(world: str, arm: str = "velocity") -> Recipe:
    """The recipe of ``arm`` in ``world``.

    Raises:
        InputError: there is no such world or arm, or the world has no priors.
    """
    arms, rows = read_yaml(CONFIGS / "arms.yaml"), load_ablations()[1]
    for given, known in ((world, WORLDS), (arm, (*arms, *rows))):
        if given not in known:
            raise InputError(f"{given!r} is not known; choose from {', '.join(known)}")
    settings = read_yaml(CONFIGS / f"{world}.yaml")
    for part in ("all", world):
        settings = merged(settings, arms.get(arm, {}).get(part, {}))
    if arm == "priors":
        if not (CONFIGS.parent / "priors" / f"{world}.yaml").is_file():
            raise InputError(f"the world {world} has no priors; choose another arm")
        settings = merged(settings, {"model": {"dynamics": read_yaml(CONFIGS.parent / "priors" / f"{world}.yaml")}})
    train = from_dict(TrainConfig, settings)
    train = changed(train, rows[arm].change) if arm in rows else train
    rig = Recipe("", world, train).stream().rig()  # to which what is shipped fits images and depth ranges
    data = dataclasses.replace(train.data, resize=(rig.size, rig.size), near_far=(rig.near, rig.far))
    return Recipe(f"{world}-{arm}", world, dataclasses.replace(train, data=data))


def merged(settings: dict, changes: dict) -> dict:
    """``settings`` with ``changes``, mapping by mapping."""
    both = {key: merged(settings[key], changes[key]) for key in changes if isinstance(settings.get(key), dict)}
    return {**settings, **changes, **both}


def of_processes(config: TrainConfig, count: int) -> TrainConfig:
    """``config`` with batches of ``count`` processes together."""
    phases = tuple(dataclasses.replace(phase, batch=count * phase.batch) for phase in config.phases)
    return dataclasses.replace(config, phases=phases)
