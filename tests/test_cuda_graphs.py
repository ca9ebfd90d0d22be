"""Rollouts replayed from a CUDA graph, and on the CPU the same steps with the same sizes."""

import dataclasses
import functools
import gc

import pytest
import torch

from gsim3d.cameras import Cameras
from gsim3d.compat.released_model import ReleasedSimulator
from gsim3d.cuda_graphs import Captured, CapturedRollout, collecting_nothing, is_out_of_memory
from gsim3d.effects.spec import DynamicsEffects, EffectsSpec
from gsim3d.errors import CaptureError, InputError, NumericalError
from gsim3d.numerics.policy import StabilityConfig
from gsim3d.numerics.report import StabilityReport
from gsim3d.ops import PyramidCapacity
from gsim3d.priors import InertiaConfig, ProximityConfig, ShapeMatchingConfig
from gsim3d.simulator import Simulator
from gsim3d.state import DYNAMIC, FROZEN, constant, keeping_constants
from tests.asserts import assert_close_relative_to_max, assert_same_bits
from tests.dynamics.scenes import batch, float_fields, make_history
from tests.nn.multiview_encoder.scenes import look_at
from tests.test_simulator import CONFIG

pytestmark = pytest.mark.usefixtures("one_thread")

SIZES = ((20, 15), (9, 0, 12))


def default_dtype(device):
    """float32 rows have the same bits on the CPU whatever is packed with them; float64 shows errors on a GPU."""
    return torch.float32 if torch.device(device).type == "cpu" else torch.float64


def make_simulator(device="cpu", dtype=None, **changes):
    torch.manual_seed(0)
    return Simulator(dataclasses.replace(CONFIG, **changes)).to(device, dtype or default_dtype(device)).eval()


def make_state(seed=0, device="cpu", dtype=None, sizes=SIZES):
    dtype = dtype or default_dtype(device)
    return batch([make_history(n, seed=seed + i, dtype=dtype) for i, n in enumerate(sizes)]).to(device)


def make_cameras(turn=0.0, n_scenes=2, device="cpu"):
    K = torch.tensor([[16.0, 0.0, 8.0], [0.0, 16.0, 8.0], [0.0, 0.0, 1.0]])
    viewmats = torch.stack([look_at(turn + scene, 2.0) for scene in range(n_scenes)]).float()
    near, far = torch.full((n_scenes,), 1.0), torch.full((n_scenes,), 3.5)
    return Cameras(viewmats, K.repeat(n_scenes, 1, 1), near, far, torch.arange(n_scenes), 16, 16).to(device)


def assert_same_steps(actual, expected, rounded=None):
    """On the CPU bit by bit; a GPU picks its matrix products by the number of rows, which is not the same. Or up to an
    error relative to the largest."""
    assert len(actual) == len(expected)
    for a, b in zip(actual, expected, strict=True):
        assert (a.clouds.starts, a.clouds.scenes, a.clouds.steps) == (b.clouds.starts, b.clouds.scenes, b.clouds.steps)
        assert torch.equal(a.activity, b.activity)
        for name, value in float_fields(b).items():
            if rounded is None and value.device.type == "cpu":
                assert_same_bits(getattr(a, name), value, name)
            else:
                assert_close_relative_to_max(getattr(a, name), value, rounded or 1e-11, name)


def rolled_out(simulator, state, n_steps, plan=None):
    with torch.no_grad():
        return simulator.rollout(state, n_steps, plan)


@pytest.mark.parametrize(
    "n_steps, changes", [(1, {}), (5, {}), (3, {"steps_per_call": 2}), (5, {"background": "relightable"})]
)
def test_graph_repeats_the_rollout_with_other_particles(n_steps, changes, device):
    simulator = make_simulator(device, dynamics=dataclasses.replace(CONFIG.dynamics, **changes))
    captured = CapturedRollout(simulator, make_state(device=device), n_steps, factor=5)
    first = captured(make_state(device=device))
    assert first.renderings == []
    kept = [{name: value.clone() for name, value in float_fields(step).items()} for step in first.steps]
    for seed in (0, 1, 2):
        other = make_state(seed, device)
        assert_same_steps(captured(other).steps, rolled_out(simulator, other, n_steps))
    assert captured.captures == 1
    for step, fields in zip(first.steps, kept, strict=True):
        for name, value in fields.items():
            assert_same_bits(getattr(step, name), value, name)


