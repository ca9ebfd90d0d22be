"""NeRF-synthetic and D-NeRF, and what transforms.json lacks: named as missing."""

import json

import cv2
import numpy as np
import pytest

from gsim3d.data import Scene, find_scenes
from gsim3d.data.check import check_scene, describe
from gsim3d.data.recording import MOVING
from gsim3d.errors import InputError
from tests.data.made_scenes import edit_json, make_scene, save, write_transforms

FLIP = np.diag([1.0, -1, -1, 1])
ANGLE = 0.9


def write_synthetic(folder, made, splits, times=None, suffix=".png", **top):
    """NeRF-synthetic's folders: square pixels, RGBA, no size. ``splits``: name -> rows (step, camera)."""
    width = made.labels.shape[3]
    focal = 0.5 * width / np.tan(0.5 * ANGLE)
    for name, rows in splits.items():
        frames = []
        for number, (step, cam) in enumerate(rows):
            alpha = (made.labels[step, cam] > 0) * np.uint8(255)
            save(folder / name / f"r_{number}{suffix}", np.concatenate([made.rgb[step, cam], alpha[..., None]], -1))
            frames.append({
                "file_path": f"./{name}/r_{number}", "rotation": 0.01,
                "transform_matrix": (np.linalg.inv(made.viewmats[step, cam]) @ FLIP).tolist(),
                **({} if times is None else {"time": times[step]}),
            })  # fmt: skip
        content = {"camera_angle_x": ANGLE, "frames": frames, "near": 1.0, "far": 6.0, **top}
        (folder / f"transforms_{name}.json").write_text(json.dumps(content))
    return focal


def test_nerf_synthetic_views_are_cameras_of_one_step(tmp_path):
    made = make_scene(n_steps=1, n_cams=5)
    focal = write_synthetic(tmp_path, made, {"train": [(0, 0), (0, 1), (0, 2)], "test": [(0, 3)], "val": [(0, 4)]})
    scene = Scene.open(tmp_path)
    assert (scene.n_steps, scene.n_cams) == (1, 5) and scene.camera_names[0] == "test/r_0"
    order = [int(scene.camera_names.index(name)) for name in ("train/r_0", "train/r_1", "train/r_2")]
    cameras = scene.cameras_at(order, [0])
    np.testing.assert_allclose(cameras.viewmats, made.viewmats[0, :3], atol=1e-6)
    np.testing.assert_allclose(cameras.Ks, [[[focal, 0, 24], [0, focal, 16], [0, 0, 1]]] * 3, rtol=1e-6)
    labels = scene.segmentation(order, [0])[0].numpy()
    np.testing.assert_array_equal(labels == MOVING, made.labels[0, :3] > 0)
    assert "transforms_val.json are added as cameras" in describe(scene) and find_scenes(tmp_path) == [tmp_path]


@pytest.mark.parametrize("count", [1, 4])
def test_d_nerf_is_one_moving_camera(tmp_path, count):
    made = make_scene(moving=True, n_steps=6)
    rows = [(step, step % 3) for step in range(6)]
    write_synthetic(tmp_path, made, {"train": rows, "test": rows[:count]}, times=np.linspace(0, 1, 6).tolist())
    scene = Scene.open(tmp_path)
    assert (scene.n_steps, scene.n_cams, scene.cameras_move) == (6, 1, True) and scene.fps == pytest.approx(5)
    wanted = np.stack([made.viewmats[row] for row in rows])
    np.testing.assert_allclose(scene.cameras_at([0], range(6)).viewmats, wanted, atol=1e-6)
    assert "transforms_test.json is ignored: its times differ" in describe(scene)
    assert check_scene(tmp_path).problems == ()


