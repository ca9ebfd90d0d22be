"""Training in several processes: which samples each computes, and what they exchange."""

from __future__ import annotations

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
    """The processes of one training run; each has a replica of the model and computes its share of every batch.

    Attributes:
        rank: number of this one, from 0.
        count: how many there are.
        liveness: watches the others; None: nothing does.
    """

    def __init__(self, rank: int = 0, count: int = 1, liveness: Liveness | None = None):
        self.rank, self.count, self.liveness = rank, count, liveness

    @property
    def lost(self) -> str | None:
        """The launcher or process that is gone, as a sentence: save and end within half a minute; None while all are
        there."""
        return None if self.liveness is None else self.liveness.lost

    @property
    def is_first(self) -> bool:
        """Whether this is the one that writes files and shows progress."""
        return self.rank == 0

    def share(self, batch: int) -> list[int]:
        """The samples of a batch that this process computes: neighbours; counts differ by one at most."""
        return list(range(self.rank * batch // self.count, (self.rank + 1) * batch // self.count))

    def gather(self, value: Any) -> list[Any]:
        """``value`` of every process, in the order of their ranks. Every process must call it."""
        if self.count == 1:
            return [value]
        values = [None] * self.count
        dist.all_gather_object(values, value)
        return values

    def add(self, tensors: Sequence[Tensor | None], factor: float) -> list[Tensor | None]:
        """Sums over all processes, each with its ``factor``, in one message; None must be None in all."""
        known = [tensor for tensor in tensors if tensor is not None]
        flat = torch.cat([tensor.reshape(-1) for tensor in known]).mul_(factor)
        dist.all_reduce(flat)
        sums = iter(flat.split([tensor.numel() for tensor in known]))
        return [None if tensor is None else next(sums).view(tensor.shape) for tensor in tensors]

    def check_same(self, **tensors: Iterable[Tensor]) -> None:
        """Raises InputError, in every process, where they do not hold the same bits."""
        if self.count > 1:
            self.check_agreement(**{name: _digest(values) for name, values in tensors.items()})

    def check_agreement(self, **values: Any) -> None:
        """Raises InputError, in every process, where one of ``values`` is not the same in all of them."""
        first, *others = self.gather(values)
        for name in first:
            if any(other[name] != first[name] for other in others):
                raise InputError(f"{name}: not the same in all processes of this run; do they see the same files?")


@contextmanager
def joined(device: str) -> Iterator[Processes]:
    """Within it the processes that torchrun started know each other; alone where none did.

    Args:
        device: "cpu" (gloo) or "cuda" (NCCL; each process takes the GPU of its local rank).
    Raises:
        RunStopped: another process is gone. Where that leaves this one waiting, it ends with the same line and exit
            code 2 within a minute.
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
    # Functions of this module keep the group that is there when it is imported (with DistributedDataParallel, for one).
    # The group's threads would outlive it, and one that frees a tensor while Python ends aborts the process.
    from torch.distributed.nn import functional  # noqa: F401

    rank = int(os.environ.get("RANK", "0"))
    liveness, failed = Liveness(rank), True
    try:
        # Small Python values travel over gloo in both cases.
        dist.init_process_group("cpu:gloo,cuda:nccl" if device == "cuda" else "gloo")
        processes = Processes(rank, count, liveness)
        liveness.connect(count, processes.gather)
        yield processes
        failed = False
        dist.destroy_process_group()  # not after an error: others may wait for this process, and torchrun ends them
    except RunStopped:  # all have agreed to end
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
    """Else NCCL waits for the process that is gone, and threads of gloo abort this one while Python ends."""
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(2)


def _digest(tensors: Iterable[Tensor]) -> str:
    digest = hashlib.sha256()
    for tensor in tensors:
        digest.update(tensor.detach().cpu().contiguous().numpy())
    return digest.hexdigest()
