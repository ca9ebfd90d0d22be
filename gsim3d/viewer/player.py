"""One HTML file that plays moving Gaussians in a browser, from disk and without a network.

All values are rounded to integers once, so that errors do not grow over time: positions to a grid of 1 mm, the others
to the steps below. What never changes is stored once; else the second difference over time (positions) or the first
(others), as unsigned zigzag numbers, low and high bytes apart, deflated.
"""

import base64
import html
import json
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path

import numpy as np
import torch

from gsim3d.cameras import Cameras
from gsim3d.errors import InputError
from gsim3d.io.arrays import Splats, colors_of, gaussians_of, splats_of
from gsim3d.io.files import write_whole
from gsim3d.io.orbit import camera_around, picture
from gsim3d.math.spherical_harmonics import SH_0
from gsim3d.state import Gaussians

POSITION_STEP = 1e-3  # metres between grid points: positions are right to half of it
LARGEST_POSITION = 1e6  # metres from the middle of the first frame
LOG_SCALE_STEP, QUAT_STEP, UNIT_STEP, SH_STEP = 1 / 32, 1 / 2047, 1 / 255, 1 / 128
LARGEST_COLOR, LARGEST_SH = 4.0, 15.0
POSTER, AZIMUTH = 512, 0.6  # pixels; radians, of the first look where none is given
MOST_IMAGES = 2**27  # bytes of encoded images


@dataclass(frozen=True)
class View:
    """A camera of the first look at a scene."""

    viewmat: np.ndarray  #: [4, 4] world to camera, x right, y down, z forward
    K: np.ndarray  #: [3, 3] pixels
    width: int  #: of its images
    height: int  #: of its images


def write_player(
    path: str | Path,
    frames: Gaussians | Sequence[Gaussians],
    *,
    fps: float,
    title: str = "gsim3d",
    view: View | None = None,
    truth: Sequence[np.ndarray] | None = None,
    background: tuple[float, float, float] = (0.0, 0.0, 0.0),
    start: int = 0,
) -> None:
    """Writes an HTML file that plays ``frames``; it appears complete or not at all.

    Args:
        path: ends in .html.
        frames: z up, metres: packed frames, or a sequence of single ones. Gaussian n of one frame is Gaussian n of
            the next; where frames have fewer Gaussians than others, the rest is invisible.
        fps: frames a second.
        title: shown above the scene.
        view: the camera of the first look, and of the poster (default: one that sees all).
        truth: uint8 [H, W, 3] images, one a frame, shown beside the scene; seen by ``view``.
        background: colour behind the scene, in [0, 1].
        start: number of the first predicted frame; earlier ones are labelled as given.
    Raises:
        InputError: a wrong name or rate, no frame, values that are not finite, or images of another count.
    """
    path = Path(path)
    if path.suffix.lower() not in (".html", ".htm"):
        raise InputError(f"{path}: a player must end in .html")
    if not 0 < fps < float("inf"):
        raise InputError(f"{path}: frames a second must be positive; got {fps}")
    parts = [frames] if isinstance(frames, Gaussians) else list(frames)
    splats = [splats_of(part, index, path) for part in parts for index in range(len(part.cu_rows) - 1)]
    if not splats:
        raise InputError(f"{path}: there is no frame to play")
    if truth is not None and len(truth) != len(splats):
        raise InputError(f"{path}: {len(truth)} true images for {len(splats)} frames")
    header, blobs = _packed(path, splats)
    header |= {"fps": fps, "title": title, "background": list(background), "start": start}
    first = gaussians_of(splats[0], path)
    if view is None:
        camera = camera_around(first, AZIMUTH, POSTER)
        view = View(camera.viewmats[0].numpy(), camera.Ks[0].numpy(), POSTER, POSTER)
    header["view"], header["antialiased"] = _view(view), first.antialiased
    header["truth"] = _encoded(path, truth) if truth is not None else []
    blob = '<script type="text/plain" id="blob{}">{}</script>\n'
    scripts = "".join(blob.format(index, base64.b64encode(one).decode()) for index, one in enumerate(blobs))
    page, script = (files("gsim3d.viewer").joinpath(f"player.{kind}").read_text() for kind in ("html", "js"))
    filled = page.replace("{{title}}", html.escape(title, quote=False)).replace("{{script}}", script)
    filled = filled.replace("{{blobs}}", scripts).replace("{{poster}}", _jpeg(_poster(first, view, background)))
    write_whole(path, filled.replace("{{header}}", json.dumps(header).replace("<", "\\u003c")))


