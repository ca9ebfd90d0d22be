"""The page of the paper's tables: measured within a budget, continued, compared with the last run."""

import dataclasses
import json
import shutil

import pytest
import torch

from gsim3d.baselines import BASELINES
from gsim3d.cli.main import main
from gsim3d.data import Scene, find_scenes
from gsim3d.evaluate.ablations import load_ablations
from gsim3d.evaluate.compare import paired
from gsim3d.evaluate.physics import true_states
from gsim3d.evaluate.protocol import score_scene
from gsim3d.evaluate.report import summarize
from gsim3d.io.files import read_yaml
from gsim3d.io.settings import from_dict
from gsim3d.reproduce import page, run
from gsim3d.reproduce.cells import from_json, to_json
from gsim3d.reproduce.entries import EDITED, ENTRIES, numbers_of_edits
from gsim3d.reproduce.run import NO_TIME, Job, reproduce
from gsim3d.synth import generate
from gsim3d.train.config import TrainConfig
from gsim3d.train.restore import restore
from tests.tiny_scenes import write_scenes

pytestmark = pytest.mark.usefixtures("one_thread")
TRAINING = """
data: {history: 2, context_views: 2, target_only_cameras: [3], background_stride: 4}
phases:
  - {steps: 2, horizon: 1, target_views: 2}
"""
GRAPH = "model: {dynamics: {norm: layer, graph: {channels: 16, layers: 1}}}"
MAIN = "Main table"


@pytest.fixture(scope="module")
def work(tmp_path_factory, one_thread):
    """The sets of a world, and two models: "two" is a graph network."""
    root = tmp_path_factory.mktemp("work")
    write_scenes(root / "sets" / "elastic", 2)
    write_scenes(root / "sets" / "elastic-train", 3)
    for name, network in {"one": "", "two": GRAPH}.items():
        (root / f"{name}.yaml").write_text(TRAINING + network)
        where = {"--data": "sets/elastic-train", "--out": f"runs/{name}", "--export": f"{name}.safetensors"}
        options = [text for option, path in where.items() for text in (option, str(root / path))]
        assert main(["train", str(root / f"{name}.yaml"), *options]) == 0
    return root


def made(work, out, *models, **options) -> tuple[dict, dict, list]:
    """(content, lines by table and row, what was measured) of a call."""
    said = []
    models = [str(work / f"{name}.safetensors") for name in models or ("one",)]
    content, files = reproduce(Job(str(out), models, data=str(work / "sets"), **options), "command", said.append)
    assert all(file.stat().st_size for file in files)
    return content, {(line["table"], line["row"]): line for line in content["lines"]}, said


@pytest.fixture(scope="module")
def first(work):
    return made(work, work / "out", "one", "two")


def test_every_row_that_the_data_allow(first, work):
    content, lines, _ = first
    main_rows = [row for table, row in lines if table == MAIN]
    assert main_rows == ["one", "constant", "copy", "constant_velocity", "two"]
    assert {("Speed", "one"), ("Edits", "two"), ("History length at inference", "two, history 1")} <= lines.keys()
    assert lines[MAIN, "one"]["paper_other_data"] == "33.15 ± 3.51" and not lines[MAIN, "copy"]["paper_other_data"]
    assert lines[MAIN, "two"]["numbers"]["step_ms"] == lines["Speed", "two"]["numbers"]["step_ms"] > 0
    assert lines[MAIN, "two"]["numbers"]["parameters"] > lines[MAIN, "constant"]["numbers"]["parameters"] == 0
    edits = lines["Edits", "one"]["numbers"]  # too short for a fall, and without known states
    assert edits.keys() == {"through", "shape_cm", "copies_cm", "above_cm"}
    page, missing = (work / "out" / "reproduce.md").read_text(), " ".join(content["missing"])
    for text in ("momentum [m/s] | two", "other data", "(figures/main-table-elastic-curves.png)"):
        assert text in page, text
    assert "needs --device cuda: spring-gaus (2), spring-gaus-given (2)" in missing
    assert "trained with 2 input steps of 2 cameras: one, history 2 (2)" in missing
    fewer = page.split("## Input cameras")[1].split("##")[0]
    assert fewer.index("| two |") < fewer.index("| two, cameras 1 |") and "| one, cameras 1 |" in fewer


