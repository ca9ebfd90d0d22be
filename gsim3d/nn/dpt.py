"""Dense prediction head: tokens of four blocks of a vision transformer -> a map at the size of the image.

Names of modules are those of published weights.

Source:
    Ranftl et al. 2021, "Vision Transformers for Dense Prediction"; Lin et al. 2025, "Depth Anything 3".
"""

import functools

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from gsim3d.nn.resize import resize
from gsim3d.nn.vision_transformer import Architecture

EMBEDDING_SCALE, EMBEDDING_BASE = 0.1, 100.0
LAST_DIM = 32  # channels before the last convolution
INITIAL_OUTPUT = 0.01  # scale of the untrained output


class ResidualUnit(nn.Module):
    def __init__(self, dim: int):
        super().__init__()
        self.conv1 = nn.Conv2d(dim, dim, 3, 1, 1)
        self.conv2 = nn.Conv2d(dim, dim, 3, 1, 1)

    def forward(self, x: Tensor) -> Tensor:
        return x + self.conv2(F.relu(self.conv1(F.relu(x))))


class Fusion(nn.Module):
    """Adds a finer map, and resizes to the next one."""

    def __init__(self, dim: int, is_first: bool):
        super().__init__()
        self.resConfUnit1 = None if is_first else ResidualUnit(dim)
        self.resConfUnit2 = ResidualUnit(dim)
        self.out_conv = nn.Conv2d(dim, dim, 1)

    def forward(self, x: Tensor, finer: Tensor | None, size: tuple[int, int]) -> Tensor:
        if finer is not None:
            x = x + self.resConfUnit1(finer)
        return self.out_conv(resize(self.resConfUnit2(x), size, "corners"))


class DPTHead(nn.Module):
    """Tokens [I, 4, h w, C] of a backbone -> [I, n_out, H, W].

    Heads of backbones whose views mix also normalise the tokens and read where in the image a pixel lies.
    """

    def __init__(self, config: Architecture, n_out: int):
        super().__init__()
        dim, channels, self.is_placed = config.head_dim, config.head_channels, config.mixes_from is not None
        self.norm = nn.LayerNorm(config.token_dim) if self.is_placed else nn.Identity()
        self.projects = nn.ModuleList(nn.Conv2d(config.token_dim, c, 1) for c in channels)
        larger = (nn.ConvTranspose2d(c, c, n, n) for c, n in zip(channels, (4, 2)))
        self.resize_layers = nn.ModuleList([*larger, nn.Identity(), nn.Conv2d(channels[3], channels[3], 3, 2, 1)])
        last = nn.Conv2d(LAST_DIM, n_out, 1)
        nn.init.normal_(last.weight, std=INITIAL_OUTPUT / LAST_DIM**0.5)
        nn.init.zeros_(last.bias)
        parts = {f"layer{i}_rn": nn.Conv2d(c, dim, 3, 1, 1, bias=False) for i, c in enumerate(channels, 1)}
        parts |= {f"refinenet{i}": Fusion(dim, is_first=i == 4) for i in (1, 2, 3, 4)}
        parts["output_conv1"] = nn.Conv2d(dim, dim // 2, 3, 1, 1)
        parts["output_conv2"] = nn.Sequential(nn.Conv2d(dim // 2, LAST_DIM, 3, 1, 1), nn.ReLU(), last)
        self.scratch = nn.ModuleDict(parts)

    def forward(self, tokens: Tensor, grid: tuple[int, int], size: tuple[int, int]) -> Tensor:
        """grid: (h, w) of the patches; size: (H, W) of the result."""
        maps, levels = [], zip(self.norm(tokens).unbind(1), self.projects, self.resize_layers, strict=True)
        for i, (x, project, layer) in enumerate(levels, 1):
            x = self._placed(project(x.mT.unflatten(-1, grid)), size)
            maps.append(self.scratch[f"layer{i}_rn"](layer(x)))
        sizes = [tuple(finer.shape[2:]) for finer in maps[:3]]
        x = self.scratch["refinenet4"](maps[3], None, sizes[2])
        for i in (3, 2, 1):
            larger = sizes[i - 2] if i > 1 else (2 * sizes[0][0], 2 * sizes[0][1])
            x = self.scratch[f"refinenet{i}"](x, maps[i - 1], larger)
        x = resize(self.scratch["output_conv1"](x), size, "corners")
        return self.scratch["output_conv2"](self._placed(x, size))

    def _placed(self, x: Tensor, size: tuple[int, int]) -> Tensor:
        return x + position_code(x.shape[1:], size, x.dtype, x.device) if self.is_placed else x


@functools.cache
def position_code(shape: torch.Size, size: tuple[int, int], dtype: torch.dtype, device: torch.device) -> Tensor:
    """[C, h, w] for maps of this ``shape`` of images of ``size`` (H, W): sines and cosines of x, then of y."""
    (channels, *lengths), aspect = shape, size[1] / size[0]
    span = (1 / (aspect**2 + 1) ** 0.5, aspect / (aspect**2 + 1) ** 0.5)
    with torch.inference_mode(False):
        y, x = (torch.linspace(-1, 1, n, dtype=torch.float64) * s * (n - 1) / n for n, s in zip(lengths, span))
        n = channels // 4
        frequency = EMBEDDING_BASE ** (-torch.arange(n, dtype=torch.float64) / n)[:, None, None]
        by_x, by_y = x[None, :] * frequency, y[:, None] * frequency
        parts = [part.expand(n, *lengths) for part in (by_x.sin(), by_x.cos(), by_y.sin(), by_y.cos())]
        return (EMBEDDING_SCALE * torch.cat(parts)).to(device, dtype)
