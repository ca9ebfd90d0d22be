"""Inertia: rigid velocity fields, gains and orientations."""

import dataclasses

import pytest
import torch

from gsim3d.dynamics import rollout
from gsim3d.effects.edits import Rotate, Throw
from gsim3d.math.rotations import rotation_matrices
from gsim3d.priors import InertiaConfig
from gsim3d.priors.inertia import rotate_with_window
from gsim3d.state import DYNAMIC, FROZEN, last_steps, with_attribute
from tests.asserts import assert_close_relative_to_max, assert_same_bits
from tests.dynamics.scenes import TINY, batch, make_dynamics, make_history
from tests.priors.scenes import build, context, windows, with_priors

pytestmark = pytest.mark.usefixtures("one_thread")

LENGTH = 0.2
CARRYING = with_priors(TINY, InertiaConfig(radius=LENGTH))
VELOCITY, SPIN = (0.03, -0.02, 0.05), (0.0, 0.08, 0.04)


def velocities(history, radius=LENGTH, priors=None):
    ctx = context(history, InertiaConfig(radius=radius), grid_size=TINY.grid_size, priors=priors)
    return ctx.priors.get("inertia").velocities(ctx)


def cross_matrix(w):
    return torch.linalg.cross(torch.tensor(w).expand(3, 3), torch.eye(3)).T


def turning(n_steps, n=200, velocity=VELOCITY, spin=SPIN, seed=0):
    """A ball of 20 cm that translates and rotates for ``n_steps``."""
    g = torch.Generator().manual_seed(seed)
    ball = torch.nn.functional.normalize(torch.randn(n, 3, generator=g), dim=1) * 0.2
    history = make_history((n,) * n_steps, seed=seed, frozen_share=0.0)
    steps = [
        1.0 + k * torch.tensor(velocity) + ball @ torch.linalg.matrix_exp(k * cross_matrix(spin)).T
        for k in range(n_steps)
    ]
    return dataclasses.replace(history, means=torch.cat(steps))


def flying(n_steps=2, **options):
    """As :func:`turning`, with the velocities of the last step."""
    history = turning(n_steps, **options)
    steps = history.means.unflatten(0, (n_steps, -1))
    velocity = torch.cat([torch.zeros_like(steps[:1]), steps[1:] - steps[:-1]])
    return dataclasses.replace(history, velocity=velocity.flatten(0, 1))


def test_velocities_continue_rigid_motion():
    history = flying()
    moved, rigid, own = velocities(history).unbind(1)
    n = history.clouds.count(1)
    assert_same_bits(own, history.velocity[-n:])
    assert_close_relative_to_max(rigid, turning(3).means[-n:] - history.means[-n:], 0.02)
    assert_close_relative_to_max(moved.mean(0), torch.tensor(VELOCITY), 0.1)


@pytest.mark.parametrize("squashed", [1.0, 0.2])
def test_tumbling_body(squashed):
    """For any shape: displacements are chords of a rotation by half a radian."""
    spin, size = (0.3, 0.0, -0.4), torch.tensor([1.0, 1.0, squashed])
    turn = torch.linalg.matrix_exp(cross_matrix(spin))
    now = (turning(1).means - 1 - 0.2) * size
    places, way = 1 + now, torch.tensor(VELOCITY) + now - now @ turn
    history = dataclasses.replace(turning(1), means=places, velocity=way)
    moved, rigid, _ = velocities(history, radius=2.0).unbind(1)
    arms = now - now.mean(0)
    assert_close_relative_to_max(moved, way.mean(0).expand_as(moved), 0.02)
    assert_close_relative_to_max(rigid, way.mean(0) + arms @ turn.T - arms, 0.02)


def test_untrained_rollout_continues_rigid_motion():
    dynamics = make_dynamics(dataclasses.replace(CARRYING, zero_init=True))
    steps = rollout(dynamics, flying(), 6, max_steps=2)
    assert_close_relative_to_max(steps[-1].means - 1, turning(8).means[1400:] - 1, 0.03)
    assert_same_bits(steps[-1].velocity, steps[-1].means - steps[-2].means)


def test_velocity_is_last_displacement():
    dynamics, history = make_dynamics(CARRYING), with_attribute(make_history((60, 60)), "velocity")
    step = dynamics(history)
    assert_same_bits(step.velocity, step.means - last_steps(history, 1).means)
    assert step.velocity[step.activity == DYNAMIC].any() and not step.velocity[step.activity == FROZEN].any()


def test_particles_without_velocity_rest():
    history = turning(2)
    assert history.velocity is None and not velocities(history).any()


