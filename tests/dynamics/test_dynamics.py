"""One step of the dynamics: histories, ragged batches, symmetries and determinism."""

import dataclasses

import pytest
import torch

from gsim3d.dynamics import Dynamics, DynamicsConfig, rollout
from gsim3d.state import FROZEN, append_step, concatenate, last_steps
from tests.asserts import assert_close_relative_to_max, assert_same_bits, with_threads
from tests.dynamics.scenes import EXPLICIT, SEEING, TINY, batch, float_fields, make_dynamics, make_history, permute_rows

MOVING = dataclasses.replace(TINY, priors=SEEING)


def assert_same_particles(actual, expected, what=""):
    for name, value in float_fields(expected).items():
        assert_same_bits(getattr(actual, name), value, f"{what} {name}")


@pytest.mark.parametrize("config", [TINY, EXPLICIT, MOVING])
@pytest.mark.parametrize("n_rows", [(30,), (30, 20), (20, 0, 25), (9, 8, 7, 6), (1,), (1, 1), (0, 12)])
def test_any_history(n_rows, config):
    history = make_history(n_rows, config=config)
    step = make_dynamics(config)(history)
    assert step.n_rows == n_rows[-1] and step.cu_rows.tolist() == [0, n_rows[-1]]
    assert step.cloud_step.tolist() == [len(n_rows)] and step.cloud_scene.tolist() == [0]
    newest = last_steps(history, 1)
    assert all(torch.isfinite(value).all() for value in float_fields(step).values())
    assert_same_bits(step.static_latents, newest.static_latents)
    assert (step.means - newest.means).abs().max() <= TINY.max_step + 1e-6
    moves = newest.activity != FROZEN
    assert not torch.equal(step.means[moves], newest.means[moves])


def test_empty_newest_step_stays_empty():
    step = make_dynamics()(make_history((12, 0)))
    assert step.n_rows == 0 and step.cloud_step.tolist() == [2]


def test_untrained_preset_predicts_no_change():
    config = dataclasses.replace(EXPLICIT, zero_init=True)
    history = make_history((20, 30), config=config)
    step, newest = make_dynamics(config)(history), last_steps(history, 1)
    for name, value in float_fields(newest).items():
        if name == "quats":  # of q and -q the one whose largest component is positive
            value = torch.where((step.quats * value).sum(1, keepdim=True) < 0, -value, value)
        assert_close_relative_to_max(getattr(step, name), value, 1e-6, name)


@pytest.mark.usefixtures("one_thread")
@pytest.mark.parametrize("config", [TINY, EXPLICIT, MOVING])
def test_scenes_are_independent(config):
    dynamics = make_dynamics(config)
    sizes = [(40, 30), (3,), (5, 6, 7), (60, 0, 1, 2)]
    histories = [make_history(n_rows, seed=i, config=config) for i, n_rows in enumerate(sizes)]
    together = dynamics(batch(histories))
    for i, history in enumerate(histories):
        assert_same_particles(together.select_clouds(torch.tensor([i])), dynamics(history), f"scene {i}")


@pytest.mark.parametrize("config", [TINY, EXPLICIT, MOVING])
def test_frozen_particles_do_not_move(config):
    history = make_history((30, 40), config=config)
    step, newest = make_dynamics(config)(history), last_steps(history, 1)
    frozen = newest.activity == FROZEN
    assert frozen.any()
    for name in ("means", "opacities", "quats", "scales"):
        if getattr(step, name) is not None:
            assert_same_bits(getattr(step, name)[frozen], getattr(newest, name)[frozen], name)
    assert not torch.equal(step.dynamic_latents[frozen], newest.dynamic_latents[frozen])


def test_frozen_particles_have_no_prediction_gradient():
    dynamics, history = make_dynamics(), make_history((30,), frozen_share=2.0)
    dynamics(history).means.sum().backward()
    assert all(p.grad is None or not p.grad.any() for p in dynamics.parameters())


