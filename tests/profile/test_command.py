"""The command on a real scene: one page without a network, and numbers that agree between its files."""

import csv
import dataclasses
import importlib.util
import json
import re
from html import escape
from pathlib import Path

import pytest

from gsim3d.cli import profile as command
from gsim3d.cli.main import main
from gsim3d.evaluate.ablations import load_ablations
from gsim3d.io import checkpoint
from gsim3d.io.settings import to_dict
from gsim3d.numerics.speed import SPEEDS_FILE
from gsim3d.profile import budget, published, report
from gsim3d.profile import measure as measuring
from gsim3d.profile.measure import Comparison, Point, measure
from gsim3d.profile.settings import Setting
from gsim3d.profile.timing import DeviceClock
from tests.profile.test_autotune import SHORT
from tests.profile.test_budget import write_log

pytestmark = pytest.mark.usefixtures("one_thread")
ROOT = Path(__file__).parents[2]
REGIMES = {"throughput": [], "training": {"problem": "no configuration"}, "gpu": []}
CONDITIONS = {
    "regimes": REGIMES,
    "command": "gsim3d profile <x>",
    "machine": {"device": "here"},
    "subject": {
        "checkpoint": "1f",
        "scenes": 2,
        "steps": 4,
        "image": "32 x 32 pixels",
        "history": 2,
        "steps_a_call": {"": 1},
    },
    "self_check": ["holds: a"],
    "not_turned": {"fp8 products": "a GPU <sic>"},
    "not_measured": {"fvd": "run gsim3d weights fvd"},
}


@pytest.fixture(scope="module")
def written(subject, tmp_path_factory):
    pytest.importorskip("matplotlib")
    out, comparison = tmp_path_factory.mktemp("report"), Comparison(subject)
    points = [
        Point(Setting(), "", "exact"),
        Point(Setting(history=1), "history", "model"),
        Point(Setting(every=2), "", "exact"),
    ]
    measure(comparison, points, DeviceClock("cpu"), SHORT)
    points.append(Point(Setting(kept=0.5), "kept", "model", failure="out of memory at step 3"))
    presets = {"exact": points[0], "balanced": points[0], "fast": points[1]}
    log = budget.read_log(write_log(tmp_path_factory.mktemp("run") / "metrics.jsonl", [10.0, 20.0, 30.0]))
    content, files = report.write(out, points, comparison, CONDITIONS, presets, log)
    assert content == json.loads((out / "report.json").read_text())
    return out, points, files


def test_every_file_is_there_and_complete(written):
    out, points, files = written
    assert {file.name for file in files} == {
        "report.json", "report.csv", "report.html", "cost.png", "agreement.png", "task.png", "stages.png",
        "horizon.png", "training.png",
    }  # fmt: skip
    assert sorted(file.name for file in out.iterdir()) == sorted(file.name for file in files)
    content = json.loads((out / "report.json").read_text())
    rows = list(csv.DictReader((out / "report.csv").open()))
    assert (
        [row["setting"] for row in rows]
        == [row["name"] for row in content["points"]]
        == [p.setting.name for p in points]
    )
    assert float(rows[1]["step_ms"]) == pytest.approx(content["points"][1]["step_ms"]["median"], rel=1e-5)
    assert rows[3]["failure"] == "out of memory at step 3" and rows[3]["step_ms"] == ""
    assert content["points"][0]["agreement"]["psnr"] == 100
    assert sum(content["points"][0]["step_ms"]["stages"].values()) > 0


def test_the_page_needs_nothing_from_elsewhere(written):
    page = (written[0] / "report.html").read_text()
    assert page.count("data:image/png;base64,") == 6
    assert not re.findall(r"(?:src|href)=['\"](?!data:)", page) and "<script" not in page
    assert "gsim3d profile &lt;x&gt;" in page and "out of memory at step 3" in page and "holds: a" in page
    assert "training step: not measured: no configuration" in page
    assert "fp8 products: needs a GPU &lt;sic&gt;" in page and "fvd: run gsim3d weights fvd" in page
    assert all(escape(line) in page for line in published.INCONSISTENT)
    assert "Training: 40 steps in 0.2 h" in page
    assert "<b>fast</b>: history 1" in page


def test_presets_and_horizons_are_in_numbers(written):
    content = json.loads((written[0] / "report.json").read_text())
    reference, turned = content["points"][:2]
    assert reference["kept"] == 1 and content["presets"]["exact"] == {
        "number": 0, "setting": {}, "faster": 1.0, "kept": 1.0
    }  # fmt: skip
    lost = reference["gain_db"] - turned["gain_db"]
    assert turned["kept"] == pytest.approx(1 - lost / abs(reference["gain_db"]))
    assert content["presets"]["fast"]["kept"] == turned["kept"]
    rows = content["horizons"]
    assert [row["steps"] for row in rows] == [1, 2, 4]
    assert rows[2]["exact"]["psnr"] == reference["by_step"]["psnr_masked"][3]
    assert rows[2]["exact"]["ms"] == pytest.approx(
        reference["encode_ms"]["median"] + 4 * reference["step_ms"]["median"]
    )
    assert rows[0]["constant_psnr"] == content["constant"]["psnr_masked"][0]


