"""Sittings: films arrive while a run goes on, its state travels, and a second sitting goes on with it."""

import dataclasses
import itertools
import json
import math
import threading
import time
import types

import numpy as np
import pytest
import torch

from gsim3d.data import Scene, find_scenes
from gsim3d.dynamics import last_steps
from gsim3d.dynamics.flight import Flight
from gsim3d.dynamics.momentum import momentum
from gsim3d.dynamics.motion import motion
from gsim3d.errors import InputError
from gsim3d.data.recording import BACKGROUND, FIXED, MOVING
from gsim3d.generate import generate
from gsim3d.generate.cameras import two_rings
from gsim3d.generate.film import film
from gsim3d.generate.worlds import build_world
from gsim3d.train import shipped
from gsim3d.train.config import DataConfig, StageConfig, TrainConfig
from gsim3d.train.films import Filming, FilmStore
from gsim3d.train.loop import deterministic
from gsim3d.train.restore import restore
from gsim3d.train.samples import draw_batch
from gsim3d.train.log import plain
from gsim3d.train.shipped import RECIPES, SittingTrainer, train
from gsim3d.train.samples import longest_gap
from gsim3d.train.sittings import (
    DIMMING,
    LIGHTS,
    Progress,
    begin_with,
    load_into,
    load_progress,
    save_state,
    weights_file,
)

pytestmark = pytest.mark.usefixtures("one_thread")

NAME = "ball-tiny"
OPTIONS = {"image_size": 32, "n_frames": 6, "objects": ("ball",), "n_trajectories": 2}
CONFIG = TrainConfig(
    stages=(StageConfig(steps=2, history=1, batch=2, target_views=2), StageConfig(steps=98, horizon=2, target_views=2)),
    data=DataConfig(history=2, context_views=2, target_only_cameras=(2, 7), background_stride=2),
    log_every=1,
)


@pytest.fixture(scope="module")
def world():
    return build_world("elastic", "mini", OPTIONS)


@pytest.fixture(scope="module")
def films(world, tmp_path_factory):
    out = tmp_path_factory.mktemp("films")
    return [dict(np.load(film(world, scene, str(out / f"{scene[1]}.npz")))) for scene in world.scenes()]


@pytest.fixture
def store(world, films):
    store = FilmStore(world, 2, "cpu")
    for given in films:
        store.put(**given)
    return store


@pytest.mark.parametrize("spread", [0.0, 0.06])
def test_a_store_gives_what_scene_folders_give(world, spread, tmp_path):
    world, store = dataclasses.replace(world, camera_spread=spread), FilmStore(world, 2, "cpu")
    for scene in world.scenes():
        store.put(**np.load(film(world, scene, str(tmp_path / "film.npz"))))
    options = {**OPTIONS, "camera_spread": spread}
    folders = generate(tmp_path / "data", preset="mini", processes=1, progress=False, **options).folders
    scenes = [Scene.open(folder) for folder in folders]
    led = dataclasses.replace(CONFIG.stages[1], batch=3, lead=2)
    for step, stage in enumerate((CONFIG.stages[0], led, dataclasses.replace(led, dynamics_alone=True))):
        given = store.draw(CONFIG.data, stage, 5, step, range(3))
        wanted = draw_batch(scenes, CONFIG.data, stage, 5, step, range(3))
        assert (given.n_context, given.n_past, given.n_future) == (wanted.n_context, wanted.n_past, wanted.n_future)
        assert len(given.targets.images) == len(given.target_step()) == 3 * 2 * (given.n_past + given.n_future)
        for part in ("context", "targets"):
            a, b = getattr(given, part), getattr(wanted, part)
            for name in ("images", "cloud_scene", "cloud_step", "origin", "masks", "dynamic"):
                assert torch.equal(getattr(a, name), getattr(b, name)), (part, name)
            for name in ("viewmats", "Ks", "near", "far", "image_cloud"):
                assert torch.equal(getattr(a.cameras, name), getattr(b.cameras, name)), (part, name)


def test_the_newest_replace_the_oldest(store, films):
    darker = films[0]["images"] // 2
    store.put(**{**films[0], "images": darker})
    assert store.count == 3
    assert torch.equal(store._films[0], torch.from_numpy(darker))
    assert torch.equal(store._films[1], torch.from_numpy(films[1]["images"]))


