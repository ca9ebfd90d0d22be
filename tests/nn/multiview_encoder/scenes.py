"""Small random frames and encoders for tests of the encoder."""

import dataclasses
import math

import torch

from gsim3d.cameras import Cameras, Frames
from gsim3d.nn.multiview_encoder import Encoder, EncoderConfig

SIZE = 16
CONFIG = EncoderConfig(
    feature_dim=8,
    cnn_dims=(8, 8),
    cnn_blocks=1,
    transformer_layers=2,
    transformer_mlp_ratio=1,
    n_depths=6,
    cost_unet_dim=8,
    cost_unet_levels=2,
    cost_unet_attention=(2,),
    refine_unet_dim=8,
    refine_unet_levels=2,
    refine_unet_attention=(),
    upsampled_dim=5,
    disparity_dim=8,
    dynamic_dim=3,
    static_dim=2,
    condition_dim=4,
)
ROW_FIELDS = ("means", "opacities", "dynamic_latents", "static_latents")


def look_at(angle: float, far: float = 3.0) -> torch.Tensor:
    """World-to-camera of a camera ``far`` metres from the z axis, half as high, that looks at the origin."""
    center = torch.tensor([far * math.cos(angle), far * math.sin(angle), far / 2], dtype=torch.float64)
    forward = -center / center.norm()
    right = torch.linalg.cross(forward, torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64))
    right = right / right.norm()
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = torch.stack([right, torch.linalg.cross(forward, right), forward])
    pose[:3, 3] = -pose[:3, :3] @ center
    return pose


def make_frames(clouds: list[int], n_clouds: int | None = None, seed: int = 0, size: int = SIZE) -> Frames:
    """One image for every entry of ``clouds``, which names its cloud."""
    n = len(clouds)
    generator = torch.Generator().manual_seed(seed)
    viewmats = torch.stack([look_at(0.4 + 1.1 * i) for i in range(n)])
    K = torch.tensor([[18.0, 0.0, 8.3], [0.0, 17.0, 7.6], [0.0, 0.0, 1.0]], dtype=torch.float64)
    K[:2] *= size / SIZE
    near, far = torch.full((n,), 1.5), torch.full((n,), 6.0)
    cameras = Cameras(viewmats, K.repeat(n, 1, 1), near, far, torch.tensor(clouds), size, size)
    n_clouds = n_clouds or max(clouds) + 1
    images = torch.rand(n, 3, size, size, generator=generator)
    origin = torch.tensor([[-2.0, -2.0, -0.5]], dtype=torch.float64)
    return Frames(images, cameras, torch.zeros(n_clouds, dtype=torch.int64), torch.arange(n_clouds), origin)


def select(frames: Frames, images: list[int], clouds: list[int]) -> Frames:
    """Frames with the chosen images, which show the named clouds."""
    rows, n_clouds = torch.tensor(images), max(clouds) + 1
    return dataclasses.replace(
        frames,
        images=frames.images[rows],
        cameras=frames.cameras.select(rows, torch.tensor(clouds)),
        cloud_scene=torch.zeros(n_clouds, dtype=torch.int64),
        cloud_step=torch.arange(n_clouds),
        masks=None if frames.masks is None else frames.masks[rows],
        dynamic=None if frames.dynamic is None else frames.dynamic[rows],
    )


def make_encoder(**changes) -> Encoder:
    """Random weights, zero-initialised norms included, so that every branch counts."""
    torch.manual_seed(0)
    encoder = Encoder(dataclasses.replace(CONFIG, **changes))
    generator = torch.Generator().manual_seed(1)
    for parameter in encoder.parameters():
        if parameter.dim() == 1:
            parameter.data.uniform_(-0.5, 0.5, generator=generator)
    return encoder


def image_rows(particles, image: int) -> list[torch.Tensor]:
    """Fields of the particles of the ``image``-th image, where no pixel is masked."""
    rows = slice(image * SIZE**2, (image + 1) * SIZE**2)
    return [getattr(particles, name)[rows] for name in ROW_FIELDS]
