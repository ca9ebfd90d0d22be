"""Runs inputs of a target in a child process with a limit of memory and time, and keeps those that fail."""

from __future__ import annotations

import dataclasses
import importlib
import json
import math
import mmap
import os
import pickle
import random
import resource
import shutil
import signal
import stat
import struct
import subprocess
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[3]
MEMORY = 2**30  # bytes that an input may take beyond what the process has
CEILING = 4 * MEMORY  # of address space: more is never given, so that the machine goes on
PATIENCE = 10.0  # seconds of processor time
WAITING = 3  # times as many seconds of the clock: on a busy machine a process gets a share
LARGE = 2**28  # bytes of a file
PROGRESS = struct.Struct("<qq")  # number of the job, number of the input
GROUPS = ("ops", "readers", "commands")  # modules of this package with TARGETS


@dataclass(frozen=True)
class Target:
    """Something to feed.

    make: (random numbers, an empty folder) -> the input, which can be pickled; the folder may be filled.
    call: the input -> nothing; raises what the call under test raises, and Failure where its result is not acceptable.
    expected: errors that are an answer.
    named: (error, input) -> whether the message names what is wrong.
    on_gpu: whether the call computes on a GPU.
    """

    name: str
    make: Callable[[random.Random, Path], Any]
    call: Callable[[Any, Path], None]
    expected: tuple[type[Exception], ...]
    named: Callable[[Exception, Any], bool] = lambda error, case: True
    on_gpu: bool = False


class Failure(Exception):
    """A result that is none: what is wrong with it."""


@dataclass
class Outcome:
    """answers: how many inputs were computed ("ok"), or refused, by the name of the error.   failures: one line and the
    file that reproduces it, each."""

    target: str
    count: int = 0
    answers: dict[str, int] = field(default_factory=dict)
    failures: list[tuple[str, Path]] = field(default_factory=list)

    def __str__(self) -> str:
        answers = ", ".join(f"{n} {name}" for name, n in sorted(self.answers.items()))
        lines = [f"{self.target}: {self.count} inputs, {answers or 'no answers'}, {len(self.failures)} failures"]
        for text, file in self.failures[:5]:
            lines += [f"  {text}", f"    again: python -m tests.stability.fuzz --replay {file}"]
        return "\n".join(lines)


def targets() -> dict[str, Target]:
    """All targets, by name; they are in the modules GROUPS. Names that start with _ are for tests of this engine."""
    found = {}
    for group in (*GROUPS, "misbehaving"):
        for target in importlib.import_module(f"tests.stability.fuzz.{group}").TARGETS:
            assert target.name not in found, target.name
            found[target.name] = target
    return found


def chosen(names: Sequence[str]) -> list[str]:
    """Names of targets, in order; a group stands for all of its targets on the CPU."""
    found = []
    for name in names:
        members = importlib.import_module(f"tests.stability.fuzz.{name}").TARGETS if name in GROUPS else []
        found += [target.name for target in members if not target.on_gpu] if members else [name]
    return found


def make_case(target: Target, seed: int, index: int, folder: Path) -> Any:
    return target.make(random.Random(f"{target.name}/{seed}/{index}"), folder)


def judge(target: Target, case: Any, folder: Path) -> tuple[str, str | None]:
    """(name of the answer, None), or (name of what came, what is wrong with that)."""
    try:
        target.call(case, folder)
    except Failure as failure:
        return "Failure", str(failure)
    except target.expected as error:
        if target.named(error, case):
            return type(error).__name__, None
        return type(error).__name__, f"{type(error).__name__} does not say what is wrong: {_line(error)}"
    except Exception as error:  # whatever a broken input brings about is what is looked for
        place = traceback.extract_tb(error.__traceback__)[-1]
        where = f"{Path(place.filename).name}:{place.lineno}"
        return type(error).__name__, f"{type(error).__name__} at {where}: {_line(error)}"
    return "ok", None


def _line(error: Exception) -> str:
    return " ".join(str(error).split())[:300]


class Peak:
    """The most memory that this process has had since it was made."""

    def __init__(self):
        Path("/proc/self/clear_refs").write_text("5")
        self.before = self._bytes("VmRSS")

    def extra(self) -> int:
        return self._bytes("VmHWM") - self.before

    def _bytes(self, name: str) -> int:
        lines = Path("/proc/self/status").read_text().splitlines()
        return 1024 * next(int(line.split()[1]) for line in lines if line.startswith(f"{name}:"))


