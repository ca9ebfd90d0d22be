"""Policies for invalid numbers.

For every input, the simulator and every op return finite outputs and finite gradients, or raise a
:class:`gsim3d.NumericalError` that names scene, step, tensor, and particle or camera. The policies are:

- ``"raise"`` (default): raises an error. The CPU raises immediately. A GPU does not synchronize: it treats the particle
  as "drop" does, and a later call, or :meth:`StabilityReport.check`, raises the error.
- ``"drop"``: the particle falls asleep. It keeps its position, is invisible to the network and in images, and has no
  gradient.
- ``"clamp"``: bounds the number. NaN becomes the previous value, or 0 (a rotation: the identity).

With every policy, a particle that leaves the workspace or moves by more than ``max_speed`` in a step falls asleep
("clamp": stops at the limit), which the report counts and is no error. Other scenes keep equal bits.
"""

from dataclasses import dataclass
from typing import Literal, get_args

import torch
from torch import Tensor

from gsim3d.errors import InputError, check_one_of

OnInvalid = Literal["raise", "drop", "clamp"]
LARGEST = torch.finfo(torch.float32).max
ACTIONS = {"raise": "error", "drop": "dropped", "clamp": "clamped"}
NEAREST = 1e-6  # smallest near plane in metres
FARTHEST = 1e9  # largest far plane, and largest coordinate of a camera or origin, in metres
PIXEL_SLACK = 1e-3  # tolerance of colours outside [0, 1], for rounding in resampling


def check_on_invalid(on_invalid: str) -> None:
    """Raises InputError if ``on_invalid`` is not a policy."""
    check_one_of("on_invalid", on_invalid, get_args(OnInvalid))


def at_most(values: Tensor, largest: float) -> Tensor:
    """bool [N]: whether all numbers of each of ``values`` [N, ...] are finite and at most ``largest`` in magnitude."""
    return (values.detach().abs() <= largest).flatten(1).all(1)


def usable_pixels(images: Tensor) -> Tensor:
    """bool, shape of ``images``: whether a number is a colour in [0, 1]."""
    return (images >= -PIXEL_SLACK) & (images <= 1 + PIXEL_SLACK)


@dataclass(frozen=True)
class StabilityConfig:
    """Limits of a model's particles, and the policy for particles beyond them."""

    on_invalid: OnInvalid = "raise"  #: default policy, "raise", "drop" or "clamp"
    #: largest displacement in m/step; faster particles fall asleep at their previous position. Should be above the
    #: model's ``max_step``, and not far above, so that diverging particles do not affect others.
    max_speed: float = 10.0
    #: largest magnitude of a latent or colour coefficient; larger values count as not finite. float16 overflows at
    #: about 6e4.
    max_latent: float = 1e4

    def __post_init__(self):
        check_on_invalid(self.on_invalid)
        for name in ("max_speed", "max_latent"):
            if not 0 < getattr(self, name) < float("inf"):
                raise InputError(f"{name} must be positive and finite; got {getattr(self, name)}")
