"""Depth and features of every pixel from a vision transformer, which may be pretrained and frozen."""

import importlib
from contextlib import nullcontext

import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from gsim3d.errors import InputError
from gsim3d.math.rotations import rotation_to_quat
from gsim3d.nn.dpt import DPTHead
from gsim3d.nn.multiview_encoder.cnn import image_statistics
from gsim3d.nn.multiview_encoder.config import EncoderConfig
from gsim3d.nn.multiview_encoder.depth import Depth, Views
from gsim3d.nn.resize import resize
from gsim3d.nn.vision_transformer import Architecture, CameraEncoder, ViT

SMALLEST_UNIT = 0.1  # metres, of the cameras' distances
TRANSPARENT = -20.0  # opacity logit of pixels below the least confidence


class TimmBackbone(nn.Module):
    """A model of timm; arguments and result as :class:`gsim3d.nn.vision_transformer.ViT`."""

    def __init__(self, config: Architecture):
        super().__init__()
        try:
            timm = importlib.import_module("timm")
        except (ImportError, RuntimeError) as error:  # the latter where torchvision is for another torch
            raise InputError(f"{config.timm}: needs timm ({error}): pip install 'gsim3d[timm]'") from None
        self.config = config
        self.model = timm.create_model(config.timm, pretrained=False, num_classes=0, dynamic_img_size=True)

    def forward(self, images: Tensor, n_views: int = 1, camera_tokens: Tensor | None = None) -> Tensor:
        options = {"indices": list(self.config.taken), "norm": True, "intermediates_only": True}
        maps = self.model.forward_intermediates(images, output_fmt="NCHW", **options)
        return torch.stack([x.flatten(2).mT for x in maps], 1)


