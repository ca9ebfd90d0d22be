""".glb: glTF 2.0 with KHR_gaussian_splatting, float32, one frame.

Positions keep their axes; the node turns z up to glTF's y up, so that no number is changed.
"""

import json
import struct
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from gsim3d.errors import InputError
from gsim3d.io.arrays import Z_TO_Y_UP, Splats, colors_of, joined, placed, read_bytes, turn_matrix, unorm
from gsim3d.io.files import write_whole

EXTENSION = "KHR_gaussian_splatting"
MAGIC, JSON_CHUNK, BIN_CHUNK = 0x46546C67, 0x4E4F534A, 0x004E4942
FLOAT, UBYTE, POINTS = 5126, 5121, 0
MOST_JSON = 2**26  # bytes
DEGREES, MAX_NODES = 4, 1000


def write(path: Path, splats: Splats) -> None:
    """Writes ``splats`` without loss; COLOR_0 holds degree 0 for viewers without the extension."""
    if not splats.count:
        raise InputError(f"{path}: a glTF accessor needs one Gaussian at least; there is none")
    quats = splats.quats[:, [1, 2, 3, 0]]
    columns = {"POSITION": splats.means, f"{EXTENSION}:ROTATION": quats, f"{EXTENSION}:SCALE": splats.scales}
    columns |= {f"{EXTENSION}:OPACITY": splats.opacities[:, None]}
    columns |= {_coefficient(k): splats.sh[:, k] for k in range(splats.sh.shape[1])}
    colors = np.concatenate([unorm(colors_of(splats), 8), unorm(splats.opacities, 8)[:, None]], 1)
    columns["COLOR_0"] = colors.astype(np.uint8)
    views, accessors, attributes, parts, begin = [], [], {}, [], 0
    for name, values in columns.items():
        is_float = values.dtype != np.uint8
        data = np.ascontiguousarray(values, "<f4" if is_float else "u1").tobytes()
        views.append({"buffer": 0, "byteOffset": begin, "byteLength": len(data), "target": 34962})
        attributes[name] = len(accessors)
        kind = "SCALAR" if values.shape[1] == 1 else f"VEC{values.shape[1]}"
        accessor = {"bufferView": len(accessors), "count": splats.count, "type": kind}
        accessor |= {"componentType": FLOAT} if is_float else {"componentType": UBYTE, "normalized": True}
        if name == "POSITION":
            accessor |= {"min": splats.means.min(0).tolist(), "max": splats.means.max(0).tolist()}
        accessors.append(accessor)
        parts.append(data)
        begin += len(data)
    how = {"kernel": "ellipse", "colorSpace": "srgb_rec709_display", "projection": "perspective"}
    how["sortingMethod"] = "cameraDistance"
    primitive, (w, x, y, z) = {"mode": POINTS, "attributes": attributes, "extensions": {EXTENSION: how}}, Z_TO_Y_UP
    document = {"asset": {"version": "2.0", "generator": "gsim3d"}, "extensionsUsed": [EXTENSION], "scene": 0}
    document |= {"scenes": [{"nodes": [0]}], "nodes": [{"mesh": 0, "rotation": [x, y, z, w]}]}
    document |= {"meshes": [{"primitives": [primitive]}], "accessors": accessors, "bufferViews": views}
    document["buffers"] = [{"byteLength": begin}]
    text = json.dumps(document, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    data = b"".join(parts) + b"\0" * (-begin % 4)
    total = 12 + 8 + len(text) + 8 + len(data)
    head = struct.pack("<III", MAGIC, 2, total) + struct.pack("<II", len(text), JSON_CHUNK)
    write_whole(path, head, text, struct.pack("<II", len(data), BIN_CHUNK), data)


def read(path: Path) -> Splats:
    """The Gaussians of all primitives with the extension, placed as the nodes say.

    Raises:
        InputError: the file is damaged, or holds no Gaussians that are read here.
    """
    document, data = _chunks(path, read_bytes(path, b"glTF"))
    try:
        parts = [
            placed(_splats(path, document, data, primitive), matrix, path)
            for matrix, mesh in _meshes(path, document)
            for primitive in mesh["primitives"]
            if EXTENSION in primitive.get("extensions", {})
        ]
    except InputError:
        raise
    except (KeyError, IndexError, TypeError, AttributeError, ValueError) as error:
        raise InputError(f"{path}: damaged, or not as {EXTENSION} says: {str(error)[:100]}") from None
    if not parts:
        raise InputError(f"{path}: no primitive has the extension {EXTENSION}")
    return joined(parts, path)


def _splats(path: Path, document: dict, data: bytes, primitive: dict) -> Splats:
    """The Gaussians of one primitive."""
    how = primitive["extensions"][EXTENSION]
    for key, known in (("kernel", "ellipse"), ("colorSpace", "srgb_rec709_display")):
        if how.get(key, known) != known:
            raise InputError(f"{path}: {key} {str(how[key])[:40]!r} is not supported; only {known}")
    attributes = primitive["attributes"]
    column = {name: _accessor(path, document, data, attributes[name]) for name in attributes if name != "COLOR_0"}
    coefficients = [column[_coefficient(0)]]
    for degree in range(1, DEGREES):
        names = [_coefficient(k) for k in range(degree**2, (degree + 1) ** 2)]
        if names[0] not in column:
            break
        coefficients += [column[name] for name in names]
    quats = column[f"{EXTENSION}:ROTATION"][:, [3, 0, 1, 2]]
    scales, opacities = column[f"{EXTENSION}:SCALE"], column[f"{EXTENSION}:OPACITY"][:, 0]
    splats = Splats(column["POSITION"], quats, scales, opacities, np.stack(coefficients, 1))
    if len({len(value) for value in column.values()}) > 1 or splats.means.shape[1:] != (3,):
        raise InputError(f"{path}: its attributes have different counts")
    return splats


def _meshes(path: Path, document: dict) -> Iterator[tuple[np.ndarray, dict]]:
    """Yields the transform float64 [4, 4] of each node with a mesh, and the mesh."""
    nodes = document.get("nodes", [])
    if len(document.get("scenes", ())) > 1 or len(nodes) > MAX_NODES:
        raise InputError(f"{path}: files of several scenes or of more than {MAX_NODES} nodes are not read")
    below = {child for node in nodes for child in node.get("children", ())}
    left = [(np.eye(4), number) for number in range(len(nodes)) if number not in below]
    for _ in nodes:  # each node has one parent at most
        if not left:
            break
        outer, number = left.pop()
        node = nodes[number]
        matrix = outer @ _matrix(node)
        left += [(matrix, child) for child in node.get("children", ())]
        if "mesh" in node:
            yield matrix, document["meshes"][node["mesh"]]


def _matrix(node: dict) -> np.ndarray:
    """The transform float64 [4, 4] of a node within its parent."""
    if "matrix" in node:
        return np.array(node["matrix"], np.float64).reshape(4, 4).T
    x, y, z, w = map(float, node.get("rotation", (0, 0, 0, 1)))
    if not np.isclose(x * x + y * y + z * z + w * w, 1, atol=1e-3):
        raise ValueError("the rotation of a node is no unit quaternion")
    matrix = np.eye(4)
    matrix[:3, :3] = turn_matrix((w, x, y, z)) * np.array(node.get("scale", (1, 1, 1)), np.float64)
    matrix[:3, 3] = node.get("translation", (0, 0, 0))
    return matrix


def _coefficient(k: int) -> str:
    degree = int(k**0.5)
    return f"{EXTENSION}:SH_DEGREE_{degree}_COEF_{k - degree**2}"


def _chunks(path: Path, content: bytes) -> tuple[dict, bytes]:
    if len(content) < 20 or struct.unpack_from("<II", content) != (MAGIC, 2):
        raise InputError(f"{path}: not a .glb file of glTF 2.0")
    length, kind = struct.unpack_from("<II", content, 12)
    if kind != JSON_CHUNK or length > min(MOST_JSON, len(content) - 20):
        raise InputError(f"{path}: truncated within its JSON chunk")
    try:
        document = json.loads(content[20 : 20 + length])
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: its JSON chunk is damaged: {str(error)[:100]}") from None
    start = 20 + length
    size, kind = struct.unpack_from("<II", content, start) if start + 8 <= len(content) else (0, 0)
    if kind != BIN_CHUNK or start + 8 + size > len(content):
        raise InputError(f"{path}: truncated within its binary chunk")
    return document, content[start + 8 : start + 8 + size]


def _accessor(path: Path, document: dict, data: bytes, index: int) -> np.ndarray:
    """float32 [N, channels]."""
    accessor = document["accessors"][index]
    view = document["bufferViews"][accessor["bufferView"]]
    channels = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[accessor["type"]]
    packed = view.get("byteStride", 4 * channels) == 4 * channels
    if accessor["componentType"] != FLOAT or "sparse" in accessor or not packed:
        raise InputError(f"{path}: attributes must be packed floats to be read here")
    count, begin = accessor["count"], view.get("byteOffset", 0) + accessor.get("byteOffset", 0)
    if not all(type(value) is int and value >= 0 for value in (count, begin)):
        raise InputError(f"{path}: an accessor has a count or an offset that is none")
    if view.get("buffer", 0) != 0 or begin + 4 * channels * count > len(data):
        raise InputError(f"{path}: truncated: an accessor ends behind the file")
    return np.frombuffer(data, "<f4", count * channels, begin).reshape(count, channels)
