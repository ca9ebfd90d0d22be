#!/usr/bin/env python
"""Patch attention against torch's scaled_dot_product_attention (its flash kernel on the CPU).

"gather": both start from one qkv tensor in row order; torch gathers it into patches and scatters the result back.
"ready": nothing has to move; torch's tensors lie as [3, patches, heads, rows, dim] and its result stays there.
"""

import torch
import torch.nn.functional as F
from harness import Bench

from gsim3d.ops import PatchTable, patch_attention

HEADS = 4
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


def main():
    bench = Bench("patch_attn")
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