@pytest.mark.parametrize("bad", [float("nan"), float("inf"), -1.0, 1e6])
def test_particles_outside_grid_sleep(bad):
    dynamics, history = make_dynamics(), make_history((25, 30))
    odd = torch.zeros(history.n_rows, dtype=torch.bool)
    odd[[3, 30, 54]] = True
    means = history.means.clone()
    means[odd, 0] = bad
    step = dynamics(dataclasses.replace(history, means=means))
    asleep = odd[25:]
    assert_same_bits(step.means[asleep], means[25:][asleep])
    assert_same_bits(step.dynamic_latents[asleep], history.dynamic_latents[25:][asleep])
    absent = dynamics(history.select_rows(~odd))
    for name, value in float_fields(absent).items():
        assert_same_bits(getattr(step, name)[~asleep], value, name)


def test_translation_by_whole_cells():
    dynamics, history = make_dynamics(), make_history((30, 30))
    history = dataclasses.replace(history, means=(history.means * 2**16).round() / 2**16)  # adds without rounding
    shift = torch.tensor([16.0, -32.0, 48.0]) * TINY.grid_size
    moved = dataclasses.replace(history, means=history.means + shift, origin=history.origin + shift)
    step, moved_step = dynamics(history), dynamics(moved)
    assert_same_bits(moved_step.dynamic_latents, step.dynamic_latents)
    assert_close_relative_to_max(moved_step.means - shift, step.means, 1e-6)


@pytest.mark.parametrize("position_features", [False, True])
def test_motion_depends_on_position_with_position_features_only(position_features):
    config = dataclasses.replace(TINY, position_features=position_features)
    dynamics, history = make_dynamics(config), make_history((30, 30))
    cells = 64.0 * TINY.grid_size  # a multiple of the coarsest cell and of the curves' coarse levels
    history = dataclasses.replace(history, means=(history.means * 2**16).round() / 2**16)
    moved = dataclasses.replace(history, means=history.means + cells)
    change = (dynamics(moved).dynamic_latents - dynamics(history).dynamic_latents).abs().max()
    assert (change > 1e-3) == position_features


def test_permutation_of_particles():
    dynamics, history = make_dynamics(), make_history((40, 40))
    permuted, order = permute_rows(history)
    step, permuted_step = dynamics(history), dynamics(permuted)
    rows = order[40:] - 40
    assert_close_relative_to_max(permuted_step.means, step.means[rows], "dynamics_order")
    assert_close_relative_to_max(permuted_step.dynamic_latents, step.dynamic_latents[rows], "dynamics_order")


def test_time_slots_count_from_newest_step():
    dynamics, history = make_dynamics(), make_history((30, 20))
    later = dataclasses.replace(history, cloud_step=history.cloud_step + 5)
    assert_same_bits(dynamics(later).means, dynamics(history).means)
    assert dynamics(later).cloud_step.tolist() == [7]
    gap = dataclasses.replace(history, cloud_step=torch.tensor([0, 2]))
    assert not torch.equal(dynamics(gap).means, dynamics(history).means)


def test_bits_are_independent_of_threads():
    dynamics, history = make_dynamics(), make_history((300, 300))

    def run():
        dynamics.zero_grad()
        step = dynamics(history)
        (step.means.square().sum() + step.dynamic_latents.square().sum()).backward()
        return [step.means.detach(), *(p.grad.clone() for p in dynamics.parameters())]

    for one, two in zip(with_threads(1, run), with_threads(2, run), strict=True):
        assert_same_bits(two, one)


@pytest.mark.parametrize("norm", ["layer", "batch"])
def test_checkpointing_keeps_gradients(norm):
    config = dataclasses.replace(TINY, norm=norm, drop_path=0.3, shuffle_orders=True)
    history = make_history((40, 40))
    grads = []
    for checkpointing in (False, True):
        dynamics = make_dynamics(dataclasses.replace(config, checkpointing=checkpointing)).train()
        generator = torch.Generator().manual_seed(3)
        step = dynamics(history, generator=generator)
        (step.means.square().sum() + step.dynamic_latents.sum()).backward()
        assert all(p.grad is not None and p.grad.any() for p in dynamics.parameters())
        grads.append([*(p.grad for p in dynamics.parameters()), *dynamics.buffers()])
    for without, with_checkpoints in zip(*grads, strict=True):
        assert_same_bits(with_checkpoints, without)