def test_impulse_changes_velocity_of_whole_body():
    """For any history."""
    still = torch.tensor([0.0, 0.01, 0.0]).expand(200, 3)
    history = flying()
    history = dataclasses.replace(history, velocity=torch.cat([history.velocity[:200], still]))
    moved, rigid, own = velocities(history).unbind(1)
    assert_same_bits(own, still)
    assert_close_relative_to_max(moved, still, 1e-3)
    assert_close_relative_to_max(rigid, still, 1e-3)


def test_stopped_particles_turn_body():
    """Friction stops the lower particles, so the body tips over."""
    before = turning(1)
    low = before.means[:, 2] < 0.85
    assert 10 < low.sum() < 60
    step = torch.where(low[:, None], 0.0, torch.tensor([0.04, 0.0, 0.0]))
    rigid = velocities(dataclasses.replace(before, velocity=step))[:, 1]
    assert rigid[before.means[:, 2] > 1.15, 0].mean() > 0.038 and rigid[low, 0].mean() < 0.03
    assert_close_relative_to_max(rigid.mean(0), step.mean(0), 0.2)


def test_invalid_position_changes_no_other_particle():
    """Neither features nor gradients of others change."""
    history = flying()
    means = history.means.clone()
    means[250] = torch.nan
    broken = dataclasses.replace(history, means=means, velocity=history.velocity.clone().requires_grad_())
    rigid = velocities(broken)[:, 1]
    others = torch.arange(200) != 50
    assert rigid.isfinite().all()
    assert_close_relative_to_max(rigid[others], velocities(history)[others, 1], 0.02)
    rigid.sum().backward()
    assert broken.velocity.grad.isfinite().all()


@pytest.mark.parametrize("n", [40, 1500])
def test_gradients_of_velocities(n):
    """With 1,500 particles and 1,024 samples."""
    history = flying(n=n)
    history = dataclasses.replace(history, means=history.means.double())
    velocity = history.velocity.double().requires_grad_()

    def of(velocity):
        return velocities(dataclasses.replace(history, velocity=velocity))

    assert torch.autograd.gradcheck(of, (velocity,), atol=1e-6, fast_mode=n > 100)


def test_velocity_gradient_over_rollout():
    dynamics, history = make_dynamics(dataclasses.replace(CARRYING, zero_init=True)), flying()
    velocity = history.velocity.requires_grad_()
    end = rollout(dynamics, history, 4, max_steps=2)[-1]
    (gradient,) = torch.autograd.grad(end.means[:, 0].sum(), [velocity])
    assert_close_relative_to_max(gradient[-200:, 0].sum(), torch.tensor(800.0), 0.05)


def test_free_body_keeps_spin():
    dynamics = make_dynamics(dataclasses.replace(CARRYING, zero_init=True))
    steps = rollout(dynamics, flying(2, velocity=(0.0, 0.0, 0.0), spin=(0.0, 0.03, 0.0)), 20, max_steps=2)
    before, after = (step.means - step.means.mean(0) for step in steps[-2:])
    turned = torch.linalg.cross(before, after).mean(0)[1] / before[:, [0, 2]].square().sum(1).mean()
    assert 0.97 < turned / 0.03 < 1.03


@pytest.mark.parametrize("of", [0, 1, 2])
def test_gains_scale_each_velocity(of):
    dynamics, history = make_dynamics(dataclasses.replace(CARRYING, zero_init=True)), flying(3)
    motions = velocities(history)
    dynamics.priors.get("inertia").gain_head.bias.detach()[3 * of : 3 * of + 3] = 2 * torch.tensor(-0.2).atanh()
    expected = motions[:, 1] - 0.4 * motions[:, of]
    assert_close_relative_to_max(dynamics(history).means - last_steps(history, 1).means, expected, 1e-3)


def test_batch_equals_single_scenes():
    scenes = [flying(seed=1), flying(velocity=(0.0, 0.0, -0.05), seed=2)]
    together = velocities(batch(scenes))
    assert_close_relative_to_max(together, torch.cat([velocities(scene) for scene in scenes]), 1e-5)


def test_edits_of_velocities():
    history = flying()
    turned = Rotate(axis=(0.0, 0.0, 1.0), degrees=90).apply(history, None)
    assert_close_relative_to_max(turned.velocity[:, 1], history.velocity[:, 0], 1e-6)
    thrown = Throw(velocity=(0.0, 0.02, 0.0)).apply(history, None)
    added = torch.tensor([0.0, 0.02, 0.0]).expand(400, 3)
    assert_close_relative_to_max(thrown.velocity - history.velocity, added, 1e-5)