def test_graph_grows_when_more_particles_move(device):
    priors = ProximityConfig(range=0.1), InertiaConfig(radius=0.2), ShapeMatchingConfig(radius=0.2)
    simulator = make_simulator(device, dynamics=dataclasses.replace(CONFIG.dynamics, priors=priors))
    state = make_state(device=device)
    moves = state.activity == DYNAMIC
    newest = torch.arange(state.n_rows, device=device) >= state.clouds.starts[-2]
    one = moves & newest & ((moves & newest).cumsum(0) == 1)  # with room for five
    first = dataclasses.replace(state, activity=torch.where(moves & ~one, FROZEN, state.activity))
    captured = CapturedRollout(simulator, first, 3, factor=5)
    assert_same_steps(captured(first).steps, rolled_out(simulator, first, 3), rounded=1e-5)
    made = captured.captures
    assert_same_steps(captured(state).steps, rolled_out(simulator, state, 3), rounded=1e-5)
    assert captured.captures > made


def test_prepared_state_holds_initial_latents(device):
    """Guards compare a step with the one before it, field by field."""
    state = make_state(device=device)
    symmetric, relightable = (
        make_simulator(device, dynamics=dataclasses.replace(CONFIG.dynamics, background=background))
        for background in ("symmetric", "relightable")
    )
    assert symmetric._prepare(state, symmetric.plan()).initial_latents is None
    prepared = relightable._prepare(state, relightable.plan())
    assert_same_bits(prepared.initial_latents, prepared.dynamic_latents)
    step = rolled_out(relightable, state, 2)[-1]
    frozen = step.activity == FROZEN
    assert frozen.any() and not torch.equal(step.initial_latents[frozen], step.dynamic_latents[frozen])
    again = relightable._prepare(step, relightable.plan())
    assert_same_bits(again.initial_latents, step.initial_latents)


def test_graph_counts_steps_from_those_given(device):
    simulator = make_simulator(device)
    state = make_state(device=device)
    captured = CapturedRollout(simulator, state, 2)
    later = dataclasses.replace(state, cloud_step=state.cloud_step + torch.where(state.cloud_scene == 1, 7, 3))
    steps = captured(later).steps
    assert [step.cloud_step.tolist() for step in steps] == [[5, 10], [6, 11]]
    assert_same_steps(steps, rolled_out(simulator, later, 2))


@pytest.mark.parametrize("effects", [{"background": "masked_out"}, {"background": "dynamic"}, {"history": 1}])
def test_graph_of_any_plan(effects, device):
    simulator, state = make_simulator(device), make_state(device=device)
    plan = simulator.plan(EffectsSpec(dynamics=DynamicsEffects(**effects)))
    captured = CapturedRollout(simulator, state, 3, plan)
    moved = dataclasses.replace(state, means=state.means + 0.01)
    assert_same_steps(captured(moved).steps, rolled_out(simulator, moved, 3, plan))


def test_graph_renders_every_step(device):
    simulator, state, background = make_simulator(device), make_state(device=device), torch.tensor([0.1, 0.5, 0.9])
    background = background.to(device, default_dtype(device))
    captured = CapturedRollout(simulator, state, 2, cameras=make_cameras(device=device), background=background)
    for turn in (0.0, 0.7):
        cameras = make_cameras(turn, device=device)
        predicted = captured(state, cameras)
        assert len(predicted.renderings) == 2
        for step, rendering in zip(predicted.steps, predicted.renderings, strict=True):
            with torch.no_grad():
                expected = simulator.render(step, cameras, background)
            assert expected.alpha.max() > 0.1
            assert_same_bits(rendering.color, expected.color)
            assert_same_bits(rendering.depth, expected.depth)
    assert_same_bits(captured(state).renderings[1].color, rendering.color)


