#!/usr/bin/env python
"""Prints what the states of runs say: validation scores against windows, and paired differences between arms.

    python tools/release/curve.py tools/release/state/elastic-velocity.state.safetensors [OTHER.state.safetensors ...]
    python tools/release/curve.py runs/elastic/elastic-velocity.state.safetensors --weights    # writes the checkpoint

Scores are masked PSNR [dB] of validation trajectories: given steps, future steps over the full horizon, bodies in
future steps, and the last given step held still. Differences are those of the first state's newest score and every
other one's, after equal windows if there are such scores, trajectory by trajectory, with their standard errors; nothing
below two of them is a difference.
"""

import argparse
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent.parent
sys.path.insert(0, str(ROOT))
from gsim3d.errors import InputError  # noqa: E402
from gsim3d.evaluate.compare import LEAST, paired  # noqa: E402
from tools.release.recipes import recipe  # noqa: E402
from tools.release.runs import RunTrainer  # noqa: E402
from tools.release.state import CURVE, Progress, load_into, load_progress, save_weights, weights_file  # noqa: E402
from tools.release.trajectories import TrajectoryStore  # noqa: E402

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


def newest(first: Progress, second: Progress) -> tuple[dict, dict]:
    """The newest scores of both after equal windows, or else the newest of each."""
    known = {entry["windows"]: entry for entry in first.scores}
    shared = [entry for entry in second.scores if entry["windows"] in known]
    return (known[shared[-1]["windows"]], shared[-1]) if shared else (first.scores[-1], second.scores[-1])


def _seconds(progress: Progress, windows: int) -> float:
    """Seconds of training after so many windows."""
    known = [row[CURVE.index("seconds")] for row in progress.curve if row[CURVE.index("windows")] <= windows]
    return max(known, default=0.0)


def write_weights(folder: Path, name: str) -> Path:
    """Writes the checkpoint of run ``name`` in ``folder`` anew; it is rounded as its state is."""
    made, file = recipe(*name.split("-", 1)), weights_file(folder, name)
    trainer = RunTrainer(made.train, TrajectoryStore(made.stream(), 1, "cpu"), folder, "cpu")
    load_into(trainer, folder, name)
    save_weights(trainer, file)
    return file


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0], allow_abbrev=False)
    parser.add_argument("states", type=Path, nargs="+", metavar="STATE", help="NAME.state.safetensors")
    parser.add_argument("--weights", action="store_true", help="write the checkpoint of each state beside it")
    args = parser.parse_args(arguments)
    names = [path.name.removesuffix(".state.safetensors") for path in args.states]
    labels = names if len(set(names)) == len(names) else map(str, args.states)
    found = {label: load_progress(path.parent, name) for label, name, path in zip(labels, names, args.states)}
    for name, progress in found.items():
        if not progress.scores:
            raise InputError(f"{name}: no state, or one without scores")
        print(table(name, progress), end="\n\n")
    for path in args.states if args.weights else ():
        print(f"written: {write_weights(path.parent, path.name.removesuffix('.state.safetensors'))}")
    first, *others = found
    for other in others:
        pair = newest(found[first], found[other])
        at = " and ".join(dict.fromkeys(f"{entry['windows']:,}" for entry in reversed(pair)))
        print(f"{other} against {first} at {at} windows: {difference(*pair)}")


if __name__ == "__main__":
    try:
        main()
    except InputError as error:
        sys.exit(f"curve: error: {error}")
