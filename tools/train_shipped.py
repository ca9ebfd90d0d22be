#!/usr/bin/env python
"""Trains the simulators that come with gsim3d, in sittings of given length, while their trajectories are simulated.

    python tools/train_shipped.py elastic --minutes 8 --state runs/elastic --out runs/elastic --device cuda
    torchrun --nproc-per-node 4 tools/train_shipped.py elastic --minutes 8 ...    # on 4 GPUs

One sitting: processes film trajectories on all spare cores, training begins with the first 32 and goes on with what is
there, while fewer of them film; near the end the learning rate falls, the state is written, and held-out trajectories
are predicted, scored and filmed. Called again, the next sitting goes on with weights, optimizer and the next
trajectories; what is kept and what is rounded stands in gsim3d/train/sittings.py. A sitting that is killed loses what
came after its last save, two minutes or less. On several GPUs each training process has films, and processes that film,
of its own, and draws a batch of the recipe's size; the first one writes and scores.

Written to OUT: the state, NAME.scores.json (held-out trajectories over the full horizon) and NAME.mp4 (truth above
prediction).
"""

# The processes that film import this file, too: what needs torch is imported where it is used.
import argparse
import gc
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))
from gsim3d.errors import CaptureError, HardCaseError, InputError  # noqa: E402

WORLDS = ("elastic", "cloth", "rigid")
REPORT_SHARE, REPORT_MOST = 0.15, 60.0  # of a sitting, seconds: for held-out predictions at its end
FILMED = 3  # held-out trajectories in the video
SPARE_CORES = 2  # that each training process keeps
LATER_SHARE = 2  # once training has begun one process in so many films: its host thread needs a free core
HELD_OUT_PROCESSES = 2


