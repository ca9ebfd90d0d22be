"""U-Nets whose coarsest features attend to all views of a cloud."""

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from gsim3d.nn.multiview_encoder.layout import GroupNorm, for_convolution

HEAD_DIM = 32  # channels of one attention head, as far as there are that many


def norm(channels: int) -> GroupNorm:
    return GroupNorm(8 if channels % 8 == 0 else 4, channels)


def zero_norm(channels: int) -> GroupNorm:
    """A norm that silences its branch until training opens it."""
    layer = norm(channels)
    nn.init.zeros_(layer.weight)
    return layer


def repeat_pixels(x: Tensor, factor: int) -> Tensor:
    """[N, C, h, w] -> [N, C, factor h, factor w]: every pixel becomes a square; its gradient is a plain sum."""
    n, c, h, w = x.shape
    x = x.permute(0, 2, 3, 1)[:, :, None, :, None].expand(n, h, factor, w, factor, c)
    return x.reshape(n, h * factor, w * factor, c).permute(0, 3, 1, 2)


class ResBlock(nn.Module):
    def __init__(self, in_dim: int, out_dim: int):
        super().__init__()
        self.in_layers = nn.Sequential(nn.Conv2d(in_dim, out_dim, 3, 1, 1), norm(out_dim), nn.SiLU())
        self.out_layers = nn.Sequential(nn.Conv2d(out_dim, out_dim, 3, 1, 1), zero_norm(out_dim), nn.SiLU())
        self.skip_connection = nn.Conv2d(in_dim, out_dim, 1) if in_dim != out_dim else nn.Identity()

    def forward(self, x: Tensor, n_views: int) -> Tensor:
        return self.skip_connection(x) + self.out_layers(for_convolution(self.in_layers(x)))


class ViewAttention(nn.Module):
    """Every pixel attends to all pixels of all views of its cloud."""

    def __init__(self, dim: int):
        super().__init__()
        self.n_heads = max(1, dim // HEAD_DIM)
        self.qkv = nn.Conv1d(dim, 3 * dim, 1)
        self.proj_out = nn.Conv1d(dim, dim, 1)
        self.norm = zero_norm(dim)

    def forward(self, x: Tensor, n_views: int) -> Tensor:
        n_images, dim, height, width = x.shape
        qkv = self.qkv(x.flatten(2)).reshape(n_images // n_views, n_views, self.n_heads, 3, dim // self.n_heads, -1)
        q, k, v = qkv.permute(3, 0, 2, 1, 5, 4).flatten(3, 4)  # each [n, heads, V * pixels, head dim]
        out = F.scaled_dot_product_attention(q, k, v).unflatten(2, (n_views, height * width))
        out = out.permute(0, 2, 1, 4, 3).reshape(n_images, dim, height * width)
        return x + self.norm(self.proj_out(out)).reshape(x.shape)


class Downsample(nn.Module):
    def __init__(self, dim: int):
        super().__init__()
        self.op = nn.Conv2d(dim, dim, 3, 2, 1)

    def forward(self, x: Tensor, n_views: int) -> Tensor:
        return self.op(x)


class Upsample(nn.Module):
    def __init__(self, dim: int):
        super().__init__()
        self.conv = nn.Conv2d(dim, dim, 3, 1, 1)

    def forward(self, x: Tensor, n_views: int) -> Tensor:
        return self.conv(repeat_pixels(x, 2))


class Stem(nn.Conv2d):
    def forward(self, x: Tensor, n_views: int) -> Tensor:
        return super().forward(x)


class UNet(nn.Module):
    """[n * V, C, h, w] -> the same shape, the views of one cloud one after another.

    Args:
        dim: C.
        levels: resolutions.
        attention: downsampling factors at which the views of a cloud attend to each other.
    """

    def __init__(self, dim: int, levels: int, attention: tuple[int, ...]):
        super().__init__()

        def block(level: int, in_dim: int) -> list[nn.Module]:
            return [ResBlock(in_dim, dim)] + ([ViewAttention(dim)] if 2**level in attention else [])

        self.input_blocks = nn.ModuleList([nn.ModuleList([Stem(dim, dim, 3, 1, 1)])])
        for level in range(levels):
            self.input_blocks.append(nn.ModuleList(block(level, dim)))
            if level < levels - 1:
                self.input_blocks.append(nn.ModuleList([Downsample(dim)]))
        self.middle_block = nn.ModuleList([ResBlock(dim, dim), nn.Identity(), ResBlock(dim, dim)])
        self.output_blocks = nn.ModuleList()
        for level in reversed(range(levels)):
            self.output_blocks.append(nn.ModuleList(block(level, 2 * dim)))
            last = block(level, 2 * dim) + ([Upsample(dim)] if level > 0 else [])
            self.output_blocks.append(nn.ModuleList(last))
        self.out = nn.Sequential(nn.Conv2d(dim, dim, 3, 1, 1), norm(dim), nn.SiLU())

    def forward(self, x: Tensor, n_views: int) -> Tensor:
        x, skips = for_convolution(x), []
        for entry in self.input_blocks:
            for module in entry:
                x = module(x, n_views)
            skips.append(x)
        x = self.middle_block[2](self.middle_block[0](x, n_views), n_views)
        for entry in self.output_blocks:
            x = torch.cat([x, skips.pop()], 1)
            for module in entry:
                x = module(x, n_views)
        return self.out(x)
