"""Reader of the published layout: metadata.json, and one PNG per camera, step and image type (rgb, seg).

Cameras are world-to-camera with OpenCV axes; moving cameras have one matrix per step. All keys: docs/reference/data.md.
"""

import re
import string
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from gsim3d.data import recording
from gsim3d.data.cameras import check_intrinsics, check_pose
from gsim3d.data.images import as_color, as_labels, read_files
from gsim3d.data.lenses import lens_of
from gsim3d.data.recording import Camera, Description, Problems, Recording, inside
from gsim3d.errors import InputError, naming

NAME = "genesis"
FILE = "metadata.json"
DEFAULTS = {"fps": 42.0, "near": 1.0, "far": 8.0}  # of the published data sets, whose metadata has none of them
KEYS = ("n_steps", "n_cams", "file_path_template", *DEFAULTS, "origin", "bounds")
TEMPLATE_FIELDS = {"cam_ix", "n_step", "img_type"}


def recognises(folder: Path) -> bool:
    """Returns whether ``folder`` has a metadata.json."""
    return (folder / FILE).is_file()


def read(folder: Path, problems: Problems) -> Recording:
    """Reads the scene in ``folder``. Raises InputError if its description cannot be parsed."""
    source = folder / FILE
    metadata = Description(recording.read_json(source), f"{source}: ", problems)
    metadata.refuse_misspelt(KEYS)
    n_steps = metadata.whole("n_steps", recording.MAX_STEPS)
    n_cams = metadata.whole("n_cams", recording.MAX_CAMS)
    template = _template(metadata)
    cameras = [_camera(metadata, f"cam_{cam}", n_steps) for cam in range(n_cams)]

    def file_of(cam: int, step: int, img_type: str) -> Path:
        relative = template.format(cam_ix=cam, n_step=step, img_type=img_type) + ".png"
        return inside(folder, relative, f"{source}: file_path_template")

    def reader(img_type: str, convert):
        def read_images(cam: int, steps: Sequence[int], problems: Problems) -> Iterator[np.ndarray | None]:
            files = ((file_of(cam, step, img_type), f"camera cam_{cam}, frame {step}") for step in steps)
            return read_files(files, cameras[cam].size, convert, problems)

        return read_images

    has_labels = any(file_of(cam, 0, "seg").is_file() for cam in range(n_cams))
    noted = "fps" not in metadata.values and metadata.values.keys() & {"near", "far"}
    return Recording.of_cameras(
        cameras,
        n_steps,
        layout=NAME,
        source=source,
        fps=metadata.positive("fps") or DEFAULTS["fps"],
        read_images=reader("rgb", as_color),
        read_labels=reader("seg", as_labels) if has_labels else None,
        notes=(f"{FILE} has no fps; {DEFAULTS['fps']:g} is used, as for the published sets",) if noted else (),
        **metadata.workspace(DEFAULTS["near"], DEFAULTS["far"]),
    )


def _camera(metadata: Description, name: str, n_steps: int) -> Camera:
    values, problems = metadata.values.get(name), metadata.problems
    if not isinstance(values, dict):
        problems.add(f"{metadata.where}{name} is missing, but n_cams includes it")
        return Camera(name, (1, 1), np.eye(4), np.eye(3))
    entry = Description(values, f"{metadata.where}{name}.", problems)
    size = entry.size("resolution")
    viewmat = entry.array("extrinsics", (4, 4), (n_steps, 4, 4))
    if viewmat is None or not check_pose(viewmat, f"{entry.where}extrinsics", problems):
        viewmat = np.eye(4)
    K = entry.array("intrinsics", (3, 3), (n_steps, 3, 3))
    if K is None or not check_intrinsics(K, size, f"{entry.where}intrinsics", problems):
        K = np.eye(3)
    shared = {key: value for key, value in metadata.values.items() if not key.startswith("cam_")}
    return Camera(name, size, viewmat, K, lens_of({**shared, **values}, f"{metadata.where}{name}", problems))


def _template(metadata: Description) -> str:
    template, where = metadata.values.get("file_path_template"), f"{metadata.where}file_path_template"
    if not isinstance(template, str):
        raise InputError(f"{where} must be a string; got {template!r}")
    with naming(f"{where} {template!r} is not a format string", ValueError):
        parts = [part for part in string.Formatter().parse(template) if part[1] is not None]
    fields = {field for _, field, _, _ in parts}
    if fields != TEMPLATE_FIELDS:
        wanted, given = (", ".join(sorted(some)) or "none" for some in (TEMPLATE_FIELDS, fields))
        raise InputError(f"{where} must use exactly the fields {wanted}; got {given}")
    # Only plain fields and zero-padded integers: a format width of 10^9 would exhaust memory.
    for _, field, spec, conversion in parts:
        if conversion or not re.fullmatch(r"" if field == "img_type" else r"(0?\d{1,2})?d?", spec):
            raise InputError(f"{where} may format numbers like n_step:04d only; got {template!r}")
    return template
