"""The experiment on cut gradients: what the published checkpoints leave untrained is cut, and the table is written."""

import importlib.util
import json
import re
from pathlib import Path

import pytest
import torch

from gsim3d import presets
from gsim3d.train.config import DataConfig, OptimizerConfig, PhaseConfig, TrainConfig
from gsim3d.train.loop import Trainer
from gsim3d.train.restore import build_simulator
from tests.tiny_scenes import write_scenes
from tests.train.test_loop import scenes

pytestmark = pytest.mark.usefixtures("one_thread")
ROOT = Path(__file__).parents[2]
CUT = re.compile(r"dynamics\..*\.(norm1|norm2|attention|mlp)\.|encoder\.heads\.(conditioning|to_latents)\.")
RUN = TrainConfig(
    phases=(PhaseConfig(steps=2, horizon=2, target_views=1, learning_rate=1e-3),),
    model={"dynamics": {"zero_init": False}},
    data=DataConfig(context_views=2, background_stride=2),
    optimizer=OptimizerConfig(ema_decay=0),
)


@pytest.fixture(scope="module")
def tool():
    spec = importlib.util.spec_from_file_location("cut_gradients", ROOT / "tools" / "cut_gradients.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return write_scenes(tmp_path_factory.mktemp("scenes"), 3)


def test_attention_mlps_and_latents_get_no_gradient_and_all_else_does(tool, folder, tmp_path):
    gradients = {}
    for kind in ("kept", "cut"):
        trainer = Trainer(RUN, scenes(folder), tmp_path)
        if kind == "cut":
            tool.cut(trainer.simulator)
        loss, _, found, _ = trainer._gradients([0])
        gradients[kind] = dict(zip(trainer.parameters, found, strict=True)) | {"loss": loss}
    assert torch.equal(gradients["kept"].pop("loss"), gradients["cut"].pop("loss"))
    unused = set(trainer.plan.unused)
    for name, gradient in gradients["kept"].items():
        assert (gradient is None) == (name in unused), name
        assert (gradients["cut"][name] is None) == (name in unused or bool(CUT.match(name))), name


def test_the_share_that_is_never_trained_is_the_published_one(tool):
    """13.99 of 57.99 million parameters, with two unused embeddings."""
    simulator = build_simulator(presets.paper_latent(4, 64), 0)
    sizes = {name: parameter.numel() for name, parameter in simulator.named_parameters()}
    untrained = sum(size for name, size in sizes.items() if CUT.match(name) or name in simulator.plan().unused)
    assert untrained / 1e6 == pytest.approx(13.99, abs=0.005) and sum(sizes.values()) / 1e6 == pytest.approx(
        57.99, abs=0.005
    )


def test_out_of_minutes_it_stops_and_goes_on(tool, folder, tmp_path, capsys):
    arguments = ["--data", str(folder), "--out", str(tmp_path), "--seeds", "1"]
    tool.main([*arguments, "--minutes", "1e-9"], RUN)
    assert "cut_0: call again to go on" in capsys.readouterr().out and not (tmp_path / "metrics.json").exists()
    tool.main(arguments, RUN)
    assert "| cut | " in capsys.readouterr().out and (tmp_path / "metrics.json").exists()


def test_the_table_compares_both_over_the_seeds(tool, folder, tmp_path, capsys, monkeypatch):
    arguments = ["--data", str(folder), "--out", str(tmp_path), "--seeds", "2"]
    tool.main(arguments, RUN)
    first = capsys.readouterr().out
    results = json.loads((tmp_path / "metrics.json").read_text())
    assert [len(results[kind]) for kind in ("kept", "cut")] == [2, 2]
    assert results["kept"][0] != results["cut"][0] and results["kept"][0] != results["kept"][1]
    assert "| kept | " in first and " ± " in first
    monkeypatch.setattr(tool, "Trainer", None)  # what is scored is not trained again
    tool.main(arguments, RUN)
    assert json.loads((tmp_path / "metrics.json").read_text()) == results
    tool.main(["--picture", str(tmp_path), str(tmp_path / "cut.png")])
    assert (tmp_path / "cut.png").read_bytes().startswith(b"\x89PNG")
