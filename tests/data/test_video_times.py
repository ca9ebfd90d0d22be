"""Videos by the times in them: variable rates, edit lists, late starts, longer sound, turned, without a duration."""

import os
import re
from pathlib import Path

import cv2
import numpy as np
import pytest

from gsim3d.data import Scene
from gsim3d.data.check import check_scene, describe
from gsim3d.errors import InputError
from gsim3d.io import write_video
from tests.data.made_scenes import edit_json
from tests.data.made_videos import (
    N_FRAMES,
    RATE,
    edit_boxes,
    shown,
    trimmed,
    with_duration,
    with_gaps,
    with_matrix,
    write_plain,
    write_scene,
)

SUFFIXES = (".mp4", ".mov", ".mkv", ".webm")
UNEVEN = [50] * 9 + [250] * 10


def frames_of(scene: Scene) -> list[list[int]]:
    """The numbers of the frames that each camera shows, step by step."""
    video = scene.recorded_images(range(scene.n_cams), range(scene.n_steps))
    return [[shown(video[step, cam, 0]) for step in range(scene.n_steps)] for cam in range(scene.n_cams)]


@pytest.mark.parametrize("suffix", [*SUFFIXES, ".avi"])
def test_video_frames_are_counted_by_decoding(tmp_path, suffix):
    write_plain(tmp_path / f"a{suffix}")
    scene = Scene.open(write_scene(tmp_path, ["a"]))
    assert (scene.n_steps, scene.fps, scene.recording.notes) == (N_FRAMES, RATE, ())
    assert frames_of(scene) == [list(range(N_FRAMES))]


@pytest.mark.parametrize("suffix", SUFFIXES)
@pytest.mark.parametrize("gaps", [UNEVEN, [50] * 12 + [100] + [50] * 6, [100] + [50] * 18, [33, 67] * 9 + [33]])
def test_uneven_videos_are_refused_with_both_numbers(tmp_path, suffix, gaps):
    with_gaps(write_plain(tmp_path / f"a{suffix}"), gaps)
    write_scene(tmp_path, ["a"])
    message = rf"a{suffix} \(camera a\) is uneven: its 20 frames are {min(gaps)} to {max(gaps)} ms apart.*resample"
    with pytest.raises(InputError, match=message):
        Scene.open(tmp_path)
    assert any("uneven" in line for line in check_scene(tmp_path).problems)
    write_scene(tmp_path, ["a"], fps=RATE)  # says nothing of frames that are missing
    with pytest.raises(InputError, match="uneven"):
        Scene.open(tmp_path)


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_uneven_videos_are_resampled_on_request(tmp_path, suffix):
    with_gaps(write_plain(tmp_path / f"a{suffix}"), UNEVEN)
    scene = Scene.open(write_scene(tmp_path, ["a"], resample=4))
    times = np.cumsum([0, *UNEVEN]) / 1000
    wanted = [int(np.argmin(np.abs(times - step / 4))) for step in range(scene.n_steps)]
    assert scene.fps == 4 and scene.n_steps == 12 and frames_of(scene) == [wanted]
    assert "resampled: frames are up to" in describe(scene)
    twice = Scene.open(write_scene(tmp_path, ["a"], resample=8))
    assert twice.fps == 8 and "9 of 24 steps repeat the previous frame" in describe(twice)
    for value in (0, -1, "4", 1e9):
        with pytest.raises(InputError, match="resample"):
            Scene.open(write_scene(tmp_path, ["a"], resample=value))
    with pytest.raises(InputError, match="steps of 20 frames; at most 2000 are allowed"):
        Scene.open(write_scene(tmp_path, ["a"], resample=100_000))


@pytest.mark.parametrize("apart", [1, 2])
def test_video_frames_apart_at_the_end_are_left_out(tmp_path, apart):
    """A cut without encoding anew takes away the frames before them."""
    with_gaps(write_plain(tmp_path / "a.mp4"), [50] * (19 - apart) + [100] * apart)
    scene = Scene.open(write_scene(tmp_path, ["a"]))
    assert scene.fps == pytest.approx(RATE) and frames_of(scene) == [list(range(20 - apart))]
    assert f"the last {apart} of 20 frames are isolated and are dropped" in describe(scene)


def test_video_rate_tolerates_small_jitter(tmp_path):
    with_gaps(write_plain(tmp_path / "a.mp4"), [50 + (2, -2, 0)[k % 3] for k in range(19)])
    with_gaps(write_plain(tmp_path / "b.mkv"), [40] * 19)  # at another rate than the header's, evenly
    assert Scene.open(write_scene(tmp_path, ["a"])).fps == pytest.approx(RATE, rel=0.01)
    assert Scene.open(write_scene(tmp_path, ["b"])).fps == pytest.approx(25)


def test_video_edit_lists_are_applied(tmp_path):
    for skipped in (0.2, 0.4, 0.75):
        trimmed(write_plain(tmp_path / "a.mp4"), skipped)
        scene = Scene.open(write_scene(tmp_path, ["a"]))
        first = round(RATE * skipped)
        assert frames_of(scene) == [list(range(first, N_FRAMES))] and scene.fps == RATE


