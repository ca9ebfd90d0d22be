"""Every array of the published model's tensors is read by a golden test, or listed in unused.txt with the reason."""

import hashlib
import json
import os
import subprocess
import sys
from fnmatch import fnmatchcase as fnmatch
from pathlib import Path

import numpy as np
import pytest

from tests.golden_files import COMMITTED, golden_directory

pytestmark = pytest.mark.golden
HERE = Path(__file__).parent


def unused() -> dict[tuple[str, str], str]:
    """(file, array) -> reason, both patterns."""
    lines = [line for line in (HERE / "unused.txt").read_text().splitlines() if line and not line.startswith("#")]
    entries = [line.partition(" -- ") for line in lines]
    return {tuple(array.split(": ", 1)): reason for array, _, reason in entries}


def is_unused(entry: tuple[str, str]) -> bool:
    return any(fnmatch(entry[0], name) and fnmatch(entry[1], key) for name, key in unused())


def read_by_tests(tmp_path: Path) -> set[tuple[str, str]]:
    """What all golden tests of this folder read, in a process of their own: whatever else runs, in any order."""
    log = tmp_path / "reads.json"
    command = [sys.executable, "-m", "pytest", "-q", "-p", "tests.golden.reads", "-p", "no:cacheprovider", str(HERE)]
    done = subprocess.run(
        [*command, "--ignore", __file__],
        cwd=HERE.parents[1],
        env=os.environ | {"GSIM3D_GOLDEN_READS": str(log), "GSIM3D_GOLDEN_DIR": str(golden_directory().resolve())},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stdout[-4000:] + done.stderr[-2000:]
    return {tuple(entry) for entry in json.loads(log.read_text())}


def test_every_array_is_read_or_listed(tmp_path):
    files = sorted(golden_directory().glob("*.npz"))
    if not files:
        pytest.skip(f"no golden files in {golden_directory()} (set GSIM3D_GOLDEN_DIR)")
    arrays = {(path.stem, key) for path in files for key in np.load(path).keys()}
    listed, read = {entry for entry in arrays if is_unused(entry)}, read_by_tests(tmp_path)
    neither, both = arrays - read - listed, read & listed
    assert not neither, f"{len(neither)} arrays are neither read nor listed: {sorted(neither)[:20]}"
    assert not both, f"read, so not unused: {sorted(both)}"
    present = {name for name, _ in arrays}
    for name, key in unused():
        if name in present or name == "*":
            assert any(fnmatch(array, key) for file, array in arrays if fnmatch(file, name)), (
                f"no array is {name}: {key}"
            )


def test_every_unused_array_has_a_reason():
    assert unused() and all(len(reason) > 10 for reason in unused().values())


def test_committed_tensors_are_whole_and_small():
    sums = dict(reversed(line.split()) for line in (COMMITTED / "SHA256SUMS").read_text().splitlines())
    files = {path.name: path for path in COMMITTED.iterdir() if path.name not in ("SHA256SUMS", "README.md")}
    assert set(files) == set(sums)
    for name, path in files.items():
        assert hashlib.sha256(path.read_bytes()).hexdigest() == sums[name], name
    assert sum(path.stat().st_size for path in COMMITTED.iterdir()) < 4e6
