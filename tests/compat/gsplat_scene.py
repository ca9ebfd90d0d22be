"""Scenes for the tests of gsplat's call, and what it renders of them by plain torch."""

import torch

from tests.ops.raster_scene import random_scene
from tests.oracle import projection as projection_oracle, raster as raster_oracle

SIZE = {"width": 45, "height": 37}


def scene_of(batch=(), cameras=2, n=40, channels=3, seed=0, dtype=torch.float64):
    """Arguments of one call, opacities below 0.98."""
    g = torch.Generator().manual_seed(seed)
    scene = random_scene(n=n, clouds=1, images=cameras, seed=seed)
    Ks = scene.Ks.clone()
    Ks[:, 0, 1] = 0  # gsplat has no skew
    colors = torch.rand(*batch, n, channels, generator=g, dtype=torch.float64)
    parts = {
        "means": scene.means + 0.1 * torch.randn(*batch, n, 3, generator=g, dtype=torch.float64),
        "quats": scene.quats.expand(*batch, n, 4),
        "scales": scene.scales.expand(*batch, n, 3),
        "opacities": scene.opacities.expand(*batch, n),
        "colors": colors,
        "viewmats": scene.viewmats.expand(*batch, cameras, 4, 4),
        "Ks": Ks.expand(*batch, cameras, 3, 3),
    }
    return {name: x.to(dtype).contiguous() for name, x in parts.items()}


def expected_images(
    arguments, *, backgrounds=None, render_mode="RGB", eps2d=0.3, antialiased=False, lens="pinhole", distortion=None
):
    """[C, H, W, X] and alpha [C, H, W, 1] of one batch by the oracles; colours [N, D] or [C, N, D]."""
    means, opacities, colors = (arguments[name] for name in ("means", "opacities", "colors"))
    shapes = arguments.get("covars")
    if shapes is None:
        shapes = projection_oracle.covariances(arguments["quats"], arguments["scales"])
    images, alphas = [], []
    for i, (viewmat, K) in enumerate(zip(arguments["viewmats"], arguments["Ks"])):
        means2d, conics, depths, compensations, _ = projection_oracle.project(
            means, shapes, viewmat, K, 45, 37, lens=lens,
            distortion=torch.zeros(8) if distortion is None else distortion[i], dilation=eps2d, clamped=True,
        )  # fmt: skip
        opacity = opacities * compensations if antialiased else opacities
        of_view = colors[i] if colors.dim() == 3 else colors
        seen = depths > 0.01
        rows = [x[seen] for x in (means2d, conics, depths, opacity, of_view)]
        background = torch.zeros(1, of_view.shape[1]).double() if backgrounds is None else backgrounds[i : i + 1]
        color, alpha, depth = blend(*rows, background)
        alpha, depth = alpha[..., None], depth[..., None]
        depth = depth / alpha.clamp_min(1e-10) if render_mode.endswith("ED") else depth
        parts = [color] * ("RGB" in render_mode) + [depth] * ("D" in render_mode.removeprefix("RGB"))
        images.append(torch.cat(parts, -1)), alphas.append(alpha)
    return torch.stack(images), torch.stack(alphas)


def expected_batches(arguments, batch, **options):
    """As expected_images, with ``batch`` in front of every argument, the backgrounds among them, and result."""
    flat = {name: x.reshape(-1, *x.shape[len(batch) :]) for name, x in arguments.items()}
    rows = [{name: x[i] for name, x in flat.items()} for i in range(len(flat["means"]))]
    results = [expected_images(row, backgrounds=row.get("backgrounds"), **options) for row in rows]
    return [torch.stack(parts).reshape(*batch, *parts[0].shape) for parts in zip(*results, strict=True)]


def harmonic_colors(means, viewmats, sh, degree):
    """Colours [..., C, N, D] on the CPU of coefficients [N, K, D] or [..., N, K, D]."""
    centre = -(viewmats[..., :3, :3].mT @ viewmats[..., :3, 3:])[..., 0]
    direction = torch.nn.functional.normalize(means[..., None, :, :] - centre[..., None, :], dim=-1)
    basis = raster_oracle.legendre_basis(direction.cpu(), degree)
    return (torch.einsum("...cnk,...nkd->...cnd", basis, sh.cpu()[..., : basis.shape[-1], :]) + 0.5).clamp_min(0)


def blend(means2d, conics, depths, opacities, colors, background):
    y, x = torch.meshgrid(torch.arange(37).double(), torch.arange(45).double(), indexing="ij")
    light, going = torch.ones(37, 45).double(), torch.ones(37, 45, dtype=torch.bool)
    color, depth = torch.zeros(37, 45, colors.shape[1]).double(), torch.zeros(37, 45).double()
    for n in torch.argsort(depths.detach(), stable=True):
        dx, dy = x + 0.5 - means2d[n, 0], y + 0.5 - means2d[n, 1]
        a, b, c = conics[n]
        alpha = (opacities[n] * torch.exp(-(a * dx * dx + 2 * b * dx * dy + c * dy * dy) / 2)).clamp_max(0.99)
        alpha = torch.where(alpha >= 1 / 255, alpha, 0)
        rest = light * (1 - alpha)
        going = going & (rest >= 1e-4)
        weight = torch.where(going, light * alpha, 0)
        color, depth = color + weight[..., None] * colors[n], depth + weight * depths[n]
        light = torch.where(going, rest, light)
    return color + light[..., None] * background, 1 - light, depth
