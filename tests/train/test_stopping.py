"""Runs that are asked to end save first; runs whose launcher or partner is gone end with one line."""

import dataclasses
import os
import re
import signal
import subprocess
import sys
import termios
import time
from pathlib import Path

import pytest
import torch
import yaml

from gsim3d.cli import main as __main__
from gsim3d.errors import RunStopped
from gsim3d.io import checkpoint
from gsim3d.io.settings import to_dict
from gsim3d.train import stopping
from gsim3d.train.loop import Trainer
from gsim3d.train.processes import joined
from tests.tiny_scenes import write_scenes
from tests.train.test_loop import CONFIG, assert_same_checkpoint, curve, scenes
from tests.train.test_processes import LAYER
from tests.two_processes import free_port

pytestmark = pytest.mark.usefixtures("one_thread")

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGUSR1, signal.SIGHUP)


@pytest.fixture(autouse=True)
def heard():
    """No signal is ignored, as those of a terminal are in jobs of a shell's background; children inherit that."""
    handlers = [signal.default_int_handler, *[signal.SIG_DFL] * 3]
    before = {number: signal.signal(number, handler) for number, handler in zip(SIGNALS, handlers, strict=True)}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return write_scenes(tmp_path_factory.mktemp("scenes"), 2)


def signalled(trainer, at: int, number: int):
    """``trainer``, which gets a signal within step ``at``."""
    step = trainer.train_step

    def train_step():
        if trainer.step == at:
            os.kill(os.getpid(), number)
        return step()

    trainer.train_step = train_step
    return trainer


def test_signal_saves_and_resumed_run_equals_uninterrupted(folder, tmp_path, capfd):
    Trainer(CONFIG, scenes(folder), tmp_path / "whole").run(progress=False)
    before = [signal.getsignal(number) for number in SIGNALS]
    for step, number in enumerate(SIGNALS):
        trainer = signalled(Trainer(CONFIG, scenes(folder), tmp_path / "parts"), step, number)
        said = f"{number.name}: step {step + 1} of 6 is saved in .*; run the same command to resume"
        with pytest.raises(RunStopped, match=said) as stopped:
            trainer.run(progress=False)
        assert stopped.value.code == 128 + number
        assert checkpoint.load(tmp_path / "parts").state["step"] == step + 1
        assert f"{number.name}: stopping after this step" in capfd.readouterr().err
    assert [signal.getsignal(number) for number in SIGNALS] == before
    Trainer(CONFIG, scenes(folder), tmp_path / "parts").run(progress=False)
    assert curve(tmp_path / "parts") == curve(tmp_path / "whole")
    assert_same_checkpoint(tmp_path / "parts", tmp_path / "whole")


def test_ignored_signals_stay_ignored(folder, tmp_path):
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)  # as under nohup
    try:
        signalled(Trainer(CONFIG, scenes(folder), tmp_path), 0, signal.SIGHUP).run(until=2, progress=False)
    finally:
        signal.signal(signal.SIGHUP, before)
    assert checkpoint.load(tmp_path).state["step"] == 2


def test_run_saves_when_its_terminal_is_gone(folder, tmp_path):
    config, inner, outer = tmp_path / "train.yaml", *os.openpty()
    termios.tcsetwinsize(outer, (24, 80))
    endless = dataclasses.replace(CONFIG.phases[0], steps=100_000)
    config.write_text(yaml.safe_dump(to_dict(dataclasses.replace(CONFIG, phases=(endless,)))))
    command = [sys.executable, "-m", "gsim3d", "train", config, "--data", folder, "--out", tmp_path / "run"]
    run = subprocess.Popen(command, stdin=outer, stdout=outer, stderr=outer, start_new_session=True)
    os.close(outer)
    said = b""
    while not re.search(rb" [1-9]\d*/100000", said):  # the bar leaves steps out
        said += os.read(inner, 4096)
    os.close(inner)  # whatever is written from here on is an error
    run.send_signal(signal.SIGHUP)
    assert run.wait(timeout=60) == 128 + signal.SIGHUP
    assert checkpoint.load(tmp_path / "run").state["step"] > 0


