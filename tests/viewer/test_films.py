"""Films: labels, times and sizes of their panels."""

import cv2
import numpy as np
import pytest

from gsim3d.io.formats import write_splats
from gsim3d.viewer.export import export
from gsim3d.viewer.films import ACCENT, film_frames
from tests.viewer.test_player import make

ORANGE = np.array(ACCENT)


def flat(n_steps, n_views, height, width, level):
    return np.full((n_steps, n_views, height, width, 3), level, np.uint8)


def has_text(corner, color):
    return (np.abs(corner.astype(int) - color).max(2) < 30).sum() > 40


@pytest.mark.parametrize(
    "size, panel",
    [((64, 64), (512, 512)), ((101, 180), (512, 912)), ((700, 901), (700, 900)), ((60, 400), (144, 956))],
    ids=["small", "odd", "large", "wide"],
)
def test_film_panels_have_sizes_that_screens_like(size, panel):
    n_views = 4 if size == (60, 400) else 2
    rows = {"truth": flat(1, n_views, *size, 90), "predicted": flat(1, n_views, *size, 20)}
    (frame,) = film_frames(rows, 24)
    height, width = panel
    assert frame.shape == (2 * height + 4, n_views * (width + 4) - 4, 3) and frame.shape[1] <= 3840
    assert frame.shape[0] % 2 == frame.shape[1] % 2 == 0
    assert (frame[height // 2, :width] == 90).all() and (frame[height + 4 + height // 2, :width] == 20).all()


def test_film_panels_have_labels_and_time():
    rows = {"truth": flat(3, 2, 64, 64, 90), "predicted": flat(3, 2, 64, 64, 20)}
    frames = list(film_frames(rows, 2.0, n_given=1))
    labels = [frame[516:560, :220] for frame in frames]
    for frame in frames:
        assert has_text(frame[:44, :220], 255) and has_text(frame[:44, -220:], 255)
        assert not has_text(frame[:44, 220:500], 255)  # the first panel's right corner
    assert all(has_text(label, ORANGE) for label in labels)
    assert not np.array_equal(labels[0], labels[1]) and np.array_equal(labels[1], labels[2])  # given, predicted
    assert not np.array_equal(frames[1][:44, -220:], frames[2][:44, -220:])  # 0.50 s, 1.00 s


def n_frames(path):
    video, n = cv2.VideoCapture(str(path)), 0
    while video.read()[0]:
        n += 1
    return n


def test_export_goes_once_around_a_single_frame(tmp_path):
    write_splats(tmp_path / "a.ply", make())
    said = export(tmp_path / "a.ply", tmp_path / "a.mp4", size=64, fps=5)
    assert "64x64" in said and n_frames(tmp_path / "a.mp4") == 30


def test_export_writes_the_time_into_videos(tmp_path):
    (tmp_path / "run").mkdir()
    for step in range(2):
        write_splats(tmp_path / "run" / f"step_{step}.ply", make())
    export(tmp_path / "run", tmp_path / "a.mp4", size=256, fps=2, turns=0)
    video = cv2.VideoCapture(str(tmp_path / "a.mp4"))
    first, second = (video.read()[1].astype(int) for _ in range(2))
    assert np.abs(first - second)[:28, -80:].max() > 60 and np.abs(first - second)[40:].max() < 60