def test_generator_is_the_only_randomness():
    config = dataclasses.replace(TINY, drop_path=0.5, shuffle_orders=True)
    dynamics, history = make_dynamics(config), make_history((40, 40))

    def run(seed):
        generator = None if seed is None else torch.Generator().manual_seed(seed)
        return dynamics(history, generator=generator).means

    assert_same_bits(run(1), run(None))
    dynamics.train()
    assert_same_bits(run(1), run(1))
    assert not torch.equal(run(1), run(2))
    assert_same_bits(run(None), dynamics.eval()(history).means)


def test_drop_path_rates_grow_from_zero():
    dynamics = Dynamics(dataclasses.replace(TINY, drop_path=0.3, encoder_depths=(2, 1, 1), decoder_depths=(2, 1)))
    encoder = [block.drop_path for stage in dynamics.net.encoder for block in stage.blocks]
    assert encoder == pytest.approx([0, 0.1, 0.2, 0.3])
    decoder = [[block.drop_path for block in stage.blocks] for stage in dynamics.net.decoder]
    assert decoder[0] == pytest.approx([0.15, 0.0]) and decoder[1] == pytest.approx([0.3])


def test_batch_norm_in_evaluation_and_with_one_row():
    dynamics = make_dynamics(dataclasses.replace(TINY, norm="batch"))
    histories = [make_history((40,), seed=0), make_history((30,), seed=1)]
    alone = dynamics(histories[0])
    assert_same_bits(dynamics(batch(histories)).select_clouds(torch.tensor([0])).means, alone.means)
    before = [b.clone() for b in dynamics.buffers()]
    step = dynamics.train()(make_history((1,)))
    assert torch.isfinite(step.means).all()
    assert all(torch.isfinite(b).all() for b in dynamics.buffers()) and len(before) == len(list(dynamics.buffers()))


@pytest.mark.parametrize("norm", ["layer", "batch"])
@pytest.mark.parametrize("sleeper", [False, True])
def test_padding_rows_change_nothing_in_training(norm, sleeper, device):
    """Rounded geometry adds padding rows, which change neither statistics nor gradients."""
    dynamics, results = make_dynamics(dataclasses.replace(TINY, norm=norm)).train().double().to(device), []
    history = make_history((97, 113)).to(device)
    reals = {k: v.double() for k, v in history.row_fields().items() if v.is_floating_point()}
    history = dataclasses.replace(history, **reals)
    if sleeper:
        history.means[7] = torch.nan
    start = {name: value.clone() for name, value in dynamics.state_dict().items()}
    for rounds in (False, True):
        dynamics.rounds = rounds
        dynamics.load_state_dict(start)
        stages = dynamics.geometry(history, rounded=rounds).stages
        assert any(stage.n_rows > stage.n_data for stage in stages) == rounds
        latents = history.dynamic_latents.clone().requires_grad_()
        step = dynamics(dataclasses.replace(history, dynamic_latents=latents))
        loss = step.means.nan_to_num().sin().sum() + step.dynamic_latents.square().sum()
        gradients = torch.autograd.grad(loss, [latents, *dynamics.parameters()])
        results.append([step.means.nan_to_num(), step.dynamic_latents, *gradients, *dynamics.buffers()])
    largest = max(gradient.abs().max() for gradient in results[0][2:])
    for exact, rounded in zip(*results, strict=True):
        assert (rounded - exact).abs().max() <= 1e-12 * max(1, largest)


