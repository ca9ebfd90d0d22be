"""The protocol: what the baselines show, how scores are averaged, and that reports hold no NaN."""

import copy
import dataclasses
import json
import math
import shutil

import pytest
import torch

from gsim3d import presets
from gsim3d.cameras import InputSpec
from gsim3d.data import Scene
from gsim3d.effects.spec import EffectsSpec
from gsim3d.errors import InputError
from gsim3d.evaluate import pictures, protocol
from gsim3d.evaluate.pictures import splat_picture, true_images, write_curves, write_prediction
from gsim3d.evaluate.protocol import (
    METHODS,
    Prediction,
    constant_velocity,
    default_views,
    predict,
    predict_together,
    render_steps,
    score_scene,
)
from gsim3d.evaluate.report import summarize, table, write_json
from gsim3d.evaluate.scoring import SceneScores
from gsim3d.io.checkpoint import Checkpoint
from gsim3d.numerics.speed import Setting
from gsim3d.state import concatenate
from gsim3d.train.config import DataConfig
from gsim3d.train.restore import Restored, build_simulator
from tests.tiny_scenes import write_scene

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return Scene.open(write_scene(tmp_path_factory.mktemp("scene") / "0000"))


@pytest.fixture(scope="module")
def restored():
    """An untrained model: tiny's dynamics starts as the identity, so a little noise in its head makes things move."""
    simulator = build_simulator(presets.tiny(), seed=0).eval()
    with torch.no_grad():
        simulator.dynamics.net.head.fc2.weight.normal_(0, 0.02, generator=torch.Generator().manual_seed(0))
    data = DataConfig(history=2, context_views=2, target_only_cameras=(3,), background_stride=2)
    simulator.inputs = InputSpec(history=2, context_views=2, background_stride=2, image_size=(32, 32))
    return Restored(simulator, data, simulator.plan(EffectsSpec()), Checkpoint({}, {}))


def moved_to(device, restored):
    return dataclasses.replace(restored, simulator=copy.deepcopy(restored.simulator).to(device))


def test_default_views(restored, scene):
    assert default_views(restored, scene) == ((0, 2), (3,))
    free = dataclasses.replace(restored, data=DataConfig(context_views=2))
    assert default_views(free, scene) == ((0, 2), (1, 3, 4))


def test_scenes_predicted_together_are_those_predicted_alone(restored, scene, tmp_path, device):
    restored = moved_to(device, restored)
    scenes = [scene, Scene.open(write_scene(tmp_path / "0001", seed=1))]
    for one, together in zip(scenes, predict_together(restored, scenes, 3), strict=True):
        alone = predict(restored, one, default_views(restored, one)[0], 3)
        assert (together.n_encoded, together.context_cams) == (alone.n_encoded, alone.context_cams)
        images = [render_steps(restored, p.particles, one, [3, 1]) for p in (together, alone)]
        torch.testing.assert_close(*images, rtol=0, atol=1e-5 if device.type == "cpu" else 1e-3)
        scores = [score_scene(restored, one, n_future=3, prediction=p).values for p in (together, alone)]
        for method, metrics in scores[0].items():
            for metric, values in metrics.items():
                torch.testing.assert_close(values, scores[1][method][metric], rtol=1e-3, atol=1e-3, equal_nan=True)


def test_predictions_of_two_calls_are_not_mixed(restored, scene, tmp_path, monkeypatch):
    """The call that ends last is refused; what the other one has written stays as it is."""
    prediction, write_clip = predict(restored, scene, (0, 2), 1), pictures.write_video
    other = tmp_path / ".out.part" / "frames"
    other.mkdir(parents=True)

    def while_another_ends(*arguments):
        write_clip(*arguments)
        shutil.copytree(other.parent, tmp_path / "out")

    monkeypatch.setattr(pictures, "write_video", while_another_ends)
    with pytest.raises(InputError, match="out exists already"):
        write_prediction(tmp_path / "out", restored, scene, prediction, [3], 0, quiet=True)
    assert sorted(path.name for path in tmp_path.rglob("*")) == [".out.part", "frames", "frames", "out"]


def test_views_that_are_named(restored, scene):
    assert default_views(restored, scene, (1, 3)) == ((1, 3), (3,))
    assert default_views(restored, scene, (1, 0), (4, 1)) == ((1, 0), (4, 1))
    context, target = default_views(restored, scene, None, (0, 3))
    assert target == (0, 3) and len(context) == 2 and not {0, 3} & set(context)
    with pytest.raises(InputError, match="1 cameras left as inputs; training used 2 views"):
        default_views(restored, scene, None, (0, 1, 2))
    elsewhere = dataclasses.replace(restored, data=DataConfig(context_views=2, target_only_cameras=(7,)))
    assert default_views(elsewhere, scene, (0, 1), (2,)) == ((0, 1), (2,))
    assert default_views(elsewhere, scene, None, (2,)) == ((0, 3), (2,))  # of the training's rig no number holds here


