"""Steps from a graph: on the CPU the same sums call by call, with the sizes that a graph would have."""

import dataclasses

import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode

from gsim3d.ablate.rows import ROWS
from gsim3d.data import Scene, find_scenes
from gsim3d.errors import InputError
from gsim3d.stability import StabilityReport
from gsim3d.train.captured import CapturedLoss
from gsim3d.train.config import DataConfig, StageConfig, TrainConfig
from gsim3d.train.loop import Trainer
from gsim3d.train.samples import draw_batch
from tests.asserts import assert_close_relative_to_max
from tests.tiny_scenes import write_scenes

pytestmark = pytest.mark.usefixtures("one_thread")

CONFIG = TrainConfig(
    stages=(StageConfig(steps=9, horizon=2, batch=2, target_views=2),),
    data=DataConfig(history=2, context_views=2, background_stride=2),
)


# A GPU picks its matrix products by the number of rows, which padding changes.
TOLERANCE = {"cpu": 1e-4, "cuda": 1e-3}


@pytest.fixture(scope="module")
def scenes(tmp_path_factory):
    return [Scene.open(path) for path in find_scenes(write_scenes(tmp_path_factory.mktemp("scenes"), 2))]


KINDS = {"latent": CONFIG, **{name: ROWS[name].change(CONFIG) for name in ("explicit", "background-masked")}}


@pytest.fixture(params=["latent"])
def trainer(scenes, tmp_path, device, request):
    trainer = Trainer(KINDS[request.param], scenes, tmp_path, device=device.type)
    with torch.no_grad():
        for parameter in trainer.simulator.dynamics.net.head.parameters():
            parameter.normal_(0, 0.02, generator=torch.Generator(parameter.device).manual_seed(0))
    return trainer


def captured_loss(trainer):
    return CapturedLoss(
        trainer.simulator, trainer.plan, trainer.loss_of_images, lambda part: torch.autocast("cpu", enabled=False)
    )


def batches(scenes, count, lead=0):
    stage = dataclasses.replace(CONFIG.stages[0], lead=lead)
    return [draw_batch(scenes, CONFIG.data, stage, 0, step, [0, 1]) for step in range(count)]


@pytest.mark.parametrize(
    "lead, trainer", [(0, "latent"), (2, "latent"), (0, "explicit"), (2, "background-masked")], indirect=["trainer"]
)
def test_gradients_are_those_of_the_loss(lead, scenes, trainer, device):
    captured, report = captured_loss(trainer), StabilityReport()
    drawn = batches(scenes, 4, lead)
    assert {batch.n_lead for batch in drawn} == {0, lead}
    for batch in drawn:
        batch = batch.to(device)
        loss, errors = trainer.loss(batch)
        expected = torch.autograd.grad(loss, list(trainer.parameters.values()), allow_unused=True)
        loss = loss.detach()  # a capture waits for the stream of every graph that is kept
        particles = trainer.simulator.encode(batch.context)
        later = captured(particles, batch, trainer.step_weights(batch), report)
        encoder = list(trainer.simulator.encoder.parameters())
        outputs = [getattr(particles, name) for name in later.particles]
        of_encoder = torch.autograd.grad(outputs, encoder, list(later.particles.values()), allow_unused=True)
        actual = dict(zip([*encoder, *captured.parameters], [*of_encoder, *later.parameters], strict=True))
        assert_close_relative_to_max(later.loss, loss.detach(), 0.1 * TOLERANCE[device.type])
        assert_close_relative_to_max(later.errors, errors, 0.1 * TOLERANCE[device.type])
        largest = max(gradient.abs().max() for gradient in expected if gradient is not None)
        for (name, parameter), gradient in zip(trainer.parameters.items(), expected, strict=True):
            assert (actual[parameter] is None) == (gradient is None), name
            if gradient is not None:
                assert (actual[parameter] - gradient).abs().max() <= TOLERANCE[device.type] * largest, name
    assert captured.captures >= 1 and not report.total


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


@pytest.mark.parametrize("row", ["latent", "explicit", "no-tem", "background-masked", "background-dynamic", "calls-2"])
def test_nothing_in_a_graph_has_a_size_that_depends_on_numbers(row, scenes, tmp_path):
    config = ROWS[row].change(CONFIG)
    trainer = Trainer(config, scenes, tmp_path)
    captured, batch = captured_loss(trainer), batches(scenes, 1)[0]
    particles = trainer.simulator.encode(batch.context)
    captured(particles, batch, trainer.step_weights(batch), StabilityReport())
    (step,) = captured._steps.values()
    with Ops() as ops:
        step._given(StabilityReport())
    assert len(ops.names) > 50
    assert not ops.names & {"index by a mask", "nonzero", "masked_select", "unique_dim", "_unique2", "is_nonzero"}


def test_what_needs_more_room_gets_it(scenes, trainer, device):
    captured, report = captured_loss(trainer), StabilityReport()
    batch = batches(scenes, 1)[0].to(device)
    particles, weights = trainer.simulator.encode(batch.context), trainer.step_weights(batch)
    first = captured(particles, batch, weights, report)
    loss = first.loss.clone()
    near = dataclasses.replace(particles, means=particles.means * 0.01)
    captured(near, batch, weights, report)  # few cells, then many
    (step,) = captured._steps.values()
    step._capacities = [dataclasses.replace(c, sizes=(c.sizes[0], *(1 for _ in c.sizes[1:]))) for c in step._capacities]
    step._capture()  # a graph with room for next to nothing
    made = captured.captures
    again = captured(particles, batch, weights, report)
    torch.testing.assert_close(again.loss, loss, rtol=TOLERANCE[device.type], atol=0)
    assert captured.captures > made


def test_weights_are_read_anew(scenes, trainer, device):
    captured, report = captured_loss(trainer), StabilityReport()
    batch = batches(scenes, 1)[0].to(device)
    particles, weights = trainer.simulator.encode(batch.context), trainer.step_weights(batch)
    once, twice = (captured(particles, batch, factor * weights, report).loss.item() for factor in (1, 2))
    assert twice == pytest.approx(2 * once, rel=1e-5)


def test_training_from_graphs_is_training(scenes, tmp_path, device):
    if device.type != "cuda":
        pytest.skip("graphs need a GPU")
    for name, config in (("plain", CONFIG), ("captured", dataclasses.replace(CONFIG, captured=True))):
        Trainer(config, scenes, tmp_path / name, device="cuda").run(progress=False)
    import json

    plain, captured = (
        [json.loads(line)["loss"] for line in (tmp_path / name / "metrics.jsonl").read_text().splitlines()]
        for name in ("plain", "captured")
    )
    assert captured == pytest.approx(plain, rel=1e-3)


def test_models_that_draw_are_refused(scenes, trainer):
    config = trainer.simulator.config
    for changes in ({"drop_path": 0.1}, {"shuffle_orders": True}):
        trainer.simulator.config = dataclasses.replace(config, dynamics=dataclasses.replace(config.dynamics, **changes))
        with pytest.raises(InputError, match="drop_path 0, shuffle_orders false"):
            captured_loss(trainer)


@pytest.mark.parametrize("changes", [{"workers": 2}, {"recompute": ("steps",)}])
def test_settings_that_do_not_fit_are_refused(scenes, tmp_path, changes):
    with pytest.raises(InputError, match="captured"):
        Trainer(dataclasses.replace(CONFIG, captured=True, **changes), scenes, tmp_path)
