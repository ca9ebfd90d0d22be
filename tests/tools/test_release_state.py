"""Runs for release: trajectories arrive while a run trains, its state is saved, and the next run goes on from it."""

import dataclasses
import itertools
import math
import shutil
import threading
import time
import types
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load_file

from gsim3d.data import Scene
from gsim3d.data.recording import BACKGROUND, FIXED, MOVING
from gsim3d.errors import InputError, RunStopped
from gsim3d.synth import generate
from gsim3d.synth.cameras import two_rings
from gsim3d.synth.run import write_trajectory
from gsim3d.synth.worlds import VALIDATION_SEED, build_world
from gsim3d.train.config import DataConfig, PhaseConfig, TrainConfig
from gsim3d.train.log import plain
from gsim3d.train.loop import deterministic
from gsim3d.train.processes import Processes
from gsim3d.train.restore import build_simulator, model_config, restore
from gsim3d.train.samples import draw_batch
from tools.release import curve, recipes, runs, validation
from tools.release.recipes import WORLDS, recipe
from tools.release.runs import RunTrainer, train
from tools.release.state import (
    Progress,
    begun_with,
    load_into,
    load_progress,
    save_state,
    state_file,
    weights_file,
)
from tools.release.trajectories import DataWorkers, TrajectoryStore

pytestmark = pytest.mark.usefixtures("one_thread")

NAME = "ball-tiny"
STATES = Path(curve.__file__).parent / "state"
OPTIONS = {"image_size": 32, "n_frames": 6, "objects": ("ball",), "n_trajectories": 2}
CONFIG = TrainConfig(
    phases=(PhaseConfig(steps=2, history=1, batch=2, target_views=2), PhaseConfig(steps=98, horizon=2, target_views=2)),
    data=DataConfig(history=2, context_views=2, target_only_cameras=(2, 7), background_stride=2, position_noise=0.003),
    log_every=1,
)


@pytest.fixture(scope="module")
def world():
    return build_world("elastic", "mini", OPTIONS)


@pytest.fixture(scope="module")
def trajectories(world, tmp_path_factory):
    out = tmp_path_factory.mktemp("trajectories")
    return [load_file(write_trajectory(world, scene, str(out / f"{scene[1]}.safetensors"))) for scene in world.scenes()]


@pytest.fixture
def store(world, trajectories):
    store = TrajectoryStore(world, 2, "cpu")
    for given in trajectories:
        store.put(**given)
    return store


@pytest.mark.parametrize("spread", [0.0, 0.06])
def test_store_batches_equal_those_of_scene_folders(world, spread, tmp_path):
    world, store = dataclasses.replace(world, camera_spread=spread), TrajectoryStore(world, 2, "cpu")
    for scene in world.scenes():
        store.put(**load_file(write_trajectory(world, scene, str(tmp_path / "video.safetensors"))))
    options = {**OPTIONS, "camera_spread": spread}
    folders = generate(tmp_path / "data", preset="mini", processes=1, progress=False, **options).folders
    scenes = [Scene.open(folder) for folder in folders]
    for step, phase in enumerate((CONFIG.phases[0], dataclasses.replace(CONFIG.phases[1], batch=3))):
        given = store.draw(CONFIG.data, phase, 5, step, range(3))
        wanted = draw_batch(scenes, CONFIG.data, phase, 5, step, range(3))
        assert torch.equal(given.noise, wanted.noise)
        assert (given.n_context, given.n_future) == (wanted.n_context, wanted.n_future)
        assert len(given.targets.images) == len(given.targets.cameras) == 3 * 2 * (given.n_context + given.n_future)
        for part in ("context", "targets"):
            a, b = getattr(given, part), getattr(wanted, part)
            for name in ("images", "cloud_scene", "cloud_step", "origin", "masks", "dynamic"):
                assert torch.equal(getattr(a, name), getattr(b, name)), (part, name)
            for name in ("viewmats", "Ks", "near", "far", "image_cloud"):
                assert torch.equal(getattr(a.cameras, name), getattr(b.cameras, name)), (part, name)


