"""What happens to numbers that cannot be used, and how one learns of it.

For every input, the simulator and every op return finite outputs and finite gradients, or raise a
:class:`gsim3d.NumericalError` that names scene, step, particle or camera and tensor. A policy says which:

- ``"raise"`` (default): an error. The CPU raises at once. On a GPU nothing waits for the device: the row sleeps as
  under "drop", and the error comes from the next call that finds the flag, or from :meth:`StabilityReport.check`.
- ``"drop"``: the row sleeps. It stays in its place, is not seen by the network, not drawn, and has no gradient.
- ``"clamp"``: the number is bounded: NaN becomes the value before it, or 0 (a rotation the identity); the row goes on.

Under every policy a particle that leaves the workspace, or moves further in a step than ``max_speed``, falls asleep by
rule ("clamp": is held at the limit); that is counted and no error. Nothing of this changes another scene by one bit.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import Any, Literal, NamedTuple, get_args

import torch
from torch import Tensor

from gsim3d.errors import InputError, NumericalError

OnInvalid = Literal["raise", "drop", "clamp"]
LARGEST = torch.finfo(torch.float32).max
ACTIONS = {"raise": "error", "drop": "dropped", "clamp": "clamped"}
ADVICE = 'on_invalid="drop" goes on without such rows, on_invalid="clamp" bounds them'
NEAREST = 1e-6  # metres: no depth range begins nearer
FARTHEST = 1e9  # metres: no depth range ends further away, and no camera or origin is further from 0
PIXEL_SLACK = 1e-3  # colours may leave [0, 1] by as much: resampling rounds
MAX_FINDINGS = 1000  # of a report, then only its total goes on counting
MAX_QUIET = 1000  # records kept as they came


def check_on_invalid(on_invalid: str) -> None:
    """Raises InputError where it is no policy."""
    if on_invalid not in get_args(OnInvalid):
        raise InputError(f"on_invalid must be one of {', '.join(get_args(OnInvalid))}; got {on_invalid!r}")


def at_most(values: Tensor, largest: float) -> Tensor:
    """bool, of each row of ``values``: whether its numbers are finite and no larger in size."""
    return (values.detach().abs() <= largest).flatten(1).all(1)


def usable_pixels(images: Tensor) -> Tensor:
    """bool, of each number of ``images``: whether it is a colour in [0, 1]."""
    return (images >= -PIXEL_SLACK) & (images <= 1 + PIXEL_SLACK)


@dataclass(frozen=True)
class StabilityConfig:
    """Limits that a model's particles keep, and what happens where one does not.

    on_invalid: "raise", "drop" or "clamp": the policy where a call names no other.
    max_speed: metres a step. A particle that moves further falls asleep where it was. Less than a model's own
        ``max_step`` stops motion that was learned; far more lets a runaway drag others along before it leaves.
    max_latent: largest size of a latent or colour coefficient. Beyond it a value counts as not finite: from about 6e4
        half precision overflows, from 1e19 a squared norm in float32.
    """

    on_invalid: OnInvalid = "raise"
    max_speed: float = 10.0
    max_latent: float = 1e4

    def __post_init__(self):
        check_on_invalid(self.on_invalid)
        for name in ("max_speed", "max_latent"):
            if not 0 < getattr(self, name) < float("inf"):
                raise InputError(f"{name} must be positive and finite; got {getattr(self, name)}")


@dataclass(frozen=True)
class Finding:
    """Rows of one tensor in one place that could not be used as they were.

    what: what is wrong, such as "not finite", "outside the workspace", "speed limit".
    where: the call, such as "encode" or "rollout". tensor: what holds the numbers.
    scene, step: of the particles' cloud; camera: image of the call; None where none is meant.
    row: the first such row, of the packed rows of the call. count: how many.
    action: "error", "dropped", "clamped", "asleep" (by rule) or "noted".
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
        place = [
            f"{name} {value}" for name in ("scene", "step", "camera") if (value := getattr(self, name)) is not None
        ]
        place = f" ({', '.join(place)})" if place else ""
        row = "" if self.row is None else f" at row {self.row}"
        more = f" and {self.count - 1} more" if self.count > 1 else ""
        return f"{self.where}: {self.tensor}: {self.what}{row}{place}{more}"

    def error(self) -> NumericalError:
        """As the error that names it and says what to do."""
        return NumericalError(
            f"{self}; {ADVICE}", tensor=self.tensor, scene=self.scene, step=self.step, row=self.row, camera=self.camera
        )


class Sentinels(NamedTuple):
    """Sums over the particles of one scene at one step.

    awake: particles that may still change. kinetic_energy: metres^2 a step^2, sum of half the squared displacement in
    the step, for unit masses. opacity_mass: sum of opacities. extent: metres, diagonal of the awake particles' bounds.
    """

    awake: int
    kinetic_energy: float
    opacity_mass: float
    extent: float


class Reading(NamedTuple):
    """What a record of a device says once the host can read it."""

    findings: Iterable[Finding]
    sentinels: dict[tuple[int, int], Sentinels]


def pack(tensors: list[Tensor]) -> Tensor:
    """The bits of ``tensors`` of 64-bit numbers in one, int64 [M]: one copy takes all of them to the host."""
    flat = [tensor.reshape(-1).view(torch.int64) for tensor in tensors]
    return flat[0] if len(flat) == 1 else torch.cat(flat)