def test_published_numbers_stand_beside_ours(written):
    content = json.loads((written[0] / "report.json").read_text())
    rows = {(row["what"], row["setting"]): row for row in content["published"]}
    points = content["points"]
    assert rows["modality", "4-4-1-3"]["published"].startswith("31.98")
    assert rows["modality", "4-4-1-3"]["ours"] is None and "calls-4" in rows["modality", "4-4-1-3"]["how"]
    assert rows["modality", "4-1-1-12"]["ours"] == points[0]["task"]["psnr_masked"]
    at_test_time = rows["history, changed at test time", "1 of 4"]
    assert at_test_time["published"] == "22.9" and at_test_time["ours"] == points[1]["task"]["psnr_masked"]
    assert rows["speed", "2 given steps"]["ours"] == pytest.approx(1e3 / points[0]["step_ms"]["median"])
    assert rows["speed", "4 given steps"]["ours"] is None
    assert {row["published"] for row in content["published"]} >= {"25.4", "33.15", "32.59", "16", "20", "4.3"}


def test_rows_of_ablations_that_are_named_exist():
    named = {name for row in published.PUBLISHED for name in re.findall(r"--rows (\S+?),?(?:\s|$)", row.how)}
    assert named and named <= set(load_ablations()[1])


def test_held_out_scenes_are_of_the_world_of_the_training(tmp_path, monkeypatch):
    """Of a simulator that comes with gsim3d; of any other checkpoint soft bodies."""
    monkeypatch.setattr("gsim3d.pretrained.FOLDER", tmp_path)
    (tmp_path / "cloth-small").mkdir()
    (tmp_path / "cloth-small" / "model.safetensors").write_bytes(b"")
    recipe = {"world": {"world": "cloth", "preset": "diverse", "n_frames": 84}}
    (tmp_path / "cloth-small" / "recipe.json").write_text(json.dumps(recipe))
    assert command._world("cloth-small", True) == ("cloth", "diverse", {"n_frames": command.QUICK_FRAMES})
    assert command._world("cloth-small", False) == ("cloth", "diverse", {})
    assert command._world(str(tmp_path / "cloth-small" / "model.safetensors"), False) == ("cloth", "diverse", {})
    (tmp_path / "run").mkdir()
    assert command._world(str(tmp_path / "run"), True) == ("elastic", "mini", {})


def test_the_table_tells_failures_and_ties(written, subject):
    content = json.loads((written[0] / "report.json").read_text())
    lines = report.table(content).splitlines()
    assert lines[1].startswith("reference") and "1.00x" in lines[1]
    assert lines[4].endswith("failed: out of memory at step 3")


@pytest.fixture
def run(subject, tmp_path):
    """A run folder with two checkpoints and a log."""
    restored = subject.restored
    config = {
        "model": to_dict(restored.simulator.config),
        "data": {**to_dict(restored.data), "image_size": list(restored.image_size)},
        "train": {},
    }
    for step in (10, 20):
        saved = checkpoint.Checkpoint(restored.simulator.state_dict(), config, {"step": step})
        checkpoint.save(tmp_path / "run", saved)
    write_log(tmp_path / "run" / "metrics.jsonl", [10.0, 20.0])
    return tmp_path / "run"


def test_the_command_from_end_to_end(subject, run, tmp_path, capsys, monkeypatch):
    pytest.importorskip("matplotlib")
    monkeypatch.setattr(measuring, "QUICK_ON_CPU", dataclasses.replace(measuring.QUICK_ON_CPU, repeats=2, n_rounds=1))
    monkeypatch.setattr(command, "HURRIED_REPEATS", 1)
    other, out = tmp_path / "other.safetensors", tmp_path / "out"
    checkpoint.export(checkpoint.load(run), other)
    data = str(subject.scenes[0].path.parent)
    arguments = ["profile", str(run), data, "--scenes", "all", "--out", str(out), "--quiet", "--others", str(other)]
    arguments += ["--knobs", "history", "training steps", "horizon", "--metrics", "psnr", "psnr_masked"]
    assert main(arguments) == 0
    content = json.loads((out / "report.json").read_text())
    names = ["reference", "history 1", "checkpoint step 000010", "checkpoint other.safetensors"]
    assert [point["name"] for point in content["points"]][:4] == names
    assert content["points"][2]["agreement"]["psnr"] == content["points"][3]["agreement"]["psnr"] == 100
    assert set(content["points"][0]["task"]) == {"psnr", "psnr_masked"}
    assert len(content["points"][0]["step_ms"]["stages"]) > 4 and content["points"][0]["step_ms"]["repeats"] >= 20
    assert content["training"]["steps"] == [0, 20] and content["not_turned"] == {} and "unfinished" not in content
    assert content["subject"]["scenes"] == 2 and "training step (1 scenes" in capsys.readouterr().out
    assert content["regimes"]["training"]["step_ms"]["median"] > 0
    speeds = json.loads((run / SPEEDS_FILE).read_text())
    kept = speeds[checkpoint.load(run).digest]["cpu"]
    assert list(kept) == ["exact", "balanced", "fast", "measured"]
    assert all("checkpoint" not in setting for setting in kept.values())
    parts = sum(kept["measured"][part] for part in ("dynamics", "gaussians", "images"))
    assert parts == pytest.approx(sum(content["points"][0]["step_ms"]["stages"].values()))


