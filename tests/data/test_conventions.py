"""Every broken convention is caught, and the message names file, camera and frame."""

import json
import shutil

import cv2
import numpy as np
import pytest

from gsim3d.data import Scene
from gsim3d.data.check import check_scene
from gsim3d.errors import InputError
from tests.data.made_scenes import WRITERS, edit_json, make_scene

FLIP = np.diag([1.0, -1.0, -1.0, 1.0])
FILES = {
    "genesis": "metadata.json",
    "kubric": "metadata.json",
    "transforms": "transforms.json",
    "videos": "cameras.json",
}


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    """The same moving scene in every layout, without bounds: they would be one more witness."""
    root = tmp_path_factory.mktemp("scenes")
    for layout in FILES:
        WRITERS[layout](root / layout, make_scene(moving=True))
        for file in (root / layout).rglob("*.json"):
            edit_json(file, lambda content: content.pop("bounds"))
    return root


@pytest.fixture
def copy(folders, tmp_path):
    def make(layout):
        return shutil.copytree(folders / layout, tmp_path / layout)

    return make


def message_of(folder) -> str:
    """The one line with which a broken scene is refused, on opening it or on reading it."""
    with pytest.raises(InputError) as error:
        scene = Scene.open(folder)
        for cam in range(scene.n_cams):
            scene.images([cam], range(scene.n_steps))
            scene.segmentation([cam], range(scene.n_steps))
    assert check_scene(folder).problems
    return str(error.value)


def edit_poses(layout, folder, change, cams=range(3), steps=range(4)):
    """Replaces the pose of some cameras at some steps, as the layout stores it (rotation 3x3 and translation)."""

    def matrices(stored):
        for step in steps:
            stored[step] = change(np.array(stored[step])).tolist()

    for cam in cams:
        if layout == "genesis":
            edit_json(folder / "metadata.json", lambda content: matrices(content[f"cam_{cam}"]["extrinsics"]))
        elif layout == "transforms":
            edit_json(
                folder / "transforms.json",
                lambda content: [
                    frame.update(transform_matrix=change(np.array(frame["transform_matrix"])).tolist())
                    for frame in content["frames"]
                    if f"cam_{cam}/" in frame["file_path"] and int(frame["file_path"][-9:-4]) - 1 in steps
                ],
            )
        else:

            def edit(content):
                camera = content["cameras"][cam]
                for step in steps:
                    full = np.eye(4)
                    full[:3, :3], full[:3, 3] = camera["R"][step], camera["T"][step]
                    full = change(full)
                    camera["R"][step], camera["T"][step] = full[:3, :3].tolist(), full[:3, 3].tolist()

            edit_json(folder / "cameras.json", edit)


STORED_MATRICES = ["genesis", "transforms", "videos"]


def flipped(layout):
    """y and z of the camera's axes flipped: on the left of world-to-camera, on the right of camera-to-world."""
    return (lambda m: m @ FLIP) if layout == "transforms" else (lambda m: FLIP @ m)


@pytest.mark.parametrize("layout", STORED_MATRICES)
def test_check_directions_names_flipped_axes_of_all_cameras(copy, layout):
    folder = copy(layout)
    edit_poses(layout, folder, flipped(layout))
    message = message_of(folder)
    assert FILES[layout] in message and "OpenGL" in message and "do not look at a common point" in message


@pytest.mark.parametrize("layout", STORED_MATRICES)
def test_check_directions_names_one_flipped_camera_and_step(copy, layout):
    folder = copy(layout)
    edit_poses(layout, folder, flipped(layout), cams=[1], steps=[2])
    message = message_of(folder)
    assert FILES[layout] in message and "y and z axes flipped" in message and "frame 2" in message
    assert "cam_1" in message


def test_check_directions_names_flipped_axes_of_kubric(copy):
    """Axes that are OpenCV's already: the quaternion turned by half a turn around x."""
    folder = copy("kubric")

    def edit(content):
        content["camera"]["quaternions"] = [[-x, w, z, -y] for w, x, y, z in content["camera"]["quaternions"]]

    for file in folder.rglob("metadata.json"):
        edit_json(file, edit)
    assert "do not look at a common point" in message_of(folder)


