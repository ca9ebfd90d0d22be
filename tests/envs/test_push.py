"""Push environments: Gymnasium's own checks, bits by seed, exact actors, and a planner that solves the task."""

import copy
import pickle
import subprocess
import sys
import warnings

import numpy as np
import pytest
import torch

from gsim3d.errors import InputError
from gsim3d.planning import MPPI

gymnasium = pytest.importorskip("gymnasium", reason="needs gymnasium: pip install 'gsim3d[envs]'")
pytest.importorskip("mujoco", reason="needs MuJoCo: pip install 'gsim3d[envs]'")
from gymnasium.utils.env_checker import check_env, data_equivalence  # noqa: E402
from gymnasium.vector import AutoresetMode, SyncVectorEnv  # noqa: E402

from gsim3d.envs.push import FPS, MAX_SPEED, N_PARTICLES, REACHED, WORKSPACE, PushClear, PushToGoal  # noqa: E402
from gsim3d.envs.push_planning import GoalCost, TrueDynamics  # noqa: E402

TASKS = ("PushToGoal", "PushClear")


def make(task="PushToGoal", **options):
    return gymnasium.make(f"gsim3d/{task}-v0", **options)


def towards_body(env, info):
    away = info["centers"][0] - env.unwrapped.simulation.pusher[:2]
    return (MAX_SPEED * away / np.linalg.norm(away)).astype(np.float32)


@pytest.mark.parametrize("task", TASKS)
@pytest.mark.parametrize("observation", ["particles", "images", "both"])
def test_gymnasium_finds_no_fault(task, observation):
    env = make(task, observation=observation, image_size=24, render_mode="rgb_array")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(env.unwrapped)
    observed, _ = env.reset(seed=0)
    assert ("images" in observed) == (observation != "particles")
    assert ("particles" in observed) == (observation != "images")
    assert env.render().shape == (24, 24, 3)


def test_an_episode_is_a_function_of_its_seed():
    episodes = []
    for seed in (5, 5, 6):
        env = make()
        _, info = env.reset(seed=seed)
        observed = [env.step(towards_body(env, info))[0] for _ in range(6)]
        episodes.append(observed[-1])
    assert all(np.array_equal(episodes[0][name], episodes[1][name]) for name in episodes[0])
    assert not np.array_equal(episodes[0]["particles"], episodes[2]["particles"])


def test_a_copy_of_an_episode_goes_on_by_itself():
    task = PushToGoal()
    task.reset(seed=3)
    other = copy.deepcopy(task)
    ends = [env.step(np.array([0.4, speed]))[0]["pusher"] for env, speed in ((task, 0.1), (other, 0.1), (other, -0.3))]
    assert np.array_equal(ends[0], ends[1]) and not np.array_equal(ends[1], ends[2])
    assert np.array_equal(task.simulation.pusher[:2].astype(np.float32), ends[0])


@pytest.mark.parametrize("name, seed", [("PushToGoal", 0), ("PushClear", 1), ("ThrowToTarget", 0), ("ClothCover", 0)])
def test_a_pickled_episode_goes_on_by_itself(name, seed):  # PushClear's has a textured body
    task = make(name, observation="both", image_size=24).unwrapped
    task.reset(seed=seed)
    other, action = pickle.loads(pickle.dumps(task)), np.full(task.action_space.shape, 0.3, np.float32)
    ends = [env.step(action)[0] for env in (task, other)]
    assert all(np.array_equal(ends[0][part], ends[1][part]) for part in ends[0])


def test_pusher_moves_exactly_as_commanded_and_moves_the_body():
    env = make()
    _, info = env.reset(seed=3)
    simulation, before = env.unwrapped.simulation, info["centers"].copy()
    for _ in range(12):
        start, action = simulation.pusher, towards_body(env, info)
        info = env.step(action)[-1]
        assert np.abs(simulation.pusher[:2] - start[:2] - info["velocity"] / FPS).max() < 1e-15
        assert np.array_equal(info["velocity"], action.astype(np.float64))
    assert np.linalg.norm(info["centers"] - before) > 0.05


