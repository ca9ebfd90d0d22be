"""Vision transformer (DINOv2) whose later blocks attend over all views of a scene (Depth Anything 3).

Names of modules are those of published weights.

Source:
    Oquab et al. 2023, "DINOv2"; Lin et al. 2025, "Depth Anything 3".
"""

import functools
from collections import OrderedDict
from dataclasses import dataclass
from typing import Literal

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from gsim3d.nn.resize import resize

ROTARY_BASE = 100.0
CAMERA_HEADS, CAMERA_SCALE = 16, 0.01  # heads of the camera encoder, and its untrained layer scale


@dataclass(frozen=True)
class Architecture:
    """Sizes of a backbone and of its DPT heads.

    A predicted depth of 1 is ``unit`` in metres: "cameras", the lower median of the cameras' distances to the first
    one, at least 0.1, as Depth Anything 3 was trained, or "range", the geometric mean of near and far.
    """

    dim: int  #: C, channels of the tokens
    heads: int  #: attention heads
    blocks: int  #: transformer blocks
    taken: tuple[int, ...]  #: blocks whose tokens the heads read, four, ascending
    mixes_from: int | None  #: from this block on, odd blocks attend over all views; None: each view is alone
    head_dim: int  #: channels of the heads' fused maps
    head_channels: tuple[int, ...]  #: channels of the heads' four maps before fusion
    mlp_ratio: int = 4  #: hidden channels of the feed-forward parts over C
    camera_blocks: int = 4  #: blocks of the camera encoder
    grid: int = 37  #: rows and columns of the learned position embedding
    patch: int = 14  #: pixels of a patch along each axis
    offset: float = 0.0  #: added to the number of patches where the position embedding is resized
    eps: float = 1e-6  #: of the last norm
    unit: Literal["cameras", "range"] = "range"  #: of predicted depths
    timm: str = ""  #: name of a model of timm, which then is the backbone

    @property
    def token_dim(self) -> int:
        """Channels of the tokens that the heads read."""
        return self.dim if self.mixes_from is None else 2 * self.dim


def perceptron(n_in: int, hidden: int, n_out: int) -> nn.Sequential:
    layers = {"fc1": nn.Linear(n_in, hidden), "act": nn.GELU(), "fc2": nn.Linear(hidden, n_out)}
    return nn.Sequential(OrderedDict(layers))


class LayerScale(nn.Module):
    def __init__(self, dim: int, value: float):
        super().__init__()
        self.gamma = nn.Parameter(torch.full((dim,), value))

    def forward(self, x: Tensor) -> Tensor:
        return x * self.gamma


