"""Several processes: the curve of one for the same batches, exact resuming, and a skip of one is a skip of all."""

import dataclasses
import json
import math
import os
import subprocess
import sys
import weakref
from pathlib import Path

import pytest
import torch
import torch.distributed as dist
import yaml
from torch.nn.parallel import DistributedDataParallel

from gsim3d.errors import InputError
from gsim3d.io import checkpoint
from gsim3d.io.settings import to_dict
from gsim3d.nn.layers import RowBatchNorm
from gsim3d.train.config import PhaseConfig, TrainConfig
from gsim3d.train.loop import Trainer
from gsim3d.train.processes import Processes, joined
from gsim3d.train.restore import build_simulator, model_config
from tests.asserts import assert_close_relative_to_max
from tests.tiny_scenes import write_scenes
from tests.train.test_loop import CONFIG, assert_same_checkpoint, curve, scenes
from tests.train.test_watch import spoil
from tests.two_processes import run_in_two_processes

pytestmark = pytest.mark.usefixtures("one_thread")

STAGES = (
    PhaseConfig(steps=2, history=1, batch=2, target_views=2, learning_rate=1e-4),
    PhaseConfig(steps=2, horizon=2, batch=2, target_views=2, learning_rate=1e-4),
)
LAYER = dataclasses.replace(CONFIG, phases=STAGES)
BATCH = dataclasses.replace(LAYER, model={"dynamics": {"norm": "batch", "zero_init": False}}, recompute=("steps",))
UNEVEN = dataclasses.replace(LAYER, phases=(dataclasses.replace(STAGES[1], batch=3),))
RUNS = {"layer": LAYER, "batch": BATCH, "uneven": UNEVEN, "captured": UNEVEN}
# float32: a batch is added in another order, and AdamW turns a gradient near zero into a step of full size. Relative;
# worst on an AMD EPYC: loss 3e-7, norms 8e-6, distance of the weights over the way they went 3e-4.
TOLERANCE = {"loss": 1e-5, "grad_norm": 1e-4, "grad_norm_by_module": 1e-4, "grad_norm_by_step": 1e-4, "weights": 0.01}


def trainer_of(name: str, config: TrainConfig, folder, out: Path, processes: Processes | None = None) -> Trainer:
    trainer = Trainer(config, scenes(folder), out, processes=processes)
    if name == "captured":  # which without a GPU computes call by call
        trainer.captured = trainer._capture()
    return trainer


def train_together(rank: int, folder: str, out: str) -> None:
    """What each of two processes does."""
    torch.set_num_threads(1)
    out = Path(out)
    with joined("cpu") as processes:
        assert processes.rank == rank
        for name, config in RUNS.items():
            trainer_of(name, config, folder, out / name, processes).run(progress=False)
        for until in (3, None):
            trainer = Trainer(LAYER, scenes(folder), out / "parts", processes=processes)
            trainer.run(until=until, progress=False)
        trainer = Trainer(LAYER, scenes(folder), out / "skips", processes=processes)
        if rank == 1:
            spoil(trainer, [1])
            encode = trainer.simulator.encode

            def broken(frames, **options):
                particles = encode(frames, **options)
                wrong = particles.opacities * (math.nan if trainer.step == 2 else 1)
                return dataclasses.replace(particles, opacities=wrong)

            trainer.simulator.encode = broken
        trainer.run(progress=False)
        torch.save(normalised(slice(rank, None, 2)), out / f"rows_{rank}.pt")
        state = {name: value.double().sum().item() for name, value in trainer.simulator.state_dict().items()}
        assert processes.gather(state)[0] == state
        with pytest.raises(InputError, match="CONFIG: differs between the processes"):
            Trainer(dataclasses.replace(LAYER, seed=rank), scenes(folder), out / "other", processes=processes)


def normalised(part: slice) -> list[torch.Tensor]:
    """Of some of 31 rows: what batch normalisation makes of them in training, gradients and running statistics."""
    torch.manual_seed(0)
    layer, x = RowBatchNorm(5).double(), torch.randn(31, 5, dtype=torch.float64)
    torch.nn.init.normal_(layer.weight), torch.nn.init.normal_(layer.bias)
    x = x[part].requires_grad_()
    out = layer.activated_in_training(x)
    gradients = torch.autograd.grad(out.sin().sum(), [x, layer.weight, layer.bias])
    return [out.detach(), *gradients, layer.running_mean, layer.running_var]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return write_scenes(tmp_path_factory.mktemp("scenes"), 2)


