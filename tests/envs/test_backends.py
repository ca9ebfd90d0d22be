"""Environments in a learned simulator, single and side by side, of random weights."""

import dataclasses
import importlib
import warnings
from pathlib import Path

import numpy as np
import pytest
import torch

from gsim3d.cameras import InputSpec
from gsim3d.effects.spec import DynamicsEffects, EffectsSpec
from gsim3d.errors import InputError
from gsim3d.priors import InertiaConfig, SegmentationConfig
from gsim3d.state import DYNAMIC, FROZEN, last_steps
from tests.test_simulator import CONFIG, awake, make_simulator

gymnasium = pytest.importorskip("gymnasium", reason="needs gymnasium: pip install 'gsim3d[envs]'")
pytest.importorskip("mujoco", reason="needs MuJoCo: pip install 'gsim3d[envs]'")
from gymnasium.utils.env_checker import check_env  # noqa: E402
from gymnasium.vector import AutoresetMode  # noqa: E402
from gymnasium.wrappers.vector import RecordEpisodeStatistics  # noqa: E402

from gsim3d.envs import ThrowToTarget  # noqa: E402
from gsim3d.envs.model import ModelScenes, Start  # noqa: E402
from gsim3d.envs.push import FPS, MAX_SPEED, PushClear, PushToGoal  # noqa: E402
from gsim3d.envs.push_planning import GoalCost, ModelDynamics  # noqa: E402
from gsim3d.envs.scenes import task_rig  # noqa: E402
from gsim3d.planning import GradientDescent  # noqa: E402
from gsim3d.planning.costs import image_distance  # noqa: E402
from gsim3d.synth.worlds import build_world  # noqa: E402

pytestmark = pytest.mark.usefixtures("one_thread")
TASKS = ("PushToGoal", "PushClear", "ThrowToTarget", "ClothCover")
PRIORS = SegmentationConfig(), InertiaConfig()


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    """Checkpoint of a tiny simulator."""
    config = dataclasses.replace(CONFIG, dynamics=dataclasses.replace(CONFIG.dynamics, priors=PRIORS, max_step=0.02))
    simulator = awake(make_simulator(config))
    simulator.inputs = InputSpec(image_size=(16, 16), fps=12.0)
    return str(simulator.save_pretrained(tmp_path_factory.mktemp("model") / "tiny"))


def make(task, model, **options):
    return gymnasium.make(f"gsim3d/{task}-v0", backend="model", model=model, **options)


def make_vec(task, n, **options):
    return gymnasium.make_vec(f"gsim3d/{task}-v0", num_envs=n, vectorization_mode="vector_entry_point", **options)


def actions(n, seed=0, size=2):
    return torch.from_numpy(np.random.default_rng(seed).uniform(-MAX_SPEED, MAX_SPEED, (n, size)))


@pytest.mark.parametrize("task", TASKS)
def test_gymnasium_finds_no_fault_and_spaces_are_those_of_the_truth(task, model):
    options = {"observation": "both", "image_size": 24, "render_mode": "rgb_array"}
    env = make(task, model, **options)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(env.unwrapped)
    truth = gymnasium.make(f"gsim3d/{task}-v0", **options)
    assert env.observation_space == truth.observation_space and env.action_space == truth.action_space
    (observed, info), (expected, of_truth) = env.reset(seed=3), truth.reset(seed=3)
    for name in set(observed) - {"images", "particles"}:
        assert np.array_equal(observed[name], expected[name])
    assert np.abs(info["centers"] - of_truth["centers"]).max() < 1e-6


def test_model_needs_weights_of_its_frame_rate(model, tmp_path):
    with pytest.raises(InputError, match="needs model=PATH"):
        ThrowToTarget(backend="model")
    with pytest.raises(InputError, match='are of backend="model"'):
        PushToGoal(model=model)
    scenes = PushToGoal(backend="model", model=model).scenes
    with pytest.raises(InputError, match="one scene can be repeated, after its reset"):
        ModelDynamics(scenes)(scenes.state, torch.zeros(2, 3, 2))
    with pytest.raises(InputError, match="backend must be one of"):
        PushToGoal(backend="dream")
    with pytest.raises(InputError, match="trained at 42 frames a second"):
        PushToGoal(backend="model", model="elastic-small")


