"""Small scene folders written by hand, so that the reader is not tested with the generator's own writer."""

import json
from pathlib import Path

import cv2
import numpy as np


def camera(cam: int, width: int, height: int) -> dict:
    angle = 0.7 * cam
    c, s = np.cos(angle), np.sin(angle)
    extrinsics = [[c, -s, 0, 0.1], [0, 0, -1, 0.3], [s, c, 0, 2.5], [0, 0, 0, 1]]
    intrinsics = [[30.0, 0, width / 2 + 1], [0, 31.0, height / 2 - 2], [0, 0, 1]]
    return {
        "extrinsics": np.array(extrinsics).tolist(),
        "intrinsics": intrinsics,
        "resolution": [width, height],
    }


def write_scene(folder: Path, *, n_steps=4, n_cams=3, width=32, height=16, seed=0, edits=None) -> dict:
    """Writes a scene of random images; ``edits`` replace metadata keys (None removes one). Returns the arrays."""
    template = "{img_type}/cam_{cam_ix}/{n_step:04d}"
    rng = np.random.default_rng(seed)
    rgb = rng.integers(0, 256, (n_steps, n_cams, height, width, 3), dtype=np.uint8)
    seg = rng.choice(np.array([0, 1, 3], dtype=np.uint8), (n_steps, n_cams, height, width))
    for step in range(n_steps):
        for cam in range(n_cams):
            for kind, image in (("rgb", rgb[step, cam, ..., ::-1]), ("seg", seg[step, cam])):
                file = folder / (template.format(img_type=kind, cam_ix=cam, n_step=step) + ".png")
                file.parent.mkdir(parents=True, exist_ok=True)
                assert cv2.imwrite(str(file), np.ascontiguousarray(image))
    metadata = {"n_steps": n_steps, "n_cams": n_cams, "file_path_template": template}
    metadata |= {f"cam_{cam}": camera(cam, width, height) for cam in range(n_cams)}
    metadata |= {"fps": 20.0, "near": 1.0, "far": 4.0, "origin": [-2.0, -2.0, -0.5], **(edits or {})}
    metadata = {key: value for key, value in metadata.items() if value is not None}
    (folder / "metadata.json").write_text(json.dumps(metadata))
    return {"rgb": rgb, "seg": seg, "metadata": metadata}
