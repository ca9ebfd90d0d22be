"""Each override of the published model, against the model it overrides.

(That all of them together are the published model is shown in tests/golden.)
"""

import dataclasses
from pathlib import Path

import pytest
import torch

import gsim3d.nn.multiview_encoder.depth
from gsim3d import presets
from gsim3d.cameras import Cameras
from gsim3d.compat.released_harmonics import (
    clamp_polar_axis,
    published_axes,
    rotate_released_harmonics,
    rotate_unpaired_harmonics,
)
from gsim3d.compat.released_model import (
    COUNTERPARTS,
    ReleasedDynamicsConfig,
    ReleasedModelConfig,
    ReleasedSimulator,
    as_released,
    released_colors,
    render_released,
    simulator_class,
)
from gsim3d.dynamics.step import StateLayout
from gsim3d.effects.spec import EffectsSpec, OutputEffects, UnsupportedEffect
from gsim3d.io.settings import from_dict, to_dict
from gsim3d.math.rotations import rotation_matrices, unit_quats
from gsim3d.math.spherical_harmonics import rotate_harmonics, sh_basis
from gsim3d.nn.gaussian_head import render
from gsim3d.nn.multiview_encoder.depth import Views
from gsim3d.nn.multiview_encoder.heads import PixelRays
from gsim3d.nn.multiview_encoder.transformer import MASKED, Windows
from gsim3d.ops import build_pyramid
from gsim3d.priors import InertiaConfig
from gsim3d.simulator import Simulator
from gsim3d.state import Gaussians
from tests.asserts import assert_close_relative_to_max, assert_same_bits
from tests.dynamics.scenes import EXPLICIT, TINY, advance, batch, make_dynamics, make_history
from tests.nn.multiview_encoder.scenes import make_encoder, make_frames

ROOT = Path(__file__).parents[2]
either = pytest.mark.parametrize("released", [False, True])


def random(*shape, seed=0):
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def test_every_override_replaces_something_of_its_base_and_is_documented():
    text = next((ROOT / "docs").rglob("differences.md")).read_text()
    for base, released in COUNTERPARTS.items():
        own = {name for name in vars(released) if not name.startswith("__")}
        assert own and all(name in vars(base) or hasattr(base, name) for name in own), released
        assert f"`{released.__name__}`" in text, released


def test_configuration_says_release_with_one_key():
    config = ReleasedModelConfig()
    content = to_dict(config)
    assert content.pop("release") is True and content.keys() == to_dict(presets.ModelConfig()).keys()
    again = from_dict(ReleasedModelConfig, {**content, "release": True}, "model")
    assert again == config and simulator_class(again) is ReleasedSimulator
    assert simulator_class(presets.tiny()) is Simulator


@pytest.mark.parametrize("change", [{"background": "relightable"}, {"priors": (InertiaConfig(),)}])
def test_published_dynamics_have_nothing_beside_the_network(change):
    with pytest.raises(ValueError, match="ReleasedDynamicsConfig"):
        ReleasedDynamicsConfig(**change)


@pytest.mark.parametrize("outputs", [{"features": True}, {"rgb": False}])
def test_published_renderer_draws_colour_alone(outputs):
    simulator = ReleasedSimulator(presets.tiny())
    with pytest.raises(UnsupportedEffect, match="unsupported effect outputs"):
        simulator.plan(EffectsSpec(outputs=OutputEffects(**outputs)))


# ---- Encoder


def encoder_of(released, **options):
    encoder = make_encoder(**options)
    return as_released(encoder) if released else encoder


@either
def test_tiled_shift_mask(released):
    windows = Windows(8, 8, 2)
    tokens = windows.rows * windows.cols
    within = windows.shift_mask(torch.zeros(1))
    mask = encoder_of(released).transformer.cross_mask(within, 3)
    between = mask[0, :, :, tokens:]  # view 0 reads view 2, the second one behind it
    assert within.eq(MASKED).any() and between.eq(MASKED).any()
    assert torch.equal(between, within) == (not released)


@either
def test_integer_pixel_centers(released):
    K = torch.tensor([[[100.0, 0, 30], [0, 90, 20], [0, 0, 1]]], dtype=torch.float64)
    at = encoder_of(released, downscale_factor=4).depth.cost_volume.feature_intrinsics(K) @ torch.linalg.inv(K)
    center = 8.0 if released else 8.5  # where image pixel 8 is thought to be; feature pixel 2 lies there
    expected = torch.tensor([2.5, 2.5, 1.0], dtype=torch.float64)
    assert torch.allclose(at[0] @ torch.tensor([center, center, 1.0], dtype=torch.float64), expected)


