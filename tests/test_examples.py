"""Examples run as they stand, on small generated scenes."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
EXAMPLES = sorted((ROOT / "examples").glob("*.py"))
DATA = {
    "scenes": ["elastic", "--preset", "diverse", "--objects", "ball", "--trajectories", "1", "--frames", "6"],
    "mini": ["elastic", "--preset", "mini", "--objects", "blob", "--trajectories", "2", "--frames", "6"],
}
ARGUMENTS = {
    "02_predict": ("scenes/ball/0000", "predicted"),
    "03_edit": ("scenes/ball/0000",),
    "04_train": ("mini", "model"),
}


def run(arguments: list[str], folder: Path) -> str:
    """What a Python program of this repository prints."""
    env = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run(
        [sys.executable, *arguments], cwd=folder, env=env, capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("examples")
    for name, arguments in DATA.items():
        run(["-m", "gsim3d", "generate", *arguments, "--out", name], folder)
    return folder


@pytest.mark.xdist_group("examples")
@pytest.mark.parametrize("example", EXAMPLES, ids=lambda path: path.stem)
def test_example_runs(example, folder):
    assert run([str(example), *ARGUMENTS.get(example.stem, ())], folder)


@pytest.mark.parametrize("example", EXAMPLES, ids=lambda path: path.stem)
def test_example_is_short(example):
    assert 20 <= len(example.read_text().splitlines()) <= 60
