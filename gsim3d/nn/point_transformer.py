"""A U-shaped transformer over packed point clouds of several time steps.

Stem, then encoder stages that pool space and merge time, then decoder stages that go back to the rows of stage 0. All
geometry (neighbours, patches, clusters) comes from a :class:`gsim3d.ops.Pyramid`; this file holds features and weights.
Source:
    Point Transformer V3 (Wu et al. 2024), time merging of 3DGSim.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, Protocol

import torch
from torch import Tensor, nn
from torch.nn import functional as F
from torch.utils.checkpoint import checkpoint

from gsim3d import ops
from gsim3d.errors import check_ranges
from gsim3d.nn import layers
from gsim3d.nn.fused_block import run_block
from gsim3d.nn.layers import RowLayerNorm, RowLinear, make_norm, product_dtype, rounded_weights, row_linear, widened
from gsim3d.ops.curve import PatchTable, Pyramid, PyramidSpec, Stage
from gsim3d.ops.streams import Streams
from gsim3d.state import cached_zero, constant

STEM_KERNEL, BLOCK_KERNEL = 5, 3  # edges of the convolutions, in cells
MAX_HISTORY_BITS = 32  # that the geometry counts
TIME_EMBEDDING_STD = 0.02
COLUMN_MULTIPLE = 8  # of a matrix product; with others the bits of a row depend on its place in the list


@dataclass(frozen=True, kw_only=True)
class TransformerConfig:
    """Geometry and layers of a :class:`PointTransformer` of S levels; every per-level tuple starts at the finest."""

    grid_size: float = 0.004  #: metres, edge of a cell at level 0
    history_bits: int = 2  #: a history has 1 to 2^history_bits steps
    strides: tuple[int, ...] = (4, 2, 2, 2)  #: S - 1 powers of two: how much coarser the next level is
    merge_windows: tuple[int, ...] = (2, 2, 2, 8)  #: S - 1 powers of two: how many steps the next level merges
    patch_sizes: tuple[int, ...] = (1024,) * 5  #: particles that attend to each other
    time_embedding: bool = True  #: a learned vector distinguishes merged steps
    encoder_depths: tuple[int, ...] = (2, 2, 2, 6, 2)  #: S, blocks
    encoder_channels: tuple[int, ...] = (32, 64, 128, 256, 512)  #: S
    encoder_heads: tuple[int, ...] = (2, 4, 8, 16, 32)  #: S
    decoder_depths: tuple[int, ...] = (2, 2, 2, 2)  #: S - 1, blocks of levels 0 to S - 2
    decoder_channels: tuple[int, ...] = (64, 64, 128, 256)  #: S - 1, of levels 0 to S - 2
    decoder_heads: tuple[int, ...] = (4, 4, 8, 16)  #: S - 1, of levels 0 to S - 2
    mlp_ratio: int = 4  #: hidden channels of a block's MLP over its channels
    norm: str = "batch"  #: "layer", or "batch" as published: evaluation uses running statistics, training the call's
    zero_init: bool = False  #: the last layer starts at zero: untrained models that predict differences predict none
    drop_path: float = 0.3  #: share of particles that skip a branch of a block in training, growing from 0 at the first
    checkpointing: bool = False  #: blocks are computed again in the backward pass instead of being kept

    origin_of_scene: ClassVar[bool] = True  # cells are counted from the origin of a scene: scenes are independent
    slots_from_newest: ClassVar[bool] = True  # steps are counted back from the newest, in histories of any length

    def __post_init__(self):
        name, n = type(self).__name__, self.n_stages
        sizes = {
            "strides": n - 1, "merge_windows": n - 1, "patch_sizes": n,
            "encoder_depths": n, "encoder_heads": n,
            "decoder_depths": n - 1, "decoder_channels": n - 1, "decoder_heads": n - 1,
        }  # fmt: skip
        for key, size in sizes.items():
            if len(getattr(self, key)) != size:
                raise ValueError(f"{name}: {key} must have {size} entries, for {n} stages; got {getattr(self, key)}")
        for part in ("encoder", "decoder"):
            for channels, heads in zip(getattr(self, f"{part}_channels"), getattr(self, f"{part}_heads"), strict=True):
                if channels % heads:
                    raise ValueError(f"{name}: {part}_channels {channels} cannot be split into {heads} heads")
        if self.norm not in ("layer", "batch"):
            raise ValueError(f'{name}: norm must be "layer" or "batch"; got {self.norm!r}')
        if not 0 <= self.history_bits <= MAX_HISTORY_BITS:
            raise ValueError(f"{name}: history_bits must be from 0 to {MAX_HISTORY_BITS}; got {self.history_bits}")
        check_ranges(self, grid_size=(1e-6, 1e6), drop_path=(0, 1), mlp_ratio=(1, 100))
        counts = ("strides", "merge_windows", "patch_sizes", "encoder_heads", "decoder_heads")
        check_ranges(self, **dict.fromkeys((*counts, "encoder_channels", "decoder_channels"), (1, 10**5)))
        check_ranges(self, **dict.fromkeys(("encoder_depths", "decoder_depths"), (0, 100)))

    @property
    def n_stages(self) -> int:
        return len(self.encoder_channels)

    @property
    def out_channels(self) -> int:
        """Channels of a particle behind the decoder."""
        return (*self.decoder_channels, self.encoder_channels[-1])[0]

    def pyramid_spec(self, history_bits: int) -> PyramidSpec:
        """What the geometry op needs to know, for a history of up to 2^history_bits steps."""
        kernel_sizes = ((STEM_KERNEL, BLOCK_KERNEL),) + ((BLOCK_KERNEL,),) * (self.n_stages - 1)
        levels = tuple(self.strides), tuple(self.merge_windows), tuple(self.patch_sizes), kernel_sizes
        return PyramidSpec(self.grid_size, history_bits, *levels, release=not self.origin_of_scene)


class FrozenContext(Protocol):
    """What particles of a level read besides each other, or what records that: see :mod:`gsim3d.dynamics`.

    Attributes:
        records: whether it keeps what this call computes, instead of adding to it.
    """

    records: bool

    def convolved(self, conv: nn.Module, x: Tensor, out: Tensor) -> Tensor:
        """``out``, which ``conv`` made of ``x``, with what the context adds."""

    def attended(self, attention: nn.Module, q: Tensor, k: Tensor, v: Tensor, patches: PatchTable, row: int) -> Tensor:
        """The attention of ``q`` to ``k``, ``v`` and the context."""


class Extension(Protocol):
    """Further inputs and outputs of a network with weights of their own, joined to its products in order."""

    conv_proj: SparseConv | None  #: convolution of further inputs into the stem; None: there are none
    in_proj: RowLinear | None  #: product of inputs that are not convolved
    gain_head: RowLinear | None  #: product of the last hidden channels, for further outputs


class SparseConv(nn.Module):
    """Submanifold convolution; weight [C_out, K, K, K, C_in].

    Attributes:
        duplicates: as of :func:`gsim3d.ops.sparse_conv`.
        extensions: convolutions of further inputs, which come behind its own and are added in one product.
    """

    duplicates = "mean"

    def __init__(self, in_channels: int, out_channels: int, kernel_size: int, *, bias: bool):
        super().__init__()
        self.kernel_size, self.extensions = kernel_size, ()
        bound = (in_channels * kernel_size**3) ** -0.5
        shape = (out_channels, kernel_size, kernel_size, kernel_size, in_channels)
        self.weight = nn.Parameter(torch.empty(shape).uniform_(-bound, bound))
        self.bias = nn.Parameter(torch.empty(out_channels).uniform_(-bound, bound)) if bias else None

    def full_weight(self) -> Tensor:
        """The weight with those of all extensions."""
        return torch.cat([conv.weight for conv in (self, *self.extensions)], -1) if self.extensions else self.weight

    def forward(self, x: Tensor, stage: Stage, context: FrozenContext | None = None) -> Tensor:
        kernel_map, weight, bias = stage.kernel_maps[self.kernel_size], self.full_weight(), self.bias
        if x.is_cuda and not torch.is_grad_enabled() and not torch.compiler.is_compiling():
            if self.extensions:
                weight = weight.to(product_dtype(x))
            else:
                weight, bias = rounded_weights(self, product_dtype(x))
        out = ops.sparse_conv(x, weight, bias, stage.voxels, kernel_map, duplicates=self.duplicates, check=False)
        return out if context is None else context.convolved(self, x, out)


class PositionEncoding(nn.Module):
    """What a row learns about its place from its neighbours, added to the row: convolution, linear layer, norm."""

    def __init__(self, channels: int):
        super().__init__()
        self.conv = SparseConv(channels, channels, BLOCK_KERNEL, bias=True)
        self.linear = RowLinear(channels, channels)
        self.norm = RowLayerNorm(channels)

    def forward(self, x: Tensor, stage: Stage, residual: Tensor, context: FrozenContext | None = None) -> Tensor:
        return self.norm(self.linear(self.conv(x, stage, context)), residual)


class Attention(nn.Module):
    """Multi-head attention inside the patches of one serialization."""

    def __init__(self, channels: int, heads: int):
        super().__init__()
        self.heads = heads
        self.qkv = RowLinear(channels, 3 * channels)
        self.proj = RowLinear(channels, channels)

    def forward(self, x: Tensor, patches: PatchTable, row: int = 0, context: FrozenContext | None = None) -> Tensor:
        """x [N, C] in the patches of serialization ``row``."""
        q, k, v = self.qkv(x).unflatten(1, (3, self.heads, -1)).unbind(1)
        if context is None:
            out = ops.patch_attention(q, k, v, patches, check=False)
        else:
            out = context.attended(self, q, k, v, patches, row)
        return self.proj(out.flatten(1))


class MLP(nn.Module):
    def __init__(self, channels: int, hidden: int):
        super().__init__()
        self.fc1 = RowLinear(channels, hidden)
        self.fc2 = RowLinear(hidden, channels)

    def forward(self, x: Tensor) -> Tensor:
        return self.fc2(self.fc1(x, gelu=True))


class Block(nn.Module):
    """Position encoding, attention and MLP, each added to what came in.

    ``fused``: computed by :mod:`gsim3d.nn.fused_block` instead of the modules; None: on a GPU.
    """

    def __init__(self, channels: int, heads: int, drop_path: float, config: TransformerConfig):
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
        context: FrozenContext | None = None,
    ) -> Tensor:
        """x [N, C] with attention along serialization ``row``. ``conv_input``: read by the convolution, default x."""
        conv_input = x if conv_input is None else conv_input
        if self.is_fused(x, context):
            return self.advance(x, conv_input, stage, row, generator, context)[0]
        keep = self._draw_keep(x, generator)
        if self._recomputes():
            arguments = (x, conv_input, stage, row, *keep, context)
            return checkpoint(self._compute, *arguments, use_reentrant=False, preserve_rng_state=False)
        return self._compute(x, conv_input, stage, row, *keep, context)

    def is_fused(self, x: Tensor, context: FrozenContext | None = None) -> bool:
        if context is not None and (context.records or torch.is_grad_enabled()):
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
        context: FrozenContext | None = None,
    ) -> tuple[Tensor, Tensor]:
        """What :meth:`forward` returns where the block is fused, and the same in the dtype that convolutions read."""
        keep = self._draw_keep(x, generator)
        conv_input = conv_input.to(product_dtype(x))
        return run_block(self, x, conv_input, stage, row, keep, self._recomputes(), context)

    def _recomputes(self) -> bool:
        return self.checkpointing and self.training and torch.is_grad_enabled()

    def _compute(self, x, conv_input, stage, row, keep_attention, keep_mlp, context):
        x = self.position(conv_input, stage, x, context)
        x = x + scaled(self.attention(self.norm1(x), stage.patches[row], row, context), keep_attention)
        return x + scaled(self.mlp(self.norm2(x)), keep_mlp)

    def _draw_keep(self, x: Tensor, generator: torch.Generator | None) -> list[Tensor | None]:
        """Of both branches [N, 1]: 0 for particles that skip it, 1 / (1 - drop_path) for the others; None: none skips.

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
    context: FrozenContext | None = None,
) -> tuple[Tensor, Tensor]:
    """x behind ``blocks``, and the same as products and convolutions read it, so that one of them need not round it;
    the first convolution reads ``conv_input``, the others what the block before them made."""
    x = widened(x)
    for i, block in enumerate(blocks):
        row = i % len(stage.patches)
        if block.is_fused(x, context):
            x, conv_input = block.advance(x, conv_input, stage, row, generator, context)
        else:
            x = conv_input = block(x, stage, row, conv_input=conv_input, generator=generator, context=context)
    return x, conv_input if len(blocks) > 0 else x


