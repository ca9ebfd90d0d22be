"""Films of a ChArUco board, ray traced with numpy through distorting lenses, with known cameras and start times."""

from pathlib import Path

import cv2
import numpy as np

SIZE, FPS, N_FRAMES = (400, 300), 30, 54
LENS = np.array([-0.12, 0.04, 0.001, -0.0005, 0.0])
MARGIN = 0.5  # squares of white paper around the board


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


def board_pose(time: float, at_rest: float) -> np.ndarray:
    """Board -> world: it swings and tilts, and lies on the floor from ``at_rest`` on."""
    moving = max(0.0, 1 - max(0.0, time - at_rest + 0.3) / 0.3)
    # The pace changes, so that the motion of two films matches at one lag only.
    phase = 11 * time + 0.9 * np.sin(7 * time) + 0.4 * np.sin(13 * time)
    turn = moving * np.array([0.3 + 0.5 * np.sin(phase), 0.6 * np.cos(0.7 * phase), 0.6 * np.sin(0.4 * phase)])
    pose = np.eye(4)
    pose[:3, :3] = cv2.Rodrigues(turn)[0] @ np.diag([1.0, -1, -1])  # printed side up
    pose[:3, 3] = moving * np.array([0.12 * np.sin(0.63 * phase), 0.12 * np.sin(0.5 * phase), 0.12])
    return pose


def write_board_films(folder: Path, board, cameras, starts, *, seed=0, fps=FPS, n_frames=N_FRAMES) -> Path:
    """One film of each camera that begins ``starts[c]`` seconds after time 0; the board rests near the end."""
    folder.mkdir(parents=True, exist_ok=True)
    rng, pixels = np.random.default_rng(seed), 40
    made = board.made()
    square = board.square
    texture = made.generateImage((board.columns * pixels, board.rows * pixels))
    texture = np.pad(texture, round(MARGIN * pixels), constant_values=255)
    centred = np.eye(4)
    centred[:2, 3] = -0.5 * square * np.array([board.columns, board.rows])
    for (name, K, viewmat), start in zip(cameras, starts, strict=True):
        y, x = np.mgrid[: 2 * SIZE[1], : 2 * SIZE[0]] / 2 - 0.25
        flat = cv2.undistortPoints(np.stack([x, y], -1).reshape(-1, 1, 2), K, LENS).reshape(-1, 2)
        rays = np.concatenate([flat, np.ones((len(flat), 1))], 1)
        scenery = cv2.GaussianBlur(rng.uniform(60, 110, (2 * SIZE[1], 2 * SIZE[0])).astype(np.float32), (0, 0), 3)
        writer = cv2.VideoWriter(str(folder / f"{name}.avi"), cv2.VideoWriter_fourcc(*"MJPG"), fps, SIZE)
        for frame in range(n_frames):
            pose = viewmat @ board_pose(start + frame / fps, n_frames / fps - 0.4) @ centred
            inverse = np.linalg.inv(pose)
            local, origin = rays @ inverse[:3, :3].T, inverse[:3, 3]
            hit = origin + local * (-origin[2] / local[:, 2])[:, None]
            at = (hit[:, :2] / square + MARGIN) * pixels - 0.5
            maps = at.reshape(2 * SIZE[1], 2 * SIZE[0], 2).astype(np.float32)
            image = cv2.remap(texture, maps, None, cv2.INTER_LINEAR, borderValue=0).astype(np.float32)
            outside = (maps < -0.5).any(-1) | (maps > np.array(texture.shape[::-1]) - 0.5).any(-1)
            image = cv2.resize(np.where(outside, scenery, image), SIZE, interpolation=cv2.INTER_AREA)
            image = (image + rng.normal(0, 1.5, image.shape)).clip(0, 255).astype(np.uint8)
            writer.write(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR))
        writer.release()
    return folder


def write_textured_films(folder: Path, cameras, *, n_frames=8, seed=0) -> Path:
    """Films of four textured walls and a floor, by pinhole cameras (``rig``), with a little noise."""
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
