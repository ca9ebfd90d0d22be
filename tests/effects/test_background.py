"""Asymmetric background: contributions to moving particles, and caching."""

import dataclasses

import pytest
import torch

from gsim3d.cuda_graphs import CapturedRollout
from gsim3d.dynamics import DynamicsConfig, Partition, RestLog, rollout, rollout_in_parts
from gsim3d.dynamics.frozen_context import FrozenContext
from gsim3d.nn.point_transformer import SparseConv
from gsim3d.ops import PatchTable, PyramidCapacity, curve_encode, joint_attention
from gsim3d.ops.curve import CURVES
from gsim3d.state import ASLEEP, FROZEN, last_steps
from tests.asserts import assert_close_relative_to_max, assert_same_bits, assert_same_bits_for_any_threads
from tests.dynamics.scenes import EXPLICIT, TINY, batch, float_fields, make_dynamics, make_history, permute_rows
from tests.effects.resting import ASYMMETRIC, make_scenes, make_simulator, newest_rows

pytestmark = pytest.mark.usefixtures("one_thread")


def assert_same_particles(actual, expected):
    assert actual.clouds.starts == expected.clouds.starts and actual.clouds.steps == expected.clouds.steps
    assert torch.equal(actual.activity, expected.activity)
    for name, value in float_fields(expected).items():
        assert_same_bits(getattr(actual, name), value, name)


def read_and_reader(dtype=torch.float64):
    """Two scenes in parts: their geometry, and a background and a reader of stage 0 with nothing kept yet."""
    dynamics = make_dynamics(ASYMMETRIC, dtype=dtype)
    history = batch([make_history((150, 140), seed=i, frozen_share=0.6, dtype=dtype) for i in range(2)])
    parts = Partition.of(history, asymmetric=True)
    rest, moving = dynamics.geometry(parts.background), dynamics.geometry(parts.moving)
    background, recorders = FrozenContext.begin(rest, parts.background, ASYMMETRIC.pyramid_spec(0))
    return parts, rest, moving, background, recorders[0]


def scene_of_rows(particles):
    return particles.cloud_scene[particles.row_cloud()].tolist()


