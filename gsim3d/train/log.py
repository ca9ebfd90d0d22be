"""Logging of a run: JSON lines, TensorBoard, Weights & Biases, profiler traces and the progress bar."""

from __future__ import annotations

import io
import json
import math
import resource
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.profiler import ProfilerActivity, profile, schedule

from gsim3d.data import Scene, make_frames
from gsim3d.effects.plan import Plan
from gsim3d.errors import InputError
from gsim3d.io.files import whole_file
from gsim3d.io.plain import is_number
from gsim3d.simulator import Simulator
from gsim3d.state import Gaussians, Particles, concatenate
from gsim3d.train.config import DataConfig, PhaseConfig
from gsim3d.train.samples import context_cameras, spread_views, subsampled

LOG, BOARD = "metrics.jsonl", "tensorboard"
MAX_LINE = 2**20  # bytes; longer lines are not log entries
MAX_LOG = 2**30  # bytes; enough for millions of steps
VIDEO_MS = 80  # duration of a frame of a sample video
TRACES = "profile"  # folder
SKIPPED, WARM_UP, TRACED = 1, 1, 2  # steps before, warm-up and recorded steps of a trace


class Log:
    """The log of a run folder.

    Attributes:
        file: file of JSON lines.
        writes: whether this process writes it.
        board: TensorBoard logger while open, or None.
        wandb: Weights & Biases logger while open, or None.
    """

    def __init__(self, out: Path, *, writes: bool = True):
        self.file, self.writes = out / LOG, writes
        self.board: Board | None = None
        self.wandb: Wandb | None = None
        self._stream = None

    def cut(self, step: int) -> None:
        """Removes the entries from ``step`` on, which will be repeated. Raises InputError if the log is not a file, or
        cannot be read or written."""
        if not self.writes or not self.file.exists():
            return
        if not self.file.is_file():
            raise InputError(f"{self.file}: cannot be read: it is not a file")
        if (size := self.file.stat().st_size) > MAX_LOG:
            raise InputError(f"{self.file}: has {size} bytes, a log has at most {MAX_LOG}; move it away")
        try:
            with whole_file(self.file) as part, open(self.file, "rb") as lines, open(part, "wb") as retained:
                while line := lines.readline(MAX_LINE):
                    if (entry := read_entry(line)) and entry["step"] < step:
                        retained.write(line.rstrip(b"\r\n") + b"\n")
        except OSError as error:
            raise InputError(f"{self.file}: cannot be cut to step {step}: {error.strerror}") from None

    @contextmanager
    def opened(self, *, tensorboard: bool = False, wandb: dict | None = None) -> Iterator[None]:
        """Context in which entries are written, optionally also to TensorBoard and Weights & Biases.

        Args:
            tensorboard: log to TensorBoard.
            wandb: configuration of a Weights & Biases run. Default: none.
        """
        if not self.writes:
            yield
            return
        with open(self.file, "a") as self._stream:
            self.board = Board(self.file.parent / BOARD) if tensorboard else None
            self.wandb = None if wandb is None else Wandb(self.file.parent, wandb)
            try:
                yield
            finally:
                for logger in self._loggers:
                    logger.close()
                self.board = self.wandb = self._stream = None

    @property
    def _loggers(self) -> list[Board | Wandb]:
        return [logger for logger in (self.board, self.wandb) if logger is not None]

    def write(self, entry: dict, machine: dict) -> None:
        """Writes ``entry``, which is reproducible, and ``machine``, time and memory, which are not."""
        if self._stream is not None:
            rounded = {name: round(value, 4) for name, value in machine.items()}
            try:
                self._stream.write(json.dumps({**entry, "machine": rounded}) + "\n")
                self._stream.flush()
            except OSError as error:
                raise InputError(
                    f"{self.file}: cannot be written: {error.strerror}; free some space and train again"
                ) from None
            for logger in self._loggers:
                logger.scalars(dict(_numbers({**entry, **machine}, "train")), entry["step"])


def _numbers(values: dict, prefix: str) -> Iterator[tuple[str, float]]:
    """Flattens nested dicts and lists; yields names "prefix/key/..." and numbers."""
    for name, value in values.items():
        if isinstance(value, list):
            value = {str(i + 1): item for i, item in enumerate(value)}
        if isinstance(value, dict):
            yield from _numbers(value, f"{prefix}/{name}")
        elif isinstance(value, (int, float)) and name != "step":
            yield f"{prefix}/{name}", value


class Wandb:
    """Logger to Weights & Biases, controlled by its environment variables.

    Raises:
        InputError: the package is not installed, or a run cannot be started.
    """

    def __init__(self, out: Path, config: dict):
        try:
            import wandb
        except ImportError:
            raise InputError("--wandb needs the package wandb: pip install 'gsim3d[wandb]'") from None
        try:
            self._run = wandb.init(project="gsim3d", name=out.resolve().name, dir=str(out), config=config)
        except wandb.Error as error:
            raise InputError(f"--wandb: {error}; set WANDB_MODE=offline to log without an account") from None

    def scalars(self, values: dict[str, float], step: int) -> None:
        self._run.log(values, step=step)

    def close(self) -> None:
        self._run.finish()