def test_push_recipe_trains_on_a_store_with_actions(tmp_path):
    """As tools/release/train.py does, with small images and the preset tiny; batches equal those of scene folders."""
    options = {"image_size": 32, "n_frames": 7, "n_trajectories": 2, "n_cams": 8}
    made = dataclasses.replace(recipe("push"), options=options)
    world, store = made.stream(), TrajectoryStore(made.stream(), 2, "cpu")
    for number, scene in enumerate(world.scenes()):
        store.put(**load_file(write_trajectory(world, scene, str(tmp_path / f"{number}.safetensors"))))
    options |= {"preset": made.preset, "seed": world.seed}
    folders = generate(tmp_path / "data", "push", processes=1, progress=False, **options).folders
    acting = {"model": {"dynamics": {"actions": ["pusher"]}}, "effects": made.train.effects}
    config = dataclasses.replace(CONFIG, **acting)
    given, wanted = (
        draw(config.data, config.phases[1], 5, 3, range(3))
        for draw in (store.draw, partial(draw_batch, [Scene.open(folder) for folder in folders]))
    )
    assert given.context.actions.names == wanted.context.actions.names == ("pusher",)
    for name in ("positions", "types"):
        assert torch.equal(getattr(given.context.actions, name), getattr(wanted.context.actions, name))
    assert torch.equal(given.context.images, wanted.context.images) and given.targets.actions is None
    trainer = RunTrainer(config, store, tmp_path / "run", "cpu")
    trainer.begin_run(time.monotonic() + 60)
    before = trainer.simulator.dynamics.actions.embedding.detach().clone()
    entries = [trainer.train_step() for _ in range(4)]
    assert not any("skipped" in entry for entry in entries)
    assert (trainer.simulator.dynamics.actions.embedding != before).any()
    save_state(trainer, tmp_path / "state", "push-pure", Progress())
    other = RunTrainer(config, store, tmp_path / "again", "cpu")
    load_into(other, tmp_path / "state", "push-pure")
    assert other.step == 4 and restore(weights_file(tmp_path / "state", "push-pure")).plan.spec.dynamics.actions


def test_store_replaces_oldest_trajectories(store, trajectories):
    darker = trajectories[0]["images"] // 2
    store.put(**{**trajectories[0], "images": darker})
    assert store.count == 3
    assert torch.equal(store._videos[0], darker)
    assert torch.equal(store._videos[1], trajectories[1]["images"])


def test_data_workers_make_each_trajectory_once(world, trajectories, tmp_path):
    store = TrajectoryStore(world, 4, "cpu")
    with DataWorkers(world, store, 1, 1, tmp_path) as workers:
        assert workers.wait_for(2, seconds=60)
        assert workers.wait_for(4, seconds=60) and 4 <= workers.next <= 8
    assert torch.equal(store._videos[0], trajectories[1]["images"])  # it began with number 1
    assert not torch.equal(store._videos[0], store._videos[1])
    assert not list(tmp_path.iterdir()) and threading.active_count() < 50


def test_error_of_a_data_worker_is_raised(world, tmp_path):
    store = TrajectoryStore(dataclasses.replace(world, n_frames=5), 4, "cpu")  # shorter than those that come
    with DataWorkers(world, store, 0, 1, tmp_path) as workers:
        with pytest.raises(RuntimeError, match="size"):
            workers.wait_for(1, seconds=60)


