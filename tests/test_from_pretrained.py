"""Loading, saving and predicting in the library: Simulator.from_pretrained, save_pretrained, predict."""

import dataclasses
import json

import pytest
import torch

from gsim3d import presets
from gsim3d.cameras import InputSpec
from gsim3d.compat import load_released
from gsim3d.compat.released_model import ReleasedModelConfig, ReleasedSimulator
from gsim3d.data import Fitting, Scene
from gsim3d.effects.edits import Edit, Remove
from gsim3d.effects.spec import DynamicsEffects, EffectsSpec
from gsim3d.errors import InputError
from gsim3d.io import checkpoint
from gsim3d.numerics.speed import SPEEDS_FILE
from gsim3d.pretrained import names
from gsim3d.simulator import Simulator
from gsim3d.train.restore import restore
from tests.asserts import assert_same_bits
from tests.compat.release import small_config
from tests.test_simulator import CONFIG, SIZE, make_frames, make_simulator, target_cameras
from tests.tiny_scenes import write_scene

INPUTS = InputSpec(history=2, context_views=2, image_size=(SIZE, SIZE), fps=30.0)


@pytest.fixture
def simulator():
    torch.manual_seed(0)
    simulator = make_simulator()
    simulator.inputs, simulator.effects = INPUTS, EffectsSpec(dynamics=DynamicsEffects(history=2))
    return simulator


@pytest.fixture
def folder(simulator, tmp_path):
    return simulator.save_pretrained(tmp_path / "model")


class Rig:
    """An own source of frames."""

    def input_frames(self, inputs):
        assert inputs.history == 2
        return make_frames((2,))


def test_saved_simulator_comes_back(simulator, folder):
    again = Simulator.from_pretrained(folder)
    assert again.config == CONFIG and again.effects == simulator.effects and again.inputs == INPUTS
    assert not again.training and again.plan().spec == simulator.effects
    assert all(torch.equal(value, again.state_dict()[name]) for name, value in simulator.state_dict().items())


def test_saved_simulator_opens_in_commands(folder):
    restored = restore(folder)
    assert restored.image_size == (SIZE, SIZE) and restored.fps == 30 and restored.data.history == 2


def test_predict_is_encode_rollout_and_render(simulator):
    frames = make_frames((2,))
    cameras, behind = target_cameras(frames, 1), torch.ones(3)
    prediction = simulator.predict(Rig(), 3, cameras=cameras, background=behind)
    with torch.no_grad():
        steps = simulator.rollout(simulator.encode(frames), 3)
        image = simulator.render(steps[-1], cameras, behind)
    assert len(prediction.steps) == len(prediction.renderings) == 3
    assert_same_bits(prediction.steps[-1].means, steps[-1].means)
    assert_same_bits(prediction.renderings[-1].color, image.color)
    assert simulator.predict(frames, 1).renderings == []


def test_predict_allows_what_its_edits_do(simulator):
    moving = simulator.predict(make_frames((2,)), 1, edits=[Edit(0, Remove("frozen"))]).steps[-1]
    assert moving.n_rows < simulator.predict(make_frames((2,)), 1).steps[-1].n_rows
    with pytest.raises(InputError, match="remove"):
        simulator.predict(make_frames((2,)), 1, simulator.plan(), edits=[Edit(0, Remove("frozen"))])


def test_speed_is_read_beside_the_weights(folder):
    digest = checkpoint.load(folder).digest
    settings = {"fast": {"history": 1, "kept": 0.5, "sh_degree": 0, "patch_size": 16}}
    (folder / SPEEDS_FILE).write_text(json.dumps({digest: {"cpu": settings}}))
    fast = Simulator.from_pretrained(folder, speed="fast")
    assert fast.inputs.history == 1 and fast.plan().history == 1 and fast.plan().sh_degree == 0
    assert set(fast.config.dynamics.patch_sizes) == {16}
    exact = Simulator.from_pretrained(folder)
    assert exact.inputs.history == 2 and exact.config == CONFIG
    frames = make_frames((1,))
    few, all_of_it = (model.predict(frames, 2).steps for model in (fast, exact))
    assert 0 < few[-1].n_rows < 0.6 * all_of_it[-1].n_rows
    with pytest.raises(InputError, match="speed balanced: this checkpoint is not tuned for cpu.*gsim3d profile"):
        Simulator.from_pretrained(folder, speed="balanced")
    with pytest.raises(InputError, match="speed: must be one of exact, balanced, fast; got 'fsat'"):
        Simulator.from_pretrained(folder, speed="fsat")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"steps": 0}, "steps must be a whole number of at least 1; got 0"),
        ({"steps": 1.5}, "steps must be a whole number of at least 1; got 1.5"),
        ({"source": "data/ball/0000"}, r"source must be a scene \(gsim3d.data.Scene.open.*got str"),
        ({"edits": "throw.yaml"}, r"edits must be a list of .*Edit\(step, operation\); got 'throw.yaml'"),
        ({"edits": Edit(0, Remove("frozen"))}, r"edits must be a list of .*; got Edit\("),
        ({"edits": [Edit(0, "remove")]}, r"edits must be a list of .*; got \[Edit\("),
        ({"cameras": [0]}, r"cameras must be Cameras.*got \[0\]"),
        (
            {"inputs": dataclasses.replace(INPUTS, image_size=(32, 48))},
            r"images must be 32x48 pixels.*Fitting\(\(32, 48\)\)",
        ),
    ],
)
def test_predictions_that_are_refused(simulator, change, message):
    simulator.inputs = change.get("inputs", INPUTS)
    with pytest.raises(InputError, match=message):
        source = change.get("source", make_frames((2,)))
        simulator.predict(source, change.get("steps", 1), cameras=change.get("cameras"), edits=change.get("edits", ()))


