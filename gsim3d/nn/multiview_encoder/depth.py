"""Depth of every pixel: a plane sweep at feature resolution, refined at full resolution."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from gsim3d import ops
from gsim3d.nn.layers import widened
from gsim3d.nn.multiview_encoder.config import EncoderConfig
from gsim3d.nn.multiview_encoder.layout import GroupNorm, by_pixel, for_convolution, two_convolutions
from gsim3d.nn.multiview_encoder.unet import UNet, repeat_pixels

if TYPE_CHECKING:
    from gsim3d.nn.multiview_encoder.static_shapes import ViewGeometry

INITIAL_OPACITY = 0.5  # of an untrained encoder: views of the same surface blend, and gradients reach what lies behind
INITIAL_OUTPUT = 0.01  # scale of the untrained disparity correction and opacity logit


@dataclass(frozen=True)
class Views:
    """Images and cameras of n clouds with V views each; I = n * V, views of one cloud one after another."""

    images: Tensor  #: [I, 3, H, W] in [0, 1]
    Ks: Tensor  #: [I, 3, 3] float64 pixels
    viewmats: Tensor  #: [I, 4, 4] float64 world-to-camera
    near: Tensor  #: [I] metres
    far: Tensor  #: [I] metres
    n_views: int  #: V
    geometry: ViewGeometry | None = None  #: what follows from the cameras; None: made where it is needed
    features: Tensor | None = None  #: of a frozen backbone; None: made where they are needed


@dataclass(frozen=True)
class Depth:
    """What is predicted of every pixel."""

    depth: Tensor  #: [I, 1, H, W] metres
    opacity_logit: Tensor  #: [I, 1, H, W]
    features: Tensor  #: [I, F, H, W] for the heads
    corners: Tensor | None = None  #: int64 [I, 2], row and column of the first pixel; None: 0


def upsampling_matrix(n: int, factor: int, stride: float, like: Tensor) -> Tensor:
    """[factor * n, n], the weights of linear upsampling along one axis, where input i lies at output i * stride."""
    index = (torch.arange(factor * n, device=like.device) / stride).clamp(max=n - 1)
    weights = 1 - (index[:, None] - torch.arange(n, device=like.device)).abs()
    return weights.clamp(min=0).to(like.dtype)


def all_pairs(n_clouds: int, n_views: int, device) -> tuple[Tensor, Tensor]:
    """Every view has all other views of its cloud as sources: src_images [n V (V - 1)] and cu_src [n V + 1]."""
    view = torch.arange(n_views, device=device)
    others = (view[:, None] + torch.arange(1, n_views, device=device)) % n_views
    cloud = torch.arange(n_clouds, device=device)[:, None, None] * n_views
    return (cloud + others).flatten(), torch.arange(n_clouds * n_views + 1, device=device) * (n_views - 1)


class CostVolume(nn.Module):
    """Correlation with the other views at D disparities -> a distribution over them at feature resolution."""

    def __init__(self, config: EncoderConfig):
        super().__init__()
        depths, dim = config.n_depths, config.cost_unet_dim
        in_dim = depths + config.feature_dim
        self.factor, self.n_depths = config.downscale_factor, depths
        self.refine_in = nn.Sequential(nn.Conv2d(in_dim, dim, 3, 1, 1), GroupNorm(8, dim), nn.GELU())
        self.unet = UNet(dim, config.cost_unet_levels, config.cost_unet_attention)
        self.refine_out = nn.Conv2d(dim, depths, 3, 1, 1)
        self.residual = nn.Conv2d(in_dim, depths, 1)
        self.head = two_convolutions(depths, 2 * depths, depths)

    def disparities(self, views: Views, like: Tensor) -> Tensor:
        """[I, D] from 1 / far to 1 / near."""
        far, near = 1 / views.far.double(), 1 / views.near.double()
        steps = torch.linspace(0, 1, self.n_depths, dtype=torch.float64, device=like.device)
        return (far[:, None] + steps * (near - far)[:, None]).to(like.dtype)

    def feature_intrinsics(self, Ks: Tensor) -> Tensor:
        """Intrinsics of feature maps whose pixel i is centred on image pixel factor * i; centres at +0.5 in both."""
        scaled = Ks.clone()
        scaled[:, :2] /= self.factor
        scaled[:, :2, 2] = (Ks[:, :2, 2] - 0.5) / self.factor + 0.5
        return scaled

    def source_intrinsics(self, Ks: Tensor, src_images: Tensor, n_views: int) -> Tensor:
        """[P, 3, 3], of the source view of each pair."""
        return Ks[src_images]

    def sweep_geometry(self, views: Views) -> tuple[Tensor, Tensor]:
        """Homographies and translations between all views of a cloud, float64."""
        src_images, cu_src = all_pairs(len(views.Ks) // views.n_views, views.n_views, views.Ks.device)
        Ks = self.feature_intrinsics(views.Ks)
        sources = self.source_intrinsics(Ks, src_images, views.n_views)
        return ops.sweep_geometry(Ks, views.viewmats, src_images, cu_src, Ks_target=sources)

    def correlation(self, features: Tensor, views: Views, disparities: Tensor) -> Tensor:
        """[I, C, h, w] features -> [I, D, h, w] mean correlation with the other views."""
        src_images, cu_src = all_pairs(features.shape[0] // views.n_views, views.n_views, features.device)
        known = views.geometry
        geometry = self.sweep_geometry(views) if known is None else known.of_depth
        geometry = (g.to(features.dtype) for g in geometry)
        return ops.plane_sweep(features, *geometry, disparities, src_images, cu_src, check=False)

    def forward(self, features: Tensor, views: Views) -> tuple[Tensor, Tensor]:
        """[I, C, h, w] -> expected disparity and largest probability, both [I, 1, h, w]."""
        features = widened(features)
        disparities = self.disparities(views, features)
        x = for_convolution(torch.cat([self.correlation(features, views, disparities), features], 1))
        refined = for_convolution(self.unet(self.refine_in(x), views.n_views))
        scores = self.refine_out(refined) + self.residual(x)
        probability = widened(self.head(scores)).softmax(1)
        expected = (probability * disparities[:, :, None, None]).sum(1, keepdim=True)
        return expected, probability.amax(1, keepdim=True)


class DepthPredictor(nn.Module):
    """Views and their features -> depth, opacity and full-resolution features."""

    def __init__(self, config: EncoderConfig):
        super().__init__()
        dim, upsampled = config.refine_unet_dim, config.upsampled_dim or config.feature_dim
        self.factor = config.downscale_factor
        self.cost_volume = CostVolume(config)
        self.upsampler = nn.Conv2d(2 * config.feature_dim, upsampled, 3, 1, 1)
        self.proj_feature = nn.Conv2d(upsampled, dim, 3, 1, 1)
        self.refine_in = nn.Sequential(nn.Conv2d(3 + dim + 2, dim, 3, 1, 1), GroupNorm(4, dim), nn.GELU())
        self.refine_unet = UNet(dim, config.refine_unet_levels, config.refine_unet_attention)
        self.to_disparity = two_convolutions(dim, config.disparity_dim, 2)
        last = self.to_disparity[2]
        nn.init.normal_(last.weight, std=INITIAL_OUTPUT / last.in_channels**0.5)
        last.bias.data.copy_(torch.tensor([0.0, math.log(INITIAL_OPACITY / (1 - INITIAL_OPACITY))]))

    def geometry(self, views: Views) -> tuple[Tensor, ...]:
        """What follows from cameras alone, float64."""
        return self.cost_volume.sweep_geometry(views)

    def upsampling_stride(self, n: int) -> float:
        """Outputs between two of ``n`` inputs: they lie where the strided convolutions took them from."""
        return self.factor

    def upsample(self, x: Tensor) -> Tensor:
        """[N, C, h, w] -> [N, C, factor h, factor w], bilinear, as two products, whose gradients need no atomics."""
        rows, cols = (upsampling_matrix(n, self.factor, self.upsampling_stride(n), x) for n in x.shape[2:])
        return rows @ (x @ cols.T)

    def forward(self, view_features: Tensor, cnn_features: Tensor, views: Views) -> Depth:
        """view_features and cnn_features: [I, C, h, w], with and without knowledge of the other views."""
        coarse, confidence = self.cost_volume(view_features, views)
        # In float64, which neither autocast nor TF32 shortens: half a permille of depth is millimetres.
        coarse = self.upsample(coarse.double()).to(coarse.dtype)
        confidence = repeat_pixels(confidence, self.factor)
        fine = self.upsampler(torch.cat([view_features, cnn_features], 1))
        fine = for_convolution(F.gelu(self.upsample(fine)))
        x = torch.cat([views.images, self.proj_feature(fine), coarse, confidence], 1)
        x = self.refine_in(for_convolution(x))
        x = by_pixel(self.refine_unet(x, views.n_views))
        correction, opacity_logit = widened(self.to_disparity(x)).split(1, 1)
        lowest, highest = (1 / bound.to(x.dtype)[:, None, None, None] for bound in (views.far, views.near))
        disparity = (coarse + correction).clamp(lowest, highest)
        return Depth(1 / disparity, opacity_logit, torch.cat([x, views.images, fine], 1))
