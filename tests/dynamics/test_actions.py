"""Action particles: where they are in the input, what they change, and what they leave as it is."""

import dataclasses

import pytest
import torch

from gsim3d import Actions
from gsim3d.cuda_graphs import CapturedRollout
from gsim3d.effects.spec import AppearanceEffects, DynamicsEffects, EffectsSpec, Sleep, UnsupportedEffect
from gsim3d.errors import InputError
from gsim3d.evaluate.plan_costs import Workload, predicted_cost
from gsim3d.io import read_particles, write_particles
from gsim3d.presets import ModelConfig
from gsim3d.pretrained.loading import with_weights
from gsim3d.priors import InertiaConfig, ProximityConfig, VelocityConfig
from gsim3d.simulator import Simulator
from gsim3d.state import ASLEEP, DYNAMIC
from tests.asserts import assert_same_bits
from tests.effects.models import MODELS
from tests.test_simulator import CONFIG, awake, make_frames, make_simulator

pytestmark = pytest.mark.usefixtures("one_thread")

TYPES, STEPS = ("hand", "pusher"), 3
SPEC = EffectsSpec(DynamicsEffects(actions=TYPES))


def acting(config: ModelConfig) -> ModelConfig:
    return dataclasses.replace(config, dynamics=dataclasses.replace(config.dynamics, actions=TYPES))


def without_actions(name: str) -> ModelConfig:
    """A model with that background, or with the prior velocity."""
    changes = {"priors": (VelocityConfig(),)} if name == "velocity" else {"background": name}
    return dataclasses.replace(CONFIG, dynamics=dataclasses.replace(CONFIG.dynamics, **changes))


CONFIGS = {name: acting(without_actions(name)) for name in ("symmetric", "relightable", "asymmetric", "velocity")}


def setting(config=CONFIGS["symmetric"], steps=(2,)):
    """A simulator, an encoded state, and random walks of two points among its particles."""
    simulator, frames = awake(make_simulator(config)), make_frames(steps)
    simulator.effects = SPEC
    with torch.no_grad():
        state = simulator.encode(frames)
    return simulator, state, walks(state)


def walks(state, types=("pusher", "hand"), n_steps=8, seed=0):
    generator = torch.Generator().manual_seed(seed)
    shape = len(state.origin), n_steps, len(types), 3
    first = state.means[state.activity == DYNAMIC].mean(0) + 0.1 * torch.randn(
        shape[0], 1, *shape[2:], generator=generator
    )
    return Actions.of(first + 0.05 * torch.randn(shape, generator=generator).cumsum(1), types)


def given(state, actions):
    return dataclasses.replace(state, actions=actions)


@torch.no_grad()
def rollout(simulator, state, n_steps=STEPS, **options):
    return simulator.rollout(state, n_steps, **options)


def assert_same_steps(first, second):
    for a, b in zip(first, second, strict=True):
        for name, value in a.row_fields().items():
            assert_same_bits(value, getattr(b, name))


@pytest.mark.parametrize("name", CONFIGS)
def test_input_holds_positions_now_and_displacements_to_the_next_step(name, monkeypatch):
    simulator, state, actions = setting(CONFIGS[name], (2, 1))
    seen, module = [], simulator.dynamics.actions
    forward = simulator.dynamics.forward

    def recorded(history, **options):
        seen.append(history)
        return forward(history, **options)

    monkeypatch.setattr(simulator.dynamics, "forward", recorded)
    steps = rollout(simulator, given(state, actions))
    assert [step.n_rows for step in steps] == [steps[0].n_rows] * STEPS
    assert steps[0].clouds.counts == [state.clouds.count(1), state.clouds.count(2)]
    histories = [history for history in seen if history.n_rows > 0][-STEPS:]
    for history in histories:
        table = history.clouds
        for q, (scene, step) in enumerate(zip(table.scenes, table.steps)):
            rows = slice(table.starts[q + 1] - 2, table.starts[q + 1])
            now, later = actions.positions[scene, step], actions.positions[scene, step + 1]
            assert_same_bits(history.means[rows], now)
            assert (history.activity[rows] == DYNAMIC).all()
            moved = (later - now) / simulator.config.dynamics.grid_size
            latents = module.embedding[[1, 0]] + moved @ module.displacement
            torch.testing.assert_close(history.latents[rows], latents)
            for velocity in (history.velocity, history.mean_velocity) if name == "velocity" else ():
                assert_same_bits(velocity[rows], later - now)
    free = rollout(simulator, state)
    changed = free[0].activity == DYNAMIC
    assert not torch.equal(free[0].means[changed], steps[0].means[changed])


