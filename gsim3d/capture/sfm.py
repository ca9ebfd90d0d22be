"""Calibration by structure from motion (COLMAP) of the still background of each video."""

import tempfile
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path

import cv2
import numpy as np

from gsim3d.capture.board import Calibrated
from gsim3d.capture.clips import Clip
from gsim3d.data.cameras import focus, inverse, positions_and_axes
from gsim3d.data.masks import background_image
from gsim3d.data.recording import Problems
from gsim3d.errors import InputError

MIN_POINTS = 12  # of a camera


def calibrate_sfm(clips: Sequence[Clip]) -> list[Calibrated]:
    """Calibrates cameras by features that their backgrounds share.

    The world's origin is the point that the cameras look at, z the mean of their upward directions, and the mean
    distance of the cameras from the origin is 1.

    Raises:
        InputError: pycolmap is not installed, or the images of some cameras cannot be connected.
    """
    try:
        import pycolmap
    except ImportError as error:
        raise InputError(
            "calibration without a board needs pycolmap: pip install 'gsim3d[capture]' (or record a board: --board)"
        ) from error
    with tempfile.TemporaryDirectory() as temporary, ExitStack() as after:
        images, database = Path(temporary) / "images", Path(temporary) / "features.db"
        images.mkdir()
        for clip in clips:
            video = clip.video
            background = background_image(lambda at: np.stack([*video.read(at, Problems())]), len(video.times))
            cv2.imwrite(str(images / f"{clip.name}.png"), background[..., ::-1])
        after.callback(setattr, pycolmap.logging, "minloglevel", pycolmap.logging.minloglevel)
        pycolmap.logging.minloglevel = pycolmap.logging.FATAL  # a missing model is an error below
        options = pycolmap.IncrementalPipelineOptions()
        options.min_model_size, options.mapper.init_min_num_inliers = 2, 30
        pycolmap.set_random_seed(0)
        cameras = {"camera_mode": pycolmap.CameraMode.PER_IMAGE, "reader_options": {"camera_model": "SIMPLE_RADIAL"}}
        pycolmap.extract_features(database, images, **cameras)
        pycolmap.match_exhaustive(database)
        models = pycolmap.incremental_mapping(database, images, temporary, options)
    found = max(models.values(), key=lambda model: model.num_reg_images(), default=None)
    registered = {Path(image.name).stem: image for image in found.images.values() if image.has_pose} if found else {}
    lost = [clip.name for clip in clips if clip.name not in registered]
    if lost:
        raise InputError(
            f"structure from motion connects {len(registered)} of {len(clips)} cameras, without {', '.join(lost)}: "
            "their images share too few features; move the cameras closer together, add texture, or record "
            "a board (--board)"
        )
    poses = (registered[clip.name].cam_from_world().matrix() for clip in clips)
    viewmats = _upright(np.stack([np.vstack([pose, [0, 0, 0, 1]]) for pose in poses]))
    return [_camera(clip, found, registered[clip.name], pose) for clip, pose in zip(clips, viewmats, strict=True)]


def _camera(clip: Clip, model, image, viewmat: np.ndarray) -> Calibrated:
    camera = model.cameras[image.camera_id]
    K = np.array(camera.calibration_matrix())
    K[:2, 2] -= 0.5  # the first pixel's centre is at 0.5 in COLMAP
    errors = [
        np.linalg.norm(camera.img_from_cam(image.cam_from_world() * model.points3D[p.point3D_id].xyz) - p.xy)
        for p in image.points2D
        if p.has_point3D()
    ]
    if len(errors) < MIN_POINTS:
        raise InputError(f"camera {clip.name}: shares only {len(errors)} points with the others; at least {MIN_POINTS}")
    distortion = np.array([camera.params[3], 0, 0, 0, 0])
    return Calibrated(clip.name, clip.size, K, distortion, viewmat, float(np.sqrt(np.mean(np.square(errors)))), 1)


def _upright(viewmats: np.ndarray) -> np.ndarray:
    """Returns the poses in a world with z up, its origin in the focus of the cameras, at mean distance 1."""
    centres, axes = positions_and_axes(viewmats)
    point = focus(viewmats)
    point = (centres + axes * np.ptp(centres, 0).max()).mean(0) if point is None else point
    up = -viewmats[:, 1, :3].mean(0)
    up /= np.linalg.norm(up)
    x = np.cross(up, np.eye(3)[np.abs(up).argmin()])
    x /= np.linalg.norm(x)
    world = np.eye(4)  # new world -> old world
    world[:3, :3], world[:3, 3] = np.stack([x, np.cross(up, x), up], 1), point
    moved = viewmats @ world
    moved[:, :3, 3] /= np.linalg.norm(inverse(moved)[:, :3, 3], axis=1).mean()
    return moved
