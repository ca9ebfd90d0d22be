"""Which rows of a state cannot be used, and how its sums stand: one look, read without waiting for the device."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from gsim3d.ops import _load  # noqa: F401
from gsim3d.ops._arguments import check_real, check_tensors
from gsim3d.stability import LARGEST

# As in csrc/gsim3d/sentinel/sentinel.h
CELLS = 2**16  # of a workspace along each axis
OUTSIDE, FAST = 1 << 29, 1 << 30  # bits of a status
MAX_FIELDS = 8
SUMS = ("awake", "kinetic_energy", "opacity_mass", "low_x", "low_y", "low_z", "high_x", "high_y", "high_z")


@dataclass(frozen=True)
class Watched:
    """What watch_rows saw.

    status: int32 [N], 0 where a row can be used; bit f: field f is out of its bounds; OUTSIDE; FAST.
    record: float64 [Q, 2 (F + 2) + 9], of every cloud: count and first row (-1: none) of each of the F fields, of
        OUTSIDE and of FAST; then SUMS over its awake rows of status 0 (bounds: 3.4e38 and -3.4e38 where there are
        none), but ``opacity_mass`` over all rows whose opacity is in bounds.
    """

    status: Tensor
    record: Tensor


def watch_rows(
    fields: Sequence[Tensor],
    bounds: Sequence[tuple[float, float]],
    cu_rows: Tensor,
    *,
    cloud_scene: Tensor,
    origin: Tensor,
    activity: Tensor,
    grid_size: float = 0.0,
    previous: Tensor | None = None,
    max_step: float = LARGEST,
) -> Watched:
    """Looks once at all rows of packed clouds.

    Row n is out of the bounds of field f unless ``low_f <= x <= high_f`` for all its values (NaN never is). It is
    OUTSIDE unless ``0 <= (means - origin) / grid_size < 2^16`` on all axes, and FAST if it moved further than
    ``max_step`` from ``previous``; both only where its position is in bounds.

    Args:
        fields: 2 to 8 tensors with N rows, float32 or float64: positions [N, 3], opacities [N], and others of any shape.
        bounds: lowest and highest value of each.
        cu_rows: int64 [Q + 1], rows of cloud q are cu_rows[q] .. cu_rows[q + 1].
        cloud_scene: int64 [Q] in [0, B).
        origin: float64 [B, 3] metres, lower corner of each scene's workspace.
        activity: uint8 [N] as in Particles; rows of 2 are asleep and not looked at: their status is 0.
        grid_size: metres, edge of a cell; 0: no row is OUTSIDE.
        previous: [N, 3] positions one step before; None: no row is FAST, and the kinetic energy is 0.
        max_step: metres.
    Returns:
        Watched, on the device of the rows.
    Gradients: none. Determinism: equal bits for any number of threads; on a GPU from run to run.
    Raises:
        ValueError, TypeError: an argument is malformed; the message names it. On a GPU offsets are not looked at.

    Example:
        >>> means, zero = torch.tensor([[0.5, 0.5, 0.5], [0.5, float("nan"), 0.5]]), torch.zeros(1, dtype=torch.int64)
        >>> watched = watch_rows([means, torch.ones(2)], [(-9, 9), (0, 1)], torch.tensor([0, 2]), cloud_scene=zero,
        ...                      origin=torch.zeros(1, 3, dtype=torch.float64), activity=torch.zeros(2, dtype=torch.uint8))
        >>> watched.status.tolist(), watched.record[0, :2].tolist()
        ([0, 1], [1.0, 1.0])
    """
    clouds = {"cu_rows": cu_rows, "cloud_scene": cloud_scene, "origin": origin, "activity": activity}
    if not torch.compiler.is_compiling():
        _check_arguments(fields, bounds, clouds if previous is None else {**clouds, "previous": previous})
        check_real("watch_rows", grid_size=grid_size, max_step=max_step)
    low, high = ([pair[end] for pair in bounds] for end in (0, 1))
    fields = [field.detach() for field in fields]
    previous = None if previous is None else previous.detach()
    return Watched(
        *torch.ops.gsim3d.watch_rows(
            fields, low, high, cu_rows, cloud_scene, origin, activity, previous, grid_size, max_step
        )
    )


def _check_arguments(
    fields: Sequence[Tensor], bounds: Sequence[tuple[float, float]], others: dict[str, Tensor]
) -> None:
    """Types, and the number of bounds; shapes and dtypes are the kernel's."""
    for name, value in {"fields": fields, "bounds": bounds}.items():
        if not isinstance(value, (tuple, list)):
            raise TypeError(f"watch_rows: {name} must be a tuple or a list; got {type(value).__name__}")
    check_tensors("watch_rows", **{f"fields[{f}]": field for f, field in enumerate(fields)}, **others)
    if len(bounds) != len(fields):
        raise ValueError(f"watch_rows: bounds must be one pair for each of {len(fields)} fields; got {len(bounds)}")
    for f, pair in enumerate(bounds):
        if not isinstance(pair, (tuple, list)) or len(pair) != 2:
            raise TypeError(f"watch_rows: bounds[{f}] must be a pair (lowest, highest); got {pair!r}")
        check_real("watch_rows", **{f"bounds[{f}][{end}]": value for end, value in enumerate(pair)})


@torch.library.register_fake("gsim3d::watch_rows")
def _(fields, low, high, cu_rows, cloud_scene, origin, activity, previous, grid_size, max_step):
    columns = 2 * (len(fields) + 2) + len(SUMS)
    n_rows, n_clouds = fields[0].shape[0], cu_rows.shape[0] - 1
    return (
        fields[0].new_empty(n_rows, dtype=torch.int32),
        fields[0].new_empty(n_clouds, columns, dtype=torch.float64),
    )
