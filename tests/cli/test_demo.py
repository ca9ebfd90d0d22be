"""The demo at a minimal size: everything is written, a second call goes on and repeats nothing."""

import dataclasses
import json

import pytest

from gsim3d.errors import InputError
from gsim3d.evaluate.demo import DemoConfig, comparisons, run_demo
from gsim3d.io import checkpoint
from gsim3d.train.config import PhaseConfig, TrainConfig
from gsim3d.train.restore import model_config

pytestmark = pytest.mark.usefixtures("one_thread")

DATA = {"n_trajectories": 2, "n_frames": 6, "image_size": 32, "processes": 1, "objects": ("ball",)}
PHASES = (
    PhaseConfig(steps=2, history=1, batch=2, target_views=2, learning_rate=1e-3),
    PhaseConfig(steps=2, horizon=2, target_views=2, learning_rate=1e-3),
)
FILES = ["gaussians", "metrics.json", "model", "model.safetensors", "overview.png", "psnr.png", "rollout.mp4"]


def small_config() -> DemoConfig:
    return DemoConfig(data=DATA, train=dataclasses.replace(DemoConfig().train, phases=PHASES))


@pytest.fixture(scope="module")
def finished(tmp_path_factory, one_thread):
    out = tmp_path_factory.mktemp("demo")
    return out, run_demo(out, small_config(), progress=False)


def test_everything_is_written(finished):
    out, summary = finished
    names = sorted(path.name for path in out.iterdir())
    assert set(FILES) <= set(names) and not [name for name in names if "part" in name]
    metrics = json.loads((out / "metrics.json").read_text())
    assert metrics == summary and metrics["n_scenes"] == 1 and metrics["n_future_steps"] == 4
    assert all(isinstance(value, float) for _, *values in comparisons(metrics) for value in values)
    assert len(list((out / "gaussians").glob("step_*.ply"))) == 6
    for name in ("psnr.png", "overview.png"):
        assert (out / name).read_bytes().startswith(b"\x89PNG")
    assert any(codec in (out / "rollout.mp4").read_bytes() for codec in (b"avc1", b"vp09"))


def test_scenes_are_fitted_to_the_simulator(tmp_path):
    """One that was trained with a depth range of its own predicts as well in a demo that does not train."""
    train = small_config().train
    train = dataclasses.replace(train, data=dataclasses.replace(train.data, near_far=(2.0, 4.5)))
    learned = run_demo(tmp_path / "learned", dataclasses.replace(small_config(), train=train), progress=False)
    given = DemoConfig(data=DATA, simulator=str(tmp_path / "learned" / "model.safetensors"))
    summary = run_demo(tmp_path / "given", given, progress=False)
    ((name, scores),) = learned["scenes"].items()
    assert summary["scenes"][name] == scores and summary["n_scenes"] == 2


def test_a_second_call_repeats_nothing(finished, capsys):
    out, summary = finished
    written = [*(name for name in FILES if name != "model"), "model/checkpoints"]
    before = {name: (out / name).stat().st_mtime_ns for name in written}
    assert run_demo(out, small_config(), progress=False) == summary
    assert {name: (out / name).stat().st_mtime_ns for name in written} == before
    printed = capsys.readouterr().out
    assert "against constant" in printed and "against copy" in printed and "GiB" in printed


def test_stopped_in_the_middle_it_goes_on(finished, tmp_path, capsys):
    out, summary = finished
    (tmp_path / "data").symlink_to(out / "data")
    config = small_config()

    from gsim3d.data import Scene, find_scenes, split_scenes
    from gsim3d.train.loop import Trainer

    scenes = [Scene.open(path) for path in split_scenes(find_scenes(out / "data"))[0]]
    Trainer(config.train, scenes, tmp_path / "model").run(until=3, progress=False)
    resumed = run_demo(tmp_path, config, progress=False)
    assert "resuming at step 3" in capsys.readouterr().out
    weights, expected = (checkpoint.load(folder / "model").weights for folder in (tmp_path, out))
    assert all((weights[name] == expected[name]).all() for name in expected)
    assert resumed["by_step"] == summary["by_step"]


def test_other_settings_do_not_mix(finished):
    out, _ = finished
    with pytest.raises(InputError, match="different 'seed'"):
        other = small_config()
        run_demo(out, dataclasses.replace(other, train=dataclasses.replace(other.train, seed=9)), progress=False)


def test_the_real_settings_are_what_the_demo_promises():
    from gsim3d.synth.worlds import build_world

    config = DemoConfig()
    world = build_world("elastic", "mini", config.data)
    assert world.n_cams == 12 and world.image_size == 64 and world.fps >= 12 and world.n_trajectories >= 28
    assert world.n_frames - config.train.data.history >= 16
    assert len(config.train.data.target_only_cameras) == 2 and isinstance(config.train, TrainConfig)
    model_config(config.train)


def test_a_trained_simulator_needs_no_training(finished, tmp_path, capsys):
    out, _ = finished
    data = {**DATA, "n_trajectories": 1, "seed": 3}
    config = DemoConfig(preset="mini", data=data, simulator=str(out / "model.safetensors"))
    summary = run_demo(tmp_path, config, progress=False)
    names = {path.name for path in tmp_path.iterdir()}
    assert {"held_out", "metrics.json", "overview.png", "psnr.png", "rollout.mp4", "gaussians"} <= names
    assert not names & {"model", "data"} and summary["n_scenes"] == 1 and summary["n_future_steps"] == 4
    before = (tmp_path / "rollout.mp4").stat().st_mtime_ns
    assert run_demo(tmp_path, config, progress=False) == summary
    assert (tmp_path / "rollout.mp4").stat().st_mtime_ns == before
    assert "training" not in capsys.readouterr().out


@pytest.mark.parametrize("options, shipped", [([], True), (["--train"], False)])
def test_the_command_trains_when_asked_or_when_nothing_is_shipped(options, shipped, tmp_path, monkeypatch):
    from gsim3d.cli.main import main
    from gsim3d.evaluate import demo

    calls = []
    monkeypatch.setattr(demo, "run_demo", lambda out, config: calls.append(config))
    for known in ([demo.SHIPPED.simulator], []):
        monkeypatch.setattr("gsim3d.pretrained.names", lambda known=known: known)
        assert main(["demo", "--out", str(tmp_path), *options]) == 0
    assert calls == [demo.SHIPPED if shipped else DemoConfig(), DemoConfig()]