def test_checkpoints_that_are_refused(folder):
    with pytest.raises(InputError, match="no such checkpoint"):
        Simulator.from_pretrained("nothing-small")
    if not torch.cuda.is_available():
        with pytest.raises(InputError, match="device cuda: "):
            Simulator.from_pretrained(folder, device="cuda")
    with pytest.raises(InputError, match="load it with Simulator.from_pretrained"):
        load_released(folder)
    with pytest.raises(InputError, match="device: must be cpu or cuda; got 'tpu'"):
        Simulator.from_pretrained(folder, device="tpu")


def test_saving_replaces_checkpoints_alone(simulator, folder, tmp_path):
    (tmp_path / "notes").mkdir()
    (tmp_path / "notes" / "a.txt").write_text("kept")
    with pytest.raises(InputError, match="notes: exists and is not a checkpoint"):
        simulator.save_pretrained(tmp_path / "notes")
    assert (tmp_path / "notes" / "a.txt").read_text() == "kept"
    assert simulator.save_pretrained(folder) == folder


def test_released_weights_are_loaded_by_compat(tmp_path):
    released = ReleasedSimulator(small_config())
    released.inputs = INPUTS
    folder = released.save_pretrained(tmp_path / "released")
    with pytest.raises(InputError, match="load it with gsim3d.compat.load_released"):
        Simulator.from_pretrained(folder)
    again = load_released(folder)
    assert isinstance(again, ReleasedSimulator) and isinstance(again.config, ReleasedModelConfig)
    assert isinstance(restore(folder).simulator, ReleasedSimulator)


@pytest.mark.parametrize("name", names())
def test_shipped_simulators_load_by_name(name):
    simulator = Simulator.from_pretrained(name)
    assert simulator.inputs.history == 4 and simulator.inputs.image_size and simulator.inputs.fps
    assert simulator.config != presets.small()


def test_scene_is_a_source_of_frames(tmp_path):
    scene = Scene.open(write_scene(tmp_path / "scene", 4))
    simulator = Simulator(presets.tiny()).eval()
    simulator.inputs = InputSpec(history=2, context_views=2, image_size=(scene.width, scene.height))
    frames = scene.input_frames(simulator.inputs)
    assert frames.cloud_step.tolist() == [0, 1] and len(frames.cameras) == 4
    prediction = simulator.predict(scene, 1, cameras=scene.cameras_at([2], [0]))
    assert prediction.renderings[0].color.shape == (1, scene.height, scene.width, 3)
    kept = dataclasses.replace(simulator.inputs, target_only_cameras=(2,))
    assert torch.equal(scene.input_frames(kept).cameras.viewmats[:2], scene.cameras_at([0, 3], [0]).viewmats)
    with pytest.raises(InputError, match="needs 2 steps from step 3, but the scene has 4 steps"):
        scene.input_frames(simulator.inputs, start=3)


def test_frames_of_a_scene_are_fitted_as_the_command_fits_them(tmp_path):
    scene = Scene.open(write_scene(tmp_path / "scene", 4))
    inputs = InputSpec(image_size=(scene.width, scene.height), fps=scene.fps)
    for factor, changes in ((1.2, True), (1.3, False)):
        depths = (scene.near * factor, scene.far)
        frames = scene.input_frames(dataclasses.replace(inputs, near_far=depths))
        assert frames.cameras.near[0] == pytest.approx(depths[0] if changes else scene.near)
    kept = Scene.open(scene.path, fitting=Fitting(near_far=(0.5, 9.0)))
    assert kept.input_frames(dataclasses.replace(inputs, near_far=(0.6, 9.0))).cameras.near[0] == 0.5
    for rate, remedy in ((scene.fps / 2, "takes every frame number 2"), (scene.fps * 0.7, "resample the scene")):
        with pytest.raises(InputError, match=f"{scene.fps:g} frames per second.*trained at.*{remedy}"):
            scene.input_frames(dataclasses.replace(inputs, fps=rate))
