"""Training runs side by side, a process each.

A small model's step leaves most of a GPU idle: it waits for the host, or for small kernels one after another. Several
runs fill the gaps.
"""

from __future__ import annotations

import json
import multiprocessing
import os
import threading
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from typing import Any

import torch

from gsim3d.errors import InputError
from gsim3d.train.log import LOG

TELL_EVERY = 20.0  # seconds


def side_by_side(
    function: Callable, jobs: Mapping[str, tuple], together: int, say: Callable[[str], None] | None = None
) -> Iterator[tuple[str, Any]]:
    """(name, function(*arguments)) of each of ``jobs`` when it is done; they begin in their order.

    Args:
        function: of a module, as a process that starts anew finds it there; its first argument is a run folder.
        together: jobs at a time, each in a process with its share of the cores; 1: here, one after another.
        say: is told what begins here, and now and then how far those in processes are.
    Raises:
        What a job raised, or InputError where a process was killed; the others are ended then, and go on from their
        last checkpoints when they are called again.
    """
    together = min(together, len(jobs))
    if together < 2:
        for name, arguments in jobs.items():
            if say is not None:
                say(name)
            yield name, function(*arguments)
        return
    n_threads = max(1, len(os.sched_getaffinity(0)) // together)
    context, over = multiprocessing.get_context("spawn"), threading.Event()
    pool = ProcessPoolExecutor(together, context, _begin, (n_threads,))
    names = {pool.submit(function, *arguments): name for name, arguments in jobs.items()}
    folders = {name: Path(arguments[0]) for name, arguments in jobs.items()}
    if say is not None:
        threading.Thread(target=_tell, args=(folders, over, say), daemon=True).start()
    try:
        for job in as_completed(names):
            folders.pop(names[job])
            yield names[job], job.result()
    except BrokenProcessPool:
        raise InputError(f"--together: one of {together} processes was killed; call again, with fewer") from None
    finally:
        over.set()
        for process in list((pool._processes or {}).values()):
            process.terminate()  # checkpoints are whole at any time
        pool.shutdown(wait=True, cancel_futures=True)


def last_entry(run: Path) -> dict:
    """What a run folder's log says last; empty where it says nothing."""
    try:
        return json.loads((run / LOG).read_text().splitlines()[-1])
    except (OSError, IndexError, ValueError):  # a line may be half written
        return {}


def _tell(folders: dict[str, Path], over: threading.Event, say: Callable[[str], None]) -> None:
    while not over.wait(TELL_EVERY):
        entries = [(name, last_entry(folder)) for name, folder in list(folders.items())]
        say(", ".join(f"{name} {_short(entry)}" for name, entry in entries if entry))


def _short(entry: dict) -> str:
    decibels = entry.get("future_psnr", entry.get("past_psnr"))
    known = f" {decibels:.1f} dB" if isinstance(decibels, float) else ""
    return f"{entry['step']}{known} {entry['machine']['step_seconds']:.2f} s"


def _begin(n_threads: int) -> None:
    torch.set_num_threads(n_threads)
    parent = multiprocessing.parent_process()  # if it is killed, nobody waits for this process
    threading.Thread(target=lambda: (parent.join(), os._exit(1)), daemon=True).start()
