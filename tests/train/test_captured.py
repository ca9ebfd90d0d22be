"""Steps from a graph: on the CPU the same sums call by call, with the sizes that a graph would have."""

import dataclasses
import gc
import itertools
import json
import math
import threading
from contextlib import nullcontext
from functools import partial

import numpy as np
import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode

from gsim3d.compat.checkpoints import OCCLUSION
from gsim3d.cuda_graphs import Captured, collecting_nothing
from gsim3d.data import Scene, find_scenes
from gsim3d.errors import CaptureError, InputError
from gsim3d.evaluate.ablations import changed, load_ablations
from gsim3d.numerics.report import StabilityReport
from gsim3d.train import captured as captured_module
from gsim3d.train.captured import CapturedLoss
from gsim3d.train.config import DataConfig, PhaseConfig, TrainConfig
from gsim3d.train.loop import Trainer, deterministic
from gsim3d.train.samples import draw_batch
from tests.asserts import assert_close_relative_to_max, assert_same_bits
from tests.tiny_scenes import write_scenes

pytestmark = pytest.mark.usefixtures("one_thread")
ROWS = load_ablations()[1]

CONFIG = TrainConfig(
    phases=(PhaseConfig(steps=9, horizon=2, batch=2, target_views=2),),
    data=DataConfig(history=2, context_views=2, background_stride=2, position_noise=0.005),
)


# A GPU picks its matrix products by the number of rows, which padding changes.
TOLERANCE = {"cpu": 1e-4, "cuda": 1e-3}


@pytest.fixture(scope="module")
def scenes(tmp_path_factory):
    folders = find_scenes(write_scenes(tmp_path_factory.mktemp("scenes"), 2))
    for number, folder in enumerate(folders):
        positions = np.random.default_rng(number).uniform(-0.3, 0.3, (6, 2, 3)).astype(np.float32)
        np.savez(folder / "actions.npz", positions=positions, types=["hand", "pusher"][:: 1 - 2 * number])
    return [Scene.open(path) for path in folders]


MOVING = dataclasses.replace(
    CONFIG,
    model={"dynamics": {"priors": [{"type": "inertia"}]}},
    effects={"appearance": {"changing": "frozen"}},
)
RELIGHTABLE = dataclasses.replace(
    MOVING,
    model={
        "dynamics": {
            "background": "relightable",
            "priors": [
                {"type": "velocity_from_images"},
                {"type": "position_waves", "count": 2},
                {"type": "proximity"},
                {"type": "inertia"},
                {"type": "directional_light", "directions": [[0.1, 0.2, 1.0]], **OCCLUSION},
            ],
        }
    },
)
FLYING = dataclasses.replace(
    RELIGHTABLE,
    model={
        "dynamics": {
            "background": "relightable",
            "priors": [
                {"type": "segmentation"},
                {"type": "velocity_from_images"},
                {"type": "position_waves", "count": 2},
                {"type": "proximity"},
                {"type": "inertia"},
                {"type": "shape_matching"},
                {"type": "gravity"},
                {"type": "contact"},
                {"type": "directional_light", "directions": [[0.1, 0.2, 1.0]]},
            ],
        }
    },
    effects={"appearance": {"changing": "dynamic"}},
)  # fmt: skip
ALL_MOVING = dataclasses.replace(
    MOVING,
    model={"dynamics": {"priors": [{"type": "velocity_from_images"}, {"type": "inertia"}, {"type": "shape_matching"}]}},
    effects={"dynamics": {"background": "dynamic"}},
)
ACTING = dataclasses.replace(
    CONFIG,
    model={"dynamics": {"actions": ["hand", "pusher"], "background": "relightable", "priors": [{"type": "velocity"}]}},
    effects={"dynamics": {"actions": ["hand", "pusher"]}},
)
KINDS = {
    "latent": CONFIG,
    "graph": dataclasses.replace(CONFIG, model={"dynamics": {"graph": {"channels": 16, "layers": 2}}}),
    "acting": ACTING,
    "all moving": ALL_MOVING,
    "moving": MOVING,
    "relightable": RELIGHTABLE,
    "flying": FLYING,
    "moving, masked": changed(MOVING, ROWS["background-masked"].change),
    **{name: changed(CONFIG, ROWS[name].change) for name in ("explicit", "background-masked")},
}


