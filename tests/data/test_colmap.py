"""COLMAP's models, text and binary, with every model of cameras, static and with time."""

import json
import shutil
import struct

import cv2
import numpy as np
import pytest

from gsim3d.data import Scene, colmap, find_scenes
from gsim3d.data.check import check_scene, describe
from gsim3d.data.colmap import MODELS
from gsim3d.errors import InputError
from tests.data.made_scenes import make_scene, quaternion, save


def write_colmap(
    folder, made, *, binary=True, model_folder="sparse/0", model="PINHOLE", params=None, names=None, points=None
):
    """Each camera and step is an image with a camera of its own; the order of images is that of no name."""
    n_steps, n_cams, height, width = made.labels.shape
    cameras, images = [], []
    for step, cam in np.ndindex(n_steps, n_cams):
        number, K, viewmat = 10 + step * n_cams + cam, made.Ks[step, cam], made.viewmats[step, cam]
        values = params or [K[0, 0], K[1, 1], K[0, 2], K[1, 2]]
        name = names(step, cam) if names else f"view {number}.png"
        save(folder / "images" / name, made.rgb[step, cam])
        cameras.append((number, model, width, height, values))
        images.append((number, quaternion(viewmat[:3, :3]), viewmat[:3, 3], number, name))
    points = np.zeros((0, 3)) if points is None else points
    target = folder / model_folder
    target.mkdir(parents=True, exist_ok=True)
    (write_binary if binary else write_text)(target, cameras, images[::-1], points)
    return folder


def write_binary(folder, cameras, images, points):
    numbers = {name: number for number, (name, _) in enumerate(MODELS)}
    data = struct.pack("<Q", len(cameras))
    for number, model, width, height, values in cameras:
        data += struct.pack(f"<iiQQ{len(values)}d", number, numbers[model], width, height, *values)
    (folder / "cameras.bin").write_bytes(data)
    data = struct.pack("<Q", len(images))
    for number, q, t, camera, name in images:
        data += struct.pack("<i7di", number, *q, *t, camera) + name.encode() + b"\0"
        data += struct.pack("<Q", 2) + struct.pack("<ddqddq", 1.5, 2.5, 7, 3.5, 4.5, -1)
    (folder / "images.bin").write_bytes(data)
    data = struct.pack("<Q", len(points))
    for number, point in enumerate(points):
        data += struct.pack("<Q3d3BdQ", number, *point, 1, 2, 3, 0.5, 2) + struct.pack("<iiii", 1, 0, 2, 1)
    (folder / "points3D.bin").write_bytes(data)


def write_text(folder, cameras, images, points):
    lines = ["# Camera list", *(f"{n} {m} {w} {h} {' '.join(map(repr, map(float, v)))}" for n, m, w, h, v in cameras)]
    (folder / "cameras.txt").write_text("\n".join(lines) + "\n")
    lines = ["# Image list", "#   POINTS2D[] as (X, Y, POINT3D_ID)"]
    for number, q, t, camera, name in images:
        lines += [f"{number} {' '.join(repr(float(x)) for x in (*q, *t))} {camera} {name}",
                  "" if number % 2 else "1.5 2.5 7 3.5 4.5 -1"]  # fmt: skip
    (folder / "images.txt").write_text("\n".join(lines) + "\n")
    lines = [f"{n} {x!r} {y!r} {z!r} 1 2 3 0.5 1 0 2 1" for n, (x, y, z) in enumerate(np.asarray(points).tolist())]
    (folder / "points3D.txt").write_text("\n".join(["# 3D points", *lines]) + "\n")


def seen_points(count=200):
    return np.random.default_rng(0).uniform([-0.5, -0.5, 0], [0.5, 0.5, 0.8], (count, 3))


