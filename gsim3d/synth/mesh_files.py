"""Readers of mesh files: triangles and colours of all objects and materials, without silent losses.

OBJ files are parsed here, since trimesh silently drops materials, colours and lines that it does not support.
"""

import io
import re
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from gsim3d.errors import InputError
from gsim3d.io.files import read_file

SUFFIXES = (".glb", ".gltf", ".obj", ".off", ".ply", ".stl")
MAX_MESH, MAX_TEXTURE = 1 << 28, 1 << 28  # largest file in bytes
SLOTS = 3  # largest number of channels of a corner
CHANGES = ("-s", "-o", "-t", "-mm", "-clamp", "-imfchan")  # options of map_Kd, unless ...
UNCHANGED = re.compile(r"-s( 1(\.0*)?)+|-[ot]( 0(\.0*)?)+|-mm 0 1|-clamp off")
# What trimesh drops, by suffix; glTF files also for what they require.
DROPPED = {
    ".ply": rb"property \w+ (r|(?:diffuse|ambient)_red)\s",
    **dict.fromkeys(
        (".glb", ".gltf"),
        rb'"(KHR_texture_transform|sparse)"|'
        rb'"extensionsRequired"\s*:\s*\[\s*(?:"KHR_(?:materials_\w+|lights_punctual)"[\s,]*)*"(\w+)|'
        rb'"baseColorTexture"\s*:\s*\{[^{}]*"(texCoord)"\s*:\s*[1-9]',
    ),
}


@dataclass(frozen=True)
class Piece:
    """Triangles of one material."""

    triangles: np.ndarray  #: positions [F, 3, 3]
    corners: np.ndarray | None = None  #: input of ``paint`` at the corners of each face [F, 3, C]; None: no colour
    #: function [N, C] -> colours [N, 3] in [0, 1]; None: no colour
    paint: Callable[[np.ndarray], np.ndarray] | None = None


def read_pieces(path: Path) -> list[Piece]:
    """Reads all triangles of a mesh file, one piece for each material. Raises InputError if it cannot be read, or has
    colours of an unsupported kind."""
    if path.suffix.lower() not in SUFFIXES:
        raise InputError(f"mesh {path}: the supported formats are {', '.join(SUFFIXES)}")
    data = read_file(path, MAX_MESH)
    pieces = _read_obj(path, data) if path.suffix.lower() == ".obj" else _read_other(path, data)
    return [piece for piece in pieces if len(piece.triangles)]


def texture_lookup(image: np.ndarray) -> Callable[[np.ndarray], np.ndarray]:
    """Bilinear, repeating texture lookup; v starts at the bottom row, as in OBJ files."""
    return partial(_looked_up, image.astype(np.float64) / 255)


def _looked_up(texels: np.ndarray, uv: np.ndarray) -> np.ndarray:
    height, width = texels.shape[:2]
    x = (uv[:, 0] % 1) * width - 0.5
    y = (1 - uv[:, 1] % 1) * height - 0.5
    x0, y0 = np.floor(x).astype(np.int64), np.floor(y).astype(np.int64)
    fx, fy = (x - x0)[:, None], (y - y0)[:, None]
    top = texels[y0 % height, x0 % width] * (1 - fx) + texels[y0 % height, (x0 + 1) % width] * fx
    low = texels[(y0 + 1) % height, x0 % width] * (1 - fx) + texels[(y0 + 1) % height, (x0 + 1) % width] * fx
    return top * (1 - fy) + low * fy


def joined_paint(pieces: list[Piece]) -> tuple[np.ndarray, Callable[[np.ndarray], np.ndarray]]:
    """Joins the corners [F, 3, C] and paints of all pieces; the first channel of a corner is the index of its piece."""
    if len(pieces) == 1:
        return pieces[0].corners, pieces[0].paint
    widths = [piece.corners.shape[2] for piece in pieces]
    padded = [np.pad(piece.corners, ((0, 0), (0, 0), (1, SLOTS - w))) for piece, w in zip(pieces, widths, strict=True)]
    corners = np.concatenate(padded)
    corners[:, :, 0] = np.repeat(np.arange(len(pieces)), [len(piece.triangles) for piece in pieces])[:, None]

    def paint(values):
        number, colours = np.round(values[:, 0]).astype(np.int64), np.empty((len(values), 3))
        for k in np.unique(number):
            colours[number == k] = pieces[k].paint(values[number == k, 1 : 1 + widths[k]])
        return colours

    return corners, paint


