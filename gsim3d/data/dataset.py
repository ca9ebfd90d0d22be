"""Train/test splits and windows of steps."""

import dataclasses
import zlib
from collections.abc import Sequence

import numpy as np

from gsim3d.data.scene import Scene
from gsim3d.errors import InputError

FEW_SCENES = 15  # smaller data sets hold out one scene


def split_scenes(scenes: Sequence, test_fraction: float = 0.12) -> tuple[list, list]:
    """Splits scenes into disjoint (train, test) lists by holding out every k-th scene.

    ``int(test_fraction * n)`` scenes are held out; one if there are fewer than 15, none if there is only one.
    """
    if not 0 <= test_fraction < 1:
        raise InputError(f"test_fraction must lie in [0, 1); got {test_fraction}")
    n = len(scenes)
    # The epsilon guards products such as 0.1 * 30 against rounding below the integer.
    n_test = min(1, n - 1) if n < FEW_SCENES else int(test_fraction * n + 1e-9)
    if n_test < 1 or test_fraction == 0:
        return list(scenes), []
    held_out = set(range(0, n_test * (n // n_test), n // n_test))
    return [s for i, s in enumerate(scenes) if i not in held_out], [scenes[i] for i in sorted(held_out)]


def published_split(scenes: Sequence) -> tuple[list, list]:
    """Splits scenes into (train, test) by the rule of the published evaluation; use only to reproduce its numbers.

    With fewer than 15 scenes, the one test scene is also a training scene. With more, the test set may be larger than
    12 % (150 of 1200 scenes).
    """
    n = len(scenes)
    n_test = 1 if n < FEW_SCENES else max(1, int(0.12 * n))
    held_out = set(range(0, n, max(1, n // n_test)))
    test = [scenes[i] for i in sorted(held_out)]
    return (list(scenes) if len(test) < FEW_SCENES else [s for i, s in enumerate(scenes) if i not in held_out]), test


def generator(seed: int, step: int, sample: int, purpose: str) -> np.random.Generator:
    """Returns a random generator seeded by (seed, step, sample, purpose), independent of all other draws."""
    return np.random.default_rng([seed, step, sample, zlib.crc32(purpose.encode())])


@dataclasses.dataclass(frozen=True)
class Window:
    """Consecutive steps of one scene: ``n_context`` input steps, followed by steps to predict."""

    scene: Scene  #: the scene
    start: int  #: index of the first step
    n_context: int  #: number of input steps
    context_cams: tuple[tuple[int, ...], ...]  #: camera indices of each input step
    target_cams: tuple[tuple[int, ...], ...]  #: camera indices of each step, input steps included

    @property
    def steps(self) -> list[int]:
        """Indices of all steps in the scene."""
        return list(range(self.start, self.start + len(self.target_cams)))