def test_pusher_is_kinematic_and_others_are_predicted(model):
    task = PushToGoal(backend="model", model=model)
    observed, _ = task.reset(seed=1)
    before = task.scenes.state
    first, start = observed["particles"], before.actors.clone()
    observed, *_, info = task.step(np.array([0.3, -0.2]))
    particles = task.scenes.state.particles
    moved = particles.means[particles.cu_rows[-2] :] - before.particles.means[before.particles.cu_rows[-2] :]
    pusher = particles.actor[particles.cu_rows[-2] :] == 0
    assert pusher.any() and not pusher.all()
    assert (moved[pusher] - torch.tensor([0.3, -0.2, 0.0]) / FPS).abs().max() < 1e-6
    expected = start + torch.tensor([0.3, -0.2, 0.0], dtype=torch.float64) / FPS
    assert (task.scenes.actors() - expected).abs().max() < 1e-15
    assert np.abs(observed["particles"] - first).max() > 0 and info["velocity"].tolist() == [0.3, -0.2]


def test_centers_follow_the_rigid_motion_of_the_points(model):
    task = PushClear(backend="model", model=model)
    task.reset(seed=0)
    scenes = task.scenes
    turn = torch.tensor([[0.8, -0.6, 0.0], [0.6, 0.8, 0.0], [0.0, 0.0, 1.0]]).double()
    shift = torch.tensor([0.1, -0.2, 0.3])
    points, expected = scenes.points().double(), scenes.centers() @ turn.T + shift
    scenes.points = lambda: points @ turn.T + shift
    moved = scenes.centers()
    exists = expected.isfinite()
    assert exists.any() and (moved - expected)[exists].abs().max() < 1e-5 and torch.equal(moved.isnan(), ~exists)


@pytest.mark.parametrize("backend", ["truth", "model"])
@pytest.mark.parametrize("task", TASKS)
def test_side_by_side_equals_single(task, backend, model):
    options = {"observation": "both", "image_size": 16, "backend": backend}
    if backend == "model":
        options["model"] = model
    envs = make_vec(task, 3, **options)
    singles = [gymnasium.make(f"gsim3d/{task}-v0", **options) for _ in range(3)]
    observed, infos = envs.reset(seed=5)
    kind = torch.Tensor if backend == "model" else np.ndarray
    assert isinstance(observed["images"], kind) and envs.metadata["torch"] == (backend == "model")
    expected = [env.reset(seed=5 + i) for i, env in enumerate(singles)]
    for step in range(3):
        for i, (of_single, info, *_) in enumerate(expected):
            for name, value in of_single.items():
                close = np.abs(np.asarray(observed[name][i]).astype(float) - value.astype(float)).max()
                assert close <= (1 if name == "images" else 1e-5), (name, step)
            assert np.allclose(infos["centers"][i], info["centers"], atol=1e-5)
        if step and task == "ThrowToTarget":
            break  # one step is an episode
        given = actions(3, step, envs.single_action_space.shape[0])
        observed, rewards, terminated, truncated, infos = envs.step(given)
        results = [env.step(action.numpy()) for env, action in zip(singles, given, strict=True)]
        expected = [(result[0], result[-1]) for result in results]
        assert isinstance(rewards, kind) and isinstance(infos["velocity"], kind)
        assert rewards.tolist() == pytest.approx([result[1] for result in results], abs=1e-5)
        assert terminated.tolist() == [result[2] for result in results] and not truncated.any()


def episode_starts(envs, seed, n_steps):
    """Observed particles of every step."""
    observed, _ = envs.reset(seed=seed)
    seen = [observed["particles"]]
    for step in range(n_steps):
        observed, rewards, terminated, truncated, infos = envs.step(actions(2, step))
        seen.append((observed["particles"], rewards, terminated, truncated, infos))
    return seen


def test_next_step_resets_in_the_step_after_the_end(model):
    envs = make_vec("PushToGoal", 2, backend="model", model=model, max_episode_steps=2)
    _, first, end, begun, _, later = episode_starts(envs, [1, 2], 5)[:6]
    assert not first[3].any() and end[3].all()
    assert not begun[3].any() and begun[1].tolist() == [0.0, 0.0] and not begun[2].any()
    single = make("PushToGoal", model)
    single.reset(seed=2)
    assert np.abs(single.reset()[0]["particles"] - begun[0][1].numpy()).max() < 1e-5
    assert later[3].all()


