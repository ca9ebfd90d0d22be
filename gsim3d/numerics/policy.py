"""The policy for numbers that cannot be used.

For every input, the simulator and every op return finite outputs and finite gradients, or raise a
:class:`gsim3d.NumericalError` that names scene, step, particle or camera and tensor. A policy says which:

- ``"raise"`` (default): an error. The CPU raises immediately. A GPU does not wait: the particle sleeps as under "drop",
  and the error is raised by the next call that finds its record, or by :meth:`StabilityReport.check`.
- ``"drop"``: the particle sleeps. It keeps its position, the network does not see it, it is not drawn, and it has no
  gradient.
- ``"clamp"``: the number is bounded. NaN becomes the previous value, or 0 (a rotation the identity).

Under every policy a particle that leaves the workspace, or moves further in a step than ``max_speed``, falls asleep
("clamp": stops at the limit); that is counted and no error. Nothing of this changes another scene by one bit.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

import torch
from torch import Tensor

from gsim3d.errors import InputError

OnInvalid = Literal["raise", "drop", "clamp"]
LARGEST = torch.finfo(torch.float32).max
ACTIONS = {"raise": "error", "drop": "dropped", "clamp": "clamped"}
NEAREST = 1e-6  # metres, smallest near plane
FARTHEST = 1e9  # metres, largest far plane, and largest coordinate of a camera or origin
PIXEL_SLACK = 1e-3  # colours may leave [0, 1] by as much: resampling rounds


def check_on_invalid(on_invalid: str) -> None:
    """Raises InputError where ``on_invalid`` is no policy."""
    if on_invalid not in get_args(OnInvalid):
        raise InputError(f"on_invalid must be one of {', '.join(get_args(OnInvalid))}; got {on_invalid!r}")


def at_most(values: Tensor, largest: float) -> Tensor:
    """bool [N], for each of N entries whether all its numbers are finite and at most ``largest`` in size."""
    return (values.detach().abs() <= largest).flatten(1).all(1)


def usable_pixels(images: Tensor) -> Tensor:
    """bool, for each number of ``images``: whether it is a colour in [0, 1]."""
    return (images >= -PIXEL_SLACK) & (images <= 1 + PIXEL_SLACK)


@dataclass(frozen=True)
class StabilityConfig:
    """Limits of a model's particles, and what happens where one exceeds them.

    Attributes:
        on_invalid: "raise", "drop" or "clamp": the policy where a call names no other.
        max_speed: m/step. A particle that moves further falls asleep where it was. Less than a model's own ``max_step``
            stops learned motion; far more lets a diverging particle drag others along before it leaves.
        max_latent: largest size of a latent or colour coefficient; larger values count as not finite. From about 6e4
            half precision overflows, from 1e19 a squared norm in float32.
    """

    on_invalid: OnInvalid = "raise"
    max_speed: float = 10.0
    max_latent: float = 1e4

    def __post_init__(self):
        check_on_invalid(self.on_invalid)
        for name in ("max_speed", "max_latent"):
            if not 0 < getattr(self, name) < float("inf"):
                raise InputError(f"{name} must be positive and finite; got {getattr(self, name)}")
