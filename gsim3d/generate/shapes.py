"""Bodies: closed procedural meshes with solid patterns, and textured meshes from files.

A body is centred on its bounding box and scaled to fit a sphere of diameter 1; a scene gives it its size.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Callable

import numpy as np

from gsim3d.errors import InputError

FINE_LEVEL = 4  # icosphere subdivisions of the drawn mesh: 2562 vertices, smooth outlines at 256 pixels
COARSE_LEVEL = 2  # of the mesh that collides: 162 vertices, each a possible contact
TORUS_RINGS = {FINE_LEVEL: (64, 32), COARSE_LEVEL: (20, 9)}  # corners around the hole and around the tube
COLLISION_VERTICES = 300  # a mesh file is clustered to at most about so many vertices for contacts

PALETTE = np.array(
    [
        [0.90, 0.30, 0.24], [0.96, 0.61, 0.17], [0.97, 0.83, 0.27], [0.38, 0.75, 0.36],
        [0.21, 0.66, 0.71], [0.29, 0.48, 0.85], [0.55, 0.39, 0.78], [0.90, 0.47, 0.65], [0.95, 0.93, 0.88],
    ]
)  # fmt: skip


@dataclass(frozen=True)
class Body:
    """A mesh to draw, a light mesh to collide, and the colour of every surface point.

    vertices [V, 3], faces int [F, 3]: drawn.          collision_vertices, collision_faces: simulated.
    corners [F, 3, C]: what is interpolated over a face and given to ``paint`` (texture or rest coordinates).
    paint: [N, C] -> colours [N, 3] in [0, 1].
    """

    name: str
    vertices: np.ndarray
    faces: np.ndarray
    collision_vertices: np.ndarray
    collision_faces: np.ndarray
    corners: np.ndarray
    paint: Callable[[np.ndarray], np.ndarray]


def icosphere(level: int) -> tuple[np.ndarray, np.ndarray]:
    """Unit sphere of 20 * 4^level triangles, all facing outwards."""
    import trimesh

    mesh = trimesh.creation.icosphere(subdivisions=level)
    return np.asarray(mesh.vertices, dtype=np.float64), np.asarray(mesh.faces, dtype=np.int64)


def _radial(radius: Callable[[np.ndarray], np.ndarray]):
    """A surface seen whole from its centre: ``radius`` of every direction."""

    def build(level):
        directions, faces = icosphere(level)
        return directions * radius(directions)[:, None], faces

    return build


def _sphere(d):
    return np.ones(len(d))


def _ellipsoid(d):
    return 1 / np.sqrt((d[:, 0] / 1.0) ** 2 + (d[:, 1] / 0.82) ** 2 + (d[:, 2] / 0.7) ** 2)


def _rounded_box(d):
    return (np.abs(d) ** 6).sum(1) ** (-1 / 6)


def _blob(d):
    x, y, z = d.T
    return 1 + 0.22 * np.sin(3 * x + 1) * np.cos(2.5 * y) + 0.18 * np.sin(4 * z + 2 * x) + 0.1 * np.cos(5 * y - 2 * z)


def _star(d):
    # Bumps towards the corners of a dodecahedron's inscribed cube and its faces: fourteen soft arms.
    arms = [(i, j, k) for i in (-1, 1) for j in (-1, 1) for k in (-1, 1)]
    arms += [(s, 0, 0) for s in (-1, 1)] + [(0, s, 0) for s in (-1, 1)] + [(0, 0, s) for s in (-1, 1)]
    arms = np.array(arms, dtype=np.float64)
    arms /= np.linalg.norm(arms, axis=1, keepdims=True)
    closeness = np.max((d[:, None] * arms[None]).sum(-1), axis=1)
    return 0.72 + 0.42 * np.exp((closeness - 1) * 14)


def _capsule(level):
    directions, faces = icosphere(level)
    # The equator of the sphere is pulled apart into a cylinder: points move along x by a smooth step.
    shift = 0.45 * np.tanh(4 * directions[:, :1])
    return directions * 0.62 + shift * np.array([[1.0, 0, 0]]), faces


def _torus(level):
    n_ring, n_tube = TORUS_RINGS[level]
    a = 2 * np.pi * np.arange(n_ring)[:, None] / n_ring
    b = 2 * np.pi * np.arange(n_tube)[None, :] / n_tube
    reach = 1 + 0.5 * np.cos(b)
    vertices = np.stack([reach * np.cos(a), reach * np.sin(a), np.broadcast_to(0.5 * np.sin(b), (n_ring, n_tube))], -1)
    i, j = np.meshgrid(np.arange(n_ring), np.arange(n_tube), indexing="ij")
    next_i, next_j = (i + 1) % n_ring, (j + 1) % n_tube
    p, q, r, s = i * n_tube + j, next_i * n_tube + j, next_i * n_tube + next_j, i * n_tube + next_j
    faces = np.stack([np.stack([p, q, r], -1), np.stack([p, r, s], -1)], 2).reshape(-1, 3)
    return vertices.reshape(-1, 3), faces


SHAPES = {
    "ball": _radial(_sphere),
    "blob": _radial(_blob),
    "box": _radial(_rounded_box),
    "capsule": _capsule,
    "ellipsoid": _radial(_ellipsoid),
    "star": _radial(_star),
    "torus": _torus,
}


def _stripes(p, colors):
    band = np.floor(p[:, 2] * 6 + 0.35 * np.sin(5 * p[:, 0])).astype(np.int64)
    return colors[band % 3]


def _checker(p, colors):
    cell = np.floor(p * 5 + 0.5).astype(np.int64).sum(1)
    return colors[cell % 2]


def _dots(p, colors):
    offset = p * 4 - np.round(p * 4)
    return np.where((offset**2).sum(1, keepdims=True) < 0.12, colors[1], colors[0])


def _patches(p, colors):
    wave = np.sin(9 * p[:, 0] + 2 * p[:, 1]) + np.sin(8 * p[:, 1] - 3 * p[:, 2]) + np.sin(10 * p[:, 2] + 1)
    return colors[np.digitize(wave, [-0.6, 0.6])]


PATTERNS = {"checker": _checker, "dots": _dots, "patches": _patches, "stripes": _stripes}


def _normalise(vertices: np.ndarray) -> tuple[np.ndarray, float]:
    """Centre [3] of the bounding box of ``vertices``, and the diameter of the sphere around it that holds them."""
    centre = (vertices.min(0) + vertices.max(0)) / 2
    return centre, 2 * float(np.linalg.norm(vertices - centre, axis=1).max())


def procedural_body(name: str, rng: np.random.Generator) -> Body:
    """One of SHAPES, painted with a random solid pattern of three colours."""
    if name not in SHAPES:
        raise InputError(f"object {name!r} is not known; choose from {', '.join(SHAPES)} or give a mesh file")
    vertices, faces = SHAPES[name](FINE_LEVEL)
    light_vertices, light_faces = SHAPES[name](COARSE_LEVEL)
    centre, diameter = _normalise(vertices)
    vertices, light_vertices = (vertices - centre) / diameter, (light_vertices - centre) / diameter
    pattern = PATTERNS[sorted(PATTERNS)[rng.integers(len(PATTERNS))]]
    colors = PALETTE[rng.permutation(len(PALETTE))[:3]]
    return Body(name, vertices, faces, light_vertices, light_faces, vertices[faces], lambda p: pattern(p, colors))


def _cluster(vertices: np.ndarray, faces: np.ndarray, limit: int) -> tuple[np.ndarray, np.ndarray]:
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

    Raises InputError when the file cannot be read, or holds no surface.
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
    centre, diameter = _normalise(vertices)
    if not diameter > 0:
        raise InputError(f"mesh {path} has no size: all vertices coincide")
    vertices = (vertices - centre) / diameter
    corners, paint = _mesh_paint(mesh, vertices, faces)
    # One vertex for each position: copies along texture seams would tear the shading and collide twice.
    positions, label = np.unique(vertices, axis=0, return_inverse=True)
    faces = label.reshape(-1)[faces]
    return Body(path.stem, positions, faces, *_cluster(positions, faces, COLLISION_VERTICES), corners, paint)


def _mesh_paint(mesh, vertices, faces):
    visual = mesh.visual
    image = getattr(getattr(visual, "material", None), "image", None)
    if getattr(visual, "uv", None) is not None and image is not None:
        texture = _texture_lookup(np.asarray(image.convert("RGB")))
        return np.asarray(visual.uv, dtype=np.float64)[faces], texture
    if getattr(visual, "kind", None) == "vertex":
        return np.asarray(visual.vertex_colors, dtype=np.float64)[:, :3][faces] / 255, lambda c: c
    colors = PALETTE[[5, 8, 1]]
    return vertices[faces], lambda p: _patches(p, colors)
