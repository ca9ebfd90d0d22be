"""Selections of particles by kind and position, for edits and for ``frozen_appearance``."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from gsim3d.errors import InputError, check_one_of, naming
from gsim3d.state import DYNAMIC, FROZEN, Particles

Vector = tuple[float, float, float]
Box = tuple[Vector, Vector]

KINDS = {"all": None, "moving": DYNAMIC, "frozen": FROZEN}


@dataclass(frozen=True)
class Selection:
    """A selection of particles."""

    which: str = "moving"  #: "moving", "frozen" (the static background) or "all"
    box: Box | None = None  #: lowest and highest corner in world coordinates (m); None: unlimited

    alone: ClassVar[str] = "which"  # field that a plain string in a file sets

    def __post_init__(self):
        check_one_of("which", self.which, KINDS)
        if self.box is not None and any(low > high for low, high in zip(*self.box, strict=True)):
            corners = [list(corner) for corner in self.box]
            raise InputError(f"box must be the lowest and the highest corner; got {corners}")

    def mask(self, particles: Particles) -> Tensor:
        """Mask bool [N] of the selected particles. Needs a device sync, except during graph capture.

        Raises:
            InputError: the selection is empty in the newest steps of all scenes; not checked during graph capture.
        """
        activity = KINDS[self.which]
        of_kind = particles.activity == activity if activity is not None else torch.ones_like(particles.activity) > 0
        chosen, positions = of_kind, particles.means
        if self.box is not None:
            if (offset := particles.row_offset()) is not None:
                positions = positions + offset
            for coordinate, low, high in zip(positions.unbind(1), *self.box, strict=True):
                chosen = chosen & (coordinate >= low) & (coordinate <= high)
        captured = chosen.is_cuda and torch.cuda.is_current_stream_capturing()
        if not captured and not bool(chosen[newest := newest_mask(particles)].any()):
            message, positions = f"the selection is empty: no particle is {self.which}", positions[of_kind & newest]
            if self.box is not None and len(positions):
                corners = [[round(x, 2) for x in corner.tolist()] for corner in (positions.amin(0), positions.amax(0))]
                message += f" in the box {[list(corner) for corner in self.box]}; their bounds are {corners}"
            raise InputError(message)
        return chosen


def any_mask(selections: Iterable[Selection], particles: Particles, where: str) -> Tensor:
    """Mask bool [N] of the union of ``selections``. Errors of :meth:`Selection.mask` name ``where``."""
    chosen = torch.zeros_like(particles.activity, dtype=torch.bool)
    for number, selection in enumerate(selections):
        with naming(f"{where}[{number}]"):
            chosen = chosen | selection.mask(particles)
    return chosen


def newest_mask(particles: Particles) -> Tensor:
    """Mask bool [N] of the particles in the newest cloud of each scene."""
    table = particles.clouds
    newest = set(dict(zip(table.scenes, range(len(table)))).values())
    marks = torch.tensor([q in newest for q in range(len(table))], dtype=torch.bool, device=particles.cu_rows.device)
    return marks[particles.row_cloud()]
