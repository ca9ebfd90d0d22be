"""Features of a frozen backbone, computed once per input of a run and kept in memory."""

import dataclasses
import hashlib
from collections import OrderedDict
from threading import Lock

import torch
from torch import Tensor

from gsim3d.cameras import Frames
from gsim3d.nn.multiview_encoder import Encoder
from gsim3d.numerics.policy import usable_pixels

MOST_BYTES = 4 * 2**30


class FeatureCache:
    """Adds :attr:`gsim3d.cameras.Frames.backbone_features` to the frames of batches.

    An entry is found by the bits of a cloud's images and cameras, so that it never depends on what was read before.

    Args:
        encoder: with a frozen backbone.
        device: of the encoder.
        most_bytes: limit; entries that were not used for longest leave first.
    """

    def __init__(self, encoder: Encoder, device: str, most_bytes: int = MOST_BYTES):
        self._encoder, self._device, self._most_bytes = encoder, device, most_bytes
        self._known: OrderedDict[bytes, Tensor] = OrderedDict()
        self._n_bytes, self._lock = 0, Lock()

    def __call__(self, frames: Frames) -> Frames:
        """Returns ``frames`` (on the CPU) with features; as they are where a pixel is invalid."""
        if not bool(usable_pixels(frames.images).all()):
            return frames
        parts, order = [], []
        for cloud in range(len(frames.cloud_scene)):
            images = (frames.cameras.image_cloud == cloud).nonzero()[:, 0]
            if len(images):
                parts.append(self._of_cloud(frames, images))
                order.append(images)
        features = torch.cat(parts)[torch.cat(order).argsort()]
        return dataclasses.replace(frames, backbone_features=features)

    def _of_cloud(self, frames: Frames, images: Tensor) -> Tensor:
        scene = (frames.cloud_scene, frames.cloud_step, frames.origin)
        one = Frames(frames.images[images], frames.cameras.select(images), *scene)
        key = hashlib.blake2b(digest_size=20)
        for tensor in (one.images, one.cameras.viewmats, one.cameras.Ks):
            key.update(tensor.contiguous().numpy())
        key = key.digest()
        with self._lock:
            if key in self._known:
                self._known.move_to_end(key)
                return self._known[key]
        features = self._encoder.backbone_features(one.to(self._device)).cpu()
        with self._lock:
            if key not in self._known:
                self._known[key] = features
                self._n_bytes += features.nbytes
            while self._n_bytes > self._most_bytes and len(self._known) > 1:
                self._n_bytes -= self._known.popitem(last=False)[1].nbytes
        return features
