"""Spring-Gaus fitted to generated scenes, as ``gsim3d evaluate`` does."""

import dataclasses
import json
import shutil

import pytest
import torch

from gsim3d import baselines
from gsim3d.baselines import SpringGausConfig, baseline, spring_gaus
from gsim3d.data import Scene, find_scenes
from gsim3d.errors import InputError
from gsim3d.evaluate.job import Job, evaluate
from gsim3d.synth import generate

TARGETS = [2, 4, 6, 7, 8, 10, 11]
QUICK = SpringGausConfig(
    fit_frames=4, anchors=64, neighbors=8, edge=0.05, substeps=5, more_substeps=5, static_iterations=24,
    ground_iterations=8, refine_iterations=2, velocity_iterations=2, dynamic_iterations=2,
)  # fmt: skip


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    folder = tmp_path_factory.mktemp("elastic")
    given = {"world": "elastic", "preset": "mini", "n_trajectories": 1, "seed": 77}
    generate(str(folder), **given, processes=1, progress=False)
    return folder


@pytest.fixture
def quick(monkeypatch):
    monkeypatch.setattr(spring_gaus, "FINE", 12)
    monkeypatch.setattr(spring_gaus, "GROUND", 20)
    for name, config in baselines.BASELINES.items():
        few = {
            "fit_frames": config.fit_frames and QUICK.fit_frames,
            "dynamic_iterations": min(config.dynamic_iterations, 3),
        }
        monkeypatch.setitem(baselines.BASELINES, name, dataclasses.replace(QUICK, **few))


def test_a_fit_falls_as_the_body_does(data, quick):
    scene = Scene.open(find_scenes(data)[0])
    cams = [cam for cam in range(scene.n_cams) if cam in (0, 3, 5, 9)]
    started = [spring_gaus.Fit(scene, cams, 4, QUICK, torch.device("cpu")) for _ in range(2)]
    given = dataclasses.replace(QUICK, dynamic_iterations=0)
    assert started[1].with_dynamics(4, given).losses == []
    made = [start.with_dynamics(4, QUICK) for start in started]  # once after another fit from the same start
    images = [fit.images([2], range(8), fit.ground) for fit in made]
    assert torch.equal(*images) and torch.equal(images[0], made[0].images([2], range(8), made[0].ground))
    truth = scene.images([2], range(8)).permute(0, 1, 3, 4, 2) / 255
    errors = (images[0] - truth).square().mean((1, 2, 3, 4))
    held = (images[0][:1] - truth).square().mean((1, 2, 3, 4))
    assert errors[0] < 0.01 and errors[7] < held[7]
    assert made[0].losses[-1] < 0.05 and made[0].velocity.abs().max() > 0


def test_a_gpu_fits_as_a_cpu_does(data, quick, devices):
    scene, cams = Scene.open(find_scenes(data)[0]), (0, 3, 5, 9)
    fits = [spring_gaus.Fit(scene, cams, 4, QUICK, torch.device(d)).with_dynamics(4, QUICK) for d in devices]
    cpu, cuda = (fit.images([2], range(8), fit.ground).cpu() for fit in fits)
    assert (cpu - cuda).abs().mean() < 0.01 and fits[1].losses[-1] == pytest.approx(fits[0].losses[-1], rel=0.2)


def test_what_it_simulated_is_recovered(data, quick, monkeypatch):
    scene, cams = Scene.open(find_scenes(data)[0]), (0, 3, 5, 9)
    config = dataclasses.replace(QUICK, velocity_iterations=45, dynamic_iterations=12, more_substeps=0)
    start = spring_gaus.Fit(scene, cams, 2, QUICK, torch.device("cpu"))
    start.velocity, start.height = torch.tensor([0.04, -0.03, 0.02]), -9.0
    falling = start.with_dynamics(4, dataclasses.replace(config, dynamic_iterations=0))
    start.height = float(start.springs.rest[:, 2].min()) + 0.02  # in contact from the first frame on
    landing = start.with_dynamics(8, dataclasses.replace(config, dynamic_iterations=0, stiffness=500.0))
    frames = {4: falling.images(cams, range(4)), 8: landing.images(cams, range(8))}

    def load(self, count):
        self._generator = torch.Generator().manual_seed(1)
        self._cameras = [scene.cameras_at(cams, [step]) for step in range(count)]
        self._objects = frames[count]

    monkeypatch.setattr(spring_gaus.Fit, "_load", load)
    fit = start.with_dynamics(8, config)
    assert 2.69 < fit.stiffness.mean() < 2.99 and sum(fit.losses[-4:]) < 0.95 * sum(fit.losses[:4])
    start.config, start.height, start.velocity = config, -9.0, torch.zeros(3, requires_grad=True)
    start._load(4)
    start._fit_velocity(0.0)
    assert (start.velocity - falling.velocity).norm() < 0.02 * falling.velocity.norm()
    start.velocity = fast = torch.tensor([-0.24, 0.21, 0.3])  # the rate reaches 0.02 m/s
    frames[4] = start.with_dynamics(4, dataclasses.replace(config, dynamic_iterations=0)).images(cams, range(4))
    start.config = dataclasses.replace(config, velocity_iterations=7)
    start._load(4)
    start._fit_velocity(0.0)
    assert (start.velocity - fast).norm() < 0.1 * fast.norm()
    frames[4] = torch.zeros_like(frames[4])
    start._load(4)
    assert not start._seen_velocity().any()