@either
def test_reference_intrinsics(released, monkeypatch):
    frames = make_frames([0, 0])
    frames.cameras.Ks[1, 0, 0] *= 2
    targets = []
    original = gsim3d.nn.multiview_encoder.depth.ops.sweep_geometry

    def note(Ks, viewmats, src_images, cu_src, *, Ks_target):
        targets.append((Ks, Ks_target))
        return original(Ks, viewmats, src_images, cu_src, Ks_target=Ks_target)

    monkeypatch.setattr(gsim3d.nn.multiview_encoder.depth.ops, "sweep_geometry", note)
    encoder_of(released)(frames)
    ((Ks, target),) = targets  # view 0 looks into view 1, and the other way
    assert torch.equal(target, Ks if released else Ks.flip(0))


@either
def test_ray_depth(released):
    cameras = make_frames([0, 0]).cameras
    views = Views(torch.zeros(2, 3, 6, 8), cameras.Ks, cameras.viewmats, cameras.near, cameras.far, 2)
    geometry = PixelRays.of(views)
    rays = encoder_of(released).heads._rays(geometry, torch.zeros(2, 2, 6, 8).double())
    depth = torch.einsum("ic,ichw->ihw", geometry.rotations[:, :, 2], rays)
    one = torch.ones(2, 6, 8, dtype=torch.float64)
    assert torch.allclose(rays.norm(dim=1), one) == released
    assert torch.allclose(depth, one) == (not released)


@either
def test_corner_aligned_upsampling(released):
    ramp = torch.arange(5.0).expand(1, 1, 3, 5)
    row = encoder_of(released, downscale_factor=4).depth.upsample(ramp)[0, 0, 0]
    expected = torch.linspace(0, 4, 20) if released else (torch.arange(20) / 4).clamp(max=4)
    assert torch.allclose(row, expected)


@either
def test_world_moments(released):
    """A moved scene has the same latents, unless moments are taken about the world's origin."""
    frames = make_frames([0, 0])
    shift = torch.tensor([4.0, -3.0, 2.0], dtype=torch.float64)
    viewmats = frames.cameras.viewmats.clone()
    viewmats[:, :3, 3] -= viewmats[:, :3, :3] @ shift
    cameras = dataclasses.replace(frames.cameras, viewmats=viewmats)
    moved = dataclasses.replace(frames, cameras=cameras, origin=frames.origin + shift)
    encoder = encoder_of(released)
    here, there = encoder(frames).dynamic_latents, encoder(moved).dynamic_latents
    assert torch.allclose(here, there, atol=1e-3) == (not released)


# ---- Dynamics


def config_of(released, config=TINY):
    return ReleasedDynamicsConfig(**vars(config)) if released else config


def dynamics_of(released):
    dynamics = make_dynamics(config_of(released))
    return as_released(dynamics) if released else dynamics


@either
def test_half_attention(released):
    attention = dynamics_of(released).net.encoder[0].blocks[0].attention
    seen = []
    attention.proj.register_forward_pre_hook(lambda _, args: seen.append(args[0]))
    dynamics = dynamics_of(released)
    dynamics.net.encoder[0].blocks[0].attention = attention
    dynamics(make_history((30,)))
    assert torch.equal(seen[0], seen[0].half().float()) == released


@either
def test_stale_decoder_conv(released):
    dynamics = dynamics_of(released)
    seen = []
    dynamics.net.decoder[0].blocks[0].register_forward_pre_hook(
        lambda _, args, kwargs: seen.append((kwargs["conv_input"], args[0])), with_kwargs=True
    )
    dynamics(make_history((30, 30)))
    convolved, summed = seen[0]
    assert torch.equal(convolved, summed) == (not released)


