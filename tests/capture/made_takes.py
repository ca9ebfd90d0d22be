"""Takes of a ball that swings over a checkered disc, recorded by still cameras, as videos beside cameras.json."""

import json
from pathlib import Path

import cv2
import numpy as np

from tests.capture.made_clips import look_at
from tests.tiny_scenes import draw

SIZE, FPS = 96, 30
NAMES = ("left", "middle", "right", "top")


def cameras_at(degrees):
    poses = []
    for angle in np.radians(degrees):
        position = np.array([2.5 * np.cos(angle), 2.5 * np.sin(angle), 1.4])
        poses.append(look_at(position, [0, 0, 0.4]))
    return poses


def write_take(folder: Path, degrees=(0, 25, 50), *, n_frames=72, starts=None, lens=None, **keys) -> Path:
    """``starts``: frames that each video begins late; ``keys`` of cameras.json."""
    folder.mkdir(parents=True)
    K = np.array([[1.3 * SIZE, 0, SIZE / 2], [0, 1.3 * SIZE, SIZE / 2], [0, 0, 1]])
    cameras = []
    for number, viewmat in enumerate(cameras_at(degrees)):
        name, late = NAMES[number], 0 if starts is None else starts[number]
        clip = cv2.VideoWriter(str(folder / f"{name}.avi"), cv2.VideoWriter_fourcc(*"MJPG"), FPS, (SIZE, SIZE))
        for frame in range(late, late + n_frames):
            time = frame / FPS
            center = np.array([0.5 * np.sin(3 * time), 0.45 * np.cos(2.3 * time + 0.5), 0.5 + 0.15 * np.sin(5 * time)])
            rgb, _ = draw(viewmat, K, SIZE, center, 0.18, np.array([0.9, 0.3, 0.2]))
            clip.write(rgb[..., ::-1])
        clip.release()
        entry = {"name": name, "size": [SIZE, SIZE], "K": K.tolist(), "offset": late / FPS}
        cameras.append({**entry, "R": viewmat[:3, :3].tolist(), "T": viewmat[:3, 3].tolist()})
    (folder / "cameras.json").write_text(json.dumps({"cameras": cameras, **keys}))
    return folder
