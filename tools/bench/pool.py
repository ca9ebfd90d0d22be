"""Pooling of feature rows over clusters and the way back, against the plain torch forms of each."""

import torch
from harness import Bench

from gsim3d.ops import pool_max, pool_mean, unpool


def clusters(n: int, mean_size: float, device: torch.device, seed: int = 0):
    """(rows, cu_rows, cluster of each row); rows of a cluster lie near each other, as after sorting along a curve."""
    generator = torch.Generator().manual_seed(seed)
    cluster = torch.sort(torch.randint(0, round(n / mean_size), (n,), generator=generator)).values
    cluster = torch.unique(cluster, return_inverse=True)[1]
    blocks = torch.arange(n).reshape(-1, 64)
    order = torch.stack([block[torch.randperm(64, generator=generator)] for block in blocks]).reshape(-1)
    cluster = cluster[order]
    rows = torch.argsort(cluster, stable=True)
    cu_rows = torch.zeros(int(cluster.max()) + 2, dtype=torch.int64)
    cu_rows[1:] = torch.cumsum(torch.bincount(cluster), 0)
    return [t.to(device) for t in (rows, cu_rows, cluster)]


def cases(n: int, channels: int, size: float, device: torch.device):
    """(name, input, ours, plain forms, goals)"""
    rows, cu_rows, cluster = clusters(n, size, device)
    m, counts, wide = len(cu_rows) - 1, cu_rows.diff(), cluster[:, None].expand(n, channels)
    generator = torch.Generator().manual_seed(1)
    # No two values are equal: torch's forms share the gradient of a tied maximum, ours gives it to the first row.
    x = (torch.randperm(n * channels, generator=generator).reshape(n, channels) / (n * channels)).to(device)
    small = torch.randn(m, channels, generator=generator).to(device)

    def scatter(kind):
        return lambda x: x.new_zeros(m, channels).scatter_reduce(0, wide, x, kind, include_self=False)

    def segment(kind):
        return lambda x: torch.segment_reduce(x.index_select(0, rows), kind, offsets=cu_rows, axis=0, unsafe=True)

    forms = {"scatter_reduce": scatter("amax"), "segment_reduce": segment("max")}
    yield "max", x, lambda x: pool_max(x, rows, cu_rows), forms, {"ratio": 5, "limits_ms": (None, 0.04)}
    forms = {"scatter_reduce": scatter("mean"), "segment_reduce": segment("mean")}
    forms["index_add"] = lambda x: x.new_zeros(m, channels).index_add(0, cluster, x) / counts[:, None]
    yield "mean", x, lambda x: pool_mean(x, rows, cu_rows), forms, {}
    forms = {"index_select": lambda x: x.index_select(0, cluster)}
    forms["index_copy"] = lambda x: x.new_zeros(n, channels).index_copy(0, rows, x.repeat_interleave(counts, 0))
    yield "unpool", small, lambda x: unpool(x, rows, cu_rows, n), forms, {}


def main():
    bench = Bench("pool")
    cuda = bench.device.type == "cuda"
    for n, channels, size in ((262144, 64, 4),) if cuda else ((65536, 64, 4), (65536, 64, 1.5), (16384, 256, 4)):
        for name, value, ours, forms, goals in cases(n, channels, size, bench.device):
            m = len(value) if name == "unpool" else len(ours(value))
            title = f"{name}, {n // 1024}k x {channels} rows to {m}"
            bench.passes(title, [value], ours, forms, tolerance=1e-6 if cuda else 1e-5, **goals)
    bench.finish()


if __name__ == "__main__":
    main()
