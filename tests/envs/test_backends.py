"""Environments in a learned simulator, single and side by side, of random weights."""

import dataclasses
import warnings

import numpy as np
import pytest
import torch

from gsim3d.cameras import InputSpec
from gsim3d.errors import InputError
from gsim3d.priors import InertiaConfig, SegmentationConfig
from tests.test_simulator import CONFIG, awake, make_simulator

gymnasium = pytest.importorskip("gymnasium", reason="needs gymnasium: pip install 'gsim3d[envs]'")
pytest.importorskip("mujoco", reason="needs MuJoCo: pip install 'gsim3d[envs]'")
from gymnasium.utils.env_checker import check_env  # noqa: E402
from gymnasium.vector import AutoresetMode  # noqa: E402

from gsim3d.envs.push import FPS, MAX_SPEED, PushClear, PushToGoal  # noqa: E402

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
        PushToGoal(backend="model")
    with pytest.raises(InputError, match='are of backend="model"'):
        PushToGoal(model=model)
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
    moved = scenes.centers_of(scenes.points().double() @ turn.T + shift)
    expected = scenes.centers() @ turn.T + shift
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
    assert isinstance(observed["images"], torch.Tensor)
    expected = [env.reset(seed=5 + i) for i, env in enumerate(singles)]
    for step in range(3):
        for i, (of_single, info, *_) in enumerate(expected):
            for name, value in of_single.items():
                close = np.abs(observed[name][i].numpy().astype(float) - value.astype(float)).max()
                assert close <= (1 if name == "images" else 1e-5), (name, step)
            centers = infos["centers"][i]
            assert np.allclose(centers[: len(info["centers"])], info["centers"], atol=1e-5)
            assert centers[len(info["centers"]) :].isnan().all()
        if step and task == "ThrowToTarget":
            break  # one step is an episode
        given = actions(3, step, envs.single_action_space.shape[0])
        observed, rewards, terminated, truncated, infos = envs.step(given)
        results = [env.step(action.numpy()) for env, action in zip(singles, given, strict=True)]
        expected = [(result[0], result[-1]) for result in results]
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
