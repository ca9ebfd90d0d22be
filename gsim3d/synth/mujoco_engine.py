"""Simulation with MuJoCo: soft bodies are trilinear flexes, rigid bodies convex meshes, and cloth is a 2D flex."""

import os

import numpy as np

from gsim3d.synth.embedding import ClothGrid, ControlGrid, Embedding, RigidFrame
from gsim3d.synth.scene_setup import GRAVITY, Cloth, RigidBody, SceneSetup, SoftBody, Unstable

NAME = "mujoco"
CONTACT_RADIUS = 0.005  # radius of collision vertices in metres; the ground plane is lowered by it
CLOTH_RADIUS = 0.012  # radius of cloth in metres; larger, so that vertices do not pass between its triangles
CONTACT_TIME = 0.005  # time constant of contacts in seconds; a longer one allows centimetres of penetration
MIN_STEPS_PER_CONTACT = 2.0  # limit of MuJoCo: smallest time constant of a contact in steps
RIGID_CONTACT = 300.0  # frequency of the contact spring of rigid bodies in rad/s; 1 cm of penetration at 3 m/s
POISSON = 0.3


def load_mujoco():
    """Imports MuJoCo, without a display and without a log file in the working directory."""
    os.environ.setdefault("MUJOCO_GL", "disable")
    import mujoco

    mujoco.set_mju_user_warning(lambda text: None)  # the default writes the log file
    return mujoco


def check_solver(data) -> None:
    """Raises Unstable if the solver has diverged."""
    if any(warning.number for warning in data.warning) or not np.isfinite(data.qpos).all():
        raise Unstable("the solver gave up")


def simulate(setup: SceneSetup, n_frames: int, fps: float, max_timestep: float) -> list[Embedding]:
    """Simulates a scene in steps of at most ``max_timestep`` seconds. Returns the embedding of each body over all
    frames (of a soft body a grid that spans the box of its collision mesh at time 0), and of the cloth last. Raises
    Unstable if the solver diverges."""
    mujoco = load_mujoco()
    substeps = int(np.ceil(1 / (fps * max_timestep) - 1e-9))
    model = mujoco.MjModel.from_xml_string(model_xml(setup, 1 / (fps * substeps)))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    parts = [
        (_Soft if isinstance(body, SoftBody) else _Rigid)(model, data, i, body) for i, body in enumerate(setup.bodies)
    ]
    if setup.cloth is not None:
        parts.append(_Cloth(model, data, setup.cloth))
    frames = [[part.rest] for part in parts]
    for frame in range(1, n_frames):
        if setup.grips is None:
            mujoco.mj_step(model, data, substeps)
        else:
            for substep in range(1, substeps + 1):
                before, after = setup.grips[frame - 1], setup.grips[frame]
                data.mocap_pos[:] = before + substep / substeps * (after - before)
                mujoco.mj_step(model, data)
            mujoco.mj_flex(model, data)
        mujoco.mj_kinematics(model, data)
        for part, nodes in zip(parts, frames):
            nodes.append(part.nodes())
    embeddings = [part.embedding(np.stack(nodes)) for part, nodes in zip(parts, frames)]
    if any(w.number for w in data.warning) or not all(np.isfinite(embedding.nodes).all() for embedding in embeddings):
        raise Unstable("the solver gave up")
    return embeddings


