"""Reading of scene folders: values, conventions, and a named error for every broken thing."""

import json
import os
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import torch

from gsim3d.data import Scene, find_scenes
from gsim3d.data.cameras import frusta_origin
from gsim3d.errors import InputError
from tests.data.scene_folder import camera, write_scene


def test_genesis_images_and_labels_equal_the_files(tmp_path):
    written = write_scene(tmp_path)
    scene = Scene.open(tmp_path)
    images = scene.images([2, 0], [3, 1, 1])
    assert images.shape == (3, 2, 3, 16, 32) and images.dtype == torch.uint8
    np.testing.assert_array_equal(images.permute(0, 1, 3, 4, 2), written["rgb"][[3, 1, 1]][:, [2, 0]])
    labels = scene.segmentation([1], [0])
    assert labels.shape == (1, 1, 16, 32) and labels.dtype == torch.uint8
    np.testing.assert_array_equal(labels[0, 0], written["seg"][0, 1])


def test_genesis_scene_attributes(tmp_path):
    folder = tmp_path / "ball" / "0003"
    write_scene(folder)
    scene = Scene.open(folder)
    assert (scene.n_steps, scene.n_cams, scene.fps, scene.near, scene.far) == (4, 3, 20.0, 1.0, 4.0)
    assert scene.name == "ball/0003" and scene.path == folder and scene.has_segmentation()
    assert scene.origin.dtype == np.float64 and scene.origin.tolist() == [-2.0, -2.0, -0.5]


def test_genesis_default_frame_rate_of_an_own_file_is_noted(tmp_path):
    notes = {"fps": ("metadata.json has no fps; 42 is used, as for the published sets",), "origin": ()}
    for key, expected in notes.items():
        write_scene(tmp_path / key, edits={key: None})
        assert Scene.open(tmp_path / key).recording.notes == expected
    write_scene(tmp_path / "published", edits=dict.fromkeys(("fps", "near", "far")))
    assert Scene.open(tmp_path / "published").recording.notes == ()


@pytest.mark.parametrize(
    "key, meant", [("naer", "near"), ("far_plane", "far"), ("Orgin", "origin"), ("bound", "bounds")]
)
def test_genesis_misspelt_keys_are_refused(tmp_path, key, meant):
    write_scene(tmp_path, edits={key: 1.0})
    with pytest.raises(InputError, match=f"metadata.json: {key} is no key of this file; did you mean {meant}?"):
        Scene.open(tmp_path)


def test_genesis_cameras_equal_the_metadata(tmp_path):
    """Extrinsics are world-to-camera, intrinsics stay in pixels with the full principal point."""
    write_scene(tmp_path)
    cameras = Scene.open(tmp_path).cameras_at(range(3), [0])
    assert len(cameras) == 3 and (cameras.width, cameras.height) == (32, 16)
    for cam in range(3):
        entry = camera(cam, 32, 16)
        np.testing.assert_allclose(cameras.viewmats[cam], entry["extrinsics"], atol=1e-7)
        np.testing.assert_array_equal(cameras.Ks[cam], entry["intrinsics"])
    assert cameras.near.tolist() == [1.0] * 3 and cameras.far.tolist() == [4.0] * 3
    assert cameras.image_cloud.tolist() == [0, 0, 0]


def test_default_origin_is_lower_corner_of_the_frusta(tmp_path):
    write_scene(tmp_path, edits={"origin": None})
    scene = Scene.open(tmp_path)
    rng = np.random.default_rng(0)
    points = []
    for cam in range(3):
        entry = camera(cam, 32, 16)
        pixel = np.stack([rng.uniform(0, 32, 500), rng.uniform(0, 16, 500), np.ones(500)])
        local = np.linalg.inv(entry["intrinsics"]) @ pixel * rng.uniform(1, 4, 500)
        rotation, shift = np.array(entry["extrinsics"])[:3, :3], np.array(entry["extrinsics"])[:3, 3:]
        points.append((rotation.T @ (local - shift)).T)
    lowest = np.concatenate(points).min(0)
    assert (scene.origin <= lowest).all() and (scene.origin > lowest - 0.5).all()
    moved = np.array([camera(cam, 32, 16)["extrinsics"] for cam in range(3)])
    shift = np.array([1.5, -2.0, 0.25])
    moved[:, :3, 3] -= moved[:, :3, :3] @ shift
    Ks = np.array([camera(cam, 32, 16)["intrinsics"] for cam in range(3)])
    np.testing.assert_allclose(frusta_origin(moved, Ks, [(32, 16)] * 3, 1.0, 4.0), scene.origin + shift, atol=1e-12)


def test_genesis_metadata_without_extras_is_read(tmp_path):
    write_scene(tmp_path, edits=dict.fromkeys(["fps", "near", "far", "origin"]))
    scene = Scene.open(tmp_path)
    assert (scene.fps, scene.near, scene.far) == (42.0, 1.0, 8.0)


