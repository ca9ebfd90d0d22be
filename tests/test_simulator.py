"""The whole way: images -> particles -> later particles -> images."""

import dataclasses

import pytest
import torch

from gsim3d import presets
from gsim3d.cameras import Cameras, Frames
from gsim3d.compat.released_model import ReleasedDynamicsConfig, ReleasedModelConfig, ReleasedSimulator, render_released
from gsim3d.effects.spec import AppearanceEffects, DynamicsEffects, EffectsSpec, UnsupportedEffect
from gsim3d.errors import InputError
from gsim3d.nn.gaussian_head import RendererConfig, render
from gsim3d.presets import ModelConfig
from gsim3d.priors import GravityConfig, InertiaConfig, ProximityConfig, ShapeMatchingConfig, VelocityFromImagesConfig
from gsim3d.simulator import Simulator
from gsim3d.state import DYNAMIC, FROZEN, last_steps
from gsim3d.train.loop import deterministic
from tests.asserts import assert_close_relative_to_max, assert_same_bits, with_threads
from tests.dynamics.scenes import TINY
from tests.nn.multiview_encoder.scenes import CONFIG as TINY_ENCODER, look_at
from tests.priors.scenes import OCCLUSION

SIZE = 16
ENCODER = dataclasses.replace(TINY_ENCODER, transformer_layers=1, upsampled_dim=4, dynamic_dim=4, static_dim=3)
CONFIG = ModelConfig(
    ENCODER,
    dataclasses.replace(TINY, grid_size=0.1),
    RendererConfig(latents=7, sh_degree=1, scale_min=0.01, scale_max=0.3, initial_scale=0.1),
)


def make_frames(steps=(2,), n_views=2, seed=0, masked=True):
    """Scene i has steps[i] steps; each step the same cameras."""
    g = torch.Generator().manual_seed(seed)
    n_clouds = sum(steps)
    viewmats = torch.stack([look_at(0.3 + 1.2 * v, 2.0) for v in range(n_views)]).repeat(n_clouds, 1, 1).float()
    K = torch.tensor([[16.0, 0.0, 8.0], [0.0, 16.0, 8.0], [0.0, 0.0, 1.0]])
    n = n_clouds * n_views
    clouds = torch.arange(n_clouds).repeat_interleave(n_views)
    cameras = Cameras(viewmats, K.repeat(n, 1, 1), torch.full((n,), 1.0), torch.full((n,), 3.5), clouds, SIZE, SIZE)
    masks = torch.rand(n, SIZE, SIZE, generator=g) < 0.3 if masked else None
    return Frames(
        images=torch.rand(n, 3, SIZE, SIZE, generator=g),
        cameras=cameras,
        cloud_scene=torch.repeat_interleave(torch.arange(len(steps)), torch.tensor(steps)),
        cloud_step=torch.cat([torch.arange(n_steps) for n_steps in steps]),
        origin=torch.full((len(steps), 3), -4.0, dtype=torch.float64),
        masks=masks,
        dynamic=torch.rand(n, SIZE, SIZE, generator=g) < 0.7,
    )


def make_simulator(config=CONFIG, seed=0):
    torch.manual_seed(seed)
    return Simulator(config).eval()


def awake(simulator):
    """Some layers start at zero and would hide those before them from gradients."""
    with torch.no_grad():
        for p in simulator.parameters():
            p.add_(torch.randn_like(p), alpha=0.02)
    return simulator


def target_cameras(frames, n_scenes):
    """One camera for each scene's newest cloud."""
    device = frames.images.device
    return frames.cameras.select(
        torch.zeros(n_scenes, dtype=torch.int64, device=device), torch.arange(n_scenes, device=device)
    )


