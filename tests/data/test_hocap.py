"""Reader of HO-Cap: cameras, labels and hand joints of both layout versions; the rig check; damaged files."""

import dataclasses
import json
import zipfile
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
import yaml

from gsim3d import Simulator
from gsim3d.cli.main import main
from gsim3d.data import Fitting, Scene, find_scenes, make_frames
from gsim3d.data.cameras import project
from gsim3d.data.check import check_scene, contact_sheet
from gsim3d.effects.spec import EffectsSpec
from gsim3d.errors import InputError
from gsim3d.evaluate.protocol import predict
from gsim3d.presets import tiny
from gsim3d.train.restore import restore
from tests.data.made_hocap import BOX, N_FRAMES, SERIALS, box_pose, hand, intrinsics, poses, write_hocap

TYPES = [f"{side}_{joint}" for side in ("right", "left") for joint in range(21)]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return write_hocap(tmp_path_factory.mktemp("hocap"))


@pytest.fixture(scope="module")
def scene(folder):
    return Scene.open(folder)


def test_sequences_are_found_below_the_root(folder):
    root = folder.parent.parent
    assert find_scenes(root) == find_scenes(folder.parent) == find_scenes(folder) == [folder]
    scene = Scene.open(folder)
    assert (scene.layout, scene.name) == ("hocap", "subject_1/20231025_165502")
    assert scene.camera_names == SERIALS and scene.n_steps == N_FRAMES and scene.fps == 30


def test_cameras_are_world_to_camera_with_pixel_centres_at_a_half(scene):
    viewmats, Ks = scene.recording.cameras_at_step(0)
    np.testing.assert_allclose(viewmats, poses(), atol=1e-9)
    np.testing.assert_allclose(Ks[1] - intrinsics(1), [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]], atol=1e-9)


def test_particles_do_not_begin_right_before_their_own_camera(scene):
    assert 0.3 < scene.near < 0.6 and scene.far > 1.5  # cameras are 1.1 m from the table's centre


def test_box_of_known_pose_is_where_images_and_labels_show_it(scene, folder):
    for frame in (0, 13):
        corners = BOX @ box_pose(frame)[:3, :3].T + box_pose(frame)[:3, 3]
        for cam, serial in enumerate(SERIALS):
            with np.load(folder / serial / f"label_{frame:06d}.npz") as label:
                pose, mask = label["obj_poses"][0], label["seg_mask"]
            viewmat = scene.recording.viewmats[0, cam]
            local = corners @ viewmat[:3, :3].T + viewmat[:3, 3]
            assert np.abs(BOX @ pose[:3, :3].T + pose[:3, 3] - local).max() < 1e-3
            pixels, _ = project(corners.mean(0, keepdims=True), viewmat, scene.recording.Ks[0, cam])
            column, row = np.floor(pixels[0]).astype(int)
            assert mask[row, column] == 1
            labels = scene.segmentation([cam], [frame])[0, 0].numpy()
            assert (labels[:120] == np.where(mask > 0, 3, 1)).all()


def test_joints_are_world_positions_with_short_gaps_interpolated(scene):
    positions, valid = scene.recording.actions.positions, scene.recording.actions.present
    assert positions.shape == (N_FRAMES, 42, 3)
    for frame in (0, 3, 31):  # camera 0 has no label at frame 3
        np.testing.assert_allclose(positions[frame, :21], hand("right", frame), atol=1e-5)
        np.testing.assert_allclose(positions[frame, 21:], hand("left", frame), atol=1e-5)
    thirds = (2 * hand("left", 4) + hand("left", 7)) / 3
    np.testing.assert_allclose(positions[5, 21:], thirds, atol=1e-5)
    assert valid[:, :21].all() and valid[:20].all()
    assert not valid[20:27, 21:].any() and (positions[22, 21:] == positions[19, 21:]).all()