@either
def test_first_of_voxel(released):
    dynamics = dynamics_of(released)
    history = make_history((40,), frozen_share=0.0)
    # Rows 0 and 1 share a cell and lie next to the others; what row 1 carries reaches them through the mean only.
    means = history.means.clone()
    means[1] = means[0]
    history = dataclasses.replace(history, means=means)
    latents = history.dynamic_latents.clone()
    latents[1] += 1.0
    convs = []
    dynamics.net.stem.conv.register_forward_hook(lambda *args: convs.append(args[2]))
    dynamics(history)
    dynamics(dataclasses.replace(history, dynamic_latents=latents))
    changed = (convs[0] != convs[1]).any(1)
    assert changed[1] and changed[2:].any() == (not released)


@either
def test_anchor_at_minimum(released):
    """Whether another scene moves the cells of a scene, and a particle far away those of its neighbours."""
    dynamics = dynamics_of(released)
    history, other = make_history((30,)), make_history((30,), seed=1)
    other = dataclasses.replace(other, means=other.means - 0.4 * TINY.grid_size)
    together = dynamics(batch([history, other])).select_clouds(torch.tensor([0]))
    assert torch.equal(together.means, dynamics(history).means) == (not released)

    far = history.means.clone()
    far[0] = 0.01  # below all others, within the workspace
    grids = [cells_of(dynamics, dataclasses.replace(history, means=means)) for means in (history.means, far)]
    assert torch.equal(grids[0][1:], grids[1][1:]) == (not released)


def cells_of(dynamics, history):
    """Cells of the finest stage."""
    spec = dynamics.config.pyramid_spec(0)
    clouds = history.cu_rows, history.cloud_scene, history.cloud_step * 0, history.origin
    return build_pyramid(history.means, *clouds, spec).stages[0].grid


@either
def test_slots_from_first(released):
    dynamics = dynamics_of(released)
    history = make_history((30, 30))
    assert torch.isfinite(dynamics(history).means).all()
    index = dynamics.geometry(history).stages[2].time_index
    if released:
        assert index is None  # two steps: nothing is left to merge a second time
    else:
        assert_same_bits(index, torch.ones_like(index))  # the newest of the pairs that would merge


def advanced(particles, value, released):
    """An explicit state after a step in which every channel predicts ``value``."""
    layout = StateLayout.of(config_of(released, EXPLICIT))
    (after,) = advance(layout, particles, torch.full((particles.n_rows, layout.out_channels), value))
    return after


@either
def test_unbounded_opacity(released):
    particles = make_history((20,), config=EXPLICIT, frozen_share=0.0)
    after = advanced(particles, 3.0, released)
    assert (after.opacities.max() > 1) == released and after.opacities.min() >= 0


@either
def test_frozen_rows_turn(released):
    particles = make_history((20,), config=EXPLICIT, frozen_share=2.0)
    after = advanced(particles, 1.0, released)
    assert torch.equal(after.quats, particles.quats) == (not released)
    assert_same_bits(after.means, particles.means)


# ---- Harmonics


def turns(n):
    return rotation_matrices(unit_quats(random(n, 4)))


@either
def test_unpaired_harmonics(released):
    """Whether a turned colour in a turned direction is the old one."""
    rotations, sh = turns(8), random(8, 16, 3, seed=1)
    d = torch.nn.functional.normalize(random(8, 3, seed=2), dim=1)
    turned = (rotate_unpaired_harmonics if released else rotate_harmonics)(sh, rotations)
    seen = torch.einsum("nk,nkc->nc", sh_basis((rotations @ d[:, :, None])[..., 0], 3), turned)
    assert torch.allclose(seen, torch.einsum("nk,nkc->nc", sh_basis(d, 3), sh)) == (not released)


@either
def test_clamped_polar_axis(released):
    """Near the identity the turn is off by about 1e-3, elsewhere not at all; gradients are finite at the identity."""
    rotate = (lambda sh, turn: rotate_harmonics(sh, clamp_polar_axis(turn))) if released else rotate_harmonics
    sh, rotations = random(5, 16, 3), turns(5)
    assert_close_relative_to_max(rotate(sh, rotations), rotate_harmonics(sh, rotations), 1e-12)
    eye = torch.eye(3, dtype=torch.float64).repeat(5, 1, 1).requires_grad_()
    near = rotate(sh, eye)
    error = (near - sh).abs().max()
    assert (error > 1e-4) == released and error < 0.05
    (grad,) = torch.autograd.grad(near.square().sum(), eye)
    assert torch.isfinite(grad).all()