@pytest.mark.parametrize("layout", STORED_MATRICES)
def test_check_directions_names_inverted_matrices(copy, layout):
    folder = copy(layout)
    edit_poses(layout, folder, np.linalg.inv)
    message = message_of(folder)
    assert FILES[layout] in message and "camera-to-world" in message


MATRICES = {
    "left-handed": (np.diag([-1.0, 1, 1, 1]), "left-handed"),
    "sheared": (np.eye(4) + 0.3 * np.eye(4, k=1) * [1, 1, 0, 0], "not orthonormal"),
    "scaled": (np.diag([1.2, 1.2, 1.2, 1]), "not orthonormal"),
    "no number": (np.full((4, 4), np.nan), "not finite"),
}


@pytest.mark.parametrize("what", MATRICES)
@pytest.mark.parametrize("layout", STORED_MATRICES)
def test_check_pose_refuses_what_is_not_rigid(copy, layout, what):
    factor, expected = MATRICES[what]
    folder = copy(layout)
    edit_poses(layout, folder, lambda m: factor @ m, cams=[2], steps=[3])
    message = message_of(folder)
    assert expected in message and FILES[layout] in message and "frame 3" in message
    assert "cam_2" in message


def edit_intrinsics(layout, folder, step, **values):
    """Replaces fx, fy, cx or cy of camera 1, at one step where the layout has them by step."""
    entry_of = {"fx": (0, 0), "fy": (1, 1), "cx": (0, 2), "cy": (1, 2)}
    names = {"fx": "fl_x", "fy": "fl_y", "cx": "cx", "cy": "cy"}

    def put(K, scale=(1.0, 1.0)):
        for name, value in values.items():
            row, column = entry_of[name]
            K[row][column] = value / scale[row]

    if layout == "genesis":
        edit_json(folder / "metadata.json", lambda content: put(content["cam_1"]["intrinsics"]))
    elif layout == "videos":
        edit_json(folder / "cameras.json", lambda content: put(content["cameras"][1]["K"]))
    elif layout == "transforms":
        edit_json(
            folder / "transforms.json",
            lambda content: [
                frame.update({names[key]: value for key, value in values.items()})
                for frame in content["frames"]
                if frame["file_path"] == f"images/cam_1/frame_{step + 1:05d}.png"
            ],
        )
    else:
        signed = {key: -value if key != "fx" else value for key, value in values.items()}
        values = signed
        edit_json(folder / "cam_1" / "metadata.json", lambda content: put(content["camera"]["K"], (48, 32)))


@pytest.mark.parametrize("layout", FILES)
@pytest.mark.parametrize(
    "values, expected",
    [
        ({"fx": 0.0}, "focal lengths must be positive"),
        ({"fy": -50.0}, "focal lengths must be positive"),
        ({"fx": 1e-30}, "focal lengths must be positive"),
        ({"fx": 1.1, "fy": 1.4, "cx": 0.5, "cy": 0.5}, "in pixels"),
        ({"cx": 60.0}, "principal point"),
        ({"cy": -3.0}, "principal point"),
        ({"fx": float("nan")}, "not finite"),
    ],
)
def test_check_intrinsics_refuses_unusable_values(copy, layout, values, expected):
    folder = copy(layout)
    edit_intrinsics(layout, folder, 2, **values)
    message = message_of(folder)
    assert expected in message and FILES[layout] in message and "cam_1" in message
    assert layout != "transforms" or "frame 2" in message


FRAMES = {
    "genesis": ("cam_1/rgb_0002.png", "cam_1/seg_0002.png"),
    "kubric": ("cam_1/rgba/rgba_2.png", "cam_1/segmentation/segmentation_2.png"),
    "transforms": ("images/cam_1/frame_00003.png", "labels/cam_1/frame_00003.png"),
    "videos": ("cam_1/004.png", "labels/cam_1/004.png"),
}
NUMBER = {"genesis": 2, "kubric": 2, "transforms": 2, "videos": 4}