def test_encode_step_rollout_render():
    simulator, frames = make_simulator(), make_frames((2, 3, 1))
    state = simulator.encode(frames)
    assert state.n_clouds == 6
    plan = simulator.plan(EffectsSpec())
    steps = simulator.rollout(state, 3, plan)
    assert [step.cloud_step.tolist() for step in steps] == [[2, 3, 1], [3, 4, 2], [4, 5, 3]]
    image = simulator.render(steps[-1], target_cameras(frames, 3), torch.ones(3))
    assert image.color.shape == (3, SIZE, SIZE, 3) and torch.isfinite(image.color).all() and image.alpha.max() > 0.05


def test_encoded_particles_have_velocity_and_light_occlusion():
    """Velocities come from no step that is older than the longest history, here of four."""
    priors = VelocityFromImagesConfig(radius=0.5), InertiaConfig(radius=0.5), OCCLUSION
    seeing = dataclasses.replace(CONFIG.dynamics, priors=priors)
    simulator, frames = make_simulator(dataclasses.replace(CONFIG, dynamics=seeing)), make_frames((3,))
    in_history, too_old = (
        simulator.encode(dataclasses.replace(frames, cloud_step=torch.tensor([0, last - 1, last]))) for last in (3, 4)
    )
    newest = in_history.row_cloud() == 2
    for state in (in_history, too_old):
        assert state.velocity[newest].any() and not state.velocity[~newest].any()
        assert (
            (state.light_occlusion[newest] >= 0).all()
            and state.light_occlusion.max() > 0
            and (state.light_occlusion[~newest] < 0).all()
        )
    first = dataclasses.replace(frames, images=frames.images.clone(), cloud_step=torch.tensor([0, 3, 4]))
    first.images[:2] = 0.5
    again = simulator.encode(first)
    assert_same_bits(again.velocity, too_old.velocity)
    assert not torch.equal(in_history.velocity, too_old.velocity)


def test_gravity_sets_encoded_velocity_in_flight_to_last_step():
    """Not as on average over the three steps that were given; those that touch something are."""
    fall = (0.0, 0.002, -0.01)
    priors = VelocityFromImagesConfig(radius=0.1), ProximityConfig(range=0.05), InertiaConfig(radius=0.1)
    states = []
    for gravity in ((), (GravityConfig(acceleration=fall, radius=0.1),)):
        config = dataclasses.replace(CONFIG.dynamics, priors=priors + gravity)
        simulator = make_simulator(dataclasses.replace(CONFIG, dynamics=config))
        states.append(simulator.encode(make_frames((3,))))
    newest = states[0].row_cloud() == 2
    gravity, ctx = simulator.dynamics.priors.get("gravity"), simulator.dynamics.context(states[1])
    touch, moves = gravity.touch(ctx), states[0].activity[newest] == DYNAMIC
    assert (touch[moves] < 0.5).any() and (touch[moves] == 1).any()
    faster = (states[1].velocity - states[0].velocity)[newest][moves]
    torch.testing.assert_close(faster, 0.5 * gravity.fall(ctx)[moves], atol=1e-5, rtol=1e-3)
    assert gravity.step.tolist() == pytest.approx(fall)


@pytest.mark.parametrize("name", ["means", "dynamic_latents"])
@pytest.mark.parametrize("activity", [DYNAMIC, FROZEN])
def test_memory_of_broken_rows_is_not_used(name, activity):
    priors = InertiaConfig(radius=0.5), ShapeMatchingConfig(radius=0.5), OCCLUSION
    dynamics = dataclasses.replace(CONFIG.dynamics, priors=priors, background="relightable")
    config = dataclasses.replace(CONFIG, dynamics=dynamics)
    simulator, frames = awake(make_simulator(config)), make_frames()
    plan = simulator.plan(EffectsSpec(appearance=AppearanceEffects(changing="all")))
    state = simulator.encode(frames)
    row = int(torch.nonzero((state.activity == activity) & (state.row_cloud() == 1))[0])
    values = getattr(state, name).clone()
    values[row] = torch.nan
    state = dataclasses.replace(state, **{name: values})
    step = simulator.rollout(state, 3, plan, on_invalid="drop")[-1]
    for seen in ("means", "opacities", "dynamic_latents", "irradiance_gain"):
        assert getattr(step, seen).isfinite().all(), seen
    assert simulator.render(step, target_cameras(frames, 1), torch.ones(3)).color.isfinite().all()


