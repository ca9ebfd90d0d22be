"""ThrowToTarget and ClothCover in MuJoCo, and what a learned simulator adds for them."""

import dataclasses
import warnings

import numpy as np
import pytest
import torch

gymnasium = pytest.importorskip("gymnasium", reason="needs gymnasium: pip install 'gsim3d[envs]'")
pytest.importorskip("mujoco", reason="needs MuJoCo: pip install 'gsim3d[envs]'")
from gymnasium.utils.env_checker import check_env  # noqa: E402

from gsim3d.envs import ClothCover, ThrowToTarget  # noqa: E402
from gsim3d.envs.cloth import HIGHEST, LOWEST, WORKSPACE  # noqa: E402
from gsim3d.envs.model import ModelScenes, Start  # noqa: E402
from gsim3d.envs.scenes import FPS  # noqa: E402
from gsim3d.state import DYNAMIC  # noqa: E402
from gsim3d.synth.scene_setup import GRAVITY  # noqa: E402
from tests.test_simulator import CONFIG, make_simulator  # noqa: E402

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.mark.parametrize("task", ["ThrowToTarget", "ClothCover"])
def test_gymnasium_finds_no_fault(task):
    env = gymnasium.make(f"gsim3d/{task}-v0", observation="both", image_size=24, render_mode="rgb_array")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(env.unwrapped)


def test_a_throw_is_one_episode_and_the_right_one_reaches_the_target():
    env, rng = ThrowToTarget(), np.random.default_rng(0)
    _, info = env.reset(seed=0)
    assert np.linalg.norm(info["centers"][0] - env.goal) > 0.25 and not info["is_success"]
    mean, spread, best = np.zeros(3), np.ones(3), -np.inf
    for _ in range(5):
        throws = np.clip(mean + spread * rng.normal(size=(16, 3)), -1, 1)
        rewards = []
        for throw in throws:
            env.reset(seed=0)
            _, reward, terminated, truncated, info = env.step(throw)
            assert terminated and not truncated and info["is_success"] == (reward > -0.1)
            rewards.append(reward)
        elites = throws[np.argsort(rewards)[-4:]]
        mean, spread, best = elites.mean(0), elites.std(0) + 0.03, max(best, *rewards)
    assert best > -0.1


def test_a_cloth_that_is_dragged_over_the_region_covers_it():
    env = ClothCover()
    observed, _ = env.reset(seed=2)
    assert env._episodes.distances[0] > 0.8
    ahead = env.goal - observed["particles"][:, :2].mean(0)
    ahead /= np.linalg.norm(ahead)
    aside = np.array([-ahead[1], ahead[0]])
    aside *= np.sign((observed["grippers"][0] - observed["grippers"][1])[:2] @ aside)
    targets = env.goal + 0.38 * ahead + 0.4 * np.stack([aside, -aside])
    for _ in range(60):
        left = targets - observed["grippers"][:, :2]
        down = np.where(np.linalg.norm(left, axis=1) < 0.1, -0.5, 0.0)
        action = np.concatenate([np.clip(left * FPS, -0.5, 0.5), down[:, None]], 1).reshape(6)
        observed, reward, terminated, _, info = env.step(action)
        grippers = observed["grippers"]
        assert (np.linalg.norm(grippers[:, :2], axis=1) < WORKSPACE + 1e-6).all()
        assert (grippers[:, 2] > LOWEST - 1e-6).all() and (grippers[:, 2] < HIGHEST + 1e-6).all()
        if terminated:
            break
    assert info["is_success"] and reward > -0.1


def test_held_corners_follow_the_grippers():
    env = ClothCover()
    env.reset(seed=1)
    scene = env.scenes.all[0]
    for _ in range(4):
        env.step(np.array([0.2, 0.0, 0.1] * 2))
        corners = scene._data.flexvert_xpos[[0, 12]]
        assert np.abs(corners - scene.actors).max() < 0.03


def test_particles_in_a_gripper_become_its_actor():
    scenes = ModelScenes(make_simulator(CONFIG), 1, 1, 16)
    scene = ClothCover.draw(np.random.default_rng(0))
    scenes.reset({0: scene}, {0: np.random.default_rng(0)})
    particles = scenes.state.particles
    row = (particles.activity == DYNAMIC).nonzero()[0, 0]
    particles.means[row] = torch.from_numpy(scene.actors[1]).float() + 0.01
    found = scenes._gripped(particles, torch.full_like(particles.actor, -1), {0: Start([], scene.actors[None], scene)})
    assert found[row] == 1 and (found[particles.activity != DYNAMIC] == -1).all()


def test_a_thrown_body_has_the_history_of_a_free_flight():
    scenes = ModelScenes(make_simulator(CONFIG), 1, 1, 16)
    scenes.reset({0: ThrowToTarget.draw(np.random.default_rng(0))}, {0: np.random.default_rng(0)})
    before, velocity = scenes.state.particles, torch.tensor([[1.0, -0.5, 2.0]], dtype=torch.float64)
    with_velocity = dataclasses.replace(before, velocity=torch.zeros_like(before.means))
    scenes.state = dataclasses.replace(scenes.state, particles=with_velocity)
    scenes.throw(velocity)
    after = scenes.state.particles
    moves, seconds = (after.activity == DYNAMIC)[:, None], (3 - after.row_cloud().double())[:, None] / FPS
    flown = velocity * seconds + 0.5 * GRAVITY * seconds**2 * torch.tensor([0.0, 0.0, 1.0])
    assert torch.allclose((before.means - after.means).double(), torch.where(moves, flown, 0), atol=1e-6)
    last = velocity / FPS + torch.tensor([0.0, 0.0, 0.5 * GRAVITY / FPS**2])
    assert torch.allclose(after.velocity.double(), torch.where(moves, last, 0), atol=1e-6)
