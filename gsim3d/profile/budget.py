"""What training time buys: PSNR against GPU-hours, from the log of a run or of a simulator that comes with gsim3d."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from gsim3d.errors import InputError
from gsim3d.io import checkpoint
from gsim3d.io.files import read_file
from gsim3d.pretrained import located
from gsim3d.train.log import LOG

LOGS = (LOG, "training.jsonl")  # of a run; of a simulator that comes with gsim3d
MAX_LOG = 2**28  # bytes
SHARES = (0.9, 0.99)  # of the last PSNR, that are looked for
SMOOTHED = 0.05  # of the log's lines are averaged


@dataclass(frozen=True)
class Training:
    """Logged optimizer steps, ascending.

    hours: of training so far, all sittings, on as many devices as trained together.   past, future: PSNR [dB] of given
        and of simulated steps, averaged over some lines; NaN where none was logged.
    """

    file: str
    steps: tuple[int, ...]
    hours: tuple[float, ...]
    past: tuple[float, ...]
    future: tuple[float, ...]

    @property
    def shown(self) -> tuple[float, ...]:
        """The PSNR that is looked at: of simulated steps if there were any."""
        return self.future if any(map(math.isfinite, self.future)) else self.past

    def hours_to(self, share: float) -> float | None:
        """Hours after which the PSNR stayed at or above this share of the last one; None: nothing was logged."""
        known = [(hours, value) for hours, value in zip(self.hours, self.shown, strict=True) if math.isfinite(value)]
        if not known:
            return None
        wanted, reached = share * known[-1][1], known[-1][0]
        for hours, value in reversed(known):
            if value < wanted:
                break
            reached = hours
        return reached


def log_of(given: str | Path) -> Path | None:
    """The log that belongs to a CHECKPOINT argument; None: there is none beside it."""
    path = located(given)
    folders = [path if path.is_dir() else path.parent]
    if path.parent.name == "checkpoints":  # a checkpoint folder of a run
        folders.append(path.parent.parent)
    return next((folder / name for folder in folders for name in LOGS if (folder / name).is_file()), None)


def read_log(file: Path) -> Training | None:
    """The log in ``file``; None where it holds no step with a PSNR. Raises InputError: it is no log."""
    rows = []
    try:
        for line in read_file(file, MAX_LOG).decode().splitlines():
            entry = json.loads(line)
            values = [_number(entry.get(f"{name}_psnr")) for name in ("past", "future")]
            if any(map(math.isfinite, values)):
                rows.append((int(entry["step"]), float(entry["machine"]["seconds"]) / 3600, *values))
    except (ValueError, KeyError, TypeError, AttributeError, OverflowError, RecursionError) as error:
        said = f"{type(error).__name__}: {str(error)[:100]}"
        raise InputError(f"{file}: not the log of a training: {said}") from None
    if not rows:
        return None
    steps, hours, past, future = zip(*sorted(rows), strict=True)
    return Training(str(file), steps, hours, _smooth(past), _smooth(future))


def as_dict(training: Training | None) -> dict | None:
    """For report.json."""
    if training is None:
        return None
    kept = {name: [None if v != v else v for v in getattr(training, name)] for name in ("past", "future")}
    hours_to = {f"{share:.0%}": training.hours_to(share) for share in SHARES}
    shown = {"log": training.file, "steps": list(training.steps), "hours": list(training.hours)}
    return {**shown, **kept, "hours_to": hours_to}


def earlier_checkpoints(given: str | Path) -> dict[str, Path]:
    """Of a run folder, its checkpoints before the last good one, by name; of anything else none."""
    path = located(given)
    if not checkpoint.exists(path):
        return {}
    last = (path / "checkpoints" / checkpoint.POINTER).read_text().strip()
    found = sorted(folder for folder in (path / "checkpoints").glob("step_*") if folder.name < last)
    return {folder.name.replace("_", " "): folder for folder in found}


def _number(value: object) -> float:
    return float(value) if isinstance(value, (int, float)) else math.nan


def _smooth(values: Sequence[float]) -> tuple[float, ...]:
    """Means over a window around each value that is known."""
    reach = int(SMOOTHED * len(values) / 2)
    smoothed = []
    for n, value in enumerate(values):
        window = [v for v in values[max(0, n - reach) : n + reach + 1] if math.isfinite(v)]
        smoothed.append(sum(window) / len(window) if math.isfinite(value) else math.nan)
    return tuple(smoothed)
