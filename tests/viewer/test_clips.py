"""Videos: labels, times and sizes of their panels."""

import re

import cv2
import numpy as np
import pytest

from gsim3d.cli.main import main
from gsim3d.data import Scene
from gsim3d.io.formats import write_splats
from gsim3d.viewer.clips import ACCENT, clip_frames
from tests.tiny_scenes import write_scene
from tests.viewer.test_player import make, unpacked

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
def test_clip_panels_have_sizes_that_screens_like(size, panel):
    n_views = 4 if size == (60, 400) else 2
    rows = {"truth": flat(1, n_views, *size, 90), "predicted": flat(1, n_views, *size, 20)}
    (frame,) = clip_frames(rows, 24)
    height, width = panel
    assert frame.shape == (2 * height + 4, n_views * (width + 4) - 4, 3) and frame.shape[1] <= 3840
    assert frame.shape[0] % 2 == frame.shape[1] % 2 == 0
    assert (frame[height // 2, :width] == 90).all() and (frame[height + 4 + height // 2, :width] == 20).all()


def test_clip_panels_have_labels_and_time():
    rows = {"truth": flat(3, 2, 64, 64, 90), "predicted": flat(3, 2, 64, 64, 20)}
    frames = list(clip_frames(rows, 2.0, n_given=1))
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


def export(target, to, *options):
    assert main(["export", str(target), "--to", str(to), *options]) == 0


def test_export_goes_once_around_a_single_frame(tmp_path, capsys):
    write_splats(tmp_path / "a.ply", make())
    assert main(["export", str(tmp_path / "a.ply"), "--to", str(tmp_path / "a.avi")]) == 2
    says = capsys.readouterr().err
    assert re.search(r"a\.avi: no format .* has this suffix; choose from .*\.ply, .*\.mp4, \.html", says)
    export(tmp_path / "a.ply", tmp_path / "a.mp4", "--size", "64", "--fps", "5")
    assert "64x64" in capsys.readouterr().out and n_frames(tmp_path / "a.mp4") == 30


def test_export_writes_the_time_into_videos(tmp_path):
    (tmp_path / "run").mkdir()
    for step in range(2):
        write_splats(tmp_path / "run" / f"step_{step}.ply", make())
    export(tmp_path / "run", tmp_path / "a.mp4", "--size", "256", "--fps", "2", "--turns", "0")
    video = cv2.VideoCapture(str(tmp_path / "a.mp4"))
    first, second = (video.read()[1].astype(int) for _ in range(2))
    assert np.abs(first - second)[:28, -80:].max() > 60 and np.abs(first - second)[40:].max() < 60


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return write_scene(tmp_path_factory.mktemp("data") / "ball" / "0000", size=32)


def test_export_shows_the_truth_beside_what_was_predicted(scene, tmp_path, capsys):
    (tmp_path / "run").mkdir()
    for step in range(2):
        write_splats(tmp_path / "run" / f"step_{step}.ply", make())
    arguments = ["export", str(tmp_path / "run"), "--scene", str(scene), "--start", "1", "--camera", "1"]
    assert main([*arguments, "--to", str(tmp_path / "a.mp4"), "--fps", "7"]) == 0
    assert "2 frames, 7 a second, truth beside prediction" in capsys.readouterr().out
    frame = cv2.VideoCapture(str(tmp_path / "a.mp4")).read()[1][..., ::-1]
    assert frame.shape == (1028, 512, 3)
    recorded = Scene.open(scene).images(range(3), range(4)).permute(1, 0, 3, 4, 2).numpy()  # [V, S, H, W, 3]
    small = cv2.resize(frame[:512], (32, 32), interpolation=cv2.INTER_AREA).astype(int)
    errors = np.abs(small - recorded)[:, :, 4:].mean((2, 3, 4))  # below the labels
    assert np.unravel_index(errors.argmin(), errors.shape) == (1, 1) and errors.min() < 10
    assert frame[560:].max() > 60
    assert main([*arguments, "--to", str(tmp_path / "a.html")]) == 0
    header, _ = unpacked((tmp_path / "a.html").read_text())
    assert len(header["truth"]) == 2 and header["view"]["width"] == 32


@pytest.mark.parametrize(
    "arguments, says",
    [
        (["--scene", "SCENE", "--to", "b.spz"], "write .mp4 or .html"),
        (["--scene", "SCENE", "--camera", "99", "--to", "b.mp4"], "--camera 99"),
        (["--scene", "SCENE", "--start", "99", "--to", "b.mp4"], "--start 99"),
        (["--scene", "SCENE", "--turns", "1", "--to", "b.mp4"], "do not go with --scene"),
        (["--scene", "SCENE", "--size", "64", "--to", "b.mp4"], "do not go with --scene"),
        (["--camera", "1", "--to", "b.mp4"], "belong to --scene"),
        (["--size", "64", "--turns", "1", "--to", "b.spz"], "b.spz: no file of this format has --size or --turns"),
        (["--up-to", "y", "--to", "b.mp4"], "b.mp4: no file of this format has --up-to"),
    ],
)
def test_export_refuses_unused_options(arguments, says, scene, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    write_splats("a.ply", make())
    arguments = [str(scene) if one == "SCENE" else one for one in arguments]
    assert main(["export", "a.ply", *arguments]) == 2 and says in capsys.readouterr().err
    assert not list(tmp_path.glob("b.*"))