class Stem(nn.Module):
    """Features of the particles -> channels of stage 0; own ones first, then those of extensions, convolved or not."""

    def __init__(self, in_channels: int, config: TransformerConfig, extensions: Sequence[Extension] = ()):
        super().__init__()
        channels = config.encoder_channels[0]
        self.conv = SparseConv(in_channels, channels, STEM_KERNEL, bias=False)
        self.conv.extensions = tuple(of.conv_proj for of in extensions if of.conv_proj is not None)
        self._in_projs = tuple(of.in_proj for of in extensions if of.in_proj is not None)
        self.norm = make_norm(config.norm, channels)

    def forward(self, x: Tensor, stage: Stage, context: FrozenContext | None = None) -> Tensor:
        n = sum(linear.in_features for linear in self._in_projs)
        x, others = x.split([x.shape[1] - n, n], 1)
        x = self.conv(x.contiguous(), stage, context)
        if n:
            sides = [others], [linear.weight for linear in self._in_projs]
            zeros = (cached_zero(of[0].dtype, x.device).expand(len(of[0]), -n % COLUMN_MULTIPLE) for of in sides)
            x = x + row_linear(*(torch.cat([*of, zero], 1) for of, zero in zip(sides, zeros, strict=True)), None)
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
        marks = constant(tuple(range(self.time_embedding.shape[0])), x.device)
        return x + (stage.time_index[:, None] == marks).to(x) @ self.time_embedding


