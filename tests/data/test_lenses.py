"""Lenses by every published key, at the top and in single frames: undistorted on reading, or refused by name."""

import json

import cv2
import numpy as np
import pytest

from gsim3d.data import Scene
from gsim3d.data.lenses import Lens, Undistorter, lens_of
from gsim3d.data.recording import Problems
from gsim3d.errors import InputError
from tests.data.made_scenes import WRITERS, edit_json, make_scene, write_transforms, write_videos

FISHEYE = {"k1": 0.03, "k2": 0.005, "k3": 0.0007, "k4": 0.0001}
RATIONAL = {"k1": 0.2, "k2": 0.05, "p1": 0.002, "p2": -0.004, "k3": 0.01, "k4": 0.1, "k5": 0.02, "k6": 0.003}
K = np.array([[90.0, 3.0, 101.5], [0, 95.0, 76.0], [0, 0, 1]])


def in_lens(ray: np.ndarray, lens: Lens) -> np.ndarray:
    """The pixel that sees a ray, by OpenCV's forward models."""
    if lens.fisheye:
        position = cv2.fisheye.distortPoints((ray[:2] / ray[2])[None, None], np.eye(3), lens.coefficients)[0, 0]
    else:
        position = cv2.projectPoints(ray[None], np.zeros(3), np.zeros(3), np.eye(3), lens.coefficients)[0].ravel()
    return K[:2, :2] @ position + K[:2, 2]


@pytest.mark.parametrize("model, keys", [
    ("OPENCV_FISHEYE", FISHEYE), ("OPENCV", RATIONAL), ("FULL_OPENCV", RATIONAL),
    ("SIMPLE_RADIAL_FISHEYE", {"k1": -0.05}), ("RADIAL", {"k1": 0.1, "k2": 0.02}),
])  # fmt: skip
def test_undistorter_samples_the_distorted_rays(model, keys):
    lens = lens_of({"camera_model": model, **keys}, "", Problems())
    y, x = np.mgrid[:160, :200].astype(np.float32)
    undistorter = Undistorter(lens, (200, 160))
    taken, valid = undistorter(np.stack([x, y], -1), K), undistorter.valid(K)
    seen = 0
    for column, row in ((20, 15), (101, 76), (180, 30), (60, 140), (150, 100), (199, 159)):
        position = in_lens(np.linalg.inv(K) @ [column + 0.5, row + 0.5, 1], lens)
        inside = ((position >= 0.5) & (position <= [199.5, 159.5])).all()
        assert inside == valid[row, column]
        if inside:
            assert np.abs(taken[row, column] + 0.5 - position).max() < 0.04
            seen += np.abs(position - [column + 0.5, row + 0.5]).max() > 0.3
    assert seen >= 2


def opened(folder, top, frame=None) -> Scene:
    write_transforms(folder, make_scene())

    def edit(content):
        content.pop("camera_model")
        content |= top
        for entry in content["frames"]:
            entry |= frame or {}

    edit_json(folder / "transforms.json", edit)
    return Scene.open(folder)


