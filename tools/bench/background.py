"""What moving rows look up of a background, and attention to both, against the same in plain torch.

Four clouds of moving rows in one place of a scene, whose other rows rest: on a GPU 26k of 65k a step, on the CPU a
tenth.
"""

import torch
from harness import Bench

from gsim3d.ops import PatchTable, add_cells, curve_encode, find_cells, joint_attention, overlapping_patches
from gsim3d.ops.curve import CURVES

CLOUDS, CHANNELS, HEADS, PATCH, SIDE = 4, 64, 4, 1024, 64


def cells_of(n: int, low: int, high: int, generator: torch.Generator) -> torch.Tensor:
    return torch.randint(low, high, (n, 3), generator=generator)


def keys_of(grid: torch.Tensor) -> torch.Tensor:
    x, y, z = grid.unbind(1)
    return x << 32 | y << 16 | z


def plain_patches(first, kv_rows, cu_k, codes, order, cu_clouds):
    """Queries by patch, and where each patch begins; without parts."""
    ordered = codes.gather(1, order)
    patch = torch.searchsorted(first, ordered, right=True) - 1
    patch, by_patch = patch.sort(dim=1, stable=True)
    count = torch.arange(first.shape[1] + 1, device=first.device).expand(len(first), -1).contiguous()
    return order.gather(1, by_patch), torch.searchsorted(patch, count)


def cases(device: torch.device, n: int, n_rest: int, dtype: torch.dtype):
    """(name, dtype, ours, plain torch)."""
    g = torch.Generator().manual_seed(0)
    rest, moving = cells_of(n_rest, 0, SIDE, g), cells_of(n, 3 * SIDE // 8, 5 * SIDE // 8, g)
    cells = torch.cat([keys_of(rest).unique(), torch.tensor([torch.iinfo(torch.int64).max])]).to(device)
    scene, grid = torch.zeros(n, dtype=torch.int64, device=device), moving.to(device)

    def plain_cells():
        keys = keys_of(grid)
        at = torch.searchsorted(cells, keys)
        return torch.where(cells[at] == keys, at, len(cells) - 1)

    yield "cells", "int64", lambda: find_cells(cells, scene, grid), plain_cells

    x, field = (torch.randn(k, CHANNELS, generator=g).to(device, dtype) for k in (n, len(cells)))
    places = find_cells(cells, scene, grid)
    name = str(dtype).removeprefix("torch.")
    yield (
        "cells, added",
        name,
        lambda: add_cells(x, field, places, check=False),
        lambda: x + field.index_select(0, places),
    )

    codes, of_rest = (curve_encode(part.to(device), None, CURVES, depth=16, shift=48) for part in (moving, rest))
    cloud = torch.arange(n, device=device) * CLOUDS // n
    order = torch.stack([(own + (cloud << 49)).argsort() for own in codes])  # clouds above the codes
    cu_clouds = torch.arange(CLOUDS + 1, device=device) * (n // CLOUDS)
    kv_rows = of_rest.argsort(1)
    cu_k = torch.tensor([*range(0, n_rest, PATCH), n_rest], device=device)
    first = of_rest.gather(1, kv_rows)[:, cu_k[:-1]].contiguous()
    first[:, 0] = 0
    arguments = first, kv_rows, cu_k, codes, order, cu_clouds

    def ours():
        return torch.stack([table.q_rows for table in overlapping_patches(*arguments, patch_size=PATCH)])

    yield "patches of four curves", "int64", ours, lambda: plain_patches(*arguments)[0]

    other = overlapping_patches(*arguments, patch_size=PATCH)[0]
    cu = torch.tensor([*range(0, n, PATCH), n], device=device)
    own = PatchTable(order[0], order[0], cu, cu)
    q, k, v = torch.randn(3, n, HEADS, 16, generator=g).to(device, dtype)
    other_k, other_v = torch.randn(2, n_rest, HEADS, 16, generator=g).to(device, dtype)

    def joined():
        """The values of two calls do not say how much weight each table has: it is found from the logits' sums."""
        attend, lists = torch.ops.gsim3d.patch_attention, lambda t: (t.q_rows, t.kv_rows, t.cu_q, t.cu_k)
        (out, stats), (more, its_stats) = (
            attend(q, k, v, *lists(own), 0.25),
            attend(q, other_k, other_v, *lists(other), 0.25),
        )
        weight, its_weight = (s[..., 1:].log() + 0.25 * s[..., :1] for s in (stats, its_stats))
        share = torch.where(its_stats[..., 1:] > 0, (its_weight - weight).sigmoid(), 0.0)
        return (out + (more - out) * share).to(out.dtype)

    yield "attention to both", name, lambda: joint_attention(q, k, v, other_k, other_v, own, other), joined


@torch.no_grad()
def main():
    bench = Bench("background")
    if bench.device.type == "cuda":
        for name, dtype, ours, plain in cases(bench.device, 26216, 58982, torch.bfloat16):
            bench.gpu(f"{name}, 26k rows of four clouds", dtype, ours, {"torch": plain}, tolerance=2e-2)
    else:
        for name, _, ours, plain in cases(bench.device, 4096, 9216, torch.float32):
            bench.compare(f"{name}, 4k rows", ours, plain)
    bench.finish()


if __name__ == "__main__":
    main()
