"""Cost volume of four views against warping features with grid_sample."""

import math

import torch
import torch.nn.functional as F
from harness import Bench, with_gradients

from gsim3d.ops import plane_sweep, sweep_geometry

TOLERANCE = 1e-4  # both compute sample places in float32, in another order


def plain(features, homographies, translations, inverse_depths, src_images, cu_src):
    """The s-th sources of all images at once; every image has the same number."""
    n, channels, height, width = features.shape
    n_sources = len(src_images) // n
    v, u = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    pixels = torch.stack([u, v, torch.ones_like(u)]).reshape(3, -1).float()
    scale = torch.tensor([2 / (width - 1), 2 / (height - 1)])
    cost = 0
    for s in range(n_sources):
        A, b = homographies[s::n_sources], translations[s::n_sources]
        q = (A @ pixels)[:, :, None] / inverse_depths[:, None, :, None] + b[:, :, None, None]
        grid = (q[:, :2] / q[:, 2:].clamp(min=1e-3)).permute(0, 2, 3, 1) * scale - 1
        warped = F.grid_sample(features[src_images[s::n_sources]], grid, padding_mode="zeros", align_corners=True)
        warped = warped.reshape(n, channels, -1, height, width)
        cost = cost + torch.einsum("nchw,ncdhw->ndhw", features, warped)
    return cost / (n_sources * math.sqrt(channels))


def arguments(n_views, channels, depths, size):
    generator = torch.Generator().manual_seed(0)
    K = torch.tensor([[1.1 * size, 0, size / 2], [0, 1.1 * size, size / 2], [0, 0, 1]]).double()
    viewmats = torch.eye(4, dtype=torch.float64).repeat(n_views, 1, 1)
    for i in range(n_views):
        angle = 0.6 * math.pi / 2 * i
        viewmats[i, 0, 0] = viewmats[i, 2, 2] = math.cos(angle)
        viewmats[i, 0, 2], viewmats[i, 2, 0] = math.sin(angle), -math.sin(angle)
        viewmats[i, 2, 3] = 3.0
    sources = torch.tensor([(i + s) % n_views for i in range(n_views) for s in range(1, n_views)])
    cu_src = torch.arange(n_views + 1) * (n_views - 1)
    A, b = sweep_geometry(K.repeat(n_views, 1, 1), viewmats, sources, cu_src)
    features = torch.randn(n_views, channels, size, size, generator=generator)
    inverse_depths = torch.linspace(1 / 6, 1 / 1.5, depths).repeat(n_views, 1)
    return features, A.float(), b.float(), inverse_depths, sources, cu_src


if __name__ == "__main__":
    bench = Bench("plane_sweep")
    for n_views, channels, depths, size in ((4, 64, 64, 32), (4, 128, 64, 32), (4, 32, 24, 16)):
        features, *geometry = arguments(n_views, channels, depths, size)

        def ours(f):
            return plane_sweep(f, *geometry)

        def torch_form(f):
            return plain(f, *geometry)

        case = f"{n_views} views {size}x{size}x{channels}, D={depths}"
        bench.compare(case, lambda: ours(features), lambda: torch_form(features), tolerance=TOLERANCE)
        bench.compare(f"{case}, fwd+bwd", *with_gradients([features], ours, torch_form), tolerance=TOLERANCE)
    bench.finish()