class Painted:
    """Cameras of a world whose videos are painted, not simulated."""

    n_frames, size, fps, actors = 6, 32, 24.0, ()

    def rig(self):
        return two_rings(12, self.size, 1.5, 5.0, distance=3.2, target_height=0.7, elevations=(18.0, 42.0), fov=42.0)

    def trajectory(self, seed):
        rng = np.random.default_rng(seed)
        video = rng.integers(0, 255, (self.n_frames, 12, self.size, self.size, 4), dtype=np.uint8)
        video[..., 3] = BACKGROUND
        video[..., self.size // 2 :, :, 3] = FIXED
        for step in range(self.n_frames):
            video[step, :, 4 + step : 14 + step, 10:20, 3] = MOVING
        made = {"images": video, "viewmats": self.rig().viewmats, "Ks": self.rig().Ks}  # as from a data worker
        return {name: torch.from_numpy(values) for name, values in made.items()}


def test_batches_drawn_ahead_belong_to_their_steps(tmp_path, device):
    store = TrajectoryStore(Painted(), 2, device.type)
    for seed in range(2):
        store.put(**Painted().trajectory(seed))
    ahead, plain = (RunTrainer(CONFIG, store, tmp_path / name, device.type) for name in "ab")
    ahead.captured = ahead._capture()
    ahead.begin_run(time.monotonic() + 1e4), plain.begin_run(time.monotonic() + 1e4)
    with deterministic():
        for step in range(4):
            samples = list(range(CONFIG.phase_of(step)[0].batch))
            assert torch.equal(ahead._prepared(samples).batch.targets.images, plain._batch(samples).targets.images)
            a, b = ahead.train_step(), plain.train_step()
            assert ahead._next[0] == step + 1 and a["particles"] == b["particles"]
            assert a["loss"] == pytest.approx(b["loss"], rel=1e-3)
    assert ahead.captured.captures == 2  # one for each kind of step


def test_release_run_without_launcher_saves_and_ends(store, tmp_path):
    class Lonely(Processes):
        lost = None

    processes = Lonely()
    trainer = RunTrainer(CONFIG, store, tmp_path / "run", "cpu", processes)
    step = trainer.train_step

    def last_step():
        processes.lost = "torchrun is gone"
        return step()

    trainer.train_step = last_step
    given = {"end": time.monotonic() + 1e4, "out": tmp_path / "state", "name": NAME, "say": lambda _: None}
    with pytest.raises(RunStopped, match="torchrun is gone; the state of step 1 is saved"):
        train(trainer, NoWorkers(), Progress(), {}, **given)
    assert load_progress(tmp_path / "state", NAME).step == 1


class NoWorkers:
    count, next = 2, 7

    def check(self):
        pass


@pytest.fixture
def first_run(store, tmp_path):
    """A first run of three steps."""
    trainer = RunTrainer(CONFIG, store, tmp_path / "run", "cpu")
    trainer.begin_run(time.monotonic() + 60)
    for _ in range(3):
        trainer.train_step()
    rows = [[0, 0, 0.5, 0.1, math.nan, 12.0, 1e-4]]
    progress = Progress(next_trajectory=7, windows=1, runs=[{"device": "cpu"}], curve=rows)
    return trainer, tmp_path / "state", save_state(trainer, tmp_path / "state", NAME, progress)


def test_average_follows_the_weights_of_a_short_run(store, tmp_path):
    """The next run begins at the average: of weights that change steadily for 500 steps it keeps most of the change."""
    decay = RunTrainer(CONFIG, store, tmp_path / "run", "cpu").config.optimizer.ema_decay
    average = 0.0
    for step in range(1, 501):
        average += (1 - decay) * (step - average)
    assert average > 0.75 * 500


def test_next_run_goes_on_from_state(first_run, store, tmp_path):
    trainer, state, done = first_run
    progress = load_progress(state, NAME)
    assert (progress.step, progress.next_trajectory, progress.windows) == (3, 7, 1)
    assert np.array_equal(progress.curve, done.curve, equal_nan=True)
    assert dataclasses.replace(progress, curve=[]) == dataclasses.replace(done, curve=[])
    other = RunTrainer(CONFIG, store, tmp_path / "again", "cpu")
    assert load_into(other, state, NAME).step == other.step == 3
    for name, value in trainer.average.items():
        again = other.simulator.state_dict()[name]
        assert (again - value).abs().max() <= value.abs().max() / 127, name
        assert value.ndim > 1 or torch.equal(again, value)
        assert torch.equal(other.average[name], again)
    for name, parameter in trainer.parameters.items():
        before, now = trainer.optimizer.state[parameter], other.optimizer.state[other.parameters[name]]
        assert before.keys() == now.keys()
        if before:
            assert not now["exp_avg"].any() and now["exp_avg_sq"].mean() == pytest.approx(before["exp_avg_sq"].mean())
            if parameter.ndim < 2:
                assert torch.equal(now["exp_avg_sq"], before["exp_avg_sq"])
    other.begin_run(time.monotonic() + 60)
    assert np.isfinite(other.train_step()["loss"])


def test_state_restores_rank_one_moments_in_a_byte_a_weight(store, tmp_path):
    trainer = RunTrainer(dataclasses.replace(CONFIG, preset="small"), store, tmp_path / "run", "cpu")
    name, parameter = max(trainer.parameters.items(), key=lambda item: item[1].numel())
    rows, columns = torch.rand(len(parameter)), torch.rand(parameter[0].numel())
    squares = (rows[:, None] * columns).view(parameter.shape)
    moments = {"step": torch.tensor(1.0), "exp_avg": squares, "exp_avg_sq": squares}
    trainer.optimizer.restore(parameter, moments)
    save_state(trainer, tmp_path / "state", NAME, Progress())
    other = RunTrainer(dataclasses.replace(CONFIG, preset="small"), store, tmp_path / "again", "cpu")
    load_into(other, tmp_path / "state", NAME)
    torch.testing.assert_close(other.optimizer.state[other.parameters[name]]["exp_avg_sq"], squares)
    n_weights = sum(x.numel() for x in trainer.parameters.values())
    assert state_file(tmp_path / "state", NAME).stat().st_size < 1.12 * n_weights


def test_the_weights_are_a_checkpoint(first_run):
    trainer, state, _ = first_run
    restored = restore(weights_file(state, NAME))
    assert restored.image_size == (32, 32) and restored.data == CONFIG.data
    weights = restored.simulator.state_dict()
    assert all(torch.equal(weights[k], v.bfloat16().float()) for k, v in trainer.average.items())


def test_a_shorter_history_is_validated_on_the_same_steps(first_run, tmp_path, monkeypatch):
    _, state, _ = first_run
    folders = generate(tmp_path / "data", preset="mini", processes=1, progress=False, **OPTIONS).folders
    asked, real = [], validation.score_scenes
    monkeypatch.setattr(validation, "score_scenes", lambda *args, **given: asked.append(given) or real(*args, **given))
    entry, *_ = validation.validate(weights_file(state, NAME), folders, "cpu")
    assert [(given["start"], given["n_encoded"], given["n_future"]) for given in asked] == [(2, 2, 2)]
    assert entry["step"] == 3 and all(math.isfinite(value) for value in next(iter(entry["scenes"].values())))


def test_a_state_replaces_the_one_before(first_run):
    trainer, state, done = first_run
    trainer.train_step()
    save_state(trainer, state, NAME, done)
    assert load_progress(state, NAME).step == 4 and len(list(state.iterdir())) == 2


def test_a_run_without_state_begins(store, tmp_path):
    trainer = RunTrainer(CONFIG, store, tmp_path / "run", "cpu")
    before = {name: value.clone() for name, value in trainer.simulator.state_dict().items()}
    assert load_progress(tmp_path, NAME) == load_into(trainer, tmp_path, NAME) == Progress()
    assert all(torch.equal(before[name], value) for name, value in trainer.simulator.state_dict().items())


@pytest.mark.parametrize("damage", ["cut", "other format", "no state", "not json"])
def test_a_damaged_state_is_named(first_run, damage):
    _, state, _ = first_run
    file = state_file(state, NAME)
    content = file.read_bytes()
    if damage == "cut":
        file.write_bytes(content[:-1])
    elif damage == "no state":
        file.write_bytes(weights_file(state, NAME).read_bytes())
    else:
        old, new = (b'"format":"2"', b'"format":"0"') if damage == "other format" else (b'\\"step\\"', b'\\"step\\x')
        assert old in content
        file.write_bytes(content.replace(old, new))
    with pytest.raises(InputError, match=file.name):
        load_progress(state, NAME)


def test_a_state_of_another_model_is_refused(first_run, store, tmp_path):
    _, state, _ = first_run
    config = dataclasses.replace(CONFIG, model={"dynamics": {"mlp_ratio": 4}})
    with pytest.raises(InputError, match="another model"):
        load_into(RunTrainer(config, store, tmp_path / "other", "cpu"), state, NAME)


def test_an_arm_begins_with_the_state_of_another(first_run, store, tmp_path):
    trainer, state, done = first_run
    scored = dataclasses.replace(done, scores=[{"windows": 1, "past": 20.0}])
    save_state(trainer, state, NAME, scored)
    source, progress = begun_with(state, "ball-other", NAME)
    assert (source, progress.step, progress.next_trajectory, progress.scores) == (NAME, 3, 7, [])
    assert begun_with(state, NAME, NAME)[1].scores and begun_with(state, "ball-other", "")[0] == "ball-other"
    with pytest.raises(InputError, match="--begin-with"):
        begun_with(state, "ball-other", "ball-none")
    assert begun_with(state, "cube-velocity", NAME) == (NAME, Progress())  # of another world: the weights alone
    config = dataclasses.replace(CONFIG, model={"dynamics": {"mlp_ratio": 4, "time_embedding": False}})
    other = RunTrainer(config, store, tmp_path / "other", "cpu")
    first = {name: value.clone() for name, value in other.parameters.items()}
    assert load_into(other, state, source, differs=True).step == other.step == 3
    assert other.new_parameters and all(".mlp." in name for name in other.new_parameters)
    for name, value in other.parameters.items():
        known = first[name] if name in other.new_parameters else trainer.average[name]
        assert (value - known).abs().max() <= known.abs().max() / 127, name
        assert not other.optimizer.state[value] or name not in other.new_parameters
    other.begin_run(time.monotonic() + 60)
    assert np.isfinite(other.train_step()["loss"])
    save_state(other, state, "ball-other", progress)
    assert begun_with(state, "ball-other", NAME)[1].step == 4


@pytest.mark.parametrize("is_last", [False, True])
def test_run_ends_on_time_and_last_one_decays(store, tmp_path, monkeypatch, is_last):
    monkeypatch.setattr(runs, "WARM_UP", 1)
    monkeypatch.setattr(runs, "SCORED_EVERY", 2)
    clock = itertools.count(100)  # a second for every look at it: a busy machine takes no fewer steps
    stand_in = types.SimpleNamespace(monotonic=clock.__next__, perf_counter=time.perf_counter)
    monkeypatch.setattr(runs, "time", stand_in)
    trainer, said = RunTrainer(CONFIG, store, tmp_path / "run", "cpu"), []
    given = {"end": 106, "out": tmp_path / "state", "name": NAME, "say": said.append, "is_last": is_last}
    train(trainer, NoWorkers(), Progress(windows=10, runs=[{"steps": [0, 0]}]), {"device": "cpu"}, **given)
    progress = load_progress(tmp_path / "state", NAME)
    assert progress.step == trainer.step == len(said) == 5
    assert progress.next_trajectory == 7 and progress.runs[1]["steps"] == [0, trainer.step]
    assert progress.windows == 13 and progress.runs[1]["windows"] == [10, 13]  # two steps simulate nothing
    rates = [row[-1] for row in progress.curve]
    assert len(rates) == 5 and rates[0] == pytest.approx(CONFIG.phases[0].learning_rate)
    assert (rates[-1] < 0.5 * rates[0]) == is_last
    scored = list((tmp_path / "state" / "scored").iterdir())
    assert [file.name for file in scored] == [f"{NAME}.0000012.weights.safetensors"]


def test_the_next_run_has_the_capacity_that_graphs_needed(store, tmp_path):
    first, second = (RunTrainer(CONFIG, store, tmp_path / name, "cpu") for name in ("first", "second"))
    for trainer in (first, second):
        trainer.captured = trainer._capture()
    known = {"rows": 10_000, "moving": 500, "geometry": [[[0], [0, 1], [7, 8]]], "margin": 1}
    first.captured.reserve(known)
    first.goes_on = iter([True, False]).__next__  # one step, however long it takes
    end = time.monotonic() + 60
    train(first, NoWorkers(), Progress(), {}, end=end, out=tmp_path / "state", name=NAME, say=lambda _: None)
    progress = load_progress(tmp_path / "state", NAME)
    assert progress.step == 1 and progress.needed == first.captured.needed
    assert known["geometry"][0] in progress.needed["geometry"]
    load_into(second, tmp_path / "state", NAME)
    assert second.captured.needed == progress.needed and second.captured.most_particles == 10_000
    for damaged in ({"rows": 1}, {**known, "geometry": [[[0], [0, 1], [7]]]}):
        save_state(first, tmp_path / "state", NAME, dataclasses.replace(progress, needed=damaged))
        with pytest.raises(InputError, match=NAME):
            load_into(second, tmp_path / "state", NAME)


@pytest.mark.parametrize("arm", ["velocity", "pure", "priors", "gns"])
@pytest.mark.parametrize("world", WORLDS)
def test_recipes_are_sound(world, arm):
    if (world, arm) == ("push", "priors"):
        with pytest.raises(InputError, match="the world push has no priors"):
            recipe(world, arm)
        return
    made = recipe(world, arm)
    stream, data, phases = made.stream(), made.train.data, made.train.phases
    assert made.name == f"{world}-{arm}" and stream.name == world and made.n_first <= made.capacity
    assert (data.resize, data.near_far) == ((128, 128), (stream.rig().near, stream.rig().far))
    assert stream.n_frames >= data.history + max(phase.horizon for phase in phases)
    assert made.train.n_steps >= 1_000_000
    model = build_simulator(model_config(made.train), 0).config.dynamics  # raises where switches do not agree
    kinds = [prior.type for prior in model.priors]
    hand_made = model.position_features, "inertia" in kinds, "contact" in kinds
    assert hand_made == ((1, 1, world != "cloth") if arm == "priors" else (0, 0, 0))
    assert ("velocity" in kinds) == (arm not in ("pure", "priors", "gns"))
    assert ("position_waves" in kinds) == (arm == "priors")
    assert (model.network == "graph network") == (arm == "gns")
    acting = made.train.effects.get("dynamics", {}).get("actions", [])
    assert model.actions == tuple(acting) == stream.effects().dynamics.actions


def test_rows_of_ablations_are_arms():
    made, base = recipe("elastic", "rollout-2"), recipe("elastic")
    assert made.name == "elastic-rollout-2" and made.train.phases[0] == base.train.phases[0]
    assert {phase.horizon for phase in made.train.phases} == {0, 2} and made.train.data == base.train.data
    assert made.train.data.resize == (128, 128)
    assert model_config(recipe("elastic", "latent").train) == model_config(base.train)


@pytest.mark.parametrize("world, arm", [("water", "pure"), ("elastic", "magic")])
def test_an_unknown_recipe_is_refused(world, arm):
    with pytest.raises(InputError, match="choose from"):
        recipe(world, arm)


def test_validation_is_of_the_recipes_own_world_with_another_seed():
    options = {"n_frames": 30, "camera_spread": 0.05, "drop_height": (0.4, 0.5)}
    made = dataclasses.replace(recipe("elastic"), options=options)
    given = made.validation()
    assert given["seed"] == VALIDATION_SEED != recipes.SEED and given["n_trajectories"] == made.n_validation
    world = build_world(given.pop("world"), given.pop("preset"), given)
    assert dataclasses.replace(world, seed=recipes.SEED, n_trajectories=made.stream().n_trajectories) == made.stream()


def test_line_of_a_skipped_step():
    entry = {"step": 7, "loss": math.nan, "grad_norm": math.inf, "learning_rate": 1e-3, "future_psnr": math.nan}
    why = "the gradient is not finite, first that of dynamics.priors.gravity.acceleration"
    said = runs.line(plain({**entry, "skipped": why}), {"step_seconds": 0.1, "memory_gib": 1.0})
    assert said == f"step      7  skipped: {why}"


def test_scores_against_windows_are_printed_with_paired_differences(first_run, tmp_path, capsys):
    trainer, state, done = first_run
    for name, shift in (("a", 0.0), ("b", 1.0)):
        scenes = {f"s{k}": [20.0 + k, 18 + k + shift * (k % 2), 12.0, 16.0] for k in range(4)}
        entry = {"windows": 1, "past": 21.5, "future": 19.5, "body": 12.0, "constant": 16.0, "scenes": scenes}
        save_state(trainer, state, name, dataclasses.replace(done, scores=[entry]))
    curve.main([str(state_file(state, name)) for name in ("a", "b")])
    said = capsys.readouterr().out
    assert "| 1 | 0 | 21.50 | 19.50 | 12.00 | 16.00 |" in said
    assert "b against a at 1 windows: past +0.00 ± 0.00 (within two standard errors)" in said
    assert "future +0.50 ± 0.29 (within two standard errors)" in said
    later = [{**entry, "windows": windows, "past": 0.0} for windows in (2, 3)]
    for name, scores in (("a", [entry, *later]), ("b", [entry, later[0]])):
        save_state(trainer, state, name, dataclasses.replace(done, scores=scores))
    curve.main([str(state_file(state, name)) for name in ("a", "b")])
    assert "b against a at 2 windows" in capsys.readouterr().out
    save_state(trainer, state, "b", dataclasses.replace(done, scores=[{**entry, "windows": 9}]))
    curve.main([str(state_file(state, name)) for name in ("a", "b")])
    assert "b against a at 9 and 3 windows" in capsys.readouterr().out
    (tmp_path / "b").mkdir()
    save_state(trainer, tmp_path / "b", "a", done)  # of the same name
    files = state_file(state, "a"), state_file(tmp_path / "b", "a")
    with pytest.raises(InputError, match="no state, or one without scores"):
        curve.main([str(file) for file in files])
    save_state(trainer, tmp_path / "b", "a", dataclasses.replace(done, scores=[entry]))
    curve.main([str(file) for file in files])
    assert f"{files[1]} against {files[0]} at 1 windows" in capsys.readouterr().out
    other = dataclasses.replace(done, scores=[{**entry, "scenes": {"t": [1.0] * 4}}])
    save_state(trainer, state, "b", other)
    with pytest.raises(InputError, match="different trajectories"):
        curve.main([str(state_file(state, name)) for name in ("a", "b")])
    with pytest.raises(InputError, match="no state"):
        curve.main([str(tmp_path / "c.state.safetensors")])


@pytest.mark.parametrize("file", sorted(STATES.glob("*.state.safetensors")), ids=lambda file: file.name.split(".")[0])
def test_committed_states_are_read_and_load(file, tmp_path, capsys):
    """Also where the settings and the parameters of the model had other names when they were saved."""
    name = file.name.split(".")[0]
    if load_progress(STATES, name).scores:
        curve.main([str(file)])
        assert "| windows | minutes |" in capsys.readouterr().out
    made = recipe(*name.split("-"))
    trainer = RunTrainer(made.train, TrajectoryStore(made.stream(), 1, "cpu"), tmp_path, "cpu")
    before = {key: value.clone() for key, value in trainer.parameters.items()}
    shutil.copy(file, tmp_path)
    assert curve.write_weights(tmp_path, name) == weights_file(tmp_path, name)
    assert restore(weights_file(tmp_path, name)).image_size == (128, 128)
    progress = load_into(trainer, STATES, name)
    assert trainer.step == progress.step > 0 and progress.windows > 1_000
    moments = [trainer.optimizer.state[parameter].get("exp_avg_sq") for parameter in trainer.parameters.values()]
    assert sum(value is not None and bool(value.any()) for value in moments) > 0.9 * len(moments)
    assert sum(not torch.equal(before[key], value) for key, value in trainer.parameters.items()) > 0.9 * len(before)


def test_new_priors_begin_at_their_first_values(first_run, store, tmp_path):
    trainer, state, _ = first_run
    priors = [{"type": "position_waves", "count": 2}]
    config = dataclasses.replace(CONFIG, model={"dynamics": {"priors": priors}})
    other = RunTrainer(config, store, tmp_path / "other", "cpu")
    first = {name: value.clone() for name, value in other.simulator.state_dict().items()}
    assert load_into(other, state, NAME).step == 3
    assert other.new_parameters and all(
        name.startswith("dynamics.priors.position_waves.") for name in other.new_parameters
    )
    for name, value in other.simulator.state_dict().items():
        known = first[name] if name in other.new_parameters else trainer.average[name]
        assert torch.allclose(value, known, atol=known.abs().max().item() / 100), name
