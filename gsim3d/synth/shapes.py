"""Procedural bodies: closed meshes with solid patterns.

The bounding box of a body is centred at the origin, and the body fits a sphere of diameter 1.
"""

import itertools
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np

from gsim3d.errors import InputError

FINE_LEVEL = 4  # icosphere subdivisions of the rendered mesh: 2562 vertices, smooth outlines at 256 pixels
COARSE_LEVEL = 2  # icosphere subdivisions of the collision mesh: 162 vertices
TORUS_RINGS = {FINE_LEVEL: (64, 32), COARSE_LEVEL: (20, 9)}  # vertices around the hole and around the tube
KNOT_RINGS = {FINE_LEVEL: (160, 20), COARSE_LEVEL: (42, 6)}  # vertices along the tube and around it
TURNED_SIDES = {FINE_LEVEL: 64, COARSE_LEVEL: 24}

PALETTE = np.array(
    [
        [0.90, 0.30, 0.24], [0.96, 0.61, 0.17], [0.97, 0.83, 0.27], [0.38, 0.75, 0.36],
        [0.21, 0.66, 0.71], [0.29, 0.48, 0.85], [0.55, 0.39, 0.78], [0.90, 0.47, 0.65], [0.95, 0.93, 0.88],
    ]
)  # fmt: skip


@dataclass(frozen=True)
class Body:
    """A rendered mesh, a collision mesh, and the colour of every surface point."""

    name: str  #: name of the shape or file
    vertices: np.ndarray  #: rendered mesh [V, 3]
    faces: np.ndarray  #: rendered mesh, int [F, 3]
    collision_vertices: np.ndarray  #: collision mesh [V', 3]
    collision_faces: np.ndarray  #: collision mesh, int [F', 3]
    corners: np.ndarray  #: input of ``paint`` at the corners of each face [F, 3, C]: texture or rest coordinates
    paint: Callable[[np.ndarray], np.ndarray]  #: function [N, C] -> colours [N, 3] in [0, 1]


def icosphere(level: int) -> tuple[np.ndarray, np.ndarray]:
    """Unit sphere of 20 * 4^level triangles that face outwards."""
    import trimesh

    mesh = trimesh.creation.icosphere(subdivisions=level)
    return np.asarray(mesh.vertices, dtype=np.float64), np.asarray(mesh.faces, dtype=np.int64)


def _radial(radius: Callable[[np.ndarray], np.ndarray]):
    """A star-shaped surface: ``radius`` of every direction."""

    def build(level):
        directions, faces = icosphere(level)
        return directions * radius(directions)[:, None], faces

    return build


def _blob(d):
    x, y, z = d.T
    return 1 + 0.22 * np.sin(3 * x + 1) * np.cos(2.5 * y) + 0.18 * np.sin(4 * z + 2 * x) + 0.1 * np.cos(5 * y - 2 * z)


def _star(d):
    # Fourteen soft arms towards the corners and faces of a cube.
    arms = np.array([*itertools.product((-1.0, 1.0), repeat=3), *np.eye(3), *-np.eye(3)])
    arms /= np.linalg.norm(arms, axis=1, keepdims=True)
    closeness = np.max((d[:, None] * arms[None]).sum(-1), axis=1)
    return 0.72 + 0.42 * np.exp((closeness - 1) * 14)


def _capsule(level):
    directions, faces = icosphere(level)
    # Stretches a sphere at its equator: a smooth step along x.
    shift = 0.45 * np.tanh(4 * directions[:, :1])
    return directions * 0.62 + shift * np.array([[1.0, 0, 0]]), faces


def _torus(level):
    n_ring, n_tube = TORUS_RINGS[level]
    a = 2 * np.pi * np.arange(n_ring)[:, None] / n_ring
    b = 2 * np.pi * np.arange(n_tube)[None, :] / n_tube
    reach = 1 + 0.5 * np.cos(b)
    vertices = np.stack([reach * np.cos(a), reach * np.sin(a), np.broadcast_to(0.5 * np.sin(b), (n_ring, n_tube))], -1)
    return vertices.reshape(-1, 3), _tube_faces(n_ring, n_tube)


def _pyramid(d):
    # A tetrahedron with rounded edges: soft minimum over four planes.
    planes = np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]]) / np.sqrt(3)
    return (np.maximum((d[:, None] * planes).sum(-1), 0) ** 7).sum(1) ** (-1 / 7)


def _dumbbell(level):
    directions, faces = icosphere(level)
    along = directions[:, :1]
    return np.concatenate([1.35 * along, directions[:, 1:] * (0.36 + 0.62 * along**2)], 1), faces


def _knot(level):
    """A tube along a trefoil knot."""
    n_ring, n_tube = KNOT_RINGS[level]
    t = 2 * np.pi * np.arange(n_ring)[:, None] / n_ring
    line = np.concatenate([np.sin(t) + 2 * np.sin(2 * t), np.cos(t) - 2 * np.cos(2 * t), -1.4 * np.sin(3 * t)], 1)
    ahead = np.concatenate([np.cos(t) + 4 * np.cos(2 * t), -np.sin(t) + 4 * np.sin(2 * t), -4.2 * np.cos(3 * t)], 1)
    bend = np.concatenate([-np.sin(t) - 8 * np.sin(2 * t), -np.cos(t) + 8 * np.cos(2 * t), 12.6 * np.sin(3 * t)], 1)
    side = np.cross(ahead, bend)
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    other = np.cross(side, ahead)
    other /= np.linalg.norm(other, axis=1, keepdims=True)
    around = 2 * np.pi * np.arange(n_tube) / n_tube
    offsets = np.cos(around)[:, None] * side[:, None] + np.sin(around)[:, None] * other[:, None]
    return (line[:, None] + 0.72 * offsets).reshape(-1, 3), _tube_faces(n_ring, n_tube)