@pytest.mark.parametrize("kernel_size", [3, 5])
def test_convolution_tap_adds_moving_and_frozen_means(kernel_size):
    parts, rest, moving, background, recorder = read_and_reader()
    conv = SparseConv(3, 4, kernel_size, bias=True).double()
    x_rest, x = torch.randn(rest.stages[0].n_rows, 3).double(), torch.randn(moving.stages[0].n_rows, 3).double()
    recorder.convolved(conv, x_rest, x_rest)
    out = conv(x, moving.stages[0], background.readers(moving, parts.moving)[0])

    def cells(stage, group):
        found = {}
        for row, (g, cell) in enumerate(zip(group, stage.grid.tolist(), strict=True)):
            found.setdefault((g, *cell), []).append(row)
        return found

    scene_rest, scene = scene_of_rows(parts.background), scene_of_rows(parts.moving)
    frozen, own = cells(rest.stages[0], scene_rest), cells(moving.stages[0], moving.stages[0].cloud.tolist())
    expected = conv.bias + x @ conv.weight[:, *[kernel_size // 2] * 3].t()
    reach, met = kernel_size // 2, 0
    steps = torch.cartesian_prod(*[torch.arange(-reach, reach + 1)] * 3)
    for row, cell in enumerate(moving.stages[0].grid):
        for step in steps[steps.any(1)]:
            weight, there = conv.weight[:, *(step + reach).tolist()], (cell + step).tolist()
            for rows, features, group in (
                (own, x, moving.stages[0].cloud[row].item()),
                (frozen, x_rest, scene[row]),
            ):
                if members := rows.get((group, *there)):
                    expected[row] += weight @ features[members].mean(0)
                    met += features is x_rest
    assert met > 100
    assert_close_relative_to_max(out, expected, 1e-12)


@pytest.mark.parametrize("row", range(4))
def test_joint_attention_reads_own_and_background_patch(row):
    parts, rest, moving, background, _ = read_and_reader()
    stage, frozen = moving.stages[0], rest.stages[0]
    q, k, v = torch.randn(3, stage.n_rows, 2, 4).double()
    other_k, other_v = torch.randn(2, frozen.n_rows, 2, 4).double()
    table = background.readers(moving, parts.moving)[0].patches[row]
    out = joint_attention(q, k, v, other_k, other_v, stage.patches[row], table)

    scene_rest, scene = scene_of_rows(parts.background), scene_of_rows(parts.moving)
    codes = curve_encode(stage.grid, None, CURVES[row]).tolist()
    rest_codes = curve_encode(frozen.grid, None, CURVES[row]).tolist()
    patches = frozen.patches[row]
    own = {}
    for p, (a, b) in enumerate(zip(stage.patches[row].cu_q, stage.patches[row].cu_q[1:])):
        keys = stage.patches[row].kv_rows[stage.patches[row].cu_k[p] : stage.patches[row].cu_k[p + 1]]
        own |= dict.fromkeys(stage.patches[row].q_rows[a:b].tolist(), keys)
    for i in range(stage.n_rows):
        around = None
        for p, a in enumerate(patches.cu_q[:-1]):
            begins = patches.q_rows[a].item()
            if scene_rest[begins] == scene[i] and (around is None or rest_codes[begins] <= codes[i]):
                around = patches.kv_rows[patches.cu_k[p] : patches.cu_k[p + 1]]
        keys, values = torch.cat([k[own[i]], other_k[around]]), torch.cat([v[own[i]], other_v[around]])
        shares = (torch.einsum("hd,nhd->nh", q[i], keys) / 2).softmax(0)
        assert_close_relative_to_max(out[i], torch.einsum("nh,nhd->hd", shares, values), 1e-12)


def test_joint_attention_gradients_match_one_softmax():
    torch.manual_seed(0)
    q, k, v, other_k, other_v = (torch.randn(n, 2, 4).double().requires_grad_() for n in (9, 9, 9, 7, 7))
    cu, rows = torch.tensor([0, 4, 8]), torch.randperm(9)
    own = PatchTable(rows, rows, cu, cu)
    other = PatchTable(
        torch.arange(9).flip(0), torch.tensor([3, 1, 0, 6, 2]), torch.tensor([0, 5, 7]), torch.tensor([0, 2, 5])
    )
    assert torch.autograd.gradcheck(lambda *x: joint_attention(*x, own, other), (q, k, v, other_k, other_v))


def test_cached_background_bits_match_recomputed():
    simulator, state, log = make_simulator(), make_scenes(), RestLog()
    steps = simulator.rollout(state, 4, log=log)
    assert log.remembered == 1 and log.calls == 4
    for step in steps:
        state = simulator.step(state)
        assert_same_particles(step, last_steps(state, 1))


@pytest.mark.parametrize("values", [{"steps_per_call": 2}, {"steps_per_call": 2, "predicts": "from_previous"}])
def test_background_with_several_steps_per_call(values):
    dynamics, history = make_dynamics(dataclasses.replace(ASYMMETRIC, **values)), make_scenes()
    steps = rollout_in_parts(
        lambda moving, background: dynamics(moving, background=background), history, 5, 4, remember=dynamics.remember
    )
    for one, other in zip(steps, rollout(dynamics, history, 5, 4), strict=True):
        assert_same_particles(one, other)


def test_background_of_explicit_model():
    config = dataclasses.replace(EXPLICIT, background="asymmetric")
    dynamics, history = make_dynamics(config), make_history((40, 50), config=config, frozen_share=0.5)
    newest, step = last_steps(history, 1), dynamics(history)
    frozen = newest.activity == FROZEN
    for name in ("means", "quats", "scales", "sh", "opacities"):
        assert_same_bits(getattr(step, name)[frozen], getattr(newest, name)[frozen], name)
        assert not torch.equal(getattr(step, name)[~frozen], getattr(newest, name)[~frozen])


def test_background_excludes_invalid_particles():
    dynamics, history = make_dynamics(ASYMMETRIC), make_history((40, 50), frozen_share=0.5)
    frozen = (history.activity == FROZEN)[:, None]
    lost = torch.arange(90)[:, None] % 3 == 0
    hidden = dataclasses.replace(history, means=torch.where(frozen & lost, torch.nan, history.means))
    kept = hidden.select_rows(~(frozen & lost)[:, 0])
    assert_same_bits(dynamics(hidden).means[~(frozen & lost)[40:, 0]], dynamics(kept).means)
    nobody = dataclasses.replace(history, means=torch.where(frozen, torch.nan, history.means))
    alone = history.select_rows(~frozen[:, 0])
    assert_same_bits(dynamics(nobody).means[~frozen[40:, 0]], dynamics(alone).means)


def test_background_reads_newest_step_only():
    dynamics, history = make_dynamics(ASYMMETRIC), make_scenes()
    newest, step = last_steps(history, 1), dynamics(history)
    frozen = newest.activity == FROZEN
    for name, value in float_fields(newest).items():
        assert_same_bits(getattr(step, name)[frozen], value[frozen], name)
        if name in dynamics.layout.changes():
            assert not torch.equal(getattr(step, name)[~frozen], value[~frozen])
    older = torch.ones(history.n_rows, dtype=torch.bool)
    table = history.clouds
    for q in (1, 4, 5, 7):
        older[table.starts[q] : table.starts[q + 1]] = False
    moved = dataclasses.replace(
        history, means=torch.where((older & (history.activity == FROZEN))[:, None], 0.1, history.means)
    )
    assert_same_particles(dynamics(moved), step)


def test_moving_particles_read_background():
    dynamics, history = make_dynamics(ASYMMETRIC), make_history((60, 60), frozen_share=0.5)
    latents = history.static_latents.clone().requires_grad_()
    step = dynamics(dataclasses.replace(history, static_latents=latents))
    frozen = history.activity == FROZEN
    (grad,) = torch.autograd.grad(step.means.sum(), latents)
    assert (grad[60:][frozen[60:]].abs().amax(1) > 0).all()
    assert not grad[:60][frozen[:60]].any()


def test_scene_without_background_matches_symmetric_model():
    history = batch([make_history((40, 30), seed=i, frozen_share=0.0) for i in range(2)])
    expected = make_dynamics(TINY)(history)
    assert_same_particles(make_dynamics(ASYMMETRIC)(history), expected)
    beside = [make_history((40, 30), seed=i, frozen_share=0.0) for i in range(2)]
    beside = batch([*beside, make_history((50,), seed=5, frozen_share=0.7)])
    some = make_dynamics(ASYMMETRIC)(beside)
    assert_same_bits(some.means[: expected.n_rows], expected.means)


def test_background_keeps_scenes_apart():
    dynamics, history = make_dynamics(ASYMMETRIC), make_scenes()
    together, table = dynamics(history), history.clouds
    for scene, begin in enumerate(together.clouds.starts[:-1]):
        alone = dynamics(history.select_clouds([q for q in range(len(table)) if table.scenes[q] == scene]))
        for name, value in float_fields(alone).items():
            assert_same_bits(getattr(together, name)[begin : begin + alone.n_rows], value, name)


def test_background_permutation_invariance():
    config = dataclasses.replace(ASYMMETRIC, position_features=False)
    dynamics, history = make_dynamics(config, dtype=torch.float64), make_scenes(torch.float64)
    step = dynamics(history)
    mixed, order = permute_rows(history)
    newest = torch.nonzero(newest_rows(history))[:, 0]
    place = torch.zeros(history.n_rows, dtype=torch.int64).index_copy(0, newest, torch.arange(newest.shape[0]))
    assert_close_relative_to_max(dynamics(mixed).means, step.means[place[order[newest]]], 1e-12)
    by = torch.tensor([16.0, -8.0, 4.0], dtype=torch.float64)
    moved = dynamics(dataclasses.replace(history, means=history.means + by, origin=history.origin + by))
    assert_close_relative_to_max(moved.means - by, step.means, 1e-12)


def test_sleeping_particles_are_in_neither_part():
    dynamics, history = make_dynamics(ASYMMETRIC), make_history((60, 60), frozen_share=0.5)
    asleep = torch.arange(120) % 4 == 0
    marked = dataclasses.replace(history, activity=torch.where(asleep, ASLEEP, history.activity))
    step, without = dynamics(marked), dynamics(marked.select_rows(~asleep))
    assert_same_bits(step.means[~asleep[60:]], without.means)
    assert_same_bits(step.means[asleep[60:]], history.means[60:][asleep[60:]])


@pytest.mark.parametrize("room", [1.0, 1.5])
def test_capacity_changes_no_bit(room):
    dynamics, parts = make_dynamics(ASYMMETRIC), Partition.of(make_scenes(), asymmetric=True)
    background, exact = dynamics.remember(parts.background), dynamics.geometry(parts.moving)
    capacity = PyramidCapacity.of(exact, parts.moving.n_rows, room)
    given = dynamics.geometry(parts.moving, capacity=capacity)
    expected = dynamics(parts.moving, background=background)
    assert_same_particles(dynamics(parts.moving, pyramid=given, background=background), expected)


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
@torch.no_grad()
def test_captured_rollout_bits_for_other_background(device, dtype):
    simulator, state = make_simulator().to(device), make_scenes().to(device)
    turned = dataclasses.replace(state, static_latents=state.static_latents.flip(1))
    frozen = (state.activity == FROZEN)[:, None]
    moved = dataclasses.replace(state, means=torch.where(frozen, 0.3 + 0.4 * state.means.flip(1), state.means))
    with torch.autocast(device.type, dtype, enabled=dtype != torch.float32):
        captured = CapturedRollout(simulator, state, 3)
        for given in (state, turned, moved, state):
            for step, expected in zip(captured(given).steps, simulator.rollout(given, 3), strict=True):
                assert_same_particles(step, expected)


@torch.no_grad()
def test_captured_background_follows_changed_weights(device):
    simulator, state = make_simulator().to(device), make_scenes().to(device)
    captured = CapturedRollout(simulator, state, 2)
    before = captured(state).steps[1].means
    for parameter in simulator.dynamics.parameters():
        parameter.mul_(1.1)
    captured.reload()
    after = captured(state).steps
    assert not torch.equal(after[1].means, before)
    for step, expected in zip(after, simulator.rollout(state, 2), strict=True):
        assert_same_particles(step, expected)


def test_captured_background_beyond_capacity():
    simulator = make_simulator()
    few, many = (make_history((60, 60), seed=2, frozen_share=0.5) for _ in range(2))
    frozen = (few.activity == FROZEN)[:, None]
    few = dataclasses.replace(few, means=torch.where(frozen, 0.3 + 0.01 * few.means, few.means))
    captured = CapturedRollout(simulator, few, 2)
    steps = captured(many).steps
    assert captured.captures == 2
    for step, expected in zip(steps, simulator.rollout(many, 2), strict=True):
        assert_same_particles(step, expected)


def test_background_rollout_repeats_bits():
    simulator = make_simulator()
    for one, other in zip(*(simulator.rollout(make_scenes(), 3) for _ in range(2)), strict=True):
        assert_same_particles(one, other)


def test_background_rollout_cuda_matches_cpu(devices):
    results = []
    for device in devices:
        simulator, state = make_simulator(dtype=torch.float64).to(device), make_scenes(torch.float64).to(device)
        state = dataclasses.replace(state, static_latents=state.static_latents.requires_grad_())
        steps = simulator.rollout(state, 3)
        loss = sum(step.means.square().sum() + step.dynamic_latents.square().sum() for step in steps)
        grads = torch.autograd.grad(
            loss, [state.static_latents, simulator.dynamics.net.encoder[0].blocks[0].mlp.fc1.weight]
        )
        with torch.no_grad():  # through blocks in few launches
            results.append(
                [*(t.cpu() for t in grads), *(s.means.cpu() for s in (*steps, *simulator.rollout(state, 3)))]
            )
    for one, other in zip(*results, strict=True):
        assert_close_relative_to_max(other, one, 1e-9)


def test_joint_attention_bits_for_any_number_of_threads():
    q, k, v, other_k, other_v = torch.randn(5, 301, 2, 4, generator=torch.Generator().manual_seed(0)).unbind(0)
    table = PatchTable(torch.arange(301), torch.arange(301), *[torch.tensor([0, 100, 301])] * 2)
    assert_same_bits_for_any_threads(lambda: (joint_attention(q, k, v, other_k, other_v, table, table),))


@pytest.mark.parametrize("checkpointing", [False, True])
def test_background_rollout_gradients(checkpointing):
    """Of cached and uncached rollouts alike, and along a random direction those of finite differences."""
    config = dataclasses.replace(ASYMMETRIC, checkpointing=checkpointing)
    simulator, history = make_simulator(config, dtype=torch.float64), make_scenes(torch.float64)
    simulator.train()
    parameters = list(simulator.dynamics.parameters())
    latents = history.static_latents.clone().requires_grad_()
    weights = torch.randn(last_steps(history, 1).n_rows, 3, generator=torch.Generator().manual_seed(1)).double()

    def loss(make, latents=latents):
        steps = make(dataclasses.replace(history, static_latents=latents))
        return sum((step.means * weights).sum() + step.dynamic_latents.square().sum() for step in steps)

    def cached(state):
        return simulator.rollout(state, 2)

    def uncached(state):
        return rollout(simulator.dynamics, state, 2, 4)

    inputs = [latents, *parameters]
    grads = [torch.autograd.grad(loss(make), inputs, allow_unused=True) for make in (cached, uncached)]
    directions = [torch.randn(p.shape, generator=torch.Generator().manual_seed(2)).double() for p in inputs]
    for one, other in zip(*grads, strict=True):
        if one is not None:
            assert_close_relative_to_max(one, other, 1e-10)
    slope = sum((g * d).sum() for g, d in zip(grads[0], directions, strict=True) if g is not None)
    step, values = 1e-7, []
    for sign in (1, -1):
        with torch.no_grad():
            for p, d in zip(parameters, directions[1:], strict=True):
                p += sign * step * d
            values.append(loss(cached, latents + sign * step * directions[0]))
            for p, d in zip(parameters, directions[1:], strict=True):
                p -= sign * step * d
    assert_close_relative_to_max(slope, (values[0] - values[1]) / (2 * step), 1e-5)


def test_shuffled_curves_match_background():
    config = dataclasses.replace(ASYMMETRIC, shuffle_orders=True, drop_path=0.2)
    dynamics, parts = make_dynamics(config).train(), Partition.of(make_scenes(), asymmetric=True)
    draws = [torch.Generator().manual_seed(3) for _ in range(2)]
    backgrounds = [dynamics.remember(parts.background, generator=g) for g in draws]
    assert backgrounds[0].curves == backgrounds[1].curves != ((0, 1, 2, 3),) * 3
    steps = [dynamics(parts.moving, generator=g, background=b) for g, b in zip(draws, backgrounds, strict=True)]
    assert_same_particles(*steps)
    first, codes = backgrounds[0].places[0].first, []
    codes = [curve_encode(torch.tensor([[7, 6, 5]]), None, CURVES[c], shift=48) for c in backgrounds[0].curves[0]]
    assert first.shape[0] == len(codes) == 4


@pytest.mark.parametrize("values", [{"norm": "batch"}, {"background": "frozen"}])
def test_asymmetric_config_refuses_unsuitable_models(values):
    with pytest.raises(ValueError, match="background"):
        DynamicsConfig(**{"norm": "layer", "background": "asymmetric", **values})
