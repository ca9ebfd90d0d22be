"""Frames encoded in memory of fixed sizes, so that nothing waits for the device: what a CUDA graph needs."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from gsim3d.cameras import Frames
from gsim3d.nn.multiview_encoder.heads import PixelRays
from gsim3d.state import CloudTable


@dataclass(frozen=True)
class ViewGeometry:
    """What follows from cameras alone, float64: ``rays`` of their pixels, ``homographies`` [P, 3, 3] and
    ``translations`` [P, 3] between the feature maps of all pairs of views of a cloud."""

    rays: PixelRays
    homographies: Tensor
    translations: Tensor

    def tensors(self) -> list[Tensor]:
        return [*vars(self.rays).values(), self.homographies, self.translations]


@dataclass(frozen=True)
class Room:
    """Where the particles of frames go, and what must be known of their cameras; made by ``Encoder.room``.

    clouds: as many rows for each cloud as for any other. Particles come first; the rows behind them sleep.
    geometry: of the cameras.
    """

    clouds: CloudTable
    geometry: ViewGeometry

    @property
    def size(self) -> int:
        """Rows of a cloud."""
        return self.clouds.count(0)

    def copy_(self, other: Room) -> None:
        """Takes what is known of other cameras, as many."""
        for own, given in zip(self.geometry.tensors(), other.geometry.tensors(), strict=True):
            own.copy_(given)


@dataclass(frozen=True)
class Places:
    """Which pixel of [Q * P] becomes which row of [Q * R].

    pixel: int64, of each row, any where it has none.   is_one: bool, of each row, whether it has one.
    row: int64, of each pixel; Q * R where it becomes none.
    """

    pixel: Tensor
    is_one: Tensor
    row: Tensor

    @classmethod
    def of(cls, frames: Frames, room: Room) -> Places:
        """Images of a cloud follow each other, clouds in ascending order."""
        n_clouds, size = len(room.clouds), room.size
        kept = frames.images.new_ones(frames.images[:, 0].shape, dtype=torch.bool)
        kept = (kept if frames.masks is None else frames.masks).reshape(n_clouds, -1)
        n_pixels, cloud = kept.shape[1], torch.arange(n_clouds, device=kept.device)[:, None]
        count = kept.cumsum(1)
        number = torch.arange(1, size + 1, device=kept.device).repeat(n_clouds, 1)
        pixel = torch.searchsorted(count, number)
        return cls(
            (pixel.clamp(max=n_pixels - 1) + cloud * n_pixels).flatten(),
            (pixel < n_pixels).flatten(),
            torch.where(kept & (count <= size), count - 1 + cloud * size, n_clouds * size).flatten(),
        )