def test_nerf_splits_of_the_same_times_are_cameras(tmp_path):
    made = make_scene(n_steps=4)
    splits = {"train": [(step, 0) for step in range(4)], "test": [(step, 1) for step in range(4)]}
    write_synthetic(tmp_path, made, splits, times=[0, 0.25, 0.5, 0.75])
    scene = Scene.open(tmp_path)
    assert scene.camera_names == ("test/r", "train/r") and (scene.n_steps, scene.fps) == (4, 4.0)


@pytest.mark.parametrize("suffix", [".png", ".tif", ".webp"])
def test_transforms_paths_without_suffix(tmp_path, suffix):
    made = make_scene(n_steps=1)
    write_synthetic(tmp_path, made, {"train": [(0, 0), (0, 1)]}, suffix=suffix)
    for number in range(2):
        (tmp_path / "train" / f"r_{number}{suffix}").rename(tmp_path / "train" / f"r_{number}.5{suffix}")
    edit_json(
        tmp_path / "transforms_train.json",
        lambda content: [frame.update(file_path=frame["file_path"] + ".5") for frame in content["frames"]],
    )
    assert Scene.open(tmp_path).recorded_images([0, 1], [0]).float().mean() > 5


def test_transforms_camera_angles_of_axes_and_frames(tmp_path):
    made = make_scene(n_steps=1)
    write_synthetic(tmp_path, made, {"train": [(0, 0), (0, 1)]}, camera_angle_y=0.5)
    own = {"camera_angle_x": 0.7, "cx": 20.0, "w": 48, "h": 32}
    edit_json(tmp_path / "transforms_train.json", lambda content: content["frames"][1].update(own))
    Ks = Scene.open(tmp_path).cameras_at([0, 1], [0]).Ks
    fy = 16 / np.tan(0.25)
    for K, fx, cx in zip(Ks, (24 / np.tan(ANGLE / 2), 24 / np.tan(0.35)), (24, 20), strict=True):
        np.testing.assert_allclose(K, [[fx, 0, cx], [0, fy, 16], [0, 0, 1]], rtol=1e-6)
    for value in (0, 3.2, -0.1, "wide", [0.9]):
        edit_json(tmp_path / "transforms_train.json", lambda c: c.update(camera_angle_x=value))
        with pytest.raises(InputError, match="transforms_train.json: .*camera_angle_x must be"):
            Scene.open(tmp_path)


def test_transforms_focal_lengths_agree_with_angles(tmp_path):
    write_transforms(tmp_path, make_scene())
    edit_json(tmp_path / "transforms.json", lambda content: content.update(camera_angle_x=0.3))  # frames have fl_x
    assert Scene.open(tmp_path).n_steps == 4
    edit_json(tmp_path / "transforms.json", lambda content: content["frames"][0].update(camera_angle_x=0.3))
    with pytest.raises(InputError, match=r"fl_x is 5\d.*, but 158.* by camera_angle_x; remove one"):
        Scene.open(tmp_path)


TIMES = {
    "60 fps to milliseconds": ([round(k / 60, 3) for k in range(4)], 60),
    "120 fps to milliseconds": ([round(k / 120, 3) for k in range(4)], 120),
    "whole milliseconds": ([0, 17, 33, 50], 0.06),
    "since 1970": ([1.7e9 + k / 30 for k in range(4)], 30),
    "nanoseconds since 1970": ([1_700_000_000_000_000_000 + 40_000_000 * k for k in range(4)], 25e-9),
}


@pytest.mark.parametrize("kind", TIMES)
def test_transforms_times_as_clocks_write_them(tmp_path, kind):
    write_transforms(tmp_path, make_scene())
    times, rate = TIMES[kind]

    def change(late):
        def edit(content):
            content.pop("fps", None)
            steps = sorted({frame["time"] for frame in content["frames"]})
            for frame in content["frames"]:
                step = steps.index(frame["time"])
                frame["time"] = times[step] + late * (step > 1) * (times[2] - times[1])

        return edit

    edit_json(tmp_path / "transforms.json", change(0))
    assert Scene.open(tmp_path).fps == pytest.approx(rate, rel=0.02)
    edit_json(tmp_path / "transforms.json", change(0.5))
    with pytest.raises(InputError, match="times must be evenly spaced"):
        Scene.open(tmp_path)


