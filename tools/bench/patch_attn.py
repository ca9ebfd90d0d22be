#!/usr/bin/env python
"""Patch attention against torch's scaled_dot_product_attention: flash on the CPU, cuDNN's and flash on CUDA.

"gather": both start from one qkv tensor in row order; torch gathers it into patches and scatters the result back.
"ready": nothing has to move; torch's tensors lie as [3, patches, heads, rows, dim] and its result stays there.
"""

import torch
import torch.nn.functional as F
from harness import Bench
from torch.nn.attention import SDPBackend, sdpa_kernel

from gsim3d.ops import PatchTable, patch_attention

HEADS = 4
PEERS = {"cuDNN": SDPBackend.CUDNN_ATTENTION, "flash": SDPBackend.FLASH_ATTENTION}
PATCH = 1024  # rows, on CUDA
# (rows, heads, head dim, dtype, gather, target ratio, limits in ms of forward and of both passes): see performance.md
GPU_CASES = (
    (65536, 4, 16, torch.bfloat16, False, 1.5, (0.064, 0.128)),
    (65536, 32, 16, torch.bfloat16, False, 1.5, (0.514, 1.03)),
    (65536, 4, 16, torch.float16, False, None, (0.064, 0.128)),
    (65536, 4, 16, torch.bfloat16, True, None, (0.064, 0.128)),
    (16384, 8, 16, torch.bfloat16, False, None, (0.032, 0.064)),
    (65536, 4, 32, torch.bfloat16, False, None, (0.064, 0.128)),
    (65536, 4, 64, torch.bfloat16, False, None, (0.064, 0.128)),
    (16384, 4, 16, torch.float32, False, None, (None, None)),
)
SIZES = ((16, 1024, 16), (16, 1024, 32), (16, 1024, 64), (128, 128, 16))  # patches, rows of a patch, head dim


def with_gradient(leaf, f, cotangent):
    """A callable that gives f(leaf) and its gradient to ``leaf``."""
    leaf = leaf.detach().requires_grad_()

    def run():
        out = f(leaf)
        return [out.detach(), *torch.autograd.grad(out, leaf, cotangent)]

    return run


def gather_case(bench, name, qkv, cotangent, n_patches, patch):
    n, _, heads, dim = qkv.shape
    order = torch.randperm(n, generator=torch.Generator().manual_seed(1))
    inverse = order.argsort()
    cu = torch.arange(n_patches + 1) * patch
    table = PatchTable(order, order, cu, cu)

    def ours(x):
        return patch_attention(*x.unbind(1), table)

    def plain(x):
        q, k, v = x.index_select(0, order).view(n_patches, patch, 3, heads, dim).permute(2, 0, 3, 1, 4)
        out = F.scaled_dot_product_attention(q, k, v)
        return out.transpose(1, 2).reshape(n, heads, dim).index_select(0, inverse)

    bench.compare(f"{name}, gather", lambda: ours(qkv), lambda: plain(qkv))
    pair = with_gradient(qkv, ours, cotangent), with_gradient(qkv, plain, cotangent)
    bench.compare(f"{name}, gather, fwd+bwd", *pair)


def ready_case(bench, name, qkv, cotangent, n_patches, patch):
    rows, cu = torch.arange(qkv.shape[0]), torch.arange(n_patches + 1) * patch
    table = PatchTable(rows, rows, cu, cu)

    def ours(x):
        return patch_attention(*x.unbind(1), table)

    def plain(x):
        return F.scaled_dot_product_attention(*x)

    def to_patches(x):
        return x.view(n_patches, patch, *x.shape[1:]).movedim(1, -2)

    packed = to_patches(qkv).transpose(0, 1).contiguous()
    bench.compare(f"{name}, ready", lambda: to_patches(ours(qkv)), lambda: plain(packed))
    run_ours = with_gradient(qkv, ours, cotangent)
    run_plain = with_gradient(packed, plain, to_patches(cotangent).contiguous())

    def plain_in_our_order():
        out, grad = run_plain()
        return [out, grad.transpose(0, 1)]

    bench.compare(f"{name}, ready, fwd+bwd", lambda: [to_patches(x) for x in run_ours()], plain_in_our_order)


def gpu_case(bench, n, heads, dim, dtype, gather, target_ratio, limits_ms):
    """Queries, keys and values are parts of one tensor. "gather": rows have to be brought into patches and back."""
    generator = torch.Generator(bench.device).manual_seed(n + heads)
    shape = n // PATCH, PATCH, heads, dim
    qkv = torch.randn(n, 3, heads, dim, generator=generator, device=bench.device).to(dtype)
    cotangent = torch.randn(n, heads, dim, generator=generator, device=bench.device).to(dtype)
    cu = torch.arange(n // PATCH + 1, device=bench.device) * PATCH
    order = torch.arange(n, device=bench.device)
    if gather:
        order = torch.randperm(n, generator=generator, device=bench.device)
    inverse = order.argsort()
    table = PatchTable(order, order, cu, cu)

    def ours(*x):
        return patch_attention(*(x[0].unbind(1) if gather else x), table).view(n, heads, dim)

    def peer(backend):
        def run(*x):
            if gather:
                x = x[0].index_select(0, order).unbind(1)
            with sdpa_kernel(backend):
                out = F.scaled_dot_product_attention(*(part.view(shape).transpose(1, 2) for part in x)).transpose(1, 2)
            out = out.reshape(n, heads, dim)
            return out.index_select(0, inverse) if gather else out

        return run

    inputs = [qkv] if gather else qkv.unbind(1)
    leaves = [x.detach().requires_grad_() for x in inputs]

    def both(f):
        def run():
            out = f(*leaves)
            return [out.detach(), *torch.autograd.grad(out, leaves, cotangent)]

        return run

    backends = {"math": SDPBackend.MATH} if dtype == torch.float32 else PEERS
    peers = {name: peer(backend) for name, backend in backends.items()}
    name = f"{n // 1024}k rows, {PATCH} a patch, {heads} heads of {dim}" + (", gather" if gather else "")
    options = {"target_ratio": target_ratio, "tolerance": 1e-5 if dtype == torch.float32 else 2e-2}
    name_of_dtype = str(dtype).removeprefix("torch.")
    with torch.no_grad():
        bench.gpu(
            f"{name}: fwd",
            name_of_dtype,
            lambda: ours(*inputs),
            {p: lambda f=f: f(*inputs) for p, f in peers.items()},
            limit_ms=limits_ms[0],
            **options,
        )
    bench.gpu(
        f"{name}: fwd+bwd",
        name_of_dtype,
        both(ours),
        {p: both(f) for p, f in peers.items()},
        limit_ms=limits_ms[1],
        **options,
    )


def main():
    bench = Bench("patch_attn")
    if bench.device.type == "cuda":
        for case in GPU_CASES:
            gpu_case(bench, *case)
        return bench.finish()
    generator = torch.Generator().manual_seed(0)
    for n_patches, patch, dim in SIZES:
        qkv = torch.randn(n_patches * patch, 3, HEADS, dim, generator=generator)
        cotangent = torch.randn(n_patches * patch, HEADS, dim, generator=generator)
        name = f"{n_patches} x {patch}, {HEADS} heads of {dim}"
        gather_case(bench, name, qkv, cotangent, n_patches, patch)
        ready_case(bench, name, qkv, cotangent, n_patches, patch)
    bench.finish()


if __name__ == "__main__":
    main()