@pytest.mark.parametrize("binary", [True, False])
@pytest.mark.parametrize("model_folder", ["sparse/0", "sparse", "colmap/sparse/0", "."])
def test_colmap_images_are_cameras_of_one_step(tmp_path, binary, model_folder):
    made = make_scene(n_steps=1, n_cams=4)
    folder = write_colmap(tmp_path / "scene", made, binary=binary, model_folder=model_folder, points=seen_points())
    scene = Scene.open(folder)
    assert (scene.layout, scene.n_steps, scene.n_cams) == ("colmap", 1, 4) and find_scenes(tmp_path) == [folder]
    assert scene.camera_names[0] == "images/view 10.png" and "its own camera at a single step" in describe(scene)
    cameras = scene.cameras_at(range(4), [0])
    np.testing.assert_allclose(cameras.viewmats, made.viewmats[0], atol=2e-6)
    np.testing.assert_allclose(cameras.Ks, made.Ks[0], rtol=1e-6)
    np.testing.assert_array_equal(scene.images(range(4), [0])[0].permute(0, 2, 3, 1), made.rgb[0])
    assert scene.recording.viewmats.dtype == np.float64 and check_scene(folder).problems == ()


@pytest.mark.parametrize("binary", [True, False])
def test_colmap_near_and_far_follow_from_points(tmp_path, binary):
    made, points = make_scene(n_steps=1), seen_points()
    local = points @ made.viewmats[0, :, :3, :3].swapaxes(1, 2) + made.viewmats[0, :, None, :3, 3]
    depths = local[..., 2]
    outliers = np.array([[0.0, 0.0, 400.0], [np.nan, 0, 0], [1e300, 0, 0], [0, np.inf, 0]])
    folder = write_colmap(tmp_path, made, binary=binary, points=np.concatenate([points, outliers]))
    scene = Scene.open(folder)
    assert 0.7 * depths.min() < scene.near < depths.min() and depths.max() < scene.far < 1.3 * depths.max()
    (tmp_path / "scene.json").write_text(json.dumps({"near": 0.5, "origin": [-3, -3, -1]}))
    assert Scene.open(folder).near == 0.5 and Scene.open(folder).far == scene.far
    assert Scene.open(folder).origin.tolist() == [-3, -3, -1]
    next((tmp_path / "sparse/0").glob("points3D*")).unlink()
    assert Scene.open(folder).far > scene.far  # guessed from the cameras


@pytest.mark.parametrize("binary", [True, False])
@pytest.mark.parametrize("stride", [1, 2])
def test_colmap_names_give_cameras_and_times_with_fps(tmp_path, binary, stride):
    made = make_scene(moving=True)
    names = lambda step, cam: f"cam{cam}/{stride * step + 1:04d}.png"  # noqa: E731
    folder = write_colmap(tmp_path, made, binary=binary, names=names)
    (folder / "scene.json").write_text(json.dumps({"fps": 24}))
    scene = Scene.open(folder)
    assert (scene.n_steps, scene.n_cams) == (4, 3) and scene.fps == pytest.approx(24 / stride)
    cameras = scene.cameras_at(range(3), range(4))
    np.testing.assert_allclose(cameras.viewmats.unflatten(0, (4, 3)), made.viewmats, atol=2e-6)
    np.testing.assert_array_equal(scene.images(range(3), range(4)).permute(0, 1, 3, 4, 2), made.rgb)
    (folder / "scene.json").unlink()
    assert (Scene.open(folder).n_steps, Scene.open(folder).n_cams) == (1, 12)


LENSES = {
    "SIMPLE_PINHOLE": ([50, 24, 16], None),
    "SIMPLE_RADIAL": ([50, 24, 16, 0.1], [0.1, 0, 0, 0, 0]),
    "RADIAL": ([50, 24, 16, 0.1, 0.02], [0.1, 0.02, 0, 0, 0]),
    "OPENCV": ([50, 51, 24, 16, 0.1, 0.02, 0.003, 0.004], [0.1, 0.02, 0.003, 0.004, 0]),
    "OPENCV_FISHEYE": ([50, 51, 24, 16, 0.1, 0.02, 0.003, 0.004], [0.1, 0.02, 0.003, 0.004]),
    "FULL_OPENCV": ([50, 51, 24, 16, *np.arange(1, 9) / 100], [0.01, 0.02, 0.03, 0.04, 0.05, 0.06, 0.07, 0.08]),
    "SIMPLE_RADIAL_FISHEYE": ([50, 24, 16, 0.1], [0.1, 0, 0, 0]),
    "RADIAL_FISHEYE": ([50, 24, 16, 0.1, 0.02], [0.1, 0.02, 0, 0]),
}


