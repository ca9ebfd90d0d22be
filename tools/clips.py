"""Videos of generated scenes as cheap cameras take them, and of a ChArUco board before the same cameras.

Videos have a lens, noise, an exposure of their own, dropped frames (the one before is shown again) and start at
different times. OUT/truth.json has the true cameras and start times.

python -m tools.clips DATA OUT --cameras 0 1 2
"""

import argparse
import json
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from gsim3d.capture.board import Board
from gsim3d.data import Scene, find_scenes
from gsim3d.io import write_video

BOARD = Board(5, 4, 0.25)
SECONDS, AT_REST = 3.0, 0.5  # of the videos of the board, and how long it lies still at their end
MARGIN, PIXELS = 0.5, 40  # white paper around the board in squares, and pixels of a square in its print
SHARP = 2  # rays along each side of a pixel


@dataclass(frozen=True)
class Damage:
    """What videos suffer from."""

    lens: tuple[float, ...] = (-0.12, 0.04, 0.001, -0.0005, 0.0)  #: k1 k2 p1 p2 k3
    noise: float = 3.0  #: standard deviation, of 255
    exposure: float = 0.1  #: largest relative deviation of a colour channel of a camera
    dropped: float = 0.02  #: fraction of frames
    late: int = 6  #: largest number of frames that a video begins late


def rays(K: np.ndarray, lens: Iterable[float], size: tuple[int, int], samples: int = 1) -> np.ndarray:
    """Returns the rays [h, w, 3] (z = 1) of ``samples`` x ``samples`` points of each pixel, centres at integers."""
    y, x = (np.mgrid[: samples * size[1], : samples * size[0]] + 0.5) / samples - 0.5
    points = np.stack([x, y], -1).reshape(-1, 1, 2)
    flat = cv2.undistortPoints(points, K, np.array(lens)).reshape(*x.shape, 2)
    return np.concatenate([flat, np.ones((*x.shape, 1))], -1)


def board_pose(board: Board, time: float, at_rest: float, viewer: np.ndarray) -> np.ndarray:
    """Returns board -> world [4, 4]: it swings above the origin, turned to ``viewer``, and rests from ``at_rest``."""
    moving = float(np.clip((at_rest - time) / 0.3, 0, 1))
    width = board.columns * board.square
    # The pace changes, so that the motion of two videos matches at one lag only.
    phase = 11 * time + 0.9 * np.sin(7 * time) + 0.4 * np.sin(13 * time)
    turn = moving * np.array([0.5 * np.sin(phase), 0.6 * np.cos(0.7 * phase), 0.6 * np.sin(0.4 * phase)])
    across = np.hypot(*viewer[:2])
    lean = 0.6 * moving * np.arctan2(across, viewer[2]) / across * np.array([-viewer[1], viewer[0], 0])
    pose, middle = np.eye(4), np.eye(4)
    pose[:3, :3] = cv2.Rodrigues(lean)[0] @ cv2.Rodrigues(turn)[0] @ np.diag([1.0, -1, -1])  # printed side up
    pose[:3, 3] = moving * 0.29 * width * np.array([np.sin(0.63 * phase), np.sin(0.5 * phase), 1])
    middle[:2, 3] = -0.5 * board.square * np.array([board.columns, board.rows])
    return pose @ middle