def test_late_videos_are_aligned_by_time(tmp_path):
    """Frame k of one and frame k - 6 of the other show one time."""
    write_plain(tmp_path / "a.mp4")
    trimmed(write_plain(tmp_path / "b.mp4"), 0.0, late=0.3)
    trimmed(write_plain(tmp_path / "c.mov"), 0.2, late=0.2)  # starts at 0.2 s with frame 4
    scene = Scene.open(write_scene(tmp_path, ["a", "b", "c"]))
    assert frames_of(scene) == [list(range(6, 20)), list(range(14)), list(range(6, 20))]
    assert "start at different times: 14 of 20 frames" in describe(scene)
    resampled = Scene.open(write_scene(tmp_path, ["a", "b", "c"], resample=10))
    assert frames_of(resampled) == [list(range(6, 20, 2)), list(range(0, 14, 2)), list(range(6, 20, 2))]
    alone = Scene.open(write_scene(tmp_path, ["b"]))
    assert frames_of(alone) == [list(range(20))] and alone.recording.notes == ()


@pytest.mark.parametrize("offsets, off", [([0.024, 0.026], 0), ([0.0, 0.012], 6), ([0.12, 0.13, 0.125], 5)])
@pytest.mark.parametrize("kind", ["videos", "folders"])
def test_offsets_of_fractions_of_a_frame(tmp_path, kind, offsets, off):
    """Offsets of 0.48 and 0.52 frames are not rounded to different steps."""
    names = [f"c{number}" for number in range(len(offsets))]
    for name in names:
        write_plain(tmp_path / f"{name}.mp4")
        if kind == "folders":
            (tmp_path / name).mkdir()
            for number in range(20):
                cv2.imwrite(str(tmp_path / name / f"{number}.png"), np.full((48, 64, 3), 12 * number, np.uint8))
            (tmp_path / f"{name}.mp4").unlink()
    folder = write_scene(tmp_path, names, fps=RATE)
    edit_json(
        folder / "cameras.json",
        lambda content: [camera.update(offset=x) for camera, x in zip(content["cameras"], offsets, strict=True)],
    )
    scene = Scene.open(folder)
    assert frames_of(scene) == [list(range(20))] * len(offsets)
    assert scene.recording.notes == ((f"frames are up to {off} ms off their steps",) if off else ())


def test_labels_of_late_videos_have_their_own_frame_numbers(tmp_path):
    write_plain(tmp_path / "a.mp4")
    trimmed(write_plain(tmp_path / "b.mp4"), 0.0, late=0.3)
    for name in ("a", "b"):
        (tmp_path / "labels" / name).mkdir(parents=True)
        for number in range(N_FRAMES):
            labels = np.zeros((48, 64), np.uint8)
            labels[: number + 1] = 3  # as many rows as the number tells
            cv2.imwrite(str(tmp_path / "labels" / name / f"{number}.png"), labels)
    write_scene(tmp_path, ["a", "b"], masks="subtract")
    rows = (Scene.open(tmp_path).segmentation([0, 1], range(14)) == 3).sum((2, 3)) // 64 - 1
    assert rows.T.tolist() == [list(range(6, 20)), list(range(14))]


@pytest.mark.parametrize("seconds", [3.0, 1.4, None])
@pytest.mark.parametrize("suffix", [".webm", ".mkv"])
def test_container_duration_has_no_influence(tmp_path, suffix, seconds):
    """A longer sound track makes it longer; a live recording has none."""
    with_duration(write_plain(tmp_path / f"a{suffix}"), seconds)
    scene = Scene.open(write_scene(tmp_path, ["a"]))
    assert (scene.n_steps, scene.fps) == (N_FRAMES, RATE) and frames_of(scene) == [list(range(N_FRAMES))]


@pytest.mark.parametrize("matrix, turn, corner", [((0, 1, -1, 0), 90, (0, -1)), ((-1, 0, 0, -1), 180, (-1, -1)),
                                                  ((0, -1, 1, 0), 270, (-1, 0))])  # fmt: skip
def test_video_display_matrix_is_applied(tmp_path, matrix, turn, corner):
    with_matrix(write_plain(tmp_path / "a.mp4"), *matrix)
    size = (64, 48) if turn == 180 else (48, 64)
    video = Scene.open(write_scene(tmp_path, ["a"], size=size)).recorded_images([0], [3])[0, 0, 0, : size[1], : size[0]]
    rows, columns = ((slice(0, 12), slice(-12, None))[side] for side in corner)
    assert video[rows, columns].float().mean() > 230 and video.float().median() < 50
    if turn != 180:
        with pytest.raises(InputError, match=f"has 48x64 pixels \\(rotated by {turn} degrees.*its camera 64x48"):
            Scene.open(write_scene(tmp_path, ["a"]))


