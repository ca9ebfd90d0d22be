"""MuJoCo engine: free fall, contact, materials, energy and cloth; bindings of surfaces to nodes."""

import dataclasses

import numpy as np
import pytest

from gsim3d.synth import embedding, meshes, mujoco_engine, scene_setup, shapes
from tests.tolerances import TOLERANCES

FPS, DROP = 24.0, 0.6
JELLY = scene_setup.Material(7e3, 0.01)
STILL = np.zeros(3)


def body_of(name, height, size=0.7, seed=0):
    """A procedural body whose centre is ``height`` metres up: vertices to draw, vertices and faces to collide."""
    body = shapes.procedural_body(name, np.random.default_rng(seed))
    lift = [0, 0, height]
    return size * body.vertices + lift, size * body.collision_vertices + lift, body.collision_faces


def soft(name, height, material=JELLY, *, size=0.7, mass=15.0, cells=3):
    drawn, vertices, faces = body_of(name, height, size)
    return drawn, scene_setup.SoftBody(vertices, faces, STILL, STILL, material, mass, cells)


def rigid(name, height, *, size=0.5, bounce=0.3, velocity=STILL, spin=STILL):
    drawn, vertices, faces = body_of(name, height, size)
    parts = tuple(meshes.convex_pieces(vertices, faces))
    return drawn, scene_setup.RigidBody(parts, np.asarray(velocity), np.asarray(spin), 10.0, 0.6, bounce)


def move(cast, n_frames, *, ground=0.0, cloth=None, fps=FPS, max_timestep=1 / 480):
    """Moved vertices [T, V, 3] of each of ``cast`` (vertices, body), and all embeddings."""
    setting = scene_setup.SceneSetup(tuple(body for _, body in cast), ground, cloth)
    carried = mujoco_engine.simulate(setting, n_frames, fps, max_timestep)
    bindings = [tie.bind(vertices) for (vertices, _), tie in zip(cast, carried)]
    return [np.stack([b.move(nodes) for nodes in c.nodes]) for b, c in zip(bindings, carried)], carried


@pytest.fixture(scope="module")
def ball():
    return soft("ball", DROP + 0.35)


@pytest.fixture(scope="module")
def motion(ball):
    (vertices,), (grid,) = move([ball], 16)
    return grid, vertices


def test_soft_body_in_free_fall(motion):
    _, vertices = motion
    time = np.arange(8) / FPS
    fallen = vertices[0].mean(0) - vertices[:8].mean(1)
    np.testing.assert_allclose(fallen[:, 2], 9.81 * time**2 / 2, atol=TOLERANCES["generate_free_fall"].value)
    np.testing.assert_allclose(fallen[:, :2], 0, atol=1e-6)


def test_body_without_ground_keeps_falling(ball):
    (vertices,), _ = move([ball], 16, ground=None)
    fallen = vertices[0].mean(0) - vertices[-1].mean(0)
    np.testing.assert_allclose(fallen, [0, 0, 9.81 * (15 / FPS) ** 2 / 2], atol=2e-2)


def test_soft_body_lands_deforms_and_bounces(motion):
    _, vertices = motion
    lowest, height = vertices[..., 2].min(1), np.ptp(vertices[..., 2], axis=1)
    assert lowest.min() > -0.03  # centimetres into the ground at impact, a pixel at most
    assert height.min() < 0.75 * height[0]
    squeezed = height.argmin()
    assert lowest[squeezed] < 0.02 and height[squeezed:].max() > 0.93 * height[0]
    wide = np.ptp(vertices[squeezed, :, 0])
    assert wide > 1.02 * np.ptp(vertices[0, :, 0])


def test_raised_ground_shifts_the_motion(motion, ball):
    drawn, body = ball
    raised = dataclasses.replace(body, vertices=body.vertices + [0, 0, 0.25])
    (vertices,), _ = move([(drawn + [0, 0, 0.25], raised)], 16, ground=0.25)
    np.testing.assert_allclose(vertices - [0, 0, 0.25], motion[1], atol=1e-4)