def test_same_step_resets_and_keeps_the_last_observation(model):
    options = {"backend": "model", "model": model, "max_episode_steps": 2}
    _, _, end, after = episode_starts(make_vec("PushToGoal", 2, autoreset_mode="SameStep", **options), 1, 3)[:4]
    _, _, last, begun = episode_starts(make_vec("PushToGoal", 2, **options), 1, 3)[:4]
    assert end[3].all() and end[4]["_final_obs"].all()
    assert torch.equal(end[4]["final_obs"][1]["particles"], last[0][1])
    assert torch.equal(end[4]["final_info"]["centers"], last[4]["centers"])
    assert torch.equal(end[0], begun[0]) and not after[3].any()


def test_wrappers_of_arrays_work_on_the_truth():
    envs = RecordEpisodeStatistics(make_vec("PushClear", 2, max_episode_steps=2, autoreset_mode="SameStep"))
    envs.reset(seed=np.int64(3))
    envs.step(actions(2).numpy())
    observed, rewards, terminated, truncated, infos = envs.step(actions(2).numpy())
    assert truncated.all() and infos["episode"]["l"].tolist() == [2, 2] and infos["episode"]["r"].max() < 0
    assert isinstance(infos["final_obs"][0]["particles"], np.ndarray)
    assert infos["final_info"]["_velocity"].all()


def test_disabled_waits_for_a_mask(model):
    envs = make_vec("PushToGoal", 2, backend="model", model=model, max_episode_steps=1, autoreset_mode="Disabled")
    assert envs.metadata["autoreset_mode"] is AutoresetMode.DISABLED and envs.metadata["torch"]
    with pytest.raises(InputError, match="before reset"):
        envs.step(actions(2))
    envs.reset(seed=1)
    kept = envs.step(actions(2))[0]["particles"]
    with pytest.raises(InputError, match=r"\[0, 1\] have ended"):
        envs.step(actions(2))
    observed, infos = envs.reset(seed=[7, 8], options={"reset_mask": np.array([False, True])})
    assert torch.equal(observed["particles"][0], kept[0]) and not torch.equal(observed["particles"][1], kept[1])
    assert infos["_centers"].tolist() == [False, True]
    alone = make_vec("PushToGoal", 1, backend="model", model=model).reset(seed=8)[0]
    assert torch.equal(observed["particles"][1], alone["particles"][0])
    with pytest.raises(InputError, match=r"\[0\] have ended"):
        envs.step(actions(2))
    with pytest.raises(InputError, match="of 2 environments"):
        envs.reset(seed=[1])


def test_seeds_decide_all_bits(model):
    runs = [episode_starts(make_vec("PushClear", 2, backend="model", model=model), seed, 3) for seed in (4, 4, 5)]
    assert torch.equal(runs[0][-1][0], runs[1][-1][0]) and not torch.equal(runs[0][-1][0], runs[2][-1][0])


def scenes_of(count=1, effects=None, **dynamics):
    """A tiny simulator's scenes of PushToGoal."""
    config = dataclasses.replace(CONFIG, dynamics=dataclasses.replace(CONFIG.dynamics, max_step=0.02, **dynamics))
    simulator = awake(make_simulator(config))
    simulator.effects = effects or EffectsSpec()
    scenes, rngs = ModelScenes(simulator, count, 1, 16), {n: np.random.default_rng(n) for n in range(count)}
    scenes.reset({n: PushToGoal.draw(rngs[n]) for n in range(count)}, rngs)
    return scenes