@pytest.fixture(params=["latent"])
def trainer(scenes, tmp_path, device, request):
    trainer = Trainer(KINDS[request.param], scenes, tmp_path, device=device.type)
    with torch.no_grad():
        dynamics = trainer.simulator.dynamics
        gains = [prior.gain_head for prior in dynamics.priors if prior.gain_head]
        for parameter in (p for module in (dynamics.net.head, *gains) for p in module.parameters()):
            parameter.normal_(0, 0.02, generator=torch.Generator(parameter.device).manual_seed(0))
    return trainer


def captured_loss(trainer, recompute=()):
    return CapturedLoss(
        trainer.simulator,
        trainer.plan,
        trainer.loss_of_images,
        lambda part: torch.autocast("cpu", enabled=False),
        recompute=recompute,
    )


def batches(scenes, count, **changes):
    phase = dataclasses.replace(CONFIG.phases[0], **changes)
    return [draw_batch(scenes, CONFIG.data, phase, 0, step, [0, 1]) for step in range(count)]


def mixed_batches(scenes, count):
    """Batches of two kinds in turn: of horizon 2, and of horizon 3."""
    by_horizon = [batches(scenes, count, horizon=horizon) for horizon in (2, 3)]
    return [by_horizon[step % 2][step] for step in range(count)]


def run(captured, batch, trainer, report=None, factor=1.0):
    weights = factor * trainer.step_weights(batch)
    return captured(captured.prepare(batch), weights, StabilityReport() if report is None else report)


@pytest.mark.parametrize(
    "phase, trainer",
    [
        ({}, "latent"),
        ({"horizon": 0}, "latent"),
        ({}, "explicit"),
        ({}, "background-masked"),
        ({"horizon": 3, "cut": 2}, "moving"),
        ({}, "moving, masked"),
        ({}, "all moving"),
        ({"horizon": 3, "cut": 2}, "relightable"),
        ({"horizon": 3, "cut": 2}, "flying"),
        ({"horizon": 3, "cut": 2}, "acting"),
        ({}, "graph"),
    ],
    ids=[
        *("rollout", "encoded", "explicit", "masked", "moving", "moving, masked", "all moving", "relightable"),
        *("flying", "acting", "graph"),
    ],
    indirect=["trainer"],
)
def test_captured_gradients_equal_autograd(phase, scenes, trainer, device):
    captured, report = captured_loss(trainer), StabilityReport()
    drawn = batches(scenes, 4, **phase)
    assert_gradients_of_the_loss(captured, drawn, trainer, device, report)
    assert captured.captures >= 1 and not report.total


@pytest.mark.parametrize("trainer", ["latent", "moving", "all moving", "flying", "acting"], indirect=True)
def test_autograd_graph_is_freed_with_its_loss(scenes, trainer, device):
    """Without a garbage collection: a capture disables it, and a graph that is left breaks the capture."""
    batch = batches(scenes, 1, horizon=2)[0].to(device)
    gc.collect()
    with collecting_nothing():
        loss, errors = trainer.loss(batch)
        torch.autograd.grad(loss, list(trainer.parameters.values()), allow_unused=True)
        del loss, errors
        left = [x for x in gc.get_objects() if type(x) is torch.Tensor and x.grad_fn is not None]
    assert not left


@pytest.mark.parametrize("trainer", ["latent", "explicit"], indirect=True)
@pytest.mark.parametrize("cut", [1, 2, 3])
def test_segments_change_no_simulated_step(cut, scenes, trainer, device):
    in_one, in_segments = (batches(scenes, 1, horizon=4, cut=c)[0].to(device) for c in (0, cut))
    expected, actual = trainer.loss(in_one)[1], trainer.loss(in_segments)[1]
    assert_close_relative_to_max(actual, expected, 0.0 if device.type == "cpu" else 1e-6)
    captured = run(captured_loss(trainer), in_segments, trainer)
    assert_close_relative_to_max(captured.errors, expected, 0.1 * TOLERANCE[device.type])