class EncoderStage(nn.Module):
    def __init__(self, index: int, drop_paths: list[float], config: TransformerConfig):
        super().__init__()
        channels = config.encoder_channels
        self.pool = Pool(channels[index - 1], channels[index], config.norm) if index > 0 else None
        window = config.merge_windows[index - 1] if index > 0 else 1
        n_merged = 2 ** config.pyramid_spec(config.history_bits).merged_bits()[index]
        newest = n_merged - 1 if config.slots_from_newest and n_merged > 1 else None
        self.merge = Merge(window, channels[index], newest) if window > 1 and config.time_embedding else None
        heads = config.encoder_heads[index]
        self.blocks = nn.ModuleList(Block(channels[index], heads, rate, config) for rate in drop_paths)

    def forward(
        self, x: Tensor, stage: Stage, generator: torch.Generator | None, context: FrozenContext | None = None
    ) -> tuple[Tensor, Tensor]:
        if self.pool is not None:
            x = self.pool(x, stage)
        if self.merge is not None and self.merge.marks(stage):
            x = self.merge(x, stage)
        return run_blocks(self.blocks, x, x, stage, generator, context)


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
    def __init__(self, index: int, drop_paths: list[float], config: TransformerConfig):
        super().__init__()
        channels = config.decoder_channels
        below = (*channels, config.encoder_channels[-1])[index + 1]
        self.unpool = Unpool(below, config.encoder_channels[index], channels[index], config.norm)
        heads = config.decoder_heads[index]
        self.blocks = nn.ModuleList(Block(channels[index], heads, rate, config) for rate in drop_paths)

    def forward(
        self,
        x: Tensor,
        skip: Tensor,
        stage: Stage,
        coarse: Stage,
        generator: torch.Generator | None,
        context: FrozenContext | None = None,
    ) -> tuple[Tensor, Tensor]:
        x = self.unpool(x, skip, coarse)
        conv_input = self.conv_input(x, skip)
        return run_blocks(self.blocks, x, conv_input, stage, generator, context)

    def conv_input(self, x: Tensor, skip: Tensor) -> Tensor:
        """What the first convolution reads."""
        return x


