"""Plane sweep in plain torch: warps features with grid_sample. Knows nothing of the op."""

import torch
import torch.nn.functional as F


def plane_sweep(features, homographies, translations, inverse_depths, src_images, cu_src):
    """Arguments and result as the op of the same name; differentiable by autograd, any float dtype."""
    n_images, channels, height, width = features.shape
    n_depths = inverse_depths.shape[1]
    v, u = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    pixels = torch.stack([u, v, torch.ones_like(u)]).reshape(3, -1).to(features.dtype)
    costs = []
    for i in range(n_images):
        cost = features.new_zeros(n_depths, height, width)
        pairs = range(int(cu_src[i]), int(cu_src[i + 1]))
        for p in pairs:
            places = (homographies[p] @ pixels)[:, None] / inverse_depths[i][None, :, None]
            places = places + translations[p][:, None, None]
            xy = places[:2] / places[2].clamp(min=1e-3)
            # grid_sample with align_corners=False: index x lies at (2 x + 1) / width - 1.
            grid = torch.stack([(2 * xy[0] + 1) / width - 1, (2 * xy[1] + 1) / height - 1], -1)
            warped = F.grid_sample(features[src_images[p]][None], grid[None], padding_mode="zeros", align_corners=False)
            correlation = (warped[0].reshape(channels, n_depths, height, width) * features[i][:, None]).sum(0)
            cost = cost + correlation / channels**0.5
        costs.append(cost / max(1, len(pairs)))
    return torch.stack(costs) if costs else features.new_zeros(0, n_depths, height, width)