def test_actions_are_the_joints_absent_in_long_gaps(scene, tmp_path):
    actions = scene.recording.actions
    assert actions.types == tuple(TYPES)
    assert any("left hand: absent at 7 of 32 frames" in note for note in scene.recording.notes)
    assert not any("right hand" in note for note in scene.recording.notes)
    assert actions.present[:, :21].all() and not actions.present[20:27, 21:].any()
    assert actions.present[:20].all() and actions.present[27:].all()
    halved = Scene.open(scene.path, fps=15).recording.actions
    np.testing.assert_array_equal(halved.present, actions.present[::2])
    types = make_frames([scene], [[0]], [[18, 19]]).actions.types
    assert types.shape == (1, 14, 42) and (types[0, 2:9, 21:] == -1).all() and (types[0, :2] >= 0).all()
    assert (types[0, :, :21] >= 0).all() and (types[0, 9:] >= 0).all()
    whole = Scene.open(write_hocap(tmp_path, gaps=False, n_frames=8), fps=15)
    assert len(whole.recording.actions.types) == 42
    for step in range(4):  # frames 0, 2, 4, 6
        np.testing.assert_allclose(whole.recording.actions.positions[step, 21:], hand("left", 2 * step), atol=1e-5)
    full = Scene.open(whole.path)
    assert (whole.images([1], [3]) == full.images([1], [6])).all()


def test_both_versions_give_equal_tensors(scene, tmp_path):
    older = Scene.open(write_hocap(tmp_path, first_version=True, n_frames=6))
    for name in ("viewmats", "Ks"):
        np.testing.assert_array_equal(getattr(older.recording, name), getattr(scene.recording, name))
    assert (older.images(range(3), range(6)) == scene.images(range(3), range(6))).all()
    assert (older.segmentation([1, 2], range(6)) == scene.segmentation([1, 2], range(6))).all()
    assert (older.segmentation([0], [3]) == 1).sum() == 160 * 120  # no file: nothing moves
    assert older.recording.actions is None


def test_one_side_with_two_rows_is_right_and_left(tmp_path):
    folder = write_hocap(tmp_path, gaps=False, n_frames=2)
    meta = yaml.safe_load((folder / "meta.yaml").read_text()) | {"mano_sides": ["left"]}
    (folder / "meta.yaml").write_text(yaml.safe_dump(meta))
    np.testing.assert_allclose(Scene.open(folder).recording.actions.positions[1], hand("left", 1), atol=1e-5)


def test_serials_that_yaml_takes_for_numbers(tmp_path):
    folder = write_hocap(tmp_path, gaps=False, n_frames=2)
    for file in (folder / "meta.yaml", tmp_path / "calibration" / "extrinsics" / "extrinsics_20231014.yaml"):
        file.write_text(file.read_text().replace("'", ""))
    assert type(yaml.safe_load((folder / "meta.yaml").read_text())["realsense"]["serials"][1]) is int
    assert Scene.open(folder).camera_names == SERIALS


def test_inverted_extrinsics_fail_the_rig_check(tmp_path):
    folder = write_hocap(tmp_path, inverted=True, n_frames=4)
    problems = check_scene(folder).problems
    assert any("calibration does not fit" in problem and "px" in problem for problem in problems)
    with pytest.raises(InputError):
        Scene.open(folder)


def test_one_camera_that_is_off_fails_the_rig_check_by_its_serial(tmp_path):
    folder = write_hocap(tmp_path, n_frames=4, gaps=False)
    file = tmp_path / "calibration" / "extrinsics" / "extrinsics_20231014.yaml"
    before = file.read_text()
    for metres in (0.05, 1.0):
        file.write_text(before)
        edited(folder, file, lambda content: add(content["extrinsics"][SERIALS[2]], 3, metres))
        (problem,) = check_scene(folder).problems
        assert "calibration does not fit" in problem and f"px (camera {SERIALS[2]})" in problem


