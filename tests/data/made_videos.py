"""Small video files as cameras and editors write them: the boxes of a plain one changed by hand."""

import json
import struct
from pathlib import Path

import cv2
import numpy as np

WIDTH, HEIGHT, N_FRAMES, RATE, SCALE = 64, 48, 20, 20, 10240
TREE = (b"moov", b"trak", b"edts", b"mdia", b"minf", b"stbl")


def write_plain(file: Path, n_frames=N_FRAMES, rate=RATE, size=(WIDTH, HEIGHT)) -> Path:
    """Frame k is grey, 12 (k mod 20), with a white corner at the upper left."""
    codec = {".mp4": "mp4v", ".mov": "mp4v", ".mkv": "mp4v", ".webm": "VP80", ".avi": "MJPG"}[file.suffix]
    writer = cv2.VideoWriter(str(file), cv2.CAP_FFMPEG, cv2.VideoWriter_fourcc(*codec), rate, size)
    assert writer.isOpened()
    for frame in range(n_frames):
        image = np.full((size[1], size[0], 3), 12 * (frame % 20), np.uint8)
        image[:16, :16] = 255
        writer.write(image)
    writer.release()
    return file


def shown(image: np.ndarray) -> int:
    """The number of a frame modulo 20, from its grey."""
    return round(float(np.median(image)) / 12)


def edit_boxes(file: Path, edits: dict) -> Path:
    """Replaces what boxes of an MP4 or MOV hold, whose index lies last. ``edits``: kind -> function of the bytes."""

    def rebuilt(data: bytes) -> bytes:
        begin, parts = 0, []
        while begin < len(data):
            length, kind = struct.unpack_from(">I4s", data, begin)
            body = data[begin + 8 : begin + length]
            body = rebuilt(body) if kind in TREE else body
            body = edits[kind](body) if kind in edits else body
            parts.append(struct.pack(">I4s", 8 + len(body), kind) + body)
            begin += length
        return b"".join(parts)

    file.write_bytes(rebuilt(file.read_bytes()))
    return file


def with_gaps(file: Path, gaps: list[int]) -> Path:
    """Frames so many milliseconds apart."""
    deltas = [round(gap * SCALE / 1000) for gap in gaps]
    deltas.append(deltas[-1])
    if file.suffix in (".mp4", ".mov"):
        total = sum(deltas)
        table = struct.pack(">II", 0, len(deltas)) + b"".join(struct.pack(">II", 1, delta) for delta in deltas)
        seconds = round(1000 * total / SCALE)
        edits = {
            b"stts": lambda old: table,
            b"mdhd": lambda old: old[:16] + struct.pack(">I", total) + old[20:],
            b"elst": lambda old: old[:8] + struct.pack(">I", seconds) + old[12:],
            b"tkhd": lambda old: old[:20] + struct.pack(">I", seconds) + old[24:],
            b"mvhd": lambda old: old[:16] + struct.pack(">I", seconds) + old[20:],
        }
        return edit_boxes(file, edits)
    data, begin, time = bytearray(file.read_bytes()), file.read_bytes().find(b"\x1fC\xb6u"), 0
    for frame, gap in enumerate([*gaps, 0]):  # blocks of Matroska and WebM hold milliseconds
        begin = data.find(b"\x81" + struct.pack(">h", 1000 // RATE * frame), begin) + 1
        assert begin
        data[begin : begin + 2] = struct.pack(">h", time)
        time += gap
    file.write_bytes(data)
    return file


def trimmed(file: Path, skipped: float, late: float = 0.0) -> Path:
    """An edit list that leaves out the first seconds of an MP4, and starts later."""
    kept = N_FRAMES / RATE - skipped
    entries = [(round(1000 * late), -1)] if late else []
    entries.append((round(1000 * kept), round(skipped * SCALE)))
    table = struct.pack(">II", 0, len(entries)) + b"".join(struct.pack(">IiI", *entry, 1 << 16) for entry in entries)
    duration = struct.pack(">I", round(1000 * (kept + late)))
    return edit_boxes(file, {b"elst": lambda old: table, b"tkhd": lambda old: old[:20] + duration + old[24:]})


def with_matrix(file: Path, a: int, b: int, c: int, d: int) -> Path:
    """A display matrix."""
    matrix = struct.pack(">9i", *(value << 16 for value in (a, b, 0, c, d, 0, 0, 0, 1 << 14)))
    return edit_boxes(file, {b"tkhd": lambda old: old[:40] + matrix + old[76:]})


def with_duration(file: Path, seconds: float | None) -> Path:
    """Another duration of a Matroska or WebM file, as a longer sound track makes it; or none, as of a live stream."""
    data = bytearray(file.read_bytes())
    begin = data.find(b"\x44\x89\x88")
    assert begin > 0
    data[begin : begin + 11] = (
        b"\xec\x89" + bytes(9) if seconds is None else data[begin : begin + 3] + struct.pack(">d", 1000 * seconds)
    )
    file.write_bytes(data)
    return file


def write_scene(folder: Path, names: list[str], size=(WIDTH, HEIGHT), **keys) -> Path:
    """cameras.json for videos (or folders of frames) that lie there."""
    cameras = [
        {"name": name, "size": list(size), "K": [[60, 0, size[0] / 2], [0, 60, size[1] / 2], [0, 0, 1]],
         "R": np.eye(3).tolist(), "T": [0.1 * number, 0, 3]}
        for number, name in enumerate(names)
    ]  # fmt: skip
    content = {"cameras": cameras, "masks": "none", "near": 1, "far": 5, **keys}
    (folder / "cameras.json").write_text(json.dumps(content))
    return folder
