"""Calibration of rendered videos: bounded errors of intrinsics, poses and time offsets; refusals."""

import dataclasses
import json
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from gsim3d.capture.board import Board, Calibrated, calm_times
from gsim3d.capture.calibrate import _common_rate, calibrate
from gsim3d.capture.clips import Clip, clips_in, takes_of, time_offsets
from gsim3d.cli.main import main
from gsim3d.data import Scene, find_scenes
from gsim3d.data.lenses import Undistorter
from gsim3d.data.recording import Lens, Problems
from gsim3d.data.video_file import Video
from gsim3d.errors import InputError
from tests.capture.made_clips import FPS, SIZE, rig, write_board_clips, write_textured_clips
from tests.capture.made_takes import write_take
from tests.data.made_videos import with_gaps, write_plain
from tests.tiny_scenes import write_scenes
from tools.clips import Damage, degraded, write_clips

BOARD = Board(7, 5, 0.06)
STARTS = (0.0, 3 / FPS, -2 / FPS)  # seconds


@pytest.fixture(scope="module")
def clips(tmp_path_factory):
    folder = write_board_clips(tmp_path_factory.mktemp("videos"), BOARD, rig(), STARTS)
    (folder / "cameras.json").write_text('{"masks": "none", "near": 9}')
    assert main(["calibrate", str(folder), "--board", "7", "5", "0.06"]) == 0
    written = json.loads((folder / "cameras.json").read_text())
    assert written["masks"] == "none" and "near" not in written  # the world is another
    return folder


def relative(viewmats):
    return [viewmats[i] @ np.linalg.inv(viewmats[0]) for i in range(1, len(viewmats))]


def cameras_of(folder):
    entries = json.loads((folder / "cameras.json").read_text())["cameras"]
    poses = [np.vstack([np.c_[e["R"], e["T"]], [0, 0, 0, 1]]) for e in entries]
    return entries, poses


def angle(a, b):
    return np.degrees(np.linalg.norm(cv2.Rodrigues(a[:3, :3] @ b[:3, :3].T)[0]))


def test_board_gives_intrinsics_and_metric_poses(clips):
    entries, poses = cameras_of(clips)
    for entry, (name, K, _) in zip(entries, rig(), strict=True):
        assert entry["name"] == name and entry["calibration"]["error"] < 0.3
        assert np.abs(np.array(entry["K"]) - K).max() < 3
    for found, true in zip(relative(poses), relative([camera[2] for camera in rig()]), strict=True):
        assert angle(found, true) < 0.5
        assert np.linalg.norm(found[:3, 3] - true[:3, 3]) < 0.004


def test_world_is_the_board_at_rest(clips):
    for pose, (_, _, true) in zip(cameras_of(clips)[1], rig(), strict=True):
        assert angle(pose, true) < 1.0
        centre, expected = np.linalg.inv(pose)[:3, 3], np.linalg.inv(true)[:3, 3]
        # The origin is the board's first corner: half a board to the left and behind its centre.
        np.testing.assert_allclose(centre - expected, [0.21, -0.15, 0], atol=0.01)


def test_offsets_of_clips_reach_the_reader(clips):
    offsets = [entry["offset"] for entry in cameras_of(clips)[0]]
    np.testing.assert_allclose(np.diff(offsets), np.diff(STARTS), atol=0.01)
    scene = Scene.open(clips)
    assert scene.n_steps == 54 - 5  # those that all three videos show


