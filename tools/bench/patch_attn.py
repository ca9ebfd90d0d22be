"""Patch attention against torch's scaled_dot_product_attention (its flash kernel on the CPU).

"gather": both start from one qkv tensor in row order; torch gathers it into patches and scatters the result back.
"ready": torch's tensors lie as [patches, heads, rows, dim] already and its result stays there.
"""

import torch
import torch.nn.functional as F
from harness import Bench

from gsim3d.ops import PatchTable, patch_attention

PATCH, N_PATCHES, HEADS = 1024, 16, 4


def with_gradient(leaf, f, cotangent):
    """A callable that runs f and its gradient to ``leaf``; results of two layouts compare after ``f``'s own view."""
    leaf = leaf.detach().requires_grad_()

    def run():
        out = f(leaf)
        return [out.detach(), *torch.autograd.grad(out, leaf, cotangent)]

    return run


def main():
    bench = Bench("patch_attn")
    n = PATCH * N_PATCHES
    generator = torch.Generator().manual_seed(0)
    order = torch.randperm(n, generator=generator)
    cu = torch.arange(N_PATCHES + 1) * PATCH
    for dim in (16, 32, 64):
        qkv = torch.randn(n, 3, HEADS, dim, generator=generator)
        cotangent = torch.randn(n, HEADS, dim, generator=generator)
        table = PatchTable(order, order, cu, cu)
        inverse = torch.empty_like(order)
        inverse[order] = torch.arange(n)

        def ours(x):
            return patch_attention(*x.unbind(1), table)

        def gathered(x):
            q, k, v = x.index_select(0, order).view(N_PATCHES, PATCH, 3, HEADS, dim).permute(2, 0, 3, 1, 4)
            out = F.scaled_dot_product_attention(q, k, v)
            return out.transpose(1, 2).reshape(n, HEADS, dim).index_select(0, inverse)

        def ready(x):
            return F.scaled_dot_product_attention(*x)

        name = f"{HEADS} heads of {dim}, {N_PATCHES} patches of {PATCH}"
        bench.compare(f"{name}, gather", lambda: ours(qkv), lambda: gathered(qkv))
        bench.compare(
            f"{name}, gather, fwd+bwd",
            with_gradient(qkv, ours, cotangent),
            with_gradient(qkv, gathered, cotangent),
        )

        # The same patches where nothing has to move: ours in row order, torch's as [3, P, H, rows, dim].
        table = PatchTable(torch.arange(n), torch.arange(n), cu, cu)

        def to_patches(x):
            return x.view(N_PATCHES, PATCH, *x.shape[1:]).movedim(1, -2)

        packed = to_patches(qkv).permute(1, 0, 2, 3, 4).contiguous()
        bench.compare(f"{name}, ready", lambda: to_patches(ours(qkv)), lambda: ready(packed))
        mine = with_gradient(qkv, ours, cotangent)
        bench.compare(
            f"{name}, ready, fwd+bwd",
            lambda: [to_patches(x) for x in mine()],
            with_packed(packed, ready, to_patches(cotangent).contiguous()),
        )
    bench.finish()


def with_packed(leaf, f, cotangent):
    """As with_gradient; the gradient [3, P, H, rows, dim] is returned as a view in the order of ours."""
    run = with_gradient(leaf, f, cotangent)

    def reordered():
        out, grad = run()
        return [out, grad.movedim(0, 1)]

    return reordered


if __name__ == "__main__":
    main()