def test_labels_that_cannot_be_used_are_noted(tmp_path):
    folder = write_hocap(tmp_path, n_frames=2, gaps=False)
    for file in (folder / SERIALS[1]).glob("label_*.npz"):
        file.unlink()
    edited(folder, folder / "meta.yaml", lambda meta: meta.pop("mano_sides"))
    lens = tmp_path / "calibration" / "intrinsics" / f"{SERIALS[0]}.yaml"
    edited(folder, lens, lambda content: content["color"].update(coeffs=[0.0] * 4))
    scene = Scene.open(folder)
    assert not scene.has_segmentation() and scene.recording.actions is None
    assert scene.recording.notes == (
        f"camera {SERIALS[1]}: has no label files, so masks are read of no camera",
        "mano_sides is missing: joints of hands are not read",
    )
    edited(folder, lens, lambda content: content["color"].update(coeffs=[0.0, 0.1, 0.0, 0.0]))
    assert any("lens coefficients are ignored" in note for note in Scene.open(folder).recording.notes)


def test_contact_sheet_draws_joints_where_the_images_show_them(scene, capsys, folder, tmp_path):
    assert main(["check-data", str(folder), "--out", str(tmp_path / "sheet.png")]) == 0
    said = capsys.readouterr().out
    assert "actors: right_0, right_1, right_2, ... (42)" in said and "no problem" in said
    sheet = contact_sheet([scene])
    assert (np.abs(sheet.astype(int) - (90, 255, 90)).max(-1) < 40).sum() > 200


def add(numbers, at, change):
    numbers[at] += change


def edited(folder, file, change):
    """The description with a change: of what yaml or json read."""
    content = yaml.safe_load(file.read_text())
    change(content)
    file.write_text(yaml.safe_dump(content))


DAMAGE = {
    "num_frames": (lambda meta: meta.update(num_frames=40), "has 32 of num_frames 40 frames; the first missing is 32"),
    "serials": (lambda meta: meta["realsense"].update(serials=["1"]), "camera '1', which has no folder"),
    "twice": (
        lambda meta: meta["realsense"].update(serials=[SERIALS[0]] * 2),
        f"lists camera {SERIALS[0]} twice",
    ),
    "no serials": (lambda meta: meta.update(realsense=3), "realsense.serials must be a list"),
    "size": (lambda meta: meta["realsense"].update(width=None), "realsense.size"),
    "sides": (lambda meta: meta.update(mano_sides=["both"]), "mano_sides must be of right, left"),
    "extrinsics": (lambda meta: meta.update(extrinsics="../../x"), "is not a file inside"),
}


@pytest.mark.parametrize("name", DAMAGE)
def test_damaged_meta_is_refused_by_key(folder, name):
    change, message = DAMAGE[name]
    file = folder / "meta.yaml"
    before = file.read_text()
    try:
        edited(folder, file, change)
        with pytest.raises(InputError, match=message):
            Scene.open(folder)
    finally:
        file.write_text(before)


def test_damaged_calibration_and_labels_are_refused_by_file(tmp_path):
    folder = write_hocap(tmp_path, n_frames=2)
    K, extrinsics = (
        tmp_path / "calibration" / "intrinsics" / f"{SERIALS[1]}.yaml",
        tmp_path / "calibration" / "extrinsics" / "extrinsics_20231014.yaml",
    )
    label = folder / SERIALS[2] / "label_000001.npz"

    def refused(file, message, content):
        before = file.read_bytes()
        file.write_bytes(content if isinstance(content, bytes) else content.encode())
        try:
            with pytest.raises(InputError, match=message):
                Scene.open(folder).segmentation([2], [1])
        finally:
            file.write_bytes(before)

    refused(K, "ppx", json.dumps({"color": {"fx": 100, "fy": 100, "ppx": None, "ppy": 50}}))
    refused(K, "fx", yaml.safe_dump({"color": {"fx": float("inf"), "fy": 100, "ppx": 80, "ppy": 50}}))
    skewed = yaml.safe_load(extrinsics.read_text())
    skewed["extrinsics"][SERIALS[0]][0] += 0.1
    refused(extrinsics, rf"extrinsics.{SERIALS[0]}.*rigid", yaml.safe_dump(skewed))
    refused(label, "label_000001.npz cannot be read", label.read_bytes()[:300])
    with np.load(label) as content:
        arrays = dict(content)
    for key, value, message in (
        ("seg_mask", np.zeros((4, 4), np.uint8), "seg_mask must be finite numbers"),
        ("hand_joints_3d", np.full((2, 21, 3), np.nan), "hand_joints_3d must be finite"),
    ):
        np.savez(tmp_path / "other.npz", **arrays | {key: value})
        refused(label, message, (tmp_path / "other.npz").read_bytes())
    with zipfile.ZipFile(tmp_path / "raw.npz", "w") as archive:
        for key in arrays:
            archive.writestr(f"{key}.npy", b"no array")
    refused(label, "must be finite numbers", (tmp_path / "raw.npz").read_bytes())
    (folder / SERIALS[1] / "color_000001.jpg").unlink()
    cv2.imwrite(str(folder / SERIALS[1] / "color_000002.jpg"), np.zeros((8, 8, 3), np.uint8))
    with pytest.raises(InputError, match="color_000001.jpg"):
        Scene.open(folder).images([1], [1])


