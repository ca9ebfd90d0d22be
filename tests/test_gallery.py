"""Every shipped simulator and every edit has a small poster, shown on the page; the script that makes them runs."""

import os
import subprocess
import sys
from pathlib import Path

import cv2
import pytest

from gsim3d import pretrained
from gsim3d.effects.edits import OPERATIONS

ROOT = Path(__file__).parent.parent
SHOWN = ROOT / "docs" / "results" / "gallery"
NAMES = {*pretrained.names(), *OPERATIONS, "orbit"}


def test_gallery_shows_every_simulator_and_edit():
    posters = {file.stem: file.stat().st_size for file in SHOWN.iterdir()}
    assert set(posters) == NAMES and max(posters.values()) <= 100_000 and sum(posters.values()) <= 600_000
    page = (ROOT / "docs" / "results" / "gallery.md").read_text()
    assert not [name for name in NAMES if f"(gallery/{name}.jpg)" not in page]


@pytest.mark.slow
def test_gallery_is_made(tmp_path):
    command = [sys.executable, str(ROOT / "docs" / "make_gallery.py"), "--frames", "10", "--only", "throw", "orbit"]
    command += ["--out", str(tmp_path / "videos"), "--posters", str(tmp_path / "posters")]
    env = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run(command, cwd=tmp_path, env=env, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    for name, size in (("throw", (1028, 512)), ("orbit", (512, 512))):
        frame = cv2.VideoCapture(str(tmp_path / "videos" / f"{name}.mp4")).read()[1]
        assert frame.shape[:2] == size and frame.std() > 10
        assert cv2.imread(str(tmp_path / "posters" / f"{name}.jpg")).shape[1] == 1036