def test_materials_bounce_and_keep_dents_as_named():
    """Rubber jumps higher than jelly, jelly than foam; clay keeps a dent, rubber does not."""
    from gsim3d.synth.worlds import MATERIALS

    jump, left = {}, {}
    for name, (young, damping, lasting) in MATERIALS.items():
        material = scene_setup.Material(np.mean(young), damping, np.mean(lasting) if lasting else 0.0)
        (vertices,), _ = move([soft("ball", 1.1, material)], 60, fps=42.0)
        centre, height = vertices[..., 2].mean(1), np.ptp(vertices[..., 2], axis=1)
        landed = centre[:30].argmin()
        jump[name], left[name] = centre[landed:].max() - centre[landed], height[-1] / height[0]
    assert jump["rubber"] > 1.2 * jump["jelly"] > 1.2 * 1.5 * jump["foam"]
    assert left["clay"] < 0.85 < 0.9 < left["rubber"]


@pytest.mark.parametrize("name", ["ball", "torus"])
def test_check_energy_bounds_gains(name):
    """Height and speed of the centre never need more than the start had, in every frame, for soft and rigid bodies."""
    spin = np.array([2.0, -1.0, 0.5])
    for cast in ([soft(name, 0.9)], [rigid(name, 0.9, bounce=0.7, velocity=[0.5, 0, 0.6], spin=spin)]):
        (vertices,), _ = move(cast, 60, fps=42.0, max_timestep=1 / 960)
        centre = vertices.mean(1)
        speed, height = np.diff(centre, axis=0) * 42.0, (centre[1:, 2] + centre[:-1, 2]) / 2
        energy = 9.81 * height + (speed**2).sum(1) / 2
        turning = (cast[0][1].spin ** 2).sum() * 0.35**2 / 2
        assert energy.max() < energy[0] + turning + 0.1
        assert energy[-1] < 0.75 * energy[0]
        scene_setup.check_energy(centre[None], np.ones(1), turning, 42.0)
        late = centre.copy()
        late[-8:, 2] += np.linspace(0, 0.3, 8) ** 2 / 0.3  # what has landed rises by itself
        for spoiled in (1.5 * centre, late):
            with pytest.raises(scene_setup.Unstable, match="gained energy"):
                scene_setup.check_energy(spoiled[None], np.ones(1), turning, 42.0)


def test_rigid_bodies_keep_their_shape_and_stay_above_the_ground():
    moved, carried = move([rigid("ball", 1.0), rigid("torus", 1.7, spin=[3.0, 1.0, 0.0])], 60, fps=42.0)
    for vertices, frame in zip(moved, carried):
        across = np.linalg.norm(vertices[:, 0] - vertices[:, 100], axis=1)
        np.testing.assert_allclose(across, across[0], rtol=1e-9)
        assert vertices[..., 2].min() > -0.02
        assert np.abs(frame.nodes[-1] - frame.nodes[0]).max() > 0.1


def test_rigid_bounce_follows_the_coefficient():
    jump = []
    for bounce in (0.1, 0.4, 0.7):
        (vertices,), _ = move([rigid("ball", 1.0, bounce=bounce)], 40, fps=42.0, max_timestep=1 / 960)
        centre = vertices[..., 2].mean(1)
        landed = centre[:25].argmin()
        jump.append(centre[landed:].max() - centre[landed])
    assert jump[2] > 1.5 * jump[1] > 1.5 * 1.5 * jump[0]


def test_thrown_rigid_body_follows_a_parabola():
    velocity, spin = np.array([1.0, -0.5, 2.0]), np.array([0.0, 4.0, 1.0])
    (vertices,), _ = move([rigid("box", 1.0, velocity=velocity, spin=spin)], 8, ground=None, max_timestep=1 / 960)
    time = np.arange(8)[:, None] / FPS
    expected = vertices[0].mean(0) + velocity * time - [0, 0, 9.81 / 2] * time**2
    np.testing.assert_allclose(vertices.mean(1), expected, atol=5e-3)
    turned = np.arccos((np.trace(_rotation(vertices[0], vertices[-1])) - 1) / 2)
    np.testing.assert_allclose(turned, np.linalg.norm(spin) * 7 / FPS, atol=0.03)


def _rotation(before, after):
    u, _, v = np.linalg.svd((before - before.mean(0)).T @ (after - after.mean(0)))
    return v.T @ np.diag([1, 1, np.linalg.det(v.T @ u.T)]) @ u.T


def test_rigid_bodies_do_not_interpenetrate():
    pairs = [[soft("ball", z, size=0.5, mass=5.0) for z in (0.3, 1.0)], [rigid("ball", z) for z in (0.3, 1.0)]]
    for cast in pairs:
        moved, _ = move(cast, 24, fps=42.0)
        apart = np.linalg.norm(moved[0].mean(1) - moved[1].mean(1), axis=1)
        assert 0.3 < apart.min() < 0.52


