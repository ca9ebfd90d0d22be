"""Point Transformer V3 as its authors published it in 2024: a backbone whose weights load by name.

The layers are those of :mod:`gsim3d.nn.point_transformer`, without time and without a head; what the published weights
were trained with and the project's own network does otherwise stands here.
"""

import dataclasses
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from gsim3d import ops
from gsim3d.errors import InputError, check_one_of, check_ranges
from gsim3d.nn.point_transformer import (
    Block,
    Pool,
    SparseConv,
    Stem,
    TransformerConfig,
    Unpool,
    linear_rates,
    run_blocks,
    scaled,
)
from gsim3d.ops._arguments import check_tensors
from gsim3d.ops.curve import CURVES, Pyramid, PyramidSpec, Stage

MIRRORS, DEPTH_RULES = ("block", "mlp"), ("largest", "count")
MAX_DEPTH, N_LISTS = 16, 4  # levels of a curve, serializations that the geometry op makes


@dataclass(frozen=True, kw_only=True)
class PointTransformerV3Config:
    """Sizes of a :class:`PointTransformerV3` of S levels, finest first; defaults are those of the published networks.

    Attributes:
        in_channels: features of a point.
        mirror: what a block's convolution reads of the block before: "block", its output (PointTransformerV3 since
            March 2024, Pointcept v1.5.2 and later); "mlp", the branch of its MLP alone (Pointcept v1.5.0 and v1.5.1, of
            which the published weights are). Weights do not show it.
        depth_rule: levels of the curves: "largest", the bits of the largest cell coordinate m of a call; "count", those
            of m + 1 (Pointcept v1.6.0 and later). They differ where m + 1 is a power of two.
        curves: 1 to 4 names out of :data:`gsim3d.CURVES`; block i of a level attends along curve i modulo their number.
        strides: S - 1 powers of two.
        patch_sizes: S, points that attend to each other, in encoder and decoder.
        encoder_depths, encoder_channels, encoder_heads: S each.
        decoder_depths, decoder_channels, decoder_heads: S - 1 each.
        mlp_ratio: hidden channels of a block's MLP over its channels.
        drop_path: share of points that skip a branch, growing from 0 at the first block. In training.
    """

    in_channels: int = 6
    mirror: str = "block"
    depth_rule: str = "largest"
    curves: tuple[str, ...] = CURVES
    strides: tuple[int, ...] = (2, 2, 2, 2)
    patch_sizes: tuple[int, ...] = (1024,) * 5
    encoder_depths: tuple[int, ...] = (2, 2, 2, 6, 2)
    encoder_channels: tuple[int, ...] = (32, 64, 128, 256, 512)
    encoder_heads: tuple[int, ...] = (2, 4, 8, 16, 32)
    decoder_depths: tuple[int, ...] = (2, 2, 2, 2)
    decoder_channels: tuple[int, ...] = (64, 64, 128, 256)
    decoder_heads: tuple[int, ...] = (4, 4, 8, 16)
    mlp_ratio: int = 4
    drop_path: float = 0.3

    def __post_init__(self):
        name = type(self).__name__
        check_one_of(f"{name}: mirror", self.mirror, MIRRORS)
        check_one_of(f"{name}: depth_rule", self.depth_rule, DEPTH_RULES)
        if not 1 <= len(self.curves) <= N_LISTS or not set(self.curves) <= set(CURVES):
            raise InputError(f"{name}: curves must be 1 to {N_LISTS} of {', '.join(CURVES)}; got {self.curves}")
        check_ranges(self, in_channels=(1, 10**5))
        self.layers()

    def layers(self) -> TransformerConfig:
        """The same sizes for the layers that it shares with the project's own network."""
        shared = {field.name for field in dataclasses.fields(TransformerConfig)}
        own = {field.name: getattr(self, field.name) for field in dataclasses.fields(self) if field.name in shared}
        without_time = {"history_bits": 0, "merge_windows": (1,) * len(self.strides), "time_embedding": False}
        return TransformerConfig(grid_size=1.0, **without_time, **own)

    def pyramid_spec(self) -> PyramidSpec:
        """The geometry of the network; an edge of a cell is 1."""
        return self.layers().pyramid_spec(0)


class BranchBlock(Block):
    """A block that gives the next convolution its MLP's branch instead of its output."""

    def is_fused(self, x: Tensor, context=None) -> bool:
        return True  # computed by `advance` everywhere

    def advance(self, x, conv_input, stage, row, generator, context=None) -> tuple[Tensor, Tensor]:
        keep_attention, keep_mlp = self._draw_keep(x, generator)
        x = self.position(conv_input, stage, x, context)
        x = x + scaled(self.attention(self.norm1(x), stage.patches[row], row, context), keep_attention)
        branch = scaled(self.mlp(self.norm2(x)), keep_mlp)
        return x + branch, branch


