"""Damages files: bytes, text, structure, and what lies where a file should."""

from __future__ import annotations

import json
import math
import os
import random
import shutil
from pathlib import Path
from typing import Any

import yaml

VALUES = (
    None, True, False, 0, -1, 1, 2, 1e-300, 1e300, math.nan, math.inf, -math.inf, 2**31, 2**63, -(2**63), 10**400,
    "", "x", "nan", "-1", "../..", "/etc/passwd", "../../../../../../etc/passwd", "a" * 5000, "\x00", "\ud800",
    [], {}, [[]], [1] * 1000, {"x": 1}, [None], [[1, 2], [3]], "{cam_ix}{cam_ix.__class__}", "{n_step:999999999d}",
    "%s%s%s",
)  # fmt: skip
OTHER_FILES = (
    b"",
    b"\x00",
    b"\x89PNG\r\n\x1a\n",
    b"\xff\xd8\xff",
    b"PK\x03\x04",
    b"ply\n",
    b"{",
    b"[" * 100_000,
    b"\x80\x04.",
)
NUMBERS = (b"0", b"-1", b"999999999999", b"4294967296", b"1e309", b"nan", b"18446744073709551616")


def damage(folder: Path, rng: random.Random, descriptions: tuple[str, ...]) -> str:
    """Damages one file, more often a description than another; what was done."""
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    described = [path for path in files if path.name in descriptions]
    file = rng.choice(described) if described and rng.random() < 0.65 else rng.choice(files)
    kinds = [_bytes, _bytes, _place]
    if file.suffix in (".json", ".yaml"):
        kinds += [_structure] * 6
    kind = rng.choice(kinds)
    return f"{file.relative_to(folder)}: {kind(file, rng)}"


def _structure(file: Path, rng: random.Random) -> str:
    """Values of JSON or YAML replaced, removed, moved."""
    is_json = file.suffix == ".json"
    content = json.loads(file.read_text()) if is_json else yaml.safe_load(file.read_text())
    done = [_change(content, rng) for _ in range(rng.choice((1, 1, 1, 2, 4)))]
    try:
        text = json.dumps(content) if is_json else yaml.safe_dump(content)
        file.write_text(text, errors="surrogatepass")
    except (ValueError, yaml.YAMLError, UnicodeError):
        file.write_text("{")
    return ", ".join(done)


def _change(content: Any, rng: random.Random) -> str:
    """One place of a tree, chosen by walking down at random."""
    place, path = content, ""
    while True:
        keys = list(place) if isinstance(place, dict) else list(range(len(place)))
        if not keys:
            return "nothing"
        key = rng.choice(keys)
        path += f".{str(key)[:20]}"
        value = place[key]
        if not isinstance(value, (dict, list)) or not value or rng.random() < 0.25:
            break
        place = value
    action = rng.randrange(6)
    if action == 0:
        del place[key]
        return f"{path} removed"
    if action == 1 and isinstance(value, (int, float)) and not isinstance(value, bool) and abs(value) < 1e300:
        place[key] = rng.choice((value * -1, value * 1e6, value + 0.5, value * 0))
    elif action == 2 and isinstance(value, list):
        place[key] = rng.choice((value[:-1], value + value[-1:], value * 3, value[::-1]))
    elif action == 3 and isinstance(place, dict):
        place[rng.choice(("extra", "", "__class__", "cam_99"))] = value
    else:
        place[key] = rng.choice(VALUES)
    return f"{path} changed"


def _bytes(file: Path, rng: random.Random) -> str:
    data = bytearray(file.read_bytes())
    kind = rng.randrange(8)
    if kind == 0 or not data:
        data = data[: rng.randrange(len(data) + 1)]
        done = f"cut to {len(data)} bytes"
    elif kind in (1, 2):
        head = min(len(data), rng.choice((64, 512, len(data))))
        count = rng.choice((1, 1, 3, 20))
        for _ in range(count):
            data[rng.randrange(head)] ^= 1 << rng.randrange(8)
        done = f"{count} bits flipped"
    elif kind == 3:
        start = rng.randrange(len(data))
        fill = rng.choice((0, 255, 127))
        length = min(len(data) - start, rng.choice((1, 4, 8, 64)))
        data[start : start + length] = bytes([fill]) * length
        done = f"{length} bytes at {start} set to {fill}"
    elif kind == 4:
        data = bytearray(rng.choice(OTHER_FILES))
        done = "another kind of file"
    elif kind == 5:
        start = rng.randrange(len(data))
        data[start:start] = data[start : start + rng.choice((1, 100))] * rng.choice((1, 50))
        done = "a part repeated"
    elif kind == 6:
        data += os.urandom(0) + bytes(rng.randrange(256) for _ in range(rng.choice((1, 100))))
        done = "something appended"
    else:
        done = "nothing"
        digits = [i for i in range(min(len(data), 4000)) if 48 <= data[i] <= 57]
        if digits:
            start = rng.choice(digits)
            end = start
            while end < len(data) and 48 <= data[end] <= 57:
                end += 1
            data[start:end] = rng.choice(NUMBERS)
            done = f"another number at {start}"
    file.write_bytes(data)
    return done


def _place(file: Path, rng: random.Random) -> str:
    """Something else than a file, or none."""
    kind = rng.randrange(7)
    file.unlink()
    if kind == 0:
        return "removed"
    if kind == 1:
        file.mkdir()
        return "a folder instead"
    if kind == 2:
        os.mkfifo(file)
        return "a pipe instead"
    if kind == 3:
        file.symlink_to(rng.choice(("/etc/passwd", "/dev/zero", "/", "/proc/self/mem")))
        return "a link out of the folder"
    if kind == 4:
        file.symlink_to(file.name)
        return "a link to itself"
    if kind == 5:
        with open(file, "wb") as opened:
            opened.truncate(3 * 2**30)  # takes no place on the disk
        return "3 GiB of zeros"
    shutil.copyfile("/dev/null", file)
    return "an empty file"
