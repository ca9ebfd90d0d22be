"""Runs of two processes: one clock, one state, the weights of one process with both batches."""

import dataclasses
import math
import time
from itertools import count
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from gsim3d.errors import InputError, NumericalError
from gsim3d.train.loop import deterministic
from gsim3d.train.processes import Processes, joined
from gsim3d.train.restore import build_simulator, model_config
from tests.tools.test_release_state import CONFIG, NAME, Painted
from tests.two_processes import run_in_two_processes
from tools.release import runs
from tools.release.runs import RunTrainer, train
from tools.release.state import Progress, load_progress
from tools.release.trajectories import QUEUED, DataWorkers, TrajectoryStore

pytestmark = pytest.mark.usefixtures("one_thread")

STEPS = 4  # of both kinds


def trainer_in(out, config=CONFIG, processes=None) -> RunTrainer:
    """Computes as a graph does, call by call."""
    store = TrajectoryStore(Painted(), 2, "cpu")
    for seed in range(2):
        store.put(**Painted().trajectory(seed))
    trainer = RunTrainer(config, store, out, "cpu", processes)
    trainer.captured = trainer._capture()
    return trainer


def steps_of(trainer: RunTrainer) -> tuple[list[dict], dict[str, torch.Tensor]]:
    trainer.begin_run(time.monotonic() + 1e4)
    with deterministic():
        return [trainer.train_step() for _ in range(STEPS)], trainer.simulator.state_dict()


def run_together(rank: int, out: str) -> None:
    """What each of two processes does. A second passes whenever the clock is read; that of the second one is wrong."""
    torch.set_num_threads(1)
    out = Path(out)
    with joined("cpu") as processes:
        torch.save(steps_of(trainer_in(out / f"run_{rank}", processes=processes)), out / f"steps_{rank}.pt")

        clock, end = (count(), 6.0) if rank == 0 else (count(1000), 0.0)
        runs.time = SimpleNamespace(monotonic=clock.__next__, perf_counter=time.perf_counter)
        runs.SAVE_EVERY, saved, save = 2.0, [], runs.save_state
        runs.save_state = lambda *given: saved.append(save(*given).step)
        trainer = trainer_in(out / f"run_of_{rank}", processes=processes)
        workers = SimpleNamespace(count=2 + rank, next=7 + 2 * rank, check=lambda: None)
        train(trainer, workers, Progress(), {}, end=end, out=out / "state", name=NAME, say=lambda _: None)
        assert trainer.step == 5 and saved == ([3, 5] if rank == 0 else [])

        if rank == 1:
            trainer.captured.prepare = broken
        trainer._next = None
        assert trainer.train_step()["skipped"] == "process 1: broken" and trainer.n_skipped == 1
        if rank == 1:
            next(trainer.simulator.parameters()).data.mul_(1 + 1e-6)
        with pytest.raises(InputError, match="weights: differs between the processes"):
            trainer.begin_run(math.inf)


def broken(*_):
    raise NumericalError("broken")


@pytest.fixture(scope="module")
def together(tmp_path_factory):
    out = tmp_path_factory.mktemp("together")
    run_in_two_processes(run_together, out)
    return out


def test_two_processes_equal_one_with_twice_the_batch(together, tmp_path):
    (first, weights), (second, others) = (torch.load(together / f"steps_{rank}.pt") for rank in range(2))
    assert first == second and all(torch.equal(weights[name], others[name]) for name in weights)
    doubled = tuple(dataclasses.replace(phase, batch=2 * phase.batch) for phase in CONFIG.phases)
    alone, expected = steps_of(trainer_in(tmp_path, dataclasses.replace(CONFIG, phases=doubled)))
    for a, b in zip(alone, first, strict=True):
        assert a.keys() == b.keys() and a["particles"] == b["particles"]
        assert b["loss"] == pytest.approx(a["loss"], rel=1e-5)
        assert b["grad_norm"] == pytest.approx(a["grad_norm"], rel=1e-4)
    start = build_simulator(model_config(CONFIG), CONFIG.seed).state_dict()
    moved, apart = (
        sum((a[name] - b[name]).double().square().sum() for name in a)
        for a, b in ((expected, start), (expected, weights))
    )
    assert (apart / moved).sqrt() < 0.01


def test_state_counts_trajectories_of_all_processes(together):
    progress = load_progress(together / "state", NAME)
    assert progress.next_trajectory == 9 and progress.runs[0]["trajectories"] == 5
    assert len(list((together / "state").glob("*.safetensors"))) == 2 and len(progress.curve) == progress.step
    assert not (together / "run_of_1" / "metrics.jsonl").exists()


@pytest.mark.parametrize("n_processes", [1, 2, 4, 5])
def test_data_workers_share_trajectories_and_make_all_objects(n_processes, tmp_path):
    names, first, n = "abcd", 5, 400
    world, job, known = SimpleNamespace(object_names=lambda: [*names]), SimpleNamespace(add_done_callback=id), []
    for rank in range(n_processes):
        workers = DataWorkers(world, None, first, n // QUEUED, tmp_path, Processes(rank, n_processes))
        files = []
        workers._pool = SimpleNamespace(submit=lambda *given: files.append(given[-1]) or job)
        workers._begin()
        numbers = [int(Path(file).stem) for file in files]
        assert len({number % len(names) for number in numbers}) == len(names)
        assert workers.next == first + n * n_processes
        known += numbers
    assert sorted(known) == list(range(first, first + n * n_processes))