@pytest.mark.parametrize("n_steps", [-1, 1.5, "2"])
def test_rollout_refuses_what_is_no_number_of_steps(n_steps):
    simulator = make_simulator()
    state = simulator.encode(make_frames())
    with pytest.raises(InputError, match="rollout: n_steps must be a whole number of at least 0; got"):
        simulator.rollout(state, n_steps)
    assert simulator.rollout(state, 0) == []


def test_rollout_is_repeated_steps():
    simulator, frames = make_simulator(), make_frames((2, 3))
    state = simulator.encode(frames)
    plan = simulator.plan(EffectsSpec(dynamics=DynamicsEffects(history=2)))
    steps = simulator.rollout(state, 3, plan)
    for step in steps:
        state = simulator.step(state, plan)
        assert state.n_clouds == 4
        newest = last_steps(state, 1)
        assert_same_bits(newest.means, step.means)
        assert_same_bits(newest.dynamic_latents, step.dynamic_latents)


@pytest.mark.parametrize("changing", ["all", "none"])
def test_several_steps_a_call(changing):
    config = dataclasses.replace(CONFIG, dynamics=dataclasses.replace(CONFIG.dynamics, steps_per_call=2))
    simulator, frames = make_simulator(config), make_frames((2, 3))
    state = simulator.encode(frames)
    plan = simulator.plan(EffectsSpec(appearance=AppearanceEffects(changing=changing)))
    steps = simulator.rollout(state, 3, plan)
    assert [step.cloud_step.tolist() for step in steps] == [[2, 3], [3, 4], [4, 5]]
    newest, after = last_steps(state, 1), last_steps(simulator.step(state, plan), 2)
    assert after.cloud_step.tolist() == [2, 3, 3, 4]
    for i, step in enumerate(steps[:2]):
        assert_same_bits(after.select_clouds(torch.tensor([i, 2 + i])).means, step.means)
        assert torch.equal(step.dynamic_latents, newest.dynamic_latents) == (changing == "none")


def published_simulator():
    dynamics = ReleasedDynamicsConfig(**vars(CONFIG.dynamics))
    return ReleasedSimulator(ReleasedModelConfig(**{**vars(CONFIG), "dynamics": dynamics})).eval()


def test_published_behaviour_end_to_end():
    """Finite, and gradients reach every parameter of the network that a clean model would train."""
    simulator, frames = awake(published_simulator()), make_frames((2,))
    steps = simulator.rollout(simulator.encode(frames), 2)
    image = simulator.render(steps[-1], target_cameras(frames, 1), torch.ones(3))
    assert image.color.shape == (1, SIZE, SIZE, 3) and torch.isfinite(image.color).all() and image.alpha.max() > 0.05
    image.color.sum().backward()
    missing = [name for name, p in simulator.named_parameters() if p.grad is None or not torch.isfinite(p.grad).all()]
    assert not [name for name in missing if "time_embedding" not in name], missing


def test_released_renderer_draws_cloud_of_each_camera():
    simulator, frames = published_simulator(), make_frames((2, 1))
    particles = simulator.encode(frames)
    cameras, background = frames.cameras, torch.rand(len(frames.cameras), 3)
    images = simulator.render(particles, cameras, background).color
    assert images.shape == (len(cameras), SIZE, SIZE, 3)
    for i, cloud in enumerate(cameras.image_cloud.tolist()):
        one = torch.tensor([i])
        alone = simulator.renderer(particles.select_clouds([cloud]))
        camera = cameras.select(one, torch.zeros_like(one))
        image = render_released(alone, camera, background[i], jacobian=CONFIG.renderer.jacobian).color
        assert_same_bits(image[0], images[i])
        assert not torch.equal(render(alone, camera, background[i]).color[0], images[i])
    none = simulator.render(particles, cameras.select(torch.zeros(0, dtype=torch.int64)))
    assert none.color.shape == (0, SIZE, SIZE, 3)


