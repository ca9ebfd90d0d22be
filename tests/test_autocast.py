"""Under torch.autocast the whole simulator works in 16 bits where it may, and nowhere else."""

import dataclasses

import pytest
import torch

from gsim3d.simulator import Simulator
from tests.asserts import assert_same_bits
from tests.test_simulator import CONFIG, awake, make_frames, make_simulator, target_cameras


def batch_norm(config=CONFIG):
    return dataclasses.replace(config, dynamics=dataclasses.replace(config.dynamics, norm="batch"))


def trained_step(simulator: Simulator, frames, dtype: torch.dtype):
    """Encoded and predicted particles, images, loss and gradients of encode, two steps and a rendering of the last."""
    device = frames.images.device
    with torch.autocast(device.type, dtype, enabled=dtype != torch.float32):
        state = simulator.encode(frames)
        steps = simulator.rollout(state, 2)
        images = simulator.render(steps[-1], target_cameras(frames, 2)).color
    loss = (images - 0.5).square().mean() + steps[-1].dynamic_latents.square().mean()
    parameters = [p for p in simulator.parameters() if p.requires_grad]
    return [state, *steps], images, loss, torch.autograd.grad(loss, parameters, allow_unused=True)


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16])
@pytest.mark.parametrize("norm", ["layer", "batch"])
@pytest.mark.parametrize("training", [False, True])
def test_a_step_is_float32_outside_and_near_the_float32_one(training, norm, dtype, device):
    simulator = awake(make_simulator(batch_norm() if norm == "batch" else CONFIG)).to(device).train(training)
    frames = make_frames((2, 3)).to(device)
    exact = trained_step(simulator, frames, torch.float32)
    particles, images, loss, grads = trained_step(simulator, frames, dtype)
    for state in particles:
        for name, value in state.row_fields().items():
            assert not value.is_floating_point() or value.dtype == torch.float32, name
            assert torch.isfinite(value).all(), name
    assert images.dtype == loss.dtype == torch.float32
    assert abs(loss - exact[2]) < 0.1 * exact[2]
    for a, b in zip(grads, exact[3], strict=True):
        assert (a is None) == (b is None)
        assert a is None or (a.dtype == torch.float32 and torch.isfinite(a).all())
    ours, theirs = (torch.cat([g.flatten() for g in some if g is not None]) for some in (grads, exact[3]))
    assert torch.nn.functional.cosine_similarity(ours, theirs, dim=0) > 0.9
    assert not torch.equal(ours, theirs)


def test_a_step_repeats_bit_by_bit(device):
    simulator, frames = awake(make_simulator(batch_norm())).to(device).eval(), make_frames((2, 1)).to(device)
    first, second = (trained_step(simulator, frames, torch.bfloat16) for _ in range(2))
    assert_same_bits(first[1], second[1])
    for a, b in zip(first[3], second[3], strict=True):
        if a is not None:
            assert_same_bits(a, b)


def test_a_scene_without_particles(device):
    simulator, frames = awake(make_simulator(batch_norm())).to(device), make_frames((2, 2)).to(device)
    masks = frames.masks.clone()
    masks[: len(masks) // 2] = False
    particles, images, _, grads = trained_step(simulator, dataclasses.replace(frames, masks=masks), torch.bfloat16)
    assert particles[-1].clouds.count(0) == 0 < particles[-1].clouds.count(1)
    assert all(torch.isfinite(t).all() for t in (images, *(g for g in grads if g is not None)))


def test_nothing_at_all(device):
    simulator, frames = awake(make_simulator(batch_norm())).to(device), make_frames((2, 2)).to(device)
    frames = dataclasses.replace(frames, masks=torch.zeros_like(frames.masks))
    particles, images, _, _ = trained_step(simulator, frames, torch.bfloat16)
    assert particles[-1].n_rows == 0 and not images.any()
