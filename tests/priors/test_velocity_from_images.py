"""Velocities of encoded particles by photometric alignment."""

import dataclasses

import pytest
import torch

from gsim3d.cameras import Cameras, Frames
from gsim3d.priors import VelocityFromImagesConfig
from gsim3d.priors.velocity_from_images import estimate_velocity
from gsim3d.state import DYNAMIC, FROZEN, last_steps
from tests.asserts import assert_close_relative_to_max, assert_same_bits
from tests.dynamics.scenes import batch, make_history
from tests.priors.scenes import context

pytestmark = pytest.mark.usefixtures("one_thread")

LENGTH, CELL, STEPS, SIZE, RADIUS = 0.3, 0.02, 4, 64, 0.25
VELOCITY, SPIN = (0.01, -0.005, -0.02), (0.02, -0.03, 0.015)
INSIDE = VelocityFromImagesConfig().inside
LAMP = torch.tensor([0.36, 0.24, 0.9])


def follow(particles, frames, n_views=None, fall=None):
    ctx = context(particles, grid_size=CELL, max_steps=STEPS)
    ctx.n_views = n_views
    return estimate_velocity(ctx, frames, VelocityFromImagesConfig(radius=LENGTH), fall)


def cross_matrix(w):
    return torch.linalg.cross(torch.tensor(w).expand(3, 3), torch.eye(3)).T


def ring(n_views, image_cloud, size=SIZE):
    """``n_views`` cameras a cloud around (1, 1, 1) at a distance of 2 m."""
    viewmats = []
    for k in range(len(image_cloud)):
        angle = torch.tensor(6.2832 * (k % n_views) / n_views + 0.3)
        eye = torch.tensor([2 * angle.cos(), 2 * angle.sin(), 0.8])
        z = torch.nn.functional.normalize(-eye, dim=0)
        x = torch.nn.functional.normalize(torch.linalg.cross(z, torch.tensor([0.0, 0.0, 1.0])), dim=0)
        R = torch.stack([x, torch.linalg.cross(z, x), z])
        viewmat = torch.eye(4)
        viewmat[:3, :3], viewmat[:3, 3] = R, -R @ (eye + 1)
        viewmats.append(viewmat)
    K = torch.tensor([[1.6 * size, 0, size / 2], [0, 1.6 * size, size / 2], [0, 0, 1]])
    n = len(image_cloud)
    near, far = torch.full((n,), 0.5), torch.full((n,), 5.0)
    return Cameras(torch.stack(viewmats), K.expand(n, 3, 3).clone(), near, far, torch.tensor(image_cloud), size, size)


def image_of(camera, viewmat, middle, turn, painted, lit):
    """Image of a ball [3, H, W] and its mask bool [H, W]."""
    v, u = torch.meshgrid(*(torch.arange(camera.height) + 0.5,) * 2, indexing="ij")
    rays = torch.stack([u, v, torch.ones_like(u)], 2) @ torch.linalg.inv(camera.Ks[0]).T @ viewmat[:3, :3]
    rays = torch.nn.functional.normalize(rays, dim=2)
    eye = -viewmat[:3, :3].T @ viewmat[:3, 3] - middle
    along = -(rays @ eye)
    reach = RADIUS**2 - eye.square().sum() + along**2
    normal = (eye + (along - reach.clamp(min=0).sqrt())[..., None] * rays) / RADIUS
    light = 0.3 + 0.7 * (normal @ LAMP).clamp(min=0) if lit else torch.ones_like(along)
    color = painted(RADIUS * normal @ turn) * light[..., None] * (reach > 0)[..., None]
    return color.permute(2, 0, 1), reach > 0