def test_graph_is_captured_again_with_more_capacity(device):
    simulator, state = make_simulator(device), make_state(device=device)
    small = dataclasses.replace(state, means=0.5 + 0.02 * state.means)
    captured = CapturedRollout(simulator, small, 3)
    assert_same_steps(captured(small).steps, rolled_out(simulator, small, 3))
    assert captured.captures == 1
    assert_same_steps(captured(state).steps, rolled_out(simulator, state, 3))
    grown = captured.captures
    assert grown > 1
    assert_same_steps(captured(small).steps, rolled_out(simulator, small, 3))
    assert_same_steps(captured(state).steps, rolled_out(simulator, state, 3))
    assert captured.captures == grown


def test_graph_can_be_launched_without_waiting(device):
    simulator, state = make_simulator(device), make_state(device=device)
    captured = CapturedRollout(simulator, state, 2, copies=False)
    other = make_state(3, device)
    captured.launch(other)
    steps = captured.finish().steps
    assert_same_steps(steps, rolled_out(simulator, other, 2))
    with pytest.raises(InputError, match="finish.. must follow launch"):
        captured.finish()


def test_graph_fills_the_report(device):
    simulator = make_simulator(device, stability=StabilityConfig(on_invalid="drop"))
    state, report = make_state(device=device), StabilityReport()
    captured = CapturedRollout(simulator, state, 2, report=report)
    captured(state)
    assert report.total == 0 and len(report.statistics) == 4
    means = state.means.clone()
    means[30] = torch.nan
    bad = dataclasses.replace(state, means=means)
    steps = captured(bad).steps
    assert report.total > 0 and {finding.row for finding in report.findings} >= {30}
    assert_same_steps(steps, rolled_out(simulator, bad, 2))


def test_bad_numbers_raise_behind_a_graph(device):
    simulator, state = make_simulator(device), make_state(device=device)
    captured = CapturedRollout(simulator, state, 1)
    means = state.means.clone()
    means[3] = torch.inf
    with pytest.raises(NumericalError, match="means"):
        captured(dataclasses.replace(state, means=means))
        simulator.report.check()
    simulator.report.clear()
    assert_same_steps(captured(state).steps, rolled_out(simulator, state, 1))


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16])
def test_graph_under_autocast_reads_reloaded_weights(dtype, devices):
    simulator = make_simulator(devices[1], torch.float32)
    state = make_state(device=devices[1], dtype=torch.float32)
    with torch.autocast("cuda", dtype):
        captured = CapturedRollout(simulator, state, 2)
        expected = rolled_out(simulator, state, 2)
    exact = rolled_out(simulator, state, 2)
    before = captured(state).steps

    def error(steps):
        return max((a.dynamic_latents - b.dynamic_latents).abs().max() for a, b in zip(steps, exact, strict=True))

    assert 0 < error(before) <= 2 * error(expected)
    with torch.no_grad():
        for parameter in simulator.dynamics.parameters():
            parameter.mul_(1.1)
    assert_same_bits(captured(state).steps[1].dynamic_latents, before[1].dynamic_latents)
    captured.reload()
    with torch.autocast("cuda", dtype):
        anew = CapturedRollout(simulator, state, 2)
    assert_same_bits(captured(state).steps[1].dynamic_latents, anew(state).steps[1].dynamic_latents)
    assert not torch.equal(anew(state).steps[1].dynamic_latents, before[1].dynamic_latents)


def test_graph_of_gradients(devices):
    simulator = make_simulator(devices[1]).train()
    history = make_state(device=devices[1])
    history = history.with_clouds(history.clouds)
    dynamics, parameters = simulator.dynamics, list(simulator.dynamics.parameters())
    capacity = PyramidCapacity.of(dynamics.geometry(history), history.n_rows, 3)

    def gradients(pyramid=None):
        step = dynamics(history, pyramid=pyramid or dynamics.geometry(history, capacity=capacity))
        return torch.autograd.grad(step.means.square().sum() + step.dynamic_latents.square().sum(), parameters)

    captured = Captured(gradients, devices[1])
    optimizer = torch.optim.SGD(parameters, lr=1e-3)
    for seed in (0, 1, 2):
        history.means.copy_(make_state(seed, devices[1]).means)
        for actual, expected in zip(captured(), gradients(dynamics.geometry(history)), strict=True):
            assert expected.any()
            assert_close_relative_to_max(actual, expected, 1e-10)
        for parameter, grad in zip(parameters, captured.result, strict=True):
            parameter.grad = grad
        optimizer.step()  # the next replay reads other weights