def _constant(triangles: np.ndarray, colour) -> Piece:
    colour = np.clip(np.asarray(colour, dtype=np.float64)[:3], 0, 1)
    return Piece(triangles, np.zeros((len(triangles), 3, 1)), lambda corners: np.tile(colour, (len(corners), 1)))


def _image(data: bytes, what: str) -> np.ndarray:
    """uint8 [H, W, 3]."""
    from PIL import Image

    try:
        return np.asarray(Image.open(io.BytesIO(data)).convert("RGB"))
    except Exception as error:  # PIL raises whatever its decoders raise
        raise InputError(f"{what} cannot be decoded: {' '.join(str(error).split())[:200]}") from None


def _read_obj(path: Path, data: bytes) -> list[Piece]:
    vertices, colours, uvs, libraries = [], [], [], []
    faces: dict[str | None, list] = {}  # material -> corners of triangles: (vertex, uv or -1)
    material = None
    text = data.decode("utf-8-sig", "surrogateescape").replace("\\\n", " ").replace("\\\r\n", " ")
    for number, line in enumerate(text.splitlines(), 1):
        key, rest = (*line.split(None, 1), "", "")[:2]
        words = rest.split("#")[0].split()
        try:
            if key == "v":
                vertices.append([float(x) for x in words[:3]])
                colours.append([float(x) for x in words[3:6]] if len(words) >= 6 else None)
                if len(vertices[-1]) != 3:
                    raise ValueError("a vertex needs three numbers")
            elif key == "vt":
                uvs.append([float(x) for x in (*words, "0")[:2]])
            elif key == "f":
                corners = [_corner(word, len(vertices), len(uvs)) for word in words]
                if len(corners) < 3:
                    raise ValueError("a face needs three corners")
                fan = [(corners[0], corners[i], corners[i + 1]) for i in range(1, len(corners) - 1)]
                faces.setdefault(material, []).extend(fan)
            elif key == "usemtl":
                material = rest.strip()
            elif key == "mtllib":
                libraries.append(rest.strip())
            elif key in ("curv", "curv2", "surf"):
                raise ValueError(f"{key}: free-form geometry is not supported; convert it to polygons")
        except (ValueError, IndexError) as error:
            raise InputError(f"mesh {path} cannot be read: line {number}: {str(error)[:100]}") from None
    materials = _materials(path, libraries) if any(name is not None for name in faces) else {}
    points = np.array(vertices, dtype=np.float64).reshape(-1, 3)
    n_coloured = sum(colour is not None for colour in colours)
    if n_coloured not in (0, len(colours)):
        raise InputError(f"mesh {path}: {n_coloured} of {len(colours)} vertices have colours; give all or none colours")
    pieces = []
    for name, found in faces.items():
        index = np.array(found, dtype=np.int64)  # [F, 3, 2]
        triangles = points[index[..., 0]]
        if len(faces) == len(materials) == 1:
            name = next(iter(materials))  # whatever it is called in the other file
        if name is not None and name not in materials:
            raise InputError(f"mesh {path}: material {name!r} is in none of its material files: {libraries}")
        colour = materials.get(name)
        if isinstance(colour, np.ndarray) and colour.ndim == 3:
            if (index[..., 1] < 0).any():
                raise InputError(f"mesh {path}: faces of material {name!r} have a texture, but no texture coordinates")
            pieces.append(Piece(triangles, np.array(uvs)[index[..., 1]], texture_lookup(colour)))
        elif n_coloured:
            pieces.append(_vertex_colours(triangles, np.array(colours)[index[..., 0]], path))
        elif colour is not None:
            pieces.append(_constant(triangles, colour))
        else:
            pieces.append(Piece(triangles))
    return pieces


