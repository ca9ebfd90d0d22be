"""Frames of anchors on springs, against the same in plain torch."""

import torch
from harness import Bench

from gsim3d.ops import SpringLists, advance_springs

SECONDS, SUBSTEPS = 1 / 60, {"cpu": 10, "cuda": 100}


def plain(x, v, ends, lengths, stiffness, damping, substeps):
    """Springs [N, k] without a ground."""
    h = SECONDS / substeps
    for _ in range(substeps):
        apart, faster = x[ends] - x[:, None], v[ends] - v[:, None]
        distance = apart.square().sum(-1).sqrt()
        along = apart / distance[..., None]
        pull = stiffness * (distance - lengths) * (1 + (distance / lengths - 1).abs()).sqrt()
        v = v + h * ((pull + damping * (faster * along).sum(-1))[..., None] * along).sum(1)
        x = x + h * v
    return torch.cat([x, v])


def main():
    bench = Bench("springs")
    substeps = SUBSTEPS[bench.device.type]
    for n, k in ((2048, 256), (512, 32)):
        x = 0.3 * torch.rand(n, 3, generator=torch.Generator().manual_seed(0)).to(bench.device)
        lengths, ends = torch.cdist(x.double(), x.double()).fill_diagonal_(9.0).topk(k, largest=False)
        lengths, numbers = lengths.float(), torch.ones(n, device=x.device)
        lists = SpringLists.from_neighbors(ends.flatten(), k * torch.arange(n + 1, device=x.device))
        inputs = [1.02 * x, torch.zeros_like(x), 1 / lengths]

        def ours(x, v, stiffness, lists=lists, lengths=lengths, numbers=numbers):
            of = {"lengths": lengths.flatten(), "stiffness": stiffness.flatten(), "damping": 0.1 / lengths.flatten()}
            of |= {"grip": numbers, "external": torch.zeros_like(x)}
            return torch.cat(advance_springs(x, v, lists, **of, seconds=SECONDS, substeps=substeps))

        def torch_loop(x, v, stiffness, ends=ends, lengths=lengths):
            return plain(x, v, ends, lengths, stiffness, 0.1 / lengths, substeps)

        bench.passes(
            f"{n} anchors, {k} springs each, {substeps} substeps", inputs, ours, {"torch": torch_loop}, tolerance=1e-4
        )
    bench.finish()


if __name__ == "__main__":
    main()
