"""One run: a trainer that goes by the clock, on trajectories that data workers make meanwhile."""

import dataclasses
import math
import time
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path

import torch

from gsim3d.errors import NumericalError, RunStopped
from gsim3d.train.captured import CapturedLoss, Prepared
from gsim3d.train.config import PhaseConfig, TrainConfig
from gsim3d.train.log import memory_gib
from gsim3d.train.loop import Trainer, deterministic
from gsim3d.train.processes import Processes
from gsim3d.train.samples import Batch
from tools.release.recipes import of_processes
from tools.release.state import CURVE, Progress, save_state, save_weights
from tools.release.trajectories import DataWorkers, TrajectoryStore

WARM_UP = 50  # steps after each start: first moments begin at zero
AVERAGED = 0.99  # decay of the averaged weights, at which the next run begins: a slower average would lag behind
COOL_DOWN = 0.5  # share of a last run in which the learning rate falls to LAST_RATE of its peak
LAST_RATE = 0.01
SAVE_EVERY = 120.0  # seconds
SCORED_EVERY = 10_000  # windows between checkpoints that are scored on the way


class RunTrainer(Trainer):
    """Trains on what a store holds; the learning rate rises once a run, stays, and falls in the last run.

    Each of several processes draws a batch of the configuration's size from a store of its own; all go by the clock of
    the first one.
    """

    def __init__(
        self, config: TrainConfig, store: TrajectoryStore, out: Path, device: str, processes: Processes | None = None
    ):
        self.store = store
        averaged = dataclasses.replace(config.optimizer, ema_decay=AVERAGED)
        config = dataclasses.replace(of_processes(config, processes.count if processes else 1), optimizer=averaged)
        super().__init__(config, store.trajectories[:1], out, device=device, processes=processes)
        self.first_step, self.begin, self.now, self.end, self.is_last = 0, 0.0, 0.0, math.inf, False
        self.gone: str | None = None
        self.new_parameters: list[str] = []
        self.data_seconds = 0.0  # for which the last step waited for its batch
        self._next: tuple[int, Future] | None = None
        self._reader = ThreadPoolExecutor(1)

    def _capture(self) -> CapturedLoss:
        captured = super()._capture()
        captured.alone, captured.meanwhile = self.store.lock, self._draw_next
        return captured

    def begin_run(self, end: float, *, is_last: bool = False) -> None:
        """From now to ``end``, on the clock of time.monotonic."""
        self.processes.check_same(weights=self.parameters.values())
        self.begin, self.end = self.processes.gather((time.monotonic(), end))[0]
        self.first_step, self.now, self.is_last = self.step, self.begin, is_last
        self.out.mkdir(parents=True, exist_ok=True)
        self.simulator.train()

    def goes_on(self) -> bool:
        """Reads the clock: whether the run is not over, and no process of it is gone."""
        seen = self.processes.gather((time.monotonic(), self.processes.lost))
        self.now, self.gone = seen[0][0], next((lost for _, lost in seen if lost), None)
        return self.now < self.end and self.gone is None

    def learning_rate(self, phase: PhaseConfig, number: int) -> float:
        rate = phase.learning_rate * min(1.0, (self.step - self.first_step + 1) / WARM_UP)
        if not self.is_last:
            return rate
        left = max(0.0, self.end - self.now) / max(1e-9, self.end - self.begin)
        return rate * (LAST_RATE + (1 - LAST_RATE) * min(1.0, left / COOL_DOWN))

    def _batch(self, samples: list[int]) -> Batch:
        return self._draw(self.step, samples)

    def _draw(self, step: int, samples: Sequence[int]) -> Batch:
        phase, _ = self.config.phase_of(step)
        return self.store.draw(self.config.data, phase, self.config.seed, step, samples)

    def _prepared(self, samples: list[int]) -> Prepared:
        """Drawn while the GPU computed the step before."""
        ahead = self._next if self._next is not None and self._next[0] == self.step else self._begin_to_draw(self.step)
        start = time.perf_counter()
        # The last one was copied by a step that is over: only now may its memory be used anew.
        self._read = ahead[1].result()
        self.data_seconds = time.perf_counter() - start
        return self._read

    def _draw_next(self) -> None:
        self._next = self._begin_to_draw(self.step + 1)

    def _begin_to_draw(self, step: int) -> tuple[int, Future]:
        return step, self._reader.submit(self._draw_ahead, step)

    @torch.no_grad()
    def _draw_ahead(self, step: int) -> Prepared:
        """Draws a batch in the store's stream."""
        phase, _ = self.config.phase_of(step)
        if self.store.stream is not None:
            torch.cuda.set_device(self.store.device)  # of this thread
        with self.store.lock, torch.cuda.stream(self.store.stream):
            prepared = self.captured.prepare(self._draw(step, self.processes.share(phase.batch)))
            if self.store.stream is not None:
                self.store.stream.synchronize()
        return prepared