def test_bodies_rest_while_the_pusher_is_away():
    env = make("PushClear")
    _, info = env.reset(seed=0)
    before = info["centers"].copy()
    for _ in range(6):
        info = env.step(np.zeros(2, np.float32))[-1]
    exists = np.isfinite(before[:, 0])
    assert exists.sum() in (2, 3) and before.shape == (3, 2) and np.isposinf(before[~exists]).all()
    assert np.abs(info["centers"] - before)[exists].max() < 1e-3


def test_particles_keep_their_distances_as_the_body_moves():
    env = make()
    observed, info = env.reset(seed=1)
    first = observed["particles"]
    for _ in range(10):
        observed, *_, info = env.step(towards_body(env, info))
    assert first.shape == (N_PARTICLES, 3)
    distances = [np.linalg.norm(p[:, None] - p[None], axis=-1) for p in (first, observed["particles"])]
    assert np.abs(distances[0] - distances[1]).max() < 1e-5


def test_pusher_stops_at_the_edge_of_the_workspace():
    env = make()
    env.reset(seed=0)
    reach = []
    for _ in range(40):
        info = env.step(np.array([0.0, -MAX_SPEED], np.float32))[-1]
        reach.append(np.linalg.norm(env.unwrapped.simulation.pusher[:2]))
    assert reach[-1] == pytest.approx(WORKSPACE) and max(reach) < WORKSPACE + 1e-9
    assert abs(info["velocity"][1]) < 0.1 * MAX_SPEED


def test_episodes_end_when_solved_or_after_sixty_steps():
    env = make()
    env.reset(seed=0)
    task = env.unwrapped
    flags = [env.step(np.zeros(2, np.float32))[2:4] for _ in range(60)]
    assert flags[-1] == (False, True) and not any(any(flag) for flag in flags[:-1])
    env.reset(seed=0)
    task._episodes.goals[0] = torch.from_numpy(task.simulation.centers[0, :2] + 0.5 * REACHED)
    _, reward, terminated, _, info = env.step(np.zeros(2, np.float32))
    assert terminated is True and info["is_success"] is True and -REACHED < reward < 0


def test_a_cleared_region_is_solved():
    task = PushClear()
    task.reset(seed=2)
    centers, goals = task.scenes.centers(), torch.zeros(1, 2)
    assert PushClear.distances(task.scenes, goals) > 0
    task.scenes.centers = lambda: centers / centers[..., :2].norm(dim=-1, keepdim=True)
    assert PushClear.solved(PushClear.distances(task.scenes, goals))


@pytest.mark.parametrize("action", [np.zeros(3), [np.nan, 0], [2 * MAX_SPEED, 0], "left", None, [[0], 0], [1j, 0]])
def test_wrong_actions_are_refused(action):
    task = PushToGoal()
    with pytest.raises(InputError, match="step was called before reset"):
        task.step(np.zeros(2))
    with pytest.raises(InputError, match="render was called before reset"):
        PushToGoal(render_mode="rgb_array").render()
    with pytest.raises(InputError, match="simulation: there is one after reset"):
        _ = task.simulation
    task.reset(seed=0)
    with pytest.raises(InputError, match="action must be 2 numbers"):
        task.step(action)


@pytest.mark.parametrize("options", [{"observation": "sound"}, {"render_mode": "human"}, {"image_size": 2.5}])
def test_wrong_options_are_refused(options):
    with pytest.raises(InputError, match=next(iter(options))):
        PushToGoal(**options)
    with pytest.raises(InputError, match="PushToGoal has no option 'modle'; it has .*; did you mean model?"):
        gymnasium.make_vec("gsim3d/PushToGoal-v0", num_envs=2, modle="push")