def recorded(velocity=VELOCITY, spin=SPIN, n_steps=4, n=3000, n_views=4, lit=True, seed=0):
    """Images of a textured ball that translates and rotates under a light, and encoded particles of its surface."""
    g = torch.Generator().manual_seed(seed)
    ball = torch.nn.functional.normalize(torch.randn(n, 3, generator=g), dim=1) * (RADIUS - INSIDE)
    waves = 12 * torch.randn(3, 3, generator=g)
    history = make_history((n,) * n_steps, seed=seed, frozen_share=0.0)
    cameras = ring(n_views, [t for t in range(n_steps) for _ in range(n_views)])
    clouds, images = [], []
    for t in range(1 - n_steps, 1):
        turn, middle = torch.linalg.matrix_exp(t * cross_matrix(spin)), 1.0 + t * torch.tensor(velocity)
        clouds.append(ball @ turn.T + middle)
        images += [
            image_of(cameras, viewmat, middle, turn, lambda x: 0.5 + 0.4 * (x @ waves).sin(), lit)
            for viewmat in cameras.viewmats[:n_views]
        ]
    color, shown = (torch.stack(parts) for parts in zip(*images, strict=True))
    particles = dataclasses.replace(history, means=torch.cat(clouds), origin=torch.zeros_like(history.origin))
    return particles, Frames(color, cameras, history.cloud_scene, history.cloud_step, particles.origin, dynamic=shown)


def motion_of(particles, found):
    """Rigid motion fitted to the estimated velocities of the newest cloud."""
    newest = last_steps(particles, 1)
    places = newest.means - newest.means.mean(0)
    fit = torch.linalg.lstsq(torch.cat([places, torch.ones(len(places), 1)], 1), found[-len(places) :]).solution
    B = fit[:3].T
    return fit[3], torch.stack([B[2, 1] - B[1, 2], B[0, 2] - B[2, 0], B[1, 0] - B[0, 1]]) / 2


@pytest.mark.parametrize("spin", [SPIN, (0.0, 0.0, 0.04), (0.0, 0.0, 0.0)])
@pytest.mark.parametrize("lit", [False, True])
def test_velocity_and_spin_under_any_light(spin, lit):
    particles, frames = recorded(spin=spin, lit=lit)
    velocity, turn = motion_of(particles, follow(particles, frames))
    assert (velocity - torch.tensor(VELOCITY)).norm() < 1e-3
    assert (turn - torch.tensor(spin)).norm() < 5e-3


@pytest.mark.parametrize("spin", [(0.0, 0.0, 0.3), (0.25, -0.1, 0.1)])
def test_velocity_of_tumbling_body(spin):
    """A rotation of 0.9 rad since the oldest step needs the spin of the last step as a start."""
    particles, frames = recorded(spin=spin)
    particles = dataclasses.replace(particles, body=torch.ones_like(particles.means))
    found = follow(particles, frames)
    newest = last_steps(particles, 1).means
    back = (newest - 1) @ torch.linalg.matrix_exp(-cross_matrix(spin)).T + 1 - torch.tensor(VELOCITY)
    off = (found[-len(newest) :] - (newest - back)).norm(dim=1)
    assert off.max() < 0.05 * RADIUS * torch.tensor(spin).norm()


def test_noisy_positions():
    """Encoded positions with an error of about 1 cm."""
    particles, frames = recorded()
    noise = 0.01 * torch.randn(particles.means.shape, generator=torch.Generator().manual_seed(1))
    noisy = dataclasses.replace(particles, means=particles.means + noise)
    velocity, turn = motion_of(noisy, follow(noisy, frames))
    assert (velocity - torch.tensor(VELOCITY)).norm() < 2e-3
    assert (turn - torch.tensor(SPIN)).norm() < 8e-3


def test_only_movable_particles_of_newest_cloud():
    particles, frames = recorded()
    activity = particles.activity.clone()
    activity[-500:] = FROZEN
    found = follow(dataclasses.replace(particles, activity=activity), frames)
    n = particles.clouds.count(3)
    assert not found[:-n].any() and not found[-500:].any() and found[-n:-500].any(1).all()
    assert (activity[-n:-500] == DYNAMIC).all()


@pytest.mark.parametrize("n_steps", [2, 4])
def test_gravity_gives_velocity_of_last_step(n_steps):
    """The correction is half of gravity for every step but one between the oldest and the newest."""
    particles, frames = recorded(n_steps=n_steps)
    gravity = torch.tensor([0.001, 0.0, -0.004])
    newest = particles.row_cloud() == n_steps - 1
    falls = gravity.expand(int(newest.sum()), 3)
    mean, last = (follow(particles, frames, fall=f) for f in (None, falls))
    moves = newest & (particles.activity == DYNAMIC)
    assert moves.any() and mean[moves].any()
    torch.testing.assert_close(last[moves], mean[moves] + 0.5 * (n_steps - 2) * gravity)
    assert not last[~moves].any()