def limit_memory(extra: int) -> None:
    """This process may take ``extra`` bytes of address space more than it has: what the libraries took when they were
    loaded does not count, and a thread's stack and arena do."""
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    limit = pages * resource.getpagesize() + extra
    resource.setrlimit(resource.RLIMIT_AS, (limit, limit))


def limit_memory_of_gpu(extra: int) -> None:
    """Limits what torch may take of the GPU. (Address space is no measure there: CUDA reserves all that it can map.)"""
    import torch

    torch.zeros(1, device="cuda")
    torch.cuda.set_per_process_memory_fraction(extra / torch.cuda.get_device_properties(0).total_memory)


def work(jobs: list[tuple[str, int, int]], seed: int, out: Path, seconds: float) -> None:
    """The child: inputs ``first`` to ``end - 1`` of each target (name, first, end) of ``jobs``, none after ``seconds``.

    ``out/progress`` holds the numbers of the job and of the input under way, ``out/answers.jsonl`` what came of others.
    """
    import cv2
    import torch

    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    known = targets()
    with open(out / "progress", "r+b") as file, open(out / "answers.jsonl", "a") as answers:
        progress = mmap.mmap(file.fileno(), PROGRESS.size)
        if any(known[name].on_gpu for name, _, _ in jobs):
            limit_memory_of_gpu(MEMORY)
        else:
            limit_memory(CEILING)
        for number, (name, first, end) in enumerate(jobs):
            target, end_of_job = known[name], time.monotonic() + seconds
            for index in range(first, end):
                if time.monotonic() > end_of_job:
                    break
                progress[:] = PROGRESS.pack(number, index)
                folder = out / "input"
                folder.mkdir()
                case = make_case(target, seed, index, folder)
                peak = Peak()
                answer, problem = judge(target, case, folder)
                if not target.on_gpu and (extra := peak.extra()) > MEMORY:
                    problem = f"takes {extra >> 20} MiB; {problem or answer}"
                if problem:
                    keep(name, seed, index, case, folder, out, problem)
                answers.write(json.dumps([name, index, answer, problem]) + "\n")
                answers.flush()
                shutil.rmtree(folder, ignore_errors=True)
        progress[:] = PROGRESS.pack(len(jobs), 0)


def keep(name: str, seed: int, index: int, case: Any, folder: Path, out: Path, problem: str) -> None:
    """Saves an input: its place in the sequence, its values and its files."""
    kept = out / "failures" / f"{name}-{index}"
    shutil.rmtree(kept, ignore_errors=True)
    shutil.copytree(folder, kept / "input", symlinks=True, copy_function=_copy)
    (kept / "case.pickle").write_bytes(pickle.dumps(case))
    (kept / "case.json").write_text(json.dumps({"target": name, "seed": seed, "index": index, "problem": problem}))


def _copy(source: str, target: str) -> None:
    """A file or pipe. Large files, all of which are of zeros, take no place on the disk."""
    found = os.stat(source)
    if stat.S_ISFIFO(found.st_mode):
        os.mkfifo(target)
    elif found.st_size > LARGE:
        Path(target).touch()
        os.truncate(target, found.st_size)
    else:
        shutil.copyfile(source, target)


def run(
    names: Sequence[str],
    count: int,
    seed: int = 0,
    out: Path | None = None,
    patience: float = PATIENCE,
    seconds: float = math.inf,
) -> list[Outcome]:
    """Feeds ``count`` inputs to each of the targets ``names``, in one child or, after a crash, the next.

    patience: seconds of processor time after which an input counts as hanging, or WAITING times as many of the clock.
    seconds: after which a target gets no further input.
    """
    out = Path(tempfile.mkdtemp(prefix="fuzz-")) if out is None else out
    out.mkdir(parents=True, exist_ok=True)
    (out / "answers.jsonl").unlink(missing_ok=True)
    outcomes = {name: Outcome(name) for name in names}
    jobs = [(name, 0, count) for name in names]
    while jobs:
        problem, number, index = _child(jobs, seed, out, patience, seconds)
        if problem is not None:
            name, _, end = jobs[number]
            _keep_again(name, seed, index, out, problem)
            with open(out / "answers.jsonl", "a") as answers:
                answers.write(json.dumps([name, index, "crash", problem]) + "\n")
            jobs = [(name, index + 1, end)] + jobs[number + 1 :]
            jobs = jobs if index + 1 < end else jobs[1:]
        else:
            jobs = []
    for line in (out / "answers.jsonl").read_text().splitlines():
        name, index, answer, problem = json.loads(line)
        outcome = outcomes[name]
        outcome.count += 1
        if problem:
            outcome.failures.append((f"input {index}: {problem}", out / "failures" / f"{name}-{index}"))
        else:
            outcome.answers[answer] = outcome.answers.get(answer, 0) + 1
    return list(outcomes.values())


