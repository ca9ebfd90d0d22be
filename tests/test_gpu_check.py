"""What tools/gpu_check.sh does, with commands in place of a GPU's that only note how they were called."""

import os
import re
import shutil
import signal
import subprocess
import time
from pathlib import Path

import pytest

from tests.conftest import spread

ROOT = Path(__file__).parents[1]
COMMANDS = {
    "nvcc": "",
    "compute-sanitizer": 'while [ "$1" != python3 ]; do shift; done; exec "$@"',
    "python3": """
        case "$*" in
            *"import torch"*) echo "torch and a GPU"; exit 0 ;;
            *"import xdist"*) exit 1 ;;
            *tools/bench/*) echo {} >tools/bench/results/x.json ;;
        esac
        echo "$GSIM3D_PART $*" >>calls
        [ -z "$GSIM3D_PART" ] || echo "$CUDA_VISIBLE_DEVICES" >>devices
        [[ -n "$SLEEPS" && "$*" == *$SLEEPS* ]] && sleep 60
        [[ -z "$FAILS" || "$*" != *$FAILS* ]]
    """,
}
SCRIPT = "tools/gpu_check.sh"


@pytest.fixture
def tree(tmp_path):
    """A source tree with the script, and the names of the tests of the ops."""
    (tmp_path / "bin").mkdir()
    for name, text in COMMANDS.items():
        (tmp_path / "bin" / name).write_text(f"#!/bin/bash\n{text}\n")
        (tmp_path / "bin" / name).chmod(0o755)
    for folder in ("csrc", "gsim3d", "tests/ops", "tools/bench/results"):
        (tmp_path / folder).mkdir(parents=True)
    (tmp_path / "setup.py").touch()
    shutil.copy(ROOT / SCRIPT, tmp_path / "tools")
    for file in (ROOT / "tests/ops").glob("test_*.py"):
        shutil.copy(file, tmp_path / "tests/ops")
    return tmp_path


def start(tree, phase, **environment):
    environment = {**os.environ, "PATH": f"{tree / 'bin'}:{os.environ['PATH']}", "PYTHON": "python3", **environment}
    return subprocess.Popen(["bash", SCRIPT, phase], cwd=tree, env=environment, stderr=subprocess.PIPE,
                            stdout=subprocess.DEVNULL, text=True, start_new_session=True)  # fmt: skip


def check(tree, phase, **environment):
    """Its status, its last line and what it called."""
    (tree / "calls").write_text("")
    process = start(tree, phase, **environment)
    said = process.communicate()[1]
    return process.returncode, re.sub(r"\033\[\d*m", "", said).splitlines()[-1], (tree / "calls").read_text()


def stopped(process) -> str:
    """Output of a check that was stopped: again where bash was about to wait, which then hears it too late."""
    for _ in range(10):
        process.send_signal(signal.SIGTERM)
        try:
            return process.communicate(timeout=3)[1]
        except subprocess.TimeoutExpired:
            continue
    raise AssertionError("it did not stop")


def test_what_passed_is_not_repeated_whatever_was_measured(tree):
    status, last, calls = check(tree, "all")
    assert status == 0 and last.endswith(" passed; failed: none; not run: none")
    n_steps = int(re.search(r"(\d+) passed", last)[1])
    assert n_steps == len(calls.splitlines()) and n_steps > 2 * len(list((tree / "tests/ops").iterdir()))
    (tree / "gsim3d/__pycache__").mkdir()
    (tree / "gsim3d/__pycache__/x.pyc.1234").write_text("half written")
    assert check(tree, "all") == (0, last, "")
    (tree / "gsim3d/x.py").write_text("changed")
    assert check(tree, "build")[2] == " setup.py build_ext --inplace\n"


def test_what_failed_is_named_and_repeated(tree):
    status, last, _ = check(tree, "bench", FAILS="bench/pool.py")
    assert status == 1 and last == "gpu_check bench: 16 passed; failed: bench_pool; not run: none"
    status, last, calls = check(tree, "bench")
    assert (status, calls) == (0, " tools/bench/pool.py --device cuda --seconds 0.5\n")
    assert "17 passed; failed: none" in last


def test_nothing_runs_without_a_build(tree):
    status, last, calls = check(tree, "test", FAILS="setup.py")
    assert (status, last) == (1, "gpu_check test: 0 passed; failed: build; not run: test")
    assert len(calls.splitlines()) == 1


def test_every_test_of_an_op_is_sanitized_by_both_tools(tree):
    assert check(tree, "sanitize")[0] == 0
    calls = (tree / "calls").read_text().splitlines()[1:]
    found = {}
    for call in calls:
        part, n_parts = map(int, call.split()[0].split("/"))
        tool = "racecheck" if "not unraced" in call else "memcheck"
        found.setdefault((re.search(r"tests/ops/\w+\.py", call)[0], tool), []).append((part, n_parts))
        assert "gpu and not unsanitized" in call
    on_gpu = [file for file in (tree / "tests/ops").iterdir() if re.search(r"\((\w+, )*devices?\b", file.read_text())]
    files = [f"tests/ops/{file.name}" for file in on_gpu]
    assert len(files) > 25 and sorted(found) == sorted(
        (file, tool) for file in files for tool in ("memcheck", "racecheck")
    )
    for parts in found.values():
        assert sorted(parts) == [(k, len(parts)) for k in range(len(parts))]


def test_the_sanitizer_uses_all_gpus_alike(tree):
    assert check(tree, "sanitize", CUDA_VISIBLE_DEVICES="3,5")[0] == 0
    used = (tree / "devices").read_text().split()
    assert set(used) == {"3", "5"} and abs(used.count("3") - used.count("5")) <= 1


LAST = "racecheck_test_validate_state", "memcheck_test_validate_state"  # before what is added here


def test_a_check_that_is_stopped_goes_on_where_it_was(tree):
    (tree / "tests/ops/test_z.py").write_text("def test_z(devices):\n    pass\n")  # the last one
    process = start(tree, "sanitize", SLEEPS="tests/ops/test_z.py")
    logs = tree / "build/gpu_check"

    def others_ended():
        begun = {log.stem for log in logs.glob("*check_*.log") if not log.stem.endswith("test_z")}
        return begun.issuperset(LAST) and all((logs / f"{name}.done").exists() for name in begun)

    deadline = time.monotonic() + 30
    while not others_ended() and time.monotonic() < deadline:
        time.sleep(0.05)
    last = stopped(process).splitlines()[-1]
    assert process.returncode == 143
    assert "failed: none; not run: racecheck_test_z memcheck_test_z" in last
    status, last, calls = check(tree, "sanitize")
    assert status == 0 and "not run: none" in last
    assert len(calls.splitlines()) == 2 and calls.count("tests/ops/test_z.py") == 2


def test_few_cases_are_from_all_over_the_list():
    assert spread(list(range(24)), 3) == [0, 9, 18] and spread(list(range(3)), 3) == [0, 1, 2]
    assert spread([7], 3) == [7] and spread([7, 8], 3) == [7, 8]