def board_clip(board: Board, K, viewmat: np.ndarray, lens, size, times, at_rest: float, viewer, seed: int):
    """Yields frames [h, w, 3] of the board at ``times``, turned to ``viewer``; pixel centres of ``K`` are integers."""
    print_size = board.columns * PIXELS, board.rows * PIXELS
    paper = np.pad(board.made().generateImage(print_size), round(MARGIN * PIXELS), constant_values=255)
    local = rays(K, lens, size, SHARP)
    noise = np.random.default_rng(seed).uniform(60, 110, local.shape[:2]).astype(np.float32)
    scenery = cv2.GaussianBlur(noise, (0, 0), 3)
    for time in times:
        to_board = np.linalg.inv(viewmat @ board_pose(board, time, at_rest, viewer))
        direction, origin = local @ to_board[:3, :3].T, to_board[:3, 3]
        hit = origin[:2] - direction[..., :2] * (origin[2] / direction[..., 2])[..., None]
        at = ((hit / board.square + MARGIN) * PIXELS - 0.5).astype(np.float32)
        outside = (at < -0.5).any(-1) | (at > np.array(paper.shape[::-1]) - 0.5).any(-1)
        shown = cv2.remap(paper, at, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        grey = cv2.resize(np.where(outside, scenery, shown), size, interpolation=cv2.INTER_AREA)
        yield np.repeat(grey[..., None], 3, 2)


def degraded(frames: Iterable[np.ndarray], damage: Damage, exposure: np.ndarray, rng) -> Iterator[np.ndarray]:
    """Yields uint8 frames with exposure, noise and repetitions; the first one is never dropped."""
    before = None
    for frame in frames:
        if before is None or rng.random() >= damage.dropped:
            before = frame * exposure + rng.normal(0, damage.noise, frame.shape)
        yield before.round().clip(0, 255).astype(np.uint8)


def write_clips(data: Path, out: Path, cams: list[int], damage: Damage = Damage(), seed: int = 0) -> dict:
    """Writes one take for each scene in ``data``, videos of the board, and truth.json, whose content it returns."""
    rng = np.random.default_rng(seed)
    scenes = [Scene.open(folder) for folder in find_scenes(data)]
    first = scenes[0]
    size, (viewmats, Ks) = (first.width, first.height), first.recording.cameras_at_step(0)
    Ks = Ks - [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]]
    viewer = np.linalg.inv(viewmats[cams])[:, :3, 3].mean(0)
    exposures = {cam: 1 + damage.exposure * rng.uniform(-1, 1, 3) for cam in cams}
    truth = {"starts": {}}
    for cam in cams:
        truth[f"cam_{cam}"] = {"K": Ks[cam].tolist(), "viewmat": viewmats[cam].tolist(), "lens": list(damage.lens)}
    clips = {f"{scene.path.parent.name}_{scene.path.name}": scene for scene in scenes}
    for take in ("board", *clips):
        (out / take).mkdir(parents=True, exist_ok=True)
        starts = rng.integers(0, damage.late + 1, len(cams)).tolist()
        truth["starts"][take] = [start / first.fps for start in starts]
        for cam, start in zip(cams, starts, strict=True):
            if take == "board":
                times = (start + np.arange(round(SECONDS * first.fps))) / first.fps
                frames = board_clip(
                    BOARD, Ks[cam], viewmats[cam], damage.lens, size, times, SECONDS - AT_REST, viewer, cam
                )
            else:
                at = (rays(Ks[cam], damage.lens, size) @ Ks[cam].T)[..., :2].astype(np.float32)
                images = clips[take].images([cam], range(start, clips[take].n_steps))[:, 0].permute(0, 2, 3, 1).numpy()
                frames = (cv2.remap(image, at, None, cv2.INTER_LINEAR) for image in images)
            write_video(out / take / f"cam_{cam}.mp4", degraded(frames, damage, exposures[cam], rng), first.fps)
    (out / "truth.json").write_text(json.dumps(truth, indent=1))
    return truth


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path, metavar="DATA", help="data set of gsim3d generate, with equal cameras")
    parser.add_argument("out", type=Path, metavar="OUT", help="folder of the takes")
    parser.add_argument("--cameras", type=int, nargs="+", default=[0, 1, 2], metavar="CAM")
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    write_clips(args.data, args.out, args.cameras, seed=args.seed)
    print(f"videos in {args.out}: --board {BOARD.columns} {BOARD.rows} {BOARD.square}")


if __name__ == "__main__":
    main()