@either
def test_heads_and_renderer_turn_predicted_harmonics(released):
    rotate = rotate_released_harmonics if released else rotate_harmonics
    sh, rotations = random(5, 16, 3), turns(5)
    assert_same_bits(encoder_of(released).heads.rotate_harmonics(sh, rotations), rotate(sh, rotations))


# ---- Renderer


def drawn(released, *scene):
    return render_released(*scene) if released else render(*scene, jacobian="clamped")


def make_cameras(n=1, size=32, near=0.5, center=(0.5, 0.5)):
    viewmats = torch.eye(4).repeat(n, 1, 1)
    K = torch.tensor([[size, 0, center[0] * size], [0, size, center[1] * size], [0, 0, 1]])
    ones = torch.ones(n)
    return Cameras(viewmats, K.repeat(n, 1, 1), near * ones, 9 * ones, torch.zeros(n).long(), size, size)


def make_gaussians(depth, scale=0.05, n=1):
    means = torch.tensor([[0.01, 0.02, depth]]).repeat(n, 1)
    quats, scales = torch.tensor([[1.0, 0, 0, 0]]).repeat(n, 1), torch.full((n, 3), scale)
    return Gaussians(means, quats, scales, torch.full((n,), 0.97), torch.ones(n, 1, 3), torch.tensor([0, n]))


@either
def test_three_sigma_tiles(released):
    """Its alpha reaches 1/255 beyond three sigma, in a tile that the square of three sigma does not touch."""
    gaussians, cameras = make_gaussians(1.0, scale=0.0769), make_cameras(size=64)
    alpha = drawn(released, gaussians, cameras).alpha
    whole = render(gaussians, cameras).alpha
    assert (alpha.gt(0).sum() < whole.gt(0).sum()) == released
    assert torch.equal(alpha, whole) == (not released)


@either
def test_far_near_plane(released):
    """Each camera culls by its own bound."""
    cameras = make_cameras(2)
    cameras.near[1] = 3.0
    image = drawn(released, make_gaussians(0.5), cameras)
    assert image.alpha[0].max() > 0.5 and (image.alpha[1].max() == 0) == released


@either
def test_centered_principal_point(released):
    gaussians, cameras = make_gaussians(2.0), make_cameras(center=(0.3, 0.6))
    image = drawn(released, gaussians, cameras)
    row, column = divmod(int(image.alpha[0].argmax()), 32)
    assert (abs(row - 16) <= 1 and abs(column - 16) <= 1) == released
    assert torch.equal(image.color, render(gaussians, cameras).color) == (not released)


def assert_equal_gradients(a, b, leaf):
    gradients = [torch.autograd.grad(value.sum(), leaf, retain_graph=True)[0] for value in (a, b)]
    assert_close_relative_to_max(*gradients, 1e-9)


@either
def test_z_in_harmonic_14(released):
    """The value changes, and by that harmonic alone; the gradient is that of the true harmonic."""
    n = 6
    sh = torch.zeros(n, 16, 3, dtype=torch.float64)
    sh[:, 9:] = 0.05 * random(n, 7, 3)
    sh.requires_grad_()
    gaussians = make_gaussians(2.0, n=n).map(lambda t: t.double() if t.is_floating_point() else t)
    means = (gaussians.means + 0.5 * random(n, 3, seed=1)).requires_grad_()
    gaussians = dataclasses.replace(gaussians, sh=sh, means=means)
    camera = make_cameras()
    image = drawn(released, gaussians, camera).color
    true = render(gaussians, camera, jacobian="clamped").color
    assert torch.allclose(image, true, atol=1e-9) == (not released)
    assert_equal_gradients(image, true, sh)
    colors = released_colors(sh, means, camera)
    directions = torch.nn.functional.normalize(means, dim=1)
    true = torch.einsum("nk,nkc->nc", sh_basis(directions, 3), sh) + 0.5
    assert_equal_gradients(colors, true, means)

    one = torch.zeros(n, 16, 3, dtype=torch.float64)
    one[:, 14] = 0.1
    x, _, z = directions.detach().unbind(1)
    expected = 0.5 + 0.1 * 1.445305721320277 * z * (z * z - x * x)
    published = rotate_harmonics(one, published_axes(one).mT.expand(n, 3, 3))  # in the standard basis
    assert_close_relative_to_max(released_colors(published, means, camera), expected[:, None].expand(n, 3), 1e-12)