@pytest.mark.parametrize("background", ["symmetric", "relightable", "asymmetric"])
def test_copies_of_a_scene_predict_what_it_does(background):
    scenes = scenes_of(background=background, norm="layer")
    given = actions(6, 1).unflatten(0, (3, 2))
    states = ModelDynamics(scenes)(scenes.state, given)
    start = scenes.state
    apart = [ModelDynamics(scenes)(start, chunk) for chunk in (given[:1], given[1:])]
    assert torch.equal(torch.cat([one.centers for one in apart]), states.centers)
    assert torch.equal(torch.cat([one.points for one in apart]), states.points)
    copies = scenes.repeated(start, 3).state.particles
    n_frozen = (copies.activity == FROZEN).sum()
    newest = last_steps(start.particles, 1).activity == FROZEN
    all_frozen = (start.particles.activity == FROZEN).sum()
    assert n_frozen == {"symmetric": 3 * all_frozen, "relightable": 3 * newest.sum(), "asymmetric": 0}[background]
    assert newest.any() and (all_frozen == newest.sum()) == (background == "relightable")
    for k in range(3):
        scenes.state = start
        for step in range(2):
            PushToGoal.act(scenes, given[k : k + 1, step])
            assert (scenes.centers()[0, 0, :2] - states.centers[k, step]).abs().max() < 1e-5
            assert (scenes.actors()[0, 0, :2] - states.pusher[k, step]).abs().max() < 1e-12
    assert (states.centers[0, 1] - states.centers[1, 1]).abs().max() > 1e-7


@pytest.mark.parametrize("types", [(), ("pusher",)])
def test_gradients_of_costs_of_particles_and_images_reach_actions(types):
    """Against differences of the cost; the planner that descends them finds a lower one than where it begins."""
    scenes = scenes_of(1, EffectsSpec(DynamicsEffects(actions=types)), actions=types)
    scenes.simulator.requires_grad_(False)
    start, goal = scenes.state, scenes.centers()[0, 0, :2] + 0.2
    dynamics = ModelDynamics(scenes, rig=task_rig(12, 2))
    target = torch.rand(2, 12, 12, 3, generator=torch.Generator().manual_seed(0))
    given = actions(2, 3)[None].requires_grad_()
    costs = {
        "center": lambda states, _: GoalCost(goal)(states, _),
        "image": lambda states, _: 100 * image_distance(states.images.double(), target.double()),
    }
    assert dynamics(start, given).points.shape == (1, 2, 256, 3)
    for name, cost in costs.items():
        (found,) = torch.autograd.grad(cost(dynamics(start, given), given).sum(), given)
        along = found / found.norm()
        ends = [cost(dynamics(start, (given + sign * 1e-3 * along).detach()), given) for sign in (1, -1)]
        slope = float(ends[0] - ends[1]) / 2e-3  # orders of particles jump beyond
        assert found.abs().min() > 0 and float(found.norm()) == pytest.approx(slope, rel=0.2), name
    planner = GradientDescent(
        dynamics, costs["image"], np.full(2, -0.5), np.full(2, 0.5), horizon=2, samples=1, iterations=4
    )
    history = planner.plan(start).history
    assert len(history) == 4 and history[-1] < float(costs["image"](dynamics(start, torch.zeros(1, 2, 2)), None))


@pytest.mark.parametrize("background", ["symmetric", "relightable"])
def test_copies_lack_the_background_out_of_reach(background):
    scenes = scenes_of(background=background, norm="layer")
    frozen = scenes.state.particles.activity == FROZEN
    given = actions(2).unflatten(0, (2, 1))
    counts, centers = [], []
    for reach in (None, 100.0, 0.05):
        copies = scenes.repeated(scenes.state, 2, reach)
        counts.append(copies.state.particles.n_rows)
        assert torch.equal(copies.points()[1], scenes.points()[0])
        centers.append(ModelDynamics(scenes, reach)(scenes.state, given).centers)
    assert counts[0] == counts[1] > counts[2] > 2 * (~frozen).sum()
    assert torch.equal(centers[0], centers[1]) and not torch.equal(centers[0], centers[2])


def test_relightable_scenes_drop_only_what_the_network_does_not_see():
    scenes, moved = scenes_of(background="relightable", norm="layer"), []
    for reduced in (ModelScenes._reduced.__get__(scenes), lambda particles: particles):
        scenes._reduced = reduced
        scenes.reset({0: PushToGoal.draw(np.random.default_rng(0))}, {0: np.random.default_rng(1)})
        PushToGoal.act(scenes, actions(1))
        PushToGoal.act(scenes, actions(1, 1))
        moved.append((scenes.state.particles.n_rows, scenes.centers()))
    assert moved[0][0] < moved[1][0] and (moved[0][1] - moved[1][1]).abs().max() < 1e-6


