"""When particles at rest are skipped, and the checks of all values in a spec of effects."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from gsim3d.errors import InputError, did_you_mean
from gsim3d.io.files import shown

POLICIES = ("exact", "approx")


@dataclass(frozen=True)
class Sleep:
    """When particles at rest are skipped.

    policy: "exact": a scene sleeps as a whole; "approx": cubes of it do (:mod:`gsim3d.dynamics.sleep` has the bounds).
    eps: cells that a particle at rest moves in a step at most, along each axis, and its latents change at most.
    patience: steps at rest before it sleeps, at least those that the model sees.
    halo: metres, edge of the cubes, and the change of speed in a step up to which nobody wakes too late.
    """

    policy: str = "exact"
    eps: float = 1e-3
    patience: int = 4
    halo: float = 0.05

    def __post_init__(self):
        one_of("dynamics.sleep.policy", self.policy, POLICIES)
        at_least("dynamics.sleep.eps", self.eps, 0)
        at_least("dynamics.sleep.patience", self.patience, 1)
        if not 0 < self.halo < math.inf:
            raise InputError(f"effects: dynamics.sleep.halo must be a length above 0; got {self.halo!r}")


def one_of(name: str, value: Any, allowed: tuple[str, ...]) -> None:
    if value not in allowed:
        raise InputError(
            f"effects: {name} must be one of {', '.join(allowed)}; got {shown(value)}{did_you_mean(value, allowed)}"
        )


def at_least(name: str, value: Any, least: int) -> None:
    whole = least == 1
    kind = "an integer" if whole else "a number"
    if isinstance(value, bool) or not isinstance(value, int if whole else (int, float)) or not value >= least:
        raise InputError(f"effects: {name} must be {kind} of at least {least}; got {shown(value)}")