def test_transforms_defaults_of_frames_are_bounded(tmp_path):
    write_transforms(tmp_path, make_scene())
    edit_json(tmp_path / "transforms.json", lambda content: content.update({f"key {i}": i for i in range(201)}))
    with pytest.raises(InputError, match="keys beside frames exceed the limit of 200"):
        Scene.open(tmp_path)


def test_transforms_paths_of_windows(tmp_path):
    write_transforms(tmp_path, make_scene())
    expected = Scene.open(tmp_path).images([0, 1], [0])

    def edit(content):
        for frame in content["frames"]:
            frame |= {key: frame[key].replace("/", "\\") for key in ("file_path", "label_path") if key in frame}
            assert "\\" in frame["file_path"]

    edit_json(tmp_path / "transforms.json", edit)
    assert (Scene.open(tmp_path).images([0, 1], [0]) == expected).all()
    edit_json(tmp_path / "transforms.json", lambda content: content["frames"][0].update(file_path="..\\a.png"))
    with pytest.raises(InputError, match="not a file inside the scene folder"):
        Scene.open(tmp_path)


def test_transforms_json_precedes_the_splits(tmp_path):
    made = make_scene(n_steps=1)
    write_synthetic(tmp_path, made, {"train": [(0, 0), (0, 1), (0, 2)]})
    write_transforms(tmp_path, make_scene(n_steps=2))
    assert Scene.open(tmp_path).n_steps == 2


MISSING = {
    "fl_x": r"intrinsics of camera .*frame 1: fl_x, fl_y are missing, or camera_angle_x instead",
    "cx": r"intrinsics of camera .*frame 1: cx is missing",
    "cy": r"intrinsics of camera .*frame 1: cy is missing",
    "transform_matrix": r"transform_matrix of camera .*frame 1 is missing",
    "time": r"has no time, but other frames have",
    "file_path": r"file_path must be a string; got 'None'",
}


@pytest.mark.parametrize("key", MISSING)
@pytest.mark.parametrize("how", ["removed", "null"])
def test_transforms_missing_keys_are_named(tmp_path, key, how):
    write_transforms(tmp_path, make_scene())

    def edit(content):
        for frame in content["frames"]:
            if frame["file_path"].endswith("00002.png"):
                frame.pop(key) if how == "removed" else frame.update({key: None})
                key == "fl_x" and frame.pop("fl_y")

    edit_json(tmp_path / "transforms.json", edit)
    message = "time of frames contains null" if (key, how) == ("time", "null") else MISSING[key]
    with pytest.raises(InputError, match="transforms.json: .*" + message) as error:
        Scene.open(tmp_path)
    assert "not finite" not in str(error.value)


@pytest.mark.parametrize("value", [True, "1.0", [[1, 0, 0, "x"]] * 4, [[True] * 4] * 4, [[None] * 4] * 4, {"a": 1}])
def test_transforms_wrong_types_are_named(tmp_path, value):
    write_transforms(tmp_path, make_scene())
    edit_json(tmp_path / "transforms.json", lambda content: content["frames"][0].update(transform_matrix=value))
    with pytest.raises(InputError, match="transform_matrix of camera .* (must be numbers|contains null)"):
        Scene.open(tmp_path)


def test_transforms_frames_of_one_camera_need_times(tmp_path):
    write_transforms(tmp_path, make_scene())

    def edit(content):
        for frame in content["frames"]:
            frame.pop("time")
            frame["camera"] = frame["file_path"].split("/")[1]

    edit_json(tmp_path / "transforms.json", edit)
    with pytest.raises(InputError, match="12 frames of 3 cameras have no time"):
        Scene.open(tmp_path)