def sit(recipe, name: str, state: Path, out: Path, *, minutes: float, device: str, processes: int) -> None:
    """One sitting of the run ``name`` of a gsim3d.train.shipped.Recipe; ``processes`` film for each that trains.

    Raises:
        InputError: the state in ``state`` is broken or of another recipe, or the time is too short.
        HardCaseError: too many steps in a row met numbers that cannot be used; ``out`` has the last good state.
    """
    begin = time.monotonic()
    deadline = begin + 60 * minutes
    end = deadline - min(REPORT_MOST, REPORT_SHARE * 60 * minutes)

    import torch

    from gsim3d.train.films import Filming, FilmStore
    from gsim3d.train.processes import joined
    from gsim3d.train.shipped import SittingTrainer, train
    from gsim3d.train.sittings import begin_with, load_into, load_progress, weights_file

    worlds = recipe.worlds()
    with tempfile.TemporaryDirectory(prefix="sitting_") as scratch:
        with joined(device) as together:
            tell = say if together.is_first else lambda _: None
            progress = load_progress(state, name)
            store = FilmStore(worlds[0], recipe.capacity, device)
            with Filming(worlds, store, progress.next_trajectory, processes, scratch, together) as filming:
                trainer = SittingTrainer(recipe.train, store, Path(scratch) / "run", device, together)
                load_into(trainer, state, name, progress)
                begun = begin_with(trainer, recipe.begin_with) if not progress.step and recipe.begin_with else None
                if not filming.wait_for(-(-recipe.first_films // together.count), end - time.monotonic()):
                    raise InputError(f"--minutes: {minutes:g} pass before {recipe.first_films} trajectories are filmed")
                waited = round(time.monotonic() - begin, 1)
                tell(f"{name}: {filming.count} trajectories after {waited} s; from step {trainer.step}")
                machine = torch.cuda.get_device_name() if device == "cuda" else "cpu"
                sitting = {
                    "device": machine if together.count == 1 else f"{together.count} x {machine}",
                    "processes": together.count * processes,
                    "seconds_before": waited,
                    "seed": worlds[0].seed,
                    "in_turn": list(recipe.in_turn),
                    **({"began_with": begun} if begun else {}),
                }
                filming.slow_down(max(1, processes // LATER_SHARE))
                held_out = film_held_out(recipe, Path(scratch) / "held_out") if together.is_first else None
                try:
                    train(trainer, filming, progress, sitting, end=end, out=out, name=name, say=tell)
                finally:
                    if held_out:
                        held_out.wait()
            tell(f"{name}: step {trainer.step}, {trainer.seconds:.0f} s of training in all")
            del trainer, store, filming
            gc.collect()  # the trainer and its graphs refer to each other: all that they hold, else predictions lack it
            if device == "cuda":
                torch.cuda.empty_cache()
            if together.is_first:
                weights = weights_file(out, load_progress(out, name))
                report(weights, Path(scratch) / "held_out", out, name, device, deadline)
            together.gather(None)  # torchrun ends all where one ends badly: nobody leaves before the report


def film_held_out(recipe, folder: Path) -> subprocess.Popen:
    """`gsim3d generate` in the background."""
    from gsim3d.train.shipped import HELD_OUT_SEED

    options = [recipe.world, "--preset", "diverse", "--seed", HELD_OUT_SEED, "--trajectories", recipe.held_out]
    for option, flag in (("image_size", "--size"), ("n_frames", "--frames")):
        options += [flag, recipe.options[option]] if option in recipe.options else []
    options += ["--out", folder, "--processes", HELD_OUT_PROCESSES, "--quiet"]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])}
    command = [sys.executable, "-m", "gsim3d", "generate", *(str(option) for option in options)]
    return subprocess.Popen(command, env=environment, stdout=subprocess.DEVNULL)


def report(weights: Path, held_out: Path, out: Path, name: str, device: str, deadline: float) -> None:
    """Scores and film of held-out trajectories, as many as there is time for, one at least."""
    import numpy as np

    from gsim3d.data import find_scenes
    from gsim3d.evaluate.pictures import as_bytes, comparison_frames, true_images
    from gsim3d.evaluate.protocol import default_views, predict_together, render_steps, score_scene
    from gsim3d.evaluate.report import summarize, table, write_json
    from gsim3d.interop import write_video
    from gsim3d.train.restore import restore

    restored = restore(weights, device)
    scores, rows = [], []
    scenes = [restored.open_scene(folder) for folder in find_scenes(held_out)]
    n_future = min(scene.n_steps for scene in scenes) - restored.data.history
    for scene, prediction in zip(scenes, predict_together(restored, scenes, n_future), strict=True):
        start = time.monotonic()
        scores.append(score_scene(restored, scene, n_future=n_future, prediction=prediction))
        if len(rows) < FILMED:
            _, target = default_views(restored, scene)
            shown = as_bytes(render_steps(restored, prediction.particles, scene, target[:1]))
            rows.append((true_images(scene, target[:1], range(len(shown))), shown))
        if time.monotonic() + (time.monotonic() - start) > deadline:
            break
    summary = {"checkpoint": restored.checkpoint.digest, **summarize(scores)}
    print(table(summary))
    write_json(out / f"{name}.scores.json", summary)
    truth, predicted = (np.concatenate(images, 1) for images in zip(*rows, strict=True))
    write_video(out / f"{name}.mp4", comparison_frames(truth, predicted), scene.fps)


def say(text: str) -> None:
    print(text, flush=True)


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("world", choices=WORLDS)
    parser.add_argument("--minutes", type=float, required=True, help="length of this sitting, everything included")
    parser.add_argument("--state", type=Path, required=True, help="folder with the state of the last sitting, if any")
    parser.add_argument("--out", type=Path, required=True, help="folder for the state and the scores; may be the same")
    parser.add_argument("--device", choices=("cpu", "cuda"), default="cuda")
    parser.add_argument("--processes", type=int, help="that film (default: all cores but two for each GPU)")
    args = parser.parse_args(arguments)
    if not args.minutes > 0:
        raise InputError(f"--minutes must be positive; got {args.minutes}")
    from gsim3d.train.shipped import RECIPES

    together = int(os.environ.get("LOCAL_WORLD_SIZE", "1"))
    processes = args.processes or len(os.sched_getaffinity(0)) - SPARE_CORES * together
    processes = max(1, processes // together)
    options = {"minutes": args.minutes, "device": args.device, "processes": processes}
    sit(RECIPES[args.world], f"{args.world}-small", args.state, args.out, **options)


if __name__ == "__main__":
    try:
        main()
    except (InputError, HardCaseError, CaptureError) as error:
        sys.exit(f"train_shipped: error: {error}")