def _child(
    jobs: list[tuple[str, int, int]], seed: int, out: Path, patience: float, seconds: float
) -> tuple[str | None, int, int]:
    """(what ended the child before it was done or None, number of the job, number of the input under way)."""
    shutil.rmtree(out / "input", ignore_errors=True)
    progress = out / "progress"
    progress.write_bytes(PROGRESS.pack(0, jobs[0][1]))
    code = "import json, sys; from pathlib import Path; from tests.stability.fuzz import engine; "
    code += "engine.work(json.loads(sys.argv[1]), int(sys.argv[2]), Path(sys.argv[3]), float(sys.argv[4]))"
    command = [sys.executable, "-c", code, json.dumps(jobs), str(seed), str(out), str(seconds)]
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "MALLOC_ARENA_MAX": "2", "PXR_WORK_THREAD_LIMIT": "1"}
    with open(out / "log", "wb") as log:
        child = subprocess.Popen(command, cwd=ROOT, env=environment, stderr=log, stdout=log)
    # The libraries take their time to load.
    place, since, used = progress.read_bytes(), time.monotonic() + 60, math.inf
    problem = None
    try:
        while child.poll() is None:
            time.sleep(0.02)
            if (now := progress.read_bytes()) != place:
                place, since, used = now, max(since, time.monotonic()), _processor_time(child.pid)
            elif time.monotonic() - since > WAITING * patience or _processor_time(child.pid) - used > patience:
                child.kill()
                child.wait()
                problem = f"hangs: no answer within {patience:g} s"
    finally:  # also where this process is stopped
        child.kill()
        child.wait()
    number, index = PROGRESS.unpack(progress.read_bytes())
    if number == len(jobs):
        return None, number, 0
    said = (out / "log").read_text(errors="replace").strip().splitlines()[-1:] or [""]
    if child.returncode > 0 and not (out / "input").exists():
        raise RuntimeError(f"the process ended with code {child.returncode} before it had an input: {said[0]}")
    if problem is None and child.returncode < 0:
        problem = f"the process was ended by {signal.Signals(-child.returncode).name}: {said[0][:200]}"
    return problem or f"the process ended with code {child.returncode}: {said[0][:200]}", number, index


def _processor_time(pid: int) -> float:
    """Seconds that a process has computed."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:  # it has ended
        return 0.0
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def _keep_again(name: str, seed: int, index: int, out: Path, problem: str) -> None:
    """Keeps the input that ended a child: makes it again."""
    folder = out / "input"
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    keep(name, seed, index, make_case(targets()[name], seed, index, folder), folder, out, problem)


def replay(kept: Path) -> tuple[str, str | None]:
    """A kept input once more, in this process, without limits; what ``judge`` says."""
    description = json.loads((kept / "case.json").read_text())
    target = targets()[description["target"]]
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place) / "input"
        shutil.copytree(kept / "input", folder, symlinks=True, copy_function=_copy)
        return judge(target, pickle.loads((kept / "case.pickle").read_bytes()), folder)


def finite(value: Any, what: str = "result") -> None:
    """Raises Failure where a floating-point tensor anywhere in ``value`` is not finite."""
    import torch

    if isinstance(value, torch.Tensor):
        if value.is_meta or not (value.is_floating_point() or value.is_complex()):
            return
        if not torch.isfinite(value).all():
            raise Failure(f"{what} is not finite, without an error or finding")
    elif isinstance(value, dict):
        for name, item in value.items():
            finite(item, f"{what}.{name}")
    elif isinstance(value, (tuple, list)):
        names = getattr(value, "_fields", range(len(value)))
        for name, item in zip(names, value, strict=True):
            finite(item, f"{what}[{name}]")
    elif dataclasses.is_dataclass(value):
        for item in dataclasses.fields(value):
            finite(getattr(value, item.name), f"{what}.{item.name}")