def test_masked_out_pixels_are_absent():
    simulator, frames = make_simulator(), make_frames((2,))
    changed = dataclasses.replace(frames, dynamic=frames.dynamic | ~frames.masks)
    steps, others = (simulator.rollout(simulator.encode(f), 2) for f in (frames, changed))
    assert_same_bits(steps[-1].means, others[-1].means)
    assert steps[0].n_rows == int(frames.masks[2:].sum())


def test_gradients_reach_every_parameter():
    simulator, frames = awake(make_simulator()), make_frames((2,))
    steps = simulator.rollout(simulator.encode(frames), 2)
    cameras = target_cameras(frames, 1)
    sum(simulator.render(step, cameras).color.square().sum() for step in steps).backward()
    without = [name for name, p in simulator.named_parameters() if p.grad is None or not p.grad.any()]
    assert without == []


class Predict(torch.nn.Module):
    """Pixels of the newest image and a target camera -> three sums over each image of a rollout of 2 steps."""

    def __init__(self):
        super().__init__()
        self.simulator, self.frames = awake(make_simulator()).double(), make_frames((2,))
        self.camera = target_cameras(self.frames, 1)
        g = torch.Generator().manual_seed(5)
        self.weights = torch.rand(3, SIZE, SIZE, 3, generator=g, dtype=torch.float64)

    def forward(self, pixels, viewmat):
        images = self.frames.images.double()
        images[-1, :, 6:8, 6:8] = pixels
        steps = self.simulator.rollout(self.simulator.encode(dataclasses.replace(self.frames, images=images)), 2)
        camera = dataclasses.replace(self.camera, viewmats=viewmat)
        colors = [self.simulator.render(step, camera, cutoff="smooth").color for step in steps]
        return torch.cat([(self.weights * color).sum((1, 2, 3)) for color in colors])


def test_gradcheck_of_a_rollout():
    """Two steps in float64, element by element: pixels, the camera, and parameters of every room."""
    predict = Predict()
    names = (
        "encoder.cnn.conv2.bias",
        "encoder.depth.cost_volume.head.2.bias",
        "encoder.heads.to_gaussians.2.bias",
        "encoder.heads.to_latents.bias",
        "dynamics.net.encoder.0.blocks.0.position.conv.bias",
        "dynamics.net.encoder.1.blocks.0.attention.qkv.bias",
        "dynamics.net.encoder.2.merge.time_embedding",
        "dynamics.net.decoder.0.unpool.skip.bias",
        "dynamics.net.head.fc2.bias",
        "renderer.fc2.bias",
    )
    values = dict(predict.simulator.named_parameters())
    pixels = torch.rand(3, 2, 2, generator=torch.Generator().manual_seed(6), dtype=torch.float64)
    inputs = [pixels, predict.camera.viewmats.double(), *(values[name].detach().clone() for name in names)]
    inputs = [t.requires_grad_() for t in inputs]

    def f(pixels, viewmat, *parameters):
        replaced = {f"simulator.{name}": value for name, value in zip(names, parameters, strict=True)}
        return torch.func.functional_call(predict, replaced, (pixels, viewmat))

    jacobian = torch.autograd.functional.jacobian(f, tuple(inputs))
    assert all(entry.abs().amax() > 1e-3 for entry in jacobian), "a check of zeros shows nothing"
    torch.autograd.gradcheck(f, inputs, eps=1e-6, atol=1e-6, rtol=1e-4)