class PointTransformerV3(nn.Module):
    """Features of points -> features [N, decoder_channels[0]] of the same points, in their order.

    Geometry comes from :meth:`pyramid`, made once for any number of calls; features do not depend on positions inside a
    cell. Where points share a cell, convolutions read the first one of a neighbour cell.

    Args of forward:
        x: [N, in_channels].
        pyramid: of the same points.
        generator: of drop path, in training; None: no drop path.

    Source:
        Point Transformer V3 (Wu et al. 2024), without a segmentation head.

    Example:
        >>> from gsim3d.nn import PointTransformerV3, PointTransformerV3Config
        >>> model = PointTransformerV3(PointTransformerV3Config(in_channels=3)).eval()
        >>> cells = torch.tensor([[0, 0, 0], [1, 0, 0], [5, 2, 1]])
        >>> model(torch.ones(3, 3), model.pyramid(cells, torch.tensor([0, 3]))).shape
        torch.Size([3, 64])
    """

    def __init__(self, config: PointTransformerV3Config):
        super().__init__()
        self.config = config
        layers, channels, up = config.layers(), config.encoder_channels, config.decoder_channels
        block = BranchBlock if config.mirror == "mlp" else Block

        def blocks(channels: int, heads: int, rates: list[float]) -> nn.ModuleList:
            return nn.ModuleList(block(channels, heads, rate, layers) for rate in rates)

        self.stem = Stem(config.in_channels, layers)
        self.pools = nn.ModuleList(Pool(a, b, "batch") for a, b in zip(channels, channels[1:]))
        rates = linear_rates(config.drop_path, config.encoder_depths)
        self.encoder = nn.ModuleList(map(blocks, channels, config.encoder_heads, rates))
        below = (*up, channels[-1])[1:]
        self.unpools = nn.ModuleList(Unpool(*sizes, "batch") for sizes in zip(below, channels, up))
        rates = [of_stage[::-1] for of_stage in linear_rates(config.drop_path, config.decoder_depths)]
        self.decoder = nn.ModuleList(map(blocks, up, config.decoder_heads, rates))
        for module in self.modules():
            if isinstance(module, SparseConv):
                module.duplicates = "first"

    def pyramid(
        self,
        cells: Tensor,
        cu_rows: Tensor,
        *,
        depth: int | None = None,
        permutations: Sequence[Sequence[int]] | None = None,
    ) -> Pyramid:
        """All geometry of a call.

        Args:
            cells: int32 or int64 [N, 3] in [0, 2^16), counted from the smallest one of each cloud: ``grid_coord`` of
                Pointcept.
            cu_rows: int64 [B + 1], rows of cloud b are cu_rows[b] .. cu_rows[b + 1]: 0, then Pointcept's ``offset``.
            depth: levels of the curves, which hold all cells; None: by the configuration's rule: CUDA waits once.
            permutations: per level the order of the curves, of those of the level before: row r is its row
                permutations[s][r]. Training draws them (Pointcept: at evaluation, too); None: as configured.
        Raises:
            InputError: a cell is out of range, or an argument has the wrong shape or dtype; the message names it.
        """
        name, n_curves, spec = type(self).__name__, len(self.config.curves), self.config.pyramid_spec()
        check_tensors(name, cells=cells, cu_rows=cu_rows)
        if cells.dtype not in (torch.int32, torch.int64) or cells.dim() != 2 or cells.shape[1] != 3:
            raise InputError(f"{name}: cells must be int32 or int64 [N, 3]; got {cells.dtype} {list(cells.shape)}")
        if depth is None:
            high = int(cells.max()) if len(cells) else 0
            depth = min(max(1, (high + (self.config.depth_rule == "count")).bit_length()), MAX_DEPTH)
        if permutations is None:
            permutations = [range(n_curves)] * spec.n_stages
        if [sorted(row) for row in permutations] != [list(range(n_curves))] * spec.n_stages:
            raise InputError(f"{name}: permutations must be {spec.n_stages} orders of {n_curves} curves")
        ids, curves = [CURVES.index(curve) for curve in self.config.curves], []
        for row in permutations:
            ids = [ids[r] for r in row]
            curves.append(tuple(ids[r % n_curves] for r in range(N_LISTS)))
        clouds = torch.arange(len(cu_rows) - 1, device=cells.device)
        origin = torch.zeros(len(clouds), 3, dtype=torch.float64, device=cells.device)
        places, slots = cells.double() + 0.5, torch.zeros_like(clouds)
        made = ops.build_pyramid(places, cu_rows, clouds, slots, origin, spec, curves=tuple(curves), depth=depth)
        if made.rows.shape[0] < len(cells):
            raise InputError(f"{name}: cells must be in [0, 2^{depth}); got {int(cells.min())} .. {int(cells.max())}")
        stages = [dataclasses.replace(stage, patches=stage.patches[:n_curves]) for stage in made.stages]
        return dataclasses.replace(made, stages=tuple(stages))

    def forward(self, x: Tensor, pyramid: Pyramid, *, generator: torch.Generator | None = None) -> Tensor:
        stages = getattr(pyramid, "stages", ())
        self._check(x, stages)
        x = self.stem(x, stages[0])
        skips = []
        for s, stage in enumerate(stages):
            if s > 0:
                x = self.pools[s - 1](x, stage)
            x, _ = run_blocks(self.encoder[s], x, x, stage, generator)
            skips.append(x)
        for s in reversed(range(len(self.decoder))):
            skip = self.unpools[s].lift(skips[s], stages[s])
            x = self.unpools[s](x, skip, stages[s + 1])
            x, _ = run_blocks(self.decoder[s], x, skip, stages[s], generator)  # convolutions first read the skip alone
        return x

    def _check(self, x: Tensor, stages: tuple[Stage, ...]) -> None:
        name = type(self).__name__
        if len(stages) != len(self.encoder):
            raise InputError(f"{name}: pyramid must have {len(self.encoder)} levels; got {len(stages)}; use .pyramid()")
        if x.dim() != 2 or x.shape[1] != self.config.in_channels or x.shape[0] != stages[0].n_rows:
            shape = [stages[0].n_rows, self.config.in_channels]
            raise InputError(f"{name}: x must be [N, in_channels] = {shape}; got {list(x.shape)}")

    def load_pointcept(self, state: Mapping[str, Tensor]) -> list[str]:
        """The keys of heads that were left out; the rest of a Pointcept state dict becomes this network's weights.

        Args:
            state: by Pointcept's names, with or without ``module.`` and ``backbone.`` before them
                (``torch.load(file, weights_only=True)["state_dict"]``).
        Raises:
            InputError: keys of another network (Sonata, PDNorm, RPE, ...), or missing, unknown or misshapen ones.
        """
        state = {key.removeprefix("module."): value for key, value in state.items()}
        heads = [key for key in state if key.startswith(HEADS)]
        state = {key.removeprefix("backbone."): value for key, value in state.items() if key not in heads}
        for variant, pattern in OTHER_NETWORKS.items():
            found = next((key for key in state if re.search(pattern, key)), None)
            if found is not None:
                raise InputError(f"load_pointcept: {found} belongs to {variant}, which this network does not compute")
        state = {key: value for key, value in state.items() if not key.endswith("num_batches_tracked")}
        own, names = self.state_dict(), {pointcept_name(name): name for name in self.state_dict()}
        problems = [f"missing: {key}" for key in names.keys() - state.keys()]
        problems += [f"unknown: {key}" for key in state.keys() - names.keys()]
        for key, value in state.items():
            if key in names and value.shape != (shape := own[names[key]].shape):
                problems.append(f"{key} must be {list(shape)}; got {list(value.shape)}")
        if problems:
            shown = "; ".join(sorted(problems)[:5])
            raise InputError(f"load_pointcept: {len(problems)} keys do not fit the configuration: {shown}")
        self.load_state_dict({names[key]: value for key, value in state.items()})
        return heads


