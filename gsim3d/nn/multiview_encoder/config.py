"""What sizes an encoder has."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

from gsim3d.errors import InputError, check_one_of, check_ranges
from gsim3d.nn.vision_transformer import Architecture

_SMALL, _BASE = (384, 6, 12), (768, 12, 12)  # channels, heads, blocks
_ALONE, _MIXED = (2, 5, 8, 11), (5, 7, 9, 11)  # taken blocks
_SMALL_HEAD, _BASE_HEAD = (64, (48, 96, 192, 384)), (128, (96, 192, 384, 768))
BACKBONES = {
    "tiny": Architecture(64, 4, 4, (0, 1, 2, 3), 0, 16, (16, 16, 32, 32), mlp_ratio=2, camera_blocks=1, grid=4),
    "depth_anything_small": Architecture(*_SMALL, _MIXED, 4, *_SMALL_HEAD, offset=0.1, eps=1e-5, unit="cameras"),
    "depth_anything_base": Architecture(*_BASE, _MIXED, 4, *_BASE_HEAD, offset=0.1, eps=1e-5, unit="cameras"),
    "dinov2_small": Architecture(*_SMALL, _ALONE, None, *_SMALL_HEAD),
    "dinov2_base": Architecture(*_BASE, _ALONE, None, *_BASE_HEAD),
    "dinov3_small": Architecture(*_SMALL, _ALONE, None, *_SMALL_HEAD, patch=16, timm="vit_small_patch16_dinov3"),
    "dinov3_base": Architecture(*_BASE, _ALONE, None, *_BASE_HEAD, patch=16, timm="vit_base_patch16_dinov3"),
}


@dataclass(frozen=True)
class ViTConfig:
    """A vision transformer with dense prediction heads for depth and latents."""

    #: one of BACKBONES: "depth_anything_small" and "depth_anything_base" attend over all views and know the cameras;
    #: "dinov2_small", "dinov2_base", and of timm "dinov3_small", "dinov3_base", see each view alone; "tiny" is for
    #: tests
    model: str = "depth_anything_small"
    #: pixels of the longer side at which the network reads images, rounded to whole patches; depth and features are
    #: brought back to the size of the image
    image_size: int = 252
    #: which parts keep their weights: "none", "backbone" (with the camera encoder), or "depth" (also the depth head;
    #: the scale of depth, the features and the particles' heads learn)
    frozen: Literal["none", "backbone", "depth"] = "backbone"
    feature_dim: int = 32  #: F, channels of the second head
    #: pixels with a lower confidence are transparent; 1: none. Needs a model that mixes views.
    min_confidence: float = 1.0

    def __post_init__(self):
        check_one_of("ViTConfig: model", self.model, BACKBONES)
        check_ranges(self, image_size=(1, 10**4), feature_dim=(1, 10**4), min_confidence=(1, 1e9))
        if self.min_confidence > 1 and self.architecture.mixes_from is None:
            raise InputError(f"ViTConfig: min_confidence must be 1: {self.model} predicts no confidence")

    @property
    def architecture(self) -> Architecture:
        return BACKBONES[self.model]


@dataclass(frozen=True)
class EncoderConfig:
    """Sizes of the inverse renderer; the defaults are the paper's.

    With ``backbone: vit_dpt`` only ``vit``, ``dynamic_dim`` and what follows it have an effect.
    """

    feature_dim: int = 128  #: C, channels of the multi-view features; a multiple of 4
    downscale_factor: int = 4  #: s, image pixels a feature pixel along each axis: 2, 4 or 8
    #: channels of the CNN's levels at strides 2, 4, 8 ... until s is reached, then at s.
    cnn_dims: tuple[int, ...] = (64, 96, 128)
    cnn_blocks: int = 2  #: residual blocks of each level
    transformer_layers: int = 6  #: layers of self- and cross-view attention
    transformer_mlp_ratio: int = 4  #: hidden channels of their feed-forward parts over 2 C
    #: K; attention sees windows of 1/K of the feature map along each axis, shifted in every other layer
    window_split: int = 2
    n_depths: int = 64  #: D, depth candidates between far and near, evenly spaced in disparity
    cost_unet_dim: int = 128  #: channels of the U-Net on the cost volume
    cost_unet_levels: int = 3  #: its resolutions
    cost_unet_attention: tuple[int, ...] = (4,)  #: its downsampling factors at which views attend to each other
    refine_unet_dim: int = 32  #: as ``cost_unet_dim``, of the U-Net on full-resolution images
    refine_unet_levels: int = 5  #: its resolutions
    refine_unet_attention: tuple[int, ...] = (16,)  #: its downsampling factors at which views attend to each other
    upsampled_dim: int = 0  #: channels of the features brought to full resolution; 0: feature_dim
    disparity_dim: int = 64  #: hidden channels of the full-resolution disparity and opacity head
    dynamic_dim: int = 32  #: channels of the latents that change with time
    static_dim: int = 32  #: channels of those that do not
    condition_dim: int = 20  #: hidden channels of the network that scales and shifts features by depth and viewing ray
    #: largest root mean square of the latents of a particle, longer ones are scaled down; None: unlimited
    latent_limit: float | None = None
    explicit: bool = False  #: also predict rotation, scale and spherical harmonics of each particle
    sh_degree: int = 3  #: degree of these harmonics
    #: smallest and largest predicted scale, in tenths of a pixel's width plus height at its depth
    scale_range: tuple[float, float] = (0.5, 15.0)
    #: what predicts depth and features: "plane_sweep", a cost volume between the views, or "vit_dpt", a vision
    #: transformer, which can start from published weights
    backbone: Literal["plane_sweep", "vit_dpt"] = "plane_sweep"
    vit: ViTConfig = ViTConfig()  #: its settings

    def __post_init__(self):
        if self.downscale_factor not in (2, 4, 8) or self.downscale_factor > 2 ** len(self.cnn_dims):
            wanted = "2, 4 or 8 and at most 2^len(cnn_dims)"
            raise InputError(f"EncoderConfig: downscale_factor must be {wanted}; got {self.downscale_factor}")
        if self.feature_dim % 4 or self.feature_dim < 4:
            raise InputError(f"EncoderConfig: feature_dim must be a multiple of 4; got {self.feature_dim}")
        if self.n_depths < 2:
            raise InputError(f"EncoderConfig: n_depths must be at least 2; got {self.n_depths}")
        for name in ("cost_unet_dim", "refine_unet_dim"):
            dim = getattr(self, name)
            if dim % 8 or (dim > 32 and dim % 32):
                raise InputError(f"EncoderConfig: {name} must be 8, 16, 24 or a multiple of 32; got {dim}")
        widths = ("feature_dim", "cnn_dims", "cost_unet_dim", "refine_unet_dim", "disparity_dim")
        check_ranges(self, **dict.fromkeys(widths, (1, 10**5)), n_depths=(2, 10**4), sh_degree=(0, 3))
        check_ranges(self, **dict.fromkeys(("upsampled_dim", "dynamic_dim", "static_dim", "condition_dim"), (0, 10**5)))
        check_ranges(self, **dict.fromkeys(("cnn_blocks", "transformer_layers"), (0, 100)), window_split=(1, 1000))
        check_ranges(self, **dict.fromkeys(("cost_unet_attention", "refine_unet_attention"), (1, 10**4)))
        check_ranges(self, cost_unet_levels=(1, 20), refine_unet_levels=(1, 20), transformer_mlp_ratio=(1, 100))
        check_ranges(self, scale_range=(0, 1e6), latent_limit=(1e-3, 1e6))
        if self.scale_range[0] > self.scale_range[1]:
            raise InputError(f"EncoderConfig: scale_range must rise; got {self.scale_range}")

    @classmethod
    def tiny(cls) -> EncoderConfig:
        """Images of 64 pixels in a few tens of milliseconds on two CPU cores."""
        return cls(
            feature_dim=32, cnn_dims=(16, 32), cnn_blocks=1, transformer_layers=2, transformer_mlp_ratio=1, n_depths=24,
            cost_unet_dim=32, cost_unet_levels=2, cost_unet_attention=(2,), refine_unet_dim=8, refine_unet_levels=3,
            refine_unet_attention=(), disparity_dim=16, dynamic_dim=16, static_dim=8, condition_dim=8,
            upsampled_dim=13,  # the heads then read 24 channels, whole vectors
        )  # fmt: skip

    @property
    def size_multiple(self) -> int:
        """Image height and width must be multiples of this."""
        if self.backbone == "vit_dpt":
            return 1
        at_features = math.lcm(self.window_split, 2 ** (self.cost_unet_levels - 1))
        return math.lcm(self.downscale_factor * at_features, 2 ** (self.refine_unet_levels - 1))

    @property
    def head_dim(self) -> int:
        """Channels of the full-resolution features that the heads read: U-Net, image, upsampled features."""
        if self.backbone == "vit_dpt":
            return self.vit.feature_dim + 3
        return self.refine_unet_dim + 3 + (self.upsampled_dim or self.feature_dim)
