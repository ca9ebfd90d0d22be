"""Bodies from mesh files with textures, and their collision meshes and convex pieces."""

from functools import partial
from pathlib import Path

import numpy as np

from gsim3d.errors import InputError
from gsim3d.synth.mesh_files import Piece, joined_paint, read_pieces
from gsim3d.synth.shapes import PALETTE, PATTERNS, Body, normalise

MAX_FOLDED, FLAT = 1e-3, 1e-9  # largest share of the area in folded faces, and 1 - cosine between their planes
COLLISION_VERTICES = 300  # approximate largest number of vertices of a collision mesh
NEARLY_CONVEX = 0.06  # depth of concavities, over the body's size, below which the convex hull collides
SLAB_CELLS = 4  # cells along the longest side of a concave body, each with its own convex piece
SLAB_THICKNESS = 0.04  # over the body's size


def cluster(vertices: np.ndarray, faces: np.ndarray, limit: int) -> tuple[np.ndarray, np.ndarray]:
    """Merges vertices in the same cell of the finest grid that leaves at most ``limit`` vertices."""
    for n_cells in range(64, 1, -2):
        cells = np.floor((vertices + 0.5) * n_cells).astype(np.int64)
        _, first, label = np.unique(cells, axis=0, return_index=True, return_inverse=True)
        label = label.reshape(-1)
        if len(first) <= limit:
            break
    count = np.bincount(label)
    merged = np.stack([np.bincount(label, vertices[:, a]) / count for a in range(3)], 1)
    light = label[faces]
    proper = (light[:, 0] != light[:, 1]) & (light[:, 1] != light[:, 2]) & (light[:, 2] != light[:, 0])
    light = light[proper]
    used, light = np.unique(light, return_inverse=True)
    return merged[used], light.reshape(-1, 3)