def test_genesis_labels_and_colours_are_not_shifted(tmp_path):
    written = write_scene(tmp_path, n_steps=1, n_cams=1)
    import cv2

    cv2.imwrite(str(tmp_path / "seg/cam_0/0000.png"), np.maximum(written["seg"][0, 0], 1))
    cv2.imwrite(str(tmp_path / "rgb/cam_0/0000.png"), np.full((16, 32, 3), 7, dtype=np.uint8))
    scene = Scene.open(tmp_path)
    assert scene.segmentation([0], [0]).min() == 1
    assert (scene.images([0], [0]) == 7).all()


def test_image_cache_files_equal_decoded_images(tmp_path):
    written = write_scene(tmp_path / "scene")
    cache = tmp_path / "cache"
    for _ in range(2):
        scene = Scene.open(tmp_path / "scene", cache_dir=cache)
        np.testing.assert_array_equal(scene.images([1], [2])[0, 0].permute(1, 2, 0), written["rgb"][2, 1])
        np.testing.assert_array_equal(scene.segmentation([1], [2])[0, 0], written["seg"][2, 1])
        assert len(os.listdir(cache)) == 2
    (tmp_path / "scene/rgb/cam_0/0000.png").unlink()
    metadata = tmp_path / "scene" / "metadata.json"
    os.utime(metadata, ns=(1, 1))
    with pytest.raises(InputError, match="missing"):
        Scene.open(tmp_path / "scene", cache_dir=cache).images([1], [2])
    assert len(os.listdir(cache)) == 2


def test_image_cache_names_foreign_and_truncated_files(tmp_path):
    write_scene(tmp_path / "scene")
    Scene.open(tmp_path / "scene", cache_dir=tmp_path / "cache").images([0], [0])
    (file,) = (tmp_path / "cache").iterdir()
    whole = file.read_bytes()
    for spoiled in (whole[:-1], b"", whole.replace(b"|u1", b"<f2"), whole[:6] + b"\x07" + whole[7:]):
        file.write_bytes(spoiled)
        with pytest.raises(InputError, match=f"{file.name} is not a cache of this scene"):
            Scene.open(tmp_path / "scene", cache_dir=tmp_path / "cache").images([0], [0])
    file.write_bytes(whole)
    scene = Scene.open(tmp_path / "scene", cache_dir=tmp_path / "cache")
    scene.images([0], [0])
    os.truncate(file, len(whole) - 1)
    with pytest.raises(InputError, match="shorter"):
        scene.images([-1 + scene.n_cams], [scene.n_steps - 1])


@pytest.mark.parametrize("cached", [True, False])
def test_image_cache_leaves_no_file_open(tmp_path, cached):
    write_scene(tmp_path / "scene", n_steps=6, n_cams=5)
    expected = Scene.open(tmp_path / "scene").images(range(5), range(6))
    scenes = [Scene.open(tmp_path / "scene", cache_dir=tmp_path / "cache" if cached else None) for _ in range(30)]
    before = len(os.listdir("/proc/self/fd"))
    with ThreadPoolExecutor(4) as pool:
        stacks = list(pool.map(lambda scene: scene.images(range(5), range(6)), [*scenes, *scenes]))
    assert len(os.listdir("/proc/self/fd")) <= before
    assert all(torch.equal(stack, expected) for stack in stacks)


def test_image_cache_decodes_once(tmp_path):
    write_scene(tmp_path)
    scene = Scene.open(tmp_path)
    first = scene.images([0], [0])
    (tmp_path / "rgb/cam_0/0000.png").unlink()
    assert torch.equal(scene.images([0], [0]), first)
    first.zero_()
    assert scene.images([0], [0]).any()


def test_find_scenes_sorts_naturally_and_skips_hidden_folders(tmp_path):
    names = ["ball/2", "ball/10", "box/0001", "cow9/0", "cow10/0"]
    for name in [*reversed(names), "ball/.3.unfinished"]:
        write_scene(tmp_path / name, n_steps=1, n_cams=1)
    assert [p.relative_to(tmp_path).as_posix() for p in find_scenes(tmp_path)] == names
    assert find_scenes(tmp_path / "ball" / "2") == [tmp_path / "ball" / "2"]


def test_find_scenes_errors(tmp_path):
    with pytest.raises(InputError, match="not a folder"):
        find_scenes(tmp_path / "absent")
    with pytest.raises(InputError, match="no scene"):
        find_scenes(tmp_path)


def edited_camera(key, value, cam=0):
    return {f"cam_{cam}": {**camera(cam, 32, 16), key: value}}