def test_options_of_a_reset_are_not_ignored():
    with pytest.raises(InputError, match="reset: a single environment has no options; got {'goal'"):
        PushToGoal().reset(options={"goal": (0.0, 0.0)})
    with pytest.raises(InputError, match="reset: the options have reset_mask alone; got .'mask'"):
        gymnasium.make_vec("gsim3d/PushToGoal-v0", num_envs=2).reset(options={"mask": [True, False]})


def test_vector_environments_of_gymnasium_take_scenes_with_different_numbers_of_bodies():
    infos = []
    for mode in ("sync", "vector_entry_point"):
        envs = gymnasium.make_vec("gsim3d/PushClear-v0", num_envs=3, vectorization_mode=mode)
        infos.append(envs.reset(seed=np.array([1, 2, 3]).tolist())[1])
    assert np.array_equal(infos[0]["centers"], infos[1]["centers"])
    assert np.isfinite(infos[0]["centers"]).all((1, 2)).tolist() != [True] * 3  # not all have three


@pytest.mark.parametrize(
    "options, words",
    [
        ({"num_envs": 0}, "num_envs must be a whole number of at least 1"),
        ({"num_envs": 1.5}, "num_envs must be a whole number of at least 1"),
        ({"num_envs": True}, "num_envs must be a whole number of at least 1; got True"),
        ({"max_episode_steps": 0}, "max_episode_steps must be a whole number of at least 1"),
        ({"autoreset_mode": "Never"}, "autoreset_mode must be one of NextStep, SameStep, Disabled; got 'Never'"),
    ],
)
def test_wrong_options_of_vector_environments_are_refused(options, words):
    with pytest.raises(InputError, match=words):
        gymnasium.make_vec("gsim3d/PushToGoal-v0", **{"num_envs": 2, **options})


def test_seeds_may_be_an_array_and_actions_stay_as_they_are():
    envs = gymnasium.make_vec("gsim3d/ThrowToTarget-v0", num_envs=2)
    first = envs.reset(seed=np.array([3, 4]))[0]
    assert np.array_equal(first["particles"], envs.reset(seed=3)[0]["particles"])
    envs.reset(seed=[7, None])
    assert envs.np_random_seed == (7, 4)
    for wrong in ("a", -1, 1.5, [5, "a"]):
        with pytest.raises(InputError, match="seed of environment [01] must be a whole number of at least 0"):
            envs.reset(seed=wrong)
    assert envs.np_random_seed == (7, 4)
    given = np.full((2, 3), 0.5)
    for _ in range(3):
        envs.step(given)
    assert (given == 0.5).all()
    envs.reset(seed=3)
    with pytest.raises(InputError, match="action must be 3 numbers"):
        envs.step(given[:1])
    with pytest.raises(InputError, match="action must be 3 numbers; got 'up'"):
        envs.step("up")


@pytest.mark.parametrize("mode", AutoresetMode)
def test_vector_environments_equal_those_of_gymnasium(mode):
    """Over three ends of episodes: observations, rewards, flags and infos, in all bits."""
    options = {"num_envs": 2, "max_episode_steps": 2}
    wanted = SyncVectorEnv([lambda: make("PushClear", max_episode_steps=2)] * 2, autoreset_mode=mode)
    envs = gymnasium.make_vec("gsim3d/PushClear-v0", autoreset_mode=mode, **options)
    assert data_equivalence(envs.reset(seed=4), wanted.reset(seed=4), exact=True)
    for step in range(8):
        actions = np.random.default_rng(step).uniform(-MAX_SPEED, MAX_SPEED, (2, 2)).astype(np.float32)
        expected = wanted.step(actions)
        assert data_equivalence(envs.step(actions), expected, exact=True)
        over = {"reset_mask": expected[2] | expected[3]}
        if mode is AutoresetMode.DISABLED and over["reset_mask"].any():
            assert data_equivalence(envs.reset(options=over), wanted.reset(options=dict(over)), exact=True)


