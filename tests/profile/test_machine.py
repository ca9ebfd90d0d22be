"""What the report says about its machine, and what a GPU does in a step."""

import re
import subprocess

import pytest
import torch

from gsim3d.profile import machine
from gsim3d.profile.regimes import work_of


def test_the_machine_and_the_sources_are_named():
    facts = machine.facts(torch.device("cpu"))
    assert facts["device"].startswith("CPU, ") and facts["processor"]
    assert re.fullmatch("[0-9a-f]{12}", facts["sources"]) and facts["torch"] == torch.__version__
    assert None not in facts.values()


def test_the_commit_is_that_of_the_checkout(tmp_path, monkeypatch):
    package = tmp_path / "checkout" / "gsim3d"
    package.mkdir(parents=True)
    (package / "a.py").write_text("1\n")
    monkeypatch.setattr(machine, "PACKAGE", package)
    assert machine._commit() is None  # not in a checkout of its own

    def git(*words):
        who = ["-c", "user.name=a", "-c", "user.email=a@b"]
        return subprocess.run(
            ["git", "-C", package.parent, *who, *words], check=True, capture_output=True, text=True
        ).stdout

    git("init", "-q")
    git("add", ".")
    git("commit", "-qm", "first")
    commit = git("rev-parse", "--short=12", "HEAD").strip()
    assert machine._commit() == commit
    before = machine._hash_of_sources()
    (package / "a.py").write_text("2\n")
    assert machine._commit() == commit + "+" and machine._hash_of_sources() != before


def test_energy_that_cannot_be_read_is_none(device):
    with machine.energy(device) as used:
        if device.type == "cpu":
            assert used() is None
        else:
            assert used() is None or used() >= 0
    if device.type == "cpu":
        assert machine._millijoules(device) is None


def test_gaps_are_what_no_kernel_covers():
    """Two kernels overlap on two streams, one comes after a gap."""
    spans = [("RadixSort", 1.0, 3.0), ("conv", 2.0, 4.0), ("conv", 6.0, 7.0)]
    work = work_of(spans, whole_ms=10.0, joules=None)
    assert work.busy_ms == pytest.approx(4.0) and work.gaps_ms == pytest.approx(6.0)
    assert work.sorting_ms == pytest.approx(2.0)
    assert [(name, ms, count) for name, ms, count in work.kernels] == [("conv", 3.0, 2), ("RadixSort", 2.0, 1)]
