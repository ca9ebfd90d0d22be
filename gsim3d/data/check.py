"""Validation of a scene folder, and a contact sheet that shows whether its cameras are correct."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from gsim3d.data import layouts
from gsim3d.data.actions import check_places
from gsim3d.data.cameras import check_directions, positions_and_axes, project
from gsim3d.data.recording import MOVING, Problems, Recording, evenly_spaced
from gsim3d.data.scene import Scene
from gsim3d.errors import InputError
from gsim3d.io.terminal import plain, progress

SHEET = 1440  # pixels, target width of the contact sheet
TILE = 200, 420  # pixels, smallest and largest height of one frame
GAP, LINE = 6, 22  # pixels between frames, and height of a line of text
MAX_CAMERAS, MAX_SCENES = 6, 6  # shown per scene and per data set, evenly spaced
MAX_COORDINATE = 8000.0  # pixels; projected points are clipped to it
BOX, BODY, MASK, CAMERA, ACTOR = (255, 220, 60), (0, 140, 255), (0, 235, 255), (255, 90, 255), (90, 255, 90)  # BGR
AXES = {"x": (60, 60, 255), "y": (70, 220, 70), "z": (255, 120, 60)}
INK, PAPER, MISSING = (40, 40, 40), (255, 255, 255), (190, 190, 190)
EDGE_POINTS = 24
TEXT = 0.42  # OpenCV font scale
HULL_GRID = 24  # grid points along each axis of a visual hull
HULL_STEPS = 3  # steps at which visual hulls are computed
EDGES = [(a, b) for a in range(8) for b in range(a + 1, 8) if (a ^ b).bit_count() == 1]


@dataclass(frozen=True)
class SceneCheck:
    """Result of :func:`check_scene`."""

    path: Path  #: scene folder
    scene: Scene | None  #: the opened scene; None if it could not be opened
    problems: tuple[str, ...]  #: one message per line, in the order found


def check_scene(folder: str | Path, quiet: bool = True) -> SceneCheck:
    """Reads every image of a scene folder and returns all problems found; unless ``quiet``, shows progress."""
    path, problems = Path(folder), Problems(collect=True)
    recording = scene = None
    try:
        recording = layouts.read(path, problems)
        if not problems.found:
            check_directions(recording, problems)
        scene = Scene(path, recording)
        if scene.has_actions():
            check_places(scene.recording.actions, scene.bounds, problems)
    except InputError as error:
        problems.add(str(error))
    if recording is not None:
        total = (1 + (recording.read_labels is not None)) * len(recording.camera_names) * recording.n_steps
        with progress(None, "images", total, unit="image", quiet=quiet) as bar:
            for cam, name in enumerate(recording.camera_names):
                try:
                    for _ in recording.read_images(cam, range(recording.n_steps), problems):
                        bar.update()
                except InputError as error:
                    problems.add(f"camera {name}: {error}")
            if recording.read_labels is not None:
                _check_labels(recording, problems, bar)
    if scene is not None and not problems.found:
        _check_agreement(Scene(path, recording), problems)  # a second Scene, so that its decoded images are freed
    return SceneCheck(path, scene, tuple(dict.fromkeys(problems.found)))


def _check_labels(recording: Recording, problems: Problems, bar) -> None:
    before, seen = len(problems.found), set()
    for cam, name in enumerate(recording.camera_names):
        try:
            for labels in recording.read_labels(cam, range(recording.n_steps), problems):
                bar.update()
                if labels is not None:
                    seen |= set(np.flatnonzero(np.bincount(labels.ravel(), minlength=256)).tolist())
        except InputError as error:
            problems.add(f"camera {name}: {error}")
    if MOVING not in seen and len(problems.found) == before:
        problems.add(
            f"{recording.source}: no label image has a pixel of value {MOVING} (movable body); found {sorted(seen)}"
        )


def _check_agreement(scene: Scene, problems: Problems) -> None:
    """Reports an empty visual hull of the moving bodies, which indicates wrong poses."""
    if not scene.has_segmentation() or scene.n_cams < 2:
        return
    hulls = [moving_box(scene, step) for step in evenly_spaced(scene.n_steps, HULL_STEPS)]
    compared = [box for box, n_cams in hulls if n_cams > 1]
    if compared and all(box is None for box in compared):
        problems.add(
            f"{scene.recording.source}: the moving bodies in the masks of the cameras have no common position: poses, "
            "intrinsics, the order of the cameras or the bounds are wrong (see the contact sheet)"
        )


def moving_box(scene: Scene, step: int) -> tuple[np.ndarray | None, int]:
    """Computes the bounding box of the visual hull of the moving bodies at a step.

    A grid point is in the hull if it projects into the moving mask of every camera that sees it. The grid covers the
    scene's bounds, then is refined around the points found; masks are dilated by half a cell.

    Returns:
        Box [2, 3], None if the hull is empty, and the number of cameras whose mask has a moving body.
    """
    labels = scene.segmentation(range(scene.n_cams), [step])[0].numpy()
    seeing = np.flatnonzero((labels == MOVING).any((1, 2)))
    coarse = _common_box(scene, step, labels, seeing, scene.bounds) if len(seeing) else None
    fine = None if coarse is None else _common_box(scene, step, labels, seeing, coarse)
    return (coarse if fine is None else fine), len(seeing)


def _common_box(scene: Scene, step: int, labels: np.ndarray, seeing: np.ndarray, box: np.ndarray) -> np.ndarray | None:
    """Returns the bounding box of the grid points in ``box`` inside the moving masks of the cameras ``seeing``."""
    recording = scene.recording
    viewmats, Ks = recording.cameras_at_step(step)
    cell = (box[1] - box[0]) / (HULL_GRID - 1)
    points = box[0] + np.stack(np.meshgrid(*[np.arange(HULL_GRID)] * 3, indexing="ij"), -1).reshape(-1, 3) * cell
    inside, seen_by = np.ones(len(points), bool), np.zeros(len(points), int)
    for cam in seeing:
        pixels, depth = project(points, viewmats[cam], Ks[cam])
        width, height = recording.sizes[cam]
        index = np.floor(pixels.clip(-1, MAX_COORDINATE)).astype(int)
        seen = (depth > 0) & (index >= 0).all(1) & (index < [width, height]).all(1)
        if not seen.any():
            continue
        radius = int(np.ceil(Ks[cam, 0, 0] * np.linalg.norm(cell) / 2 / np.median(depth[seen])))
        radius = min(radius, max(width, height))  # a wrong calibration can give any radius
        disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))
        mask = cv2.dilate((labels[cam] == MOVING).astype(np.uint8), disc) > 0
        inside[seen] &= mask[index[seen, 1], index[seen, 0]]
        seen_by += seen
    body = points[inside & (seen_by >= max(1, 0.75 * len(seeing)))]
    return np.stack([body.min(0) - cell / 2, body.max(0) + cell / 2]) if len(body) else None


def describe(scene: Scene) -> str:
    """Returns a one-line summary of a scene."""
    size = " x ".join(f"{side:.2g}" for side in scene.bounds[1] - scene.bounds[0])
    sizes = sorted(set(scene.recording.sizes))
    pixels = ", ".join(f"{width}x{height}" for width, height in sizes[:2]) + (", ..." if len(sizes) > 2 else "")
    moves = ", moving" if len(scene.recording.viewmats) > 1 else ""
    labels = "subtracted" if scene.recording.subtract_background else "yes" if scene.has_segmentation() else "none"
    offset = ", ".join(f"{x:.0f}" for x in scene.world_offset) if scene.world_offset.any() else None
    where = "" if offset is None else f", world offset ({offset})"
    names = [*dict.fromkeys(scene.recording.actions.types)] if scene.has_actions() else []
    actors = f", actors: {', '.join(names[:3])}" + f", ... ({len(names)})" * (len(names) > 3) if names else ""
    return (
        f"{scene.name}: {scene.layout}, {scene.n_steps} steps at {scene.fps:g} fps, "
        f"{scene.n_cams} cameras{moves}, "
        f"{pixels} pixels, depth {scene.near:.2f} to {scene.far:.2f} m, bounds {size} m{where}, "
        f"masks: {labels}{actors}" + "".join(f"; {note}" for note in scene.recording.notes)
    )


def contact_sheet(scenes: Sequence[Scene]) -> np.ndarray:
    """Draws sample frames of the scenes with their bounds, cameras and masks.

    Blue box: the scene's bounds. Orange box: the visual hull of the moving bodies. Arrows: the world's x, y and z axes
    (red, green, blue) at the centre of the lower face of the bounds. Magenta squares: the other cameras. Yellow:
    outline of the foreground. Green dots: points of actors.

    Returns:
        uint8 [H, W, 3], BGR.
    """
    shown = [scenes[i] for i in evenly_spaced(len(scenes), MAX_SCENES)]
    blocks = []
    for scene in shown:
        steps = evenly_spaced(scene.n_steps, 3 if len(shown) == 1 else 1 if len(shown) > 3 else 2)
        cams = evenly_spaced(scene.n_cams, MAX_CAMERAS)
        aspect = sum(width / height for width, height in (scene.recording.sizes[cam] for cam in cams))
        tile_height = int(np.clip((SHEET - GAP * len(cams)) / aspect, *TILE))
        blocks.append(_text(describe(scene)))
        for step in steps:
            body = _try(lambda: moving_box(scene, step)[0] if scene.has_segmentation() else None)
            tiles = [_tile(scene, cam, step, tile_height, body) for cam in cams]
            padded = [np.pad(tile, ((0, GAP), (0, GAP), (0, 0)), constant_values=255) for tile in tiles]
            blocks.append(np.concatenate(padded, 1)[:, :-GAP])
    legend = (
        "blue box: scene bounds; orange box: visual hull of moving bodies; red, green, blue: world x, y, z; "
        "magenta: other cameras; yellow: masks; green: points of actors, such as hand joints"
    )
    blocks.append(_text(legend))
    width = max(block.shape[1] for block in blocks)
    return np.concatenate(
        [np.pad(block, ((0, 0), (0, width - block.shape[1]), (0, 0)), constant_values=255) for block in blocks]
    )


def _try(compute):
    try:
        return compute()
    except InputError:
        return None


def _tile(scene: Scene, cam: int, step: int, tile_height: int, body: np.ndarray | None) -> np.ndarray:
    width, height = scene.recording.sizes[cam]
    zoom = tile_height / height
    size = max(1, round(width * zoom)), tile_height
    image = _try(lambda: scene.recorded_images([cam], [step])[0, 0, :, :height, :width])
    if image is None:
        tile = np.full((size[1], size[0], 3), MISSING, np.uint8)
        _write(tile, "unreadable", (8, tile_height // 2), INK)
    else:
        how = cv2.INTER_AREA if zoom < 1 else cv2.INTER_NEAREST
        tile = cv2.resize(image.permute(1, 2, 0).numpy()[..., ::-1], size, interpolation=how)
    labels = _try(lambda: scene.segmentation([cam], [step])[0, 0, :height, :width].numpy())
    if labels is not None:
        mask = cv2.resize((labels > 0).astype(np.uint8), size, interpolation=cv2.INTER_NEAREST)
        outlines, _ = cv2.findContours(mask, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
        cv2.drawContours(tile, outlines, -1, MASK, 1)
    _draw_scene(tile, scene, cam, step, zoom, body)
    label = f"{scene.camera_names[cam][-24:]}, frame {step}"
    (label_width, _), _ = cv2.getTextSize(plain(label), cv2.FONT_HERSHEY_SIMPLEX, TEXT, 1)
    tile[:17, : label_width + 8] = INK
    _write(tile, label, (4, 13), PAPER)
    return tile


def _draw_scene(tile: np.ndarray, scene: Scene, cam: int, step: int, zoom: float, body: np.ndarray | None) -> None:
    viewmats, Ks = scene.recording.cameras_at_step(step)
    viewmat, K = viewmats[cam], np.diag([zoom, zoom, 1.0]) @ Ks[cam]

    def line(start: np.ndarray, end: np.ndarray, color: tuple, thickness: int) -> np.ndarray | None:
        """Draws the part in front of the camera. Returns the end pixel, None if it is behind the camera."""
        pixels, depth = project(start + np.linspace(0, 1, EDGE_POINTS)[:, None] * (end - start), viewmat, K)
        pixels = pixels.clip(-MAX_COORDINATE, MAX_COORDINATE).round().astype(int)
        for i in np.flatnonzero((depth[:-1] > 1e-3) & (depth[1:] > 1e-3)):
            cv2.line(tile, pixels[i].tolist(), pixels[i + 1].tolist(), color, thickness, cv2.LINE_AA)
        return pixels[-1] if depth[-1] > 1e-3 else None

    low, high = scene.bounds
    for box, color in ((scene.bounds, BOX), (body, BODY)):
        if box is not None:
            corners = np.array([[box[k >> axis & 1][axis] for axis in range(3)] for k in range(8)])
            for a, b in EDGES:
                line(corners[a], corners[b], color, 1)
    foot = np.array([(low[0] + high[0]) / 2, (low[1] + high[1]) / 2, low[2]])
    for axis, (name, color) in enumerate(AXES.items()):
        end = line(foot, foot + np.eye(3)[axis] * 0.3 * (high - low).min(), color, 2)
        if end is not None:
            _write(tile, name, (end + 2).tolist(), color)
    if (actions := scene.recording.actions) is not None:
        pixels, depth = project(actions.positions[step][actions.present[step]], viewmat, K)
        for pixel in pixels[depth > 1e-3].clip(-MAX_COORDINATE, MAX_COORDINATE).round().astype(int):
            cv2.circle(tile, pixel.tolist(), 2, ACTOR, -1, cv2.LINE_AA)
    centres, _ = positions_and_axes(viewmats)
    pixels, depth = project(centres, viewmat, K)
    for other in np.flatnonzero(depth > 1e-3):
        x, y = pixels[other].clip(-MAX_COORDINATE, MAX_COORDINATE).round().astype(int).tolist()
        if other != cam and 0 <= x < tile.shape[1] and 0 <= y < tile.shape[0]:
            cv2.rectangle(tile, (x - 3, y - 3), (x + 3, y + 3), CAMERA, 1)
            _write(tile, scene.camera_names[other][-12:], (x + 5, y + 4), CAMERA)


def _write(image: np.ndarray, text: str, corner: Sequence[int], color: tuple) -> None:
    cv2.putText(image, plain(text), tuple(corner), cv2.FONT_HERSHEY_SIMPLEX, TEXT, color, 1, cv2.LINE_AA)


def _text(text: str) -> np.ndarray:
    (width, _), _ = cv2.getTextSize(plain(text), cv2.FONT_HERSHEY_SIMPLEX, TEXT, 1)
    line = np.full((LINE, width + 8, 3), PAPER, np.uint8)
    _write(line, text, (4, LINE - 7), INK)
    return line
