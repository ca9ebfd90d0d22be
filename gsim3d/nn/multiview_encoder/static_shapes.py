"""Frames encoded into tensors of fixed shapes without a device synchronisation, as a CUDA graph needs it."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from gsim3d.cameras import Frames
from gsim3d.nn.multiview_encoder.heads import PixelRays
from gsim3d.state import CloudTable


@dataclass(frozen=True)
class ViewGeometry:
    """What follows from cameras alone, float64; for a plane sweep, of all P pairs of views of a cloud."""

    rays: PixelRays  #: of their pixels
    of_depth: tuple[Tensor, ...]  #: what the prediction of depth reads: homographies [P, 3, 3], translations [P, 3]

    def tensors(self) -> list[Tensor]:
        return [*vars(self.rays).values(), *self.of_depth]


@dataclass(frozen=True)
class StaticShapes:
    """Where the particles of frames go, and what depends on their cameras; of ``Encoder.static_shapes``. Padding,
    which sleeps, follows the pixels that become particles."""

    clouds: CloudTable  #: as many particles in each cloud as in any other
    geometry: ViewGeometry  #: of the cameras

    @property
    def size(self) -> int:
        """Particles of a cloud."""
        return self.clouds.count(0)

    def copy_(self, other: StaticShapes) -> None:
        """Takes the geometry of other cameras, as many."""
        for own, given in zip(self.geometry.tensors(), other.geometry.tensors(), strict=True):
            own.copy_(given)


@dataclass(frozen=True)
class PixelIndex:
    """Which pixel of [Q * P] becomes which particle of [Q * R]."""

    pixel: Tensor  #: int64, of each particle; any of padding
    exists: Tensor  #: bool, of each particle, False of padding
    particle: Tensor  #: int64, of each pixel; Q * R where it becomes none

    @classmethod
    def of(cls, frames: Frames, shapes: StaticShapes) -> PixelIndex:
        """Images of a cloud follow each other, clouds in ascending order."""
        n_clouds, size = len(shapes.clouds), shapes.size
        masks = frames.images.new_ones(frames.images[:, 0].shape, dtype=torch.bool)
        masks = (masks if frames.masks is None else frames.masks).reshape(n_clouds, -1)
        n_pixels, cloud = masks.shape[1], torch.arange(n_clouds, device=masks.device)[:, None]
        count = masks.cumsum(1)
        number = torch.arange(1, size + 1, device=masks.device).repeat(n_clouds, 1)
        pixel = torch.searchsorted(count, number)
        particle = torch.where(masks & (count <= size), count - 1 + cloud * size, n_clouds * size)
        exists, pixel = pixel < n_pixels, pixel.clamp(max=n_pixels - 1) + cloud * n_pixels
        return cls(pixel.flatten(), exists.flatten(), particle.flatten())