def test_directional_derivatives_of_a_rollout_in_float64():
    """Two steps from images to images: the derivative along random directions of all parameters, by differences."""
    simulator, frames = make_simulator().double(), make_frames((2,))
    frames = dataclasses.replace(frames, images=frames.images.double())
    cameras = target_cameras(frames, 1)
    parameters = list(simulator.parameters())
    weights = torch.rand(SIZE, SIZE, 3, generator=torch.Generator().manual_seed(5), dtype=torch.float64)

    def loss():
        steps = simulator.rollout(simulator.encode(frames), 2)
        images = [simulator.render(step, cameras, cutoff="smooth").color[0] for step in steps]
        return sum((weights * image).sum() for image in images)

    grads = torch.autograd.grad(loss(), parameters)
    g = torch.Generator().manual_seed(7)
    for _ in range(3):
        direction = [torch.randn(p.shape, generator=g, dtype=torch.float64) for p in parameters]
        exact = sum((d * grad).sum() for d, grad in zip(direction, grads, strict=True)).item()
        with torch.no_grad():
            values = []
            for step in (1, -2):
                for p, d in zip(parameters, direction, strict=True):
                    p.add_(d, alpha=step * 1e-7)
                values.append(loss().item())
            for p, d in zip(parameters, direction, strict=True):
                p.add_(d, alpha=1e-7)
        numeric = (values[0] - values[1]) / 2e-7
        assert numeric == pytest.approx(exact, rel=1e-5)


def test_rollout_and_images_have_the_same_bits_on_one_thread_and_two():
    simulator, frames = make_simulator(), make_frames((2,))
    state = simulator.encode(frames).detach()

    def run():
        with torch.no_grad():
            step = simulator.rollout(state, 2)[-1]
            return [step.means, simulator.render(step, target_cameras(frames, 1)).color]

    for one, two in zip(with_threads(1, run), with_threads(2, run), strict=True):
        assert_same_bits(two, one)


def test_background_frozen_masked_out_and_dynamic():
    simulator, frames = make_simulator(), make_frames((2,))
    state = simulator.encode(frames)
    newest = last_steps(state, 1)
    frozen = newest.activity == FROZEN
    steps = {
        mode: simulator.rollout(state, 1, simulator.plan(EffectsSpec(dynamics=DynamicsEffects(background=mode))))[0]
        for mode in ("frozen", "masked_out", "dynamic")
    }
    assert_same_bits(steps["frozen"].means[frozen], newest.means[frozen])
    assert not torch.equal(steps["dynamic"].means[frozen], newest.means[frozen])
    assert steps["masked_out"].n_rows == int((~frozen).sum())
    without = simulator.rollout(state.select_rows(state.activity != FROZEN), 1)[0]
    assert_same_bits(steps["masked_out"].means, without.means)


@pytest.mark.parametrize("changing", ["all", "dynamic", "none"])
def test_changing_features_by_selection(changing):
    simulator, frames = make_simulator(), make_frames((2,))
    state = simulator.encode(frames)
    newest = last_steps(state, 1)
    plan = simulator.plan(EffectsSpec(appearance=AppearanceEffects(changing=changing)))
    same = (simulator.rollout(state, 1, plan)[0].dynamic_latents == newest.dynamic_latents).all(1)
    frozen = newest.activity == FROZEN
    assert bool(same[frozen].all()) == (changing != "all") and bool(same[~frozen].all()) == (changing == "none")


def test_one_step_of_history_equals_a_state_of_one_step():
    simulator, frames = make_simulator(), make_frames((3,))
    state = simulator.encode(frames)
    plan = simulator.plan(EffectsSpec(dynamics=DynamicsEffects(history=1)))
    assert "history" not in plan.on
    expected = simulator.rollout(last_steps(state, 1), 2, plan)
    for actual, step in zip(simulator.rollout(state, 2, plan), expected, strict=True):
        assert_same_bits(actual.means, step.means)