def float32_training(device):
    """(dynamics, history, capacity for it) to train in float32."""
    dynamics = make_simulator(device, torch.float32).train().dynamics
    history = make_state(device=device, dtype=torch.float32)
    history = history.with_clouds(history.clouds)
    return dynamics, history, PyramidCapacity.of(dynamics.geometry(history), history.n_rows, 2)


def test_graph_of_gradients_rounds_weights_that_have_changed(devices):
    dynamics, history, capacity = float32_training(devices[1])
    parameters = list(dynamics.parameters())

    def gradients():
        with torch.autocast("cuda", torch.bfloat16):
            step = dynamics(history, pyramid=dynamics.geometry(history, capacity=capacity))
            return torch.autograd.grad(step.dynamic_latents.square().sum(), parameters)

    captured = Captured(gradients, devices[1])
    for _ in range(2):
        for actual, expected in zip(captured(), gradients(), strict=True):
            assert_same_bits(actual, expected)
        with torch.no_grad():
            for parameter in parameters:
                parameter.mul_(1.2)


def test_graph_of_gradients_inside_an_autocast_that_has_rounded_weights(devices):
    dynamics, history, capacity = float32_training(devices[1])
    parameters = list(dynamics.parameters())

    def gradients():
        step = dynamics(history, pyramid=dynamics.geometry(history, capacity=capacity))
        return torch.autograd.grad(step.dynamic_latents.square().sum(), parameters)

    with torch.autocast("cuda", torch.bfloat16):
        expected = gradients()
        captured = Captured(gradients, devices[1])
    for actual, wanted in zip(captured(), expected, strict=True):
        assert_same_bits(actual, wanted)


def test_waiting_for_the_device_cannot_be_captured(devices):
    x = torch.ones(3, device=devices[1])
    with pytest.raises(CaptureError, match="Captured: .*captur") as caught:
        Captured(lambda: x.sum().item(), devices[1])
    assert not caught.value.out_of_memory
    torch.cuda.synchronize()
    assert Captured(lambda: 2 * x, devices[1])().tolist() == [2, 2, 2]


def test_gpu_out_of_memory_is_reported(devices):
    with pytest.raises(CaptureError, match="out of memory") as caught:
        Captured(lambda: torch.empty(1 << 50, dtype=torch.uint8, device=devices[1]), devices[1])
    assert caught.value.out_of_memory

    def render():  # the ops have an error of their own for it
        raise MemoryError("rasterize_gaussians: there is no memory for the result")

    with pytest.raises(CaptureError, match="no memory for the result") as caught:
        Captured(render, devices[1])
    assert caught.value.out_of_memory


def test_op_out_of_memory_raises_its_own_message():
    with pytest.raises(RuntimeError) as caught:
        torch.ops.gsim3d.unpool(torch.ones(1, 1), torch.tensor([0]), torch.tensor([0, 1]), 2**62)
    assert is_out_of_memory(caught.value) and not is_out_of_memory(RuntimeError("another"))


def test_collected_graphs_do_not_end_a_capture(devices):
    x, calls, before = torch.ones(3, device=devices[1]), [], gc.get_threshold()
    graphs = [Captured(lambda: 2 * x, devices[1])]

    def function():
        calls.append(len(calls))
        if len(calls) == 3:  # the one that is captured
            cycle = [graphs.pop()]
            cycle.append(cycle)
            del cycle  # only the collector finds it, and so many lists call for it
            gc.set_threshold(100)
        return x * len([[k] for k in range(5000)])

    try:
        assert Captured(function, devices[1])().tolist() == [5000, 5000, 5000]
    finally:
        gc.set_threshold(*before)
    assert len(calls) == 3 and not graphs


@pytest.mark.parametrize("enabled", [True, False])
def test_collector_goes_on_as_before(enabled):
    assert gc.isenabled()
    try:
        (gc.enable if enabled else gc.disable)()
        with pytest.raises(KeyError), collecting_nothing():
            assert not gc.isenabled()
            raise KeyError
        assert gc.isenabled() == enabled
    finally:
        gc.enable()


def test_captured_needs_a_gpu():
    with pytest.raises(CaptureError, match="device must be a GPU; got cpu"):
        Captured(lambda: None, "cpu")


