#!/usr/bin/env python
"""How many images a second training gets: decoded for the first time, from memory, and from decoded files.

    python tools/bench/loading.py FOLDER [--cache DIR]

FOLDER holds scenes, as `gsim3d generate` makes them. A step is the paper's: 4 samples of 4 given and 12 predicted
steps, 4 input views, 5 target views; batches are drawn as training draws them, ready for the device. Prints images a
second and the longest training step that one reader could not keep up with; CPU seconds do not depend on what else
runs.
"""

import argparse
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import torch

from gsim3d.data import Scene, find_scenes
from gsim3d.train.config import DataConfig, PhaseConfig
from gsim3d.train.samples import draw_batch

BATCH, HISTORY, HORIZON, CONTEXT_VIEWS, TARGET_VIEWS = 4, 4, 12, 4, 5
WORKERS = (1, 2, 4)


def measure(name: str, scenes: list[Scene], steps: range, n_workers: int) -> None:
    phase = PhaseConfig(steps=1, horizon=HORIZON, batch=BATCH, target_views=TARGET_VIEWS)
    data = DataConfig(history=HISTORY, context_views=CONTEXT_VIEWS)

    def draw(step: int) -> int:
        batch = draw_batch(scenes, data, phase, 0, step, range(BATCH))
        return len(batch.context.images) + len(batch.targets.images)

    start, cpu = time.perf_counter(), time.process_time()
    with ThreadPoolExecutor(n_workers) as pool:
        n_images = sum(pool.map(draw, steps))
    seconds, cpu = time.perf_counter() - start, time.process_time() - cpu
    print(
        f"{name:<24}{n_workers:>8}{n_images / seconds:>14.0f}{1e3 * cpu / n_images:>16.3f}{cpu / len(steps):>14.3f}",
        flush=True,
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--cache", type=Path, metavar="DIR", help="where decoded files go; default: a temporary folder")
    parser.add_argument("--steps", type=int, default=24, help="training steps a row")
    args = parser.parse_args()
    torch.set_num_threads(1)
    folders = find_scenes(args.folder)
    with tempfile.TemporaryDirectory() as temporary:
        cache = args.cache or Path(temporary)
        print(
            f"{len(folders)} scenes; "
            f"{BATCH * (HISTORY * CONTEXT_VIEWS + (HISTORY + HORIZON) * TARGET_VIEWS)} images a step"
        )
        print(f"{'images from':<24}{'workers':>8}{'images/s':>14}{'CPU ms/image':>16}{'CPU s/step':>14}")
        for name, folder in (("memory", None), ("decoded files", cache)):
            scenes = [Scene.open(path, cache_dir=folder) for path in folders]
            measure(f"{name}, first time", scenes, range(args.steps), 1)
            for scene in scenes:
                scene.images(range(scene.n_cams), range(scene.n_steps))
                scene.segmentation(range(scene.n_cams), range(scene.n_steps))
            for n_workers in WORKERS:
                measure(name, scenes, range(args.steps, 2 * args.steps), n_workers)


if __name__ == "__main__":
    main()