NAN_MATRIX = [[float("nan")] * 4] * 4
SHEAR = [[1, 1, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
MIRROR = [[-1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]


@pytest.mark.parametrize(
    "changes, message",
    [
        ({"n_steps": None}, "n_steps"),
        ({"n_steps": 0}, "n_steps"),
        ({"n_steps": True}, "n_steps"),
        ({"n_steps": 10**12}, "n_steps"),
        ({"n_cams": "3"}, "n_cams"),
        ({"n_cams": 4}, "cam_3 is missing"),
        ({"fps": -1.0}, "fps"),
        ({"near": float("inf")}, "near"),
        ({"near": 5.0}, "far must lie beyond near"),
        ({"origin": [0, 0]}, "origin"),
        ({"origin": [0, 0, "a"]}, "origin"),
        ({"file_path_template": None}, "file_path_template"),
        ({"file_path_template": "{img_type}/{cam_ix}"}, "file_path_template"),
        ({"file_path_template": "{img_type}/{cam_ix}/{n_step}/{other}"}, "other"),
        ({"file_path_template": "{img_type.__class__}{cam_ix}{n_step}"}, "file_path_template"),
        ({"file_path_template": "{img_type}/{cam_ix}/{n_step"}, "not a format string"),
        ({"file_path_template": "{img_type}/{cam_ix}/{n_step:999999999d}"}, "n_step:04d"),
        ({"file_path_template": "{img_type!r}/{cam_ix}/{n_step}"}, "n_step:04d"),
        (edited_camera("extrinsics", [[1, 2], [3]]), "cam_0.extrinsics"),
        (edited_camera("extrinsics", NAN_MATRIX), "not finite"),
        (edited_camera("extrinsics", SHEAR, cam=1), "cam_1.extrinsics must be a rigid transform"),
        (edited_camera("extrinsics", MIRROR), "rigid transform"),
        (edited_camera("extrinsics", None), "cam_0.extrinsics"),
        (edited_camera("intrinsics", [[0, 0, 5], [0, 30, 4], [0, 0, 1]]), "focal lengths"),
        (edited_camera("resolution", [32, 16.5]), "cam_0.resolution"),
        (edited_camera("resolution", [10**9, 16]), "cam_0.resolution"),
        ({"cam_1": 3}, "cam_1 is missing"),
    ],
)
def test_genesis_broken_metadata_is_named(tmp_path, changes, message):
    write_scene(tmp_path, edits=changes)
    with pytest.raises(InputError, match=message) as error:
        Scene.open(tmp_path)
    assert "metadata.json" in str(error.value)


@pytest.mark.parametrize("text", ["", "{", "[1]", "\0"])
def test_genesis_metadata_must_be_a_json_object(tmp_path, text):
    (tmp_path / "metadata.json").write_text(text)
    with pytest.raises(InputError, match="metadata.json"):
        Scene.open(tmp_path)


def test_genesis_missing_metadata_is_named(tmp_path):
    with pytest.raises(InputError, match="not a scene folder"):
        Scene.open(tmp_path)


@pytest.mark.parametrize(
    "template",
    ["../{img_type}_{cam_ix}_{n_step}", "/etc/{img_type}_{cam_ix}_{n_step}", "a/../../{img_type}/{cam_ix}/{n_step}"],
)
def test_genesis_template_out_of_the_scene_is_refused(tmp_path, template):
    write_scene(tmp_path / "scene", edits={"file_path_template": template})
    with pytest.raises(InputError, match="not a file inside the scene"):
        Scene.open(tmp_path / "scene").images([0], [0])


def test_genesis_link_out_of_the_scene_is_refused(tmp_path):
    write_scene(tmp_path / "scene")
    write_scene(tmp_path / "other")
    link = tmp_path / "scene/rgb/cam_0/0000.png"
    link.unlink()
    link.symlink_to(tmp_path / "other/rgb/cam_0/0000.png")
    with pytest.raises(InputError, match="not a file inside the scene"):
        Scene.open(tmp_path / "scene").images([0], [0])


def test_genesis_broken_images_are_named(tmp_path):
    import cv2

    write_scene(tmp_path, n_cams=1)
    files = [tmp_path / f"rgb/cam_0/000{step}.png" for step in range(4)]
    files[0].unlink()
    files[1].write_bytes(b"")
    files[2].write_bytes(files[3].read_bytes()[:40])
    cv2.imwrite(str(files[3]), np.zeros((32, 16, 3), dtype=np.uint8))
    scene = Scene.open(tmp_path)
    for step, message in enumerate(["is missing", "cannot be decoded", "cannot be decoded", "16x32 pixels"]):
        with pytest.raises(InputError, match=message) as error:
            scene.images([0], [step])
        assert str(files[step]) in str(error.value)
    cv2.imwrite(str(tmp_path / "seg/cam_0/0000.png"), np.eye(32)[:16, :, None] * [255, 0, 0])
    with pytest.raises(InputError, match="single-channel"):
        scene.segmentation([0], [0])
    cv2.imwrite(str(tmp_path / "deep.tif"), np.zeros((16, 32), dtype=np.float32))
    (tmp_path / "deep.tif").replace(files[0])
    with pytest.raises(InputError, match="8 or 16 bits"):
        scene.images([0], [0])


def test_scene_refuses_numbers_out_of_range(tmp_path):
    write_scene(tmp_path)
    scene = Scene.open(tmp_path)
    with pytest.raises(InputError, match="camera 3 does not exist"):
        scene.images([3], [0])
    with pytest.raises(InputError, match="step -1 does not exist"):
        scene.segmentation([0], [-1])


def test_genesis_metadata_round_trips_through_json(tmp_path):
    metadata = write_scene(tmp_path)["metadata"]
    assert json.loads((tmp_path / "metadata.json").read_text()) == metadata
