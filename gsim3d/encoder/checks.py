"""Are these frames something the encoder can read?"""

import torch

from gsim3d.encoder.config import EncoderConfig
from gsim3d.errors import HardCaseError, InputError
from gsim3d.stability import ADVICE
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
    near, far = cameras.near, cameras.far
    wanted = {
        ("cameras.image_cloud", ""): (cameras.image_cloud >= 0) & (cameras.image_cloud < n_clouds),
        ("images", "must be finite"): _finite(images),
        ("cameras.viewmats", "must be finite"): _finite(cameras.viewmats),
        ("cameras.Ks", "must be finite"): _finite(cameras.Ks),
        ("cameras.near", "must be positive"): near > 0,
        ("cameras.far", "must be finite and larger than near"): (far > near) & far.isfinite(),
    }
    good = torch.stack(list(wanted.values()))
    if not bool(good.all()):  # the device is waited for once
        check, image = good.logical_not().nonzero()[0].tolist()
        tensor, what = list(wanted)[check]
        if tensor == "cameras.image_cloud":
            raise InputError(f"encoder: {tensor} must be in [0, {n_clouds}), the number of clouds")
        cloud = int(cameras.image_cloud[image])
        scene, step = int(frames.cloud_scene[cloud]), int(frames.cloud_step[cloud])
        advice = ADVICE.replace("rows", "pixels") if tensor == "images" else "mend its calibration or leave it out"
        raise HardCaseError(
            f"encoder: {tensor} {what}; image {image} (scene {scene}, step {step}) is not; {advice}",
            tensor=tensor,
            scene=scene,
            step=step,
            camera=image,
        )


def _finite(values: torch.Tensor) -> torch.Tensor:
    """bool [I], of each image."""
    return values.detach().flatten(1).isfinite().all(1)