def test_degree_zero_equals_higher_coefficients_of_zero():
    simulator, frames = make_simulator(), make_frames((1,))
    state = simulator.encode(frames)
    plan = simulator.plan(EffectsSpec(appearance=AppearanceEffects(view_dependent=0)))
    plain = simulator.render(state, target_cameras(frames, 1), plan=plan)
    with torch.no_grad():
        rows = simulator.renderer.fc2.weight[:12].view(3, 4, -1)
        rows[:, 1:] = 0
    assert_close_relative_to_max(simulator.render(state, target_cameras(frames, 1)).color, plain.color, 1e-6)


def test_plan_names_parameters_without_use():
    shorter = dataclasses.replace(CONFIG, dynamics=dataclasses.replace(CONFIG.dynamics, history_bits=1))
    assert make_simulator(shorter).plan().unused == ("dynamics.net.encoder.2.merge.time_embedding",)
    assert make_simulator().plan().unused == ()
    with pytest.raises(UnsupportedEffect, match="history: this model supports at most 2"):
        make_simulator(shorter).plan(EffectsSpec(dynamics=DynamicsEffects(history=3)))


def test_presets_are_consistent_and_of_the_stated_size():
    sizes = {}
    for preset in (presets.tiny, presets.small, presets.paper_latent, presets.paper_explicit):
        sizes[preset.__name__] = sum(p.numel() for p in Simulator(preset()).parameters())
    assert sizes["tiny"] < 1.3e6 and 3.5e6 < sizes["small"] < 4.5e6
    # The published models have 57,576,665 and 57,724,921; here the head's last layer has a bias of 55 entries as well.
    assert sizes["paper_latent"] == 57_576_665 + 55 and sizes["paper_explicit"] == 57_724_921
    with pytest.raises(ValueError, match="n_steps must be 1, 2, 4 or 8; got 3"):
        presets.paper_latent(3)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"renderer": dataclasses.replace(CONFIG.renderer, latents=8)}, "renderer.latents and what it reads"),
        ({"encoder": dataclasses.replace(ENCODER, dynamic_dim=5)}, "encoder.dynamic_dim and dynamics.dynamic_latents"),
    ],
)
def test_parts_that_do_not_fit_raise(change, message):
    with pytest.raises(ValueError, match=message):
        dataclasses.replace(CONFIG, **change)


def images_and_gradients(device, dtype):
    """A rollout of 2 steps in one picture each, and the gradient of every parameter."""
    simulator = awake(make_simulator()).to(device, dtype)
    frames = make_frames((2, 3)).to(device)
    frames = dataclasses.replace(frames, images=frames.images.to(dtype))
    steps = simulator.rollout(simulator.encode(frames), 2)
    cameras = target_cameras(frames, 2).to(device)
    images = torch.stack([simulator.render(step, cameras).color for step in steps])
    return images.detach(), *torch.autograd.grad(images.square().sum(), list(simulator.parameters()))


def test_cuda_equals_cpu(devices):
    cpu, cuda = (images_and_gradients(device, torch.float64) for device in devices)
    assert_close_relative_to_max(cuda[0], cpu[0], 1e-9, "images")
    # Together: a bias in front of a norm has no gradient but rounding.
    assert_close_relative_to_max(
        *(torch.cat([g.flatten() for g in grads[1:]]) for grads in (cuda, cpu)), 1e-9, "gradients"
    )


def test_rollout_and_its_gradients_repeat_bit_by_bit(device):
    with deterministic():
        runs = [images_and_gradients(device, torch.float32) for _ in range(2)]
    for i, (a, b) in enumerate(zip(*runs, strict=True)):
        assert_same_bits(a, b, f"output {i}")


def test_gpu_that_is_not_the_current_one_gives_the_same_bits(gpus):
    with deterministic():
        first, second = (images_and_gradients(gpu, torch.float32) for gpu in gpus)
    assert second[0].device == gpus[1] and torch.cuda.current_device() == 0
    for i, (actual, expected) in enumerate(zip(second, first, strict=True)):
        assert_same_bits(actual, expected, f"output {i}")
