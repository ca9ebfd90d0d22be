"""The inverse renderer: images of calibrated cameras -> particles."""

import dataclasses
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from gsim3d.cameras import Frames
from gsim3d.errors import InputError
from gsim3d.nn.layers import tf32_only_if_asked
from gsim3d.nn.multiview_encoder.checks import check_frames
from gsim3d.nn.multiview_encoder.cnn import CNN
from gsim3d.nn.multiview_encoder.config import EncoderConfig
from gsim3d.nn.multiview_encoder.crops import Crops
from gsim3d.nn.multiview_encoder.depth import Depth, DepthPredictor, Views
from gsim3d.nn.multiview_encoder.heads import ParticleHeads, PixelParticles, PixelRays
from gsim3d.nn.multiview_encoder.static_shapes import PixelIndex, StaticShapes, ViewGeometry
from gsim3d.nn.multiview_encoder.transformer import MultiViewTransformer
from gsim3d.nn.multiview_encoder.vit_depth import ViTDepth
from gsim3d.state import ASLEEP, DYNAMIC, FROZEN, CloudTable, Particles


def pixel_rows(frames: Frames, values: Tensor, shapes: StaticShapes | None = None) -> Tensor:
    """Those of ``values`` [I, H, W] of the pixels that become particles, in the order of these. ``shapes``: as of
    :meth:`Encoder.forward`; values of padding are 0."""
    if shapes is not None:
        index = PixelIndex.of(frames, shapes)
        return torch.where(index.exists, values.flatten()[index.pixel], 0)
    order = torch.argsort(frames.cameras.image_cloud, stable=True)
    flat = values[order].flatten()
    return flat if frames.masks is None else flat[frames.masks[order].flatten()]


