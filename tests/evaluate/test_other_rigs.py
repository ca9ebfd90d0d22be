"""Models predict scenes of other rigs, sizes and depth ranges than those of their training, and say what is changed."""

import dataclasses
import json
import warnings
from types import SimpleNamespace

import cv2
import pytest
import torch

from gsim3d import presets
from gsim3d.cameras import InputSpec
from gsim3d.cli.main import main
from gsim3d.compat.released_model import ReleasedModelConfig
from gsim3d.data import Scene
from gsim3d.effects.spec import EffectsSpec
from gsim3d.errors import FitWarning, InputError
from gsim3d.evaluate.protocol import default_views, predict
from gsim3d.io.checkpoint import Checkpoint
from gsim3d.pretrained import names
from gsim3d.train.config import DataConfig
from gsim3d.train.restore import Restored, build_simulator, restore
from tests.data.made_videos import trimmed, write_plain, write_scene as write_videos
from tests.tiny_scenes import write_scene

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture(scope="module")
def restored():
    """Trained, as it says, like the shipped models: on four of 12 cameras, two of which are never an input."""
    simulator = build_simulator(presets.tiny(), seed=0).eval()
    data = DataConfig(history=2, target_only_cameras=(2, 7), background_stride=2, body_stride=2, resize=(32, 32))
    data = dataclasses.replace(data, near_far=(1.2, 4.0))
    simulator.inputs = InputSpec(background_stride=2, body_stride=2, image_size=(32, 32), fps=12.0)
    return Restored(simulator, data, simulator.plan(EffectsSpec()), Checkpoint({}, {}))


def rig(folder, n_cams, size=32, **keys):
    """A scene of ``n_cams`` cameras; the tiny scene's five are used over and over."""
    write_scene(folder, n_steps=3, size=size)
    metadata = json.loads((folder / "metadata.json").read_text()) | {"n_cams": n_cams} | keys
    for cam in range(5, n_cams):
        metadata[f"cam_{cam}"] = metadata[f"cam_{cam - 5}"]
        (folder / f"cam_{cam}").symlink_to(folder / f"cam_{cam - 5}")
    (folder / "metadata.json").write_text(json.dumps(metadata))
    return folder


def opened(restored, folder, *keep):
    """The scene, and what was said of it."""
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        scene = restored.open_scene(folder, keep)
    assert all(warning.category is FitWarning for warning in said)
    return scene, " ".join(str(warning.message) for warning in said)


VIEWS = {
    2: ((0, 1), (0, 1)),
    3: ((0, 1, 2), (0, 1, 2)),
    4: ((0, 1, 2, 3), (0, 1, 2, 3)),
    5: ((0, 1, 2, 3), (4,)),
    7: ((0, 1, 3, 5), (2, 4, 6)),
    8: ((0, 1, 4, 5), (2, 7)),
}


def test_changes_of_a_reader_are_reported(restored, tmp_path):
    for name in ("a", "b"):
        write_plain(tmp_path / f"{name}.mp4")
    trimmed(tmp_path / "b.mp4", 0.0, late=0.3)
    folder = write_videos(tmp_path, ["a", "b"], resample=12)
    said = opened(restored, folder)[1]
    assert f"{folder}: resampled: frames are up to" in said


@pytest.mark.parametrize("n_cams", VIEWS)
def test_any_rig_of_two_cameras_or_more_is_predicted(restored, tmp_path, n_cams):
    scene, said = opened(restored, rig(tmp_path / "scene", n_cams))
    assert said == ""
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        views = default_views(restored, scene)
    assert views == VIEWS[n_cams]
    few = f"fitted to the model: {n_cams} input views, cameras {' '.join(map(str, range(n_cams)))}; training used 4"
    assert [few in str(warning.message) for warning in said] == [True] * (n_cams < 4)
    assert predict(restored, scene, views[0], 1).particles.means.isfinite().all()


def test_one_camera_is_refused_unless_it_is_named(restored, tmp_path):
    scene, _ = opened(restored, rig(tmp_path / "scene", 1))
    with pytest.raises(InputError, match="1 cameras left as inputs"):
        default_views(restored, scene)
    with pytest.warns(FitWarning, match="1 input view, cameras 0; training used 4"):
        assert default_views(restored, scene, (0,)) == ((0,), (0,))


@pytest.mark.parametrize("context", [(0, 0), (1, 2, 1), (3, 2, 1, 0, 3)])
def test_named_cameras_are_different(restored, tmp_path, context):
    scene, _ = opened(restored, rig(tmp_path / "scene", 4))
    with pytest.raises(InputError, match=f"{len(set(context))} cameras left .*--context, each once"):
        default_views(restored, scene, context)


def test_small_images_are_enlarged_with_a_warning(restored, tmp_path):
    scene, said = opened(restored, rig(tmp_path / "scene", 5, size=16))
    assert said == "fitted to the model: images of 16x16 pixels scaled to 32x32"
    assert torch.allclose(scene.cameras_at([0], [0]).Ks[0, :2], torch.tensor([[41.6, 0, 16], [0, 41.6, 16]]))
    ball, recorded = ((s.segmentation([0], [0]) == 3).sum() for s in (scene, Scene.open(scene.path)))
    assert 3.5 * recorded < ball < 8 * recorded


