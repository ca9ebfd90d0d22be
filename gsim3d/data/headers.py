"""Parsers of PNG, JPEG, WebP and TIFF headers, so that size and integrity are checked before decoding."""

import struct
from dataclasses import dataclass

PNG_START, JPEG_START = b"\x89PNG\r\n\x1a\n", b"\xff\xd8"
TIFF_STARTS = {b"II*\0": "<", b"MM\0*": ">"}
TIFF_TYPES = {1: "B", 3: "H", 4: "I"}  # struct formats of the types that the tags below use: byte, short, long
WIDTH, HEIGHT, PHOTOMETRIC, STRIPS, SAMPLES, STRIP_BYTES, TILES, TILE_BYTES = 256, 257, 262, 273, 277, 279, 324, 325
ORIENTATION, EXTRA_SAMPLES = 274, 338
READ_PHOTOMETRIC = (1, 2, 3, 6)  # supported: grey, RGB, palette, YCbCr; unsupported: white-is-zero, CMYK
MAX_TAGS, MAX_VALUES = 1000, 1 << 20


@dataclass(frozen=True)
class Header:
    """Header of an image file."""

    size: tuple[int, int]  #: (width, height) in pixels
    whole: bool  #: whether the file is complete (not truncated)
    alpha: bool = False  #: whether the image has an alpha channel or transparent colour
    refused: str = ""  #: why the image is not supported; "" if it is


def read_header(data: bytes) -> Header | None:
    """Parses the header of an encoded image; returns None if it is not PNG, JPEG, WebP or TIFF."""
    try:
        if data.startswith(PNG_START):
            return _png(data)
        if data.startswith(JPEG_START):
            return _jpeg(data)
        if data[:4] == b"RIFF" and data[8:12] == b"WEBP":
            return _webp(data)
        return _tiff(data, TIFF_STARTS[data[:4]]) if data[:4] in TIFF_STARTS else None
    except (struct.error, IndexError):  # truncated within the header
        return None


def _png(data: bytes) -> Header | None:
    if len(data) < 33 or data[12:16] != b"IHDR":
        return None
    # Checks every chunk length: decoders allocate the length a chunk declares, up to 2 GiB.
    at, alpha, whole, refused = 8, data[25] in (4, 6), False, ""
    while at + 12 <= len(data) and not whole:
        kind = data[at + 4 : at + 8]
        alpha, whole, refused = alpha or kind == b"tRNS", kind == b"IEND", refused or "is animated" * (kind == b"acTL")
        at += 12 + int.from_bytes(data[at : at + 4], "big")
    return Header(struct.unpack_from(">II", data, 16), whole, alpha, refused)


def _jpeg(data: bytes) -> Header | None:
    at, size, refused = 2, None, ""
    while at + 9 < len(data) and data[at] == 0xFF:
        marker = data[at + 1]
        if marker == 0xFF:  # fill byte
            at += 1
            continue
        if marker == 0xDA:  # start of scan; inside a scan 0xFF 0xD9 can only be the end of the image
            return size and Header(size, data.rfind(b"\xff\xd9") > at, refused=refused)
        if 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):
            size = struct.unpack_from(">HH", data, at + 5)[::-1]
            refused = "is CMYK" if data[at + 9] == 4 else ""
        at += 2 + int.from_bytes(data[at + 2 : at + 4], "big")
    return size and Header(size, False)


def _webp(data: bytes) -> Header | None:
    whole = len(data) >= 8 + struct.unpack_from("<I", data, 4)[0]
    kind = data[12:16]
    if kind == b"VP8X":
        width, height = (1 + int.from_bytes(data[at : at + 3], "little") for at in (24, 27))
        return Header((width, height), whole, bool(data[20] & 0x10), "is animated" if data[20] & 0x02 else "")
    if kind == b"VP8L":
        bits = struct.unpack_from("<I", data, 21)[0]
        return Header((1 + (bits & 0x3FFF), 1 + (bits >> 14 & 0x3FFF)), whole, bool(bits >> 28 & 1))
    if kind == b"VP8 ":
        return Header(tuple(side & 0x3FFF for side in struct.unpack_from("<HH", data, 26)), whole)
    return None


def _tiff(data: bytes, order: str) -> Header | None:
    first = struct.unpack_from(order + "I", data, 4)[0]
    n_tags = struct.unpack_from(order + "H", data, first)[0]
    if n_tags > MAX_TAGS:
        return None
    tags: dict[int, tuple] = {}
    for entry in range(first + 2, first + 2 + 12 * n_tags, 12):
        tag, kind, count = struct.unpack_from(order + "HHI", data, entry)
        if kind in TIFF_TYPES and 0 < count <= MAX_VALUES:
            form = f"{order}{count}{TIFF_TYPES[kind]}"
            inline = struct.calcsize(form) <= 4
            tags[tag] = struct.unpack_from(form, data, entry + 8 if inline else _long(data, order, entry + 8))
    if WIDTH not in tags or HEIGHT not in tags:
        return None
    parts = zip(
        tags.get(STRIPS, ()) + tags.get(TILES, ()), tags.get(STRIP_BYTES, ()) + tags.get(TILE_BYTES, ()), strict=False
    )
    ends = [start + length for start, length in parts]
    refused = "" if tags.get(PHOTOMETRIC, (1,))[0] in READ_PHOTOMETRIC else "is inverted or CMYK"
    if tags.get(ORIENTATION, (1,))[0] != 1:
        refused = "is rotated by its orientation tag"
    if _long(data, order, first + 2 + 12 * n_tags):
        refused = "has several pages"
    alpha = EXTRA_SAMPLES in tags or tags.get(SAMPLES, (1,))[0] in (2, 4)
    return Header((tags[WIDTH][0], tags[HEIGHT][0]), bool(ends) and max(ends) <= len(data), alpha, refused)


def _long(data: bytes, order: str, at: int) -> int:
    return struct.unpack_from(order + "I", data, at)[0]
