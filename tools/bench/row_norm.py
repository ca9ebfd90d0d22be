"""Layer normalisation with the residual sum behind it, against torch's layer_norm and an addition."""

import torch
from harness import Bench
from torch.nn.functional import layer_norm

from gsim3d.ops import row_norm


def plain(x, weight, bias, residual):
    return layer_norm(x, weight.shape, weight, bias) + residual


def main():
    bench = Bench("row_norm")
    cuda = bench.device.type == "cuda"
    for n, channels in ((262144, 64), (65536, 128), (16384, 512)) if cuda else ((65536, 64), (16384, 128), (4096, 256)):
        g = torch.Generator().manual_seed(0)
        shapes = (n, channels), (channels,), (channels,), (n, channels)
        values = [torch.randn(*shape, generator=g).to(bench.device) for shape in shapes]
        limit = n * channels * 4 / 4.2e9  # milliseconds for one pass over the rows at the memory's speed
        case = f"{n // 1024}k x {channels}, with residual"
        bench.passes(case, values, row_norm, {"layer_norm + add": plain}, limits_ms=(3 * limit, 6 * limit))
    bench.finish()


if __name__ == "__main__":
    main()
