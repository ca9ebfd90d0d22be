"""The report of a validation: findings and statistics, collected without waiting for a GPU."""

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
MAX_FINDINGS = 1000  # kept by a report; later ones only count
MAX_QUIET = 1000  # records kept unread


@dataclass(frozen=True)
class Finding:
    """Particles or pixels of one tensor in one cloud or image that could not be used as they were.

    Attributes:
        what: what is wrong, such as "not finite", "outside the workspace", "speed limit".
        where: the call, such as "encode" or "rollout".
        tensor: what holds the numbers.
        action: "error", "dropped", "clamped", "asleep" (by rule) or "noted".
        count: how many.
        row: index of the first one in the packed tensors of the call.
        scene: of the particles' cloud.
        step: of the particles' cloud.
        camera: image of the call.
    """

    what: str
    where: str
    tensor: str
    action: str
    count: int
    row: int | None = None
    scene: int | None = None
    step: int | None = None
    camera: int | None = None

    def __str__(self) -> str:
        location = {"scene": self.scene, "step": self.step, "camera": self.camera}
        location = ", ".join(f"{name} {value}" for name, value in location.items() if value is not None)
        location = f" ({location})" if location else ""
        row = "" if self.row is None else f" at row {self.row}"
        more = f" and {self.count - 1} more" if self.count > 1 else ""
        return f"{self.where}: {self.tensor}: {self.what}{row}{location}{more}"

    def error(self) -> NumericalError:
        """The error that names the finding and says what to do."""
        return NumericalError(
            f"{self}; {ADVICE}", tensor=self.tensor, scene=self.scene, step=self.step, row=self.row, camera=self.camera
        )


class Statistics(NamedTuple):
    """Sums over the particles of one scene at one step.

    Attributes:
        awake: particles that may still change.
        kinetic_energy: (m/step)^2, half the squared displacements in the step, for unit masses.
        opacity_mass: sum of opacities.
        extent: metres, diagonal of the bounds of the awake particles.
    """

    awake: int
    kinetic_energy: float
    opacity_mass: float
    extent: float


class Reading(NamedTuple):
    """The content of a record once the host can read it."""

    findings: Iterable[Finding]
    statistics: dict[tuple[int, int], Statistics]


def pack(tensors: list[Tensor]) -> Tensor:
    """int64 [M], the bits of ``tensors`` of 64-bit numbers in one: one copy takes all of them to the host."""
    flat = [tensor.reshape(-1).view(torch.int64) for tensor in tensors]
    return flat[0] if len(flat) == 1 else torch.cat(flat)


class _Record(NamedTuple):
    """Numbers of a validation on a GPU; fields as the arguments of :meth:`StabilityReport.record`."""

    numbers: Any
    read: Callable[[Tensor], Reading]
    counts: Sequence[int]
    join: Callable[[Sequence[Any]], Tensor] | None = None


def _numbers_of(records: Iterable[_Record]) -> list[Tensor]:
    """All numbers in the order of the records; those that one function joins are in one tensor."""
    numbers = []
    for join, group in groupby(records, key=lambda record: record.join):
        own = [record.numbers for record in group]
        numbers += own if join is None else [join(own)]
    return numbers


def _read_packed(read: Callable, packed: Tensor, begin: int, shape: torch.Size, dtype: torch.dtype) -> Reading:
    """The content of one record among others in ``packed``, from ``begin`` on."""
    return read(packed[begin : begin + shape.numel()].view(dtype).view(shape))


@dataclass
class _Pending:
    """Records on their way to the host: the copy is complete when the event is; None: it has arrived."""

    records: list[_Record]
    packed: Tensor
    event: torch.cuda.Event | None


