"""Patch attention against torch's scaled_dot_product_attention: its default on the CPU, cuDNN's and flash on CUDA.

Queries, keys and values are parts of one tensor. "gather": rows have to be brought into patches and back.
"""

from contextlib import nullcontext

import torch
import torch.nn.functional as F
from harness import Bench
from torch.nn.attention import SDPBackend, sdpa_kernel

from gsim3d.ops import PatchTable, patch_attention

PEERS = {"cuDNN": SDPBackend.CUDNN_ATTENTION, "flash": SDPBackend.FLASH_ATTENTION}
# (patches, rows of a patch, heads, head dim, dtype, gather, target ratio, limits in ms of forward and of both passes)
NONE = (None, None)
CPU_CASES = tuple(
    (n, patch, 4, dim, torch.float32, gather, None, NONE)
    for n, patch, dim in ((16, 1024, 16), (16, 1024, 32), (16, 1024, 64), (128, 128, 16))
    for gather in (True, False)
)
GPU_CASES = (
    (64, 1024, 4, 16, torch.bfloat16, False, 1.5, (0.064, 0.128)),
    (64, 1024, 32, 16, torch.bfloat16, False, 1.5, (0.514, 1.03)),
    (64, 1024, 4, 16, torch.float16, False, None, (0.064, 0.128)),
    (64, 1024, 4, 16, torch.bfloat16, True, None, (0.064, 0.128)),
    (16, 1024, 8, 16, torch.bfloat16, False, None, (0.032, 0.064)),
    (64, 1024, 4, 32, torch.bfloat16, False, None, (0.064, 0.128)),
    (64, 1024, 4, 64, torch.bfloat16, False, None, (0.064, 0.128)),
    (16, 1024, 4, 16, torch.float32, False, None, NONE),
)


def case(bench, n_patches, patch, heads, dim, dtype, gather, ratio, limits_ms):
    device, n = bench.device, n_patches * patch
    generator = torch.Generator(device).manual_seed(n + heads)
    shape = n_patches, patch, heads, dim
    qkv = torch.randn(n, 3, heads, dim, generator=generator, device=device).to(dtype)
    cu = torch.arange(n_patches + 1, device=device) * patch
    order = torch.randperm(n, generator=generator, device=device) if gather else torch.arange(n, device=device)
    inverse, table = order.argsort(), PatchTable(order, order, cu, cu)

    def ours(*x):
        return patch_attention(*(x[0].unbind(1) if gather else x), table).view(n, heads, dim)

    def peer(backend):
        def run(*x):
            if gather:
                x = x[0].index_select(0, order).unbind(1)
            with nullcontext() if backend is None else sdpa_kernel(backend):
                out = F.scaled_dot_product_attention(*(part.view(shape).transpose(1, 2) for part in x)).transpose(1, 2)
            out = out.reshape(n, heads, dim)
            return out.index_select(0, inverse) if gather else out

        return run

    backends = PEERS if dtype != torch.float32 else {"math": SDPBackend.MATH if device.type == "cuda" else None}
    peers = {name: peer(backend) for name, backend in backends.items()}
    name = f"{n // 1024}k rows, {patch} a patch, {heads} heads of {dim}" + (", gather" if gather else "")
    tolerance = 1e-5 if dtype == torch.float32 else 2e-2
    inputs = [qkv] if gather else [part.contiguous() if device.type == "cpu" else part for part in qkv.unbind(1)]
    bench.passes(name, inputs, ours, peers, ratio=ratio, limits_ms=limits_ms, tolerance=tolerance)


def main():
    bench = Bench("patch_attn")
    for options in GPU_CASES if bench.device.type == "cuda" else CPU_CASES:
        case(bench, *options)
    bench.finish()


if __name__ == "__main__":
    main()
