"""Examples run as they stand, on small generated scenes."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
EXAMPLES = sorted((ROOT / "examples").glob("*.py"))
ARGUMENTS = {
    "02_predict": ("falling/ball/0000", "predicted"),
    "03_edit": ("falling/ball/0000",),
    "08_hybrid_scene": ("falling/ball/0000",),
    "04_train": ("small", "model"),
}
LONG = {"07_fit_scene": 190}  # a whole training, with densification
OPTIONS = {
    "falling": ["--preset", "diverse", "--objects", "ball", "--trajectories", "1"],
    "small": ["--preset", "mini", "--objects", "blob", "--trajectories", "2"],
}


def run(arguments: list[str], folder: Path) -> str:
    """What a Python program of this repository prints."""
    env = {**os.environ, "PYTHONPATH": str(ROOT)}
    command = [sys.executable, *arguments]
    done = subprocess.run(command, cwd=folder, env=env, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("examples")


def generate(scenes: str, folder: Path) -> None:
    """Makes the set ``scenes`` in ``folder`` once."""
    if not (folder / scenes).exists():
        run(["-m", "gsim3d", "generate", "elastic", *OPTIONS[scenes], "--frames", "6", "--out", scenes], folder)


@pytest.mark.parametrize("example", EXAMPLES, ids=lambda path: path.stem)
def test_example_runs(example, folder):
    arguments = ARGUMENTS.get(example.stem, ())
    if arguments:
        generate(arguments[0].split("/")[0], folder)
    output = run([str(example), *arguments], folder)
    assert output
    if example.stem == "07_fit_scene":  # the held-out images, after the last step
        assert float(re.findall(r"PSNR ([\d.]+) dB", output)[-1]) > 20


@pytest.mark.parametrize("example", ARGUMENTS)
def test_examples_say_what_they_take(example, folder):
    for given in ([], ["--help"]):
        command = [sys.executable, str(ROOT / "examples" / f"{example}.py"), *given]
        env = {**os.environ, "PYTHONPATH": str(ROOT)}
        done = subprocess.run(command, cwd=folder, env=env, capture_output=True, text=True, timeout=300)
        assert done.returncode == 1 and "Traceback" not in done.stderr, done.stderr
        assert f"python examples/{example}.py " in done.stderr


def test_a_scene_is_fitted_by_both_packages(tmp_path):
    (tmp_path / "gsplat.py").write_text("from gsim3d.compat.gsplat import rasterization\n")
    start = (
        f"import runpy, sys; sys.path.insert(0, '.'); runpy.run_path({str(ROOT / 'examples' / '07_fit_scene.py')!r})"
    )
    output = run(["-c", start, "--steps", "6", "--beside", "gsplat"], tmp_path)
    ours, theirs = (re.findall(rf"{name}: step 6, .*PSNR (.*) dB", output) for name in ("gsim3d", "gsplat"))
    assert len(ours) == len(theirs) == 1


@pytest.mark.parametrize("example", EXAMPLES, ids=lambda path: path.stem)
def test_example_is_short(example):
    assert 20 <= len(example.read_text().splitlines()) <= LONG.get(example.stem, 60)
