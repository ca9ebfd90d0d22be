"""Validation of the encoder's input: types and shapes first, then all values in one device synchronisation."""

from typing import NamedTuple

import torch
from torch import Tensor

from gsim3d.cameras import Cameras, Frames
from gsim3d.errors import InputError, NumericalError
from gsim3d.nn.multiview_encoder.config import EncoderConfig
from gsim3d.numerics.policy import FARTHEST, NEAREST, at_most, usable_pixels
from gsim3d.numerics.report import ADVICE

FLOATS = (torch.float32, torch.float64)
MAX_PIXELS = 1e9  # of a focal length or a principal point
ROTATION_ERROR = 0.01  # largest |R R^T - 1| of a camera
NEARER = "give cameras and origin relative to a nearer point"
MEND = "mend its calibration or leave it out"


class _Wanted(NamedTuple):
    """One check of a field: whether each entry passes, and the requirement in words."""

    name: str
    good: Tensor
    what: str
    of: str = "image"  # what the entries are: "image", "scene", or "" for entries without a scene
    advice: str = MEND


def check_frames(frames: Frames, config: EncoderConfig, dtype: torch.dtype, *, pixels: bool = True) -> None:
    """Raises InputError where a type, device, shape or index is wrong, and NumericalError where a value is: the message
    names the field, and where. ``dtype``: of the network; ``pixels``: whether to check the values of images too."""
    _check_layout(frames, config, dtype)
    wanted = _wanted(frames)
    if pixels:
        lowest, highest = torch.aminmax(frames.images.detach().flatten(1), dim=1)
        finite, advice = lowest.isfinite() & highest.isfinite(), ADVICE.replace("rows", "pixels")
        wanted.append(_Wanted("images", finite, "must be finite", advice=advice))
        usable = usable_pixels(lowest) & usable_pixels(highest)
        wanted.append(_Wanted("images", usable, "must be in [0, 1]", advice=advice))
    if not bool(torch.cat([check.good for check in wanted]).all()):  # the one synchronisation
        _refuse(frames, next(check for check in wanted if not bool(check.good.all())))


def _check_layout(frames: Frames, config: EncoderConfig, dtype: torch.dtype) -> None:
    """Types, devices, dtypes and shapes, without a device synchronisation."""
    images, cameras = frames.images, frames.cameras
    if not isinstance(cameras, Cameras):
        raise InputError(f"encoder: cameras must be gsim3d.Cameras; got {type(cameras).__name__}")
    if not isinstance(images, Tensor) or images.dim() != 4 or images.shape[0] == 0 or images.shape[1] != 3:
        got = list(images.shape) if isinstance(images, Tensor) else type(images).__name__
        raise InputError(f"encoder: images must be [I, 3, H, W] with at least one image; got {got}")
    if images.dtype != dtype:
        fix = "divide by the largest value" if not images.is_floating_point() else f"convert them with .to({dtype})"
        raise InputError(f"encoder: images must be {dtype} in [0, 1], as the network; got {images.dtype}; {fix}")
    n, _, height, width = images.shape
    multiple = config.size_multiple
    if height % multiple or width % multiple:
        wanted = f"image height and width must be multiples of {multiple} for this model; got {height} x {width}"
        raise InputError(f"encoder: {wanted} (crop or resize the images and their intrinsics)")
    if (cameras.height, cameras.width) != (height, width):
        raise InputError(f"encoder: cameras are {cameras.height} x {cameras.width} pixels, images {height} x {width}")
    clouds = tuple(frames.cloud_scene.shape[:1])
    masks, whole = ((torch.bool,), (n, height, width)), (torch.int64,)
    fields = {
        "cameras.viewmats": (cameras.viewmats, FLOATS, (n, 4, 4)),
        "cameras.Ks": (cameras.Ks, FLOATS, (n, 3, 3)),
        "cameras.near": (cameras.near, FLOATS, (n,)),
        "cameras.far": (cameras.far, FLOATS, (n,)),
        "cameras.image_cloud": (cameras.image_cloud, whole, (n,)),
        "cloud_scene": (frames.cloud_scene, whole, clouds),
        "cloud_step": (frames.cloud_step, whole, clouds),
        "origin": (frames.origin, FLOATS, (*frames.origin.shape[:1], 3)),
        "world_offset": (frames.world_offset, (torch.float64,), tuple(frames.origin.shape)),
        **{name: (getattr(frames, name), *masks) for name in ("masks", "dynamic", "valid")},
    }
    for name, (value, dtypes, shape) in fields.items():
        if value is None and name in ("masks", "dynamic", "valid", "world_offset"):
            continue
        if not isinstance(value, Tensor) or value.dtype not in dtypes or tuple(value.shape) != shape:
            got = f"{value.dtype} {list(value.shape)}" if isinstance(value, Tensor) else type(value).__name__
            names = " or ".join(str(dtype).removeprefix("torch.") for dtype in dtypes)
            expected = f"bool {list(shape)}" if dtypes == masks[0] else f"{list(shape)} of {names} for {n} images"
            raise InputError(f"encoder: {name} must be {expected}; got {got}")
        if value.device != images.device:
            raise InputError(f"encoder: {name} is on {value.device}, images are on {images.device}")