def _corner(word: str, n_vertices: int, n_uvs: int) -> tuple[int, int]:
    """Indices of vertex and texture coordinate (-1: none) of "v/vt/vn"; negative numbers count back from the line."""
    parts, found = (word.split("/") + ["", ""])[:2], []
    for part, count in zip(parts, (n_vertices, n_uvs), strict=True):
        number = int(part) if part or not found else 0
        index = number - 1 if number > 0 else count + number
        if part and not 0 <= index < count:
            raise ValueError(f"invalid index {word}: only {count} are defined before")
        found.append(index if part else -1)
    return found[0], found[1]


def _materials(path: Path, libraries: list[str]) -> dict[str, np.ndarray | None]:
    """Name -> texture uint8 [H, W, 3], colour [3], or None for a material with neither."""
    found: dict[str, np.ndarray | None] = {}
    for library in libraries:
        names = [library] if (path.parent / library).is_file() else library.split()
        for name in names:
            file = path.parent / name.replace("\\", "/")
            if not file.is_file():
                raise InputError(f"mesh {path}: its material file {name} is missing")
            found |= _read_mtl(path, file)
    return found


def _read_mtl(path: Path, file: Path) -> dict[str, np.ndarray | None]:
    found, name = {}, None
    for line in read_file(file, MAX_MESH).decode("utf-8-sig", "surrogateescape").splitlines():
        key, rest = (*line.split(None, 1), "", "")[:2]
        rest = re.split(r"(?:^|\s)#", rest)[0]
        key, words = key.lower(), rest.split()
        if key == "newmtl":
            name = rest.strip()
            found[name] = None
        elif key == "kd" and not (isinstance(found.get(name), np.ndarray) and found[name].ndim == 3):
            try:
                found[name] = np.array([float(word) for word in words] * (3 if len(words) == 1 else 1))
            except ValueError:
                found[name] = np.zeros(0)
            if found[name].shape != (3,) or not np.isfinite(found[name]).all():
                raise InputError(f"mesh {path}: Kd of material {name!r} must be three numbers; got {rest[:80]!r}")
        elif key == "map_kd" and words:
            if option := next((word for word in UNCHANGED.sub("", " ".join(words)).split() if word in CHANGES), ""):
                raise InputError(f"mesh {path}: option {option} of map_Kd of material {name!r} is not supported")
            texture = words[-1] if words[0].startswith("-") else rest.strip()
            image = file.parent / texture.replace("\\", "/")
            if not image.is_file():
                raise InputError(f"mesh {path}: texture {texture} of material {name!r} is missing, next to {file.name}")
            found[name] = _image(read_file(image, MAX_TEXTURE), f"mesh {path}: texture {texture}")
    return found


def _vertex_colours(triangles: np.ndarray, colours: np.ndarray, path: Path) -> Piece:
    """Piece with vertex colours [F, 3, 3] in [0, 1], or in [0, 255] if any is above 1."""
    if not (colours >= 0).all() or not (colours <= 255).all():
        raise InputError(f"mesh {path}: vertex colours must be in [0, 1] or in [0, 255]")
    return Piece(triangles, colours / (255 if (colours > 1).any() else 1), lambda corners: corners)


def _read_other(path: Path, data: bytes) -> list[Piece]:
    import trimesh

    kind = path.suffix.lower()
    if kind == ".off" and _has_off_colours(data) or kind == ".stl" and _has_stl_colours(data):
        raise InputError(f"mesh {path} has colours, which are not supported in {kind[1:].upper()}: use PLY or OBJ")
    dropped = re.search(DROPPED.get(kind, rb"(?!)"), data[: 1 << 16] if kind == ".ply" else data)
    if dropped:
        what = next(filter(None, dropped.groups())).decode()
        raise InputError(f"mesh {path} has {what[:80]}, which is not supported: save it without, or as OBJ")
    try:
        scene = trimesh.load_scene(path, process=False)
        nodes = [(scene.graph[node][0], scene.geometry[scene.graph[node][1]]) for node in scene.graph.nodes_geometry]
        pieces = [_of_trimesh(mesh, matrix, path) for matrix, mesh in nodes if isinstance(mesh, trimesh.Trimesh)]
    except InputError:
        raise
    except Exception as error:  # trimesh raises whatever its parsers raise
        raise InputError(f"mesh {path} cannot be read: {' '.join(str(error).split())[:200]}") from error
    if kind == ".ply" and b"TextureFile" in data[:4096] and any(piece.corners is None for piece in pieces):
        raise InputError(f"mesh {path} has a texture that is missing, or has no texture coordinates")
    return pieces


