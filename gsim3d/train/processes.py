"""Distributed training: division of a batch among processes, and their communication."""

import atexit
import hashlib
import os
import sys
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import torch
import torch.distributed as dist
from torch import Tensor

from gsim3d.errors import InputError, RunStopped
from gsim3d.train.stopping import Liveness


class Processes:
    """The processes of a training run; each has a replica of the model and computes a share of every batch.

    Attributes:
        rank: rank of this process.
        count: number of processes.
        liveness: monitor of the other processes; None for a single process.
    """

    def __init__(self, rank: int = 0, count: int = 1, liveness: Liveness | None = None):
        self.rank, self.count, self.liveness = rank, count, liveness

    @property
    def lost(self) -> str | None:
        """Message about a launcher or process that ended, after which this one must save and exit within half a minute;
        None while all are alive."""
        return None if self.liveness is None else self.liveness.lost

    @property
    def is_first(self) -> bool:
        """Whether this is the process that writes files and shows progress."""
        return self.rank == 0

    def share(self, batch: int) -> list[int]:
        """Returns the contiguous samples of a batch for this process; counts differ by at most one."""
        return list(range(self.rank * batch // self.count, (self.rank + 1) * batch // self.count))

    def gather(self, value: Any) -> list[Any]:
        """Returns ``value`` of every process in order of rank. All processes must call it."""
        if self.count == 1:
            return [value]
        values = [None] * self.count
        dist.all_gather_object(values, value)
        return values

    def add(self, tensors: Sequence[Tensor | None], factor: float) -> list[Tensor | None]:
        """All-reduces the sum of ``factor * tensor`` in one message; None must be None in all processes."""
        known = [tensor for tensor in tensors if tensor is not None]
        flat = torch.cat([tensor.reshape(-1) for tensor in known]).mul_(factor)
        dist.all_reduce(flat)
        sums = iter(flat.split([tensor.numel() for tensor in known]))
        return [None if tensor is None else next(sums).view(tensor.shape) for tensor in tensors]

    def check_same(self, **tensors: Iterable[Tensor]) -> None:
        """Raises InputError, in every process, if tensors differ in any bit between processes."""
        if self.count > 1:
            self.check_agreement(**{name: _digest(values) for name, values in tensors.items()})

    def check_agreement(self, **values: Any) -> None:
        """Raises InputError, in every process, if one of ``values`` differs between processes."""
        first, *others = self.gather(values)
        for name in first:
            if any(other[name] != first[name] for other in others):
                raise InputError(f"{name}: differs between the processes of this run; do they read the same files?")


@contextmanager
def joined(device: str) -> Iterator[Processes]:
    """Context with the process group of torchrun, or a single process without it.

    Args:
        device: "cpu" (gloo) or "cuda" (NCCL; each process uses the GPU of its local rank).

    Raises:
        RunStopped: another process ended. If this process is blocked in communication, it prints the same message and
            exits with code 2 within a minute.
    """
    count = int(os.environ.get("WORLD_SIZE", "1"))
    if count == 1:
        yield Processes()
        return
    if device == "cuda":
        local = int(os.environ.get("LOCAL_RANK", "0"))
        if local >= torch.cuda.device_count():
            raise InputError(
                f"--nproc-per-node: process {local} of this node has no GPU; {torch.cuda.device_count()} found"
            )
        torch.cuda.set_device(local)
    # This module keeps the group that exists when it is imported (by DistributedDataParallel, for example), whose
    # threads could then abort the process at exit. So it is imported before a group exists.
    from torch.distributed.nn import functional  # noqa: F401

    rank = int(os.environ.get("RANK", "0"))
    liveness, failed = Liveness(rank), True
    try:
        # Python objects are sent over gloo in both cases.
        dist.init_process_group("cpu:gloo,cuda:nccl" if device == "cuda" else "gloo")
        processes = Processes(rank, count, liveness)
        liveness.connect(count, processes.gather)
        yield processes
        failed = False
        dist.destroy_process_group()  # not after an error: others may be blocked, and torchrun terminates them
    except RunStopped:  # all processes have agreed to stop
        failed = False
        dist.destroy_process_group()
        raise
    except RuntimeError as error:
        if not (isinstance(error, dist.DistError) or "gloo" in str(error)):
            raise
        atexit.register(_exit_immediately)
        raise liveness.error() from None
    finally:
        liveness.end(failed=failed)


def _exit_immediately() -> None:
    """Exits without cleanup: NCCL would wait for the lost process, and gloo's threads would abort this one."""
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(2)


def _digest(tensors: Iterable[Tensor]) -> str:
    digest = hashlib.sha256()
    for tensor in tensors:
        digest.update(tensor.detach().cpu().contiguous().numpy())
    return digest.hexdigest()
