"""Training of captures: images drawn without the particles of their own camera, gains, masks of any folder, rates."""

import dataclasses
import json

import cv2
import numpy as np
import pytest
import torch

from gsim3d.cameras import Cameras, Frames
from gsim3d.data import Scene
from gsim3d.errors import InputError
from gsim3d.state import concatenate
from gsim3d.train.captured import CapturedLoss
from gsim3d.train.config import DataConfig, LossConfig, PhaseConfig, TrainConfig
from gsim3d.train.left_out import draw_left_out, images_per_cloud, with_views
from gsim3d.train.loop import Trainer
from gsim3d.train.losses import image_errors, relative_gains, training_loss
from gsim3d.train.restore import restore
from gsim3d.train.run import train
from tests.tiny_scenes import write_scene

CONFIG = TrainConfig(
    phases=(PhaseConfig(steps=1, horizon=1, batch=2),),
    data=DataConfig(history=2, context_views=3, context_cameras=(0, 1, 2), leave_one_out=True, subsample_fps=6.0),
    loss=LossConfig(image_gain=True),
)


@pytest.fixture(scope="module")
def trainer(tmp_path_factory):
    folder = tmp_path_factory.mktemp("left_out")
    scenes = [Scene.open(write_scene(folder / f"{i}", seed=i), fps=6.0) for i in range(2)]
    return Trainer(CONFIG, scenes, folder / "run")


def test_targets_are_the_inputs(trainer):
    batch = trainer._batch([0, 1])
    assert len(batch.targets.cameras) == 2 * 3 * 3 and len(batch.context.cameras) == 2 * 2 * 3
    by_cloud = batch.targets.cameras.viewmats.view(2, 3, 3, 4, 4)
    torch.testing.assert_close(by_cloud[:, :2], batch.context.cameras.viewmats.view(2, 2, 3, 4, 4), rtol=0, atol=0)


def test_no_gradient_to_particles_of_the_target_camera(trainer):
    batch, simulator = trainer._batch([0, 1]), trainer.simulator
    state = with_views(simulator.encode(batch.context), batch.context)
    steps = simulator.rollout(state, 1, trainer.plan)
    particles = concatenate([state, *steps])
    assert particles.label.bincount().tolist() == [(particles.label == v).sum() for v in range(3)]
    assert min(particles.label.bincount()) > 0
    leaf = particles.means.detach().requires_grad_()
    particles = dataclasses.replace(particles, means=leaf)
    views = images_per_cloud(batch.context)
    images = draw_left_out(
        lambda p, cameras, valid: simulator.render(p, cameras, plan=trainer.plan, active=valid).color,
        particles,
        batch.targets,
        views,
    )
    for view in range(3):
        (gradient,) = torch.autograd.grad(images[view::3].square().sum(), leaf, retain_graph=True)
        assert (gradient[particles.label == view] == 0).all()
        assert all(gradient[particles.label == other].abs().max() > 0 for other in range(3) if other != view)


def test_particles_know_the_image_they_come_from(trainer):
    frames = trainer._batch([0]).context
    state = with_views(trainer.simulator.encode(frames), frames)
    counts = frames.masks.flatten(1).sum(1).view(-1, 3)
    expected = torch.cat([torch.arange(3).repeat_interleave(row) for row in counts])
    assert state.label.tolist() == expected.tolist()