def test_numbers_of_edits(tmp_path):
    """A rigid body of which a tenth goes on through the ground; its copy is 10 % lower at the end."""
    options = {"n_trajectories": 1, "n_frames": 6, "objects": ("capsule",), "processes": 1, "progress": False}
    scene = Scene.open(generate(tmp_path, "elastic", preset="published", **options).folders[0])
    body = true_states(scene)[0][2].double().flatten(0, -2).mean(0) + 0.1 * torch.randn(
        100, 3, generator=torch.Generator().manual_seed(0)
    )
    still, lower = (torch.stack([body, body * torch.tensor(scale)]) for scale in ([1, 1, 1.0], [1, 1, 0.9]))
    fallen = torch.where(torch.arange(100)[:, None] < 10, torch.tensor([0, 0, -3.0]), 0.0)
    alone, raised = still.clone(), still.clone()
    alone[1] += fallen
    raised[1, :, 2] += 0.3 - body[:, 2].quantile(0.05)
    points = dict.fromkeys(EDITED, still) | {"as it is": alone, "ground raised": raised}
    points["duplicated"] = torch.cat([alone, lower], 1)
    found = numbers_of_edits(points, [1.0, 0.9], scene, 2)
    assert found["through"] == pytest.approx(100 * 20 / 400)
    assert found["shape_cm"] == pytest.approx(0, abs=1e-9) and found["true_cm"] == pytest.approx(0, abs=1e-4)
    assert 0.5 < found["copies_cm"] < 2
    assert found["above_cm"] == pytest.approx(10) and "fall" not in found
    points["ground raised"] = alone  # stays where it was, as if the ground were not there
    sunk = numbers_of_edits(points, [1.0, 0.9], scene, 2)
    assert sunk["through"] > found["through"]
    points["as it is"] = points["duplicated"] = points["ground raised"] = still - torch.tensor([0, 0, 9.0])
    assert numbers_of_edits(points, [1.0, 0.9], scene, 2).keys() == {"through", "true_cm"}


def test_scores_are_those_of_evaluate(first, work):
    restored, lines = restore(work / "one.safetensors"), first[1]
    scenes = [restored.open_scene(folder) for folder in find_scenes(work / "sets" / "elastic")]
    scores = [score_scene(restored, scene, target_cams=(3,), start=2) for scene in scenes]
    summary = summarize(scores)
    found = lines[MAIN, "one"]["numbers"]
    assert found["future.psnr_masked"] == pytest.approx(summary["future.psnr_masked"])
    assert found["past.psnr_masked"] == pytest.approx(summary["past.psnr_masked"])
    copied = lines[MAIN, "copy"]
    assert copied["numbers"]["future.ssim"] == pytest.approx(summary["copy.future.ssim"])
    pairs = [copied["by_scene"][scene] - value for scene, value in lines[MAIN, "one"]["by_scene"].items()]
    assert len(pairs) == 2 and copied["against_first"] == paired(pairs)
    again = summarize([from_json({**to_json(score, 2), "scene": scene.name}) for score, scene in zip(scores, scenes)])
    assert again["future.psnr"] == summary["future.psnr"] and again["past.ssim"] == summary["past.ssim"]


def test_a_shorter_history_predicts_the_same_steps(first, work):
    restored = restore(work / "one.safetensors")
    scene = restored.open_scene(find_scenes(work / "sets" / "elastic")[0])
    scores = to_json(score_scene(restored, scene, target_cams=(3,), start=2), 4)
    assert scores["n_encoded"] == 4 and scores["n_steps"] == scene.n_steps == len(scores["values"]["model"]["psnr"])
    assert scores["values"]["model"]["psnr"][:2] == [None, None]


@pytest.fixture
def no_curves(monkeypatch):
    """Drawing is slow."""
    monkeypatch.setattr(page, "write_curves", lambda path, *content: path.write_text("curves"))


def test_the_next_call_continues(first, work, tmp_path, no_curves):
    out = tmp_path / "out"
    shutil.copytree(work / "out", out)
    (cell,) = (out / "cells" / MAIN.replace(" ", "-") / "elastic" / "two").glob("*0001.json")
    cell.write_text(cell.read_text()[:-20])
    content, lines, said = made(work, out, "one", "two")
    assert len(said) == 1 and "two, ball/0001" in said[0]
    assert lines[MAIN, "two"]["by_scene"] == first[1][MAIN, "two"]["by_scene"]


def test_another_machine_measures_times_alone(first, work, tmp_path, no_curves, monkeypatch):
    shutil.copytree(work / "out", tmp_path / "out")
    facts = {**run.machine(torch.device("cpu")), "device": "another", "processor": "other"}
    monkeypatch.setattr(run, "machine", lambda device: facts)
    said = made(work, tmp_path / "out", "one", "two")[2]
    assert len(said) == 2 and all(line.startswith("Speed") for line in said)
    facts["sources"] = "of other code"
    assert len(made(work, tmp_path / "out")[2]) > 2


def test_other_weights_are_compared_with_the_last_run(first, work, tmp_path, no_curves):
    shutil.copytree(work / "out", tmp_path / "out")
    shutil.copytree(work / "sets", tmp_path / "sets")
    shutil.copy(work / "two.safetensors", tmp_path / "one.safetensors")
    _, lines, said = made(tmp_path, tmp_path / "out", steps=None)
    one, two, now = first[1][MAIN, "one"], first[1][MAIN, "two"], lines[MAIN, "one"]
    assert said and now["by_scene"] == pytest.approx(two["by_scene"])
    change = two["numbers"]["future.psnr_masked"] - one["numbers"]["future.psnr_masked"]
    assert now["since_last"] == pytest.approx(change) and change != 0
    assert lines[MAIN, "copy"]["since_last"] == 0 and one["since_last"] is None


