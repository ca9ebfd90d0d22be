"""gsim3d doctor --stability: invariances and stress tests of a user's model and scenes."""

import dataclasses
import json
import sys
from pathlib import Path

import pytest
import torch

from gsim3d.cli.main import main
from gsim3d.compat.released_model import ReleasedSimulator
from gsim3d.data import Scene
from gsim3d.errors import InputError
from gsim3d.testing import stability
from gsim3d.testing.invariances import Deviation
from gsim3d.testing.stability import (
    CHECKS,
    check,
    check_stability,
    describe,
    load_sample,
    open_subject,
    random_sample,
    replay,
)
from tests.tiny_scenes import write_scene, write_scenes

pytestmark = pytest.mark.usefixtures("one_thread")

FEW = ("repeat", "what is not a number")


def job(out, *paths, **changes):
    return {"paths": tuple(map(str, paths)), "out": out, "n_steps": 2, "only": FEW, "quiet": True, **changes}


@pytest.fixture(scope="module")
def scenes(tmp_path_factory):
    return write_scenes(tmp_path_factory.mktemp("data"), 2, n_steps=3)


@pytest.fixture(scope="module")
def trained(tmp_path_factory, scenes):
    root = tmp_path_factory.mktemp("trained")
    settings = "data: {history: 2, context_views: 2}\nphases: [{steps: 1, horizon: 1, target_views: 1}]\n"
    (root / "train.yaml").write_text(settings)
    assert main(["train", str(root / "train.yaml"), "--data", str(scenes), "--out", str(root / "run")]) == 0
    return root / "run"


def test_random_model_passes_all_checks(tmp_path):
    report = check_stability(**job(tmp_path, only=()))
    assert report.healthy and [finding.check for finding in report.findings] == list(CHECKS)
    assert all(finding.n_compared > 0 for finding in report.findings)
    written = json.loads((tmp_path / "report.json").read_text())
    assert written["healthy"] and len(written["findings"]) == len(CHECKS)
    page = (tmp_path / "report.md").read_text()
    assert all(f"| {name} | holds |" in page for name in CHECKS)
    assert not list((tmp_path / "failures").iterdir())


def test_small_preset_passes_full_check(tmp_path, capsys):
    scenes = write_scenes(tmp_path / "data", 2, n_steps=2, size=16)
    arguments = ["--stability", "small", scenes, "--full", "--steps", "3", "--out", tmp_path / "report"]
    assert main(["doctor", *map(str, arguments)]) == 0, capsys.readouterr().out
    report = json.loads((tmp_path / "report" / "report.json").read_text())
    assert report["subject"]["preset"] == "small, random weights"
    assert [(finding["check"], finding["outcome"]) for finding in report["findings"]] == [(c, "holds") for c in CHECKS]
    assert all(finding["n_compared"] > 0 for finding in report["findings"])


def test_full_check_sample_size(tmp_path):
    folders = sorted((write_scenes(tmp_path, 2, n_steps=6, size=64) / "ball").iterdir())
    subject = open_subject("small")
    few, full = (stability.sample_of_scenes(subject, folders, full)[0].frames for full in (False, True))
    opened = [Scene.open(folder) for folder in folders]
    shown = sum(int((scene.segmentation([0, 1, 2, 3], range(4)) > 0).sum()) for scene in opened)
    assert len(few.images) == 2 * 2 * 3 and int(few.masks.sum()) <= len(few.images) * 150
    assert len(full.images) == 2 * 4 * 4 and int(full.masks.sum()) == shown > 10 * len(full.images) * 15


@pytest.mark.parametrize(
    "arguments, message",
    [
        (["--stability", "smal"], "smal: no such file or folder; did you mean small?"),
        (["--stability", "--full"], "--full needs scenes"),
        (["--stability", "small", "--full"], "--full needs scenes"),
        (["--device", "cuda"], "--only, --full and --device need --stability"),
        (["--only", "gradients"], "--only, --full and --device need --stability"),
    ],
)
def test_full_check_refuses_missing_scenes(tmp_path, capsys, arguments, message):
    assert main(["doctor", *arguments, "--out", str(tmp_path / "r")]) == 2
    assert message in capsys.readouterr().err


@pytest.mark.parametrize("terminal", [True, False])
def test_check_of_checkpoint_on_scenes(tmp_path, trained, scenes, capsys, monkeypatch, terminal):
    monkeypatch.setattr(sys.stderr, "isatty", lambda: terminal)
    arguments = [
        "--stability",
        trained,
        scenes,
        "--only",
        *FEW,
        "a long rollout",
        "--steps",
        "5",
        "--out",
        tmp_path / "r",
    ]
    assert main(["doctor", *map(str, arguments)]) == 0
    printed = capsys.readouterr()
    assert f"checkpoint: {trained}" in printed.out and "ok   a long rollout" in printed.out
    assert ("3/3" in printed.err) == terminal
    written = json.loads((tmp_path / "r" / "report.json").read_text())
    assert written["subject"] == {"checkpoint": str(trained), "scenes": str(scenes)}


@pytest.fixture
def broken_check(monkeypatch):
    """A check that fails for one particle and step, which the report must name."""

    def failing(simulator, sample):
        yield Deviation("encode means", 0.0, 0.0, "scene 0, step 0, particle 0")
        red = float(sample.frames.images[3, 0].mean())
        yield Deviation("step means", red, 1e-9, "scene 1, step 4, particle 17")

    monkeypatch.setitem(CHECKS, "repeat", failing)