class Head(nn.Module):
    """Hidden channels -> outputs, those of extensions behind its own."""

    def __init__(self, channels: int, out_channels: int, zero_init: bool, extensions: Sequence[Extension] = ()):
        super().__init__()
        self._products = tuple(of.gain_head for of in extensions if of.gain_head is not None)
        self.norm = RowLayerNorm(channels)
        self.fc1 = RowLinear(channels, channels)
        self.fc2 = RowLinear(channels, out_channels)
        if zero_init:
            nn.init.zeros_(self.fc2.weight)
            nn.init.zeros_(self.fc2.bias)

    def forward(self, x: Tensor, outputs: Sequence[tuple[int, int]] | None = None) -> Tensor:
        """``outputs``: channels to compute, as :meth:`RowLinear.some`; None: all."""
        x = self.fc1(F.gelu(self.norm(x)))
        if self._products:
            parts = self.fc2, *self._products
            weight, bias = (torch.cat([getattr(part, name) for part in parts]) for name in ("weight", "bias"))
            if outputs is not None:
                weight, bias = (torch.cat([t[a:b] for a, b in outputs]) for t in (weight, bias))
            return layers.rounded_linear(x, weight, bias)
        return self.fc2(x) if outputs is None else self.fc2.some(x, outputs)


class PointTransformer(nn.Module):
    """Features of all clouds -> features [N, config.out_channels] of the same particles, and a head.

    Args of forward:
        x: [N, in_channels and those of extensions, convolved ones first], of the particles of stage 0.
        pyramid: their geometry.
        generator: of drop path, in training; None: no drop path.
        contexts: of each stage what its particles read besides each other; none: nothing.
    """

    def __init__(
        self, in_channels: int, out_channels: int, config: TransformerConfig, extensions: Sequence[Extension] = ()
    ):
        super().__init__()
        self.stem = Stem(in_channels, config, extensions)
        rates = linear_rates(config.drop_path, config.encoder_depths)
        self.encoder = nn.ModuleList(EncoderStage(s, rates[s], config) for s in range(config.n_stages))
        rates = linear_rates(config.drop_path, config.decoder_depths)
        self.decoder = nn.ModuleList(DecoderStage(s, rates[s][::-1], config) for s in range(config.n_stages - 1))
        self.head = Head(config.out_channels, out_channels, config.zero_init, extensions)
        parts = (self.encoder, self.decoder)
        self._products = [m for part in parts for m in part.modules() if isinstance(m, (RowLinear, SparseConv))]

    def forward(
        self,
        x: Tensor,
        pyramid: Pyramid,
        *,
        generator: torch.Generator | None = None,
        contexts: Sequence[FrozenContext] = (),
    ) -> Tensor:
        contexts = contexts or [None] * len(pyramid.stages)
        if not x.is_cuda or torch.compiler.is_compiling():
            x = self.stem(x, pyramid.stages[0], contexts[0])
            return self._behind_stem(x, pyramid, generator, contexts)
        with Streams(x) as streams:
            rounded = streams.run(layers.round_weights, self._products, product_dtype(x))
            x = self.stem(x, pyramid.stages[0], contexts[0])
        with layers.use_rounded(rounded):
            return self._behind_stem(x, pyramid, generator, contexts)

    def _behind_stem(
        self, x: Tensor, pyramid: Pyramid, generator: torch.Generator | None, contexts: Sequence[FrozenContext | None]
    ) -> Tensor:
        stages, skips, reads = pyramid.stages, [], x
        with Streams(x) as streams:
            for s, (encoder, stage, context) in enumerate(zip(self.encoder, stages, contexts, strict=True)):
                # Gradients of two products that read the same are not added in 16 bits.
                x, reads = encoder(x if torch.is_grad_enabled() else reads, stage, generator, context)
                if s < len(self.decoder):  # made beside the deeper stages
                    lift = self.decoder[s].unpool.lift
                    skips.append(lift(reads, stage) if torch.is_grad_enabled() else streams.run(lift, reads, stage))
        for s in reversed(range(len(self.decoder))):
            x, reads = self.decoder[s](reads, skips[s], stages[s], stages[s + 1], generator, contexts[s])
        return x


def linear_rates(last: float, depths: tuple[int, ...]) -> list[list[float]]:
    """Drop-path rates of the blocks of each stage: from 0 at the first block to ``last`` at the last one."""
    n_blocks = sum(depths)
    rates = iter([last * i / max(n_blocks - 1, 1) for i in range(n_blocks)])
    return [[next(rates) for _ in range(depth)] for depth in depths]