def test_scores_from_a_later_step_equal_those_of_a_cut_scene(restored, tmp_path):
    whole, cut = (write_scene(tmp_path / name) for name in ("whole", "cut"))
    for folder in cut.glob("cam_*"):
        for image in sorted(folder.iterdir()):  # step 0 is lost, the others move up
            image.rename(folder / f"{image.stem[:-4]}{max(0, int(image.stem[-4:]) - 1):04d}.png")
    metadata = json.loads((whole / "metadata.json").read_text())
    places = [metadata[f"cam_{cam}"]["extrinsics"] for cam in range(5)]
    for folder, first in ((whole, 0), (cut, 1)):
        for cam in range(5):  # cameras move
            metadata[f"cam_{cam}"]["extrinsics"] = [places[(cam + step // 3) % 5] for step in range(first, 6)]
        (folder / "metadata.json").write_text(json.dumps({**metadata, "n_steps": 6 - first}))
    later, expected = score_scene(restored, Scene.open(whole), start=1), score_scene(restored, Scene.open(cut))
    assert later.n_steps == expected.n_steps == 5 and list(later.values) == list(METHODS)
    for method, metrics in expected.values.items():
        for metric, values in metrics.items():
            assert torch.equal(later.values[method][metric].nan_to_num(), values.nan_to_num()), (method, metric)
    with pytest.raises(InputError, match="but only 0 after the input"):
        score_scene(restored, Scene.open(whole), start=4)


def test_rollout_keeps_number_of_particles_and_frozen_positions(restored, scene):
    prediction = predict(restored, scene, (0, 2), 3)
    assert prediction.n_steps == 5
    clouds = [prediction.particles.select_clouds(torch.tensor([q])) for q in range(1, 5)]
    assert len({cloud.n_rows for cloud in clouds}) == 1
    frozen = clouds[0].activity == 1
    assert torch.equal(clouds[0].means[frozen], clouds[-1].means[frozen])
    assert (clouds[0].means[~frozen] != clouds[-1].means[~frozen]).any()


def test_constant_velocity_continues_the_centroid(restored, scene):
    prediction = predict(restored, scene, (0, 2), 3)

    def centroid(particles, cloud):
        cloud = particles.select_clouds(torch.tensor([cloud]))
        return cloud.means[cloud.activity == 0].mean(0)

    first, last = centroid(prediction.particles, 0), centroid(prediction.particles, 1)
    moved = constant_velocity(prediction)
    assert moved.n_clouds == 3
    for j in range(3):
        torch.testing.assert_close(centroid(moved, j), last + (j + 1) * (last - first), rtol=0, atol=1e-5)


VELOCITY = torch.tensor([0.05, -0.03, 0.02])


def falling_apart(restored, scene, n_steps):
    """Hand-made particles: a body of 20 that moves by VELOCITY a step, and 15 on the ground that stay."""
    encoded = predict(restored, scene, (0, 2), 1).particles.select_clouds(torch.tensor([0]))
    chosen = torch.zeros(encoded.n_rows, dtype=torch.bool)
    chosen[:35] = True
    cloud = encoded.select_rows(chosen)
    activity = torch.ones(35, dtype=torch.uint8)
    activity[:20] = 0
    means = torch.rand(35, 3, generator=torch.Generator().manual_seed(0)) * 0.5 + torch.tensor([-0.25, -0.25, 0.2])
    steps = [
        dataclasses.replace(
            cloud,
            activity=activity,
            cloud_step=cloud.cloud_step + t,
            means=means + t * VELOCITY * (activity == 0)[:, None],
        )
        for t in range(n_steps)
    ]
    return concatenate(steps)


def test_constant_velocity_is_exact_for_a_body_that_translates(restored, scene):
    truth = falling_apart(restored, scene, 6)
    prediction = Prediction(truth, n_encoded=2, context_cams=(0, 2))
    moved = constant_velocity(prediction)
    torch.testing.assert_close(moved.means, truth.means[2 * 35 :], rtol=0, atol=1e-6)
    assert torch.equal(moved.means.unflatten(0, (4, 35))[:, 20:], truth.means.unflatten(0, (6, 35))[:4, 20:])
    # Only the mean motion counts: the same body turned into a cloud that also grows is continued, not grown.
    later = truth.select_clouds(torch.tensor([1]))
    grown = dataclasses.replace(later, means=torch.where((later.activity == 0)[:, None], later.means * 2, later.means))
    pair = Prediction(concatenate([truth.select_clouds(torch.tensor([0])), grown, grown]), 2, (0, 2))
    body = constant_velocity(pair).means[:20]
    speed = grown.means[:20].mean(0) - truth.means[:20].mean(0)
    torch.testing.assert_close(body, grown.means[:20] + speed, rtol=0, atol=1e-6)


def test_baselines_of_a_body_that_translates(restored, scene, monkeypatch):
    """The images show the hand-made body: continuing it is right, holding it is worse the longer it is held."""
    truth = falling_apart(restored, scene, 6)
    monkeypatch.setattr(protocol, "predict", lambda *_, start: Prediction(truth, 2, (0, 2)))
    images = render_steps(restored, truth, scene, [3])
    monkeypatch.setattr(
        scene, "images", lambda cams, steps: (images * 255).round().to(torch.uint8).permute(0, 1, 4, 2, 3)
    )
    values = {name: v["psnr"] for name, v in score_scene(restored, scene).values.items() if "psnr" in v}
    assert (values["model"] > 50).all() and (values["constant_velocity"][2:] > 50).all()  # rounded to 8 bits
    for name in ("constant", "copy", "release_constant"):
        assert (values[name][3:] < 40).all() and values[name][5] < values[name][3]
    assert values["release_constant"][2] > 50 and values["constant"][2] < 40
    torch.testing.assert_close(values["copy"][2:], values["constant"][2:], rtol=0.02, atol=0)


@pytest.mark.parametrize("hidden", [0, 1])
def test_constant_velocity_without_a_motion_to_continue(restored, scene, hidden):
    truth = falling_apart(restored, scene, 3)
    activity = truth.activity.clone()
    activity[35 * hidden : 35 * (hidden + 1)] = 1
    unseen = Prediction(dataclasses.replace(truth, activity=activity), 2, (0, 2))
    single = Prediction(truth, 1, (0, 2))
    assert torch.equal(constant_velocity(unseen).means, truth.means[35:70])
    assert torch.equal(constant_velocity(single).means, truth.means[:35].repeat(2, 1))


def test_baselines_are_seen_by_cameras_that_move(restored, scene, tmp_path, monkeypatch):
    folder = tmp_path / "moving"
    shutil.copytree(scene.path, folder)
    metadata = json.loads((folder / "metadata.json").read_text())
    places = [metadata[f"cam_{cam}"]["extrinsics"] for cam in range(5)]
    for cam in range(5):
        metadata[f"cam_{cam}"]["extrinsics"] = [places[cam if step < 4 else (cam + 1) % 5] for step in range(6)]
    (folder / "metadata.json").write_text(json.dumps(metadata))
    moving = Scene.open(folder)
    assert moving.cameras_move and not scene.cameras_move
    prediction = predict(restored, scene, (0, 2), 4)
    still = render_steps(restored, prediction.particles, scene, [3, 4])
    for step in (1, 2):
        images = protocol._held(restored, prediction, None, step, moving, [3])
        torch.testing.assert_close(images[:2, 0], still[step, 0].expand(2, 32, 32, 3))
        torch.testing.assert_close(images[2:, 0], still[step, 1].expand(2, 32, 32, 3))  # camera 3 is where 4 was
    body = falling_apart(restored, scene, 6)
    monkeypatch.setattr(protocol, "predict", lambda *_, start: Prediction(body, 2, (0, 2)))
    images = render_steps(restored, body, moving, [3])
    monkeypatch.setattr(
        moving, "images", lambda cams, steps: (images * 255).round().to(torch.uint8).permute(0, 1, 4, 2, 3)
    )
    values = {name: v["psnr"] for name, v in score_scene(restored, moving).values.items() if "psnr" in v}
    assert (values["model"] > 50).all() and (values["constant_velocity"][2:] > 50).all()
    assert (values["copy"][4:] < values["constant"][4:]).all()  # a still image does not follow the camera


def test_scores_by_hand(restored, scene):
    scores = score_scene(restored, scene)
    assert set(scores.values) == set(METHODS) and scores.n_encoded == 2
    truth = scene.images([3], range(6)).permute(0, 1, 3, 4, 2).float() / 255
    for step in range(2, 6):
        mse = (truth[1] - truth[step]).square().mean().item()
        assert scores.values["copy"]["psnr"][step].item() == pytest.approx(-10 * math.log10(mse), abs=1e-4)
    prediction = predict(restored, scene, (0, 2), 4)
    images = render_steps(restored, prediction.particles, scene, [3])
    for method, shown in (("model", 4), ("constant", 1), ("release_constant", 2)):
        mask = scene.segmentation([3], [4])[0] > 0
        mse = (images[shown] - truth[4])[mask].square().mean().item()
        assert scores.values[method]["psnr_masked"][4].item() == pytest.approx(-10 * math.log10(mse), abs=1e-4)
    assert scores.values["constant"]["psnr"][:2].isnan().all()


def test_scores_are_the_same_on_both_devices(restored, scene, devices):
    cpu, cuda = (score_scene(moved_to(device, restored), scene).values for device in devices)
    for method in METHODS:
        for metric, values in cpu[method].items():
            torch.testing.assert_close(cuda[method][metric], values, rtol=0, atol=0.01, equal_nan=True)


def test_what_does_not_fit_is_named(restored, scene):
    larger = copy.copy(restored.simulator)
    larger.inputs = dataclasses.replace(larger.inputs, image_size=(64, 64))
    with pytest.raises(InputError, match="the model was trained on 64x64"):
        predict(dataclasses.replace(restored, simulator=larger), scene, (0, 2), 1)
    near_only = dataclasses.replace(restored.data, near_far=(scene.near, scene.far - 0.5))
    with pytest.raises(InputError, match="open the scene with open_scene"):
        predict(dataclasses.replace(restored, data=near_only), scene, (0, 2), 1)
    with pytest.raises(InputError, match="at least 1"):
        predict(restored, scene, (0, 2), 0)
    with pytest.raises(InputError, match="from step 5"):
        predict(restored, scene, (0, 2), 1, start=5)
    with pytest.raises(InputError, match="only 4 after the input"):
        score_scene(restored, scene, n_future=5)


def example_scores(name="a", shift=0.0, n_steps=6):
    values = torch.arange(n_steps, dtype=torch.float64) + shift
    return SceneScores(name, 2, n_steps, {m: {"psnr": values.clone(), "ssim": values / 10} for m in METHODS}, {}, {})


def test_summary_by_hand(tmp_path):
    summary = summarize([example_scores("a"), example_scores("b", shift=2.0)])
    assert summary["past.psnr"] == 1.5 and summary["future.psnr"] == 4.5 and summary["future_late.psnr"] == 5.5
    assert summary["future_std.psnr"] == pytest.approx(math.sqrt(2))
    assert summary["constant.future.ssim"] == pytest.approx(0.45)
    assert summary["by_step"]["psnr"] == [1, 2, 3, 4, 5, 6] and summary["scenes"]["b"]["future.psnr"] == 5.5
    write_json(tmp_path / "a.json", summary)
    assert json.loads((tmp_path / "a.json").read_text()) == summary
    assert "predicted" in table(summary) and "4.50" in table(summary)
    write_curves(tmp_path / "a.png", summary, fps=12)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.json", "a.png"]


def test_values_that_do_not_exist_are_null(tmp_path):
    scores = example_scores()
    scores.values["model"]["psnr"][2:] = torch.nan
    summary = summarize([scores])
    assert summary["future.psnr"] is None and summary["future_std.psnr"] is None
    assert summary["by_step"]["psnr"][2:] == [None] * 4
    write_json(tmp_path / "a.json", summary)
    assert " - " in table(summary) + " "


def test_pictures(restored, scene, device):
    restored = moved_to(device, restored)
    prediction = predict(restored, scene, (0, 2), 6)
    truth = true_images(scene, [3, 1], range(8))
    assert truth[5].any() and not truth[6:].any()  # the scene has six steps
    assert splat_picture(restored, prediction, scene, 3, 1).shape == (320, 320, 3)


def test_predict_and_render_steps_follow_the_setting(restored, scene):
    """As Simulator.predict does; the reference stays as it is."""
    whole, fast = predict(restored, scene, (0, 2), 2), copy.copy(restored.simulator)
    least = float(whole.step(2).opacities.quantile(0.8))
    fast.setting = Setting(history=1, context_views=1, kept=0.5, least_opacity=least)
    fast.inputs = fast.setting.of_inputs(fast.inputs)
    fast = dataclasses.replace(restored, simulator=fast)
    prediction = predict(fast, scene, (0, 2), 2, start=1)
    assert prediction.n_encoded == 1 and prediction.n_steps == 3
    frames = scene.input_frames(fast.simulator.inputs, start=1, cams=[0])
    cameras = scene.cameras_at([3], [0])
    expected = fast.simulator.predict(frames, 2, fast.plan, cameras=cameras)
    assert torch.equal(prediction.step(2).means, expected.steps[1].means)
    images = render_steps(fast, prediction.step(2), scene, [3])[0]
    assert torch.equal(images, expected.renderings[1].color.clamp(0, 1))
    assert prediction.step(2).n_rows < whole.step(2).n_rows / 2
    assert not torch.equal(images, render_steps(restored, prediction.step(2), scene, [3])[0])
