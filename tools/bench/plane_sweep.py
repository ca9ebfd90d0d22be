"""Cost volume of four views against warping features with grid_sample."""

import math

import torch
import torch.nn.functional as F
from harness import Bench

from gsim3d.ops import plane_sweep, sweep_geometry

TOLERANCE = 1e-4  # both compute sample places in float32, in another order


def plain(features, homographies, translations, inverse_depths, src_images, cu_src):
    """The s-th sources of all images at once; every image has the same number."""
    n, channels, height, width = features.shape
    n_sources = len(src_images) // n
    v, u = torch.meshgrid(*(torch.arange(n, device=features.device) for n in (height, width)), indexing="ij")
    pixels = torch.stack([u, v, torch.ones_like(u)]).reshape(3, -1).float()
    scale = torch.tensor([2 / (width - 1), 2 / (height - 1)], device=features.device)
    cost = 0
    for s in range(n_sources):
        A, b = homographies[s::n_sources], translations[s::n_sources]
        q = (A @ pixels)[:, :, None] / inverse_depths[:, None, :, None] + b[:, :, None, None]
        grid = (q[:, :2] / q[:, 2:].clamp(min=1e-3)).permute(0, 2, 3, 1) * scale - 1
        warped = F.grid_sample(features[src_images[s::n_sources]], grid, padding_mode="zeros", align_corners=True)
        warped = warped.reshape(n, channels, -1, height, width)
        cost = cost + torch.einsum("nchw,ncdhw->ndhw", features, warped)
    return cost / (n_sources * math.sqrt(channels))


def scenes_on_rings(n_scenes, channels, depths, size, device):
    """Four views a scene, a quarter turn apart on a ring of 3.5 m, every other view a source of each."""
    n_views = 4
    angle = torch.arange(n_views) * (math.pi / 2)
    eye = torch.stack([3.5 * angle.cos(), 3.5 * angle.sin(), torch.full_like(angle, 1.6)], 1)
    forward = F.normalize(-eye, dim=1)
    right = F.normalize(torch.linalg.cross(forward, torch.tensor([0.0, 0.0, 1.0]).expand_as(forward)), dim=1)
    viewmats = torch.eye(4).repeat(n_views, 1, 1)
    viewmats[:, :3, :3] = torch.stack([right, torch.linalg.cross(forward, right), forward], 1)
    viewmats[:, :3, 3] = -(viewmats[:, :3, :3] @ eye[..., None])[..., 0]
    K = torch.tensor([[1.1 * size, 0, size / 2], [0, 1.1 * size, size / 2], [0, 0, 1.0]])
    n = n_scenes * n_views
    sources = torch.tensor([v // 4 * 4 + (v + s) % 4 for v in range(n) for s in range(1, n_views)])
    cu_src = torch.arange(n + 1) * (n_views - 1)
    A, b = sweep_geometry(K.repeat(n, 1, 1), viewmats.repeat(n_scenes, 1, 1), sources, cu_src)
    features = torch.randn(n, channels, size, size, generator=torch.Generator().manual_seed(9))
    inverse_depths = torch.linspace(1 / 8, 1 / 1.5, depths).repeat(n, 1)
    return [t.to(device) for t in (features, A, b, inverse_depths, sources, cu_src)]


def main():
    bench = Bench("plane_sweep")
    cases = ((1, 64, 64, 32, {}), (1, 128, 64, 32, {}), (1, 32, 24, 16, {}))
    if bench.device.type == "cuda":
        small, large = {"ratio": 45, "limits_ms": (0.016, 0.05)}, {"ratio": 25, "limits_ms": (0.26, 0.8)}
        cases = ((4, 128, 64, 32, small), (4, 128, 64, 64, large))
    for n_scenes, channels, depths, size, goals in cases:
        features, *geometry = scenes_on_rings(n_scenes, channels, depths, size, bench.device)

        def ours(f):
            return plane_sweep(f, *geometry)

        def grid_sample(f):
            return plain(f, *geometry)

        case = f"{n_scenes} scenes x 4 views, {size}x{size}x{channels}, D={depths}"
        bench.passes(case, [features], ours, {"grid_sample": grid_sample}, tolerance=TOLERANCE, **goals)
    bench.finish()


if __name__ == "__main__":
    main()
