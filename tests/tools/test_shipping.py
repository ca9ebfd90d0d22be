"""From the state of a run to a simulator in the package: scores and model card."""

import importlib.util
import json
import math
import sys
import time
from pathlib import Path

import pytest
import yaml
from safetensors.torch import load_file

from gsim3d import pretrained
from gsim3d.errors import InputError
from gsim3d.synth.run import write_trajectory
from gsim3d.synth.worlds import TEST_SEED, build_world
from gsim3d.train.config import DataConfig, PhaseConfig, TrainConfig
from gsim3d.train.restore import restore
from tools.release import score
from tools.release.recipes import Recipe
from tools.release.runs import RunTrainer
from tools.release.state import Progress, save_state, weights_file
from tools.release.trajectories import TrajectoryStore

pytestmark = pytest.mark.usefixtures("one_thread")
ROOT = Path(__file__).parent.parent.parent
NAME, RUN = "elastic-small", "elastic-velocity"
OPTIONS = {"image_size": 32, "n_frames": 6, "objects": ("ball",)}
CONFIG = TrainConfig(
    phases=(PhaseConfig(steps=9, horizon=1, target_views=2),),
    data=DataConfig(history=2, context_views=2, target_only_cameras=(2, 7), background_stride=2),
    log_every=1,
)
MADE = Recipe(RUN, "elastic", CONFIG, options=OPTIONS)