def _wanted(frames: Frames) -> list[_Wanted]:
    cameras, viewmats, Ks = frames.cameras, frames.cameras.viewmats.detach(), frames.cameras.Ks.detach()
    near, far, origin = cameras.near.detach(), cameras.far.detach(), frames.origin
    n_clouds, n_scenes = len(frames.cloud_scene), len(origin)
    scenes, steps, shows = frames.cloud_scene, frames.cloud_step, cameras.image_cloud
    last = torch.eye(4, dtype=viewmats.dtype, device=viewmats.device)[3]
    rotation = viewmats[:, :3, :3].double()
    error = (rotation @ rotation.mT - torch.eye(3, dtype=rotation.dtype, device=rotation.device)).abs().amax((1, 2))
    focal = torch.stack([Ks[:, 0, 0], Ks[:, 1, 1]], 1)
    lower = torch.stack([Ks[:, 1, 0], Ks[:, 2, 0], Ks[:, 2, 1], Ks[:, 2, 2] - 1], 1).abs().amax(1)
    is_right_handed = (torch.linalg.cross(rotation[:, 0], rotation[:, 1]) * rotation[:, 2]).sum(1) > 0
    is_pose = is_right_handed & (error <= ROTATION_ERROR) & ((viewmats[:, 3] - last).abs().amax(1) <= 1e-5)
    is_K = at_most(Ks, MAX_PIXELS) & (focal.amin(1) >= 1 / MAX_PIXELS) & (lower <= 1e-5)
    of_focal = f"from {1 / MAX_PIXELS:g} to {MAX_PIXELS:g}"
    offset = origin if frames.world_offset is None else frames.world_offset
    finite, size = "must be finite", f"must be at most {FARTHEST:g} m in size"
    bounds = f"must be from {NEAREST:g} to {FARTHEST:g} m"
    return [
        _Wanted("cameras.image_cloud", (shows >= 0) & (shows < n_clouds), f"must be in [0, {n_clouds}), the clouds"),
        _Wanted("cloud_scene", (scenes >= 0) & (scenes < n_scenes), f"must be in [0, {n_scenes}), rows of origin", ""),
        _Wanted("cloud_step", steps >= 0, "must not be negative", ""),
        _Wanted("origin", at_most(origin, FARTHEST), f"{finite} and at most {FARTHEST:g} m in size", "scene", NEARER),
        _Wanted("world_offset", at_most(offset, FARTHEST), f"{finite} and at most {FARTHEST:g} m in size", "scene"),
        _Wanted("cameras.viewmats", viewmats.flatten(1).isfinite().all(1), finite),
        _Wanted("cameras.viewmats", at_most(viewmats, FARTHEST), size, advice=NEARER),
        _Wanted("cameras.viewmats", is_pose, "must be a rotation, right-handed, and a translation"),
        _Wanted("cameras.Ks", Ks.flatten(1).isfinite().all(1), finite),
        _Wanted("cameras.Ks", is_K, f"must be [[fx, skew, cx], [0, fy, cy], [0, 0, 1]], fx and fy {of_focal}"),
        _Wanted("cameras.near", near > 0, "must be positive"),
        _Wanted("cameras.far", (far > near) & far.isfinite(), "must be finite and larger than near"),
        _Wanted("cameras.near", (near >= NEAREST) & (near <= FARTHEST), bounds),
        _Wanted("cameras.far", (far >= NEAREST) & (far <= FARTHEST), bounds),
    ]


def _refuse(frames: Frames, check: _Wanted) -> None:
    index = int(check.good.logical_not().nonzero()[0])
    if check.of == "":
        raise InputError(f"encoder: {check.name} {check.what}; entry {index} is not")
    if check.name == "cameras.image_cloud":
        raise InputError(f"encoder: {check.name} {check.what}; image {index} is not")
    what = f"encoder: {check.name} {check.what}; {check.of} {index}"
    if check.of == "scene":
        raise NumericalError(f"{what} is not; {check.advice}", tensor=check.name, scene=index)
    cloud = int(frames.cameras.image_cloud[index])
    scene, step = int(frames.cloud_scene[cloud]), int(frames.cloud_step[cloud])
    where = {"tensor": check.name, "scene": scene, "step": step, "camera": index}
    raise NumericalError(f"{what} (scene {scene}, step {step}) is not; {check.advice}", **where)
