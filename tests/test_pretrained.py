"""Names of simulators stand for checkpoints; what is shipped is whole, small and described."""

import json
import re

import pytest
import torch
from safetensors.torch import load_file

from gsim3d import pretrained
from gsim3d.cli.main import main
from gsim3d.errors import InputError
from gsim3d.io import checkpoint
from gsim3d.numerics.speed import SPEEDS_FILE
from gsim3d.numerics.trust import TRUST_FILE
from gsim3d.testing.invariances import INVARIANCES
from gsim3d.train.restore import restore
from tests.tiny_scenes import write_scenes

PARTS = {"model.safetensors", "config.yaml", "training.jsonl", "recipe.json", "scores.json", "README.md"}
FIELDS = [
    "Intended use", "Inputs and outputs", "How to load", "Training data and compute", "Evaluation", "Limitations",
    "Licence and version",
]  # fmt: skip
MOST_BYTES = 25_000_000  # of all weights together


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.setattr(pretrained, "FOLDER", tmp_path)
    return tmp_path


def test_name_is_the_simulator_and_a_path_the_file(folder, monkeypatch):
    (folder / "ball-tiny").mkdir()
    assert pretrained.names() == []
    (folder / "ball-tiny" / pretrained.WEIGHTS).write_bytes(b"")
    assert pretrained.names() == ["ball-tiny"]
    assert pretrained.located("ball-tiny") == folder / "ball-tiny" / pretrained.WEIGHTS
    monkeypatch.chdir(folder)
    assert pretrained.located("ball-tiny") == pretrained.Path("ball-tiny", pretrained.WEIGHTS)
    assert pretrained.located(folder) == folder


@pytest.mark.parametrize("name", ["ball-tiny", "ball-tiny/model.safetensors", "../ball-tiny", ""])
def test_unknown_name_lists_the_known_ones(folder, name):
    (folder / "cube-tiny").mkdir()
    (folder / "cube-tiny" / pretrained.WEIGHTS).write_bytes(b"")
    if name:
        with pytest.raises(InputError, match="no such checkpoint.*: cube-tiny"):
            checkpoint.load(name)
    else:
        with pytest.raises(InputError, match="not a checkpoint"):
            checkpoint.load(name)  # the current folder


@pytest.mark.parametrize(
    "command",
    [
        ["simulate", "ball-small", "x", "--out", "y"],
        ["evaluate", "ball-small", "x"],
        ["doctor", "--stability", "ball-small"],
    ],
)
def test_commands_name_unknown_models(command, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(command) == 2
    assert "ball-small: no such" in capsys.readouterr().err


@pytest.mark.parametrize("name", pretrained.names())
def test_shipped_models_are_complete_and_described(name):
    folder = pretrained.FOLDER / name
    assert {path.name for path in folder.iterdir()} - {pretrained.LAWS, TRUST_FILE} == {*PARTS, SPEEDS_FILE}
    weights = load_file(folder / pretrained.WEIGHTS)
    assert all(value.dtype == torch.bfloat16 for value in weights.values())
    assert all(bool(value.isfinite().all()) for value in weights.values())
    restored = restore(name)
    assert list(json.loads((folder / SPEEDS_FILE).read_text())) == [restored.checkpoint.digest]
    assert restored.image_size == (128, 128)
    recipe, scores = (json.loads((folder / f"{part}.json").read_text()) for part in ("recipe", "scores"))
    steps = [json.loads(line)["step"] for line in (folder / "training.jsonl").read_text().splitlines()]
    assert steps == sorted(steps) and steps[-1] < recipe["steps"]
    card = (folder / "README.md").read_text()
    assert f"{recipe['steps']:,}" in card and f"{scores['held_out']['future.psnr_masked']:.2f}" in card
    fields = re.findall(r"^## (.*)", card, re.MULTILINE)
    assert fields == FIELDS
    limitations = card.split("## Limitations\n")[1].split("\n## ")[0]
    assert 3 <= len(re.findall(r"^- ", limitations, re.MULTILINE)) <= 5


@pytest.mark.parametrize("name", pretrained.names())
def test_violated_invariances_stand_in_the_model_card(name):
    laws = pretrained.known_failures(pretrained.located(name))
    assert set(laws) <= set(INVARIANCES)
    card = (pretrained.FOLDER / name / "README.md").read_text()
    assert ("### Invariances that it violates" in card) == bool(laws)
    for law, found in laws.items():
        assert found["error"] > found["bound"]
        assert f"| {law} | {found['what']} | {found['error']:.3g} | {found['bound'] or 'equal bits'} |" in card


def test_other_checkpoints_have_no_known_failures(folder):
    (folder / "ball-tiny").mkdir()
    assert pretrained.known_failures(folder / "ball-tiny" / pretrained.WEIGHTS) == {}
    assert pretrained.known_failures(folder / "elsewhere" / "run" / pretrained.WEIGHTS) == {}


def test_shipped_files_are_small():
    sizes = [(pretrained.FOLDER / name / pretrained.WEIGHTS).stat().st_size for name in pretrained.names()]
    assert sum(sizes) <= MOST_BYTES


def test_a_folder_of_a_shipped_simulator_is_a_checkpoint():
    name = pretrained.names()[0]
    assert checkpoint.load(pretrained.FOLDER / name).digest == checkpoint.load(name).digest


def test_evaluate_keeps_a_report_of_a_shipped_simulator(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "metrics.json").write_text("kept")
    write_scenes(tmp_path / "data", 1)
    assert main(["evaluate", pretrained.names()[0], "data", "--scenes", "all"]) == 2
    assert "--out: metrics.json exists already" in capsys.readouterr().err
    assert (tmp_path / "metrics.json").read_text() == "kept"
