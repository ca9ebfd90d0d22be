"""The frame rate is part of a model: scenes of another one are resampled on request, or refused with both numbers."""

import json

import pytest
import torch

from gsim3d import pretrained
from gsim3d.cli.main import main
from gsim3d.data import Scene
from gsim3d.data.fitting import frame_stride
from gsim3d.effects.spec import EffectsSpec
from gsim3d.errors import FitWarning, InputError
from gsim3d.evaluate.predictions import Predictions
from gsim3d.io import checkpoint
from gsim3d.synth.worlds import build_world
from gsim3d.train.config import DataConfig, PhaseConfig, TrainConfig
from gsim3d.train.restore import build_simulator, describe, model_config, restore
from gsim3d.train.samples import check_scenes
from tests.data.made_scenes import make_scene, write_genesis
from tests.tiny_scenes import write_scene, write_scenes
from tools.release.trajectories import TrajectoryStore

pytestmark = pytest.mark.usefixtures("one_thread")

CONFIG = TrainConfig(preset="tiny", data=DataConfig(history=2, context_views=2, target_only_cameras=(3,)))


def at_rate(folder, fps):
    metadata = json.loads((folder / "metadata.json").read_text())
    (folder / "metadata.json").write_text(json.dumps({**metadata, "fps": fps}))
    return folder


def untrained(path, scene, change=lambda config: config):
    """A checkpoint of a model that was trained on ``scene``, as it says."""
    model = model_config(CONFIG)
    config = change(describe(CONFIG, model, scene, EffectsSpec()))
    checkpoint.export(checkpoint.Checkpoint(build_simulator(model, 0).state_dict(), config), path)
    return path


def without_rate(config):
    return {**config, "data": {name: value for name, value in config["data"].items() if name != "fps"}}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return write_scene(tmp_path_factory.mktemp("scene") / "0000", n_steps=7)


@pytest.fixture
def restored(folder, tmp_path):
    return restore(untrained(tmp_path / "model.safetensors", Scene.open(folder)))


@pytest.mark.parametrize(
    "rate, wanted, stride",
    [(30, 30, 1), (29.97, 30, 1), (30, 29.97, 1), (60, 30, 2), (59.94, 30, 2), (84, 42, 2), (12.2, 12, None),
     (30, 12, None), (12, 24, None), (1e6, 1, 1_000_000)],
)  # fmt: skip
def test_rates_that_are_whole_multiples(rate, wanted, stride):
    assert frame_stride(rate, wanted) == stride


def test_checkpoints_hold_the_rate_of_their_scenes(restored, folder, tmp_path):
    assert restored.fps == 12.0 and restored.open_scene(folder).fps == 12.0
    single = describe(CONFIG, model_config(CONFIG), Scene.open(write_scene(tmp_path / "1", n_steps=1)), EffectsSpec())
    assert "fps" not in single["data"]  # one instant has no rate


@pytest.mark.parametrize("name, fps", [("elastic-small", 42.0), ("cloth-small", 42.0), ("rigid-small", 12.0)])
def test_shipped_models_have_a_rate(name, fps):
    if name not in pretrained.names():
        pytest.skip("not shipped")
    assert pretrained.frame_rate(name) == pretrained.frame_rate(pretrained.located(name)) == fps


def test_another_rate_is_refused_with_both_numbers(restored, tmp_path):
    folder = at_rate(write_scene(tmp_path / "a"), 24)
    with pytest.raises(InputError, match="a: 24 frames per second; the model was trained at 12.*--resample"):
        restored.open_scene(folder)
    with pytest.raises(InputError, match="24 frames per second"):
        restored.check_scene(Scene.open(folder))
    for fps in (30, 6):
        with pytest.raises(InputError, match=f"{fps} frames per second; .* trained at 12 .not an integer multiple"):
            restored.open_scene(at_rate(folder, fps))
        with pytest.raises(InputError, match=f"its {fps} fps are not an integer multiple of the requested 12"):
            restored.open_scene(folder, resample=True)
    assert restored.open_scene(at_rate(folder, 12.01)).n_steps == 6


