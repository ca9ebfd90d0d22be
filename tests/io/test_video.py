"""The video is H.264 or VP9 in MP4, has every frame, and the frames differ."""

import sys

import cv2
import numpy as np
import pytest

from gsim3d.errors import InputError
from gsim3d.io import write_video


def moving_square(n, height=64, width=96):
    frames = np.full((n, height, width, 3), 30, np.uint8)
    for t in range(n):
        frames[t, 20:40, 5 * t : 5 * t + 20] = (220, 60, 40)
    return frames


@pytest.fixture(params=["avc1", "vp09"])
def codec(request, monkeypatch):
    if request.param == "avc1":
        pytest.importorskip("av", reason="PyAV is not installed")
    else:
        monkeypatch.setitem(sys.modules, "av", None)
    return request.param


def test_write_video_codec_frames_rate_and_colours(codec, tmp_path):
    frames = moving_square(10)
    write_video(tmp_path / "a.mp4", iter(frames), fps=12)
    assert [path.name for path in tmp_path.iterdir()] == ["a.mp4"]
    content = (tmp_path / "a.mp4").read_bytes()
    assert content[4:8] == b"ftyp" and codec.encode() in content
    if codec == "avc1":  # plays while it loads, and says its colours
        assert content.index(b"moov") < content.index(b"mdat") and b"colrnclx\0\1\0\1\0\1" in content
    video = cv2.VideoCapture(str(tmp_path / "a.mp4"))
    assert video.get(cv2.CAP_PROP_FPS) == 12
    decoded = []
    while (read := video.read())[0]:
        decoded.append(read[1][..., ::-1].astype(int))
    assert len(decoded) == 10
    for t, frame in enumerate(decoded):
        assert np.abs(frame - frames[t]).mean() < 6
        assert np.abs(frame[30, 5 * t + 10] - frames[t, 30, 5 * t + 10]).max() < 40
    assert all(np.abs(a - b).max() > 50 for a, b in zip(decoded, decoded[1:]))


@pytest.mark.parametrize(
    "name, frames, fps, message",
    [
        ("a.avi", moving_square(2), 12, "must end in .mp4"),
        ("a.mp4", moving_square(2), 0, "must be positive"),
        ("a.mp4", [], 12, "uint8"),
        ("a.mp4", moving_square(2).astype(np.float32), 12, "uint8"),
        ("a.mp4", moving_square(2, height=63), 12, "even size"),
        ("missing/a.mp4", moving_square(2), 12, "cannot write"),
        ("a.mp4", [*moving_square(2), moving_square(1, height=32)[0]], 12, r"got uint8 \[32, 96, 3\] after \[64, 96"),
    ],
)
def test_write_video_refuses_bad_input(tmp_path, name, frames, fps, message):
    with pytest.raises(InputError, match=message):
        write_video(tmp_path / name, frames, fps)
    assert list(tmp_path.iterdir()) == []


def test_write_video_detects_truncation(tmp_path, monkeypatch):
    """A full disk ends the file before its index, and the writer of OpenCV says nothing."""

    class Full:
        fourcc = staticmethod(lambda *_: 0)

        def __init__(self, path, *_):
            self.path = path

        def isOpened(self):
            return True

        def write(self, frame):
            pass

        def release(self):
            with open(self.path, "wb") as file:
                file.write(whole[: len(whole) // 2])

    frames = [np.full((32, 32, 3), 40 * k, np.uint8) for k in range(4)]
    monkeypatch.setitem(sys.modules, "av", None)
    write_video(tmp_path / "whole.mp4", frames, 12)
    whole = (tmp_path / "whole.mp4").read_bytes()
    monkeypatch.setattr(cv2, "VideoWriter", Full)
    with pytest.raises(OSError, match="could not be written as a whole.*cut.mp4"):
        write_video(tmp_path / "cut.mp4", frames, 12)
    assert [path.name for path in tmp_path.iterdir()] == ["whole.mp4"]
