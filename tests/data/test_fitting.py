"""Scenes brought to the size, depth range and unit that a model expects."""

import cv2
import numpy as np
import pytest
import torch
import torch.nn.functional as F

from gsim3d.data import Fitting, Scene
from gsim3d.data.recording import Problems, Recording
from gsim3d.errors import InputError
from tests.data.made_scenes import BOUNDS, ORIGIN, make_scene
from tests.tiny_scenes import write_scene


def record(source, made, **changes):
    source.write_text("{}")
    n_steps, n_cams, height, width = made.labels.shape

    def reader(values):
        return lambda cam, steps, problems: (values[step, cam] for step in steps)

    fields = {
        "layout": "made", "source": source, "n_steps": n_steps, "fps": 12.0,
        "camera_names": tuple(f"cam_{cam}" for cam in range(n_cams)), "viewmats": made.viewmats, "Ks": made.Ks,
        "sizes": ((width, height),) * n_cams, "read_images": reader(made.rgb), "read_labels": reader(made.labels),
        "near": 1.0, "far": 5.0, "origin": np.array(ORIGIN), "bounds": np.array(BOUNDS),
    }  # fmt: skip
    return Recording(**{**fields, **changes})


@pytest.fixture
def made(tmp_path):
    made = make_scene(moving=True, width=120, height=96)
    return made, record(tmp_path / "scene.json", made)


def opened(tmp_path, recording, **fitting):
    return Scene(tmp_path, recording, fitting=Fitting(**fitting))


def test_default_fitting_changes_nothing(tmp_path, made):
    plain, fitted = Scene(tmp_path, made[1]), opened(tmp_path, made[1])
    assert torch.equal(plain.images([0, 2], [1, 3]), fitted.images([0, 2], [1, 3]))
    assert plain.near == fitted.near and np.array_equal(plain.origin, fitted.origin)


def test_fit_scales_images_to_cover_and_crops_the_centre(tmp_path, made):
    made, recording = made
    scene = opened(tmp_path, recording, size=(48, 48))
    assert (scene.width, scene.height) == (48, 48)
    image = scene.images([1], [2])[0, 0].permute(1, 2, 0).numpy().astype(float)
    large = torch.from_numpy(made.rgb[2, 1]).permute(2, 0, 1)[None].float()
    expected = F.interpolate(large, (48, 60), mode="bilinear", antialias=True)[0, :, :, 6:54].permute(1, 2, 0).numpy()
    assert np.abs(image - expected).max() <= 0.5
    smooth = cv2.resize(cv2.GaussianBlur(made.rgb[2, 1], (0, 0), 1), (60, 48), interpolation=cv2.INTER_AREA)[:, 6:54]
    assert np.abs(image - smooth.astype(float)).mean() < 6  # another way of scaling shows the same picture


@pytest.mark.parametrize("size", [(48, 48), (96, 48), (48, 64), (112, 96)])
def test_fit_changes_intrinsics_with_images(tmp_path, made, size):
    """The ball is seen where the fitted cameras say that it is."""
    made, recording = made
    scene = opened(tmp_path, recording, size=size)
    for step in range(scene.n_steps):
        cameras = scene.cameras_at(range(scene.n_cams), [step])
        labels = scene.segmentation(range(scene.n_cams), [step])[0]
        center = torch.from_numpy(np.append(made.centers[step], 1)).float()
        for cam in range(scene.n_cams):
            pixel = cameras.Ks[cam] @ (cameras.viewmats[cam] @ center)[:3]
            pixel = (pixel[:2] / pixel[2]).numpy()
            rows, cols = np.nonzero(labels[cam].numpy() == 3)
            inside = rows.min() > 0 and cols.min() > 0 and rows.max() < size[1] - 1 and cols.max() < size[0] - 1
            if inside:
                middle = np.array([cols.min() + cols.max() + 1, rows.min() + rows.max() + 1]) / 2
                assert np.abs(middle - pixel).max() < 1.0, (step, cam)


def test_fit_keeps_moving_labels(tmp_path):
    made = make_scene(width=64, height=64, n_steps=1, n_cams=1)
    made.labels[:] = 0
    made.labels[0, 0, :, 32:] = 1
    made.labels[0, 0, 41, 41] = 3
    scene = opened(tmp_path, record(tmp_path / "scene.json", made), size=(16, 16))
    labels = scene.segmentation([0], [0])[0, 0]
    assert set(labels.unique().tolist()) == {0, 1, 3}
    assert labels[10, 10] == 3 and (labels == 3).sum() <= 4
    assert (labels[:, :7] == 0).all() and (labels[:, 8:] != 0).all()


def test_fit_replaces_depth_range(tmp_path, made):
    scene = opened(tmp_path, made[1], near_far=(0.2, 4.0))
    cameras = scene.cameras_at([0], [0])
    assert (scene.near, scene.far, cameras.near.item(), cameras.far.item()) == pytest.approx((0.2, 4.0, 0.2, 4.0))


def test_fit_unit_cameras_scales_lengths(tmp_path, made):
    made, recording = made
    scene = opened(tmp_path, recording, unit_cameras=True)
    extent = np.abs(np.linalg.inv(made.viewmats[0])[:, :3, 3]).max()
    centers = np.linalg.inv(scene.recording.viewmats)[..., :3, 3]
    assert np.abs(centers[0]).max() == pytest.approx(1)
    assert centers[-1] == pytest.approx(np.linalg.inv(made.viewmats[-1])[:, :3, 3] / extent)
    assert (scene.near, scene.far) == pytest.approx((1 / extent, 5 / extent))
    assert scene.origin == pytest.approx(np.array(ORIGIN) / extent)
    assert scene.bounds == pytest.approx(np.array(BOUNDS) / extent)
    both = opened(tmp_path, recording, unit_cameras=True, near_far=(0.2, 4.0))
    assert (both.near, both.far) == (0.2, 4.0)  # given in the new unit


def test_fit_unit_cameras_at_the_origin_changes_nothing(tmp_path):
    made = make_scene(n_steps=1, n_cams=1)
    made.viewmats[0, 0] = np.eye(4)
    scene = opened(tmp_path, record(tmp_path / "scene.json", made, bounds=None), unit_cameras=True)
    assert (scene.near, scene.far) == (1.0, 5.0)


def test_fit_refuses_to_enlarge_images(tmp_path, made):
    with pytest.raises(InputError, match=r"scene.json: camera cam_0 has images of 120x96 pixels; .* at least 128x96"):
        opened(tmp_path, made[1], size=(128, 96))


def test_fit_passes_unreadable_images_on(tmp_path):
    folder = write_scene(tmp_path / "scene", size=64)
    (folder / "cam_1" / "rgb_0002.png").write_bytes(b"no image")
    scene = Scene.open(folder, fitting=Fitting(size=(32, 32)))
    assert scene.images([0], [2]).shape == (1, 1, 3, 32, 32)
    with pytest.raises(InputError, match="rgb_0002.png .*cannot be decoded"):
        scene.images([1], [2])
    problems = Problems(collect=True)
    assert next(scene.recording.read_images(1, [2], problems)) is None and len(problems.found) == 1
