"""Small scene folders for tests: a coloured ball falls on a disc, drawn with numpy only."""

import json
from pathlib import Path

import cv2
import numpy as np

SIZE, N_CAMS, DISTANCE = 32, 5, 2.5


def write_scene(folder: Path, n_steps=6, size=SIZE, seed=0) -> Path:
    """A scene in the published layout: cameras on a ring look at a ball (label 3) above the ground (label 1)."""
    rng = np.random.default_rng(seed)
    color, height = rng.uniform(0.3, 1, 3), rng.uniform(0.8, 1.0)
    metadata = {
        "n_steps": n_steps, "n_cams": N_CAMS, "file_path_template": "cam_{cam_ix}/{img_type}_{n_step:04d}",
        "fps": 12.0, "near": 1.2, "far": 4.0,
    }  # fmt: skip
    for cam in range(N_CAMS):
        viewmat, K = camera(cam, size)
        metadata[f"cam_{cam}"] = {"extrinsics": viewmat.tolist(), "intrinsics": K.tolist(), "resolution": [size, size]}
        (folder / f"cam_{cam}").mkdir(parents=True)
        for step in range(n_steps):
            center = np.array([0.0, 0.0, max(0.3, height - 0.02 * step**2)])
            rgb, labels = draw(viewmat, K, size, center, 0.3, color)
            cv2.imwrite(str(folder / f"cam_{cam}" / f"rgb_{step:04d}.png"), rgb[..., ::-1])
            cv2.imwrite(str(folder / f"cam_{cam}" / f"seg_{step:04d}.png"), labels)
    (folder / "metadata.json").write_text(json.dumps(metadata))
    return folder


def write_scenes(root: Path, count=2, **options) -> Path:
    for i in range(count):
        write_scene(root / "ball" / f"{i:04d}", seed=i, **options)
    return root


def camera(cam, size):
    angle = 2 * np.pi * cam / N_CAMS
    position = np.array([DISTANCE * np.cos(angle), DISTANCE * np.sin(angle), 1.4])
    forward = np.array([0, 0, 0.4]) - position
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, [0, 0, 1])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    viewmat = np.eye(4)
    viewmat[:3, :3], viewmat[:3, 3] = rotation, -rotation @ position
    return viewmat, np.array([[1.3 * size, 0, size / 2], [0, 1.3 * size, size / 2], [0, 0, 1]])


def draw(viewmat, K, size, center, radius, color):
    y, x = np.mgrid[:size, :size] + 0.5
    rays = np.stack([(x - K[0, 2]) / K[0, 0], (y - K[1, 2]) / K[1, 1], np.ones_like(x)], -1) @ viewmat[:3, :3]
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    origin = -viewmat[:3, :3].T @ viewmat[:3, 3]
    ground = origin + rays * (-origin[2] / np.minimum(rays[..., 2], -1e-6))[..., None]
    labels = np.where((rays[..., 2] < 0) & (np.hypot(ground[..., 0], ground[..., 1]) < 1), 1, 0).astype(np.uint8)
    checks = (np.floor(4 * ground[..., 0]) + np.floor(4 * ground[..., 1])) % 2
    rgb = np.where(labels[..., None] == 1, 0.5 + 0.3 * checks[..., None] * np.ones(3), 0.0)
    to_center = center - origin
    along = rays @ to_center
    off = (to_center**2).sum() - along**2
    hit = (off < radius**2) & (along > 0)
    normal = (origin + rays * (along - np.sqrt(np.maximum(radius**2 - off, 0)))[..., None] - center) / radius
    rgb[hit] = (color * (0.5 + 0.5 * normal[..., 2:]))[hit]
    labels[hit] = 3
    return (np.clip(rgb, 0, 1) * 255).round().astype(np.uint8), labels