def test_a_budget_that_ends_lists_what_is_missing(first, work, tmp_path, no_curves):
    shutil.copytree(work / "out", tmp_path / "before")
    content, lines, said = made(work, tmp_path / "before", "one", "two", budget=1e-9)
    assert len(lines) == len(first[1]) and not said
    content, lines, said = made(work, tmp_path / "out", budget=1e-9)
    assert not lines and not said
    assert any(NO_TIME in line and "one (2)" in line for line in content["missing"])
    assert f"{MAIN}, elastic: {NO_TIME}" in (tmp_path / "out" / "reproduce.md").read_text()


def test_training(work, tmp_path, monkeypatch, no_curves):
    few = {name: load_ablations()[1][name] for name in ("latent", "calls-1")}
    base = from_dict(TrainConfig, read_yaml(work / "one.yaml"))
    monkeypatch.setattr(run, "load_ablations", lambda: ({"tiny": base}, few))
    content, lines, said = made(work, tmp_path / "out", train=1, trajectories=1)
    assert ("Ablations", "latent: the base run") in lines and (MAIN, "trained here") in lines
    assert made(work, tmp_path / "out", train=1, trajectories=1)[2] == []


def test_fitted_methods_are_rows(work, tmp_path, monkeypatch, no_curves):
    few = {"anchors": 64, "neighbors": 8, "edge": 0.05, "substeps": 5, "static_iterations": 24, "ground_iterations": 8}
    few |= {"refine_iterations": 2, "velocity_iterations": 2, "dynamic_iterations": 2}
    monkeypatch.setitem(BASELINES, "spring-gaus", dataclasses.replace(BASELINES["spring-gaus"], **few))
    fitted = [dataclasses.replace(entry, device=None) for entry in ENTRIES[:2]]
    monkeypatch.setattr(run, "ENTRIES", fitted)
    monkeypatch.setenv("GSIM3D_CACHE_DIR", str(tmp_path / "no weights"))  # of LPIPS, which is scored where it is there
    _, lines, _ = made(work, tmp_path / "out", trajectories=1)
    row = lines[MAIN, "spring-gaus"]
    assert row["numbers"]["future.psnr_masked"] > 10 and row["seed"] is None
    assert row["numbers"].keys() - lines[MAIN, "copy"]["numbers"].keys() == {"substeps", "seconds"}
    assert row["numbers"]["parameters"] > 8 * 64**2 and lines[MAIN, "copy"]["numbers"]["parameters"] == 0
    cell = json.loads(
        next((tmp_path / "out" / "cells" / "Main-table" / "elastic" / "spring-gaus").iterdir()).read_text()
    )
    assert 0 < row["numbers"]["seconds"] < cell["seconds"]  # that of scoring does not count
    found = page.Line(None, "", row["numbers"], {}, {"n_future_steps": 4})
    assert page._seconds(found) == row["numbers"]["seconds"] / 4
    assert row["numbers"]["substeps"] >= 5 and "| substeps a frame |" in (tmp_path / "out" / "reproduce.md").read_text()
    alone = lines[MAIN, "spring-gaus-object"]
    fitted = {"substeps", "seconds", "parameters"}
    assert {"future.psnr", "future.ssim", *fitted} == alone["numbers"].keys() and not alone["by_scene"]


@pytest.mark.parametrize(
    "arguments, message",
    [
        (["--worlds", "elastik"], "'elastik' does not exist; choose from elastic"),
        (["--data", "{work}/none"], "none is not a folder"),
        (["rigid={work}/one.safetensors"], "'rigid' is not among the worlds elastic"),
        (["{work}/one.safetensors", "{work}/runs/../one.safetensors"], "two models named one"),
        (["--preset", "small"], "is the base run of --train"),
        (["--train", "1"], "at least 2"),
        (["{work}/none.safetensors"], "no such checkpoint"),
    ],
)
def test_bad_options(capsys, work, tmp_path, arguments, message):
    given = [text.format(work=work) for text in arguments]
    options = ["--out", str(tmp_path / "out"), *([] if "--data" in given else ["--data", str(work / "sets")])]
    assert main(["reproduce", *given, *options]) == 2
    errors = capsys.readouterr().err
    assert message in errors and errors.count("\n") == 1
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_a_shipped_simulator_in_three_minutes(tmp_path):
    options = ["--worlds", "elastic", "--trajectories", "1", "--steps", "4", "--budget", "3"]
    assert main(["reproduce", "--out", str(tmp_path), *options]) == 0
    content = json.loads((tmp_path / "reproduce.json").read_text())
    lines = {(line["table"], line["row"]): line["numbers"] for line in content["lines"]}
    assert all("needs --device cuda" in line or NO_TIME in line for line in content["missing"]), content["missing"]
    model, still = lines[MAIN, "elastic-small"], lines[MAIN, "constant"]
    assert model["future.psnr_body"] > still["future.psnr_body"] + 2 and model["step_ms"] > 0
    cell = json.loads(next((tmp_path / "cells" / "Main-table").rglob("*.json")).read_text())["result"]["scores"]
    fall, true = (cell["physics"]["model"][name] for name in ("momentum", "true momentum"))  # of free fall
    assert fall == pytest.approx(true, rel=0.1) and true[-1] > true[0] > 0.5
