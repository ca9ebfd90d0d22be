"""The .ply container: columns of the elements of a file, whatever other elements and lists it holds."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from gsim3d.errors import InputError

MIP = "SplatRenderMode: mip"  # comment of files that were trained with Mip-Splatting's compensation
MAX_HEADER = 65536  # bytes
MAX_DIGITS = 15  # of a count
MAX_LIST_ROWS = 100_000  # rows with lists are read one by one

_DTYPES = {
    "float": "f4", "float32": "f4", "double": "f8", "float64": "f8",
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1",
    "short": "i2", "int16": "i2", "ushort": "u2", "uint16": "u2",
    "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4",
}  # fmt: skip
_ORDERS = {"ascii": "<", "binary_little_endian": "<", "binary_big_endian": ">"}


@dataclass
class Element:
    """One element of a header."""

    name: str  #: as the header has it
    count: int  #: rows
    #: of each its name, the dtype of its length (None: a single number) and the dtype of its numbers
    properties: list[tuple[str, str | None, str]] = field(default_factory=list)


@dataclass
class Header:
    """The header of a file."""

    encoding: str  #: a key of _ORDERS
    elements: list[Element]  #: in the order of the body
    comments: list[str]  #: also those of obj_info
    end: int  #: bytes before the body

    @property
    def is_mip(self) -> bool:
        """Whether a comment says so, as MIP does."""
        said = re.compile(r"splatrendermode\s*:\s*mip|antialiased\s+1\b", re.IGNORECASE)  # Brush, Postshot
        return any(map(said.match, self.comments))


def read_header(path: Path, content: bytes) -> Header:
    """The header of a file's content. Raises InputError that names ``path`` and the line that cannot be used."""
    end = re.search(rb"end_header\r?\n", content[:MAX_HEADER])
    if content[:2] == b"\x1f\x8b":
        raise InputError(f"{path}: compressed with gzip; unpack it first (gunzip)")
    if not content.startswith(b"ply") or end is None:
        raise InputError(f"{path}: not a .ply file")
    header = Header("", [], [], end.end())
    for line in content[: end.start()].decode("ascii", "replace").splitlines():
        words = line.split()
        if words[:1] == ["format"] and len(words) > 1:
            header.encoding = words[1]
        elif words[:1] in (["comment"], ["obj_info"]):
            header.comments.append(" ".join(words[1:]))
        elif words[:1] == ["element"]:
            if len(words) != 3 or not words[2].isdigit() or len(words[2]) > MAX_DIGITS:
                raise InputError(f"{path}: unusable line in the header: {line.strip()[:80]!r}")
            header.elements.append(Element(words[1], int(words[2])))
        elif words[:1] == ["property"]:
            header_property = _property(words[1:]) if header.elements else None
            if header_property is None:
                raise InputError(f"{path}: unsupported line in the header: {line.strip()[:80]!r}")
            header.elements[-1].properties.append(header_property)
    if header.encoding not in _ORDERS:
        raise InputError(f"{path}: unknown format {header.encoding[:80]!r}; expected {', '.join(_ORDERS)}")
    return header


def read_columns(path: Path, content: bytes, header: Header, *names: str) -> dict[str, dict[str, np.ndarray]]:
    """Element -> property -> [count] numbers, of the elements ``names`` that the file has, without their lists.

    Raises:
        InputError: an element has no usable property, the file is truncated, or too many rows have lists.
    """
    body = (_Text if header.encoding == "ascii" else _Binary)(content[header.end :], _ORDERS[header.encoding])
    found = {}
    wanted = {element.name for element in header.elements} & set(names)
    for element in header.elements:
        if found.keys() >= wanted:
            break
        properties = [name for name, _, _ in element.properties]
        if element.name in wanted and (not properties or len(set(properties)) != len(properties)):
            raise InputError(f"{path}: the header has no usable element {element.name[:80]}")
        if element.count > MAX_LIST_ROWS and any(length for _, length, _ in element.properties):
            most = f"at most {MAX_LIST_ROWS} such rows are read"
            raise InputError(f"{path}: {element.count} rows of element {element.name[:80]} have lists; {most}")
        try:
            found[element.name] = _columns(body, element)
        except _Truncated:
            wanted = f"expected {element.count} rows of element {element.name[:80]}"
            raise InputError(f"{path}: truncated or not numeric: {wanted}") from None
    return found


def _property(words: list[str]) -> tuple[str, str | None, str] | None:
    if len(words) == 2 and words[0] in _DTYPES:
        return words[1], None, _DTYPES[words[0]]
    if len(words) == 4 and words[0] == "list" and words[1] in _DTYPES and words[2] in _DTYPES:
        return (words[3], _DTYPES[words[1]], _DTYPES[words[2]]) if _DTYPES[words[1]][0] != "f" else None
    return None


def _columns(body: _Binary | _Text, element: Element) -> dict[str, np.ndarray]:
    names = [name for name, length, _ in element.properties if length is None]
    if len(names) == len(element.properties):
        return dict(zip(names, body.table(element.count, [kind for _, _, kind in element.properties]), strict=True))
    rows = []
    for _ in range(element.count):
        row, run = [], []  # numbers of one row, and the kinds of those that stand before the next list
        for _, length, kind in element.properties:
            run.append(length or kind)
            if length is not None:
                *numbers, count = body.table(1, run)
                body.skip(int(count[0]), kind)
                row, run = row + numbers, []
        rows.append(row + body.table(1, run))
    return {name: np.concatenate([row[i] for row in rows] or [np.zeros(0)]) for i, name in enumerate(names)}


class _Truncated(Exception):
    pass


class _Binary:
    """The bytes behind a header, taken off from their start."""

    def __init__(self, body: bytes, order: str):
        self.body, self.order, self.at = body, order, 0

    def table(self, count: int, kinds: list[str]) -> list[np.ndarray]:
        """``count`` rows of one number of each of ``kinds``, by column."""
        dtype = np.dtype([(f"f{i}", self.order + kind) for i, kind in enumerate(kinds)])
        begin = self.at
        self._move(count * dtype.itemsize)
        if not count * dtype.itemsize:
            return [np.zeros(count, kind) for kind in kinds]
        return [np.frombuffer(self.body, dtype, count, begin)[name] for name in dtype.names]

    def skip(self, count: int, kind: str) -> None:
        self._move(count * np.dtype(kind).itemsize)

    def _move(self, count: int) -> None:
        if not 0 <= count <= len(self.body) - self.at:
            raise _Truncated
        self.at += count


class _Text(_Binary):
    """The words behind a header."""

    def __init__(self, body: bytes, order: str):
        super().__init__(body.split(), order)

    def table(self, count: int, kinds: list[str]) -> list[np.ndarray]:
        begin = self.at
        self._move(count * len(kinds))
        try:
            values = np.array(self.body[begin : self.at], dtype=np.float64).reshape(count, len(kinds))
        except ValueError:
            raise _Truncated from None
        return [self._typed(column, kind) for column, kind in zip(values.T, kinds, strict=True)]

    def skip(self, count: int, kind: str) -> None:
        self._move(count)

    @staticmethod
    def _typed(column: np.ndarray, kind: str) -> np.ndarray:
        """Whole numbers in their type; others keep the digits of the text."""
        if kind[0] == "f":
            return column
        with np.errstate(invalid="ignore"):
            whole = column.astype(kind)
        if (whole != column).any():
            raise _Truncated
        return whole
