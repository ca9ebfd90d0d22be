"""Splits, windows and the packing of images into Frames."""

import pytest
import torch

from gsim3d.data import Scene, Window, generator, make_frames, split_scenes
from gsim3d.errors import InputError
from tests.data.scene_folder import write_scene


@pytest.fixture
def scenes(tmp_path):
    opened = []
    for number in range(2):
        edits = {"origin": [float(number), 0.0, 0.0]}
        write_scene(tmp_path / f"s{number}", n_steps=6, n_cams=5, seed=number, edits=edits)
        opened.append(Scene.open(tmp_path / f"s{number}"))
    return opened


@pytest.mark.parametrize("n, n_test", [(1, 0), (2, 1), (14, 1), (15, 1), (34, 4), (100, 12), (1200, 144)])
def test_split_scenes_takes_every_kth_scene(n, n_test):
    train, test = split_scenes(list(range(n)))
    assert len(test) == n_test and sorted(train + test) == list(range(n))
    if n_test:
        assert test == list(range(0, n_test * (n // n_test), n // n_test))


def test_split_scenes_by_other_fractions():
    assert [len(part) for part in split_scenes(list(range(30)), 0.1)] == [27, 3]
    assert [len(part) for part in split_scenes(list(range(30)), 0.0)] == [30, 0]
    with pytest.raises(InputError, match="test_fraction"):
        split_scenes([1, 2], 1.0)


def test_make_frames_packs_clouds_by_scene_and_step(scenes):
    frames = make_frames(scenes, [[0, 3], [[1], [2, 4, 0]]], [[1, 2], [0, 5]])
    assert frames.cloud_scene.tolist() == [0, 0, 1, 1] and frames.cloud_step.tolist() == [0, 1, 0, 1]
    assert frames.cameras.image_cloud.tolist() == [0, 0, 1, 1, 2, 3, 3, 3]
    expected = [(0, 1, 0), (0, 1, 3), (0, 2, 0), (0, 2, 3), (1, 0, 1), (1, 5, 2), (1, 5, 4), (1, 5, 0)]
    assert frames.images.shape == (8, 3, 16, 32) and frames.images.dtype == torch.float32
    for row, (scene, step, cam) in enumerate(expected):
        image = scenes[scene].images([cam], [step])[0, 0]
        label = scenes[scene].segmentation([cam], [step])[0, 0]
        assert torch.equal(frames.images[row], image.float() / 255)
        assert torch.equal(frames.masks[row], label > 0) and torch.equal(frames.dynamic[row], label == 3)
        assert torch.equal(frames.cameras.viewmats[row], scenes[scene].cameras_at([cam], [step]).viewmats[0])
        assert torch.equal(frames.cameras.Ks[row], scenes[scene].cameras_at([cam], [step]).Ks[0])
    assert frames.origin.dtype == torch.float64 and frames.origin.tolist() == [[0, 0, 0], [1, 0, 0]]


def test_make_frames_without_labels(scenes, tmp_path):
    for file in (tmp_path / "s0" / "seg").rglob("*.png"):
        file.unlink()
    scene = Scene.open(tmp_path / "s0")
    assert not scene.has_segmentation()
    for masked in (False, None):
        frames = make_frames([scene], [[0]], [[0]], masked=masked)
        assert frames.masks is None and frames.dynamic is None
    with pytest.raises(InputError, match="no segmentation labels"):
        make_frames([scene], [[0]], [[0]], masked=True)


def test_make_frames_errors(scenes, tmp_path):
    with pytest.raises(InputError, match="one list of cameras"):
        make_frames(scenes, [[0]], [[0], [0]])
    with pytest.raises(InputError, match="ascend"):
        make_frames(scenes[:1], [[0]], [[2, 1]])
    with pytest.raises(InputError, match="given for 1 steps"):
        make_frames(scenes[:1], [[[0]]], [[0, 1]])
    with pytest.raises(InputError, match="at least one step"):
        make_frames(scenes[:1], [[0]], [[]])
    write_scene(tmp_path / "wide", width=48)
    with pytest.raises(InputError, match="48x16"):
        make_frames([scenes[0], Scene.open(tmp_path / "wide")], [[0], [0]], [[0], [0]])


def test_generator_depends_on_seed_step_sample_and_purpose_only():
    keys = [(1, 2, 3, "views"), (0, 2, 3, "views"), (1, 0, 3, "views"), (1, 2, 0, "views"), (1, 2, 3, "window")]
    drawn = [int(generator(*key).integers(2**60)) for key in keys]
    assert len(set(drawn)) == len(keys)
    assert [int(generator(*key).integers(2**60)) for key in reversed(keys)] == drawn[::-1]


def test_window_steps(scenes):
    window = Window(scenes[0], 2, 1, context_cams=((0, 1),), target_cams=((2,), (3,), (4,)))
    assert window.steps == [2, 3, 4]
