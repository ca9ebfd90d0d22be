"""Embeddings of surfaces: nodes that an engine moves, and surface points bound to them at frame 0."""

from dataclasses import dataclass

import numpy as np

LEAST_WEIGHT = 0.03  # of a node in any vertex, relative to the largest of all nodes
NEWTON_STEPS, MOST_CHANGE = 15, 0.3  # to find a point in a deformed grid, and the largest change in cells
NEIGHBOURS = 12  # particles that a point is bound to; an affine motion needs four in general position


@dataclass(frozen=True)
class Binding:
    """Points as weighted sums of nodes."""

    corners: np.ndarray  #: int64 [N, K], indices of the flattened nodes
    weights: np.ndarray  #: [N, K], rows sum to 1; some are negative for points outside the convex hull of the nodes

    def move(self, nodes: np.ndarray) -> np.ndarray:
        """Points [N, 3] for the positions ``nodes`` [..., 3]."""
        nodes = nodes.reshape(-1, 3)
        points = np.zeros((len(self.corners), 3))
        for corner in range(self.corners.shape[1]):
            points += self.weights[:, corner, None] * nodes[self.corners[:, corner]]
        return points


@dataclass(frozen=True)
class ControlGrid:
    """Control grid of a soft body."""

    #: [T, c+1, c+1, c+1, 3], world coordinates in metres; frame 0 is an axis-aligned box of equal cells
    nodes: np.ndarray
    #: bool [c, c, c], cells with collision vertices whose corners all move with the body. Nodes of other cells are not
    #: simulated.
    occupied: np.ndarray
    vertices: np.ndarray  #: [N, 3], of the body at frame 0

    def bind(self, points: np.ndarray) -> Binding:
        """Binds ``points`` [N, 3] at frame 0 to their nearest occupied cells, by trilinear weights.

        Weights extrapolate outside a cell, so a rigid motion of the grid moves all points rigidly.
        """
        rest = self.nodes[0]
        n = rest.shape[0] - 1
        low, high = rest[0, 0, 0], rest[-1, -1, -1]
        position = (points - low) / (high - low) * n
        cells = np.argwhere(self.occupied)
        outside = np.maximum(np.abs(position[:, None] - (cells[None] + 0.5)) - 0.5, 0)
        return _trilinear(position, cells[(outside**2).sum(-1).argmin(1)], n)


def bind_deformed(nodes: np.ndarray, points: np.ndarray) -> Binding:
    """Binds ``points`` [N, 3] to the nearest cells of a deformed control grid [c+1, c+1, c+1, 3], by trilinear weights:
    Newton's method, from affine motions of the nodes around."""
    n, flat = nodes.shape[0] - 1, nodes.reshape(-1, 3)
    indices = np.argwhere(np.ones(nodes.shape[:-1])).astype(np.float64)
    position = ParticleCloud(flat[None]).bind(points).move(indices)
    for _ in range(NEWTON_STEPS):
        cell = np.clip(np.floor(position), 0, n - 1).astype(np.int64)
        axes = [_trilinear(position + step, cell, n).move(flat) for step in (*np.eye(3), *-np.eye(3))]
        jacobian = np.stack([(axes[a] - axes[a + 3]) / 2 for a in range(3)], 2)  # exact: linear along each axis
        change = np.einsum("nij,nj->ni", np.linalg.pinv(jacobian), points - _trilinear(position, cell, n).move(flat))
        position += change * np.minimum(1, MOST_CHANGE / np.linalg.norm(change, axis=1, keepdims=True).clip(1e-9))
    return _trilinear(position, np.clip(np.floor(position), 0, n - 1).astype(np.int64), n)


def _trilinear(position: np.ndarray, cell: np.ndarray, n: int) -> Binding:
    """Binds ``position`` [N, 3] in cells to the corners of ``cell`` [N, 3], of n along each axis."""
    part = position - cell
    corners, weights = [], []
    for step in np.ndindex(2, 2, 2):
        corner = cell + np.array(step)
        corners.append((corner[:, 0] * (n + 1) + corner[:, 1]) * (n + 1) + corner[:, 2])
        weights.append(np.where(np.array(step) == 1, part, 1 - part).prod(1))
    return Binding(np.stack(corners, 1), np.stack(weights, 1))


@dataclass(frozen=True)
class RigidFrame:
    """Axes of a rigid body."""

    nodes: np.ndarray  #: [T, 4, 3], origin and tips of the three unit axes, world coordinates in metres

    def bind(self, points: np.ndarray) -> Binding:
        """Binds ``points`` [N, 3] at frame 0 to the axes."""
        axes = self.nodes[0, 1:] - self.nodes[0, 0]
        local = ((points - self.nodes[0, 0])[:, None] * axes).sum(-1)
        corners = np.broadcast_to(np.arange(4), (len(points), 4))
        return Binding(corners, np.concatenate([1 - local.sum(1, keepdims=True), local], 1))