@pytest.mark.parametrize("model", LENSES)
@pytest.mark.parametrize("binary", [True, False])
def test_colmap_camera_models_are_read(tmp_path, model, binary):
    params, wanted = LENSES[model]
    scene = Scene.open(write_colmap(tmp_path, make_scene(n_steps=1), binary=binary, model=model, params=params))
    lens = scene.recording.distortions[0]
    assert (lens is None) == (wanted is None)
    if lens is not None:
        assert lens.coefficients.tolist() == wanted and lens.fisheye == ("FISHEYE" in model)
    K = scene.recording.Ks[0, 0]
    assert K[0, 0] == 50 and K[1, 1] == (51 if "OPENCV" in model else 50) and K[:2, 2].tolist() == [24, 16]


@pytest.mark.parametrize("model", ["FOV", "THIN_PRISM_FISHEYE", "RAD_TAN_THIN_PRISM_FISHEYE"])
@pytest.mark.parametrize("binary", [True, False])
def test_colmap_unread_camera_models_are_refused_by_name(tmp_path, model, binary):
    write_colmap(tmp_path, make_scene(n_steps=1), binary=binary, model=model, params=[50, 50, 24, 16, 0.9])
    with pytest.raises(InputError, match=f"camera 10: camera model {model} is not supported"):
        Scene.open(tmp_path)


def test_colmap_images_are_undistorted(tmp_path):
    made = make_scene(n_steps=1)
    scene = Scene.open(write_colmap(tmp_path, made, model="OPENCV_FISHEYE", params=[50, 51, 24, 16, 0.1, 0, 0, 0]))
    assert scene.valid(range(3), [0]) is not None
    assert not np.array_equal(scene.recorded_images(range(3), [0])[0].permute(0, 2, 3, 1), made.rgb[0])


def test_colmap_alpha_is_the_mask(tmp_path):
    made = make_scene(n_steps=1)
    write_colmap(tmp_path, made, names=lambda step, cam: f"{cam}.png")
    for cam in range(3):
        image = np.concatenate([made.rgb[0, cam], 255 * (made.labels[0, cam] == 3)[..., None].astype(np.uint8)], -1)
        save(tmp_path / "images" / f"{cam}.png", image)
    labels = Scene.open(tmp_path).segmentation(range(3), [0])[0].numpy()
    np.testing.assert_array_equal(labels, np.where(made.labels[0] == 3, 3, 0))


def test_colmap_notes_name_other_models(tmp_path):
    folder = write_colmap(tmp_path, make_scene(n_steps=1))
    shutil.copytree(folder / "sparse/0", folder / "sparse/1")
    assert "1 other models are ignored" in describe(Scene.open(folder))