def test_frames_that_a_clip_repeats_do_not_bend_the_calibration(clips, tmp_path):
    for name in ("cam0", "cam1", "cam2"):
        frames = list(Video(clips / f"{name}.avi", name, SIZE, Problems()).read(range(54), Problems()))
        for dropped in (9, 10, 21, 22, 33) if name == "cam1" else ():
            frames[dropped] = frames[dropped - 1]
        writer = cv2.VideoWriter(str(tmp_path / f"{name}.avi"), cv2.VideoWriter_fourcc(*"MJPG"), FPS, SIZE)
        for frame in frames:
            writer.write(frame[..., ::-1])
        writer.release()
    calibrate(tmp_path, board=BOARD, say=lambda _: None)
    entries, poses = cameras_of(tmp_path)
    assert all(entry["calibration"]["error"] < 0.5 for entry in entries)
    for found, true in zip(relative(poses), relative([camera[2] for camera in rig()]), strict=True):
        assert angle(found, true) < 0.5


def test_offset_of_one_clip_shifts_its_steps(clips, tmp_path):
    content = json.loads((clips / "cameras.json").read_text())
    for entry in content["cameras"]:
        (tmp_path / f"{entry['name']}.avi").write_bytes((clips / f"{entry['name']}.avi").read_bytes())
        entry["offset"] = 0.5 if entry["name"] == "cam1" else 0.0
    (tmp_path / "cameras.json").write_text(json.dumps(content))
    moved, problems = Scene.open(tmp_path), Problems()
    assert moved.n_steps == 54 - 15
    video = Video(tmp_path / "cam0.avi", "cam0", SIZE, problems)
    later = next(video.read([15], problems))  # cam1 began when frame 15 of the others was taken
    assert (next(moved.recording.read_images(0, [0], problems)) == later).all()


def test_a_board_that_is_not_seen_is_refused(clips):
    with pytest.raises(InputError, match="recognised in 0 images.*--dictionary"):
        calibrate(clips, board=dataclasses.replace(BOARD, dictionary="6X6_250"), say=lambda _: None)


def test_a_calibration_that_does_not_fit_is_refused_by_its_error(clips, tmp_path, monkeypatch):
    monkeypatch.setattr("gsim3d.capture.calibrate.MAX_ERROR", 1e-5)
    with pytest.raises(InputError, match=r"does not fit: reprojection error of cam0 0\.\d+ px"):
        calibrate(clips, board=BOARD, say=lambda _: None)


def test_offsets_of_motion_are_found_within_a_fraction_of_a_frame():
    rng, fine = np.random.default_rng(0), np.linspace(0, 12, 1200)
    energy = np.interp(fine, np.linspace(0, 12, 60), rng.exponential(1, 60))
    times = [np.arange(0, 8, 1 / 30), np.arange(0, 9, 1 / 25), np.arange(0, 8, 1 / 30)]
    starts = (0.0, 1.23, 2.5)
    motions = [
        np.interp((t[1:] + t[:-1]) / 2 + s, fine, energy) + rng.normal(0, 0.02, len(t) - 1).clip(0)
        for t, s in zip(times, starts)
    ]
    offsets, agreement = time_offsets(times, motions)
    np.testing.assert_allclose(offsets, starts, atol=0.01)
    assert agreement.min() > 0.9


def test_a_board_is_searched_where_it_pauses():
    times, moves = np.arange(900) / 30, np.sin(2 * np.pi * np.arange(899) / 45) ** 2
    clips = [
        SimpleNamespace(video=SimpleNamespace(times=times), motion=moved) for moved in (moves, 3 * np.roll(moves, 15))
    ]
    chosen = calm_times(times[30:870], clips, [0.0, -0.5])
    assert 50 < len(chosen) <= 60 and (np.diff(chosen) > 0).all()
    speed = np.interp(chosen, (times[1:] + times[:-1]) / 2, moves)
    assert speed.mean() < 0.15 and moves.mean() > 0.45
    assert (calm_times(times[:7], clips, [0.0, -0.5]) == times[:7]).all()


