"""Held-out sets for model selection and test scores: trajectories with reserved seeds."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from gsim3d.data.recording import read_json
from gsim3d.errors import InputError
from gsim3d.synth.world import TRAIN
from gsim3d.synth.worlds import TEST_SEED, VALIDATION_SEED, WORLDS

# name -> seed and number of trajectories. "validation" selects models; "test" is scored once a release.
SETS = {"validation": (VALIDATION_SEED, 24), "test": (TEST_SEED, 56)}


@dataclass(frozen=True)
class Origin:
    """Generator options of a scene."""

    world: str  #: a key of worlds.WORLDS
    subset: str | None  #: held-out variant of the world; None: the training variant
    seed: int  #: seed of the set
    body: str  #: name of the object

    @property
    def set_name(self) -> str | None:
        """A key of :data:`SETS`, or None."""
        return next((name for name, (seed, _) in SETS.items() if seed == self.seed), None)


def origin_of(folder: Path) -> Origin | None:
    """Generator options of the scene in ``folder``; None for other scenes."""
    try:
        metadata = read_json(folder / "metadata.json")
    except (InputError, OSError):
        return None
    world, seed, subset = (metadata.get(key) for key in ("world", "seed", "subset"))
    if not isinstance(world, str) or world not in WORLDS or not isinstance(seed, int):
        return None
    return Origin(world, None if subset == TRAIN else str(subset), seed, str(metadata.get("object")))


def refuse_held_out(folders: Sequence[Path]) -> None:
    """Raises InputError if a training scene belongs to a held-out set."""
    for folder in folders:
        if (origin := origin_of(folder)) and origin.set_name:
            raise InputError(
                f"{folder}: a scene of the {origin.set_name} set (seed {origin.seed}), which is held out; generate "
                "training data with another --seed"
            )


def set_of(folders: Sequence[Path]) -> dict | None:
    """Description of the generated set of the scenes; None if they are of several sets or not generated.

    Returns:
        "name" ("validation", "test" or None), "world", "subset", "seed" and "bodies" (body -> number of trajectories).
    """
    first, bodies = None, Counter()
    for folder in folders:
        if (origin := origin_of(folder)) is None:
            return None
        first = first or origin
        if (origin.world, origin.subset, origin.seed) != (first.world, first.subset, first.seed):
            return None
        bodies[origin.body] += 1
    if first is None:
        return None
    found = {"name": first.set_name, "world": first.world, "subset": first.subset, "seed": first.seed}
    return {**found, "bodies": dict(sorted(bodies.items()))}


def describe_set(found: dict) -> str:
    """The output of :func:`set_of` as a sentence."""
    n_trajectories, counts = sum(found["bodies"].values()), sorted(set(found["bodies"].values()))
    each = f"{counts[0]}" if len(counts) == 1 else f"{counts[0]} to {counts[-1]}"
    of = f"{found['world']} ({found['subset']})" if found["subset"] else found["world"]
    text = f"{n_trajectories} trajectories of {of} with seed {found['seed']}, {each} a body"
    if found["name"] is None:
        return f"Neither the validation nor the test set: {text}."
    whole = SETS[found["name"]][1]
    part = "" if n_trajectories == whole or found["subset"] else f"; the whole set has {whole}"
    return f"{found['name'].capitalize()} set: {text}{part}."
