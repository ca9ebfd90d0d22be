"""Files of unknown origin, read with bounded memory; and new files, which appear whole or not at all."""

from __future__ import annotations

import dataclasses
import hashlib
import os
import reprlib
import types
import typing
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from gsim3d.errors import InputError, did_you_mean
from gsim3d.io.plain import is_number, parse_yaml

_BOUNDED = reprlib.Repr()
_BOUNDED.maxstring = _BOUNDED.maxother = 80
_BOUNDED.maxlevel = 2
MAX_TEXT = 256 * 2**20  # bytes of a description or of settings


def sha256_of(path: Path) -> str:
    """The hash of a file's bytes, in hex."""
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def new_output_path(out: str | Path, kind: str = "folder") -> Path:
    """The path of a file or folder that a command will make.

    Raises:
        InputError: it exists, or a folder around it is a file; the message starts with ``--out``.
    """
    out = output_path(out)
    if out.exists() or out.is_symlink():
        raise InputError(f"--out: {out} exists already; name another {kind} or remove it")
    return out


def output_path(out: str | Path, suffix: str = "", option: str = "--out") -> Path:
    """The path of a file that ends in ``suffix``, or of a folder, that a command will write.

    Args:
        out: path; folders around it need not exist.
        suffix: ending of a file; empty: any file or folder.
        option: name of the option, for messages.

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
        part.unlink(missing_ok=True)


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
    """The bytes of a file.

    Args:
        path: a regular file.
        most: bytes that it may have.
        first: how many are read from its start; None: all.

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


def read_yaml(path: str | Path, subject: str) -> Any:
    """Plain values of a YAML (or JSON) file.

    Raises:
        InputError: as :func:`read_file`, or it is none; the message starts with ``subject``.
    """
    text = read_file(path, MAX_TEXT)
    try:
        return parse_yaml(text)
    except ValueError as error:
        raise InputError(f"{subject}: {path} cannot be read: {error}") from None


def shown(value: Any) -> str:
    """The start of the repr of a value. The whole is never made: lists may hold each other many times."""
    try:
        return _BOUNDED.repr(value)
    except ValueError:  # an integer of thousands of digits
        return "a number of thousands of digits"


def typed(cls: type, values: Any, subject: str, where: str = "") -> Any:
    """An object of the dataclass ``cls`` from plain values, checked against the types of its fields.

    Args:
        cls: dataclass. Where it has an attribute ``alone``, a text by itself is the field of this name.
        values: mapping of plain values.
        subject: what the values belong to, for messages.
        where: path of keys before these, ending in a dot.

    Raises:
        InputError: a key is unknown or missing, or a value of another type; the message starts with ``subject`` and
            names the key.
    """
    if not isinstance(values, dict):
        raise InputError(f"{subject}: {where.rstrip('.')} must be a mapping; got {shown(values)}")
    hints = typing.get_type_hints(cls)
    hints = {field.name: hints[field.name] for field in dataclasses.fields(cls)}
    if unknown := [name for name in values if name not in hints]:
        hint = did_you_mean(unknown[0], hints)
        raise InputError(f"{subject}: unknown key {where}{str(unknown[0])[:80]}; known: {', '.join(hints)}{hint}")
    fields = {name: _value(hints[name], value, subject, where + name) for name, value in values.items()}
    for field in dataclasses.fields(cls):
        if field.name not in values and field.default is field.default_factory is dataclasses.MISSING:
            raise InputError(f"{subject}: key {where}{field.name} is missing")
    try:
        return cls(**fields)
    except InputError as error:
        if str(error).startswith(subject):
            raise
        raise InputError(": ".join(filter(None, (subject, where.rstrip("."), str(error))))) from None


def _value(hint: Any, value: Any, subject: str, where: str) -> Any:
    """``value`` as ``hint`` asks for it."""
    if typing.get_origin(hint) is types.UnionType:
        if value is None:
            return None
        hint = typing.get_args(hint)[0]
    if dataclasses.is_dataclass(hint):
        if isinstance(value, str) and hasattr(hint, "alone"):
            value = {hint.alone: value}
        return typed(hint, value, subject, f"{where}.")
    if typing.get_origin(hint) is tuple:
        items = typing.get_args(hint)
        n = None if items[-1] is ... else len(items)
        if not isinstance(value, (list, tuple)) or n not in (None, len(value)):
            raise InputError(f"{subject}: {where} must be a list{'' if n is None else f' of {n}'}; got {shown(value)}")
        return tuple(_value(item, v, subject, where) for item, v in zip(items if n else items[:1] * len(value), value))
    fits = {bool: isinstance(value, bool), str: isinstance(value, str)}
    fits |= {kind: is_number(value, kind) for kind in (int, float)}
    if not fits.get(hint, True):
        wanted = {bool: "true or false", str: "a text", int: "a whole number", float: "a number"}[hint]
        raise InputError(f"{subject}: {where} must be {wanted}; got {shown(value)}")
    return value
