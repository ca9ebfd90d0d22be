"""The report of ``gsim3d profile``: files agree, the page has no external resources, and the command."""

import csv
import importlib.util
import json
import re
from pathlib import Path

import pytest

from gsim3d.cli.main import main
from gsim3d.io import checkpoint
from gsim3d.io.settings import to_dict
from gsim3d.numerics.speed import SPEEDS_FILE, Setting
from gsim3d.profile import report
from gsim3d.profile.sweep import Effort, Point, Sweep
from gsim3d.synth.worlds import build_world

pytestmark = pytest.mark.usefixtures("one_thread")
ROOT = Path(__file__).parents[2]
SHORT = Effort(n_rounds=2, repeats=2, warm_up=0)


@pytest.fixture(scope="module")
def written(case, tmp_path_factory):
    """(folder, points, content of report.json)"""
    pytest.importorskip("matplotlib")
    out, sweep = tmp_path_factory.mktemp("report"), Sweep(case, SHORT)
    settings = {Setting(): "exact", Setting(history=1): "model", Setting(grid=2.0): "model"}
    points = [sweep.point(setting, "", kind) for setting, kind in settings.items()]
    sweep.run(points)
    points.append(Point(Setting(kept=0.5), "", "model", failure="out of memory"))
    presets = {"exact": points[0], "balanced": points[0], "fast": points[1]}
    content = report.as_dict(case, points, presets) | {
        "command": "gsim3d profile <x>",
        "throughput": [{"setting": "reference", "scenes": 4, "steps_a_second": 110.6, "problem": ""}],
        "not_run": {"precision": "a GPU <sic>"},
        "not_measured": {"fvd": "run gsim3d weights fvd"},
    }
    files = report.write(out, case, points, presets, content)
    assert sorted(file.name for file in out.iterdir()) == sorted(file.name for file in files)
    return out, points, content


def test_report_files_agree(written):
    out, points, content = written
    names = {"report.json", "report.csv", "report.html", "cost.png", "sections.png", "horizon.png"}
    assert {file.name for file in out.iterdir()} == names
    assert content == json.loads((out / "report.json").read_text())
    rows = list(csv.DictReader((out / "report.csv").open()))
    assert [r["setting"] for r in rows] == [r["name"] for r in content["settings"]] == [p.setting.name for p in points]
    assert float(rows[1]["step ms"]) == pytest.approx(content["settings"][1]["step_ms"]["median"], rel=1e-5)
    assert float(rows[0]["agreement dB"]) == 100 and float(rows[0]["kept"]) == 1
    assert rows[3]["step ms"] == "failed: out of memory" and rows[3]["kept"] == ""
    assert sum(content["settings"][0]["step_ms"]["sections"].values()) > 0


def test_page_has_no_external_files(written):
    page = (written[0] / "report.html").read_text()
    assert page.count("data:image/png;base64,") == 3
    assert not re.findall(r"(?:src|href)=['\"](?!data:)", page) and "<script" not in page
    assert "gsim3d profile &lt;x&gt;" in page and "failed: out of memory" in page
    assert "precision: needs a GPU &lt;sic&gt;" in page and "fvd: run gsim3d weights fvd" in page
    assert "111 steps a second in a batch of 4 scenes" in page and "<li>fast: history 1" in page


def test_retained_share_of_the_gain(written):
    content = written[2]
    reference, other = content["settings"][:2]
    assert reference["kept"] == 1 and content["presets"] == {"exact": 0, "balanced": 0, "fast": 1}
    lost = reference["gain_db"] - other["gain_db"]
    assert other["kept"] == pytest.approx(1 - lost / abs(reference["gain_db"]))
    gains = [
        ours - still for ours, still in zip(reference["by_step"]["psnr_masked"], content["constant"]["psnr_masked"])
    ]
    assert reference["gain_db"] == pytest.approx(sum(gains) / len(gains))


def test_share_in_words():
    assert [report.share_in_words(v) for v in (None, 0.9991, -3.0, 7.0)] == ["-", "99.91%", "below 0", "above 200%"]


def test_table_shows_failures_and_ties(written):
    content = json.loads(json.dumps(written[2]))
    content["settings"][2]["tie_with_reference"] = True
    lines = report.table(content).splitlines()
    assert lines[1].startswith("reference") and "1.00" in lines[1] and "100.00%" in lines[1]
    assert "tie" in lines[3] and lines[4].split() == ["kept", "0.5", "failed"]
    assert lines[5] == "reference: 111 steps a second in a batch of 4 scenes, with images"


@pytest.fixture
def run(case, tmp_path):
    """A run folder."""
    restored = case.restored
    config = {
        "model": to_dict(restored.simulator.config),
        "data": {**to_dict(restored.data), "image_size": list(restored.image_size)},
        "train": {},
    }
    checkpoint.save(tmp_path / "run", checkpoint.Checkpoint(restored.simulator.state_dict(), config, {"step": 20}))
    return tmp_path / "run"


