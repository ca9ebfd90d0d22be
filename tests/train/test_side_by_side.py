"""Runs side by side: results by name, errors as they were raised, and a process that is killed is told."""

import multiprocessing
import os
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch

from gsim3d.errors import InputError, NumericalError
from gsim3d.train.side_by_side import last_entry, side_by_side

pytestmark = pytest.mark.usefixtures("one_thread")


def work(folder, action):
    if action == "raise":
        raise NumericalError("step 7 is not finite", step=7)
    if action == "die":
        os._exit(9)
    if action == "wait":
        folder.write_text(str(os.getpid()))
        time.sleep(600)
    return folder, action, torch.get_num_threads(), os.getpid()


def jobs(tmp_path, *actions):
    return {f"job {i}": (tmp_path / str(i), action) for i, action in enumerate(actions)}


@pytest.mark.parametrize("together", [1, 2])
def test_every_job_is_done_once(together, tmp_path):
    given, said = jobs(tmp_path, "a", "b", "c"), []
    done = dict(side_by_side(work, given, together, said.append))
    assert {name: result[:2] for name, result in done.items()} == given
    assert said == ([*given] if together == 1 else [])
    processes = {result[3] for result in done.values()}
    if together == 1:
        assert processes == {os.getpid()}
    else:
        assert os.getpid() not in processes
        assert all(result[2] == max(1, len(os.sched_getaffinity(0)) // 2) for result in done.values())


@pytest.mark.parametrize("action, error", [("raise", NumericalError), ("die", InputError)])
def test_what_a_job_raises_ends_the_others(action, error, tmp_path):
    with pytest.raises(error, match="step 7 is not finite" if action == "raise" else "job 1: its process was killed"):
        list(side_by_side(work, jobs(tmp_path, "wait", action), 2))
    assert not multiprocessing.active_children()


def test_nobody_goes_on_when_the_caller_is_killed(tmp_path):
    script = (
        "from pathlib import Path\n"
        "from gsim3d.train.side_by_side import side_by_side\n"
        "from tests.train.test_side_by_side import jobs, work\n"
        f"list(side_by_side(work, jobs(Path({str(tmp_path)!r}), 'wait', 'wait'), 2))"
    )
    caller = subprocess.Popen([sys.executable, "-c", script], cwd=Path(__file__).parents[2])
    try:
        wait_until(lambda: all((tmp_path / name).exists() and (tmp_path / name).read_text() for name in "01"))
    finally:
        caller.kill()
        caller.wait()
    workers = [int((tmp_path / name).read_text()) for name in "01"]
    wait_until(lambda: not any(is_running(worker) for worker in workers))


def wait_until(condition):
    end = time.monotonic() + 60
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.1)


def is_running(process):
    try:
        return Path(f"/proc/{process}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except OSError:
        return False


def test_a_log_whose_last_line_is_cut_says_nothing(tmp_path):
    assert last_entry(tmp_path) == {}
    (tmp_path / "metrics.jsonl").write_text('{"step": 3}\n{"step": 4}\n')
    assert last_entry(tmp_path) == {"step": 4}
    (tmp_path / "metrics.jsonl").write_text('{"step": 3}\n{"st')
    assert last_entry(tmp_path) == {}