HEADS = ("seg_head.", "cls_head.")
OTHER_NETWORKS = {  # tell-tale keys
    "a network with relative position tables (RPE)": r"\.rpe\.",
    "a network with norms by data set (PDNorm)": r"norm\.norm\.|norm\.0\.norm\.|proj(_skip)?\.1\.norm\.|\.modulation\.",
    "Point Prompt Training": r"^(embedding_table\.|class_embedding|proj_head\.|logit_scale)",
    "Utonia (PT-v3m3)": r"\.rope\.",
    "Sonata or Concerto (PT-v3m2)": r"embedding\.(stem\.linear|mask_token)|\.ls[12]\.0\.gamma",
    "a network with LoRA": r"\.(lora_[AB]|base_layer)\.",
    "the temporal network of 3DGSim (gsim3d import reads it)": r"dynamic_model\.net\.|\.merger\.",
}
OF_BLOCK = {
    "position.conv": "cpe.0", "position.linear": "cpe.1", "position.norm": "cpe.2",
    "norm1": "norm1.0", "attention": "attn", "norm2": "norm2.0", "mlp": "mlp.0",
}  # fmt: skip
OF_UNPOOL = {"proj": "proj.0", "proj_norm": "proj.1", "skip": "proj_skip.0", "skip_norm": "proj_skip.1"}


def pointcept_name(name: str) -> str:
    """What Pointcept calls the weight ``name`` of a :class:`PointTransformerV3`."""
    part, _, rest = name.partition(".")
    if part == "stem":
        return f"embedding.stem.{rest}"
    index, _, rest = rest.partition(".")
    if part == "pools":
        return f"enc.enc{int(index) + 1}.down.{rest.replace('norm.', 'norm.0.')}"
    if part == "unpools":
        layer, _, leaf = rest.partition(".")
        return f"dec.dec{index}.up.{OF_UNPOOL[layer]}.{leaf}"
    block, _, rest = rest.partition(".")
    layer = next(layer for layer in OF_BLOCK if rest.startswith(f"{layer}."))
    return f"{part[:3]}.{part[:3]}{index}.block{block}.{OF_BLOCK[layer]}{rest.removeprefix(layer)}"
