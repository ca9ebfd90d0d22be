"""Trajectories that data workers simulate while a run trains, and that lie decoded where it computes."""

from __future__ import annotations

import dataclasses
import multiprocessing
import os
import shutil
import tempfile
import threading
from collections.abc import Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import torch
from safetensors.torch import load_file
from torch import Tensor

from gsim3d.cameras import Cameras, Frames
from gsim3d.data import Window, generator
from gsim3d.data.recording import BACKGROUND, MOVING
from gsim3d.state import Actions
from gsim3d.synth.cameras import Rig, workspace_origin
from gsim3d.synth.run import start_data_worker, write_trajectory
from gsim3d.synth.world import World
from gsim3d.train.config import DataConfig, PhaseConfig
from gsim3d.train.processes import Processes
from gsim3d.train.samples import Batch, draw_noise, draw_windows, subsampled

QUEUED = 2  # trajectories that wait for each data worker


@dataclass(frozen=True)
class Trajectory:
    """One trajectory of a store, as far as the drawing of windows reads it."""

    slot: int  #: its number in the store
    path: Path  #: a name
    n_steps: int  #: frames of each camera
    n_cams: int  #: cameras
    width: int  #: pixels
    height: int  #: pixels
    fps: float  #: frames per second
    acting: bool = False  #: whether it has actors

    @property
    def name(self) -> str:
        return self.path.name

    def has_segmentation(self) -> bool:
        return True

    def has_actions(self) -> bool:
        return self.acting


class TrajectoryStore:
    """Images and labels of many trajectories of one world in the memory of a device; the newest replace the oldest.

    Args:
        world: of the trajectories: how many cameras record how many frames.
        capacity: trajectories that it holds.
        device: where they lie.
    """

    def __init__(self, world: World, capacity: int, device: str):
        rig = world.rig()
        self.capacity, self.count = capacity, 0
        self._shape = (world.n_frames, rig.n_cams, rig.size, rig.size)
        self._videos = torch.empty((capacity, *self._shape, 4), dtype=torch.uint8, device=device)
        self.device = self._videos.device  # with its number: each thread has a current one of its own
        self._viewmats = torch.zeros(capacity, rig.n_cams, 4, 4, device=device)
        self._Ks = torch.zeros(capacity, rig.n_cams, 3, 3, device=device)
        self._origins = torch.zeros(capacity, 3, dtype=torch.float64, device=device)
        self._names, n_points = tuple(sorted(set(world.actors))), len(world.actors)
        self._actions = torch.zeros(capacity, world.n_frames, n_points, 3, device=device)
        self._types = torch.full((capacity, n_points), -1, device=device)
        self._type_of = torch.tensor([self._names.index(name) for name in world.actors], device=device)
        self._near, self._far = rig.near, rig.far
        self.lock = threading.RLock()  # held while trajectories come or are read
        self.stream: torch.cuda.Stream | None = None  # in which they do, on a GPU
        if self.device.type == "cuda":  # in the stream of training they would wait for the step that runs
            self.stream = torch.cuda.Stream(self.device, priority=-1)  # does not share its queue
            self.stream.wait_stream(torch.cuda.current_stream(self.device))  # which clears the memory above
        self.trajectories = [
            Trajectory(
                slot, Path(f"trajectory_{slot}"), *self._shape[:2], rig.size, rig.size, world.fps, bool(self._names)
            )
            for slot in range(capacity)
        ]

    def put(self, images: Tensor, viewmats: Tensor, Ks: Tensor, actions: Tensor | None = None) -> None:
        """Stores a trajectory, as :func:`gsim3d.synth.run.write_trajectory` writes it."""
        rig = Rig(viewmats.numpy(), Ks.numpy(), images.shape[2], self._near, self._far)
        with self.lock, torch.cuda.stream(self.stream):
            slot = self.count % self.capacity
            stored = (self._videos, images), (self._viewmats, viewmats), (self._Ks, Ks)
            for whole, values in (*stored, (self._origins, torch.from_numpy(workspace_origin(rig)))):
                whole[slot].copy_(values)
            if actions is not None:
                n_points = actions.shape[1]
                self._actions[slot, :, :n_points].copy_(actions)
                self._types[slot] = -1
                self._types[slot, :n_points] = self._type_of[:n_points]
            if self.stream is not None:
                self.stream.synchronize()
            self.count += 1

    def draw(self, data: DataConfig, phase: PhaseConfig, seed: int, step: int, samples: Sequence[int]) -> Batch:
        """As :func:`gsim3d.train.samples.draw_batch`, of the trajectories that are there."""
        with self.lock:
            known = self.trajectories[: min(self.count, self.capacity)]
            windows = draw_windows(known, data, phase, seed, step, samples)
            n_context = windows[0].n_context
            frames = partial(self._frames, windows, data.near_far or (self._near, self._far))
            context = frames([window.context_cams for window in windows], range(n_context))
            targets = frames([window.target_cams for window in windows], range(n_context + phase.horizon))
            context = dataclasses.replace(context, actions=self._acting(windows))
        noise = draw_noise(data, n_context, seed, step, samples)
        batch = Batch(subsampled(context, data), targets, n_context, phase.horizon, phase.cut, noise)
        return batch.to(self.device)

    def _acting(self, windows: Sequence[Window]) -> Actions | None:
        """The actions of the windows; None: the world has no actors."""
        if not self._names:
            return None
        slots = torch.tensor([window.scene.slot for window in windows], device=self.device)
        steps = torch.tensor([window.steps for window in windows], device=self.device)
        positions, types = self._actions[slots[:, None], steps], self._types[slots, None].expand(*steps.shape, -1)
        return Actions(positions, types, self._names)

    def _frames(self, windows: Sequence[Window], depths: tuple[float, float], cams: Sequence, steps: range) -> Frames:
        """Some steps of the windows, seen by the cameras of each step."""
        n_views, (n_frames, n_cams, height, width) = len(cams[0][0]), self._shape
        slots = torch.tensor([window.scene.slot for window in windows], device=self.device)
        numbers = [
            ((window.scene.slot * n_frames + window.steps[step]) * n_cams + cam, window.scene.slot * n_cams + cam)
            for window, by_step in zip(windows, cams, strict=True)
            for step in steps
            for cam in by_step[step]
        ]
        image, cam = torch.tensor(numbers, device=self.device).T
        n_clouds = len(windows) * len(steps)
        cloud = torch.arange(n_clouds, device=self.device)
        pixels = self._videos.view(-1, height, width, 4)[image]
        labels, depth = pixels[..., 3], torch.ones(len(numbers), device=self.device)
        return Frames(
            images=pixels[..., :3].permute(0, 3, 1, 2).float().contiguous().div_(255),
            cameras=Cameras(
                self._viewmats.flatten(0, 1)[cam],
                self._Ks.flatten(0, 1)[cam],
                depth * depths[0],
                depth * depths[1],
                cloud.repeat_interleave(n_views),
                width,
                height,
            ),
            cloud_scene=cloud // len(steps),
            cloud_step=cloud % len(steps),
            origin=self._origins[slots],
            masks=labels != BACKGROUND,
            dynamic=labels == MOVING,
        )


