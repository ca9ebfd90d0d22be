"""The loss and the learning-rate schedule."""

import dataclasses
import math

import pytest
import torch

from gsim3d.cameras import Cameras, Frames
from gsim3d.train.config import LossConfig
from gsim3d.train.losses import (
    LEAST_ERROR,
    image_errors,
    image_loss,
    mean_by_step,
    relative_errors,
    time_weights,
    training_loss,
)
from gsim3d.train.optimizer import one_cycle


def test_time_weights_equal_the_papers():
    weights = time_weights(4, 12)
    assert weights[:4].tolist() == pytest.approx([0.125] * 4)
    assert weights[4:].tolist() == pytest.approx([0.5 * 0.87**j for j in range(12)], rel=1e-6)
    assert weights[4:].sum().item() == pytest.approx(3.12, abs=0.01)
    assert time_weights(2, 0).tolist() == [0.5, 0.5]
    with pytest.raises(ValueError, match="n_past"):
        time_weights(0, 3)


def test_image_loss_by_hand():
    pred, target = torch.zeros(3, 2, 2, 3), torch.zeros(3, 2, 2, 3)
    target[0] += 0.1
    target[1] += 0.3
    target[2] += 0.2
    errors = image_errors(pred, target)
    assert errors.tolist() == pytest.approx([0.01, 0.09, 0.04])
    loss = image_loss(errors, torch.tensor([0, 0, 1]), torch.tensor([0.25, 2.0]))
    assert loss.item() == pytest.approx(0.25 * 0.05 + 2 * 0.04)


def test_the_published_loss_by_hand():
    """Two encoded and three simulated steps, two views each, errors 1 .. 10; the mean over views, then over time."""
    errors, step = torch.arange(1.0, 11), torch.arange(5).repeat_interleave(2)
    by_hand = 0.25 * 1.5 + 0.25 * 3.5 + 0.5 * 5.5 + 0.5 * 0.87 * 7.5 + 0.5 * 0.87**2 * 9.5
    assert image_loss(errors, step, time_weights(2, 3)).item() == pytest.approx(by_hand, rel=1e-6)
    shuffled = torch.randperm(10, generator=torch.Generator().manual_seed(0))
    assert image_loss(errors[shuffled], step[shuffled], time_weights(2, 3)).item() == pytest.approx(by_hand, rel=1e-6)


def test_pixel_weights_make_a_weighted_mean():
    pred, target = torch.zeros(1, 1, 2, 3), torch.tensor([1.0, 3.0]).reshape(1, 1, 2, 1).expand(1, 1, 2, 3)
    assert image_errors(pred, target, torch.tensor([[[3.0, 1.0]]])).item() == pytest.approx((3 * 1 + 1 * 9) / 4)
    assert image_errors(pred, target, torch.ones(1, 1, 2)).item() == image_errors(pred, target).item()


def test_relative_errors_by_hand():
    pred, target = torch.zeros(2, 1, 4, 3), torch.tensor([1.0, 3.0, 2.0, 0.5]).reshape(1, 1, 4, 1).expand(2, 1, 4, 3)
    bodies = torch.tensor([[[False, True, True, False]], [[False] * 4]])
    valid = torch.tensor([[[True, True, False, True]], [[True] * 4]])

    def log(*errors):
        return math.log(sum(errors) / 4 + LEAST_ERROR)

    expected = [log(1, 0.25) + 3 * log(9), log(1, 9, 4, 0.25) + 3 * log()]
    assert relative_errors(pred, target, bodies, 2.0, valid).tolist() == pytest.approx(expected, rel=1e-6)
    whole = [log(1, 9, 0.25), log(1, 9, 4, 0.25)]
    assert relative_errors(pred, target, None, 2.0, valid).tolist() == pytest.approx(whole, rel=1e-6)


