"""Attention inside each view and between the views of a cloud, in shifted windows."""

import math
from functools import partial

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from gsim3d import ops
from gsim3d.nn.layers import Linear, RowLayerNorm, widened
from gsim3d.nn.multiview_encoder.config import EncoderConfig
from gsim3d.ops.curve import PatchTable

MAX_HEAD_DIM = 256  # of :func:`gsim3d.ops.patch_attention`
MASKED = -100.0  # added to the score of a masked pair; finite, so that a softmax over masked keys alone is finite


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
        """[n, V, h, w, C] -> [n * V, K * K, rows * cols, C]."""
        k = self.split
        if shifted:
            x = x.roll((-self.shift[0], -self.shift[1]), (2, 3))
        x = x.reshape(-1, k, self.rows, k, self.cols, x.shape[-1]).transpose(2, 3)
        return x.reshape(-1, k * k, self.rows * self.cols, x.shape[-1])

    def join(self, x: Tensor, n_views: int, shifted: bool) -> Tensor:
        """The inverse of :meth:`cut`."""
        k = self.split
        x = x.reshape(-1, k, k, self.rows, self.cols, x.shape[-1]).transpose(2, 3)
        x = x.reshape(-1, n_views, self.height, self.width, x.shape[-1])
        return x.roll(self.shift, (2, 3)) if shifted else x

    def labels(self, device: torch.device) -> Tensor:
        """[K * K, L] with L = rows * cols, from 0 to 8: equal of true neighbours in shifted windows."""

        def bands(n: int, size: int, shift: int) -> Tensor:
            i = torch.arange(n, device=device)
            return (i >= n - size).long() + (i >= n - shift).long()

        row_band = bands(self.height, self.rows, self.shift[0])
        col_band = bands(self.width, self.cols, self.shift[1])
        return self.cut((3 * row_band[:, None] + col_band)[None, None, ..., None], False)[0, ..., 0]

    def patches(self, shape: tuple[int, ...], shifted: bool, others: bool) -> PatchTable:
        """Of the rows of maps of ``shape``, n and V: the pixels of a window that are true neighbours attend to each
        other, or to such ``others`` of the other views. On the CPU."""
        shape = (*shape, self.height, self.width, 1)
        own = self.cut(torch.arange(math.prod(shape)).view(shape), shifted)
        keys = own if not others else own[:, :, :0] if shape[1] == 1 else other_views(own, shape[1])
        labels = self.labels(own.device) if shifted else torch.zeros(own.shape[1:3], dtype=torch.int64)
        n, times = len(own), keys.shape[2] // own.shape[2]
        order, key_order = (x.argsort(dim=1, stable=True)[None, :, :, None] for x in (labels, labels.repeat(1, times)))
        rows = (x.gather(2, by.expand(n, -1, -1, -1)).flatten() for x, by in ((own, order), (keys, key_order)))
        counts = (labels[:, :, None] == torch.arange(9)).sum(1)
        cu_q = F.pad(counts.repeat(n, 1).flatten().cumsum(0), (1, 0))
        return PatchTable(*rows, cu_q, cu_q * times)

    def shift_mask(self, like: Tensor) -> Tensor:
        """[K * K, L, L]: MASKED between pixels that are neighbours only by wrapping around."""
        labels = self.labels(like.device)
        return (labels[:, :, None] != labels[:, None, :]).to(like.dtype) * MASKED


def other_views(x: Tensor, n_views: int) -> Tensor:
    """[n * V, K * K, L, C] -> [n * V, K * K, (V - 1) * L, C]: the same window of the others, from the next view on."""
    clouds = x.unflatten(0, (-1, n_views))
    return torch.cat([clouds.roll(-offset, 1) for offset in range(1, n_views)], 3).flatten(0, 1)


class Attention(nn.Module):
    """One head of attention whose normalised message joins the residual stream, through an MLP where one is given."""

    def __init__(self, dim: int, mlp_dim: int = 0):
        super().__init__()
        self.q_proj = Linear(dim, dim, bias=False)
        self.k_proj = Linear(dim, dim, bias=False)
        self.v_proj = Linear(dim, dim, bias=False)
        self.merge = Linear(dim, dim, bias=False)
        self.norm1 = RowLayerNorm(dim)
        if mlp_dim:
            layers = Linear(2 * dim, mlp_dim, bias=False), nn.GELU(), Linear(mlp_dim, dim, bias=False)
            self.mlp = nn.Sequential(*layers)
            self.norm2 = RowLayerNorm(dim)
        else:
            self.mlp = None

    def forward(self, x: Tensor, source: Tensor, attend) -> Tensor:
        """Queries come from ``x``, keys and values from ``source``; ``attend`` is a function of the three."""
        message = self.merge(attend(self.q_proj(x), self.k_proj(source), self.v_proj(source))).flatten(0, -2)
        rows = x.flatten(0, -2)
        if self.mlp is None:
            return self.norm1(message, rows).view(x.shape)
        message = self.norm1(message)
        message = self.mlp(torch.cat([rows.to(message.dtype), message], -1))
        return self.norm2(message, rows).view(x.shape)


