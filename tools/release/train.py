#!/usr/bin/env python
"""Trains a simulator for release: one run of given length, while its trajectories are simulated.

    python tools/release/train.py elastic --minutes 22 --state runs/elastic --out runs/elastic
    torchrun --nproc-per-node 4 tools/release/train.py elastic --minutes 22 --state ... --out ...    # on 4 GPUs

Data workers simulate trajectories on all spare cores; training begins with the first of them. Called again, the next
run goes on from the state that the last one left. A run that is killed loses what came after its last save, two minutes
or less. On several GPUs each training process has trajectories and data workers of its own.

Written to OUT: NAME.state.safetensors and NAME.weights.safetensors (tools/release/state.py), NAME.mp4 (truth above
prediction); scores of validation trajectories are in the state.
"""

# Data workers import this file, too: what needs torch is imported where it is used.
import argparse
import gc
import multiprocessing
import os
import sys
import tempfile
import time
from contextlib import ExitStack
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent.parent
sys.path.insert(0, str(ROOT))
from gsim3d.errors import CaptureError, InputError, NumericalError, RunStopped  # noqa: E402

SCORING_SHARE, SCORING_MOST = 0.2, 100.0  # of a run, seconds: for validation at its end
SPARE_CORES = 3  # that each training process keeps
VALIDATION_WORKERS = 2  # that make validation trajectories


