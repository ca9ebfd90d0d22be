"""Reports of validations: findings and statistics, collected without device syncs."""

from __future__ import annotations

import dataclasses
import threading
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import groupby
from typing import Any, NamedTuple

import torch
from torch import Tensor

from gsim3d.errors import NumericalError

ADVICE = 'on_invalid="drop" goes on without such particles, on_invalid="clamp" bounds them'
MAX_FINDINGS = 1000  # findings stored in a report; later ones are only counted
MAX_QUIET = 1000  # records without findings that are stored unread


@dataclass(frozen=True)
class Finding:
    """Invalid particles or pixels of one tensor in one cloud or image."""

    what: str  #: kind of finding, such as "not finite", "outside the workspace" or "speed limit"
    where: str  #: call, such as "encode" or "rollout"
    tensor: str  #: name of the tensor
    action: str  #: "error", "dropped", "clamped", "asleep" (limit exceeded) or "noted"
    count: int  #: number of particles or pixels
    row: int | None = None  #: index of the first one in the packed tensor
    scene: int | None = None  #: scene of the cloud
    step: int | None = None  #: step of the cloud
    camera: int | None = None  #: index of the image

    def __str__(self) -> str:
        location = {"scene": self.scene, "step": self.step, "camera": self.camera}
        location = ", ".join(f"{name} {value}" for name, value in location.items() if value is not None)
        location = f" ({location})" if location else ""
        row = "" if self.row is None else f" at row {self.row}"
        more = f" and {self.count - 1} more" if self.count > 1 else ""
        return f"{self.where}: {self.tensor}: {self.what}{row}{location}{more}"

    def error(self) -> NumericalError:
        """Returns the error of this finding, with advice."""
        place = {name: getattr(self, name) for name in ("tensor", "scene", "step", "row", "camera")}
        return NumericalError(f"{self}; {ADVICE}", **place)


class Statistics(NamedTuple):
    """Statistics of the particles of a scene at a step."""

    awake: int  #: number of awake particles
    kinetic_energy: float  #: half the sum of squared displacements in (m/step)^2, for unit masses
    opacity_mass: float  #: sum of opacities
    extent: float  #: diagonal of the bounding box of the awake particles in metres


class Reading(NamedTuple):
    """Content of a record on the host."""

    findings: Iterable[Finding]
    statistics: dict[tuple[int, int], Statistics]


def pack(tensors: list[Tensor]) -> Tensor:
    """Concatenates the bits of tensors of 64-bit numbers to int64 [M], for a single copy to the host."""
    flat = [tensor.reshape(-1).view(torch.int64) for tensor in tensors]
    return flat[0] if len(flat) == 1 else torch.cat(flat)


class _Record(NamedTuple):
    """A record of a validation on a GPU; the fields are the arguments of :meth:`StabilityReport.record`."""

    numbers: Any
    read: Callable[[Tensor], Reading]
    counts: Sequence[int]
    join: Callable[[Sequence[Any]], Tensor] | None = None


def _numbers_of(records: Iterable[_Record]) -> list[Tensor]:
    """Tensors of the records in order, with consecutive records of the same ``join`` joined."""
    numbers = []
    for join, group in groupby(records, key=lambda record: record.join):
        own = [record.numbers for record in group]
        numbers += own if join is None else [join(own)]
    return numbers


@dataclass
class _Pending:
    """Records that are copied to the host; ``event`` ends the copy (None: complete)."""

    records: list[_Record]
    packed: Tensor
    event: torch.cuda.Event | None


