"""LPIPS (Learned Perceptual Image Patch Similarity), version 0.1.

At five layers of an image classifier, the features of each pixel are normalised to length 1; their squared differences
between two images are weighted by channel (a learned 1x1 head), averaged over pixels, and summed over layers.

Source:
    Zhang et al. 2018, "The unreasonable effectiveness of deep features as a perceptual metric".
"""

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from gsim3d.errors import InputError
from gsim3d.evaluate.perceptual.colors import as_colors
from gsim3d.evaluate.perceptual.weights import load
from gsim3d.nn.layers import exact_convolutions, widened

# Mean and deviation of the classifier's training images, for inputs in [-1, 1].
SHIFT = (-0.030, -0.088, -0.188)
SCALE = (0.458, 0.448, 0.450)
MIN_SQUARE = 1e-10  # added to the squared length of feature vectors, which keeps gradients of zero vectors finite

_CHUNK = 8  # images per batch, which bounds memory


@dataclass(frozen=True)
class _Conv:
    """Configuration of a convolution with ReLU."""

    channels: int  #: output channels
    kernel: int  #: kernel size
    stride: int = 1  #: stride
    pool: int = 0  #: kernel size of a max pooling with stride 2 before it; 0 for none
    tap: bool = False  #: whether LPIPS compares its output


def _vgg_stage(channels: int, depth: int, pool: int) -> tuple[_Conv, ...]:
    return tuple(_Conv(channels, 3, pool=0 if i else pool, tap=i == depth - 1) for i in range(depth))


NETWORKS = {
    "alex": (
        _Conv(64, 11, stride=4, tap=True),
        _Conv(192, 5, pool=3, tap=True),
        _Conv(384, 3, pool=3, tap=True),
        _Conv(256, 3, tap=True),
        _Conv(256, 3, tap=True),
    ),
    "vgg": (
        *_vgg_stage(64, 2, 0),
        *_vgg_stage(128, 2, 2),
        *_vgg_stage(256, 3, 2),
        *_vgg_stage(512, 3, 2),
        *_vgg_stage(512, 3, 2),
    ),
}
MIN_SIZE = {"alex": 31, "vgg": 16}  # pixels; a smaller image leaves nothing after the poolings


class LPIPS(nn.Module):
    """The distance as a module: [I, 3, H, W] twice, values in [0, 1] -> [I]. Differentiable."""

    def __init__(self, network: str):
        super().__init__()
        self.layers = NETWORKS[network]
        widths = [3] + [layer.channels for layer in self.layers]
        self.convs = nn.ModuleList(
            nn.Conv2d(width, layer.channels, layer.kernel, layer.stride, 2 if layer.stride == 4 else layer.kernel // 2)
            for width, layer in zip(widths, self.layers)
        )
        self.heads = nn.ParameterList(nn.Parameter(torch.zeros(layer.channels)) for layer in self.layers if layer.tap)
        self.register_buffer("shift", torch.tensor(SHIFT)[:, None, None], persistent=False)
        self.register_buffer("scale", torch.tensor(SCALE)[:, None, None], persistent=False)

    def forward(self, pred: Tensor, target: Tensor) -> Tensor:
        return sum(layer.mean((1, 2)) for layer in self.maps(pred, target))

    def maps(self, pred: Tensor, target: Tensor) -> list[Tensor]:
        """Returns the weighted differences [I, h, w] of the five layers, each at its own resolution."""
        pairs = zip(self.heads, self._features(pred), self._features(target), strict=True)
        return [((_unit(a) - _unit(b)).square() * head[:, None, None]).sum(1) for head, a, b in pairs]

    def _features(self, images: Tensor) -> list[Tensor]:
        x = ((2 * images - 1) - self.shift) / self.scale
        taps = []
        for layer, conv in zip(self.layers, self.convs):
            if layer.pool == 2:  # a maximum whose gradient needs no atomics
                height, width = (size // 2 for size in x.shape[2:])
                blocks = x[:, :, : 2 * height, : 2 * width].unflatten(3, (width, 2)).unflatten(2, (height, 2))
                x = blocks.amax((3, 5))
            elif layer.pool:
                x = F.max_pool2d(x, layer.pool, 2)
            x = F.relu(conv(x))
            if layer.tap:
                taps.append(widened(x))  # under autocast only convolutions are shorter
        return taps


def _unit(features: Tensor) -> Tensor:
    return features / (features.square().sum(1, keepdim=True) + MIN_SQUARE).sqrt()


@torch.no_grad()
def lpips(pred: Tensor, target: Tensor, network: str = "vgg") -> Tensor:
    """Computes the LPIPS of each pair of images; 0 for equal ones.

    Args:
        pred, target: [I, H, W, 3], floating point in [0, 1], or uint8, which is divided by 255.
        network: ``"alex"`` (sides of at least 31 pixels) or ``"vgg"`` (16).

    Returns:
        float64 [I].

    Raises:
        InputError: shapes are wrong, images are not in [0, 1], or the weights are not installed
            (`gsim3d weights lpips`).
    """
    pred, target = as_colors(pred, "lpips: pred"), as_colors(target, "lpips: target")
    if pred.ndim != 4 or pred.shape[-1] != 3 or pred.shape != target.shape:
        raise InputError(f"lpips: images must both be [I, H, W, 3]; got {tuple(pred.shape)} and {tuple(target.shape)}")
    if min(pred.shape[1:3]) < MIN_SIZE[network]:
        least = MIN_SIZE[network]
        raise InputError(f"lpips: {network} needs images of at least {least} x {least}; got {tuple(pred.shape[1:3])}")
    module = load(f"lpips_{network}", lambda: LPIPS(network)).to(pred.device)
    pred, target = (images.permute(0, 3, 1, 2).float() for images in (pred, target))
    pairs = zip(pred.split(_CHUNK), target.split(_CHUNK), strict=True)
    with exact_convolutions():
        return torch.cat([module(a, b).double() for a, b in pairs] or [torch.zeros(0, dtype=torch.float64)])