@pytest.fixture
def arguments(case, run, tmp_path, monkeypatch):
    pytest.importorskip("matplotlib")
    monkeypatch.setattr(report, "QUICK", Effort(n_steps=12, n_scenes=2, few=True, repeats=2, n_rounds=1))
    data = str(case.scenes[0].path.parent)
    return ["profile", str(run), data, "--scenes", "all", "--out", str(tmp_path / "out"), "--quiet"]


def test_command_writes_report_and_speeds(arguments, run, tmp_path, capsys):
    arguments += ["--settings", "history", "precision", "--metrics", "psnr", "psnr_masked"]
    assert main(arguments) == 0
    out, content = capsys.readouterr().out, json.loads((tmp_path / "out" / "report.json").read_text())
    assert [row["name"] for row in content["settings"]][:2] == ["reference", "history 1"]
    assert set(content["settings"][0]["task"]) == {"psnr", "psnr_masked"}
    assert len(content["settings"][0]["step_ms"]["sections"]) > 4 and content["case"]["scenes"] == 2
    assert content["not_run"] == {"precision": "a GPU: on a CPU there is only float32"}
    assert content["throughput"][0]["steps_a_second"] > 0 and "--speed fast: " in out
    kept = json.loads((run / SPEEDS_FILE).read_text())[checkpoint.load(run).digest]["cpu"]
    assert list(kept) == ["exact", "balanced", "fast", "measured"]
    parts = sum(kept["measured"][part] for part in ("dynamics", "gaussians", "images"))
    assert parts == pytest.approx(sum(content["settings"][0]["step_ms"]["sections"].values()))


def test_command_lists_settings_skipped_by_time_limit(arguments, tmp_path):
    assert main([*arguments, "--minutes", "1e-4", "--settings", "history", "grid size"]) == 0
    content = json.loads((tmp_path / "out" / "report.json").read_text())
    assert [row["name"] for row in content["settings"]] == ["reference"] and content["throughput"] == []
    assert content["not_run"] == {
        "history": "a larger --minutes, for history 1;",
        "grid size": "a larger --minutes, for grid 0.5; grid 2;",
    }


def test_some_settings_do_not_replace_tuned_speeds(arguments, run, tmp_path, capsys):
    tuned = json.dumps({checkpoint.load(run).digest: {"cpu": {"fast": {"history": 1}}}})
    (run / SPEEDS_FILE).write_text(tuned)
    assert main([*arguments, "--minutes", "1e-4"]) == 0
    assert (run / SPEEDS_FILE).read_text() == tuned and (tmp_path / "out" / SPEEDS_FILE).is_file()
    assert ": kept, as only some settings were measured" in capsys.readouterr().out


@pytest.mark.parametrize("name, world", [("cloth-small", "cloth"), ("runs/own", "elastic")])
def test_scenes_are_generated_for_the_model(name, world, case, tmp_path, monkeypatch):
    asked = []
    monkeypatch.setattr(report, "generate", lambda *given, **options: asked.append((*given, options)))
    assert report.generated(name, case.restored, tmp_path, n_steps=3) == tmp_path
    folder, made, options = asked[0]
    settings = build_world(
        made, options.pop("preset"), {k: options[k] for k in options.keys() - {"processes", "progress"}}
    )
    assert made == world and settings.image_size == case.restored.image_size[0]
    assert settings.n_frames == case.restored.n_encoded + 3


def test_wrong_arguments_are_one_line(capsys, tmp_path):
    arguments = ["profile", str(tmp_path / "none"), "data", "--out", str(tmp_path / "out")]
    for more, message in (
        ([], "none"),
        (["--settings", "volume"], "unknown name 'volume'; settings: 'precision'"),
        (["--minutes", "0"], "--minutes: must be a finite number above 0"),
    ):
        assert main([*arguments, *more]) == 2
        error = capsys.readouterr().err
        assert error.count("\n") == 1 and message in error
    assert not (tmp_path / "out").exists()


def test_ship_report_copies_report_and_speeds(written, tmp_path):
    spec = importlib.util.spec_from_file_location("ship_report", ROOT / "tools" / "release" / "ship_report.py")
    tool = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(tool)
    shown = json.loads(tool.keep_report("ball-small", "cpu", written[0], tmp_path).read_text())
    assert {file.name for file in tmp_path.iterdir()} == {
        "ball-small-cpu.json", *(f"ball-small-cpu-{name}.png" for name in ("cost", "stages", "horizon"))
    }  # fmt: skip
    assert shown["command"] == "gsim3d profile <x>" and shown["rows"][3][3] == "failed: out of memory"
    assert shown["rows"][1][:3] == ["1", "history 1", "model"] and len({len(row) for row in shown["rows"]}) == 1
    reports = {name: tmp_path / name for name in ("cpu", "h200")}
    for folder, device in zip(reports.values(), ("cpu", "cuda"), strict=True):
        folder.mkdir()
        (folder / SPEEDS_FILE).write_text(json.dumps({"1f": {device: {"fast": {"history": 1}}}}))
    kept = json.loads(tool.keep_speeds(tmp_path, reports).read_text())
    assert kept == {"1f": {"cpu": {"fast": {"history": 1}}, "cuda": {"fast": {"history": 1}}}}
