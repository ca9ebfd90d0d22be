"""Implementation of ``gsim3d calibrate``: writes cameras.json of every take of a capture."""

import dataclasses
import json
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from gsim3d.capture.board import Board, Calibrated, calibrate_board
from gsim3d.capture.clips import BOARD, MIN_AGREEMENT, Clip, clips_in, takes_of, time_offsets
from gsim3d.capture.sfm import calibrate_sfm
from gsim3d.data.recording import read_json
from gsim3d.data.videos import FILE, SAME_RATE
from gsim3d.errors import InputError
from gsim3d.io.files import write_whole

MAX_ERROR = 1 / 400  # of the image width: largest reprojection error of a calibration that fits


def calibrate(
    folder: str | Path,
    *,
    board: Board | None = None,
    scale: tuple[str, str, float] | None = None,
    synchronous: bool = False,
    force: bool = False,
    say: Callable[[str], None] = print,
) -> list[Path]:
    """Calibrates the videos in ``folder`` and writes cameras.json beside the videos of each take, with its "masks".

    Args:
        folder: videos <camera>.mp4, or one folder of videos for each take; videos of the board lie in ``folder``/board,
            or else the videos of the first take show it.
        board: the board; None: structure from motion.
        scale: two cameras and the distance between them in metres.
        synchronous: keep the times in the files, instead of aligning videos by motion.
        force: write cameras that do not fit, too.
        say: receives what was decided, and why.

    Returns:
        The files written.

    Raises:
        InputError: no videos, too few detections, unconnected cameras, or a reprojection error above MAX_ERROR.
    """
    folder = Path(folder)
    takes = takes_of(folder)
    shown = clips_in(folder / BOARD) or next(iter(takes.values()))
    clips = [Clip.open(file) for file in shown]
    names = [clip.name for clip in clips]
    if wrong := set(names) ^ {file.stem for file in next(iter(takes.values()))}:
        raise InputError(f"{folder / BOARD}: must have one video of each camera; {', '.join(sorted(wrong))} differ")
    if scale and (scale[0] == scale[1] or not set(scale[:2]) <= set(names)):
        raise InputError(f"--scale: {scale[0]} and {scale[1]} must be two of the cameras {', '.join(names)}")
    if board is None:
        say(f"calibrate: structure from motion of {len(clips)} backgrounds, because no --board is given")
        cameras = calibrate_sfm(clips)
    else:
        offsets, _ = _offsets(clips, synchronous, say)
        cameras = calibrate_board(clips, offsets, board)
    for camera in cameras:
        say(f"  {camera.name}: reprojection error {camera.error:.2f} px, {camera.views} images")
    bad = [camera for camera in cameras if camera.error > MAX_ERROR * camera.size[0]]
    if bad and not force:
        errors = ", ".join(f"{c.name} {c.error:.2f} px (at most {MAX_ERROR * c.size[0]:.2f})" for c in bad)
        raise InputError(
            f"{folder}: the calibration does not fit: reprojection error of {errors}; record the board again, sharper, "
            "closer and with pauses, by cameras that do not move (--force goes on)"
        )
    cameras = _scaled(cameras, scale, board is not None, say)
    for take, files in takes.items():
        clips = clips if files == shown else [Clip.open(file) for file in files]
        for clip, camera in zip(clips, cameras, strict=True):
            if clip.size != camera.size:
                raise InputError(f"{clip.video.what}: has {clip.size} pixels, the video of the board {camera.size}")
        say(f"{take}:")
        offsets, agreement = _offsets(clips, synchronous, say)
        before = read_json(take / FILE) if (take / FILE).is_file() else {}
        keys = {"resample": _common_rate(clips, say), "masks": before.get("masks")}
        write_whole(take / FILE, _description(cameras, offsets, agreement, keys))
    say(f"calibrate: wrote {', '.join(str(take / FILE) for take in takes)}")
    return [take / FILE for take in takes]


def _offsets(clips: Sequence[Clip], synchronous: bool, say: Callable[[str], None]) -> tuple[np.ndarray, list]:
    if synchronous:
        return np.zeros(len(clips)), [None] * len(clips)
    offsets, agreement = time_offsets([clip.video.times for clip in clips], [clip.motion for clip in clips])
    for clip, offset, own in zip(clips, offsets, agreement, strict=True):
        why = f"motion correlates by {own:.2f}"
        if own < MIN_AGREEMENT:
            why += f", below {MIN_AGREEMENT}: the times in the file are kept; clap once in view of all cameras"
        say(f"  {clip.name}: {1000 * offset:+.0f} ms ({why})")
    return offsets, agreement.tolist()


def _scaled(cameras: list[Calibrated], scale, metric: bool, say) -> list[Calibrated]:
    if scale is None:
        if not metric:
            say("  no --scale: lengths are in units of the mean distance of the cameras, not in metres")
        return cameras
    centres = {c.name: -c.viewmat[:3, :3].T @ c.viewmat[:3, 3] for c in cameras}
    first, second, metres = scale
    share = metres / float(np.linalg.norm(centres[first] - centres[second]))
    say(f"  scale: {first} and {second} are {metres:g} m apart, lengths are multiplied by {share:.4g}")
    step = np.array([1.0, 1.0, 1.0, share])
    return [dataclasses.replace(c, viewmat=np.vstack([c.viewmat[:3] * step, c.viewmat[3:]])) for c in cameras]


def _common_rate(clips: Sequence[Clip], say: Callable[[str], None]) -> float | None:
    """Returns the rate to which videos of uneven or different rates are resampled; None if they are even and equal."""
    rates = [1 / float(np.median(np.diff(clip.video.times))) for clip in clips]
    if all(clip.video.rate for clip in clips) and max(rates) / min(rates) - 1 < SAME_RATE:
        return None
    say(f"  resampled to {min(rates):.5g} frames a second: videos have {', '.join(f'{rate:.5g}' for rate in rates)}")
    return min(rates)


def _description(cameras: Sequence[Calibrated], offsets, agreement, keys: dict) -> str:
    entries = []
    for camera, offset, own in zip(cameras, offsets, agreement, strict=True):
        numbers = camera.K, camera.viewmat[:3, :3], camera.viewmat[:3, 3], camera.distortion
        K, R, T, lens = (values.tolist() for values in numbers)
        entry = {"name": camera.name, "size": list(camera.size), "K": K, "R": R, "T": T, "distortion": lens}
        found = {"error": camera.error, "images": camera.views, "motion_agreement": own}
        entries.append(entry | {"offset": round(float(offset), 6), "calibration": found})
    content = {"pixel_center": 0, **{key: value for key, value in keys.items() if value}, "cameras": entries}
    return json.dumps(content, indent=1) + "\n"
