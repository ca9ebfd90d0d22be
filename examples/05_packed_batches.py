"""Packs scenes of different sizes into one batch: one call, the bits of separate calls.

python examples/05_packed_batches.py
"""

import torch

from gsim3d.ops import curve_encode, curve_sort, pool_mean

torch.manual_seed(0)
sizes = [300, 50, 0, 700]  # particles of four clouds; an empty one is fine
cu_rows = torch.tensor([0, *sizes]).cumsum(0)
cloud = torch.repeat_interleave(torch.arange(len(sizes)), torch.tensor(sizes))
cells = torch.randint(0, 64, (sum(sizes), 3))

# Serialization: codes with the cloud above the bits of space, so one sort keeps clouds apart.
codes = curve_encode(cells, cloud, ["z", "hilbert"])
order, inverse = curve_sort(codes)
print("sorted by cloud:", bool((cloud[order[1]].diff() >= 0).all()))

# Patches of 64 consecutive rows, pooled: offsets into the order.
starts = torch.cat([torch.arange(int(a), int(b), 64) for a, b in zip(cu_rows[:-1], cu_rows[1:])])
cu_patches = torch.cat([starts, cu_rows[-1:]])
features = torch.randn(sum(sizes), 8)
pooled = pool_mean(features, order[1], cu_patches)
print("patches:", pooled.shape[0])

# The last cloud alone gives the same rows, bit by bit.
alone, _ = curve_sort(curve_encode(cells[350:], None, ["hilbert"]))
cu_alone = torch.cat([torch.arange(0, 700, 64), torch.tensor([700])])
print("equal bits:", torch.equal(pool_mean(features[350:], alone[0], cu_alone), pooled[-11:]))
