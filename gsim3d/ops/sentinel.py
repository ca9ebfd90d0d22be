"""Which rows of a state cannot be used, what stands in for them, and how its sums stand: one look, without waiting."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from gsim3d.numerics.policy import LARGEST
from gsim3d.ops import _load  # noqa: F401
from gsim3d.ops._arguments import check_real, check_tensors
from gsim3d.ops._gradients import refuse

# As in csrc/gsim3d/sentinel/sentinel.h
CELLS = 2**16  # of a workspace along each axis
OUTSIDE, FAST = 1 << 29, 1 << 30  # bits of a status
MAX_FIELDS = 9
PIECES = {"cpu": 1024, "cuda": 128}  # rows of a part
SUMS = ("awake", "kinetic_energy", "opacity_mass", "low_x", "low_y", "low_z", "high_x", "high_y", "high_z")


class Unjoined(NamedTuple):
    """A record of watch_rows in parts: :func:`joined` puts those of many looks together at once."""

    parts: Tensor
    cu_rows: Tensor
    n_rows: int
    shape: torch.Size  # of the record
    dtype: torch.dtype
    device: torch.device


class Watched(NamedTuple):
    """What watch_rows saw.

    status: int32 [N], 0 where a row can be used; bit f: field f is out of its bounds; OUTSIDE; FAST.
    record: float64 [Q, 2 (F + 2) + 9], of every cloud: count and first row (-1: none) of each of the F fields, of
        OUTSIDE and of FAST; then SUMS over its awake rows of status 0 (bounds: 3.4e38 and -3.4e38 where there are
        none), but ``opacity_mass`` over all rows whose opacity is in bounds.
    fields, activity: the rows mended; None where that was not asked for.
    """

    status: Tensor
    record: Tensor | Unjoined
    fields: tuple[Tensor, ...] | None = None
    activity: Tensor | None = None


def watch_rows(
    fields: Sequence[Tensor],
    bounds: Sequence[tuple[float, float]],
    cu_rows: Tensor,
    *,
    cloud_scene: Tensor,
    origin: Tensor,
    activity: Tensor,
    grid_size: float = 0.0,
    previous: Sequence[Tensor] | None = None,
    max_step: float = LARGEST,
    neutral: Sequence[float] | None = None,
    join: bool = True,
    check: bool = True,
) -> Watched:
    """Looks once at all rows of packed clouds, and mends them where it is told how.

    Row n is out of the bounds of field f unless ``low_f <= x <= high_f`` for all its values (NaN never is). It is
    OUTSIDE unless ``0 <= (means - origin) / grid_size < 2^16`` on all axes, and FAST if it moved further than
    ``max_step`` from ``previous``; both only where its position is in bounds.

    In the mended copy rows with a status sleep. Those out of bounds of a field, or FAST, have the numbers of
    ``previous``; without it their position is ``origin``, and a field's first number that of ``neutral``, followed by
    zeros. The opacity of rows out of bounds is 0. Rows that sleep already stay as they are.

    Args:
        fields: 2 to 9 tensors with N rows, float32 or float64: positions [N, 3], opacities [N], others of any shape.
        bounds: lowest and highest value of each.
        cu_rows: int64 [Q + 1], rows of cloud q are cu_rows[q] .. cu_rows[q + 1].
        cloud_scene: int64 [Q] in [0, B).
        origin: float64 [B, 3] metres, lower corner of each scene's workspace.
        activity: uint8 [N] as in Particles; rows of 2 are asleep and not looked at: their status is 0.
        grid_size: metres, edge of a cell; 0: no row is OUTSIDE.
        previous: the fields one step before, all finite; None: no row is FAST, and the kinetic energy is 0.
        max_step: metres.
        neutral: one number a field; None: nothing is mended.
        join: False: the record is left Unjoined.
        check: look at the types of the arguments; a model that makes them itself leaves it out.
    Returns:
        Watched, on the device of the rows.
    Gradients: none; fields that ask for one are refused where rows are mended.
    Determinism: equal bits for any number of threads; on a GPU in every run.
    Raises:
        ValueError, TypeError: an argument is malformed; the message names it. On a GPU offsets are not looked at.

    Example:
        >>> means, zero = torch.tensor([[0.5, 0.5, 0.5], [0.5, float("nan"), 0.5]]), torch.zeros(1, dtype=torch.int64)
        >>> watched = watch_rows([means, torch.ones(2)], [(-9, 9), (0, 1)], torch.tensor([0, 2]), cloud_scene=zero,
        ...                      origin=torch.zeros(1, 3, dtype=torch.float64),
        ...                      activity=torch.zeros(2, dtype=torch.uint8))
        >>> watched.status.tolist(), watched.record[0, :2].tolist()
        ([0, 1], [1.0, 1.0])
    """
    if check and not torch.compiler.is_compiling():
        clouds = {"cu_rows": cu_rows, "cloud_scene": cloud_scene, "origin": origin, "activity": activity}
        _check_arguments(fields, bounds, previous, neutral, clouds)
        check_real("watch_rows", grid_size=grid_size, max_step=max_step)
    if neutral is not None:
        refuse("watch_rows", {f"fields[{f}]": field for f, field in enumerate(fields)})
    status, record, mended = torch.ops.gsim3d.watch_rows(
        _detached(fields),
        [low for low, _ in bounds],
        [high for _, high in bounds],
        cu_rows,
        cloud_scene,
        origin,
        activity,
        _detached(previous or ()),
        grid_size,
        max_step,
        [] if neutral is None else list(neutral),
        join,
    )
    if not join:
        shape = torch.Size((cu_rows.shape[0] - 1, record.shape[1]))
        record = Unjoined(record, cu_rows, fields[0].shape[0], shape, record.dtype, record.device)
    return Watched(status, record, tuple(mended[1:]), mended[0]) if mended else Watched(status, record)


def joined(records: Sequence[Unjoined]) -> Tensor:
    """float64 [M], the numbers of ``records`` one after another, in one launch."""
    parts, cu_rows, n_rows, *_ = zip(*records, strict=True)
    return torch.ops.gsim3d.join_parts(list(parts), list(cu_rows), list(n_rows))


def _detached(fields: Sequence[Tensor]) -> list[Tensor]:
    return [field.detach() if field.requires_grad else field for field in fields]


def _check_arguments(
    fields: Sequence[Tensor],
    bounds: Sequence[tuple[float, float]],
    previous: Sequence[Tensor] | None,
    neutral: Sequence[float] | None,
    clouds: dict[str, Tensor],
) -> None:
    """Types, and how many there are; shapes and dtypes are the kernel's."""
    lists = {"fields": fields, "bounds": bounds, "previous": previous, "neutral": neutral}
    for name, value in lists.items():
        if value is None and name in ("previous", "neutral"):
            continue
        if not isinstance(value, (tuple, list)):
            raise TypeError(f"watch_rows: {name} must be a tuple or a list; got {type(value).__name__}")
        if len(value) != len(fields):
            raise ValueError(
                f"watch_rows: {name} must have one entry for each of {len(fields)} fields; got {len(value)}"
            )
    tensors = {f"fields[{f}]": field for f, field in enumerate(fields)}
    tensors |= {f"previous[{f}]": field for f, field in enumerate(previous or ())}
    check_tensors("watch_rows", **tensors, **clouds)
    check_real("watch_rows", **{f"neutral[{f}]": value for f, value in enumerate(neutral or ())})
    for f, pair in enumerate(bounds):
        if not isinstance(pair, (tuple, list)) or len(pair) != 2:
            raise TypeError(f"watch_rows: bounds[{f}] must be a pair (lowest, highest); got {pair!r}")
        check_real("watch_rows", **{f"bounds[{f}][{end}]": value for end, value in enumerate(pair)})


@torch.library.register_fake("gsim3d::watch_rows")
def _(fields, low, high, cu_rows, cloud_scene, origin, activity, previous, grid_size, max_step, neutral, joined=True):
    columns = 2 * (len(fields) + 2) + len(SUMS)
    n_rows, n_records = fields[0].shape[0], cu_rows.shape[0] - 1
    if not joined:
        n_records = max(0, n_records - 1 + -(-n_rows // PIECES[fields[0].device.type]))
    return (
        fields[0].new_empty(n_rows, dtype=torch.int32),
        fields[0].new_empty(n_records, columns, dtype=torch.float64),
        [x.new_empty(x.shape) for x in (activity, *fields)] if neutral else [],
    )


@torch.library.register_fake("gsim3d::join_parts")
def _(parts, cu_rows, n_rows):
    total = sum((offsets.shape[0] - 1) * own.shape[1] for own, offsets in zip(parts, cu_rows, strict=True))
    return parts[0].new_empty(total)
