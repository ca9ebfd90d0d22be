"""Which rows cannot be used, and sums over clouds, in plain torch."""

import torch

LARGEST = torch.finfo(torch.float32).max
CELLS, OUTSIDE, FAST, ASLEEP = 2**16, 1 << 29, 1 << 30, 2


def validate_state(
    fields, bounds, cu_rows, cloud_scene, origin, activity, grid_size=0.0, previous=None, max_step=LARGEST
):
    """(status, record) of gsim3d.ops.validate_state."""
    is_asleep = activity == ASLEEP
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
            squared = (means.double() - previous[0].double()).square().sum(1)
            status |= torch.where(finite & ~(squared <= max_step**2), FAST, 0).to(torch.int32)
        shown = status & 2 == 0
        status = torch.where(is_asleep, 0, status)
        record = torch.zeros(n_clouds, 2 * (len(fields) + 2) + 9, dtype=torch.float64, device=means.device)
        for k, bit in enumerate([*(1 << f for f in range(len(fields))), OUTSIDE, FAST]):
            bad = status & bit != 0
            record[:, 2 * k].index_add_(0, cloud, bad.double())
            first = torch.full((n_clouds,), float(n), dtype=torch.float64, device=means.device)
            rows = torch.where(bad, torch.arange(n, device=means.device), n).double()
            first = first.scatter_reduce(0, cloud, rows, "amin")
            record[:, 2 * k + 1] = torch.where(first < n, first, -1.0)
        sums = record[:, 2 * (len(fields) + 2) :]
        usable = (status == 0) & ~is_asleep
        sums[:, 0].index_add_(0, cloud, usable.double())
        sums[:, 1].index_add_(0, cloud, torch.where(usable, squared / 2, 0.0))
        sums[:, 2].index_add_(0, cloud, torch.where(shown, opacities.double(), 0.0))
        for axis in range(3):
            for column, rest, reduce in ((3, LARGEST, "amin"), (6, -LARGEST, "amax")):
                values = torch.where(usable, means[:, axis].double(), rest)
                start = torch.full((n_clouds,), rest, dtype=torch.float64, device=means.device)
                sums[:, column + axis] = start.scatter_reduce(0, cloud, values, reduce)
        return status, record


def sanitized(fields, status, neutral, cu_rows, cloud_scene, origin, activity, previous=None):
    """(activity, *fields) of rows of which those with a status sleep."""
    faulty, goes_back = status & (OUTSIDE - 1) != 0, status & (OUTSIDE - 1 | FAST) != 0
    rows = [torch.where(status != 0, ASLEEP, activity)]
    for f, field in enumerate(fields):
        if previous is None:
            before = torch.zeros_like(field).reshape(len(field), -1)
            before[:, :1] = neutral[f]
            if f == 0:
                counts = cu_rows[1:] - cu_rows[:-1]
                before = origin[cloud_scene.repeat_interleave(counts)]
            before = before.reshape(field.shape).to(field)
        else:
            before = previous[f]
        row = torch.where(goes_back.reshape(-1, *[1] * (field.dim() - 1)), before, field)
        rows.append(torch.where(faulty, 0.0, row) if f == 1 else row)
    return rows
