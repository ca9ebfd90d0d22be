"""From depth and features of pixels to particles in the world."""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from gsim3d.math.rotations import quat_product, rotation_to_quat, unit_quats, with_positive_largest
from gsim3d.math.spherical_harmonics import degree_damping, rotate_harmonics
from gsim3d.nn.layers import widened
from gsim3d.nn.multiview_encoder.config import EncoderConfig
from gsim3d.nn.multiview_encoder.crops import Crops
from gsim3d.nn.multiview_encoder.depth import Depth, Views
from gsim3d.nn.multiview_encoder.layout import for_convolution, two_convolutions


@dataclass(frozen=True)
class PixelRays:
    """Viewing rays of pixels, made in float64."""

    centers: Tensor  #: [I, 3] of the cameras, world
    rotations: Tensor  #: [I, 3, 3] of the cameras, camera-to-world
    inverse_Ks: Tensor  #: [I, 3, 3]

    @classmethod
    def of(cls, views: Views) -> PixelRays:
        poses = torch.linalg.inv(views.viewmats)
        return cls(poses[:, :3, 3], poses[:, :3, :3], torch.linalg.inv(views.Ks))

    def directions(self, height: int, width: int, offset: Tensor, corners: Tensor | None = None) -> Tensor:
        """[I, 3, H, W] world directions of z-depth 1 through pixel centres + ``offset`` [I or 1, 2, H, W] pixels, from
        the pixels ``corners`` on."""
        ticks = (torch.arange(n, device=offset.device) + 0.5 for n in (height, width))
        v, u = torch.meshgrid(*ticks, indexing="ij")
        centers = torch.stack([u, v]).to(offset.dtype)
        if corners is not None:
            centers = centers + corners.flip(1)[:, :, None, None]
        x, y = (offset + centers).split(1, 1)
        to_world = (self.rotations @ self.inverse_Ks).to(offset.dtype)[:, :, :, None, None]
        return to_world[:, :, 0] * x + to_world[:, :, 1] * y + to_world[:, :, 2]


def unit_vectors(x: Tensor) -> Tensor:
    """[I, 3, H, W], along axis 1. (Written out: torch's norm over that axis is slow on the CPU.)"""
    return x * (x * x).sum(1, keepdim=True).rsqrt()


def pluecker(centers: Tensor, directions: Tensor) -> Tensor:
    """[I, 3] and [I, 3, H, W] -> [I, 6, H, W]: unit direction and moment, the same for every point of a ray."""
    unit = unit_vectors(directions)
    origin = centers.to(unit.dtype)[:, :, None, None].expand_as(unit)
    return torch.cat([unit, torch.linalg.cross(origin, unit, dim=1)], 1)


class Conditioning(nn.Module):
    """Scales and shifts features by what depends on the view: y = x (1 + softplus(scale)) + shift."""

    def __init__(self, hidden: int, dim: int):
        super().__init__()
        self.net = two_convolutions(10, hidden, 2 * dim)

    def forward(self, x: Tensor, depth: Tensor, opacity_logit: Tensor, raw_offset: Tensor, rays: Tensor) -> Tensor:
        """x [I, F, H, W]; depth and opacity_logit [I, 1, H, W]; raw_offset [I, 2, H, W]; rays [I, 6, H, W]."""
        seen = for_convolution(torch.cat([depth, opacity_logit, raw_offset, rays], 1))
        scale, shift = self.net(seen).chunk(2, 1)
        if scale.is_cpu:  # where torch computes the softplus of strided numbers one by one
            scale = scale.contiguous(memory_format=torch.channels_last)
        return x * (1 + F.softplus(scale)) + shift


@dataclass(frozen=True)
class PixelParticles:
    """One particle a pixel, [I, H * W, .]; pixel (u, v) is particle v * W + u. Attributes as in Particles."""

    means: Tensor  #: metres, world
    opacities: Tensor  #: in (0, 1)
    dynamic_latents: Tensor  #: change with time
    static_latents: Tensor  #: do not
    quats: Tensor | None = None  #: only in explicit models
    scales: Tensor | None = None  #: only in explicit models
    sh: Tensor | None = None  #: only in explicit models


