"""Projection of Gaussians against plain torch, and projection, colours and blending one after the other against the
fused rasterizer: 64k Gaussians of a pixel each, 2 images of 256 x 256 px."""

import torch
from harness import Bench

from gsim3d.cameras import Cameras
from gsim3d.math.rotations import rotation_matrices
from gsim3d.ops import project_gaussians, rasterize_gaussians, rasterize_projected, sh_to_color

N, IMAGES, SIZE = 65536, 2, 256
FOCAL = 1.2 * SIZE


def scene(device: torch.device):
    g = torch.Generator().manual_seed(0)
    means = torch.randn(N, 3, generator=g) + torch.tensor([0.0, 0.0, 5.0])
    quats, scales = torch.randn(N, 4, generator=g), 0.02 * torch.rand(N, 3, generator=g)
    rows = [means, quats, scales, torch.rand(N, generator=g), 0.3 * torch.randn(N, 9, 3, generator=g)]
    viewmats = torch.eye(4).repeat(IMAGES, 1, 1)
    viewmats[:, 0, 3] = torch.linspace(-0.2, 0.2, IMAGES)
    K = torch.tensor([[FOCAL, 0, SIZE / 2], [0, FOCAL, SIZE / 2], [0, 0, 1]]).repeat(IMAGES, 1, 1)
    first = torch.zeros(IMAGES, dtype=torch.int64)
    cameras = Cameras(viewmats, K, torch.ones(IMAGES), torch.ones(IMAGES), first, SIZE, SIZE)
    return [row.to(device) for row in rows], cameras.to(device)


def plain_projection(means, quats, scales, cameras):
    """means2d [I, N, 2], conics [I, N, 3] and depths [I, N] of pinholes."""
    points = means @ cameras.viewmats[:, :3, :3].mT + cameras.viewmats[:, None, :3, 3]
    z = points[..., 2]
    R = rotation_matrices(torch.nn.functional.normalize(quats, dim=1))
    ratio = points[..., :2] / z[..., None]
    W = cameras.viewmats[:, None, :3, :3]
    H = (FOCAL / z)[..., None, None] * (W[:, :, :2] - ratio[..., None] * W[:, :, 2:]) @ (R * scales[:, None])
    xx, yy = (H**2).sum(-1).add(0.3).unbind(-1)
    xy = (H[..., 0, :] * H[..., 1, :]).sum(-1)
    conics = torch.stack([yy, -xy, xx], -1) / (xx * yy - xy * xy)[..., None]
    return FOCAL * ratio + SIZE / 2, conics, z


def main():
    bench = Bench("projection")
    (means, quats, scales, opacities, sh), cameras = scene(bench.device)
    seen = (project_gaussians(means, quats, scales, cameras).radii > 0).all(1)[:, None].float()

    def ours(means, quats, scales):
        pairs = project_gaussians(means, quats, scales, cameras)
        return torch.cat([pairs.means2d, pairs.conics, pairs.depths[:, None]], 1) * seen

    def plain(means, quats, scales):
        means2d, conics, depths = plain_projection(means, quats, scales, cameras)
        return torch.cat([means2d, conics, depths[..., None]], -1).reshape(-1, 6) * seen

    bench.passes("64k Gaussians, 2 images", [means, quats, scales], ours, {"torch": plain}, tolerance=1e-3)

    def in_parts(means, quats, scales, opacities, sh):
        pairs = project_gaussians(means, quats, scales, cameras, opacities=opacities)
        centres = -(cameras.viewmats[:, :3, :3].mT @ cameras.viewmats[:, :3, 3:])[..., 0]
        colors = sh_to_color(means - centres[:, None], sh).flatten(0, 1)
        image = rasterize_projected(
            *pairs[:3], opacities.repeat(IMAGES), colors, width=SIZE, height=SIZE, cu_pairs=pairs.cu_pairs
        )
        return torch.cat([image.color, image.depth[..., None]], -1)

    def fused(means, quats, scales, opacities, sh):
        image = rasterize_gaussians(means, quats, scales, opacities, cameras, sh=sh)
        return torch.cat([image.color, image.depth[..., None]], -1)

    rows = [means, quats, scales, opacities, sh]
    bench.passes("in parts", rows, in_parts, {"rasterize_gaussians": fused}, tolerance=1e-3)
    bench.finish()


if __name__ == "__main__":
    main()