def test_rollout_is_autoregressive_and_differentiable():
    dynamics, history = make_dynamics(), make_history((20, 25))
    means = history.means.clone().requires_grad_()
    steps = rollout(dynamics, dataclasses.replace(history, means=means), 3, 2)
    assert [step.cloud_step.tolist() for step in steps] == [[2], [3], [4]]
    by_hand = dynamics(last_steps(concatenate([history, steps[0].detach()]), 2))
    assert_same_bits(steps[1].means.detach(), by_hand.means.detach())
    (grad,) = torch.autograd.grad(steps[2].means.sum(), means)
    assert grad[20:].any() and torch.isfinite(grad).all()


@pytest.mark.parametrize("predicts", ["from_newest", "from_previous", "absolute"])
def test_several_steps_per_call(predicts):
    config = dataclasses.replace(TINY, steps_per_call=3, predicts=predicts)
    dynamics = make_dynamics(config)
    both = batch([make_history((20, 25)), make_history((9,), seed=1)])
    predicted = dynamics(both)
    assert predicted.cloud_scene.tolist() == [0, 0, 0, 1, 1, 1]
    assert predicted.cloud_step.tolist() == [2, 3, 4, 1, 2, 3]
    assert predicted.cu_rows.diff().tolist() == [25, 25, 25, 9, 9, 9]
    alone = dynamics(make_history((20, 25)))
    assert_same_particles(predicted.select_clouds(torch.tensor([0, 1, 2])), alone)
    steps = rollout(dynamics, both, 5, 4)
    assert [step.cloud_step.tolist() for step in steps] == [[2, 1], [3, 2], [4, 3], [5, 4], [6, 5]]
    for i, step in enumerate(steps[:3]):
        assert_same_particles(step, predicted.select_clouds(torch.tensor([i, 3 + i])))
    again = dynamics(last_steps(concatenate([both, predicted]), 4))
    assert_same_particles(steps[3], again.select_clouds(torch.tensor([0, 3])))


def test_append_step_keeps_last_steps():
    both = batch([make_history((5, 6)), make_history((3,), seed=1)])
    step = make_dynamics()(both)
    state = append_step(both, step, 2)
    assert state.cloud_scene.tolist() == [0, 0, 1, 1] and state.cloud_step.tolist() == [1, 2, 0, 1]
    assert torch.diff(state.cu_rows).tolist() == [6, 6, 3, 3]
    assert_same_bits(state.means[6:12], step.means[:6])


def test_long_rollout_is_finite():
    dynamics, history = make_dynamics(), make_history((30, 30))
    with torch.no_grad():
        final = rollout(dynamics, history, 200, 2)[-1]
    assert all(torch.isfinite(value).all() for value in float_fields(final).values())


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"cloud_step": torch.tensor([0, 9])}, "must span at most 4 steps; got 10"),
        ({"cloud_step": torch.tensor([1, 0])}, "sorted by .scene, step."),
        ({"static_latents": torch.zeros(25, 7)}, "static_latents must have 3 channels"),
    ],
)
def test_errors_name_the_argument(change, message):
    with pytest.raises(ValueError, match=message):
        make_dynamics()(dataclasses.replace(make_history((10, 15)), **change))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"strides": (2,)}, "strides must have 2 entries"),
        ({"encoder_heads": (3, 3, 2)}, "8 cannot be split into 3 heads"),
        ({"norm": "group"}, 'norm must be "layer" or "batch"'),
        ({"predicts": "velocity"}, "predicts must be one of from_newest"),
        ({"steps_per_call": 0}, "steps_per_call must be at least 1"),
    ],
)
def test_config_errors(change, message):
    with pytest.raises(ValueError, match=message):
        DynamicsConfig(**{**dataclasses.asdict(TINY), **change})


@pytest.mark.parametrize("config", [TINY, EXPLICIT, MOVING])
def test_history_without_particles_stays_empty(config):
    step = make_dynamics(config)(make_history((0, 0), config=config))
    assert step.n_rows == 0 and step.cloud_step.tolist() == [2]