@pytest.mark.parametrize("name", CONFIGS)
def test_without_actors_bits_are_those_of_a_model_without_embeddings(name):
    simulator, state, actions = setting(CONFIGS[name])
    weights = {k: v for k, v in simulator.state_dict().items() if not k.startswith("dynamics.actions.")}
    assert len(simulator.state_dict()) == len(weights) + 2
    plain = Simulator(without_actions(name)).eval()
    plain.load_state_dict(weights)
    wanted = rollout(plain, state)
    assert_same_steps(rollout(simulator, state), wanted)
    off = simulator.plan(EffectsSpec())
    assert_same_steps(rollout(simulator, given(state, actions), plan=off), wanted)
    assert set(off.unused) == {"dynamics.actions.embedding", "dynamics.actions.displacement"}
    absent = dataclasses.replace(actions, types=torch.full_like(actions.types, -1))
    for a, b in zip(rollout(simulator, given(state, absent)), wanted):  # a scene of a batch without actors
        torch.testing.assert_close(a.means, b.means)


def test_later_positions_change_no_earlier_step():
    simulator, state, actions = setting()
    changed = actions.positions.clone()
    changed[:, 4:] += 0.1
    first = rollout(simulator, given(state, actions))
    second = rollout(simulator, given(state, dataclasses.replace(actions, positions=changed)))
    assert_same_steps(first[:2], second[:2])  # steps 2 and 3, from positions up to step 3
    assert not torch.equal(first[2].means, second[2].means)


def test_absent_points_have_no_influence():
    """A point that vanishes rests before; while it is away its positions count for nothing."""
    simulator, state, actions = setting()
    types = actions.types.clone()
    types[:, 3:5, 1] = -1
    steps = [rollout(simulator, given(state, dataclasses.replace(actions, types=types)))]
    moved = actions.positions.clone()
    moved[:, 3:5, 1] += 5.0
    steps.append(rollout(simulator, given(state, dataclasses.replace(actions, types=types, positions=moved))))
    assert_same_steps(*steps)
    there = rollout(simulator, given(state, actions))
    assert_same_steps(steps[0][:1], there[:1])  # step 2, from positions up to step 2
    assert not torch.equal(steps[0][1].means, there[1].means)


def test_order_of_points_does_not_count():
    simulator, state, actions = setting()
    swapped = dataclasses.replace(actions, positions=actions.positions.flip(2), types=actions.types.flip(2))
    assert_same_steps(rollout(simulator, given(state, actions)), rollout(simulator, given(state, swapped)))
    types = dataclasses.replace(actions, types=actions.types.flip(2))
    assert not torch.equal(
        rollout(simulator, given(state, actions))[0].means, rollout(simulator, given(state, types))[0].means
    )


@pytest.mark.parametrize("name", CONFIGS)
def test_scenes_of_a_batch_equal_those_alone(name):
    """The second scene has one point, the first has two."""
    simulator, state, actions = setting(CONFIGS[name], (2, 2))
    actions = dataclasses.replace(actions, types=torch.tensor([[1, 0], [0, -1]])[:, None].expand(2, 8, 2), names=TYPES)
    together = rollout(simulator, given(state, actions))
    frames = make_frames((2, 2))
    for scene in range(2):
        alone = state.select_clouds([2 * scene, 2 * scene + 1])
        steps = rollout(simulator, given(alone, actions))
        for a, b in zip(together, steps):
            torch.testing.assert_close(a.select_clouds([scene]).means, b.means)
    assert frames.actions is None


def test_copies_of_a_scene_predict_different_actions():
    pytest.importorskip("gymnasium", reason="needs gymnasium: pip install 'gsim3d[envs]'")
    from gsim3d.envs.model import tiled

    simulator, state, first = setting()
    state = dataclasses.replace(given(state, first), world_offset=torch.ones(1, 3, dtype=torch.float64))
    others = [walks(state, seed=seed) for seed in (1, 2)]
    copies = tiled(state, 3)
    assert torch.equal(copies.actions.positions, first.positions.expand(3, -1, -1, -1))
    assert copies.world_offset.shape == copies.origin.shape == (3, 3)
    positions = torch.cat([one.positions for one in (first, *others)])
    steps = rollout(simulator, given(copies, dataclasses.replace(copies.actions, positions=positions)))
    for scene, actions in enumerate((first, *others)):
        for a, b in zip(steps, rollout(simulator, given(state, actions)), strict=True):
            torch.testing.assert_close(a.select_clouds([scene]).means, b.means)
    with pytest.raises(InputError, match="particles must have one scene; got 3"):
        tiled(copies, 2)