def test_failure_is_named_and_replayed(tmp_path, broken_check, scenes, capsys):
    folder = scenes / "ball" / "0000"
    arguments = ["--stability", folder, "--only", *FEW, "--out", tmp_path]
    assert main(["doctor", *map(str, arguments)]) == 1
    printed = capsys.readouterr().out
    assert "FAIL repeat" in printed and "scene 1, step 4, particle 17" in printed and "ok   what is not" in printed
    file = tmp_path / "failures" / "repeat.safetensors"
    assert f"reproduce: gsim3d doctor --stability --replay {file}" in printed
    assert "scene 1, step 4, particle 17" in (tmp_path / "report.md").read_text()
    found = json.loads((tmp_path / "report.json").read_text())["findings"][0]
    again = replay(file)
    assert not again.healthy and again.findings[0].failures[0].error == found["failures"][0]["error"] > 0
    assert main(["doctor", "--replay", str(file)]) == 1


def test_known_failure_of_model_card(tmp_path, broken_check, monkeypatch, trained, scenes):
    known = {"repeat": {"what": "step means", "error": 0.25, "bound": 1e-9}}
    monkeypatch.setattr(stability, "known_failures", lambda path: known)
    report = check_stability(**job(tmp_path, trained, scenes))
    assert [finding.outcome for finding in report.findings] == ["known failure", "holds"] and not report.healthy
    printed = describe(report)
    assert "known failure, in the model card: step means 0.25 (at most 1e-09)" in printed
    assert printed.endswith("known failures, in the model card: 1; no other check fails")
    assert "| repeat | known failure |" in (tmp_path / "report.md").read_text()
    known.clear()
    assert check_stability(**job(tmp_path, trained, scenes)).findings[0].outcome == "fails"


def test_check_that_raises_is_a_failure(tmp_path, monkeypatch):
    def failing(simulator, sample):
        raise RuntimeError("the rollout is not finite")
        yield

    monkeypatch.setitem(CHECKS, "repeat", failing)
    report = check_stability(**job(tmp_path))
    assert [finding.outcome for finding in report.findings] == ["fails", "holds"]
    failure = report.findings[0].failures[0]
    assert failure.what == "ends with RuntimeError" and failure.where == "the rollout is not finite"
    assert "RuntimeError" in describe(report) and not report.healthy


def test_unreadable_scene_is_reported(tmp_path, capsys):
    scene = write_scene(tmp_path / "scene", n_steps=2)
    (scene / "cam_2" / "rgb_0001.png").write_bytes(b"no picture")
    arguments = ["--stability", scene, "--only", "repeat", "--out", tmp_path / "report"]
    assert main(["doctor", *map(str, arguments)]) == 1
    printed = capsys.readouterr().out
    assert "cam_2/rgb_0001.png" in printed and "cannot be decoded" in printed
    assert "cam_2/rgb_0001.png" in (tmp_path / "report" / "report.md").read_text()


def test_released_model_has_no_promised_invariances(tmp_path):
    subject = open_subject(None)
    subject = dataclasses.replace(subject, simulator=ReleasedSimulator(subject.simulator.config).eval())
    found = {f.check: f for f, _ in check(subject, random_sample(subject), 2, ["repeat", "split the batch"])}
    assert found["repeat"].outcome == "holds" and found["split the batch"].outcome == "not promised"
    assert "the published model does not have" in found["split the batch"].reason


def test_sample_round_trip(tmp_path):
    sample = random_sample(open_subject(None))
    stability.save_sample(tmp_path / "s.safetensors", sample, {"check": "repeat"})
    again, what = load_sample(tmp_path / "s.safetensors")
    assert what["check"] == "repeat" and again.n_steps == sample.n_steps
    for a, b in (
        (again.frames, sample.frames),
        (again.frames.cameras, sample.frames.cameras),
        (again.targets, sample.targets),
    ):
        for name, value in vars(b).items():
            equal = torch.equal if isinstance(value, torch.Tensor) else lambda x, y: x == y
            assert name == "cameras" or equal(getattr(a, name), value), name


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--stability", "{tmp}/nowhere"], "no such file or folder"),
        (["--stability", "{tmp}"], "contains no scene"),
        (["--stability", "--only", "gravity"], "unknown check 'gravity'"),
        (["--stability", "--steps", "0"], "--steps: must be at least 1"),
        (["--replay", "{tmp}/note.txt"], "not a file that gsim3d doctor --stability wrote"),
        (["--stability", "{scene}", "{scene}"], "one scene or folder of scenes"),
    ],
)
def test_bad_input_gets_one_line_and_exit_code_2(arguments, message, tmp_path, scenes, capsys):
    (tmp_path / "note.txt").write_text("nothing")
    places = {"tmp": tmp_path, "scene": scenes / "ball" / "0000"}
    arguments = [argument.format(**places) for argument in arguments] + ["--out", str(tmp_path / "report")]
    assert main(["doctor", *arguments]) == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1 and message in lines[0]
    assert not (tmp_path / "report").exists()


@pytest.mark.parametrize("damage", ["truncated", "no metadata", "missing tensor"])
def test_load_sample_refuses_damaged_files(damage, tmp_path):
    from safetensors.torch import load_file, save_file

    file = Path(tmp_path / "s.safetensors")
    stability.save_sample(file, random_sample(open_subject(None)), {"check": "repeat"})
    if damage == "truncated":
        file.write_bytes(file.read_bytes()[:1000])
    elif damage == "no metadata":
        save_file(load_file(file), file)
    else:
        text = {"gsim3d_stability": json.dumps({"format": 1, "check": "repeat", "width": 8, "height": 8, "n_steps": 1})}
        save_file({"frames.images": torch.zeros(1)}, file, text)
    with pytest.raises(InputError, match="s.safetensors: not a file that gsim3d doctor --stability wrote"):
        load_sample(file)