def test_models_with_action_particles_read_the_actors_path():
    effects = EffectsSpec(DynamicsEffects(actions=("pusher",)))
    scenes = scenes_of(2, effects, actions=("pusher",))
    before, start = scenes.state, last_steps(scenes.state.particles, 1)
    ends = []
    for seed in (0, 1):
        scenes.state = before
        given = actions(2, seed)
        given[0] = 0.25
        PushToGoal.act(scenes, given)
        PushToGoal.act(scenes, given)
        ends.append(newest := last_steps(scenes.state.particles, 1))
        pusher = newest.actor == 0
        path = (2 * given / FPS)[newest.row_scene()].float()
        assert pusher.any() and (newest.means - start.means)[pusher][:, :2].sub(path[pusher]).abs().max() < 1e-6
        assert newest.actions is None
    first, bodies = ends[0].row_scene() == 0, ends[0].actor < 0
    assert torch.allclose(ends[0].means[first], ends[1].means[first], atol=1e-6)
    assert (ends[0].means - ends[1].means)[~first & bodies].abs().max() > 1e-6
    known = scenes.state.actors[1, -3:, 0]
    assert torch.allclose(known.diff(dim=0)[:, :2], given[1] / FPS)


def test_models_read_the_points_that_the_world_records():
    """Of a pusher with the same centers; gradients of the coming ones reach its velocity."""
    scenes, read = scenes_of(1, EffectsSpec(DynamicsEffects(actions=("pusher",))), actions=("pusher",)), []
    length, rollout = scenes.state.actors.shape[1], scenes.simulator.rollout
    world = build_world("push", "mini", {"n_cams": 2, "n_frames": length + 1})
    points = torch.from_numpy(world.simulate(world.draw("box", 0, 0))[0][-1].nodes)
    assert points.shape == (length + 1, 27, 3)
    path = points[:, :1]
    scenes.state = dataclasses.replace(scenes.state, actors=path[None, :-1])
    scenes.simulator.rollout = lambda state, *given, **options: (
        read.append(state.actions) or rollout(state, *given, **options)
    )
    velocities = ((path[-1] - path[-2]) * FPS)[None].requires_grad_()
    scenes.move(velocities)
    (actions,) = read
    assert actions.names == ("pusher",) and not actions.types.any()
    assert (actions.positions - points).abs().max() < 1e-6
    assert torch.allclose(scenes.actors(), path[None, -1]) and scenes.state.actors.shape == (1, length, 1, 3)
    (slope,) = torch.autograd.grad(actions.positions.sum(), velocities, retain_graph=True)
    assert torch.allclose(slope, torch.full_like(slope, 27 / FPS))
    newest = last_steps(scenes.state.particles, 1)
    bodies = newest.means[(newest.activity == DYNAMIC) & (newest.actor < 0)]
    (slope,) = torch.autograd.grad(bodies.sum(), velocities)
    assert slope.isfinite().all() and slope.abs().min() > 0


def test_points_of_several_actors_stay_together():
    scenes = scenes_of(1)
    scenes._offsets = torch.tensor([[0.0, 0.0, 0.0], [0.0, 0.0, 0.5]]).double()
    read, centers = [], torch.tensor([[[1.0, 0.0, 0.0], [2.0, 0.0, 0.0]]]).double()[None].expand(1, 3, -1, -1)
    scenes.simulator.rollout = lambda state, *_, **__: read.append(state.actions) or [state]
    scenes._acted(scenes.state.particles, centers)
    wanted = [[1.0, 0.0, 0.0], [1.0, 0.0, 0.5], [2.0, 0.0, 0.0], [2.0, 0.0, 0.5]]
    assert read[0].positions.shape == (1, 3, 4, 3) and read[0].positions[0, 0].tolist() == wanted