@pytest.mark.parametrize("name", ["cameras.bin", "images.bin", "points3D.bin"])
def test_colmap_truncated_binary_files_are_refused(tmp_path, name):
    folder = write_colmap(tmp_path, make_scene(n_steps=1), points=seen_points(9))
    file = folder / "sparse/0" / name
    data = file.read_bytes()
    for cut in (0, 4, 12, len(data) // 2, len(data) - 1):
        file.write_bytes(data[:cut])
        with pytest.raises(InputError, match=f"{name} cannot be read: it ends too early"):
            Scene.open(folder)
    for wrong in (b"\xff" * 8 + data[8:], data[:8] + b"\xff" * (len(data) - 8)):
        file.write_bytes(wrong)
        with pytest.raises(InputError, match=name.split(".")[0]):
            Scene.open(folder)


DAMAGE = {
    "a word": ("cameras.txt", " 48 32 ", " 48 wide ", "cameras.txt: line 2 cannot be read"),
    "too few": ("cameras.txt", "10 PINHOLE 48 32 ", "10 PINHOLE 48 32 1.0 ", "PINHOLE has 4 parameters; got 5"),
    "no camera": ("images.txt", " 10 view", " 99 view", "has camera 99, which is not in"),
    "no pose": ("images.txt", "view 10.png", "", "cannot be read"),
    "outside": ("images.txt", "view 10.png", "../../x.png", "not a file inside the scene"),
    "twice": ("images.txt", "view 10.png", "view 11.png", "two images have the same name"),
    "no points": ("images.txt", "\n\n", "\n", "must hold the previous image's 2D points, or be empty"),
    "not UTF-8": ("images.txt", "view 10.png", "vi\udcff.png", "not UTF-8"),
}


@pytest.mark.parametrize("kind", DAMAGE)
def test_colmap_damaged_text_is_refused(tmp_path, kind):
    name, old, new, message = DAMAGE[kind]
    file = write_colmap(tmp_path, make_scene(n_steps=1), binary=False) / "sparse/0" / name
    text = file.read_text()
    assert old in text
    file.write_text(text.replace(old, new, 1), errors="surrogateescape")
    with pytest.raises(InputError, match=message):
        Scene.open(tmp_path)
    assert check_scene(tmp_path).problems


def test_colmap_number_of_images_is_bounded(tmp_path, monkeypatch):
    monkeypatch.setattr(colmap, "MAX_ENTRIES", 3)
    folder = write_colmap(tmp_path, make_scene(n_steps=1))
    assert Scene.open(folder).n_cams == 3
    write_colmap(tmp_path, make_scene(n_steps=1, n_cams=4))
    with pytest.raises(InputError, match="more than 3 images or cameras"):
        Scene.open(folder)


def test_colmap_quaternions_must_be_unit(tmp_path):
    made = make_scene(n_steps=1)
    folder = write_colmap(tmp_path, made, binary=False)
    text = (folder / "sparse/0/images.txt").read_text().splitlines()
    fields = text[2].split()
    text[2] = " ".join([fields[0], "9.0", *fields[2:]])
    (folder / "sparse/0/images.txt").write_text("\n".join(text))
    with pytest.raises(InputError, match="quaternion must have length 1"):
        Scene.open(folder)


def test_colmap_names_without_number_are_refused_with_fps(tmp_path):
    folder = write_colmap(tmp_path, make_scene(n_steps=1), names=lambda step, cam: f"{'abc'[cam]}.png")
    (folder / "scene.json").write_text('{"fps": 30}')
    with pytest.raises(InputError, match="has no frame number, needed because"):
        Scene.open(folder)


def test_colmap_missing_image_is_named(tmp_path):
    folder = write_colmap(tmp_path, make_scene(n_steps=1))
    (folder / "images" / "view 11.png").unlink()
    with pytest.raises(InputError, match="view 11.png .* is missing"):
        Scene.open(folder).images([1], [0])
    assert cv2.imwrite(str(folder / "images" / "view 11.png"), np.zeros((4, 4, 3), np.uint8))
    assert any("4x4 pixels" in line for line in check_scene(folder).problems)
    (folder / "images").rename(folder / "elsewhere")
    assert any("images/view 10.png" in line and "missing" in line for line in check_scene(folder).problems)


def test_colmap_text_of_windows(tmp_path):
    made = make_scene(n_steps=1, n_cams=4)
    write_colmap(tmp_path, made, binary=False, names=lambda step, cam: f"left/{cam}.png", points=seen_points())
    expected = Scene.open(tmp_path)
    for file in (tmp_path / "sparse/0").glob("*.txt"):
        file.write_bytes(b"\xef\xbb\xbf" + file.read_bytes().replace(b"\n", b"\r\n").replace(b"left/", b"left\\"))
    scene = Scene.open(tmp_path)
    np.testing.assert_array_equal(scene.recording.viewmats, expected.recording.viewmats)
    assert (scene.images(range(4), [0]) == expected.images(range(4), [0])).all() and scene.near == expected.near


@pytest.mark.parametrize("key", ["units", "fsp", "k1", "camera_model"])
def test_colmap_other_settings_are_refused(tmp_path, key):
    write_colmap(tmp_path, make_scene(n_steps=1, n_cams=4))
    (tmp_path / "scene.json").write_text(json.dumps({"near": 1.0, key: 1}))
    with pytest.raises(InputError, match=f"scene.json: {key} is no key of this file; it has fps, near, far"):
        Scene.open(tmp_path)
