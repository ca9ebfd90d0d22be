"""One synthetic scene, written in every layout: a ball (label 3) moves over a disc (label 1) on black (label 0)."""

import json
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

WIDTH, HEIGHT, N_CAMS, N_STEPS, FPS = 48, 32, 3, 4, 12.0
NEAR, FAR, ORIGIN, BOUNDS = 1.0, 5.0, [-2.0, -2.5, -1.0], [[-1.0, -1.0, -0.2], [1.0, 1.0, 1.2]]
EXTRAS = {"fps": FPS, "near": NEAR, "far": FAR, "origin": ORIGIN, "bounds": BOUNDS}
RADIUS = 0.22
COLOR = np.array([250, 90, 20])


@dataclass
class Made:
    """viewmats [T, V, 4, 4] (world-to-camera, OpenCV), Ks [T, V, 3, 3], rgb [T, V, H, W, 3], labels [T, V, H, W]."""

    viewmats: np.ndarray
    Ks: np.ndarray
    rgb: np.ndarray
    labels: np.ndarray
    centers: np.ndarray


def make_scene(moving=False, zoom=0.0, width=WIDTH, height=HEIGHT, n_steps=N_STEPS, n_cams=N_CAMS) -> Made:
    """Cameras on an arc, each with its own intrinsics; with ``moving`` they walk on, with ``zoom`` they zoom in."""
    shape = (n_steps, n_cams)
    viewmats, Ks = np.zeros((*shape, 4, 4)), np.zeros((*shape, 3, 3))
    rgb, labels = np.zeros((*shape, height, width, 3), np.uint8), np.zeros((*shape, height, width), np.uint8)
    centers = np.stack([[0.3 * np.cos(t), 0.1 * t - 0.2, 0.5 + 0.05 * t] for t in range(n_steps)])
    for step, cam in np.ndindex(*shape):
        viewmats[step, cam] = look_at(0.9 * cam + (0.15 * step if moving else 0), roll=0.2 * cam)
        focal = (1.1 + zoom * step) * width + cam
        Ks[step, cam] = [[focal, 0, width / 2 + 2 - cam], [0, focal + 3, height / 2 + 1.5 * cam], [0, 0, 1]]
        rgb[step, cam], labels[step, cam] = draw(viewmats[step, cam], Ks[step, cam], width, height, centers[step])
    return Made(viewmats, Ks, rgb, labels, centers)


def look_at(angle, roll):
    position = np.array([2.6 * np.cos(angle), 2.6 * np.sin(angle), 1.5])
    forward = np.array([0, 0, 0.4]) - position
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, [0, 0, 1])
    right /= np.linalg.norm(right)
    down = np.cross(forward, right)
    right, down = np.cos(roll) * right + np.sin(roll) * down, np.cos(roll) * down - np.sin(roll) * right
    viewmat = np.eye(4)
    viewmat[:3, :3] = [right, down, forward]
    viewmat[:3, 3] = -viewmat[:3, :3] @ position
    return viewmat


def draw(viewmat, K, width, height, center):
    """Colours and labels along the ray through the centre (+0.5) of every pixel."""
    y, x = np.mgrid[:height, :width] + 0.5
    rays = np.stack([(x - K[0, 2]) / K[0, 0], (y - K[1, 2]) / K[1, 1], np.ones_like(x)], -1) @ viewmat[:3, :3]
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    origin = -viewmat[:3, :3].T @ viewmat[:3, 3]
    ground = origin + rays * (-origin[2] / np.minimum(rays[..., 2], -1e-6))[..., None]
    on_disc = (rays[..., 2] < 0) & (np.hypot(ground[..., 0], ground[..., 1]) < 0.8)
    along = rays @ (center - origin)
    on_ball = (along > 0) & ((center - origin) @ (center - origin) - along**2 < RADIUS**2)
    labels = np.where(on_ball, 3, np.where(on_disc, 1, 0)).astype(np.uint8)
    rgb = np.zeros((height, width, 3), np.uint8)
    rgb[on_disc] = (100 + 60 * np.sin(5 * ground[on_disc])).astype(np.uint8)
    rgb[on_ball] = COLOR
    return rgb, labels


def save(file: Path, image: np.ndarray) -> None:
    """RGB, RGBA or one channel."""
    file.parent.mkdir(parents=True, exist_ok=True)
    order = {3: [2, 1, 0], 4: [2, 1, 0, 3]}.get(image.shape[2]) if image.ndim == 3 else None
    assert cv2.imwrite(str(file), np.ascontiguousarray(image if order is None else image[..., order]))


def edit_json(file: Path, change) -> None:
    content = json.loads(file.read_text())
    change(content)
    file.write_text(json.dumps(content))


def still(matrices: np.ndarray) -> list:
    """One matrix where it is the same at all steps, else one a step."""
    return (matrices[0] if (matrices == matrices[0]).all() else matrices).tolist()