@pytest.mark.parametrize("trainer", ["latent"], indirect=True)
@pytest.mark.parametrize("whole, expected", [(False, "ffbfb"), (True, "fffb")])
def test_a_segment_has_its_backward_pass_before_the_next(whole, expected, scenes, trainer, device, monkeypatch):
    captured = captured_loss(trainer)
    captured.whole, events, grad = whole, [], torch.autograd.grad
    batch = batches(scenes, 1, horizon=3, cut=2)[0].to(device)
    run(captured, batch, trainer)
    monkeypatch.setattr(torch.autograd, "grad", lambda *a, **k: (events.append("b"), grad(*a, **k))[1])
    trainer.simulator.dynamics.register_forward_pre_hook(
        lambda *_: events.append("f") if torch.is_grad_enabled() else None
    )
    captured._steps.clear()
    run(captured, batch, trainer)
    assert "".join(events)[-len(expected) :] == expected


@pytest.mark.parametrize(
    "phase, trainer",
    [({}, "latent"), ({"horizon": 3, "cut": 2}, "flying")],
    ids=["rollout", "flying"],
    indirect=["trainer"],
)
def test_captured_recomputing_changes_no_bit(phase, scenes, trainer, device):
    batch, counts = batches(scenes, 2, **phase)[1].to(device), {"calls": 0, "geometry": 0}
    reports, found, counted = (StabilityReport(), StabilityReport()), [], []
    dynamics, geometry = trainer.simulator.dynamics, trainer.simulator.dynamics.geometry
    dynamics.register_forward_pre_hook(lambda *_: counts.update(calls=counts["calls"] + 1))
    dynamics.geometry = lambda *a, **k: (counts.update(geometry=counts["geometry"] + 1), geometry(*a, **k))[1]
    for recompute, report in zip(((), ("encoder", "steps", "images")), reports, strict=True):
        counts.update(calls=0, geometry=0)
        with deterministic():
            found.append(run(captured_loss(trainer, recompute), batch, trainer, report))
        counted.append(dict(counts))
    expected, actual = found
    assert torch.equal(expected.loss, actual.loss) and torch.equal(expected.errors, actual.errors)
    for one, other in zip(expected.parameters, actual.parameters, strict=True):
        assert (one is None) == (other is None) and (one is None or torch.equal(one, other))
    assert reports[0].total == reports[1].total
    assert counted[1]["calls"] > counted[0]["calls"] and counted[1]["geometry"] == counted[0]["geometry"]


def assert_gradients_of_the_loss(captured, drawn, trainer, device, report):
    for batch in drawn:
        batch = batch.to(device)
        loss, errors = trainer.loss(batch)
        expected = torch.autograd.grad(loss, list(trainer.parameters.values()), allow_unused=True)
        loss = loss.detach()  # a capture waits for the stream of every graph that is kept
        actual = run(captured, batch, trainer, report)
        assert_close_relative_to_max(actual.loss, loss, 0.1 * TOLERANCE[device.type])
        assert_close_relative_to_max(actual.errors, errors, 0.1 * TOLERANCE[device.type])
        largest = max(gradient.abs().max() for gradient in expected if gradient is not None)
        for name, gradient, wanted in zip(trainer.parameters, actual.parameters, expected, strict=True):
            assert (gradient is None) == (wanted is None), name
            if gradient is not None:
                assert (gradient - wanted).abs().max() <= TOLERANCE[device.type] * largest, name
                assert gradient.stride() == trainer.parameters[name].stride(), name


class FullGPU:
    """Instead of Captured: holds the graphs of one kind of step, or any that share memory."""

    def __init__(self, captured, make):
        self.captured, self.make, self.pools = captured, make, []

    def __call__(self, function, device, pool):
        self.pools.append(pool)
        if pool is None and len(self.captured._steps) > 1:
            raise CaptureError("Captured: CUDA out of memory.", out_of_memory=True)
        return self.make(function, device, pool)


@pytest.fixture
def full_gpu(monkeypatch):
    def fill(captured, make):
        gpu = FullGPU(captured, make)
        monkeypatch.setattr("gsim3d.train.captured.Captured", gpu)
        return gpu

    return fill


