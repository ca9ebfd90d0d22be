"""Validation of a state: rows that cannot be used, what replaces them, and sums over each cloud, without waiting."""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from gsim3d._core import constants
from gsim3d.numerics.policy import LARGEST
from gsim3d.ops._arguments import check_real, check_tensors, check_whole
from gsim3d.ops._register import fakes, refuse

CELLS: int = constants["validate_cells"]  # of a workspace along each axis
OUTSIDE: int = constants["validate_outside"]  # bits of a status
FAST: int = constants["validate_fast"]
SUMS: tuple[str, ...] = constants["validate_sums"]
_ROWS_A_PART: dict[str, int] = constants["validate_rows_a_part"]


class PartialRecord(NamedTuple):
    """A record of :func:`validate_state` in parts: :func:`join_records` joins those of many calls in one launch.

    Attributes:
        parts: what each part of the rows counted.
        cu_rows: of the call.
        n_rows: of the call.
        shape: of the record.
        dtype: of the record.
        device: of the record.
    """

    parts: Tensor
    cu_rows: Tensor
    n_rows: int
    shape: torch.Size
    dtype: torch.dtype
    device: torch.device


class ValidatedState(NamedTuple):
    """What :func:`validate_state` found.

    Attributes:
        status: int32 [N], 0 where a row can be used; bit f: field f is out of its bounds; OUTSIDE; FAST.
        record: float64 [Q, 2 (F + 2) + 9], of every cloud: count and first row (-1: none) of each of the F fields, of
            OUTSIDE and of FAST; then SUMS over its awake rows of status 0 (bounds: 3.4e38 and -3.4e38 where there are
            none), but ``opacity_mass`` over all rows whose opacity is in bounds.
        fields: the sanitized rows; None where that was not asked for.
        activity: the same.
    """

    status: Tensor
    record: Tensor | PartialRecord
    fields: tuple[Tensor, ...] | None = None
    activity: Tensor | None = None


def validate_state(
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
) -> ValidatedState:
    """Finds the rows of packed clouds that cannot be used and, where ``neutral`` is given, sanitizes them; one pass.

    Row n is out of the bounds of field f unless ``low_f <= x <= high_f`` for all its values (NaN never is). It is
    OUTSIDE unless ``0 <= (means - origin) / grid_size < 2^16`` on all axes, and FAST if it moved further than
    ``max_step`` from ``previous``; both only where its position is in bounds.

    In the sanitized copy rows with a status sleep. Those out of bounds of a field, or FAST, have the numbers of
    ``previous``; without it their position is ``origin``, and a field's first number that of ``neutral``, followed by
    zeros. The opacity of rows out of bounds is 0. Rows that sleep already stay as they are.

    Args:
        fields: 2 to 9 tensors with N rows, float32 or float64: positions [N, 3], opacities [N], others of any shape.
        bounds: lowest and highest value of each.
        cu_rows: int64 [Q + 1], rows of cloud q are cu_rows[q] .. cu_rows[q + 1].
        cloud_scene: int64 [Q] in [0, B).
        origin: float64 [B, 3] metres, lower corner of each scene's workspace.
        activity: uint8 [N] as in Particles; rows of 2 are asleep and not checked: their status is 0.
        grid_size: metres, edge of a cell; 0: no row is OUTSIDE.
        previous: the fields one step before, all finite; None: no row is FAST, and the kinetic energy is 0.
        max_step: metres.
        neutral: one number a field; None: nothing is sanitized.
        join: False: the record stays a PartialRecord.
        check: check the types of the arguments; a model that makes them itself leaves it out.
    Returns:
        Status, record and sanitized rows, on the device of the rows.
    Gradients:
        none; fields that ask for one are refused where rows are sanitized.
    Determinism:
        equal bits for any number of threads; on a GPU in every run.
    Raises:
        ValueError, TypeError: an argument is malformed; the message names it. On a GPU offsets are not checked.

    Example:
        >>> means, zero = torch.tensor([[0.5, 0.5, 0.5], [0.5, float("nan"), 0.5]]), torch.zeros(1, dtype=torch.int64)
        >>> clouds = {"cloud_scene": zero, "origin": torch.zeros(1, 3, dtype=torch.float64)}
        >>> validated = validate_state([means, torch.ones(2)], [(-9, 9), (0, 1)], torch.tensor([0, 2]), **clouds,
        ...                            activity=torch.zeros(2, dtype=torch.uint8))
        >>> validated.status.tolist(), validated.record[0, :2].tolist()
        ([0, 1], [1.0, 1.0])
    """
    if check and not torch.compiler.is_compiling():
        clouds = {"cu_rows": cu_rows, "cloud_scene": cloud_scene, "origin": origin, "activity": activity}
        _check_arguments(fields, bounds, previous, neutral, clouds)
        check_real("validate_state", grid_size=grid_size, max_step=max_step)
    if neutral is not None:
        refuse("validate_state", {f"fields[{f}]": field for f, field in enumerate(fields)})
    low, high = ([pair[end] for pair in bounds] for end in (0, 1))
    status, record, sanitized = torch.ops.gsim3d.validate_state(
        *(_detached(fields), low, high, cu_rows, cloud_scene, origin, activity, _detached(previous or ())),
        *(grid_size, max_step, [] if neutral is None else list(neutral), join),
    )
    if not join:
        shape = torch.Size((cu_rows.shape[0] - 1, record.shape[1]))
        record = PartialRecord(record, cu_rows, fields[0].shape[0], shape, record.dtype, record.device)
    if not sanitized:
        return ValidatedState(status, record)
    return ValidatedState(status, record, tuple(sanitized[1:]), sanitized[0])