def test_short_clips_are_not_aligned_by_a_few_frames_that_agree():
    wrong, smooth = 0, np.hanning(9) / np.hanning(9).sum()
    for seed in range(30):
        rng, starts = np.random.default_rng(seed), np.array([0, 5, 2])
        common, *own = (np.convolve(rng.normal(size=64), smooth, "same") for _ in range(4))
        views = [np.exp(1.5 * (common + share * view)) for view, share in zip(own, (0.18, 0.9, 0.18), strict=True)]
        motions = [view[start : start + 56] for view, start in zip(views, starts, strict=True)]
        wrong += np.abs(time_offsets([np.arange(57) / 42] * 3, motions)[0] - starts / 42).max() > 3 / 42
    assert wrong <= 4


@pytest.mark.parametrize("degrees", [(0, 25, 50), (0, 40, 80), (0, 60, 120), (0, 90)])
def test_synchronous_clips_keep_their_times(tmp_path, degrees):
    clips = [Clip.open(file) for file in clips_in(write_take(tmp_path / "take", degrees))]
    offsets, _ = time_offsets([clip.video.times for clip in clips], [clip.motion for clip in clips])
    assert (offsets == 0).all()


def test_synchronous_clips_are_not_aligned_by_option(tmp_path, monkeypatch):
    def calibrated(clips, offsets, board):
        return [Calibrated(clip.name, clip.size, np.eye(3), np.zeros(5), np.eye(4), 0.1, 9) for clip in clips]

    monkeypatch.setattr("gsim3d.capture.calibrate.calibrate_board", calibrated)
    folder = write_take(tmp_path / "take", n_frames=150, starts=(0, 3, 6))
    for option, starts in ([], [0, 3, 6]), (["--synchronous"], [0, 0, 0]):
        assert main(["calibrate", str(folder), "--board", "7", "5", "0.04", *option]) == 0
        offsets = [entry["offset"] for entry in cameras_of(folder)[0]]
        np.testing.assert_allclose(np.array(offsets) * 30, starts, atol=0 if option else 0.5)


def test_clips_without_common_motion_keep_their_times():
    rng, times = np.random.default_rng(1), [np.arange(90) / 30] * 2
    still = time_offsets(times, [np.full(89, 2.0) + rng.normal(0, 0.01, 89) for _ in times])
    assert still[0].tolist() == [0, 0] and still[1].tolist() == [0, 0]


def test_structure_from_motion_with_a_scale(tmp_path):
    pytest.importorskip("pycolmap")
    cameras = rig((-30, -15, 0, 15, 30), 1.0)
    write_textured_clips(tmp_path, cameras)
    centres = [np.linalg.inv(camera[2])[:3, 3] for camera in cameras]
    scale = ["cam0", "cam4", str(np.linalg.norm(centres[0] - centres[4]))]
    assert main(["calibrate", str(tmp_path), "--scale", *scale]) == 0
    for found, true in zip(relative(cameras_of(tmp_path)[1]), relative([c[2] for c in cameras]), strict=True):
        assert angle(found, true) < 3
        assert np.linalg.norm(found[:3, 3] - true[:3, 3]) < 0.1


def test_cameras_without_common_features_are_refused(tmp_path, capfd):
    pycolmap = pytest.importorskip("pycolmap")
    before = pycolmap.logging.minloglevel
    write_textured_clips(tmp_path, rig((-170, 0, 100), 1.0))
    with pytest.raises(InputError, match="structure from motion connects . of 3 cameras"):
        calibrate(tmp_path, say=lambda _: None)
    assert "Failed" not in capfd.readouterr().err and pycolmap.logging.minloglevel == before


def test_missing_pycolmap_names_the_extra(clips, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "pycolmap", None)
    with pytest.raises(InputError, match=r"pip install 'gsim3d\[capture\]'"):
        calibrate(clips, say=lambda _: None)