@pytest.mark.parametrize("trainer", ["latent", "relightable"], indirect=True)
def test_graphs_that_share_memory_do_not_change_each_other(scenes, trainer, full_gpu, device):
    if device.type != "cuda":
        pytest.skip("graphs need a GPU")
    captured, report = captured_loss(trainer), StabilityReport()
    gpu = full_gpu(captured, Captured)
    drawn = mixed_batches(scenes, 8)
    assert_gradients_of_the_loss(captured, drawn, trainer, device, report)
    assert not report.total and len(captured._steps) == 2
    assert None not in gpu.pools[-2:]
    captured._steps.clear()
    assert_gradients_of_the_loss(captured, drawn, trainer, device, report)  # in memory of its own again


def test_full_gpu_drops_other_graphs_and_shares_memory(scenes, trainer, full_gpu, monkeypatch):
    monkeypatch.setattr(torch.cuda, "graph_pool_handle", lambda: (0, 7))
    captured = captured_loss(trainer)
    for batch in mixed_batches(scenes, 9):
        run(captured, batch.to(trainer.device), trainer)
    (_, first), (kind, last) = captured._steps.items()
    gpu = full_gpu(captured, lambda function, device, pool: (function, pool))
    assert captured.graph(last, len) == (len, (0, 7))
    assert gpu.pools == [None, (0, 7)] and captured._steps == {kind: last}
    captured._steps["first"] = first  # made anew
    assert captured.graph(first, max) == (max, (0, 7))
    assert gpu.pools[2:] == [(0, 7)] and list(captured._steps.values()) == [last, first]


def test_memory_pool_without_graphs_is_not_reused(scenes, trainer, full_gpu, monkeypatch):
    """torch has forgotten it."""
    handles = ((0, number) for number in itertools.count(7))
    monkeypatch.setattr(torch.cuda, "graph_pool_handle", lambda: next(handles))
    captured = captured_loss(trainer)
    for batch in mixed_batches(scenes, 9):
        run(captured, batch.to(trainer.device), trainer)
    (_, first), (kind, last) = captured._steps.items()
    gpu = full_gpu(captured, lambda function, device, pool: pool)
    assert captured.graph(last, len) == (0, 7) and gpu.pools == [None, (0, 7)]
    assert captured.graph(last, len) == (0, 8)  # it was the only one
    captured._steps["first"] = first
    assert captured.graph(first, len) == (0, 8)


@pytest.mark.parametrize("out_of_memory, tries, match", [(True, 2, "lower batch, target_views or"), (False, 1, "^no$")])
def test_graph_that_does_not_fit_alone_is_refused(out_of_memory, tries, match, scenes, trainer, full_gpu, monkeypatch):
    def make(function, device, pool):
        raise CaptureError("no", out_of_memory=out_of_memory)

    monkeypatch.setattr(torch.cuda, "graph_pool_handle", lambda: (0, 7))
    captured = captured_loss(trainer)
    gpu = full_gpu(captured, make)
    with pytest.raises(CaptureError, match=match) as caught:
        captured.graph(None, len)
    assert caught.value.out_of_memory == out_of_memory and len(gpu.pools) == tries


class Ops(TorchDispatchMode):
    """Names of the ops that were called; those that index by a mask have another."""

    def __init__(self):
        super().__init__()
        self.names = set()

    def __torch_dispatch__(self, op, types, args=(), kwargs=None):
        masks = op.overloadpacket in (torch.ops.aten.index, torch.ops.aten.index_put) and any(
            index is not None and index.dtype == torch.bool for index in args[1]
        )
        self.names.add("index by a mask" if masks else op.overloadpacket.__name__)
        return op(*args, **(kwargs or {}))


@pytest.mark.parametrize(
    "row",
    [
        *("latent", "explicit", "no-tem", "background-masked", "background-dynamic", "calls-2", "relightable"),
        *("no-masks", "flying", "acting", "graph"),
    ],
)
def test_captured_ops_have_fixed_sizes(row, scenes, tmp_path):
    config = KINDS[row] if row in KINDS else changed(CONFIG, ROWS[row].change)
    trainer = Trainer(config, scenes, tmp_path)
    captured = captured_loss(trainer)
    run(captured, batches(scenes, 1)[0], trainer)
    (step,) = captured._steps.values()
    with Ops() as ops:
        step._given(StabilityReport())
    assert len(ops.names) > 50
    assert not ops.names & {"index by a mask", "nonzero", "masked_select", "unique_dim", "_unique2", "is_nonzero"}


