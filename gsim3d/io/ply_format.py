"""The .ply container: the columns of one element of a file, whatever other elements and lists it holds."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from gsim3d.errors import InputError

MAX_HEADER = 65536  # bytes
MAX_DIGITS = 15  # of a count
MAX_RAGGED = 100_000  # rows of a file whose lists differ in length: they are read one by one

_DTYPES = {
    "float": "f4", "float32": "f4", "double": "f8", "float64": "f8",
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1",
    "short": "i2", "int16": "i2", "ushort": "u2", "uint16": "u2",
    "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4",
}  # fmt: skip
_ORDERS = {"ascii": "<", "binary_little_endian": "<", "binary_big_endian": ">"}


@dataclass
class Element:
    """name and count, and of each property its name, the dtype of a list's length (None: no list) and its own."""

    name: str
    count: int
    properties: list[tuple[str, str | None, str]] = field(default_factory=list)

    @property
    def has_lists(self) -> bool:
        return any(length for _, length, _ in self.properties)


@dataclass
class Header:
    """encoding, the elements in their order, the comments, and where the body begins."""

    encoding: str
    elements: list[Element]
    comments: list[str]
    end: int


def read_header(path: Path, content: bytes) -> Header:
    """Raises InputError that names ``path`` and the line that cannot be used."""
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


def read_columns(path: Path, content: bytes, header: Header, name: str) -> dict[str, np.ndarray]:
    """The columns of the element ``name``, without its lists.

    Raises:
        InputError: there is no such element, the file is truncated, or lists of too many rows differ in length.
    """
    wanted = next((element for element in header.elements if element.name == name), None)
    names = [] if wanted is None else [own for own, _, _ in wanted.properties]
    if not names or len(set(names)) != len(names):
        raise InputError(f"{path}: the header has no usable element {name}")
    reader = _Text if header.encoding == "ascii" else _Binary
    body = reader(path, memoryview(content)[header.end :], _ORDERS[header.encoding])
    for element in header.elements:
        columns = body.take(element, element is wanted)
        if element is wanted:
            return columns
    raise AssertionError(name)


def _property(words: list[str]) -> tuple[str, str | None, str] | None:
    if len(words) == 2 and words[0] in _DTYPES:
        return words[1], None, _DTYPES[words[0]]
    if len(words) == 4 and words[0] == "list" and words[1] in _DTYPES and words[2] in _DTYPES:
        return (words[3], _DTYPES[words[1]], _DTYPES[words[2]]) if _DTYPES[words[1]][0] != "f" else None
    return None


class _Body:
    """Takes one element after the other off a body: rows of one size at once, others one by one."""

    def __init__(self, path: Path, order: str):
        self.path, self.order, self.at, self.n_ragged = path, order, 0, 0

    def take(self, element: Element, wanted: bool) -> dict[str, np.ndarray]:
        lengths = [0] * len(element.properties)
        if element.has_lists and element.count:
            lengths = self.lengths(element, self.at)
        columns, end = self.rows(element, lengths)
        if columns is None:
            columns, end = self._one_by_one(element, wanted)
        self.at = end
        return columns

    def _one_by_one(self, element: Element, wanted: bool) -> tuple[dict[str, np.ndarray], int]:
        self.n_ragged += element.count
        if self.n_ragged > MAX_RAGGED:
            raise InputError(
                f"{self.path}: the lists of {element.count} rows of element {element.name} differ in length; at most "
                f"{MAX_RAGGED} such rows are read"
            )
        one, found, at = Element(element.name, 1, element.properties), [], self.at
        for _ in range(element.count):
            columns, self.at = self.rows(one, self.lengths(one, self.at))
            found.append(columns)
        end, self.at = self.at, at
        names = [name for name, length, _ in element.properties if not length]
        return {name: np.concatenate([row[name] for row in found]) for name in names if wanted}, end

    def _truncated(self, element: Element) -> InputError:
        return InputError(
            f"{self.path}: truncated or not numeric: expected {element.count} rows of element {element.name}"
        )


class _Binary(_Body):
    def __init__(self, path: Path, body: memoryview, order: str):
        super().__init__(path, order)
        self.body = body

    def lengths(self, element: Element, at: int) -> list[int]:
        """How long the lists of the row at ``at`` are."""
        found = []
        for _, length, kind in element.properties:
            found.append(0)
            if length is not None:
                size = np.dtype(length).itemsize
                if at + size > len(self.body):
                    raise self._truncated(element)
                found[-1] = max(0, int(np.frombuffer(self.body, self.order + length, 1, at)[0]))
                at += size
            at += np.dtype(kind).itemsize * (1 if length is None else found[-1])
        if at > len(self.body):
            raise self._truncated(element)
        return found

    def rows(self, element: Element, lengths: list[int]) -> tuple[dict[str, np.ndarray] | None, int]:
        """The columns, and where they end; None where not all lists are so long."""
        columns, size = [], 0  # of each property: where it begins, and the dtype of its number or of its length
        for (_, length, kind), n in zip(element.properties, lengths, strict=True):
            columns.append((size, np.dtype(self.order + (length or kind))))
            size += columns[-1][1].itemsize + (0 if length is None else n * np.dtype(kind).itemsize)
        end = self.at + element.count * size
        if end > len(self.body):
            if element.has_lists and element.count > 1:
                return None, end
            raise self._truncated(element)
        found = {}
        for (name, length, _), n, (begin, kind) in zip(element.properties, lengths, columns, strict=True):
            column = np.empty(0, kind)
            if element.count:
                column = np.ndarray(element.count, kind, self.body, self.at + begin, (size,))
            if length is None:
                found[name] = column
            elif (column != n).any():
                return None, end
        return found, end


class _Text(_Body):
    def __init__(self, path: Path, body: memoryview, order: str):
        super().__init__(path, order)
        self.body = bytes(body).split()

    def lengths(self, element: Element, at: int) -> list[int]:
        found = []
        for _, length, _ in element.properties:
            found.append(0)
            if length is not None:
                if at >= len(self.body) or not self.body[at].isdigit() or len(self.body[at]) > MAX_DIGITS:
                    raise self._truncated(element)
                found[-1] = int(self.body[at])
            at += 1 + found[-1]
        if at > len(self.body):
            raise self._truncated(element)
        return found

    def rows(self, element: Element, lengths: list[int]) -> tuple[dict[str, np.ndarray] | None, int]:
        width = len(lengths) + sum(lengths)
        end = self.at + element.count * width
        try:
            values = np.array(self.body[self.at : end], dtype=np.float64).reshape(element.count, width)
        except ValueError:
            if element.has_lists and element.count > 1:
                return None, end
            raise self._truncated(element) from None
        found, at = {}, 0
        for (name, length, kind), n in zip(element.properties, lengths, strict=True):
            column = values[:, at]
            if length is None:
                found[name] = self._typed(column, kind, element)
            elif (column != n).any():
                return None, end
            at += 1 + n
        return found, end

    def _typed(self, column: np.ndarray, kind: str, element: Element) -> np.ndarray:
        """Whole numbers in their type; others keep the digits of the text."""
        if kind[0] == "f":
            return column
        with np.errstate(invalid="ignore"):
            whole = column.astype(kind)
        if (whole != column).any():
            raise self._truncated(element)
        return whole
