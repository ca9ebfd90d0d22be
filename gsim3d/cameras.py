"""Cameras and Frames: calibrated images, the input of the simulator.

Ragged: the images of many frames are packed one after another. Sizes: B scenes, Q clouds, I images, H W pixels.
Units are metres and pixels; axes are OpenCV's (x right, y down, z forward).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol, Self

import torch
from torch import Tensor


class TensorRecord:
    """Moves and selects all tensors of a dataclass together."""

    def map(self, f: Callable[[Tensor], Tensor]) -> Self:
        """The same object with ``f`` applied to every tensor."""
        return dataclasses.replace(self, **{k: f(v) for k, v in vars(self).items() if isinstance(v, Tensor)})

    def to(self, device: str | torch.device) -> Self:
        """The same on ``device``."""
        return self.map(lambda t: t.to(device))

    def detach(self) -> Self:
        """The same without gradients."""
        return self.map(lambda t: t.detach() if t.is_floating_point() else t)


@dataclass(frozen=True)
class Cameras(TensorRecord):
    """Calibrated pinhole cameras, one for each image.

    Attributes:
        viewmats: [I, 4, 4] world-to-camera, OpenCV axes.
        Ks: [I, 3, 3] in pixels, full principal point, pixel centres at +0.5.
        near: [I] metres, where the depth range of the scene begins.
        far: [I] metres, where it ends.
        image_cloud: int64 [I], the cloud that each image shows.
        width: pixels, the same for all images of one call.
        height: pixels.
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
        """Some of the cameras.

        Args:
            images: int64, which.
            image_cloud: int64, clouds that they show; None: as before.
        """
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
    """Images of calibrated cameras, the input of the simulator.

    Attributes:
        images: float32 [I, 3, H, W] in [0, 1].
        cameras: of the I images; images of one cloud are its views, any number of them.
        cloud_scene: int64 [Q]; clouds are sorted by (scene, step).
        cloud_step: int64 [Q], steps of a scene count from 0.
        origin: float64 [B, 3] metres, lower corner of each scene's workspace; voxels are counted from it.
        masks: bool [I, H, W], pixels that become particles; None: all.
        dynamic: bool [I, H, W], pixels of bodies that may move; None: all.
        valid: bool [I, H, W], pixels that were recorded: no padding; losses compare no others; None: all.
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

    def to(self, device: str | torch.device) -> Frames:
        """The same on ``device``."""
        return dataclasses.replace(super().to(device), cameras=self.cameras.to(device))

    def subsample(self, background_stride: int, body_stride: int) -> Frames:
        """The same frames, of which every n-th row and column of pixels becomes particles.

        Args:
            background_stride: n of pixels that show what never moves.
            body_stride: n of pixels that show what may move.
        """
        if background_stride == body_stride == 1 or self.masks is None or self.dynamic is None:
            return self
        of_body, of_background = (_every(n, self.masks) for n in (body_stride, background_stride))
        return dataclasses.replace(self, masks=self.masks & torch.where(self.dynamic, of_body, of_background))


def _every(stride: int, like: Tensor) -> Tensor:
    """bool [H, W]: every n-th row and column of images [I, H, W]."""
    chosen = torch.zeros(like.shape[1:], dtype=torch.bool, device=like.device)
    chosen[stride // 2 :: stride, stride // 2 :: stride] = True
    return chosen


@dataclass(frozen=True)
class InputSpec:
    """What a trained simulator takes as input: the steps, views and pixels that it was trained with.

    Attributes:
        history: steps that are encoded.
        context_views: images of each step.
        context_cameras: the cameras they come from; empty: all but ``target_only_cameras``.
        target_only_cameras: cameras that are never an input.
        background_stride: as of :meth:`Frames.subsample`.
        body_stride: as of :meth:`Frames.subsample`.
        image_size: (width, height) pixels.
        near_far: metres, the depth range of all scenes; empty: each scene's own.
        fps: frames per second; None: not known.
    """

    history: int = 2
    context_views: int = 4
    context_cameras: tuple[int, ...] = ()
    target_only_cameras: tuple[int, ...] = ()
    background_stride: int = 1
    body_stride: int = 1
    image_size: tuple[int, ...] = ()
    near_far: tuple[float, ...] = ()
    fps: float | None = None


class FrameSource(Protocol):
    """Anything that shows scenes to a simulator, such as :class:`gsim3d.data.Scene`."""

    def input_frames(self, inputs: InputSpec) -> Frames:
        """Input images.

        Args:
            inputs: of the simulator: how many steps and views, of which size.
        Returns:
            The first ``inputs.history`` steps of one scene or several.
        """