def test_capacity_is_shared_between_kinds_of_steps(scenes, trainer, device):
    captured = captured_loss(trainer)
    run(captured, batches(scenes, 1)[0].to(device), trainer)
    ((clouds, most),) = captured.most.items()
    captured.most[clouds] = (most[0], *(size + 100 for size in most[1:]))
    longer = batches(scenes, 1, horizon=3)[0]
    run(captured, longer.to(device), trainer)
    step = list(captured._steps.values())[-1]
    assert captured.captures == 2 and len(step._capacities) == longer.n_future
    largest = captured.most[clouds][-1]
    assert largest >= most[-1] + 100
    assert all(capacity.sizes[-1] == math.ceil(captured_module.FACTOR * largest) for capacity in step._capacities)


def test_reserved_capacity_is_there_from_the_first_step(scenes, trainer, device):
    captured, other = captured_loss(trainer), captured_loss(trainer)
    small, large = (batch.to(device) for batch in batches(scenes, 2))
    run(other, large, trainer)
    ((clouds, most),) = other.most.items()
    other.most[clouds] = tuple(2 * size for size in most)
    other.most_particles = 2 * max(other.prepare(large).counts)
    captured.reserve(json.loads(json.dumps(other.needed)))
    assert captured.needed == other.needed
    loss = run(captured, small, trainer).loss.clone()
    (step,) = captured._steps.values()
    assert captured.captures == 1 and step.particles >= other.most_particles
    wanted = tuple(math.ceil(captured_module.FACTOR * size) for size in other.most[clouds])
    assert all(capacity.sizes == wanted for capacity in step._capacities)
    torch.testing.assert_close(loss, run(captured_loss(trainer), small, trainer).loss, rtol=1e-4, atol=0)


def test_sizes_that_fit_are_remembered(scenes, trainer, device, monkeypatch):
    small, large = (batch.to(device) for batch in batches(scenes, 2))
    other = captured_loss(trainer)
    run(other, large, trainer)
    ((clouds, needed),) = other.most.items()
    monkeypatch.setattr(captured_module, "FACTOR", 3.0)
    captured = captured_loss(trainer)
    captured.most_particles, captured.most_moving = other.most_particles, other.most_moving
    run(captured, small, trainer)
    assert captured.captures == 1 and any(a < b for a, b in zip(captured.most[clouds], needed, strict=True))
    run(captured, large, trainer)
    assert captured.captures == 1 and all(a >= b for a, b in zip(captured.most[clouds], needed, strict=True))


def test_margins_of_older_states_are_taken_off(trainer):
    captured = captured_loss(trainer)
    captured.reserve({"rows": 9, "moving": 3, "geometry": [[[0], [0, 1], [15, 31]]]})
    assert captured.most[(0,), (0, 1)] == (10, 21)


def test_capacity_grows_where_a_batch_needs_more(scenes, trainer, device):
    captured = captured_loss(trainer)
    batch = batches(scenes, 1)[0].to(device)
    loss = run(captured, batch, trainer).loss.clone()
    (step,) = captured._steps.values()
    step._capacities = [dataclasses.replace(c, sizes=(c.sizes[0], *(1 for _ in c.sizes[1:]))) for c in step._capacities]
    step._capture()  # a graph with room for next to nothing
    made = captured.captures
    torch.testing.assert_close(run(captured, batch, trainer).loss, loss, rtol=TOLERANCE[device.type], atol=0)
    assert captured.captures > made
    fewer = dataclasses.replace(batch.context, masks=batch.context.masks & ~batch.context.dynamic)
    captured = captured_loss(trainer)
    run(captured, dataclasses.replace(batch, context=fewer), trainer)
    (before,) = (step.particles for step in captured._steps.values())
    torch.testing.assert_close(run(captured, batch, trainer).loss, loss, rtol=TOLERANCE[device.type], atol=0)
    (after,) = (step.particles for step in captured._steps.values())
    assert max(captured.prepare(batch).counts) <= after and before <= after