def load_body(path: str | Path, up: str = "y", *, fill_holes: bool = False) -> Body:
    """Loads all objects of a mesh file with textures and colours (:data:`gsim3d.synth.mesh_files.SUFFIXES`).

    Parts without colours get a pattern. Copies of a vertex along texture seams are merged by position; the surface
    must then be closed.

    Args:
        path: mesh file, with its material files and textures in the same folder.
        up: axis that points up in the file: "y" (usual for .obj and .glb) or "z".
        fill_holes: closes each hole by a fan of triangles around its center.

    Raises:
        InputError: the file cannot be read, the surface is not closed or has duplicate faces, or colours are lost.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f"mesh {path} is not a file")
    pieces = read_pieces(path)
    triangles = np.concatenate([piece.triangles for piece in pieces] or [np.zeros((0, 3, 3))])
    if len(triangles) < 4 or not np.isfinite(triangles).all():
        raise InputError(f"mesh {path} must be a closed surface with finite vertices; got {len(triangles)} faces")
    if up == "y":
        triangles = triangles[:, :, [0, 2, 1]] * [1, -1, 1]
    centre, diameter = normalise(triangles.reshape(-1, 3))
    if not diameter > 0:
        raise InputError(f"mesh {path} has zero size: all vertices coincide")
    triangles = (triangles - centre) / diameter
    corners, paint = joined_paint(_with_patterns(pieces, triangles))
    # One vertex for each position: copies along texture seams would break smooth shading and collide twice.
    positions, label = np.unique(triangles.reshape(-1, 3), axis=0, return_inverse=True)
    faces = label.reshape(-1, 3)
    proper = (faces != np.roll(faces, 1, axis=1)).all(1)
    faces, corners = faces[proper], corners[proper]
    if fill_holes:
        positions, faces, corners = _filled(positions, faces, corners)
    _, uses = np.unique(np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1), axis=0, return_counts=True)
    if not len(faces) or (uses % 2).any():
        raise InputError(
            f"mesh {path} is not closed: {int((uses % 2).sum())} edges have a face on one side only; fill its holes"
        )
    n_different = len(np.unique(np.sort(faces, axis=1), axis=0))
    if n_different < len(faces):
        raise InputError(f"mesh {path} has {len(faces) - n_different} duplicate faces; remove them")
    if _folded(positions, faces) > MAX_FOLDED:
        what = "as of concave polygons (triangulate it) or doubled faces (remove them)"
        raise InputError(f"mesh {path} has faces that fold back onto others, {what}")
    inwards = _turned_inwards(positions, faces)
    faces[inwards], corners[inwards] = faces[inwards, ::-1], corners[inwards, ::-1]
    return Body(path.stem, positions, faces, *cluster(positions, faces, COLLISION_VERTICES), corners, paint)


def _with_patterns(pieces: list[Piece], triangles: np.ndarray) -> list[Piece]:
    """Gives pieces without colours a pattern, a function of the positions ``triangles``."""
    parts = np.split(triangles, np.cumsum([len(piece.triangles) for piece in pieces])[:-1])
    pattern = partial(PATTERNS["patches"], colors=PALETTE[[5, 8, 1]])
    return [
        Piece(piece.triangles, part, pattern) if piece.paint is None else piece
        for piece, part in zip(pieces, parts, strict=True)
    ]


def _filled(positions: np.ndarray, faces: np.ndarray, corners: np.ndarray) -> tuple[np.ndarray, ...]:
    """Closes holes, loops of edges with a single face, by fans. Returns positions, faces and corners."""
    sides = [[0, 1], [1, 2], [2, 0]]
    edges, ends = faces[:, sides].reshape(-1, 2), corners[:, sides].reshape(-1, 2, corners.shape[2])
    _, label, uses = np.unique(np.sort(edges, axis=1), axis=0, return_inverse=True, return_counts=True)
    border = uses[label.reshape(-1)] == 1
    edges, ends = edges[border], ends[border]
    hole, middle = np.unique(_components(len(positions), edges)[edges[:, 0]], return_inverse=True)
    count = np.maximum(np.bincount(middle, minlength=len(hole)), 1)[:, None]
    middles = np.stack([np.bincount(middle, positions[edges[:, 0], k], len(hole)) for k in range(3)], 1) / count
    fans = np.stack([edges[:, 1], edges[:, 0], len(positions) + middle], 1)
    fan_corners = np.stack([ends[:, 1], ends[:, 0], ends.mean(1)], 1)
    return (
        np.concatenate([positions, middles]), np.concatenate([faces, fans]), np.concatenate([corners, fan_corners])
    )  # fmt: skip


def _components(n: int, cells: np.ndarray) -> np.ndarray:
    """Connected components of n vertices: lowest connected vertex, int [n]. ``cells`` [C, K] connect K vertices."""
    label, before = np.arange(n), None
    while before is None or (label != before).any():
        before = label.copy()
        np.minimum.at(label, cells, label[cells].min(1)[:, None])
        label = label[label]
    return label


def _folded(positions: np.ndarray, faces: np.ndarray) -> float:
    """Share of the area in faces that lie in the plane of a neighbour, on the same side of the common edge."""
    a, b, c = (positions[faces[:, k]] for k in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    edges = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    far = positions[(faces.sum(1).repeat(3) - edges.sum(1))]  # corner opposite of the edge
    start, along = positions[edges[:, 0]], positions[edges[:, 1]] - positions[edges[:, 0]]
    length = np.maximum((along**2).sum(1), np.finfo(float).tiny)
    away = far - start - ((far - start) * along).sum(1)[:, None] / length[:, None] * along
    away /= np.maximum(np.linalg.norm(away, axis=1, keepdims=True), np.finfo(float).tiny)
    order = np.lexsort(edges.T)
    pairs = np.concatenate([np.stack([order[:-k], order[k:]], 1) for k in (1, 2, 3)])  # of up to four faces at an edge
    first, second = pairs[(edges[pairs[:, 0]] == edges[pairs[:, 1]]).all(1)].T
    folded = (away[first] * away[second]).sum(1) > 1 - FLAT
    return float(area[np.unique(np.concatenate([first[folded], second[folded]]) // 3)].sum() / area.sum())


def _turned_inwards(positions: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """bool [F], faces of parts that are inside out; a cavity is oriented with its body."""
    bodies, body = np.unique(_components(len(positions), faces)[faces[:, 0]], return_inverse=True)
    volume = np.bincount(body, _volumes(positions, faces), len(bodies))
    inverted = volume.sum() < 0
    low, high = np.full((len(bodies), 3), np.inf), np.full((len(bodies), 3), -np.inf)
    np.minimum.at(low, body, positions[faces].min(1))
    np.maximum.at(high, body, positions[faces].max(1))
    turned = np.full(len(bodies), inverted)
    for k in np.flatnonzero(volume < 0 if not inverted else volume > 0):
        if ((low <= low[k]) & (high >= high[k])).all(1).sum() == 1:  # not inside another part
            turned[k] = not inverted
    return turned[body]


def _volumes(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Signed volumes [F] of the tetrahedra of faces and origin, times six."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    return (a * np.cross(b, c)).sum(1)


def enclosed_volume(vertices: np.ndarray, faces: np.ndarray) -> float:
    """Signed volume of a closed surface; negative if its faces point inwards."""
    return float(_volumes(vertices, faces).sum()) / 6


def convex_pieces(vertices: np.ndarray, faces: np.ndarray) -> list[np.ndarray]:
    """Vertices of convex pieces that cover the surface, for engines with convex collision shapes.

    One piece, the hull, if the body is nearly convex; otherwise a slab of the surface for each cell of a grid.
    """
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    normals = np.cross(b - a, c - a)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    size = float(np.ptp(vertices, axis=0).max())
    above = (normals[:, None] * vertices[None]).sum(-1).max(1) - (normals * a).sum(-1)
    if above.max() < NEARLY_CONVEX * size:
        return [vertices]
    inner = vertices - SLAB_THICKNESS * size * vertex_normals(vertices, faces)
    cells = np.floor(((a + b + c) / 3 - vertices.min(0)) / size * SLAB_CELLS).astype(np.int64)
    _, cell = np.unique(cells, axis=0, return_inverse=True)
    cell = cell.reshape(-1)
    chosen = [np.unique(faces[cell == k]) for k in range(cell.max() + 1)]
    return [np.concatenate([vertices[some], inner[some]]) for some in chosen]


def vertex_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Unit vertex normals [V, 3], area-weighted means of the face normals."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    face_normals = np.cross(b - a, c - a)
    normals = np.stack(
        [np.bincount(faces.reshape(-1), np.repeat(face_normals[:, k], 3), len(vertices)) for k in range(3)], 1
    )
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    return normals / np.where(length > 0, length, 1)
