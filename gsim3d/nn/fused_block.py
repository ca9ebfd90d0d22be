"""A block of the network for GPUs: the same numbers as its modules, in few launches and with one node of autograd.

The residual stream is float32; what matrix products, convolution and attention read has the dtype of
``torch.autocast``. Everything between them is done by ``residual_norm`` in one pass over the rows. Gradients are
written out below, for a backward pass in as few launches.
"""

import functools
from collections import namedtuple
from typing import NamedTuple

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable
from torch.nn import functional as F

from gsim3d.nn.layers import linear_grad_weight, rounded_weights, row_linear
from gsim3d.ops.curve import PatchTable, Stage
from gsim3d.ops.streams import Streams

_ops = torch.ops.gsim3d
_keys = torch._C.DispatchKey.AutocastCUDA, torch._C.DispatchKey.AutocastCPU
_autocast = torch._C.DispatchKeySet(_keys[0]) | torch._C.DispatchKeySet(_keys[1])


class BlockInputs(NamedTuple):
    """What a block reads besides tensors that have gradients."""

    stage: Stage
    patches: PatchTable
    kernel_size: int
    reads_lowest: bool
    heads: int
    eps: float
    recompute: bool

    def geometry(self) -> tuple:
        voxels, taps = self.stage.voxels, self.stage.kernel_maps[self.kernel_size]
        pairs = taps.tap_in, taps.tap_out, taps.cu_taps
        return voxels.row_voxel, voxels.rows, voxels.cu_rows, *pairs, self.reads_lowest

    def conv_plan(self) -> Tensor | None:
        return self.stage.kernel_maps[self.kernel_size].plan

    def table(self) -> tuple[Tensor, ...]:
        return self.patches.q_rows, self.patches.kv_rows, self.patches.cu_q, self.patches.cu_k


Weights = namedtuple(
    "Weights",
    "conv conv_bias linear linear_bias qkv qkv_bias proj proj_bias fc1 fc1_bias fc2 fc2_bias position_norm "
    "position_norm_bias norm1 norm1_bias norm2 norm2_bias",
)
# What the backward pass reads: results of the convolution, of the linear layer behind it, and of what follows.
Saved = namedtuple(
    "Saved",
    "place position sum1 normed1 position_stats stats1 qkv attended attention_stats sum2 normed2 stats2 hidden "
    "activated",
)


def run_block(block, x: Tensor, conv_input: Tensor, stage: Stage, row: int, keeps: list, recompute: bool, beside=None):
    """(x, what the next convolution reads) behind a ``point_transformer.Block``.

    x [N, C]; conv_input [N, C] in the dtype of the products; keeps: factors [N, 1] of the rows' branches or None;
    beside: what else the rows read, a ``background.Reader``, without gradients only.
    """
    conv, attention, mlp, position = block.position.conv, block.attention, block.mlp, block.position
    plan = BlockInputs(stage, stage.patches[row], conv.kernel_size, conv.duplicates == "first", attention.heads,
                block.norm1.eps, recompute)  # fmt: skip
    layers = (conv, position.linear, attention.qkv, attention.proj, mlp.fc1, mlp.fc2)
    norms = (position.norm, block.norm1, block.norm2)
    rounded = [t for layer in layers for t in rounded_weights(layer, conv_input.dtype)]
    of_norms = [t for norm in norms for t in (norm.weight, norm.bias)]
    if torch.is_grad_enabled():
        weights = [t for layer in layers for t in (layer.weight, layer.bias)]
        out = _Block.apply(plan, Weights(*rounded, *of_norms), x, conv_input, *keeps, *weights, *of_norms)
    else:
        with torch._C._AutoDispatchBelowAutograd(), torch._C._ExcludeDispatchKeyGuard(_autocast):
            reads = None if beside is None else _Reads(beside, conv, attention, row)
            out = _forward(plan, Weights(*rounded, *of_norms), x, conv_input, *keeps, reads)[0]
    return out if len(out) == 2 else (out[0], out[0])


class _Reads(NamedTuple):
    """A ``background.Reader`` and the modules whose part of the background a block reads."""

    beside: object
    conv: object
    attention: object
    row: int


def _forward(
    plan: BlockInputs, w: Weights, x: Tensor, conv_input: Tensor, keep_attention, keep_mlp, reads: _Reads | None = None
):
    """(sum,) or (sum, sum in the dtype of the products); Saved."""
    place = _ops.sparse_conv.default(conv_input, w.conv, w.conv_bias, *plan.geometry(), plan.conv_plan())
    if reads is not None:
        place = reads.beside.convolved(reads.conv, conv_input, place)
    position = row_linear(place, w.linear, w.linear_bias)
    norm, norm1, norm2 = (w.position_norm, w.position_norm_bias), (w.norm1, w.norm1_bias), (w.norm2, w.norm2_bias)
    sum1, normed1, position_stats, stats1 = _ops.residual_norm.default(x, position, None, *norm, *norm1, plan.eps)
    qkv = row_linear(normed1, w.qkv, w.qkv_bias)
    q, k, v = _heads(qkv, plan.heads)
    if reads is None:
        attended, attention_stats = _ops.patch_attention.default(q, k, v, *plan.table(), q.shape[-1] ** -0.5)
    else:
        attended, attention_stats = reads.beside.attended(reads.attention, q, k, v, plan.patches, reads.row), None
    branch = row_linear(attended.flatten(1), w.proj, w.proj_bias)
    sum2, normed2, _, stats2 = _ops.residual_norm.default(sum1, branch, keep_attention, None, None, *norm2, plan.eps)
    hidden = row_linear(normed2, w.fc1, w.fc1_bias)
    activated = F.gelu(hidden)
    branch = row_linear(activated, w.fc2, w.fc2_bias)
    if branch.dtype == x.dtype:
        out = (sum2 + (branch if keep_mlp is None else branch * keep_mlp),)
    else:
        out = _ops.residual_norm.default(sum2, branch, keep_mlp, None, None, None, None, plan.eps)[:2]
    return out, Saved(place, position, sum1, normed1, position_stats, stats1, qkv, attended, attention_stats, sum2,
                     normed2, stats2, hidden, activated)  # fmt: skip