def write_genesis(folder: Path, made: Made) -> Path:
    n_steps, n_cams, height, width = made.labels.shape
    metadata = {"n_steps": n_steps, "n_cams": n_cams, "file_path_template": "cam_{cam_ix}/{img_type}_{n_step:04d}"}
    for cam in range(n_cams):
        metadata[f"cam_{cam}"] = {
            "extrinsics": still(made.viewmats[:, cam]),
            "intrinsics": still(made.Ks[:, cam]),
            "resolution": [width, height],
        }
        for step in range(n_steps):
            save(folder / f"cam_{cam}/rgb_{step:04d}.png", made.rgb[step, cam])
            save(folder / f"cam_{cam}/seg_{step:04d}.png", made.labels[step, cam])
    (folder / "metadata.json").write_text(json.dumps({**metadata, **EXTRAS}))
    return folder


def write_kubric(folder: Path, made: Made, subfolders=True) -> Path:
    """MOVi's folders for each kind of image, or Kubric's own file names."""
    n_steps, n_cams, height, width = made.labels.shape
    flip = np.diag([1.0, -1.0, -1.0])
    for cam in range(n_cams):
        poses = np.linalg.inv(made.viewmats[:, cam])
        K = np.diag([1 / width, 1 / height, 1.0]) @ made.Ks[0, cam] @ flip
        camera = {
            "positions": poses[:, :3, 3].tolist(),
            "quaternions": [quaternion(pose[:3, :3] @ flip) for pose in poses],
            "K": K.tolist(),
            "focal_length": 35.0,
            "sensor_width": 32.0,
            "field_of_view": 0.8,
        }
        metadata = {"resolution": [width, height], "frame_rate": FPS, "num_frames": n_steps}
        own = folder / f"cam_{cam}"
        for step in range(n_steps):
            labels = made.labels[step, cam]
            alpha = np.where(labels > 0, 255, 0).astype(np.uint8)[..., None]
            rgba = own / "rgba" / f"rgba_{step}.png" if subfolders else own / f"rgba_{step:05d}.png"
            save(rgba, np.concatenate([made.rgb[step, cam], alpha], -1))
            marked = np.where(labels == 3, 2, 0).astype(np.uint8)
            name = f"segmentation_{step}.png" if subfolders else f"segmentation_{step:05d}.png"
            save(
                own / "segmentation" / name if subfolders else own / name,
                marked[..., None] * np.array([0, 1, 90], np.uint8),
            )
        (own / "metadata.json").write_text(json.dumps({"camera": camera, "metadata": metadata, **EXTRAS}))
    return folder


def quaternion(rotation: np.ndarray) -> list:
    """(w, x, y, z): the eigenvector of the largest eigenvalue of Bar-Itzhack's matrix."""
    (a, b, c), (d, e, f), (g, h, i) = rotation
    matrix = np.array(
        [
            [a - e - i, d + b, g + c, h - f],
            [d + b, e - a - i, h + f, c - g],
            [g + c, h + f, i - a - e, d - b],
            [h - f, c - g, d - b, a + e + i],
        ]
    )
    x, y, z, w = np.linalg.eigh(matrix)[1][:, -1]
    return [w, x, y, z]


def write_transforms(folder: Path, made: Made) -> Path:
    n_steps, n_cams, height, width = made.labels.shape
    frames = []
    for step, cam in np.ndindex(n_steps, n_cams):
        K = made.Ks[step, cam]
        name = f"cam_{cam}/frame_{step + 1:05d}.png"
        save(folder / "images" / name, made.rgb[step, cam])
        save(folder / "labels" / name, made.labels[step, cam])
        frames.append(
            {
                "file_path": f"images/{name}",
                "label_path": f"labels/{name}",
                "transform_matrix": (np.linalg.inv(made.viewmats[step, cam]) @ np.diag([1.0, -1, -1, 1])).tolist(),
                "time": 7.0 + step / FPS,
                "fl_x": K[0, 0], "fl_y": K[1, 1], "cx": K[0, 2], "cy": K[1, 2],
            }
        )  # fmt: skip
    content = {"camera_model": "OPENCV", "w": width, "h": height, "frames": frames[::-1], **EXTRAS}
    (folder / "transforms.json").write_text(json.dumps(content))
    return folder


def write_videos(folder: Path, made: Made, stride=2) -> Path:
    """Folders of frames whose numbers are ``stride`` apart, recorded at ``stride`` times the rate."""
    n_steps, n_cams, height, width = made.labels.shape
    cameras = []
    for cam in range(n_cams):
        for step in range(n_steps):
            save(folder / f"cam_{cam}/{stride * step:03d}.png", made.rgb[step, cam])
            save(folder / f"labels/cam_{cam}/{stride * step:03d}.png", made.labels[step, cam])
        viewmats = made.viewmats[:, cam]
        cameras.append(
            {
                "name": f"cam_{cam}",
                "size": [width, height],
                "K": still(made.Ks[:, cam]),
                "R": still(viewmats[:, :3, :3]),
                "T": still(viewmats[:, :3, 3]),
            }
        )
    content = {"cameras": cameras, **EXTRAS, "fps": stride * FPS}
    (folder / "cameras.json").write_text(json.dumps(content))
    return folder


def write_kubric_flat(folder: Path, made: Made) -> Path:
    return write_kubric(folder, made, subfolders=False)


WRITERS = {
    "genesis": write_genesis,
    "kubric": write_kubric,
    "kubric's own names": write_kubric_flat,
    "transforms": write_transforms,
    "videos": write_videos,
}
