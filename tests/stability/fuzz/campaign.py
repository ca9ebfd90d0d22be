"""Many inputs of many targets, in rounds: stopped at any time, it goes on where it was."""

from __future__ import annotations

import json
import os
import shutil
import signal
import sys
from collections.abc import Sequence
from pathlib import Path

from tests.stability.fuzz.engine import PATIENCE, run

ROUND = 1000  # inputs of a target at a time
TOTALS = "totals.json"


def campaign(names: Sequence[str], count: int, place: Path, patience: float = PATIENCE, a_round: int = ROUND) -> bool:
    """Feeds each of the targets ``names`` until it had ``count`` inputs; whether none failed, now or before.

    Args:
        place: folder with the totals up to now, and with failing inputs.
        patience: as of :func:`tests.stability.fuzz.engine.run`.
        a_round: inputs of a target at a time; the target with the fewest is next.
    """
    place.mkdir(parents=True, exist_ok=True)
    totals = json.loads((place / TOTALS).read_text()) if (place / TOTALS).is_file() else {}
    for name in names:
        totals.setdefault(name, {"count": 0, "answers": {}, "failures": []})
    before = signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # so that the child ends, too
    try:
        while open_ := [name for name in names if totals[name]["count"] < count]:
            name = min(open_, key=lambda name: totals[name]["count"])
            _round(name, min(a_round, count - totals[name]["count"]), totals[name], place, patience)
            part = place / f"{TOTALS}.part"
            part.write_text(json.dumps(totals, indent=1))
            os.replace(part, place / TOTALS)
    finally:
        signal.signal(signal.SIGTERM, before)
        print(_table(totals, place), flush=True)
    return not any(total["failures"] for total in totals.values())


def _round(name: str, n: int, total: dict, place: Path, patience: float) -> None:
    seed = total["count"]  # no two rounds of a target have the same
    out = place / f"{name}-{seed}"
    (outcome,) = run([name], n, seed, out, patience)
    print(outcome, flush=True)
    total["count"] += outcome.count
    for answer, times in outcome.answers.items():
        total["answers"][answer] = total["answers"].get(answer, 0) + times
    total["failures"] += [[text, str(kept)] for text, kept in outcome.failures]
    if not outcome.failures:
        shutil.rmtree(out)


def _table(totals: dict, place: Path) -> str:
    lines = [
        f"{name:24} {total['count']:9,} inputs, {len(total['failures'])} failures" for name, total in totals.items()
    ]
    n_failures = sum(len(total["failures"]) for total in totals.values())
    count = sum(total["count"] for total in totals.values())
    return "\n".join([*lines, f"{'all':24} {count:9,} inputs, {n_failures} failures; kept in {place}"])
