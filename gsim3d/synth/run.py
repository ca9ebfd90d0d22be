"""Makes a whole data set with all cores, in any order, with the same bytes every time."""

from __future__ import annotations

import dataclasses
import multiprocessing
import os
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

import numpy as np

from gsim3d.effects.spec import FILE as EFFECTS_FILE
from gsim3d.errors import InputError
from gsim3d.io.locks import only_one_writer
from gsim3d.synth import writer
from gsim3d.synth.world import World
from gsim3d.synth.worlds import build_world

NICENESS = 10  # of the data workers of a training run: the run goes first
NEEDED = {"embreex": "embreex", "trimesh": "trimesh", "PIL": "pillow"}


@dataclass(frozen=True)
class Report:
    """What `generate` did.

    Attributes:
        folders: scenes in the order of `gsim3d.data.find_scenes`, so that splits of both lists agree.
        n_made: how many were made now.
        rejected: number of draws that could not be used, by reason.
    """

    folders: list[Path]
    n_made: int
    rejected: dict[str, int]


def generate(
    out: str | Path,
    world: str = "elastic",
    *,
    preset: str = "mini",
    processes: int | None = None,
    part: tuple[int, int] | None = None,
    progress: bool = True,
    **changes,
) -> Report:
    """Simulates and renders a data set of multi-view video with masks, in the layout that `gsim3d.data` reads.

    The bytes depend on the options only, not on the number of processes. Finished scenes are kept: after a
    kill, call it again; to get more trajectories, call it with a larger ``n_trajectories``.
    A script that calls it with several processes needs the usual ``if __name__ == "__main__":``.

    Args:
        out: folder, made if absent; scenes go to out/<object>/<sample>.
        world: one of worlds.WORLDS.
        preset: one of worlds.PRESETS.
        processes: default: as many as there are cores.
        part: (i, n) makes the i-th of n parts of the scenes, from 1, and no manifest: other parts may be made at the
            same time, on other machines too. A call without it then makes what is missing, and the manifest.
        progress: show a progress bar.
        changes: replace single options of the preset (fields of the world's class).

    Returns:
        What was made.

    Raises:
        InputError: impossible options, missing packages, and folders that hold something else.
    """
    require_packages(NEEDED)
    settings = build_world(world, preset, changes)
    require_engine(settings.engine)
    check_processes(processes)
    if part is not None and not 1 <= part[0] <= part[1]:
        raise InputError(f"part must be I/N with I from 1 to N; got {part[0]}/{part[1]}")
    out = Path(out)
    if out.exists() and not out.is_dir():
        raise InputError(f"{out} is not a folder")
    out.mkdir(parents=True, exist_ok=True)
    scenes = settings.scenes()
    mine = None if part is None else range(part[0] - 1, len(scenes), part[1])
    with only_one_writer(out, mine):
        scenes = scenes if mine is None else [scenes[i] for i in mine]
        fingerprints = {name: settings.fingerprint(name) for name in settings.object_names()}
        folders = {scene: writer.scene_folder(out, *scene) for scene in scenes}
        missing = [scene for scene in scenes if not writer.is_finished(folders[scene], fingerprints[scene[0]])]
        jobs = [(settings, out, scene) for scene in missing]
        for _ in each(_make_one, jobs, processes, "scenes" if progress else None):
            pass
        folders = list(folders.values())
        if part is None:
            settings.effects().save(out / EFFECTS_FILE)
            writer.write_manifest(out, folders, {"world": world, **dataclasses.asdict(settings)})
        rejected = writer.rejected_draws(folders)
    from gsim3d.data import find_scenes  # not above: the worker processes do without torch

    wanted = set(folders)
    ordered = [folder for folder in find_scenes(out) if folder in wanted]
    return Report(ordered, len(missing), rejected)


def require_packages(needed: dict[str, str]) -> None:
    """Raises InputError unless all modules can be imported; ``needed`` has the package of each."""
    for module, package in needed.items():
        try:
            __import__(module)
        except ImportError as error:
            raise InputError(f"generate needs {package}: pip install 'gsim3d[generate]' ({error})") from error


def require_engine(engine: str) -> None:
    """Raises InputError unless the package of an engine is installed."""
    if engine == "mujoco":
        require_packages({"mujoco": "mujoco-core==4.0.0"})
    elif find_spec(engine) is None:
        raise InputError(
            f"engine {engine} needs the package genesis-world, 4 GB with what it needs: "
            "pip install 'gsim3d[genesis]'; leave --engine out to simulate with MuJoCo"
        )


def check_processes(processes: int | None) -> None:
    """Raises InputError unless ``processes`` is None or a number of processes."""
    if processes is not None and processes < 1:
        raise InputError(f"processes must be 1 or more; got {processes}")


def each(function: Callable, jobs: Sequence[tuple], processes: int | None, shown: str | None) -> Iterator:
    """Results of ``function`` for every job, in the order in which they end.

    Args:
        function: of a module, so that other processes find it.
        jobs: its arguments.
        processes: None: as many as there are cores.
        shown: what the progress bar counts; None: no bar.
    """
    from gsim3d.io.terminal import progress

    processes = min(processes or len(os.sched_getaffinity(0)), len(jobs))
    with progress(None, shown or "", len(jobs), unit="scene", quiet=shown is None or not jobs) as bar:
        if processes <= 1:
            for job in jobs:
                yield function(*job)
                bar.update()
            return
        context = multiprocessing.get_context("spawn")
        with ProcessPoolExecutor(processes, context, start_worker) as pool:
            futures = [pool.submit(function, *job) for job in jobs]
            try:
                for future in as_completed(futures):
                    yield future.result()
                    bar.update()
            except BaseException:
                pool.shutdown(wait=True, cancel_futures=True)
                raise


def _make_one(settings, out: Path, scene: tuple[str, int]) -> None:
    writer.write_scene(out, settings.make(*scene))


def start_worker() -> None:
    """To be called first in a process that makes scenes."""
    import cv2

    cv2.setNumThreads(1)
    # A worker whose parent was killed would wait for work for ever.
    parent = multiprocessing.parent_process()
    threading.Thread(target=lambda: (parent.join(), os._exit(1)), daemon=True).start()


def start_data_worker() -> None:
    """To be called first in a process that makes scenes beside a training run."""
    os.nice(NICENESS)
    start_worker()


def write_trajectory(world: World, scene: tuple[str, int], file: str) -> str:
    """Writes one trajectory as arrays, without files of images.

    Args:
        world: settings.
        scene: object and sample.
        file: name of the .npz: images uint8 [T, V, H, W, 4], colours and the label of seg images; viewmats
            [V, 4, 4] and Ks [V, 3, 3].

    Returns:
        ``file``.
    """
    made = world.make(*scene)
    images = np.stack([np.concatenate([view.rgb, view.segmentation[..., None]], -1) for view in made.views])
    np.savez(file, images=images, viewmats=made.rig.viewmats, Ks=made.rig.Ks)
    return file
