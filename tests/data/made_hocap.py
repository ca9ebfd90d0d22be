"""A HO-Cap folder with known geometry: a table, a moving box and hands of spheres, in both layout versions."""

import json
from pathlib import Path

import cv2
import numpy as np
import yaml

from tests.capture.made_clips import look_at

SERIALS = ("105322251564", "037522251142", "043422252387")  # the second is an octal number without quotes
SIZE, N_FRAMES = (160, 120), 32
WORLD_FROM_MASTER = np.eye(4)  # tag_1 in the master camera's frame is its inverse
BOX = np.array([[x, y, z] for x in (-0.06, 0.06) for y in (-0.04, 0.04) for z in (0.0, 0.09)])
FACES = ((0, 1, 3, 2), (4, 5, 7, 6), (0, 1, 5, 4), (2, 3, 7, 6), (0, 2, 6, 4), (1, 3, 7, 5))


def intrinsics(number: int) -> np.ndarray:
    """With pixel centres at integers, as in the files."""
    return np.array([[118.0 + number, 0, 81.5 - number], [0, 121.0, 57.0 + number], [0, 0, 1]])


def poses() -> list[np.ndarray]:
    """World -> camera."""
    angles = np.radians([-60, -25, 20])
    return [look_at(0.9 * np.array([np.sin(a), -np.cos(a), 0.8]), [0, 0, 0.1]) for a in angles]