@pytest.mark.parametrize("name", CONFIGS)
def test_gradients_flow_to_positions_and_embeddings(name):
    simulator, state, actions = setting(CONFIGS[name])
    positions = actions.positions.clone().requires_grad_()
    steps = simulator.rollout(given(state, dataclasses.replace(actions, positions=positions)), STEPS)
    module = simulator.dynamics.actions
    sought = positions, module.embedding, module.displacement
    gradients = torch.autograd.grad(steps[-1].means.square().sum(), sought)
    assert all(gradient.isfinite().all() for gradient in gradients)
    used = gradients[0].abs().sum((0, 2, 3)) > 0
    assert used.tolist() == [True] * 5 + [False] * 3
    assert (gradients[1].abs().sum(1) > 0).all() and (gradients[2].abs().sum(1) > 0).all()


@pytest.mark.parametrize("name", CONFIGS)
def test_captured_rollouts_read_the_actions_of_each_call(name):
    simulator, state, actions = setting(CONFIGS[name])
    captured = CapturedRollout(simulator, given(state, actions), STEPS, simulator.plan())
    other = given(state, walks(state, seed=1))
    later = state.with_clouds(state.clouds.ahead(2))
    for one in (given(state, actions), other, given(later, actions)):
        found, wanted = captured(one).steps, rollout(simulator, one)
        for a, b in zip(found, wanted, strict=True):
            assert a.clouds.steps == b.clouds.steps
            torch.testing.assert_close(a.means, b.means)
        assert found[-1].actions is one.actions
    with pytest.raises(InputError, match=r"state.actions must have as many points"):
        captured(given(state, walks(state, ("hand",))))


def test_captured_rollouts_have_room_for_many_points_in_priors():
    """A prior's padding counts action particles beside the movable particles of a scene."""
    dynamics = dataclasses.replace(CONFIG.dynamics, priors=(ProximityConfig(),))
    simulator, state, _ = setting(acting(dataclasses.replace(CONFIG, dynamics=dynamics)))
    one = given(state, walks(state, 14 * TYPES))
    captured = CapturedRollout(simulator, one, STEPS, simulator.plan(), factor=1.0)
    for a, b in zip(captured(one).steps, rollout(simulator, one), strict=True):
        torch.testing.assert_close(a.means, b.means)
        torch.testing.assert_close(a.dynamic_latents, b.dynamic_latents)


def test_points_rest_outside_of_their_steps():
    _, state, actions = setting()
    table = state.clouds.ahead(20)
    assert_same_bits(actions.at(table)[0], actions.positions[:, -1].expand(2, -1, -1))
    assert_same_bits(actions.between([3], 2).at(state.clouds.ahead(3))[0], actions.positions[0, 3:5])
    assert_same_bits(actions.between([3], 2).at(state.clouds)[0], actions.positions[0, [3, 3]])


def test_plan_shows_actions_with_their_cost_and_refuses_unknown_types():
    simulator, _, _ = setting()
    on, off = simulator.plan(), simulator.plan(EffectsSpec())
    assert ("actions", "types: 2") in on.switches and "actions" not in off.on
    one, more = Workload(1000, 500), Workload(1000, 500, actions=42)
    costs = [predicted_cost(plan, simulator.config, work)["dynamics"] for plan in (on, off) for work in (one, more)]
    assert costs[0] < costs[1] and costs[0] == costs[2] == costs[3]
    for spec, words in (
        (DynamicsEffects(actions=("foot",)), "does not know the type .*foot.*; it has hand, pusher"),
        (DynamicsEffects(actions=TYPES, sleep=Sleep()), "dynamics.actions and dynamics.sleep"),
    ):
        with pytest.raises(UnsupportedEffect, match=words):
            simulator.plan(EffectsSpec(spec))
    with pytest.raises(UnsupportedEffect, match="dynamics.actions: .* it has none"):
        make_simulator().plan(SPEC)
    assert EffectsSpec.from_dict(SPEC.to_dict()) == SPEC