def relative_poses(viewmats: Tensor, n_views: int) -> tuple[Tensor, Tensor]:
    """Poses that do not depend on where the world is, nor on how large, of ``viewmats`` [I, 4, 4], V views of a scene
    after each other: [I, 4, 4] world-to-camera where the first view of a scene is the world, and [I] metres, by which
    translations are divided: the lower median of the distances to the first view (0 included), at least 0.1.
    """
    scenes = viewmats.unflatten(0, (-1, n_views))
    relative = scenes @ _inverse(scenes[:, :1])
    distance = _inverse(relative)[..., :3, 3].norm(dim=-1)
    unit = distance.sort(1).values[:, (n_views - 1) // 2].clamp(min=SMALLEST_UNIT).repeat_interleave(n_views)
    relative = relative.flatten(0, 1).clone()
    relative[:, :3, 3] /= unit[:, None]
    return relative, unit


def pose_code(viewmats: Tensor, Ks: Tensor, size: tuple[int, int]) -> Tensor:
    """[I, 9]: translation and quaternion (x, y, z, w >= 0) of camera-to-world, vertical and horizontal field of view.

    size: (H, W) of the images of ``Ks``.
    """
    pose = _inverse(viewmats)
    quats = rotation_to_quat(pose[:, :3, :3])
    quats = torch.where(quats[:, :1] < 0, -quats, quats).roll(-1, 1)
    height, width = (2 * torch.atan(n / 2 / Ks[:, i, i]) for n, i in zip(size, (1, 0), strict=True))
    return torch.cat([pose[:, :3, 3], quats, height[:, None], width[:, None]], 1)


def _inverse(poses: Tensor) -> Tensor:
    """Of rotations with translations [..., 4, 4]."""
    turn = poses[..., :3, :3].mT
    return torch.cat([torch.cat([turn, -turn @ poses[..., :3, 3:]], -1), poses[..., 3:, :]], -2)


class _Bounded(torch.autograd.Function):
    """``x.clamp(lowest, highest)``, whose gradient also reaches what lies outside where a step would bring it back."""

    @staticmethod
    def forward(ctx, x: Tensor, lowest: Tensor, highest: Tensor) -> Tensor:
        ctx.save_for_backward(x < lowest, x > highest)
        return x.clamp(lowest, highest)

    @staticmethod
    @once_differentiable
    def backward(ctx, grad: Tensor) -> tuple[Tensor, None, None]:
        below, above = ctx.saved_tensors
        return grad.masked_fill((below & (grad > 0)) | (above & (grad < 0)), 0), None, None


class ViTDepth(nn.Module):
    """Views -> depth, opacity and full-resolution features."""

    def __init__(self, config: EncoderConfig):
        super().__init__()
        self.config, architecture = config.vit, config.vit.architecture
        mixes = architecture.mixes_from is not None
        self.backbone = TimmBackbone(architecture) if architecture.timm else ViT(architecture)
        self.camera_encoder = CameraEncoder(architecture.dim, architecture.camera_blocks) if mixes else None
        self.depth_head = DPTHead(architecture, 2 if mixes else 1)  # logarithms of depth, and of confidence - 1
        self.feature_head = DPTHead(architecture, config.vit.feature_dim + 1)  # the last one: opacity
        self.log_scale = nn.Parameter(torch.zeros(1))

    def geometry(self, views: Views) -> tuple[Tensor, ...]:
        """What follows from cameras alone, float64: the camera encoder's input [I, 9], and the unit of depth [I]."""
        relative, unit = relative_poses(views.viewmats, views.n_views)
        if self.config.architecture.unit == "range":
            unit = (views.near.double() * views.far.double()).sqrt()
        return pose_code(relative, views.Ks, views.images.shape[2:]), unit

    def grid(self, size: tuple[int, int]) -> tuple[int, int]:
        """(rows, columns) of the patches of images of ``size``."""
        scale = self.config.image_size / max(size) / self.config.architecture.patch
        return tuple(max(1, round(n * scale)) for n in size)

    def tokens(self, views: Views) -> Tensor:
        """[I, 4, P, C] of the backbone; of a frozen one scene by scene, so that they do not depend on the batch."""
        poses = self._geometry(views)[0].to(self.log_scale.dtype)
        if self.config.frozen == "none":
            return self._tokens(views.images, poses, views.n_views)
        parts = zip(views.images.split(views.n_views), poses.split(views.n_views), strict=True)
        with torch.no_grad():  # copies are aligned, by which matrix products on the CPU choose how they round
            return torch.cat([self._tokens(images.clone(), poses.clone(), views.n_views) for images, poses in parts])

    def forward(self, views: Views) -> Depth:
        size, like = tuple(views.images.shape[2:]), self.log_scale
        grid, (_, unit) = self.grid(size), self._geometry(views)
        read_at = tuple(n * self.config.architecture.patch for n in grid)
        tokens = self.tokens(views) if views.features is None else self._checked(views.features, len(views.Ks), grid)
        with torch.autocast(like.device.type, enabled=False):
            tokens = tokens.to(like.dtype)
            with torch.no_grad() if self.config.frozen == "depth" else nullcontext():
                seen = self.depth_head(tokens, grid, read_at)
            seen = resize(seen.double(), size)  # half a permille of depth is millimetres: TF32 is too coarse
            log_depth = seen[:, :1] + self.log_scale + unit.log()[:, None, None, None]
            lowest, highest = (bound.double().log()[:, None, None, None] for bound in (views.near, views.far))
            depth = _Bounded.apply(log_depth, lowest, highest).exp()
            features, opacity_logit = resize(self.feature_head(tokens, grid, read_at), size).tensor_split([-1], 1)
            if self.config.min_confidence > 1:
                is_low = seen[:, 1:].exp() + 1 < self.config.min_confidence
                opacity_logit = opacity_logit.masked_fill(is_low, TRANSPARENT)
        return Depth(depth.to(like.dtype), opacity_logit, torch.cat([features, views.images], 1))

    def _geometry(self, views: Views) -> tuple[Tensor, ...]:
        return self.geometry(views) if views.geometry is None else views.geometry.of_depth

    def _tokens(self, images: Tensor, poses: Tensor, n_views: int) -> Tensor:
        read_at = tuple(n * self.config.architecture.patch for n in self.grid(images.shape[2:]))
        mean, std = image_statistics(images.dtype, images.device)
        images, cameras = (resize(images, read_at) - mean) / std, None
        if self.camera_encoder is not None:
            with torch.autocast(poses.device.type, enabled=False):
                cameras = self.camera_encoder(poses.unflatten(0, (-1, n_views))).flatten(0, 1)
        return self.backbone(images, n_views, cameras)

    def _checked(self, features: Tensor, n_images: int, grid: tuple[int, int]) -> Tensor:
        wanted = (n_images, 4, grid[0] * grid[1], self.config.architecture.token_dim)
        if tuple(features.shape) != wanted or features.device != self.log_scale.device:
            wanted, got = f"{list(wanted)} on {self.log_scale.device}", f"{list(features.shape)} on {features.device}"
            advice = "make them with Encoder.backbone_features"
            raise InputError(f"encoder: backbone_features must be {wanted} for this model; got {got}; {advice}")
        return features
