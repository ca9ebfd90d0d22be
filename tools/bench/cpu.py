"""Whole steps of a model on two CPU cores, in turns with those of another commit, as a table.

    python tools/bench/cpu.py --other FOLDER [--scene SCENE]

FOLDER is a checkout of the other commit with built extensions. Each commit has a process of its own, since two versions
of an extension do not fit into one; both wait but for the one whose turn it is. A time is the median of --rounds, each
with the other side next to it, and the ratio that of medians; the spread is the distance between the quartiles as a
part of the median. With SCENE, a scene folder, the commands of this commit are timed too, from start to files.
"""

import argparse
import dataclasses
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
CASES = {  # case -> (what, wanted ratio to the other commit)
    "pure": ("a step of the pure elastic model, one scene, 8,164 particles", None),
    "step": ("a step of `small`, one scene of 4 steps", None),
    "encode": ("encode of `small`, 4 views x 4 steps", 2.0),
    "train": ("training step of `tiny`", 1.3),
}
COMMANDS = {  # command -> wanted seconds
    "simulate elastic-small SCENE --out OUT --steps 80 --quiet": 12,
    "effects infer SCENE elastic-small --out OUT --quiet": 20,
}


def serve() -> None:
    """Runs the case of every line of stdin and writes its seconds of wall clock and of the processor."""
    sys.path[0] = str(Path.cwd() / "tools" / "bench")  # of the commit, in place of this file's folder
    import surface_scene
    import torch

    from gsim3d.presets import small, tiny
    from gsim3d.simulator import Simulator

    def model(config, n_views, size):
        frames, places = surface_scene.frames(1, [surface_scene.evenly(n_views)] * 4, size, masked=True)
        torch.manual_seed(0)
        made = surface_scene.as_if_trained(Simulator(config), places.float()).eval()
        return made, frames, torch.no_grad()(made.encode)(frames)

    torch.set_num_threads(2)
    config = small()
    dynamics = dataclasses.replace(config.dynamics, position_features=False)  # as in configs/train/elastic.yaml
    pure, _, few = model(dataclasses.replace(config, dynamics=dynamics), 2, 64)
    (small, frames, state), (tiny, *_) = model(config, 4, 128), model(tiny(), 4, 128)
    tiny.train()

    def train() -> None:
        particles = tiny.encode(frames)
        image = tiny.render(tiny.rollout(particles, 1)[0], surface_scene.cameras(range(4), torch.zeros(4).long(), 128))
        image.color.square().mean().backward()

    runs = {"encode": lambda: small.encode(frames), "step": lambda: small.rollout(state, 1), "train": train}
    runs["pure"] = lambda: pure.rollout(few, 1)
    for case in map(str.strip, sys.stdin):
        start = time.perf_counter(), time.process_time()
        with torch.set_grad_enabled(case == "train"):
            runs[case]()
        print(json.dumps([time.perf_counter() - start[0], time.process_time() - start[1]]), flush=True)


def side(folder: Path) -> subprocess.Popen:
    """The process of a commit; it ends with its stdin."""
    environment = os.environ | {"PYTHONPATH": str(folder), "OMP_WAIT_POLICY": "passive"}
    command = [sys.executable, __file__, "--serve"]
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    return subprocess.Popen(command, env=environment, cwd=folder, **pipes)


def compared(ours: subprocess.Popen, other: subprocess.Popen, rounds: int) -> None:
    """Prints the rows of the table."""
    from harness import summary

    for case, (what, wanted) in CASES.items():
        times: dict = {ours: [], other: []}
        for k in range(rounds + 1):
            for process in (ours, other) if k % 2 else (other, ours):
                process.stdin.write(case + "\n")
                process.stdin.flush()
                times[process].append(json.loads(process.stdout.readline()))
        times, cells = {process: rows[1:] for process, rows in times.items()}, []  # the first one warms up
        for clock in (0, 1):
            a, b = (summary([row[clock] for row in of]) for of in times.values())
            cells += [f"{x['ms']:.0f} ({x['spread']:.0%})" for x in (a, b)] + [f"{b['ms'] / a['ms']:.2f}"]
        print(f"| {what} | {' | '.join(cells)} | {'-' if wanted is None else f'{wanted:g}'} |", flush=True)


def commands(scene: Path) -> None:
    """Prints the rows of the commands of this commit."""
    for words, wanted in COMMANDS.items():
        with tempfile.TemporaryDirectory() as folder:
            given = {"SCENE": str(scene.resolve()), "OUT": f"{folder}/out"}
            command = [sys.executable, "-m", "gsim3d", *(given.get(x, x) for x in words.split())]
            start, before = time.perf_counter(), sum(os.times()[2:4])
            subprocess.run(command, cwd=ROOT, check=True, stdout=subprocess.DEVNULL)
            used = sum(os.times()[2:4]) - before
        print(f"| `gsim3d {words}` | {time.perf_counter() - start:.1f} | {used:.1f} | {wanted} |", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description="gsim3d on two CPU cores against another commit")
    add = parser.add_argument
    add("--other", type=Path, metavar="FOLDER", help="checkout of another commit, with built extensions")
    add("--scene", type=Path, help="scene folder of 84 steps or more; also times commands")
    add("--rounds", type=int, default=9, help="of each case, at least 2 (default: 9)")
    add("--serve", action="store_true", help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.rounds < 2:
        parser.error("--rounds: must be at least 2")
    if args.serve:
        return serve()
    if args.other is not None:
        print("| what | ms (spread) | other | ratio | processor ms (spread) | other | ratio | wanted |")
        print("| --- | ---: | ---: | ---: | ---: | ---: | ---: | ---: |")
        compared(side(ROOT), side(args.other.resolve()), args.rounds)
    if args.scene is not None:
        print("\n| command | s | processor s | wanted s |\n| --- | ---: | ---: | ---: |")
        commands(args.scene)


if __name__ == "__main__":
    main()
