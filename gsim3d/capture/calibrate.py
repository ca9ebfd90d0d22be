"""Implementation of ``gsim3d calibrate``: writes cameras.json of every take of a capture."""

import dataclasses
import json
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from gsim3d.capture.board import Board, Calibrated, calibrate_board
from gsim3d.capture.films import BOARD, MIN_AGREEMENT, Film, films_in, takes_of, time_offsets
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
    """Calibrates the films in ``folder`` and writes cameras.json beside the films of each take, with its "masks".

    Args:
        folder: films <camera>.mp4, or one folder of films for each take; films of the board lie in ``folder``/board,
            or else the films of the first take show it.
        board: the board; None: structure from motion.
        scale: two cameras and the distance between them in metres.
        synchronous: keep the times in the files, instead of aligning films by motion.
        force: write cameras that do not fit, too.
        say: receives what was decided, and why.

    Returns:
        The files written.

    Raises:
        InputError: no films, too few detections, unconnected cameras, or a reprojection error above MAX_ERROR.
    """
    folder = Path(folder)
    takes = takes_of(folder)
    shown = films_in(folder / BOARD) or next(iter(takes.values()))
    films = [Film.open(file) for file in shown]
    names = [film.name for film in films]
    if wrong := set(names) ^ {file.stem for file in next(iter(takes.values()))}:
        raise InputError(f"{folder / BOARD}: must have one film of each camera; {', '.join(sorted(wrong))} differ")
    if scale and (scale[0] == scale[1] or not set(scale[:2]) <= set(names)):
        raise InputError(f"--scale: {scale[0]} and {scale[1]} must be two of the cameras {', '.join(names)}")
    if board is None:
        say(f"calibrate: structure from motion of {len(films)} backgrounds, because no --board is given")
        cameras = calibrate_sfm(films)
    else:
        offsets, _ = _offsets(films, synchronous, say)
        cameras = calibrate_board(films, offsets, board)
    for camera in cameras:
        say(f"  {camera.name}: reprojection error {camera.error:.2f} px, {camera.views} images")
    bad = [camera for camera in cameras if camera.error > MAX_ERROR * camera.size[0]]
    if bad and not force:
        errors = ", ".join(f"{c.name} {c.error:.2f} px (at most {MAX_ERROR * c.size[0]:.2f})" for c in bad)
        raise InputError(
            f"{folder}: the calibration does not fit: reprojection error of {errors}; film the board again, sharper, "
            "closer and with pauses, by cameras that do not move (--force goes on)"
        )
    cameras = _scaled(cameras, scale, board is not None, say)
    for take, files in takes.items():
        films = films if files == shown else [Film.open(file) for file in files]
        for film, camera in zip(films, cameras, strict=True):
            if film.size != camera.size:
                raise InputError(f"{film.video.what}: has {film.size} pixels, the film of the board {camera.size}")
        say(f"{take}:")
        offsets, agreement = _offsets(films, synchronous, say)
        before = read_json(take / FILE) if (take / FILE).is_file() else {}
        keys = {"resample": _common_rate(films, say), "masks": before.get("masks")}
        write_whole(take / FILE, _description(cameras, offsets, agreement, keys))
    say(f"calibrate: wrote {', '.join(str(take / FILE) for take in takes)}")
    return [take / FILE for take in takes]


def _offsets(films: Sequence[Film], synchronous: bool, say: Callable[[str], None]) -> tuple[np.ndarray, list]:
    if synchronous:
        return np.zeros(len(films)), [None] * len(films)
    offsets, agreement = time_offsets([film.video.times for film in films], [film.motion for film in films])
    for film, offset, own in zip(films, offsets, agreement, strict=True):
        why = f"motion correlates by {own:.2f}"
        if own < MIN_AGREEMENT:
            why += f", below {MIN_AGREEMENT}: the times in the file are kept; clap once in view of all cameras"
        say(f"  {film.name}: {1000 * offset:+.0f} ms ({why})")
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


def _common_rate(films: Sequence[Film], say: Callable[[str], None]) -> float | None:
    """Returns the rate to which films of uneven or different rates are resampled; None if they are even and equal."""
    rates = [1 / float(np.median(np.diff(film.video.times))) for film in films]
    if all(film.video.rate for film in films) and max(rates) / min(rates) - 1 < SAME_RATE:
        return None
    say(f"  resampled to {min(rates):.5g} frames a second: the films have {', '.join(f'{rate:.5g}' for rate in rates)}")
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