def test_trajectories_are_filmed_once_each_while_others_work(world, films, tmp_path):
    store = FilmStore(world, 4, "cpu")
    with Filming([world], store, 1, 1, tmp_path) as filming:
        assert filming.wait_for(2, seconds=60)
        filming.slow_down(1)
        assert filming.wait_for(4, seconds=60) and 4 <= filming.next <= 8
    assert torch.equal(store._films[0], torch.from_numpy(films[1]["images"]))  # it began with number 1
    assert not torch.equal(store._films[0], store._films[1])
    assert not list(tmp_path.iterdir()) and threading.active_count() < 50


def test_worlds_take_turns(world, films, tmp_path):
    store = FilmStore(world, 2, "cpu")
    raised = dataclasses.replace(world, ground_height=(0.2, 0.2))
    with Filming([world, raised], store, 0, 1, tmp_path) as filming:
        assert filming.wait_for(2, seconds=60)
    assert torch.equal(store._films[0], torch.from_numpy(films[0]["images"]))
    lower, higher = ((film[0, 0, ..., 3] == FIXED).nonzero()[:, 0].float().mean() for film in store._films)
    assert higher < lower - 1  # rows are counted from the top of an image


def test_what_a_process_raises_is_told(world, tmp_path):
    store = FilmStore(dataclasses.replace(world, n_frames=5), 4, "cpu")  # its films are shorter than those that come
    with Filming([world], store, 0, 1, tmp_path) as filming:
        with pytest.raises(RuntimeError, match="size"):
            filming.wait_for(1, seconds=60)