def test_no_batch_is_prepared_while_weights_are_rounded(scenes, trainer, device):
    """Else its images would have another dtype than the network for as long as another thread captures."""
    captured, seen = captured_loss(trainer), []
    captured.alone, captured.meanwhile = threading.Lock(), seen.clear
    captured.precision = lambda part: torch.autocast(device.type, torch.bfloat16, enabled=part == "encoder")
    convolution = next(part for part in trainer.simulator.encoder.modules() if isinstance(part, torch.nn.Conv2d))
    convolution.register_forward_pre_hook(lambda *_: seen.append(captured.alone.locked()))
    batch = batches(scenes, 1)[0].to(device)
    run(captured, batch, trainer)
    (step,) = captured._steps.values()
    step._capacities = [dataclasses.replace(c, sizes=(c.sizes[0], *(1 for _ in c.sizes[1:]))) for c in step._capacities]
    step._capture()
    run(captured, batch, trainer)  # the next batch is prepared from the first replay on
    assert seen and all(seen)


def test_weights_are_read_anew(scenes, trainer, device):
    captured = captured_loss(trainer)
    batch = batches(scenes, 1)[0].to(device)
    once, twice = (run(captured, batch, trainer, factor=factor).loss.item() for factor in (1, 2))
    assert twice == pytest.approx(2 * once, rel=1e-5)
    with torch.no_grad():
        for parameter in trainer.simulator.encoder.parameters():
            parameter.mul_(0.9)
    other, _ = trainer.loss(batch)
    assert run(captured, batch, trainer).loss.item() == pytest.approx(other.item(), rel=TOLERANCE[device.type])
    assert abs(other.item() / once - 1) > 1e-4


def test_weights_that_are_rounded_at_once_change_no_bit(scenes, trainer, device, monkeypatch):
    batch, seen, found = batches(scenes, 1)[0].to(device), [], []
    convolution = next(part for part in trainer.simulator.encoder.modules() if isinstance(part, torch.nn.Conv2d))
    convolution.register_forward_pre_hook(lambda part, _: seen.append(part.weight.dtype))
    one_by_one = partial(torch.autocast, device.type, torch.bfloat16)
    for rounded in (captured_module._rounded, lambda _: nullcontext()):
        monkeypatch.setattr(captured_module, "_rounded", rounded)
        captured = captured_loss(trainer)
        captured.precision = lambda part: one_by_one(enabled=part == "encoder")
        with deterministic():
            found.append(run(captured, batch, trainer))
    assert {*seen[: len(seen) // 2]} == {torch.bfloat16} and {*seen[len(seen) // 2 :]} == {torch.float32}
    assert_same_bits(found[0].loss, found[1].loss)
    for name, *both in zip(trainer.parameters, *(result.parameters for result in found), strict=True):
        assert (both[0] is None) == (both[1] is None), name
        if both[0] is not None:
            assert_same_bits(*both, name)


def test_captured_training_equals_eager(scenes, tmp_path, device):
    if device.type != "cuda":
        pytest.skip("graphs need a GPU")
    for name, config in (("plain", CONFIG), ("captured", dataclasses.replace(CONFIG, captured=True))):
        Trainer(config, scenes, tmp_path / name, device="cuda").run(progress=False)
    plain, captured = (
        [json.loads(line)["loss"] for line in (tmp_path / name / "metrics.jsonl").read_text().splitlines()]
        for name in ("plain", "captured")
    )
    assert captured == pytest.approx(plain, rel=1e-3)


def test_actions_need_scenes_with_actors(tmp_path):
    plain = [Scene.open(folder) for folder in find_scenes(write_scenes(tmp_path / "plain", 1))]
    with pytest.raises(InputError, match="dynamics.actions is on, but no scene has actions"):
        Trainer(ACTING, plain, tmp_path / "run")


def test_capture_refuses_models_that_draw(scenes, trainer):
    config = trainer.simulator.config
    for changes in ({"drop_path": 0.1}, {"shuffle_orders": True}):
        trainer.simulator.config = dataclasses.replace(config, dynamics=dataclasses.replace(config.dynamics, **changes))
        with pytest.raises(InputError, match="drop_path 0, shuffle_orders false"):
            captured_loss(trainer)


def test_settings_that_do_not_fit_are_refused(scenes, tmp_path):
    with pytest.raises(InputError, match="captured: requires workers: 0"):
        Trainer(dataclasses.replace(CONFIG, captured=True, workers=2), scenes, tmp_path)
