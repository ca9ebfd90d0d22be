"""Particles become Gaussians, Gaussians become images."""

import dataclasses

import pytest
import torch

from gsim3d import ops
from gsim3d.cameras import Cameras
from gsim3d.math.rotations import rotation_matrices, unit_quats
from gsim3d.math.spherical_harmonics import sh_basis
from gsim3d.nn.gaussian_head import GaussianHead, RendererConfig, render
from tests.asserts import assert_close_relative_to_max, assert_same_bits
from tests.dynamics.scenes import EXPLICIT, TINY, make_history

CONFIG = RendererConfig(latents=7, sh_degree=2, scale_min=0.001, scale_max=0.1, initial_scale=0.03)


def make_head(config=CONFIG, dtype=torch.float32):
    torch.manual_seed(0)
    return GaussianHead(config).to(dtype)


def make_cameras(n=1, size=24, near=0.5):
    viewmats = torch.eye(4).repeat(n, 1, 1)
    viewmats[:, :3, 3] = torch.tensor([-0.5, -0.5, 1.5])
    K = torch.tensor([[1.5 * size, 0, size / 2], [0, 1.5 * size, size / 2], [0, 0, 1]])
    ones = torch.ones(n)
    return Cameras(viewmats, K.repeat(n, 1, 1), near * ones, 5 * ones, torch.arange(n), size, size)


def test_gaussians_keep_place_and_opacity_and_stay_in_their_limits():
    particles = make_history((30, 20))
    gaussians = make_head()(particles)
    assert_same_bits(gaussians.means, particles.means)
    assert_same_bits(gaussians.opacities, particles.opacities)
    assert_same_bits(gaussians.cu_rows, particles.cu_rows)
    assert gaussians.sh.shape == (50, 9, 3)
    assert gaussians.scales.min() > CONFIG.scale_min and gaussians.scales.max() < CONFIG.scale_max
    assert_close_relative_to_max(gaussians.quats.norm(dim=1), torch.ones(50), 1e-6)


def test_head_without_latents_starts_at_identity_and_initial_scale():
    particles = make_history((5,))
    zero = dataclasses.replace(particles, dynamic_latents=torch.zeros(5, 4), static_latents=torch.zeros(5, 3))
    head = make_head()
    torch.nn.init.zeros_(head.fc1.bias)
    gaussians = head(zero)
    assert_close_relative_to_max(gaussians.scales, torch.full((5, 3), 0.03), 1e-6)
    assert gaussians.quats[0].tolist() == [1, 0, 0, 0]


def test_colours_turn_with_the_particle():
    head, particles = make_head(dtype=torch.float64), make_history((10,), dtype=torch.float64)
    gaussians = head(particles)
    latents = torch.cat([particles.dynamic_latents, particles.static_latents], 1)
    plain = head.fc2(torch.nn.functional.gelu(head.fc1(latents)))
    assert plain.shape == (10, 3 * 9 + 4 + 3)
    damping = torch.tensor([1.0] + [0.025] * 3 + [0.00625] * 5, dtype=torch.float64)
    own = plain[:, :27].unflatten(1, (3, 9)).mT * damping[:, None]
    d = torch.nn.functional.normalize(torch.randn(10, 3, dtype=torch.float64), dim=1)
    turned = (rotation_matrices(gaussians.quats) @ d[:, :, None])[..., 0]
    seen = torch.einsum("nk,nkc->nc", sh_basis(turned, 2), gaussians.sh)
    assert_close_relative_to_max(seen, torch.einsum("nk,nkc->nc", sh_basis(d, 2), own), 1e-12)


@pytest.mark.parametrize("degree", [0, 1, 2])
def test_rotated_appearance_is_seen_from_rotated_direction(degree):
    """Gaussians and colours of a particle that is turned further are its own, seen from as far round."""
    head, particles = make_head(dtype=torch.float64), make_history((10,), dtype=torch.float64)
    turns = torch.nn.functional.normalize(torch.randn(10, 4, dtype=torch.float64), dim=1)
    before = head(particles, sh_degree=degree)
    after = head(dataclasses.replace(particles, orientations=turns), sh_degree=degree)
    turn = rotation_matrices(turns)
    assert_close_relative_to_max(rotation_matrices(after.quats), turn @ rotation_matrices(before.quats), 1e-12)
    assert_same_bits(after.scales, before.scales)
    d = torch.nn.functional.normalize(torch.randn(10, 3, dtype=torch.float64), dim=1)
    seen = torch.einsum("nk,nkc->nc", sh_basis((turn @ d[:, :, None])[..., 0], degree), after.sh)
    assert_close_relative_to_max(seen, torch.einsum("nk,nkc->nc", sh_basis(d, degree), before.sh), 1e-12)


