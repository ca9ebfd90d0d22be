"""Training with a vision transformer: two steps, resumed, saved, loaded, planned; features kept; published weights."""

import dataclasses

import pytest
import torch
from safetensors.torch import save_file

from gsim3d import Simulator
from gsim3d.cli.main import main
from gsim3d.data import Scene, find_scenes
from gsim3d.errors import InputError
from gsim3d.nn.multiview_encoder import Encoder
from gsim3d.train import captured as captured_module
from gsim3d.train.config import DataConfig, OptimizerConfig, PhaseConfig, TrainConfig
from gsim3d.train.features import FeatureCache
from gsim3d.train.loop import Trainer, deterministic
from gsim3d.train.restore import restore
from tests.asserts import assert_same_bits
from tests.tiny_scenes import write_scenes

pytestmark = pytest.mark.usefixtures("one_thread")

CONFIG = TrainConfig(
    phases=(PhaseConfig(steps=2, horizon=1, batch=2, target_views=2, learning_rate=1e-3),),
    model={"encoder": {"backbone": "vit_dpt", "vit": {"model": "tiny", "image_size": 28, "feature_dim": 8}}},
    data=DataConfig(history=2, context_views=2, target_only_cameras=(3,), background_stride=2),
    optimizer=OptimizerConfig(ema_decay=0.9),
)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return write_scenes(tmp_path_factory.mktemp("scenes"), 2)


@pytest.fixture(scope="module")
def scenes(folder):
    return [Scene.open(path) for path in find_scenes(folder)]


@pytest.fixture(scope="module")
def finished(scenes, tmp_path_factory, one_thread):
    out = tmp_path_factory.mktemp("run")
    Trainer(CONFIG, scenes, out).run(progress=False)
    return out


def test_only_parts_that_are_not_frozen_learn(scenes, finished, tmp_path):
    trained, start = restore(finished).checkpoint.model, Trainer(CONFIG, scenes, tmp_path).simulator.state_dict()
    frozen = ("encoder.depth.backbone.", "encoder.depth.camera_encoder.")
    kept = {name for name, value in start.items() if name.startswith("encoder.") and torch.equal(value, trained[name])}
    assert kept == {name for name in start if name.startswith(frozen)}


def test_a_resumed_run_has_the_same_bits(scenes, finished, tmp_path):
    Trainer(CONFIG, scenes, tmp_path).run(until=1, progress=False)
    Trainer(CONFIG, scenes, tmp_path).run(progress=False)
    again = restore(tmp_path).checkpoint.model
    for name, value in restore(finished).checkpoint.model.items():
        assert_same_bits(again[name], value, name)


def test_features_that_were_kept_change_no_bit(scenes, tmp_path):
    with_cache, without = (Trainer(CONFIG, scenes, tmp_path / name) for name in "ab")
    without.features = None
    for trainer in (with_cache, without):
        with deterministic():
            trainer.entries = [trainer.train_step() for _ in range(2)]
    assert [entry["loss"] for entry in with_cache.entries] == [entry["loss"] for entry in without.entries]
    for a, b in zip(with_cache.simulator.parameters(), without.simulator.parameters(), strict=True):
        assert_same_bits(a, b)


def test_saved_loaded_predicted_and_planned(folder, finished, tmp_path, capsys):
    simulator = Simulator.from_pretrained(finished)
    again = Simulator.from_pretrained(simulator.save_pretrained(tmp_path / "saved"))
    assert again.config == simulator.config and again.config.encoder.backbone == "vit_dpt"
    scene = Scene.open(find_scenes(folder)[0])
    for one, other in zip(*(s.predict(scene, 2).steps for s in (simulator, again)), strict=True):
        assert_same_bits(one.means, other.means)
    assert main(["plan", str(find_scenes(folder)[0]), str(finished)]) == 0
    assert "moving and" in capsys.readouterr().out


def test_every_input_is_computed_once(scenes, tmp_path):
    trainer = Trainer(CONFIG, scenes, tmp_path)
    batch, seen = trainer._draw(0, (0, 1)), []
    trainer.simulator.encoder.depth.backbone.register_forward_hook(lambda *_: seen.append(1))
    frames = batch.context
    first = trainer.features(frames)
    assert len(seen) == len(frames.cloud_scene) == 4
    assert_same_bits(trainer.features(frames).backbone_features, first.backbone_features)
    assert len(seen) == 4
    images = frames.images.clone()
    images[0, 0, 5, 5] += 1e-3
    assert not torch.equal(
        trainer.features(dataclasses.replace(frames, images=images)).backbone_features, first.backbone_features
    )
    assert len(seen) == 5
    images[0, 0, 5, 5] = torch.nan  # left to the checks of the encoder
    assert trainer.features(dataclasses.replace(frames, images=images)).backbone_features is None
    one = FeatureCache(trainer.simulator.encoder, "cpu", most_bytes=1)
    one(frames), one(frames)
    assert len(seen) == 5 + 2 * 4 and one._n_bytes == first.backbone_features[:2].nbytes


def test_a_run_starts_from_published_weights(scenes, tmp_path):
    own = Encoder(Trainer(CONFIG, scenes, tmp_path / "a").simulator.config.encoder).depth.backbone.state_dict()
    save_file({name: torch.randn(value.shape) for name, value in own.items()}, tmp_path / "dinov2.safetensors")
    config = dataclasses.replace(CONFIG, pretrained_depth=str(tmp_path / "dinov2.safetensors"))
    trainer = Trainer(config, scenes, tmp_path / "b")
    trainer.run(until=1, progress=False)
    loaded = trainer.simulator.encoder.depth.backbone.state_dict()
    assert not torch.equal(loaded["cls_token"], own["cls_token"])
    assert_same_bits(trainer.average["encoder.depth.backbone.cls_token"], loaded["cls_token"])
    (tmp_path / "dinov2.safetensors").unlink()  # needed at the start only
    assert Trainer(config, scenes, tmp_path / "b").step == 1
    with pytest.raises(InputError, match=r"dinov2\.safetensors: no such file"):
        Trainer(config, scenes, tmp_path / "c")


def test_steps_of_a_graph_read_kept_features(scenes, tmp_path, monkeypatch):
    """The computation that a GPU captures, step by step on the CPU."""
    monkeypatch.setattr(captured_module, "FACTOR", 2.0)  # both batches fit into one graph
    config = dataclasses.replace(CONFIG, optimizer=OptimizerConfig(ema_decay=0))
    trainer, plain = Trainer(config, scenes, tmp_path / "a"), Trainer(config, scenes, tmp_path / "b")
    trainer.captured = trainer._capture()
    for _ in range(2):
        entries = [each.train_step() for each in (trainer, plain)]
        assert entries[0]["loss"] == pytest.approx(entries[1]["loss"], rel=1e-4)
    assert trainer.captured.captures == 1