class StabilityReport:
    """Collects the findings and statistics of all calls that share it.

    On a GPU, a call adds a small record that is copied asynchronously; reading the report synchronizes. A replay of a
    CUDA graph overwrites its records, which :meth:`replayed` fetches. Under ``torch.compile`` nothing is recorded, but
    invalid particles still fall asleep.

    Attributes:
        is_closed: whether :meth:`close` was called.

    Example:
        >>> report = StabilityReport()
        >>> report.total, bool(report.findings)
        (0, False)
        >>> report.check()
    """

    def __init__(self):
        self._lock = threading.Lock()
        self.clear()

    def __reduce__(self):
        return StabilityReport, ()  # copies of a model start with an empty report

    def clear(self) -> None:
        """Removes all findings, statistics and records."""
        self._found: dict[Finding, Finding] = {}
        self._total = 0
        self._errors: list[Finding] = []
        self._first_error: Finding | None = None
        self._statistics: dict[tuple[int, int], Statistics] = {}
        self._unsent: list[_Record] = []
        self._stream: torch.cuda.Stream | None = None  # stream of the unsent records
        self._pending: deque[_Pending] = deque()
        self._quiet: list[Callable[[], Reading]] = []  # records without findings, whose statistics are unread
        self._captured: list[_Record] = []
        self.is_closed = False

    def close(self) -> None:
        """Ignores all later findings, including errors in gradients."""
        self.is_closed = True

    def add(self, finding: Finding) -> None:
        """Adds ``finding``; findings of the same kind and location are merged."""
        key = dataclasses.replace(finding, count=0, row=None)
        with self._lock:
            self._total += finding.count
            if finding.action == "error":
                self._errors.append(finding)  # unmerged, so that its message counts this call only
                self._first_error = self._first_error or finding
            if known := self._found.get(key):
                self._found[key] = dataclasses.replace(known, count=known.count + finding.count)
            elif len(self._found) < MAX_FINDINGS:
                self._found[key] = finding

    def record(
        self,
        numbers: Tensor,
        read: Callable[[Tensor], Reading],
        *,
        counts: Sequence[int] = (),
        send: bool = True,
        join: Callable[[Sequence[Any]], Tensor] | None = None,
    ) -> None:
        """Adds the record of a validation. The CPU reads it immediately and may raise; a GPU copies it asynchronously.

        Args:
            numbers: small tensor of 64-bit numbers.
            read: parses a copy of ``numbers`` on the host.
            counts: indices into the flattened ``numbers`` of the counts of findings; if all are 0, a GPU's record is
                read only for :attr:`statistics`. Empty: the record is always read.
            send: whether to start the copy now; else :meth:`send` or a read of the report starts it.
            join: joins several ``numbers``, which are partial results on a GPU, into one tensor; None: no join.
        """
        if self.is_closed:
            return
        if numbers.device.type != "cuda":
            self._take(read(numbers))
            self.poll()
        elif torch.cuda.is_current_stream_capturing():
            self._captured.append(_Record(numbers, read, counts, join))
        else:
            stream = torch.cuda.current_stream(numbers.device)
            if stream != self._stream:
                self.send()
            self._stream = stream
            self._unsent.append(_Record(numbers, read, counts, join))
            if send:
                self.send()

    def send(self) -> None:
        """Starts an asynchronous copy of all unsent records to the host."""
        if torch.compiler.is_compiling() or not self._unsent:
            return
        records, self._unsent = self._unsent, []
        if self._stream == torch.cuda.current_stream():
            self._send(records)
        else:
            with torch.cuda.stream(self._stream):
                self._send(records)

    def captured(self) -> list[Tensor]:
        """Tensors of the records that a replay of the captured CUDA graphs overwrites. Call it during the capture."""
        return _numbers_of(self._captured)

    def replayed(self, to: StabilityReport | None = None, packed: Tensor | None = None) -> None:
        """Fetches the records of the captured CUDA graphs asynchronously. Call it after a replay.

        Args:
            to: report to which the records and all findings of this report are added; None: this report.
            packed: packed content of :meth:`captured` on the host, if already copied.
        """
        target = self if to is None else to
        if self._captured and packed is not None:
            target._pending.append(_Pending(self._captured, packed, None))
        elif self._captured:
            with torch.cuda.device(self._captured[0].numbers.device):
                target._send(self._captured)
        if to is not None:
            to._take(Reading(self._found.values(), self._statistics))

    def _send(self, records: list[_Record]) -> None:
        packed = pack(_numbers_of(records))
        copy = torch.empty(packed.shape, dtype=packed.dtype, pin_memory=True)
        copy.copy_(packed, non_blocking=True)
        event = torch.cuda.Event()
        event.record()
        self._pending.append(_Pending(records, copy, event))

    def _take(self, reading: Reading) -> None:
        for finding in reading.findings:
            self.add(finding)
        self._statistics.update(reading.statistics)

    def _collect(self, wait: bool) -> None:
        self.send()
        while self._pending:
            event = self._pending[0].event
            if wait and event is not None:
                event.synchronize()
            elif event is not None and not event.query():
                return
            self._arrived(self._pending.popleft())

    def _arrived(self, pending: _Pending) -> None:
        numbers, begin = pending.packed.tolist(), 0
        for record in pending.records:
            shape, dtype = record.numbers.shape, record.numbers.dtype
            own = pending.packed[begin : begin + shape.numel()].view(dtype).view(shape)
            reading = partial(record.read, own)
            if record.counts and not any([numbers[begin + index] for index in record.counts]):
                self._quiet.append(reading)
            else:
                self._read_quiet()  # in the order of steps
                self._take(reading())
            begin += shape.numel()
        if len(self._quiet) > MAX_QUIET:
            self._read_quiet()

    def _read_quiet(self) -> None:
        quiet, self._quiet = self._quiet, []
        for reading in quiet:
            self._take(reading())

    def poll(self) -> None:
        """Raises the first error that has arrived and was not raised yet, without a device sync."""
        if torch.compiler.is_compiling():
            return
        if (self._unsent or self._pending) and not torch.cuda.is_current_stream_capturing():
            self._collect(wait=False)
        with self._lock:
            new, self._errors = self._errors, []
        if new:
            raise new[0].error()

    def check(self) -> None:
        """Synchronizes and raises the first error of the report.

        Raises:
            NumericalError: names scene, step, tensor, and row or camera, and says what to do.
        """
        self._collect(wait=True)
        if self._first_error is not None:
            self._errors = []
            raise self._first_error.error()

    @property
    def findings(self) -> tuple[Finding, ...]:
        """The first 1000 findings in order."""
        self._collect(wait=True)
        return tuple(self._found.values())

    @property
    def total(self) -> int:
        """Sum of the counts of all findings."""
        self._collect(wait=True)
        return self._total

    @property
    def statistics(self) -> dict[tuple[int, int], Statistics]:
        """(scene, step) -> statistics, for every simulated step."""
        self._collect(wait=True)
        self._read_quiet()
        return dict(sorted(self._statistics.items()))

    def to_dict(self) -> dict:
        """Total and findings as plain values."""
        return {"total": self.total, "findings": [vars(finding) for finding in self.findings]}

    def __str__(self) -> str:
        """A table, one line a finding."""
        findings = self.findings
        if not findings:
            return "nothing was raised, dropped, clamped or put to sleep"
        names = ("where", "tensor", "what", "action", "scene", "step", "camera", "row", "count")
        values = ([getattr(finding, name) for name in names] for finding in findings)
        rows = [names, *(["-" if value is None else str(value) for value in row] for row in values)]
        widths = [max(len(row[c]) for row in rows) for c in range(len(names))]
        lines = ["  ".join(cell.ljust(width) for cell, width in zip(row, widths)).rstrip() for row in rows]
        return "\n".join([*lines, f"total {self.total}"])
