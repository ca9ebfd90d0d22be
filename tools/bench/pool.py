"""Pooling of feature rows over clusters and the way back, against the fastest plain torch form of each."""

import torch
from harness import Bench, best_seconds, with_gradients

from gsim3d.ops import pool_max, pool_mean, unpool


def clusters(n: int, mean_size: float, seed: int = 0):
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
    return rows, cu_rows, cluster


def inverted(rows, cu_rows):
    """The cluster of each row."""
    sizes = cu_rows.diff()
    return torch.empty_like(rows).index_copy(0, rows, torch.arange(len(sizes)).repeat_interleave(sizes))


def gpu(bench):
    """A quarter of 256k rows to a cluster; torch's forms as in the networks that use scatter or segment reductions."""
    n, channels = 262144, 64
    rows, cu_rows, cluster = (t.cuda() for t in clusters(n, 4))
    m = len(cu_rows) - 1
    generator = torch.Generator().manual_seed(1)
    x = (torch.randperm(n * channels, generator=generator).reshape(n, channels) / (n * channels)).cuda()
    small = torch.randn(m, channels, generator=generator).cuda()
    wide = cluster[:, None].expand(n, channels)

    def segment(x):
        return torch.segment_reduce(x.index_select(0, rows), "max", offsets=cu_rows, axis=0, unsafe=True)

    def scatter(x):
        return x.new_zeros(m, channels).scatter_reduce(0, wide, x, "amax", include_self=False)

    cases = {
        "max": (x, lambda x: pool_max(x, rows, cu_rows), {"segment_reduce": segment, "scatter_reduce": scatter}),
        "mean": (
            x,
            lambda x: pool_mean(x, rows, cu_rows),
            {
                "scatter_reduce": lambda x: x.new_zeros(m, channels).scatter_reduce(
                    0, wide, x, "mean", include_self=False
                )
            },
        ),
        "unpool": (
            small,
            lambda x: unpool(x, rows, cu_rows, n),
            {"index_select": lambda x: x.index_select(0, cluster)},
        ),
    }
    for name, (value, ours, forms) in cases.items():
        bench.gpu(
            f"{name}, 256k x 64 rows to {m}: fwd",
            "float32",
            lambda: ours(value),
            {peer: lambda f=f: f(value) for peer, f in forms.items()},
            tolerance=1e-6,
        )
        runs = with_gradients([value], ours, *forms.values())
        target = {"target_ratio": 5, "limit_ms": 0.04} if name == "max" else {}
        bench.gpu(
            f"{name}, 256k x 64 rows to {m}: fwd+bwd",
            "float32",
            runs[0],
            dict(zip(forms, runs[1:])),
            tolerance=1e-6,
            **target,
        )


def main():
    bench = Bench("pool")
    if bench.device.type == "cuda":
        gpu(bench)
        return bench.finish()
    for n, channels, size in ((65536, 64, 4), (65536, 64, 1.5), (16384, 256, 4)):
        rows, cu_rows, cluster = clusters(n, size)
        m, counts = len(cu_rows) - 1, cu_rows.diff()
        wide = cluster[:, None].expand(n, channels)
        generator = torch.Generator().manual_seed(1)
        # No two values are equal: torch's forms share the gradient of a tied maximum, ours gives it to the first row.
        x = torch.randperm(n * channels, generator=generator).reshape(n, channels) / (n * channels)
        small = torch.randn(m, channels, generator=generator)
        cases = {
            "max": (
                x,
                lambda x: pool_max(x, rows, cu_rows),
                lambda x: x.new_zeros(m, channels).scatter_reduce(0, wide, x, "amax", include_self=False),
                lambda x: torch.segment_reduce(x.index_select(0, rows), "max", offsets=cu_rows, axis=0),
            ),
            "mean": (
                x,
                lambda x: pool_mean(x, rows, cu_rows),
                lambda x: x.new_zeros(m, channels).index_add(0, cluster, x) / counts[:, None],
                lambda x: x.new_zeros(m, channels).scatter_reduce(0, wide, x, "mean", include_self=False),
                lambda x: torch.segment_reduce(x.index_select(0, rows), "mean", offsets=cu_rows, axis=0),
            ),
            # From the same lists as ours: spread the rows, or invert the list and gather.
            "unpool": (
                small,
                lambda x: unpool(x, rows, cu_rows, n),
                lambda x: x.new_zeros(n, channels).index_copy(0, rows, x.repeat_interleave(cu_rows.diff(), 0)),
                lambda x: x.index_select(0, inverted(rows, cu_rows)),
            ),
        }
        for name, (value, ours, *forms) in cases.items():
            title = f"{name}, {n // 1024}k x {channels} rows to {m}"
            plain = min(forms, key=lambda f: best_seconds(lambda: f(value)))
            bench.compare(f"{title}: fwd", lambda: ours(value), lambda: plain(value))
            runs = with_gradients([value], ours, *forms)
            bench.compare(f"{title}: fwd+bwd", runs[0], min(runs[1:], key=best_seconds))
    bench.finish()


if __name__ == "__main__":
    main()