def _has_off_colours(data: bytes) -> bool:
    """Whether an OFF file is a COFF, or a face has numbers after its vertices."""
    lines = [line.split(b"#")[0].split() for line in data.splitlines()]
    lines = [words for words in lines if words]
    if not lines or lines[0][0] != b"OFF":
        return bool(lines) and b"C" in lines[0][0]
    counts = lines[0][1:] or (lines[1] if len(lines) > 1 else [])
    first = 1 if lines[0][1:] else 2
    try:
        n_vertices, n_faces = int(counts[0]), int(counts[1])
        faces = lines[first + n_vertices : first + n_vertices + n_faces]
        return any(len(words) > int(words[0]) + 1 for words in faces)
    except (ValueError, IndexError):
        return False


def _has_stl_colours(data: bytes) -> bool:
    """Whether the header of a binary STL has a colour, or its faces have attributes, which hold colours."""
    is_binary = len(data) > 84 and len(data) % 50 == 34 and not data.startswith(b"solid ")
    attributes = np.frombuffer(data[84:], np.uint8).reshape(-1, 50)[:, 48:] if is_binary else np.zeros(0)
    return b"COLOR=" in data[:80] or bool(attributes.any())


def _of_trimesh(mesh, matrix: np.ndarray, path: Path) -> Piece:
    """Piece of ``mesh`` transformed by ``matrix`` [4, 4]."""
    faces, vertices = np.asarray(mesh.faces, dtype=np.int64), np.asarray(mesh.vertices, dtype=np.float64)
    if not np.array_equal(matrix, np.eye(4)):
        vertices = vertices @ matrix[:3, :3].T + matrix[:3, 3]
    if len(faces) and not 0 <= faces.min() <= faces.max() < len(vertices):
        raise InputError(f"mesh {path} cannot be read: a face has an invalid vertex index")
    triangles = vertices[faces]
    visual = mesh.visual
    if visual.kind == "vertex":
        return Piece(triangles, np.asarray(visual.vertex_colors, dtype=np.float64)[:, :3][faces] / 255, lambda c: c)
    if visual.kind == "face":
        colours = np.asarray(visual.face_colors, dtype=np.float64)[:, None, :3].repeat(3, 1)
        if len(colours) != len(triangles):
            raise InputError(f"mesh {path}: faces with colours must be triangles")
        return Piece(triangles, colours / 255, lambda c: c)
    if visual.kind != "texture":
        return Piece(triangles)
    material = visual.material
    image = getattr(material, "baseColorTexture", None) or getattr(material, "image", None)
    factor = getattr(material, "baseColorFactor", None)
    factor = np.ones(3) if factor is None else np.asarray(factor, dtype=np.float64)[:3] / 255
    colours = visual.vertex_attributes.get("color")
    if image is not None:
        if visual.uv is None:
            raise InputError(f"mesh {path} has a texture, but no texture coordinates")
        if colours is not None:
            raise InputError(f"mesh {path} has a texture and vertex colours; keep one of them")
        lookup = texture_lookup(np.asarray(image.convert("RGB")))
        return Piece(triangles, np.asarray(visual.uv, dtype=np.float64)[faces], lambda uv: factor * lookup(uv))
    if colours is not None:
        colours = np.asarray(colours)
        scale = 255 if colours.dtype == np.uint8 else 65535 if colours.dtype == np.uint16 else 1
        return Piece(triangles, factor * (colours[:, :3].astype(np.float64) / scale)[faces], lambda c: c)
    if not hasattr(material, "baseColorFactor"):
        factor = np.asarray(material.main_color, dtype=np.float64)[:3] / 255
    return _constant(triangles, factor)