class StabilityReport:
    """What was raised, dropped, clamped or put to sleep, where and how often. Calls that share a report add to it.

    On a GPU a call adds a small record that is copied while the device works on; reading the report waits for it. In a
    CUDA graph records are overwritten by every replay: :meth:`replayed` fetches them. A region of ``torch.compile``
    records nothing; invalid particles sleep all the same.

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
        return StabilityReport, ()  # a copy of a model starts with an empty report

    def clear(self) -> None:
        """Forgets everything."""
        self._found: dict[Finding, Finding] = {}
        self._total = 0
        self._errors: list[Finding] = []
        self._first_error: Finding | None = None
        self._statistics: dict[tuple[int, int], Statistics] = {}
        self._unsent: list[_Record] = []
        self._stream: torch.cuda.Stream | None = None  # that computes what is unsent
        self._pending: deque[_Pending] = deque()
        self._quiet: list[Callable[[], Reading]] = []  # readings without findings, whose statistics were not read yet
        self._captured: list[_Record] = []
        self.is_closed = False

    # ---- writing ----

    def close(self) -> None:
        """Takes no further records: later findings are neither counted nor, in gradients, an error."""
        self.is_closed = True

    def add(self, finding: Finding) -> None:
        """Counts ``finding``; those of the same kind and location become one."""
        key = dataclasses.replace(finding, count=0, row=None)
        with self._lock:
            self._total += finding.count
            if finding.action == "error":
                self._errors.append(finding)  # of this call alone, whose rows its message counts
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
        """Adds the counts of a validation: now on the CPU, which also raises; on a GPU when their copy has arrived.

        Args:
            numbers: any small tensor of 64-bit numbers.
            read: a copy of ``numbers`` on the host -> its content.
            counts: indices into the flat ``numbers`` that are all 0 where there are no findings; a GPU's record is then
                read only with :attr:`statistics`. Empty: it is read when it arrives.
            send: copy it now; else with others by :meth:`send`, or when the report is read.
            join: makes one tensor of several such ``numbers``, which are parts on a GPU, when they are copied; None:
                they are whole.
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
        """Begins to copy to the host what has been recorded on a GPU, all in one, without waiting."""
        if torch.compiler.is_compiling() or not self._unsent:
            return
        records, self._unsent = self._unsent, []
        if self._stream == torch.cuda.current_stream():
            self._send(records)
        else:
            with torch.cuda.stream(self._stream):
                self._send(records)

    def captured(self) -> list[Tensor]:
        """The numbers that every replay of the CUDA graphs captured with this report overwrites; during a capture they
        are joined within the graph."""
        return _numbers_of(self._captured)

    def replayed(self, to: StabilityReport | None = None, packed: Tensor | None = None) -> None:
        """Fetches the records of the CUDA graphs captured with this report, without waiting; call it after a replay.

        Args:
            to: report that gets them, and the findings of this one so far; None: this one.
            packed: the packed content of :meth:`captured` on the host, if the caller has it already.
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
            reading = partial(_read_packed, record.read, pending.packed, begin, shape, dtype)
            if record.counts and not any([numbers[begin + index] for index in record.counts]):
                self._quiet.append(reading)
            else:
                self._read_quiet()  # steps in the order in which they came
                self._take(reading())
            begin += shape.numel()
        if len(self._quiet) > MAX_QUIET:
            self._read_quiet()

    def _read_quiet(self) -> None:
        quiet, self._quiet = self._quiet, []
        for reading in quiet:
            self._take(reading())

    # ---- reading ----

    def poll(self) -> None:
        """Raises the first error that has arrived and was not raised yet; waits for nothing."""
        if torch.compiler.is_compiling():
            return
        if (self._unsent or self._pending) and not torch.cuda.is_current_stream_capturing():
            self._collect(wait=False)
        with self._lock:
            new, self._errors = self._errors, []
        if new:
            raise new[0].error()

    def check(self) -> None:
        """Waits for the device and raises the first error of the report.

        Raises:
            NumericalError: naming scene, step, row or camera and tensor, and what to do.
        """
        self._collect(wait=True)
        if self._first_error is not None:
            self._errors = []
            raise self._first_error.error()

    @property
    def findings(self) -> tuple[Finding, ...]:
        """All findings, in the order in which they came; the first 1000."""
        self._collect(wait=True)
        return tuple(self._found.values())

    @property
    def total(self) -> int:
        """Count of all findings together."""
        self._collect(wait=True)
        return self._total

    @property
    def statistics(self) -> dict[tuple[int, int], Statistics]:
        """(scene, step) -> statistics, of every step that was simulated."""
        self._collect(wait=True)
        self._read_quiet()
        return dict(sorted(self._statistics.items()))

    def to_dict(self) -> dict:
        """Plain data: total and findings."""
        return {"total": self.total, "findings": [vars(finding) for finding in self.findings]}

    def __str__(self) -> str:
        """A table, one line a finding."""
        findings = self.findings
        if not findings:
            return "nothing was raised, dropped, clamped or put to sleep"
        names = ("where", "tensor", "what", "action", "scene", "step", "camera", "row", "count")
        rows = [names] + [
            tuple("-" if (value := getattr(f, name)) is None else str(value) for name in names) for f in findings
        ]
        widths = [max(len(row[c]) for row in rows) for c in range(len(names))]
        lines = ["  ".join(cell.ljust(width) for cell, width in zip(row, widths)).rstrip() for row in rows]
        return "\n".join([*lines, f"total {self.total}"])
