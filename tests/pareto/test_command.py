"""The command on a real scene: one page without a network, and numbers that agree between its files."""

import csv
import json
import re

import pytest

from gsim3d.__main__ import main
from gsim3d.pareto import report
from gsim3d.pareto.measure import Comparison, Point, compare, time_points
from gsim3d.pareto.settings import Setting
from gsim3d.pareto.timing import DeviceClock
from tests.pareto.test_autotune import SHORT

pytestmark = pytest.mark.usefixtures("one_thread")
REGIMES = {"throughput": [], "training": {"problem": "no configuration"}}
CONDITIONS = {
    "regimes": REGIMES,
    "command": "gsim3d pareto <x>",
    "machine": {"device": "here"},
    "subject": {"steps": 4},
    "self_check": ["holds: a"],
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
    compare(comparison, points)
    time_points(subject, points, DeviceClock("cpu"), SHORT)
    points.append(Point(Setting(kept=0.5), "kept", "model", failure="out of memory at step 3"))
    return out, points, report.write(out, points, comparison, CONDITIONS)


def test_every_file_is_there_and_complete(written):
    out, points, files = written
    assert {file.name for file in files} == {
        "report.json", "report.csv", "report.html", "agreement.png", "task.png", "stages.png", "horizon.png"
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
    assert page.count("data:image/png;base64,") == 4
    assert not re.findall(r"(?:src|href)=['\"](?!data:)", page) and "<script" not in page
    assert "gsim3d pareto &lt;x&gt;" in page and "out of memory at step 3" in page and "holds: a" in page
    assert "training step: not measured: no configuration" in page


def test_the_table_tells_failures_and_ties(written, subject):
    content = json.loads((written[0] / "report.json").read_text())
    lines = report.table(content).splitlines()
    assert lines[1].startswith("reference") and "1.00x" in lines[1]
    assert lines[4].endswith("failed: out of memory at step 3")


def test_wrong_arguments_are_one_line(capsys, tmp_path):
    assert main(["pareto", str(tmp_path / "none"), "--out", str(tmp_path / "out")]) == 2
    assert main(["pareto", str(tmp_path / "none"), "--out", str(tmp_path / "out"), "--knobs", "volume"]) == 2
    error = capsys.readouterr().err.strip().splitlines()
    assert len(error) == 2 and "'volume' does not exist; knobs: 'precision'" in error[1]
    assert not (tmp_path / "out").exists()