def tool(name):
    spec = importlib.util.spec_from_file_location(name, ROOT / "tools" / "release" / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def scored(tmp_path_factory, one_thread):
    """A state after two steps, and its scores."""
    out = tmp_path_factory.mktemp("shipping")
    world = build_world("elastic", "diverse", OPTIONS)
    store = TrajectoryStore(world, 1, "cpu")
    store.put(**load_file(write_trajectory(world, ("ball", 0), str(out / "video.safetensors"))))
    trainer = RunTrainer(CONFIG, store, out / "run", "cpu")
    trainer.begin_run(time.monotonic() + 60)
    for _ in range(2):
        trainer.train_step()
    this = {"device": "cpu", "trajectories": 1, "steps": [0, 2], "seed": 4321}
    curve = [[step, 1, 0.5, 0.1, 20.0, math.nan, 1e-4] for step in range(2)]
    scores = [
        {"windows": n, "past": 20.0, "future": 15.0 + n, "body": 9.0, "constant": 14.0, "scenes": {}} for n in (1, 2)
    ]
    save_state(trainer, out / "state", RUN, Progress(next_trajectory=1, runs=[this], curve=curve, scores=scores))
    given = {"device": "cpu", "counts": (2, 1), "changes": {**OPTIONS, "objects": ("ball",)}}
    score.score(weights_file(out / "state", RUN), NAME, out / "trajectories", out / "scores", **given)
    return out


@pytest.fixture
def package(tmp_path, monkeypatch):
    monkeypatch.setattr(pretrained, "FOLDER", tmp_path / "pretrained")
    pretrained.FOLDER.mkdir()
    module = tool("ship_model")
    monkeypatch.setattr(module, "PICTURES", tmp_path)
    monkeypatch.setattr(module, "recipe", lambda *_: MADE)
    return module


def test_all_sets_are_scored_over_the_full_horizon(scored):
    scores = json.loads((scored / "scores" / f"{NAME}.scores.json").read_text())
    counts = {name: s["n_scenes"] for name, s in scores.items() if isinstance(s, dict)}
    assert counts == {"held_out": 2, "unseen": 1, "several": 1, "no-ground": 1, "raised": 1}
    assert scores["held_out"]["n_future_steps"] == 4 and "constant" in scores["raised"]["methods"]
    assert (scored / "scores" / f"{NAME}.frames.png").read_bytes().startswith(b"\x89PNG")


def test_some_sets_are_measured_anew(scored, tmp_path):
    file = tmp_path / f"{NAME}.scores.json"
    before = json.loads((scored / "scores" / file.name).read_text())
    file.write_text(json.dumps({**before, "raised": {"n_scenes": 5}, "unseen": {"n_scenes": 6}}))
    weights = next((scored / "state").glob("*.weights.safetensors"))
    given = {"device": "cpu", "counts": (2, 1), "changes": {**OPTIONS, "objects": ("ball",)}, "subsets": ["raised"]}
    score.score(weights, NAME, scored / "trajectories", tmp_path, **given)
    after = json.loads(file.read_text())
    assert after["raised"]["n_scenes"] == 1 and after["unseen"] == {"n_scenes": 6}
    assert after["raised"]["set"]["name"] == "validation" and after["raised"]["set"]["subset"] == "raised"
    score.score(weights, NAME, scored / "trajectories", tmp_path, held_out="test", **given)
    assert json.loads(file.read_text()) == after
    test = json.loads((tmp_path / f"{NAME}.test.scores.json").read_text())
    assert test["raised"]["set"]["seed"] == TEST_SEED and test["raised"]["scenes"] != after["raised"]["scenes"]
    file.write_text(json.dumps({**before, "checkpoint": "0"}))
    with pytest.raises(InputError, match="of other weights"):
        score.score(weights, NAME, scored / "trajectories", tmp_path, **given)


def test_state_becomes_simulator_with_card(scored, package, tmp_path):
    (tmp_path / "limitations.md").write_text("- It floats.\n")
    paths = ["--state", str(scored / "state"), "--scores", str(scored / "scores")]
    with pytest.raises(InputError, match="--limitations is needed"):
        package.main([NAME, *paths])
    package.main([NAME, *paths, "--limitations", str(tmp_path / "limitations.md")])
    folder = pretrained.FOLDER / NAME
    names = {path.name for path in folder.iterdir()}
    assert names == {"model.safetensors", "config.yaml", "training.jsonl", "recipe.json", "scores.json", "README.md"}
    assert restore(NAME).checkpoint.state["step"] == 2
    steps = [json.loads(line) for line in (folder / "training.jsonl").read_text().splitlines()]
    assert [(step["step"], step["past_psnr"], step["machine"]) for step in steps] == [
        (0, 20.0, {"seconds": 0.5}), (1, 20.0, {"seconds": 0.5})
    ]  # fmt: skip
    text = (folder / "README.md").read_text()
    scores = json.loads((folder / "scores.json").read_text())
    assert "## Limitations\n\n- It floats.\n\n## Licence" in text and "--seed 4321" in text
    assert "- Dynamics: point transformer, " in text
    assert f"{scores['unseen']['future.psnr_masked']:.2f}" in text and "2 optimizer steps (0 windows)" in text
    assert f"| {scores['held_out']['past.psnr_masked']:.2f} | " in text
    kept = json.loads((folder / "recipe.json").read_text())["scores"]
    assert [entry["future"] for entry in kept] == [16.0, 17.0] and "scenes" not in kept[0]
    assert (tmp_path / f"{NAME}-windows.png").read_bytes().startswith(b"\x89PNG")
    assert (tmp_path / f"{NAME}.png").is_file() and (tmp_path / f"{NAME}-frames.png").is_file()
    package.main([NAME, *paths])  # keeps the limitations
    assert (folder / "README.md").read_text() == text
    described, measured = (json.loads((folder / name).read_text()) for name in ("recipe.json", "scores.json"))
    config = yaml.safe_load((folder / "config.yaml").read_text())
    config["model"]["dynamics"]["actions"] = ["pusher"]
    acting = package.card(NAME, described, measured, config, "- It floats.\n")
    assert (
        "actors" not in text
        and "\n- Input: positions of its actors at all steps, also of the future: pusher.\n" in acting
    )


def test_scores_of_other_weights_are_refused(scored, package, tmp_path):
    content = json.loads((scored / "scores" / f"{NAME}.scores.json").read_text())
    (tmp_path / f"{NAME}.scores.json").write_text(json.dumps({**content, "checkpoint": "0"}))
    with pytest.raises(InputError, match="of other weights"):
        package.ship(NAME, MADE, scored / "state", tmp_path, "")
    assert pretrained.names() == []


def test_violated_laws_come_from_reports(scored, package, tmp_path):
    (tmp_path / "limitations.md").write_text("- It floats.\n")
    paths = ["--state", str(scored / "state"), "--scores", str(scored / "scores")]
    package.main([NAME, *paths, "--limitations", str(tmp_path / "limitations.md")])
    for number, error in enumerate((0.51234, 0.2)):
        failures = [{"what": "encode means", "error": error, "bound": 1e-4, "where": "camera 0"}]
        findings = [{"check": "translate", "failures": failures}, {"check": "other", "failures": failures}]
        (tmp_path / str(number)).mkdir()
        (tmp_path / str(number) / "report.json").write_text(json.dumps({"findings": findings}))
    package.main([NAME, "--laws", str(tmp_path / "1"), str(tmp_path / "0")])
    folder = pretrained.FOLDER / NAME
    found = json.loads((folder / pretrained.LAWS).read_text())
    assert found == {"translate": {"what": "encode means", "error": 0.512, "bound": 1e-4}}
    assert "| translate | encode means | 0.512 | 0.0001 |" in (folder / "README.md").read_text()
    (tmp_path / "1" / "report.json").write_text(json.dumps({"findings": []}))
    package.main([NAME, "--laws", str(tmp_path / "1")])
    assert not (folder / pretrained.LAWS).exists() and "translate" not in (folder / "README.md").read_text()
