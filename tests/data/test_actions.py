"""actions.npz: round trip, conversion with the scene, and refusal of damaged files."""

import dataclasses
import io
import re
import zipfile

import numpy as np
import pytest

from gsim3d.data import Scene, make_frames
from gsim3d.data.actions import FILE
from gsim3d.data.cameras import near_zero
from gsim3d.data.check import check_scene, describe
from gsim3d.data.fitting import Fitting, fit
from gsim3d.errors import InputError
from gsim3d.train.config import DataConfig, PhaseConfig
from gsim3d.train.samples import draw_batch, draw_windows
from tests.data.scene_folder import write_scene

STEPS, TYPES = 4, ("pusher", "gripper")
POSITIONS = np.random.default_rng(0).uniform(-1, 1, (STEPS, 2, 3)).astype(np.float32)


@pytest.fixture
def folder(tmp_path):
    write_scene(tmp_path, n_steps=STEPS)
    return tmp_path


def save(folder, **arrays):
    np.savez(folder / FILE, **{"positions": POSITIONS, "types": np.array(TYPES), **arrays})


def test_actions_round_trip(folder):
    assert Scene.open(folder).recording.actions is None
    save(folder)
    scene = Scene.open(folder)
    assert scene.recording.actions.types == TYPES
    np.testing.assert_array_equal(scene.recording.actions.positions.astype(np.float32), POSITIONS)
    assert "actors: pusher, gripper" in describe(scene)
    half = Scene.open(folder, fps=10.0).recording.actions
    np.testing.assert_array_equal(half.positions.astype(np.float32), POSITIONS[::2])


def test_actions_move_and_scale_with_the_cameras(folder):
    save(folder)
    recording = Scene.open(folder).recording
    far = recording.viewmats.copy()
    offset = np.array([1e6, -2e6, 0.0])
    far[..., :3, 3] -= far[..., :3, :3] @ offset
    moved = near_zero(dataclasses.replace(recording, viewmats=far))
    there = moved.actions.positions + moved.world_offset
    np.testing.assert_allclose(there, recording.actions.positions, atol=1e-9)
    small = fit(recording, Fitting(unit_cameras=True))
    scale = small.near / recording.near
    assert scale < 1
    np.testing.assert_allclose(small.actions.positions, scale * recording.actions.positions)


def test_frames_hold_the_actions_of_each_scene_from_their_first_step(tmp_path):
    scenes = []
    for number, types in enumerate((TYPES, TYPES[:1], None)):
        write_scene(tmp_path / f"{number}", n_steps=STEPS)
        if types:
            save(tmp_path / f"{number}", positions=POSITIONS[:, : len(types)], types=np.array(types))
        scenes.append(Scene.open(tmp_path / f"{number}"))
    frames = make_frames(scenes, [[0]] * 3, [[0, 1], [1, 3], [2]])
    positions, types = frames.actions.positions.numpy(), frames.actions.types.tolist()
    assert frames.actions.names == ("gripper", "pusher") and types == [[row] * 4 for row in ([1, 0], [1, -1], [-1, -1])]
    np.testing.assert_array_equal(positions[0], POSITIONS)
    np.testing.assert_array_equal(positions[1, :, 0], POSITIONS[[1, 3, 3, 3], 0])  # rests after its last step
    assert make_frames(scenes[2:], [[0]], [[0]]).actions is None
    phase, data = PhaseConfig(steps=1, horizon=1, batch=4, target_views=1), DataConfig(history=2, context_views=1)
    for step in range(4):
        batch = draw_batch(scenes[:1], data, phase, 0, step, range(4))
        actions, windows = batch.context.actions, draw_windows(scenes[:1], data, phase, 0, step, range(4))
        wanted = np.stack([POSITIONS[window.start : window.start + 3] for window in windows])
        np.testing.assert_array_equal(actions.positions.numpy(), wanted)
        assert batch.targets.actions is None and actions.types.unique(dim=1).tolist() == [[[1, 0]]] * 4


LATE = POSITIONS.copy()
LATE[2, 1, 0] = np.nan


@pytest.mark.parametrize(
    "arrays, words",
    [
        ({"positions": POSITIONS[:3]}, r"must have the 4 steps of the scene; got float32 \[3, 2, 3\]"),
        ({"positions": POSITIONS.astype(np.float64)}, r"must be float32 \[T, A, 3\].*got float64"),
        ({"positions": POSITIONS[:, :, :2]}, r"got float32 \[4, 2, 2\]"),
        ({"positions": POSITIONS[:, :0], "types": np.array([], "U1")}, "A of 1 or more"),
        ({"positions": LATE}, "frame 2, point 1 are not finite"),
        ({"types": np.array(["pusher"])}, r"types must be 2 strings, one for each point; got <U6 \[1\]"),
        ({"types": np.array([0, 1])}, "types must be 2 strings"),
        ({"types": np.array(["", "a"])}, "types of point 0 must be a name"),
        ({"types": np.array([None, "a"], object)}, "cannot be read: Object arrays"),
    ],
)
def test_damaged_actions_are_refused(folder, arrays, words):
    save(folder, **arrays)
    with pytest.raises(InputError, match=words) as error:
        Scene.open(folder)
    assert str(folder / FILE) in str(error.value)
    assert any(str(folder / FILE) in problem for problem in check_scene(folder).problems)


@pytest.mark.parametrize(
    "positions, words",
    [
        (POSITIONS, ()),
        (
            1000 * POSITIONS,
            (
                "all points are far from the bounds of the scene",
                "point . moves by .* m, more than the scene, to frame 1",
            ),
        ),
        (POSITIONS + np.float32(20), ("all points are far from the bounds of the scene",)),
        (POSITIONS + np.float32([[[0]], [[0]], [[100]], [[0]]]), ("point . moves by 173 m, .* frame 2",)),
    ],
)
def test_places_of_points_are_checked(folder, positions, words):
    save(folder, positions=positions)
    problems = check_scene(folder).problems
    assert len(problems) == len(words)
    for problem, wanted in zip(problems, words, strict=True):
        assert re.search(f"actors: {wanted}", problem)


def test_files_that_are_no_actions_are_refused(folder):
    save(folder)
    content = (folder / FILE).read_bytes()
    rng = np.random.default_rng(0)
    damaged = [b"", b"positions", content[:-30], content[: len(content) // 2]]
    for _ in range(200):
        bytes_ = bytearray(content)
        for at in rng.integers(len(content), size=3):
            bytes_[at] = rng.integers(256)
        damaged.append(bytes(bytes_))
    refused = 0
    for bytes_ in damaged:
        (folder / FILE).write_bytes(bytes_)
        try:
            Scene.open(folder)
        except InputError:
            refused += 1
    assert refused > 150
    np.savez(folder / FILE, positions=POSITIONS)
    with pytest.raises(InputError, match="the array types is missing"):
        Scene.open(folder)
    with zipfile.ZipFile(folder / FILE, "w") as archive:
        archive.writestr("positions.npy", b"no array")
        archive.writestr("types.npy", b"no array")
    with pytest.raises(InputError, match="positions must be float32"):
        Scene.open(folder)


def test_a_damaged_header_of_an_array_is_refused(folder):
    header = io.BytesIO()
    np.save(header, POSITIONS)
    with zipfile.ZipFile(folder / FILE, "w") as archive:
        archive.writestr("positions.npy", header.getvalue().replace(b"'descr': '<f4'", b"'descr': ('<f4"))
        archive.writestr("types.npy", b"no array")
    with pytest.raises(InputError, match="cannot be read"):
        Scene.open(folder)
