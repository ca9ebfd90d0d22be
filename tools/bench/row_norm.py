"""Layer normalisation with the residual sum behind it, against torch's layer_norm and an addition."""

import torch
from harness import Bench, with_gradients
from torch.nn.functional import layer_norm

from gsim3d.ops import row_norm


def inputs(n: int, channels: int, device) -> list[torch.Tensor]:
    g = torch.Generator().manual_seed(0)
    return [
        torch.randn(*shape, generator=g).to(device)
        for shape in ((n, channels), (channels,), (channels,), (n, channels))
    ]


def plain(x, weight, bias, residual):
    return layer_norm(x, weight.shape, weight, bias) + residual


def main():
    bench = Bench("row_norm")
    cuda = bench.device.type == "cuda"
    for n, channels in ((262144, 64), (65536, 128), (16384, 512)) if cuda else ((65536, 64), (16384, 128), (4096, 256)):
        values = inputs(n, channels, bench.device)
        runs = with_gradients(values, row_norm, plain)
        title = f"{n // 1024}k x {channels}, with residual"
        if cuda:
            limit = n * channels * 4 / 4.2e9  # milliseconds for one pass over the rows at the memory's speed
            peers = {"layer_norm + add": lambda: plain(*values)}
            bench.gpu(f"{title}: fwd", "float32", lambda: row_norm(*values), peers, limit_ms=3 * limit)
            bench.gpu(f"{title}: fwd+bwd", "float32", runs[0], {"layer_norm + add": runs[1]}, limit_ms=6 * limit)
        else:
            bench.compare(f"{title}: fwd", lambda: row_norm(*values), lambda: plain(*values))
            bench.compare(f"{title}: fwd+bwd", *runs)
    bench.finish()


if __name__ == "__main__":
    main()
