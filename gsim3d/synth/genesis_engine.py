"""Simulation with Genesis, as in the paper: MPM for soft bodies, PBD for cloth. Needs the package genesis-world.

Surfaces are embedded in the particles of their bodies. Genesis does not guarantee equal bits in repeated runs.
"""

import tempfile
from pathlib import Path

import numpy as np

from gsim3d.synth.embedding import ClothGrid, ParticleCloud, grid_faces
from gsim3d.synth.meshes import enclosed_volume
from gsim3d.synth.scene_setup import GRAVITY, Cloth, SceneSetup, SoftBody, Unstable

TIMESTEP, SUBSTEPS = 1e-3, 20  # of the paper; time step in seconds
GRID_DENSITY = 64  # cells a metre
POISSON = 0.2
GROUND_RADIUS, GROUND_DEPTH = 2.0, 0.1
DOMAIN = 2.0  # half extent of the domain along x and y, and its height over the highest body, in metres
FIX_DISTANCE = 1e-3  # largest distance in metres between a node of the cloth and its particle


def simulate(setup: SceneSetup, n_frames: int, fps: float, max_timestep: float) -> list[ParticleCloud | ClothGrid]:
    """Simulates a scene with soft bodies only, in steps of TIMESTEP. Returns the embedding of each body over all
    frames, and of the cloth last. Raises Unstable if particles are not finite."""
    import genesis as gs

    if not getattr(gs, "_initialized", False):
        gs.init(logging_level="warning", seed=0)
    with tempfile.TemporaryDirectory() as folder:
        scene, bodies, cloth = _build(gs, setup, Path(folder))
    for entity, body in zip(bodies, setup.bodies):
        positions = _positions(entity)
        entity.set_velocity((body.velocity + np.cross(body.spin, positions - positions.mean(0))).astype(np.float32))
    order = None if cloth is None else _pin(cloth, setup.cloth)
    frames = [[_positions(entity) for entity in bodies]]
    sheets = [] if cloth is None else [_positions(cloth)[order]]
    n_steps = 0
    for frame in range(1, n_frames):
        wanted = round(frame / (fps * TIMESTEP))
        for _ in range(wanted - n_steps):
            scene.step()
        n_steps = wanted
        frames.append([_positions(entity) for entity in bodies])
        if cloth is not None:
            sheets.append(_positions(cloth)[order])
    embeddings = [ParticleCloud(np.stack(nodes)) for nodes in zip(*frames)]
    if cloth is not None:
        embeddings.append(ClothGrid(np.stack(sheets).reshape(n_frames, setup.cloth.count, setup.cloth.count, 3)))
    if not all(np.isfinite(embedding.nodes).all() for embedding in embeddings):
        raise Unstable("the solver gave up")
    return embeddings


def _build(gs, setup: SceneSetup, folder: Path):
    """Builds the scene. Returns scene, soft entities and cloth entity (or None)."""
    top = max(float(body.vertices[:, 2].max()) for body in setup.bodies)
    low = setup.ground if setup.ground is not None else -DOMAIN
    lower, upper = (-DOMAIN, -DOMAIN, low - GROUND_DEPTH), (DOMAIN, DOMAIN, top + DOMAIN)
    scene = gs.Scene(
        sim_options=gs.options.SimOptions(dt=TIMESTEP, substeps=SUBSTEPS, gravity=(0.0, 0.0, -GRAVITY)),
        mpm_options=gs.options.MPMOptions(lower_bound=lower, upper_bound=upper, grid_density=GRID_DENSITY),
        pbd_options=gs.options.PBDOptions(lower_bound=lower, upper_bound=upper),
        show_viewer=False,
    )
    if setup.ground is not None:
        scene.add_entity(
            material=gs.materials.Rigid(needs_coup=True, coup_friction=0.5),
            morph=gs.morphs.Cylinder(
                pos=(0.0, 0.0, setup.ground - GROUND_DEPTH / 2), radius=GROUND_RADIUS, height=GROUND_DEPTH, fixed=True
            ),
        )
    bodies = [_add_soft(gs, scene, body, folder / f"body_{index}.obj") for index, body in enumerate(setup.bodies)]
    cloth = None
    if setup.cloth is not None:
        _write_obj(path := folder / "cloth.obj", setup.cloth.rest_nodes().reshape(-1, 3), grid_faces(setup.cloth.count))
        material = gs.materials.PBD.Cloth(rho=setup.cloth.mass / setup.cloth.width**2)
        cloth = scene.add_entity(material=material, morph=gs.morphs.Mesh(file=str(path), file_meshes_are_zup=True))
    scene.build()
    return scene, bodies, cloth


def _add_soft(gs, scene, body: SoftBody, path: Path):
    _write_obj(path, body.vertices, body.faces)
    material, volume = body.material, abs(enclosed_volume(body.vertices, body.faces))
    common = {"E": material.young, "nu": POISSON, "rho": body.mass / volume, "sampler": "regular"}
    if material.yield_strain:
        shear = material.young / (2 * (1 + POISSON))
        chosen = gs.materials.MPM.ElastoPlastic(von_mises_yield_stress=2 * shear * material.yield_strain, **common)
    else:
        chosen = gs.materials.MPM.Elastic(**common)
    return scene.add_entity(material=chosen, morph=gs.morphs.Mesh(file=str(path), file_meshes_are_zup=True))


def _pin(entity, cloth: Cloth) -> np.ndarray:
    """Fixes the four corners. Returns the particle of every node of the grid, in row-major order."""
    nodes, positions = cloth.rest_nodes().reshape(-1, 3), _positions(entity)
    distance = np.linalg.norm(nodes[:, None] - positions[None], axis=-1)
    order = distance.argmin(1)
    if distance.min(1).max() > FIX_DISTANCE:
        raise RuntimeError("the particles of the cloth differ from the vertices of its mesh in this version of Genesis")
    n = cloth.count
    entity.fix_particles(order[[0, n - 1, n * (n - 1), n * n - 1]])
    return order


def _positions(entity) -> np.ndarray:
    return entity.get_particles_pos().cpu().numpy().astype(np.float64)


def _write_obj(path: Path, vertices: np.ndarray, faces: np.ndarray) -> None:
    lines = [f"v {x:.9g} {y:.9g} {z:.9g}" for x, y, z in vertices]
    lines += [f"f {a + 1} {b + 1} {c + 1}" for a, b, c in faces]
    path.write_text("\n".join(lines) + "\n")