def box_pose(frame: int) -> np.ndarray:
    pose = np.eye(4)
    angle = 0.05 * frame
    pose[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    pose[:3, 3] = 0.12 * np.sin(0.2 * frame), 0.08 * np.cos(0.2 * frame), 0.0
    return pose


def hand(side: str, frame: int) -> np.ndarray:
    """Joints [21, 3] in the world; the motion is cyclic."""
    finger, along = np.divmod(np.arange(20), 4)
    base = np.array([0.16 if side == "right" else -0.16, -0.02, 0.12 + 0.03 * np.sin(2 * np.pi * frame / 16)])
    tips = np.stack([0.018 * (finger - 2), 0.02 + 0.02 * along, 0.004 * along * np.cos(0.3 * frame)], 1)
    return base + np.concatenate([np.zeros((1, 3)), tips])


def write_hocap(
    root: Path, *, first_version=False, sides=("right", "left"), n_frames=N_FRAMES, inverted=False, gaps=True
):
    """Writes ROOT/subject_1/20231025_165502 and the calibration; returns the sequence.

    ``inverted``: extrinsics written world-to-camera. ``gaps``: labels of the first camera are missing at frame 3, the
    left hand is absent at frames 5 and 6, and from frame 20 to 26.
    """
    folder, calibration = root / "subject_1" / "20231025_165502", root / "calibration"
    viewmats = poses()
    master = np.linalg.inv(viewmats[0])  # master camera -> world
    turn = np.eye(4)
    turn[:3, :3], turn[:3, 3] = cv2.Rodrigues(np.radians([0, 0, 30.0]))[0], [0.4, 0, 0]
    to_master = np.linalg.inv(turn @ master)
    matrices = {"tag_0": np.eye(4), "tag_1": to_master @ turn}
    for serial, viewmat in zip(SERIALS, viewmats, strict=True):
        matrices[serial] = to_master @ turn @ np.linalg.inv(viewmat)
    matrices |= {serial: np.linalg.inv(matrices[serial]) for serial in SERIALS if inverted}
    extrinsics = {"rs_master": SERIALS[0], "extrinsics": {k: m[:3].ravel().tolist() for k, m in matrices.items()}}
    meta = {
        "num_frames": n_frames, "object_ids": ["G01_1"], "mano_sides": list(sides), "task_id": 1,
        "realsense": {"serials": list(SERIALS), "width": SIZE[0], "height": SIZE[1]},
    }  # fmt: skip
    for number, serial in enumerate(SERIALS):
        K = intrinsics(number)
        color = {"color": {"fx": K[0, 0], "fy": K[1, 1], "ppx": K[0, 2], "ppy": K[1, 2]}}
        color = {"color": {key: float(value) for key, value in color["color"].items()}}
        name = f"{serial}_640x480.json" if first_version else f"{serial}.yaml"
        _write(calibration / "intrinsics" / name, color)
    if first_version:
        _write(calibration / "extrinsics" / "extrinsics_20231014" / "extrinsics.json", extrinsics)
        meta |= {"calibration": {"mano": "subject_1", "extrinsics": "extrinsics_20231014"}}
        meta["hololens"] = {"serials": ["hololens_kv5h72"], "pv_width": 1280, "pv_height": 720}
    else:
        _write(calibration / "extrinsics" / "extrinsics_20231014.yaml", extrinsics)
        meta |= {"subject_id": "subject_1", "extrinsics": "extrinsics_20231014.yaml"}
        meta["hololens"] = {"serial": "hololens_kv5h72", "pv_width": 1280, "pv_height": 720}
    _write(folder / ("meta.json" if first_version else "meta.yaml"), meta)
    np.save(folder / "poses_m.npy", np.full((2, n_frames, 51), -1, np.float32))
    for number, (serial, viewmat) in enumerate(zip(SERIALS, viewmats, strict=True)):
        (folder / serial).mkdir()
        for frame in range(n_frames):
            image, mask = draw(viewmat, intrinsics(number), sides, frame)
            cv2.imwrite(str(folder / serial / f"color_{frame:06d}.jpg"), image, [cv2.IMWRITE_JPEG_QUALITY, 95])
            if first_version:
                if not (gaps and frame == 3 and number == 0):
                    cv2.imwrite(str(folder / serial / f"mask_{frame:06d}.png"), mask)
            elif not (gaps and frame == 3 and number == 0):
                _write_label(folder / serial / f"label_{frame:06d}.npz", viewmat, number, sides, frame, mask, gaps)
    return folder


def _write(file: Path, content: dict) -> None:
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(json.dumps(content) if file.suffix == ".json" else yaml.safe_dump(content))


def _write_label(file, viewmat, number, sides, frame, mask, gaps) -> None:
    K = intrinsics(number)
    joints3d, joints2d = np.full((len(sides), 21, 3), -1.0, np.float32), np.full((len(sides), 21, 2), -1.0, np.float32)
    for row, side in enumerate(sides):
        if gaps and side == "left" and (frame in (5, 6) or 20 <= frame <= 26):
            continue
        local = hand(side, frame) @ viewmat[:3, :3].T + viewmat[:3, 3]
        joints3d[row], joints2d[row] = local, (local @ K.T)[:, :2] / local[:, 2:]
    np.savez_compressed(
        file, cam_K=K, obj_poses=(viewmat @ box_pose(frame))[None], hand_joints_3d=joints3d, hand_joints_2d=joints2d,
        seg_mask=mask, obj_class_inds=np.arange(2), obj_class_names=np.array(["G01_1", "right"]),
    )  # fmt: skip


def draw(viewmat, K, sides, frame):
    """BGR image and mask: a table of checks, the box (1) and the joints (2 and more), painted from far to near."""

    def pixels(points):
        local = points @ viewmat[:3, :3].T + viewmat[:3, 3]
        return ((local @ K.T)[:, :2] / local[:, 2:]).round().astype(np.int32), local[:, 2]

    checks = np.kron(np.indices((14, 24)).sum(0) % 2, np.ones((5, 5))).astype(np.float32) * 60 + 120
    plane = np.array([[0.01, 0, -0.6], [0, 0.01, -0.35], [0, 0, 0]])
    H = K @ (viewmat[:3, :3] @ plane + np.outer(viewmat[:3, 3], [0, 0, 1]))
    image = np.repeat(cv2.warpPerspective(checks, H, SIZE)[..., None], 3, 2)
    mask = np.zeros(SIZE[::-1], np.uint8)
    shapes = []
    corners = BOX @ box_pose(frame)[:3, :3].T + box_pose(frame)[:3, 3]
    at, depth = pixels(corners)
    shapes += [(depth[list(face)].mean(), 1, at[list(face)], (40, 60 + 30 * n, 220)) for n, face in enumerate(FACES)]
    for row, side in enumerate(sides):
        at, depth = pixels(hand(side, frame))
        shapes += [(d, 2 + row, pixel, (120, 160, 230)) for d, pixel in zip(depth, at)]
    for depth, label, at, color in sorted(shapes, key=lambda shape: -shape[0]):
        for canvas, ink in ((image, color), (mask, label)):
            if at.ndim == 2:
                cv2.fillConvexPoly(canvas, at, ink)
            else:
                cv2.circle(canvas, at.tolist(), max(1, round(0.012 * K[0, 0] / depth)), ink, -1)
    return image.clip(0, 255).astype(np.uint8), mask