KEYS = {
    "fisheye": ({"camera_model": "OPENCV_FISHEYE", **FISHEYE}, Lens(np.array([*FISHEYE.values()]), True)),
    "is_fisheye": ({"is_fisheye": True, **FISHEYE}, Lens(np.array([*FISHEYE.values()]), True)),
    "an equidistant fisheye": ({"camera_model": "OPENCV_FISHEYE"}, Lens(np.zeros(4), True)),
    "rational": (RATIONAL, Lens(np.array([RATIONAL[k] for k in ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")]))),
    "k4 alone": ({"camera_model": "OPENCV", "k4": 0.3}, Lens(np.array([0, 0, 0, 0, 0, 0.3, 0, 0]))),
    "Brown": ({"k1": 0.1, "p2": 0.01, "is_fisheye": False}, Lens(np.array([0.1, 0, 0, 0.01, 0]))),
    "simple": ({"camera_model": "SIMPLE_RADIAL", "k1": 0.1, "k2": 0}, Lens(np.array([0.1, 0, 0, 0, 0]))),
    "a list": ({"distortion_params": [0.1, 0.2, 0.3, 0, 0.01, 0.02]}, Lens(np.array([0.1, 0.2, 0.01, 0.02, 0.3]))),
    "pinhole": ({"camera_model": "PINHOLE", "k1": 0, "p1": 0.0}, None),
}


@pytest.mark.parametrize("kind", KEYS)
@pytest.mark.parametrize("where", ["top", "frames", "both"])
def test_lens_of_uses_every_published_key(tmp_path, kind, where):
    keys, wanted = KEYS[kind]
    if where == "both":  # what frames say wins
        wrong = {key: 0.77 if isinstance(value, float) else value for key, value in keys.items()}
        scene = opened(tmp_path, wrong, keys)
    else:
        scene = opened(tmp_path, *((keys,) if where == "top" else ({}, keys)))
    assert all(lens == wanted for lens in scene.recording.distortions)
    valid = scene.valid(range(3), [0])
    assert (valid is None) == (wanted is None)


REFUSED = [
    ({"camera_model": "EQUIRECTANGULAR"}, "camera_model 'EQUIRECTANGULAR' is not supported"),
    ({"camera_model": "THIN_PRISM_FISHEYE", "k1": 0.1}, "camera_model 'THIN_PRISM_FISHEYE' is not supported"),
    ({"camera_model": "OMNIDIRECTIONALSTEREO_L"}, "OMNIDIRECTIONALSTEREO_L"),
    ({"camera_model": 3}, "camera_model 3"),
    ({"camera_model": "OPENCV_FISHEYE", "k5": 0.1}, "OPENCV_FISHEYE has no k5"),
    ({"camera_model": "OPENCV_FISHEYE", "p1": 0.1}, "OPENCV_FISHEYE has no p1"),
    ({"camera_model": "PINHOLE", "k1": 0.1}, "PINHOLE has no k1"),
    ({"camera_model": "SIMPLE_RADIAL", "k2": 0.1}, "SIMPLE_RADIAL has no k2"),
    ({"camera_model": "OPENCV", "is_fisheye": True}, "is_fisheye"),
    ({"is_fisheye": "yes"}, "is_fisheye must be true or false"),
    ({"ftheta_p1": 0.4}, "ftheta_p1"),
    ({"rolling_shutter": [0, 0, 0.1, 0]}, "rolling_shutter"),
    ({"latlong": True}, "latlong"),
    ({"distortion": [0.1, 0, 0, 0]}, "the lens key distortion is not supported; use k1"),
    ({"dist_coeffs": [0.1]}, "the lens key dist_coeffs"),
    ({"radial_distortion": [0, 0.1]}, "the lens key radial_distortion"),
    ({"k1": None}, "k1 contains null"),
    ({"k2": "0.1"}, "k2 must be numbers"),
    ({"distortion_params": [0.1]}, "distortion_params"),
    ({"distortion_params": [0.1, 0, 0, 0.3, 0, 0]}, "k4 in distortion_params"),
    ({"k7": 0.1}, "the lens key k7"),
    ({"camera_type": "ORTHO"}, "camera_type"),
    ({"orthographic": True}, "orthographic"),
    ({"ortho_scale": 2.5}, "ortho_scale"),
    ({"sensors": [{"name": "a"}, {"k1": 0.1}]}, "sensors.k1"),
]


@pytest.mark.parametrize("keys, message", REFUSED)
@pytest.mark.parametrize("where", ["top", "frames"])
def test_lens_of_refuses_other_lenses_by_name(tmp_path, keys, message, where):
    with pytest.raises(InputError, match="transforms.json: camera .*frame 0.*" + message):
        opened(tmp_path, *((keys,) if where == "top" else ({}, keys)))


def test_lens_of_ignores_zero_keys_of_other_lenses(tmp_path):
    keys = {"rolling_shutter": [0, 0, 0, 0], "latlong": False, "s1": 0, "lens": "50 mm"}
    assert opened(tmp_path, keys).valid([0], [0]) is None


def test_undistorter_keeps_values_of_masks(tmp_path):
    scene = opened(tmp_path, {"camera_model": "OPENCV_FISHEYE", **FISHEYE})
    labels = scene.segmentation(range(3), range(4))
    assert set(labels.unique().tolist()) == {0, 1, 3} and not labels[~scene.valid(range(3), range(4))].any()


def test_fisheye_scene_equals_pinhole_scene(tmp_path):
    """Each image is drawn as the fisheye sees it; undistorted, it is the one of the pinhole."""
    made = make_scene(width=96, height=64)
    write_transforms(tmp_path, made)
    lens = Lens(np.array([-0.3, 0.05, 0.0, 0.0]), True)
    height, width = made.labels.shape[2:]
    grid = np.stack(np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5), -1).reshape(-1, 1, 2)
    for step, cam in np.ndindex(made.labels.shape[:2]):
        position = cv2.fisheye.undistortPoints(grid, made.Ks[step, cam], lens.coefficients, P=made.Ks[step, cam])
        x, y = (position.reshape(height, width, 2) - 0.5).astype(np.float32).transpose(2, 0, 1)
        for kind, image, how in (("images", made.rgb, cv2.INTER_LINEAR), ("labels", made.labels, cv2.INTER_NEAREST)):
            seen = cv2.remap(image[step, cam], x, y, how)
            file = tmp_path / kind / f"cam_{cam}" / f"frame_{step + 1:05d}.png"
            cv2.imwrite(str(file), seen[..., ::-1] if seen.ndim == 3 else seen)
    keys = {"camera_model": "OPENCV_FISHEYE", "k1": -0.3, "k2": 0.05}
    edit_json(tmp_path / "transforms.json", lambda content: content.update(keys))
    scene = Scene.open(tmp_path)
    valid, labels = scene.valid(range(3), range(4)).numpy(), scene.segmentation(range(3), range(4)).numpy()
    assert valid.mean() > 0.9 and (labels != made.labels)[valid].mean() < 0.02
    error = np.abs(scene.recorded_images(range(3), range(4)).permute(0, 1, 3, 4, 2).numpy().astype(float) - made.rgb)
    stored = cv2.imread(str(tmp_path / "images/cam_0/frame_00001.png"))[..., ::-1].astype(float)
    assert 3 * error[valid].mean() < np.abs(stored - made.rgb[0, 0]).mean()


@pytest.mark.parametrize("lens", [Lens(np.array([-0.6, 0, 0, 0, 0])), Lens(np.array([-0.5, 0, 0, 0]), True)])
def test_undistorter_marks_folded_rays_as_not_recorded(lens):
    """Beyond that radius it would show again, mirrored, what lies farther inside."""
    undistorter = Undistorter(lens, (200, 160))
    wide = K * [[0.4, 0, 1], [0, 0.4, 1], [0, 0, 1]]  # without the skew
    valid = undistorter.valid(wide)
    x, y = undistorter._sources(wide)
    for values in (x[76, 101:][valid[76, 101:]], y[76:, 101][valid[76:, 101]]):
        assert (np.diff(values) > 0).all() and 3 < len(values) < 50
    assert not undistorter(np.full((160, 200), 255, np.uint8), wide)[~valid].any() and not valid[0, 0]


def test_videos_layout_lens_keys(tmp_path):
    folder = write_videos(tmp_path, make_scene())

    def lens(**keys):
        edit_json(folder / "cameras.json", lambda content: [camera.update(keys) for camera in content["cameras"]])
        try:
            return Scene.open(folder).recording.distortions[0]
        finally:
            edit_json(
                folder / "cameras.json",
                lambda content: [camera.pop(key) for camera in content["cameras"] for key in keys],
            )

    four = [*FISHEYE.values()]
    assert lens(camera_model="OPENCV_FISHEYE", distortion=four) == Lens(np.array(four), True)
    assert lens(is_fisheye=True, **FISHEYE) == Lens(np.array(four), True)
    assert lens(distortion=four) == Lens(np.array([0.03, 0.005, 0.0007, 0.0001, 0]))
    assert lens(k1=0.1) == Lens(np.array([0.1, 0, 0, 0, 0])) and lens(distortion=[0.0] * 5) is None
    for keys, message in (({"camera_model": "EQUIRECTANGULAR"}, "EQUIRECTANGULAR"), ({"xi": 0.4}, "xi"),
                          ({"distCoeffs": [0.1]}, "distCoeffs"), ({"D": [0.1]}, "lens key D"),
                          ({"is_fisheye": True, "distortion": [0.1] * 5}, "distortion of a fisheye"),
                          ({"distortion": four, "k1": 0.3}, "k1 is given twice")):  # fmt: skip
        with pytest.raises(InputError, match="cameras.json: camera cam_0.*" + message):
            lens(**keys)


def test_changing_lens_is_refused(tmp_path):
    write_transforms(tmp_path, make_scene())
    content = json.loads((tmp_path / "transforms.json").read_text())
    content["frames"][4]["camera_model"] = "OPENCV_FISHEYE"
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    with pytest.raises(InputError, match="the lens .* must be the same in all frames"):
        Scene.open(tmp_path)


OTHER_NAMES = [
    {"K1": 0.1}, {"radialDistortion": [0.1]}, {"projection_type": "fisheye"}, {"lens-model": "Equidistant"},
    {"fisheye": True}, {"distortion_model": {"k1": 0.3}}, {"dist": "0.1 0 0 0"}, {"intrinsics_extra": {"k1": 0.3}},
    {"lens_mode": "ftheta"}, {"fisheye_crop_radius": 9.5}, {"distortion_params": [0.1] + [0] * 5, "k1": 0},
]  # fmt: skip


@pytest.mark.parametrize("layout", ["transforms", "videos", "genesis", "kubric"])
def test_no_layout_ignores_lens_keys(tmp_path, layout):
    folder = WRITERS[layout](tmp_path / "scene", make_scene())
    name = {"transforms": "transforms.json", "videos": "cameras.json", "genesis": "metadata.json"}
    file = folder / name.get(layout, "cam_0/metadata.json")
    content = json.loads(file.read_text())
    content.pop("camera_model", None)

    def opened_with(keys, camera):
        changed = json.loads(json.dumps(content))
        places = {"transforms": lambda c: c["frames"], "videos": lambda c: c["cameras"]}
        one = places.get(layout, lambda c: [c.get("camera", c.get("cam_0"))])(changed)
        for entry in one if camera else [changed]:
            entry |= keys
        file.write_text(json.dumps(changed))
        return Scene.open(folder).recording.distortions[0]

    for camera in (False, True):
        for keys in OTHER_NAMES:
            with pytest.raises(InputError, match="the lens key|k1 is 0, but 0.1|did you mean"):
                opened_with(keys, camera)
        assert opened_with({"camera_model": "OPENCV_FISHEYE", **FISHEYE}, camera) == Lens(
            np.array([*FISHEYE.values()]), True
        )
        assert opened_with({"distortion_model": "plumb_bob", "dist": "none", "D": [0.0, 0]}, camera) is None