def test_the_step_after_an_end_ignores_the_action():
    envs = gymnasium.make_vec("gsim3d/PushToGoal-v0", num_envs=2, max_episode_steps=3)
    envs.reset(seed=1)
    envs.step(np.zeros((2, 2)))
    envs.reset(seed=2, options={"reset_mask": np.array([False, True])})
    for _ in range(2):
        truncated = envs.step(np.zeros((2, 2)))[3]
    assert truncated.tolist() == [True, False]
    observed, rewards, *_ = envs.step(np.array([[np.nan, 9.0], [0.1, 0.1]]))
    assert rewards[0] == 0 > rewards[1] and np.isfinite(observed["particles"]).all()
    with pytest.raises(InputError, match="action must be 2 numbers of at most"):
        envs.step(np.array([[np.nan, 0.1], [0.1, 0.1]]))


@pytest.mark.parametrize("package", ["gymnasium", "mujoco"])
def test_missing_packages_are_one_clear_error(package):
    code = f"import sys; sys.modules['{package}'] = None\nimport gsim3d.envs"
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert "pip install 'gsim3d[envs]'" in ended.stderr


def test_later_actions_change_no_earlier_state():
    env = make()
    env.reset(seed=4)
    simulation = env.unwrapped.simulation
    state, dynamics = simulation.state(), TrueDynamics(env)
    actions = torch.rand(2, 6, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(0)) - 0.5
    actions[1, :3] = actions[0, :3]
    states = dynamics(state, actions)
    assert torch.equal(states.centers[0, :3], states.centers[1, :3])
    assert torch.equal(states.pusher[0, :3], states.pusher[1, :3])
    assert not torch.equal(states.pusher[0, 3:], states.pusher[1, 3:])
    assert np.array_equal(simulation.state(), state)
    for step, action in enumerate(actions[0].numpy()):
        simulation.step(action)
        assert np.array_equal(simulation.centers[0, :2], states.centers[0, step].numpy())


def test_dynamics_simulate_the_current_episode_and_leave_it_as_it_was():
    env = make()
    env.reset(seed=1)
    dynamics, actions = TrueDynamics(env), torch.full((1, 3, 2), 0.3)
    env.reset(seed=2)
    simulation = env.unwrapped.simulation
    state = simulation.state()
    assert torch.equal(dynamics(state, actions).centers, TrueDynamics(env)(state, actions).centers)
    actions[0, 1] = torch.nan
    for wrong, words in ((actions, "velocity must be"), (torch.zeros(1, 2, 3), r"actions must be \[K, H, 2\]; got")):
        with pytest.raises(InputError, match=words):
            dynamics(state, wrong)
        assert np.array_equal(simulation.state(), state)


def test_cost_prefers_bodies_at_the_goal_and_pushers_behind_the_body():
    from gsim3d.envs.push_planning import PushStates

    cost = GoalCost(torch.tensor([1.0, 0.0]))
    centers = torch.tensor([[[0.9, 0.0]], [[0.5, 0.0]], [[0.5, 0.0]]])
    pusher = torch.tensor([[[0.6, 0.0]], [[0.2, 0.0]], [[0.8, 0.0]]])
    values = cost(PushStates(centers, pusher), torch.zeros(3, 1, 2))
    assert values[0] < values[1] < values[2]


def test_a_planner_in_the_truth_solves_an_episode():
    env = make()
    _, info = env.reset(seed=1)
    task = env.unwrapped
    planner = MPPI(
        TrueDynamics(task), GoalCost(torch.from_numpy(task.goal)),
        env.action_space.low, env.action_space.high, horizon=8, samples=32, iterations=2, noise=0.3,
    )  # fmt: skip
    executed, terminated = 0, False
    while not terminated:
        plan = planner.plan(task.simulation.state(), executed)
        executed = 4
        for action in plan.actions[:executed].numpy().astype(np.float32):
            _, _, terminated, truncated, info = env.step(action)
            if terminated:
                break
            assert not truncated
    assert info["is_success"]