def test_signal_in_last_step_raises_nothing(folder, tmp_path):
    signalled(Trainer(CONFIG, scenes(folder), tmp_path), 0, signal.SIGTERM).run(until=1, progress=False)
    assert checkpoint.load(tmp_path).state["step"] == 1


def test_exit_code_is_that_of_the_signal(folder, tmp_path, monkeypatch, capsys):
    config = tmp_path / "train.yaml"
    config.write_text(yaml.safe_dump(to_dict(CONFIG)))
    run = Trainer.run
    monkeypatch.setattr(Trainer, "run", lambda self, **options: run(signalled(self, 1, signal.SIGTERM), **options))
    command = ["train", str(config), "--data", str(folder), "--out", str(tmp_path / "run")]
    assert __main__.main(command) == 128 + signal.SIGTERM
    assert capsys.readouterr().err.splitlines()[-1].startswith("gsim3d: error: SIGTERM: step 2 of 6 is saved in ")


NO_ROOM = {
    "gpu": torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 3 GiB.\nmore lines"),
    "cpu": RuntimeError("[enforce fail at alloc_cpu.cpp:126] DefaultCPUAllocator: can't allocate memory: you tried"),
    "cublas": RuntimeError("CUDA error: CUBLAS_STATUS_ALLOC_FAILED when calling `cublasCreate(handle)`"),
    "python": MemoryError(),
}


@pytest.mark.parametrize("name", NO_ROOM)
@pytest.mark.parametrize("place", ["train_step", "__init__"])
def test_out_of_memory_is_one_line(folder, tmp_path, monkeypatch, capsys, name, place):
    def full(*_, **__):
        raise NO_ROOM[name]

    config = tmp_path / "train.yaml"
    config.write_text(yaml.safe_dump(to_dict(CONFIG)))
    monkeypatch.setattr(Trainer, place, full)
    command = ["train", str(config), "--data", str(folder), "--out", str(tmp_path / "run")]
    assert __main__.main(command) == 2
    said = capsys.readouterr().err.strip().splitlines()[-1]
    assert said.startswith("gsim3d: error: ") and "out of memory" in said and len(said) < 500
    assert ("step 0: " in said and "reduce batch" in said) == (place == "train_step")


def test_other_errors_of_torch_are_not_hidden(monkeypatch):
    module = type(sys)("broken")
    module.add_arguments, module.run = lambda parser: None, lambda args: torch.zeros(2) @ torch.zeros(3)
    monkeypatch.setitem(sys.modules, "broken", module)
    monkeypatch.setitem(__main__.COMMANDS, "broken", ("broken", ""))
    with pytest.raises(RuntimeError, match="inconsistent tensor size"):
        __main__.main(["broken"])


def test_broken_log_lines_are_cut(folder, tmp_path):
    trainer = Trainer(CONFIG, scenes(folder), tmp_path)
    trainer.run(until=3, progress=False)
    log = tmp_path / "metrics.jsonl"
    first, second, third = log.read_bytes().splitlines(keepends=True)
    deep = b"[" * 100_000
    for wrong in (b"\xff\xfe\x00", b"[1]", b'{"step": "two"}', b'{"step": NaN}', deep, b'"text"', b""):
        log.write_bytes(first + wrong + b"\n" + second + third + b'{"step": 3')
        trainer = Trainer(CONFIG, scenes(folder), tmp_path)
        assert log.read_bytes() == first + second + third
    trainer.run(progress=False)
    assert [line["step"] for line in curve(tmp_path)] == list(range(6))


