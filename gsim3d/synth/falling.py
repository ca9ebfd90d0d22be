"""Base class of worlds whose bodies fall or are thrown at time 0."""

from abc import abstractmethod
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from gsim3d.synth import render
from gsim3d.synth.bodies import load_mesh, mesh_name, name_rng, named_body
from gsim3d.synth.scene_setup import GRAVITY, Cloth, RigidBody, SoftBody, turn_about_z
from gsim3d.synth.world import SceneBody, World

GAP = 0.03  # smallest initial distance between the bounding spheres of two bodies in metres


@dataclass(frozen=True)
class FallingWorld(World):
    """Bodies fall or are thrown on a ground or on a cloth, or fly where there is neither."""

    def _draw(self, name: str, rng: np.random.Generator) -> tuple[float | None, Cloth | None, list[SceneBody]]:
        names = [name]
        if self.n_bodies[1] > 1:
            count = int(rng.integers(self.n_bodies[0], self.n_bodies[1] + 1))
            known = self.object_names()
            names += [known[rng.integers(len(known))] for _ in range(count - 1)]
        low, high = self.ground_height
        ground = (float(rng.uniform(low, high)) if high > low else low) if self.ground else None
        cloth = self._draw_cloth(rng)
        floor = cloth.height if cloth is not None else ground or 0.0
        bodies = []
        for body_name in names:
            bodies.append(self._draw_body(body_name, floor, bodies, rng))
        return ground, cloth, bodies

    def _draw_body(self, name: str, floor: float, before: list[SceneBody], rng: np.random.Generator) -> SceneBody:
        path = next((path for path in self.meshes if mesh_name(path) == name), None)
        if path is None:
            body = named_body(name, name_rng(name) if self.by_name else rng)
        else:
            body = load_mesh(path, self.mesh_up)
        # Mesh files stay upright and rotate about the z axis; other bodies have a random orientation.
        rotation = _random_rotation(rng) if path is None else turn_about_z(rng.uniform(0, 2 * np.pi))
        size = rng.uniform(*self.body_size)
        vertices = size * (body.vertices[:, None, :] * rotation).sum(-1)
        collision = size * (body.collision_vertices[:, None, :] * rotation).sum(-1)
        drop = self._drop(rng.uniform(*self.drop_height), float(np.ptp(vertices[:, 2])))
        heading, speed = rng.uniform(0, 2 * np.pi), rng.uniform(0, self.speed)
        velocity = speed * np.array([np.cos(heading), np.sin(heading), 0])
        if self.lift[1] > 0:
            velocity[2] = rng.uniform(*self.lift)
        aim = rng.uniform(-self.spread, self.spread, 2)
        position = np.array([*aim, floor + drop - vertices[:, 2].min()])
        # Compensates the horizontal drift, so that the body lands, or is halfway, near its target.
        position[:2] -= velocity[:2] * self._flight(drop, velocity[2])
        position = _clear_of(position, size / 2, before)
        axis = rng.normal(size=3)
        spin = rng.uniform(0, self.spin) * axis / np.linalg.norm(axis)
        simulated, facts = self._make_body(name, collision + position, body.collision_faces, velocity, spin, rng)
        facts = {"object": name, "mass": round(simulated.mass, 6), "size": round(size, 6), **facts}
        surface = render.Surface(body.faces, body.corners, self._painted(body.paint, facts))
        return SceneBody(simulated, surface, vertices + position, facts)

    def _flight(self, drop: float, lift: float) -> float:
        """Seconds until a body reaches its target position."""
        if not self.ground:
            return self.n_frames / self.fps / 2
        return (lift + np.sqrt(lift**2 + 2 * GRAVITY * drop)) / GRAVITY

    @abstractmethod
    def _make_body(self, name, vertices, faces, velocity, spin, rng) -> tuple[SoftBody | RigidBody, dict]:
        """Returns the simulated body at time 0 and its facts for metadata.json."""

    def _drop(self, height: float, body_height: float) -> float:
        """Drop height from the drawn ``height``."""
        return height

    def _painted(self, paint: Callable[[np.ndarray], np.ndarray], facts: dict) -> Callable[[np.ndarray], np.ndarray]:
        """Paint of a body with these facts, from the drawn ``paint``."""
        return paint

    def _draw_cloth(self, rng: np.random.Generator) -> Cloth | None:
        return None


def _clear_of(position: np.ndarray, radius: float, before: list[SceneBody]) -> np.ndarray:
    """Raises ``position`` until the bounding sphere of the body touches no other."""
    position = position.copy()
    for other in sorted(before, key=lambda other: other.vertices[:, 2].mean()):
        centre = (other.vertices.min(0) + other.vertices.max(0)) / 2
        reach = radius + other.facts["size"] / 2 + GAP
        aside = ((position[:2] - centre[:2]) ** 2).sum()
        if aside < reach**2 and abs(position[2] - centre[2]) ** 2 + aside < reach**2:
            position[2] = centre[2] + np.sqrt(reach**2 - aside)
    return position


def _random_rotation(rng: np.random.Generator) -> np.ndarray:
    """Uniformly distributed rotation matrix, from a random unit quaternion."""
    w, x, y, z = (q := rng.normal(size=4)) / np.linalg.norm(q)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
