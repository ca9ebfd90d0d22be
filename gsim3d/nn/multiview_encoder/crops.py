"""The part of each image that becomes particles: the heads, whose layers see few neighbours, compute no other."""

from __future__ import annotations

import dataclasses

import torch
from torch import Tensor

from gsim3d.nn.multiview_encoder.depth import Depth

MARGIN = 5  # pixels that the 3x3 convolutions of the heads see around one, one behind the other
MULTIPLE = 8  # pixels along both axes; with others torch computes single elements otherwise than whole vectors


@dataclasses.dataclass(frozen=True)
class Crops:
    """One rectangle of an image each, all of one size."""

    corners: Tensor  #: int64 [I, 2], first row and column
    size: tuple[int, int]  #: rows and columns

    @classmethod
    def around(cls, masks: Tensor) -> Crops:
        """Around ``masks`` [I, H, W] and MARGIN, inside the images; a device sync."""
        spans = [_spans(masks.any(axis)) for axis in (2, 1)]
        return cls(torch.stack([first for first, _ in spans], 1), (spans[0][1], spans[1][1]))

    def __getitem__(self, images: Tensor) -> Crops:
        return Crops(self.corners[images], self.size)

    def cut(self, x: Tensor | None) -> Tensor | None:
        """[I, ..., H, W] -> [I, ..., rows, columns]."""
        if x is None:
            return None
        (rows, cols), places = self.size, zip(x.split(1), self.corners.tolist(), strict=True)
        return torch.cat([image[..., row : row + rows, col : col + cols] for image, (row, col) in places])

    def cut_depth(self, depth: Depth) -> Depth:
        maps = (depth.depth, depth.opacity_logit, depth.features)
        return Depth(*map(self.cut, maps), self.corners)


def _spans(seen: Tensor) -> tuple[Tensor, int]:
    """[I, n] -> the first of the places of each row, and their number."""
    n = seen.shape[1]
    place = torch.arange(n, device=seen.device)
    first = torch.where(seen, place, n).amin(1) - MARGIN
    size = torch.where(seen, place, -1).amax(1) + 1 + MARGIN - first
    longest = min(-(-max(int(size.max()), 1) // MULTIPLE) * MULTIPLE, n)
    return first.clamp(0, n - longest), longest
