"""The published layout: metadata.json, and one PNG for each camera, step and image type.

metadata.json holds n_steps, n_cams, file_path_template (fields cam_ix, n_step, img_type; ".png" is appended)
and for each camera cam_<j>: extrinsics (4x4, world-to-camera, OpenCV axes), intrinsics (3x3, pixels) and
resolution [W, H]. Optional: fps, near, far (metres), origin, bounds; extrinsics and intrinsics of cameras that move
are lists with one matrix a step. Image types: rgb; seg (0 background, 1 ground and fixed parts, 3 bodies that may
move).
"""

from __future__ import annotations

import re
import string
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from gsim3d.data.cameras import by_step, check_intrinsics, check_pose
from gsim3d.data.images import as_color, as_labels, read_files
from gsim3d.data.recording import (
    MAX_CAMS,
    MAX_STEPS,
    Problems,
    Recording,
    array,
    image_size,
    inside,
    positive,
    read_json,
    whole,
    workspace,
)
from gsim3d.errors import InputError

NAME = "genesis"
FILE = "metadata.json"
DEFAULT_FPS = 42.0  # of the published sets, whose metadata says nothing
DEFAULT_NEAR, DEFAULT_FAR = 1.0, 8.0  # metres, likewise
TEMPLATE_FIELDS = {"cam_ix", "n_step", "img_type"}


def recognises(folder: Path) -> bool:
    return (folder / FILE).is_file()


def read(folder: Path, problems: Problems) -> Recording:
    """The scene in ``folder``. Raises InputError where its description cannot be read at all."""
    source = folder / FILE
    metadata = read_json(source)
    n_steps = whole(metadata.get("n_steps"), MAX_STEPS, f"{source}: n_steps", problems)
    n_cams = whole(metadata.get("n_cams"), MAX_CAMS, f"{source}: n_cams", problems)
    template = _template(metadata, source)
    viewmats, Ks, sizes = [], [], []
    for cam in range(n_cams):
        viewmat, K, size = _camera(metadata.get(f"cam_{cam}"), f"{source}: cam_{cam}", n_steps, problems)
        viewmats.append(viewmat)
        Ks.append(K)
        sizes.append(size)

    def reader(img_type: str, convert):
        def read_images(cam: int, steps: Sequence[int], problems: Problems) -> Iterator[np.ndarray | None]:
            files = ((file_of(cam, step, img_type), f"camera cam_{cam}, frame {step}") for step in steps)
            return read_files(files, sizes[cam], convert, problems)

        return read_images

    def file_of(cam: int, step: int, img_type: str) -> Path:
        relative = template.format(cam_ix=cam, n_step=step, img_type=img_type) + ".png"
        return inside(folder, relative, f"{source}: file_path_template")

    given = workspace(metadata, source, problems)
    has_labels = any(file_of(cam, 0, "seg").is_file() for cam in range(n_cams))
    return Recording(
        layout=NAME,
        source=source,
        n_steps=n_steps,
        fps=positive(metadata.get("fps", DEFAULT_FPS), f"{source}: fps", problems) or DEFAULT_FPS,
        camera_names=tuple(f"cam_{cam}" for cam in range(n_cams)),
        viewmats=by_step(viewmats, n_steps),
        Ks=by_step(Ks, n_steps),
        sizes=tuple(sizes),
        read_images=reader("rgb", as_color),
        read_labels=reader("seg", as_labels) if has_labels else None,
        **{**given, "near": given["near"] or DEFAULT_NEAR, "far": given["far"] or DEFAULT_FAR},
    )


def _camera(entry, what: str, n_steps: int, problems: Problems) -> tuple[np.ndarray, np.ndarray, tuple[int, int]]:
    viewmat, K = np.eye(4), np.eye(3)
    if not isinstance(entry, dict):
        problems.add(f"{what} is missing, though n_cams says that it exists")
        return viewmat, K, (1, 1)
    size = image_size(entry.get("resolution"), f"{what}.resolution", problems)
    found = array(entry.get("extrinsics"), [(4, 4), (n_steps, 4, 4)], f"{what}.extrinsics", problems)
    if found is not None and check_pose(found, f"{what}.extrinsics", problems):
        viewmat = found
    found = array(entry.get("intrinsics"), [(3, 3), (n_steps, 3, 3)], f"{what}.intrinsics", problems)
    if found is not None and check_intrinsics(found, size, f"{what}.intrinsics", problems):
        K = found
    return viewmat, K, size


def _template(metadata: dict, source: Path) -> str:
    template = metadata.get("file_path_template")
    if not isinstance(template, str):
        raise InputError(f"{source}: file_path_template must be text; got {template!r}")
    try:
        parts = [part for part in string.Formatter().parse(template) if part[1] is not None]
    except ValueError as error:
        raise InputError(f"{source}: file_path_template {template!r} is no format string: {error}") from error
    fields = {field for _, field, _, _ in parts}
    if fields != TEMPLATE_FIELDS:
        raise InputError(
            f"{source}: file_path_template must use the fields {', '.join(sorted(TEMPLATE_FIELDS))}, each as it is; "
            f"got {', '.join(sorted(fields)) or 'none'}"
        )
    # Only plain fields and zero-padded numbers: a format width of 10^9 would fill the memory.
    for _, field, spec, conversion in parts:
        if conversion or not re.fullmatch(r"" if field == "img_type" else r"(0?\d{1,2})?d?", spec):
            raise InputError(f"{source}: file_path_template may format numbers like n_step:04d only; got {template!r}")
    return template
