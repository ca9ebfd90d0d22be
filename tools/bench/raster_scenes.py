"""Scenes of the rasterizer's GPU benchmark: seeded, and drawn in the order of the recorded peers' scenes."""

import math

import torch
import torch.nn.functional as F

from gsim3d.cameras import Cameras

RING, CONTEXT, FOCAL = 12, 4, 1.1  # cameras of the ring, of them those that give Gaussians, focal length / width


def ring_of_cameras(phase: float, device, radius=3.5, height=1.6) -> torch.Tensor:
    """World-to-camera [RING, 4, 4] of cameras around the z axis that look at the origin."""
    angle = torch.arange(RING, device=device) * (2 * math.pi / RING) + phase
    eye = torch.stack([radius * angle.cos(), radius * angle.sin(), torch.full_like(angle, height)], -1)
    forward = F.normalize(-eye, dim=-1)
    right = F.normalize(torch.cross(forward, forward.new_tensor([0.0, 0.0, 1.0]).expand_as(forward), dim=-1), dim=-1)
    pose = torch.eye(4, device=device).repeat(RING, 1, 1)
    pose[:, :3, :3] = torch.stack([right, torch.cross(forward, right, dim=-1), forward], dim=1)
    pose[:, :3, 3] = -(pose[:, :3, :3] @ eye[..., None])[..., 0]
    return pose


def pixel_aligned_scene(clouds: int, size: int, views: int, seed: int, device, context: int = CONTEXT) -> dict:
    """What a feed-forward model gives: every pixel of ``context`` cameras, unprojected onto a ball on a ground disc
    before a wall; each Gaussian about a pixel wide. ``views`` cameras of the same ring look at it."""
    g = torch.Generator(device=device).manual_seed(seed)
    parts = {name: [] for name in ("means", "scales", "quats", "opacities", "viewmats")}
    centres = (torch.arange(size, device=device) + 0.5) / size
    row, column = torch.meshgrid(centres, centres, indexing="ij")
    rays = torch.stack([(column - 0.5) / FOCAL, (row - 0.5) / FOCAL, torch.ones_like(row)], -1).reshape(-1, 3)
    never = torch.full((context, size * size), 1e9, device=device)
    for cloud in range(clouds):
        cameras = ring_of_cameras(0.1 * cloud, device)
        chosen = torch.randperm(RING, generator=g, device=device)
        to_world = torch.inverse(cameras[chosen[:context]])
        direction = rays @ to_world[:, :3, :3].transpose(1, 2)
        origin = to_world[:, None, :3, 3].expand_as(direction)
        ball = direction.new_tensor([0.3 * math.cos(cloud), 0.3 * math.sin(cloud), 0.1])
        offset = origin - ball
        a, b = (direction * direction).sum(-1), (offset * direction).sum(-1)
        inside = b * b - a * ((offset * offset).sum(-1) - 0.75 * 0.75)
        to_ball = torch.where(inside > 0, (-b - inside.clamp_min(0).sqrt()) / a, never)
        to_ground = torch.where(direction[..., 2] < -1e-3, (-0.65 - origin[..., 2]) / direction[..., 2], never)
        on_disc = (origin + to_ground[..., None] * direction)[..., :2].norm(dim=-1) < 2.5
        depth = torch.minimum(to_ball, torch.where(on_disc, to_ground, never))
        depth = torch.where(depth < 1e8, depth, 6.5 + 1.0 * torch.rand(depth.shape, generator=g, device=device))
        depth = depth * (1 + 0.01 * torch.randn(depth.shape, generator=g, device=device))
        means = (origin + depth[..., None] * direction).reshape(-1, 3)
        pixel = (depth / (FOCAL * size)).reshape(-1, 1)
        scales = pixel * torch.exp(0.5 * torch.randn(means.shape, generator=g, device=device)) * 0.7
        parts["means"].append(means)
        parts["scales"].append(scales.clamp(2e-4, 0.1))
        parts["quats"].append(F.normalize(torch.randn(len(means), 4, generator=g, device=device), dim=-1))
        parts["opacities"].append(torch.sigmoid(1.5 * torch.randn(len(means), generator=g, device=device) + 0.5))
        parts["viewmats"].append(cameras[chosen[:views]])
    f = FOCAL * size
    K = torch.tensor([[f, 0, size / 2], [0, f, size / 2], [0, 0, 1.0]], device=device)
    return {name: torch.stack(values) for name, values in parts.items()} | {"K": K, "width": size, "height": size}


def layered_scene(n: int, seed: int, device) -> dict:
    """One cloud on 64 noisy surfaces before one camera of 1920 x 1080 px; sizes in pixels are lognormal up to 40."""
    g = torch.Generator(device=device).manual_seed(seed)
    width, height, focal, surfaces = 1920, 1080, 1100.0, 64

    def uniform(*size):
        return torch.rand(*size, generator=g, device=device)

    def normal(*size):
        return torch.randn(*size, generator=g, device=device)

    z = 2.0 + 18.0 * uniform(n) ** 2
    z = z[torch.randint(0, surfaces, (n,), generator=g, device=device)] * (1 + 0.02 * normal(n))
    x = (uniform(n) * 1.15 - 0.575) * width
    y = (uniform(n) * 1.15 - 0.575) * height
    pixels = torch.exp(0.6 + 0.9 * normal(n, 1)).clamp(max=40) * torch.exp(0.5 * normal(n, 3))
    scene = {
        "means": torch.stack([x / focal * z, y / focal * z, z], -1),
        "scales": pixels * (z[:, None] / focal),
        "quats": F.normalize(normal(n, 4), dim=-1),
        "opacities": torch.sigmoid(2.0 * normal(n) - 0.5),
    }
    K = torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1.0]], device=device)
    scene = {name: value[None] for name, value in scene.items()}
    return scene | {"viewmats": torch.eye(4, device=device)[None, None], "K": K, "width": width, "height": height}


def repeated(scene: dict, times: int) -> dict:
    """The clouds of a scene ``times`` over."""
    return {
        name: value.repeat(times, *[1] * (value.dim() - 1)) if torch.is_tensor(value) and name != "K" else value
        for name, value in scene.items()
    }


def sh_of(scene: dict, degree: int, seed: int) -> torch.Tensor:
    """[B, N, (degree + 1)^2, 3]"""
    g = torch.Generator(device=scene["means"].device).manual_seed(seed)
    return 0.3 * torch.randn(*scene["means"].shape[:2], (degree + 1) ** 2, 3, generator=g, device=scene["means"].device)


def packed(scene: dict) -> tuple[Cameras, torch.Tensor]:
    """Cameras of all clouds' views, and cu_rows."""
    clouds, views = scene["viewmats"].shape[:2]
    device, images = scene["means"].device, clouds * views
    ones = torch.ones(images, device=device)
    of_cloud = torch.arange(clouds, device=device).repeat_interleave(views)
    cameras = Cameras(
        scene["viewmats"].reshape(images, 4, 4), scene["K"].expand(images, 3, 3).contiguous(), 0.1 * ones, 10 * ones,
        of_cloud, scene["width"], scene["height"],
    )  # fmt: skip
    return cameras, torch.arange(clouds + 1, device=device) * scene["means"].shape[1]