@dataclass(frozen=True)
class ClothGrid:
    """Grid of a cloth."""

    nodes: np.ndarray  #: square grid [T, n, n, 3], world coordinates in metres

    def refine(self, times: int) -> Binding:
        """Binds a grid that is ``times`` finer, by Catmull-Rom interpolation along both axes; row-major points."""
        n = self.nodes.shape[1]
        weights = _catmull_rom(n, times)
        m = len(weights)
        dense = np.einsum("ia,jb->ijab", weights, weights).reshape(m * m, n * n)
        corners = np.argsort(dense == 0, axis=1, kind="stable")[:, : int((dense != 0).sum(1).max())]
        return Binding(corners, np.take_along_axis(dense, corners, 1))


def _catmull_rom(n: int, times: int) -> np.ndarray:
    """Catmull-Rom weights [(n - 1) * times + 1, n] for n uniform knots, with linear extrapolation at the ends."""
    position = np.arange((n - 1) * times + 1) / times
    first = np.minimum(position.astype(np.int64), n - 2)
    t = position - first
    basis = np.stack(
        [(-t + 2 * t**2 - t**3) / 2, (2 - 5 * t**2 + 3 * t**3) / 2, (t + 4 * t**2 - 3 * t**3) / 2, (t**3 - t**2) / 2], 1
    )
    padded = np.zeros((len(position), n + 2))
    np.put_along_axis(padded, first[:, None] + np.arange(4), basis, 1)
    weights = padded[:, 1:-1].copy()
    weights[:, :2] += padded[:, :1] * [2, -1]
    weights[:, -2:] += padded[:, -1:] * [-1, 2]
    return weights


def grid_faces(n: int) -> np.ndarray:
    """Triangles [2 (n-1)^2, 3] of a grid of n x n vertices, facing +z if rows run along x and columns along y."""
    i, j = (a.reshape(-1) for a in np.meshgrid(np.arange(n - 1), np.arange(n - 1), indexing="ij"))
    a, b, c, d = i * n + j, (i + 1) * n + j, (i + 1) * n + j + 1, i * n + j + 1
    return np.stack([np.stack([a, b, c], 1), np.stack([a, c, d], 1)], 1).reshape(-1, 3)


@dataclass(frozen=True)
class ParticleCloud:
    """Particles of a body."""

    nodes: np.ndarray  #: [T, P, 3], world coordinates in metres

    def bind(self, points: np.ndarray) -> Binding:
        """Binds ``points`` [N, 3] at frame 0 to their nearest particles.

        The weights decrease with distance, and reproduce affine motions exactly.
        """
        rest = self.nodes[0]
        count = min(NEIGHBOURS, len(rest))
        corners = np.stack([_nearest(rest, point, count) for point in points])
        arms = rest[corners] - points[:, None]
        near = 1 / ((arms**2).sum(-1) + 1e-12 + (arms**2).sum(-1).mean(1, keepdims=True) / count)
        design = np.concatenate([np.ones((*arms.shape[:2], 1)), arms], 2)
        # Weights of smallest distance-weighted norm that sum to 1 and reproduce the point.
        normal = np.einsum("nki,nk,nkj->nij", design, near, design)
        multiplier = np.einsum("nij,j->ni", np.linalg.pinv(normal, hermitian=True), [1.0, 0, 0, 0])
        return Binding(corners, near * np.einsum("nki,ni->nk", design, multiplier))


Embedding = ControlGrid | RigidFrame | ClothGrid | ParticleCloud


def states(embedding: Embedding) -> np.ndarray:
    """Nodes as float32; control grid nodes with little weight in all vertices, which may fall, follow the others."""
    nodes = embedding.nodes.astype(np.float32)
    if isinstance(embedding, ControlGrid):
        binding, most = embedding.bind(embedding.vertices), np.zeros(nodes[0, ..., 0].shape)
        np.maximum.at(most.reshape(-1), binding.corners, binding.weights)
        held = most >= LEAST_WEIGHT * most.max()
        if not held.all():
            loose = ParticleCloud(embedding.nodes[:, held]).bind(embedding.nodes[0, ~held])
            nodes[:, ~held] = [loose.move(step) for step in embedding.nodes[:, held]]
    return nodes


def _nearest(nodes: np.ndarray, point: np.ndarray, count: int) -> np.ndarray:
    distance = ((nodes - point) ** 2).sum(1)
    return np.sort(np.argpartition(distance, count - 1)[:count])
