"""The models of the paper at full size on the CPU: encode, roll out, render, gradients of every parameter."""

import dataclasses

import pytest
import torch

from gsim3d import presets
from gsim3d.cameras import Cameras, Frames
from gsim3d.simulator import Simulator
from tests.asserts import assert_close_relative_to_max
from tests.nn.multiview_encoder.scenes import look_at

pytestmark = pytest.mark.slow
SIZE, VIEWS = 32, 4
KEPT = (0.10, 0.04)  # share of the pixels of each scene that become particles


def make_frames(n_steps):
    """Two scenes with different numbers of particles."""
    generator = torch.Generator().manual_seed(0)
    n_scenes = len(KEPT)
    n_clouds = n_scenes * n_steps
    n = n_clouds * VIEWS
    viewmats = torch.stack([look_at(0.3 + 1.5 * view, 2.0) for view in range(VIEWS)]).repeat(n_clouds, 1, 1).float()
    K = torch.tensor([[1.2 * SIZE, 0.0, SIZE / 2], [0.0, 1.2 * SIZE, SIZE / 2], [0.0, 0.0, 1.0]]).repeat(n, 1, 1)
    clouds = torch.arange(n_clouds).repeat_interleave(VIEWS)
    scene = torch.arange(n_scenes).repeat_interleave(n_steps)
    share = torch.tensor(KEPT)[scene[clouds]][:, None, None]
    return Frames(
        images=torch.rand(n, 3, SIZE, SIZE, generator=generator),
        cameras=Cameras(viewmats, K, torch.full((n,), 1.0), torch.full((n,), 4.0), clouds, SIZE, SIZE),
        cloud_scene=scene,
        cloud_step=torch.arange(n_steps).repeat(n_scenes),
        origin=torch.full((n_scenes, 3), -6.0, dtype=torch.float64),
        masks=torch.rand(n, SIZE, SIZE, generator=generator) < share,
    )


def predict(simulator, state, frames, generator=None):
    """Two steps on, and one image of each scene."""
    steps = simulator.rollout(state, 2, generator=generator)
    cameras = frames.cameras.select(torch.tensor([0, len(frames.cameras) - 1]), torch.arange(2))
    return steps, simulator.render(steps[-1], cameras).color


CONFIGS = {
    "latent, 4 steps": (presets.paper_latent(4, 64), 4),
    "latent, 2 steps": (presets.paper_latent(2, 64), 2),
    "explicit, 2 steps": (presets.paper_explicit(2), 2),
}


@pytest.mark.parametrize("name", CONFIGS)
def test_forward_backward_and_rollout(name):
    config, n_steps = CONFIGS[name]
    config = dataclasses.replace(config, dynamics=dataclasses.replace(config.dynamics, checkpointing=True))
    torch.manual_seed(0)
    simulator, frames = Simulator(config).train(), make_frames(n_steps)
    state = simulator.encode(frames)
    counts = torch.diff(state.cu_rows)
    assert counts[:n_steps].min() > counts[n_steps:].max() > 0
    steps, image = predict(simulator, state, frames, torch.Generator().manual_seed(0))
    assert [step.n_rows for step in steps] == [int(counts[n_steps - 1] + counts[-1])] * 2
    assert image.shape == (2, SIZE, SIZE, 3) and image.isfinite().all() and image.max() > 0
    features = steps[-1].sh if config.encoder.explicit else steps[-1].dynamic_latents
    (image.square().mean() + steps[-1].means.square().mean() + features.square().mean()).backward()
    unused = set(simulator.plan().unused)
    for parameter_name, parameter in simulator.named_parameters():
        if parameter_name in unused:
            assert parameter.grad is None, parameter_name
        else:
            assert parameter.grad is not None and parameter.grad.isfinite().all(), parameter_name
    for block in simulator.dynamics.net.encoder[3].blocks:
        assert all(layer.weight.grad.any() for layer in (block.attention.qkv, block.mlp.fc1, block.norm1))


def test_a_scene_predicts_the_same_alone():
    torch.manual_seed(0)
    simulator, frames = Simulator(presets.paper_latent(2, 64)).eval(), make_frames(2)
    with torch.no_grad():
        state = simulator.encode(frames)
        together, _ = predict(simulator, state, frames)
        second = state.select_clouds(torch.tensor([2, 3]))
        second = dataclasses.replace(second, cloud_scene=second.cloud_scene - 1, origin=second.origin[1:])
        alone = simulator.rollout(second, 2)
    for mine, both in zip(alone, together, strict=True):
        rows = slice(int(both.cu_rows[1]), None)
        for field in ("means", "dynamic_latents"):
            assert_close_relative_to_max(getattr(mine, field), getattr(both, field)[rows], "dynamics_order", field)