@pytest.fixture(scope="module")
def on_cloth():
    cloth = scene_setup.Cloth(1.7, 0.8, 13, mass=0.8, young=6e4, thickness=0.008, damping=0.015)
    cast = [soft("ball", 1.15, size=0.5, mass=2.0)]
    moved, carried = move(cast, 36, cloth=cloth, fps=42.0, max_timestep=1 / 504)
    return moved, carried[-1], cloth


def test_cloth_carries_a_body(on_cloth):
    (body,), sheet, cloth = on_cloth
    corners = sheet.nodes[:, [0, 0, -1, -1], [0, -1, 0, -1]]
    np.testing.assert_allclose(corners, np.broadcast_to(corners[0], corners.shape), atol=1e-6)
    np.testing.assert_allclose(sheet.nodes[0, ..., 2], cloth.height)
    sag = cloth.height - sheet.nodes[..., 2].min((1, 2))
    assert sag.max() > 0.15 and sheet.nodes[..., 2].min() > 0
    fine = np.stack([sheet.refine(3).move(nodes) for nodes in sheet.nodes]).reshape(36, 37, 37, 3)
    scene_setup.check_cloth([body], fine, 0.0)
    with pytest.raises(scene_setup.Unstable, match="through the cloth"):
        scene_setup.check_cloth([body - [0, 0, 0.1]], fine, 0.0)
    with pytest.raises(scene_setup.Unstable, match="the cloth sank"):
        scene_setup.check_cloth([body], fine - [0, 0, 0.8], 0.0)


def test_refined_cloth_passes_through_its_nodes(on_cloth):
    _, sheet, _ = on_cloth
    nodes = sheet.nodes[-1]
    fine = sheet.refine(3).move(nodes).reshape(37, 37, 3)
    np.testing.assert_allclose(fine[::3, ::3], nodes, atol=1e-12)
    plane = np.einsum("ij,abj->abi", np.diag([2.0, 0.5, 1.0]), sheet.nodes[0]) + [1, 2, 3]
    flat = sheet.refine(3).move(plane).reshape(37, 37, 3)
    np.testing.assert_allclose(np.diff(flat, 2, axis=0), 0, atol=1e-12)  # straight lines stay straight, borders too


def test_bound_points_equal_the_mesh_at_rest(motion, ball):
    np.testing.assert_allclose(motion[1][0], ball[0], atol=TOLERANCES["generate_binding"].value)


def test_bindings_reproduce_rigid_motions(motion, ball):
    points = np.concatenate([ball[0], ball[0] * 1.3 - 0.2])  # also outside the grid
    particles = np.random.default_rng(0).normal(0, 0.2, (1, 300, 3)) + [0, 0, 0.95]
    axes = np.concatenate([np.zeros((1, 3)), np.eye(3)])[None]
    for tie in (motion[0], embedding.ParticleCloud(particles), embedding.RigidFrame(axes)):
        binding = tie.bind(points)
        rotation = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))[0]
        rotation *= np.linalg.det(rotation)
        moved = binding.move(tie.nodes[0] @ rotation.T + [3.0, -1.0, 2.0])
        expected = points @ rotation.T + [3.0, -1.0, 2.0]
        np.testing.assert_allclose(moved, expected, atol=TOLERANCES["generate_binding"].value)


@pytest.mark.parametrize("cells", [1, 3, 4])
def test_bound_points_follow_the_simulated_mesh(ball, cells):
    """The collision mesh, bound like any other points, is where MuJoCo has it.

    With 4 cells some corners of the box hold nothing: their nodes are welded to the world or drift freely.
    """
    import mujoco

    body = dataclasses.replace(ball[1], cells=cells)
    (moved,), _ = move([(body.vertices, body)], 12)
    setting = scene_setup.SceneSetup((body,), 0.0)
    model = mujoco.MjModel.from_xml_string(mujoco_engine.model_xml(setting, 1 / 480))
    data = mujoco.MjData(model)
    for _ in range(11):
        mujoco.mj_step(model, data, 20)
    mujoco.mj_forward(model, data)
    nearest = np.linalg.norm(moved[-1][:, None] - data.flexvert_xpos[None], axis=-1).min(1)
    assert nearest.max() < 1e-5


