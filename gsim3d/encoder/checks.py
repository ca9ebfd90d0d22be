"""Are these frames something the encoder can read?"""

import torch

from gsim3d.encoder.config import EncoderConfig
from gsim3d.errors import HardCaseError, InputError
from gsim3d.types import Frames


def check_frames(frames: Frames, config: EncoderConfig) -> None:
    """Raises InputError or HardCaseError naming what is wrong."""
    cameras, images = frames.cameras, frames.images
    if images.dim() != 4 or images.shape[0] == 0 or images.shape[1] != 3:
        raise InputError(f"encoder: images must be [I, 3, H, W] with at least one image; got {list(images.shape)}")
    n_images, _, height, width = images.shape
    multiple = config.size_multiple
    if height % multiple or width % multiple:
        raise InputError(
            f"encoder: image height and width must be multiples of {multiple} for this model; got {height} x {width} "
            "(crop or resize the images and their intrinsics)"
        )
    shapes = {"viewmats": (4, 4), "Ks": (3, 3), "near": (), "far": (), "image_cloud": ()}
    for name, shape in shapes.items():
        if tuple(getattr(cameras, name).shape) != (n_images, *shape):
            raise InputError(
                f"encoder: cameras.{name} must be {[n_images, *shape]} for {n_images} images; "
                f"got {list(getattr(cameras, name).shape)}"
            )
    if (cameras.height, cameras.width) != (height, width):
        raise InputError(f"encoder: cameras are {cameras.height} x {cameras.width} pixels, images {height} x {width}")
    for name in ("masks", "dynamic"):
        value = getattr(frames, name)
        if value is not None and (value.dtype != torch.bool or value.shape != (n_images, height, width)):
            raise InputError(
                f"encoder: {name} must be bool {[n_images, height, width]}; got {value.dtype} {list(value.shape)}"
            )
    n_clouds = frames.cloud_scene.shape[0]
    if int(cameras.image_cloud.min()) < 0 or int(cameras.image_cloud.max()) >= n_clouds:
        raise InputError(f"encoder: cameras.image_cloud must be in [0, {n_clouds}), the number of clouds")
    finite = {"images": images, "cameras.viewmats": cameras.viewmats, "cameras.Ks": cameras.Ks}
    for name, value in finite.items():
        _check_rows(frames, name, value.detach().flatten(1).isfinite().all(1), "must be finite")
    _check_rows(frames, "cameras.near", cameras.near > 0, "must be positive")
    bounded = (cameras.far > cameras.near) & cameras.far.isfinite()
    _check_rows(frames, "cameras.far", bounded, "must be finite and larger than near")


def _check_rows(frames: Frames, name: str, ok: torch.Tensor, wanted: str) -> None:
    if bool(ok.all()):
        return
    image = int((~ok).nonzero()[0])
    cloud = int(frames.cameras.image_cloud[image])
    scene, step = int(frames.cloud_scene[cloud]), int(frames.cloud_step[cloud])
    raise HardCaseError(f"encoder: {name} {wanted}; image {image} (scene {scene}, step {step}) is not")
