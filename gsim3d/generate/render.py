"""Images of a deforming body on a round ground: ray casting with one light, ambient light and a cast shadow.

The ground is an exact disc in the plane z = 0. The body is a triangle mesh in an Embree tree that is built
once a frame and serves all cameras. Static work (the ground's points and colours) is done once a scene.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gsim3d.generate.cameras import Rig, pixel_rays, project

BACKGROUND, GROUND, BODY = 0, 1, 3  # segmentation ids; 3 is every body that may move
AMBIENT = 0.42  # light from the sky on a face that looks up; half of it on a face that looks down
DIFFUSE = 0.68
SHADOW_OFFSET = 2e-3  # metres along the normal, so that a shadow ray does not meet its own face
LIGHT_DIRECTION = np.array([0.36, 0.24, 0.90]) / np.linalg.norm([0.36, 0.24, 0.90])  # towards the light
ACROSS_LIGHT = np.linalg.svd(LIGHT_DIRECTION[None])[2][1:]  # two unit vectors that are at right angles to it
GROUND_COLORS = np.array([[0.80, 0.80, 0.76], [0.36, 0.42, 0.48], [0.62, 0.47, 0.36]])
GROUND_RINGS = 4
GROUND_SECTORS = 12


@dataclass(frozen=True)
class View:
    """Images of all cameras at one frame: rgb uint8 [V, H, W, 3], segmentation and instances uint8 [V, H, W]."""

    rgb: np.ndarray
    segmentation: np.ndarray
    instances: np.ndarray


def ground_color(points: np.ndarray, radius: float) -> np.ndarray:
    """Colour [N, 3] of ground points [N, 3]: rings cut into sectors, with one ring of another colour."""
    reach = np.hypot(points[:, 0], points[:, 1]) / radius * GROUND_RINGS
    ring = np.floor(reach).astype(np.int64)
    sector = np.floor((np.arctan2(points[:, 1], points[:, 0]) / (2 * np.pi) + 1) * GROUND_SECTORS).astype(np.int64)
    sector = np.where(ring == 0, sector // 4, sector)
    dark = (ring + sector) % 2
    return GROUND_COLORS[np.where((ring == GROUND_RINGS - 2) & (dark == 1), 2, dark)]


def vertex_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Unit normals [V, 3]: the sum of the normals of the faces around each vertex, weighted by their areas."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    face_normals = np.cross(b - a, c - a)
    normals = np.stack(
        [np.bincount(faces.reshape(-1), np.repeat(face_normals[:, k], 3), len(vertices)) for k in range(3)], 1
    )
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    return normals / np.where(length > 0, length, 1)


class Renderer:
    """Draws one body on the ground, frame after frame, with all cameras of a rig.

    Args:
        rig: cameras.
        faces [F, 3], corners [F, 3, C], paint: see shapes.Body.
        ground_radius: metres.
        background: (3,) colour in [0, 1] where nothing is hit.
        samples: rays along each side of a pixel (2: four rays a pixel).
    """

    def __init__(self, rig: Rig, faces, corners, paint, *, ground_radius, background, samples=2):
        self.rig, self.faces, self.corners, self.paint = rig, faces, corners, paint
        self.samples = samples
        self.origins, directions = pixel_rays(rig, samples)
        self.directions = directions.astype(np.float32)
        self._draw_ground(directions, ground_radius, np.asarray(background, dtype=np.float64))

    def _draw_ground(self, directions, radius, background):
        """The scene without a body: lit colour and shadowed colour of every ray."""
        height = self.origins[:, 2].reshape(-1, 1, 1, 1)
        down = directions[..., 2]
        distance = np.where(down < 0, -height / np.where(down < 0, down, -1), np.inf)
        reach = np.where(np.isfinite(distance), distance, 0)
        points = self.origins[:, None, None, None] + reach[..., None] * directions
        hit = np.isfinite(distance) & (np.hypot(points[..., 0], points[..., 1]) <= radius)
        self.ground_distance = np.where(hit, distance, np.inf).astype(np.float32)
        self.ground_rays = np.flatnonzero(hit)
        self.ground_points = points[hit]
        self.ground_across = self.ground_points @ ACROSS_LIGHT.T
        albedo = ground_color(self.ground_points, radius)
        self.ground_shadowed = (albedo * AMBIENT).astype(np.float32)
        lit = np.broadcast_to(background, (*hit.shape, 3)).astype(np.float32)
        lit[hit] = albedo * (AMBIENT + DIFFUSE * LIGHT_DIRECTION[2])
        self.base_color = lit.reshape(-1, 3)
        self.base_id = np.where(hit, GROUND, BACKGROUND).astype(np.uint8).reshape(-1)

    def draw(self, vertices: np.ndarray) -> View:
        """Images of the body with its vertices [V, 3] at these places, metres, world."""
        from embreex.mesh_construction import TriangleMesh
        from embreex.rtcore_scene import EmbreeScene

        tree = EmbreeScene(robust=True)
        TriangleMesh(tree, vertices.astype(np.float32), self.faces.astype(np.int32))
        color, ids = self.base_color.copy(), self.base_id.copy()
        self._cast_shadow(tree, vertices, color)
        rays = self._rays_near(vertices)
        origins = np.repeat(self.origins.astype(np.float32), self.directions[0].size // 3, axis=0)[rays]
        directions = self.directions.reshape(-1, 3)[rays]
        hits = tree.run(origins, directions, query="INTERSECT", output=1)
        seen = (hits["primID"] >= 0) & (hits["tfar"] < self.ground_distance.reshape(-1)[rays])
        rays = rays[seen]
        face, u, v = hits["primID"][seen], hits["u"][seen].astype(np.float64), hits["v"][seen].astype(np.float64)
        color[rays] = self._shade(tree, vertices, face, np.stack([1 - u - v, u, v], 1))
        ids[rays] = BODY
        return self._collect(color, ids)

    def _rays_near(self, vertices) -> np.ndarray:
        """Indices of the rays inside the body's bounding rectangle in each image."""
        rig, per_pixel = self.rig, self.samples**2
        pixels, depth = project(vertices, rig.viewmats, rig.Ks)
        rays = []
        for cam in range(rig.n_cams):
            if (depth[cam] <= 0).any():
                low, high = np.zeros(2, dtype=np.int64), np.full(2, rig.size)
            else:
                low = np.clip(np.floor(pixels[cam].min(0)), 0, rig.size).astype(np.int64)
                high = np.clip(np.ceil(pixels[cam].max(0)), 0, rig.size).astype(np.int64)
            y = np.arange(low[1], high[1])
            x = np.arange(low[0], high[0])
            pixel = ((cam * rig.size + y[:, None]) * rig.size + x[None]).reshape(-1)
            rays.append((pixel[:, None] * per_pixel + np.arange(per_pixel)).reshape(-1))
        return np.concatenate(rays)

    def _cast_shadow(self, tree, vertices, color):
        # Only ground points whose way to the light passes the body's bounding sphere can lie in shadow.
        centre = (vertices.min(0) + vertices.max(0)) / 2
        radius = 1.01 * np.linalg.norm(vertices - centre, axis=1).max()
        x, y = (self.ground_across - ACROSS_LIGHT @ centre).T
        dark = np.flatnonzero(x * x + y * y < radius * radius)
        dark = dark[self._occluded(tree, self.ground_points[dark])]
        color[self.ground_rays[dark]] = self.ground_shadowed[dark]

    def _occluded(self, tree, points) -> np.ndarray:
        if not len(points):
            return np.zeros(0, dtype=bool)
        toward = np.broadcast_to(LIGHT_DIRECTION.astype(np.float32), points.shape).copy()
        return tree.run(points.astype(np.float32), toward, query="OCCLUDED") >= 0

    def _shade(self, tree, vertices, face, weights) -> np.ndarray:
        rows = self.faces[face]
        points = np.einsum("nk,nkc->nc", weights, vertices[rows])
        normals = np.einsum("nk,nkc->nc", weights, vertex_normals(vertices, self.faces)[rows])
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
        facing = np.maximum(np.einsum("nc,c->n", normals, LIGHT_DIRECTION), 0)
        lit = np.flatnonzero(facing > 0)
        blocked = self._occluded(tree, points[lit] + SHADOW_OFFSET * normals[lit])
        facing[lit[blocked]] = 0
        light = AMBIENT * (0.75 + 0.25 * normals[:, 2]) + DIFFUSE * facing
        return self.paint(np.einsum("nk,nkc->nc", weights, self.corners[face])) * light[:, None]

    def _collect(self, color, ids) -> View:
        """Means of the rays of each pixel; its id is what most of them hit, the higher id on a draw."""
        shape = (self.rig.n_cams, self.rig.size, self.rig.size, self.samples**2)
        rgb = np.zeros((*shape[:3], 3), dtype=np.float32)
        per_ray = color.reshape(*shape, 3)
        for ray in range(shape[3]):
            rgb += per_ray[..., ray, :]
        rgb = np.clip(rgb * np.float32(255 / shape[3]) + np.float32(0.5), 0, 255).astype(np.uint8)
        ids = ids.reshape(shape)
        count = {}
        for label in (BACKGROUND, GROUND, BODY):
            hits = (ids == label).view(np.uint8)
            count[label] = sum((hits[..., ray] for ray in range(1, shape[3])), hits[..., 0])
        ground = count[GROUND] >= count[BACKGROUND]
        body = count[BODY] >= np.maximum(count[GROUND], count[BACKGROUND])
        segmentation = np.where(body, BODY, np.where(ground, GROUND, BACKGROUND)).astype(np.uint8)
        instances = np.where(body, 2, segmentation).astype(np.uint8)
        return View(rgb, segmentation, instances)
