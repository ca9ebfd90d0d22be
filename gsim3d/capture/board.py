"""Calibration from videos of a ChArUco board: intrinsics of each camera, then all poses by bundle adjustment.

Pixel centres are OpenCV's (integers). The board's axes are OpenCV's too: x along its rows, y down, z into the paper.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from gsim3d.capture.clips import Clip
from gsim3d.errors import InputError, did_you_mean

MAX_VIEWS = 60  # times at which the board is searched
MIN_CORNERS = 8  # of a view that is used
MIN_VIEWS = 5  # of each camera
ITERATIONS = 30
OUTLIER, MOST_OUTLIERS = 4.0, 0.25  # of the median error of a view, and of the views of a camera
LOSS_SCALE = 2.0  # pixels; larger residuals are weighted down (Huber)
MARKER_SHARE = 0.75  # of the square
OUT_OF_PAPER = np.diag([1.0, -1.0, -1.0, 1.0])  # axes of a board -> world axes, with z out of the printed side


@dataclass(frozen=True)
class Board:
    """A ChArUco board."""

    columns: int  #: squares along x
    rows: int  #: squares along y
    square: float  #: side of a square in metres
    marker: float = 0.0  #: side of a marker in metres; 0: 0.75 squares
    dictionary: str = "4X4_50"  #: OpenCV's name of the markers, such as "4X4_50"

    def __post_init__(self):
        self.made()

    def made(self):
        """Returns the board as an object of OpenCV; raises InputError if its measures are invalid."""
        known = [name.removeprefix("DICT_") for name in dir(cv2.aruco) if name.startswith("DICT_")]
        if self.dictionary not in known:
            raise InputError(
                f"--dictionary: {self.dictionary!r} is none of OpenCV's{did_you_mean(self.dictionary, known)}"
            )
        marker = self.marker or MARKER_SHARE * self.square
        whole = self.columns == int(self.columns) and self.rows == int(self.rows)
        if not whole or min(self.columns, self.rows) < 3 or not 0 < marker < self.square:
            raise InputError(f"--board: needs 3 whole squares or more a side, and smaller markers; got {self}")
        markers = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{self.dictionary}"))
        needed, held = int(self.columns * self.rows) // 2, len(markers.bytesList)
        if needed > held:
            raise InputError(
                f"--board: {self.columns:g} x {self.rows:g} squares need {needed} markers; --dictionary "
                f"{self.dictionary} has {held}"
            )
        return cv2.aruco.CharucoBoard((int(self.columns), int(self.rows)), self.square, marker, markers)


@dataclass(frozen=True)
class Calibrated:
    """A calibrated camera."""

    name: str  #: camera
    size: tuple[int, int]  #: (width, height) in pixels
    K: np.ndarray  #: [3, 3], pixels
    distortion: np.ndarray  #: OpenCV's k1 k2 p1 p2 k3
    viewmat: np.ndarray  #: [4, 4], world-to-camera, metres
    error: float  #: root mean squared reprojection error in pixels
    views: int  #: number of images that it rests on


@dataclass
class _Views:
    """Detections of one camera: frame -> (object points [N, 1, 3], pixels [N, 1, 2], board -> camera)."""

    found: dict[int, tuple]
    K: np.ndarray
    distortion: np.ndarray


def calibrate_board(clips: Sequence[Clip], offsets: Sequence[float], board: Board) -> list[Calibrated]:
    """Calibrates cameras by a board that is moved before them, or several of them see at rest.

    The world is the board where a camera sees it last: x along its rows, z out of the printed side.

    Args:
        clips: videos of the board.
        offsets: seconds to add to the times of each video.
        board: what they show.

    Raises:
        InputError: a camera sees the board too rarely, or never at the same time as the others.
    """
    views = [_intrinsics(clip, found) for clip, found in zip(clips, _detect(clips, offsets, board), strict=True)]
    cameras = _initial_poses([clip.name for clip in clips], views)
    boards = {}
    for frame in set().union(*(v.found for v in views)):
        cam = max((c for c, v in enumerate(views) if frame in v.found), key=lambda c: len(views[c].found[frame][0]))
        boards[frame] = np.linalg.inv(cameras[cam]) @ views[cam].found[frame][2]
    cameras, boards, residuals = _adjust(views, cameras, boards)
    if any([_drop_outliers(view, own) for view, own in zip(views, residuals, strict=True)]):
        boards = {frame: pose for frame, pose in boards.items() if any(frame in view.found for view in views)}
        cameras, boards, residuals = _adjust(views, cameras, boards)
    world = boards[max(boards)]
    errors = [float(np.sqrt(np.square(np.concatenate(own)).sum(-1).mean())) for own in residuals]
    return [
        Calibrated(clip.name, clip.size, v.K, v.distortion, camera @ world @ OUT_OF_PAPER, error, len(v.found))
        for clip, v, camera, error in zip(clips, views, cameras, errors, strict=True)
    ]


def calm_times(times: np.ndarray, clips: Sequence[Clip], offsets: Sequence[float]) -> np.ndarray:
    """Returns at most MAX_VIEWS of ``times``: in each part that of least motion, since shutters are not synchronous."""
    own = [clip.video.times + offset for clip, offset in zip(clips, offsets, strict=True)]
    speed = sum(np.interp(times, (at[1:] + at[:-1]) / 2, clip.motion) for at, clip in zip(own, clips, strict=True))
    parts = np.array_split(np.arange(len(times)), min(len(times), MAX_VIEWS))
    return times[[part[speed[part].argmin()] for part in parts]]


def _detect(clips: Sequence[Clip], offsets: Sequence[float], board: Board) -> list[dict[int, tuple]]:
    """Returns (object points, pixels) of the board by time, for each camera."""
    detector = cv2.aruco.CharucoDetector(board.made())
    spans = [clip.video.times[[0, -1]] + offset for clip, offset in zip(clips, offsets, strict=True)]
    low, high = max(span[0] for span in spans), min(span[1] for span in spans)
    if low >= high:
        raise InputError(f"{clips[0].video.what}: the videos of the board have no time in common")
    times, every = clips[0].video.times + offsets[0], []
    times = calm_times(times[(times >= low - 1e-6) & (times <= high + 1e-6)], clips, offsets)
    for clip, offset in zip(clips, offsets, strict=True):
        own, found = clip.video.times + offset, {}
        numbers = np.searchsorted((own[1:] + own[:-1]) / 2, times).tolist()
        for frame, image in enumerate(clip.grey(numbers)):
            corners, ids, *_ = detector.detectBoard(image)
            if ids is not None and len(ids) >= MIN_CORNERS:
                found[frame] = detector.getBoard().matchImagePoints(corners, ids)
        every.append(found)
    return every


def _intrinsics(clip: Clip, found: dict[int, tuple]) -> _Views:
    if len(found) < MIN_VIEWS:
        raise InputError(
            f"camera {clip.name}: the board is recognised in {len(found)} images; at least {MIN_VIEWS} are needed, "
            "close up, tilted and in the corners (are --board and --dictionary those of the print?)"
        )
    points, pixels = zip(*found.values(), strict=True)
    flags = cv2.CALIB_FIX_K3 | cv2.CALIB_ZERO_TANGENT_DIST
    _, K, distortion, turns, shifts = cv2.calibrateCamera(points, pixels, clip.size, None, None, flags=flags)
    poses = (_matrix(turn, shift) for turn, shift in zip(turns, shifts, strict=True))
    views = {frame: (*given, pose) for (frame, given), pose in zip(found.items(), poses, strict=True)}
    return _Views(views, K, distortion.reshape(-1)[:5])


def _initial_poses(names: Sequence[str], views: Sequence[_Views]) -> list[np.ndarray]:
    """Returns camera poses [4, 4] relative to the first, along the pairs that share most views of the board."""
    shared = {(a, b): sorted(set(views[a].found) & set(views[b].found)) for a in range(len(views)) for b in range(a)}
    poses: dict[int, np.ndarray] = {0: np.eye(4)}
    while len(poses) < len(views):
        pairs = [(len(frames), pair) for pair, frames in shared.items() if sum(c in poses for c in pair) == 1]
        count, pair = max(pairs, default=(0, ()))
        if count == 0:
            lost = ", ".join(name for cam, name in enumerate(names) if cam not in poses)
            raise InputError(f"camera {lost}: never sees the board at the same time as camera {names[0]} or its others")
        known, new = sorted(pair, key=lambda cam: cam not in poses)
        steps = [views[new].found[f][2] @ np.linalg.inv(views[known].found[f][2]) for f in shared[pair]]
        middle = np.median([step[:3, 3] for step in steps], 0)  # of the relative positions: robust to wrong poses
        poses[new] = min(steps, key=lambda step: np.linalg.norm(step[:3, 3] - middle)) @ poses[known]
    return [poses[cam] for cam in range(len(views))]


def _adjust(views, cameras, boards):
    """Minimises the reprojection errors over lenses (in ``views``), cameras and boards, by Levenberg-Marquardt.

    A camera alone leaves its intrinsics uncertain. Returns cameras, boards, and the residuals [N, 2] of each view.
    """
    start = {("cam", cam): _vector(pose) for cam, pose in enumerate(cameras)}
    start |= {("board", frame): _vector(pose) for frame, pose in boards.items()}
    for cam, v in enumerate(views):  # in the order of cv2.projectPoints
        start["lens", cam] = np.array([v.K[0, 0], v.K[1, 1], *v.K[:2, 2], *v.distortion[:2]])
    where = {key: slice(6 * number, 6 * number + 6) for number, key in enumerate(start)}
    x, damping = np.concatenate(list(start.values())), 1e-3
    cost, normal, slope, residuals = _linearised(x, views, where)
    for _ in range(ITERATIONS):
        step = np.linalg.solve(normal + damping * np.diag(np.diag(normal) + 1e-9), -slope)
        tried = _linearised(x + step, views, where)
        damping = damping / 5 if tried[0] < cost else damping * 5
        if tried[0] < cost:
            gain, x = cost - tried[0], x + step
            cost, normal, slope, residuals = tried
            if gain < 1e-9 * cost:
                break
    for cam, view in enumerate(views):
        view.K, view.distortion = _lens(x[where["lens", cam]])
    cameras = [_matrix(*np.split(x[where["cam", cam]], 2)) for cam in range(len(views))]
    return cameras, {frame: _matrix(*np.split(x[where["board", frame]], 2)) for frame in boards}, residuals


def _drop_outliers(view: _Views, residuals: Sequence[np.ndarray]) -> bool:
    """Removes the few detections whose error is far above the others': frames that a video repeats. Returns if any."""
    errors = np.array([np.linalg.norm(own, axis=1).mean() for own in residuals])
    outlier = errors > OUTLIER * np.median(errors)
    few = 0 < outlier.sum() <= MOST_OUTLIERS * len(errors)
    view.found = {frame: found for (frame, found), out in zip(view.found.items(), outlier & few) if not out}
    return bool(few)