class _Record(NamedTuple):
    """Numbers of a guard on a GPU. read, counts, join: as of StabilityReport.record."""

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


class _Packed(NamedTuple):
    """One record among others in ``packed`` on the host, from ``begin`` on."""

    packed: Tensor
    begin: int
    shape: torch.Size
    dtype: torch.dtype
    read: Callable[[Tensor], Reading]

    def reading(self) -> Reading:
        own = self.packed[self.begin : self.begin + self.shape.numel()]
        return self.read(own.view(self.dtype).view(self.shape))


@dataclass
class _Pending:
    """Records on their way to the host: the copy is complete when the event is; None: it has arrived."""

    records: list[_Record]
    packed: Tensor
    event: torch.cuda.Event | None


class StabilityReport:
    """What was raised, dropped, clamped or put to sleep: where, and how often. Calls that share it add to it.

    On a GPU a call adds a small record that is copied while the device works on; reading the report waits for it. In a
    CUDA graph records are overwritten by every replay: :meth:`replayed` fetches them. A region of ``torch.compile``
    records nothing; its rows sleep all the same.

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
        self._found: dict[tuple, Finding] = {}
        self._total, self._raised = 0, 0
        self._errors: list[Finding] = []
        self._first_error: Finding | None = None
        self._sentinels: dict[tuple[int, int], Sentinels] = {}
        self._unsent: list[_Record] = []
        self._stream: torch.cuda.Stream | None = None  # that computes what is unsent
        self._pending: deque[_Pending] = deque()
        self._quiet: list[_Packed] = []  # have no findings, and sentinels that nobody has asked for
        self._captured: list[_Record] = []
        self.is_closed = False

    # ---- writing ----

    def close(self) -> None:
        """Takes no further records: guards go on, and what they find is neither counted nor, in gradients, an error."""
        self.is_closed = True

    def add(self, finding: Finding) -> None:
        """Counts a finding; those of the same kind and place become one."""
        place = (finding.what, finding.where, finding.tensor, finding.action)
        place += (finding.scene, finding.step, finding.camera)
        with self._lock:
            self._total += finding.count
            if finding.action == "error":
                self._errors.append(finding)  # of this call alone, whose rows its message counts
                self._first_error = self._first_error or finding
            known = self._found.get(place)
            if known is not None:
                finding = Finding(*place[:4], known.count + finding.count, known.row, *place[4:])
            if known is not None or len(self._found) < MAX_FINDINGS:
                self._found[place] = finding

    def record(
        self,
        numbers: Tensor,
        read: Callable[[Tensor], Reading],
        *,
        counts: Sequence[int] = (),
        at_once: bool = True,
        join: Callable[[Sequence[Any]], Tensor] | None = None,
    ) -> None:
        """Takes what a guard counted: at once on the CPU, which also raises; on a GPU when its copy has arrived.

        Args:
            numbers: any small tensor of 64-bit numbers.
            read: what it says, from a copy on the host.
            counts: places in ``numbers`` (row by row) that are all 0 where it says no findings; a GPU's record is then
                read only when somebody asks for sentinels. Empty: it is read when it arrives.
            at_once: copy it now; else with others by :meth:`send`, or when somebody reads.
            join: makes one tensor of several such ``numbers``, parts on a GPU with the shape, dtype and device of what
                they make, when they are copied. None: they are whole.
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
            if at_once:
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
        """The numbers that every replay of the CUDA graphs captured with this report overwrites; asked for while one is
        captured, they are put together in it."""
        return _numbers_of(self._captured)

    def replayed(self, to: StabilityReport | None = None, packed: Tensor | None = None) -> None:
        """Fetches the records of the CUDA graphs captured with this report, without waiting; call it after a replay.

        Args:
            to: report that is told of them, and of what this one has found so far; None: this one.
            packed: what :meth:`captured` held, packed and on the host, where the caller has it already; nobody else may
                change it.
        """
        target = self if to is None else to
        if self._captured and packed is not None:
            target._pending.append(_Pending(self._captured, packed, None))
        elif self._captured:
            with torch.cuda.device(self._captured[0].numbers.device):
                target._send(self._captured)
        if to is not None:
            to._take(Reading(self._found.values(), self._sentinels))

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
        self._sentinels.update(reading.sentinels)

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
            shape = record.numbers.shape
            packed = _Packed(pending.packed, begin, shape, record.numbers.dtype, record.read)
            if record.counts and not any([numbers[begin + place] for place in record.counts]):
                self._quiet.append(packed)
            else:
                self._read_quiet()  # steps in the order in which they came
                self._take(packed.reading())
            begin += shape.numel()
        if len(self._quiet) > MAX_QUIET:
            self._read_quiet()

    def _read_quiet(self) -> None:
        quiet, self._quiet = self._quiet, []
        for packed in quiet:
            self._take(packed.reading())

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
        """Rows of all findings together."""
        self._collect(wait=True)
        return self._total

    @property
    def sentinels(self) -> dict[tuple[int, int], Sentinels]:
        """The sentinels of every (scene, step) that was simulated."""
        self._collect(wait=True)
        self._read_quiet()
        return dict(sorted(self._sentinels.items()))

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