@pytest.mark.parametrize("layout", FILES)
@pytest.mark.parametrize("kind", [0, 1], ids=["image", "mask"])
@pytest.mark.parametrize("damage", ["missing", "truncated", "empty", "other size", "no image"])
def test_missing_and_broken_files_are_named(copy, layout, kind, damage):
    folder = copy(layout)
    file = folder / FRAMES[layout][kind]
    data = file.read_bytes()
    if damage == "missing":
        file.unlink()
    elif damage == "other size":
        assert cv2.imwrite(str(file), np.zeros((32, 40), np.uint8))
    else:
        file.write_bytes({"truncated": data[: len(data) // 2], "empty": b"", "no image": b"GIF89a" + data}[damage])
    message = message_of(folder)
    assert "cam_1" in message and str(NUMBER[layout]) in message
    if damage == "missing":
        assert "missing" in message
    else:
        expected = "40x32 pixels" if damage == "other size" else "cannot be decoded"
        assert expected in message and str(file) in message


def test_camera_with_fewer_frames_is_named(copy):
    for layout, last in (("kubric", "cam_2/rgba/rgba_3.png"), ("videos", "cam_2/006.png")):
        folder = copy(layout)
        (folder / last).unlink()
        message = message_of(folder)
        assert "camera cam_2 has 3 frames" in message and "4; missing: frame" in message
    folder = copy("transforms")
    edit_json(
        folder / "transforms.json",
        lambda content: content.update(
            frames=[f for f in content["frames"] if "cam_2/frame_00004" not in f["file_path"]]
        ),
    )
    message = message_of(folder)
    assert "camera images/cam_2/frame has 3 frames" in message and "4 times" in message and "transforms.json" in message


def test_unevenly_numbered_frames_are_refused(copy):
    folder = copy("videos")
    for cam in range(3):
        (folder / f"cam_{cam}" / "002.png").unlink()
    assert "evenly spaced" in message_of(folder)
    folder = copy("transforms")

    def late(content):
        for frame in content["frames"]:
            frame["time"] += 0.01 if frame["time"] > 7.2 else 0

    edit_json(folder / "transforms.json", late)
    assert "evenly spaced" in message_of(folder)


OUTSIDE = {
    "genesis": lambda content: content.update(file_path_template="../x/cam_{cam_ix}/{img_type}_{n_step:04d}"),
    "transforms": lambda content: content["frames"][0].update(file_path="../../etc/passwd"),
    "videos": lambda content: content["cameras"][0].update(name="../cam_0"),
}


@pytest.mark.parametrize("layout", OUTSIDE)
def test_paths_out_of_the_scene_are_refused(copy, layout):
    folder = copy(layout)
    edit_json(folder / FILES[layout], OUTSIDE[layout])
    message = message_of(folder)
    assert FILES[layout] in message and ("not a file inside the scene" in message or "must be the name" in message)


@pytest.mark.parametrize("layout", FILES)
def test_links_out_of_the_scene_are_refused(copy, tmp_path, layout):
    folder = copy(layout)
    file = folder / FRAMES[layout][0]
    file.rename(tmp_path / "elsewhere.png")
    file.symlink_to(tmp_path / "elsewhere.png")
    assert "not a file inside the scene" in message_of(folder)


def test_camera_that_sees_nothing_of_the_bounds_is_named(copy):
    folder = copy("genesis")
    edit_json(folder / "metadata.json", lambda content: content.update(bounds=[[20, 20, 0], [21, 21, 1]]))
    assert "cam_0 does not see the bounds" in message_of(folder)
    edit_json(folder / "metadata.json", lambda content: content.update(bounds=[[1, 1, 1], [0, 2, 2]]))
    assert "bounds must be [lower corner, upper corner]" in message_of(folder)


@pytest.mark.parametrize("layout", FILES)
def test_distant_origin_is_refused(copy, layout):
    folder = copy(layout)
    for key, value in (("origin", [1e9, 0, 0]), ("origin", [0, 0, -5001]), ("bounds", [[-1e9] * 3, [1e9] * 3])):
        for file in folder.rglob(FILES[layout]):
            edit_json(file, lambda content: content.update({"origin": [0, 0, 0], key: value}))
            key == "bounds" and edit_json(file, lambda content: content.pop("origin"))
        assert f"{key} lies" in message_of(folder)


def test_default_near_and_far_follow_from_cameras(copy):
    folder = copy("videos")
    edit_json(folder / "cameras.json", lambda content: [content.pop("near"), content.pop("far")])
    scene = Scene.open(folder)
    assert 0.3 < scene.near < 1.5 and 4 < scene.far < 8

    def parallel(content):
        for number, camera in enumerate(content["cameras"]):
            camera["R"], camera["T"] = np.eye(3).tolist(), [0.1 * number, 0, 0]

    edit_json(folder / "cameras.json", parallel)
    assert "near and far" in message_of(folder)


def test_check_scene_collects_all_problems(copy):
    folder = copy("genesis")
    (folder / "cam_0/rgb_0001.png").unlink()
    (folder / "cam_2/seg_0003.png").write_bytes(b"")
    edit_intrinsics("genesis", folder, 0, fx=-1.0)
    edit_poses("genesis", folder, lambda m: np.diag([-1.0, 1, 1, 1]) @ m, cams=[2])
    problems = check_scene(folder).problems
    assert len(problems) == 4
    for words in (
        ("cam_1", "focal"),
        ("cam_2", "left-handed"),
        ("rgb_0001.png", "missing"),
        ("seg_0003.png", "decoded"),
    ):
        assert any(all(word in problem for word in words) for problem in problems), words


def test_check_scene_of_sound_scenes_is_empty(folders):
    for layout in FILES:
        check = check_scene(folders / layout)
        assert check.problems == () and check.scene.layout == layout


def test_check_scene_reports_masks_without_moving_body(copy):
    folder = copy("genesis")
    for file in folder.rglob("seg_*.png"):
        cv2.imwrite(str(file), np.minimum(cv2.imread(str(file), cv2.IMREAD_UNCHANGED), 1))
    (problem,) = check_scene(folder).problems
    assert "no label image has a pixel of value 3" in problem and "[0, 1]" in problem


@pytest.mark.parametrize("text", ["", "{", "[1]", "\0", '{"cameras": 3}', '{"frames": [1]}', "{}"])
@pytest.mark.parametrize("name", ["transforms.json", "cameras.json", "cam_0/metadata.json"])
def test_unreadable_descriptions_are_refused(tmp_path, name, text):
    (tmp_path / name).parent.mkdir(exist_ok=True)
    (tmp_path / name).write_text(text)
    with pytest.raises(InputError):
        Scene.open(tmp_path)
    assert check_scene(tmp_path).scene is None and len(check_scene(tmp_path).problems) >= 1


def test_image_sizes_are_checked_before_allocation(tmp_path):
    """A PNG whose header tells of 60000 x 60000 pixels is refused by its header."""
    import struct
    import zlib

    folder = WRITERS["genesis"](tmp_path / "scene", make_scene())
    head = b"IHDR" + struct.pack(">IIBBBBB", 60000, 60000, 8, 2, 0, 0, 0)
    chunk = struct.pack(">I", 13) + head + struct.pack(">I", zlib.crc32(head))
    (folder / "cam_0/rgb_0000.png").write_bytes(b"\x89PNG\r\n\x1a\n" + chunk + b"\0\0\0\0IEND\xaeB`\x82")
    assert "60000x60000 pixels" in message_of(folder)
    metadata = json.loads((folder / "metadata.json").read_text())
    metadata |= {"n_steps": 999_999}
    (folder / "metadata.json").write_text(json.dumps(metadata))
    assert Scene.open(folder).n_steps == 999_999