class Attention(nn.Module):
    """Every token [N, T, C] attends to all T; queries and keys are normalised and rotated where ``rotates``."""

    def __init__(self, dim: int, heads: int, rotates: bool):
        super().__init__()
        self.heads = heads
        self.qkv = nn.Linear(dim, 3 * dim)
        self.q_norm = nn.LayerNorm(dim // heads) if rotates else nn.Identity()
        self.k_norm = nn.LayerNorm(dim // heads) if rotates else nn.Identity()
        self.proj = nn.Linear(dim, dim)

    def forward(self, x: Tensor, turn: Tensor | None = None) -> Tensor:
        q, k, v = self.qkv(x).unflatten(-1, (3, self.heads, -1)).permute(2, 0, 3, 1, 4)
        q, k = self.q_norm(q), self.k_norm(k)
        if turn is not None:
            q, k = rotate(q, turn), rotate(k, turn)
        x = F.scaled_dot_product_attention(q.to(v.dtype), k.to(v.dtype), v)
        return self.proj(x.transpose(1, 2).flatten(2))


class Block(nn.Module):
    def __init__(
        self, dim: int, heads: int, mlp_ratio: int, *, rotates: bool = False, eps: float = 1e-6, scale: float = 1.0
    ):
        super().__init__()
        self.norm1 = nn.LayerNorm(dim, eps)
        self.attn = Attention(dim, heads, rotates)
        self.ls1 = LayerScale(dim, scale)
        self.norm2 = nn.LayerNorm(dim, eps)
        self.mlp = perceptron(dim, mlp_ratio * dim, dim)
        self.ls2 = LayerScale(dim, scale)

    def forward(self, x: Tensor, turn: Tensor | None = None) -> Tensor:
        x = x + self.ls1(self.attn(self.norm1(x), turn))
        return x + self.ls2(self.mlp(self.norm2(x)))


def rotate(x: Tensor, turn: Tensor) -> Tensor:
    """[N, heads, T, d] rotated by the tables ``turn`` [2, T, d] of :func:`rotary`."""
    a, b = x.unflatten(-1, (2, 2, -1)).unbind(-2)
    cos, sin = turn.to(x.dtype)
    return x * cos + torch.stack([-b, a], -2).flatten(-3) * sin


def rotary(positions: Tensor, dim: int) -> Tensor:
    """[2, T, dim]: cosines, sines of tokens at ``positions`` [T, 2]: half the channels turn by row, half by column."""
    frequency = ROTARY_BASE ** (-torch.arange(dim // 4, dtype=torch.float64) / (dim // 4))
    angle = (positions[:, :, None] * frequency)[:, :, None].expand(-1, -1, 2, -1).flatten(1)
    return torch.stack([angle.cos(), angle.sin()])


@functools.cache
def _rotary_tables(
    grid: tuple[int, int], dim: int, n_views: int, dtype: torch.dtype, device: torch.device
) -> tuple[Tensor, Tensor]:
    """Tables within a view, where patches lie at row and column + 1, and over all views, where all lie at 1."""
    with torch.inference_mode(False):
        patches = torch.cartesian_prod(*(torch.arange(1, n + 1) for n in grid))
        within = F.pad(patches, (0, 0, 1, 0))  # the class token lies at 0
        return tuple(rotary(p, dim).to(device, dtype) for p in (within, within.clamp(max=1).repeat(n_views, 1)))


class ViT(nn.Module):
    """Normalised images -> tokens of the four taken blocks."""

    def __init__(self, config: Architecture):
        super().__init__()
        self.config = config
        dim, mixes_from = config.dim, config.mixes_from
        self.patch_embed = nn.Sequential(OrderedDict(proj=nn.Conv2d(3, dim, config.patch, config.patch)))
        self.cls_token = nn.Parameter(torch.zeros(1, 1, dim))
        self.pos_embed = nn.Parameter(torch.zeros(1, 1 + config.grid**2, dim))
        self.camera_token = None if mixes_from is None else nn.Parameter(torch.zeros(1, 2, dim))
        mixing = config.blocks if mixes_from is None else mixes_from
        self.blocks = nn.ModuleList(
            Block(dim, config.heads, config.mlp_ratio, rotates=i >= mixing) for i in range(config.blocks)
        )
        self.norm = nn.LayerNorm(dim, config.eps)
        for name, parameter in self.named_parameters():
            if parameter.dim() > 1:
                nn.init.normal_(parameter, std=0.02)
            elif name.endswith("bias"):
                nn.init.zeros_(parameter)

    def positions(self, grid: tuple[int, int]) -> Tensor:
        """[1, 1 + h w, C], the position embedding of the class token and of ``grid`` patches."""
        of_class, of_patches = self.pos_embed.split([1, self.config.grid**2], 1)
        maps = of_patches.mT.unflatten(-1, (self.config.grid, self.config.grid))
        return torch.cat([of_class, resize(maps, grid, "cubic", self.config.offset).flatten(2).mT], 1)

    def forward(self, images: Tensor, n_views: int = 1, camera_tokens: Tensor | None = None) -> Tensor:
        """Tokens of patches [I, 4, h w, C] of images [I, 3, H, W], multiples of the patch, V views of a scene after
        each other; where views mix [I, 4, h w, 2 C], of the last block within a view and of the taken one.
        ``camera_tokens``: [I, C] of the camera encoder; None: learned ones, of the first view and of the others."""
        config, grid = self.config, tuple(n // self.config.patch for n in images.shape[2:])
        x = self.patch_embed(images).flatten(2).mT
        x = torch.cat([self.cls_token.expand(len(x), -1, -1), x], 1) + self.positions(grid)
        if camera_tokens is None and config.mixes_from is not None:
            first, others = self.camera_token[0].split(1)
            camera_tokens = torch.cat([first, others.expand(n_views - 1, -1)]).repeat(len(x) // n_views, 1)
        within = over_views = None
        taken, alone = [], x
        for i, block in enumerate(self.blocks):
            if i == config.mixes_from:
                x = torch.cat([camera_tokens[:, None].to(x.dtype), x[:, 1:]], 1)
                head_dim = config.dim // config.heads
                within, over_views = _rotary_tables(grid, head_dim, n_views, self.pos_embed.dtype, x.device)
            if within is not None and i % 2:
                scenes = x.unflatten(0, (-1, n_views)).flatten(1, 2)
                x = block(scenes, over_views).unflatten(1, (n_views, -1)).flatten(0, 1)
            else:
                alone = x = block(x, within)
            if i in config.taken:
                normed = self.norm(x)
                taken.append((normed if config.mixes_from is None else torch.cat([alone, normed], -1))[:, 1:])
        return torch.stack(taken, 1)


class CameraEncoder(nn.Module):
    """Poses and fields of view [n, V, 9] of the views of n scenes -> a token [n, V, C] of each view."""

    def __init__(self, dim: int, n_blocks: int):
        super().__init__()
        self.pose_branch = perceptron(9, dim // 2, dim)
        self.token_norm = nn.LayerNorm(dim)
        trunk = (Block(dim, CAMERA_HEADS, 4, eps=1e-5, scale=CAMERA_SCALE) for _ in range(n_blocks))
        self.trunk = nn.Sequential(*trunk)
        self.trunk_norm = nn.LayerNorm(dim)

    def forward(self, poses: Tensor) -> Tensor:
        return self.trunk_norm(self.trunk(self.token_norm(self.pose_branch(poses))))