def test_relative_gradients_count_well_predicted_images_alike():
    off = torch.tensor([0.02, 0.2], dtype=torch.double).reshape(2, 1, 1, 1).expand(2, 8, 8, 3).clone().requires_grad_()
    bodies = torch.zeros(2, 8, 8, dtype=torch.bool)
    bodies[:, 2:6, 2:6] = True
    loss = relative_errors(off, torch.zeros_like(off), bodies).sum()
    (gradient,) = torch.autograd.grad(loss, off)
    steps = (gradient * off).sum((2, 3)).detach()  # what a relative change of the error is worth
    torch.testing.assert_close(steps[0].sum(), steps[1].sum(), rtol=0.1, atol=0)
    assert torch.autograd.gradcheck(lambda x: relative_errors(x, torch.zeros_like(x), bodies, 1.0), off)


def test_images_without_error_or_bodies_have_finite_gradients():
    pred = torch.zeros(1, 4, 4, 3, requires_grad=True)
    loss = relative_errors(pred, torch.zeros(1, 4, 4, 3), torch.zeros(1, 4, 4, dtype=torch.bool)).sum()
    (gradient,) = torch.autograd.grad(loss, pred)
    assert loss.isfinite() and not gradient.any()


@pytest.mark.parametrize("relative", [False, True])
def test_perceptual_distances_are_added(relative):
    images, truth, distances = torch.rand(4, 8, 8, 3), torch.rand(4, 3, 8, 8), torch.tensor([0.1, 0.2, 0.3, 0.4])
    cameras = Cameras(*torch.eye(4).expand(2, 4, 4, 4), *torch.ones(2, 4), torch.arange(4) % 2, 8, 8)
    targets = Frames(truth, cameras, torch.zeros(2).long(), torch.arange(2), torch.zeros(1, 3))
    settings = LossConfig(relative=relative, body_weight=1.0, perceptual=0.5)
    weights = torch.tensor([1.0, 2.0])
    plain, _ = training_loss(dataclasses.replace(settings, perceptual=0.0), None, images, targets, weights)
    loss, _ = training_loss(settings, lambda seen, other: distances, images, targets, weights)
    added = (distances + LEAST_ERROR).log() if relative else distances
    expected = 0.5 * ((added[0] + added[2]) / 2 + 2 * (added[1] + added[3]) / 2)
    assert (loss - plain).item() == pytest.approx(expected.item(), rel=1e-4)


def test_mean_by_step_of_a_step_without_images():
    assert mean_by_step(torch.tensor([2.0, 4.0]), torch.tensor([2, 2]), 4).tolist() == [0, 0, 3, 0]


def test_one_cycle_start_peak_and_end():
    rates = [one_cycle(step, 1000, 2e-4, warm_up=0.1) for step in range(1000)]
    assert rates[0] == pytest.approx(8e-6)
    assert max(rates) == pytest.approx(2e-4) and rates.index(max(rates)) == 99
    assert rates[-1] == pytest.approx(8e-10)
    assert rates[:100] == sorted(rates[:100]) and rates[99:] == sorted(rates[99:], reverse=True)
    assert all(math.isfinite(one_cycle(0, n, 1.0, 0.0)) for n in (1, 2))


def test_the_published_schedule():
    """Peak 2e-4 at 1 % of the steps, from 8e-6 and down to 8e-10."""
    rates = [one_cycle(step, 120_000, 2e-4) for step in (0, 1199, 119_999)]
    assert rates == pytest.approx([8e-6, 2e-4, 8e-10], rel=1e-9)


def test_one_cycle_equals_torch():
    parameter = torch.nn.Parameter(torch.zeros(1))
    optimizer = torch.optim.SGD([parameter], lr=1)
    theirs = torch.optim.lr_scheduler.OneCycleLR(optimizer, 2e-4, total_steps=200, pct_start=0.1, cycle_momentum=False)
    for step in range(200):
        assert one_cycle(step, 200, 2e-4, 0.1) == pytest.approx(theirs.get_last_lr()[0], rel=1e-9, abs=1e-15)
        optimizer.step()
        if step < 199:
            theirs.step()