def train(
    trainer: RunTrainer,
    workers: DataWorkers,
    progress: Progress,
    about: dict,
    *,
    end: float,
    out: Path,
    name: str,
    is_last: bool = False,
    say: Callable[[str], None] = print,
) -> Progress:
    """Trains until the clock (time.monotonic) shows ``end``; saves on the way and at last.

    Args:
        trainer: of the run.
        workers: that make its trajectories.
        progress: before this run.
        about: what the progress keeps of this run, beside steps, seconds and trajectories.
        out: folder of the state; checkpoints to be scored go to ``out/scored``.
        name: of the run's files.
        is_last: whether the learning rate falls.
        say: receives a line for every logged step.
    Returns:
        The progress after it.
    Raises:
        NumericalError: too many steps in a row were skipped.
        RunStopped: the launcher or a partner is gone; the state is saved.
    """
    settings, gather, is_first = trainer.config, trainer.processes.gather, trainer.processes.is_first
    first, before, curve = trainer.step, trainer.seconds, list(progress.curve)
    windows = progress.windows

    def save() -> Progress:
        this = {
            **about,
            "steps": [first, trainer.step],
            "windows": [progress.windows, windows],
            "training_seconds": round(trainer.seconds - before, 1),
            "trajectories": sum(gather(workers.count)),
        }
        known = {"next_trajectory": max(gather(workers.next)), "runs": [*progress.runs, this], "windows": windows}
        if trainer.captured:
            for needed in gather(trainer.captured.needed):
                trainer.captured.reserve(needed)
            known["needed"] = trainer.captured.needed
        done = dataclasses.replace(progress, **known, curve=curve)
        return save_state(trainer, out, name, done) if is_first else done

    trainer.begin_run(end, is_last=is_last)
    saved = trainer.begin
    with deterministic(), trainer.log.opened(tensorboard=False):
        while trainer.goes_on():
            phase, _ = settings.phase_of(trainer.step)
            start = time.perf_counter()
            entry = trainer.train_step()
            spent = time.perf_counter() - start
            trainer.seconds += spent
            was, windows = windows, windows + phase.batch * (phase.horizon > 0)
            if entry["step"] % settings.log_every == 0 or "skipped" in entry:
                machine = {"seconds": trainer.seconds, "step_seconds": spent, "data_seconds": trainer.data_seconds}
                machine["memory_gib"] = memory_gib(trainer.device)
                entry |= {
                    "windows": windows,
                    "trajectories": sum(gather(workers.count)),
                    "captures": trainer.captured.captures if trainer.captured else 0,
                }
                trainer.log.write(entry, machine)
                say(line(entry, machine))
                row = {**entry, **machine}
                curve.append([math.nan if row.get(column) is None else float(row[column]) for column in CURVE])
            if trainer.n_skipped_in_a_row >= settings.optimizer.max_skipped:
                raise NumericalError(f"{name}: step {entry['step']}: {entry['skipped']}", step=entry["step"])
            workers.check()
            if is_first and windows // SCORED_EVERY > was // SCORED_EVERY:
                save_weights(trainer, out / "scored" / f"{name}.{windows:07d}.weights.safetensors")
            if trainer.now - saved > SAVE_EVERY:
                save()
                saved = trainer.now
    done = save()
    if trainer.gone:
        raise RunStopped(f"{trainer.gone}; the state of step {trainer.step} is saved, call again to go on")
    trainer.processes.check_same(weights=trainer.parameters.values())
    return done


def line(entry: dict, machine: dict) -> str:
    """What is printed of a step."""
    if "skipped" in entry:  # its numbers may be none
        return f"step {entry['step']:6d}  skipped: {entry['skipped']}"
    known = {name: entry.get(f"{name}_psnr") for name in ("past", "future")}
    decibels = " ".join(f"{name} {value:.2f}" for name, value in known.items() if isinstance(value, float))
    return (
        f"step {entry['step']:6d}  windows {entry['windows']:7d}  loss {entry['loss']:.5f}  {decibels} dB  "
        f"norm {entry['grad_norm']:.3f}  rate {entry['learning_rate']:.1e}  {machine['step_seconds']:.3f} s, "
        f"{machine['data_seconds']:.3f} of it for data  "
        f"{machine['memory_gib']:.1f} GiB  {entry['particles']:.0f} particles  {entry['trajectories']} trajectories  "
        f"{entry['captures']} captures"
    )
