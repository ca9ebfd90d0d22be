"""The vision transformer with alternating attention, token by token and head by head, in float64."""

import math

import torch
import torch.nn.functional as F


def tokens_of(weights, images, n_views, cameras, config):
    """[I, 4, P, C or 2 C] of ViT with ``weights``; arguments as its own."""
    w = {name: value.double() for name, value in weights.items()}
    p, (n_images, _, height, width) = config.patch, images.shape
    h, width = height // p, width // p
    x = []
    for image in images:
        rows = [w["cls_token"][0, 0]]
        for r in range(h):
            for c in range(width):
                patch = image[:, r * p : (r + 1) * p, c * p : (c + 1) * p]
                kernel = w["patch_embed.proj.weight"]
                rows.append((kernel * patch).sum((1, 2, 3)) + w["patch_embed.proj.bias"])
        x.append(torch.stack(rows))
    x = torch.stack(x) + _positions(w["pos_embed"], h, width, config)
    mixes = config.mixes_from is not None
    taken, local = [], x
    for i in range(config.blocks):
        if mixes and i == config.mixes_from:
            x = x.clone()
            x[:, 0] = cameras
        turns = mixes and i >= config.mixes_from
        over_views = turns and i % 2 == 1
        places = [(0, 0)] + [((1, 1) if over_views else (r + 1, c + 1)) for r in range(h) for c in range(width)]
        groups = range(0, n_images, n_views) if over_views else range(n_images)
        out = []
        for first in groups:
            views = x[first : first + (n_views if over_views else 1)]
            rows = views.flatten(0, 1)
            at = places * len(views) if turns else None
            out.append(_block(rows, at, f"blocks.{i}.", w, config).view_as(views))
        x = torch.cat(out)
        local = local if over_views else x
        if i in config.taken:
            normed = F.layer_norm(x, x.shape[-1:], w["norm.weight"], w["norm.bias"], config.eps)
            taken.append((torch.cat([local, normed], -1) if mixes else normed)[:, 1:])
    return torch.stack(taken, 1)


def _positions(embedding, h, width, config):
    maps = embedding[:, 1:].mT.reshape(1, -1, config.grid, config.grid)
    patches = F.interpolate(maps, (h, width), mode="bicubic") if (h, width) != (config.grid,) * 2 else maps
    return torch.cat([embedding[:, :1], patches.flatten(2).mT], 1)


def _block(x, places, name, w, config):
    def layer(x, part):
        return x @ w[f"{name}{part}.weight"].T + w[f"{name}{part}.bias"]

    def norm(x, part, eps=1e-6):
        return F.layer_norm(x, x.shape[-1:], w[f"{name}{part}.weight"], w[f"{name}{part}.bias"], eps)

    d, heads = config.dim // config.heads, []
    qkv = layer(norm(x, "norm1"), "attn.qkv")
    for head in range(config.heads):
        q, k, v = (qkv[:, part * config.dim + head * d :][:, :d] for part in range(3))
        if places is not None:
            q, k = norm(q, "attn.q_norm", 1e-5), norm(k, "attn.k_norm", 1e-5)
            q, k = (torch.stack([_turned(t, place) for t, place in zip(rows, places)]) for rows in (q, k))
        heads.append((q @ k.T / math.sqrt(d)).softmax(-1) @ v)
    x = x + w[f"{name}ls1.gamma"] * layer(torch.cat(heads, -1), "attn.proj")
    hidden = F.gelu(layer(norm(x, "norm2"), "mlp.fc1"))
    return x + w[f"{name}ls2.gamma"] * layer(hidden, "mlp.fc2")


def _turned(x, place):
    """Pairs (j, j + q) of each half of the channels turn by position / 100^(j / q)."""
    half, parts = len(x) // 2, []
    for value, axis in zip(place, (x[:half], x[half:])):
        q = half // 2
        angle = torch.tensor([value / 100 ** (j / q) for j in range(q)], dtype=x.dtype)
        a, b = axis[:q], axis[q:]
        parts += [a * angle.cos() - b * angle.sin(), b * angle.cos() + a * angle.sin()]
    return torch.cat(parts)