def turn_of(process: Processes, first: int) -> int:
    """Which of as many numbers as there are processes is this one's; drawn anew in every round, else a process would
    always have the same few objects."""
    return (process.rank + int(generator(0, first, 0, "place").integers(process.count))) % process.count


class DataWorkers:
    """Processes that simulate and record one trajectory after another, from number ``first`` on, into a store.

    Trajectory n is the n-th of the world's list (one of each object in turn), whatever ``n_trajectories`` says; each
    number is made once. Use as a context; leaving it ends the processes.

    Args:
        world: of the trajectories.
        store: that receives them.
        first: number of the first one.
        processes: data workers.
        cache: folder for files on their way; None: a temporary one.
        together: training processes that have data workers of their own, each other numbers; any of each object.
    Attributes:
        next: the smallest number from which on no process was given any.
    """

    def __init__(
        self,
        world: World,
        store: TrajectoryStore,
        first: int,
        processes: int,
        cache: str | Path | None = None,
        together: Processes | None = None,
    ):
        self._world, self._store, self.next = world, store, first
        self._together = together or Processes()
        self._processes, self._names = processes, world.object_names()
        self._wanted, self._begun = processes * QUEUED, 0
        self._cache = Path(tempfile.mkdtemp(prefix="trajectories_", dir=cache))
        self._running = True
        self._failure: BaseException | None = None
        self._arrived = threading.Condition()

    def __enter__(self) -> DataWorkers:
        context = multiprocessing.get_context("spawn")
        self._pool = ProcessPoolExecutor(self._processes, context, start_data_worker)
        threads = os.environ.get("OMP_NUM_THREADS")
        os.environ["OMP_NUM_THREADS"] = "1"  # of the processes that start now
        try:
            self._begin()
        finally:
            os.environ.pop("OMP_NUM_THREADS") if threads is None else os.environ.update(OMP_NUM_THREADS=threads)
        return self

    def __exit__(self, *_) -> None:
        self._running = False
        for process in list((self._pool._processes or {}).values()):
            process.terminate()  # none of them has anything to finish
        self._pool.shutdown(wait=True, cancel_futures=True)
        shutil.rmtree(self._cache, ignore_errors=True)

    @property
    def count(self) -> int:
        """Trajectories that have arrived."""
        return self._store.count

    def wait_for(self, count: int, seconds: float) -> bool:
        """Waits until the store has seen ``count`` trajectories; False where ``seconds`` passed before."""
        with self._arrived:
            done = self._arrived.wait_for(lambda: self._failure or self._store.count >= count, seconds)
        self.check()
        return bool(done)

    def check(self) -> None:
        """Raises what a process raised."""
        if self._failure is not None:
            raise self._failure

    def _begin(self) -> None:
        """Hands out trajectories until as many are being made as wanted."""
        while self._begun < self._wanted:
            number, names = self.next + turn_of(self._together, self.next), self._names
            self.next, self._begun = self.next + self._together.count, self._begun + 1
            scene = names[number % len(names)], number // len(names)
            job = self._pool.submit(write_trajectory, self._world, scene, str(self._cache / f"{number}.safetensors"))
            job.add_done_callback(self._take)

    def _take(self, job: Future) -> None:
        """Moves a trajectory that a worker has made into the store; called in a thread of the pool."""
        if not self._running:
            return
        try:
            file = Path(job.result())
            self._store.put(**load_file(file))
            file.unlink()
            self._begun -= 1
            self._begin()
        except BaseException as error:  # raised by check() in the thread that trains
            self._failure = self._failure or error
        with self._arrived:
            self._arrived.notify_all()