class Painted:
    """Cameras of a world whose films are painted, not simulated."""

    n_frames, size = 6, 32

    def rig(self):
        return two_rings(12, self.size, 1.5, 5.0, distance=3.2, target_height=0.7, elevations=(18.0, 42.0), fov=42.0)

    def film(self, seed):
        rng = np.random.default_rng(seed)
        film = rng.integers(0, 255, (self.n_frames, 12, self.size, self.size, 4), dtype=np.uint8)
        film[..., 3] = BACKGROUND
        film[..., self.size // 2 :, :, 3] = FIXED
        for step in range(self.n_frames):
            film[step, :, 4 + step : 14 + step, 10:20, 3] = MOVING
        return {"images": film, "viewmats": self.rig().viewmats, "Ks": self.rig().Ks}


def test_batches_drawn_ahead_are_those_of_their_steps(tmp_path, device):
    store = FilmStore(Painted(), 2, device.type)
    for seed in range(2):
        store.put(**Painted().film(seed))
    ahead, plain = (SittingTrainer(CONFIG, store, tmp_path / name, device.type) for name in "ab")
    ahead.captured = ahead._capture()
    ahead.begin_sitting(time.monotonic() + 1e4), plain.begin_sitting(time.monotonic() + 1e4)
    with deterministic():
        for step in range(4):
            samples = list(range(CONFIG.stage_of(step)[0].batch))
            assert torch.equal(ahead._prepared(samples).batch.targets.images, plain._batch(samples).targets.images)
            a, b = ahead.train_step(), plain.train_step()
            assert ahead._next[0] == step + 1 and a["particles"] == b["particles"]
            assert a["loss"] == pytest.approx(b["loss"], rel=1e-3)
    assert ahead.captured.captures == 2  # one for each kind of step


class NoFilming:
    count, next = 2, 7

    def check(self):
        pass


@pytest.fixture
def sat(store, tmp_path):
    """A first sitting of three steps."""
    trainer = SittingTrainer(CONFIG, store, tmp_path / "run", "cpu")
    trainer.begin_sitting(time.monotonic() + 60)
    with trainer.log.opened(tensorboard=False):
        for _ in range(3):
            trainer.log.write(trainer.train_step(), {})
    done = save_state(trainer, tmp_path / "state", NAME, Progress(next_trajectory=7, sittings=[{"device": "cpu"}]))
    return trainer, tmp_path / "state", done


def test_the_next_sitting_goes_on(sat, store, tmp_path):
    trainer, state, done = sat
    progress = load_progress(state, NAME)
    assert progress == done and (progress.step, progress.next_trajectory) == (3, 7)
    other = SittingTrainer(CONFIG, store, tmp_path / "again", "cpu")
    load_into(other, state, NAME, progress)
    assert other.step == 3 and (tmp_path / "again" / "metrics.jsonl").read_text().count("\n") == 3
    for name, value in trainer.simulator.state_dict().items():
        scale = value.abs().max().clamp(min=1e-6)
        assert (other.simulator.state_dict()[name] - value).abs().max() <= 2**-7 * scale, name
        assert (other.average[name] - trainer.average[name]).abs().max() <= 2**-8 * scale, name
    for name, parameter in trainer.parameters.items():
        before, now = trainer.optimizer.state[parameter], other.optimizer.state[other.parameters[name]]
        assert before.keys() == now.keys()
        if before:
            torch.testing.assert_close(now["exp_avg_sq"], before["exp_avg_sq"], rtol=2**-8, atol=1e-37)
            assert not now["exp_avg"].any()
    other.begin_sitting(time.monotonic() + 60)
    assert np.isfinite(other.train_step()["loss"])


def test_the_weights_are_a_checkpoint(sat, store):
    trainer, state, done = sat
    restored = restore(weights_file(state, done))
    assert restored.image_size == (32, 32) and restored.data == CONFIG.data
    weights = restored.simulator.state_dict()
    assert all(torch.equal(weights[k], v.bfloat16().float()) for k, v in trainer.average.items())


def test_a_state_replaces_the_one_before(sat):
    trainer, state, done = sat
    trainer.train_step()
    save_state(trainer, state, NAME, done)
    assert load_progress(state, NAME).step == 4 and len(list(state.glob("*.safetensors"))) == 3


def test_a_run_without_state_begins(tmp_path):
    assert load_progress(tmp_path, NAME) == Progress()


@pytest.mark.parametrize("damage", ["cut", "missing", "other format", "no json"])
def test_a_damaged_state_is_named(sat, damage):
    _, state, done = sat
    file = weights_file(state, done)
    if damage == "cut":
        file.write_bytes(file.read_bytes()[:-1])
    elif damage == "missing":
        file.unlink()
    else:
        file = state / f"{NAME}.json"
        text = file.read_text()
        file.write_text("{" if damage == "no json" else text.replace('"format": 1', '"format": 0'))
    with pytest.raises(InputError, match=file.name):
        load_progress(state, NAME)


def test_a_state_of_another_model_is_refused(sat, store, tmp_path):
    _, state, done = sat
    config = dataclasses.replace(CONFIG, model={"dynamics": {"mlp_ratio": 4}})
    with pytest.raises(InputError, match="another model"):
        load_into(SittingTrainer(config, store, tmp_path / "other", "cpu"), state, NAME, done)


def test_a_sitting_ends_on_time_with_a_falling_rate_and_a_saved_state(store, tmp_path, monkeypatch):
    monkeypatch.setattr(shipped, "WARM_UP", 1)
    clock = itertools.count(100)  # a second for every look at it: a busy machine takes no fewer steps
    stand_in = types.SimpleNamespace(monotonic=clock.__next__, perf_counter=time.perf_counter)
    monkeypatch.setattr(shipped, "time", stand_in)
    trainer, said = SittingTrainer(CONFIG, store, tmp_path / "run", "cpu"), []
    given = {"end": 106, "out": tmp_path / "state", "name": NAME, "say": said.append}
    train(trainer, NoFilming(), Progress(sittings=[{"steps": [0, 0]}]), {"device": "cpu"}, **given)
    progress = load_progress(tmp_path / "state", NAME)
    assert progress.step == trainer.step == len(said) == 5
    assert progress.next_trajectory == 7 and progress.sittings[1]["steps"] == [0, trainer.step]
    log = (tmp_path / "state" / f"{NAME}.metrics.jsonl").read_text().splitlines()
    rates = [json.loads(entry)["learning_rate"] for entry in log]
    assert rates[0] == pytest.approx(CONFIG.stages[0].learning_rate) and rates[-1] < rates[0]


def test_the_next_sitting_knows_what_graphs_needed(store, tmp_path):
    first, second = (SittingTrainer(CONFIG, store, tmp_path / name, "cpu") for name in ("first", "second"))
    for trainer in (first, second):
        trainer.captured = trainer._capture()
    known = {"rows": 10_000, "moving": 500, "geometry": [[[0], [0, 1], [7, 8]]]}
    first.captured.make_room(known)
    end = time.monotonic() + 2
    train(first, NoFilming(), Progress(), {}, end=end, out=tmp_path / "state", name=NAME, say=lambda _: None)
    progress = load_progress(tmp_path / "state", NAME)
    assert progress.step and progress.needed == first.captured.needed
    assert known["geometry"][0] in progress.needed["geometry"]
    load_into(second, tmp_path / "state", NAME, progress)
    assert second.captured.needed == progress.needed and second.captured.most_rows == 10_000
    new = SittingTrainer(CONFIG, store, tmp_path / "new", "cpu")
    new.captured = new._capture()
    load_into(new, tmp_path / "nothing", NAME, Progress(needed=known))  # a run that begins with what another one knew
    assert new.captured.needed == known and new.step == 0
    for damaged in ({"rows": 1}, {**known, "geometry": [[[0], [0, 1], [7]]]}):
        with pytest.raises(InputError, match="needed"):
            load_into(second, tmp_path / "state", NAME, dataclasses.replace(progress, needed=damaged))


def saved_with_a_head(config, store, folder):
    """The checkpoint of a simulator whose dynamics predicts something."""
    trainer = SittingTrainer(config, store, folder / "other", "cpu")
    with torch.no_grad():
        for parameter in trainer.simulator.dynamics.net.head.parameters():
            parameter.normal_(0, 0.1)
    trainer.average = {key: value.clone() for key, value in trainer.simulator.state_dict().items()}
    save_state(trainer, folder / "state", NAME, Progress())
    return weights_file(folder / "state", load_progress(folder / "state", NAME))


ALL_BUT_LIGHTS = {"position_waves": 2, "contact_length": 0.15, "velocity": True, "deformation": True}


@pytest.mark.parametrize("more", [{}, ALL_BUT_LIGHTS])
def test_a_run_begins_with_a_simulator_that_saw_no_motion(store, tmp_path, more):
    """What it predicts is the same, but that bodies fly on instead of what it said of positions."""
    known = saved_with_a_head(CONFIG, store, tmp_path)
    moving = dataclasses.replace(CONFIG, model={"dynamics": {"motion_length": 0.3, **more}})
    trainer = SittingTrainer(moving, store, tmp_path / "run", "cpu")
    begun = begin_with(trainer, known)
    assert begun["digest"] == restore(known).checkpoint.digest and begun["step"] == 0
    given, own = restore(known).simulator, trainer.simulator.eval()
    batch = store.draw(CONFIG.data, CONFIG.stages[1], 0, 2, range(1))
    with torch.no_grad():
        state = given.encode(batch.context)
        seen = own.encode(batch.context)
        expected, step = given.dynamics(state), own.dynamics(seen)
        goes_on = momentum if seen.velocity is not None else motion
        drift = goes_on(seen, 0.3, own.config.dynamics.grid_size)[:, 1]
    torch.testing.assert_close(step.dynamic_latents, expected.dynamic_latents)
    newest = last_steps(state, 1)
    torch.testing.assert_close(step.means, newest.means + drift)
    assert not torch.allclose(expected.means, newest.means + drift, atol=1e-3)
    assert all(torch.equal(value, trainer.average[key]) for key, value in own.state_dict().items())
    larger = SittingTrainer(dataclasses.replace(CONFIG, preset="small"), store, tmp_path / "larger", "cpu")
    with pytest.raises(InputError, match="other sizes"):
        begin_with(larger, known)


def test_a_run_that_sees_more_begins_as_one_that_saw_motion_went_on(store, tmp_path, monkeypatch):
    """Given the same motions, which one reads off clouds and the other off velocities."""
    motion_only = dataclasses.replace(CONFIG, model={"dynamics": {"motion_length": 0.3}})
    told = {"motion_length": 0.3, **ALL_BUT_LIGHTS, "lights": ((0.0, 0.3, 1.0),)}
    more = dataclasses.replace(CONFIG, model={"dynamics": told})
    known = saved_with_a_head(motion_only, store, tmp_path)
    trainer = SittingTrainer(more, store, tmp_path / "run", "cpu")
    begin_with(trainer, known)
    given, own = restore(known).simulator, trainer.simulator.eval()
    batch = store.draw(CONFIG.data, CONFIG.stages[1], 0, 2, range(1))
    monkeypatch.setattr("gsim3d.dynamics.dynamics.motion", lambda *history: momentum(*history)[:, :2])
    with torch.no_grad():
        state = own.encode(batch.context)
        expected, step = given.dynamics(state), own.dynamics(state)
    moved = (expected.means - last_steps(state, 1).means).abs().max()
    assert moved > 0.01 and (step.means - expected.means).abs().max() < 1e-4 * moved
    torch.testing.assert_close(step.dynamic_latents, expected.dynamic_latents)
    before, now = step.shaded.split(1, 1)  # nothing more is predicted than what has moved
    torch.testing.assert_close(step.light, (2 * ((before - now) * own.dynamics.dimming / 2).tanh()).exp())
    assert now.max() > 0


def test_a_run_that_is_told_more_goes_on_with_what_it_was_told_before(store, tmp_path):
    """Whatever stands between."""
    lights = {"lights": ((0.0, 0.3, 1.0),)}
    before = {"motion_length": 0.3, "velocity": True, **lights}
    known = saved_with_a_head(dataclasses.replace(CONFIG, model={"dynamics": before}), store, tmp_path)
    after = {"motion_length": 0.3, **ALL_BUT_LIGHTS, **lights}
    trainer = SittingTrainer(dataclasses.replace(CONFIG, model={"dynamics": after}), store, tmp_path / "run", "cpu")
    begin_with(trainer, known)
    given, own = restore(known).simulator, trainer.simulator.eval()
    batch = store.draw(CONFIG.data, CONFIG.stages[1], 0, 2, range(1))
    with torch.no_grad():
        state = own.encode(batch.context)
        expected, step = given.dynamics(state), own.dynamics(state)
    for name in ("means", "dynamic_latents", "light"):
        torch.testing.assert_close(getattr(step, name), getattr(expected, name))
    less = SittingTrainer(dataclasses.replace(CONFIG, model={"dynamics": lights}), store, tmp_path / "less", "cpu")
    with pytest.raises(InputError, match="other sizes"):
        begin_with(less, known)


@pytest.mark.parametrize("other", [{"steps_per_call": 2}, {"motion_length": 0.3}, {"contact_length": 0.2}])
def test_a_run_does_not_begin_with_what_predicts_more(store, tmp_path, other):
    config = dataclasses.replace(CONFIG, model={"dynamics": other})
    trainer = SittingTrainer(CONFIG, store, tmp_path / "run", "cpu")
    with pytest.raises(InputError, match="other sizes"):
        begin_with(trainer, saved_with_a_head(config, store, tmp_path))


@pytest.mark.parametrize("key", [LIGHTS, DIMMING])
def test_lights_of_a_run_begin_as_they_are_made_or_go_on(store, tmp_path, key):
    config = dataclasses.replace(CONFIG, model={"dynamics": {"lights": ((0.0, 0.3, 1.0),)}})
    for known in (saved_with_a_head(CONFIG, store, tmp_path / "a"), saved_with_a_head(config, store, tmp_path / "b")):
        trainer = SittingTrainer(config, store, tmp_path / "run", "cpu")
        made = trainer.simulator.state_dict()[key].clone()
        begin_with(trainer, known)
        expected = restore(known).simulator.state_dict().get(key, made)
        assert made.any() and torch.equal(trainer.simulator.state_dict()[key], expected)


def test_a_run_whose_bodies_fly_and_are_lit_begins_with_what_neither_knew(store, tmp_path, monkeypatch):
    """Nothing is predicted of light at first; latents, and what is predicted of places, are what they were."""
    told = {"motion_length": 0.3, **ALL_BUT_LIGHTS, "lights": ((0.0, 0.3, 1.0),)}
    known = saved_with_a_head(dataclasses.replace(CONFIG, model={"dynamics": told}), store, tmp_path)
    new = {**told, "surfaces": True, "gravity": (0.0, 0.0, -0.01)}
    trainer = SittingTrainer(dataclasses.replace(CONFIG, model={"dynamics": new}), store, tmp_path / "run", "cpu")
    begin_with(trainer, known)
    given, own = restore(known).simulator, trainer.simulator.eval()
    with torch.no_grad():
        state = own.encode(store.draw(CONFIG.data, CONFIG.stages[1], 0, 2, range(1)).context)
        n_told = sum(n for _, n in given.dynamics.layout.told)
        given.dynamics.net.stem.told.weight[:, n_told - 2 : n_told] = 0  # what it was told of its lights
        expected, flight = given.dynamics(dataclasses.replace(state, shaded=None)), own.dynamics.flight(state)
        ones = torch.ones_like(flight.near)
        monkeypatch.setattr(own.dynamics, "flight", lambda *_: Flight(ones, ones, flight.gravity))
        step = own.dynamics(state)
    torch.testing.assert_close(step.dynamic_latents, expected.dynamic_latents)
    torch.testing.assert_close(step.means, expected.means)
    assert (step.means - last_steps(state, 1).means).abs().max() > 1e-3
    assert flight.gravity.tolist() == pytest.approx(new["gravity"])
    before, _, now = (1 + lit * own.dynamics.strength for lit in step.shaded.split(1, 1))
    torch.testing.assert_close(step.light, now / before)
    again = saved_with_a_head(dataclasses.replace(CONFIG, model={"dynamics": new}), store, tmp_path / "again")
    begin_with(trainer, again)
    for key, value in restore(again).simulator.state_dict().items():
        assert torch.equal(trainer.simulator.state_dict()[key], value), key


def test_a_run_whose_bodies_are_pushed_begins_with_nothing_predicted_of_places(store, tmp_path):
    told = {"motion_length": 0.3, **ALL_BUT_LIGHTS, "gravity": (0.0, 0.0, -0.01)}
    known = saved_with_a_head(dataclasses.replace(CONFIG, model={"dynamics": told}), store, tmp_path)
    config = dataclasses.replace(CONFIG, model={"dynamics": {**told, "pushes": True}})
    trainer = SittingTrainer(config, store, tmp_path / "run", "cpu")
    begin_with(trainer, known)
    own, given = (simulator.state_dict() for simulator in (trainer.simulator, restore(known).simulator))
    (_, n_looks), (name, n_places) = trainer.simulator.dynamics.layout.outputs
    assert name == "means"
    for key in ("dynamics.net.head.fc2.weight", "dynamics.net.head.fc2.bias"):
        looks, places = own.pop(key).split([n_looks, n_places])
        assert not places.any() and given[key][n_looks:].any()
        assert torch.equal(looks, given.pop(key)[:n_looks])
    assert own.pop("dynamics.friction") == 1 and own.pop("dynamics.skin") > 0
    assert own.keys() == given.keys() and all(torch.equal(own[key], given[key]) for key in own)


def test_recipes_are_sound():
    for world, recipe in RECIPES.items():
        data, stages, first, *others = recipe.train.data, recipe.train.all_stages, *recipe.worlds()
        assert recipe.world == world == first.name and recipe.first_films <= recipe.capacity
        assert first == build_world(world, "diverse", {"seed": shipped.SEED, **recipe.options})
        assert all(begun_alike(other, first) == first for other in others)
        assert first.n_frames >= data.history + max(stage.lead + stage.horizon + longest_gap(stage) for stage in stages)
        assert recipe.train.n_steps >= 1_000_000 and shipped.SEED != shipped.HELD_OUT_SEED


def begun_alike(world, other):
    """What is filmed in turn differs in how it begins, not in how it is filmed."""
    same = {name: getattr(other, name) for name in ("ground_height", "drop_height", "lift")}
    return dataclasses.replace(world, **same)


def test_a_step_that_was_skipped_is_said_to_be_whatever_its_numbers():
    entry = {"step": 7, "loss": math.nan, "grad_norm": math.inf, "learning_rate": 1e-3, "future_psnr": math.nan}
    why = "the gradient is not finite, first that of dynamics.gravity"
    said = shipped.line(plain({**entry, "skipped": why}), {"step_seconds": 0.1, "memory_gib": 1.0})
    assert said == f"step      7  skipped: {why}"