def portrait(folder):
    """Cameras whose images are 24 wide and 48 high."""
    write_scene(folder, n_steps=3, size=48)
    metadata = json.loads((folder / "metadata.json").read_text())
    for cam in range(5):
        metadata[f"cam_{cam}"]["resolution"] = [24, 48]
        metadata[f"cam_{cam}"]["intrinsics"][0][2] -= 12
        for file in (folder / f"cam_{cam}").iterdir():
            image = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)
            cv2.imwrite(str(file), image[:, 12:36])
    (folder / "metadata.json").write_text(json.dumps(metadata))
    return folder


def test_cropping_is_reported_and_can_be_avoided(restored, tmp_path):
    folder = portrait(tmp_path / "scene")
    cut, said = opened(restored, folder)
    assert said == (
        "fitted to the model: images of 24x48 pixels scaled to 32x32, 50% cropped (--keep image preserves it)"
    )
    whole, said = opened(restored, folder, "image")
    assert said == "fitted to the model: images of 24x48 pixels scaled to 32x32"
    assert (whole.width, whole.height) == (cut.width, cut.height) == (32, 32)
    valid = whole.valid([1], [0])[0, 0]
    assert valid[:, :16].all() and not valid[:, 16:].any()
    for scene in (cut, whole):  # the ball's centre is seen where the fitted cameras say
        for step in range(3):
            cameras = scene.cameras_at([1], [step])
            center = torch.tensor([0.0, 0.0, 0.8, 1.0])
            rows, cols = torch.nonzero(scene.segmentation([1], [step])[0, 0] == 3, as_tuple=True)
            pixel = cameras.Ks[0] @ (cameras.viewmats[0] @ center)[:3]
            assert abs(float(pixel[0] / pixel[2]) - float(cols.float().mean() + 0.5)) < 1
    assert predict(restored, whole, (0, 2), 1).particles.means.isfinite().all()


@pytest.mark.parametrize(
    "own, keep, expected",
    [
        ((1.2, 4.0), (), (1.25, 4.0)),  # of the kind of the training
        ((1.2, 4.0), ("depth",), (1.2, 4.0)),
        ((1.4, 4.0), (), (1.25, 4.0)),  # the model's holds all of it
        ((0.9, 4.0), (), (0.9, 4.0)),
        ((1.2, 7.5), (), (1.2, 7.5)),
        ((1.2, 2.9), (), (1.2, 2.9)),
        ((30.0, 50.0), (), (30.0, 50.0)),
    ],
)
def test_depths_are_kept_unless_they_are_those_of_the_training(restored, tmp_path, own, keep, expected):
    restored = dataclasses.replace(restored, data=dataclasses.replace(restored.data, near_far=(1.25, 4.0)))
    folder = rig(tmp_path / "scene", 5, near=own[0], far=own[1])
    scene, said = opened(restored, folder, *keep)
    assert (scene.near, scene.far) == expected
    lost = expected[0] > own[0] or expected[1] < own[1]
    assert ("replaced by" in said and "--keep depth" in said) == lost
    restored.check_scene(scene)


def test_missing_depths_are_guessed_and_kept(restored, tmp_path):
    folder = rig(tmp_path / "scene", 5)
    metadata = json.loads((folder / "metadata.json").read_text())
    del metadata["near"], metadata["far"]
    (folder / "metadata.json").write_text(json.dumps(metadata))
    scene, said = opened(restored, folder)
    assert (scene.near, scene.far) == Scene.open(folder).own_depths and said == ""


def test_published_models_keep_their_depths(restored, tmp_path):
    released = SimpleNamespace(config=ReleasedModelConfig(), inputs=restored.simulator.inputs)
    published = dataclasses.replace(restored, simulator=released)
    scene, said = opened(published, rig(tmp_path / "scene", 5, near=0.5, far=9.0))
    assert (scene.near, scene.far) == (
        1.2,
        4.0,
    ) and "depth range 0.5 to 9 replaced by that of the training, 1.2 to 4" in said


def test_an_unknown_part_is_named(restored, tmp_path):
    with pytest.raises(InputError, match="keep must contain only image, depth; got 'masks'"):
        restored.open_scene(rig(tmp_path / "scene", 2), ("masks",))


@pytest.mark.skipif("elastic-small" not in names(), reason="no simulator is shipped")
def test_shipped_model_reports_changes_in_one_line(tmp_path, capsys):
    near, far = restore("elastic-small", "cpu").data.near_far
    folder = rig(tmp_path / "scene", 3, size=16, fps=42.0, near=near, far=far)
    assert main(["plan", str(folder), "elastic-small"]) == 0
    assert capsys.readouterr().err == "gsim3d: fitted to the model: images of 16x16 pixels scaled to 128x128\n"