def model_xml(setup: SceneSetup, timestep: float) -> str:
    """MuJoCo model of the scene as XML."""
    contact_time = max(CONTACT_TIME, MIN_STEPS_PER_CONTACT * timestep)
    contact = f'solref="{contact_time:.9g} 1"'
    assets, bodies = [], []
    for index, body in enumerate(setup.bodies):
        asset, element = _soft_xml(index, body, contact) if isinstance(body, SoftBody) else _rigid_xml(index, body)
        assets.append(asset)
        bodies.append(element)
    if setup.cloth is not None:
        bodies.append(_cloth_xml(setup.cloth, contact))
    if setup.ground is not None:
        soft = any(isinstance(body, SoftBody) for body in setup.bodies)
        held = setup.grips is not None  # its cloth may lie on the ground, and is drawn above it
        height = setup.ground - (CONTACT_RADIUS if soft else CLOTH_RADIUS / 2 if held else 0)
        bodies.append(f'<geom type="plane" size="9 9 .1" pos="0 0 {height:.9g}" {contact}/>')
    if setup.pusher is not None:
        position, radius = _numbers(setup.pusher.position), f"{setup.pusher.radius:.9g}"
        geom = f'<geom type="sphere" size="{radius}"/>'  # contact parameters are those of the pushed body
        bodies.append(f'<body name="pusher" mocap="true" pos="{position}">{geom}</body>')
    equality = ""
    for number, (node, place) in enumerate(zip(setup.cloth.held, setup.grips[0]) if setup.grips is not None else ()):
        bodies.append(f'<body name="g{number}" mocap="true" pos="{_numbers(place)}"/>')
        ends = f'body1="g{number}" body2="cloth_{node}" anchor="0 0 0"'
        equality += f'<connect {ends} {contact} solimp="0.99 0.999 0.001"/>'
    iterations = 50 if setup.cloth is None else 100  # slow convergence of soft bodies on a cloth
    return f"""<mujoco>
  <option timestep="{timestep:.12g}" integrator="discrete" iterations="{iterations}" gravity="0 0 {-GRAVITY}"/>
  <size memory="256M"/>
  <asset>{"".join(assets)}</asset>
  <worldbody>{"".join(bodies)}</worldbody>
  <equality>{equality}</equality>
</mujoco>"""


def _numbers(values) -> str:
    return " ".join(f"{x:.9g}" for x in np.ravel(values))


def _soft_xml(index: int, body: SoftBody, contact: str) -> tuple[str, str]:
    centre = (body.vertices.min(0) + body.vertices.max(0)) / 2  # inside the grid
    material = body.material
    lasting = f' yield="{material.yield_strain:.9g}"' if material.yield_strain else ""
    asset = f'<mesh name="m{index}" vertex="{_numbers(body.vertices)}" face="{_numbers(body.faces)}"/>'
    element = f"""<body name="b{index}">
      <flexcomp name="b{index}" type="mesh" dim="3" mesh="m{index}" dof="trilinear"
                cellcount="{body.cells} {body.cells} {body.cells}"
                origin="{_numbers(centre)}" mass="{body.mass:.9g}" radius="{CONTACT_RADIUS}">
        <elasticity young="{material.young:.9g}" poisson="{POISSON}" damping="{material.damping:.9g}"{lasting}/>
        <contact selfcollide="none" {contact}/>
      </flexcomp></body>"""
    return asset, element


def _rigid_xml(index: int, body: RigidBody) -> tuple[str, str]:
    vertices = np.concatenate(body.parts)
    centre = (vertices.min(0) + vertices.max(0)) / 2
    # Damping ratio of the contact spring for the coefficient of restitution after half a period.
    loss = np.log(max(body.bounce, 1e-3))
    ratio = -loss / np.hypot(np.pi, loss)
    contact = f'solref="{-(RIGID_CONTACT**2):.9g} {-2 * ratio * RIGID_CONTACT:.9g}" priority="1"'
    friction = f'friction="{body.friction:.9g} 0.01 0.004" condim="6"'
    names = [f"m{index}p{part}" for part in range(len(body.parts))]
    assets = [f'<mesh name="{name}" vertex="{_numbers(part - centre)}"/>' for name, part in zip(names, body.parts)]
    geoms = [f'<geom type="mesh" mesh="{name}" mass="{body.mass / len(names):.9g}" {contact} {friction}/>'
             for name in names]  # fmt: skip
    return "".join(assets), f'<body name="b{index}" pos="{_numbers(centre)}"><freejoint/>{"".join(geoms)}</body>'


def _cloth_xml(cloth: Cloth, contact: str) -> str:
    n = cloth.count
    pins = f'<pin id="0 {n - 1} {n * (n - 1)} {n * n - 1}"/>' if cloth.held is None else ""
    return f"""<body name="cloth"><flexcomp name="cloth" type="grid" dim="2" count="{n} {n} 1"
      spacing="{cloth.width / (n - 1):.9g} {cloth.width / (n - 1):.9g} 1" pos="0 0 {cloth.height:.9g}"
      mass="{cloth.mass:.9g}" radius="{CLOTH_RADIUS}">
      <elasticity young="{cloth.young:.9g}" poisson="{POISSON}" thickness="{cloth.thickness:.9g}"
                  damping="{cloth.damping:.9g}" elastic2d="both"/>
      <contact selfcollide="none" {contact}/>
      {pins}
    </flexcomp></body>"""