def endless(out: str, folder: str = "") -> int:
    """A run that ends if another process, its launcher or a signal ends it; with a folder it trains."""
    stopping.INTERVAL, stopping.SILENCE, stopping.GRACE = 0.1, 2.0, 20.0 if folder else 0.5

    def work(_args):
        torch.set_num_threads(1)
        with joined("cpu") as processes:
            place = Path(out) / f"pid_{processes.rank}"
            if folder:
                trainer = Trainer(LAYER, scenes(folder), Path(out) / "run", processes=processes)
                step = trainer.train_step

                def slow_step():
                    place.write_text(f"{os.getpid()} ")
                    time.sleep(2)
                    return step()

                trainer.train_step = slow_step
                trainer.run(progress=False)
            place.write_text(f"{os.getpid()} ")
            while True:
                processes.gather(time.sleep(0.01))

    module = type(sys)("endless")
    module.add_arguments, module.run = lambda parser: None, work
    sys.modules["endless"] = module
    __main__.COMMANDS["endless"] = ("endless", "")
    return __main__.main(["endless"])


def started(out: Path, *arguments: str, launcher: bool) -> tuple[list[subprocess.Popen], list[int]]:
    """Those processes that this one started, and the ids of two that work together; their output goes to out/log_*."""
    script = out / "endless.py"
    call = f"endless{(str(out), *arguments)}"
    script.write_text(f"import sys; from tests.train.test_stopping import endless; sys.exit({call})")
    environment = {**os.environ, "PYTHONPATH": os.getcwd(), "OMP_NUM_THREADS": "1"}
    command = [sys.executable, str(script)]
    environments = [environment]
    if launcher:
        command[1:1] = ["-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2"]
    else:
        place = {"WORLD_SIZE": "2", "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(free_port())}
        environments = [{**environment, **place, "RANK": str(rank)} for rank in range(2)]
    running = []
    for i, environment in enumerate(environments):
        with open(out / f"log_{i}", "w") as log:
            running.append(subprocess.Popen(command, env=environment, stdout=log, stderr=log))
    files = [out / f"pid_{rank}" for rank in range(2)]
    for _ in range(600):
        if all(file.exists() and file.read_text().endswith(" ") for file in files):
            return running, [int(file.read_text()) for file in files]
        assert all(process.poll() is None for process in running), (out / "log_0").read_text()
        time.sleep(0.1)
    raise AssertionError("the processes did not start")


def is_running(process: int) -> bool:
    try:
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] not in "ZX"
    except OSError:
        return False


@pytest.mark.parametrize(("gone", "signal_of_one"), [(0, signal.SIGSTOP), (1, signal.SIGKILL)])
def test_process_without_partner_ends_with_one_line(tmp_path, gone, signal_of_one):
    running, _ = started(tmp_path, launcher=False)
    try:
        running[gone].send_signal(signal_of_one)
        assert running[1 - gone].wait(timeout=60) == 2
    finally:
        for process in running:
            process.kill()
            process.wait()
    said = (tmp_path / f"log_{1 - gone}").read_text().strip()
    assert said.count("\n") == 0
    assert said.startswith(
        f"gsim3d: error: process {gone} of this run has ended or does not answer; run the command again"
    )


def test_signal_of_one_process_stops_all(folder, tmp_path):
    running, _ = started(tmp_path, str(folder), launcher=False)
    running[1].send_signal(signal.SIGUSR1)
    assert [process.wait(timeout=60) for process in running] == [128 + signal.SIGUSR1] * 2
    step = checkpoint.load(tmp_path / "run").state["step"]
    assert 1 <= step < LAYER.n_steps
    assert f"SIGUSR1: step {step} of {LAYER.n_steps} is saved" in (tmp_path / "log_0").read_text()


def test_run_without_launcher_saves_and_ends(folder, tmp_path):
    (launcher,), workers = started(tmp_path, str(folder), launcher=True)
    launcher.kill()
    launcher.wait()
    try:
        for _ in range(600):
            if not any(map(is_running, workers)):
                break
            time.sleep(0.1)
        assert not any(map(is_running, workers))
    finally:
        for worker in filter(is_running, workers):
            os.kill(worker, signal.SIGKILL)
    said = (tmp_path / "log_0").read_text()
    assert "Traceback" not in said
    step = checkpoint.load(tmp_path / "run").state["step"]
    assert 1 <= step < LAYER.n_steps
    assert said.count(f"gsim3d: error: the launcher of this run (torchrun) has ended: step {step} of ") == 2