def test_control_grid_binds_to_occupied_cells_only():
    rest = np.stack(np.meshgrid(*[np.linspace(0, 1, 4)] * 3, indexing="ij"), -1)
    occupied = np.zeros((3, 3, 3), dtype=bool)
    occupied[1, 1, 1] = True
    points = np.random.default_rng(0).uniform(-0.2, 1.2, (50, 3))
    binding = embedding.ControlGrid(rest[None], occupied, points).bind(points)
    np.testing.assert_allclose(binding.move(rest), points, atol=1e-12)
    assert set(np.unique(binding.corners)) == {(x * 4 + y) * 4 + z for x in (1, 2) for y in (1, 2) for z in (1, 2)}


def test_states_hold_nodes_that_hardly_move_a_vertex():
    rest = np.stack(np.meshgrid(*[np.linspace(0, 1, 4)] * 3, indexing="ij"), -1)
    vertices = np.stack(np.meshgrid(*[[0, 0.3, 0.7, 1]] * 3, indexing="ij"), -1).reshape(-1, 3)
    vertices = vertices[vertices.max(1) < 1]  # none near the nodes of three sides
    nodes = np.stack([rest, rest + 1])
    nodes[1, 3, 3, 3] -= 20  # without a vertex nearby
    nodes[1, 0, 0, 0] += 0.1  # at a vertex
    grid = embedding.ControlGrid(nodes, np.ones((3, 3, 3), dtype=bool), vertices)
    found = embedding.states(grid)
    assert found.dtype == np.float32
    np.testing.assert_allclose(found[0], rest, atol=1e-6)
    np.testing.assert_allclose(found[1, 3, 3, 3], [2, 2, 2], atol=1e-5)
    np.testing.assert_allclose(found[1, 0, 0, 0], [1.1, 1.1, 1.1], atol=1e-6)


def test_points_bind_to_a_deformed_control_grid(motion):
    grid, vertices = motion
    nodes = embedding.states(grid)
    before, after = (np.linalg.norm(nodes[step, 3, 0, 0] - nodes[step, 0, 0, 0]) for step in (0, 15))
    assert abs(after / before - 1) > 0.01
    for step in (3, 15):
        binding = embedding.bind_deformed(nodes[step], vertices[step])
        np.testing.assert_allclose(binding.move(nodes[step]), vertices[step], atol=1e-6)
        for later in (0, 8, 15):
            off = np.linalg.norm(binding.move(nodes[later]) - vertices[later], axis=1)
            assert off.mean() < 1e-3, (step, later)
    beside = vertices[15] + np.random.default_rng(0).normal(size=vertices[15].shape) * 0.02  # inside and outside
    np.testing.assert_allclose(embedding.bind_deformed(nodes[15], beside).move(nodes[15]), beside, atol=1e-6)


def test_simulation_repeats_bit_by_bit(motion, ball):
    assert np.array_equal(motion[0].nodes, move([ball], 16)[1][0].nodes)


def test_simulation_starts_with_velocity_and_spin(ball):
    velocity, spin = np.array([0.3, -0.2, 0.0]), np.array([0.0, 0.0, 1.0])
    body = dataclasses.replace(ball[1], velocity=velocity, spin=spin)
    (moved,), _ = move([(body.vertices, body)], 3)
    centre = body.vertices.mean(0)
    np.testing.assert_allclose(moved[2].mean(0) - centre, velocity * 2 / FPS - [0, 0, 9.81 * 2 / FPS**2], atol=3e-3)
    sideways = np.argmax(body.vertices[:, 0])
    arm = body.vertices[sideways] - centre
    turned = moved[2][sideways] - moved[2].mean(0)
    angle = np.arctan2(turned[1], turned[0]) - np.arctan2(arm[1], arm[0])
    np.testing.assert_allclose(angle, 2 / FPS, atol=5e-3)


@pytest.mark.parametrize(
    "spoil, message",
    [
        (lambda v: v * np.nan, "not finite"),
        (lambda v: v * np.linspace(1, 3, len(v))[:, None, None], "torn"),
        (lambda v: v * np.linspace(1, 0.2, len(v))[:, None, None], "crushed"),
        (lambda v: v - [0, 0, 2.0], "sank"),
    ],
)
def test_check_motion_rejects_broken_bodies(motion, spoil, message):
    scene_setup.check_motion(motion[1], 0.0)
    with pytest.raises(scene_setup.Unstable, match=message):
        scene_setup.check_motion(spoil(motion[1]), 0.0)
