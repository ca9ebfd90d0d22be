"""The inverse renderer: images of calibrated cameras -> particles."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from gsim3d.encoder.checks import check_frames
from gsim3d.encoder.cnn import CNN
from gsim3d.encoder.config import EncoderConfig
from gsim3d.encoder.depth import DepthPredictor, Views
from gsim3d.encoder.heads import ParticleHeads, PixelParticles
from gsim3d.encoder.transformer import MultiViewTransformer
from gsim3d.layers import tf32_only_if_asked
from gsim3d.types import DYNAMIC, FROZEN, Frames, Particles


def pixel_rows(frames: Frames, values: Tensor) -> Tensor:
    """``values`` [I, H, W] of the pixels that become particles, in the order of their rows."""
    order = torch.argsort(frames.cameras.image_cloud, stable=True)
    flat = values[order].flatten()
    return flat if frames.masks is None else flat[frames.masks[order].flatten()]


class Encoder(nn.Module):
    """Multi-view features, a plane sweep, depth refinement and view-independent latents: one particle a pixel.

    Clouds are encoded independently of each other; each may have any number of views, one included (its depth then
    rests on its features alone).

    Example:
        >>> encoder = Encoder(EncoderConfig.tiny())
        >>> encoder.config.size_multiple
        8
    """

    def __init__(self, config: EncoderConfig):
        super().__init__()
        self.config = config
        self.cnn = CNN(config)
        self.transformer = MultiViewTransformer(config)
        self.depth = DepthPredictor(config)
        self.heads = ParticleHeads(config)
        self.to(memory_format=torch.channels_last)  # convolutions with few channels are faster on it, on CPU and GPU

    def forward(self, frames: Frames) -> Particles:
        """Particles of every cloud: its images in ascending order, pixels row by row, those outside ``masks`` left out.

        On a GPU it computes in float32 unless autocast, or torch's switch for TF32 in matrix products, says otherwise.

        Gradients: ``frames.images`` and the parameters; of convolutions as torch's own switch for them says.
        Raises:
            InputError: sizes do not fit the network's strides or each other; the message names the argument.
            HardCaseError: an image or camera is not finite; the message names scene, step and tensor.
        """
        check_frames(frames, self.config)
        with tf32_only_if_asked():
            return self._encode(frames)

    def _encode(self, frames: Frames) -> Particles:
        n_clouds = frames.cloud_scene.shape[0]
        image_cloud = frames.cameras.image_cloud
        n_views = torch.bincount(image_cloud, minlength=n_clouds)
        order = torch.argsort(image_cloud, stable=True)
        parts, images_of_parts = [], []
        for count in n_views.unique().tolist():
            if count > 0:
                images = order[n_views[image_cloud[order]] == count]
                parts.append(self._encode_images(frames, images, count))
                images_of_parts.append(images)
        return self._assemble(frames, parts, images_of_parts, order, n_views)

    def _encode_images(self, frames: Frames, images: Tensor, n_views: int) -> PixelParticles:
        """Images of clouds with ``n_views`` views each, cloud by cloud."""
        cameras = frames.cameras.select(images)
        pixels = frames.images[images].contiguous(memory_format=torch.channels_last)
        views = Views(pixels, cameras.Ks.double(), cameras.viewmats.double(), cameras.near, cameras.far, n_views)
        cnn_features = self.cnn(views.images)
        view_features = self.transformer(cnn_features.unflatten(0, (-1, n_views))).flatten(0, 1)
        depth = self.depth(view_features, cnn_features, views)
        origin = frames.origin[frames.cloud_scene[cameras.image_cloud]]
        return self.heads(depth, views, origin * 0 if self.config.quirks.world_moments else origin)

    def _assemble(
        self, frames: Frames, parts: list[PixelParticles], images_of_parts: list[Tensor], order: Tensor, n_views: Tensor
    ) -> Particles:
        """Puts the images of all parts in the order of clouds and drops masked pixels."""
        device, n_pixels = frames.images.device, frames.images.shape[2] * frames.images.shape[3]
        place = None
        if len(parts) > 1:
            place = torch.empty_like(order)
            place[torch.cat(images_of_parts)] = torch.arange(order.shape[0], device=device)
        kept, kept_rows, row_of_pixel = None, None, None
        if frames.masks is not None:
            kept = frames.masks[order].flatten()
            kept_rows = kept.nonzero()[:, 0]
            row_of_pixel = torch.where(kept, kept.cumsum(0) - 1, kept_rows.shape[0])

        def rows(name: str) -> Tensor | None:
            values = [getattr(part, name) for part in parts]
            if any(value is None for value in values):
                return None
            joined = (values[0] if place is None else torch.cat(values)[place[order]]).flatten(0, 1)
            return joined if kept is None else _Kept.apply(joined, kept_rows, row_of_pixel)

        if frames.masks is None:
            per_image = torch.full_like(order, n_pixels)
        else:
            per_image = frames.masks[order].flatten(1).sum(1, dtype=torch.int64)
        per_cloud = torch.zeros_like(n_views).index_add_(0, frames.cameras.image_cloud[order], per_image)
        cu_rows = torch.zeros(n_views.shape[0] + 1, dtype=torch.int64, device=device)
        cu_rows[1:] = per_cloud.cumsum(0)
        if frames.dynamic is None:
            activity = torch.full((order.shape[0] * n_pixels,), DYNAMIC, dtype=torch.uint8, device=device)
        else:
            activity = torch.where(frames.dynamic[order].flatten(), DYNAMIC, FROZEN).to(torch.uint8)
        return Particles(
            **{name: rows(name) for name in PixelParticles.__dataclass_fields__},
            cu_rows=cu_rows,
            cloud_scene=frames.cloud_scene,
            cloud_step=frames.cloud_step,
            activity=activity if kept is None else activity[kept_rows],
            origin=frames.origin,
        )


class _Kept(torch.autograd.Function):
    """Some rows of x, each once. The gradient takes rows too; torch would sort them and add them to zeros.

    rows: which, int64. place: of each row of x its place among ``rows``, or their number.
    """

    @staticmethod
    def forward(ctx, x: Tensor, rows: Tensor, place: Tensor) -> Tensor:
        ctx.save_for_backward(place)
        return x.index_select(0, rows)

    @staticmethod
    @once_differentiable
    def backward(ctx, grad: Tensor) -> tuple[Tensor, None, None]:
        (place,) = ctx.saved_tensors
        return torch.cat([grad, grad.new_zeros(1, *grad.shape[1:])]).index_select(0, place), None, None
