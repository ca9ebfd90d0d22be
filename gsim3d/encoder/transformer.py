"""Attention inside each view and between the views of a cloud, in shifted windows."""

import math

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from gsim3d.encoder.config import EncoderConfig
from gsim3d.quirks import Quirks

MASKED = -100.0  # added to a score that must not count; finite, so that a row of masked keys stays finite


def sine_position_code(height: int, width: int, channels: int, like: Tensor) -> Tensor:
    """[height * width, channels]: the first half of the channels encodes the row, the second the column."""
    half = channels // 2
    j = torch.arange(half, device=like.device)
    wavelength = 10000.0 ** (2 * (j // 2) / half)

    def encode(n: int) -> Tensor:
        angle = torch.arange(1, n + 1, device=like.device)[:, None] / (n + 1e-6) * (2 * math.pi) / wavelength
        return torch.where(j % 2 == 0, angle.sin(), angle.cos())

    rows = encode(height)[:, None].expand(height, width, half)
    cols = encode(width)[None].expand(height, width, half)
    return torch.cat([rows, cols], -1).reshape(height * width, channels).to(like.dtype)


class Windows:
    """Cuts feature maps [n, V, h, w, C] into K x K windows and back; shifted windows wrap around the border."""

    def __init__(self, height: int, width: int, split: int):
        self.height, self.width, self.split = height, width, split
        self.rows, self.cols = height // split, width // split
        self.shift = (self.rows // 2, self.cols // 2)

    def cut(self, x: Tensor, shifted: bool) -> Tensor:
        """[n, V, h, w, C] -> [n, K * K, V * rows * cols, C]."""
        n, n_views, k = x.shape[0], x.shape[1], self.split
        if shifted:
            x = x.roll((-self.shift[0], -self.shift[1]), (2, 3))
        x = x.reshape(n, n_views, k, self.rows, k, self.cols, -1).permute(0, 2, 4, 1, 3, 5, 6)
        return x.reshape(n, k * k, n_views * self.rows * self.cols, -1)

    def join(self, x: Tensor, shifted: bool) -> Tensor:
        """The way back."""
        n, k = x.shape[0], self.split
        x = x.reshape(n, k, k, -1, self.rows, self.cols, x.shape[-1]).permute(0, 3, 1, 4, 2, 5, 6)
        x = x.reshape(n, -1, self.height, self.width, x.shape[-1])
        return x.roll(self.shift, (2, 3)) if shifted else x

    def shift_mask(self, like: Tensor) -> Tensor:
        """[K * K, L, L] with L = rows * cols: MASKED between pixels that only wrapping around made neighbours."""

        def bands(n: int, size: int, shift: int) -> Tensor:
            i = torch.arange(n, device=like.device)
            return (i >= n - size).long() + (i >= n - shift).long()

        row_band = bands(self.height, self.rows, self.shift[0])
        col_band = bands(self.width, self.cols, self.shift[1])
        labels = self.cut((3 * row_band[:, None] + col_band)[None, None, ..., None], False)[0, ..., 0]
        return (labels[:, :, None] != labels[:, None, :]).to(like.dtype) * MASKED

    def cross_mask(self, like: Tensor, n_views: int, shifted: bool, quirks: Quirks) -> Tensor:
        """[1 or K * K, V * L, V * L]: each view sees the others."""
        tokens = self.rows * self.cols
        others = ~torch.eye(n_views, dtype=torch.bool, device=like.device)
        if not shifted:
            return _between_views(like.new_zeros(1, n_views, tokens, n_views, tokens), others)
        mask = self.shift_mask(like)
        spread = mask[:, None, :, None].expand(-1, n_views, -1, n_views, -1)
        if quirks.tiled_shift_mask:
            view = torch.arange(n_views, device=like.device)
            rank = view[None] - (view[None] > view[:, None]).long()  # of a key view among the others of a query view
            position = torch.arange(tokens, device=like.device)
            column = (position * (n_views - 1) + rank[..., None]) % tokens  # [V, V, L]
            spread = mask[:, :, column].permute(0, 2, 1, 3, 4)
        return _between_views(spread, others)


def _between_views(mask: Tensor, visible: Tensor) -> Tensor:
    mask = mask.masked_fill(~visible[None, :, None, :, None], -math.inf)
    return mask.reshape(mask.shape[0], mask.shape[1] * mask.shape[2], -1)


class Attention(nn.Module):
    """One head of attention whose normalised message joins the residual stream, through an MLP where one is given."""

    def __init__(self, dim: int, mlp_dim: int = 0):
        super().__init__()
        self.q_proj = nn.Linear(dim, dim, bias=False)
        self.k_proj = nn.Linear(dim, dim, bias=False)
        self.v_proj = nn.Linear(dim, dim, bias=False)
        self.merge = nn.Linear(dim, dim, bias=False)
        self.norm1 = nn.LayerNorm(dim)
        if mlp_dim:
            self.mlp = nn.Sequential(
                nn.Linear(2 * dim, mlp_dim, bias=False), nn.GELU(), nn.Linear(mlp_dim, dim, bias=False)
            )
            self.norm2 = nn.LayerNorm(dim)
        else:
            self.mlp = None

    def forward(self, x: Tensor, source: Tensor, attend) -> Tensor:
        """x asks, source answers; attend(q, k, v) knows who sees whom."""
        message = self.norm1(self.merge(attend(self.q_proj(x), self.k_proj(source), self.v_proj(source))))
        if self.mlp is not None:
            message = self.norm2(self.mlp(torch.cat([x, message], -1)))
        return x + message


class Layer(nn.Module):
    def __init__(self, dim: int, mlp_dim: int):
        super().__init__()
        self.self_attn = Attention(dim)
        self.cross_attn_ffn = Attention(dim, mlp_dim)


class MultiViewTransformer(nn.Module):
    """[n, V, C, h, w] features of n clouds with V views each -> the same shape, informed by all views."""

    def __init__(self, config: EncoderConfig):
        super().__init__()
        dim, self.split, self.quirks = config.feature_dim, config.window_split, config.quirks
        mlp_dim = 2 * dim * config.transformer_mlp_ratio
        self.layers = nn.ModuleList(Layer(dim, mlp_dim) for _ in range(config.transformer_layers))
        for parameter in self.parameters():
            if parameter.dim() > 1:
                nn.init.xavier_uniform_(parameter)

    def forward(self, x: Tensor) -> Tensor:
        n, n_views, dim, height, width = x.shape
        windows = Windows(height, width, self.split)
        code = sine_position_code(windows.rows, windows.cols, dim, x).reshape(windows.rows, windows.cols, dim)
        x = x.permute(0, 1, 3, 4, 2) + code.repeat(self.split, self.split, 1)
        for i, layer in enumerate(self.layers):
            shifted = i % 2 == 1 and self.split > 1
            within = windows.shift_mask(x)[:, None] if shifted else None

            def attend_self(q: Tensor, k: Tensor, v: Tensor) -> Tensor:
                q, k, v = (windows.cut(t, shifted).unflatten(2, (n_views, -1)) for t in (q, k, v))
                return windows.join(F.scaled_dot_product_attention(q, k, v, within).flatten(2, 3), shifted)

            def attend_others(q: Tensor, k: Tensor, v: Tensor) -> Tensor:
                if n_views == 1:
                    return torch.zeros_like(v)
                mask = windows.cross_mask(x, n_views, shifted, self.quirks)
                q, k, v = (windows.cut(t, shifted) for t in (q, k, v))
                return windows.join(F.scaled_dot_product_attention(q, k, v, mask), shifted)

            # Other views are read as they entered the layer, before they looked at themselves.
            x = layer.cross_attn_ffn(layer.self_attn(x, x, attend_self), x, attend_others)
        return x.permute(0, 1, 4, 2, 3)
