#!/usr/bin/env python
"""Prints what the states of runs say: validation scores against windows, and paired differences between arms.

    python tools/release/curve.py tools/release/state/elastic-velocity.state.safetensors [OTHER.state.safetensors ...]

Scores are masked PSNR [dB] of validation trajectories: given steps, future steps over the full horizon, bodies in
future steps, and the last given step held still. Differences are those of the first state's newest score and every
other one's, trajectory by trajectory, with their standard errors; nothing below two of them is a difference.
"""

import argparse
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent.parent
sys.path.insert(0, str(ROOT))
from gsim3d.errors import InputError  # noqa: E402
from gsim3d.evaluate.compare import LEAST, paired  # noqa: E402
from tools.release.state import CURVE, Progress, load_progress  # noqa: E402

SCORES = ("past", "future", "body", "constant")


def table(name: str, progress: Progress) -> str:
    """Markdown: a row for each score on the way."""
    minutes = f"{progress.seconds / 60:.0f} minutes"
    lines = [
        f"{name}: {progress.step:,} steps, {progress.windows:,} windows, {minutes} of training",
        "",
        "| windows | minutes | given steps | future | bodies | constant |",
        "| ---: | ---: | ---: | ---: | ---: | ---: |",
    ]
    for entry in progress.scores:
        minutes = f"{_seconds(progress, entry['windows']) / 60:.0f}"
        numbers = " | ".join(f"{entry[score]:.2f}" for score in SCORES)
        lines.append(f"| {entry['windows']:,} | {minutes} | {numbers} |")
    return "\n".join(lines)


def difference(first: dict, second: dict) -> str:
    """Means and standard errors of ``second`` minus ``first`` over the trajectories that both have.

    Raises:
        InputError: they are of different trajectories.
    """
    if first["scenes"].keys() != second["scenes"].keys():
        raise InputError("the two scores are of different trajectories")
    parts = []
    for index, score in enumerate(SCORES[:3]):
        mean, error = paired([second["scenes"][name][index] - first["scenes"][name][index] for name in first["scenes"]])
        where = "beyond" if abs(mean) > LEAST * error else "within"
        parts.append(f"{score} {mean:+.2f} ± {error:.2f} ({where} two standard errors)")
    return ", ".join(parts)


def _seconds(progress: Progress, windows: int) -> float:
    """Seconds of training after so many windows."""
    known = [row[CURVE.index("seconds")] for row in progress.curve if row[CURVE.index("windows")] <= windows]
    return max(known, default=0.0)


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0], allow_abbrev=False)
    parser.add_argument("states", type=Path, nargs="+", metavar="STATE", help="NAME.state.safetensors")
    args = parser.parse_args(arguments)
    names = [path.name.removesuffix(".state.safetensors") for path in args.states]
    found = {str(path): load_progress(path.parent, name) for name, path in zip(names, args.states, strict=True)}
    for name, progress in found.items():
        if not progress.scores:
            raise InputError(f"{name}: no state, or one without scores")
        print(table(name, progress), end="\n\n")
    first, *others = found
    for other in others:
        gaps = difference(found[first].scores[-1], found[other].scores[-1])
        print(f"{other} against {first}: {gaps}")


if __name__ == "__main__":
    try:
        main()
    except InputError as error:
        sys.exit(f"curve: error: {error}")