def join_records(records: Sequence[PartialRecord]) -> Tensor:
    """float64 [M], the numbers of ``records`` one after another, in one launch."""
    for record in records:
        check_tensors("join_records", parts=record.parts, cu_rows=record.cu_rows)
        check_whole("join_records", n_rows=record.n_rows)
    parts, cu_rows, n_rows, *_ = zip(*records, strict=True)
    return torch.ops.gsim3d.join_records(list(parts), list(cu_rows), list(n_rows))


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
            raise TypeError(f"validate_state: {name} must be a tuple or a list; got {type(value).__name__}")
        if len(value) != len(fields):
            wanted = f"one entry for each of {len(fields)} fields"
            raise ValueError(f"validate_state: {name} must have {wanted}; got {len(value)}")
    tensors = {f"fields[{f}]": field for f, field in enumerate(fields)}
    tensors |= {f"previous[{f}]": field for f, field in enumerate(previous or ())}
    check_tensors("validate_state", **tensors, **clouds)
    check_real("validate_state", **{f"neutral[{f}]": value for f, value in enumerate(neutral or ())})
    for f, pair in enumerate(bounds):
        if not isinstance(pair, (tuple, list)) or len(pair) != 2:
            raise TypeError(f"validate_state: bounds[{f}] must be a pair (lowest, highest); got {pair!r}")
        check_real("validate_state", **{f"bounds[{f}][{end}]": value for end, value in enumerate(pair)})


def _validated(
    fields, low, high, cu_rows, cloud_scene, origin, activity, previous, grid_size, max_step, neutral, *join
):
    columns = 2 * (len(fields) + 2) + len(SUMS)
    n_rows, n_records = fields[0].shape[0], cu_rows.shape[0] - 1
    if not all(join):
        n_records = max(0, n_records - 1 + -(-n_rows // _ROWS_A_PART[fields[0].device.type]))
    return (
        fields[0].new_empty(n_rows, dtype=torch.int32),
        fields[0].new_empty(n_records, columns, dtype=torch.float64),
        [x.new_empty(x.shape) for x in (activity, *fields)] if neutral else [],
    )


def _joined(parts, cu_rows, n_rows):
    total = sum((offsets.shape[0] - 1) * own.shape[1] for own, offsets in zip(parts, cu_rows, strict=True))
    return parts[0].new_empty(total)


fakes(validate_state=_validated, join_records=_joined)
