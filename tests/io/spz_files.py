"""Files in version 4 of .spz, which the package reads and does not write."""

import struct

SIZES = (9, 1, 3, 3, 4)  # bytes a Gaussian of positions, opacities, colours, scales and rotations
HARMONICS = (0, 9, 24, 45)  # by degree


def spz_4(content: bytes, n_streams: int | None = None, extension: bytes = b"") -> bytes:
    """Version 4 of the unpacked ``content`` of a file in version 3; ``n_streams`` is what its header says."""
    import zstandard

    count, degree = struct.unpack_from("<I", content, 8)[0], content[12]
    begin, parts = 16, []
    for size in (*SIZES, HARMONICS[degree])[: 6 if degree else 5]:
        parts.append(content[begin : begin + count * size])
        begin += count * size
    packed = [zstandard.ZstdCompressor().compress(part) for part in parts]
    head = content[:4] + struct.pack("<I", 4) + content[8:15]
    head += struct.pack("<BI", len(parts) if n_streams is None else n_streams, 32 + len(extension))
    head += bytes(12) + extension
    table = b"".join(struct.pack("<QQ", len(p), len(part)) for p, part in zip(packed, parts, strict=True))
    return head + table + b"".join(packed)