class Layer(nn.Module):
    """Attention within a view, then to the other views."""

    def __init__(self, dim: int, mlp_dim: int):
        super().__init__()
        self.self_attn = Attention(dim)
        self.cross_attn_ffn = Attention(dim, mlp_dim)


class MultiViewTransformer(nn.Module):
    """Self-attention and attention between views: features [n, V, C, h, w] of n clouds -> the same shape."""

    masks_by_label = True  # :meth:`cross_mask` follows from :meth:`Windows.labels`

    def __init__(self, config: EncoderConfig):
        super().__init__()
        dim, self.split = config.feature_dim, config.window_split
        mlp_dim = 2 * dim * config.transformer_mlp_ratio
        self.layers = nn.ModuleList(Layer(dim, mlp_dim) for _ in range(config.transformer_layers))
        for parameter in self.parameters():
            if parameter.dim() > 1:
                nn.init.xavier_uniform_(parameter)

    def cross_mask(self, mask: Tensor, n_views: int) -> Tensor:
        """[1 or V, K * K, L, (V - 1) * L]: :meth:`Windows.shift_mask` between the pixels of a view and those of the
        others, in the order of :func:`other_views`."""
        return mask.repeat(1, 1, n_views - 1)[None]

    def _over_patches(self, x: Tensor, windows: Windows) -> Tensor:
        """The layers on the CPU: windows are read in place, and wrapped ones need no mask."""
        kinds = [(shifted, others) for shifted in (False, True) for others in (False, True)]
        tables = {kind: windows.patches(x.shape[:2], *kind) for kind in kinds}

        def attend(table: PatchTable, *qkv: Tensor) -> Tensor:
            rows = (t.reshape(-1, 1, x.shape[-1]) for t in qkv)
            return ops.patch_attention(*rows, table, check=False).view(x.shape)

        for i, layer in enumerate(self.layers):
            within, between = (
                partial(attend, tables[i % 2 == 1 and self.split > 1, others]) for others in (False, True)
            )
            x = layer.cross_attn_ffn(layer.self_attn(x, x, within), x, between)
        return x

    def forward(self, x: Tensor) -> Tensor:
        n, n_views, dim, height, width = x.shape
        windows = Windows(height, width, self.split)
        code = sine_position_code(windows.rows, windows.cols, dim, x).reshape(windows.rows, windows.cols, dim)
        x = widened(x.permute(0, 1, 3, 4, 2) + code.repeat(self.split, self.split, 1))
        if self.masks_by_label and x.is_cpu and dim <= MAX_HEAD_DIM and not torch.compiler.is_compiling():
            return self._over_patches(x, windows).permute(0, 1, 4, 2, 3)
        for i, layer in enumerate(self.layers):
            shifted = i % 2 == 1 and self.split > 1
            mask = windows.shift_mask(x) if shifted else None
            within = None if mask is None else mask[None]
            between = None if mask is None or n_views == 1 else self.cross_mask(mask, n_views)
            if between is not None and between.shape[0] > 1:
                between = between.repeat(n, 1, 1, 1)

            def attend_self(q: Tensor, k: Tensor, v: Tensor) -> Tensor:
                q, k, v = (windows.cut(t, shifted) for t in (q, k, v))
                return windows.join(F.scaled_dot_product_attention(q, k, v, within), n_views, shifted)

            def attend_others(q: Tensor, k: Tensor, v: Tensor) -> Tensor:
                if n_views == 1:
                    return torch.zeros_like(v)
                q, k, v = (windows.cut(t, shifted) for t in (q, k, v))
                k, v = (other_views(t, n_views) for t in (k, v))
                return windows.join(F.scaled_dot_product_attention(q, k, v, between), n_views, shifted)

            # Other views are read as they entered the layer, before their self-attention.
            x = layer.cross_attn_ffn(layer.self_attn(x, x, attend_self), x, attend_others)
        return x.permute(0, 1, 4, 2, 3)