def _packed(path: Path, frames: Sequence[Splats]) -> tuple[dict, list[bytes]]:
    """Header and blobs of all channels of ``frames``."""
    count, n_sh = max(frame.count for frame in frames), max(frame.sh.shape[1] for frame in frames)
    first = frames[0].means
    middle = first.mean(0, dtype=np.float64) if len(first) else np.zeros(3)
    channels: dict[str, tuple[np.ndarray, float]] = {}

    def stacked(values: Sequence[np.ndarray], width: int, step: float, most: float) -> np.ndarray:
        """int32 [frames, count, width]; Gaussians that a frame lacks keep their last values, 0 at first."""
        table = np.zeros((len(values), count, width), np.int32)
        for index, value in enumerate(values):
            if index:
                table[index] = table[index - 1]
            rounded = np.round(np.clip(value.astype(np.float64), -most, most) / step)
            table[index, : len(value), : value.shape[1]] = rounded
        return table

    offsets = [frame.means - middle for frame in frames]
    if any(len(offset) and np.abs(offset).max() > LARGEST_POSITION for offset in offsets):
        raise InputError(f"{path}: positions reach over {LARGEST_POSITION:g} m; leave out what is far away")
    channels["means"] = stacked(offsets, 3, POSITION_STEP, LARGEST_POSITION), POSITION_STEP
    channels["scales"] = stacked([np.log(f.scales) for f in frames], 3, LOG_SCALE_STEP, 30.0), LOG_SCALE_STEP
    channels["quats"] = stacked(_continuous([frame.quats for frame in frames]), 4, QUAT_STEP, 1.0), QUAT_STEP
    opacities = stacked([frame.opacities[:, None] for frame in frames], 1, UNIT_STEP, 1.0)
    for index, frame in enumerate(frames):
        opacities[index, frame.count :] = 0
    channels["opacities"] = opacities, UNIT_STEP
    channels["colors"] = stacked([colors_of(f) for f in frames], 3, UNIT_STEP, LARGEST_COLOR), UNIT_STEP
    if n_sh > 1:
        rest = [frame.sh[:, 1:].reshape(frame.count, 3 * (frame.sh.shape[1] - 1)) for frame in frames]
        channels["sh"] = stacked(rest, 3 * (n_sh - 1), SH_STEP, LARGEST_SH), SH_STEP
    header: dict = {"count": count, "frames": len(frames), "middle": middle.tolist(), "n_sh": n_sh, "sh0": SH_0}
    header["channels"], blobs = {}, []
    for name, (table, step) in channels.items():
        order = 0 if (table == table[:1]).all() else 2 if name == "means" else 1
        header["channels"][name] = {"step": step, "width": table.shape[2], "order": order, "blob": len(blobs)}
        blobs.append(_deflated(table, order))
    return header, blobs


def _deflated(table: np.ndarray, order: int) -> bytes:
    """Differences of ``order`` over time, 0: the first frame alone, as zigzag uint32.

    In byte planes that are not zero everywhere: a byte with their number first.
    """
    values = table[: len(table) if order else 1].astype(np.int64)
    for _ in range(order):
        values = np.concatenate([values[:1], np.diff(values, axis=0)])
    zigzag = np.where(values < 0, -2 * values - 1, 2 * values).astype("<u4").transpose(0, 2, 1)
    planes = np.ascontiguousarray(zigzag).view(np.uint8).reshape(-1, 4).T
    n_planes = next((k + 1 for k in (3, 2, 1) if planes[k].any()), 1)
    packer = zlib.compressobj(6, zlib.DEFLATED, -15)
    return packer.compress(bytes([n_planes]) + planes[:n_planes].tobytes()) + packer.flush()


def _continuous(quats: Sequence[np.ndarray]) -> list[np.ndarray]:
    """The same rotations with signs that change as little as possible over time."""
    out = [quats[0] * np.where(quats[0][:, :1] < 0, -1, 1)]
    for now in quats[1:]:
        n = min(len(now), len(out[-1]))
        sign = np.where(now[:, :1] < 0, -1.0, 1.0)
        sign[:n, 0] = np.where((now[:n] * out[-1][:n]).sum(1) < 0, -1, 1)
        out.append(now * sign)
    return out


def _view(view: View) -> dict:
    viewmat, K = np.asarray(view.viewmat, np.float64), np.asarray(view.K, np.float64)
    if viewmat.shape != (4, 4) or K.shape != (3, 3) or not np.isfinite(viewmat).all() or not np.isfinite(K).all():
        raise InputError("view: viewmat must be [4, 4] and K [3, 3], finite")
    return {"viewmat": viewmat.tolist(), "K": K.tolist(), "width": int(view.width), "height": int(view.height)}


@torch.no_grad()
def _poster(gaussians: Gaussians, view: View, background: tuple[float, float, float]) -> np.ndarray:
    """Image uint8 [H, W, 3] of the first look, its longer side of POSTER pixels."""
    zoom = POSTER / max(view.width, view.height)
    width, height = (max(1, round(zoom * side)) for side in (view.width, view.height))
    K = torch.tensor(np.asarray(view.K, np.float64) * [[zoom], [zoom], [1]])[None].float()
    viewmat = torch.tensor(np.asarray(view.viewmat, np.float64))[None].float()
    camera = Cameras(viewmat, K, torch.tensor([0.1]), torch.tensor([1e6]), torch.tensor([0]), width, height)
    return picture(gaussians, camera, torch.tensor(background))


def _jpeg(image: np.ndarray) -> str:
    """Base64 of an image as JPEG."""
    import cv2

    return base64.b64encode(cv2.imencode(".jpg", image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 92])[1]).decode()


def _encoded(path: Path, images: Sequence[np.ndarray]) -> list[str]:
    """Images as base64 of JPEG."""
    out = []
    for index, image in enumerate(images):
        if image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] != 3:
            raise InputError(f"{path}: true images must be uint8 [H, W, 3]; image {index} is not")
        out.append(_jpeg(image))
    if sum(map(len, out)) > MOST_IMAGES:
        raise InputError(f"{path}: its true images take over {MOST_IMAGES >> 20} MiB; give smaller ones")
    return out