def test_resampling_takes_every_kth_frame_with_its_cameras(restored, tmp_path):
    made = make_scene(moving=True, zoom=0.01, width=32, n_steps=7)
    folder = at_rate(write_genesis(tmp_path / "moving", made), 36)
    whole, scene = Scene.open(folder), Scene.open(folder, fps=12)
    assert (scene.n_steps, scene.fps) == (3, 12)
    for step in range(3):
        assert torch.equal(scene.images([0, 2], [step]), whole.images([0, 2], [3 * step]))
        assert torch.equal(scene.segmentation([1], [step]), whole.segmentation([1], [3 * step]))
        for name in ("viewmats", "Ks"):
            ours, theirs = (getattr(s.cameras_at([1], [t]), name) for s, t in ((scene, step), (whole, 3 * step)))
            assert torch.equal(ours, theirs)
    cached = Scene.open(folder, fps=12, cache_dir=tmp_path)
    assert torch.equal(cached.images([0], [1]), Scene.open(folder, cache_dir=tmp_path).images([0], [3]))


def test_predictions_of_other_models_count_resampled_steps(folder, tmp_path):
    scene = Scene.open(at_rate(write_scene(tmp_path / "b", n_steps=7), 24), fps=12)
    for step in (2, 3):
        (tmp_path / "other" / "cam_1").mkdir(parents=True, exist_ok=True)
        source = scene.path / "cam_1" / f"rgb_{2 * step:04d}.png"
        (tmp_path / "other" / "cam_1" / f"{step}.png").write_bytes(source.read_bytes())
    images = Predictions("other", tmp_path / "other", scene.path).images(scene, [1], 2, 2)
    assert torch.equal(images, scene.images([1], [2, 3]).permute(0, 1, 3, 4, 2))


def test_a_checkpoint_without_a_rate_is_not_checked_and_says_so(folder, tmp_path):
    old = restore(untrained(tmp_path / "old.safetensors", Scene.open(folder), without_rate))
    assert old.fps is None
    with pytest.warns(FitWarning, match="frame rate not checked"):
        old.open_scene(folder)
    with pytest.raises(InputError, match="--resample: the checkpoint does not contain"):
        old.open_scene(folder, resample=True)


@pytest.mark.parametrize("fps", [0, -1.0, True, "fast", [12], 1e9, float("nan"), float("inf")])
def test_a_rate_that_is_none_is_refused(folder, tmp_path, fps):
    def change(config):
        return {**config, "data": {**config["data"], "fps": fps}}

    with pytest.raises(InputError, match="data.fps must be frames per second"):
        restore(untrained(tmp_path / "model.safetensors", Scene.open(folder), change))


def test_training_scenes_have_one_rate(folder, tmp_path):
    scenes = [Scene.open(folder), Scene.open(at_rate(write_scene(tmp_path / "c"), 24))]
    with pytest.raises(InputError, match="c: 24 frames per second, .* has 12; rates must be equal"):
        check_scenes(scenes, CONFIG.data, [PhaseConfig(steps=1, target_views=2)])
    check_scenes(scenes[:1] * 2, CONFIG.data, [PhaseConfig(steps=1, target_views=2)])


def test_commands_refuse_resample_and_say_once_what_is_not_checked(folder, tmp_path, capsys):
    data = write_scenes(tmp_path / "data", 2, n_steps=7)
    for scene in (data / "ball").iterdir():
        at_rate(scene, 24)
    model = untrained(tmp_path / "model.safetensors", Scene.open(folder))
    evaluate = ["evaluate", str(model), str(data), "--scenes", "all", "--metrics", "psnr"]
    simulate = ["simulate", str(model), str(data / "ball" / "0000"), "--steps", "1", "--out", str(tmp_path / "out")]
    for command in (evaluate, simulate, ["plan", str(data / "ball" / "0000"), str(model)]):
        assert main(command) == 2
        err = capsys.readouterr().err
        assert "24 frames per second; the model was trained at 12" in err and len(err.splitlines()) == 1
        assert main([*command, "--resample"]) == 0
        capsys.readouterr()
    report = json.loads((tmp_path / "metrics.json").read_text())
    assert report["fps"] == [12] and report["n_future_steps"] == 2
    old = untrained(tmp_path / "old.safetensors", Scene.open(folder), without_rate)
    assert main(["evaluate", str(old), *evaluate[2:]]) == 0
    assert capsys.readouterr().err.count("frame rate not checked") == 1


def test_trajectories_of_a_training_run_have_the_rate_of_their_world():
    world = build_world("elastic", "mini", {"fps": 17.0, "image_size": 16, "n_frames": 2})
    assert [trajectory.fps for trajectory in TrajectoryStore(world, 2, "cpu").trajectories] == [17.0, 17.0]
