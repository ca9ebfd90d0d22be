"""Image metrics, one value per image, computed in float64.

Images are floating point in [0, 1], or uint8, which is divided by 255; other dtypes and ranges are an error.
"""

import torch
import torch.nn.functional as F
from torch import Tensor

from gsim3d.errors import InputError
from gsim3d.evaluate.perceptual.colors import as_colors

PSNR_CAP = 100.0  # dB, largest value; reached at a mean squared error of 1e-10

SSIM_WINDOW = 11  # pixels

_SSIM_SIGMA = 1.5  # pixels
_SSIM_K1, _SSIM_K2 = 0.01, 0.03


def psnr(pred: Tensor, target: Tensor, mask: Tensor | None = None) -> Tensor:
    """Computes the peak signal-to-noise ratio of each image, over all pixels or over a mask.

    ``-10 log10 max(1e-10, mse)``, with the mean squared error over masked pixels and channels; at most 100 dB. NaN for
    an image with an empty mask, which :func:`mean_of_counted` ignores.

    Args:
        pred, target: [I, H, W, C].
        mask: bool [I, H, W]. Default: all pixels.

    Returns:
        float64 [I], dB.

    Raises:
        InputError: shapes differ, or images are not in [0, 1].
    """
    pred, target = _checked(pred, target, mask)
    error = (pred - target).square().mean(-1)
    weight = torch.ones_like(error) if mask is None else mask.double()
    mean = (error * weight).sum((1, 2)) / weight.sum((1, 2))
    return -10 * torch.log10(mean.clamp(min=10 ** (-PSNR_CAP / 10)))


def ssim(pred: Tensor, target: Tensor) -> Tensor:
    """Computes the structural similarity of each image: Gaussian window of 11 pixels, sigma 1.5, sample covariance.

    Averaged over channels and over the pixels whose window lies inside the image.

    Args:
        pred, target: [I, H, W, C], H and W at least 11.

    Returns:
        float64 [I] in [-1, 1].

    Raises:
        InputError: shapes differ, or images are not in [0, 1] or too small.

    Source:
        Wang et al. 2004, "Image quality assessment: from error visibility to structural similarity".
    """
    x, y = _checked(pred, target)
    size, radius = SSIM_WINDOW, SSIM_WINDOW // 2
    if min(pred.shape[1:3]) < size:
        raise InputError(f"ssim: images must be at least {size} x {size}; got {tuple(pred.shape[1:3])}")
    offsets = torch.arange(-radius, radius + 1, dtype=torch.float64, device=pred.device)
    window = torch.exp(-0.5 * (offsets / _SSIM_SIGMA) ** 2)
    window = window / window.sum()

    def blur(image: Tensor) -> Tensor:
        image = image.permute(0, 3, 1, 2).flatten(0, 1)[:, None]
        image = F.conv2d(F.conv2d(image, window[None, None, :, None]), window[None, None, None])
        return image.reshape(pred.shape[0], pred.shape[3], *image.shape[2:])

    mean_x, mean_y = blur(x), blur(y)
    unbiased = size**2 / (size**2 - 1)
    var_x = unbiased * (blur(x * x) - mean_x**2)
    var_y = unbiased * (blur(y * y) - mean_y**2)
    cov = unbiased * (blur(x * y) - mean_x * mean_y)
    c1, c2 = _SSIM_K1**2, _SSIM_K2**2
    similarity = (2 * mean_x * mean_y + c1) * (2 * cov + c2) / ((mean_x**2 + mean_y**2 + c1) * (var_x + var_y + c2))
    return similarity.mean((1, 2, 3))


def mean_of_counted(values: Tensor) -> float | None:
    """Returns the mean of the values that are not NaN; None if all are NaN."""
    counted = values[~values.isnan()]
    return float(counted.mean()) if len(counted) else None


def _checked(pred: Tensor, target: Tensor, mask: Tensor | None = None) -> tuple[Tensor, Tensor]:
    """Validates both images and converts them to float64."""
    pred, target = as_colors(pred, "pred"), as_colors(target, "target")
    if pred.ndim != 4 or pred.shape != target.shape or 0 in pred.shape[1:]:
        raise InputError(f"images must both be [I, H, W, C]; got {tuple(pred.shape)} and {tuple(target.shape)}")
    if mask is not None and (mask.shape != pred.shape[:3] or mask.dtype != torch.bool):
        raise InputError(f"mask must be bool {tuple(pred.shape[:3])}; got {mask.dtype} {tuple(mask.shape)}")
    return pred.double(), target.double()