@pytest.mark.parametrize("config", [CONFIG, RendererConfig(latents=0, sh_degree=1)])
def test_light_multiplies_the_colours_that_are_seen_from_anywhere(config):
    """Also those of paint, and nothing else."""
    particles, head = make_history((10,), config=TINY if config.latents else EXPLICIT), make_head(config)
    light, paint = torch.rand(10, 3) + 0.5, torch.rand(10, 3, 3)
    d = torch.nn.functional.normalize(torch.randn(10, 3), dim=1)

    def colours(**look):
        gaussians = head(dataclasses.replace(particles, **look))
        return 0.5 + torch.einsum("nk,nkc->nc", sh_basis(d, config.sh_degree), gaussians.sh), gaussians

    for look in ({}, {"color_transform": paint}):
        (plain, before), (seen, gaussians) = colours(**look), colours(**look, irradiance_gain=light)
        assert_close_relative_to_max(seen, light * plain, 1e-5)
        assert_same_bits(gaussians.scales, before.scales)
        assert_same_bits(gaussians.opacities, before.opacities)


def test_explicit_particles_are_gaussians_already():
    particles = make_history((10,), config=EXPLICIT)
    head = GaussianHead(RendererConfig(latents=0, sh_degree=1))
    assert not list(head.parameters())
    gaussians = head(particles)
    assert_same_bits(gaussians.sh, particles.sh)
    assert gaussians.quats is particles.quats and gaussians.scales is particles.scales


def test_lower_degrees_are_the_first_coefficients():
    particles, head = make_history((10,)), make_head()
    assert_close_relative_to_max(head(particles, sh_degree=0).sh, head(particles).sh[:, :1], 1e-6)


def test_short_quaternions_are_the_identity_without_gradient():
    quats = torch.tensor([[0.0, 0, 0, 0], [1e-8, 0, 0, 1e-8], [0, 0, 3e-3, 0]], requires_grad=True)
    unit = unit_quats(quats)
    assert unit.tolist() == [[1, 0, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0]]
    unit[:, 1].sum().backward()
    assert torch.isfinite(quats.grad).all() and not quats.grad[:2].any()


def test_each_camera_shows_its_cloud():
    particles, head = make_history((30, 30)), make_head()
    both = render(head(particles), make_cameras(2), torch.tensor([0.0, 0.5, 1.0]))
    assert both.color.shape == (2, 24, 24, 3) and both.alpha.max() > 0.3
    for i in range(2):
        alone = render(head(particles.select_clouds(torch.tensor([i]))), make_cameras(), torch.tensor([0.0, 0.5, 1.0]))
        assert_same_bits(alone.color[0], both.color[i])


def test_no_particles_show_the_background():
    image = render(make_head()(make_history((0,))), make_cameras(), torch.tensor([0.2, 0.4, 0.6]))
    assert_same_bits(image.color, torch.tensor([0.2, 0.4, 0.6]).expand(1, 24, 24, 3).contiguous())


def test_gradients_of_the_head():
    config = dataclasses.replace(CONFIG, sh_degree=1)
    head, particles = make_head(config, torch.float64), make_history((3,), dtype=torch.float64)

    def f(dynamic_latents, static_latents):
        moved = dataclasses.replace(particles, dynamic_latents=dynamic_latents, static_latents=static_latents)
        gaussians = head(moved)
        return gaussians.quats, gaussians.scales, gaussians.sh

    inputs = [t.clone().requires_grad_() for t in (particles.dynamic_latents, particles.static_latents)]
    assert torch.autograd.gradcheck(f, inputs)


def test_render_is_the_op():
    gaussians = make_head()(make_history((10,)))
    expected = ops.rasterize_gaussians(
        gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities, make_cameras(), sh=gaussians.sh
    )
    assert_same_bits(render(gaussians, make_cameras()).color, expected.color)
