"""Files of unknown origin, read with bounded memory; and new files, which appear whole or not at all."""

import hashlib
import os
import reprlib
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np

from gsim3d.errors import InputError, naming
from gsim3d.io.plain import parse_yaml

_BOUNDED = reprlib.Repr()
_BOUNDED.maxstring = _BOUNDED.maxother = 80
_BOUNDED.maxlevel = 2
MAX_TEXT = 256 * 2**20  # bytes of a description or of settings


def sha256_of(path: Path) -> str:
    """The hash of a file's bytes, in hex."""
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def new_output_path(out: str | Path, kind: str = "folder", option: str = "--out") -> Path:
    """The path of a file or folder that a command will make.

    Raises:
        InputError: it exists, or a folder around it is a file; the message starts with ``option``.
    """
    out = output_path(out, option=option)
    if out.exists() or out.is_symlink():
        raise InputError(f"{option}: {out} exists already; name another {kind} or remove it")
    return out


def output_path(out: str | Path, suffix: str = "", option: str = "--out") -> Path:
    """The path of a file that ends in ``suffix``, or of any file or folder, that a command will write.

    Folders around it need not exist. ``option`` is named in messages.

    Raises:
        InputError: another ending, a folder in place of the file, or a file in place of a folder around it.
    """
    out = Path(out)
    if suffix and (out.suffix != suffix or out.is_dir()):
        raise InputError(f"{option}: the name must end in {suffix}; got {out}")
    around = next(folder for folder in out.absolute().parents if folder.exists() or folder == folder.parent)
    if not around.is_dir():
        raise InputError(f"{option}: {out} lies in {around}, which is no folder")
    return out


def with_parents(path: Path) -> Path:
    """``path``, the folders around which exist from here on."""
    path.absolute().parent.mkdir(parents=True, exist_ok=True)
    return path


@contextmanager
def whole_file(path: str | Path) -> Iterator[Path]:
    """A hidden path beside ``path``, for a file that becomes ``path`` when the block ends, and is removed if it fails.

    Raises:
        OSError: it cannot be written; names ``path``.
    """
    path = Path(path)
    part = path.with_name(f".{path.stem}.part{path.suffix}")
    try:
        yield part
        os.replace(part, path)
    except OSError as error:
        raise OSError(error.errno, error.strerror, str(path)) from None
    finally:
        with suppress(OSError):
            part.unlink()


def write_whole(path: str | Path, *parts: str | bytes) -> None:
    """Writes text or bytes as a file that appears whole or not at all. Raises OSError as :func:`whole_file`."""
    with whole_file(path) as part, open(part, "wb") as file:
        for content in parts:
            file.write(content.encode(errors="backslashreplace") if isinstance(content, str) else content)


def write_picture(path: str | Path, image: np.ndarray) -> None:
    """Writes uint8 [H, W, 3], RGB, as PNG. Raises OSError as :func:`whole_file`."""
    import cv2

    write_whole(path, cv2.imencode(".png", image[..., ::-1])[1].tobytes())


def opencv_path(path: str | Path) -> str:
    """``path`` for a function of OpenCV, which ends the process where a name is not UTF-8. Raises InputError there."""
    try:
        str(path).encode()
    except UnicodeEncodeError:
        raise InputError(f"the path {str(path)!a} is not UTF-8; rename what it names") from None
    return str(path)


def read_file(path: str | Path, most: int, first: int | None = None) -> bytes:
    """The bytes of a regular file, or its ``first`` bytes.

    Raises:
        InputError: it is missing, no file (pipes and devices are not opened), has more than ``most`` bytes, or cannot
            be read; the message names it.
    """
    path = Path(path)
    try:
        if not path.is_file():
            raise InputError(f"{path} cannot be read: {'it is not a file' if path.exists() else 'no such file'}")
        size = path.stat().st_size
        if size > most:
            raise InputError(f"{path} cannot be read: it has {size} bytes; more than {most} are refused")
        with open(path, "rb") as file:
            return file.read(size if first is None else first)
    except MemoryError:
        raise InputError(f"{path} cannot be read: no memory for {size} bytes") from None
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror}") from None


def read_yaml(path: str | Path, kind: Any = dict) -> Any:
    """Plain values of a YAML (or JSON) file that holds ``kind``: dict, list, or ``dict | None`` where it may be empty.

    Raises:
        InputError: as :func:`read_file`, it is no YAML, or it holds something else; the message names it.
    """
    text = read_file(path, MAX_TEXT)
    with naming(f"{path} cannot be read: not valid YAML", ValueError):
        content = parse_yaml(text)
    if not isinstance(content, kind):
        wanted = "list" if kind is list else "mapping"
        raise InputError(f"{path} must hold a {wanted}; got {type(content).__name__}")
    return content


def shown(value: Any) -> str:
    """The start of the repr of a value. The whole is never made: lists may hold each other many times."""
    try:
        return _BOUNDED.repr(value)
    except ValueError:  # an integer of thousands of digits
        return "a number of thousands of digits"