def run(
    recipe, state: Path, out: Path, *, minutes: float, device: str, workers: int, about: dict, is_last: bool, first: str
):
    """One run of a tools.release.recipes.Recipe, with ``workers`` data workers for each process that trains; where it
    has no state yet, it begins with that of the run ``first``, if that is not "".

    Raises:
        InputError: the state in ``state`` is broken or of another recipe, or the time is too short.
        NumericalError: too many steps in a row were skipped; ``out`` has the last good state.
    """
    begin = time.monotonic()
    deadline = begin + 60 * minutes
    end = deadline - min(SCORING_MOST, SCORING_SHARE * 60 * minutes)

    import torch

    from gsim3d.train.processes import joined
    from tools.release.runs import RunTrainer, train
    from tools.release.state import begun_with, load_into
    from tools.release.trajectories import DataWorkers, TrajectoryStore

    world, name = recipe.stream(), recipe.name
    folder = tempfile.TemporaryDirectory(prefix="release_", ignore_cleanup_errors=True)
    with folder as scratch, joined(device) as together, ExitStack() as ended:
        report = say if together.is_first else lambda _: None
        store = TrajectoryStore(world, recipe.capacity, device)
        source, progress = begun_with(state, name, first)
        validation = Path(scratch) / "validation"
        maker = make_validation(recipe, validation) if together.is_first else None
        for ends_it in (maker.join, maker.terminate) if maker else ():  # the last one first
            ended.callback(ends_it)
        with DataWorkers(world, store, progress.next_trajectory, workers, scratch, together) as made:
            trainer = RunTrainer(recipe.train, store, Path(scratch) / "run", device, together)
            load_into(trainer, state, source, differs=source != name)
            if not progress.step:  # of another world
                trainer.step, trainer.seconds, trainer.n_skipped = 0, 0.0, 0
            report(f"{name}: waits for {recipe.n_first} trajectories of {workers} data workers")
            if not made.wait_for(-(-recipe.n_first // together.count), end - time.monotonic()):
                raise InputError(f"--minutes: {minutes:g} pass before {recipe.n_first} trajectories are made")
            if trainer.new_parameters:
                report(f"{name}: begin at their first values: {', '.join(trainer.new_parameters)}")
            waited = round(time.monotonic() - begin, 1)
            report(f"{name}: {made.count} trajectories after {waited} s; from step {trainer.step}")
            machine = torch.cuda.get_device_name() if device == "cuda" else "cpu"
            about = {
                **about,
                "device": machine if together.count == 1 else f"{together.count} x {machine}",
                "seconds_before": waited,
                "seed": world.seed,
                "is_last": is_last,
                **({"began_with": {"name": source, "step": progress.step}} if source != name else {}),
                "new_parameters": trainer.new_parameters,
            }
            given = {"end": end, "out": out, "name": name, "is_last": is_last, "say": report}
            progress = train(trainer, made, progress, about, **given)
        report(f"{name}: step {trainer.step}, {progress.windows} windows, {trainer.seconds:.0f} s of training in all")
        del trainer, store, made
        gc.collect()  # the trainer and its graphs refer to each other
        if device == "cuda":
            torch.cuda.empty_cache()
        if together.is_first:
            maker.join()
            if maker.exitcode:
                raise InputError("the validation set could not be made; its messages are above")
            score(out, name, progress, validation, device, deadline)
        together.gather(None)  # torchrun ends all where one ends badly: none leaves before the scores


def make_validation(recipe, folder: Path) -> multiprocessing.Process:
    """Makes the recipe's own validation set in the background."""
    context = multiprocessing.get_context("spawn")
    process = context.Process(target=_generate, args=(str(folder), recipe.validation()))
    process.start()
    return process


def _generate(folder: str, given: dict) -> None:
    from gsim3d.synth import generate

    os.environ["OMP_NUM_THREADS"] = "1"
    generate(folder, processes=VALIDATION_WORKERS, progress=False, **given)


def score(out: Path, name: str, progress, validation: Path, device: str, deadline: float) -> None:
    """Scores the last checkpoint, then those on the way from the newest on while there is time; into the state."""
    import dataclasses

    from gsim3d.data import find_scenes
    from tools.release.state import add_scores, weights_file
    from tools.release.validation import validate, write_comparison

    files = {progress.windows: weights_file(out, name)}
    files |= {int(path.name.split(".")[1]): path for path in (out / "scored").glob(f"{name}.*.weights.safetensors")}
    scores, longest = list(progress.scores), 0.0
    known = {entry["windows"] for entry in scores}
    for windows in sorted(set(files) - known, reverse=True):
        start = time.monotonic()
        if longest and start + longest > deadline:
            say(f"no time to score {files[windows].name}")
            continue
        entry, restored, scenes = validate(files[windows], find_scenes(validation), device)
        scores.append({"windows": windows, **entry})
        add_scores(out, name, dataclasses.replace(progress, scores=sorted(scores, key=lambda e: e["windows"])))
        longest = max(longest, time.monotonic() - start)
        say(
            f"{name}: {windows} windows: given {entry['past']:.2f}, future {entry['future']:.2f}, bodies "
            f"{entry['body']:.2f} dB masked, constant {entry['constant']:.2f} ({len(entry['scenes'])} trajectories, "
            f"{time.monotonic() - start:.0f} s)"
        )
        if files[windows] == weights_file(out, name):
            write_comparison(out / f"{name}.mp4", restored, scenes)


def say(text: str) -> None:
    print(text, flush=True)


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0], allow_abbrev=False)
    parser.add_argument("world", choices=("elastic", "cloth", "rigid", "push"))
    parser.add_argument("--arm", default="velocity", help="of configs/train/arms.yaml (default: velocity)")
    parser.add_argument("--minutes", type=float, required=True, help="length of this run, everything included")
    parser.add_argument("--state", type=Path, required=True, help="folder with the state of the last run, if any")
    parser.add_argument("--out", type=Path, required=True, help="folder for the state and the video; may be the same")
    parser.add_argument("--device", choices=("cpu", "cuda"), default="cuda")
    parser.add_argument("--workers", type=int, help="data workers (default: all cores but three for each GPU)")
    parser.add_argument("--last", action="store_true", help="the learning rate falls: the last run of a simulator")
    parser.add_argument("--begin-with", metavar="NAME", help="run whose state is taken where the own has none")
    parser.add_argument("--commit", default="", help="of the code that runs, for the state")
    args = parser.parse_args(arguments)
    if not args.minutes > 0:
        raise InputError(f"--minutes must be positive; got {args.minutes}")
    from tools.release.recipes import recipe

    together = int(os.environ.get("LOCAL_WORLD_SIZE", "1"))
    workers = args.workers or len(os.sched_getaffinity(0)) - SPARE_CORES * together
    options = {"minutes": args.minutes, "device": args.device, "workers": max(1, workers // together)}
    options |= {"first": args.begin_with or "", "is_last": args.last}
    run(recipe(args.world, args.arm), args.state, args.out, about={"commit": args.commit}, **options)


if __name__ == "__main__":
    try:
        main()
    except RunStopped as error:
        print(f"train: {error}", file=sys.stderr)
        sys.exit(error.code)
    except (InputError, NumericalError, CaptureError) as error:
        sys.exit(f"train: error: {error}")
