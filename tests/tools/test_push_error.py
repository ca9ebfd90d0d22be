"""tools/release/push_error.py: errors of true, of resting and of predicted bodies."""

import dataclasses
import json
import shutil

import numpy as np
import pytest
import torch

from gsim3d.data import Scene
from gsim3d.effects.spec import EffectsSpec
from gsim3d.errors import FitWarning
from gsim3d.synth import generate
from gsim3d.train.config import DataConfig, PhaseConfig, TrainConfig
from gsim3d.train.loop import Trainer
from gsim3d.train.restore import restore
from tools.release.push_error import main, moved_rigidly, scene_errors

pytestmark = pytest.mark.usefixtures("one_thread")
CONFIG = TrainConfig(
    model={"dynamics": {"actions": ["pusher"]}},
    effects={"dynamics": {"actions": ["pusher"]}},
    phases=(PhaseConfig(steps=1, horizon=2, target_views=1),),
    data=DataConfig(history=2, context_views=2, background_stride=3),
)
OPTIONS = {"image_size": 32, "n_frames": 14, "n_cams": 4, "n_trajectories": 2, "samples": 1, "n_bodies": (1, 1)}


def test_rigid_motion_is_found():
    rng = np.random.default_rng(0)
    points, (turn, _) = rng.normal(size=(20, 3)), np.linalg.qr(rng.normal(size=(3, 3)))
    turn *= np.linalg.det(turn)
    point = np.array([0.1, 0.2, 0.3])
    np.testing.assert_allclose(moved_rigidly(point, points, points @ turn.T + 2), turn @ point + 2)


def test_errors_of_a_simulator_that_moves_nothing_are_those_of_constant(tmp_path, capsys):
    folders = generate(tmp_path / "data", "push", processes=1, progress=False, **OPTIONS).folders
    trainer = Trainer(CONFIG, [Scene.open(folder) for folder in folders], tmp_path / "run")
    trainer.save()
    main([str(tmp_path / "run"), str(tmp_path / "data"), "--out", str(tmp_path / "new" / "errors.json")])
    found = json.loads((tmp_path / "new" / "errors.json").read_text())
    assert len(found["scenes"]) == 2 and "2 scenes, 0 left out" in capsys.readouterr().out
    both = sorted(errors["constant"] for errors in found["scenes"].values())
    assert found["median"]["constant"] == pytest.approx([sum(both) / 2, *both])  # interval of two values
    for folder in folders:
        center = np.load(folder / "states.npz")["body_0"][:, 0]
        errors = found["scenes"][folder.relative_to(tmp_path / "data").as_posix()]
        assert errors["constant"] == pytest.approx(np.linalg.norm(center[13] - center[1]), abs=1e-6)
        assert errors["model"] == pytest.approx(errors["constant"], abs=1e-4)
    restored = restore(tmp_path / "run")
    (tmp_path / "silent").mkdir()
    shutil.copytree(folders[0], tmp_path / "silent" / "box", ignore=shutil.ignore_patterns("actions.npz"))
    with pytest.warns(FitWarning, match="no actors, because the scene has no actions.npz"):
        restored.open_scene(tmp_path / "silent" / "box")
    plain = dataclasses.replace(restored, plan=restored.simulator.plan(EffectsSpec()))
    with pytest.warns(FitWarning, match="actors ignored, because the model was not trained with dynamics.actions"):
        plain.open_scene(folders[0])
    scene, moved = restored.open_scene(folders[0]), torch.tensor([0.3, 0.0, 0.0])
    roll = restored.simulator.rollout

    def shifted(*given, **options):
        steps = roll(*given, **options)
        return [dataclasses.replace(step, means=step.means + moved) for step in steps]

    restored.simulator.rollout = shifted
    center = np.load(folders[0] / "states.npz")["body_0"][:, 0]
    wanted = np.linalg.norm(center[1] + moved.numpy() - center[13])
    assert scene_errors(restored, scene)["model"] == pytest.approx(wanted, abs=1e-4)
