"""Training runs side by side, a process each.

A small model's step leaves most of a GPU idle: it waits for the host, or for small kernels one after another. Several
runs fill the gaps.
"""

from __future__ import annotations

import multiprocessing
import os
import threading
import traceback
from collections.abc import Callable, Iterator, Mapping
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any

import torch

from gsim3d.errors import InputError
from gsim3d.train.log import LOG, read_entry

TELL_EVERY = 20.0  # seconds


def side_by_side(
    function: Callable, jobs: Mapping[str, tuple], together: int, say: Callable[[str], None] | None = None
) -> Iterator[tuple[str, Any]]:
    """(name, function(*arguments)) of each of ``jobs`` when it is done; they begin in their order.

    Args:
        function: of a module, as a process that starts anew finds it there; its first argument is a run folder.
        together: jobs at a time, each in a process with its share of the cores, on one GPU after another; 1: here.
        say: is told what begins here, and now and then how far those in processes are.
    Raises:
        What a job raised, or InputError where its process was killed; the others are ended then, and go on from their
        last checkpoints when they are called again.
    """
    together = min(together, len(jobs))
    if together < 2:
        for name, arguments in jobs.items():
            if say is not None:
                say(name)
            yield name, function(*arguments)
        return
    context, n_threads = multiprocessing.get_context("spawn"), max(1, len(os.sched_getaffinity(0)) // together)
    waiting, running, places = list(jobs), {}, list(range(together))
    try:
        while waiting or running:
            while waiting and places:
                name, place = waiting.pop(0), places.pop(0)
                receiver, sender = context.Pipe(duplex=False)
                process = context.Process(
                    target=_work, args=(sender, place, n_threads, function, jobs[name]), daemon=True
                )
                process.start()
                sender.close()
                running[receiver] = name, process, place
            ready = wait(list(running), TELL_EVERY)
            told = "" if ready else _progress({name: jobs[name][0] for name, *_ in running.values()})
            if told and say is not None:
                say(told)
            for receiver in ready:
                name, process, place = running.pop(receiver)
                try:
                    result, error = receiver.recv()
                except EOFError:
                    raise InputError(f"{name}: its process was killed; call again, with fewer --together") from None
                process.join()
                places.append(place)
                if error is not None:
                    raise error
                yield name, result
    finally:
        for _, process, _ in running.values():
            process.terminate()  # checkpoints are whole at any time
            process.join()


def _work(sender: Connection, place: int, n_threads: int, function: Callable, arguments: tuple) -> None:
    torch.set_num_threads(n_threads)
    if torch.cuda.is_available():
        torch.cuda.set_device(place % torch.cuda.device_count())
    parent = multiprocessing.parent_process()  # if it is killed, nobody waits for this process
    threading.Thread(target=lambda: (parent.join(), os._exit(1)), daemon=True).start()
    try:
        sender.send((function(*arguments), None))
    except Exception as error:
        error.add_note(traceback.format_exc())
        sender.send((None, error))


def last_entry(run: Path) -> dict:
    """What a run folder's log says last; empty where it says nothing."""
    try:
        return read_entry((run / LOG).read_bytes().splitlines()[-1]) or {}
    except (OSError, IndexError):
        return {}


def _progress(folders: dict[str, Path]) -> str:
    entries = {name: last_entry(folder) for name, folder in folders.items()}
    return ", ".join(f"{name}: {_short(entry)}" for name, entry in entries.items() if entry)


def _short(entry: dict) -> str:
    decibels = entry.get("future_psnr", entry.get("past_psnr"))
    known = f" {decibels:.1f} dB" if isinstance(decibels, float) else ""
    return f"step {entry['step']}{known} {entry['machine']['step_seconds']:.2f} s"
