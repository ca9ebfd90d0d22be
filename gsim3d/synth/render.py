"""Ray-traced images of moving bodies on a round ground, with one directional light, ambient light and shadows.

The ground is a disc, whose hit points and colours are computed once a scene. The bodies are triangle meshes in one
Embree scene a frame, for all cameras.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from gsim3d.synth.cameras import Rig, pixel_rays, project
from gsim3d.synth.meshes import vertex_normals

BACKGROUND, GROUND, BODY = 0, 1, 3  # segmentation ids; 3 for all movable bodies
AMBIENT = 0.42  # ambient light on faces that point up; half of it on faces that point down
DIFFUSE = 0.68
SHADOW_OFFSET = 2e-3  # metres along the normal, against self-shadowing
LIGHT_DIRECTION = np.array([0.36, 0.24, 0.90]) / np.linalg.norm([0.36, 0.24, 0.90])  # towards the light
ACROSS_LIGHT = np.linalg.svd(LIGHT_DIRECTION[None])[2][1:]  # two unit vectors orthogonal to it
GROUND_COLORS = np.array([[0.80, 0.80, 0.76], [0.36, 0.42, 0.48], [0.62, 0.47, 0.36]])
FIRST_BODY = 2  # instance id of the first body, after background and ground
GROUND_RINGS = 4
GROUND_SECTORS = 12


@dataclass(frozen=True)
class View:
    """Images of all cameras at one frame."""

    rgb: np.ndarray  #: uint8 [V, H, W, 3]
    segmentation: np.ndarray  #: uint8 [V, H, W]: BACKGROUND, GROUND or BODY
    instances: np.ndarray  #: uint8 [V, H, W]: BACKGROUND, GROUND, or FIRST_BODY and more
    #: float32 [V, H, W], mean depth along the optical axis in metres of the rays that hit the pixel's instance, 0 for
    #: the background; None: not rendered
    depth: np.ndarray | None


@dataclass(frozen=True)
class Surface:
    """A body to render."""

    faces: np.ndarray  #: [F, 3]
    corners: np.ndarray  #: [F, 3, C], see :class:`gsim3d.synth.shapes.Body`
    paint: Callable[[np.ndarray], np.ndarray]  #: function [N, C] -> colours [N, 3]
    two_sided: bool = False  #: shades both sides, for sheets


@dataclass(frozen=True)
class Ground:
    """A disc around the world's z axis."""

    radius: float  #: radius in metres
    height: float  #: height in metres
    albedo: float | None = None  #: uniform grey in [0, 1]; None: a pattern of rings and sectors in three colours