def test_compile_of_a_rollout(device):
    simulator, state = (
        make_simulator(device, torch.float32),
        make_state(device=device, dtype=torch.float32, sizes=((9, 8),)),
    )
    state, plan, sizes = state.with_clouds(state.clouds), simulator.plan(), []

    def observe(history):
        pyramid = simulator.dynamics.geometry(history)
        sizes.append(PyramidCapacity.of(pyramid, history.n_rows))
        return pyramid

    with torch.no_grad():
        (expected,) = simulator.rollout(state, 1, plan, geometry=observe)

    def step(means, latents):
        history = dataclasses.replace(state, means=means, dynamic_latents=latents)
        geometry = functools.partial(simulator.dynamics.geometry, capacity=sizes[0])
        (later,) = simulator.rollout(history, 1, plan, geometry=geometry)
        return later.means, later.dynamic_latents

    backend = "aot_eager" if device.type == "cpu" else "inductor"
    with torch.no_grad():
        means, latents = torch.compile(step, fullgraph=True, backend=backend)(state.means, state.dynamic_latents)
    assert_close_relative_to_max(means, expected.means, "dynamics_order")
    assert_close_relative_to_max(latents, expected.dynamic_latents, "dynamics_order")


def test_graph_keeps_the_constants_it_reads(devices):
    simulator, state = make_simulator(devices[1]), make_state(device=devices[1])
    captured = CapturedRollout(simulator, state, 2)
    expected = captured(state).steps
    for i in range(600):  # more than are kept without a graph
        constant((i, 12345), devices[1])
    torch.full((1 << 20,), -1, device=devices[1])
    assert_same_steps(captured(state).steps, expected)


def test_kept_constants_outlive_others():
    store = {}
    with keeping_constants(store):
        first = constant((1, 2, 3), torch.device("cpu"))
        assert constant((1, 2, 3), "cpu") is first
    assert list(store.values())[0] is first and first.tolist() == [1, 2, 3]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (dict(n_steps=0), "n_steps must be at least 1; got 0"),
        (dict(factor=0.9), "factor must be at least 1; got 0.9"),
        (dict(factor=float("nan")), "factor must be at least 1; got nan"),
    ],
)
def test_arguments_that_do_not_fit(change, message):
    arguments = dict(simulator=make_simulator(), state=make_state(), n_steps=1) | change
    with pytest.raises(InputError, match=f"CapturedRollout: {message}"):
        CapturedRollout(**arguments)


def test_models_that_cannot_be_captured():
    with pytest.raises(InputError, match="must be in evaluation mode"):
        CapturedRollout(make_simulator().train(), make_state(), 1)
    with pytest.raises(InputError, match="cannot render in a graph"):
        CapturedRollout(ReleasedSimulator(CONFIG).eval(), make_state(), 1, cameras=make_cameras())


@pytest.mark.parametrize(
    ("other", "message"),
    [
        (lambda s: make_state(sizes=((20, 14), (9, 0, 12))), r"clouds that start at rows \[0, 20, 35, 44, 44, 56\]"),
        (lambda s: dataclasses.replace(s, cloud_step=s.cloud_step * 2), "the same differences between steps"),
        (
            lambda s: dataclasses.replace(s, static_latents=s.static_latents[:, :2]),
            r"state.static_latents must be \[56, 3\]",
        ),
        (lambda s: dataclasses.replace(s, static_latents=None), r"state.static_latents must be \[56, 3\]"),
    ],
)
def test_states_that_do_not_fit_the_graph(other, message):
    captured = CapturedRollout(make_simulator(), make_state(), 1)
    with pytest.raises(InputError, match=f"CapturedRollout: .*{message}"):
        captured(other(make_state()))


def test_cameras_that_do_not_fit_the_graph():
    captured = CapturedRollout(make_simulator(), make_state(), 1, cameras=make_cameras())
    with pytest.raises(InputError, match="2 of 16 x 16 pixels; got 3 of 16 x 16"):
        captured(make_state(), make_cameras(n_scenes=3))
    with pytest.raises(InputError, match="of the first ones, none; got 2"):
        CapturedRollout(make_simulator(), make_state(), 1)(make_state(), make_cameras())