def test_wrong_actions_are_refused():
    simulator, state, actions = setting()
    positions = torch.zeros(2, 4, 2, 3)
    with pytest.raises(InputError, match=r"positions must be float .B, T, 1, 3.; got torch.float32 .2, 4, 2, 3."):
        Actions.of(positions, ("hand",))
    with pytest.raises(InputError, match="types must be a list, one name for each point; got 'ab'"):
        Actions.of(positions, "ab")
    positions[1, 2, 0, 1] = torch.nan
    with pytest.raises(InputError, match="positions of scene 1, step 2 must be finite"):
        Actions.of(positions, TYPES)
    with pytest.raises(InputError, match=r"rollout: particles.actions must .* .1, T, A, 3.*got .2, 4, 1, 3."):
        rollout(simulator, given(state, Actions.of(torch.zeros(2, 4, 1, 3), ("hand",))))
    with pytest.raises(InputError, match=r"positions must be float .B, T, A > 0, 3.; got torch.float32 .1, 4, 0, 3."):
        Actions.of(torch.zeros(1, 4, 0, 3), ())
    late, types = actions.positions.clone(), actions.types.clone()
    late[0, 3, 1, 0], types[0, 2, 1] = torch.nan, 2
    for change, words in (
        ({"positions": late, "first": (5,)}, "rollout: particles.actions: positions must be finite; scene 0, step 8"),
        ({"types": types}, "types must be indices of names, or -1; scene 0, step 2"),
        ({"types": types - 4}, "types must be indices of names, or -1; scene 0, step 0"),
        (
            {"types": types.float()},
            r"int64 types .* on cpu.*got .1, 8, 2, 3. torch.float32 and .1, 8, 2. torch.float32",
        ),
        ({"positions": late[:, :, :0], "types": types[:, :, :0]}, "T and A > 0; got .1, 8, 0, 3."),
    ):
        with pytest.raises(InputError, match=words):
            rollout(simulator, given(state, dataclasses.replace(actions, **change)))
    with pytest.raises(InputError, match="does not know the type .foot.; it has hand, pusher"):
        rollout(simulator, given(state, Actions.of(torch.zeros(1, 4, 1, 3), ("foot",))))
    for wrong in ({"actions": ("a", "a")}, {"actions": ("a",), "priors": (InertiaConfig(),)}):
        with pytest.raises(InputError, match="DynamicsConfig: "):
            dataclasses.replace(CONFIG.dynamics, **wrong)
    with pytest.raises(InputError, match="need a latent model"):
        dataclasses.replace(MODELS["explicit"].dynamics, actions=TYPES)


def test_weights_without_embeddings_serve_plans_without_actions():
    simulator, state, _ = setting()
    weights = simulator.state_dict()
    plain = {k: v for k, v in weights.items() if not k.startswith("dynamics.actions.")}
    loaded = with_weights(Simulator, simulator.config, EffectsSpec(), plain).eval()
    assert_same_steps(rollout(loaded, state), rollout(simulator, state))
    with pytest.raises(UnsupportedEffect, match="they require dynamics.actions.displacement"):
        loaded.plan(SPEC)
    with pytest.raises(InputError, match=r"weights do not fit the model: Missing key.*dynamics.actions"):
        with_weights(Simulator, simulator.config, SPEC, plain)
    with pytest.raises(InputError, match=r"weights do not fit the model: Unexpected key.*dynamics.actions"):
        with_weights(Simulator, CONFIG, EffectsSpec(), weights)


def test_saved_states_keep_their_actions(tmp_path):
    _, state, actions = setting()
    actions = dataclasses.replace(actions, first=(5,))
    write_particles(tmp_path / "state.safetensors", given(state, actions))
    again = read_particles(tmp_path / "state.safetensors")[0].actions
    assert (again.names, again.first) == (actions.names, (5,))
    assert_same_bits(again.positions, actions.positions) or assert_same_bits(again.types, actions.types)
    damaged = dataclasses.replace(actions, types=actions.types + 5)
    write_particles(tmp_path / "state.safetensors", given(state, damaged))
    with pytest.raises(
        InputError,
        match=r"state.safetensors: particles.actions: types must be indices of names, or -1; scene 0, step 5",
    ):
        read_particles(tmp_path / "state.safetensors")


def test_hidden_points_are_asleep_and_kinds_of_appearance_do_not_count():
    simulator, state, actions = setting()
    simulator.effects = EffectsSpec(DynamicsEffects(actions=("hand",)), AppearanceEffects(changing="dynamic"))
    history = simulator.dynamics.actions.added(given(state, actions), ("hand",))
    activity = history.activity[[history.clouds.starts[1] - 2, history.clouds.starts[1] - 1]]
    assert activity.tolist() == [ASLEEP, DYNAMIC]
    assert_same_bits(simulator.dynamics.actions.removed(history).means, state.means)
    assert len(rollout(simulator, given(state, actions))) == STEPS
