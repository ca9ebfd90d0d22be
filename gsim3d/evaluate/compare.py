"""Comparison of two reports on the same scenes: mean difference and paired standard error of each score."""

import math
import statistics
from collections.abc import Iterable, Iterator, Sequence
from numbers import Real
from pathlib import Path

from gsim3d.data.recording import read_json
from gsim3d.errors import InputError
from gsim3d.evaluate.scoring import METRICS

PARTS = ("past", "future", "future_late")
LEAST = 2.0  # standard errors; smaller differences are a tie
SAME = {"n_encoded_steps": "given steps", "n_future_steps": "predicted steps"}


def read_report(file: str | Path) -> dict:
    """Reads a metrics.json, or the scores of a shipped simulator, which map data sets to reports.

    Raises:
        InputError: the file cannot be read or contains no report.
    """
    content = read_json(Path(file))
    if not list(_reports(content)):
        raise InputError(f"{file}: not a report of gsim3d evaluate: it has no scores of individual scenes")
    return content


def compare(report: dict, other: dict, file: str | Path) -> dict:
    """Subtracts the scores of ``other`` from those of ``report``, for the first method of each.

    Args:
        file: file of ``other``, for messages.

    Returns:
        Data set ("" if the report has only one) -> score -> difference, standard_error (None for a single scene),
        scenes (number of scenes with both values), verdict.

    Raises:
        InputError: the reports share no data set, or differ in scenes, steps or images.
    """
    ours, others = dict(_reports(report)), dict(_reports(other))
    shared = [name for name in ours if name in others]
    if not shared:
        raise InputError(f"{file}: has no set in common with this report: {sorted(others)}, here {sorted(ours)}")
    return {name: _compare(ours[name], others[name], f"{file}: {name}".removesuffix(": ")) for name in shared}


def table(comparison: dict, file: str | Path) -> str:
    """Formats the result of :func:`compare` as text."""
    lines = [f"difference to {file} (mean over scenes ± paired standard error):"]
    for name, scores in comparison.items():
        lines += [f"  {name}"] if name else []
        for score, row in scores.items():
            digits, error = METRICS[score.split(".")[-1]].digits, row["standard_error"]
            numbers = f"{row['difference']:+.{digits}f} ± {'-' if error is None else f'{error:.{digits}f}'}"
            lines.append(f"  {score:26}{numbers:>20}  {row['scenes']} scenes: {row['verdict']}")
    return "\n".join(lines)


def _reports(content: dict) -> Iterator[tuple[str, dict]]:
    """Yields (data set, report); the data set is "" if ``content`` is itself a report."""

    def is_report(part) -> bool:
        return isinstance(part, dict) and isinstance(part.get("scenes"), dict) and bool(part.get("methods"))

    if is_report(content):
        yield "", content
    else:
        yield from ((name, part) for name, part in content.items() if is_report(part))


def check_same(steps: dict, names: Iterable[str], other: dict, where: str | Path) -> None:
    """Raises InputError if the report ``other``, from the file ``where``, has other ``n_encoded_steps`` or
    ``n_future_steps`` than ``steps``, or other scenes than ``names``."""
    for key, what in SAME.items():
        if steps.get(key) != other.get(key):
            raise InputError(
                f"{where}: {other.get(key)} {what}, here {steps.get(key)}; compare equal steps (--steps, --given)"
            )
    known = set(names)
    if differing := sorted(known ^ set(other.get("scenes", ()))):
        missing = "not scored there" if differing[0] in known else "scored only there"
        raise InputError(f"{where}: different scenes: {differing[0]} is {missing} ({len(differing)} scenes differ)")


def _compare(ours: dict, other: dict, where: str) -> dict:
    known, its = ours["scenes"], other["scenes"]
    check_same(ours, known, other, where)
    for scene, scores in known.items():
        digests = [found.get("digest") if isinstance(found, dict) else None for found in (scores, its[scene])]
        if None in digests:
            raise InputError(f"{where}: has no digest of the scored images of {scene}; run gsim3d evaluate again")
        if digests[0] != digests[1]:
            raise InputError(f"{where}: images, labels or target cameras of {scene} differ between the reports")
    found = {}
    for score in (f"{part}.{metric}" for part in PARTS for metric in METRICS):
        both = ((_score(ours, scene, score), _score(other, scene, score)) for scene in known)
        if differences := [a - b for a, b in both if a is not None and b is not None]:
            found[score] = _difference(differences, METRICS[score.split(".")[-1]].rises)
    return found


def _score(report: dict, scene: str, score: str) -> float | None:
    """Returns a score of the first method; None if it has no value."""
    method = report["methods"][0]
    value = report["scenes"][scene].get(score if method == "model" else f"{method}.{score}")
    return float(value) if isinstance(value, Real) and math.isfinite(value) else None


def paired(differences: Sequence[float]) -> tuple[float, float | None]:
    """Returns the mean of paired differences, and its standard error (None for a single pair)."""
    n = len(differences)
    return statistics.fmean(differences), statistics.stdev(differences) / math.sqrt(n) if n > 1 else None


def _difference(differences: list[float], rises: bool) -> dict:
    mean, error = paired(differences)
    if error is None:
        verdict = "single scene: no standard error"
    elif abs(mean) > LEAST * error:
        verdict = "better" if (mean > 0) == rises else "worse"
    else:
        verdict = "equal within two standard errors"
    return {"difference": mean, "standard_error": error, "scenes": len(differences), "verdict": verdict}