def _turned(corners: list[tuple[float, float]]):
    """A surface of revolution about z with sharp edges; ``corners`` are (radius, height) from top to bottom."""

    def build(level):
        n = TURNED_SIDES[level]
        angle = 2 * np.pi * np.arange(n) / n
        circle = np.stack([np.cos(angle), np.sin(angle)], 1)
        rings = [np.concatenate([r * circle, np.full((n, 1), z)], 1) for r, z in corners if r]
        top, bottom = ([0.0, 0.0, corners[k][1]] for k in (0, -1))
        vertices = np.concatenate([*rings, [top, bottom]])
        i, j = np.arange(n), (np.arange(n) + 1) % n
        first, last = len(vertices) - 2, len(vertices) - 1
        faces = [np.stack([np.full(n, first), i, j], 1)]
        for ring in range(len(rings) - 1):
            a, b = ring * n, (ring + 1) * n
            faces += [np.stack([a + i, b + i, b + j], 1), np.stack([a + i, b + j, a + j], 1)]
        a = (len(rings) - 1) * n
        faces.append(np.stack([a + j, a + i, np.full(n, last)], 1))
        faces = np.concatenate(faces)
        if level == FINE_LEVEL:  # separate vertices for each face give sharp edges
            return vertices[faces].reshape(-1, 3), np.arange(faces.size).reshape(-1, 3)
        return vertices, faces

    return build


def _tube_faces(n_ring: int, n_tube: int) -> np.ndarray:
    i, j = np.meshgrid(np.arange(n_ring), np.arange(n_tube), indexing="ij")
    next_i, next_j = (i + 1) % n_ring, (j + 1) % n_tube
    p, q, r, s = i * n_tube + j, next_i * n_tube + j, next_i * n_tube + next_j, i * n_tube + next_j
    return np.stack([np.stack([p, q, r], -1), np.stack([p, r, s], -1)], 2).reshape(-1, 3)


SHAPES = {
    "ball": _radial(lambda d: np.ones(len(d))),
    "blob": _radial(_blob),
    "box": _radial(lambda d: (np.abs(d) ** 6).sum(1) ** (-1 / 6)),
    "capsule": _capsule,
    "ellipsoid": _radial(lambda d: 1 / np.sqrt((d[:, 0] / 1.0) ** 2 + (d[:, 1] / 0.82) ** 2 + (d[:, 2] / 0.7) ** 2)),
    "star": _radial(_star),
    "torus": _torus,
    "cone": _turned([(0.0, 0.6), (0.62, -0.5)]),
    "cylinder": _turned([(0.0, 0.55), (0.5, 0.55), (0.5, -0.55), (0.0, -0.55)]),
    "cross": _radial(lambda d: 0.52 + 0.62 * np.exp((np.abs(d).max(1) - 1) * 9)),  # six arms along the axes
    "dumbbell": _dumbbell,
    "knot": _knot,
    "pyramid": _radial(_pyramid),
}
SOFT_SHAPES = ("ball", "blob", "box", "capsule", "ellipsoid", "star", "torus")
RIGID_SHAPES = (*SOFT_SHAPES, "cone", "cylinder")


def _stripes(p, colors):
    band = np.floor(p[:, 2] * 6 + 0.35 * np.sin(5 * p[:, 0])).astype(np.int64)
    return colors[band % 3]


def _dots(p, colors):
    offset = p * 4 - np.round(p * 4)
    return np.where((offset**2).sum(1, keepdims=True) < 0.12, colors[1], colors[0])


def _patches(p, colors):
    wave = np.sin(9 * p[:, 0] + 2 * p[:, 1]) + np.sin(8 * p[:, 1] - 3 * p[:, 2]) + np.sin(10 * p[:, 2] + 1)
    return colors[np.digitize(wave, [-0.6, 0.6])]


def _checker(p, colors):
    return colors[np.floor(p * 5 + 0.5).astype(np.int64).sum(1) % 2]


PATTERNS = {"checker": _checker, "dots": _dots, "patches": _patches, "stripes": _stripes}


def normalise(vertices: np.ndarray) -> tuple[np.ndarray, float]:
    """Center [3] of the bounding box of ``vertices``, and diameter of the enclosing sphere around it."""
    centre = (vertices.min(0) + vertices.max(0)) / 2
    return centre, 2 * float(np.linalg.norm(vertices - centre, axis=1).max())


def procedural_body(name: str, rng: np.random.Generator) -> Body:
    """A body of SHAPES with a random solid pattern of three colours."""
    if name not in SHAPES:
        raise InputError(f"object {name!r} is not known; choose from {', '.join(SHAPES)}")
    vertices, faces = SHAPES[name](FINE_LEVEL)
    light_vertices, light_faces = SHAPES[name](COARSE_LEVEL)
    centre, diameter = normalise(vertices)
    vertices, light_vertices = (vertices - centre) / diameter, (light_vertices - centre) / diameter
    return Body(name, vertices, faces, light_vertices, light_faces, vertices[faces], random_paint(rng))


def random_paint(rng: np.random.Generator) -> Callable[[np.ndarray], np.ndarray]:
    """Random pattern of three colours, as a function from points [N, 3] of a unit body to colours [N, 3]."""
    pattern = PATTERNS[sorted(PATTERNS)[rng.integers(len(PATTERNS))]]
    colors = PALETTE[rng.permutation(len(PALETTE))[:3]]
    return partial(pattern, colors=colors)