def test_network_reads_features():
    """Zeroing the projections of the features changes the prediction."""
    dynamics, history = make_dynamics(CARRYING), flying()
    torch.nn.init.normal_(dynamics.priors.get("inertia").in_proj.weight)
    step = dynamics(history)
    with torch.no_grad():
        dynamics.priors.get("inertia").in_proj.weight[:] = 0
    assert (dynamics(history).dynamic_latents - step.dynamic_latents).abs().max() > 1e-6


def test_on_gpu(devices):
    expected, actual = (velocities(flying().to(device)).cpu() for device in devices)
    assert_close_relative_to_max(actual, expected, 1e-5)


def test_compiled(device):
    history = flying().to(device)
    history.clouds
    priors, compiled = build(history, InertiaConfig(radius=LENGTH)), torch.compile(velocities, fullgraph=True)
    assert_close_relative_to_max(compiled(history, priors=priors), velocities(history), 1e-4)


TURNING = with_priors(TINY, InertiaConfig(radius=LENGTH, rotate_appearance=True), zero_init=True)


def test_orientations_follow_body():
    """Also after an edit that rotates the body."""
    history = flying()
    frozen = torch.arange(400) % 200 < 5
    history = dataclasses.replace(history, activity=torch.where(frozen, FROZEN, history.activity).to(torch.uint8))
    steps = rollout(make_dynamics(TURNING), history, 6, max_steps=2)
    expected = torch.linalg.matrix_exp(6 * cross_matrix(SPIN))
    found = rotation_matrices(steps[-1].orientations)
    assert_close_relative_to_max(found[5:], expected.expand(195, 3, 3), 0.02)
    assert_same_bits(steps[-1].orientations[:5], torch.tensor([1.0, 0, 0, 0]).expand(5, 4))
    edited = Rotate(axis=(1.0, 0.0, 0.0), degrees=90.0).apply(history, None)
    again = rollout(make_dynamics(TURNING), edited, 1, max_steps=2)[0].orientations
    about_x = torch.linalg.matrix_exp(cross_matrix((torch.pi / 2, 0.0, 0.0)))
    one = about_x @ torch.linalg.matrix_exp(cross_matrix(SPIN)) @ about_x.T @ about_x
    assert_close_relative_to_max(rotation_matrices(again)[5:], one.expand(195, 3, 3), 0.02)


def test_orientations_absent_without_rotated_appearance():
    assert make_dynamics(CARRYING)(flying()).orientations is None


def test_orientations_of_empty_or_invalid_scene():
    """Also with invalid positions."""
    history = flying()
    empty = history.select_rows(torch.zeros(history.n_rows, dtype=torch.bool))
    assert make_dynamics(TURNING)(empty).orientations.shape == (0, 4)
    means = history.means.clone()
    means[250] = torch.nan
    found = make_dynamics(TURNING)(dataclasses.replace(history, means=means)).orientations
    assert_same_bits(found[50], torch.tensor([1.0, 0, 0, 0]))
    others = torch.arange(200) != 50
    assert_close_relative_to_max(found[others], make_dynamics(TURNING)(history).orientations[others], 0.02)


def test_orientations_of_batch_equal_single_scenes():
    one, other = flying(), flying(n=150, seed=3, spin=(0.1, 0.0, 0.0))
    both = make_dynamics(TURNING)(batch([one, other])).orientations
    alone = torch.cat([make_dynamics(TURNING)(q).orientations for q in (one, other)])
    assert_close_relative_to_max(both, alone, 1e-5)


def test_orientations_on_gpu(devices):
    history = flying()
    expected, actual, again = (
        make_dynamics(TURNING).to(d)(history.to(d)).orientations.cpu() for d in (*devices, devices[1])
    )
    assert_close_relative_to_max(actual, expected, 1e-4)
    assert_same_bits(again, actual)


def test_orientations_compiled(device):
    history = flying().to(device)
    last = last_steps(history, 1)
    last.clouds
    turns, moved = torch.tensor([1.0, 0, 0, 0], device=device).expand(200, 4), history.velocity[200:]

    def found(turns, moved, last):
        return rotate_with_window(windows(last, LENGTH, TINY.grid_size), turns, moved)

    expected = found(turns, moved, last)
    assert_close_relative_to_max(torch.compile(found, fullgraph=True)(turns, moved, last), expected, 1e-5)


@pytest.mark.parametrize("change", [{"explicit": True}, {"steps_per_call": 2}])
def test_rotated_appearance_needs_latent_model_and_one_step_a_call(change):
    with pytest.raises(ValueError, match="prior inertia needs"):
        dataclasses.replace(TURNING, **change)
