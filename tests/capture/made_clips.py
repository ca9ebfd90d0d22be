"""Videos of a ChArUco board and of textured walls, with known cameras and start times."""

from pathlib import Path

import cv2
import numpy as np

from tools.clips import board_clip

SIZE, FPS, N_FRAMES = (400, 300), 30, 54
LENS = np.array([-0.12, 0.04, 0.001, -0.0005, 0.0])


def look_at(position, target):
    forward = (np.asarray(target, float) - position) / np.linalg.norm(np.asarray(target) - position)
    right = np.cross(forward, [0, 0, 1.0])
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward])
    pose[:3, 3] = -pose[:3, :3] @ position
    return pose


def rig(angles=(-25, 0, 30), distance=0.66):
    """(name, K, viewmat) of cameras that look down at the origin."""
    cameras = []
    for number, degrees in enumerate(angles):
        angle = np.radians(degrees)
        position = distance * np.array([np.sin(angle), -np.cos(angle), 0.9])
        K = np.array([[370.0 + 5 * number, 0, 202 - number], [0, 373, 148 + number], [0, 0, 1]])  # pixel centres at 0
        cameras.append((f"cam{number}", K, look_at(position, [0, 0, 0.05])))
    return cameras


def write_board_clips(folder: Path, board, cameras, starts, *, n_frames=N_FRAMES) -> Path:
    """One video of each camera that begins ``starts[c]`` seconds after time 0; the board rests near the end."""
    folder.mkdir(parents=True, exist_ok=True)
    rng, viewer = np.random.default_rng(0), np.mean([np.linalg.inv(camera[2])[:3, 3] for camera in cameras], 0)
    for number, ((name, K, viewmat), start) in enumerate(zip(cameras, starts, strict=True)):
        writer = cv2.VideoWriter(str(folder / f"{name}.avi"), cv2.VideoWriter_fourcc(*"MJPG"), FPS, SIZE)
        times = start + np.arange(n_frames) / FPS
        for frame in board_clip(board, K, viewmat, LENS, SIZE, times, n_frames / FPS - 0.4, viewer, number):
            writer.write((frame + rng.normal(0, 1.5, frame.shape)).clip(0, 255).astype(np.uint8))
        writer.release()
    return folder


def write_textured_clips(folder: Path, cameras, *, n_frames=8, seed=0) -> Path:
    """Videos of four textured walls and a floor, by pinhole cameras (``rig``), with a little noise."""
    rng = np.random.default_rng(seed)
    walls = [  # corner and two sides, metres
        ([-0.6, -0.6, 0.0], [1.2, 0, 0], [0, 1.2, 0]),
        ([-0.6, 0.6, 0.0], [1.2, 0, 0], [0, 0, 0.7]),
        ([-0.3, 0.2, 0.0], [0.3, 0.1, 0], [0, 0, 0.4]),
        ([0.1, -0.1, 0.0], [0.25, -0.1, 0], [0.0, 0.05, 0.3]),
    ]
    textures = [cv2.resize(rng.uniform(0, 255, (60, 60, 3)), (600, 600), interpolation=cv2.INTER_CUBIC) for _ in walls]
    folder.mkdir(parents=True, exist_ok=True)
    for name, K, viewmat in cameras:
        image = np.full((SIZE[1], SIZE[0], 3), 90.0)
        for (corner, x, y), texture in zip(walls, textures, strict=True):
            plane = np.stack([np.array(x) / 600, np.array(y) / 600, np.array(corner)], 1)
            H = K @ (viewmat[:3, :3] @ plane + np.outer(viewmat[:3, 3], [0, 0, 1]))
            shown = cv2.warpPerspective(np.dstack([texture.clip(0, 255), np.ones((600, 600))]), H, SIZE)
            image = np.where(shown[..., 3:] > 0.5, shown[..., :3], image)
        writer = cv2.VideoWriter(str(folder / f"{name}.avi"), cv2.VideoWriter_fourcc(*"MJPG"), FPS, SIZE)
        for _ in range(n_frames):
            writer.write((image + rng.normal(0, 2, image.shape)).clip(0, 255).astype(np.uint8))
        writer.release()
    return folder
