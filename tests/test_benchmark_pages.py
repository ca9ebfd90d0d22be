"""Tables of benchmarks are what was measured: every row, of its own commit."""

import importlib
import json
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
RUN = {"gpu": "a GPU", "torch": "2.11", "date": "2026-11-22"}


@pytest.fixture
def report(monkeypatch):
    monkeypatch.syspath_prepend(str(ROOT / "tools" / "bench"))
    return importlib.import_module("report")


@pytest.fixture
def records(report):
    return json.loads(report.NUMBERS.read_text())


def test_every_row_is_on_a_page(report, records):
    page = report.page(records) + report.effects(records[report.EFFECTS])
    for file in report.RESULTS.glob("*.jsonl"):
        rows = report.rows_of(file.stem)
        assert rows and all(row["op"] == file.stem and row["commit"] != "unknown" for row in rows), file.name
        for row in rows:
            assert page.count(f"| {row['case']}{', ' if 'cost' in row else ' | '}{row['dtype']} |"), row["case"]


def test_training_steps_are_a_table(report):
    rows = json.loads(report.STEPS.read_text())
    assert report.steps_table(rows).count("\n| captured |") == sum(row["case"] == "captured" for row in rows) > 0


def test_rows_of_two_runs_stand_in_two_tables(report):
    row = {"case": "a", "cost": 0.02, "quartiles": [0.01, 0.03], "ours_ms": 1.02, "peer_ms": 1.0, **RUN}
    found = list(report.runs([{**row, "commit": "aaa"}, {**row, "commit": "aaa"}, {**row, "commit": "bbb"}]))
    assert [(where.split(", ")[2], len(rows)) for where, rows in found] == [("commit aaa", 2), ("commit bbb", 1)]


def test_what_rest_saves(report):
    def rows(view, *times):
        shares = zip((50, 90), times)
        return [
            {
                "case": f"4 x (step{view}), {share}% of 65k points rest",
                "ours_ms": ms,
                "peer_ms": awake,
                "ours_graph_ms": None if view else ms - 4,
                "peer_graph_ms": None if view else awake - 4,
            }
            for share, (ms, awake) in shares
        ]

    table = report.resting(
        rows("", (24.0, 40.0), (10.0, 42.0))
        + rows(" + one 128 px view", (28.0, 44.0), (16.0, 48.0))
        + [{"case": "the background, 59k points", "ours_ms": 40.0}]
    )
    assert "Calls of 4 steps." in table
    assert "| 0% | 9.25 | 1.00x | 10.25 | 1.00x | - | 11.50 | 1.00x | 87 |" in table
    assert "| 50% | 5.00 | 1.80x | 6.00 | 1.67x | - | 7.00 | 1.57x | 143 |" in table
    assert "| 90% | 1.50 | 6.33x | 2.50 | 4.20x | - | 4.00 | 3.00x | 250 |" in table
    assert "40.0 ms, once a rollout and as Python calls it; at 90% it is saved again after 5.0" in table


def test_a_target_is_held_where_each_of_its_times_is(report):
    targets = report.targets
    row = {"op": "raster", "dtype": "float32", "peer_ms": 4.0, "commit": "aaa", "ours_ms": 2.0}
    both = [{**row, "case": f"1 view, 1080p, 1M, SH0: {part}"} for part in ("fwd", "fwd+bwd")]
    held = [{**both[0], "ours_graph_ms": 0.7}, {**both[1], "ours_graph_ms": 1.9}]
    assert "| 0.700 / 1.900 | 2.000 / 2.000 | 2.0 / 2.0x | aaa | yes |" in targets.table(held)
    missed = targets.table([held[0], {**both[1], "ours_graph_ms": 2.2}])
    assert "| misses by 10.0% |" in missed and "0 of 1 are held." in missed
    assert targets.measured(held[:1]) == [] and targets.table([]) == ""


def test_every_target_was_measured(report):
    rows = [row for file in report.RESULTS.glob("*.jsonl") for row in report.rows_of(file.stem)]
    assert len(report.targets.measured(rows)) == len(report.targets.TARGETS)


def test_captures_are_compared_over_the_same_windows(monkeypatch, tmp_path):
    monkeypatch.syspath_prepend(str(ROOT / "docs"))
    captures = importlib.import_module("generate").captures
    assert captures(tmp_path) == "Not measured yet.\n"

    def write(name, model, constant, copy):
        windows = {"model": model, "constant": constant, "copy": copy}
        scores = {"device": "cpu", "minutes": 1.5, "steps": 9, "of_windows": windows}
        (tmp_path / f"{name}.json").write_text(json.dumps(scores))

    write("elastic-plane_sweep", [20.0, 21.0], [17.0, 18.5], [19.0, 19.0])
    write("elastic-dinov2_small", [22.0, 22.4], [18.0, 18.5], [19.0, 19.0])
    write("cloth-plane_sweep", [10.0, 9.0], [11.0, 12.0], [10.0, 9.0])
    page = captures(tmp_path)
    scores = "22.20 | 18.25 | 19.00 | +3.95 ± 0.05 | +3.20 ± 0.20"
    assert f"| elastic | dinov2_small | cpu | 1.5 | 9 | 2 | {scores} | +1.70 ± 0.30 |" in page
    assert "| cloth | plane_sweep | cpu | 1.5 | 9 | 2 | 9.50 | 11.50 | 9.50 | -2.00 ± 1.00 | +0.00 ± 0.00 |  |" in page
    assert f"| all | dinov2_small |  |  |  | 2 | {scores} |  |" in page  # of other videos
