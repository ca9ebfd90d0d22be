"""The stability tables are what the tests measured: every case, nothing that fails."""

import importlib.util
import json
import re
from pathlib import Path

import pytest

from tests.stability.cases import CASES, GROUPS
from tests.stability.constants import CONSTANTS

HERE = Path(__file__).parent
ROOT = HERE.parent.parent
CASES_OF_THE_LIST = 50


@pytest.fixture(scope="module")
def tool():
    spec = importlib.util.spec_from_file_location("stability_tool", ROOT / "tools" / "stability.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def columns():
    return json.loads((ROOT / "docs" / "results" / "stability.json").read_text())


def cases_with_tests() -> set[str]:
    names = (re.findall(r"^def test_([a-z]\d\d)_", file.read_text(), re.MULTILINE) for file in HERE.glob("test_?_*.py"))
    return {name.upper() for found in names for name in found}


def test_every_case_has_a_test_and_every_test_a_case():
    assert cases_with_tests() == set(CASES)
    assert {int(case[1:]) for case in CASES} >= set(range(1, CASES_OF_THE_LIST + 1))
    assert {case[0] for case in CASES} == set(GROUPS)


def test_page_has_every_case(tool, columns):
    page = tool.page(columns)
    for case in CASES:
        assert f"| {case} {CASES[case].words} |" in page


def test_every_case_was_measured_and_holds(columns):
    everywhere = set(columns["host"]["cases"])
    for name in ("cpu float64", "cpu float32"):
        missing = set(CASES) - everywhere - set(columns[name]["cases"])
        assert missing <= ({"D50"} if name == "cpu float64" else set()), f"{name}: {missing}"
    for name, column in columns.items():
        for case, record in column["cases"].items():
            assert case in CASES and record["tests"] > 0 and record["failed"] == 0, f"{case} on {name}"
            assert record["error"] is None or record["error"] <= record["bound"], f"{case} on {name}"
            assert record["error"] is not None or record["outcomes"], f"{case} on {name}"


def test_constants_are_those_of_the_code():
    for c in CONSTANTS:
        text = (ROOT / c.file).read_text()
        assert re.search(rf"\b{c.name}\b[^\n]*?=[\s(]*{re.escape(c.value)}", text), f"{c.name} in {c.file}"


def test_every_constant_and_guard_has_a_mutant_and_a_test(tool):
    guarded = set()
    for name in tool.GUARDS:
        for mutant in json.loads((ROOT / "tests" / "mutants" / f"{name}.json").read_text()):
            guarded.update(re.findall(r"\w+", mutant["guard"].partition(":")[0]) if ":" in mutant["guard"] else ())
            assert (ROOT / mutant["file"]).read_text().count(mutant["old"]) == 1, mutant["guard"]
            file, _, test = mutant["test"].partition("::")
            assert re.search(rf"^def {test}\(", (ROOT / file).read_text(), re.MULTILINE), mutant["test"]
    assert guarded >= {c.name for c in CONSTANTS}


def test_new_results_replace_old_ones_of_the_same_column_only(tool):
    def column(machine, **cases):
        return {"machine": machine, "torch": "2", "cases": cases}

    old = {"cpu float32": column("a", R01=1, R02=2), "cuda float32": column("b", R01=3)}
    merged = tool.add(old, {"cpu float32": column("c", R02=4)})
    assert merged == {"cpu float32": column("c", R01=1, R02=4), "cuda float32": column("b", R01=3)}


def test_costs_of_a_machine_replace_its_old_ones(tool, tmp_path):
    row = {"case": "tiny", "dtype": "bfloat16", "cost": 0.004, "quartiles": [0.001, 0.007], "torch": "2"}
    gpu = tmp_path / "stability.jsonl"
    measured = {**row, "gpu": "H", "ours_ms": 1.004, "peer_ms": 1.0}
    gpu.write_text(f"{json.dumps(measured)}\n{json.dumps({'case': 'the op alone', 'gpu': 'H'})}\n")
    known = [{**row, "machine": machine, "guarded_ms": 3.0, "unguarded_ms": 2.0} for machine in ("C", "H")]
    merged = tool.with_costs(known, gpu)
    assert merged == [known[0], {**known[1], "guarded_ms": 1.004, "unguarded_ms": 1.0}]
    side = {"gsim3d": {"ms": 5.0}, "plain": {"ms": 4.0}}
    cpu = tmp_path / "benchmarks.json"
    cpu.write_text(json.dumps({"stability": {"machine": "C", "torch": "2", "results": [{**row, **side}]}}))
    merged = tool.with_costs(merged, cpu)
    assert [(r["machine"], r["guarded_ms"], r["unguarded_ms"]) for r in merged] == [("H", 1.004, 1.0), ("C", 5.0, 4.0)]
