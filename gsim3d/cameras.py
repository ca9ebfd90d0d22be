"""Cameras and Frames: calibrated images, the input of the simulator.

Images of any number of scenes, steps and views are packed along one dimension. Sizes: B scenes, Q clouds, I images,
H x W pixels. Units are metres and pixels; axes are OpenCV's (x right, y down, z forward).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol, Self

import torch
from torch import Tensor


class TensorRecord:
    """Base class of dataclasses of tensors, with operations on all of them."""

    def map(self, f: Callable[[Tensor], Tensor]) -> Self:
        """Returns a copy with ``f`` applied to every tensor, also of records in it."""
        tensors = {k: f(v) for k, v in vars(self).items() if isinstance(v, Tensor)}
        records = {k: v.map(f) for k, v in vars(self).items() if isinstance(v, TensorRecord)}
        return dataclasses.replace(self, **tensors, **records)

    def to(self, device: str | torch.device) -> Self:
        """Returns a copy on ``device``; pinned memory is copied without waiting."""
        return self.map(lambda t: t.to(device, non_blocking=t.is_pinned()))

    def detach(self) -> Self:
        """Returns a copy detached from the autograd graph."""
        return self.map(lambda t: t.detach() if t.is_floating_point() else t)


@dataclass(frozen=True)
class Cameras(TensorRecord):
    """Calibrated pinhole cameras, one for each image.

    Attributes:
        viewmats: [I, 4, 4] world-to-camera, OpenCV axes.
        Ks: [I, 3, 3] in pixels, full principal point, pixel centres at +0.5.
        near: [I] metres, near end of the scene's depth range.
        far: [I] metres, far end of the scene's depth range.
        image_cloud: int64 [I], the cloud that each image shows.
        width: image width in pixels, equal for all images.
        height: image height in pixels, equal for all images.
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

    def select(self, images: Tensor | slice, image_cloud: Tensor | None = None) -> Cameras:
        """Returns a subset of the cameras.

        Args:
            images: int64, indices of the cameras, or a slice of them.
            image_cloud: int64, clouds that they show. Default: unchanged.
        """
        chosen = self.map(lambda values: values[images])
        return chosen if image_cloud is None else dataclasses.replace(chosen, image_cloud=image_cloud)


@dataclass(frozen=True)
class Frames(TensorRecord):
    """Images of calibrated cameras, the input of the simulator.

    Attributes:
        images: float32 [I, 3, H, W] in [0, 1].
        cameras: cameras of the I images; the images of a cloud are its views.
        cloud_scene: int64 [Q], scene of each cloud; clouds are sorted by (scene, step).
        cloud_step: int64 [Q], step of each cloud, from 0.
        origin: float64 [B, 3] metres, lower corner of each scene's workspace, and origin of its voxel grid.
        masks: bool [I, H, W], pixels that become particles; None: all.
        dynamic: bool [I, H, W], pixels of movable bodies; None: all.
        valid: bool [I, H, W], pixels with recorded values (no padding), to which losses are restricted; None: all.
        world_offset: float64 [B, 3] metres, see Particles.
        actions: motions of actors, :class:`gsim3d.Actions`; None: no actors.
        backbone_features: [I, 4, P, C], of a frozen backbone
            (:meth:`gsim3d.nn.multiview_encoder.Encoder.backbone_features`); None: computed from ``images``.
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
    actions: TensorRecord | None = None
    backbone_features: Tensor | None = None

    def subsample(self, background_stride: int, body_stride: int, masks: bool = True) -> Frames:
        """Returns frames with subsampled masks: only every n-th row and column of pixels becomes particles.

        Args:
            background_stride: n for pixels of static geometry.
            body_stride: n for pixels of movable bodies.
            masks: False: all pixels with recorded values are of movable bodies, whatever the labels say.
        """
        if not masks:
            whole = torch.ones_like(self.images[:, 0], dtype=torch.bool)
            self = dataclasses.replace(self, masks=whole if self.valid is None else self.valid, dynamic=whole)
        if background_stride == body_stride == 1 or self.masks is None or self.dynamic is None:
            return self
        of_body, of_background = (_every(n, self.masks) for n in (body_stride, background_stride))
        return dataclasses.replace(self, masks=self.masks & torch.where(self.dynamic, of_body, of_background))


def _every(stride: int, like: Tensor) -> Tensor:
    """Returns bool [H, W] that selects every n-th row and column of images [I, H, W]."""
    chosen = torch.zeros(like.shape[1:], dtype=torch.bool, device=like.device)
    chosen[stride // 2 :: stride, stride // 2 :: stride] = True
    return chosen


@dataclass(frozen=True)
class InputSpec:
    """Input specification of a trained simulator: steps, views and pixels that it was trained with.

    Attributes:
        history: number of input steps.
        context_views: input images per step.
        context_cameras: input cameras; empty: all but ``target_only_cameras``.
        target_only_cameras: cameras that are never an input.
        background_stride: see :meth:`Frames.subsample`.
        body_stride: see :meth:`Frames.subsample`.
        image_size: (width, height) in pixels.
        near_far: depth range of all scenes in metres; empty: each scene's own.
        fps: frames per second; None if unknown.
        masks: see :meth:`Frames.subsample`.
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
    masks: bool = True


class FrameSource(Protocol):
    """Protocol of objects that provide input frames, such as :class:`gsim3d.data.Scene`."""

    def input_frames(self, inputs: InputSpec) -> Frames:
        """Returns input frames for a simulator.

        Args:
            inputs: input specification of the simulator.

        Returns:
            The first ``inputs.history`` steps of one or more scenes.
        """