def test_transforms_name_files_of_other_formats(tmp_path):
    write_transforms(tmp_path, make_scene(n_steps=1))
    for file in list(tmp_path.glob("images/*/*.png")):
        file.rename(file.with_suffix(".bmp"))
    edit_json(
        tmp_path / "transforms.json",
        lambda content: [f.update(file_path=f["file_path"].replace(".png", ".bmp")) for f in content["frames"]],
    )
    (tmp_path / "images/cam_0/frame_00001.bmp").write_bytes(b"BM" + bytes(100))
    with pytest.raises(InputError, match=r"frame_00001.bmp \(.*no PNG, JPEG, WebP or TIFF"):
        Scene.open(tmp_path).images([0], [0])


def test_transforms_cameras_are_no_objects(tmp_path):
    write_transforms(tmp_path, make_scene(n_steps=1))
    edit_json(tmp_path / "transforms.json", lambda content: content.update(camera={"k1": 0.1}))
    with pytest.raises(InputError, match="camera must not be an object"):
        Scene.open(tmp_path)


@pytest.mark.parametrize("text", [
    rb'{"frames": [{"file_path": "\xff.png"}]}', rb'{"frames": [{"file_path": "a\ud800.png"}]}',
    rb'{"frames": [], "na\udc80me": 1}', b'{"frames": [{"file_path": "\xed\xa0\x80.png"}]}',
])  # fmt: skip
def test_transforms_unusable_paths_are_refused(tmp_path, text):
    """Bytes that are no UTF-8, and halves of surrogate pairs, which can neither be printed nor opened."""
    for name in ("transforms.json", "cameras.json", "metadata.json"):
        folder = tmp_path / name[:5]
        folder.mkdir()
        (folder / name).write_bytes(text)
        with pytest.raises(InputError, match=f"{name} cannot be read: ") as error:
            Scene.open(folder)
        str(error.value).encode()


def test_transforms_paths_may_be_unicode(tmp_path):
    write_transforms(tmp_path, make_scene(n_steps=1))
    edit_json(
        tmp_path / "transforms.json",
        lambda content: [frame.update(camera=frame["file_path"] + "\U0001f3a5é") for frame in content["frames"]],
    )
    assert Scene.open(tmp_path).camera_names[0].endswith("\U0001f3a5é")


def test_transforms_utm_coordinates_keep_their_digits(tmp_path):
    made = make_scene()
    write_transforms(tmp_path, made)
    where = np.array([500000.0, 4649776.0, 100.0])

    def move(content):
        content.pop("bounds"), content.pop("origin")
        for frame in content["frames"]:
            matrix = np.array(frame["transform_matrix"])
            matrix[:3, 3] += where
            frame["transform_matrix"] = matrix.tolist()

    edit_json(tmp_path / "transforms.json", move)
    scene = Scene.open(tmp_path)
    viewmats, point = scene.recording.viewmats, np.array([0.3, 0.2, 0.1])
    assert viewmats.dtype == np.float64
    for found, wanted in zip(viewmats[0], made.viewmats[0], strict=True):
        seen = found[:3, :3] @ (point + where - scene.world_offset) + found[:3, 3]
        np.testing.assert_allclose(seen, wanted[:3, :3] @ point + wanted[:3, 3], atol=1e-8)


def test_transforms_masks_and_labels_may_mix(tmp_path):
    """A frame without a mask is named, whether its image has alpha or not."""
    write_transforms(tmp_path, make_scene())
    edit_json(tmp_path / "transforms.json", lambda content: content["frames"][-1].pop("label_path"))
    file = tmp_path / "images/cam_0/frame_00001.png"
    cv2.imwrite(str(file), cv2.cvtColor(cv2.imread(str(file)), cv2.COLOR_BGR2BGRA))
    with pytest.raises(InputError, match="frame 0 has no mask_path"):
        Scene.open(tmp_path).segmentation([0], [0])