class ParticleHeads(nn.Module):
    """Depth and features of pixels -> particles."""

    def __init__(self, config: EncoderConfig):
        super().__init__()
        self.config = config
        dim = config.head_dim
        n_harmonics = (config.sh_degree + 1) ** 2
        n_raw = 2 + (3 + 4 + 3 * n_harmonics if config.explicit else 0)
        self.to_gaussians = two_convolutions(dim, 2 * n_raw, n_raw)
        n_latents = config.dynamic_dim + config.static_dim
        self.conditioning = Conditioning(config.condition_dim, dim) if n_latents else None
        self.to_latents = nn.Conv2d(dim, n_latents, 3, 1, 1) if n_latents else None

    def forward(self, depth: Depth, views: Views, origin: Tensor, crops: Crops | None = None) -> PixelParticles:
        """origin: [I, 3] world point from which the moments of viewing rays are taken; ``crops``: pixels to compute."""
        opacities = depth.opacity_logit.sigmoid()
        if crops is not None:
            depth, opacities = crops.cut_depth(depth), crops.cut(opacities)
        geometry = PixelRays.of(views) if views.geometry is None else views.geometry.rays
        raw = widened(self.to_gaussians(depth.features))
        raw_offset = raw[:, :2]
        rays = self._rays(geometry, raw_offset, depth.corners)
        means = geometry.centers.to(raw.dtype)[:, :, None, None] + depth.depth * rays
        latents = self._latents(depth, raw_offset, geometry, geometry.centers - origin)
        dynamic, static = latents.split([self.config.dynamic_dim, self.config.static_dim], -1)
        explicit = self.explicit_gaussians(raw[:, 2:], depth.depth, geometry) if self.config.explicit else {}
        return PixelParticles(_rows(means), _rows(opacities)[..., 0], dynamic, static, **explicit)

    def _latents(self, depth: Depth, raw_offset: Tensor, geometry: PixelRays, centers: Tensor) -> Tensor:
        n_images, _, height, width = depth.depth.shape
        if self.to_latents is None:
            return depth.depth.new_zeros(n_images, height * width, 0)
        central = geometry.directions(height, width, raw_offset.new_zeros(1, 2, height, width), depth.corners)
        rays = pluecker(centers, central)
        features = self.conditioning(depth.features, depth.depth, depth.opacity_logit, raw_offset, rays)
        latents = _rows(widened(self.to_latents(features)))
        return latents if self.config.latent_limit is None else _within(latents, self.config.latent_limit)

    def _rays(self, geometry: PixelRays, raw_offset: Tensor, corners: Tensor | None = None) -> Tensor:
        return geometry.directions(*raw_offset.shape[-2:], raw_offset.sigmoid() - 0.5, corners)

    def explicit_gaussians(self, raw: Tensor, depth: Tensor, geometry: PixelRays) -> dict[str, Tensor]:
        """quats, scales and sh of the explicit variant, predicted in the camera frame and turned into the world."""
        raw_scales, raw_quats, raw_sh = _rows(raw).split([3, 4, raw.shape[1] - 7], -1)
        smallest, largest = self.config.scale_range
        pixel_size = geometry.inverse_Ks[:, :2, :2].sum((1, 2)).to(raw.dtype)[:, None, None]
        scales = (smallest + (largest - smallest) * raw_scales.sigmoid()) * (_rows(depth) * 0.1 * pixel_size)
        rotations = geometry.rotations.to(raw.dtype)
        quats = quat_product(rotation_to_quat(rotations)[:, None], unit_quats(raw_quats.roll(1, -1)))  # raw: w last
        quats = with_positive_largest(quats)  # as those that the dynamics writes and reads
        damping = degree_damping(self.config.sh_degree, raw)
        in_camera = raw_sh.reshape(raw.shape[0], -1, 3, damping.shape[0]) * damping
        each = torch.eye(len(damping), dtype=geometry.rotations.dtype, device=raw.device).repeat(raw.shape[0], 1, 1)
        sh = self.rotate_harmonics(each, geometry.rotations).to(raw.dtype)
        sh = torch.einsum("ikl,incl->inkc", sh, in_camera).to(raw.dtype)  # autocast narrows it
        return {"quats": quats, "scales": scales, "sh": sh}

    def rotate_harmonics(self, sh: Tensor, rotations: Tensor) -> Tensor:
        """Predicted coefficients [N, K, C] turned into the world by ``rotations`` [N, 3, 3]."""
        return rotate_harmonics(sh, rotations)


def _within(latents: Tensor, limit: float) -> Tensor:
    """Rows [..., C], scaled down to a root mean square of ``limit`` where it is larger."""
    return latents * (limit**2 / latents.square().mean(-1, keepdim=True).clamp_min(limit**2)).sqrt()


def _rows(maps: Tensor) -> Tensor:
    """[I, C, H, W] -> [I, H * W, C]."""
    return maps.flatten(2).transpose(1, 2)