@pytest.mark.parametrize("matrix", [(-1, 0, 0, 1), (1, 0, 0, -1), (1, 1, -1, 1)])
def test_mirrored_and_slanting_videos_are_refused(tmp_path, matrix):
    with_matrix(write_plain(tmp_path / "a.mp4"), *matrix)
    with pytest.raises(InputError, match=r"a.mp4 \(camera a\) has a display matrix that is not a rotation"):
        Scene.open(write_scene(tmp_path, ["a"]))


def test_videos_of_different_rates_are_refused(tmp_path):
    write_plain(tmp_path / "a.mp4")
    write_plain(tmp_path / "b.webm", n_frames=30, rate=30)
    for keys in ({}, {"fps": 20}):
        with pytest.raises(InputError, match=r"20 \(camera a\) and 30 \(camera b\) frames per second.*resample"):
            Scene.open(write_scene(tmp_path, ["a", "b"], **keys))
    scene = Scene.open(write_scene(tmp_path, ["a", "b"], resample=10))
    assert scene.fps == 10 and frames_of(scene) == [list(range(0, 20, 2)), [number % 20 for number in range(0, 30, 3)]]


@pytest.mark.parametrize("name, codec", [("a.mp4", "mpeg4"), ("a.mkv", "mpeg2video"), ("a.mov", "libx264")])
def test_interlaced_videos_are_read_or_refused(tmp_path, name, codec):
    """OpenCV 5 gives the same picture of whatever its memory held for each of their frames, without an error."""
    av = pytest.importorskip("av")
    with av.open(str(tmp_path / name), "w") as file:
        clip = file.add_stream(codec, rate=RATE, options={"flags": "+ilme+ildct", "x264-params": "interlaced=1"})
        clip.width, clip.height, clip.pix_fmt = 64, 48, "yuv420p"
        for frame in range(N_FRAMES):
            picture = np.full((48, 64, 3), 12 * frame, np.uint8)
            file.mux(clip.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
        file.mux(clip.encode())
    try:
        assert frames_of(Scene.open(write_scene(tmp_path, ["a"]))) == [list(range(N_FRAMES))]
    except InputError as error:
        assert re.search("same picture in all frames: .* or it is interlaced", str(error))


def test_fps_replaces_the_rate_of_even_videos(tmp_path):
    """Slow motion is stored at the rate at which it is played."""
    write_plain(tmp_path / "a.mp4")
    scene = Scene.open(write_scene(tmp_path, ["a"], fps=240))
    assert (scene.n_steps, scene.fps) == (20, 240) and "20 per second, is replaced by fps: 240" in describe(scene)
    (tmp_path / "b").mkdir()
    for number in range(20):
        cv2.imwrite(str(tmp_path / "b" / f"{number}.png"), np.zeros((48, 64, 3), np.uint8))
    with pytest.raises(InputError, match="fps is 240, but the videos have 20"):
        Scene.open(write_scene(tmp_path, ["a", "b"], fps=240))
    assert Scene.open(write_scene(tmp_path, ["a", "b"], fps=20)).n_steps == 20
    with pytest.raises(InputError, match="fps is needed"):
        Scene.open(write_scene(tmp_path, ["a", "b"]))


@pytest.mark.parametrize("suffix", [*SUFFIXES, ".avi"])
@pytest.mark.parametrize("share", [0.5, 0.97])
def test_truncated_videos_are_named(tmp_path, suffix, share):
    file = write_plain(tmp_path / f"a{suffix}")
    data = file.read_bytes()
    file.write_bytes(data[: round(len(data) * share)])
    with pytest.raises(InputError, match=rf"a{suffix} \(camera a\) cannot be (opened|decoded to its end)"):
        Scene.open(write_scene(tmp_path, ["a"]))


def test_video_with_damaged_end_is_refused(tmp_path):
    file = write_plain(tmp_path / "a.mp4")
    data = bytearray(file.read_bytes())
    index, start = data.find(b"moov") - 4, data.find(b"mdat") + 4
    data[start + (index - start) // 2 : index] = bytes(index - start - (index - start) // 2)
    file.write_bytes(data)
    with pytest.raises(InputError, match=r"a.mp4 \(camera a\) (cannot be decoded|is uneven)"):
        Scene.open(write_scene(tmp_path, ["a"]))


def test_constant_time_stamps_are_refused(tmp_path):
    file = write_plain(tmp_path / "a.mp4")
    edit_boxes(file, {b"stts": lambda old: old[:-4] + bytes(4)})
    with pytest.raises(InputError, match=r"a.mp4 \(camera a\) (has invalid time stamps|is uneven|cannot be decoded)"):
        Scene.open(write_scene(tmp_path, ["a"]))


def test_video_path_that_is_not_utf8_is_refused(tmp_path):
    """OpenCV ends the process there."""
    folder = Path(os.fsdecode(os.fsencode(tmp_path) + b"/\xff"))
    folder.mkdir()
    write_plain(tmp_path / "a.mp4").rename(folder / "a.mp4")
    with pytest.raises(InputError, match="not UTF-8"):
        Scene.open(write_scene(folder, ["a"]))
    with pytest.raises(InputError, match="not UTF-8"):
        write_video(folder / "b.mp4", [np.zeros((48, 64, 3), np.uint8)], 20)