def test_what_was_measured_before_an_end_is_kept(subject, run, tmp_path, monkeypatch):
    def ended(*args, **options):
        raise KeyboardInterrupt

    pytest.importorskip("matplotlib")
    monkeypatch.setattr(measuring, "QUICK_ON_CPU", dataclasses.replace(measuring.QUICK_ON_CPU, repeats=2, n_rounds=2))
    monkeypatch.setattr(command, "HURRIED_REPEATS", 1)
    monkeypatch.setattr("gsim3d.profile.autotune.tune", ended)
    data, out = str(subject.scenes[0].path.parent), tmp_path / "out"
    arguments = ["profile", str(run), data, "--scenes", "all", "--out", str(out), "--quiet", "--knobs", "history"]
    with pytest.raises((KeyboardInterrupt, SystemExit)):
        raise SystemExit(main(arguments))
    content = json.loads((out / "report.json").read_text())
    assert content["unfinished"] == "ended after 2 of 2 rounds"
    assert [point["name"] for point in content["points"]] == ["reference", "history 1"]
    assert all(point["step_ms"]["median"] > 0 for point in content["points"])
    rows = list(csv.DictReader((out / "report.csv").open()))
    assert [row["setting"] for row in rows] == ["reference", "history 1"]


def test_what_there_is_no_time_for_is_named(subject, run, tmp_path, monkeypatch):
    pytest.importorskip("matplotlib")
    monkeypatch.setattr(measuring, "QUICK_ON_CPU", dataclasses.replace(measuring.QUICK_ON_CPU, repeats=2, n_rounds=1))
    data, out = str(subject.scenes[0].path.parent), tmp_path / "out"
    arguments = ["profile", str(run), data, "--scenes", "all", "--out", str(out), "--quiet", "--minutes", "1e-4"]
    assert main([*arguments, "--self-check", "--knobs", "history", "grid size"]) == 1
    content = json.loads((out / "report.json").read_text())
    assert [point["name"] for point in content["points"]] == ["reference"]
    assert content["not_turned"] == {
        "history": "more time than --minutes gave, for history 1",
        "grid size": "more time than --minutes gave, for grid 0.5, grid 2",
    }
    assert content["regimes"]["training"]["problem"] == "--minutes left no time"
    assert len(content["self_check"]) == 1 and "not checked" in content["self_check"][0]
    assert main([*arguments[:-1], "0"]) == 2


def test_wrong_arguments_are_one_line(capsys, tmp_path):
    assert main(["profile", str(tmp_path / "none"), "--out", str(tmp_path / "out")]) == 2
    assert main(["profile", str(tmp_path / "none"), "--out", str(tmp_path / "out"), "--knobs", "volume"]) == 2
    error = capsys.readouterr().err.strip().splitlines()
    assert len(error) == 2 and "'volume' does not exist; knobs: 'precision'" in error[1]
    assert not (tmp_path / "out").exists()


def test_a_report_goes_into_the_documentation(written, tmp_path):
    spec = importlib.util.spec_from_file_location("ship_report", ROOT / "tools" / "release" / "ship_report.py")
    tool = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(tool)
    kept = json.loads(tool.keep_report("ball-small", "cpu", written[0], tmp_path).read_text())
    assert all((tmp_path / f"ball-small-cpu-{picture}").is_file() for picture in tool.PICTURES)
    assert kept["command"].startswith("gsim3d profile") and any(check.startswith("holds") for check in kept["checks"])
    assert {len(row) for row in kept["rows"]} == {10} and kept["rows"][1][:3] == ["1", "history 1", "model"]
    assert "failed: out of memory at step 3" in {row[3] for row in kept["rows"]}
    reports = {name: tmp_path / name for name in ("cpu", "h200")}
    for (_name, folder), device in zip(reports.items(), ("cpu", "cuda"), strict=True):
        folder.mkdir()
        (folder / SPEEDS_FILE).write_text(json.dumps({"1f": {device: {"fast": {"history": 1}}}}))
    kept = json.loads(tool.keep_speeds(tmp_path, reports).read_text())
    assert kept == {"1f": {"cpu": {"fast": {"history": 1}}, "cuda": {"fast": {"history": 1}}}}