def train_as_documented(folder, steps):
    """The configuration as documented, with a small model and few steps; its settings of data and actions are kept."""
    root = Path(__file__).parent.parent.parent
    for number in range(2):
        write_hocap(folder / "data" / str(number), gaps=False, n_frames=20)
    config = yaml.safe_load((root / "configs" / "train" / "hocap.yaml").read_text())
    config |= {"preset": "tiny", "captured": False, "precision": {}, "phases": [{"steps": steps, "horizon": 2}]}
    config["model"] = {"dynamics": {"actions": config["model"]["dynamics"]["actions"], "zero_init": False}}
    config["data"] |= {"resize": [64, 48], "context_cameras": [0, 1, 2], "history": 2}
    (folder / "train.yaml").write_text(yaml.safe_dump(config))
    arguments = [str(folder / "train.yaml"), "--data", str(folder / "data"), "--out", str(folder / "run")]
    assert main(["train", *arguments]) == 0


@pytest.mark.slow
def test_documented_training_of_120_steps_lowers_the_loss(tmp_path):
    train_as_documented(tmp_path, 120)
    entries = [json.loads(line) for line in (tmp_path / "run" / "metrics.jsonl").read_text().splitlines()]
    assert entries[-1]["step"] == 119 and not any("skipped" in entry for entry in entries)
    assert entries[-1]["loss"] < 0.3 * entries[0]["loss"]


def test_documented_training_runs_on_the_sequence(tmp_path):
    train_as_documented(tmp_path, 2)
    restored = restore(tmp_path / "run")
    scene = restored.open_scene(find_scenes(tmp_path / "data")[0])
    prediction = predict(restored, scene, [0, 1, 2], 6)
    assert scene.fps == 15 and prediction.particles.means.isfinite().all()
    assert len(restored.plan.spec.dynamics.actions) == 42
    moved = dataclasses.replace(scene.recording.actions, positions=scene.recording.actions.positions + [0.1, 0, 0])
    scene.recording = dataclasses.replace(scene.recording, actions=moved)
    assert (predict(restored, scene, [0, 1, 2], 6).particles.means != prediction.particles.means).any()


@pytest.mark.slow
def test_rollout_of_120_steps_follows_the_hands(tmp_path):
    write_hocap(tmp_path / "data", gaps=False, n_frames=2 * 130)
    simulator = Simulator(
        dataclasses.replace(tiny(), dynamics=dataclasses.replace(tiny().dynamics, actions=tuple(TYPES)))
    )
    scene = Scene.open(find_scenes(tmp_path)[0], fitting=Fitting((64, 48)), fps=15)
    frames = make_frames([scene], [[0, 1, 2]], [[0, 1]]).subsample(4, 2)
    spec = EffectsSpec.from_dict({"dynamics": {"actions": TYPES}})
    with torch.no_grad():
        steps = simulator.rollout(simulator.encode(frames), 120, simulator.plan(spec))
    assert all(step.means.isfinite().all() for step in steps)