class Encoder(nn.Module):
    """Depth by a plane sweep or a vision transformer, and view-independent latents: one particle a pixel.

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
        if config.backbone == "vit_dpt":
            self.depth = ViTDepth(config)
        else:
            self.cnn = CNN(config)
            self.transformer = MultiViewTransformer(config)
            self.depth = DepthPredictor(config)
        self.heads = ParticleHeads(config)
        self.to(memory_format=torch.channels_last)  # convolutions with few channels are faster on it, on CPU and GPU

    def check(self, frames: Frames, *, pixels: bool = True) -> None:
        """Raises as :meth:`forward` does.

        Args:
            frames: to encode.
            pixels: whether to check the values of images too.
        """
        check_frames(frames, self.config, next(self.parameters()).dtype, pixels=pixels)

    def forward(self, frames: Frames, shapes: StaticShapes | None = None, *, check: bool = True) -> Particles:
        """Particles of every cloud: images in ascending order, pixels line by line, inside ``masks``.

        On a GPU it computes in float32 unless autocast, or torch's switch for TF32 in matrix products, is on.

        Args:
            frames: images and cameras of all clouds.
            shapes: of :meth:`static_shapes`, for frames whose values alone differ. There is then no device
                synchronisation and no check; pixels beyond the capacity are left out.
            check: whether to validate ``frames``; False where the caller has done so.

        Returns:
            One particle a pixel.

        Gradients:
            Flow to ``frames.images`` and the parameters; of convolutions as torch's own switch for them says.

        Raises:
            InputError: sizes do not fit the network's strides or each other; the message names the argument.
            NumericalError: an image, camera or origin is not finite or out of range; the message names scene, step and
                tensor.
        """
        if check and shapes is None:
            self.check(frames)
        with tf32_only_if_asked():
            return self._encode(frames) if shapes is None else self._encode_into(frames, shapes)

    @property
    def has_frozen_backbone(self) -> bool:
        """Whether :meth:`backbone_features` of an image stay the same in training."""
        return self.config.backbone == "vit_dpt" and self.config.vit.frozen != "none"

    @torch.no_grad()
    def backbone_features(self, frames: Frames) -> Tensor:
        """Returns what the frozen backbone makes of images, to be kept as ``frames.backbone_features``.

        Args:
            frames: images and cameras of one cloud.
        Returns:
            [I, 4, P, C], of P patches; the bits that :meth:`forward` would compute.
        Raises:
            InputError: the encoder has no frozen backbone.
        """
        if not self.has_frozen_backbone:
            needed = 'backbone "vit_dpt" with vit.frozen "backbone" or "depth"'
            raise InputError(f"Encoder.backbone_features: needs {needed}")
        with tf32_only_if_asked():
            return self.depth.tokens(_views(frames, len(frames.cameras)))

    @torch.no_grad()
    def static_shapes(self, frames: Frames, size: int) -> StaticShapes:
        """Static shapes that follow from the cameras; images and masks may then change.

        Args:
            frames: whose clouds have equal numbers of views.
            size: particles of a cloud.
        Raises:
            InputError: as :meth:`forward`, or clouds have different numbers of views.
            NumericalError: as :meth:`forward`.
        """
        self.check(frames)
        n_clouds, cameras = frames.cloud_scene.shape[0], frames.cameras
        n_views = len(cameras) // n_clouds
        ordered = torch.arange(n_clouds, device=cameras.image_cloud.device).repeat_interleave(n_views)
        if not torch.equal(ordered, cameras.image_cloud):
            raise InputError("Encoder.static_shapes: cameras.image_cloud must ascend, as many views in each cloud")
        views = _views(frames, n_views)
        geometry = ViewGeometry(PixelRays.of(views), self.depth.geometry(views))
        scenes, steps = torch.stack([frames.cloud_scene, frames.cloud_step]).tolist()
        return StaticShapes(CloudTable.make([size] * n_clouds, scenes, steps, frames.images.device), geometry)

    def _encode_into(self, frames: Frames, shapes: StaticShapes) -> Particles:
        n_views, index = len(frames.cameras) // len(shapes.clouds), PixelIndex.of(frames, shapes)
        part = self._predict(_views(frames, n_views, shapes.geometry), frames.origin[_scene_of_image(frames)])
        (cu_rows, cloud_scene, cloud_step), known = shapes.clouds.tensors, shapes.clouds
        fields = {}
        for name in PixelParticles.__dataclass_fields__:
            values = getattr(part, name)
            if values is not None:
                values = _Kept.apply(values.flatten(0, 1), index.pixel, index.particle)
                nothing = torch.eye(1, 4, dtype=values.dtype, device=values.device) if name == "quats" else 0
                fields[name] = torch.where(index.exists.reshape(-1, *[1] * (values.dim() - 1)), values, nothing)
        activity = torch.full_like(index.pixel, DYNAMIC, dtype=torch.uint8)
        if frames.dynamic is not None:
            activity.masked_fill_(~frames.dynamic.flatten()[index.pixel], FROZEN)
        fields["activity"] = activity.masked_fill_(~index.exists, ASLEEP)
        table = {"cu_rows": cu_rows, "cloud_scene": cloud_scene, "cloud_step": cloud_step, "known": known}
        return Particles(**fields, **table, **_of_scenes(frames))

    def _encode(self, frames: Frames) -> Particles:
        """Clouds with equally many views are encoded together."""
        image_cloud = frames.cameras.image_cloud
        n_views = torch.bincount(image_cloud, minlength=frames.cloud_scene.shape[0])
        order = torch.argsort(image_cloud, stable=True)
        groups = {count: order[n_views[image_cloud[order]] == count] for count in n_views.unique().tolist() if count}
        crops = None if frames.masks is None or frames.images.is_cuda else Crops.around(frames.masks)
        parts = []
        for count, images in groups.items():
            features = None if frames.backbone_features is None else frames.backbone_features[images]
            of_images = {"images": frames.images[images], "backbone_features": features}
            chosen = dataclasses.replace(frames, **of_images, cameras=frames.cameras.select(images))
            views, origin = _views(chosen, count), frames.origin[_scene_of_image(chosen)]
            parts.append(self._predict(views, origin, None if crops is None else crops[images]))
        if crops is not None:
            frames = dataclasses.replace(frames, **{k: crops.cut(getattr(frames, k)) for k in ("masks", "dynamic")})
        place = torch.cat(list(groups.values())).argsort()[order] if len(groups) > 1 else None
        return self._assemble(frames, parts, place, order, n_views)

    def _predict(self, views: Views, origin: Tensor, crops: Crops | None = None) -> PixelParticles:
        """origin: [I, 3], of the scene that each image shows."""
        return self.heads(self._depth(views), views, origin, crops)

    def _depth(self, views: Views) -> Depth:
        if self.config.backbone == "vit_dpt":
            return self.depth(views)
        cnn_features = self.cnn(views.images)
        view_features = self.transformer(cnn_features.unflatten(0, (-1, views.n_views))).flatten(0, 1)
        return self.depth(view_features, cnn_features, views)

    def _assemble(
        self, frames: Frames, parts: list[PixelParticles], place: Tensor | None, order: Tensor, n_views: Tensor
    ) -> Particles:
        """Particles without masked pixels; the images of ``order`` lie at ``place`` among those of ``parts``."""
        n_pixels = parts[0].means.shape[1]
        kept, index, place_of_pixel, per_image = None, None, None, torch.full_like(order, n_pixels)
        if frames.masks is not None:
            kept = frames.masks[order].flatten()
            index = kept.nonzero()[:, 0]
            place_of_pixel = torch.where(kept, kept.cumsum(0) - 1, index.shape[0])
            per_image = kept.reshape(-1, n_pixels).sum(1, dtype=torch.int64)

        def field(name: str) -> Tensor | None:
            values = [getattr(part, name) for part in parts]
            if values[0] is None:
                return None
            joined = (values[0] if place is None else torch.cat(values)[place]).flatten(0, 1)
            return joined if kept is None else _Kept.apply(joined, index, place_of_pixel)

        activity = torch.full((order.shape[0] * n_pixels,), DYNAMIC, dtype=torch.uint8, device=order.device)
        if frames.dynamic is not None:
            activity.masked_fill_(~frames.dynamic[order].flatten(), FROZEN)
        fields = {name: field(name) for name in PixelParticles.__dataclass_fields__}
        fields["activity"] = activity if kept is None else activity[index]
        cu_rows = F.pad(per_image.cumsum(0), (1, 0))[F.pad(n_views.cumsum(0), (1, 0))]
        table = {"cu_rows": cu_rows, "cloud_scene": frames.cloud_scene, "cloud_step": frames.cloud_step}
        return Particles(**fields, **table, **_of_scenes(frames))


def _of_scenes(frames: Frames) -> dict[str, Any]:
    """What particles have of the scenes that ``frames`` show."""
    return {"origin": frames.origin, "world_offset": frames.world_offset, "actions": frames.actions}


def _views(frames: Frames, n_views: int, geometry: ViewGeometry | None = None) -> Views:
    cameras, images = frames.cameras, frames.images.contiguous(memory_format=torch.channels_last)
    Ks, viewmats = cameras.Ks.double(), cameras.viewmats.double()
    return Views(images, Ks, viewmats, cameras.near, cameras.far, n_views, geometry, frames.backbone_features)


def _scene_of_image(frames: Frames) -> Tensor:
    return frames.cloud_scene[frames.cameras.image_cloud]


class _Kept(torch.autograd.Function):
    """``x[rows]`` for distinct ``rows``, whose gradient is a gather too; torch would sort and add them to zeros.

    ``place`` has the index among ``rows`` of each row of ``x``, or their number where it is not among them.
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