def test_clips_of_generated_scenes_have_the_true_cameras(tmp_path):
    """What tools/clips.py degrades is what its truth.json says: undistorted, it shows the generated scene again."""
    data = write_scenes(tmp_path / "data", 1, n_steps=8, size=64)
    truth = write_clips(data, tmp_path / "videos", [0, 1], Damage(noise=0.0, exposure=0.0, dropped=0.0, late=3))
    (take,) = (folder for folder in (tmp_path / "videos").iterdir() if folder.name.startswith("ball"))
    scene, clips = Scene.open(find_scenes(data)[0]), [Clip.open(take / f"cam_{cam}.mp4") for cam in (0, 1)]
    for cam, (clip, start) in enumerate(zip(clips, truth["starts"][take.name], strict=True)):
        late = round(start * scene.fps)
        assert len(clip.video.numbers) == 8 - late
        true = truth[f"cam_{cam}"]
        image = next(clip.video.read([2], Problems()))
        K = np.array(true["K"]) + [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]]
        shown = Undistorter(Lens(np.array(true["lens"])), (64, 64))(image, K)
        expected = scene.images([cam], [2 + late])[0, 0].permute(1, 2, 0).numpy()
        assert np.abs(shown.astype(int) - expected)[8:-8, 8:-8].mean() < 6
    frames = [np.full((4, 4, 3), 10.0 * k) for k in range(30)]
    damaged = list(degraded(frames, Damage(dropped=0.5), 1.1, np.random.default_rng(0)))
    repeated = [(a == b).all() for a, b in zip(damaged, damaged[1:])]
    assert 8 < sum(repeated) < 22 and not (damaged[0] == damaged[-1]).all()


def test_clips_of_uneven_rates_are_resampled(tmp_path):
    with_gaps(write_plain(tmp_path / "a.mkv"), [50] * 9 + [60] * 10)
    write_plain(tmp_path / "b.mp4")
    clips = [Clip.open(tmp_path / name) for name in ("a.mkv", "b.mp4")]
    assert _common_rate(clips, lambda _: None) == pytest.approx(1000 / 60, rel=0.01)
    assert _common_rate(clips[1:] * 2, lambda _: None) is None


def test_takes_are_found_or_refused(tmp_path, capsys):
    assert main(["capture", str(tmp_path), "--out", str(tmp_path / "run")]) == 2
    assert "and no videos <camera>.mp4" in capsys.readouterr().err
    for take in ("one", "two", "board"):
        (tmp_path / take).mkdir()
        for name in ("left", "right"):
            write_plain(tmp_path / take / f"{name}.mp4")
    assert {take.name: [file.stem for file in clips] for take, clips in takes_of(tmp_path).items()} == {
        "one": ["left", "right"],
        "two": ["left", "right"],
    }
    (tmp_path / "two" / "right.avi").write_bytes(b"")
    with pytest.raises(InputError, match=r"two: two videos of camera right: right.avi and right.mp4"):
        takes_of(tmp_path)
    (tmp_path / "two" / "right.avi").unlink()
    (tmp_path / "two" / "right.mp4").unlink()
    with pytest.raises(InputError, match=r"two: has videos of left; every take needs .* same two cameras"):
        takes_of(tmp_path)
    for columns in ("2", "5.5"):
        assert main(["calibrate", str(tmp_path), "--board", columns, "5", "0.1"]) == 2
        assert "--board: needs 3 whole squares or more a side" in capsys.readouterr().err
    for squares, needed in ("20", 200), ("100000", 5_000_000_000):
        assert main(["calibrate", str(tmp_path), "--board", squares, squares, "0.1"]) == 2
        assert f"squares need {needed} markers; --dictionary 4X4_50 has 50" in capsys.readouterr().err
    assert main(["calibrate", str(tmp_path), "--scale", "left", "right", "-3"]) == 2
    assert "M must be a positive number of metres; got '-3'" in capsys.readouterr().err


def test_a_single_picture_is_no_clip(tmp_path, capsys):
    for name in ("left", "right"):
        write_plain(tmp_path / f"{name}.mp4", 1)
    assert main(["calibrate", str(tmp_path), "--board", "5", "4", "0.1"]) == 2
    assert "left.mp4 (camera left) has one frame" in capsys.readouterr().err
