"""Validation of images and conversion to colours in [0, 1]."""

import torch
from torch import Tensor

from gsim3d.errors import InputError

ROUNDING = 1e-6  # tolerance for colours outside of [0, 1]


def as_colors(images: Tensor, name: str) -> Tensor:
    """Converts ``images``, floating point or uint8 (divided by 255), to float32 or float64 in [0, 1]. Raises
    InputError, with the ``name`` of the argument, for another dtype, and values that are not finite or outside of
    [0, 1]."""
    check_colors(images, name)
    if images.dtype == torch.uint8:
        return images.float() / 255
    return (images if images.dtype == torch.float64 else images.float()).clamp(0, 1)


def check_colors(images: Tensor, name: str) -> None:
    """Raises InputError as :func:`as_colors` does."""
    if not isinstance(images, Tensor):
        raise InputError(f"{name}: must be a tensor; got {type(images).__name__}")
    if images.dtype == torch.uint8 or not images.numel():
        if images.numel() and images.max() == 1:
            raise InputError(f"{name}: colours are 0 and 1 of 255; give float images in [0, 1] as they are")
        return
    if not images.is_floating_point():
        raise InputError(f"{name}: must be uint8, or floating point in [0, 1]; got {images.dtype}")
    least, most = (bound.item() for bound in images.detach().aminmax())
    if not (-ROUNDING <= least and most <= 1 + ROUNDING):  # also rejects NaN
        raise InputError(f"{name}: colours must be in [0, 1]; got {least:g} to {most:g} (divide by 255, or clamp)")
