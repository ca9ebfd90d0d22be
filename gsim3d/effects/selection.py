"""Which particles of a scene are meant, by kind and place: for edits, and for bodies that a spec of effects names."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from gsim3d.errors import InputError, did_you_mean
from gsim3d.io.files import shown
from gsim3d.state import DYNAMIC, FROZEN, Particles

Vector = tuple[float, float, float]
Box = tuple[Vector, Vector]

WHICH = ("all", "moving", "frozen")


@dataclass(frozen=True)
class Selection:
    """Which particles. which: "moving", "frozen" (the ground) or "all".

    box: lowest and highest corner in the world [metres].
    """

    which: str = "moving"
    box: Box | None = None

    alone: ClassVar[str] = "which"  # what a text in a file says

    def __post_init__(self):
        if self.which not in WHICH:
            raise InputError(
                f"which must be one of {', '.join(WHICH)}; got {shown(self.which)}{did_you_mean(self.which, WHICH)}"
            )
        if self.box is not None and any(low > high for low, high in zip(*self.box, strict=True)):
            corners = [list(corner) for corner in self.box]
            raise InputError(f"box must be the lowest and the highest corner; got {corners}")

    def rows(self, particles: Particles) -> Tensor:
        """bool [N]. Waits for the device, except in a CUDA graph, which has no error.

        Raises:
            InputError: the newest steps have none.
        """
        activity = {"moving": DYNAMIC, "frozen": FROZEN}.get(self.which)
        rows = kind = torch.ones_like(particles.activity, dtype=torch.bool)
        if activity is not None:
            rows = kind = particles.activity == activity
        places, offset = particles.means, None if self.box is None else particles.row_offset()
        if offset is not None:
            places = places + offset
        if self.box is not None:
            for place, low, high in zip(places.unbind(1), *self.box, strict=True):
                rows = rows & (place >= low) & (place <= high)
        captured = rows.is_cuda and torch.cuda.is_current_stream_capturing()
        if not captured and not bool(rows[newest_rows(particles)].any()):
            raise InputError(self._nobody(places[kind & newest_rows(particles)]))
        return rows

    def _nobody(self, places: Tensor) -> str:
        """Why nobody is meant, where particles of the kind are at ``places``."""
        message = f"no particle is meant: there are none that are {self.which}"
        if self.box is None or not len(places):
            return message
        corners = [[round(x, 2) for x in corner.tolist()] for corner in (places.amin(0), places.amax(0))]
        return f"{message} in the box {[list(corner) for corner in self.box]}; theirs is {corners}"


def rows_of_any(selections: Iterable[Selection], particles: Particles, where: str) -> Tensor:
    """bool [N], rows that one of ``selections`` means; as :meth:`Selection.rows`, with errors that name ``where``."""
    rows = torch.zeros_like(particles.activity, dtype=torch.bool)
    for number, selection in enumerate(selections):
        try:
            rows = rows | selection.rows(particles)
        except InputError as error:
            raise InputError(f"{where}[{number}]: {error}") from None
    return rows


def newest_rows(particles: Particles) -> Tensor:
    """bool [N], rows of the newest cloud of each scene."""
    table = particles.clouds
    newest = set(dict(zip(table.scenes, range(len(table)))).values())
    marks = torch.tensor([q in newest for q in range(len(table))], dtype=torch.bool, device=particles.cu_rows.device)
    return marks[particles.row_cloud()]
