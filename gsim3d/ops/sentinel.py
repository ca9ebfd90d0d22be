"""Are rows usable, and how do their sums stand: one look at a state, read without waiting for the device."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

LARGEST = torch.finfo(torch.float32).max
CELLS = 2**16  # of a workspace along each axis
OUTSIDE, FAST = 1 << 29, 1 << 30  # bits of a status
SUMS = ("awake", "kinetic_energy", "opacity_mass", "low_x", "low_y", "low_z", "high_x", "high_y", "high_z")


@dataclass(frozen=True)
class Watched:
    """status: int32 [N], 0 where a row is usable; bit f: field f is out of its bounds; OUTSIDE, FAST.
    record: float64 [Q, 2 (F + 2) + 9]: of every cloud, count and first row (-1: none) of each of the F fields, of
    OUTSIDE and of FAST; then SUMS over its usable rows that are not asleep, but ``opacity_mass`` over all whose opacity
    is in bounds."""

    status: Tensor
    record: Tensor


def watch_rows(
    fields: Sequence[Tensor],
    bounds: Sequence[tuple[float, float]],
    cu_rows: Tensor,
    *,
    cloud_scene: Tensor,
    origin: Tensor,
    asleep: Tensor,
    grid_size: float,
    previous: Tensor | None = None,
    max_step: float = LARGEST,
) -> Watched:
    with torch.no_grad():
        means, opacities = fields[0], fields[1]
        n, n_clouds = means.shape[0], cu_rows.shape[0] - 1
        status = torch.zeros(n, dtype=torch.int32, device=means.device)
        for f, (field, (low, high)) in enumerate(zip(fields, bounds, strict=True)):
            good = ((field >= low) & (field <= high)).reshape(n, -1).all(1)
            status |= (~good).to(torch.int32) << f
        finite = status & 1 == 0
        counts = cu_rows[1:] - cu_rows[:-1]
        cloud = torch.repeat_interleave(torch.arange(n_clouds, device=means.device), counts, output_size=n)
        if grid_size > 0:
            cells = (means.double() - origin[cloud_scene[cloud]]) / grid_size
            inside = ((cells >= 0) & (cells < CELLS)).all(1)
            status |= torch.where(finite & ~inside, OUTSIDE, 0).to(torch.int32)
        squared = torch.zeros(n, dtype=torch.float64, device=means.device)
        if previous is not None:
            squared = (means.double() - previous.double()).square().sum(1)
            status |= torch.where(finite & (squared > max_step**2), FAST, 0).to(torch.int32)
        status = torch.where(asleep, 0, status)
        record = torch.zeros(n_clouds, 2 * (len(fields) + 2) + len(SUMS), dtype=torch.float64, device=means.device)
        for k, bit in enumerate([*(1 << f for f in range(len(fields))), OUTSIDE, FAST]):
            bad = status & bit != 0
            record[:, 2 * k].index_add_(0, cloud, bad.double())
            first = torch.full((n_clouds,), float(n), dtype=torch.float64, device=means.device)
            rows = torch.where(bad, torch.arange(n, device=means.device), n).double()
            first = first.scatter_reduce(0, cloud, rows, "amin")
            record[:, 2 * k + 1] = torch.where(first < n, first, -1.0)
        sums = record[:, 2 * (len(fields) + 2) :]
        usable = (status == 0) & ~asleep
        sums[:, 0].index_add_(0, cloud, usable.double())
        sums[:, 1].index_add_(0, cloud, torch.where(usable, squared / 2, 0.0))
        shown = status & 2 == 0
        sums[:, 2].index_add_(0, cloud, torch.where(shown, opacities.double(), 0.0))
        for axis in range(3):
            for column, rest, reduce in ((3, LARGEST, "amin"), (6, -LARGEST, "amax")):
                values = torch.where(usable, means[:, axis].double(), rest)
                start = torch.full((n_clouds,), rest, dtype=torch.float64, device=means.device)
                sums[:, column + axis] = start.scatter_reduce(0, cloud, values, reduce)
        return Watched(status, record)