def _flex_id(model, name: str) -> int:
    import mujoco

    return mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_FLEX, name)


def body_nodes(data, body: int) -> np.ndarray:
    """Origin and tips of the unit axes of a rigid body [4, 3] in metres."""
    origin = data.xpos[body]
    return np.concatenate([origin[None], origin + data.xmat[body].reshape(3, 3).T])


class _Soft:
    def __init__(self, model, data, index: int, body: SoftBody):
        flex = _flex_id(model, f"b{index}")
        first = model.flex_nodeadr[flex]
        self.data, self.body, self.bodies = data, body, model.flex_nodebodyid[first : first + model.flex_nodenum[flex]]
        self.shape = (body.cells + 1,) * 3
        low, high, part = body.vertices.min(0), body.vertices.max(0), np.arange(body.cells + 1) / body.cells
        self.rest = np.stack(np.meshgrid(*(a + (b - a) * part for a, b in zip(low, high)), indexing="ij"), -1)
        movable = model.body_dofnum[self.bodies] == 3  # nodes without mass are welded to the world
        cell = np.floor((body.vertices - low) / (high - low) * body.cells).astype(np.int64)
        self.occupied = np.zeros((body.cells,) * 3, dtype=bool)
        self.occupied[tuple(np.clip(cell, 0, body.cells - 1).T)] = True
        used = np.zeros(self.shape, dtype=bool)
        corners = [tuple(slice(s, s + body.cells) for s in step) for step in np.ndindex(2, 2, 2)]
        for corner in corners:
            self.occupied &= movable.reshape(self.shape)[corner]
        for corner in corners:
            used[corner] |= self.occupied
        if not used.any() or np.abs(self.nodes() - self.rest)[used].max() > 1e-5:
            raise RuntimeError("unexpected order of the nodes of a flex in this version of MuJoCo")
        velocity = body.velocity + np.cross(body.spin, self.rest - self.rest[used].mean(0))
        dofs = model.body_dofadr[self.bodies[movable]][:, None] + np.arange(3)
        data.qvel[dofs] = velocity.reshape(-1, 3)[movable]

    def nodes(self) -> np.ndarray:
        return self.data.xpos[self.bodies].reshape(*self.shape, 3)

    def embedding(self, nodes: np.ndarray) -> ControlGrid:
        return ControlGrid(nodes, self.occupied, self.body.vertices)


class _Rigid:
    def __init__(self, model, data, index: int, body: RigidBody):
        self.data, self.id = data, model.body(f"b{index}").id
        first = model.body_dofadr[self.id]
        # Velocity of the frame's origin; the spin is about the center of mass.
        arm = data.xipos[self.id] - data.xpos[self.id]
        data.qvel[first : first + 3] = body.velocity - np.cross(body.spin, arm)
        data.qvel[first + 3 : first + 6] = body.spin  # the initial frame is aligned with the world
        self.rest = self.nodes()

    def nodes(self) -> np.ndarray:
        return body_nodes(self.data, self.id)

    def embedding(self, nodes: np.ndarray) -> RigidFrame:
        return RigidFrame(nodes)


class _Cloth:
    def __init__(self, model, data, cloth: Cloth):
        flex = _flex_id(model, "cloth")
        first = model.flex_vertadr[flex]
        self.data, self.vertices = data, slice(first, first + model.flex_vertnum[flex])
        self.rest = cloth.rest_nodes()
        if np.abs(self.nodes() - self.rest).max() > 1e-5:
            raise RuntimeError("unexpected order of the nodes of the cloth in this version of MuJoCo")

    def nodes(self) -> np.ndarray:
        return self.data.flexvert_xpos[self.vertices].reshape(self.rest.shape).copy()

    def embedding(self, nodes: np.ndarray) -> ClothGrid:
        return ClothGrid(nodes)
