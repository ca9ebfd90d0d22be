"""Bodies from mesh files, with their textures, and the light meshes and convex pieces that collide."""

from __future__ import annotations

from pathlib import Path
from typing import Callable

import numpy as np

from gsim3d.errors import InputError
from gsim3d.generate.shapes import PALETTE, PATTERNS, Body, normalise

COLLISION_VERTICES = 300  # a mesh file is clustered to at most about so many vertices for contacts
NEARLY_CONVEX = 0.06  # of the body's size: hollows that are no deeper are filled by the hull that collides
SLAB_CELLS = 4  # along the longest side of a body's box; hollows of a quarter of the body stay hollow
SLAB_THICKNESS = 0.04  # of the body's size


def cluster(vertices: np.ndarray, faces: np.ndarray, limit: int) -> tuple[np.ndarray, np.ndarray]:
    """Merges vertices that share a cell of a grid, the finest that leaves at most ``limit`` of them."""
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


def _texture_lookup(image: np.ndarray) -> Callable[[np.ndarray], np.ndarray]:
    """Bilinear, repeating texture; v counts from the bottom row, as in .obj files."""
    texels = image.astype(np.float64) / 255
    height, width = texels.shape[:2]

    def paint(uv):
        x = (uv[:, 0] % 1) * width - 0.5
        y = (1 - uv[:, 1] % 1) * height - 0.5
        x0, y0 = np.floor(x).astype(np.int64), np.floor(y).astype(np.int64)
        fx, fy = (x - x0)[:, None], (y - y0)[:, None]
        top = texels[y0 % height, x0 % width] * (1 - fx) + texels[y0 % height, (x0 + 1) % width] * fx
        low = texels[(y0 + 1) % height, x0 % width] * (1 - fx) + texels[(y0 + 1) % height, (x0 + 1) % width] * fx
        return top * (1 - fy) + low * fy

    return paint


def load_body(path: str | Path, up: str = "y") -> Body:
    """A body from a mesh file (anything that trimesh reads), with its texture or vertex colours where it has any.

    Args:
        path: mesh file; a texture named by its material must lie beside it.
        up: "y" (usual for .obj and .glb) or "z", the axis that points up in the file.

    Copies of a vertex along texture seams are merged by position; the surface must be closed then.

    Raises InputError when the file cannot be read, or holds no closed surface.
    """
    import trimesh

    path = Path(path)
    if not path.is_file():
        raise InputError(f"mesh {path} is not a file")
    try:
        mesh = trimesh.load(path, force="mesh", process=False)
    except Exception as error:  # trimesh raises whatever its parsers raise
        raise InputError(f"mesh {path} cannot be read: {error}") from error
    vertices, faces = np.asarray(mesh.vertices, dtype=np.float64), np.asarray(mesh.faces, dtype=np.int64)
    if len(faces) < 4 or not np.isfinite(vertices).all():
        raise InputError(f"mesh {path} must be a closed surface with finite vertices; got {len(faces)} faces")
    if up == "y":
        vertices = vertices[:, [0, 2, 1]] * [1, -1, 1]
    centre, diameter = normalise(vertices)
    if not diameter > 0:
        raise InputError(f"mesh {path} has no size: all vertices coincide")
    vertices = (vertices - centre) / diameter
    corners, paint = _mesh_paint(mesh, vertices, faces)
    # One vertex for each position: copies along texture seams would tear the shading and collide twice.
    positions, label = np.unique(vertices, axis=0, return_inverse=True)
    faces = label.reshape(-1)[faces]
    proper = (faces != np.roll(faces, 1, axis=1)).all(1)
    faces, corners = faces[proper], corners[proper]
    _, uses = np.unique(np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1), axis=0, return_counts=True)
    if not len(faces) or (uses % 2).any():
        raise InputError(
            f"mesh {path} is not closed: {int((uses % 2).sum())} edges have a face on one side only, also after "
            "vertices at the same position are merged; fill its holes"
        )
    if np.einsum("fk,fk->", *_corner_and_cross(positions, faces)) < 0:
        faces, corners = faces[:, ::-1], corners[:, ::-1]
    return Body(path.stem, positions, faces, *cluster(positions, faces, COLLISION_VERTICES), corners, paint)


def _corner_and_cross(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Two arrays [F, 3] whose product, summed, is six times the volume that faces turned outwards enclose."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    return a, np.cross(b, c)


def convex_pieces(vertices: np.ndarray, faces: np.ndarray) -> list[np.ndarray]:
    """Vertices of convex bodies that together cover the surface, for engines that collide convex bodies only.

    One piece, the hull, where the body is nearly convex; otherwise a slab of the surface for each cell of a grid.
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
    rows = [np.unique(faces[cell == k]) for k in range(cell.max() + 1)]
    return [np.concatenate([vertices[row], inner[row]]) for row in rows]


def vertex_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Unit normals [V, 3]: the sum of the normals of the faces around each vertex, weighted by their areas."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    face_normals = np.cross(b - a, c - a)
    normals = np.stack(
        [np.bincount(faces.reshape(-1), np.repeat(face_normals[:, k], 3), len(vertices)) for k in range(3)], 1
    )
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    return normals / np.where(length > 0, length, 1)


def _mesh_paint(mesh, vertices, faces):
    visual = mesh.visual
    image = getattr(getattr(visual, "material", None), "image", None)
    if getattr(visual, "uv", None) is not None and image is not None:
        texture = _texture_lookup(np.asarray(image.convert("RGB")))
        return np.asarray(visual.uv, dtype=np.float64)[faces], texture
    if getattr(visual, "kind", None) == "vertex":
        return np.asarray(visual.vertex_colors, dtype=np.float64)[:, :3][faces] / 255, lambda c: c
    colors = PALETTE[[5, 8, 1]]
    return vertices[faces], lambda p: PATTERNS["patches"](p, colors)
