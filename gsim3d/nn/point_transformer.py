"""A U-shaped transformer over packed point clouds of several time steps.

Stem, then encoder stages that pool space and merge time, then decoder stages that go back to the rows of stage 0. All
geometry (neighbours, patches, clusters) comes from a :class:`gsim3d.ops.Pyramid`; this file holds features and weights.
Source: Point Transformer V3 (Wu et al. 2024), time merging of 3DGSim.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional as F
from torch.utils.checkpoint import checkpoint

from gsim3d import ops
from gsim3d.dynamics.background import Reader, Recorder
from gsim3d.dynamics.config import BLOCK_KERNEL, STEM_KERNEL, DynamicsConfig
from gsim3d.nn.fused_block import run_block
from gsim3d.nn.layers import (
    RowLayerNorm,
    RowLinear,
    at_hand,
    make_norm,
    product_dtype,
    round_at_once,
    rounded_weights,
    widened,
)
from gsim3d.ops.curve import PatchTable, Pyramid, Stage
from gsim3d.ops.streams import Branches

Beside = Recorder | Reader
TIME_EMBEDDING_STD = 0.02
TOLD_MULTIPLE = 8  # of the columns of a matrix product; with others the bits of a row depend on its place in the list


class SparseConv(nn.Module):
    """Submanifold convolution; weight [C_out, K, K, K, C_in]. duplicates: as of :func:`gsim3d.ops.sparse_conv`."""

    duplicates = "mean"

    def __init__(self, in_channels: int, out_channels: int, kernel_size: int, *, bias: bool):
        super().__init__()
        self.kernel_size = kernel_size
        bound = (in_channels * kernel_size**3) ** -0.5
        shape = (out_channels, kernel_size, kernel_size, kernel_size, in_channels)
        self.weight = nn.Parameter(torch.empty(shape).uniform_(-bound, bound))
        self.bias = nn.Parameter(torch.empty(out_channels).uniform_(-bound, bound)) if bias else None

    def forward(self, x: Tensor, stage: Stage, beside: Beside | None = None) -> Tensor:
        kernel_map, weight, bias = stage.kernel_maps[self.kernel_size], self.weight, self.bias
        if x.is_cuda and not torch.is_grad_enabled() and not torch.compiler.is_compiling():
            weight, bias = rounded_weights(self, product_dtype(x))
        out = ops.sparse_conv(x, weight, bias, stage.voxels, kernel_map, duplicates=self.duplicates, check=False)
        return out if beside is None else beside.convolved(self, x, out)


class PositionEncoding(nn.Module):
    """What a row learns about its place from its neighbours, added to the row: convolution, linear layer, norm."""

    def __init__(self, channels: int):
        super().__init__()
        self.conv = SparseConv(channels, channels, BLOCK_KERNEL, bias=True)
        self.linear = RowLinear(channels, channels)
        self.norm = RowLayerNorm(channels)

    def forward(self, x: Tensor, stage: Stage, residual: Tensor, beside: Beside | None = None) -> Tensor:
        return self.norm(self.linear(self.conv(x, stage, beside)), residual)


class Attention(nn.Module):
    """Multi-head attention inside the patches of one serialization."""

    def __init__(self, channels: int, heads: int):
        super().__init__()
        self.heads = heads
        self.qkv = RowLinear(channels, 3 * channels)
        self.proj = RowLinear(channels, channels)

    def forward(self, x: Tensor, patches: PatchTable, row: int = 0, beside: Beside | None = None) -> Tensor:
        """x [N, C] in the patches of serialization ``row``."""
        q, k, v = self.qkv(x).unflatten(1, (3, self.heads, -1)).unbind(1)
        if beside is None:
            out = ops.patch_attention(q, k, v, patches, check=False)
        else:
            out = beside.attended(self, q, k, v, patches, row)
        return self.proj(out.flatten(1))


class MLP(nn.Module):
    def __init__(self, channels: int, hidden: int):
        super().__init__()
        self.fc1 = RowLinear(channels, hidden)
        self.fc2 = RowLinear(hidden, channels)

    def forward(self, x: Tensor) -> Tensor:
        return self.fc2(F.gelu(self.fc1(x)))


class Block(nn.Module):
    """Position encoding, attention and MLP, each added to what came in.

    ``fused``: computed by :mod:`gsim3d.nn.fused_block` instead of the modules; None: on a GPU.
    """

    def __init__(self, channels: int, heads: int, drop_path: float, config: DynamicsConfig):
        super().__init__()
        self.drop_path, self.checkpointing, self.fused = drop_path, config.checkpointing, None
        self.position = PositionEncoding(channels)
        self.norm1 = RowLayerNorm(channels)
        self.attention = Attention(channels, heads)
        self.norm2 = RowLayerNorm(channels)
        self.mlp = MLP(channels, config.mlp_ratio * channels)

    def forward(
        self,
        x: Tensor,
        stage: Stage,
        row: int,
        *,
        conv_input: Tensor | None = None,
        generator: torch.Generator | None = None,
        beside: Beside | None = None,
    ) -> Tensor:
        """x [N, C] with attention along serialization ``row``. ``conv_input``: read by the convolution, default x."""
        conv_input = x if conv_input is None else conv_input
        if self.is_fused(x, beside):
            return self.advance(x, conv_input, stage, row, generator, beside)[0]
        keep = self._draw_keep(x, generator)
        if self._recomputes():
            arguments = (x, conv_input, stage, row, *keep, beside)
            return checkpoint(self._compute, *arguments, use_reentrant=False, preserve_rng_state=False)
        return self._compute(x, conv_input, stage, row, *keep, beside)

    def is_fused(self, x: Tensor, beside: Beside | None = None) -> bool:
        if isinstance(beside, Recorder) or (beside is not None and torch.is_grad_enabled()):
            return False
        if torch.compiler.is_compiling() or type(self.attention) is not Attention:  # a subclass computes otherwise
            return False
        return x.is_cuda if self.fused is None else self.fused

    def advance(
        self,
        x: Tensor,
        conv_input: Tensor,
        stage: Stage,
        row: int,
        generator: torch.Generator | None,
        beside: Reader | None = None,
    ) -> tuple[Tensor, Tensor]:
        """What :meth:`forward` returns where the block is fused, and the same in the dtype that convolutions read."""
        keep = self._draw_keep(x, generator)
        conv_input = conv_input.to(product_dtype(x))
        return run_block(self, x, conv_input, stage, row, keep, self._recomputes(), beside)

    def _recomputes(self) -> bool:
        return self.checkpointing and self.training and torch.is_grad_enabled()

    def _compute(self, x, conv_input, stage, row, keep_attention, keep_mlp, beside):
        x = self.position(conv_input, stage, x, beside)
        x = x + scaled(self.attention(self.norm1(x), stage.patches[row], row, beside), keep_attention)
        return x + scaled(self.mlp(self.norm2(x)), keep_mlp)

    def _draw_keep(self, x: Tensor, generator: torch.Generator | None) -> list[Tensor | None]:
        """Of both branches [N, 1]: 0 for rows that skip it, 1 / share kept for the others; None: nobody skips.

        Drawn before anything is computed: a generator does not repeat itself when the block is computed again.
        """
        if not self.training or generator is None or self.drop_path == 0:
            return [None, None]
        draws = torch.rand(2, x.shape[0], 1, generator=generator, device=generator.device)
        return list((draws >= self.drop_path).to(x).div_(1 - self.drop_path).unbind())


def scaled(x: Tensor, keep: Tensor | None) -> Tensor:
    return x if keep is None else x * keep


def run_blocks(
    blocks: nn.ModuleList,
    x: Tensor,
    conv_input: Tensor,
    stage: Stage,
    generator: torch.Generator | None,
    beside: Beside | None = None,
    *,
    for_products: bool = False,
) -> Tensor:
    """x behind ``blocks``; the first convolution reads ``conv_input``, the others what the block before them made.

    ``for_products``: only products read the result, so that without gradients it may have their dtype.
    """
    x = widened(x)
    for i, block in enumerate(blocks):
        row = i % len(stage.patches)
        if block.is_fused(x, beside):
            x, conv_input = block.advance(x, conv_input, stage, row, generator, beside)
        else:
            x = conv_input = block(x, stage, row, conv_input=conv_input, generator=generator, beside=beside)
    return conv_input if for_products and len(blocks) > 0 and not torch.is_grad_enabled() else x


class Stem(nn.Module):
    """Features of the particles -> channels of stage 0. What rows are told alone, the last ones, is not convolved."""

    def __init__(self, in_channels: int, told_channels: int, config: DynamicsConfig):
        super().__init__()
        channels = config.encoder_channels[0]
        self.widths = in_channels, told_channels
        self.conv = SparseConv(in_channels, channels, STEM_KERNEL, bias=False)
        rounded = -(-told_channels // TOLD_MULTIPLE) * TOLD_MULTIPLE
        self.told = RowLinear(rounded, channels, bias=False) if told_channels else None
        if told_channels:  # what begins with these weights may be told more
            nn.init.zeros_(self.told.weight[:, told_channels:])
        self.norm = make_norm(config.norm, channels)

    def forward(self, x: Tensor, stage: Stage, beside: Beside | None = None) -> Tensor:
        x, told = x.split(self.widths, 1)
        x = self.conv(x.contiguous(), stage, beside)
        if self.told is not None:
            x = x + self.told(F.pad(told, (0, self.told.in_features - told.shape[1])))
        return self.norm.activated(x, stage.n_data)


class Pool(nn.Module):
    """Maximum over the rows of a larger cell."""

    def __init__(self, in_channels: int, out_channels: int, norm: str):
        super().__init__()
        self.proj = RowLinear(in_channels, out_channels)
        self.norm = make_norm(norm, out_channels)

    def forward(self, x: Tensor, stage: Stage) -> Tensor:
        cluster = stage.cluster
        return self.norm.activated(ops.pool_max(self.proj(x), cluster.rows, cluster.cu_rows, check=False), stage.n_data)


class Merge(nn.Module):
    """Marks each row with its step inside the merged window. (That steps share a cloud is part of the geometry.)

    newest: the mark of the newest step, which a history of one step has throughout; None: it has none.
    """

    def __init__(self, window: int, channels: int, newest: int | None):
        super().__init__()
        self.newest = newest
        self.time_embedding = nn.Parameter(torch.empty(window, channels))
        nn.init.trunc_normal_(self.time_embedding, std=TIME_EMBEDDING_STD)

    def marks(self, stage: Stage) -> bool:
        """Whether there is anything to tell apart."""
        return stage.time_index is not None or self.newest is not None

    def forward(self, x: Tensor, stage: Stage) -> Tensor:
        if stage.time_index is None:
            return x + self.time_embedding[self.newest].to(x.dtype)
        # A product with a one-hot matrix: its gradient is a sum in row order, where indexing would use atomics on CUDA.
        return x + F.one_hot(stage.time_index, self.time_embedding.shape[0]).to(x) @ self.time_embedding


class EncoderStage(nn.Module):
    def __init__(self, index: int, drop_paths: list[float], config: DynamicsConfig):
        super().__init__()
        channels, self.is_last = config.encoder_channels, config.n_stages == 1
        self.pool = Pool(channels[index - 1], channels[index], config.norm) if index > 0 else None
        window = config.merge_windows[index - 1] if index > 0 else 1
        n_merged = 2 ** config.pyramid_spec(config.history_bits).merged_bits()[index]
        newest = n_merged - 1 if config.slots_from_newest and n_merged > 1 else None
        self.merge = Merge(window, channels[index], newest) if window > 1 and config.time_embedding else None
        self.blocks = nn.ModuleList(
            Block(channels[index], config.encoder_heads[index], drop_path, config) for drop_path in drop_paths
        )

    def forward(
        self, x: Tensor, stage: Stage, generator: torch.Generator | None, beside: Beside | None = None
    ) -> Tensor:
        if self.pool is not None:
            x = self.pool(x, stage)
        if self.merge is not None and self.merge.marks(stage):
            x = self.merge(x, stage)
        return run_blocks(self.blocks, x, x, stage, generator, beside, for_products=not self.is_last)


class Unpool(nn.Module):
    """Features of the coarser rows, added to what :meth:`lift` makes of those that the encoder had at this stage."""

    def __init__(self, in_channels: int, skip_channels: int, out_channels: int, norm: str):
        super().__init__()
        self.proj = RowLinear(in_channels, out_channels)
        self.proj_norm = make_norm(norm, out_channels)
        self.skip = RowLinear(skip_channels, out_channels)
        self.skip_norm = make_norm(norm, out_channels)

    def lift(self, skip: Tensor, stage: Stage) -> Tensor:
        return self.skip_norm.activated(self.skip(skip), stage.n_data)

    def forward(self, x: Tensor, skip: Tensor, coarse: Stage) -> Tensor:
        below = self.proj_norm.activated(self.proj(x), coarse.n_data)
        cluster = coarse.cluster
        return skip + ops.unpool(below, cluster.rows, cluster.cu_rows, skip.shape[0], check=False)


class DecoderStage(nn.Module):
    def __init__(self, index: int, drop_paths: list[float], config: DynamicsConfig):
        super().__init__()
        channels = config.decoder_channels
        below = (*channels, config.encoder_channels[-1])[index + 1]
        self.unpool = Unpool(below, config.encoder_channels[index], channels[index], config.norm)
        self.blocks = nn.ModuleList(
            Block(channels[index], config.decoder_heads[index], drop_path, config) for drop_path in drop_paths
        )
        self.is_last = index == 0

    def forward(
        self,
        x: Tensor,
        skip: Tensor,
        stage: Stage,
        coarse: Stage,
        generator: torch.Generator | None,
        beside: Beside | None = None,
    ) -> Tensor:
        x = self.unpool(x, skip, coarse)
        conv_input = self.conv_input(x, skip)
        return run_blocks(self.blocks, x, conv_input, stage, generator, beside, for_products=not self.is_last)

    def conv_input(self, x: Tensor, skip: Tensor) -> Tensor:
        """What the first convolution reads."""
        return x


class Head(nn.Module):
    def __init__(self, channels: int, out_channels: int, zero_init: bool):
        super().__init__()
        self.norm = RowLayerNorm(channels)
        self.fc1 = RowLinear(channels, channels)
        self.fc2 = RowLinear(channels, out_channels)
        if zero_init:
            nn.init.zeros_(self.fc2.weight)
            nn.init.zeros_(self.fc2.bias)

    def forward(self, x: Tensor, outputs: Sequence[tuple[int, int]] | None = None) -> Tensor:
        """``outputs``: channels to compute, as :meth:`RowLinear.some`; None: all."""
        x = self.fc1(F.gelu(self.norm(x)))
        return self.fc2(x) if outputs is None else self.fc2.some(x, outputs)


class PointTransformer(nn.Module):
    """Features [N, in_channels + told_channels] of all clouds -> features [N, decoder_channels[0]] of the same rows,
    and a head.

    Args of forward:
        x: features of the rows of stage 0.
        pyramid: their geometry.
        generator: of drop path, in training; None: no drop path.
        besides: of each stage what else its rows read, or who listens; none: nothing and nobody.
    """

    def __init__(self, in_channels: int, told_channels: int, out_channels: int, config: DynamicsConfig):
        super().__init__()
        self.stem = Stem(in_channels, told_channels, config)
        rates = linear_rates(config.drop_path, config.encoder_depths)
        self.encoder = nn.ModuleList(EncoderStage(s, rates[s], config) for s in range(config.n_stages))
        rates = linear_rates(config.drop_path, config.decoder_depths)
        self.decoder = nn.ModuleList(DecoderStage(s, rates[s][::-1], config) for s in range(config.n_stages - 1))
        self.head = Head((*config.decoder_channels, config.encoder_channels[-1])[0], out_channels, config.zero_init)
        parts = (self.encoder, self.decoder)
        self._products = [m for part in parts for m in part.modules() if isinstance(m, (RowLinear, SparseConv))]

    def forward(
        self,
        x: Tensor,
        pyramid: Pyramid,
        *,
        generator: torch.Generator | None = None,
        besides: Sequence[Beside] = (),
    ) -> Tensor:
        besides = besides or [None] * len(pyramid.stages)
        if not x.is_cuda or torch.compiler.is_compiling():
            x = self.stem(x, pyramid.stages[0], besides[0])
            return self._behind_stem(x, pyramid, generator, besides)
        with Branches(x) as branches:
            rounded = branches.run(round_at_once, self._products, product_dtype(x))
            x = self.stem(x, pyramid.stages[0], besides[0])
        with at_hand(rounded):
            return self._behind_stem(x, pyramid, generator, besides)

    def _behind_stem(
        self, x: Tensor, pyramid: Pyramid, generator: torch.Generator | None, besides: Sequence[Beside | None]
    ) -> Tensor:
        stages, skips = pyramid.stages, []
        with Branches(x) as branches:
            for s, (encoder, stage, beside) in enumerate(zip(self.encoder, stages, besides, strict=True)):
                x = encoder(x, stage, generator, beside)
                if s < len(self.decoder):  # made beside the deeper stages
                    lift = self.decoder[s].unpool.lift
                    skips.append(lift(x, stage) if torch.is_grad_enabled() else branches.run(lift, x, stage))
        for s in reversed(range(len(self.decoder))):
            x = self.decoder[s](x, skips[s], stages[s], stages[s + 1], generator, besides[s])
        return x


def linear_rates(last: float, depths: tuple[int, ...]) -> list[list[float]]:
    """Drop-path rates of the blocks of each stage: from 0 at the first block to ``last`` at the last one."""
    n_blocks = sum(depths)
    rates = iter([last * i / max(n_blocks - 1, 1) for i in range(n_blocks)])
    return [[next(rates) for _ in range(depth)] for depth in depths]