def ground_color(points: np.ndarray, radius: float) -> np.ndarray:
    """Colours [N, 3] of ground points [N, 3]: a pattern of rings and sectors."""
    reach = np.hypot(points[:, 0], points[:, 1]) / radius * GROUND_RINGS
    ring = np.floor(reach).astype(np.int64)
    sector = np.floor((np.arctan2(points[:, 1], points[:, 0]) / (2 * np.pi) + 1) * GROUND_SECTORS).astype(np.int64)
    sector = np.where(ring == 0, sector // 4, sector)
    dark = (ring + sector) % 2
    return GROUND_COLORS[np.where((ring == GROUND_RINGS - 2) & (dark == 1), 2, dark)]


class Renderer:
    """Renders frames of bodies on the ground with all cameras of a rig.

    Args:
        rig: cameras.
        surfaces: bodies with the instance ids 2, 3, ...
        ground: ground; None: no ground.
        background: colour (3,) in [0, 1] of rays that hit nothing.
        samples: rays along each side of a pixel (2: four rays a pixel).
        depth: also renders depth images.
    """

    def __init__(
        self,
        rig: Rig,
        surfaces: Sequence[Surface],
        *,
        ground: Ground | None,
        background,
        samples: int = 2,
        depth: bool = False,
    ):
        self.rig, self.surfaces, self.samples, self.wants_depth = rig, tuple(surfaces), samples, depth
        counts = [len(surface.faces) for surface in self.surfaces]
        self.owner = np.repeat(np.arange(len(counts)), counts)  # surface of every face of the joined mesh
        self.first_face = np.cumsum([0, *counts])
        self.origins, directions = pixel_rays(rig, samples)
        self.directions = directions.astype(np.float32)
        self._draw_ground(directions, ground, np.asarray(background, dtype=np.float64))

    def _draw_ground(self, directions, ground, background):
        """Renders the scene without bodies: colour with and without shadow, and distance, of every ray."""
        if ground is None:
            ground = Ground(-1.0, 0.0)  # without points
        height = (self.origins[:, 2] - ground.height).reshape(-1, 1, 1, 1)
        down = directions[..., 2]
        distance = np.where((down < 0) & (height > 0), -height / np.where(down < 0, down, -1), np.inf)
        reach = np.where(np.isfinite(distance), distance, 0)
        points = self.origins[:, None, None, None] + reach[..., None] * directions
        hit = np.isfinite(distance) & (np.hypot(points[..., 0], points[..., 1]) <= ground.radius)
        self.ground_distance = np.where(hit, distance, np.inf).astype(np.float32).reshape(-1)
        self.ground_rays = np.flatnonzero(hit)
        self.ground_points = points[hit]
        self.ground_across = self.ground_points @ ACROSS_LIGHT.T
        if ground.albedo is None:
            albedo = ground_color(self.ground_points, ground.radius)
        else:
            albedo = np.full(self.ground_points.shape, ground.albedo)
        self.ground_shadowed = (albedo * AMBIENT).astype(np.float32)
        lit = np.broadcast_to(background, (*hit.shape, 3)).astype(np.float32)
        lit[hit] = albedo * (AMBIENT + DIFFUSE * LIGHT_DIRECTION[2])
        self.base_color = lit.reshape(-1, 3)
        self.base_instance = np.where(hit, GROUND, BACKGROUND).astype(np.uint8).reshape(-1)

    def draw(self, vertices: Sequence[np.ndarray]) -> View:
        """Renders the bodies with these vertices, [V, 3] each, world coordinates in metres."""
        from embreex.mesh_construction import TriangleMesh
        from embreex.rtcore_scene import EmbreeScene

        starts = np.cumsum([0, *(len(points) for points in vertices)])
        joint = np.concatenate(vertices)
        faces = np.concatenate([surface.faces + start for surface, start in zip(self.surfaces, starts)])
        tree = EmbreeScene(robust=True)
        TriangleMesh(tree, joint.astype(np.float32), faces.astype(np.int32))
        color, instance = self.base_color.copy(), self.base_instance.copy()
        distance = self.ground_distance.copy()
        self._cast_shadow(tree, vertices, color)
        rays = self._rays_near(vertices)
        origins = np.repeat(self.origins.astype(np.float32), self.directions[0].size // 3, axis=0)[rays]
        directions = self.directions.reshape(-1, 3)[rays]
        hits = tree.run(origins, directions, query="INTERSECT", output=1)
        seen = (hits["primID"] >= 0) & (hits["tfar"] < distance[rays])
        rays, directions = rays[seen], directions[seen]
        face, u, v = hits["primID"][seen], hits["u"][seen].astype(np.float64), hits["v"][seen].astype(np.float64)
        color[rays] = self._shade(tree, joint, faces, face, np.stack([1 - u - v, u, v], 1), directions)
        instance[rays] = FIRST_BODY + self.owner[face]
        distance[rays] = hits["tfar"][seen]
        return self._collect(color, instance, distance)

    def _rays_near(self, vertices) -> np.ndarray:
        """Indices of the rays inside the bounding rectangle of a body in each image."""
        rig, per_pixel = self.rig, self.samples**2
        near = np.zeros((rig.n_cams, rig.size, rig.size), dtype=bool)
        for points in vertices:
            pixels, depth = project(points, rig.viewmats, rig.Ks)
            for cam in range(rig.n_cams):
                if (depth[cam] <= 0).any():
                    low, high = np.zeros(2, dtype=np.int64), np.full(2, rig.size)
                else:
                    low = np.clip(np.floor(pixels[cam].min(0)), 0, rig.size).astype(np.int64)
                    high = np.clip(np.ceil(pixels[cam].max(0)), 0, rig.size).astype(np.int64)
                near[cam, low[1] : high[1], low[0] : high[0]] = True
        return (np.flatnonzero(near)[:, None] * per_pixel + np.arange(per_pixel)).reshape(-1)

    def _cast_shadow(self, tree, vertices, color):
        # Only ground points whose shadow ray passes through a body's bounding sphere can be in shadow.
        near = np.zeros(len(self.ground_points), dtype=bool)
        for points in vertices:
            centre = (points.min(0) + points.max(0)) / 2
            radius = 1.01 * np.linalg.norm(points - centre, axis=1).max()
            x, y = (self.ground_across - ACROSS_LIGHT @ centre).T
            near |= x * x + y * y < radius * radius
        dark = np.flatnonzero(near)
        dark = dark[self._occluded(tree, self.ground_points[dark])]
        color[self.ground_rays[dark]] = self.ground_shadowed[dark]

    def _occluded(self, tree, points) -> np.ndarray:
        if not len(points):
            return np.zeros(0, dtype=bool)
        toward = np.broadcast_to(LIGHT_DIRECTION.astype(np.float32), points.shape).copy()
        return tree.run(points.astype(np.float32), toward, query="OCCLUDED") >= 0

    def _shade(self, tree, vertices, faces, face, weights, directions) -> np.ndarray:
        hit = faces[face]
        points = np.einsum("nk,nkc->nc", weights, vertices[hit])
        normals = np.einsum("nk,nkc->nc", weights, vertex_normals(vertices, faces)[hit])
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
        sheets = np.array([surface.two_sided for surface in self.surfaces])[self.owner[face]]
        away = sheets & (np.einsum("nc,nc->n", normals, directions) > 0)
        normals[away] *= -1
        facing = np.maximum(np.einsum("nc,c->n", normals, LIGHT_DIRECTION), 0)
        lit = np.flatnonzero(facing > 0)
        blocked = self._occluded(tree, points[lit] + SHADOW_OFFSET * normals[lit])
        facing[lit[blocked]] = 0
        light = AMBIENT * (0.75 + 0.25 * normals[:, 2]) + DIFFUSE * facing
        return self._albedo(face, weights) * light[:, None]

    def _albedo(self, face, weights) -> np.ndarray:
        albedo = np.empty((len(face), 3))
        for index, surface in enumerate(self.surfaces):
            mine = np.flatnonzero(self.owner[face] == index)
            corners = surface.corners[face[mine] - self.first_face[index]]
            albedo[mine] = surface.paint(np.einsum("nk,nkc->nc", weights[mine], corners))
        return albedo

    def _collect(self, color, instance, distance) -> View:
        """Averages the rays of each pixel. Its instance is that of most rays; ties favour bodies, then the ground."""
        shape = (self.rig.n_cams, self.rig.size, self.rig.size, self.samples**2)
        rgb = np.zeros((*shape[:3], 3), dtype=np.float32)
        per_ray = color.reshape(*shape, 3)
        for ray in range(shape[3]):
            rgb += per_ray[..., ray, :]
        rgb = np.clip(rgb * np.float32(255 / shape[3]) + np.float32(0.5), 0, 255).astype(np.uint8)
        instance = instance.reshape(shape)

        def count(label: int) -> np.ndarray:
            hits = (instance == label).view(np.uint8)
            return sum((hits[..., ray] for ray in range(1, shape[3])), hits[..., 0])

        none, ground = count(BACKGROUND), count(GROUND)
        shown, most = np.zeros(shape[:3], np.uint8), np.zeros(shape[:3], np.uint8)
        for label in range(FIRST_BODY, FIRST_BODY + len(self.surfaces)):
            hits = count(label)
            shown = np.where(hits > most, label, shown).astype(np.uint8)
            most = np.maximum(most, hits)
        body = shape[3] - none - ground >= np.maximum(np.maximum(ground, none), 1)
        rest = np.where(ground >= np.maximum(none, 1), GROUND, BACKGROUND).astype(np.uint8)
        instances = np.where(body, shown, rest)
        segmentation = np.where(body, BODY, rest).astype(np.uint8)
        depth = self._depth(instance, instances, distance.reshape(shape)) if self.wants_depth else None
        return View(rgb, segmentation, instances, depth)

    def _depth(self, instance, instances, distance) -> np.ndarray:
        forward = self.rig.viewmats[:, 2, :3]
        axial = np.einsum("vhwsc,vc->vhws", self.directions, forward.astype(np.float32))
        match = (instance == instances[..., None]) & (instances[..., None] != BACKGROUND)
        total = np.where(match, distance * axial, 0).sum(-1)
        return (total / np.maximum(match.sum(-1), 1)).astype(np.float32)
