"""Motion: free fall, contact, deformation; and visual points bound to the control lattice."""

import dataclasses

import numpy as np
import pytest

from gsim3d.generate import physics, shapes
from tests.tolerances import TOLERANCES

FPS, DROP = 24.0, 0.6


@pytest.fixture(scope="module")
def ball():
    body = shapes.procedural_body("ball", np.random.default_rng(0))
    return body, 0.7 * body.vertices + [0, 0, DROP + 0.35]


@pytest.fixture(scope="module")
def fall(ball):
    body, _ = ball
    vertices = 0.7 * body.collision_vertices + [0, 0, DROP + 0.35]
    still = np.zeros(3)
    return physics.Fall(vertices, body.collision_faces, still, still, young=7e3, damping=0.01, mass=15.0, cells=3)


@pytest.fixture(scope="module")
def motion(fall, ball):
    lattice = physics.simulate(fall, 16, FPS, 1 / 480)
    binding = physics.bind(ball[1], lattice.nodes[0], lattice.occupied)
    return lattice, np.stack([binding.move(nodes) for nodes in lattice.nodes])


def test_free_fall(motion):
    _, vertices = motion
    time = np.arange(8) / FPS
    fallen = vertices[0].mean(0) - vertices[:8].mean(1)
    np.testing.assert_allclose(fallen[:, 2], 9.81 * time**2 / 2, atol=TOLERANCES["generate_free_fall"].value)
    np.testing.assert_allclose(fallen[:, :2], 0, atol=1e-6)


def test_the_body_lands_is_squeezed_and_jumps_back(motion):
    _, vertices = motion
    lowest, height = vertices[..., 2].min(1), np.ptp(vertices[..., 2], axis=1)
    assert lowest.min() > -0.03  # centimetres into the ground at impact, a pixel at most
    assert height.min() < 0.75 * height[0]
    squeezed = height.argmin()
    assert lowest[squeezed] < 0.02 and height[squeezed:].max() > 0.93 * height[0]
    wide = np.ptp(vertices[squeezed, :, 0])
    assert wide > 1.02 * np.ptp(vertices[0, :, 0])


def test_points_equal_the_mesh_at_rest(motion, ball):
    _, vertices = motion
    np.testing.assert_allclose(vertices[0], ball[1], atol=TOLERANCES["generate_binding"].value)


def test_rigid_motion_of_the_nodes_moves_points_rigidly(motion, ball):
    lattice, _ = motion
    points = np.concatenate([ball[1], ball[1] * 1.3 - 0.2])  # also outside the lattice
    binding = physics.bind(points, lattice.nodes[0], lattice.occupied)
    rotation = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))[0]
    rotation *= np.linalg.det(rotation)
    moved = binding.move(lattice.nodes[0] @ rotation.T + [3.0, -1.0, 2.0])
    expected = points @ rotation.T + [3.0, -1.0, 2.0]
    np.testing.assert_allclose(moved, expected, atol=TOLERANCES["generate_binding"].value)


@pytest.mark.parametrize("cells", [1, 3, 4])
def test_points_follow_the_simulated_mesh(fall, cells):
    """The collision mesh, bound like any other points, is where MuJoCo has it.

    With 4 cells some corners of the box hold nothing: their nodes are welded to the world or drift freely.
    """
    import mujoco

    fall = dataclasses.replace(fall, cells=cells)
    lattice = physics.simulate(fall, 12, FPS, 1 / 480)
    binding = physics.bind(fall.vertices, lattice.nodes[0], lattice.occupied)
    model = mujoco.MjModel.from_xml_string(physics._model_xml(fall, 1 / 480))
    data = mujoco.MjData(model)
    for _ in range(11):
        mujoco.mj_step(model, data, 20)
    mujoco.mj_forward(model, data)
    moved = binding.move(lattice.nodes[-1])
    nearest = np.linalg.norm(moved[:, None] - data.flexvert_xpos[None], axis=-1).min(1)
    assert nearest.max() < 1e-5


def test_points_are_bound_to_occupied_cells_only():
    rest = np.stack(np.meshgrid(*[np.linspace(0, 1, 4)] * 3, indexing="ij"), -1)
    occupied = np.zeros((3, 3, 3), dtype=bool)
    occupied[1, 1, 1] = True
    points = np.random.default_rng(0).uniform(-0.2, 1.2, (50, 3))
    binding = physics.bind(points, rest, occupied)
    np.testing.assert_allclose(binding.move(rest), points, atol=1e-12)
    assert set(np.unique(binding.corners)) == {(x * 4 + y) * 4 + z for x in (1, 2) for y in (1, 2) for z in (1, 2)}


def test_the_same_bits_twice(fall):
    first, second = (physics.simulate(fall, 14, FPS, 1 / 480).nodes for _ in range(2))
    assert np.array_equal(first, second)


def test_start_velocity_and_spin(fall):
    velocity, spin = np.array([0.3, -0.2, 0.0]), np.array([0.0, 0.0, 1.0])
    moving = dataclasses.replace(fall, velocity=velocity, spin=spin)
    lattice = physics.simulate(moving, 3, FPS, 1 / 480)
    moved = physics.bind(fall.vertices, lattice.nodes[0], lattice.occupied).move(lattice.nodes[2])
    centre = fall.vertices.mean(0)
    np.testing.assert_allclose(moved.mean(0) - centre, velocity * 2 / FPS - [0, 0, 9.81 * 2 / FPS**2], atol=3e-3)
    sideways = np.argmax(fall.vertices[:, 0])
    arm = fall.vertices[sideways] - centre
    turned = moved[sideways] - moved.mean(0)
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
def test_motion_that_is_no_motion(motion, spoil, message):
    physics.check_motion(motion[1])
    with pytest.raises(physics.Unstable, match=message):
        physics.check_motion(spoil(motion[1]))