@pytest.mark.parametrize("leaves_out", [False, True])
def test_tiles_outside_of_the_mask_are_not_drawn(trainer, leaves_out, monkeypatch):
    batch = trainer._batch([0, 1])
    valid = torch.zeros(batch.targets.images[:, 0].shape, dtype=torch.bool)
    valid[:, :10, :20] = True
    batch = dataclasses.replace(batch, targets=dataclasses.replace(batch.targets, valid=valid))
    config = dataclasses.replace(CONFIG, data=dataclasses.replace(CONFIG.data, leave_one_out=leaves_out))
    monkeypatch.setattr(trainer, "config", config)
    render, parameters, drawn = trainer.simulator.render, list(trainer.parameters.values()), []

    def loss(with_mask):
        def spied(*arguments, active, **options):
            image = render(*arguments, active=active if with_mask else None, **options)
            drawn.append((image.color > 0).sum().item())
            return image

        monkeypatch.setattr(trainer.simulator, "render", spied)
        value, errors = trainer.loss(batch)
        return value, errors, *torch.autograd.grad(value, parameters, materialize_grads=True)

    masked, whole = loss(True), loss(False)
    assert sum(drawn[: len(drawn) // 2]) < 0.8 * sum(drawn[len(drawn) // 2 :])
    for a, e in zip(masked, whole, strict=True):
        assert torch.equal(a, e)


def test_captured_loss_leaves_out_the_same_particles(trainer):
    batch = trainer._batch([0, 1])
    loss, errors = trainer.loss(batch)
    gradients = torch.autograd.grad(loss, list(trainer.parameters.values()), allow_unused=True)
    captured = CapturedLoss(
        trainer.simulator,
        trainer.plan,
        trainer.loss_of_images,
        lambda part: torch.autocast("cpu", enabled=False),
        (),
        True,
    )
    found = captured(captured.prepare(batch), trainer.step_weights(batch), trainer.simulator.report)
    torch.testing.assert_close(found.errors, errors, rtol=1e-4, atol=1e-6)
    known = dict(zip(map(id, captured.parameters), found.parameters, strict=True))
    for parameter, gradient in zip(trainer.parameters.values(), gradients, strict=True):
        if gradient is not None and gradient.abs().max() > 1e-4:
            assert (known[id(parameter)] - gradient).norm() < 0.02 * gradient.norm()


def cameras_of(n_scenes, n_steps, n_cameras):
    poses = torch.eye(4).repeat(n_scenes * n_steps * n_cameras, 1, 1)
    poses[:, 0, 3] = torch.arange(n_cameras).repeat(n_scenes * n_steps)
    clouds = torch.arange(n_scenes * n_steps).repeat_interleave(n_cameras)
    return Cameras(poses, torch.eye(3).expand(len(poses), 3, 3), *torch.ones(2, len(poses)), clouds, 8, 8)


def test_gains_of_cameras_are_fitted_relative_to_their_mean(trainer):
    pred = torch.rand(3, 8, 8, 3, generator=torch.Generator().manual_seed(0))
    gains = torch.tensor([[1.2, 0.8, 1.0], [3.0, 0.1, 1.0], [1.0, 1.0, 1.0]])[:, None, None]
    limited, cameras = gains.clamp(1 / 1.5, 1.5), cameras_of(1, 1, 3)
    expected = limited / limited.log().mean(0).exp()
    torch.testing.assert_close(relative_gains(pred, pred * gains, cameras, 1), expected)
    assert (relative_gains(torch.zeros_like(pred), torch.ones_like(pred), cameras, 1) == 1).all()
    twice = relative_gains(pred.repeat(2, 1, 1, 1), torch.cat([pred * gains, pred / 2]), cameras_of(2, 1, 3), 1)
    torch.testing.assert_close(twice, torch.cat([expected, torch.ones_like(expected)]))  # each scene of its own
    targets, weights = trainer._batch([0]).targets, torch.ones(3)
    truth = targets.images.permute(0, 2, 3, 1)
    exposure = torch.tensor([0.8, 1.0, 1.25]).repeat(3)[:, None, None, None]  # of the three cameras at each step
    for images, forgiven in ((truth * exposure, True), (truth * 0.8, False)):
        plain, _ = training_loss(LossConfig(), None, images, targets, weights)
        gained, _ = training_loss(LossConfig(image_gain=True), None, images, targets, weights)
        assert gained < 1e-6 * plain if forgiven else torch.isclose(gained, plain, rtol=1e-3)


@pytest.mark.parametrize("fading", [(0, 1, 2), (1,)], ids=["all cameras", "one camera"])
def test_gains_do_not_forgive_images_that_darken_over_time(fading):
    truth = torch.rand(12, 8, 8, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    fade = torch.ones(4, 3, dtype=torch.float64)
    fade[:, fading] = torch.linspace(1.2, 0.8, 4, dtype=torch.float64)[:, None]
    images, cameras = (truth * fade.flatten()[:, None, None, None]).requires_grad_(), cameras_of(1, 4, 3)
    gains = relative_gains(images.detach(), truth, cameras, 4)
    assert gains.view(4, 3, 3).diff(dim=0).abs().max() < 1e-12
    plain, gained = (image_errors(image, truth).mean() for image in (images, images * gains))
    assert 0.9 * plain < gained < 1.1 * plain
    targets = Frames(truth.permute(0, 3, 1, 2), cameras, torch.zeros(4).long(), torch.arange(4), torch.zeros(1, 3))
    loss, _ = training_loss(LossConfig(image_gain=True), None, images, targets, torch.full((4,), 0.25).double())
    gradient, expected = (torch.autograd.grad(of, images)[0] for of in (loss, gained))
    torch.testing.assert_close(gradient, expected, rtol=1e-12, atol=1e-15)


def test_run_trains_at_the_subsampled_rate_and_its_model_asks_for_it(tmp_path):
    folders = [write_scene(tmp_path / "data" / str(i), seed=i) for i in range(2)]
    config = dataclasses.replace(CONFIG, phases=(PhaseConfig(steps=1, horizon=1),))
    train(config, folders, tmp_path / "run")
    scene = restore(tmp_path / "run").open_scene(folders[0])
    assert scene.fps == 6 and scene.n_steps == 3


def test_leaving_out_needs_two_views():
    with pytest.raises(InputError, match="leave_one_out: needs two input views"):
        DataConfig(context_views=1, leave_one_out=True)
    with pytest.raises(InputError, match="targets_apart"):
        DataConfig(leave_one_out=True, targets_apart=True)


def test_masks_of_any_folder(tmp_path):
    cameras = []
    for cam in range(2):
        entry = {"name": f"c{cam}", "size": [32, 16], "K": [[30, 0, 16], [0, 30, 8], [0, 0, 1]], "T": [0.1 * cam, 0, 3]}
        cameras.append({**entry, "R": np.eye(3).tolist()})
        for kind in (f"c{cam}", f"sam/c{cam}"):
            (tmp_path / kind).mkdir(parents=True)
        for frame in range(2):
            segments = np.zeros((16, 32), np.uint8)
            segments[4:8, 4 + frame : 12] = 7  # the number of a segment
            cv2.imwrite(str(tmp_path / f"c{cam}" / f"{frame}.png"), np.full((16, 32, 3), 90, np.uint8))
            cv2.imwrite(str(tmp_path / "sam" / f"c{cam}" / f"{frame}.png"), segments)
    content = {"cameras": cameras, "fps": 10, "near": 1, "far": 5, "masks": "sam"}
    (tmp_path / "cameras.json").write_text(json.dumps(content))
    labels = Scene.open(tmp_path).segmentation([0, 1], [0, 1])
    assert (labels[1, :, 4:8, 5:12] == 3).all() and (labels > 0).sum() == 2 * 4 * (8 + 7)
    for bad, message in (("nothing", "a folder beside it"), ("../sam", "not a file inside"), (3, "a folder beside it")):
        (tmp_path / "cameras.json").write_text(json.dumps(content | {"masks": bad}))
        with pytest.raises(InputError, match=message):
            Scene.open(tmp_path)
