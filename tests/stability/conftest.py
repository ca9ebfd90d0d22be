"""Every hard case runs in every setting, and what it measured is written to GSIM3D_STABILITY_JSON at the end."""

import json
import os
import platform
import re
from pathlib import Path

import pytest
import torch

from tests.conftest import cuda_device
from tests.stability.setting import NAMES, Measured, Setting

PROPERTY = "stability"
_results = {}


@pytest.fixture(params=NAMES)
def setting(request, one_thread) -> Setting:
    """Runs the test once for each device and precision, with torch computing so; on one thread, tensors are tiny."""
    device, precision = request.param.split()
    here = Setting(cuda_device() if device == "cuda" else torch.device("cpu"), precision)
    with here.computing():
        yield here


@pytest.fixture
def measured(request) -> Measured:
    """What the test reports of its case, which its name begins with."""
    case = re.match(r"test_([a-z]\d\d)_", request.node.name)[1].upper()
    column = request.node.callspec.params["setting"] if "setting" in request.fixturenames else "host"
    what = Measured()
    request.node.user_properties.append((PROPERTY, {"case": case, "column": column, "measured": vars(what)}))
    return what


def pytest_runtest_logreport(report):
    for name, value in report.user_properties:
        if name == PROPERTY and report.when == "call" and report.outcome != "skipped":
            cell = _results.setdefault(value["column"], {}).setdefault(value["case"], _empty())
            _add(cell, value["measured"], report.passed)


@pytest.hookimpl(tryfirst=True)
def pytest_sessionfinish(session):
    file = os.environ.get("GSIM3D_STABILITY_JSON")
    if file and not hasattr(session.config, "workerinput"):
        Path(file).parent.mkdir(parents=True, exist_ok=True)
        columns = {
            name: {"machine": _machine(name), "torch": torch.__version__, "cases": c} for name, c in _results.items()
        }
        Path(file).write_text(json.dumps(columns, indent=1, sort_keys=True) + "\n")


def _machine(column: str) -> str:
    if column.startswith("cuda"):
        return torch.cuda.get_device_name()
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.exists() else []
    names = [line.split(":")[1].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.machine()


def _empty() -> dict:
    return {"tests": 0, "failed": 0, "outcomes": [], "error": None, "bound": None}


def _add(cell: dict, measured: dict, passed: bool) -> None:
    """Puts one test of a case to the others: every outcome once, the largest error and its bound."""
    cell["tests"] += 1
    cell["failed"] += not passed
    cell["outcomes"] += [text for text in measured["outcomes"] if text not in cell["outcomes"]]
    if measured["error"] is not None and (cell["error"] is None or measured["error"] > cell["error"]):
        cell["error"], cell["bound"] = measured["error"], measured["bound"]
