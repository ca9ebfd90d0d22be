"""I3D, the video classifier of FVD: Inception-v1 with kernels inflated in time, and 400 classes.

Batch norms are folded into convolutions when weights are converted (convert.py), so every unit is a convolution with
bias and a ReLU.

Source:
    Carreira and Zisserman 2017, "Quo vadis, action recognition? A new model and the Kinetics dataset".
"""

import torch
import torch.nn.functional as F
from torch import Tensor, nn

INPUT_SIZE = 224  # pixels
CLASSES = 400

# Channels of each Inception block: 1x1 | 1x1 -> 3x3 | 1x1 -> 3x3 | pooled -> 1x1
BLOCKS = {
    "mixed_3b": (64, 96, 128, 16, 32, 32),
    "mixed_3c": (128, 128, 192, 32, 96, 64),
    "mixed_4b": (192, 96, 208, 16, 48, 64),
    "mixed_4c": (160, 112, 224, 24, 64, 64),
    "mixed_4d": (128, 128, 256, 24, 64, 64),
    "mixed_4e": (112, 144, 288, 32, 64, 64),
    "mixed_4f": (256, 160, 320, 32, 128, 128),
    "mixed_5b": (256, 160, 320, 32, 128, 128),
    "mixed_5c": (384, 192, 384, 48, 128, 128),
}
POOLS = {"mixed_4b": ((3, 3, 3), (2, 2, 2)), "mixed_5b": ((2, 2, 2), (2, 2, 2))}  # before a block: kernel, stride


class I3D(nn.Module):
    """I3D network: clips [K, 3, T, 224, 224] in [-1, 1] with T >= 9 to logits [K, 400], averaged over time."""

    def __init__(self):
        super().__init__()
        self.conv_1a = Unit(3, 64, 7, stride=2)
        self.conv_2b = Unit(64, 64, 1)
        self.conv_2c = Unit(64, 192, 3)
        width = 192
        self.blocks = nn.ModuleDict()
        for name, channels in BLOCKS.items():
            self.blocks[name] = Inception(width, channels)
            width = self.blocks[name].out_channels
        self.logits = nn.Conv3d(width, CLASSES, 1)

    def forward(self, x: Tensor) -> Tensor:
        x = _max_pool(self.conv_1a(x), (1, 3, 3), (1, 2, 2))
        x = _max_pool(self.conv_2c(self.conv_2b(x)), (1, 3, 3), (1, 2, 2))
        for name, block in self.blocks.items():
            if name in POOLS:
                x = _max_pool(x, *POOLS[name])
            x = block(x)
        return self.logits(F.avg_pool3d(x, (2, 7, 7), stride=1)).mean((2, 3, 4))


class Inception(nn.Module):
    """Inception block: four parallel branches, concatenated along channels."""

    def __init__(self, width: int, channels: tuple[int, ...]):
        super().__init__()
        self.branch_0 = Unit(width, channels[0], 1)
        self.branch_1 = nn.Sequential(Unit(width, channels[1], 1), Unit(channels[1], channels[2], 3))
        self.branch_2 = nn.Sequential(Unit(width, channels[3], 1), Unit(channels[3], channels[4], 3))
        self.branch_3 = Unit(width, channels[5], 1)
        self.out_channels = channels[0] + channels[2] + channels[4] + channels[5]

    def forward(self, x: Tensor) -> Tensor:
        pooled = _max_pool(x, (3, 3, 3), (1, 1, 1))
        return torch.cat([self.branch_0(x), self.branch_1(x), self.branch_2(x), self.branch_3(pooled)], 1)


class Unit(nn.Module):
    """3D convolution with a cubic kernel and bias, and a ReLU."""

    def __init__(self, width: int, channels: int, kernel: int, stride: int = 1):
        super().__init__()
        self.conv = nn.Conv3d(width, channels, kernel, stride)

    def forward(self, x: Tensor) -> Tensor:
        return F.relu(self.conv(_pad_same(x, self.conv.kernel_size, self.conv.stride)))


def _max_pool(x: Tensor, kernel: tuple[int, ...], stride: tuple[int, ...]) -> Tensor:
    # Zero padding does not change maxima, because inputs are outputs of a ReLU.
    return F.max_pool3d(_pad_same(x, kernel, stride), kernel, stride)


def _pad_same(x: Tensor, kernel: tuple[int, ...], stride: tuple[int, ...]) -> Tensor:
    """Zero-pads the last three axes as TensorFlow's SAME: ceil(size / stride) outputs, odd padding at the end."""
    pads: list[int] = []
    for size, k, s in zip(reversed(x.shape[2:]), reversed(kernel), reversed(stride), strict=True):
        total = max((-(-size // s) - 1) * s + k - size, 0)
        pads += [total // 2, total - total // 2]
    return F.pad(x, pads) if any(pads) else x