def test_without_known_centers_they_are_the_middles_of_the_particles():
    scenes = scenes_of()
    truth = PushToGoal.draw(np.random.default_rng(0))
    views, path = [truth.view(scenes.rig)] * 4, np.stack([truth.actors] * 4)
    scenes.encode({0: Start(views, path, truth)}, {0: np.random.default_rng(0)})
    particles = last_steps(scenes.state.particles, 1)
    body = particles.means[(particles.activity == DYNAMIC) & (particles.actor < 0)]
    assert torch.allclose(scenes.centers()[0, 0].float(), (body.amin(0) + body.amax(0)) / 2, atol=1e-5)


def test_benchmark_plans_in_a_model_from_images_of_the_truth(monkeypatch, capsys):
    monkeypatch.syspath_prepend(str(Path(__file__).parents[2] / "tools" / "bench"))
    bench = importlib.import_module("push_planning")
    monkeypatch.setitem(bench.SETTINGS, "samples", 3)
    monkeypatch.setitem(bench.SETTINGS, "iterations", 1)
    scenes, env = scenes_of(), gymnasium.make("gsim3d/PushToGoal-v0", max_episode_steps=6)
    episode = bench.run("model", env, 1000, scenes=scenes, reach=0.5, chunk=2)
    assert episode["steps"] == 6 and len(episode["plan_seconds"]) == len(episode["errors"]) == 2
    assert np.array(episode["errors"]).shape == (2, 2, 8) and np.isfinite(episode["errors"]).all()
    assert len(episode["encode_seconds"]) == 2 and episode["predicted_steps"] == 2 * 8 * (3 + 1)  # and the mean's
    found = bench.summary([episode, bench.run("zero", env, 1000)])
    bench.show("model", found)
    assert found["solved"] == 0 and len(found["median_errors"]["model"]) == 8
    shown = capsys.readouterr().out
    assert "solved 0 of 2 (95 %: 0% to 66%)" in shown and "s to encode" in shown


def test_random_actions_of_the_benchmark_are_held_and_independent_of_the_scene(monkeypatch):
    monkeypatch.syspath_prepend(str(Path(__file__).parents[2] / "tools" / "bench"))
    env, given = gymnasium.make("gsim3d/PushToGoal-v0", max_episode_steps=8), []
    step = env.step
    monkeypatch.setattr(env, "step", lambda action: (given.append(action), step(action))[1])
    importlib.import_module("push_planning").run("random", env, 1000)
    given = np.stack(given).reshape(2, 4, 2)
    assert (given == given[:, :1]).all() and (given[0, 0] != given[1, 0]).all()
    scene = np.random.default_rng(1000).uniform(-0.5, 0.5, 2)
    assert np.abs(given[0, 0] - scene).min() > 1e-3


def test_benchmark_goes_on_from_its_file(monkeypatch, capsys, tmp_path, model):
    monkeypatch.syspath_prepend(str(Path(__file__).parents[2] / "tools" / "bench"))
    bench = importlib.import_module("push_planning")
    called, wanted = [], bench.run
    episode = {"solved": True, "distance": 0.1, "steps": 3, "plan_seconds": [1.0]}
    episode |= {"encode_seconds": [0.5], "predicted_steps": 100, "errors": [[[0.01] * 8] * 2]}

    def run(agent, env, seed, **options):
        called.append((agent, seed))
        if seed == 1002:
            raise InputError("it broke")
        return {"seed": seed, **episode}

    monkeypatch.setattr(bench, "run", run)
    given = ["--agents", "zero", "model", "--model", model, "--out", str(tmp_path / "out.json")]
    with pytest.raises(InputError, match="it broke"):
        bench.main([*given, "--seeds", "3"])
    bench.main([*given, "--seeds", "2"])
    assert called == [("zero", 1000), ("zero", 1001), ("zero", 1002), ("model", 1000), ("model", 1001)]
    shown = capsys.readouterr().out
    ended = "solved 2 of 2 (95 %: 34% to 100%), last distance 0.100 m, 3 steps"
    assert shown.count(f"{ended}, 0.50 s to encode, 1.00 s a plan, 100 steps") == 2
    monkeypatch.setattr(bench, "run", wanted)
    for wrong, words in ((["--reach", "1"], "is of other settings"), (["--seeds", "0"], "--seeds must be at least 1")):
        with pytest.raises(SystemExit):
            bench.main([*given, *wrong])
        assert words in capsys.readouterr().err