def test_one_step_has_no_velocity():
    particles, frames = recorded(n_steps=1)
    assert not follow(particles, frames).any()


def test_older_clouds_are_ignored():
    particles, frames = recorded()
    velocity = 0.01 * torch.rand(3)
    moved = torch.where((particles.row_cloud() == 0)[:, None], particles.means + 20 * velocity, particles.means)
    long_ago = dataclasses.replace(particles, means=moved, cloud_step=torch.tensor([0, 7, 8, 9]), known=None)
    found = follow(long_ago, frames)
    newer = dataclasses.replace(frames, images=frames.images.clone())
    newer.images[:4] = 0.5
    assert_same_bits(follow(long_ago, newer), found)
    velocity, turn = motion_of(particles, found)
    assert (velocity - torch.tensor(VELOCITY)).norm() < 1e-3 and (turn - torch.tensor(SPIN)).norm() < 8e-3


def test_far_from_origin():
    particles, frames = recorded()
    far = torch.tensor([300.0, -200.0, 100.0])
    viewmats = frames.cameras.viewmats.clone()
    viewmats[:, :3, 3] -= viewmats[:, :3, :3] @ far
    moved = dataclasses.replace(particles, means=particles.means + far, origin=particles.origin + far)
    cameras = dataclasses.replace(frames.cameras, viewmats=viewmats)
    found = follow(moved, dataclasses.replace(frames, cameras=cameras, origin=moved.origin))
    assert_close_relative_to_max(found, follow(particles, frames), 0.03)


def test_any_order_of_images():
    particles, frames = recorded()
    expected = follow(particles, frames)
    assert_same_bits(follow(particles, frames, n_views=4), expected)
    order = torch.arange(16).reshape(4, 4).T.flatten()
    mixed = dataclasses.replace(
        frames, images=frames.images[order], cameras=frames.cameras.select(order), dynamic=frames.dynamic[order]
    )
    assert_same_bits(follow(particles, mixed), expected)


def test_fewer_views():
    particles, frames = recorded()
    kept = torch.arange(2, 16)
    fewer = dataclasses.replace(
        frames, images=frames.images[kept], cameras=frames.cameras.select(kept), dynamic=frames.dynamic[kept]
    )
    velocity, turn = motion_of(particles, follow(particles, fewer))
    assert (velocity - torch.tensor(VELOCITY)).norm() < 3e-3 and turn.isfinite().all()


def test_batch_equals_single_scenes():
    one, other = recorded(), recorded(velocity=(0.0, 0.01, 0.0), spin=(0.0, 0.03, 0.0), seed=1)
    particles = batch([one[0], other[0]])
    image_cloud = torch.cat([one[1].cameras.image_cloud, other[1].cameras.image_cloud + 4])
    cameras = ring(4, image_cloud.tolist())
    frames = Frames(
        torch.cat([one[1].images, other[1].images]), cameras, particles.cloud_scene, particles.cloud_step,
        particles.origin, dynamic=torch.cat([one[1].dynamic, other[1].dynamic]),
    )  # fmt: skip
    together = follow(particles, frames)
    alone = torch.cat([follow(*scene) for scene in (one, other)])
    assert_close_relative_to_max(together, alone, 1e-4)


def test_blank_images_leave_displacement_of_means():
    particles, frames = recorded(spin=(0.0, 0.0, 0.0))
    dark = dataclasses.replace(frames, images=torch.zeros_like(frames.images))
    velocity, turn = motion_of(particles, follow(particles, dark))
    assert (velocity - torch.tensor(VELOCITY)).norm() < 1e-4 and turn.norm() < 1e-4


def test_on_gpu(devices):
    particles, frames = recorded()
    expected, actual = (follow(particles.to(d), frames.to(d)).cpu() for d in devices)
    assert_close_relative_to_max(actual, expected, 1e-3)