def test_evaluate_scores_baselines_without_a_checkpoint(data, quick, tmp_path):
    out = tmp_path / "metrics.json"
    given = {"given": 4, "steps": 4, "cameras": TARGETS, "scenes": "all", "metrics": ["psnr", "psnr_body"]}
    evaluate(Job(data=str(data), baselines=["spring-gaus"], out=str(out), **given))
    report = json.loads(out.read_text())
    physics = report["physics"]["spring-gaus"]
    assert list(report["physics"]) == ["spring-gaus"] and physics["true energy"] == pytest.approx(
        physics["energy"], rel=0.2
    )
    (found,) = [scene["fitted"]["spring-gaus"] for scene in report["scenes"].values()]
    assert found["substeps"] >= 5 and len(found["velocity"]) == 3 and found["stiffness"] > 0
    assert 0 < found["seconds"] < 600 and found["parameters"] > 8 * 20**2 + 64 + 5  # of the ground, and of 64 anchors
    assert report["not_applicable"] == {} and "spring-gaus" in report["predictions"]
    assert report["spring-gaus.future.psnr"] > 18 and report["spring-gaus-object.future.psnr"] > 12
    assert "spring-gaus-object.future.psnr_body" not in report and report["fitted"]["spring-gaus"]["anchors"] == 64


def test_a_shared_start_counts_for_each(data, quick, monkeypatch):
    scene, cams, clock = Scene.open(find_scenes(data)[0]), [1, 2, 4, 6, 7, 8, 10, 11], iter(range(100))
    given = {"static_iterations": 2, "ground_iterations": 2, "velocity_iterations": 0, "dynamic_iterations": 1}
    for name, config in list(baselines.BASELINES.items()):
        monkeypatch.setitem(baselines.BASELINES, name, dataclasses.replace(config, **given))
    monkeypatch.setattr(spring_gaus, "perf_counter", lambda: next(clock))
    for name in ("spring-gaus", "spring-gaus-given"):  # the second has the start of the first
        method = baseline(name)
        method.images(scene, cams, 4, 1)
        method.object_images(scene, cams, 4, 1)
        assert method.found()["seconds"] == 3  # a second each for start, dynamics and images


def test_where_it_does_not_apply_it_says_why(data, quick, tmp_path, monkeypatch, capsys):
    with pytest.raises(InputError, match="choose from spring-gaus"):
        baseline("springs")
    scene, method = Scene.open(find_scenes(data)[0]), baseline("spring-gaus")
    with pytest.raises(InputError, match="0 cameras are left"):
        method.check(scene, list(range(scene.n_cams)), 4, 4)
    for place, name, found in (
        (Scene, "generated", {"world": "cloth", "bodies": [0, 1]}),
        (spring_gaus, "_count_bodies", lambda scene: 4),
    ):
        monkeypatch.setattr(place, name, found)
        with pytest.raises(InputError, match=r"[34] bodies \(a cloth is one\), and it simulates one"):
            method.check(scene, [2], 4, 4)
    out = tmp_path / "metrics.json"
    with pytest.raises(InputError, match="--baselines: names must be unique"):
        evaluate(Job(data=str(data), baselines=["spring-gaus"] * 2, given=4))
    job = Job(data=str(data), baselines=["spring-gaus"], given=4, steps=4, cameras=TARGETS, scenes="all", out=str(out))
    evaluate(job)
    (reason,) = json.loads(out.read_text())["not_applicable"]["spring-gaus"].values()
    assert "4 bodies" in reason and "4 bodies" in capsys.readouterr().out


def test_a_scene_where_it_does_not_apply_is_left_out_alone(data, quick, tmp_path, monkeypatch, capsys):
    (scene,) = find_scenes(data)
    for name in ("0000", "0001", "0002"):
        shutil.copytree(scene, tmp_path / "set" / "spot" / name)
    count = spring_gaus._hull
    monkeypatch.setattr(spring_gaus, "_hull", lambda scene, *given: (*count(scene, *given)[:1], scene.name))
    monkeypatch.setattr(spring_gaus, "_count_bodies", lambda name: 4 if name.endswith("0001") else 1)
    monkeypatch.setattr(spring_gaus.SpringGaus, "points", lambda *given: torch.zeros(5, 0, 3))
    monkeypatch.setattr(spring_gaus.SpringGaus, "found", lambda self: {"substeps": 5})
    for name in ("images", "object_images"):
        monkeypatch.setattr(spring_gaus.SpringGaus, name, lambda self, scene, cams, n_encoded, n_future: (
            scene.images(cams, range(n_encoded, n_encoded + n_future)).permute(0, 1, 3, 4, 2)))  # fmt: skip
    given = {"given": 4, "steps": 4, "cameras": TARGETS, "scenes": "all", "metrics": ["psnr"]}
    out = tmp_path / "metrics.json"
    evaluate(Job(data=str(tmp_path / "set"), baselines=["spring-gaus"], out=str(out), **given))
    report = json.loads(out.read_text())
    assert list(report["not_applicable"]["spring-gaus"]) == ["spot/0001"]
    assert report["n_scenes"] == 3 and report["n_scenes_of"]["spring-gaus"] == 2
    assert report["spring-gaus.future.psnr"] == 100 and report["copy.future.psnr"] < 100
    for text in (capsys.readouterr().out, out.with_suffix(".md").read_text()):
        assert "spring-gaus: mean over 2 of 3 scenes" in text


def test_bodies_are_counted():
    inside = torch.zeros(20, 20, 20, dtype=torch.bool)
    inside[2:6, 2:6, 2:6] = inside[12:16, 12:16, 12:16] = True
    assert spring_gaus._count_bodies(inside) == 2
    inside[6:12, 5, 5] = inside[11, 5:12, 5] = inside[11, 11, 5:12] = inside[11:13, 11:13, 11:13] = True
    assert spring_gaus._count_bodies(inside) == 1