def _heads(qkv: Tensor, heads: int) -> tuple[Tensor, ...]:
    return qkv.view(qkv.shape[0], 3, heads, qkv.shape[1] // (3 * heads)).unbind(1)


def _backward(plan, w: Weights, kept: Saved, conv_input: Tensor, keep_attention, keep_mlp, grad_sum, grad_out, streams):
    """Gradients of x, conv_input and all weights, in their order; those of weights of layers run in ``streams``."""
    # Without a norm of the branch the op reads only the dtype of the branch: any tensor like it will do.
    grad2, grad_branch, fc2_bias, *_ = _ops.residual_norm_backward.default(
        grad_sum, grad_out, kept.normed2, kept.sum2, keep_mlp, None, None, kept.stats2[:0], kept.stats2[:0]
    )
    fc2 = streams.run(linear_grad_weight, grad_branch, kept.activated)
    grad_activated = grad_branch @ w.fc2
    zero, one = _zeros_and_ones(w.fc1.shape[0], grad2.dtype, grad2.device)
    grad_hidden, _, fc1_bias = _ops.norm_gelu_backward.default(grad_activated, kept.hidden, zero, one, zero)
    fc1 = streams.run(linear_grad_weight, grad_hidden, kept.normed2)
    grad_normed = grad_hidden @ w.fc1

    grad1, grad_branch, proj_bias, _, _, norm2, norm2_bias = _ops.residual_norm_backward.default(
        grad2, grad_normed, kept.normed2, kept.sum2, keep_attention, None, w.norm2, kept.stats2[:0], kept.stats2
    )
    proj = streams.run(linear_grad_weight, grad_branch, kept.attended.flatten(1))
    grad_attended = grad_branch @ w.proj
    q, k, v = _heads(kept.qkv, plan.heads)
    grad_qkv = _ops.patch_attention_backward_packed.default(
        grad_attended.view(q.shape), q, k, v, kept.attended, kept.attention_stats, *plan.table(), q.shape[-1] ** -0.5
    ).flatten(1)
    qkv = streams.run(linear_grad_weight, grad_qkv, kept.normed1)
    qkv_bias = streams.run(_ops.linear_grad_bias.default, grad_qkv)
    grad_normed = grad_qkv @ w.qkv

    grad_x, grad_position, linear_bias, *of_norms = _ops.residual_norm_backward.default(
        grad1, grad_normed, kept.position, kept.sum1, None, w.position_norm, w.norm1, kept.position_stats, kept.stats1
    )
    grad_place = grad_position @ w.linear
    conv, conv_bias = streams.run(
        _ops.sparse_conv_grad_weight.default, grad_place, conv_input, plan.kernel_size, *plan.geometry()
    )
    linear = streams.run(linear_grad_weight, grad_position, kept.place)
    grad_input = _ops.sparse_conv_grad_input.default(grad_place, w.conv, *plan.geometry(), plan.conv_plan())
    of_layers = conv, conv_bias, linear, linear_bias, qkv, qkv_bias, proj, proj_bias, fc1, fc1_bias, fc2
    return grad_x, grad_input, *of_layers, fc2_bias, *of_norms, norm2, norm2_bias


@functools.cache
def _zeros_and_ones(n: int, dtype: torch.dtype, device: torch.device) -> tuple[Tensor, Tensor]:
    """Mean and scale of a normalisation that changes nothing."""
    return torch.zeros(n, dtype=dtype, device=device), torch.ones(n, dtype=dtype, device=device)


class _Block(torch.autograd.Function):
    @staticmethod
    def forward(ctx, plan, weights, x, conv_input, keep_attention, keep_mlp, *parameters):
        with torch._C._AutoDispatchBelowAutograd(), torch._C._ExcludeDispatchKeyGuard(_autocast):
            out, kept = _forward(plan, weights, x, conv_input, keep_attention, keep_mlp)
        ctx.plan, ctx.weights = plan, weights
        ctx.set_materialize_grads(False)
        # The parameters are saved for torch to notice if they change before the backward pass.
        ctx.save_for_backward(x, conv_input, keep_attention, keep_mlp, *(() if plan.recompute else kept), *parameters)
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx, grad_sum, grad_out=None):
        x, conv_input, keep_attention, keep_mlp, *saved = ctx.saved_tensors
        with torch._C._AutoDispatchBelowAutograd(), torch._C._ExcludeDispatchKeyGuard(_autocast):
            if ctx.plan.recompute:
                kept = _forward(ctx.plan, ctx.weights, x, conv_input, keep_attention, keep_mlp)[1]
            else:
                kept = Saved(*saved[: len(Saved._fields)])
            keeps = keep_attention, keep_mlp
            with Streams(conv_input) as streams:
                grads = _backward(ctx.plan, ctx.weights, kept, conv_input, *keeps, grad_sum, grad_out, streams)
        return None, None, *grads[:2], None, None, *grads[2:]
