"""Features of each image by itself."""

import functools

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from gsim3d.nn.multiview_encoder.config import EncoderConfig

IMAGE_MEAN = (0.485, 0.456, 0.406)  # of ImageNet, the statistics published weights expect
IMAGE_STD = (0.229, 0.224, 0.225)


class ResidualBlock(nn.Module):
    """Two 3x3 convolutions with instance norm around a shortcut."""

    def __init__(self, in_dim: int, out_dim: int, stride: int):
        super().__init__()
        self.conv1 = nn.Conv2d(in_dim, out_dim, 3, stride, 1, bias=False)
        self.conv2 = nn.Conv2d(out_dim, out_dim, 3, 1, 1, bias=False)
        changes = stride != 1 or in_dim != out_dim
        self.downsample = nn.Conv2d(in_dim, out_dim, 1, stride) if changes else None

    def forward(self, x: Tensor) -> Tensor:
        y = F.relu(F.instance_norm(self.conv1(x)))
        y = F.relu(F.instance_norm(self.conv2(y)))
        return F.relu((F.instance_norm(self.downsample(x)) if self.downsample is not None else x) + y)


class CNN(nn.Module):
    """[N, 3, H, W] images in [0, 1] -> [N, C, H / s, W / s]. Feature (v, u) is centred on image pixel (s v, s u)."""

    def __init__(self, config: EncoderConfig):
        super().__init__()
        dims = config.cnn_dims
        self.conv1 = nn.Conv2d(3, dims[0], 7, 2, 3, bias=False)
        self.stages = nn.ModuleList()
        stride, remaining = 1, config.downscale_factor // 2
        for i, dim in enumerate(dims):
            blocks = [ResidualBlock(dims[max(0, i - 1)], dim, stride)]
            blocks += [ResidualBlock(dim, dim, 1) for _ in range(config.cnn_blocks - 1)]
            self.stages.append(nn.Sequential(*blocks))
            stride = 2 if remaining > 1 else 1
            remaining //= stride
        self.conv2 = nn.Conv2d(dims[-1], config.feature_dim, 1)
        for module in self.modules():
            if isinstance(module, nn.Conv2d):
                nn.init.kaiming_normal_(module.weight, mode="fan_out", nonlinearity="relu")

    def forward(self, images: Tensor) -> Tensor:
        mean, std = image_statistics(images.dtype, images.device)
        x = F.relu(F.instance_norm(self.conv1((images - mean) / std)))
        for stage in self.stages:
            x = stage(x)
        return self.conv2(x)


@functools.cache
def image_statistics(dtype: torch.dtype, device: torch.device) -> tuple[Tensor, Tensor]:
    """Mean and deviation [3, 1, 1] of the images that the network expects."""
    with torch.inference_mode(False):
        return tuple(torch.tensor(v, dtype=dtype, device=device)[:, None, None] for v in (IMAGE_MEAN, IMAGE_STD))