@pytest.fixture(scope="module")
def together(folder, tmp_path_factory):
    out = tmp_path_factory.mktemp("together")
    run_in_two_processes(train_together, folder, out)
    return out


@pytest.mark.parametrize("name", RUNS)
def test_curve_of_two_processes_equals_curve_of_one(folder, together, tmp_path, name):
    trainer_of(name, RUNS[name], folder, tmp_path).run(progress=False)
    alone, two = curve(tmp_path), curve(together / name)
    assert len(alone) == len(two) == RUNS[name].n_steps
    for a, b in zip(alone, two, strict=True):
        assert a.keys() == b.keys() and a["particles"] == b["particles"]
        for key, tolerance in TOLERANCE.items():
            if key in a:
                assert b[key] == pytest.approx(a[key], rel=tolerance), (a["step"], key)
    start = build_simulator(model_config(RUNS[name]), RUNS[name].seed).state_dict()
    alone, two = (checkpoint.load(run).model for run in (tmp_path, together / name))
    moved, apart = (
        sum((a[key] - b[key]).double().square().sum() for key in a) for a, b in ((alone, start), (alone, two))
    )
    assert (apart / moved).sqrt() < TOLERANCE["weights"]


def test_batch_norm_counts_rows_of_all_processes(together):
    out, x, weight, bias, *running = normalised(slice(None))
    parts = [torch.load(together / f"rows_{rank}.pt", weights_only=True) for rank in range(2)]
    for rank, part in enumerate(parts):
        for ours, all_rows in zip(part[:2], (out, x), strict=True):
            assert_close_relative_to_max(ours, all_rows[rank::2], 1e-13)
        for ours, of_all in zip(part[4:], running, strict=True):
            assert_close_relative_to_max(ours, of_all, 1e-13)
    for k, whole in ((2, weight), (3, bias)):
        assert_close_relative_to_max(parts[0][k] + parts[1][k], whole, 1e-13)


def test_two_processes_resume_exactly(together):
    assert curve(together / "parts") == curve(together / "layer")
    assert_same_checkpoint(together / "parts", together / "layer")


def test_unusable_step_of_one_process_is_skipped_by_all(together):
    log = curve(together / "skips")
    assert log[1]["skipped"] == "the loss is not finite"
    assert log[2]["skipped"].startswith("process 1: ") and "particles.opacities" in log[2]["skipped"]
    assert "skipped" not in log[0] and "skipped" not in log[3] and math.isfinite(log[3]["loss"])
    assert checkpoint.load(together / "skips").state["n_skipped"] == 2


def test_torchrun_starts_the_command(folder, together, tmp_path):
    config = tmp_path / "train.yaml"
    config.write_text(yaml.safe_dump(to_dict(dataclasses.replace(LAYER, phases=STAGES[:1]))))
    command = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2", "-m", "gsim3d"]
    command += ["train", str(config), "--data", str(folder), "--out", str(tmp_path / "run")]
    environment = {**os.environ, "PYTHONPATH": os.getcwd(), "OMP_NUM_THREADS": "1"}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("trained to step 2 of 2") == 1
    lines = [json.loads(line) for line in (tmp_path / "run" / "metrics.jsonl").read_text().splitlines()]
    assert [line["step"] for line in lines] == [0, 1]


def test_shares_cover_the_batch():
    for count in (1, 2, 3, 5):
        shares = [Processes(rank, count).share(7) for rank in range(count)]
        assert sum(shares, []) == list(range(7)) and max(map(len, shares)) - min(map(len, shares)) <= 1


def test_batches_that_cannot_be_shared_are_refused(folder, tmp_path):
    with pytest.raises(InputError, match=r"phases\[0\].batch: must be at least the 3 processes; got 2"):
        Trainer(LAYER, scenes(folder), tmp_path, processes=Processes(0, 3))
    with pytest.raises(InputError, match="workers: must be 0 with 2 processes"):
        Trainer(dataclasses.replace(LAYER, workers=2), scenes(folder), tmp_path, processes=Processes(0, 2))


def leave(rank: int) -> None:
    with joined("cpu"):
        group = weakref.ref(dist.group.WORLD)
        DistributedDataParallel(torch.nn.Linear(1, 1), process_group=dist.new_group())
    assert group() is None


def test_process_group_threads_end_before_python():
    run_in_two_processes(leave)