def _lens(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    fx, fy, cx, cy, k1, k2 = x
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]), np.array([k1, k2, 0, 0, 0])


def _linearised(x, views, where):
    """Returns cost, normal matrix and slope of the robust squared errors, and the residuals of each camera."""
    normal, slope, cost, residuals = np.zeros((len(x), len(x))), np.zeros(len(x)), 0.0, []
    for cam, own in enumerate(views):
        residuals.append([])
        lens, pose = where["lens", cam], where["cam", cam]
        K, distortion = _lens(x[lens])
        for frame, (points, pixels, _) in own.found.items():
            board = where["board", frame]
            turn, shift, *d = cv2.composeRT(*np.split(x[board], 2), *np.split(x[pose], 2))
            projected, jacobian = cv2.projectPoints(points, turn, shift, K, distortion)[:2]
            off = projected.reshape(-1, 2) - pixels.reshape(-1, 2)
            size = np.linalg.norm(off, axis=1)
            weight = np.repeat(np.minimum(1, LOSS_SCALE / np.maximum(size, 1e-12)), 2)
            cost += np.where(size < LOSS_SCALE, size**2, 2 * LOSS_SCALE * size - LOSS_SCALE**2).sum()
            parts = [(lens, jacobian[:, 6:12])]
            for at, k in ((board, 0), (pose, 2)):
                parts.append((at, jacobian[:, :6] @ np.block([[d[k], d[k + 1]], [d[k + 4], d[k + 5]]])))
            for at, J in parts:
                slope[at] += J.T @ (weight * off.ravel())
                for other, J2 in parts:
                    normal[at, other] += J.T @ (weight[:, None] * J2)
            residuals[-1].append(off)
    return cost, normal, slope, residuals


def _matrix(turn, shift) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = cv2.Rodrigues(np.asarray(turn))[0], np.ravel(shift)
    return pose


def _vector(pose: np.ndarray) -> np.ndarray:
    return np.concatenate([cv2.Rodrigues(pose[:3, :3])[0].ravel(), pose[:3, 3]])
