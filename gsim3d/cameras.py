"""Cameras and Frames: calibrated images, the input of the simulator.

Ragged: the images of many frames are packed one after another. Sizes: B scenes, Q clouds, I images, H W pixels.
Units are metres and pixels; axes are OpenCV's (x right, y down, z forward).
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

from torch import Tensor


class TensorRecord:
    """Moves and selects all tensors of a dataclass together."""

    def map(self, f):
        """The same object with ``f`` applied to every tensor."""
        return dataclasses.replace(self, **{k: f(v) for k, v in vars(self).items() if isinstance(v, Tensor)})

    def to(self, device):
        return self.map(lambda t: t.to(device))

    def detach(self):
        return self.map(lambda t: t.detach() if t.is_floating_point() else t)


@dataclass(frozen=True)
class Cameras(TensorRecord):
    """Calibrated pinhole cameras, one row an image.

    viewmats: [I, 4, 4] world-to-camera, OpenCV axes.
    Ks: [I, 3, 3] in pixels, full principal point, pixel centres at +0.5.
    near, far: [I] metres, depth range in which the scene lies.
    image_cloud: int64 [I], the cloud that each image shows.
    width, height: pixels, the same for all images of one call.
    """

    viewmats: Tensor
    Ks: Tensor
    near: Tensor
    far: Tensor
    image_cloud: Tensor
    width: int
    height: int

    def __len__(self) -> int:
        return self.viewmats.shape[0]

    def select(self, images: Tensor, image_cloud: Tensor | None = None) -> Cameras:
        """The cameras of rows ``images``; ``image_cloud`` replaces the cloud ids where given."""
        return Cameras(
            self.viewmats[images],
            self.Ks[images],
            self.near[images],
            self.far[images],
            self.image_cloud[images] if image_cloud is None else image_cloud,
            self.width,
            self.height,
        )


@dataclass(frozen=True)
class Frames(TensorRecord):
    """Images of calibrated cameras: what the simulator sees.

    images: float32 [I, 3, H, W] in [0, 1].
    cameras: I rows; images of one cloud are its views, any number of them.
    cloud_scene, cloud_step: int64 [Q]; clouds are sorted by (scene, step), steps of a scene count from 0.
    origin: float64 [B, 3] metres, lower corner of each scene's workspace; voxels are counted from it.
    masks: bool [I, H, W], pixels that become particles; None: all.
    dynamic: bool [I, H, W], pixels of bodies that may move; None: all.
    valid: bool [I, H, W], pixels that were filmed: no padding; losses look at no others; None: all.
    world_offset: float64 [B, 3] metres, as of Particles.
    """

    images: Tensor
    cameras: Cameras
    cloud_scene: Tensor
    cloud_step: Tensor
    origin: Tensor
    masks: Tensor | None = None
    dynamic: Tensor | None = None
    valid: Tensor | None = None
    world_offset: Tensor | None = None

    def to(self, device):
        return dataclasses.replace(super().to(device), cameras=self.cameras.to(device))