class Board:
    """Logger to TensorBoard. Raises InputError if the package is not installed."""

    def __init__(self, folder: Path):
        try:
            from torch.utils.tensorboard import SummaryWriter
        except ImportError:
            raise InputError("--tensorboard needs the package tensorboard: pip install 'gsim3d[tensorboard]'") from None
        self._writer = SummaryWriter(str(folder))

    def scalars(self, values: dict[str, float], step: int) -> None:
        for name, value in values.items():
            self._writer.add_scalar(name, value, step)

    def video(self, frames: Tensor, step: int) -> None:
        """Logs ``frames``, uint8 [T, H, W, 3], as an animated image."""
        from PIL import Image
        from tensorboard.compat.proto.summary_pb2 import Summary

        first, *others = (Image.fromarray(frame.numpy()) for frame in frames)
        gif = io.BytesIO()
        first.save(gif, "gif", save_all=True, append_images=others, duration=VIDEO_MS, loop=0)
        image = Summary.Image(
            height=frames.shape[1], width=frames.shape[2], colorspace=3, encoded_image_string=gif.getvalue()
        )
        summary = Summary(value=[Summary.Value(tag="sample/true, predicted", image=image)])
        self._writer._get_file_writer().add_summary(summary, step)

    def close(self) -> None:
        self._writer.close()


@dataclass(frozen=True)
class Sample:
    """A prediction of the first window of a scene."""

    particles: Particles  #: one cloud per step
    gaussians: Gaussians  #: decoded Gaussians
    n_given: int  #: number of encoded steps
    scene: Scene  #: the scene
    cam: int  #: camera of the sample video


@torch.no_grad()
def draw_sample(
    simulator: Simulator, plan: Plan, scene: Scene, data: DataConfig, phase: PhaseConfig, device: str
) -> Sample:
    """Predicts the first window of ``scene`` with the current weights."""
    n_past, cams = phase.history or data.history, context_cameras(scene, data)
    frames = make_frames([scene], [spread_views(cams, data.context_views, 0)], [list(range(n_past))])
    with _evaluating(simulator):
        state = simulator.encode(subsampled(frames, data).to(device), on_invalid="drop")
        if phase.horizon:
            state = concatenate([state, *simulator.rollout(state, phase.horizon, plan, on_invalid="drop")])
        return Sample(state, simulator.renderer(state, sh_degree=plan.sh_degree), n_past, scene, cams[0])


@contextmanager
def _evaluating(simulator: Simulator) -> Iterator[None]:
    simulator.eval()
    try:
        yield
    finally:
        simulator.train()


@torch.no_grad()
def sample_video(simulator: Simulator, plan: Plan, sample: Sample) -> Tensor:
    """Renders a sample next to the recorded images, uint8 [T, H, 2 W, 3]."""
    scene, steps, particles = sample.scene, range(sample.particles.n_clouds), sample.particles
    cameras = scene.cameras_at([sample.cam], steps).to(particles.means.device)
    with _evaluating(simulator):
        predicted = simulator.render(particles, cameras, plan=plan, on_invalid="drop").color
    recorded = scene.images([sample.cam], steps)[:, 0].permute(0, 2, 3, 1)
    return torch.cat([recorded, (predicted.clamp(0, 1) * 255).round().to(torch.uint8).cpu()], 2)


def memory_gib(device: str) -> float:
    """Returns the peak memory: of tensors on a GPU, or of the process on a CPU."""
    if device == "cuda":
        return torch.cuda.max_memory_allocated() / 2**30
    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 2**30


def progress_note(entry: dict, machine: dict) -> str:
    """Returns the postfix of the progress bar."""
    values = {name: entry.get(f"{name}_psnr") for name in ("past", "future")}
    parts = [f"{name} {value:.1f} dB" for name, value in values.items() if isinstance(value, float)]
    parts += [f"{machine['step_seconds']:.2f} s/step", f"{machine['memory_gib']:.1f} GiB"]
    return ", ".join(parts + ["skipped"] * ("skipped" in entry))


def plain(value: Any) -> Any:
    """Converts numbers that are not finite to strings, because JSON has no NaN."""
    if isinstance(value, dict):
        return {name: plain(item) for name, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    return str(value) if isinstance(value, float) and not math.isfinite(value) else value


def read_entry(line: bytes) -> dict[str, Any] | None:
    """Parses a line of a log; returns None if it is truncated or damaged."""
    try:
        entry = json.loads(line)
    except (ValueError, RecursionError):
        return None
    return entry if isinstance(entry, dict) and is_number(entry.get("step"), int) else None


def profiler(out: Path, rank: int, n_steps: int) -> profile:
    """Returns a profiler that writes ``out/profile/process_<rank>.json`` after its traced steps. Raises InputError if
    ``n_steps``, those of the run, are too few."""
    if n_steps < SKIPPED + WARM_UP + TRACED:
        raise InputError(f"--profile traces steps 3 and 4 of a run; this one has {n_steps}")
    folder = out / TRACES
    folder.mkdir(parents=True, exist_ok=True)
    file = folder / f"process_{rank}.json"

    def write(traced: profile) -> None:
        with whole_file(file) as part:
            traced.export_chrome_trace(str(part))

    activities = [ProfilerActivity.CPU] + [ProfilerActivity.CUDA] * torch.cuda.is_available()
    plan = schedule(wait=SKIPPED, warmup=WARM_UP, active=TRACED, repeat=1)
    return profile(activities=activities, schedule=plan, on_trace_ready=write, profile_memory=True)
